"""All decisions about time, as pure functions of the frames seen so far; no clock is read here.

Conventions. A frame is known by its `Mark`: the epoch of its publisher (new at every start of it), the sequence number
in that epoch, and the sensor's stamp in nanoseconds. Two clocks occur and are never mixed: sensor stamps, and the local
monotonic clock (`now_ns`), which serves only for waiting.

A stream is cut into *eras*: a new one begins with every publisher epoch and with every jump of the stamps. A
*generation* is what one density lives through: eras that only continue another share it, a restart begins the next
one. Where the cuts lie follows from the frames in their publisher's order, epoch by epoch and number by number
(`Course.follow`); within an era frames are processed by stamp, equal stamps by sequence number.

Both are functions of which frames there are, not of when each came. So a frame that comes late is put where it belongs,
also before a cut, and the cuts move as they must: `Timeline.places` says where every frame of the window belongs now.
Behind the window nothing moves any more. What is later than that is `Verdict.LATE`.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass, replace
from enum import StrEnum, unique
from typing import Final

WINDOW: Final = 1024
"""How many sequence numbers back a frame of an epoch is remembered; older unseen ones count as late."""

EPOCHS: Final = 32
"""How many publisher epochs are remembered."""


@unique
class Verdict(StrEnum):
    """What becomes of a frame."""

    FIRST = "first"
    """The first frame of the stream: a session begins."""
    NEXT = "next"
    """In order: it continues the density."""
    NEW_EPOCH = "new_epoch"
    """The publisher was restarted and its stamps go on: the density is kept, sequence numbers begin anew."""
    RESTART = "restart"
    """The stamps jumped, ahead or back: this session begins anew with this frame."""
    INSERTED = "inserted"
    """Frames behind it came before it, and it is inside the window: it is put in its place."""
    DUPLICATE = "duplicate"
    """The same epoch and sequence number came before: dropped."""
    LATE = "late"
    """Frames behind it can no longer be taken back: refused."""
    RETIRED = "retired"
    """From a publisher epoch that another one has succeeded: refused."""

    @property
    def admitted(self) -> bool:
        """Whether the frame is to be processed."""
        return self not in _REFUSED


_REFUSED: Final = frozenset({Verdict.DUPLICATE, Verdict.LATE, Verdict.RETIRED})


@dataclass(frozen=True, slots=True)
class Mark:
    """What identifies and orders a frame.

    Attributes:
        epoch: 16 bytes, new at every start of the publisher.
        seq: counts the publisher's frames in the epoch.
        stamp_ns: sensor time, nanoseconds.
    """

    epoch: bytes
    seq: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Place:
    """Where a frame belongs among the others.

    Attributes:
        era: the era that it belongs to.
        generation: counts restarts; a frame of a higher generation than the one before it starts the session anew.
        floor_ns: in an era that continues another, the stamp that the other one reached; None elsewhere.
        opens: whether it begins its era, and how: first, new_epoch, restart; next where it does not.
        jump_ns: how far its stamp lies from the newest one before it in its publisher's order.
    """

    era: int
    generation: int
    floor_ns: int | None
    opens: Verdict
    jump_ns: int

    def order(self, mark: Mark) -> tuple[int, int, int]:
        """Return the key by which frames are processed."""
        return self.era, mark.stamp_ns, mark.seq


@dataclass(frozen=True, slots=True)
class Course:
    """What frames up to some point mean for the one that follows them.

    Attributes:
        epoch: publisher epoch of the last one, None before the first.
        seq: highest sequence number in it.
        era: number of its era.
        generation: number of restarts.
        newest_ns: highest stamp of the era.
        floor_ns: see `Place`.
    """

    epoch: bytes | None = None
    seq: int = 0
    era: int = 0
    generation: int = 0
    newest_ns: int = 0
    floor_ns: int | None = None

    def follow(self, mark: Mark, gap_limit_ns: int) -> Place:
        """Return the place of the frame that comes next in its publisher's order."""
        if self.epoch is None:
            return Place(self.era + 1, self.generation, None, Verdict.FIRST, 0)
        jump_ns = mark.stamp_ns - self.newest_ns
        if mark.epoch != self.epoch and 0 < jump_ns <= gap_limit_ns:
            return Place(self.era + 1, self.generation, self.newest_ns, Verdict.NEW_EPOCH, jump_ns)
        if mark.epoch != self.epoch or abs(jump_ns) > gap_limit_ns:
            return Place(self.era + 1, self.generation + 1, None, Verdict.RESTART, jump_ns)
        return Place(self.era, self.generation, self.floor_ns, Verdict.NEXT, jump_ns)

    def after(self, mark: Mark, place: Place) -> Course:
        """Return the course after a frame at its place."""
        newest_ns = max(self.newest_ns, mark.stamp_ns) if place.era == self.era else mark.stamp_ns
        seq = max(self.seq, mark.seq) if mark.epoch == self.epoch else mark.seq
        return Course(mark.epoch, seq, place.era, place.generation, newest_ns, place.floor_ns)


@dataclass(frozen=True, slots=True)
class Seen:
    """Which frames of an epoch came.

    Attributes:
        epoch: whose.
        highest: highest sequence number.
        mask: bit i says whether `highest - i` came, for i below `WINDOW`.
    """

    epoch: bytes
    highest: int
    mask: int

    def has(self, seq: int) -> bool:
        """Whether a sequence number came, as far as that is remembered."""
        return 0 <= self.highest - seq < WINDOW and bool(self.mask >> (self.highest - seq) & 1)

    def add(self, seq: int) -> Seen:
        """Return it with one more sequence number."""
        ahead = seq - self.highest
        if ahead <= 0:
            return Seen(self.epoch, self.highest, self.mask | 1 << -ahead)
        # A sequence number may leap by 2^60: never shift further than the window is wide.
        shifted = self.mask << ahead if ahead < WINDOW else 0
        return Seen(self.epoch, seq, (shifted | 1) & ((1 << WINDOW) - 1))


@dataclass(frozen=True, slots=True)
class Decision:
    """The verdict on one frame.

    Attributes:
        verdict: what becomes of it.
        place: where it belongs when it is admitted; for the others only how far it lay from the newest means something.
        last: whether it is admitted behind all others and moves none of them.
    """

    verdict: Verdict
    place: Place
    last: bool = False


@dataclass(frozen=True, slots=True)
class Timeline:
    """What is remembered of the frames of a stream.

    Attributes:
        gap_limit_ns: a step of the stamps beyond this, ahead or back, is a jump.
        epochs: what came of each epoch, in the order of their appearance; the last one is in force.
        base: the course up to the window.
        floor: the last frame before the window in the order of processing; nothing goes before it.
        marks: the frames of the window in their publisher's order.
        tip: the course after all of them.
    """

    gap_limit_ns: int
    epochs: tuple[Seen, ...] = ()
    base: Course = Course()
    floor: Mark | None = None
    marks: tuple[Mark, ...] = ()
    tip: Course = Course()

    def judge(self, mark: Mark) -> tuple[Decision, Timeline]:
        """Decide on a frame that arrived; the second result replaces this timeline."""
        number = self._number(mark.epoch)
        if number < 0:
            return self._append(mark, number)
        seen = self.epochs[number]
        if seen.has(mark.seq):
            return self._refuse(mark, Verdict.DUPLICATE)
        if seen.highest - mark.seq >= WINDOW:
            return self._refuse(mark, Verdict.LATE)
        newest = number == len(self.epochs) - 1 and mark.seq > seen.highest
        return self._append(mark, number) if newest else self._insert(mark, number)

    def places(self) -> dict[Mark, Place]:
        """Return where each frame of the window belongs."""
        return dict(zip(self.marks, self._arrange(self.marks)[0], strict=True))

    @classmethod
    def resume(
        cls, gap_limit_ns: int, epochs: tuple[Seen, ...], base: Course, floor: Mark | None, marks: frozenset[Mark]
    ) -> Timeline:
        """Return the timeline that had these parts."""
        timeline = cls(gap_limit_ns, epochs, base, floor)
        ordered = tuple(sorted(marks, key=lambda one: (timeline._number(one.epoch), one.seq)))
        return replace(timeline, marks=ordered, tip=timeline._arrange(ordered)[1])

    def knows(self, epoch: bytes) -> bool:
        """Whether frames came in an epoch."""
        return self._number(epoch) >= 0

    def note(self, mark: Mark) -> Timeline:
        """Remember that a frame came which is not to be processed, so that it is not looked at again."""
        return replace(self, epochs=self._remember(mark, self._number(mark.epoch)))

    def settle(self, base: Course, floor: Mark | None, gone: frozenset[Mark]) -> Timeline:
        """Return it with a later beginning of the window: `gone` are the frames that fell out of it."""
        marks = self.marks[len(gone) :]  # mostly it was the oldest that went
        if gone != frozenset(self.marks[: len(gone)]):
            marks = tuple(mark for mark in self.marks if mark not in gone)
        return Timeline(self.gap_limit_ns, self.epochs, base, floor, marks, self.tip)

    def complete_until(self, mark: Mark, processed: tuple[bytes, int] | None) -> bool:
        """Whether no frame is missing between the last one processed of its epoch and this one."""
        number = self._number(mark.epoch)
        first = processed[1] + 1 if processed is not None and processed[0] == mark.epoch else 0
        if mark.seq - first > WINDOW or (number < 0 and mark.seq > first):
            return False
        return all(self.epochs[number].has(seq) for seq in range(first, mark.seq))

    # How

    def _append(self, mark: Mark, number: int) -> tuple[Decision, Timeline]:
        """Take a frame that is the last one in its publisher's order."""
        place = self.tip.follow(mark, self.gap_limit_ns)
        if not self._free(mark, place):
            return self._refuse(mark, Verdict.LATE)
        behind = place.era == self.tip.era and mark.stamp_ns < self.tip.newest_ns
        epochs, marks, tip = self._remember(mark, number), (*self.marks, mark), self.tip.after(mark, place)
        timeline = Timeline(self.gap_limit_ns, epochs, self.base, self.floor, marks, tip)
        return Decision(Verdict.INSERTED if behind else place.opens, place, last=not behind), timeline

    def _insert(self, mark: Mark, number: int) -> tuple[Decision, Timeline]:
        """Take a frame that others came before which its publisher sent after it."""
        seen = self.epochs[number]
        succeeded = number < len(self.epochs) - 1 and mark.seq > seen.highest
        refusal = Verdict.RETIRED if succeeded else Verdict.LATE
        if number < self._number(self.base.epoch):
            return self._refuse(mark, refusal)
        at = bisect(self.marks, (number, mark.seq), key=lambda one: (self._number(one.epoch), one.seq))
        marks = (*self.marks[:at], mark, *self.marks[at:])
        places, tip = self._arrange(marks)
        place = places[at]
        if not all(map(self._free, marks, places)):
            return self._refuse(mark, refusal)
        if mark.epoch == self.base.epoch and mark.seq < self.base.seq and place.opens is not Verdict.NEXT:
            # What was sent before the window cannot be what opens an era behind it: it merely took long.
            return self._refuse(mark, refusal)
        if succeeded and not self._before_successor(at, places):
            return self._refuse(mark, refusal)
        order = place.order(mark)
        behind = any(other.order(one) > order for one, other in zip(marks, places, strict=True))
        last = not behind and at == len(self.marks)
        timeline = replace(self, epochs=self._remember(mark, number), marks=marks, tip=tip)
        return Decision(place.opens if last else Verdict.INSERTED, place, last=last), timeline

    def _before_successor(self, at: int, places: tuple[Place, ...]) -> bool:
        """Whether the last frame of a stopped publisher was only overtaken by its successor's first, and fits."""
        follows = at + 1 < len(places) and places[at + 1].opens is Verdict.NEW_EPOCH
        before = self._arrange(self.marks)[0]
        others = (*places[:at], *places[at + 1 :])
        return follows and [place.generation for place in others] == [place.generation for place in before]

    def _arrange(self, marks: tuple[Mark, ...]) -> tuple[tuple[Place, ...], Course]:
        course, places = self.base, []
        for mark in marks:
            place = course.follow(mark, self.gap_limit_ns)
            course = course.after(mark, place)
            places.append(place)
        return tuple(places), course

    def _free(self, mark: Mark, place: Place) -> bool:
        """Whether a place lies behind the window's beginning and behind what its era continues."""
        if place.floor_ns is not None and mark.stamp_ns <= place.floor_ns:
            return False
        if self.floor is None:
            return True
        return place.order(mark) > (self.base.era, self.floor.stamp_ns, self.floor.seq)

    def _refuse(self, mark: Mark, verdict: Verdict) -> tuple[Decision, Timeline]:
        jump_ns = 0 if self.tip.epoch is None else mark.stamp_ns - self.tip.newest_ns
        return Decision(verdict, Place(self.tip.era, self.tip.generation, None, verdict, jump_ns)), self

    def _number(self, epoch: bytes | None) -> int:
        for number in range(len(self.epochs) - 1, -1, -1):
            if self.epochs[number].epoch == epoch:
                return number
        return -1

    def _remember(self, mark: Mark, number: int) -> tuple[Seen, ...]:
        if number < 0:
            return (*self.epochs, Seen(mark.epoch, mark.seq, 1))[-EPOCHS:]
        return (*self.epochs[:number], self.epochs[number].add(mark.seq), *self.epochs[number + 1 :])


def hold_until(
    *,
    has_points: bool | None,
    stamp_ns: int,
    arrived_ns: int,
    newest_cloud_ns: int | None,
    cloud_wait_ns: int,
    cloud_memory_ns: int,
) -> int | None:
    """Until when (monotonic, ns) a frame without its point cloud waits for it; None: not at all.

    Args:
        has_points: what the frame says: a cloud comes, none comes, or nothing (None).
        stamp_ns: the frame's sensor stamp.
        arrived_ns: monotonic time of the frame's arrival.
        newest_cloud_ns: highest stamp of the clouds that the stream has sent so far.
        cloud_wait_ns: the longest wait.
        cloud_memory_ns: when the frame says nothing, it waits only if its stamp is this close to a cloud's.
    """
    if has_points is None:
        has_points = newest_cloud_ns is not None and abs(stamp_ns - newest_cloud_ns) <= cloud_memory_ns
    return arrived_ns + cloud_wait_ns if has_points and cloud_wait_ns > 0 else None

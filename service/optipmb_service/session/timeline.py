"""Timeline of a session: decisions about time, as pure functions of the frames seen so far; no clock is read here.

Conventions. A frame is known by its `FrameId`: the epoch of its publisher (new at every start of it), the sequence
number in that epoch, and the sensor's stamp in nanoseconds. Two clocks occur and are never mixed: sensor stamps, and
the local monotonic clock (`now_ns`), which serves only for waiting.

A `Timeline` remembers which frames of each sensor came, and so knows duplicates and gaps. Where a frame belongs among
the others differs, because a single publisher says in which order its frames were taken and several do not:

- `StreamTimeline`, of one sensor, follows the order of its publisher. The stream is cut into *eras*: a new one begins
  with every publisher epoch and with every jump of the stamps that several frames agree on. A *generation* is what one
  density lives through: eras that only continue another share it, a restart begins the next one. Where the cuts lie
  follows from the frames in their publisher's order, epoch by epoch and number by number (`Cursor.follow`); within an
  era frames are processed by stamp, equal stamps by sequence number.
- `FusedTimeline`, of several sensors, follows one clock that all share: frames are processed by stamp, equal stamps by
  the name of the sensor, so no sensor waits for another.

Both are functions of which frames there are, not of when each came. So a late frame is put where it belongs, also
before a cut, and the cuts move as they must: `places` says where every frame of the window belongs now. Behind the
window nothing moves any more. A later frame is `Verdict.LATE`.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import field, replace
from enum import StrEnum, unique
from typing import TYPE_CHECKING, Final, NamedTuple

from optipmb.model.rows import record
from optipmb_service.session.counts import Count  # noqa: TC001 - pydantic reads the annotation
from optipmb_service.session.identity import Epoch, SensorName, Whole  # noqa: TC001 - as above
from optipmb_service.session.policy import MAX_SENSORS, JumpLimits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.state import FilterState

WINDOW: Final = 1024
"""How many sequence numbers back a frame of an epoch is remembered; older unseen ones count as late."""

EPOCHS: Final = 32
"""How many publisher epochs of a sensor are remembered."""

JUMP_FRAMES: Final = 3
"""Frames of one epoch that must agree on a jump of the stamps before it is believed."""


@unique
class Verdict(StrEnum):
    """Decision on a frame that arrived."""

    FIRST = "first"
    """The first frame of the stream: a session begins."""
    NEXT = "next"
    """In order: it continues the density."""
    NEW_EPOCH = "new_epoch"
    """The publisher was restarted and its stamps go on: the density is kept, sequence numbers begin again."""
    RESTART = "restart"
    """The stamps jumped, ahead or back: the session restarts with this frame."""
    UNCONFIRMED = "unconfirmed"
    """The stamp jumped, and the frames before it do not agree: it has a place, and is refused when its turn comes."""
    INSERTED = "inserted"
    """Frames behind it came before it, and it is inside the window: it is put in its place."""
    DUPLICATE = "duplicate"
    """The same epoch and sequence number came before: dropped."""
    JUMPED = "jumped"
    """In a session of several sensors: the stamp is far from the clock on which the others go on: refused."""
    LATE = "late"
    """Frames behind it can no longer be taken back: refused."""
    RETIRED = "retired"
    """From a publisher epoch that another one has succeeded: refused."""

    @property
    def admitted(self) -> bool:
        """Return whether the frame is to be processed."""
        return self not in _REFUSED


_REFUSED: Final = frozenset({Verdict.DUPLICATE, Verdict.JUMPED, Verdict.LATE, Verdict.RETIRED})


class FrameId(NamedTuple):
    """Identity of a frame.

    Attributes:
        epoch: 16 bytes, new at every start of the publisher.
        seq: counts the publisher's frames in the epoch.
        stamp_ns: sensor time, nanoseconds.
        sensor: its stream, where several sensors feed one session; empty in a session of one stream.
    """

    epoch: Epoch
    seq: Whole
    stamp_ns: Whole
    sensor: SensorName = ""


Order = tuple[int, int, str, int, int]
"""The key by which frames are processed: generation, stamp, sensor, era, sequence number."""


@record
class Placement:
    """Place of a frame among the others.

    Attributes:
        era: the era that it belongs to.
        generation: counts restarts; a frame of a higher generation than the one before it restarts the session.
        floor_ns: in an era that continues another, the stamp that the other one reached; None elsewhere.
        opens: whether it begins its era, and how: first, new_epoch, restart; next where it does not, unconfirmed where
            its stamp jumped and nothing follows from it yet.
        jump_ns: how far its stamp lies from the newest one before it in its publisher's order.
        time_ns: the stamp by which it is ordered: its own, unless that cannot be believed.
    """

    era: int
    generation: int
    floor_ns: int | None
    opens: Verdict
    jump_ns: int
    time_ns: int

    def order(self, frame_id: FrameId) -> Order:
        """Return the key by which frames are processed."""
        return self.generation, self.time_ns, frame_id.sensor, self.era, frame_id.seq


@record
class Cursor:
    """State of a publisher's order after some frame, from which the place of the next follows.

    Attributes:
        epoch: publisher epoch of the last one, None before the first.
        seq: highest sequence number in it.
        era: number of its era.
        generation: number of restarts.
        newest_ns: highest stamp of the era.
        floor_ns: see `Placement`.
        jumped: frames in a row whose stamps jumped, the last one as far as the ones before it.
        jumped_ns: stamp of the last of these.
    """

    epoch: Epoch | None = None
    seq: Whole = 0
    era: Count = 0
    generation: Count = 0
    newest_ns: Whole = 0
    floor_ns: Whole | None = None
    jumped: Count = 0
    jumped_ns: Whole = 0

    def follow(self, frame_id: FrameId, limits: JumpLimits) -> Placement:
        """Return the place of the frame that comes next in its publisher's order."""
        stamp_ns = frame_id.stamp_ns
        if self.epoch is None:
            return Placement(self.era + 1, self.generation, None, Verdict.FIRST, 0, stamp_ns)
        jump_ns = stamp_ns - self.newest_ns
        if frame_id.epoch == self.epoch:
            goes_on = -limits.back_ns <= jump_ns <= limits.ahead_ns
            if goes_on and not (jump_ns < 0 and self.jumped_ns < self.newest_ns and self._agreeing(frame_id) > 1):
                return Placement(self.era, self.generation, self.floor_ns, Verdict.NEXT, jump_ns, stamp_ns)
            if self._agreeing(frame_id) < JUMP_FRAMES:
                return Placement(self.era, self.generation, self.floor_ns, Verdict.UNCONFIRMED, jump_ns, self.newest_ns)
        elif 0 < jump_ns <= limits.ahead_ns:
            return Placement(self.era + 1, self.generation, self.newest_ns, Verdict.NEW_EPOCH, jump_ns, stamp_ns)
        return Placement(self.era + 1, self.generation + 1, None, Verdict.RESTART, jump_ns, stamp_ns)

    def after(self, frame_id: FrameId, place: Placement) -> Cursor:
        """Return the cursor after a frame at its place."""
        if place.opens is Verdict.UNCONFIRMED:
            jumped = self._agreeing(frame_id)
            return replace(self, seq=max(self.seq, frame_id.seq), jumped=jumped, jumped_ns=frame_id.stamp_ns)
        newest_ns, seq = frame_id.stamp_ns, frame_id.seq
        if place.era == self.era and self.newest_ns > newest_ns:
            newest_ns = self.newest_ns
        if frame_id.epoch == self.epoch and self.seq > seq:
            seq = self.seq
        return Cursor(frame_id.epoch, seq, place.era, place.generation, newest_ns, place.floor_ns)

    def _agreeing(self, frame_id: FrameId) -> int:
        """Return how many frames in a row say that the clock is where this one says: their stamps go on from there."""
        step_ns = frame_id.stamp_ns - self.jumped_ns
        agrees = self.jumped > 0 and 0 < step_ns <= abs(frame_id.stamp_ns - self.newest_ns)
        return self.jumped + 1 if agrees else 1


@record
class Decision:
    """The verdict on one frame.

    Attributes:
        verdict: whether it is processed, and how.
        place: where it belongs when it is admitted; for the others only how far it lay from the newest means something.
        last: whether it is admitted behind all others and moves none of them.
    """

    verdict: Verdict
    place: Placement
    last: bool = False


@record
class SeenNumbers:
    """Sequence numbers of an epoch that came.

    Attributes:
        epoch: the epoch.
        highest: highest sequence number.
        mask: bit i says whether `highest - i` came, for i below `WINDOW`.
    """

    epoch: bytes
    highest: int
    mask: int

    def has(self, seq: int) -> bool:
        """Return whether a sequence number came, as far as that is remembered."""
        return 0 <= self.highest - seq < WINDOW and bool(self.mask >> (self.highest - seq) & 1)

    def add(self, seq: int) -> SeenNumbers:
        """Return it with one more sequence number."""
        ahead = seq - self.highest
        if ahead <= 0:
            return SeenNumbers(self.epoch, self.highest, self.mask | 1 << -ahead)
        # A sequence number may leap by 2^60: never shift further than the window is wide.
        shifted = self.mask << ahead if ahead < WINDOW else 0
        return SeenNumbers(self.epoch, seq, (shifted | 1) & ((1 << WINDOW) - 1))


@record
class Timeline:
    """Frames that were seen of the sensors of a session; subclasses say where each belongs.

    Attributes:
        limits: a step of the stamps beyond these is a jump.
        seen: the numbers seen of each epoch, by sensor, in the order of appearance; the last epoch is in force.
        base: the cursor of each sensor up to the window.
        floor: the last frame before the window in the order of processing; nothing goes before it.
        frame_ids: the frames of the window in the order of the subclass.
        clock: newest stamp of each sensor in this generation, where there are several.
    """

    limits: JumpLimits
    seen: Mapping[str, tuple[SeenNumbers, ...]] = field(default_factory=dict)
    base: Mapping[str, Cursor] = field(default_factory=dict)
    floor: FrameId | None = None
    frame_ids: tuple[FrameId, ...] = ()
    clock: Mapping[str, int] = field(default_factory=dict)

    def judge(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        """Decide on a frame that arrived; the second result replaces this timeline, also after a refusal."""
        epochs = self.seen.get(frame_id.sensor, ())
        number = number_of(epochs, frame_id.epoch)
        if number >= 0:
            if epochs[number].has(frame_id.seq):
                return self._refuse(frame_id, Verdict.DUPLICATE)
            if epochs[number].highest - frame_id.seq >= WINDOW:
                return self._refuse(frame_id, Verdict.LATE)
        return self._place(frame_id, number)

    def places(self) -> dict[FrameId, Placement]:
        """Return where each frame of the window belongs."""
        raise NotImplementedError

    @classmethod
    def resume(cls, limits: JumpLimits, checkpoint: Checkpoint) -> Timeline:
        """Return the timeline of a session that is restored."""
        raise NotImplementedError

    def knows(self, frame_id: FrameId) -> bool:
        """Return whether frames of its sensor came in an epoch."""
        return number_of(self.seen.get(frame_id.sensor, ()), frame_id.epoch) >= 0

    def note(self, frame_id: FrameId) -> Timeline:
        """Return it with a frame that is refused: its repetition is a duplicate."""
        return replace(self, seen=self._remember(frame_id))

    def settle(self, base: FilterState, gone: Sequence[FrameId]) -> Timeline:
        """Return it with the window after `base`, without the frames `gone`."""
        left = self.frame_ids[len(gone) :]
        if self.frame_ids[: len(gone)] != gone:  # rarely: mostly the oldest go
            other = frozenset(gone)
            left = tuple([frame_id for frame_id in self.frame_ids if frame_id not in other])
        return self._from(base, left)

    def _from(self, base: FilterState, frame_ids: tuple[FrameId, ...]) -> Timeline:
        return replace(self, base=base.cursors, floor=base.last, frame_ids=frame_ids)

    def reinstated(self, frame_id: FrameId) -> Timeline:
        """Return it with the publisher of a frame in force again, which others have succeeded."""
        epochs = self.seen[frame_id.sensor]
        number = number_of(epochs, frame_id.epoch)
        epochs = (*epochs[:number], *epochs[number + 1 :], epochs[number])
        return replace(self, seen={**self.seen, frame_id.sensor: epochs})

    def live(self) -> dict[str, int]:
        """Return the sensors of several that fed the session lately, each with its newest stamp."""
        newest_ns = max(self.clock.values(), default=0)
        return {name: stamp_ns for name, stamp_ns in self.clock.items() if newest_ns - stamp_ns <= self.limits.ahead_ns}

    def silent(self, names: Iterable[str]) -> list[str]:
        """Return the sensors, of several, that did not feed the session lately, the longest silent first."""
        live = self.live()
        return sorted([name for name in names if name not in live], key=lambda one: (self.clock.get(one, -1), one))

    def _place(self, frame_id: FrameId, number: int) -> tuple[Decision, Timeline]:
        """Decide on a frame that was not seen; `number` is its epoch's, -1 for a new one."""
        raise NotImplementedError

    def _jump_ns(self, frame_id: FrameId) -> int:
        """Return how far the stamp of a frame lies from the newest one."""
        raise NotImplementedError

    def _refuse(self, frame_id: FrameId, verdict: Verdict) -> tuple[Decision, Timeline]:
        place = Placement(0, 0, None, verdict, self._jump_ns(frame_id), frame_id.stamp_ns)
        return Decision(verdict, place), self

    def _remember(self, frame_id: FrameId) -> Mapping[str, tuple[SeenNumbers, ...]]:
        """Return the numbers seen with a frame; of too many sensors the longest silent are forgotten."""
        epochs = self.seen.get(frame_id.sensor, ())
        number = number_of(epochs, frame_id.epoch)
        if number < 0:
            epochs = (*epochs, SeenNumbers(frame_id.epoch, frame_id.seq, 1))[-EPOCHS:]
        else:
            epochs = (*epochs[:number], epochs[number].add(frame_id.seq), *epochs[number + 1 :])
        seen = {**self.seen, frame_id.sensor: epochs}
        if len(seen) > MAX_SENSORS:
            silent = self.silent(name for name in seen if name != frame_id.sensor)
            for name in silent[: len(seen) - MAX_SENSORS]:
                del seen[name]
        return seen


@record
class StreamTimeline(Timeline):
    """Timeline of one sensor, in its publisher's order.

    Attributes:
        tip: the cursor after all frames of the window.
    """

    tip: Cursor = field(default_factory=Cursor)

    def places(self) -> dict[FrameId, Placement]:
        """Return where each frame of the window belongs."""
        return dict(zip(self.frame_ids, self._arrange(self.frame_ids)[0], strict=True))

    @classmethod
    def resume(cls, limits: JumpLimits, checkpoint: Checkpoint) -> StreamTimeline:
        """Return the timeline of a session that is restored."""
        base, epochs = checkpoint.base, checkpoint.seen.get("", ())
        timeline = cls(limits, {"": epochs}, base.cursors, base.last)
        frame_ids = [one.frame_id for one in checkpoint.window]
        ordered = tuple(sorted(frame_ids, key=lambda one: (number_of(epochs, one.epoch), one.seq)))
        return replace(timeline, frame_ids=ordered, tip=timeline._arrange(ordered)[1])

    def _from(self, base: FilterState, frame_ids: tuple[FrameId, ...]) -> Timeline:
        # With every frame: `replace` would take three times as long.
        return StreamTimeline(self.limits, self.seen, base.cursors, base.last, frame_ids, self.clock, self.tip)

    @property
    def _before(self) -> Cursor:
        return self.base.get("") or Cursor()

    def _jump_ns(self, frame_id: FrameId) -> int:
        return 0 if self.tip.epoch is None else frame_id.stamp_ns - self.tip.newest_ns

    def _place(self, frame_id: FrameId, number: int) -> tuple[Decision, Timeline]:
        epochs = self.seen[""]
        if number < 0 or (number == len(epochs) - 1 and frame_id.seq > epochs[number].highest):
            return self._append(frame_id)
        return self._insert(frame_id, number)

    def _append(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        """Take a frame that is the last one in its publisher's order."""
        place = self.tip.follow(frame_id, self.limits)
        if not self._free(frame_id, place):
            return self._refuse(frame_id, Verdict.LATE)
        behind = place.jump_ns < 0 and place.opens is Verdict.NEXT
        seen, tip = self._remember(frame_id), self.tip.after(frame_id, place)
        frame_ids = (*self.frame_ids, frame_id)
        timeline = StreamTimeline(self.limits, seen, self.base, self.floor, frame_ids, self.clock, tip)
        return Decision(Verdict.INSERTED if behind else place.opens, place, not behind), timeline

    def _insert(self, frame_id: FrameId, number: int) -> tuple[Decision, Timeline]:
        """Take a frame that others came before which its publisher sent after it."""
        epochs, before = self.seen[""], self._before
        succeeded = number < len(epochs) - 1 and frame_id.seq > epochs[number].highest
        refusal = Verdict.RETIRED if succeeded else Verdict.LATE
        if number < number_of(epochs, before.epoch):
            return self._refuse(frame_id, refusal)
        at = bisect(self.frame_ids, (number, frame_id.seq), key=lambda one: (number_of(epochs, one.epoch), one.seq))
        frame_ids = (*self.frame_ids[:at], frame_id, *self.frame_ids[at:])
        places, tip = self._arrange(frame_ids)
        place = places[at]
        if not all(map(self._free, frame_ids, places)):
            return self._refuse(frame_id, refusal)
        if frame_id.epoch == before.epoch and frame_id.seq < before.seq and place.opens is not Verdict.NEXT:
            # A frame from before the window cannot open an era behind it: it merely took long.
            return self._refuse(frame_id, refusal)
        if succeeded and (place.opens is Verdict.UNCONFIRMED or not self._before_successor(at, places)):
            return self._refuse(frame_id, refusal)
        order = place.order(frame_id)
        behind = any(other.order(one) > order for one, other in zip(frame_ids, places, strict=True))
        last = not behind and at == len(self.frame_ids)
        timeline = replace(self, seen=self._remember(frame_id), frame_ids=frame_ids, tip=tip)
        return Decision(place.opens if last else Verdict.INSERTED, place, last=last), timeline

    def _before_successor(self, at: int, places: tuple[Placement, ...]) -> bool:
        """Return whether a stopped publisher's last frame was only overtaken by its successor's first, and fits."""
        follows = at + 1 < len(places) and places[at + 1].opens is Verdict.NEW_EPOCH
        before = self._arrange(self.frame_ids)[0]
        others = (*places[:at], *places[at + 1 :])
        return follows and [place.generation for place in others] == [place.generation for place in before]

    def _arrange(self, frame_ids: tuple[FrameId, ...]) -> tuple[tuple[Placement, ...], Cursor]:
        cursor, places = self._before, []
        for frame_id in frame_ids:
            place = cursor.follow(frame_id, self.limits)
            cursor = cursor.after(frame_id, place)
            places.append(place)
        return tuple(places), cursor

    def _free(self, frame_id: FrameId, place: Placement) -> bool:
        """Return whether a place lies behind the window's beginning and behind what its era continues."""
        if place.floor_ns is not None and frame_id.stamp_ns <= place.floor_ns:
            return False
        if self.floor is None:
            return True
        before = self._before
        return place.order(frame_id) > (before.generation, self.floor.stamp_ns, "", before.era, self.floor.seq)


@record
class JumpedFrames:
    """Frames in a row of one sensor that agree on another clock.

    Attributes:
        count: how many.
        first_ns: stamp of the first of them.
        since_ns: stamp of the first of them that came after the session's clock moved last.
        newest_ns: stamp of the last one.
    """

    count: int
    first_ns: int
    since_ns: int
    newest_ns: int


@record
class FusedTimeline(Timeline):
    """Timeline of several sensors, in the order of their stamps.

    Each sensor has its own epochs and sequence numbers. A sensor whose publisher restarts goes on where its stamps
    are beyond the publisher's before; other sensors are not concerned.

    The session's clock is the highest stamp. A frame further from it than the gap limit, ahead or back, is refused, so
    one sensor's wrong clock costs the others nothing. So is a frame that is only further ahead than a late frame may
    be behind (`is_ahead`), once another sensor has gone on with the old clock: until then it waits. The jump is
    believed when `JUMP_FRAMES` frames of the sensor agree and most sensors that fed the session lately are on the new
    clock as well, or none has moved the old one for as long as the gap limit. The density restarts, unless the gap
    limit is kept. Most sensors that are late for longer than the gap limit, as behind a clock that drifts, also
    restart it.

    Attributes:
        generation: number of jumps that were believed; all frames of the window are of this one.
        jumped: frames with another clock, by sensor.
    """

    generation: int = 0
    jumped: Mapping[str, JumpedFrames] = field(default_factory=dict)

    def places(self) -> dict[FrameId, Placement]:
        """Return where each frame of the window belongs."""
        return {frame_id: _placed(frame_id, self.generation) for frame_id in self.frame_ids}

    @classmethod
    def resume(cls, limits: JumpLimits, checkpoint: Checkpoint) -> FusedTimeline:
        """Return the timeline of a session that is restored."""
        base, head = checkpoint.base, checkpoint.head
        # A frame that was refused for its effort may have begun a generation that no frame was tracked in yet.
        generation = max([head.generation, *(one.generation for one in head.cursors.values())])
        clock = {
            name: cursor.newest_ns
            for name, cursor in base.cursors.items()
            if cursor.epoch is not None and cursor.generation == generation
        }
        frame_ids = tuple(sorted([one.frame_id for one in checkpoint.window], key=_order))
        for one in frame_ids:
            clock[one.sensor] = max(one.stamp_ns, clock.get(one.sensor, one.stamp_ns))
        return cls(limits, checkpoint.seen, base.cursors, base.last, frame_ids, clock, generation)

    def is_ahead(self, frame_id: FrameId) -> bool:
        """Return whether a frame would make frames of all others late, and nothing says yet whether they follow."""
        return self._jump_ns(frame_id) > self.limits.back_ns and not self._is_doubted(frame_id.sensor)

    def doubted(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        """Refuse a frame that is ahead, and later frames of its sensor, until most sensors agree."""
        decision, _ = self._refuse(frame_id, Verdict.JUMPED)
        return decision, replace(self, jumped=self._jumped(frame_id))

    def _is_doubted(self, sensor: str) -> bool:
        one = self.jumped.get(sensor)
        return one is not None and one.newest_ns > max(self.clock.values(), default=0)

    def _jump_ns(self, frame_id: FrameId) -> int:
        return frame_id.stamp_ns - max(self.clock.values(), default=frame_id.stamp_ns)

    def _place(self, frame_id: FrameId, number: int) -> tuple[Decision, Timeline]:
        epochs, jump_ns = self.seen.get(frame_id.sensor, ()), self._jump_ns(frame_id)
        if abs(jump_ns) > self.limits.ahead_ns or (jump_ns > self.limits.back_ns and self._is_doubted(frame_id.sensor)):
            return self._other_clock(frame_id)
        refusal = self._no_place(frame_id, number if number >= 0 else len(epochs))
        if refusal is None:
            return self._admit(frame_id)
        newest = number < 0 or (number == len(epochs) - 1 and frame_id.seq > epochs[number].highest)
        if refusal is Verdict.LATE and newest:
            return self._other_clock(frame_id, refusal)  # its clock has stepped back, or another sensor's ahead
        return self._refuse(frame_id, refusal)

    def _no_place(self, frame_id: FrameId, number: int) -> Verdict | None:
        """Return why a frame has no place; None when it has.

        It lies behind the window's beginning, and the publishers of a sensor follow each other.
        """
        sensor, stamp_ns = frame_id.sensor, frame_id.stamp_ns
        floor = self.floor
        bound = floor is not None and self.base[floor.sensor].generation == self.generation
        if floor is not None and bound and _order(frame_id) <= _order(floor):
            return Verdict.LATE
        epochs = self.seen.get(sensor, ())
        cursor = self.base.get(sensor, Cursor())
        if number == len(epochs) - 1 and (number == 0 or cursor.epoch == frame_id.epoch):
            return None  # there is no other publisher in the window
        others = [(one.epoch, one.stamp_ns) for one in self.frame_ids if one.sensor == sensor]
        if cursor.epoch is not None and cursor.generation == self.generation:
            others.append((cursor.epoch, cursor.newest_ns))
        for epoch, other_ns in others:
            if (other := number_of(epochs, epoch)) > number and other_ns <= stamp_ns:
                return Verdict.RETIRED
            if other < number and other_ns >= stamp_ns:
                return Verdict.LATE
        return None

    def _admit(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        opens = Verdict.NEXT if self.clock else Verdict.FIRST
        at = bisect(self.frame_ids, _order(frame_id), key=_order)
        last = at == len(self.frame_ids)
        jumped = self.jumped
        if jumped:
            moved = self._jump_ns(frame_id) > 0
            jumped = {
                name: replace(one, since_ns=one.newest_ns) if moved else one
                for name, one in jumped.items()
                if name != frame_id.sensor
            }
        seen = self._remember(frame_id)
        timeline = replace(
            self,
            seen=seen,
            frame_ids=(*self.frame_ids[:at], frame_id, *self.frame_ids[at:]),
            clock=self._moved(frame_id, seen),
            jumped=jumped,
        )
        return Decision(opens if last else Verdict.INSERTED, _placed(frame_id, self.generation), last), timeline

    def _other_clock(self, frame_id: FrameId, refusal: Verdict = Verdict.JUMPED) -> tuple[Decision, Timeline]:
        """Refuse a frame whose stamp is far from the session's clock, or restart on its own."""
        sensor, stamp_ns, limit_ns = frame_id.sensor, frame_id.stamp_ns, self.limits.ahead_ns
        jumped = self._jumped(frame_id)
        one = jumped[sensor]
        agreeing = {name for name, other in jumped.items() if _agrees(other, stamp_ns, limit_ns)}
        believed = 2 * len(agreeing) > len(self.live().keys() | agreeing)
        if refusal is Verdict.LATE and stamp_ns > self.clock.get(sensor, 0):  # delay ends, a wrong clock does not
            believed &= stamp_ns - one.first_ns > limit_ns
        alone = stamp_ns - one.since_ns > limit_ns
        if one.count < JUMP_FRAMES or not (believed or alone):
            return self._refuse(frame_id, refusal)[0], replace(self, jumped=jumped)
        if 0 < self._jump_ns(frame_id) <= limit_ns:
            return self._admit(frame_id)
        begun = replace(
            self,
            seen=self._remember(frame_id),
            frame_ids=(frame_id,),
            generation=self.generation + 1,
            clock={sensor: stamp_ns},
            jumped={},
        )
        return Decision(Verdict.RESTART, _placed(frame_id, begun.generation), last=True), begun

    def _jumped(self, frame_id: FrameId) -> dict[str, JumpedFrames]:
        """Return the frames with another clock, with one more."""
        sensor, stamp_ns = frame_id.sensor, frame_id.stamp_ns
        before = self.jumped.get(sensor)
        one = JumpedFrames(1, stamp_ns, stamp_ns, stamp_ns)
        if before is not None and 0 < stamp_ns - before.newest_ns <= self.limits.ahead_ns:
            one = replace(before, count=before.count + 1, newest_ns=stamp_ns)
        return {**_latest(self.jumped, MAX_SENSORS - 1), sensor: one}

    def _moved(self, frame_id: FrameId, seen: Mapping[str, object]) -> Mapping[str, int]:
        """Return the clock with a frame; of sensors that are seen no more, which were not live, nothing is left."""
        before = self.clock.get(frame_id.sensor, frame_id.stamp_ns)
        clock = {**self.clock, frame_id.sensor: max(before, frame_id.stamp_ns)}
        return {name: stamp_ns for name, stamp_ns in clock.items() if name in seen}


def _placed(frame_id: FrameId, generation: int) -> Placement:
    """Return the place of a frame of a generation; the eras are the generations."""
    return Placement(generation, generation, None, Verdict.NEXT, 0, frame_id.stamp_ns)


def _latest(jumped: Mapping[str, JumpedFrames], most: int) -> dict[str, JumpedFrames]:
    return dict(tuple(jumped.items())[-most:])


def _order(frame_id: FrameId) -> tuple[int, str, int]:
    """Return the key by which the frames of a generation are processed; see `Placement.order`."""
    return frame_id.stamp_ns, frame_id.sensor, frame_id.seq


def _agrees(other: JumpedFrames, stamp_ns: int, gap_limit_ns: int) -> bool:
    return other.count >= JUMP_FRAMES and abs(other.newest_ns - stamp_ns) <= gap_limit_ns


def number_of(epochs: Sequence[SeenNumbers], epoch: bytes | None) -> int:
    """Return the index of an epoch among a publisher's, -1 when it is not there."""
    for number in range(len(epochs) - 1, -1, -1):
        if epochs[number].epoch == epoch:
            return number
    return -1

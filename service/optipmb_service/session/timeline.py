"""All decisions about time, as pure functions of the frames seen so far; no clock is read here.

Conventions. A frame is known by its `FrameId`: the epoch of its publisher (new at every start of it), the sequence
number in that epoch, and the sensor's stamp in nanoseconds. Two clocks occur and are never mixed: sensor stamps, and
the local monotonic clock (`now_ns`), which serves only for waiting.

A stream is cut into *eras*: a new one begins with every publisher epoch and with every jump of the stamps that several
frames agree on. A
*generation* is what one density lives through: eras that only continue another share it, a restart begins the next
one. Where the cuts lie follows from the frames in their publisher's order, epoch by epoch and number by number
(`Cursor.follow`); within an era frames are processed by stamp, equal stamps by sequence number.

Both are functions of which frames there are, not of when each came. So a frame that comes late is put where it belongs,
also before a cut, and the cuts move as they must: `Timeline.places` says where every frame of the window belongs now.
Behind the window nothing moves any more. What is later than that is `Verdict.LATE`.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import field, replace
from enum import StrEnum, unique
from typing import TYPE_CHECKING, Final, NamedTuple

from optipmb.records import record
from optipmb_service.session.seen_numbers import (
    WINDOW,
    SeenNumbers,
    complete_until,
    number_of,
    reinstated,
    remembered,
)
from optipmb_service.session.values import Count, Epoch, JumpLimits, SensorName, Whole  # noqa: TC001 - pydantic reads them

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.state import FilterState

JUMP_FRAMES: Final = 3
"""Frames of one epoch that must agree on a jump of the stamps before it is believed."""


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
        """Whether the frame is to be processed."""
        return self not in _REFUSED


_REFUSED: Final = frozenset({Verdict.DUPLICATE, Verdict.JUMPED, Verdict.LATE, Verdict.RETIRED})


class FrameId(NamedTuple):
    """What identifies and orders a frame.

    Attributes:
        epoch: 16 bytes, new at every start of the publisher.
        seq: counts the publisher's frames in the epoch.
        stamp_ns: sensor time, nanoseconds.
        sensor: its stream, where several sensors feed one session; empty where the session is that of one stream.
    """

    epoch: Epoch
    seq: Whole
    stamp_ns: Whole
    sensor: SensorName = ""


Order = tuple[int, int, str, int, int]
"""The key by which frames are processed: generation, stamp, sensor, era, sequence number."""


@record
class Placement:
    """Where a frame belongs among the others.

    Attributes:
        era: the era that it belongs to.
        generation: counts restarts; a frame of a higher generation than the one before it starts the session anew.
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
    """What frames up to some point mean for the one that follows them.

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
        """Return the course after a frame at its place."""
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
        verdict: what becomes of it.
        place: where it belongs when it is admitted; for the others only how far it lay from the newest means something.
        last: whether it is admitted behind all others and moves none of them.
    """

    verdict: Verdict
    place: Placement
    last: bool = False


@record
class Timeline:
    """What is remembered of the frames of a stream.

    Attributes:
        limits: a step of the stamps beyond these is a jump.
        epochs: what came of each epoch, in the order of their appearance; the last one is in force.
        base: the course up to the window.
        floor: the last frame before the window in the order of processing; nothing goes before it.
        frame_ids: the frames of the window in their publisher's order.
        tip: the course after all of them.
    """

    limits: JumpLimits
    epochs: tuple[SeenNumbers, ...] = ()
    base: Cursor = field(default_factory=Cursor)
    floor: FrameId | None = None
    frame_ids: tuple[FrameId, ...] = ()
    tip: Cursor = field(default_factory=Cursor)

    def judge(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        """Decide on a frame that arrived; the second result replaces this timeline."""
        if self.epochs and self.epochs[-1].epoch == frame_id.epoch and frame_id.seq > self.epochs[-1].highest:
            return self._append(frame_id)
        number = self._number(frame_id.epoch)
        if number < 0:
            return self._append(frame_id)
        seen = self.epochs[number]
        if seen.has(frame_id.seq):
            return self._refuse(frame_id, Verdict.DUPLICATE)
        if seen.highest - frame_id.seq >= WINDOW:
            return self._refuse(frame_id, Verdict.LATE)
        return self._insert(frame_id, number)

    def places(self) -> dict[FrameId, Placement]:
        """Return where each frame of the window belongs."""
        return dict(zip(self.frame_ids, self._arrange(self.frame_ids)[0], strict=True))

    @classmethod
    def resume(cls, limits: JumpLimits, checkpoint: Checkpoint) -> Timeline:
        """Return the timeline of a session that is restored."""
        base = checkpoint.base
        timeline = cls(limits, checkpoint.seen.get("", ()), base.sensor("").cursor, base.last)
        frame_ids = [one.frame_id for one in checkpoint.window]
        ordered = tuple(sorted(frame_ids, key=lambda one: (timeline._number(one.epoch), one.seq)))
        return replace(timeline, frame_ids=ordered, tip=timeline._arrange(ordered)[1])

    @property
    def clock(self) -> Mapping[str, int]:
        """Newest stamps of other sensors: there are none."""
        return {}

    def live(self) -> dict[str, int]:
        """Return the other sensors that fed the session lately: there are none."""
        return {}

    @property
    def seen(self) -> Mapping[str, tuple[SeenNumbers, ...]]:
        """What came, by sensor: there is one, without a name."""
        return {"": self.epochs}

    def knows(self, frame_id: FrameId) -> bool:
        """Whether frames came in an epoch."""
        return self._number(frame_id.epoch) >= 0

    def note(self, frame_id: FrameId) -> Timeline:
        """Remember that a frame came which is not to be processed, so that it is not looked at again."""
        return replace(self, epochs=remembered(self.epochs, frame_id))

    def settle(self, base: FilterState, gone: Sequence[FrameId]) -> Timeline:
        """Return it with a later beginning of the window: `gone` are the frames that fell out of it."""
        left = without(self.frame_ids, gone)
        return Timeline(self.limits, self.epochs, base.sensor("").cursor, base.last, left, self.tip)

    def reinstated(self, frame_id: FrameId) -> Timeline:
        """Return it with the publisher of a frame in force again; nothing is in the window."""
        return replace(self, epochs=reinstated(self.epochs, frame_id.epoch))

    def complete_until(self, frame_id: FrameId, processed: tuple[bytes, int] | None) -> bool:
        """Whether no frame is missing between the last one processed of its epoch and this one."""
        return complete_until(self.epochs, frame_id, processed)

    # How

    def _append(self, frame_id: FrameId) -> tuple[Decision, Timeline]:
        """Take a frame that is the last one in its publisher's order."""
        place = self.tip.follow(frame_id, self.limits)
        if not self._free(frame_id, place):
            return self._refuse(frame_id, Verdict.LATE)
        behind = place.jump_ns < 0 and place.opens is Verdict.NEXT
        epochs, tip = remembered(self.epochs, frame_id), self.tip.after(frame_id, place)
        timeline = Timeline(self.limits, epochs, self.base, self.floor, (*self.frame_ids, frame_id), tip)
        return Decision(Verdict.INSERTED if behind else place.opens, place, not behind), timeline

    def _insert(self, frame_id: FrameId, number: int) -> tuple[Decision, Timeline]:
        """Take a frame that others came before which its publisher sent after it."""
        seen = self.epochs[number]
        succeeded = number < len(self.epochs) - 1 and frame_id.seq > seen.highest
        refusal = Verdict.RETIRED if succeeded else Verdict.LATE
        if number < self._number(self.base.epoch):
            return self._refuse(frame_id, refusal)
        at = bisect(self.frame_ids, (number, frame_id.seq), key=lambda one: (self._number(one.epoch), one.seq))
        frame_ids = (*self.frame_ids[:at], frame_id, *self.frame_ids[at:])
        places, tip = self._arrange(frame_ids)
        place = places[at]
        if not all(map(self._free, frame_ids, places)):
            return self._refuse(frame_id, refusal)
        if frame_id.epoch == self.base.epoch and frame_id.seq < self.base.seq and place.opens is not Verdict.NEXT:
            # What was sent before the window cannot be what opens an era behind it: it merely took long.
            return self._refuse(frame_id, refusal)
        if succeeded and (place.opens is Verdict.UNCONFIRMED or not self._before_successor(at, places)):
            return self._refuse(frame_id, refusal)
        order = place.order(frame_id)
        behind = any(other.order(one) > order for one, other in zip(frame_ids, places, strict=True))
        last = not behind and at == len(self.frame_ids)
        timeline = replace(self, epochs=remembered(self.epochs, frame_id), frame_ids=frame_ids, tip=tip)
        return Decision(place.opens if last else Verdict.INSERTED, place, last=last), timeline

    def _before_successor(self, at: int, places: tuple[Placement, ...]) -> bool:
        """Whether the last frame of a stopped publisher was only overtaken by its successor's first, and fits."""
        follows = at + 1 < len(places) and places[at + 1].opens is Verdict.NEW_EPOCH
        before = self._arrange(self.frame_ids)[0]
        others = (*places[:at], *places[at + 1 :])
        return follows and [place.generation for place in others] == [place.generation for place in before]

    def _arrange(self, frame_ids: tuple[FrameId, ...]) -> tuple[tuple[Placement, ...], Cursor]:
        cursor, places = self.base, []
        for frame_id in frame_ids:
            place = cursor.follow(frame_id, self.limits)
            cursor = cursor.after(frame_id, place)
            places.append(place)
        return tuple(places), cursor

    def _free(self, frame_id: FrameId, place: Placement) -> bool:
        """Whether a place lies behind the window's beginning and behind what its era continues."""
        if place.floor_ns is not None and frame_id.stamp_ns <= place.floor_ns:
            return False
        if self.floor is None:
            return True
        base = self.base
        return place.order(frame_id) > (base.generation, self.floor.stamp_ns, "", base.era, self.floor.seq)

    def _refuse(self, frame_id: FrameId, verdict: Verdict) -> tuple[Decision, Timeline]:
        jump_ns = 0 if self.tip.epoch is None else frame_id.stamp_ns - self.tip.newest_ns
        place = Placement(self.tip.era, self.tip.generation, None, verdict, jump_ns, frame_id.stamp_ns)
        return Decision(verdict, place), self

    def _number(self, epoch: bytes | None) -> int:
        return number_of(self.epochs, epoch)


def without(frame_ids: tuple[FrameId, ...], gone: Sequence[FrameId]) -> tuple[FrameId, ...]:
    """Return the frames of a window but for some that have left it, mostly the oldest."""
    number = len(gone)
    if frame_ids[:number] == gone:
        return frame_ids[number:]
    left = frozenset(gone)
    return tuple([frame_id for frame_id in frame_ids if frame_id not in left])

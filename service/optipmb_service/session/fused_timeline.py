"""The decisions about time for a session that several sensors feed: as `timeline`, but for one clock that all share.

Each sensor has its own epochs and sequence numbers, by which its duplicates and gaps are known. Frames are processed by
stamp, equal stamps by the name of the sensor, so their order follows from the frames alone and no sensor waits for
another. A sensor whose publisher starts anew goes on where its stamps are beyond those of the publisher before; that
concerns nobody else.

The session's clock is the highest stamp. A frame further from it than the gap limit, ahead or back, is refused, so one
sensor's wrong clock costs the others nothing. The jump is believed, and the density begins anew, when `JUMP_FRAMES`
frames of the sensor agree and the others do too: each sensor that fed the session lately is on the new clock as well,
or for as long as the gap limit nobody has moved the old one.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from optipmb_service.session.seen_numbers import (
    WINDOW,
    SeenNumbers,
    complete_until,
    number_of,
    reinstated,
    remembered,
)
from optipmb_service.session.timeline import JUMP_FRAMES, Cursor, Decision, FrameId, Placement, Verdict, without
from optipmb_service.session.values import MAX_SENSORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.state import FilterState
    from optipmb_service.session.values import JumpLimits


@dataclass(frozen=True, slots=True)
class JumpedFrames:
    """Frames in a row of one sensor that agree on another clock.

    Attributes:
        count: how many.
        since_ns: stamp of the first of them that came after the session's clock moved last.
        newest_ns: stamp of the last one.
    """

    count: int
    since_ns: int
    newest_ns: int


@dataclass(frozen=True, slots=True)
class FusedTimeline:
    """What is remembered of the frames of several sensors.

    Attributes:
        limits: a frame further ahead of the session's clock has another clock.
        seen: what came of each epoch, by sensor, in the order of their appearance.
        base: the course of each sensor up to the window.
        floor: the last frame before the window in the order of processing; nothing goes before it.
        frame_ids: the frames of the window in the order of processing; all are of the present generation.
        generation: number of jumps that were believed.
        clock: newest stamp in this generation of each sensor that is seen.
        jumped: frames with another clock, by sensor.
    """

    limits: JumpLimits
    seen: Mapping[str, tuple[SeenNumbers, ...]] = field(default_factory=dict)
    base: Mapping[str, Cursor] = field(default_factory=dict)
    floor: FrameId | None = None
    frame_ids: tuple[FrameId, ...] = ()
    generation: int = 0
    clock: Mapping[str, int] = field(default_factory=dict)
    jumped: Mapping[str, JumpedFrames] = field(default_factory=dict)

    def judge(self, frame_id: FrameId) -> tuple[Decision, FusedTimeline]:
        """Decide on a frame that arrived; the second result replaces this timeline, also after a refusal."""
        epochs = self.seen.get(frame_id.sensor, ())
        number = number_of(epochs, frame_id.epoch)
        if number >= 0 and epochs[number].has(frame_id.seq):
            return self._refuse(frame_id, Verdict.DUPLICATE)
        if number >= 0 and epochs[number].highest - frame_id.seq >= WINDOW:
            return self._refuse(frame_id, Verdict.LATE)
        if self.clock and abs(self._jump_ns(frame_id)) > self.limits.ahead_ns:
            return self._other_clock(frame_id)
        refusal = self._no_place(frame_id, number if number >= 0 else len(epochs))
        if refusal is None:
            return self._admit(frame_id)
        newest = number < 0 or (number == len(epochs) - 1 and frame_id.seq > epochs[number].highest)
        if refusal is Verdict.LATE and newest and frame_id.stamp_ns < self.clock.get(frame_id.sensor, 0):
            return self._other_clock(frame_id, refusal)  # the sensor's own clock has stepped back
        return self._refuse(frame_id, refusal)

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
        return cls(limits, checkpoint.seen, base.cursors, base.last, frame_ids, generation, clock)

    def knows(self, frame_id: FrameId) -> bool:
        """Whether frames of its sensor came in an epoch."""
        return number_of(self.seen.get(frame_id.sensor, ()), frame_id.epoch) >= 0

    def note(self, frame_id: FrameId) -> FusedTimeline:
        """Remember that a frame came which is not to be processed, so that it is not looked at again."""
        return replace(self, seen=self._remembering(frame_id))

    def settle(self, base: FilterState, gone: Sequence[FrameId]) -> FusedTimeline:
        """Return it with a later beginning of the window: `gone` are the frames that fell out of it."""
        return replace(self, base=base.cursors, floor=base.last, frame_ids=without(self.frame_ids, gone))

    def reinstated(self, frame_id: FrameId) -> FusedTimeline:
        """Return it with the publisher of a frame in force again."""
        epochs = reinstated(self.seen[frame_id.sensor], frame_id.epoch)
        return replace(self, seen={**self.seen, frame_id.sensor: epochs})

    def complete_until(self, frame_id: FrameId, processed: tuple[bytes, int] | None) -> bool:
        """Whether no frame of its sensor is missing between the last one processed of its epoch and this one."""
        return complete_until(self.seen.get(frame_id.sensor, ()), frame_id, processed)

    def live(self) -> dict[str, int]:
        """Return the sensors that fed the session lately, each with its newest stamp."""
        newest_ns = max(self.clock.values(), default=0)
        return {name: stamp for name, stamp in self.clock.items() if newest_ns - stamp <= self.limits.ahead_ns}

    # How

    def _jump_ns(self, frame_id: FrameId) -> int:
        return frame_id.stamp_ns - max(self.clock.values(), default=frame_id.stamp_ns)

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

    def _admit(self, frame_id: FrameId) -> tuple[Decision, FusedTimeline]:
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
        seen = self._remembering(frame_id)
        timeline = replace(
            self,
            seen=seen,
            frame_ids=(*self.frame_ids[:at], frame_id, *self.frame_ids[at:]),
            clock=self._moved(frame_id, seen),
            jumped=jumped,
        )
        return Decision(opens if last else Verdict.INSERTED, _placed(frame_id, self.generation), last), timeline

    def _other_clock(self, frame_id: FrameId, refusal: Verdict = Verdict.JUMPED) -> tuple[Decision, FusedTimeline]:
        """Refuse a frame whose stamp is far from the session's clock, or begin anew on its own."""
        sensor, stamp_ns = frame_id.sensor, frame_id.stamp_ns
        before = self.jumped.get(sensor)
        one = JumpedFrames(1, stamp_ns, stamp_ns)
        if before is not None and 0 < stamp_ns - before.newest_ns <= self.limits.ahead_ns:
            one = JumpedFrames(before.count + 1, before.since_ns, stamp_ns)
        jumped = {**_latest(self.jumped, MAX_SENSORS - 1), sensor: one}
        agreed = all(
            _agrees(jumped.get(name), stamp_ns, self.limits.ahead_ns) for name in self.live() if name != sensor
        )
        alone = stamp_ns - one.since_ns > self.limits.ahead_ns
        if one.count < JUMP_FRAMES or not (agreed or alone):
            return self._refuse(frame_id, refusal)[0], replace(self, jumped=jumped)
        begun = replace(
            self,
            seen=self._remembering(frame_id),
            frame_ids=(frame_id,),
            generation=self.generation + 1,
            clock={sensor: stamp_ns},
            jumped={},
        )
        return Decision(Verdict.RESTART, _placed(frame_id, begun.generation), last=True), begun

    def _refuse(self, frame_id: FrameId, verdict: Verdict) -> tuple[Decision, FusedTimeline]:
        return Decision(verdict, _placed(frame_id, self.generation, self._jump_ns(frame_id))), self

    def _moved(self, frame_id: FrameId, seen: Mapping[str, object]) -> Mapping[str, int]:
        """Return the clock with a frame; of sensors that are seen no more, which were not live, nothing is left."""
        before = self.clock.get(frame_id.sensor, frame_id.stamp_ns)
        clock = {**self.clock, frame_id.sensor: max(before, frame_id.stamp_ns)}
        return {name: stamp_ns for name, stamp_ns in clock.items() if name in seen}

    def _remembering(self, frame_id: FrameId) -> Mapping[str, tuple[SeenNumbers, ...]]:
        seen = {**self.seen, frame_id.sensor: remembered(self.seen.get(frame_id.sensor, ()), frame_id)}
        if len(seen) > MAX_SENSORS:
            live = self.live()
            silent = [name for name in seen if name not in live and name != frame_id.sensor]
            for name in sorted(silent, key=lambda one: (self.clock.get(one, -1), one))[: len(seen) - MAX_SENSORS]:
                del seen[name]
        return seen


def _placed(frame_id: FrameId, generation: int, jump_ns: int = 0) -> Placement:
    """Return the place of a frame of a generation; the eras are the generations."""
    return Placement(generation, generation, None, Verdict.NEXT, jump_ns, frame_id.stamp_ns)


def _latest(jumped: Mapping[str, JumpedFrames], most: int) -> dict[str, JumpedFrames]:
    """Return those of the sensors that have come last."""
    return dict(tuple(jumped.items())[-most:])


def _order(frame_id: FrameId) -> tuple[int, str, int]:
    """Return the key by which the frames of a generation are processed; see `Placement.order`."""
    return frame_id.stamp_ns, frame_id.sensor, frame_id.seq


def _agrees(other: JumpedFrames | None, stamp_ns: int, gap_limit_ns: int) -> bool:
    return other is not None and other.count >= JUMP_FRAMES and abs(other.newest_ns - stamp_ns) <= gap_limit_ns

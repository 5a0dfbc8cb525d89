"""What is held of each sensor of a session, and the error for which one is quarantined.

A session of one stream has one sensor, without a name. One of several sensors knows them by their streams: each has
frames and clouds of its own that wait, and no sensor waits for another.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.pending import PendingFrames
from optipmb_service.session.values import MAX_SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.pending import Held
    from optipmb_service.session.processed import ProcessedFrames
    from optipmb_service.session.timeline import FrameId, Timeline
    from optipmb_service.session.values import Policy


class SensorQueues:
    """The frames and clouds that wait, by sensor.

    Args:
        policy: how long frames wait.
        processed: what the session has gone through.
    """

    def __init__(self, policy: Policy, processed: ProcessedFrames) -> None:
        self._policy = policy
        self._processed = processed
        self.pending: dict[str, PendingFrames] = {}
        """What waits of each sensor that is known."""
        self.quarantine: dict[str, str] = {}
        """The errors for which frames of sensors are refused."""
        self.recovery_ns: int | None = None
        """Until when frames behind a gap are held for those missing (monotonic); None: they are not."""

    def of(self, name: str) -> PendingFrames | None:
        """Return what is held of a sensor, nothing for a new one; None when there are too many."""
        pending = self.pending.get(name)
        if pending is None and len(self.pending) >= MAX_SENSORS:
            self._forget_one()
        if pending is None and len(self.pending) < MAX_SENSORS:
            pending = self.pending[name] = PendingFrames(self._policy, self._processed.timeline)
            pending.recovery_ns = self.recovery_ns
        return pending

    def passes(self, frame: Held, pending: PendingFrames) -> bool:
        """Whether a frame that arrived need not be held: there is one sensor, whose frames wait for nothing."""
        return len(self.pending) == 1 and pending.passes(frame)

    def take(self, now_ns: int | None, complete: Callable[[FrameId], bool]) -> Held | None:
        """Take the earliest of the frames that are ready; None while none is.

        Args:
            now_ns: monotonic time; None: nothing waits any longer.
            complete: whether no frame is missing before one.
        """
        for one in self.pending.values() if len(self.pending) == 1 else sorted(self.pending.values(), key=_earliest):
            if one.held and (held := one.take(now_ns, complete)):
                return held
        return None

    def deadline_ns(self, complete: Callable[[FrameId], bool]) -> int | None:
        """Return when `take` is due (monotonic); None while nothing waits. The argument is that of `take`."""
        earliest: int | None = None
        for one in self.pending.values():
            due_ns = one.deadline_ns(complete) if one.held else None
            if due_ns is not None and (earliest is None or due_ns < earliest):
                earliest = due_ns
        return earliest

    @property
    def held(self) -> int:
        """Frames that are held; may be asked by any thread."""
        return sum(len(one) for one in tuple(self.pending.values()))

    @property
    def at_once(self) -> int:
        """How many frames are taken at once, as long as no sensor has more bytes held than it may."""
        return self._policy.at_once

    @property
    def within_bounds(self) -> bool:
        """Whether no sensor has more bytes held than it may."""
        most = self._policy.held_bytes
        return all(one.held_bytes <= most for one in self.pending.values())

    def follow(self, gone: Sequence[FrameId] = ()) -> None:
        """Take over where the past is now; `gone` are the frames that have left its window."""
        past, base = self._processed.timeline, self._processed.base
        for one in self.pending.values():
            one.follow(past, base, gone)

    def begin_anew(self) -> None:
        """Take over a past that has no way back."""
        for one in self.pending.values():
            one.timeline = self._processed.timeline

    def remember(
        self, pending: PendingFrames, judged_by: Timeline | FusedTimeline, arrived: Timeline | FusedTimeline
    ) -> None:
        """Keep what a timeline remembers of a frame that it refused."""
        pending.timeline = arrived
        if self._processed.timeline is judged_by is not arrived:
            self._processed.timeline = arrived
            self.follow()

    def hold_until(self, recovery_ns: int | None) -> None:
        """Hold frames behind a gap until then (monotonic); None: no longer."""
        self.recovery_ns = recovery_ns
        for one in self.pending.values():
            one.recovery_ns = recovery_ns

    def wait_by(self, policy: Policy) -> None:
        """Have frames wait as a policy says."""
        self._policy = policy
        for one in self.pending.values():
            one.policy = policy

    def resume(self, checkpoint: Checkpoint) -> None:
        """Take up the sensors of a checkpoint; nothing is held of them."""
        self.quarantine = dict(checkpoint.quarantine)
        self.pending.clear()
        for name in checkpoint.head.sensors if checkpoint.fused else ("",):
            if (pending := self.of(name)) is not None:
                pending.clouds.newest_ns = checkpoint.newest_cloud_ns.get(name)
        for one in checkpoint.window:
            if (pending := self.pending.get(one.frame_id.sensor)) is not None:
                pending.checksums.add(one.frame_id.epoch, one.frame_id.seq, one.detections)

    def unprocessed(self) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return clouds without their frame, and frames held, each with its ticket."""
        used = frozenset(id(entry.points) for entry in self._processed.entries)
        return [one for pending in self.pending.values() for one in pending.unprocessed(used)]

    def kept_bytes(self) -> int:
        """Return the bytes of what waits, of clouds and of the window, nearly; may be called by any thread.

        A cloud of the window is found by its stamp as well until its frame leaves the window: it counts once.
        """
        entries = self._processed.entries
        used = frozenset(id(entry.points) for entry in entries)
        waiting = [one.held_bytes + one.clouds.bytes_beside(used) for one in tuple(self.pending.values())]
        return sum(entry.weight for entry in entries) + sum(waiting)

    def newest_cloud_ns(self) -> dict[str, int]:
        """Return the stamp of the cloud that arrived last, of each sensor that has sent one."""
        newest = ((name, one.clouds.newest_ns) for name, one in self.pending.items())
        return {name: newest_ns for name, newest_ns in newest if newest_ns is not None}

    def _forget_one(self) -> None:
        """Make room for a sensor: the one that fed the session longest ago goes, if that is not lately."""
        timeline = self._processed.timeline
        if isinstance(timeline, FusedTimeline):
            live, newest_ns = timeline.live(), timeline.clock
            silent = [name for name, one in self.pending.items() if not one.held and name not in live]
            if silent:
                name = min(silent, key=lambda one: (newest_ns.get(one, -1), one))
                del self.pending[name]
                self.quarantine.pop(name, None)


def _earliest(one: PendingFrames) -> tuple[int, str]:
    first = one.first
    return (first.stamp_ns, first.sensor) if first else (0, "")

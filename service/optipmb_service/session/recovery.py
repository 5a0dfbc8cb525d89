"""How long a session waits for what publishers' caches may hold: after a restore, and where several sensors begin.

After a restore the frames between the checkpoint and the crash come from the caches: what lies behind a gap is held for
them. When a session of several sensors begins, their caches come one after the other: until it is known which sensors
there are, none goes ahead of the time that has passed by more than half of the time for which late frames are taken.
The other half is for sensors that began a little earlier and are heard of a little later.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.session.fused_timeline import FusedTimeline

if TYPE_CHECKING:
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.processed import ProcessedFrames
    from optipmb_service.session.sensor_queues import SensorQueues
    from optipmb_service.session.timeline import FrameId
    from optipmb_service.session.values import Policy


class Recovery:
    """Whether a session waits for caches, and which frames may go on meanwhile.

    Args:
        policy: for how long; how far back late frames are taken.
        processed: what the session has gone through.
        sensors: what is held.
    """

    def __init__(self, policy: Policy, processed: ProcessedFrames, sensors: SensorQueues) -> None:
        self._wait_ns = policy.recovery_wait_ns
        self._margin_ns = policy.rewind_ns // 2
        self._processed = processed
        self._sensors = sensors
        self._backlog = False
        self._young_ns: int | None = None
        self.began: tuple[int, int] | None = None
        """Stamp and arrival (monotonic) of the first frame, while a session of several sensors begins."""
        self.now_ns = 0
        """When frames were last let go (monotonic), which whoever does it says."""

    def begin(self, frame_id: FrameId, arrived_ns: int, now_ns: int) -> None:
        """Wait for other sensors: the session begins with a frame."""
        self.began = frame_id.stamp_ns, arrived_ns
        self._sensors.hold_until(now_ns + self._wait_ns)

    def resume(self, checkpoint: Checkpoint, now_ns: int) -> None:
        """Wait for missed frames: the session was restored."""
        if checkpoint.fused and checkpoint.base.last is None:
            # Of the beginning of a session: other sensors may have been there that it does not know yet.
            self._young_ns = min((one.frame_id.stamp_ns for one in checkpoint.window), default=None)
        self._sensors.hold_until(now_ns + self._wait_ns)

    def end(self) -> None:
        """End the waiting: all that the caches had is here, or it took too long."""
        self.began, self._backlog, self._young_ns = None, False, None
        self._sensors.hold_until(None)

    @property
    def behind_gap(self) -> bool:
        """Whether frames behind a gap are held for those missing."""
        return self._sensors.recovery_ns is not None and not self.began

    @property
    def young_since_ns(self) -> int | None:
        """Since when it waits (monotonic), if the session began so lately that it may not know all its sensors."""
        recovery_ns = self._sensors.recovery_ns
        if recovery_ns is None or (self.began is None and self._young_ns is None):
            return None
        return recovery_ns - self._wait_ns

    def complete_until(self, frame_id: FrameId) -> bool:
        """Whether no frame is missing before one: of its sensor, and while it waits of those that were live."""
        if self.began:
            stamp_ns, began_ns = self.began
            ahead_ns = frame_id.stamp_ns - stamp_ns - self._margin_ns
            # Stamps that pass faster than time come from a cache, and the other caches begin as early.
            self._backlog |= ahead_ns > self.now_ns - began_ns
            return ahead_ns <= (0 if self._backlog else self.now_ns - began_ns)
        timeline = self._processed.timeline
        if isinstance(timeline, FusedTimeline) and self.behind_gap:
            if self._young_ns is not None and frame_id.stamp_ns - self._young_ns > self._margin_ns:
                return False
            pending = self._sensors.pending
            for name, newest_ns in timeline.live().items():
                held = pending[name].first if name in pending else None
                reached_ns = newest_ns if held is None else held.stamp_ns
                if name != frame_id.sensor and reached_ns < frame_id.stamp_ns:
                    return False
        return self._processed.complete_until(frame_id)

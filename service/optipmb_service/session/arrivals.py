"""Arrivals: what may still come of the frames of one session. Pure: no clock, no I/O, no threads.

Stream processing calls the answer a watermark. A session that begins or is restored is sent frames by several sources:
its sensors, the caches of their publishers, and the log. Frames wait for those before them until all sources have
answered, or until a deadline. A frame that is far ahead waits to see whether the other sensors follow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.session.timeline import WINDOW, FusedTimeline, number_of
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from optipmb_service.session.pending import PendingFrame, SensorQueue
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.timeline import FrameId, SeenNumbers, Timeline

BACK_NS: Final = 5 * SECOND
"""Longest delay of a token after a session has begun: a client that lost its router tries every 4 s at least.

Sessions wait no longer than `recovery_wait_s` in any case."""

MOST: Final = 4 * MAX_SENSORS
"""Sources whose answers are remembered; beyond it the oldest are asked again."""


class Arrivals:
    """Sources of one session, and the frames that wait for them.

    Args:
        policy: how long frames wait, and how late they may be inserted.
        queues: the pending frames of each sensor; the session changes it.
    """

    def __init__(self, policy: Policy, queues: Mapping[str, SensorQueue]) -> None:
        self._wait_ns = policy.recovery_wait_ns
        self._rewind_ns = policy.rewind_ns
        self._margin_ns = policy.rewind_ns // 2
        self._queues = queues
        self._resumed = False
        self._asked: set[str] = set()
        self.answered: dict[str, None] = {}
        """Sources of which all has come, in the order of their answers."""
        self.end()

    def end(self) -> None:
        """Wait no longer: all sources have answered, or the deadline has passed."""
        self.deadline_ns: int | None = None
        """Monotonic end of the wait; None: nothing is waited for."""
        self._first: tuple[int, int] | None = None
        """Stamp and arrival of the first frame, while a new session waits for its other sensors."""
        self._faster = False
        """Whether stamps advance faster than time, as those from a cache do."""
        self._young_ns: int | None = None
        """First stamp of a session that was restored before it may have known all its sensors."""

    def begin(self, stamp_ns: int, arrived_ns: int, now_ns: int) -> None:
        """Wait for the other sensors of a fused session, whose first frame has come; not after a restore."""
        if self._wait_ns and not (self._resumed or self.waiting):
            self._first, self.deadline_ns = (stamp_ns, arrived_ns), now_ns + self._wait_ns

    def resume(self, now_ns: int, young_ns: int | None) -> None:
        """Wait for the frames between a checkpoint and now.

        Args:
            now_ns: monotonic time.
            young_ns: first stamp of a fused session that may not know all its sensors; None: it knows them.
        """
        self._resumed, self._young_ns, self.deadline_ns = True, young_ns, now_ns + self._wait_ns

    def end_at_deadline(self, now_ns: int) -> None:
        """Wait no longer if the deadline has passed."""
        if self.deadline_ns is not None and now_ns >= self.deadline_ns:
            self.end()

    @property
    def waiting(self) -> bool:
        """Whether frames wait for others before them, or of other sensors."""
        return self.deadline_ns is not None

    @property
    def recovering(self) -> bool:
        """Whether they wait for frames that an earlier process may not have kept."""
        return self.waiting and self._first is None

    def until_ns(
        self, pending: PendingFrame, now_ns: int, timeline: Timeline, last: tuple[bytes, int] | None
    ) -> int | None:
        """Return until when (monotonic) a frame waits for frames before it that may still come; None: it does not.

        Args:
            pending: the earliest pending frame of its sensor.
            now_ns: monotonic time.
            timeline: the frames that have come.
            last: epoch and number of the newest frame of the sensor that was processed, None before the first.
        """
        if self.deadline_ns is not None and self._is_early(pending.frame_id, now_ns, timeline, last):
            return self.deadline_ns
        follows_ns = pending.since_ns + self._rewind_ns
        return follows_ns if now_ns < follows_ns and self._is_ahead(pending.frame_id, timeline) else None

    def _is_early(self, frame_id: FrameId, now_ns: int, timeline: Timeline, last: tuple[bytes, int] | None) -> bool:
        """Return whether sources may still send frames before a frame: of its sensor, and of live ones.

        After a restore the frames between the checkpoint and the crash come from the caches. When a fused session
        begins, the caches come one after the other: until it is known which sensors there are, none goes ahead of the
        time that has passed by more than half of the time for which late frames are inserted. The other half is for
        sensors that began a little earlier and are heard of a little later.
        """
        stamp_ns = frame_id.stamp_ns
        if self._first is not None:
            first_ns, arrived_ns = self._first
            ahead_ns, passed_ns = stamp_ns - first_ns - self._margin_ns, now_ns - arrived_ns
            self._faster |= ahead_ns > passed_ns  # the other caches begin as early
            return ahead_ns > (0 if self._faster else passed_ns)
        if self._young_ns is not None and stamp_ns - self._young_ns > self._margin_ns:
            return True
        held = {name: one.stamp_ns for name, one in self._heads().items()}
        others = ((name, newest_ns) for name, newest_ns in timeline.live().items() if name != frame_id.sensor)
        if any(held.get(name, newest_ns) < stamp_ns for name, newest_ns in others):
            return True
        return _is_gap(timeline.seen.get(frame_id.sensor, ()), frame_id, last)

    def _is_ahead(self, frame_id: FrameId, timeline: Timeline) -> bool:
        """Return whether a frame waits to show whether its clock or time itself has gone on so far.

        Most sensors decide. A frame on the old clock refuses it.
        """
        if not isinstance(timeline, FusedTimeline) or not timeline.is_ahead(frame_id):
            return False
        ahead = {name for name, one in self._heads().items() if timeline.is_ahead(one)}
        return 2 * len(ahead) <= len(timeline.live().keys() | ahead)

    def _heads(self) -> dict[str, FrameId]:
        return {name: one.held[0].frame_id for name, one in self._queues.items() if one.held}

    # Sources

    def answer(self, *streams: str) -> None:
        """Note that all has come which the caches of these streams held."""
        self._asked.update(streams)
        self.answered |= dict.fromkeys(streams)
        while len(self.answered) > MOST:
            oldest = next(iter(self.answered))
            del self.answered[oldest]
            self._asked.discard(oldest)

    def ask_again(self, stream: str) -> None:
        """Note that the cache of a stream has not answered in full; for any thread."""
        self._asked.discard(stream)

    def to_ask(self, caches: Mapping[str, bool]) -> list[str]:
        """Return the caches to ask now, each once; of `caches`, those whose publisher is there."""
        asked = [stream for stream, is_there in caches.items() if is_there and stream not in self._asked]
        self._asked.update(asked)
        return asked

    def complete(self, caches: Mapping[str, bool], now_ns: int) -> bool:
        """Return whether all caches have answered, and tokens of unknown sensors have had their time to come."""
        knows_all = self._first is None and self._young_ns is None
        if self.deadline_ns is not None and not knows_all and now_ns - (self.deadline_ns - self._wait_ns) < BACK_NS:
            return False
        return caches.keys() <= self.answered.keys()


def _is_gap(epochs: Sequence[SeenNumbers], frame_id: FrameId, last: tuple[bytes, int] | None) -> bool:
    """Return whether a frame is missing between the last one processed of an epoch and this one."""
    number = number_of(epochs, frame_id.epoch)
    first = last[1] + 1 if last is not None and last[0] == frame_id.epoch else 0
    if frame_id.seq - first > WINDOW or (number < 0 and frame_id.seq > first):
        return True
    return not all(epochs[number].has(seq) for seq in range(first, frame_id.seq))

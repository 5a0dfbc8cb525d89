"""Frames and clouds of the sensors of a session that await processing.

A frame is held for its point cloud and, while the session recovers, for frames before it that may still come. The queue
has a timeline of the processed frames with the pending ones: a frame is judged by it when it arrives, and by the
timeline of the session when its turn comes.
"""

from __future__ import annotations

import zlib
from array import array
from bisect import insort
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

from optipmb_service.session.checks import SensorChecks
from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.session.state import size_of
from optipmb_service.session.timeline import JUMP_FRAMES, WINDOW, FusedTimeline, Order, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.state import FilterState, Inputs
    from optipmb_service.session.timeline import Decision, FrameId, Timeline

    Judged = tuple[Timeline, Decision, Timeline]

MAX_HELD: Final = 1024
"""Frames held at once: more than come from a publisher's cache before its clouds do.

Beyond it the oldest goes on without its cloud, and behind a gap.
"""


@dataclass(slots=True)
class PendingFrame:
    """Frame that arrived and is not processed yet.

    Attributes:
        frame_id: its identity.
        detections: its detections as `schemas.encode` gives them.
        inputs: its detections as the tracker reads them.
        deadline_ns: until when it waits for its cloud (monotonic); None: it does not.
        ticket: value that the caller gave with it.
        judged: the timeline that it was judged by on arrival, the decision, and the timeline with it.
        since_ns: when it arrived (monotonic).
        points: its cloud, once its turn has come.
        missed: whether it waited for a cloud in vain.
    """

    frame_id: FrameId
    detections: bytes
    inputs: Inputs
    deadline_ns: int | None
    ticket: Any
    judged: Judged
    since_ns: int
    points: schemas.Points | None = None
    missed: bool = False

    @property
    def message(self) -> schemas.Detections:
        return self.inputs[0]

    @property
    def order(self) -> Order:
        """The key by which frames are processed, as of its arrival."""
        return self.judged[1].place.order(self.frame_id)

    @property
    def size(self) -> int:
        """Bytes that it takes, nearly: its detections, and as many once more decoded."""
        return size_of(self.detections) + len(self.detections)


_order: Final = attrgetter("order")


class SensorQueue:
    """Frames of one sensor that wait, in the order in which they will be processed, and its clouds.

    Args:
        policy: how long a frame waits for its cloud and for other sensors, and how much may wait. The session replaces
            it when its profile changes.
        timeline: places of the processed frames, after which the waiting ones find theirs.
    """

    def __init__(self, policy: Policy, timeline: Timeline) -> None:
        self.policy = policy
        self._timeline = timeline
        self._behind = False
        self.clouds = CloudBuffer(policy.clouds, policy.cloud_bytes)
        self.checks = SensorChecks()
        self._checksums = b"", array("I")
        """Epoch of the newest publisher, and the checksums of its newest frames, by number."""
        self._claim = b"", -1, 0, 0
        """Epoch and number of the last frame of a publisher that another one has succeeded, how many came in a row, and
        the stamp of the first of them."""
        self.quarantine = ""
        """Error for which its frames are refused; empty while they are not."""
        self.held: list[PendingFrame] = []
        """The frames, in order."""
        self.held_bytes = 0
        """Bytes of the frames, nearly."""

    def __len__(self) -> int:
        return len(self.held)

    @property
    def timeline(self) -> Timeline:
        """The timeline of the processed frames, with the pending ones added."""
        if self._behind:
            # Other sensors' frames were processed since: judge the held ones again, on the new timeline.
            self._behind = False
            for one in self.held:
                self._timeline = self._timeline.judge(one.frame_id)[1]
        return self._timeline

    @timeline.setter
    def timeline(self, timeline: Timeline) -> None:
        self._timeline, self._behind = timeline, False

    def judge(self, frame_id: FrameId) -> Judged:
        """Return the timeline, its decision on a frame that arrived, and the timeline with the frame."""
        timeline = self.timeline
        return timeline, *timeline.judge(frame_id)

    def cloud_deadline_ns(self, message: schemas.Detections, arrived_ns: int) -> int | None:
        """Return until when (monotonic) a frame waits for its cloud; None: it does not.

        A frame that does not say whether it has a cloud waits if one with a stamp close to its own came last.
        """
        has_points, newest_ns, policy = message.has_points, self.clouds.newest_ns, self.policy
        if has_points is None:
            has_points = newest_ns is not None and abs(message.stamp_ns - newest_ns) <= policy.cloud_memory_ns
        return arrived_ns + policy.cloud_wait_ns if has_points and policy.cloud_wait_ns > 0 else None

    def is_alive(self, frame_id: FrameId, decision: Decision) -> bool:
        """Return whether a frame shows that a publisher is the one to track, though another one has succeeded it.

        It has sent several frames in a row since the other one's last: for as long as a late frame may take, where the
        other one has sent fewer; else for as long as stamps may be apart.
        """
        if decision.verdict is not Verdict.RETIRED:
            if decision.verdict.admitted:
                self._claim = b"", -1, 0, 0
            return False
        strayed = self.timeline.seen[frame_id.sensor][-1].mask.bit_count() < JUMP_FRAMES
        span_ns = self.policy.rewind_ns if strayed else self.policy.gap_limit_ns
        epoch, seq, count, since_ns = self._claim
        if frame_id.epoch != epoch or frame_id.seq <= seq:
            count, since_ns = 0, frame_id.stamp_ns
        self._claim = frame_id.epoch, frame_id.seq, count + 1, since_ns
        return count + 1 >= JUMP_FRAMES and frame_id.stamp_ns - since_ns >= span_ns

    def reuses_number(self, frame_id: FrameId, detections: bytes, decision: Decision) -> bool:
        """Return whether a frame that is refused has the number of another frame."""
        epoch, checksums = self._checksums
        known = checksums[frame_id.seq % WINDOW] if frame_id.epoch == epoch else 0
        if decision.verdict is Verdict.DUPLICATE and known:
            return known != zlib.crc32(detections)
        # An earlier frame has no stamp beyond the newest one.
        return decision.verdict in {Verdict.DUPLICATE, Verdict.LATE} and decision.place.jump_ns > 0

    def remember(self, frame_id: FrameId, detections: bytes) -> None:
        """Remember the bytes of a frame that came, to tell its repetition from another frame with its number."""
        if frame_id.epoch != self._checksums[0]:
            self._checksums = frame_id.epoch, array("I", bytes(array("I").itemsize * WINDOW))
        self._checksums[1][frame_id.seq % WINDOW] = zlib.crc32(detections)

    def add(self, frame: PendingFrame) -> None:
        """Hold a frame, where it belongs."""
        self.timeline = frame.judged[2]
        self.held_bytes += frame.size
        insort(self.held, frame, key=_order)

    def follow(self, past: Timeline, base: FilterState, gone: Sequence[FrameId]) -> None:
        """Follow the session's timeline.

        Args:
            past: that timeline.
            base: the state before its window.
            gone: the frames that have left the window.
        """
        if gone and self.clouds.newest_ns is not None and base.last is not None:
            self.clouds.forget_before(base.last.stamp_ns, self.policy.gap_limit_ns)
        if not self.held:
            self.timeline = past
        elif isinstance(past, FusedTimeline):
            self._timeline, self._behind = past, True  # judged when it is asked for: many are processed before that
        elif gone:
            self.timeline = self.timeline.settle(base, gone)

    def unprocessed(self, used: Container[int]) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return clouds and frames that were not processed, frames with the ticket they came with.

        Args:
            used: of clouds, by `id`, that frames have had.
        """
        clouds = [(cloud, None) for cloud in self.clouds if id(cloud) not in used]
        return [*clouds, *((one.message, one.ticket) for one in self.held)]

    def clear(self) -> int:
        """Drop all frames; return how many there were."""
        count = len(self.held)
        self.held.clear()
        self.held_bytes = 0
        return count

    def take(self, now_ns: int | None, until_ns: Callable[[PendingFrame], int | None]) -> PendingFrame | None:
        """Return the next frame if it is ready, with its cloud, None otherwise.

        Args:
            now_ns: monotonic time; None: nothing waits any longer.
            until_ns: until when a frame waits for others, None: it does not.
        """
        if not self.held:
            return None
        head, clouds = self.held[0], self.clouds
        full = self.held_bytes > self.policy.held_bytes or len(self.held) > MAX_HELD
        if now_ns is not None and not full and until_ns(head) is not None:
            return None
        points = self._cloud(head) if clouds.newest_ns is not None else None
        head.missed = points is None and head.deadline_ns is not None
        if head.missed and now_ns is not None and now_ns < (head.deadline_ns or 0):
            # Once the buffer is full of later clouds, more waiting would cost the frames behind it theirs.
            full = full or clouds.full_behind(head.frame_id.stamp_ns)
            if not full:
                return None
        head.points = points
        return self.pop()

    def pop(self) -> PendingFrame:
        """Remove the next frame and return it."""
        head = self.held.pop(0)
        self.held_bytes -= head.size
        return head

    def _cloud(self, head: PendingFrame) -> schemas.Points | None:
        if head.message.has_points is False:
            return None
        frame_id = head.frame_id
        return self.clouds.get(
            frame_id.epoch, frame_id.stamp_ns, lambda one: self.timeline.knows(frame_id._replace(epoch=one))
        )


class SensorQueues(dict[str, SensorQueue]):
    """Queue of each sensor of a session by its stream; of the only one of a stream's own session by an empty name.

    Args:
        policy: how long frames wait.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self._policy = policy

    def set_policy(self, policy: Policy) -> None:
        """Let all sensors follow a policy."""
        self._policy = policy
        for one in self.values():
            one.policy = policy

    def open(self, name: str, timeline: Timeline) -> SensorQueue | None:
        """Return the queue of a sensor, an empty one for a new sensor; None when there are too many.

        For a new sensor the one that fed the session longest ago is forgotten, unless that was lately.
        """
        if (queue := self.get(name)) is not None:
            return queue
        if len(self) >= MAX_SENSORS:
            for silent in timeline.silent([name for name, one in self.items() if not one.held])[:1]:
                del self[silent]
        if len(self) >= MAX_SENSORS:
            return None
        queue = self[name] = SensorQueue(self._policy, timeline)
        return queue

    def resume(self, checkpoint: Checkpoint, timeline: Timeline) -> None:
        """Open the queues of the sensors of a checkpoint."""
        self.clear()
        for name in {**checkpoint.head.sensors, **checkpoint.quarantine} if checkpoint.fused else ("",):
            if (queue := self.open(name, timeline)) is not None:
                queue.clouds.newest_ns = checkpoint.newest_cloud_ns.get(name)
                queue.quarantine = checkpoint.quarantine.get(name, "")
        for frame in checkpoint.window:
            if (queue := self.get(frame.frame_id.sensor)) is not None:
                queue.remember(frame.frame_id, frame.detections)

    @property
    def held(self) -> int:
        """Number of pending frames; may be called by any thread."""
        return sum(len(one) for one in tuple(self.values()))

    @property
    def is_full(self) -> bool:
        """Whether the pending frames of a sensor take more memory than they may."""
        return any(one.held_bytes > self._policy.held_bytes for one in self.values())

    def bytes_beside(self, used: Container[int]) -> int:
        """Return the bytes of pending frames, and of all clouds but some, given by `id`; for any thread."""
        return sum(one.held_bytes + one.clouds.bytes_beside(used) for one in tuple(self.values()))

    def take(self, now_ns: int | None, until_ns: Callable[[PendingFrame], int | None]) -> PendingFrame | None:
        """Return the earliest of the frames that are ready, with its cloud; arguments as of `SensorQueue.take`."""
        queues = [one for one in self.values() if one.held]
        if len(queues) > 1:
            queues.sort(key=lambda one: (one.held[0].frame_id.stamp_ns, one.held[0].frame_id.sensor))
        return next((frame for one in queues if (frame := one.take(now_ns, until_ns))), None)


class CloudBuffer:
    """Bounded buffer of the clouds of a sensor: one per epoch and stamp, the newest arrival holds; the oldest goes.

    A publisher sends its clouds under the epoch of its detections. Clouds of an epoch in which the sensor has no
    detections come from a program of their own and belong to the frame with their stamp.

    Args:
        most: number of clouds kept.
        most_bytes: bytes of points kept.
    """

    def __init__(self, most: int, most_bytes: int = 2**62) -> None:
        self._most = most
        self._most_bytes = most_bytes
        self.bytes = 0
        """Bytes of points kept now."""
        self._kept: dict[tuple[bytes, int], schemas.Points] = {}
        self.newest_ns: int | None = None
        """Stamp of the cloud that arrived last."""

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[schemas.Points]:
        return iter(self._kept.values())

    def bytes_beside(self, used: Container[int]) -> int:
        """Return the bytes of points kept of all clouds but some, given by `id`; may be called by any thread."""
        return sum(cloud.xyz.nbytes for cloud in tuple(self._kept.values()) if id(cloud) not in used)

    def add(self, cloud: schemas.Points) -> None:
        """Keep a cloud."""
        key = cloud.epoch, cloud.stamp_ns
        if key in self._kept:
            self._drop(key)
        self._kept[key] = cloud
        self.bytes += cloud.xyz.nbytes
        self.newest_ns = cloud.stamp_ns
        while len(self._kept) > self._most or (self.bytes > self._most_bytes and len(self._kept) > 1):
            self._drop(next(iter(self._kept)))

    def get(self, epoch: bytes, stamp_ns: int, publishers: Callable[[bytes], bool]) -> schemas.Points | None:
        """Return the cloud of a frame, None when it is not there; what another publisher of detections sent is not.

        Args:
            epoch: of the frame.
            stamp_ns: of the frame.
            publishers: whether detections came in an epoch.
        """
        own = self._kept.get((epoch, stamp_ns))
        if own is not None:
            return own
        others = (cloud for (whose, stamp), cloud in self._kept.items() if stamp == stamp_ns and not publishers(whose))
        return next(others, None)

    def full_behind(self, stamp_ns: int) -> bool:
        """Return whether it is full of clouds for frames later than a stamp: the next would push one of them off."""
        full = len(self._kept) >= self._most or self.bytes >= self._most_bytes
        return full and all(stamp > stamp_ns for _, stamp in self._kept)

    def forget_before(self, stamp_ns: int, reach_ns: int) -> None:
        """Drop the clouds before a stamp; those further back than `reach_ns` belong to frames after a jump."""
        gone = [key for key in self._kept if 0 < stamp_ns - key[1] <= reach_ns]
        for key in gone:
            self._drop(key)

    def _drop(self, key: tuple[bytes, int]) -> None:
        self.bytes -= self._kept.pop(key).xyz.nbytes

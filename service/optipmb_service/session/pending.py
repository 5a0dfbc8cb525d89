"""What arrived of a sensor and was not gone through yet: clouds, and frames that are held until they are ready.

A frame is held for its point cloud and, after a restore, for frames before it that may still come. The timeline here is
that of the past with the frames held: a frame is judged by it when it arrives, and by the past's when its turn comes.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas

from optipmb.records import record
from optipmb_service.session.cloud_buffer import CloudBuffer
from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.seen_numbers import Checksums, Claim
from optipmb_service.session.stamp_check import StampCheck
from optipmb_service.session.state import Entry, size_of
from optipmb_service.session.timeline import JUMP_FRAMES, Verdict, hold_until

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence

    from optipmb_service.session.state import Contents, FilterState
    from optipmb_service.session.timeline import Decision, FrameId, Timeline
    from optipmb_service.session.values import Policy

    Judged = tuple[Timeline | FusedTimeline, Decision, Timeline | FusedTimeline]


MAX_HELD: Final = 1024
"""Frames held at once: more than come from a publisher's cache before its clouds do.

Beyond it the oldest goes on without its cloud, and behind a gap.
"""


@record
class Held:
    """A frame that arrived.

    Attributes:
        entry: the frame, without its cloud until its turn has come, where it belonged when it arrived.
        contents: what was read of it.
        deadline_ns: until when it waits for its cloud (monotonic); None: it does not.
        ticket: what the caller gave with it.
        judged: the timeline that it was judged by, and the decision and the timeline that came of it.
    """

    entry: Entry
    contents: Contents
    deadline_ns: int | None
    ticket: Any
    judged: Judged

    @property
    def size(self) -> int:
        """The bytes that it takes, nearly: those of its detections, and as many once more for what was read of them."""
        return self.entry.weight + len(self.entry.detections)


_order: Final = attrgetter("entry.order")


class PendingFrames:
    """The frames held, in the order in which they will be processed, and the clouds.

    Args:
        policy: how long frames wait; may be replaced.
        timeline: of the past.
    """

    def __init__(self, policy: Policy, timeline: Timeline | FusedTimeline) -> None:
        self.policy = policy
        self._timeline = timeline
        self._behind = False
        self.clouds = CloudBuffer(policy.clouds, policy.cloud_bytes)
        self.stamps = StampCheck()
        self.checksums = Checksums()
        self._claim = Claim()
        self.held: list[Held] = []
        """The frames held, in order."""
        self.held_bytes = 0
        """Bytes of the frames held, nearly."""
        self.recovery_ns: int | None = None
        """Until when frames behind a gap are held for those missing (monotonic); None: they are not."""

    def __len__(self) -> int:
        return len(self.held)

    @property
    def timeline(self) -> Timeline | FusedTimeline:
        """The timeline of the past with the frames held."""
        if self._behind:
            # Frames of other sensors were processed, of which the timeline with those held knows nothing.
            self._behind = False
            for one in self.held:
                self._timeline = self._timeline.judge(one.entry.frame_id)[1]
        return self._timeline

    @timeline.setter
    def timeline(self, timeline: Timeline | FusedTimeline) -> None:
        self._timeline, self._behind = timeline, False

    def arrived(
        self,
        contents: Contents,
        frame_id: FrameId,
        arrived_ns: int,
        ticket: Any,
        judged: Judged,
    ) -> Held:
        """Return a frame that arrived; the arguments are of `Entry` and `Held`, and when that was (monotonic)."""
        deadline_ns = hold_until(
            has_points=contents.message.has_points,
            stamp_ns=frame_id.stamp_ns,
            arrived_ns=arrived_ns,
            newest_cloud_ns=self.clouds.newest_ns,
            cloud_wait_ns=self.policy.cloud_wait_ns,
            cloud_memory_ns=self.policy.cloud_memory_ns,
        )
        place, detections = judged[1].place, schemas.encoded(contents.message)
        entry = Entry(frame_id, detections, None, False, 0, [], place, size_of(detections))
        return Held(entry, contents, deadline_ns, ticket, judged)

    def is_alive(self, frame_id: FrameId, decision: Decision) -> bool:
        """Whether a frame shows that a publisher is the one to track, though another one has succeeded it.

        It has sent several frames in a row since the other one's last: for as long as a late frame may take, where the
        other one has sent fewer; else for as long as stamps may be apart.
        """
        if decision.verdict is not Verdict.RETIRED:
            if decision.verdict.admitted:
                self._claim.clear()
            return False
        strayed = self.timeline.seen[frame_id.sensor][-1].mask.bit_count() < JUMP_FRAMES
        span_ns = self.policy.rewind_ns if strayed else self.policy.gap_limit_ns
        return self._claim.add(frame_id, frames=JUMP_FRAMES, span_ns=span_ns)

    def reuses_number(self, message: schemas.Detections, decision: Decision) -> bool:
        """Whether a frame that is refused has the number of another frame."""
        if decision.verdict is Verdict.DUPLICATE:
            same = self.checksums.same(message.epoch, message.seq, schemas.encoded(message))
            if same is not None:
                return not same
        # What was sent earlier has no stamp beyond the newest one.
        return decision.verdict in {Verdict.DUPLICATE, Verdict.LATE} and decision.place.jump_ns > 0

    def passes(self, frame: Held) -> bool:
        """Whether a frame that arrived need not be held: nothing is, no frames are awaited, and no cloud ever came."""
        return (
            not self.held and frame.deadline_ns is None and self.recovery_ns is None and self.clouds.newest_ns is None
        )

    def add(self, frame: Held) -> None:
        """Hold a frame, where it belongs."""
        self.held_bytes += frame.size
        insort(self.held, frame, key=_order)

    def follow(self, past: Timeline | FusedTimeline, base: FilterState, gone: Sequence[FrameId]) -> None:
        """Take over where the past is now.

        Args:
            past: its timeline.
            base: the state before its window.
            gone: the frames that have left the window.
        """
        if gone and self.clouds.newest_ns is not None and base.last is not None:
            self.clouds.forget_before(base.last.stamp_ns, self.policy.gap_limit_ns)
        if not self.held:
            self._timeline, self._behind = past, False
        elif isinstance(past, FusedTimeline):
            self._timeline, self._behind = past, True  # judged when it is asked for: many are let go before that
        elif gone:
            self.timeline = self.timeline.settle(base, gone)

    def unprocessed(self, used: Container[int]) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return clouds and frames that were not gone through, frames with the ticket they came with.

        Args:
            used: of clouds, by `id`, that frames have had.
        """
        clouds = [(cloud, None) for cloud in self.clouds if id(cloud) not in used]
        return [*clouds, *((one.contents.message, one.ticket) for one in self.held)]

    def clear(self) -> int:
        """Drop all; returns how many there were."""
        count = len(self.held)
        self.held.clear()
        self.held_bytes = 0
        return count

    @property
    def first(self) -> FrameId | None:
        """The earliest frame held."""
        return self.held[0].entry.frame_id if self.held else None

    def deadline_ns(self, complete: Callable[[FrameId], bool]) -> int | None:
        """Return when `take` is due (monotonic); None while nothing waits.

        Args:
            complete: whether no frame is missing before one.
        """
        if not self.held:
            return None
        head = self.held[0]
        return self.recovery_ns if self._behind_gap(head, complete) else head.deadline_ns

    def take(
        self,
        now_ns: int | None,
        complete: Callable[[FrameId], bool],
    ) -> Held | None:
        """Return the next frame if it is ready, with its cloud, None otherwise.

        Args:
            now_ns: monotonic time; None: nothing waits any longer.
            complete: whether no frame is missing before one.
        """
        if not self.held:
            return None
        head = self.held[0]
        much = self.held_bytes > self.policy.held_bytes
        many = much or len(self.held) > MAX_HELD
        if now_ns is not None and not many and self._behind_gap(head, complete):
            return None
        points = self._cloud(head) if self.clouds.newest_ns is not None else None
        missed = points is None and head.deadline_ns is not None
        if missed and now_ns is not None and now_ns < (head.deadline_ns or 0) and not (many or self._crowded(head)):
            return None
        del self.held[0]
        self.held_bytes -= head.size
        return replace(head, entry=head.entry.given(points, missed=missed)) if points is not None or missed else head

    def _cloud(self, held: Held) -> schemas.Points | None:
        if held.contents.message.has_points is False:
            return None
        frame_id = held.entry.frame_id
        return self.clouds.get(
            frame_id.epoch, frame_id.stamp_ns, lambda one: self.timeline.knows(frame_id._replace(epoch=one))
        )

    def _crowded(self, held: Held) -> bool:
        """Whether longer waiting for a cloud would cost the frames behind it theirs.

        Else one lost cloud would: each frame would find its own pushed off by the time that the one before was let go.
        """
        return self.clouds.full_behind(held.entry.frame_id.stamp_ns)

    def _behind_gap(self, head: Held, complete: Callable[[FrameId], bool]) -> bool:
        return self.recovery_ns is not None and not complete(head.entry.frame_id)

"""What a session has gone through and where it stands: the timeline of its frames, its window and what steps them.

The three change together. A frame that is ready is put among the others (`placed`, `amended`: pure), the frames
are gone through (`go`), and what no longer belongs to the window leaves it (`settle`). Whatever a step raises, nothing
has changed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import optipmb
from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.reorder_window import ReorderWindow
from optipmb_service.session.restored_window import window_of
from optipmb_service.session.timeline import Timeline
from optipmb_service.session.transition import Transition, empty

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.state import Contents, Entry, FilterState
    from optipmb_service.session.timeline import FrameId
    from optipmb_service.session.transition import Outcome
    from optipmb_service.session.values import Lineage, Policy


class ProcessedFrames:
    """The frames that a session processed, up to the present state.

    Args:
        transition: goes from one state to the next.
        policy: how far back the window reaches.
        life: what an earlier session of the stream left behind.
        fused: whether the frames are those of several sensors.
    """

    def __init__(self, transition: Transition, policy: Policy, life: Lineage, *, fused: bool) -> None:
        self.transition = transition
        self._policy = policy
        self.timeline: Timeline | FusedTimeline
        self.timeline = FusedTimeline(policy.gap_limit_ns) if fused else Timeline(policy.jump_limits)
        self._history = ReorderWindow(empty(transition, None, life.next_id, life.starts), transition.step)

    @property
    def head(self) -> FilterState:
        """The present state."""
        return self._history.head

    @property
    def base(self) -> FilterState:
        """The moment before the window."""
        return self._history.base

    @property
    def entries(self) -> Sequence[Entry]:
        """The frames of the window in the order of processing."""
        return self._history.entries

    def complete_until(self, frame_id: FrameId) -> bool:
        """Whether no frame is missing between the last one tracked of its epoch and this one."""
        return self.timeline.complete_until(frame_id, self.head.sensor(frame_id.sensor).tracked)

    def placed(self, entry: Entry, timeline: Timeline | FusedTimeline) -> list[Entry]:
        """Return the frames of the window with one more among them; the timeline is that with it."""
        return self._history.inserted(entry, timeline.places())

    def amended(self, points: schemas.Points, frame_id: FrameId) -> list[Entry] | None:
        """Return the frames of the window, a late cloud given to those that lack it; None when none does."""
        placed = self._history.amended(points, frame_id, published=self.timeline.knows(frame_id))
        return None if all(new is old for new, old in zip(placed, self.entries, strict=True)) else placed

    def go(self, placed: Sequence[Entry], contents: Contents | None) -> list[Outcome]:
        """Go through the frames from the first that is not as it was; returns what became of each in order.

        Args:
            placed: the frames of the window as they are to be, or one that belongs behind all others and moves none.
            contents: what was read of that one; None: they are those of the window.

        Raises:
            Exception: whatever the tracker raises.
        """
        return self._history.redo(placed) if contents is None else self._history.append(placed[0], contents)

    def settle(self, timeline: Timeline | FusedTimeline) -> Sequence[FrameId]:
        """Take over the timeline with what was gone through; returns the frames that have left the window by it."""
        gone = self._history.trim(self._policy)
        self.timeline = timeline.settle(self._history.base, gone) if gone else timeline
        return gone

    def note(self, frame_id: FrameId) -> None:
        """Remember that a frame came which is not to be processed."""
        self.timeline = self.timeline.note(frame_id)

    def reinstate(self, frame_id: FrameId) -> None:
        """Go on with the publisher of a frame, which others have succeeded."""
        if isinstance(self.timeline, Timeline):
            self.begin(self.head)  # in the window the order of publishers is that of their first frames
        self.timeline = self.timeline.reinstated(frame_id)

    def begin(self, state: FilterState, transition: Transition | None = None) -> None:
        """Go on from a moment without a way back behind it; with another transition when the profile changes."""
        self.transition = transition or self.transition
        self._history = ReorderWindow(state, self.transition.step)
        self.timeline = self.timeline.settle(state, self.timeline.frame_ids)

    def begin_anew(self) -> None:
        """Forget the density: another life of it begins, whose track ids go on."""
        starts = self.head.starts + 1
        self.begin(self.head.begun_anew(self._no_objects(), self.transition.name(self.head.last, starts), starts))

    def empty(self) -> None:
        """Begin the same life with no objects: what was begun with another profile has its classes."""
        session = self.transition.name(None, self.head.starts)
        self.begin(replace(self.head, session=session, density=self._no_objects()))

    def report_by(self, transition: Transition) -> None:
        """Go on by a transition that tracks as the one before and reports more or less of the tracks."""
        self.transition = transition
        self._history.step = transition.step

    def _no_objects(self) -> optipmb.Density:
        return optipmb.Density.empty(self.transition.parameters.labels, self.head.density.next_id)

    def portable(self) -> tuple[FilterState, tuple[Entry, ...]]:
        """Return the beginning and the frames of as much of the window as a checkpoint takes along."""
        return self._history.portable(self._policy.checkpoint_bytes)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Take up what was written down."""
        self.timeline, entries = window_of(checkpoint, self._policy.jump_limits)
        self._history = ReorderWindow(checkpoint.base, self.transition.step, entries, checkpoint.head)

"""What a session has gone through and where it stands: the timeline of its frames, its window and what steps them.

The three change together. A frame that is ready is put among the others (`placed`, `amended`: pure), the frames
are gone through (`go`), and what no longer belongs to the window leaves it (`settle`). Whatever a step raises, nothing
has changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.checkpoint import Recorded
from optipmb_service.history import History
from optipmb_service.moments import Entry, weigh
from optipmb_service.stepping import Stepper, empty
from optipmb_service.timing import Timeline
from optipmb_service.window import window_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb_schemas as schemas

    from optipmb_service.checkpoint import Checkpoint
    from optipmb_service.moments import Moment
    from optipmb_service.records import Life, Policy
    from optipmb_service.stepping import Outcome
    from optipmb_service.timing import Decision, Mark
    from optipmb_service.waiting import Ready


class Past:
    """The frames that a session processed, up to the present moment.

    Args:
        stepper: goes from one moment to the next.
        policy: how far back the window reaches.
        life: what an earlier session of the stream left behind.
    """

    def __init__(self, stepper: Stepper, policy: Policy, life: Life) -> None:
        self.stepper = stepper
        self._policy = policy
        self.timeline = Timeline(policy.gap_limit_ns)
        self._history = History(empty(stepper, None, life.next_id, life.starts), stepper.step)

    @property
    def head(self) -> Moment:
        """The present moment."""
        return self._history.head

    @property
    def base(self) -> Moment:
        """The moment before the window."""
        return self._history.base

    @property
    def entries(self) -> Sequence[Entry]:
        """The frames of the window in the order of processing."""
        return self._history.entries

    def complete_until(self, mark: Mark) -> bool:
        """Whether no frame is missing between the last one tracked of its epoch and this one."""
        return self.timeline.complete_until(mark, self.head.tracked)

    def placed(self, ready: Ready, decision: Decision, timeline: Timeline) -> list[Entry]:
        """Return the frames of the window with one more among them.

        Args:
            ready: the frame.
            decision: that it is admitted.
            timeline: with it.
        """
        mark, message, points = ready.held.mark, ready.held.message, ready.points
        frame, ignored, weight = ready.held.frame, ready.held.ignored, weigh(message, points)
        entry = Entry(mark, decision.place, message, points, ready.missed, 0, frame, ignored, weight)
        return [*self.entries, entry] if decision.last else self._history.inserted(entry, timeline.places())

    def amended(self, points: schemas.Points) -> list[Entry] | None:
        """Return the frames of the window, a late cloud given to those that lack it; None when none does."""
        placed = self._history.amended(points, self.timeline.knows)
        return None if all(new is old for new, old in zip(placed, self.entries, strict=True)) else placed

    def go(self, placed: Sequence[Entry], *, behind: bool) -> list[Outcome]:
        """Go through the frames from the first that is not as it was; returns what became of each in order.

        Args:
            placed: the frames of the window as they are to be.
            behind: whether the last one alone is new.

        Raises:
            Exception: whatever the tracker raises.
        """
        return self._history.append(placed[-1]) if behind else self._history.redo(placed)

    def settle(self, timeline: Timeline) -> frozenset[Mark]:
        """Take over the timeline with what was gone through; returns the frames that have left the window by it."""
        gone = self._history.trim(self._policy)
        self.timeline = timeline.settle(self.base.course, self.base.last, gone) if gone else timeline
        return gone

    def note(self, mark: Mark) -> None:
        """Remember that a frame came which is not to be processed."""
        self.timeline = self.timeline.note(mark)

    def begin(self, moment: Moment, stepper: Stepper | None = None) -> None:
        """Go on from a moment without a way back behind it; with another stepper when the profile changes."""
        self.stepper = stepper or self.stepper
        self._history = History(moment, self.stepper.step)
        self.timeline = self.timeline.settle(moment.course, moment.last, frozenset(self.timeline.marks))

    def portable(self) -> tuple[Moment, tuple[Recorded, ...]]:
        """Return the beginning and the frames of as much of the window as a checkpoint takes along."""
        base, entries = self._history.portable(self._policy.checkpoint_bytes)
        return base, tuple(Recorded(one.message, one.points, one.missed, one.revision, one.packed) for one in entries)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Take up what was written down.

        Raises:
            CheckpointError: its frames do not fit together.
        """
        self.timeline, entries = window_of(checkpoint, self._policy.gap_limit_ns)
        self._history = History(checkpoint.base, self.stepper.step, entries, checkpoint.head)

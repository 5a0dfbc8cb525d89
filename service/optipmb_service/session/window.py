"""Reorder window of a session: a state, the frames since, and the state after each of them.

A late frame is inserted where it belongs, and those behind it are processed again; so they are when a cloud comes late.
The state is then byte-equal to processing in order, because a step is a pure function and nothing else leads from one
state to the next. That holds across the cuts between incarnations of the density too, and for the first frame of one.

The window has the newest frames within a span of sensor time, a number of frames and a number of bytes: a function of
the frames alone, so that sessions that took the same frames have the same window. States take memory and are easily
computed again: checkpoints leave them out, and after a restore they are computed when they are needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.state import FilterState, Inputs, ProcessedFrame
    from optipmb_service.session.timeline import FrameId, Placement
    from optipmb_service.session.transition import Outcome, Transition


class ReorderWindow:
    """State before the window, its frames, and the states after them.

    Args:
        base: the state before the window.
        transition: processes frames; may raise, then nothing has changed here.
        frames: the frames of the window in the order of processing.
        head: the state after them.
    """

    def __init__(
        self,
        base: FilterState,
        transition: Transition,
        frames: Sequence[ProcessedFrame] = (),
        head: FilterState | None = None,
    ) -> None:
        self.base = base
        self.transition = transition
        self._frames = list(frames)
        self._weight = sum(frame.weight for frame in frames)
        self._after: list[FilterState | None] = [None] * len(self._frames)
        if self._frames:
            self._after[-1] = head
        self.head = self.state(len(self._frames))
        """The present state."""

    @classmethod
    def resume(
        cls, checkpoint: Checkpoint, transition: Transition, places: Mapping[FrameId, Placement]
    ) -> ReorderWindow:
        """Return the window of a checkpoint, whose frames have these places."""
        frames = [replace(frame, place=places[frame.frame_id]) for frame in checkpoint.window]
        frames.sort(key=lambda frame: frame.order)
        return cls(checkpoint.base, transition, frames, checkpoint.head)

    @property
    def frames(self) -> tuple[ProcessedFrame, ...]:
        return tuple(self._frames)

    def state(self, number: int) -> FilterState:
        """Return the state after so many frames of the window; it is computed when it is not there."""
        state, known = self.base, 0
        for at in range(number, 0, -1):
            if (after := self._after[at - 1]) is not None:
                state, known = after, at
                break
        for at in range(known, number):
            state, _ = self.transition.step(state, self._frames[at])
            self._after[at] = state
        return state

    def again(self) -> list[Outcome]:
        """Return the outcomes of its frames once more."""
        state, outcomes = self.base, []
        for frame in self._frames:
            state, outcome = self.transition.step(state, frame)
            outcomes.append(outcome)
        return outcomes

    def append(self, frame: ProcessedFrame, inputs: Inputs) -> list[Outcome]:
        """Process a frame that belongs behind all others and moves none."""
        state, outcome = self.transition.step(self.head, frame, inputs)
        self._frames.append(frame)
        self._weight += frame.weight
        self._after.append(state)
        self.head = state
        return [outcome]

    def inserted(self, frame: ProcessedFrame, places: Mapping[FrameId, Placement]) -> list[ProcessedFrame]:
        """Return the frames of the window with one more among them, all where they belong then."""
        placed = [
            old if old.place == (place := places[old.frame_id]) else replace(old, place=place) for old in self._frames
        ]
        return sorted([*placed, frame], key=lambda one: one.order)

    def amended(self, points: schemas.Points, frame_id: FrameId, *, published: bool) -> list[ProcessedFrame]:
        """Return the frames of the window, a late cloud given to the frame of its sensor and stamp that lacks one.

        Args:
            points: the cloud.
            frame_id: its epoch, stamp and sensor.
            published: whether detections came in that epoch; see `CloudBuffer.get`.
        """
        return [
            replace(one, points=points, missed=False, packed=[])
            if (one.frame_id.stamp_ns, one.frame_id.sensor) == (frame_id.stamp_ns, frame_id.sensor)
            and one.points is None
            and one.message.has_points is not False
            and (one.frame_id.epoch == frame_id.epoch or not published)
            else one
            for one in self._frames
        ]

    def redo(self, placed: Sequence[ProcessedFrame]) -> list[Outcome]:
        """Replace the frames, and process them from the first that differs.

        Returns:
            The outcome of each in order. Frames that were there before get a higher revision.
        """
        old = self._frames
        same = (new is one for new, one in zip(placed, old, strict=False))
        first = next((i for i, one in enumerate(same) if not one), min(len(placed), len(old)))
        known = {frame.frame_id for frame in old}
        frames = list(placed)
        state = self.state(first)
        after: list[FilterState] = []
        outcomes: list[Outcome] = []
        for i in range(first, len(frames)):
            if frames[i].frame_id in known:
                frames[i] = replace(frames[i], revision=frames[i].revision + 1)
            state, outcome = self.transition.step(state, frames[i])
            after.append(state)
            outcomes.append(outcome)
        self._frames = frames
        self._weight = sum([frame.weight for frame in frames])
        self._after = [*self._after[:first], *after]
        self.head = state
        return outcomes

    def trim(self, policy: Policy) -> tuple[FrameId, ...]:
        """Drop the frames that no longer belong to the window; return them."""
        sensors = max(1, len(self.head.sensors))
        keep = self._fitting(policy.rewind_ns, policy.rewind_frames * sensors, policy.rewind_bytes * sensors)
        cut = len(self._frames) - keep
        if not cut:
            return ()
        self.base = self.state(cut)
        gone = self._frames[:cut]
        del self._frames[:cut], self._after[:cut]
        for frame in gone:
            self._weight -= frame.weight
        return tuple([frame.frame_id for frame in gone])

    def portable(self, most_bytes: int) -> tuple[FilterState, tuple[ProcessedFrame, ...]]:
        """Return the beginning and the frames of the longest part of the window that takes at most so many bytes."""
        cut = len(self._frames) - self._fitting(None, len(self._frames), most_bytes)
        return self.state(cut), tuple(self._frames[cut:])

    def _fitting(self, span_ns: int | None, most: int, most_bytes: int) -> int:
        """Return how many of the newest frames fit."""
        frames = self._frames
        if span_ns != 0 and frames and len(frames) <= most and self._weight <= most_bytes:
            # Mostly all but the oldest few fit, and they are of one generation: the two ends give their span.
            last, first = frames[-1], 0
            if span_ns is not None and frames[0].place.generation == last.place.generation:
                since_ns = last.place.time_ns - span_ns
                while frames[first].place.time_ns < since_ns:
                    first += 1
                return len(frames) - first
        elapsed, weight, number = 0, 0, 0
        later: ProcessedFrame | None = None
        for frame in reversed(self._frames):
            if later is not None and later.place.generation == frame.place.generation:
                elapsed += later.place.time_ns - frame.place.time_ns
            elif later is not None and frame.frame_id.sensor:
                break  # the clock of several sensors is not set back
            weight += frame.weight
            if number >= most or weight > most_bytes or (span_ns is not None and elapsed > span_ns) or span_ns == 0:
                break
            number += 1
            later = frame
        return number

"""The window of a session that can be processed again: a state, the frames since, and the state after each of them.

A frame that comes late is put between those that it belongs between, and those behind it are gone through once more,
as is done for a cloud that comes late. What then stands at the end is what would stand there had everything come in
order, to the last byte, because a step is a pure function and nothing else leads from one state to the next. That
holds across the cuts between lives of the density too, and for the first frame of one.

The window is the longest row of newest frames that lies within a span of sensor time, a number of frames and a number
of bytes: again a function of the frames alone, so that sessions that took the same frames have the same window.
States take memory and are easily computed again, so they are not written into checkpoints; after a restore they are
made up for when they are needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.state import Contents, Entry, FilterState
    from optipmb_service.session.timeline import FrameId, Placement
    from optipmb_service.session.transition import Outcome
    from optipmb_service.session.values import Policy

    Step = Callable[[FilterState, Entry, Contents | None], tuple[FilterState, Outcome]]


class ReorderWindow:
    """Where a session is and how it came there.

    Args:
        base: the state before the window.
        step: goes from one state to the next by a frame; may raise, then nothing has changed here.
        entries: the frames of the window in the order of processing.
        head: the state after them.
    """

    def __init__(
        self, base: FilterState, step: Step, entries: Sequence[Entry] = (), head: FilterState | None = None
    ) -> None:
        self.base = base
        self.step = step
        self._entries = list(entries)
        self._weight = sum(entry.weight for entry in entries)
        self._after: list[FilterState | None] = [None] * len(self._entries)
        if self._entries:
            self._after[-1] = head
        self.head = self.state(len(self._entries))
        """The present state."""

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The frames of the window in the order of processing."""
        return tuple(self._entries)

    def state(self, number: int) -> FilterState:
        """Return the state after so many frames of the window; it is computed when it is not there."""
        known = number
        while known and self._after[known - 1] is None:
            known -= 1
        state = self._after[known - 1] if known else self.base
        assert state is not None  # noqa: S101 - the search ended at one that is there; said for the type checker
        for at in range(known, number):
            state, _ = self.step(state, self._entries[at], None)
            self._after[at] = state
        return state

    def append(self, entry: Entry, contents: Contents) -> list[Outcome]:
        """Go on by a frame that belongs behind all others and moves none."""
        state, outcome = self.step(self.head, entry, contents)
        self._entries.append(entry)
        self._weight += entry.weight
        self._after.append(state)
        self.head = state
        return [outcome]

    def inserted(self, entry: Entry, places: Mapping[FrameId, Placement]) -> list[Entry]:
        """Return the frames of the window with one more among them, all where they belong then."""
        placed = [
            old if old.place == (place := places[old.frame_id]) else replace(old, place=place) for old in self._entries
        ]
        return sorted([*placed, entry], key=lambda one: one.order)

    def amended(self, points: schemas.Points, frame_id: FrameId, *, published: bool) -> list[Entry]:
        """Return the frames of the window, a late cloud given to those of its sensor and stamp that lack one.

        Args:
            points: the cloud.
            frame_id: its epoch, stamp and sensor.
            published: whether detections came in that epoch; see `CloudBuffer.get`.
        """
        return [
            one.given(points)
            if (one.frame_id.stamp_ns, one.frame_id.sensor) == (frame_id.stamp_ns, frame_id.sensor)
            and one.points is None
            and one.message.has_points is not False
            and (one.frame_id.epoch == frame_id.epoch or not published)
            else one
            for one in self._entries
        ]

    def redo(self, placed: Sequence[Entry]) -> list[Outcome]:
        """Take over other frames, and go through them again from the first that differs.

        Returns:
            What became of each of them in order; those that were there before get a higher revision.
        """
        old = self._entries
        same = (new is one for new, one in zip(placed, old, strict=False))
        first = next((i for i, one in enumerate(same) if not one), min(len(placed), len(old)))
        known = {entry.frame_id for entry in old}
        entries = list(placed)
        state = self.state(first)
        after: list[FilterState] = []
        outcomes: list[Outcome] = []
        for i in range(first, len(entries)):
            if entries[i].frame_id in known:
                entries[i] = replace(entries[i], revision=entries[i].revision + 1)
            state, outcome = self.step(state, entries[i], None)
            after.append(state)
            outcomes.append(outcome)
        self._entries = entries
        self._weight = sum([entry.weight for entry in entries])
        self._after = [*self._after[:first], *after]
        self.head = state
        return outcomes

    def trim(self, policy: Policy) -> tuple[FrameId, ...]:
        """Let what no longer belongs to the window go; returns which frames that were."""
        sensors = max(1, len(self.head.sensors))
        keep = self._fitting(policy.rewind_ns, policy.rewind_frames * sensors, policy.rewind_bytes * sensors)
        cut = len(self._entries) - keep
        if not cut:
            return ()
        self.base = self.state(cut)
        gone = self._entries[:cut]
        del self._entries[:cut], self._after[:cut]
        for entry in gone:
            self._weight -= entry.weight
        return tuple([entry.frame_id for entry in gone])

    def portable(self, most_bytes: int) -> tuple[FilterState, tuple[Entry, ...]]:
        """Return the beginning and the frames of the longest part of the window that takes at most so many bytes."""
        cut = len(self._entries) - self._fitting(None, len(self._entries), most_bytes)
        return self.state(cut), tuple(self._entries[cut:])

    def _fitting(self, span_ns: int | None, most: int, most_bytes: int) -> int:
        """Return how many of the newest frames fit."""
        entries = self._entries
        if span_ns != 0 and entries and len(entries) <= most and self._weight <= most_bytes:
            # Mostly all but the oldest few fit, and they are of one generation: their span is that of the two ends.
            last, first = entries[-1], 0
            if span_ns is not None and entries[0].place.generation == last.place.generation:
                since_ns = last.place.time_ns - span_ns
                while entries[first].place.time_ns < since_ns:
                    first += 1
                return len(entries) - first
        elapsed, weight, number = 0, 0, 0
        later: Entry | None = None
        for entry in reversed(self._entries):
            if later is not None and later.place.generation == entry.place.generation:
                elapsed += later.place.time_ns - entry.place.time_ns
            elif later is not None and entry.frame_id.sensor:
                break  # the clock of several sensors is not set back
            weight += entry.weight
            if number >= most or weight > most_bytes or (span_ns is not None and elapsed > span_ns) or span_ns == 0:
                break
            number += 1
            later = entry
        return number

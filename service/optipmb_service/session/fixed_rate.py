"""Output at a fixed rate: tracks of a session, predicted to now or as they were some time ago. It has no own clock."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from optipmb_schemas import PATHS

from optipmb.filter.paths import tracks_ahead
from optipmb.learning.hindsight import with_hindsight
from optipmb.model.table import ClassTable
from optipmb_service.session.outputs import Begun, TrackedFrame
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb
    from optipmb_service.session.outputs import Output
    from optipmb_service.settings import OutputSettings

CLOCK_NS: Final = 5 * SECOND
"""Time for which stamps are away from the clock before that is a problem."""

MOST_FRAMES: Final = 200
"""Frames held for a delay; beyond them the delay is shorter."""


def _stamp_of(tracked: TrackedFrame) -> int:
    stamp_ns: int = tracked.header["stamp_ns"]
    return stamp_ns


class FixedRate:
    """Tracks of one session, due at a fixed rate while frames come.

    Args:
        settings: the rate, and the clock of the stamps.
    """

    def __init__(self, settings: OutputSettings) -> None:
        self._period_ns = round(SECOND / settings.rate_hz)
        self._delay_ns, self._longest_ns = round(settings.delay_s * SECOND), round(settings.longest_s * SECOND)
        self._by_arrival, self._show = settings.clock == "arrival", settings.show
        self._frames: list[TrackedFrame] = []
        """By stamp: the newest frames, up to the one before the delay."""
        self._arrived_ns = 0
        """Monotonic arrival of the newest stamp."""
        self._away_ns: int | None = None
        """Monotonic time since when stamps are away from the clock."""
        self._wrong = False
        self._parameters: optipmb.Parameters | None = None
        self.due_ns: int | None = None
        """Monotonic time of the next output; None: none before another frame."""

    def take(self, outputs: Sequence[Output], now_ns: int) -> str:
        """Take outputs of the session; return how far its stamps are from the clock, once they have been for long."""
        frames = self._frames
        before = frames[-1] if frames else None
        for one in outputs:
            if isinstance(one, Begun):
                frames.clear()
            elif isinstance(one, TrackedFrame):  # corrected ones come up to the newest
                place = bisect_left(frames, _stamp_of(one), key=_stamp_of)
                same = place < len(frames) and _stamp_of(frames[place]) == _stamp_of(one)
                frames[place : place + same] = [one]
        if not frames or frames[-1] is before:
            return ""
        newest, stamp_ns = frames[-1], _stamp_of(frames[-1])
        passed = bisect_left(frames, stamp_ns - self._delay_ns, key=_stamp_of) - 1
        del frames[: max(passed, len(frames) - MOST_FRAMES, 0)]
        if self.due_ns is None:
            self.due_ns = now_ns
        ticket = newest.ticket
        if before is not None and _stamp_of(before) == stamp_ns:
            return ""  # corrected, with the ticket of a late frame
        self._arrived_ns = ticket.now_ns
        behind_ns = ticket.wall_ns - stamp_ns
        if self._by_arrival or abs(behind_ns) <= self._longest_ns:
            self._away_ns, self._wrong = None, False
            return ""
        if self._away_ns is None:
            self._away_ns = ticket.now_ns
        known, self._wrong = self._wrong, ticket.now_ns - self._away_ns >= CLOCK_NS
        side = "behind" if behind_ns > 0 else "ahead"
        return f"{abs(behind_ns) / SECOND:.3f} s {side}" if self._wrong and not known else ""

    def due(self, now_ns: int, wall_ns: int, parameters: optipmb.Parameters) -> TrackedFrame | None:
        """Return the tracks that are due, if any.

        Args:
            now_ns: monotonic time.
            wall_ns: system time.
            parameters: the profile of the session.
        """
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        frames = self._frames
        stamp_ns = _stamp_of(frames[-1]) if frames else 0
        silent_ns = now_ns - self._arrived_ns
        age_ns = silent_ns if self._by_arrival else wall_ns - stamp_ns
        if not frames or self._wrong or max(age_ns, silent_ns) > self._longest_ns:
            self.due_ns = None
            return None
        self.due_ns += ((now_ns - self.due_ns) // self._period_ns + 1) * self._period_ns
        if parameters is not self._parameters:
            self._parameters, self._table = parameters, ClassTable.of(parameters)
        wanted_ns = stamp_ns + max(0, age_ns) - self._delay_ns
        if len(frames) == MOST_FRAMES:
            wanted_ns = max(wanted_ns, _stamp_of(frames[0]))
        elif wanted_ns < _stamp_of(frames[0]):
            return None  # of a time before the first frame
        place = min(bisect_left(frames, wanted_ns, key=_stamp_of), len(frames) - 1)
        shown, later = frames[place], frames[place + 1 :]
        tracks, shown_ns = shown.estimates, _stamp_of(shown)
        if later:
            seen = [tracks, *(one.estimates for one in later)]
            tracks = tracks.replaced(**with_hindsight(seen, parameters, show=self._show)[0])
        elif wanted_ns > shown_ns:
            tracks = tracks_ahead(tracks, (wanted_ns - shown_ns) * 1e-9, self._table)
        if self._show is not None and not later:
            tracks = tracks.replaced(confirmed=tracks.existence >= self._show)
        return replace(
            shown,
            estimates=tracks,
            header=shown.header | {"predicted_to_ns": max(wanted_ns, shown_ns)},
            others={name: value for name, value in shown.others.items() if name not in PATHS},
        )

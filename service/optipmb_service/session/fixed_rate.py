"""Output at a fixed rate: the newest tracks of a session, predicted to now. It has no clock of its own."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from optipmb_schemas import PATHS

from optipmb.paths import tracks_ahead
from optipmb.table import ClassTable
from optipmb_service.session.values import SECOND, Begun, Tracked

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb
    from optipmb_service.session.values import Output
    from optipmb_service.settings import OutputSettings

CLOCK_NS: Final = 5 * SECOND
"""Time for which stamps are away from the clock before that is a problem."""


class FixedRate:
    """Tracks of one session, due at a fixed rate while frames come.

    Args:
        settings: the rate, and the clock of the stamps.
    """

    def __init__(self, settings: OutputSettings) -> None:
        self._period_ns = round(SECOND / settings.rate_hz)
        self._delay_ns, self._longest_ns = round(settings.delay_s * SECOND), round(settings.longest_s * SECOND)
        self._by_arrival = settings.clock == "arrival"
        self._newest: Tracked | None = None
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
        before = newest = self._newest
        for one in outputs:
            if isinstance(one, Begun):
                newest = None
            elif isinstance(one, Tracked):
                newest = one  # frames come in the order of their stamps, corrected ones up to the newest
        self._newest = newest
        if newest is None or newest is before:
            return ""
        if self.due_ns is None:
            self.due_ns = now_ns
        stamp_ns, ticket = newest.header["stamp_ns"], newest.ticket
        if before is not None and before.header["stamp_ns"] == stamp_ns:
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

    def due(self, now_ns: int, wall_ns: int, parameters: optipmb.Parameters) -> Tracked | None:
        """Return the tracks that are due, if any.

        Args:
            now_ns: monotonic time.
            wall_ns: system time.
            parameters: the profile of the session.
        """
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        newest = self._newest
        stamp_ns = 0 if newest is None else newest.header["stamp_ns"]
        silent_ns = now_ns - self._arrived_ns
        age_ns = silent_ns if self._by_arrival else wall_ns - stamp_ns
        if newest is None or self._wrong or max(age_ns, silent_ns) > self._longest_ns:
            self.due_ns = None
            return None
        self.due_ns += ((now_ns - self.due_ns) // self._period_ns + 1) * self._period_ns
        if parameters is not self._parameters:
            self._parameters, self._table = parameters, ClassTable.of(parameters)
        ahead_ns = max(0, age_ns - self._delay_ns)
        tracks = newest.estimates
        return replace(
            newest,
            estimates=tracks_ahead(tracks, ahead_ns * 1e-9, self._table) if ahead_ns else tracks,
            header=newest.header | {"predicted_to_ns": stamp_ns + ahead_ns},
            others={name: value for name, value in newest.others.items() if name not in PATHS},
        )

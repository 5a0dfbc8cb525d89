"""Whether the stamps of a sensor advance as a clock in nanoseconds does. Nothing is decided by it but a report.

Frames of a detector are more than a millisecond apart. Stamps that advance by less are constant or have another unit,
at whatever speed a recording is replayed; the times of arrival tell which unit, where the ratio is certain.
"""

from __future__ import annotations

from typing import Final

from optipmb_service.session.values import SECOND

FRAMES: Final = 20
"""Frames after which the advance of their stamps is looked at."""

SHORTEST_STEP_NS: Final = SECOND // 1000
"""Frames that are further apart by their stamps have a clock in nanoseconds."""

SHORTEST_ARRIVAL_NS: Final = SECOND // 10
"""Frames that all came within less time are from a cache: their arrival tells nothing."""

UNITS: Final = {"microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}

CERTAIN: Final = 3.0
"""Factor by which the ratio of arrival and stamps may differ from that of a unit."""


class StampCheck:
    """The advance of the stamps of one sensor, over `FRAMES` frames after another."""

    def __init__(self) -> None:
        self._count = 0
        self._first = 0, 0
        self._constant = True

    def add(self, stamp_ns: int, arrived_ns: int) -> str:
        """Return what is wrong with the stamps up to a frame; empty when nothing is, or too few came.

        Args:
            stamp_ns: stamp of the frame.
            arrived_ns: when it arrived, monotonic.
        """
        if not self._count:
            self._first, self._constant = (stamp_ns, arrived_ns), True
        self._count += 1
        first_ns, first_arrived_ns = self._first
        self._constant &= stamp_ns == first_ns
        if self._count < FRAMES:
            return ""
        self._count = 0
        if self._constant:
            return f"{FRAMES} frames with the stamp {stamp_ns}: the clock does not advance"
        advance_ns, took_ns = stamp_ns - first_ns, arrived_ns - first_arrived_ns
        if not 0 < advance_ns < (FRAMES - 1) * SHORTEST_STEP_NS or took_ns < SHORTEST_ARRIVAL_NS:
            return ""
        for unit, factor in UNITS.items():
            if 1 / CERTAIN < advance_ns * factor / took_ns < CERTAIN:
                return f"{FRAMES} frames in {took_ns / SECOND:.1f} s, {advance_ns} apart: stamps look like {unit}"
        return ""

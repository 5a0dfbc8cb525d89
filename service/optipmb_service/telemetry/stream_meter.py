"""Figures of a stream that an operator reads: rate, latency, age. The clock is handed in, in monotonic ns."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from itertools import pairwise
from typing import Final

import optipmb_schemas as schemas

LATENCIES: Final = 512
ARRIVALS: Final = 1024
RATE_NS: Final = 5_000_000_000  # the rate is averaged over this time, or over the last two frames
SILENT_PERIODS: Final = 3  # after so many periods without a frame the rate falls, and the stream is silent
LAST: Final = 5  # frames whose largest distance is the period by which silence is judged


class StreamMeter:
    """Written by the tracking thread, read by any: the interpreter copies a queue of integers in one step."""

    def __init__(self, now_ns: int) -> None:
        self._latencies: deque[int] = deque(maxlen=LATENCIES)
        self._arrivals: deque[int] = deque(maxlen=ARRIVALS)
        self.active_ns = now_ns
        """When the last valid message arrived."""
        self.frame_ns: int | None = None
        """When the last frame arrived."""

    def arrived(self, now_ns: int, *, frame: bool) -> None:
        """Note a valid message."""
        self.active_ns = max(self.active_ns, now_ns)
        if frame:
            self._arrivals.append(now_ns)
            self.frame_ns = now_ns

    def published(self, latency_ns: int) -> None:
        """Note the time from the arrival of a frame to the publication of its tracks."""
        self._latencies.append(latency_ns)

    def is_silent(self, now_ns: int) -> bool:
        """Tell whether no frame came for several of the stream's own periods; a stream of one frame has none."""
        last = list(self._arrivals)[-LAST:]
        period_ns = max((after - before for before, after in pairwise(last)), default=0)
        return not last or now_ns - last[-1] > SILENT_PERIODS * period_ns

    def rate_hz(self, now_ns: int) -> float:
        """Return frames per second over the last `RATE_NS`, falling while none comes; 0 with fewer than two."""
        arrivals = list(self._arrivals)
        if len(arrivals) < 2:  # noqa: PLR2004 - a rate needs two frames
            return 0.0
        last = arrivals[-1]
        begin = min(bisect_left(arrivals, last - RATE_NS), len(arrivals) - 2)
        count, span = len(arrivals) - 1 - begin, last - arrivals[begin]
        if span <= 0:
            return 0.0
        if (now_ns - last) * count > SILENT_PERIODS * span:
            return (len(arrivals) - bisect_left(arrivals, now_ns - RATE_NS)) * 1e9 / RATE_NS
        return count * 1e9 / span

    def latency_ms(self) -> tuple[float, float]:
        """Return the median and the 99th percentile over the last frames; zeros without any."""
        values = sorted(self._latencies)
        if not values:
            return 0.0, 0.0
        return values[len(values) // 2] / 1e6, values[min(len(values) - 1, len(values) * 99 // 100)] / 1e6

    def age_s(self, now_ns: int) -> float | None:
        """Return the seconds since the last frame; None before the first."""
        return None if self.frame_ns is None else max(0.0, (now_ns - self.frame_ns) / 1e9)

    def summary(
        self, state: schemas.SessionState, now_ns: int, *, stale: bool, degraded: bool
    ) -> schemas.SessionSummary:
        """Return the line of the service's status for a stream in a state; may be called by any thread."""
        p50, p99 = self.latency_ms()
        return schemas.SessionSummary(
            stream=state.stream,
            profile=state.profile,
            state="stale" if stale else "degraded" if degraded else state.state,
            rate_hz=self.rate_hz(now_ns),
            latency_p50_ms=p50,
            latency_p99_ms=p99,
            frames=state.frames,
            refused=state.refused,
            shed=state.shed,
            gaps=state.gaps,
            late=state.late,
            duplicates=state.duplicates,
            tracks=state.tracks,
            queue=state.queue,
            age_s=self.age_s(now_ns),
            rejoined=state.rejoined,
            lost_objects=state.lost_objects,
            lost_dropped=state.lost_dropped,
            embedding_ignored=state.embedding_ignored,
        )

"""What the gateway counts; read when somebody asks for the metrics."""

from __future__ import annotations

import collections


class CallMetrics:
    """Counts of calls; written on the loop, or by one thread each, and read by any."""

    def __init__(self) -> None:
        self.open: collections.Counter[str] = collections.Counter()
        self.ended: collections.Counter[tuple[str, str]] = collections.Counter()
        self.seconds: collections.Counter[str] = collections.Counter()
        self.requests: collections.Counter[str] = collections.Counter()
        self.responses: collections.Counter[str] = collections.Counter()
        self.skipped: collections.Counter[str] = collections.Counter()
        self.refused: collections.Counter[str] = collections.Counter()
        self.request_bytes = 0
        self.invalid = 0

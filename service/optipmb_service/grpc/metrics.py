"""What the gateway counts; read when somebody asks for the metrics."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from optipmb_service.observability.metrics import Value


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

    def figures(self) -> Iterator[Value]:
        """Return all counts as metrics."""
        for name, counts in (
            ("grpc_open_calls", self.open),
            ("grpc_requests_total", self.requests),
            ("grpc_responses_total", self.responses),
            ("grpc_skipped_total", self.skipped),
            ("grpc_refused_total", self.refused),
        ):
            for label, count in dict(counts).items():
                yield name, (label,), count
        for labels, count in dict(self.ended).items():
            yield "grpc_calls_total", labels, count
        yield "grpc_invalid_total", (), self.invalid

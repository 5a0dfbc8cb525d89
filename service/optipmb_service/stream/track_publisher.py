"""Publication of a stream's tracks: delivery, encoding, publisher, and waiting for a write lease.

Used by the tracking thread alone.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import structlog

from optipmb.rows import record
from optipmb_service.stream.ports import TransportError
from optipmb_service.stream.values import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.cluster.member import Member
    from optipmb_service.stream.ports import Publisher
    from optipmb_service.stream.values import Tracked
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.telemetry.stream_meter import StreamMeter

log = structlog.get_logger("optipmb_service")

MILLISECOND: Final = 1e6


@record
class Arrival:
    """Times of a frame's arrival, and of its decoding."""

    wall_ns: int
    now_ns: int
    decode_ns: int


class TrackPublisher:
    """The publisher of a stream, while this instance owns it.

    Args:
        stream: `site/node/sensor`.
        instance: name of the service.
        open_publisher: opens the publisher of a stream.
        meter: counts publications of the stream.
        metrics: counts those of the process.
        member: knows whether the write lease holds; tracks wait while it does not.
    """

    def __init__(
        self,
        stream: str,
        instance: str,
        open_publisher: Callable[[str], Publisher],
        meter: StreamMeter,
        metrics: Metrics,
        member: Member,
    ) -> None:
        self._stream = stream
        self._instance = instance
        self._open_publisher = open_publisher
        self._meter = meter
        self._metrics = metrics
        self._member = member
        self._publisher: Publisher | None = None
        self.waiting: list[tuple[bytes, Arrival, int, int]] = []
        """Encoded tracks that wait for the write lease."""
        self._ids = b""
        self._fence: int | None = None

    def open(self, fence: int | None) -> None:
        """Open the publisher, for what is made under a fence."""
        self._fence = fence
        try:
            self._publisher = self._open_publisher(self._stream)
        except TransportError as error:
            log.warning("publisher_failed", stream=self._stream, error=str(error))

    def renew(self, fence: int | None) -> None:
        """Go on under another fence."""
        self._fence = fence

    def close(self) -> None:
        """Withdraw the publisher; what waits is dropped: another owner publishes it."""
        self.waiting.clear()
        self._count_tracks(b"")
        if self._publisher is not None:
            self._publisher.release()
            self._publisher = None

    def send(self, tracked: Tracked) -> None:
        """Publish the tracks of a frame, now or when the write lease holds again."""
        ticket: Arrival = tracked.ticket
        passed_ns = time.monotonic_ns() - ticket.now_ns
        waited_ns = max(0, passed_ns - ticket.decode_ns - tracked.step_ns)
        delivery = {
            "instance": self._instance,
            "received_ns": ticket.wall_ns,
            "published_ns": time.time_ns(),
            "queue_ms": waited_ns / MILLISECOND,
            "decode_ms": ticket.decode_ns / MILLISECOND,
            "step_ms": tracked.step_ns / MILLISECOND,
            "run": tracked.run,
        }
        self._count_tracks(tracked.estimates.id.tobytes())
        self.waiting.append((tracked.encoded(delivery), ticket, waited_ns, tracked.step_ns))
        self.flush()

    def flush(self) -> None:
        """Publish what waits, if the write lease holds."""
        if not self.waiting or not self._member.may_write(self._stream, self._fence):
            return
        waiting, self.waiting = self.waiting, []
        for payload, ticket, waited_ns, step_ns in waiting:
            try:
                if self._publisher is not None:
                    self._publisher.publish(payload)
            except TransportError as error:
                log.warning("publish_failed", stream=self._stream, error=str(error))
            else:
                latency_ns = time.monotonic_ns() - ticket.now_ns
                self._meter.published(latency_ns)
                self._metrics.published(
                    latency_s=latency_ns / SECOND,
                    queue_s=waited_ns / SECOND,
                    decode_s=ticket.decode_ns / SECOND,
                    step_s=step_ns / SECOND,
                )

    def _count_tracks(self, ids: bytes) -> None:
        """Count the ids, as the bytes of int64, that were not there before, and those that no longer are."""
        if ids == self._ids:
            return
        after, before = (set(memoryview(one).cast("q")) for one in (ids, self._ids))
        self._metrics.tracks(started=len(after - before), ended=len(before - after))
        self._ids = ids

"""Outbox of one stream: outputs of its sessions on their way to the network, the log and the reporter of problems."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import structlog
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.trace_context import attachment_of

from optipmb_service.session.counts import MAX_COUNT
from optipmb_service.session.outputs import Begun, Quarantined, TrackedFrame
from optipmb_service.settings import FARTHEST
from optipmb_service.streams.persistence import save_dump
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from opentelemetry.context import Context

    from optipmb_service.session.fixed_rate import FixedRate
    from optipmb_service.session.identity import Reached
    from optipmb_service.session.outputs import Output
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.session import Session
    from optipmb_service.streams.parts import Parts
    from optipmb_service.streams.traces import FrameTrace
    from optipmb_service.telemetry.stream_meter import StreamMeter
    from optipmb_service.zenoh.transport import StreamPublisher

log = structlog.get_logger("optipmb_service")

MILLISECOND: Final = 1e6


class Ticket(NamedTuple):
    """Times of a frame's arrival and decoding, and its trace where traces are recorded; comes back with its tracks."""

    wall_ns: int
    now_ns: int
    decode_ns: int
    trace: FrameTrace | None = None


class StreamOutbox:
    """Tracks and events of one stream: published at once, or as soon as the write lease holds again.

    Args:
        stream: name of the session.
        parts: of the process.
        policy: of the session.
        meter: notes the latency of each frame.
    """

    def __init__(self, stream: str, parts: Parts, policy: Policy, meter: StreamMeter) -> None:
        self.fence: int | None = None
        """Fence of the lease by which the session publishes."""
        self.durable: Reached | None = None if parts.checkpoints.durable else (MAX_COUNT, 0, "")
        """How far the newest checkpoint is that a process would go on from; None: there is none."""
        self._stream = stream
        self._parts = parts
        self._policy = policy
        self._meter = meter
        self._traces = parts.traces
        self._publisher: StreamPublisher | None = None
        self._fixed_rate: FixedRate | None = None
        self._unpublished: list[tuple[bytes, bytes | None, TrackedFrame, int, Context | None]] = []
        """Encoded tracks and events that wait for the write lease, each with the time that its frame waited, ns."""
        self._ids = b""
        """Ids of the newest tracks, as the bytes of int64."""
        self._is_far = False

    @property
    def may_write(self) -> bool:
        """Whether the write lease holds."""
        return self._parts.member.may_write(self._stream, self.fence)

    def open(self, fence: int | None) -> None:
        """Declare the publishers of a session that begins."""
        self.fence = fence
        self._fixed_rate = self._parts.sessions.fixed_rate(self._stream)
        kinds = {"events": bool(self._policy.zones), "now": self._fixed_rate is not None}
        try:
            self._publisher = self._parts.transport.open_publisher(self._stream, **kinds)
        except TransportError as error:
            log.warning("publisher_failed", stream=self._stream, error=str(error))

    def close(self) -> None:
        """Withdraw the publishers; the next owner publishes what waits."""
        self._fixed_rate = None
        self._unpublished.clear()
        self._count_tracks(b"")
        if self._publisher is not None:
            self._publisher.release()
            self._publisher = None

    def deliver(self, outputs: Sequence[Output], session: Session | None) -> None:
        """Publish, log and report outputs of a session."""
        for output in outputs:
            if isinstance(output, TrackedFrame):
                self._check_place(output)
                self._send(output)
            elif isinstance(output, Begun):
                self._log_begun(output, session)
            elif isinstance(output, Quarantined):
                file = save_dump(self._parts.settings.folder, self._stream, output.dump)
                log.error("session_quarantined", stream=self._stream, error=output.error, file=file)
            else:
                self._parts.reporter.report(output, time.monotonic_ns())
        if self._fixed_rate is not None and (wrong := self._fixed_rate.take(outputs, time.monotonic_ns())):
            expected = 'system time, or `clock = "arrival"` in `outputs`'
            self._parts.report("clock", self._stream, expected, wrong, path="stamp_ns")

    def resume(self, session: Session) -> None:
        """Publish the events of a restored session's window in this run, which voids later ones of the run before."""
        self.durable = self.durable or session.final
        self._check_zones(session)
        now = Ticket(time.time_ns(), time.monotonic_ns(), 0)
        for tracked in session.again() if self._policy.zones else ():
            tracked.ticket = now
            self._send(tracked, again=True)

    def publish(self) -> None:
        """Publish what waits, if the write lease holds."""
        if not self._unpublished or not self.may_write:
            return
        waiting, self._unpublished = self._unpublished, []
        for payload, events, tracked, waited_ns, span in waiting:
            attachment = attachment_of(self._traces.traceparent(span)) if self._traces and span else None
            try:
                if self._publisher is not None:
                    if payload:
                        self._publisher.publish(payload, attachment)
                    if events is not None:
                        self._publisher.publish_events(events)
            except TransportError as error:
                log.warning("publish_failed", stream=self._stream, error=str(error))
                continue
            if self._traces and span:
                self._traces.published(span)
            if payload:
                latency_ns = time.monotonic_ns() - tracked.ticket.now_ns
                self._meter.published(latency_ns)
                self._parts.metrics.published(
                    latency_s=latency_ns / SECOND,
                    queue_s=waited_ns / SECOND,
                    decode_s=tracked.ticket.decode_ns / SECOND,
                    step_s=tracked.step_ns / SECOND,
                )

    def predict(self, session: Session) -> int | None:
        """Send tracks predicted to now, if they are due; return when the next ones are (monotonic), None: never."""
        if (fixed_rate := self._fixed_rate) is None:
            return None
        due_ns, now_ns = fixed_rate.due_ns, time.monotonic_ns()
        tracked = fixed_rate.due(now_ns, time.time_ns(), session.parameters)
        if tracked is not None and due_ns is not None and self._publisher is not None:
            try:
                self._publisher.publish_now(tracked.encoded(self._delivery(tracked, now_ns - due_ns)))
            except TransportError as error:
                log.warning("publish_failed", stream=self._stream, error=str(error))
        return fixed_rate.due_ns

    def _send(self, tracked: TrackedFrame, *, again: bool = False) -> None:
        """Publish tracks and events of a frame, `again` events alone, now or when the write lease holds again."""
        ticket: Ticket = tracked.ticket
        passed_ns = time.monotonic_ns() - ticket.now_ns
        waited_ns = max(0, passed_ns - ticket.decode_ns - tracked.step_ns)
        delivery = self._delivery(tracked, waited_ns)
        events = tracked.encoded_events(delivery, self.durable)
        if not again:
            self._count_tracks(tracked.estimates.id.tobytes())
        span = self._traces.tracked(ticket.trace, tracked) if self._traces and ticket.trace else None
        self._unpublished.append((b"" if again else tracked.encoded(delivery), events, tracked, waited_ns, span))
        self.publish()

    def _delivery(self, tracked: TrackedFrame, waited_ns: int) -> dict[str, Any]:
        return {
            "instance": self._parts.settings.instance,
            "received_ns": tracked.ticket.wall_ns,
            "published_ns": time.time_ns(),
            "queue_ms": waited_ns / MILLISECOND,
            "decode_ms": tracked.ticket.decode_ns / MILLISECOND,
            "step_ms": tracked.step_ns / MILLISECOND,
            "run": tracked.run,
        }

    def _count_tracks(self, ids: bytes) -> None:
        """Count new and ended tracks."""
        if ids != self._ids:
            after, before = (set(memoryview(one).cast("q")) for one in (ids, self._ids))
            self._parts.metrics.tracks(started=len(after - before), ended=len(before - after))
            self._ids = ids

    def _log_begun(self, begun: Begun, session: Session | None) -> None:
        if session and begun.reason in {"first", "parameters"}:
            self._check_zones(session)
        epoch = session.state().epoch if session else None
        log.info(
            "session_begun",
            stream=self._stream,
            session=begun.session,
            epoch=epoch.hex() if epoch else "",
            reason=begun.reason,
            profile=session.parameters.name if session else "",
            jump_s=begun.jump_ns / 1e9,
        )

    def _check_zones(self, session: Session) -> None:
        """Report the classes of zones that the profile lacks."""
        for zone in self._policy.zones:
            for label in zone.classes:
                if label not in session.parameters.labels:
                    expected = f"one of {', '.join(session.parameters.labels)} (profile {session.parameters.name})"
                    path = f"zones.{zone.name}.classes"
                    self._parts.report("unknown_class", self._stream, expected, repr(label), path=path)

    def _check_place(self, tracked: TrackedFrame) -> None:
        """Report, once, tracks that are far from the place of the site: as of coordinates of a grid, such as UTM."""
        if self._is_far or not self._policy.has_place:
            return
        far = abs(tracked.estimates.center[:, :2]).max(axis=1, initial=0.0) > FARTHEST
        if far.any():
            self._is_far = True
            expected = f"within {FARTHEST / 1e3:g} km of the origin of its site in `sites`"
            x, y = tracked.estimates.center[far][0, :2]
            self._parts.report("far", self._stream, expected, f"{x:.0f}, {y:.0f} m", path="center")

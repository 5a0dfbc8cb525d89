"""Spans of frames, by OpenTelemetry: the only module that imports it, where the setting `traces` is on.

The context of a frame stays with the frame, never with a thread: a frame may wait in several places, and spans are
recorded when their times are known.
"""

from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import OTELResourceDetector, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExportResult
from opentelemetry.trace import SpanKind, get_current_span, set_span_in_context
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb_schemas as schemas
    from opentelemetry.context import Context
    from opentelemetry.sdk.trace import ReadableSpan

    from optipmb_service.session.outputs import TrackedFrame
    from optipmb_service.zenoh.topics import Packet

log = structlog.get_logger("optipmb_service")

HEADER: Final = "traceparent"
MAX_REPORTED: Final = 1024
"""Streams whose invalid trace context is logged, each once."""


class FrameTrace(NamedTuple):
    """Context of the span `receive` of a frame or cloud, and the end of that span, ns since 1970."""

    context: Context
    ended_ns: int


class _Exporter(OTLPSpanExporter):
    """Exporter that logs when the collector takes no spans, and when it does again."""

    _fails = False

    def export(self, spans: Sequence[ReadableSpan]) -> SpanExportResult:
        result = super().export(spans)
        fails = result is not SpanExportResult.SUCCESS
        if fails and not self._fails:
            log.warning("traces_lost", spans=len(spans))
        elif self._fails and not fails:
            log.info("traces_back")
        self._fails = fails
        return result


class Traces:
    """Recorder of spans.

    Args:
        instance: name of the service.
        provider: of the spans; default: batches over OTLP to the collector that the variables OTEL_* name. A batch
            processor drops spans when its queue is full.
    """

    def __init__(self, instance: str, provider: TracerProvider | None = None) -> None:
        if provider is None:
            ours = Resource.create(
                {"service.name": "optipmb-service", "service.instance.id": instance, "process.pid": os.getpid()}
            )
            provider = TracerProvider(resource=ours.merge(OTELResourceDetector().detect()), shutdown_on_exit=False)
            provider.add_span_processor(BatchSpanProcessor(_Exporter()))
        self._provider = provider
        self._tracer = provider.get_tracer("optipmb_service")
        self._w3c = TraceContextTextMapPropagator()
        self._reported: set[str] = set()

    def received(self, packet: Packet, message: schemas.Detections | schemas.Points) -> FrameTrace:
        """Record the span `receive` of a message that has just been decoded, below the context that came with it."""
        parent = self._w3c.extract({HEADER: packet.traceparent})
        invalid = packet.traceparent and not get_current_span(parent).get_span_context().is_valid
        if invalid and message.stream not in self._reported and len(self._reported) < MAX_REPORTED:
            self._reported.add(message.stream)
            log.warning("traceparent_invalid", stream=message.stream, received=packet.traceparent)
        about = {
            "optipmb.stream": message.stream,
            "optipmb.topic": "detections" if packet.frame else "points",
            "optipmb.epoch": message.epoch.hex(),
            "optipmb.seq": message.seq,
        }
        span = self._tracer.start_span("receive", parent, SpanKind.CONSUMER, about, start_time=packet.wall_ns)
        ended_ns = time.time_ns()
        span.end(ended_ns)
        return FrameTrace(set_span_in_context(span), ended_ns)

    def tracked(self, trace: FrameTrace, tracked: TrackedFrame) -> Context:
        """Record `wait` and `step` of a frame whose step has just ended, begin `publish`, and return its context."""
        now_ns, header = time.time_ns(), tracked.header
        about = {
            "optipmb.stream": header["stream"],
            "optipmb.epoch": header["epoch"].hex(),
            "optipmb.seq": header["seq"],
            "optipmb.revision": header.get("revision", 0),
            "optipmb.session": header["session"],
        }
        if sensor := header.get("sensor"):
            about["optipmb.sensor"] = sensor
        began_ns = max(trace.ended_ns, now_ns - tracked.step_ns)
        for name, start_ns, end_ns in (("wait", trace.ended_ns, began_ns), ("step", began_ns, now_ns)):
            span = self._tracer.start_span(name, trace.context, attributes=about, start_time=start_ns)
            span.end(end_ns)
        span = self._tracer.start_span("publish", trace.context, SpanKind.PRODUCER, about, start_time=now_ns)
        return set_span_in_context(span)

    def published(self, context: Context) -> None:
        """End the span `publish`."""
        get_current_span(context).end()

    def traceparent(self, context: Context) -> str:
        """Return the W3C header of a context."""
        carrier: dict[str, str] = {}
        self._w3c.inject(carrier, context)
        return carrier.get(HEADER, "")

    def close(self, seconds: float) -> None:
        """Send the spans that wait, within `seconds`: a collector that does not answer must not delay the end."""
        closing = threading.Thread(target=self._provider.shutdown, name="traces", daemon=True)
        closing.start()
        closing.join(seconds)

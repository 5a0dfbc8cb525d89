"""Traces: spans of frames by OpenTelemetry, from the context that a publisher sends to the context of the tracks."""

import os
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
import structlog
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanContext
from optipmb_client import Publisher, Subscriber
from optipmb_client.trace_context import attached, attachment_of
from optipmb_schemas import Detections, Points, Tracks, decode
from optipmb_service.session.checkpoint import encode_checkpoint
from optipmb_service.streams.traces import Traces
from registries import Around, packet_of, streams_of
from router import Sensor, plain, until
from service_process import ServiceProcess

SENSOR = Sensor()
PARENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"


def traceparent(context: SpanContext) -> str:
    """Return the W3C header of a span."""
    return f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"


class Traced(Around):
    """The streams of a process that records spans, and its published tracks."""

    def __init__(self) -> None:
        super().__init__()
        self.exporter = InMemorySpanExporter()
        self.published: list[tuple[bytes, str]] = []
        provider = TracerProvider(shutdown_on_exit=False)
        provider.add_span_processor(SimpleSpanProcessor(self.exporter))
        self.traces = Traces("test", provider)
        self.streams = streams_of(
            self, traces=self.traces, cloud_wait_s=60
        )  # for clouds that come late on a busy machine

    def publish(self, payload: bytes, attachment: bytes | None = None) -> None:  # type: ignore[override]  # as the service calls it
        self.published.append((payload, attached(attachment)))

    def send(self, message: Detections | Points, parent: str = "") -> None:
        """Receive a message, and run until nothing is left to do."""
        packet = packet_of(message)
        packet.traceparent = parent
        self.streams.receive(packet)
        self.run()

    def spans(self) -> dict[int, dict[str, list[ReadableSpan]]]:
        found: dict[int, dict[str, list[ReadableSpan]]] = defaultdict(lambda: defaultdict(list))
        for one in self.exporter.get_finished_spans():
            found[int(str((one.attributes or {})["optipmb.seq"]))][one.name].append(one)
        return found


def test_a_frame_is_traced_from_its_publisher_to_its_tracks() -> None:
    """The spans of a frame are below its parent, one after the other, and say which frame; its tracks go on with it."""
    process = Traced()
    process.send(SENSOR.detections(0), PARENT)
    spans = {name: one for name, (one,) in process.spans()[0].items()}
    assert list(spans) == ["receive", "wait", "step", "publish"]
    receive = spans["receive"]
    assert receive.parent is not None
    assert traceparent(receive.parent) == PARENT
    assert all(one.context.trace_id == int(PARENT.split("-")[1], 16) for one in spans.values())
    assert all(one.parent == receive.context for name, one in spans.items() if name != "receive")
    times = [time for one in spans.values() for time in (one.start_time, one.end_time)]
    assert times == sorted(times, key=lambda one: one or 0)
    said = {"optipmb.stream": SENSOR.stream, "optipmb.epoch": SENSOR.epoch.hex(), "optipmb.seq": 0}
    assert all(said.items() <= dict(one.attributes or {}).items() for one in spans.values())
    assert (spans["step"].attributes or {})["optipmb.revision"] == 0
    assert [parent for _, parent in process.published] == [traceparent(spans["publish"].context)]


def test_corrections_belong_to_the_trace_of_the_late_frame() -> None:
    """A late frame's trace has the steps of all frames that it corrects, with their revisions."""
    process = Traced()
    for seq in (0, 1, 3, 4):
        process.send(SENSOR.detections(seq))
    process.send(SENSOR.detections(2), PARENT)
    late = int(PARENT.split("-")[1], 16)
    steps = [
        (seq, (one.attributes or {})["optipmb.revision"])
        for seq, names in process.spans().items()
        for one in names["step"]
        if one.context.trace_id == late
    ]
    assert sorted(steps) == [(2, 0), (3, 1), (4, 1)]


def test_a_frame_keeps_its_context_where_it_waits() -> None:
    """A frame that waits for its cloud is published with its own context."""
    process = Traced()
    process.send(SENSOR.detections(0, has_points=False))
    process.send(SENSOR.detections(1, has_points=True), PARENT)
    assert not process.spans()[1]["step"]
    process.send(SENSOR.points(1))
    (step,) = process.spans()[1]["step"]
    assert step.context.trace_id == int(PARENT.split("-")[1], 16)
    assert process.published[1][1].split("-")[1] == PARENT.split("-")[1]


def test_a_frame_keeps_its_context_when_its_stream_moves() -> None:
    """A pending frame goes to the next member of the stream below the span that received it here."""
    process = Traced()
    process.send(SENSOR.detections(0, has_points=False))
    process.send(SENSOR.detections(1, has_points=True), PARENT)
    process.streams.command(SENSOR.stream, lambda one: one.close_session("moved"), urgent=False)
    process.run()  # and it comes back
    process.send(SENSOR.points(1))
    here, there, _cloud = process.spans()[1]["receive"]
    assert there.parent is not None
    assert traceparent(there.parent) == traceparent(here.context)
    (step,) = process.spans()[1]["step"]
    assert step.parent == there.context


def test_payloads_are_those_without_traces() -> None:
    """Tracks and states do not depend on whether traces are recorded, but for the times of delivery."""
    traced = Traced()
    plain_one = Traced()
    plain_one.streams = streams_of(plain_one)
    for process in (traced, plain_one):
        for seq in (0, 1, 3, 2):
            process.send(SENSOR.detections(seq), PARENT)
    payloads = [[plain(decode(one, Tracks)) for one, _ in process.published] for process in (traced, plain_one)]
    assert payloads[0] == payloads[1]
    assert [parent for _, parent in plain_one.published] == [""] * 5
    states = [process.streams.of(SENSOR.stream).session.snapshot() for process in (traced, plain_one)]  # type: ignore[union-attr]  # both have one
    assert encode_checkpoint(states[0]) == encode_checkpoint(states[1])


def test_a_frame_from_a_kept_state_has_no_trace() -> None:
    """What a session that goes on after a crash publishes again belongs to no trace; new frames do."""
    process = Traced()
    for seq in range(3):
        process.send(SENSOR.detections(seq))
    process.streams.keep()
    process.run()
    process.exporter.clear()
    process.streams = streams_of(process, traces=process.traces)
    process.send(SENSOR.detections(3), PARENT)
    assert list(process.spans()) == [3]


@pytest.mark.parametrize("parent", ["00-0-0-01", PARENT.replace("b7ad6b7169203331", "0" * 16), "ff" + PARENT[2:], "x"])
def test_an_invalid_context_is_left_out_and_logged_once(parent: str) -> None:
    """The frames are tracked, in traces of their own."""
    process = Traced()
    with structlog.testing.capture_logs() as lines:
        for seq in range(3):
            process.send(SENSOR.detections(seq), parent)
    assert [(one["stream"], one["received"]) for one in lines if one["event"] == "traceparent_invalid"] == [
        (SENSOR.stream, parent)
    ]
    assert [one["receive"][0].parent for one in process.spans().values()] == [None] * 3
    assert len(process.published) == 3


def test_what_is_not_sampled_is_not_recorded_and_goes_on() -> None:
    """A parent that is not sampled decides for the whole trace."""
    process = Traced()
    process.send(SENSOR.detections(0), PARENT[:-1] + "0")
    assert not process.spans()
    ((_, parent),) = process.published
    assert (parent.split("-")[1], parent.split("-")[3]) == (PARENT.split("-")[1], "00")


@pytest.mark.parametrize(
    ("attachment", "parent"),
    [
        (attachment_of(PARENT), PARENT),
        (b"other=1\ntraceparent=" + PARENT.encode() + b"\nmore=2", PARENT),
        (b"no context", ""),
        (b"\xff" * 64, ""),
        (b"traceparent=" + b"0" * 300, ""),
        (None, ""),
    ],
)
def test_attachments(attachment: bytes | None, parent: str) -> None:
    """An attachment of somebody else is no trace context."""
    assert attached(attachment) == parent


class Collector(HTTPServer):
    """A collector of OTLP over HTTP, as small as one can be; answers with `status`."""

    def __init__(self) -> None:
        collector = self
        self.status = 200
        self.requests: list[ExportTraceServiceRequest] = []

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                collector.requests.append(ExportTraceServiceRequest.FromString(body))
                self.send_response(collector.status)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        super().__init__(("127.0.0.1", 0), Handler)

    def spans(self, scope: str = "optipmb_service") -> list[Any]:
        groups = [group for one in self.requests for resource in one.resource_spans for group in resource.scope_spans]
        return [span for group in groups if group.scope.name == scope for span in group.spans]

    def services(self) -> set[str]:
        found = [one.resource.attributes for request in self.requests for one in request.resource_spans]
        return {pair.value.string_value for pairs in found for pair in pairs if pair.key == "service.name"}


@pytest.fixture
def collector() -> Iterator[Collector]:
    with Collector() as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join(60)


@pytest.mark.parametrize("options", [(), ("--workers", "2")])
def test_a_trace_goes_through_processes(collector: Collector, options: tuple[str, ...]) -> None:
    """The span of a node is the parent of the service's spans, which are parents of the tracks' reader."""
    variables = {
        "OPTIPMB_TRACES": "true",
        "OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{collector.server_port}",
        "OTEL_BSP_SCHEDULE_DELAY": "100",
        "OTEL_SERVICE_NAME": "tracking",
    }
    tracer = TracerProvider(shutdown_on_exit=False).get_tracer("node")
    with ServiceProcess(*options, environment=variables) as service:
        service.wait_ready()
        with (
            Subscriber(SENSOR.stream, service.endpoint, timeout=60, history=True) as subscriber,
            Publisher(SENSOR.stream, service.endpoint, frame="world") as publisher,
        ):
            with tracer.start_as_current_span("detect") as span:
                parent = span.get_span_context()
                publisher.publish(stamp_ns=1, label=["car"], center=[[0, 0, 1]], score=[0.9])
            publisher.publish(stamp_ns=10**8, label=["car"], center=[[0, 0, 1]], score=[0.9])
            received = [subscriber.receive(60.0) for _ in range(2)]
            until(lambda: len(collector.spans()) >= 8, "the spans of two frames")
            spans = collector.spans()[:8]  # at the end another worker may track the frames again
        assert service.end()[0] == 0
    traced = [one for one in spans if int.from_bytes(one.trace_id, "big") == parent.trace_id]
    assert {one.name for one in traced} == {"receive", "wait", "step", "publish"}
    by_name = {one.name: one for one in traced}
    assert int.from_bytes(by_name["receive"].parent_span_id, "big") == parent.span_id
    assert received[0] is not None
    assert received[0].traceparent.split("-")[1:3] == [
        parent.trace_id.to_bytes(16, "big").hex(),
        by_name["publish"].span_id.hex(),
    ]
    assert collector.services() == {"tracking"}


def test_a_collector_that_fails_is_logged_and_harms_nothing(collector: Collector) -> None:
    """Frames are tracked, and the service ends in order."""
    collector.status = 400
    variables = {
        "OPTIPMB_TRACES": "true",
        "OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{collector.server_port}",
        "OTEL_BSP_SCHEDULE_DELAY": "100",
    }
    with ServiceProcess(environment=variables) as service:
        service.wait_ready()
        with (
            Subscriber(SENSOR.stream, service.endpoint, timeout=60, history=True) as subscriber,
            Publisher(SENSOR.stream, service.endpoint, frame="world") as publisher,
        ):
            publisher.publish(stamp_ns=1, label=["car"], center=[[0, 0, 1]], score=[0.9])
            assert next(iter(subscriber)).seq == 0
        service.wait_log("traces_failed")
        assert service.end()[0] == 0


def test_the_missing_extra_is_named(tmp_path: Path) -> None:
    """A service that is to record traces names the missing extra at its start."""
    (tmp_path / "opentelemetry").mkdir()
    (tmp_path / "opentelemetry" / "__init__.py").write_text("")  # in the place of the real one
    variables = {"OPTIPMB_TRACES": "true", "PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    with ServiceProcess(environment=variables, fresh=True) as service:
        assert service.wait_end() == 2
    assert "opentelemetry" in service.errors
    assert "[traces]" in service.errors
    assert len(service.errors.splitlines()) == 1


def test_a_collector_that_does_not_take_spans_is_reported(
    collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line when it begins to fail, one when it takes them again."""
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{collector.server_port}")
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "20")
    traces, message = Traces("test"), SENSOR.detections(0)
    with structlog.testing.capture_logs() as logged:

        def told() -> list[str]:
            return [one["event"] for one in logged if one["event"] in {"traces_lost", "traces_back"}]

        for count, status in enumerate((400, 400, 200)):
            collector.status = status
            traces.received(packet_of(message), message)
            until(lambda: len(collector.requests) > count, "spans are sent")  # noqa: B023 - it is called here
            until(lambda: len(told()) == (2 if status == 200 else 1), "it is logged")  # noqa: B023 - as above
        traces.close(60.0)
    assert told() == ["traces_lost", "traces_back"]

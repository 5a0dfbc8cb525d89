"""`Track`: input as of a native publisher, output as for a native subscriber."""

import queue
import secrets
import threading
import time
from collections.abc import Iterator
from typing import Any, Self

import grpc
import numpy as np
import pytest
import zenoh
import zenoh.ext
from gateway import GatewayProcess, detections, frame, points
from google.rpc import error_details_pb2
from grpc_status import rpc_status
from opentelemetry.sdk.trace import TracerProvider
from optipmb_client import Publisher
from optipmb_client.trace_context import attached
from optipmb_schemas import Detections, Keys, Points, Tracks, decode, encode
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from router import until
from routers import open_client
from service_process import ServiceProcess

KEYS = Keys()
DEADLINE_S = 30.0


class Heard:
    """What a plain Zenoh session hears of some keys."""

    def __init__(self, endpoint: str, *keys: str) -> None:
        self.session = open_client(endpoint)
        self._samples = [self.session.declare_subscriber(key, zenoh.handlers.FifoChannel(4096)) for key in keys]
        list(self.session.liveliness().get(KEYS.all_alive()))  # the router has taken the subscriptions

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped

    def take(self, number: int, at: int = 0, what: Any = lambda sample: sample.payload.to_bytes()) -> list[bytes]:
        ends, payloads = time.monotonic() + DEADLINE_S, []
        while len(payloads) < number:
            sample = self._samples[at].try_recv()
            assert time.monotonic() < ends, f"{len(payloads)} of {number}"
            payloads += [] if sample is None else [what(sample)]
            time.sleep(0 if sample else 0.002)
        return payloads


TRACE = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b716920333"


def test_trace_contexts_go_on_to_the_network(
    service: ServiceProcess, gateway: GatewayProcess, stub: Any, stream: str
) -> None:
    """The context of a request, or else of the call's metadata, is in the attachment; the client sends its span's."""
    first = detections(frame(0, stream))
    own = detections(frame(1, stream))
    own.traceparent = f"{TRACE}1-01"
    tracer = TracerProvider(shutdown_on_exit=False).get_tracer("node")
    with Heard(service.endpoint, KEYS.detections(stream)) as heard:
        list(stub.Track(iter((first, own)), metadata=(("traceparent", f"{TRACE}0-01"),)))
        with (
            Publisher(stream, f"grpc://{gateway.address}", frame="world") as publisher,
            tracer.start_as_current_span("detect") as span,
        ):
            publisher.publish(stamp_ns=10**19 // 2, label=["car"], center=[[0, 0, 1]], score=[0.9])
        attachments = heard.take(3, what=lambda sample: sample.attachment.to_bytes())
    context = span.get_span_context()
    said = f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"
    assert [attached(one) for one in attachments] == [f"{TRACE}0-01", f"{TRACE}1-01", said]


def violation(raised: pytest.ExceptionInfo[grpc.RpcError]) -> Any:
    status = rpc_status.from_call(raised.value)
    details = error_details_pb2.BadRequest()
    assert status is not None
    assert status.details[0].Unpack(details)
    return details.field_violations[0]


def test_tracks_are_those_on_zenoh(service: ServiceProcess, stub: Any, stream: str) -> None:
    """The tracks of every frame come back, byte-equal, as msgpack, to the ones on Zenoh."""
    with Heard(service.endpoint, KEYS.tracks(stream)) as heard:
        responses = list(stub.Track(detections(frame(seq, stream)) for seq in range(40)))
        published = heard.take(40)
    assert [encode(convert.from_proto(one.tracks, Tracks)) for one in responses] == published
    assert [one.tracks.seq for one in responses] == list(range(40))
    assert len(convert.from_proto(responses[-1].tracks, Tracks).id) == 2


def test_sensors_of_a_fused_session_get_the_tracks_of_their_frames(stub: Any) -> None:
    """Tracks of the session of their node, also when a call comes back."""
    for number, name in enumerate(["lidar", "radar", "radar"]):
        stream, first = f"fused-yard/robot/{name}", 20 * (name == "radar")
        found, complete = [], threading.Event()

        def requests(stream: str, first: int, complete: threading.Event) -> Iterator[pb.TrackRequest]:
            yield from (detections(frame(seq, stream, bytes([first] * 16))) for seq in range(first, first + 20))
            complete.wait(DEADLINE_S)  # first frames of a fused session wait for sensors that it does not know yet

        for one in stub.Track(requests(stream, first, complete)):
            found.append(one.tracks)
            if len(found) == 20:
                complete.set()
        assert {(one.stream, one.sensor) for one in found} == {("fused-yard/robot/fused", stream)}, number
        assert [one.seq for one in found] == list(range(first, first + 20))


def test_what_is_published_is_what_the_client_library_publishes(
    service: ServiceProcess, stub: Any, stream: str
) -> None:
    """Detections and a cloud in the sensor frame are on Zenoh, byte for byte, as `Publisher` would have sent them."""
    car: dict[str, Any] = {"label": ["car"], "center": [[1, 2, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.5]}
    pose = ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0])
    cloud = np.linspace(0, 50, 30_000, dtype="f4").reshape(-1, 3)
    with Heard(service.endpoint, KEYS.detections(stream), KEYS.points(stream)) as heard:
        with Publisher(stream, service.endpoint) as publisher:
            publisher.publish(
                stamp_ns=10**18, **car, score=[0.9], velocity=[[1, 0]], pose=pose, points=cloud, has_points=True
            )
            native = (*heard.take(1), *heard.take(1, at=1))
        requests = [
            points(decode(native[1], Points)),
            detections(decode(native[0], Detections)),
        ]
        list(stub.Track(iter(requests)))
        assert (*heard.take(1), *heard.take(1, at=1)) == native


def test_tracks_with_clouds_are_those_without_gateway(service: ServiceProcess, stub: Any, stream: str) -> None:
    """Frames that announce a cloud are tracked with it."""
    del service
    box = np.array([[0.0, 0.0, 0.8], [0.5, 0.2, 0.9]], dtype="f4")
    stub.SetParameters(pb.SetParametersRequest(stream=stream, parameters=pb.SessionParameters(cloud_wait_s=5.0)))

    def requests() -> Iterator[pb.TrackRequest]:
        for seq in range(10):
            one = frame(seq, stream, has_points=True)
            cloud = Points(
                stream=stream, epoch=one.epoch, seq=seq, stamp_ns=one.stamp_ns, frame="world", xyz=box + np.float32(seq)
            )
            yield points(cloud)
            yield detections(one)

    responses = list(stub.Track(requests()))
    assert [one.tracks.cloud_used for one in responses] == [True] * 10


def test_a_refused_frame_is_a_problem_and_the_stream_goes_on(stub: Any, stream: str) -> None:
    """A value that is not allowed is answered by a problem with its path; the frames around it are tracked."""
    bad = detections(frame(1, stream))
    bad.detections.score.data = np.array([0.5, 1.5]).tobytes()
    requests = [detections(frame(0, stream)), bad, detections(frame(2, stream))]
    responses = list(stub.Track(iter(requests)))
    problems = [one.problem for one in responses if one.WhichOneof("response") == "problem"]
    assert {one.tracks.seq for one in responses if one.WhichOneof("response") == "tracks"} == {0, 2}
    assert [(problem.code, problem.path, problem.seq) for problem in problems] == [("invalid_value", "score[1]", 1)]
    assert problems[0].expected == "a number in [0, 1]"


def test_a_caller_that_comes_back_gets_what_was_tracked(stub: Any, stream: str) -> None:
    """Frames that are sent again by a caller that lost its call are answered, and not tracked twice."""
    epoch = secrets.token_bytes(16)
    first = list(stub.Track(detections(frame(seq, stream, epoch)) for seq in range(20)))
    again = list(stub.Track(detections(frame(seq, stream, epoch)) for seq in range(10, 30)))
    assert [one.tracks.seq for one in again] == list(range(10, 30))
    assert [one.SerializeToString() for one in again[:10]] == [one.SerializeToString() for one in first[10:]]
    assert stub.GetState(pb.GetStateRequest(stream=stream)).state.frames == 30


def test_a_heartbeat_brings_nothing_again(service: ServiceProcess, stub: Any, stream: str) -> None:
    """What recovery sends a call, as to every late subscriber, is left out: the call gets its own frames' tracks."""
    list(stub.Track(detections(frame(seq, stream)) for seq in range(20)))
    answered = threading.Event()

    def requests() -> Iterator[pb.TrackRequest]:
        yield detections(frame(20, stream))
        assert answered.wait(60)  # a subscriber that gets frame 20 itself is not sent those before it
        with open_client(service.endpoint) as late:
            recovered = zenoh.ext.declare_advanced_subscriber(
                late,
                KEYS.tracks(stream),
                zenoh.handlers.FifoChannel(64),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
            for _ in range(20):  # a heartbeat has come
                until(lambda: recovered.try_recv() is not None, "what a heartbeat brings")
        yield detections(frame(21, stream))

    call = stub.Track(requests())
    first = next(call).tracks.seq
    answered.set()
    assert [first, *(one.tracks.seq for one in call)] == [20, 21]


@pytest.mark.parametrize(
    ("second", "path"),
    [
        (lambda: detections(frame(1, "another/robot/lidar")), "detections.stream"),
        (pb.TrackRequest, "request"),
    ],
)
def test_what_is_no_message_of_the_call_ends_it(stub: Any, stream: str, second: Any, path: str) -> None:
    """Another stream, or nothing at all, is INVALID_ARGUMENT with the path of the field."""
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.Track(iter([detections(frame(0, stream)), second()])))
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert violation(raised).field == path


def test_bytes_that_are_no_protobuf(gateway: Any) -> None:
    """They end the call as INVALID_ARGUMENT, malformed."""
    call = gateway.channel().stream_stream("/optipmb.v1.TrackingService/Track")
    with pytest.raises(grpc.RpcError) as raised:
        list(call(iter([b"\xff\xff\xff\xff"])))
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert violation(raised).reason == "MALFORMED"


def test_a_call_without_a_message_ends(stub: Any) -> None:
    """Nothing in, nothing out, no error."""
    assert list(stub.Track(iter([]))) == []


def test_acknowledgements_are_few(stub: Any, stream: str) -> None:
    """One comes when the stream is open; the next ones, which nothing but time brings, cover many messages each."""
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    for seq in range(40):
        requests.put(detections(frame(seq, stream), pb.PublishRequest))
    call = stub.Publish(iter(requests.get, None), timeout=DEADLINE_S)
    numbers = [-1]
    while numbers[-1] < 39:  # the call stays open
        newest = next(call).acknowledgement
        numbers.append(newest.detections if newest.HasField("detections") else -1)
    assert numbers == sorted(numbers)
    assert len(numbers) < 20
    requests.put(None)
    assert {one.acknowledgement.detections for one in call} <= {39}


def test_a_clock_that_stands_still_is_told_to_the_caller(stub: Any, stream: str) -> None:
    """Frames with one stamp are tracked, and the call that sent them gets the problem `clock`."""
    sent = [frame(seq, stream).model_copy(update={"stamp_ns": 10**18}) for seq in range(25)]
    answered, responses = threading.Event(), []

    def requests() -> Iterator[Any]:
        yield from map(detections, sent)
        answered.wait(DEADLINE_S)  # a call that is closed ends after a second without tracks

    for one in stub.Track(requests()):
        responses.append(one)
        if len(responses) > len(sent):
            answered.set()
    problems = [one.problem for one in responses if one.WhichOneof("response") == "problem"]
    assert [one.code for one in problems] == ["clock"]
    assert problems[0].received == f"20 frames with the stamp {10**18}: the clock does not advance"
    assert sum(one.WhichOneof("response") == "tracks" for one in responses) == 25

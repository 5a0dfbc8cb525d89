"""What a gateway stands: broken, huge and idle callers, while the others are served."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from gateway import EPOCH, GatewayProcess, connected, detections, frame, points, resident
from optipmb_schemas import Points
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_service.edges.grpc.calls import varint
from service_process import ServiceProcess

CONNECTIONS = 2_000
"""Idle connections of the test; each end of one takes a file."""

CONNECTION_BYTES = 64 * 2**10
"""Memory that the gateway may take for each of them; it is about 17 KB."""

ALLOWED = 4
"""Connections of the gateway that allows few."""


@pytest.fixture(scope="module")
def bounded(service: ServiceProcess) -> Iterator[GatewayProcess]:
    environment = {"OPTIPMB_GRPC_CALLS": "2", "OPTIPMB_GRPC_CONNECTIONS": str(ALLOWED)}
    with GatewayProcess(service.endpoint, environment=environment) as process:
        process.wait_ready()
        yield process


def files(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def served(gateway: GatewayProcess, stream: str) -> None:
    responses = list(gateway.stub().Track((detections(frame(seq, stream)) for seq in range(5)), timeout=30))
    assert [one.tracks.seq for one in responses] == list(range(5))


def test_a_message_of_100_mb_is_refused(gateway: GatewayProcess, stream: str) -> None:
    """It is RESOURCE_EXHAUSTED before memory is taken for it, and others are served."""
    options = [("grpc.max_send_message_length", -1)]
    stub = gateway.stub(options)
    before = resident(gateway.process.pid)
    huge = pb.TrackRequest(points=pb.Points(stream=stream, xyz=pb.Array(data=bytes(100 * 2**20))))
    with pytest.raises(grpc.RpcError) as raised:
        list(stub.Track(iter([huge])))
    assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert resident(gateway.process.pid) - before < 50 * 2**20
    served(gateway, stream)


def test_many_small_lists_take_little_memory(gateway: GatewayProcess, stream: str) -> None:
    """Labels, shapes and numbers by the million are refused, and the memory comes back."""
    stub = gateway.stub()
    served(gateway, stream)
    before = resident(gateway.process.pid)
    message = pb.TrackRequest(detections=pb.Detections(stream=stream, labels=[""] * 2_000_000))
    shape = pb.Array(dtype=pb.DATA_TYPE_F8, shape=[1] * 2_000_000)
    # Of another stream: the problem of the first call comes back from the network, and may come late.
    other = pb.TrackRequest(detections=pb.Detections(stream=f"{stream}-2", center=shape))
    for request in (message, other):
        problems = list(stub.Track(iter([request])))
        assert [one.WhichOneof("response") for one in problems] == ["problem"]
    assert resident(gateway.process.pid) - before < 300 * 2**20


def test_fields_that_nobody_knows_leave_no_memory_behind(gateway: GatewayProcess, stream: str) -> None:
    """Forty calls at once with 30 MB of unknown fields are refused, and their memory is given back."""
    size = 30 * 2**20
    payload = b"\xa2\x06" + varint(size) + bytes(size)
    channel = gateway.channel([("grpc.max_send_message_length", -1)])
    track = channel.stream_stream(f"/{pb.DESCRIPTOR.services_by_name['TrackingService'].full_name}/Track")
    served(gateway, stream)
    before = resident(gateway.process.pid)

    def refusal(_number: int) -> grpc.StatusCode:
        with pytest.raises(grpc.RpcError) as raised:
            list(track(iter([payload])))
        code: grpc.StatusCode = raised.value.code()
        return code

    with ThreadPoolExecutor(40) as pool:
        assert set(pool.map(refusal, range(40))) == {grpc.StatusCode.INVALID_ARGUMENT}
    ends = time.monotonic() + 60
    while resident(gateway.process.pid) - before > 250 * 2**20:
        assert time.monotonic() < ends, f"{(resident(gateway.process.pid) - before) >> 20} MB are left"
        time.sleep(0.1)
    channel.close()
    served(gateway, stream)


def test_a_call_that_ends_badly_after_a_problem_ends(gateway: GatewayProcess, stream: str) -> None:
    """A valid frame, an invalid one and one of another stream, sent at once: the problem comes, then the status."""
    invalid = detections(frame(1, stream))
    invalid.detections.yaw.data = np.full(2, np.nan).tobytes()
    requests = [detections(frame(0, stream)), invalid, detections(frame(2, f"{stream}-2"))]
    call = gateway.stub().Track(iter(requests), timeout=30)
    with pytest.raises(grpc.RpcError) as raised:
        list(call)
    assert raised.value.code() == grpc.StatusCode.INVALID_ARGUMENT


def test_deadlines_are_no_faults_of_the_gateway(gateway: GatewayProcess, stream: str) -> None:
    """Calls that pass their deadline at any moment leave no line about an internal error."""
    stub = gateway.stub()
    served(gateway, stream)
    for number in range(60):
        with contextlib.suppress(grpc.RpcError):
            stub.GetState(pb.GetStateRequest(stream=stream), timeout=0.001 * number)
        with contextlib.suppress(grpc.RpcError):
            list(
                stub.Track((detections(frame(seq, f"{stream}-{number}")) for seq in range(20)), timeout=0.002 * number)
            )
        with contextlib.suppress(grpc.RpcError):
            list(stub.Subscribe(pb.SubscribeRequest(pattern=stream), timeout=0.002 * number))
    served(gateway, f"{stream}-last")
    assert "internal_error" not in gateway.errors
    assert "Traceback" not in gateway.errors


def test_a_refused_cloud_is_told_to_all(gateway: GatewayProcess, stream: str) -> None:
    """A cloud that the gateway refuses is a problem for the caller, once, and for everybody who looks at the stream."""
    stub = gateway.stub()
    watching = stub.Subscribe(pb.SubscribeRequest(pattern=stream, problems=True), timeout=60)
    watching.initial_metadata()
    cloud = points(
        Points(stream=stream, epoch=EPOCH, seq=0, stamp_ns=0, frame="world", xyz=np.zeros((5, 3), np.float32)),
        pb.PublishRequest,
    )
    cloud.points.xyz.data = b"123"
    seen = threading.Event()

    def requests() -> Iterator[pb.PublishRequest]:
        yield cloud
        seen.wait(60)

    call = stub.Publish(requests())
    problem = next(watching).problem
    assert (problem.code, problem.path) == ("invalid_value", "xyz.data")
    seen.set()
    assert [one.problem.path for one in call if one.HasField("problem")] == ["xyz.data"]
    watching.cancel()


def test_idle_connections(gateway: GatewayProcess, stream: str) -> None:
    """Thousands of connections without calls hinder no client and take little; their files come back."""
    pid = gateway.process.pid
    served(gateway, stream)
    before, memory = files(pid), resident(pid)
    idle: list[socket.socket] = []
    try:
        idle.extend(connected(gateway) for _ in range(CONNECTIONS))
        for one in idle:
            assert one.recv(1), "a connection was closed"
        served(gateway, stream)
        assert resident(pid) - memory < CONNECTIONS * CONNECTION_BYTES
    finally:
        for one in idle:
            one.close()
    ends = time.monotonic() + 60
    while files(pid) > before + 20:
        assert time.monotonic() < ends, f"{files(pid) - before} files are left"
        time.sleep(0.1)
    served(gateway, stream)


def test_slow_requests_hold_nobody(gateway: GatewayProcess, stream: str) -> None:
    """Calls that begin and never send their message are no obstacle; they end with their callers."""
    release = threading.Event()

    def nothing() -> Iterator[Any]:
        release.wait(60)
        yield from ()

    stub = gateway.stub()
    slow = [stub.Track(nothing()) for _ in range(100)]
    served(gateway, stream)
    release.set()
    assert [list(call) for call in slow] == [[]] * 100


def test_garbage_is_no_http(gateway: GatewayProcess, stream: str) -> None:
    """Bytes that are no HTTP/2, and a connection cut in the middle of a frame, leave nothing behind."""
    host, _, port = gateway.address.rpartition(":")
    for garbage in (b"\x00" * 1000, b"GET / HTTP/1.1\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\x00\xff\xff"):
        with socket.create_connection((host, int(port)), timeout=10) as one:
            one.sendall(garbage)
    served(gateway, stream)


def test_more_calls_than_allowed(bounded: GatewayProcess, stream: str) -> None:
    """The call beyond the bound is RESOURCE_EXHAUSTED at once; when one ends there is room again."""
    stub = bounded.stub()
    calls = [stub.Subscribe(pb.SubscribeRequest(pattern=stream)) for _ in range(2)]
    for call in calls:
        call.initial_metadata()
    with pytest.raises(grpc.RpcError) as raised:
        stub.GetState(pb.GetStateRequest(stream=stream))
    assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    for call in calls:
        call.cancel()
    wait_served(stub, stream)


def test_more_connections_than_allowed(bounded: GatewayProcess, stream: str) -> None:
    """The connection beyond the bound is closed and its call UNAVAILABLE; when one ends there is room again."""
    idle: list[socket.socket] = []
    try:
        while len(idle) < 2 * ALLOWED:
            idle.append(connected(bounded))
            if not idle[-1].recv(1):
                break
        assert len(idle) <= ALLOWED + 1
        stub = bounded.stub([("grpc.use_local_subchannel_pool", 1)])
        with pytest.raises(grpc.RpcError) as raised:
            stub.GetState(pb.GetStateRequest(stream=stream), timeout=30)
        assert raised.value.code() == grpc.StatusCode.UNAVAILABLE
    finally:
        for one in idle:
            one.close()
    wait_served(stub, stream)


def wait_served(stub: Any, stream: str) -> None:
    ends = time.monotonic() + 60
    while True:
        try:
            stub.GetState(pb.GetStateRequest(stream=stream), timeout=30)
        except grpc.RpcError:
            assert time.monotonic() < ends
            time.sleep(0.1)
        else:
            return


def test_the_end_of_a_gateway_finishes_what_is_under_way(service: ServiceProcess, stream: str) -> None:
    """On SIGTERM frames that were sent get their tracks, calls end as UNAVAILABLE, the process ends with status 0."""
    with GatewayProcess(service.endpoint) as gateway:
        gateway.wait_ready()
        stub, release = gateway.stub(), threading.Event()

        def requests() -> Iterator[pb.TrackRequest]:
            yield from (detections(frame(seq, stream)) for seq in range(20))
            release.wait(30)

        call = stub.Track(requests())
        received = [next(call).tracks.seq for _ in range(20)]
        watching = stub.Subscribe(pb.SubscribeRequest(pattern=stream))
        watching.initial_metadata()
        status, _ = gateway.end()
        for one in (call, watching):
            with pytest.raises(grpc.RpcError) as raised:
                list(one)
            assert raised.value.code() == grpc.StatusCode.UNAVAILABLE
        release.set()
        assert (received, status) == (list(range(20)), 0)


def test_tracks_that_a_caller_does_not_take_end_its_call_alone(gateway: GatewayProcess, stream: str) -> None:
    """A caller with a limit below one frame hears so; the next call and other callers get the frames after it."""
    limited = gateway.stub([("grpc.max_receive_message_length", 4000)])
    calls = [one.Subscribe(pb.SubscribeRequest(pattern=stream)) for one in (limited, gateway.stub())]
    for call in calls:
        call.initial_metadata()
    crowd = {name: np.repeat(getattr(frame(0), name)[:1], 20, axis=0) for name in ("label", "size", "yaw", "score")}
    crowd["center"] = np.arange(20)[:, None] * [20.0, 0.0, 0.0] + [0.0, 50.0, 0.8]
    frames = [frame(seq, stream, **(crowd if 3 <= seq < 6 else {})) for seq in range(12)]
    tracked = [one.tracks for one in gateway.stub().Track(map(detections, frames))]
    large = next(one.seq for one in tracked if one.ByteSize() > 4000)
    with pytest.raises(grpc.RpcError) as raised:
        list(calls[0])
    assert raised.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert [next(calls[1]).tracks.seq for _ in tracked] == [one.seq for one in tracked]
    again = limited.Subscribe(pb.SubscribeRequest(pattern=stream))
    again.initial_metadata()
    list(gateway.stub().Track(detections(frame(seq, stream)) for seq in range(40, 60)))
    assert next(one.tracks.seq for one in again) > large

"""gRPC served by a service of several worker processes: its parent is the gateway of them all."""

import grpc
import pytest
from gateway import channel_to, detections, frame
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from router import Node
from routers import free_endpoint
from service_process import ServiceProcess

STREAMS = tuple(f"garage/robot-{number}/lidar" for number in range(4))


def test_streams_of_all_workers() -> None:
    """Streams of both workers are tracked, listed with their worker, asked about, reset and queried at one address.

    On SIGTERM a subscription ends as UNAVAILABLE, and the service with status 0.
    """
    address = f"127.0.0.1:{free_endpoint().rpartition(':')[2]}"
    with ServiceProcess("--workers", "2", "--grpc", address, "--instance", "garage") as process:
        process.wait_ready()
        stub = rpc.TrackingServiceStub(channel_to(address))
        serves_all(stub, process.endpoint)
        call = stub.Subscribe(pb.SubscribeRequest(pattern="*/*/*"))
        call.initial_metadata()
        status, _ = process.end()
        with pytest.raises(grpc.RpcError) as raised:
            list(call)
        assert raised.value.code() == grpc.StatusCode.UNAVAILABLE
        assert status == 0, process.errors


def serves_all(stub: rpc.TrackingServiceStub, endpoint: str) -> None:
    with Node(endpoint) as node:
        for number, stream in enumerate(STREAMS):
            node.move("garage", stream, number % 2)
    for stream in STREAMS:
        responses = list(stub.Track((detections(frame(seq, stream)) for seq in range(10)), timeout=60))
        assert [one.tracks.seq for one in responses] == list(range(10))
        assert stub.GetState(pb.GetStateRequest(stream=stream)).state.frames == 10
        kept = [one.tracks.seq for one in stub.QueryTracks(pb.QueryTracksRequest(pattern=stream))]
        assert kept == list(range(10))
    listed = stub.ListStreams(pb.ListStreamsRequest()).streams
    assert [one.session.stream for one in listed] == list(STREAMS)
    assert [one.session.worker for one in listed] == [0, 1, 0, 1]
    assert {one.instance for one in listed} == {listed[0].instance}
    before = stub.GetState(pb.GetStateRequest(stream=STREAMS[0])).state.session
    assert stub.Reset(pb.ResetRequest(stream=STREAMS[0])).state.session not in {"", before}

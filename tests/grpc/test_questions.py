"""`GetState`, `Reset`, `SetParameters`, `ListStreams`, health and reflection."""

from typing import Any

import grpc
import pytest
from gateway import GatewayProcess, detections, frame
from google.protobuf import descriptor_pool
from google.protobuf.message_factory import GetMessageClass
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from optipmb_client import ClientError
from optipmb_client.grpc import GrpcConnection
from optipmb_schemas import Keys
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from routers import free_endpoint, open_router

SERVICE = "optipmb.v1.TrackingService"


def test_a_session_is_set_up_asked_reset_and_ended(stub: Any, stream: str) -> None:
    """Parameters start a session, tracking shows in its state and in the list, a reset empties it, closing ends it."""
    wanted = pb.SessionParameters(profile="kitti", cloud_wait_s=0.5)
    in_force = stub.SetParameters(pb.SetParametersRequest(stream=stream, parameters=wanted)).parameters
    assert (in_force.profile, in_force.cloud_wait_s) == ("kitti", 0.5)
    assert "classes" in in_force.values
    *_, last = stub.Track(detections(frame(seq, stream, labels=("Car", "Pedestrian"))) for seq in range(10))
    state = stub.GetState(pb.GetStateRequest(stream=stream)).state
    assert (state.state, state.frames, state.profile) == ("running", 10, "kitti")
    assert (state.tracks, len(convert.column(last.tracks.id))) == (sum(convert.column(last.tracks.confirmed)), 2)
    (listed,) = stub.ListStreams(pb.ListStreamsRequest(pattern=stream)).streams
    assert (listed.session.stream, listed.session.frames) == (stream, 10)
    assert stream in {one.session.stream for one in stub.ListStreams(pb.ListStreamsRequest()).streams}
    reset = stub.Reset(pb.ResetRequest(stream=stream)).state
    assert (reset.tracks, reset.bernoullis, reset.session == state.session) == (0, 0, False)
    assert stub.Reset(pb.ResetRequest(stream=stream, close=True)).state.state == "closed"


def test_a_stream_without_a_session_is_new(stub: Any, stream: str) -> None:
    """Asking starts nothing."""
    assert stub.GetState(pb.GetStateRequest(stream=stream)).state.state == "new"
    assert len(stub.ListStreams(pb.ListStreamsRequest(pattern=stream)).streams) == 0


@pytest.mark.parametrize(
    ("method", "request_", "code"),
    [
        ("GetState", pb.GetStateRequest(stream="a/b"), "INVALID_ARGUMENT"),
        ("GetState", pb.GetStateRequest(), "INVALID_ARGUMENT"),
        ("Reset", pb.ResetRequest(stream="service/b/c"), "INVALID_ARGUMENT"),
        ("ListStreams", pb.ListStreamsRequest(pattern="a/b/c/d"), "INVALID_ARGUMENT"),
        (
            "SetParameters",
            pb.SetParametersRequest(stream="a/b/c", parameters=pb.SessionParameters(profile="nobody")),
            "INVALID_ARGUMENT",
        ),
        (
            "SetParameters",
            pb.SetParametersRequest(stream="a/b/c", parameters=pb.SessionParameters(cloud_wait_s=-1)),
            "INVALID_ARGUMENT",
        ),
    ],
)
def test_wrong_questions_have_clear_answers(stub: Any, method: str, request_: Any, code: str) -> None:
    """A status code, and a line with the expected and the received value."""
    with pytest.raises(grpc.RpcError) as raised:
        getattr(stub, method)(request_)
    assert raised.value.code().name == code
    assert "expected" in raised.value.details()
    assert "received" in raised.value.details()


def test_without_a_service_the_answer_is_unavailable() -> None:
    """A gateway of a network without a tracking service says so."""
    from gateway import GatewayProcess  # noqa: PLC0415 - this test's own

    endpoint = free_endpoint()
    with open_router(endpoint), GatewayProcess(endpoint) as gateway:
        gateway.wait_ready()
        stub = gateway.stub()
        with pytest.raises(grpc.RpcError) as raised:
            stub.GetState(pb.GetStateRequest(stream="a/b/c"))
        assert raised.value.code() == grpc.StatusCode.UNAVAILABLE
        assert "no tracking service" in raised.value.details()
        assert len(stub.ListStreams(pb.ListStreamsRequest()).streams) == 0


def test_what_the_gateway_lacks_is_an_error(gateway: GatewayProcess) -> None:
    """Tracks of the past come over Zenoh alone."""
    with GrpcConnection([gateway.address]) as connection, pytest.raises(ClientError, match="connect to Zenoh"):
        connection.query(Keys().query("a/b/c", "tracks"))


def test_a_health_probe(gateway: GatewayProcess) -> None:
    """The standard health service says SERVING for the process and for the service, and NOT_FOUND for others."""
    health = health_pb2_grpc.HealthStub(gateway.channel())
    for name in ("", SERVICE):
        assert (
            health.Check(health_pb2.HealthCheckRequest(service=name)).status == health_pb2.HealthCheckResponse.SERVING
        )
    with pytest.raises(grpc.RpcError) as raised:
        health.Check(health_pb2.HealthCheckRequest(service="other"))
    assert raised.value.code() == grpc.StatusCode.NOT_FOUND


def test_a_client_that_has_no_schema(gateway: GatewayProcess, stub: Any, stream: str) -> None:
    """By reflection alone, as grpcurl does, a client finds the service, its methods and messages, and calls one."""
    list(stub.Track(detections(frame(seq, stream)) for seq in range(5)))
    channel = gateway.channel()
    database = ProtoReflectionDescriptorDatabase(channel)
    assert SERVICE in database.get_services()
    pool = descriptor_pool.DescriptorPool(database)
    service = pool.FindServiceByName(SERVICE)
    assert {method.name for method in service.methods} == {
        "Track", "Publish", "Subscribe", "SubscribeEvents", "QueryTracks", "GetState", "Reset", "SetParameters",
        "ListStreams", "GetLinks",
    }  # fmt: skip
    method = service.FindMethodByName("GetState")
    asked = GetMessageClass(method.input_type)(stream=stream)
    call = channel.unary_unary(
        f"/{SERVICE}/GetState",
        request_serializer=lambda message: message.SerializeToString(),
        response_deserializer=GetMessageClass(method.output_type).FromString,
    )
    assert call(asked).state.frames == 5

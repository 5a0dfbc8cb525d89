"""Who may do what over gRPC: by the name in the certificate, on a protected network with real processes."""

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from gateway import GatewayProcess, detections, frame
from optipmb_client import Publisher, Subscriber
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from protected import Network, make

ROBOT, OTHER = "garage/robot-1", "garage/robot-2"
LIDAR, FOREIGN = f"{ROBOT}/lidar", f"{OTHER}/lidar"
NODE, VIEWER, SERVICE = f"node/{ROBOT}", "viewer/ops", "service/tracker"
EVERYBODY = ("--node", ROBOT, "--node", OTHER, "--service", "tracker", "--viewer", "ops", "--gateway", "localhost")

TOKENS = """
def caller(metadata, certificate):
    return {"Bearer robot": "garage/robot-1", "Bearer ops": "viewer/ops"}.get(metadata.get("authorization"))
"""


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with Network(tmp_path_factory.mktemp("tls"), *EVERYBODY) as one, one.service() as service:
        service.wait_ready()
        yield one


@pytest.fixture(scope="module")
def secured(network: Network) -> Iterator[GatewayProcess]:
    folder = network.folder / "gateway" / "localhost"
    options = ("--zenoh-config", str(folder / "zenoh.json5"), "--grpc-tls", str(folder))
    fused = {name: {"streams": [f"garage/{name}/*"], "read": [ROBOT] * (name == "let")} for name in ("let", "other")}
    names = {"OPTIPMB_GRPC_NAMES": str(folder / "names.json"), "OPTIPMB_FUSED": json.dumps(fused)}
    with GatewayProcess(network.endpoint, *options, environment=names) as process:
        process.wait_ready()
        yield process


def channel(folder: Path, gateway: GatewayProcess) -> grpc.Channel:
    authority, key, certificate = ((folder / name).read_bytes() for name in ("ca.pem", "key.pem", "cert.pem"))
    port = gateway.address.rpartition(":")[2]
    return grpc.secure_channel(f"localhost:{port}", grpc.ssl_channel_credentials(authority, key, certificate))


def stub(network: Network, role: str, gateway: GatewayProcess) -> Any:
    return rpc.TrackingServiceStub(channel(network.folder / role, gateway))


def denied(call: Any) -> grpc.StatusCode:
    with pytest.raises(grpc.RpcError) as raised:
        list(call) if hasattr(call, "__iter__") else call()
    code: grpc.StatusCode = raised.value.code()
    return code


def test_a_node_tracks_its_own_streams_alone(network: Network, secured: GatewayProcess) -> None:
    """It gets tracks of its own detections; another node's it may neither publish, nor read, nor reset.

    It may read sessions of its site that name it.
    """
    own = stub(network, NODE, secured)
    responses = list(own.Track(detections(frame(seq, LIDAR)) for seq in range(10)))
    assert [one.tracks.seq for one in responses] == list(range(10))
    no = grpc.StatusCode.PERMISSION_DENIED
    assert denied(own.Track(iter([detections(frame(0, FOREIGN))]))) == no
    assert denied(own.Publish(iter([pb.PublishRequest(options=pb.PublishOptions(stream=FOREIGN))]))) == no
    assert denied(own.Subscribe(pb.SubscribeRequest(pattern="garage/*/lidar"))) == no
    assert denied(own.SubscribeEvents(pb.SubscribeEventsRequest(pattern=FOREIGN))) == no
    assert denied(own.QueryTracks(pb.QueryTracksRequest(pattern=FOREIGN))) == no
    assert denied(lambda: own.Reset(pb.ResetRequest(stream=FOREIGN))) == no
    streams = {one.session.stream for one in own.ListStreams(pb.ListStreamsRequest()).streams}
    assert LIDAR in streams
    assert all(one.startswith(f"{ROBOT}/") for one in streams)
    assert own.GetState(pb.GetStateRequest(stream=LIDAR)).state.frames == 10
    assert list(own.QueryTracks(pb.QueryTracksRequest(pattern="garage/fused/let"))) == []
    assert denied(own.QueryTracks(pb.QueryTracksRequest(pattern="garage/fused/other"))) == no
    assert denied(lambda: own.Reset(pb.ResetRequest(stream="garage/fused/let"))) == no


def test_a_viewer_reads_everything_and_changes_nothing(network: Network, secured: GatewayProcess) -> None:
    """Tracks and states of all streams, but no detections of its own, no reset and no parameters."""
    viewer = stub(network, VIEWER, secured)
    assert viewer.GetState(pb.GetStateRequest(stream=FOREIGN)).state.state == "new"
    assert list(viewer.QueryTracks(pb.QueryTracksRequest(pattern="*/*/*"))) is not None
    no = grpc.StatusCode.PERMISSION_DENIED
    assert denied(viewer.Track(iter([detections(frame(0, LIDAR))]))) == no
    assert denied(lambda: viewer.Reset(pb.ResetRequest(stream=LIDAR))) == no
    assert denied(lambda: viewer.SetParameters(pb.SetParametersRequest(stream=LIDAR))) == no


def test_a_name_that_is_not_listed_is_not_let_in(network: Network, secured: GatewayProcess, tmp_path: Path) -> None:
    """A certificate of the authority with an unlisted name may do nothing, as on Zenoh."""
    del tmp_path
    network.make("--node", "garage/stranger")
    stranger = stub(network, "node/garage/stranger", secured)
    assert denied(stranger.Track(iter([detections(frame(0, "garage/stranger/lidar"))]))) == (
        grpc.StatusCode.PERMISSION_DENIED
    )


def test_without_a_certificate_of_the_authority_there_is_no_connection(
    network: Network, secured: GatewayProcess, tmp_path: Path
) -> None:
    """Plain text, and a certificate of another authority, get no answer."""
    plain = rpc.TrackingServiceStub(secured.channel())
    assert denied(lambda: plain.GetState(pb.GetStateRequest(stream=LIDAR), timeout=60)) == grpc.StatusCode.UNAVAILABLE
    assert make(tmp_path, *network.options).returncode == 0
    shutil.copy(network.folder / NODE / "ca.pem", tmp_path / NODE / "ca.pem")
    foreign = rpc.TrackingServiceStub(channel(tmp_path / NODE, secured))
    assert denied(lambda: foreign.GetState(pb.GetStateRequest(stream=LIDAR), timeout=60)) == grpc.StatusCode.UNAVAILABLE


def test_the_client_library_with_certificates(network: Network, secured: GatewayProcess) -> None:
    """Publisher and Subscriber take the folder of the certificates as their configuration."""
    address = f"grpc://localhost:{secured.address.rpartition(':')[2]}"
    car: dict[str, Any] = {"center": [[1, 2, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.5], "score": [0.9]}
    stream = f"{ROBOT}/camera"
    with (
        Subscriber(stream, address, config=network.folder / VIEWER, timeout=60.0) as tracks,
        Publisher(stream, address, config=network.config(NODE), frame="world") as publisher,
    ):
        for k in range(5):
            publisher.publish(stamp_ns=10**18 + k * 10**8, label=["car"], **car)
        assert [message.seq for _, message in zip(range(5), tracks, strict=False)] == list(range(5))


def test_tokens_of_ones_own(network: Network, tmp_path: Path) -> None:
    """A function of one's own turns metadata into a name, whose rights hold; without a token there is no entry."""
    del network
    (tmp_path / "own_tokens.py").write_text(TOKENS)
    from service_process import ServiceProcess  # noqa: PLC0415 - this test's own

    paths = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    environment = {"PYTHONPATH": paths, "OPTIPMB_GRPC_TOKENS": "own_tokens:caller"}
    with (
        ServiceProcess("router") as router,
        GatewayProcess(router.endpoint, environment=environment) as gateway,
    ):
        gateway.wait_ready()
        one = gateway.stub()
        asked = pb.QueryTracksRequest(pattern=FOREIGN)
        assert denied(one.QueryTracks(asked)) == grpc.StatusCode.UNAUTHENTICATED
        robot = (("authorization", "Bearer robot"),)
        assert denied(one.QueryTracks(asked, metadata=robot)) == grpc.StatusCode.PERMISSION_DENIED
        operator = (("authorization", "Bearer ops"),)
        assert list(one.QueryTracks(pb.QueryTracksRequest(pattern="*/*/*"), metadata=operator)) == []


def test_renewed_certificates_are_taken(network: Network, secured: GatewayProcess) -> None:
    """A gateway that runs shows its new certificate to who connects next."""
    folder = network.folder / "gateway" / "localhost"
    before = (folder / "cert.pem").read_bytes()
    time.sleep(0.01)  # the files' times tell them apart
    network.make("--renew")
    assert (folder / "cert.pem").read_bytes() != before
    responses = stub(network, VIEWER, secured).ListStreams(pb.ListStreamsRequest(), timeout=60)
    assert responses is not None

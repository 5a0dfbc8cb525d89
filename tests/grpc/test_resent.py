"""Frames that are sent again after a gateway has failed, and frames that are lost then, as a gateway sees them."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np
import pytest
from optipmb_client import Publisher, Subscriber
from optipmb_client.errors import ClientError, ServiceRefused
from optipmb_client.grpc import channels
from optipmb_client.grpc.channels import SERVICE
from optipmb_client.grpc.streams import GrpcSubscription
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from routers import free_endpoint
from tracks_message import tracks_message

FRAMES = 4
DEADLINE_S = 60.0
POSE = ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])


class Failing(rpc.TrackingServiceServicer):
    """A gateway whose first call fails when all has come."""

    def __init__(self) -> None:
        self.calls: list[list[tuple[str, int]]] = []
        self.complete = threading.Event()

    def Publish(self, requests: Iterator[Any], context: Any) -> Iterator[Any]:  # noqa: N802 - of gRPC
        next(requests)
        taken: list[tuple[str, int]] = []
        self.calls.append(taken)
        yield pb.PublishResponse(acknowledgement=pb.Acknowledgement(points_wanted=True))
        for request in requests:
            kind = request.WhichOneof("request")
            taken.append((kind, getattr(request, kind).seq))
            if len(taken) == 2 * FRAMES:
                if len(self.calls) == 1:
                    context.abort(grpc.StatusCode.UNAVAILABLE, "goes")
                self.complete.set()


@contextlib.contextmanager
def served(gateway: Any, add: Any = rpc.add_TrackingServiceServicer_to_server) -> Iterator[str]:
    address = free_endpoint().removeprefix("tcp/")
    server = grpc.server(ThreadPoolExecutor(4))
    add(gateway, server)
    server.add_insecure_port(address)
    server.start()
    try:
        yield f"grpc://{address}"
    finally:
        server.stop(None).wait(DEADLINE_S)


def add_generic(handlers: Any, server: grpc.Server) -> None:
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))


def test_what_was_kept_is_sent_again_in_its_order() -> None:
    """Clouds among detections, as they were published, when a call fails."""
    gateway = Failing()
    with served(gateway) as endpoint, Publisher("a/b/c", endpoint, frame="world", cache_clouds=FRAMES) as publisher:
        for k in range(FRAMES):
            publisher.publish_points(stamp_ns=k, points=np.zeros((1, 3)), pose=POSE)
            publisher.publish(stamp_ns=k, label=["car"], center=[[1, 2, 0]], score=[0.9], has_points=True)
        assert gateway.complete.wait(DEADLINE_S), gateway.calls
    assert gateway.calls == [[(kind, k) for k in range(FRAMES) for kind in ("points", "detections")]] * 2


class Losing(rpc.TrackingServiceServicer):
    """A gateway that skips frames, and fails; the next call has only the newest ones."""

    def __init__(self) -> None:
        self.calls = [[(0, 0), (1, 0), (5, 3)], [(9, 0), (10, 0)]]  # number of a frame, and skipped ones

    def Subscribe(self, _request: Any, context: Any) -> Iterator[Any]:  # noqa: N802 - of gRPC
        context.send_initial_metadata(())
        for seq, skipped in self.calls.pop(0) if self.calls else ():
            tracks = convert.to_proto(tracks_message("a/b/c", seq))
            yield pb.SubscribeResponse(tracks=tracks, skipped=skipped)
        context.abort(grpc.StatusCode.UNAVAILABLE, "goes")


def test_frames_that_are_lost_at_a_gateway_are_named() -> None:
    """Frames that it skipped for a slow reader, and frames between two calls that are kept no longer."""
    with served(Losing()) as endpoint, Subscriber("a/b/c", endpoint) as tracks:
        received = [tracks.receive(DEADLINE_S) for _ in range(5)]
        assert [one.tracks.seq for one in received if one] == [0, 1, 5, 9, 10]
        assert [(one.first, one.last) for one in tracks.missed] == [(2, 4), (6, 8)]
        assert (tracks.statistics.missed, tracks.statistics.dropped) == (2, 3)


@pytest.mark.parametrize("at_once", [True, False])
def test_responses_of_another_release_end_no_subscription_in_silence(*, at_once: bool) -> None:
    """A kind of response that is not known is left out; one that cannot be read is raised once, to who iterates."""
    received = threading.Event()
    if at_once:
        received.set()

    def subscribe(_request: bytes, _context: Any) -> Iterator[bytes]:
        yield bytes([15 << 3 | 2, 0])  # a field that there is not
        yield pb.SubscribeResponse(tracks=convert.to_proto(tracks_message("a/b/c", 1))).SerializeToString()
        received.wait(DEADLINE_S)
        yield bytes([1 << 3 | 2, 9])  # tracks that are cut

    handlers = {"Subscribe": grpc.unary_stream_rpc_method_handler(subscribe)}
    with served(handlers, add_generic) as endpoint, Subscriber("a/b/c", endpoint) as tracks:
        first = tracks.receive(DEADLINE_S)
        assert first is not None
        assert first.tracks.seq == 1
        received.set()
        with pytest.raises(ServiceRefused, match="cannot be read"):
            tracks.receive(DEADLINE_S)
        assert list(tracks) == []


def test_a_response_that_cannot_be_read_opens_a_subscription_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """However soon it comes, and however late the program looks: the error is raised where it iterates."""
    ended = threading.Event()
    fail = GrpcSubscription._fail

    def failed(self: GrpcSubscription, error: ClientError) -> None:
        fail(self, error)
        ended.set()

    class Late(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            return super().wait(timeout) and ended.wait(DEADLINE_S)

    monkeypatch.setattr(GrpcSubscription, "_fail", failed)
    names = {"Event": Late, "Lock": threading.Lock, "Thread": threading.Thread}
    monkeypatch.setattr(channels, "threading", SimpleNamespace(**names))
    handlers = {"Subscribe": grpc.unary_stream_rpc_method_handler(lambda *_: iter([bytes([1 << 3 | 2, 9])]))}
    with served(handlers, add_generic) as endpoint, Subscriber("a/b/c", endpoint) as tracks:
        with pytest.raises(ServiceRefused, match="cannot be read"):
            tracks.receive(DEADLINE_S)
        assert tracks.receive(DEADLINE_S) is None

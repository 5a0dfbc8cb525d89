"""What a publisher sends again to the next gateway, seen from a gateway."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
import numpy as np
from optipmb_client import Publisher
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from routers import free_endpoint

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


def test_what_was_kept_is_sent_again_in_its_order() -> None:
    """Clouds among detections, as they were published, when a call fails."""
    gateway, address = Failing(), free_endpoint().removeprefix("tcp/")
    server = grpc.server(ThreadPoolExecutor(4))
    rpc.add_TrackingServiceServicer_to_server(gateway, server)  # type: ignore[no-untyped-call]  # as it is generated
    server.add_insecure_port(address)
    server.start()
    try:
        with Publisher("a/b/c", f"grpc://{address}", frame="world", cache_clouds=FRAMES) as publisher:
            for k in range(FRAMES):
                publisher.publish_points(stamp_ns=k, points=np.zeros((1, 3)), pose=POSE)
                publisher.publish(stamp_ns=k, label=["car"], center=[[1, 2, 0]], score=[0.9], has_points=True)
            assert gateway.complete.wait(DEADLINE_S), gateway.calls
    finally:
        server.stop(None).wait(DEADLINE_S)
    assert gateway.calls == [[(kind, k) for k in range(FRAMES) for kind in ("points", "detections")]] * 2

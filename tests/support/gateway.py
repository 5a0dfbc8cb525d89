"""A real gateway in a process of its own, and what tests say to it with the generated stubs alone."""

import json
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from optipmb_schemas import Detections, Points
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from routers import free_endpoint
from service_process import ServiceProcess

EPOCH = bytes(range(16))
STREAM = "garage/robot-1/lidar"

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
"""How a client of HTTP/2 begins: with this the handshake is over, and the connection is idle."""


DEADLINES = json.dumps({"methodConfig": [{"name": [{}], "timeout": "60s"}]})
"""The deadline of every call, unless it has an earlier one."""


class GatewayProcess(ServiceProcess):
    """`optipmb-service grpc` on a free port, a client of a router.

    Args:
        router: its endpoint.
        options: further ones.
        environment: variables.
        fresh: whether it is a new interpreter.
    """

    def __init__(
        self, router: str, *options: str, environment: Mapping[str, str] | None = None, fresh: bool = False
    ) -> None:
        port = free_endpoint().rpartition(":")[2]
        self.address = f"127.0.0.1:{port}"
        super().__init__(
            *("grpc", "--connect", router, "--grpc", self.address, *options),
            environment=environment,
            listen=False,
            fresh=fresh,
        )

    def channel(self, options: Sequence[tuple[str, int]] = ()) -> grpc.Channel:
        return channel_to(self.address, options)

    def stub(self, options: Sequence[tuple[str, int]] = ()) -> Any:
        return rpc.TrackingServiceStub(self.channel(options))


def channel_to(address: str, options: Sequence[tuple[str, int]] = ()) -> grpc.Channel:
    """Return a channel whose calls all have a deadline."""
    return grpc.insecure_channel(address, options=[*options, ("grpc.service_config", DEADLINES)])


def connected(gateway: GatewayProcess) -> socket.socket:
    host, _, port = gateway.address.rpartition(":")
    one = socket.create_connection((host, int(port)), timeout=10)
    one.sendall(PREFACE)
    return one


def resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


def frame(seq: int, stream: str = STREAM, epoch: bytes = EPOCH, **changes: Any) -> Detections:
    """A car that drives along x at 10 m/s and a pedestrian who stands, seen ten times a second."""
    fields: dict[str, Any] = {
        "stream": stream,
        "epoch": epoch,
        "seq": seq,
        "stamp_ns": 10**18 + seq * 10**8,
        "frame": "world",
        "labels": ("car", "pedestrian"),
        "label": np.array([0, 1]),
        "center": np.array([[seq * 1.0, 0.0, 0.8], [5.0, 20.0, 0.9]]),
        "size": np.array([[4.5, 1.9, 1.6], [0.6, 0.7, 1.8]]),
        "yaw": np.zeros(2),
        "score": np.array([0.9, 0.8]),
    }
    return Detections(**fields | changes)


def detections(message: Detections, kind: Any = pb.TrackRequest) -> Any:
    return kind(detections=convert.to_proto(message))


def points(message: Points, kind: Any = pb.TrackRequest) -> Any:
    return kind(points=convert.to_proto(message))

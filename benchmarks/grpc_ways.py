"""The ways that `grpc_cost.py` compares, from a frame to its tracks, and what is sent over them."""

from __future__ import annotations

import queue
import time
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np
from optipmb_client import Publisher, Subscriber
from optipmb_schemas import Detections, Keys, Tracks, decode, encode, encoding_of
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.incoming import Arrival
    from optipmb_client.zenoh.session import Session

RATE_HZ = 10.0
EPOCH = bytes(range(16))
TRACK = "/optipmb.v1.TrackingService/Track"
BARE = "/Bare/Call"


class Way:
    """A way from a frame to its tracks.

    Attributes:
        name: of the way.
        stream: that is to be answered on Zenoh; empty: none.
        pid: the process in between, if there is one.
    """

    def __init__(self, name: str, stream: str = "", pid: int | None = None) -> None:
        self.name, self.stream, self.pid = name, stream, pid

    def send(self, frame: Detections) -> None:
        """Send a frame."""
        raise NotImplementedError

    def receive(self) -> int:
        """Wait for the next tracks; return when they came, as `time.monotonic_ns`."""
        raise NotImplementedError

    def close(self) -> None:
        """End it."""
        raise NotImplementedError


class Library(Way):
    """The client library, over Zenoh or a gateway."""

    def __init__(self, name: str, where: str, pid: int | None = None) -> None:
        super().__init__(name, f"cost/{name}/lidar", pid)
        self._publisher = Publisher(self.stream, where, frame="world")
        self._subscriber = Subscriber(self.stream, where)

    def send(self, frame: Detections) -> None:
        """Send a frame."""
        columns = {name: getattr(frame, name) for name in ("label", "center", "size", "yaw", "score")}
        self._publisher.publish(stamp_ns=frame.stamp_ns, labels=frame.labels, **columns)

    def receive(self) -> int:
        """Wait for the next tracks; return when they came, as `time.monotonic_ns`."""
        tracks = self._subscriber.receive(10.0)
        if tracks is None:
            raise SystemExit(f"no tracks over {self.name}")
        return tracks.monotonic_ns

    def close(self) -> None:
        """End it."""
        self._publisher.close()
        self._subscriber.close()


class Raw(Way):
    """A call of bytes."""

    def __init__(self, name: str, pid: int, address: str, method: str, packed: Callable[[Detections], bytes]) -> None:
        super().__init__(name, "" if name == "echo" else f"cost/{name}/lidar", pid)
        self._channel = grpc.insecure_channel(address, options=[("grpc.max_receive_message_length", -1)])
        self._method = method
        self._packed = packed
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._call: Any = None

    def send(self, frame: Detections) -> None:
        """Send a frame."""
        self._requests.put(self._packed(frame))

    def receive(self) -> int:
        """Wait for the next tracks; return when they came, as `time.monotonic_ns`."""
        if self._call is None:  # a gateway waits for the first message of a call, but not for ever
            self._call = self._channel.stream_stream(self._method)(iter(self._requests.get, None))
        next(self._call)
        return time.monotonic_ns()

    def close(self) -> None:
        """End it."""
        self._requests.put(None)
        self._channel.close()


def boxes(objects: int, k: int) -> dict[str, Any]:
    """Objects on a grid, all driving along x at 10 m/s."""
    side = int(np.ceil(np.sqrt(objects)))
    place = 12.0 * np.stack([np.arange(objects) % side, np.arange(objects) // side], axis=1)
    center = np.column_stack([place[:, 0] + k / RATE_HZ * 10.0, place[:, 1], np.full(objects, 0.8)])
    size = np.tile([4.5, 1.9, 1.6], (objects, 1))
    shared = {"labels": ("car",), "label": np.zeros(objects, dtype=int), "yaw": np.zeros(objects)}
    return {**shared, "center": center, "size": size, "score": np.full(objects, 0.9)}


def frame_of(stream: str, k: int, objects: int) -> Detections:
    """Frame number k of a stream."""
    header = {"stream": stream, "epoch": EPOCH, "seq": k, "stamp_ns": 10**18 + k * 10**8, "frame": "world"}
    return Detections(**header, **boxes(objects, k))


def request_of(frame: Detections) -> bytes:
    """A frame as a request of `Track`."""
    packed: bytes = pb.TrackRequest(detections=convert.to_proto(frame)).SerializeToString()
    return packed


def answer_of(frame: Detections) -> bytes:
    """As many bytes as the tracks of a frame have."""
    return bytes(convert.to_proto(tracks_of(frame)).ByteSize())


def answering(session: Session, stream: str) -> Any:
    """Answer every frame of a stream with a track for each of its objects; nothing is lost on the way."""
    keys = Keys()
    publisher = session.cached_sender(keys.tracks(stream), encoding_of(Tracks), cache=200)

    def answer(message: Arrival) -> None:
        publisher.put(encode(tracks_of(decode(message.payload, Detections))))

    return publisher, session.subscribe(keys.detections(stream), answer)


def tracks_of(frame: Detections) -> Tracks:
    """A track for each object of a frame."""
    n = len(frame.label)
    zeros, ones = np.zeros(n), np.ones(n)
    header = {"stream": frame.stream, "epoch": frame.epoch, "seq": frame.seq, "stamp_ns": frame.stamp_ns}
    boxes = {"label": frame.label, "center": frame.center, "size": frame.size, "yaw": frame.yaw}
    rest = {"velocity": np.zeros((n, 2)), "yaw_rate": zeros, "acceleration": zeros, "existence": ones, "score": ones}
    last = {"covariance": np.tile(np.eye(6), (n, 1, 1)), "age": ones, "time_since_detection": zeros}
    return Tracks(
        **header, **boxes, **rest, **last, session="0" * 32, profile="cost", cloud_used=False, labels=frame.labels,
        id=np.arange(n), detection=np.arange(n),
    )  # fmt: skip

"""Frames for a load, encoded once: while it runs, a message costs one copy, and the generator is no bottleneck.

Stream, epoch, number and stamp stand at the start of every message and take the same number of bytes in all of them
(stream names are of one length, numbers begin at 2^32). So a message is a head, made anew for each, and a body, which
all streams share. The frames go round and round; those that are generated join without a jump.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from optipmb_schemas import Detections, Points, Pose, encode

from optipmb_client.datasets import DataSequence, DetectionFrame
from optipmb_client.datasets.interface import DETECTION_COLUMNS

FIRST = 2**32  # number of the first frame: from here on msgpack writes nine bytes

STREAM_BYTES = 24  # length of the names of streams

CLOUDS = 20  # different clouds that are generated; more would only take memory

SPACING_M = 12.0
RADIUS_M = 4.0
NOISE_M = 0.05

_msgpack: Any = msgpack  # its type information is partial


@dataclass(frozen=True)
class Frames:
    """The bodies of messages: of frame k the detections `[k]`, and the cloud `[k]` unless there are none."""

    detections: tuple[bytes, ...]
    clouds: tuple[bytes | None, ...]
    objects: float  # mean number of objects in a frame
    points: float  # mean number of points in a frame

    def __len__(self) -> int:
        return len(self.detections)


def head(stream: str, epoch: bytes, seq: int, stamp_ns: int) -> bytes:
    """Return the four fields that every message starts with, as msgpack, without the size of the map before them."""
    fields = ("stream", stream, "epoch", epoch, "seq", seq, "stamp_ns", stamp_ns)
    return b"".join(map(_msgpack.packb, fields))


def generated(objects: int, points: int, rate: float, seed: int = 0) -> Frames:
    """Return ten seconds of objects that drive in circles, and clouds around the sensor, seen in the world frame.

    Args:
        objects: how many, of two classes.
        points: points of every cloud; 0: no clouds.
        rate: frames per second.
        seed: of the noise.
    """
    random = np.random.default_rng(seed)
    count = max(2, round(10 * rate))
    columns = max(1, int(np.ceil(np.sqrt(objects))))
    index = np.arange(objects)
    middle = SPACING_M * np.stack([index % columns, index // columns, 0 * index], axis=1).astype(np.float64)
    middle[:, :2] -= SPACING_M * (columns - 1) / 2
    begun = random.uniform(0, 2 * np.pi, objects)
    turn = 2 * np.pi * rate / count
    detections = []
    for k in range(count):
        angle = begun + 2 * np.pi * k / count
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros(objects)], axis=1)
        along = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        detections.append(
            _detections(
                frame="world",
                labels=("car", "pedestrian"),
                label=index % 2,
                center=middle + RADIUS_M * around + random.normal(0, NOISE_M, (objects, 3)),
                size=np.where(index[:, None] % 2 == 0, [4.5, 1.9, 1.6], [0.8, 0.7, 1.8]),
                yaw=angle + np.pi / 2,
                velocity=RADIUS_M * turn * along,
                score=np.full(objects, 0.8),
                has_points=points > 0,
            )
        )
    reach = SPACING_M * columns / 2 + 20
    clouds = [
        _points(frame="world", pose=None, xyz=random.uniform(-reach, reach, (points, 3)).astype(np.float32))
        for _ in range(CLOUDS if points else 0)
    ]
    shelf = itertools.islice(itertools.cycle(clouds or [None]), count)
    return Frames(tuple(detections), tuple(shelf), float(objects), float(points))


def recorded(sequences: Sequence[DataSequence], *, clouds: bool) -> Frames:
    """Return the frames of recorded sequences, one after the other; between them the scene changes."""
    frames = [frame for sequence in sequences for frame in sequence.frames()]
    shelf = [_cloud(frame) if clouds else None for frame in frames]
    points = [len(frame.cloud.xyz) if clouds and frame.cloud is not None else 0 for frame in frames]
    return Frames(
        tuple(_recorded(frame, with_cloud=cloud is not None) for frame, cloud in zip(frames, shelf, strict=True)),
        tuple(shelf),
        float(np.mean([len(frame) for frame in frames])),
        float(np.mean(points)),
    )


def _recorded(frame: DetectionFrame, *, with_cloud: bool) -> bytes:
    return _detections(
        frame="sensor",
        pose=Pose(translation=frame.pose.translation, quaternion=frame.pose.quaternion),
        labels=frame.labels,
        **{name: getattr(frame, name) for name in DETECTION_COLUMNS if name != "position_covariance"},
        has_points=with_cloud,
    )


def _cloud(frame: DetectionFrame) -> bytes | None:
    if frame.cloud is None:
        return None
    pose = frame.cloud.pose
    return _points(
        frame="sensor", pose=Pose(translation=pose.translation, quaternion=pose.quaternion), xyz=frame.cloud.xyz
    )


_ANY: Any = {"stream": f"{'s' * (STREAM_BYTES - 4)}/s/s", "epoch": bytes(16), "seq": FIRST, "stamp_ns": FIRST}


def _detections(**fields: Any) -> bytes:
    return _body(encode(Detections(**_ANY, **fields)))


def _points(**fields: Any) -> bytes:
    return _body(encode(Points(**_ANY, **fields)))


def _body(payload: bytes) -> bytes:
    """Return a message without its head, but with the byte before the head put first."""
    start = head(**_ANY)
    at = payload.index(start)
    assert at == 1, "the header is not what a message starts with"  # noqa: S101  a fact of the codec
    return payload[:at] + payload[at + len(start) :]


def message(body: bytes, begins: bytes) -> bytes:
    """Return the message of a body with a head."""
    return b"".join((body[:1], begins, memoryview(body)[1:]))


def chain(parts: Iterable[str]) -> str:
    """Return a stream name of the common length from its parts, the first padded."""
    first, *rest = parts
    tail = "/".join(rest)
    return f"{first.ljust(STREAM_BYTES - len(tail) - 1, '-')}/{tail}"

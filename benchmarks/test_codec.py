"""Time of the codec. Run with `pytest benchmarks/test_codec.py`.

The figures to watch: 100 detections in less than 150 us, and a cloud of 120,000 points in far less than the 1 ms that
one copy and check of every point in Python would take many times over.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from optipmb_schemas import Detections, Message, Points, Pose, Tracks, decode, encode, encode_json

HEADER: dict[str, Any] = {
    "stream": "site/node/lidar",
    "epoch": bytes(16),
    "seq": 5,
    "stamp_ns": 1_700_000_000_000_000_000,
}
POSE = Pose(translation=np.array([1.0, 2.0, 3.0]), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))

Benchmark = Callable[..., Any]


def detections(rows: int) -> Detections:
    """Return so many detections, half of them of unknown velocity."""
    random = np.random.default_rng(1)
    velocity = random.normal(size=(rows, 2))
    velocity[::2] = np.nan
    return Detections(
        **HEADER,
        frame="sensor",
        pose=POSE,
        labels=("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"),
        label=random.integers(0, 7, rows),
        center=random.normal(size=(rows, 3)),
        size=random.uniform(0.5, 5, (rows, 3)),
        yaw=random.normal(size=rows),
        score=random.uniform(0.1, 1, rows),
        velocity=velocity,
    )


def points(rows: int) -> Points:
    """Return a cloud."""
    xyz = np.random.default_rng(1).normal(size=(rows, 3)).astype("f4")
    return Points(**HEADER, frame="sensor", pose=POSE, xyz=xyz)


def tracks(rows: int) -> Tracks:
    """Return so many tracks."""
    random = np.random.default_rng(1)
    columns = ("yaw", "yaw_rate", "acceleration", "existence", "score", "age", "time_since_detection")
    return Tracks(
        **HEADER,
        session="0" * 32,
        profile="nuscenes",
        cloud_used=True,
        labels=("car", "pedestrian"),
        id=np.arange(rows),
        label=random.integers(0, 2, rows),
        center=random.normal(size=(rows, 3)),
        size=random.uniform(0.5, 5, (rows, 3)),
        velocity=random.normal(size=(rows, 2)),
        covariance=random.normal(size=(rows, 6, 6)),
        detection=np.arange(rows) - 1,
        **{name: random.uniform(0, 1, rows) for name in columns},
    )


MESSAGES = {
    "detections-100": detections(100),
    "points-30000": points(30_000),
    "points-120000": points(120_000),
    "tracks-100": tracks(100),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_decode(benchmark: Benchmark, name: str) -> None:
    """Bytes to a checked message."""
    message = MESSAGES[name]
    payload = encode(message)
    assert benchmark(decode, payload, type(message)) == message


@pytest.mark.parametrize("name", MESSAGES)
def test_encode(benchmark: Benchmark, name: str) -> None:
    """A message to bytes."""
    message = MESSAGES[name]
    assert decode(benchmark(encode, message), type(message)) == message


@pytest.mark.parametrize("name", ["detections-100", "tracks-100"])
def test_decode_json(benchmark: Benchmark, name: str) -> None:
    """JSON to a checked message."""
    message = MESSAGES[name]
    assert benchmark(decode, encode_json(message), type(message)) == message


@pytest.mark.parametrize("name", MESSAGES)
def test_construct(benchmark: Benchmark, name: str) -> None:
    """Checking alone: a message from arrays."""
    message: Message = MESSAGES[name]
    fields = dict(message.present())
    assert benchmark(type(message), **fields) == message


def test_a_cloud_is_not_copied() -> None:
    """The points of a decoded cloud lie in the payload."""
    payload = encode(MESSAGES["points-120000"])
    assert np.shares_memory(decode(payload, Points).xyz, np.frombuffer(payload, np.uint8))

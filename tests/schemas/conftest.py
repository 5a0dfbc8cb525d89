"""One valid message of every type, small and complete: every field is present."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from optipmb_schemas import (
    Attribute,
    Delivery,
    Density,
    Detections,
    DrainRequest,
    Events,
    FieldOfView,
    LinkedObject,
    Links,
    Message,
    MoveRequest,
    Points,
    Pose,
    Problem,
    Relocation,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    SessionSummary,
    Tracks,
    TracksRequest,
    ZoneCount,
    ZoneEvent,
)

EPOCH = bytes(range(16))
POSE = Pose(translation=np.array([10.0, 20.0, 1.5]), quaternion=np.array([0.6, 0.0, 0.0, 0.8]))
MOTION = Relocation(world=3, translation=np.array([10.0, -2.0, 0.5]), quaternion=np.array([0.8, 0.0, 0.0, -0.6]))
VIEW = FieldOfView(azimuth=np.array([2.5, -2.5]), elevation=np.array([-0.4, 0.2]), range=np.array([0.5, 80]))
HEADER = {"stream": "site-1/node.2/lidar_3", "epoch": EPOCH, "seq": 7, "stamp_ns": 1_700_000_000_123_456_789}


PLATE = Attribute(row=1, name="plate", text="AB 12", score=0.75)


def _examples() -> list[Message]:
    detections = Detections(
        **HEADER,
        frame="sensor",
        pose=POSE,
        labels=("car", "pedestrian"),
        label=np.array([0, 1, 0]),
        center=np.array([[1.0, 2.0, 0.5], [-3.0, 0.0, -0.0], [40.0, -8.5, 1.0]]),
        size=np.array([[4.2, 1.8, 1.5], [0.6, 0.7, 1.75], [4.0, 1.7, 1.4]]),
        yaw=np.array([0.0, 1.5, -3.0]),
        score=np.array([1.0, 0.3, 1e-9]),
        velocity=np.array([[1.0, -0.0], [np.nan, np.nan], [0.0, 5.5]]),
        has_points=True,
        field_of_view=VIEW,
    )
    points = Points(
        **HEADER, frame="sensor", pose=POSE, relocation=MOTION, xyz=np.arange(30, dtype="f4").reshape(10, 3)
    )
    tracks = Tracks(
        **HEADER,
        session="0123456789abcdef" * 2,
        revision=1,
        profile="nuscenes",
        cloud_used=True,
        gap=2,
        ignored=3,
        world=3,
        labels=("car", "pedestrian"),
        id=np.array([3, 8]),
        label=np.array([1, 0]),
        center=np.array([[1.0, 2.0, 0.5], [-3.0, 0.0, -0.0]]),
        size=np.array([[4.2, 1.8, 1.5], [0.6, 0.7, 1.75]]),
        yaw=np.array([0.1, -0.2]),
        heading_confidence=np.array([0.9, 0.5]),
        confirmed=np.array([1, 0]),
        measured=np.array([7, 4]),
        class_probability=np.array([[0.25, 0.75], [1.0, 0.0]], dtype="f4"),
        object=np.array([3, -1]),
        object_probability=np.array([0.995, 1.0], dtype="f4"),
        velocity=np.array([[1.0, 2.0], [0.0, 0.5]]),
        yaw_rate=np.array([0.01, 0.0]),
        acceleration=np.array([0.5, -0.5]),
        existence=np.array([0.99, 0.0]),
        score=np.array([0.7, 1.0]),
        covariance=np.stack([np.eye(6), 2 * np.eye(6)]),
        age=np.array([1.5, 0.0]),
        time_since_detection=np.array([0.0, 0.5]),
        detection=np.array([1, -1]),
        horizons=np.array([0.5, 1.0, 3.0]),
        path_position=np.arange(12.0).reshape(2, 3, 2),
        path_yaw=np.array([[0.1, 0.2, -3.0], [0.0, -0.0, 1e-9]], dtype="f4"),
        path_covariance=np.broadcast_to(np.eye(2), (2, 3, 2, 2)),
        delivery=Delivery(instance="host-1", received_ns=5, published_ns=6, queue_ms=0.5, decode_ms=0.125, step_ms=3.0),
    )
    where: dict[str, Any] = {
        "n": 3,
        "id": 8,
        "label": 1,
        "at_ns": 5,
        "position": (1.0, 2.0, 0.5),
        "speed": 1.5,
        "yaw": -3.0,
    }
    left = ZoneEvent(zone="crossing", kind="left", how="lost", dwell_s=2.5, **where)
    crossed = ZoneEvent(zone="gate", kind="crossed", direction="left", **where)
    names = ("inside", "entered", "left", "appeared", "lost", "to_left", "to_right", "distinct")
    linked = LinkedObject(
        global_id=bytes(range(16)),
        stream=HEADER["stream"],
        session="0123456789abcdef" * 2,
        object=3,
        probability=0.998,
        kind="overlap",
        ended=False,
    )
    links = Links(area="campus", revision=5, stamp_ns=6, whole=True, objects=(linked,))
    events = Events(
        **HEADER,
        session="0123456789abcdef" * 2,
        revision=1,
        labels=("car", "pedestrian"),
        events=(left, crossed),
        attributes=(PLATE,),
        zones=(ZoneCount(zone="crossing", **dict.fromkeys(names, (0, 3))),),
        delivery=tracks.delivery,
    )
    state = SessionState(
        stream=HEADER["stream"],
        session="f" * 32,
        state="running",
        profile="kitti",
        epoch=EPOCH,
        seq=7,
        stamp_ns=8,
        frames=9,
    )
    density = Density(
        stream=HEADER["stream"],
        session="f" * 32,
        stamp_ns=8,
        labels=("car", "pedestrian"),
        label=np.array([1, 0]),
        weight=np.array([0.25, 1e-9]),
        mean=np.arange(12.0).reshape(2, 6),
        covariance=np.stack([np.eye(6), 2 * np.eye(6)]),
        z=np.array([1.0, -0.5]),
    )
    parameters = SessionParameters(
        profile="kitti",
        cloud_wait_s=0.05,
        horizons=np.array([0.5, 2.0]),
        restart=True,
        values={"b": [1, 2.5, None, True], "a": {"text": "ü", "low": -(2**63)}},
    )
    problem = Problem(
        stream=HEADER["stream"],
        instance="host-1",
        code="invalid_value",
        path="score[3]",
        expected="a number in (0, 1]",
        received="0.0",
        message="score[3]: expected a number in (0, 1], received 0.0",
        seq=7,
        stamp_ns=8,
        count=2,
    )
    status = ServiceStatus(
        instance="host-1",
        version="0.1.0",
        started_ns=1,
        uptime_s=2.5,
        state="ready",
        sessions=(
            SessionSummary(stream="a/b/c", profile="kitti", state="running", rate_hz=10.0, age_s=0.1),
            SessionSummary(stream="a/b/d", profile="kitti", state="new"),
        ),
        frames=3,
        refused=4,
        problems=(problem,),
    )
    return [
        detections,
        points,
        tracks,
        events,
        links,
        state,
        density,
        parameters,
        ResetRequest(close=True),
        MoveRequest(stream="a/b/c", worker=1),
        DrainRequest(drain=False),
        TracksRequest(from_ns=5, to_ns=7),
        problem,
        status,
    ]


@pytest.fixture(scope="session")
def examples() -> dict[str, Message]:
    return {type(message).__name__: message for message in _examples()}


@pytest.fixture(scope="session")
def example_of(examples: dict[str, Message]) -> Callable[[type[Message]], Message]:
    tracks, status, events = examples["Tracks"], examples["ServiceStatus"], examples["Events"]
    assert isinstance(tracks, Tracks)
    assert isinstance(status, ServiceStatus)
    links = examples["Links"]
    assert isinstance(links, Links)
    assert isinstance(events, Events)
    assert tracks.delivery is not None
    assert events.zones is not None
    held = {
        "Pose": POSE,
        "Relocation": MOTION,
        "FieldOfView": VIEW,
        "Delivery": tracks.delivery,
        "SessionSummary": status.sessions[0],
        "ZoneEvent": events.events[0],
        "ZoneCount": events.zones[0],
        "LinkedObject": links.objects[0],
        "Attribute": PLATE,
    }
    return lambda kind: {**examples, **held}[kind.__name__]


@pytest.fixture(scope="session")
def detections(examples: dict[str, Message]) -> Detections:
    message = examples["Detections"]
    assert isinstance(message, Detections)
    return message

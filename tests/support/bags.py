"""Bags of ROS 2 from any dataset, by libraries that are not ours: MCAP by mcap-ros2-support, SQLite by rosbags."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.writer import Writer as McapWriter
from optipmb_schemas.ros2.tracks import CLASS_NAMES
from optipmb_schemas.ros2.types import own_types
from optipmb_tools.datasets import DataSequence, DetectionFrame
from optipmb_tools.geometry import Pose, pose_of, rotation_of
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

LATENCY_NS = 80_000_000
"""How much later than its stamp a message of detections is received; a cloud is received at once."""

VISION = "vision_msgs/msg/Detection3DArray"
AUTOWARE = "autoware_perception_msgs/msg/DetectedObjects"
OLD_AUTOWARE = "autoware_auto_perception_msgs/msg/DetectedObjects"
NUMBERS = {name: number for number, name in CLASS_NAMES.items()} | {"cyclist": 6}


class Sent(NamedTuple):
    topic: str
    kind: str
    received_ns: int
    message: dict[str, Any]


def messages(
    sequence: DataSequence, *, kind: str = VISION, odometry: bool = False, start_ns: int = 10**18
) -> Iterator[Sent]:
    """Give the frames of a sequence as a vehicle would record them: tf or odometry, static tf, clouds, detections."""
    extrinsic: Pose | None = None
    for frame in sequence.frames():
        stamp = start_ns + frame.stamp_ns
        if frame.cloud is not None and extrinsic is None:
            extrinsic = _between(frame.pose, frame.cloud.pose)
            fixed = _transform(0, "camera", "velodyne", extrinsic)
            yield Sent("/tf_static", "tf2_msgs/msg/TFMessage", stamp, {"transforms": [fixed]})
        if odometry:
            yield Sent("/odometry", "nav_msgs/msg/Odometry", stamp, _odometry(stamp, frame.pose))
        else:
            moving = _transform(stamp, "map", "camera", frame.pose)
            yield Sent("/tf", "tf2_msgs/msg/TFMessage", stamp, {"transforms": [moving]})
        if frame.cloud is not None:
            yield Sent("/points", "sensor_msgs/msg/PointCloud2", stamp, cloud(stamp, "velodyne", frame.cloud.xyz))
        detections = vision(stamp, "camera", frame) if kind == VISION else autoware(stamp, "camera", frame)
        yield Sent("/detector/boxes", kind, stamp + LATENCY_NS, detections)


def write_mcap(path: Path, sent: Sequence[Sent]) -> Path:
    schemas: dict[str, Any] = {}
    with path.open("wb") as file:
        writer = McapWriter(file)
        for one in sorted(sent, key=lambda sent: sent.received_ns):
            if one.kind not in schemas:
                schemas[one.kind] = writer.register_msgdef(one.kind, own_types().definition(one.kind))
            writer.write_message(one.topic, schemas[one.kind], one.message, one.received_ns, one.received_ns)
        writer.finish()
    return path


def write_sqlite(path: Path, sent: Sequence[Sent]) -> Path:
    """Write messages to a folder with SQLite: the bytes of the MCAP file, filed by another library."""
    whole = write_mcap(path.with_suffix(".whole"), sent)
    with RosbagWriter(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer, whole.open("rb") as file:
        topics: dict[str, Any] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.topic not in topics:
                about = {"msgdef": schema.data.decode(), "rihs01": own_types().hash_of(schema.name)}
                topics[channel.topic] = writer.add_connection(channel.topic, schema.name, **about)
            writer.write(topics[channel.topic], message.log_time, message.data)
    whole.unlink()
    return path


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def vector(values: Sequence[float]) -> dict[str, float]:
    x, y, z = (float(value) for value in values)
    return {"x": x, "y": y, "z": z}


def pose(center: Sequence[float], quaternion: Sequence[float]) -> dict[str, Any]:
    w, x, y, z = (float(value) for value in quaternion)
    return {"position": vector(center), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def turned(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def vision(stamp_ns: int, frame_id: str, frame: DetectionFrame) -> dict[str, Any]:
    detections = []
    for row in range(len(frame)):
        box = pose(frame.center[row], turned(frame.yaw[row]))
        hypothesis = {"class_id": frame.labels[frame.label[row]], "score": float(frame.score[row])}
        detections.append(
            {
                "header": header(stamp_ns, frame_id),
                "results": [{"hypothesis": hypothesis, "pose": {"pose": box, "covariance": [0.0] * 36}}],
                "bbox": {"center": box, "size": vector(frame.size[row])},
                "id": "",
            }
        )
    return {"header": header(stamp_ns, frame_id), "detections": detections}


def autoware(stamp_ns: int, frame_id: str, frame: DetectionFrame) -> dict[str, Any]:
    """Give the objects of a frame as DetectedObjects; velocities are turned into the frame of each object."""
    objects = []
    for row in range(len(frame)):
        yaw = float(frame.yaw[row])
        moving = frame.velocity is not None and not np.isnan(frame.velocity[row]).any()
        east, north = frame.velocity[row] if frame.velocity is not None and moving else (0.0, 0.0)
        along = [math.cos(yaw) * east + math.sin(yaw) * north, math.cos(yaw) * north - math.sin(yaw) * east, 0.0]
        number = NUMBERS.get(frame.labels[frame.label[row]].lower(), 0)
        objects.append(
            {
                "existence_probability": float(frame.score[row]),
                "classification": [{"label": number, "probability": 1.0}],
                "kinematics": {
                    "pose_with_covariance": {"pose": pose(frame.center[row], turned(yaw)), "covariance": [0.0] * 36},
                    "has_position_covariance": False,
                    "orientation_availability": 2,
                    "twist_with_covariance": {
                        "twist": {"linear": vector(along), "angular": vector([0, 0, 0])},
                        "covariance": [0.0] * 36,
                    },
                    "has_twist": moving,
                    "has_twist_covariance": False,
                },
                "shape": {"type": 0, "footprint": {"points": []}, "dimensions": vector(frame.size[row])},
            }
        )
    return {"header": header(stamp_ns, frame_id), "objects": objects}


def cloud(stamp_ns: int, frame_id: str, xyz: np.ndarray, *, padding: int = 4) -> dict[str, Any]:
    """Give points as PointCloud2 with a column of intensities between them."""
    step = 12 + padding
    data = np.zeros((len(xyz), step), dtype=np.uint8)
    data[:, :12] = np.ascontiguousarray(xyz, dtype="<f4").view(np.uint8).reshape(len(xyz), 12)
    fields = [{"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")]
    return {
        "header": header(stamp_ns, frame_id),
        "height": 1,
        "width": len(xyz),
        "fields": fields,
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(xyz),
        "data": data.ravel().tobytes(),
        "is_dense": True,
    }


def _transform(stamp_ns: int, parent: str, child: str, at: Pose) -> dict[str, Any]:
    w, x, y, z = (float(value) for value in at.quaternion)
    moved = {"translation": vector(at.translation), "rotation": {"x": x, "y": y, "z": z, "w": w}}
    return {"header": header(stamp_ns, parent), "child_frame_id": child, "transform": moved}


def _odometry(stamp_ns: int, at: Pose) -> dict[str, Any]:
    still = {"linear": vector([0, 0, 0]), "angular": vector([0, 0, 0])}
    return {
        "header": header(stamp_ns, "map"),
        "child_frame_id": "camera",
        "pose": {"pose": pose(at.translation, at.quaternion), "covariance": [0.0] * 36},
        "twist": {"twist": still, "covariance": [0.0] * 36},
    }


def _between(parent: Pose, child: Pose) -> Pose:
    turn = rotation_of(parent.quaternion).T
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ rotation_of(child.quaternion)
    matrix[:3, 3] = turn @ (child.translation - parent.translation)
    return pose_of(matrix)

"""Bags of ROS 2: their messages, and what is tracked of one topic of detections.

A frame is a message of detections. Its cloud is the one with the same stamp. Its pose is that of its frame in the fixed
frame, from tf and, for frames that have no parent there, from odometry.
"""

import contextlib
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from optipmb_schemas import MessageError
from optipmb_schemas.ros2.arrays import CLOUD, DETECTIONS, stamp_of
from optipmb_schemas.ros2.transforms import TransformError, Transforms
from optipmb_schemas.ros2.types import Types
from rosbags.rosbag2 import Reader, ReaderError

from optipmb_client.files import DatasetError
from optipmb_client.geometry import Pose

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


_CDR: Final = 4  # bytes ahead of the fields; the second tells the order of the bytes of numbers
_TF: Final = "tf2_msgs/msg/TFMessage"
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_SOME: Final = 5


class Raw(NamedTuple):
    """A message as it is in the bag."""

    topic: str
    received_ns: int
    data: bytes


class Stamped(NamedTuple):
    """The header of a message: stamp in nanoseconds, and frame."""

    stamp_ns: int
    frame: str


class Bag:
    """A rosbag2 folder, or one MCAP or SQLite file of it.

    Args:
        path: The folder with `metadata.yaml`, or the file.

    Raises:
        DatasetError: It is none, or was not closed properly.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with contextlib.closing(self._reader()) as reader:
            self.connections: tuple[Connection, ...] = tuple(reader.connections)
        self.topics: dict[str, str] = {one.topic: one.msgtype for one in self.connections}
        self._definitions = {one.msgtype: one.msgdef for one in self.connections}
        self._types: dict[str, Types] = {}

    def of_type(self, *names: str) -> tuple[str, ...]:
        """Return the topics of some types, ordered by name."""
        return tuple(sorted(topic for topic, name in self.topics.items() if name in names))

    def messages(self, topics: Collection[str]) -> Iterator[Raw]:
        """Yield the messages of some topics in the order in which they were received."""
        with contextlib.closing(self._reader()) as reader:
            chosen = [one for one in reader.connections if one.topic in topics]
            if not chosen:
                return
            try:
                for connection, received_ns, data in reader.messages(chosen):
                    yield Raw(connection.topic, received_ns, data)
            except (ReaderError, EOFError, struct.error) as error:
                raise DatasetError(self.path, "whole messages", str(error)) from error

    def read(self, raw: Raw) -> Any:
        """Return what a message says.

        Raises:
            DatasetError: Its bytes are no message of the topic's type.
        """
        name = self.topics[raw.topic]
        if name not in self._types:
            try:
                self._types[name] = Types({name: self._definitions[name]})
            except MessageError as error:
                raise self.wrong(raw, error) from error
        try:
            return self._types[name].read(name, raw.data)
        except MessageError as error:
            raise self.wrong(raw, error) from error

    def header(self, raw: Raw) -> Stamped:
        """Return the header that a message begins with, without reading the rest.

        Raises:
            DatasetError: There is none.
        """
        order = "<" if raw.data[1:2] == b"\x01" else ">"
        try:
            second, rest, length = struct.unpack_from(order + "iII", raw.data, _CDR)
            start = _CDR + 12
            if second < 0 or rest >= 10**9 or not 0 < length <= len(raw.data) - start:
                raise ValueError  # noqa: TRY301 - reported below
            frame = raw.data[start : start + length - 1].decode()
        except (struct.error, ValueError) as error:
            raise DatasetError(f"{self.path} {raw.topic}", "a header", f"{len(raw.data)} bytes without one") from error
        return Stamped(second * 10**9 + rest, frame.removeprefix("/"))

    def wrong(self, raw: Raw, error: MessageError) -> DatasetError:
        """Return an error that says which message of the bag is wrong."""
        place = f"{self.path} {raw.topic}, received at {raw.received_ns} ns"
        return DatasetError(f"{place}: {error.path}" if error.path else place, error.expected, error.received)

    def _reader(self) -> Reader:
        what = "a bag of ROS 2 (a folder with metadata.yaml, or an .mcap or .db3 file)"
        try:
            reader = Reader(self.path)
            reader.open()
        except FileNotFoundError as error:
            received = "a folder without metadata.yaml" if self.path.is_dir() else "nothing"
            raise DatasetError(self.path, what, received) from error
        except (ReaderError, EOFError, struct.error, TypeError) as error:
            hint = " (if the recorder was killed: mcap recover, or ros2 bag reindex)"
            raise DatasetError(self.path, what, f"{error}{hint}") from error
        return reader


@dataclass(frozen=True)
class Choice:
    """Choices of the user where a bag leaves something open; empty: by the rules above."""

    points: str = ""  # topic of the clouds
    odometry: str = ""  # topic of the odometry
    fixed_frame: str = ""  # frame of the tracks; default: the root of the tree of frames


class PlannedFrame(NamedTuple):
    """One message of detections."""

    stamp_ns: int
    received_ns: int
    pose: Pose


@dataclass
class Plan:
    """Frames and clouds of one topic of detections."""

    topic: str
    world: str  # name of the fixed frame
    frames: list[PlannedFrame] = field(default_factory=list)  # ordered by stamp
    clouds: dict[int, Pose] = field(default_factory=dict)  # pose of each cloud that belongs to a frame, by its stamp
    cloud_topic: str | None = None
    notes: list[str] = field(default_factory=list)  # what was left out, and why


def read_transforms(bag: Bag, choice: Choice) -> Transforms:
    """Return all transforms of a bag: tf, static tf, and odometry for frames without a parent in tf.

    Raises:
        DatasetError: A transform is none, or several topics tell the odometry of one frame.
    """
    transforms = Transforms()
    for raw in bag.messages(bag.of_type(_TF)):
        for one in bag.read(raw).transforms:
            static = raw.topic.rstrip("/").endswith("tf_static")
            _add(bag, raw, transforms, one.header, one.child_frame_id, one.transform, static=static)
    topics = bag.of_type(_ODOMETRY)
    if choice.odometry and choice.odometry not in topics:
        raise DatasetError("option odometry", f"one of {', '.join(topics) or 'no topics'}", choice.odometry)
    topic_of: dict[str, str] = {}
    for raw in bag.messages((choice.odometry,) if choice.odometry else topics):
        message = bag.read(raw)
        child = str(message.child_frame_id).removeprefix("/")
        if transforms.has_parent(child) and child not in topic_of:
            continue
        if topic_of.setdefault(child, raw.topic) != raw.topic:
            expected = f"one topic for the pose of {child!r} (--option odometry=TOPIC)"
            raise DatasetError(bag.path, expected, f"{topic_of[child]} and {raw.topic}")
        _add(bag, raw, transforms, message.header, child, message.pose.pose, static=False)
    return transforms


def plan(bag: Bag, topic: str, transforms: Transforms, choice: Choice) -> Plan:
    """Return what is tracked of one topic of detections.

    Raises:
        DatasetError: Frames are not in tf, no frame has a pose, or clouds of several topics would fit.
    """
    heads = sorted((bag.header(raw), raw.received_ns) for raw in bag.messages((topic,)))
    if not heads:
        raise DatasetError(bag.path, f"messages on {topic}", "none")
    first = heads[0][0].frame
    world = choice.fixed_frame.removeprefix("/") or _root(bag, transforms, first)
    made = Plan(topic, world)
    without: list[TransformError] = []
    for head, received_ns in heads:
        try:
            pose = _pose(transforms, world, head.frame, head.stamp_ns)
        except TransformError as error:
            without.append(error)
            continue
        made.frames.append(PlannedFrame(head.stamp_ns, received_ns, pose))
    if not made.frames:
        raise DatasetError(f"{bag.path} {topic}", "a pose of the sensor for at least one message", str(without[0]))
    if without:
        made.notes.append(
            f"{len(without)} of {len(heads)} messages on {topic} left out for want of a pose: {without[0]}"
        )
    _match_clouds(bag, made, transforms, choice, first)
    return made


def _match_clouds(bag: Bag, made: Plan, transforms: Transforms, choice: Choice, sensor: str) -> None:
    topics = bag.of_type(CLOUD)
    if choice.points and choice.points not in topics:
        raise DatasetError("option points", f"one of {', '.join(topics) or 'no topics'}", choice.points)
    wanted = {one.stamp_ns for one in made.frames}
    stamps: dict[str, dict[int, str]] = {}
    for raw in bag.messages((choice.points,) if choice.points else topics):
        head = bag.header(raw)
        if head.stamp_ns in wanted:
            stamps.setdefault(raw.topic, {})[head.stamp_ns] = head.frame
    of_sensor = [name for name, heads in stamps.items() if sensor in heads.values()]
    fitting = of_sensor if len(of_sensor) == 1 else sorted(stamps)
    if len(fitting) > 1:
        expected = f"clouds with the stamps of {made.topic} on one topic (--option points=TOPIC)"
        raise DatasetError(bag.path, expected, ", ".join(fitting))
    if topics and not fitting:
        made.notes.append(f"no cloud has the stamp of a message on {made.topic}: tracked without clouds")
    for name in fitting:
        made.cloud_topic = name
        for stamp_ns, frame in stamps[name].items():
            try:
                made.clouds[stamp_ns] = _pose(transforms, made.world, frame, stamp_ns)
            except TransformError as error:
                made.notes.append(f"a cloud on {name} left out for want of a pose: {error}")
    del made.notes[_SOME:]


def _root(bag: Bag, transforms: Transforms, frame: str) -> str:
    if len(transforms) and frame not in transforms.frames:
        known = ", ".join(transforms.frames)
        raise DatasetError(bag.path, f"the frame {frame!r} of the detections in tf", f"the frames {known}")
    try:
        return transforms.root(frame)
    except TransformError as error:
        raise DatasetError(bag.path, "a tree of frames in tf", str(error)) from error


def _pose(transforms: Transforms, world: str, frame: str, stamp_ns: int) -> Pose:
    translation, quaternion = transforms.lookup(world, frame, stamp_ns)
    return Pose(translation, -quaternion if quaternion[0] < 0 else quaternion)


def _add(bag: Bag, raw: Raw, transforms: Transforms, header: Any, child: str, pose: Any, *, static: bool) -> None:
    place = getattr(pose, "translation", None) or pose.position
    turn = getattr(pose, "rotation", None) or pose.orientation
    try:
        transforms.add(
            str(header.frame_id),
            str(child),
            stamp_of(header),
            np.array([place.x, place.y, place.z]),
            np.array([turn.w, turn.x, turn.y, turn.z]),
            static=static,
        )
    except MessageError as error:
        raise bag.wrong(raw, error) from error


def detection_topics(bag: Bag) -> tuple[str, ...]:
    """Return the topics of a bag that hold detections.

    Raises:
        DatasetError: There are none.
    """
    topics = bag.of_type(*DETECTIONS)
    if not topics:
        received = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.topics.items())[:20]) or "no topics"
        raise DatasetError(bag.path, f"a topic of {' or '.join(DETECTIONS)}", received)
    return topics

"""Bags of ROS 2 as a data set: each topic of detections is a sequence, `/lidar/boxes` is called `lidar.boxes`.

A frame is a message of detections, at the stamp of its header. Its cloud is the one with the same stamp. Its pose is
the pose of its frame in the fixed frame, from tf and, for frames that have no parent there, from odometry. Tracks are
in the fixed frame. There is no truth. What a bag leaves open is chosen by options: `points`, `odometry`, `fixed_frame`,
`class.NAME=OTHER` for names of classes, and `invalid=skip` to leave out objects with values that are not allowed.

Tracks can be written as a bag: one MCAP file with objects, detections with ids, and markers, as all of ROS 2 reads
them. Their topics begin with the topic of the detections: `…/tracks` and, below it, `detections`, `markers`,
`predicted`. A message is received, as far as the bag is concerned, when its detections were.
"""

import contextlib
import struct
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from optipmb_schemas import MessageError, Tracks
from optipmb_schemas.ros2.arrays import CLOUD, DETECTIONS, Boxes, boxes_of, points_of, stamp_of
from optipmb_schemas.ros2.tracks import TOPICS, messages
from optipmb_schemas.ros2.transforms import TransformError, Transforms
from optipmb_schemas.ros2.types import Types, own_types
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from optipmb_tools.camera import synthetic_camera
from optipmb_tools.datasets.interface import (
    DETECTION_COLUMNS,
    Cloud,
    DataSequence,
    Dataset,
    DetectionFrame,
    Points,
)
from optipmb_tools.files import DatasetError, damage
from optipmb_tools.geometry import Pose
from optipmb_tools.results.kitti import write_kitti_results

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
    """A rosbag2 folder (with `metadata.yaml`), or one MCAP or SQLite file of it.

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
            with damage(self.path, "whole messages"):
                for connection, received_ns, data in reader.messages(chosen):
                    yield Raw(connection.topic, received_ns, bytes(data))

    def read(self, raw: Raw) -> Any:
        """Return a message.

        Raises:
            DatasetError: Its bytes are no message of the topic's type.
        """
        name = self.topics[raw.topic]
        try:
            with damage(f"{self.path} {raw.topic}", f"messages of {name}"):
                if name not in self._types:
                    self._types[name] = Types({name: self._definitions[name]})
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

    def wrong(self, raw: Raw, error: MessageError, remedy: str = "") -> DatasetError:
        place = f"{self.path} {raw.topic}, received at {raw.received_ns} ns"
        return DatasetError(f"{place}: {error.path}" if error.path else place, error.expected + remedy, error.received)

    def _reader(self) -> Reader:
        what = "a bag of ROS 2 (a folder with metadata.yaml, or an .mcap or .db3 file)"
        try:
            reader = Reader(self.path)
            reader.open()
        except FileNotFoundError as error:
            received = "a folder without metadata.yaml" if self.path.is_dir() else "nothing"
            raise DatasetError(self.path, what, received) from error
        except Exception as error:
            hint = " (if the recorder was killed: mcap recover, or ros2 bag reindex)"
            raise DatasetError(self.path, what, f"{error or type(error).__name__}{hint}") from error
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
class TopicPlan:
    """Frames and clouds of one topic of detections."""

    topic: str
    world: str  # name of the fixed frame
    frames: list[PlannedFrame] = field(default_factory=list)  # ordered by stamp
    clouds: dict[int, Pose] = field(default_factory=dict)  # pose of each cloud that belongs to a frame, by its stamp
    cloud_topic: str | None = None
    notes: list[str] = field(default_factory=list)  # messages that are left out, and why


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


def plan(bag: Bag, topic: str, transforms: Transforms, choice: Choice) -> TopicPlan:
    """Return the plan of one topic of detections.

    Raises:
        DatasetError: Frames are not in tf, no frame has a pose, or clouds of several topics would fit.
    """
    heads = sorted((bag.header(raw), raw.received_ns) for raw in bag.messages((topic,)))
    if not heads:
        raise DatasetError(bag.path, f"messages on {topic}", "none")
    first = heads[0][0].frame
    world = choice.fixed_frame.removeprefix("/") or _root(bag, transforms, first)
    made = TopicPlan(topic, world)
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


def _match_clouds(bag: Bag, made: TopicPlan, transforms: Transforms, choice: Choice, sensor: str) -> None:
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


def write_bag(path: Path, bag: Bag, plan: TopicPlan, tracks: Mapping[int, Tracks], *, keep_input: bool) -> Path:
    """Write the tracks (world frame) of one topic of a bag, by frame index; return the file.

    With `keep_input` every message of the bag is copied too.

    Raises:
        DatasetError: A topic that is to be copied has a type that the bag does not define.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        writer = Writer(Path(folder) / path.stem, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        types = own_types()
        with writer:
            copied = {one.topic: _copy_topic(bag, one, writer, types) for one in bag.connections if keep_input}
            given = bag.messages(copied)
            ahead = next(given, None) if copied else None
            topics = {
                end: writer.add_connection(
                    f"{plan.topic}/tracks{end}", kind, msgdef=types.definition(kind), rihs01=types.hash_of(kind)
                )
                for end, kind in TOPICS.items()
            }
            for index in sorted(tracks):
                frame = plan.frames[index]
                while ahead is not None and ahead.received_ns <= frame.received_ns:
                    writer.write(copied[ahead.topic], ahead.received_ns, ahead.data)
                    ahead = next(given, None)
                for end, message in messages(types, tracks[index], frame.stamp_ns, plan.world, plan.topic):
                    writer.write(topics[end], frame.received_ns, types.write(message))
            while ahead is not None:
                writer.write(copied[ahead.topic], ahead.received_ns, ahead.data)
                ahead = next(given, None)
        (made,) = (Path(folder) / path.stem).glob("*.mcap")
        made.replace(path)
    return path


def _copy_topic(bag: Bag, one: Connection, writer: Writer, types: Types) -> Connection:
    defined = one.msgdef.format != MessageDefinitionFormat.NONE
    try:
        definition = one.msgdef.data if defined else types.definition(one.msgtype)
        digest = one.digest or types.hash_of(one.msgtype)
    except KeyError:
        received = f"{one.msgtype} on {one.topic}, which it does not define"
        raise DatasetError(bag.path, "types that the bag defines, to copy them", received) from None
    assert isinstance(one.ext, ConnectionExtRosbag2)  # noqa: S101  the other kind is of ROS 1
    return writer.add_connection(
        one.topic,
        one.msgtype,
        msgdef=definition,
        rihs01=digest,
        serialization_format=one.ext.serialization_format,
        offered_qos_profiles=one.ext.offered_qos_profiles,
    )


_CLASS = "class."


class RosbagSequence(DataSequence):
    """One topic of detections."""

    def __init__(self, bag: Bag, plan_: TopicPlan, classes: Mapping[str, str], *, covariance: bool, skip: bool) -> None:
        self.name = plan_.topic.strip("/").replace("/", ".")
        self.plan = plan_
        self.bag = bag
        self.has_clouds: bool = bool(plan_.clouds)
        self.poses: list[Pose] = [frame.pose for frame in plan_.frames]
        self._classes = classes
        self._covariance = covariance
        self._skip = skip

    def __len__(self) -> int:
        return len(self.plan.frames)

    @cached_property
    def _content(self) -> tuple[tuple[str, ...], list[MessageError]]:
        """Class names of all frames, and errors of the objects that are left out."""
        left_out: list[MessageError] = []
        names = (name for raw in self.bag.messages((self.plan.topic,)) for name in self._boxes(raw, left_out).labels)
        return tuple(dict.fromkeys(names)), left_out

    @cached_property
    def notes(self) -> list[str]:  # type: ignore[override]  # with --option invalid=skip all messages are read for it
        """Messages and objects that are left out."""
        if not self._skip or not (errors := self._content[1]):
            return self.plan.notes
        return [*self.plan.notes, f"{len(errors)} objects on {self.plan.topic} are left out, the first: {errors[0]}"]

    @property
    def labels(self) -> tuple[str, ...]:
        """Class names of all frames."""
        return self._content[0]

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in the order of the stamps. Messages between a frame and its cloud are kept."""
        topics = {self.plan.topic, *([self.plan.cloud_topic] if self.plan.cloud_topic else [])}
        due = [(frame.stamp_ns, frame.received_ns) for frame in self.plan.frames]
        known = set(due)
        boxes: dict[tuple[int, int], Boxes] = {}
        clouds: dict[int, Raw] = {}
        index = 0
        for raw in self.bag.messages(topics):
            stamp_ns = self.bag.header(raw).stamp_ns
            if raw.topic == self.plan.topic:
                if (stamp_ns, raw.received_ns) in known:
                    boxes[stamp_ns, raw.received_ns] = self._boxes(raw, [])
            elif stamp_ns in self.plan.clouds:
                clouds[stamp_ns] = raw
            while index < len(due) and due[index] in boxes and self._complete(due[index][0], clouds):
                yield self._frame(index, boxes.pop(due[index]), clouds.get(due[index][0]))
                index += 1
                if index == len(due) or due[index][0] != due[index - 1][0]:
                    clouds.pop(due[index - 1][0], None)

    def _complete(self, stamp_ns: int, clouds: Mapping[int, Raw]) -> bool:
        return stamp_ns not in self.plan.clouds or stamp_ns in clouds

    def _frame(self, index: int, boxes: Boxes, cloud: Raw | None) -> DetectionFrame:
        planned = self.plan.frames[index]
        pose = self.plan.clouds.get(planned.stamp_ns)
        columns = {name: getattr(boxes, name) for name in DETECTION_COLUMNS}
        return DetectionFrame(
            index=index,
            stamp_ns=planned.stamp_ns,
            pose=planned.pose,
            labels=boxes.labels,
            **columns,
            cloud=None if cloud is None or pose is None else Cloud(partial(self._points, cloud), *pose),
        )

    def _boxes(self, raw: Raw, left_out: list[MessageError]) -> Boxes:
        try:
            message = self.bag.read(raw)
            errors = left_out if self._skip else None
            with damage(f"{self.bag.path} {raw.topic}", "messages of the topic's type"):
                return boxes_of(message, self._classes, covariance=self._covariance, left_out=errors)
        except MessageError as error:
            raise self.bag.wrong(raw, error, " (--option invalid=skip leaves such objects out)") from error

    def _points(self, raw: Raw) -> Points:
        try:
            with damage(f"{self.bag.path} {raw.topic}", "clouds"):
                return points_of(self.bag.read(raw))
        except MessageError as error:
            raise self.bag.wrong(raw, error) from error


class RosbagDataset(Dataset):
    """The topics of detections of one bag.

    Args:
        path: The folder or file.
        options: `points`, `odometry`, `fixed_frame`, `class.NAME`, `keep_input`, `invalid`, and `covariance`: whether
            the covariances of positions in the detections are taken for their accuracy.

    Raises:
        DatasetError: It cannot be read, has no detections, or an option is not known.
    """

    name = "rosbag"
    profile = "auto"

    def __init__(self, path: Path, options: Mapping[str, float | str]) -> None:
        texts = {name: str(value) for name, value in options.items()}
        self._classes = {name.removeprefix(_CLASS): texts.pop(name) for name in list(texts) if name.startswith(_CLASS)}
        self._keep_input = texts.pop("keep_input", "0") not in {"0", "False"}
        self._covariance = texts.pop("covariance", "0") not in {"0", "False"}
        invalid = texts.pop("invalid", "refuse")
        if invalid not in {"skip", "refuse"}:
            raise DatasetError("--option invalid", "skip or refuse", repr(invalid))
        self._skip = invalid == "skip"
        known = set(Choice.__dataclass_fields__)
        for name in texts:
            if name not in known:
                allowed = f"one of {', '.join(sorted(known))}, keep_input, covariance, invalid, class.NAME"
                raise DatasetError(f"option {name}", allowed, "an unknown option")
        self._bag = Bag(path)
        self._sequences: dict[str, RosbagSequence] = {}
        self._choice = Choice(**texts)
        self._topics = {topic.strip("/").replace("/", "."): topic for topic in detection_topics(self._bag)}

    def sequences(self, names: Sequence[str]) -> Sequence[RosbagSequence]:
        """Return the topics of these names, with dots or slashes, or `all`."""
        wanted: dict[str, None] = {}
        for name in names:
            for dotted in self._topics if name == "all" else (name.strip("/").replace("/", "."),):
                if dotted not in self._topics:
                    raise DatasetError("--sequences", f"topics of detections: {', '.join(self._topics.values())}", name)
                wanted[dotted] = None
        new = [name for name in wanted if name not in self._sequences]
        if new:
            with damage(self._bag.path, "transforms and odometry"):
                transforms = read_transforms(self._bag, self._choice)
            for name in new:
                made = plan(self._bag, self._topics[name], transforms, self._choice)
                self._sequences[name] = RosbagSequence(
                    self._bag, made, self._classes, covariance=self._covariance, skip=self._skip
                )
        return [self._sequences[name] for name in wanted]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write the bag `out` if that is an .mcap file, else `out/NAME.txt` in the format of KITTI."""
        if out.suffix == ".mcap":
            (one,) = self.sequences([sequence.name])
            return write_bag(out, one.bag, one.plan, tracks, keep_input=self._keep_input)
        return write_kitti_results(out / f"{sequence.name}.txt", synthetic_camera(), sequence.poses, tracks)

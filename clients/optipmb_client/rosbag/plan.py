"""What a bag holds for one topic of detections: its frames by stamp, their poses, and which clouds belong to them.

A frame is a message of detections. Its cloud is the one with the same stamp. Its pose is that of its frame in the fixed
frame, from tf and, for frames that have no parent there, from odometry.
"""

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from optipmb_schemas import MessageError
from optipmb_schemas.ros2.arrays import CLOUD, DETECTIONS, stamp_of
from optipmb_schemas.ros2.transforms import TransformError, Transforms

from optipmb_client.files import DatasetError
from optipmb_client.geometry import Pose
from optipmb_client.rosbag.reading import Bag, Raw

_TF: Final = "tf2_msgs/msg/TFMessage"
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_SOME: Final = 5


@dataclass(frozen=True)
class Choice:
    """What a user chooses where a bag leaves it open; empty: by the rules above."""

    points: str = ""  # topic of the clouds
    odometry: str = ""  # topic of the odometry
    fixed_frame: str = ""  # frame of the tracks; default: the one that all others hang from


class PlannedFrame(NamedTuple):
    """One message of detections."""

    stamp_ns: int
    received_ns: int
    frame: str
    pose: Pose


@dataclass
class Plan:
    """What is tracked of one topic.

    Attributes:
        topic: of the detections.
        world: name of the fixed frame.
        frames: ordered by stamp.
        clouds: pose of each cloud that belongs to a frame, by its stamp.
        cloud_topic: where they are; None where there are none.
        notes: what was left out, and why, for people.
    """

    topic: str
    world: str
    frames: list[PlannedFrame] = field(default_factory=list)
    clouds: dict[int, Pose] = field(default_factory=dict)
    cloud_topic: str | None = None
    notes: list[str] = field(default_factory=list)


def read_transforms(bag: Bag, choice: Choice) -> Transforms:
    """Return all transforms of a bag: tf, static tf, and odometry for frames without a parent in tf.

    Raises:
        DatasetError: a transform is none, or several topics tell the odometry of one frame.
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
        DatasetError: frames are not in tf, no frame has a pose, or clouds of several topics would fit.
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
        made.frames.append(PlannedFrame(head.stamp_ns, received_ns, head.frame, pose))
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
        DatasetError: there are none.
    """
    topics = bag.of_type(*DETECTIONS)
    if not topics:
        received = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.topics.items())[:20]) or "no topics"
        raise DatasetError(bag.path, f"a topic of {' or '.join(DETECTIONS)}", received)
    return topics

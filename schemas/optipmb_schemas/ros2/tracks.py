"""Tracks as ROS 2 messages: Autoware's tracked and predicted objects, `Detection3DArray`, and markers for RViz.

All in the world frame, under the name that the caller gives it. What the messages have room for:

- pose: centre of the box, rotation about z; covariance of x, y and the rotation about z. Height, roll and pitch are not
  estimated; their entries are 0.
- twist and acceleration: in the frame of the object, x forward, as Autoware has them; covariance of the speed along x
  and of the turn rate about z, and of the acceleration along x.
- predicted paths, in `PredictedObjects` alone: the box now and at the `HORIZONS`, of tracks that have paths at these.
- existence probability, box, and a UUID whose last eight bytes are the track's id, big endian, and whose first eight
  are a digest of the stream's name.
- the class with probability 1; where tracks have probabilities of classes, those above 0, the most probable first.
"""

import hashlib
import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.messages import Tracks
from optipmb_schemas.ros2.definitions import CLASS_NAMES, UNKNOWN_CLASS
from optipmb_schemas.ros2.types import Types

__all__ = ["HORIZONS", "TOPICS", "TRACKED", "has_paths", "messages"]

TRACKED: Final = "autoware_perception_msgs/msg/TrackedObjects"
DETECTION_ARRAY: Final = "vision_msgs/msg/Detection3DArray"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"

PREDICTED: Final = "autoware_perception_msgs/msg/PredictedObjects"

TOPICS: Final = {"": TRACKED, "/detections": DETECTION_ARRAY, "/markers": MARKERS, "/predicted": PREDICTED}
"""Types of the messages by what their topics' names end with, below the topic of the tracks."""

STEP_NS: Final = 500_000_000
HORIZONS: Final = tuple(step * STEP_NS / 1e9 for step in range(1, 7))
"""Of predicted paths, s: a step apart, as the messages have them."""

FACES: Final = 0.95
"""Least confidence of a heading whose sign counts as known."""

STANDING: Final = 0.3
"""Speed in m/s below which an object counts as standing, and has no arrow."""

_CLASSES: Final = {name: number for number, name in CLASS_NAMES.items()} | {"cyclist": 6, "van": 1}
"""Autoware's numbers by lower-case class names, KITTI's among them."""
_SIGN_UNKNOWN, _SIGN_KNOWN = 1, 2
_SIZE: Final = 6
_X, _Y, _SPEED, _HEADING, _TURN, _ACCELERATION = range(_SIZE)
_ADD, _DELETE_ALL = 0, 3
_ARROW, _CUBE, _TEXT = 0, 1, 9
_COLOURS: Final = (
    (0.0, 0.447, 0.698),
    (0.835, 0.369, 0.0),
    (0.0, 0.62, 0.451),
    (0.8, 0.475, 0.655),
    (0.337, 0.706, 0.914),
    (0.902, 0.624, 0.0),
    (0.549, 0.427, 0.122),
)
"""Okabe and Ito (2008): most people with a colour vision deficiency can tell them apart."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def messages(types: Types, tracks: Tracks, stamp_ns: int, frame: str, stream: str) -> Iterator[tuple[str, Any]]:
    """Yield the messages of one frame with what their topics' names end with (`TOPICS`).

    Args:
        types: makes the messages.
        tracks: the tracks, world frame.
        stamp_ns: of the detections, nanoseconds.
        frame: ROS's name of the world frame.
        stream: name of the stream; the same track of the same stream has the same UUID.
    """
    header = _header(types, stamp_ns, frame)
    objects = _Objects(types, tracks, stream)
    rows = range(len(tracks.id))
    yield "", types.new(TRACKED, header=header, objects=[objects.tracked(row) for row in rows])
    yield "/detections", detection_array(types, tracks, stamp_ns, frame)
    yield "/markers", markers(types, tracks, stamp_ns, frame)
    yield "/predicted", types.new(PREDICTED, header=header, objects=[objects.predicted(row) for row in rows])


def has_paths(tracks: Tracks) -> bool:
    """Tell whether the tracks have paths at all the `HORIZONS`; they may have them at others too."""
    return tracks.horizons is not None and set(HORIZONS) <= set(tracks.horizons.tolist())


class _Objects:
    """Makes Autoware's objects from the rows of tracks."""

    def __init__(self, types: Types, tracks: Tracks, stream: str) -> None:
        self._types = types
        self._tracks = tracks
        self._key = hashlib.blake2b(stream.encode(), digest_size=8).digest()
        self._time_step = types.new("builtin_interfaces/msg/Duration", sec=0, nanosec=STEP_NS)
        at = () if tracks.horizons is None else tracks.horizons
        self._at = np.flatnonzero(np.isin(at, HORIZONS)) if has_paths(tracks) else None
        self._package = TRACKED.rpartition("/")[0]
        confidence = getattr(tracks, "heading_confidence", None)
        self._pi = getattr(tracks, "class_probability", None)
        self._faces = np.ones(len(tracks.id), dtype=np.bool_) if confidence is None else confidence >= FACES

    def tracked(self, row: int) -> Any:
        """Return a `TrackedObject`."""
        pose, twist, acceleration = self._motion(row)
        moving = self._types.new(
            f"{self._package}/TrackedObjectKinematics",
            pose_with_covariance=pose,
            twist_with_covariance=twist,
            acceleration_with_covariance=acceleration,
            orientation_availability=_SIGN_KNOWN if self._faces[row] else _SIGN_UNKNOWN,
            is_stationary=math.hypot(*self._tracks.velocity[row].tolist()) < STANDING,
        )
        return self._types.new(f"{self._package}/TrackedObject", **self._what(row), kinematics=moving)

    def predicted(self, row: int) -> Any:
        """Return a `PredictedObject` with one path, if its track has one."""
        pose, twist, acceleration = self._motion(row)
        moving = self._types.new(
            f"{self._package}/PredictedObjectKinematics",
            initial_pose_with_covariance=pose,
            initial_twist_with_covariance=twist,
            initial_acceleration_with_covariance=acceleration,
            predicted_paths=self._paths(row),
        )
        return self._types.new(f"{self._package}/PredictedObject", **self._what(row), kinematics=moving)

    def _paths(self, row: int) -> list[Any]:
        """Return the path of a track: the box now and at each horizon."""
        tracks, types = self._tracks, self._types
        if self._at is None or tracks.path_position is None or tracks.path_yaw is None:
            return []
        *place, z = tracks.center[row].tolist()
        places = [place, *tracks.path_position[row, self._at].tolist()]
        headings = [float(tracks.yaw[row]), *tracks.path_yaw[row, self._at].tolist()]
        path = [_pose(types, [x, y, z], yaw) for (x, y), yaw in zip(places, headings, strict=True)]
        return [types.new(f"{self._package}/PredictedPath", path=path, time_step=self._time_step, confidence=1.0)]

    def _what(self, row: int) -> dict[str, Any]:
        """Return the fields that say what it is."""
        tracks, types = self._tracks, self._types
        uuid = np.frombuffer(self._key + int(tracks.id[row]).to_bytes(8, "big"), dtype=np.uint8)
        return {
            "object_id": types.new("unique_identifier_msgs/msg/UUID", uuid=uuid),
            "existence_probability": float(tracks.existence[row]),
            "classification": [
                types.new(f"{self._package}/ObjectClassification", label=number, probability=probability)
                for number, probability in self._classes(row)
            ],
            "shape": types.new(
                f"{self._package}/Shape",
                type=0,
                footprint=types.new("geometry_msgs/msg/Polygon", points=[]),
                dimensions=_vector(types, *tracks.size[row].tolist()),
            ),
        }

    def _classes(self, row: int) -> list[tuple[int, float]]:
        """Return Autoware's number and the probability of each class that the object may be of, likeliest first."""
        names, pi = self._tracks.labels, self._pi
        likely = [(int(self._tracks.label[row]), 1.0)] if pi is None else enumerate(pi[row].tolist())
        found: dict[int, float] = {}
        for c, probability in likely:
            if probability > 0.0:
                number = _CLASSES.get(names[c].lower(), UNKNOWN_CLASS)
                found[number] = found.get(number, 0.0) + probability
        return sorted(found.items(), key=lambda one: -one[1])

    def _motion(self, row: int) -> tuple[Any, Any, Any]:
        """Return pose, twist and acceleration with their covariances."""
        tracks, types = self._tracks, self._types
        covariance = tracks.covariance[row]
        yaw, (east, north) = float(tracks.yaw[row]), tracks.velocity[row].tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        pose = types.new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_pose(types, tracks.center[row].tolist(), yaw),
            covariance=_spread(covariance, {0: _X, 1: _Y, 5: _HEADING}),
        )
        twist = types.new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=types.new(
                "geometry_msgs/msg/Twist",
                linear=_vector(types, cos * east + sin * north, cos * north - sin * east, 0.0),
                angular=_vector(types, 0.0, 0.0, float(tracks.yaw_rate[row])),
            ),
            covariance=_spread(covariance, {0: _SPEED, 5: _TURN}),
        )
        acceleration = types.new(
            "geometry_msgs/msg/AccelWithCovariance",
            accel=types.new(
                "geometry_msgs/msg/Accel",
                linear=_vector(types, float(tracks.acceleration[row]), 0.0, 0.0),
                angular=_vector(types, 0.0, 0.0, 0.0),
            ),
            covariance=_spread(covariance, {0: _ACCELERATION}),
        )
        return pose, twist, acceleration


def detection_array(types: Types, tracks: Tracks, stamp_ns: int, frame: str) -> Any:
    """Return the tracks of one frame as `vision_msgs/Detection3DArray`: id as text, score, class by name."""
    header = _header(types, stamp_ns, frame)
    detections = []
    for row, identity in enumerate(tracks.id.tolist()):
        pose = _pose(types, tracks.center[row].tolist(), float(tracks.yaw[row]))
        hypothesis = types.new(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=types.new(
                "vision_msgs/msg/ObjectHypothesis",
                class_id=tracks.labels[int(tracks.label[row])],
                score=float(tracks.score[row]),
            ),
            pose=types.new(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=pose,
                covariance=_spread(tracks.covariance[row], {0: _X, 1: _Y, 5: _HEADING}),
            ),
        )
        box = types.new("vision_msgs/msg/BoundingBox3D", center=pose, size=_vector(types, *tracks.size[row].tolist()))
        one = types.new("vision_msgs/msg/Detection3D", header=header, results=[hypothesis], bbox=box, id=str(identity))
        detections.append(one)
    return types.new(DETECTION_ARRAY, header=header, detections=detections)


def markers(types: Types, tracks: Tracks, stamp_ns: int, frame: str) -> Any:
    """Return the tracks of one frame as markers: boxes, the way of the next second as arrows, class, id and existence.

    The first marker takes away all of before, so that each message shows its own frame and no other.
    """
    header = _header(types, stamp_ns, frame)
    nowhere = _pose(types, [0.0, 0.0, 0.0], 0.0)
    shown = [_marker(types, header, "", 0, _ARROW, nowhere, [0.0, 0.0, 0.0], (0.0, 0.0, 0.0), action=_DELETE_ALL)]
    for row, identity in enumerate(tracks.id.tolist()):
        number = identity % 2**31
        colour = _COLOURS[identity % len(_COLOURS)]
        (x, y, z), size = tracks.center[row].tolist(), tracks.size[row].tolist()
        pose = _pose(types, [x, y, z], float(tracks.yaw[row]))
        existence = float(tracks.existence[row])
        shown.append(_marker(types, header, "boxes", number, _CUBE, pose, size, colour, alpha=0.2 + 0.5 * existence))
        speed = math.hypot(*tracks.velocity[row].tolist())
        if speed >= STANDING:
            course = math.atan2(tracks.velocity[row, 1], tracks.velocity[row, 0])
            arrow = _pose(types, [x, y, z], course)
            shown.append(_marker(types, header, "velocity", number, _ARROW, arrow, [speed, 0.2, 0.2], colour))
        text = f"{tracks.labels[int(tracks.label[row])]} {identity} {existence:.2f}"
        above = _pose(types, [x, y, z + 0.5 * size[2] + 0.6], 0.0)
        shown.append(
            _marker(types, header, "labels", number, _TEXT, above, [0.0, 0.0, 0.8], (1.0, 1.0, 1.0), text=text)
        )
    return types.new(MARKERS, markers=shown)


def _marker(  # noqa: PLR0913  the fields of the message
    types: Types,
    header: Any,
    namespace: str,
    number: int,
    kind: int,
    pose: Any,
    scale: list[float],
    colour: tuple[float, float, float],
    *,
    alpha: float = 1.0,
    action: int = _ADD,
    text: str = "",
) -> Any:
    red, green, blue = colour
    return types.new(
        "visualization_msgs/msg/Marker",
        header=header,
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=pose,
        scale=_vector(types, *scale),
        color=types.new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        lifetime=types.new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=types.new(
            "sensor_msgs/msg/CompressedImage", header=header, format="", data=np.empty(0, dtype=np.uint8)
        ),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=types.new("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _header(types: Types, stamp_ns: int, frame: str) -> Any:
    stamp = types.new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _pose(types: Types, center: list[float], yaw: float) -> Any:
    x, y, z = center
    turn = types.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))
    return types.new(
        "geometry_msgs/msg/Pose", position=types.new("geometry_msgs/msg/Point", x=x, y=y, z=z), orientation=turn
    )


def _vector(types: Types, x: float, y: float, z: float) -> Any:
    return types.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _spread(covariance: Floats, place: dict[int, int]) -> Floats:
    """Return a row-major covariance (36,) over x, y, z and the rotations about them, from the columns of `place`."""
    full = np.zeros((_SIZE, _SIZE))
    to, of = list(place), list(place.values())
    full[np.ix_(to, to)] = covariance[np.ix_(of, of)]
    return full.ravel()

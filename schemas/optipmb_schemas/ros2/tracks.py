"""Tracks as ROS 2 messages: `TrackedObjects` of Autoware, `Detection3DArray` with ids, and markers for RViz.

All in the world frame, under the name that the caller gives it. What the messages have room for:

- pose: centre of the box, rotation about z; covariance of x, y and the rotation about z. Height, roll and pitch are not
  estimated; their entries are 0.
- twist and acceleration: in the frame of the object, x forward, as Autoware has them; covariance of the speed along x
  and of the turn rate about z, and of the acceleration along x.
- existence probability, class (probability 1: a track keeps its class), box, and a UUID whose last eight bytes are the
  track's id, big endian, and whose first eight are a digest of the stream's name.
"""

import hashlib
import math
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.ros2.definitions import CLASS_NAMES, UNKNOWN_CLASS
from optipmb_schemas.ros2.types import Types

__all__ = ["DETECTION_ARRAY", "MARKERS", "TRACKED", "TrackColumns", "detection_array", "markers", "tracked_objects"]

TRACKED: Final = "autoware_perception_msgs/msg/TrackedObjects"
DETECTION_ARRAY: Final = "vision_msgs/msg/Detection3DArray"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"

STANDING: Final = 0.3
"""Speed in m/s below which an object counts as standing, and has no arrow."""

_CLASSES: Final = {name: number for number, name in CLASS_NAMES.items()} | {"cyclist": 6, "van": 1}
"""Autoware's numbers by lower-case class names, KITTI's among them."""
_SIGN_KNOWN: Final = 2
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


class TrackColumns(Protocol):
    """The N tracks of one frame in the world frame; `optipmb_schemas.Tracks` is of this shape."""

    @property
    def id(self) -> Ints: ...  # noqa: D102 - (N,)

    @property
    def labels(self) -> tuple[str, ...]: ...  # noqa: D102 - class names

    @property
    def label(self) -> Ints: ...  # noqa: D102 - (N,) index into labels

    @property
    def center(self) -> Floats: ...  # noqa: D102 - (N, 3) m

    @property
    def size(self) -> Floats: ...  # noqa: D102 - (N, 3) length, width, height, m

    @property
    def yaw(self) -> Floats: ...  # noqa: D102 - (N,) rad

    @property
    def velocity(self) -> Floats: ...  # noqa: D102 - (N, 2) m/s

    @property
    def yaw_rate(self) -> Floats: ...  # noqa: D102 - (N,) rad/s

    @property
    def acceleration(self) -> Floats: ...  # noqa: D102 - (N,) m/s^2 along the heading

    @property
    def existence(self) -> Floats: ...  # noqa: D102 - (N,) probability

    @property
    def score(self) -> Floats: ...  # noqa: D102 - (N,) in [0, 1]

    @property
    def covariance(self) -> Floats: ...  # noqa: D102 - (N, 6, 6) of x, y, speed, heading, turn rate, acceleration


def tracked_objects(types: Types, tracks: TrackColumns, stamp_ns: int, frame: str, stream: str) -> Any:
    """Return the tracks of one frame as `autoware_perception_msgs/TrackedObjects`.

    Args:
        types: makes the messages.
        tracks: the tracks, world frame.
        stamp_ns: of the detections, nanoseconds.
        frame: ROS's name of the world frame.
        stream: name of the stream; the same track of the same stream has the same UUID.
    """
    package = TRACKED.rpartition("/")[0]
    key = hashlib.blake2b(stream.encode(), digest_size=8).digest()
    objects = []
    for row, identity in enumerate(tracks.id.tolist()):
        covariance = tracks.covariance[row]
        yaw, (east, north) = float(tracks.yaw[row]), tracks.velocity[row].tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        moving = types.new(
            f"{package}/TrackedObjectKinematics",
            pose_with_covariance=types.new(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=_pose(types, tracks.center[row].tolist(), yaw),
                covariance=_spread(covariance, {0: _X, 1: _Y, 5: _HEADING}),
            ),
            twist_with_covariance=types.new(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=types.new(
                    "geometry_msgs/msg/Twist",
                    linear=_vector(types, cos * east + sin * north, cos * north - sin * east, 0.0),
                    angular=_vector(types, 0.0, 0.0, float(tracks.yaw_rate[row])),
                ),
                covariance=_spread(covariance, {0: _SPEED, 5: _TURN}),
            ),
            acceleration_with_covariance=types.new(
                "geometry_msgs/msg/AccelWithCovariance",
                accel=types.new(
                    "geometry_msgs/msg/Accel",
                    linear=_vector(types, float(tracks.acceleration[row]), 0.0, 0.0),
                    angular=_vector(types, 0.0, 0.0, 0.0),
                ),
                covariance=_spread(covariance, {0: _ACCELERATION}),
            ),
            orientation_availability=_SIGN_KNOWN,
            is_stationary=math.hypot(east, north) < STANDING,
        )
        number = _CLASSES.get(tracks.labels[int(tracks.label[row])].lower(), UNKNOWN_CLASS)
        uuid = np.frombuffer(key + identity.to_bytes(8, "big"), dtype=np.uint8)
        objects.append(
            types.new(
                f"{package}/TrackedObject",
                object_id=types.new("unique_identifier_msgs/msg/UUID", uuid=uuid),
                existence_probability=float(tracks.existence[row]),
                classification=[types.new(f"{package}/ObjectClassification", label=number, probability=1.0)],
                kinematics=moving,
                shape=types.new(
                    f"{package}/Shape",
                    type=0,
                    footprint=types.new("geometry_msgs/msg/Polygon", points=[]),
                    dimensions=_vector(types, *tracks.size[row].tolist()),
                ),
            )
        )
    return types.new(TRACKED, header=_header(types, stamp_ns, frame), objects=objects)


def detection_array(types: Types, tracks: TrackColumns, stamp_ns: int, frame: str) -> Any:
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


def markers(types: Types, tracks: TrackColumns, stamp_ns: int, frame: str) -> Any:
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

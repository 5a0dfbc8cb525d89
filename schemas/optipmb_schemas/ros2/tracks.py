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
- in `Detection3DArray`: the id as text, the score, the class by name.
- markers: boxes, the way of the next second as arrows, class, id and existence. The first marker clears
  earlier frames.
"""

import hashlib
import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.messages import Tracks
from optipmb_schemas.ros2.types import Types

__all__ = ["CLASS_NAMES", "HORIZONS", "TOPICS", "TRACKED", "has_paths", "header_of", "messages"]

TRACKED: Final = "autoware_perception_msgs/msg/TrackedObjects"
DETECTION_ARRAY: Final = "vision_msgs/msg/Detection3DArray"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
PREDICTED: Final = "autoware_perception_msgs/msg/PredictedObjects"

TOPICS: Final = {"": TRACKED, "/detections": DETECTION_ARRAY, "/markers": MARKERS, "/predicted": PREDICTED}
"""Types of the messages by what their topics' names end with, below the topic of the tracks."""

_NAMED: Final = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian")
CLASS_NAMES: Final = dict(enumerate((*_NAMED, "animal", "hazard", "over_drivable", "under_drivable"), 1))
"""Autoware's numbers of classes (`ObjectClassification.label`) by name; older versions lack those from 8 on."""

STEP_NS: Final = 500_000_000
HORIZONS: Final = tuple(step * STEP_NS / 1e9 for step in range(1, 7))
"""Of predicted paths, s: a step apart, as the messages have them."""

FACES: Final = 0.95
"""Least confidence of a heading whose sign counts as known."""

STANDING: Final = 0.3
"""Speed in m/s below which an object counts as standing, and has no arrow."""

_CLASSES: Final = {name: number for number, name in CLASS_NAMES.items()} | {"cyclist": 6, "van": 1}
"""Autoware's numbers by lower-case class names, KITTI's among them; 0 is unknown."""
_UNAVAILABLE, _SIGN_UNKNOWN, _SIGN_KNOWN = 0, 1, 2
_SIZE: Final = 6
_X, _Y, _SPEED, _HEADING, _TURN, _ACCELERATION = range(_SIZE)
_DELETE_ALL: Final = 3
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

Fields = dict[str, Any]


def messages(types: Types, tracks: Tracks, stamp_ns: int, frame: str, stream: str) -> Iterator[tuple[str, Any]]:
    """Yield the messages of one frame with what their topics' names end with (`TOPICS`).

    Args:
        types: makes the messages.
        tracks: the tracks, world frame.
        stamp_ns: of the detections, nanoseconds.
        frame: ROS's name of the world frame.
        stream: name of the stream; the same track of the same stream has the same UUID.
    """
    header = header_of(stamp_ns, frame)
    key = hashlib.blake2b(stream.encode(), digest_size=8).digest()
    at = np.flatnonzero(np.isin(tracks.horizons, HORIZONS)) if has_paths(tracks) else None  # type: ignore[arg-type]  # then it has horizons
    found: dict[str, list[Fields]] = {end: [] for end in TOPICS}
    stamped = {"header": header, "texture": {"header": header}}
    clear = {"action": _DELETE_ALL, "pose": _pose([0.0, 0.0, 0.0], 0.0), "color": {"a": 1.0}}
    found["/markers"].append(stamped | clear)
    for row in range(len(tracks.id)):
        objects = _object(tracks, row, key)
        pose, twist, acceleration = _motion(tracks, row)
        tracked: Fields = {"pose_with_covariance": pose, "twist_with_covariance": twist}
        tracked |= {"acceleration_with_covariance": acceleration}
        predicted = {f"initial_{name}": value for name, value in tracked.items()}
        found["/predicted"].append(objects | {"kinematics": predicted | {"predicted_paths": _paths(tracks, row, at)}})
        confidence = getattr(tracks, "heading_confidence", None)
        faces = confidence is None or confidence[row] >= FACES
        known = getattr(tracks, "measured", None)
        unavailable = known is not None and not int(known[row]) & 1
        tracked |= {
            "orientation_availability": _UNAVAILABLE if unavailable else _SIGN_KNOWN if faces else _SIGN_UNKNOWN,
            "is_stationary": math.hypot(*tracks.velocity[row].tolist()) < STANDING,
        }
        found[""].append(objects | {"kinematics": tracked})
        found["/detections"].append(_detection(tracks, row, pose) | {"header": header})
        found["/markers"] += [stamped | one for one in _markers(tracks, row)]
    yield "", types.new(TRACKED, header=header, objects=found[""])
    yield "/detections", types.new(DETECTION_ARRAY, header=header, detections=found["/detections"])
    yield "/markers", types.new(MARKERS, markers=found["/markers"])
    yield "/predicted", types.new(PREDICTED, header=header, objects=found["/predicted"])


def has_paths(tracks: Tracks) -> bool:
    """Tell whether the tracks have paths at all the `HORIZONS`; they may have them at others too."""
    return tracks.horizons is not None and set(HORIZONS) <= set(tracks.horizons.tolist())


def header_of(stamp_ns: int, frame: str) -> Fields:
    """Return a header as a map."""
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _object(tracks: Tracks, row: int, key: bytes) -> Fields:
    """Return the fields that tracked and predicted objects share."""
    pi = getattr(tracks, "class_probability", None)
    likely = [(int(tracks.label[row]), 1.0)] if pi is None else enumerate(pi[row].tolist())
    classes: dict[int, float] = {}
    for c, probability in likely:
        if probability > 0.0:
            number = _CLASSES.get(tracks.labels[c].lower(), 0)
            classes[number] = classes.get(number, 0.0) + probability
    by_probability = sorted(classes.items(), key=lambda one: -one[1])
    objects = getattr(tracks, "object", None)
    identity = int(tracks.id[row] if objects is None or objects[row] < 0 else objects[row])
    return {
        "object_id": {"uuid": np.frombuffer(key + identity.to_bytes(8, "big"), np.uint8)},
        "existence_probability": float(tracks.existence[row]),
        "classification": [{"label": number, "probability": probability} for number, probability in by_probability],
        "shape": {"dimensions": _vector(tracks.size[row].tolist())},
    }


def _motion(tracks: Tracks, row: int) -> tuple[Fields, Fields, Fields]:
    """Return pose, twist and acceleration with their covariances."""
    covariance = tracks.covariance[row]
    yaw, (east, north) = float(tracks.yaw[row]), tracks.velocity[row].tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    pose = {
        "pose": _pose(tracks.center[row].tolist(), yaw),
        "covariance": _spread(covariance, {0: _X, 1: _Y, 5: _HEADING}),
    }
    twist = {
        "twist": {
            "linear": _vector([cos * east + sin * north, cos * north - sin * east, 0.0]),
            "angular": {"z": float(tracks.yaw_rate[row])},
        },
        "covariance": _spread(covariance, {0: _SPEED, 5: _TURN}),
    }
    acceleration = {
        "accel": {"linear": {"x": float(tracks.acceleration[row])}},
        "covariance": _spread(covariance, {0: _ACCELERATION}),
    }
    return pose, twist, acceleration


def _paths(tracks: Tracks, row: int, at: NDArray[np.int64] | None) -> list[Fields]:
    """Return the path of a track: the box now and at each horizon."""
    if at is None or tracks.path_position is None or tracks.path_yaw is None:
        return []
    *place, z = tracks.center[row].tolist()
    places = [place, *tracks.path_position[row, at].tolist()]
    headings = [float(tracks.yaw[row]), *tracks.path_yaw[row, at].tolist()]
    path = [_pose([x, y, z], yaw) for (x, y), yaw in zip(places, headings, strict=True)]
    return [{"path": path, "time_step": {"nanosec": STEP_NS}, "confidence": 1.0}]


def _detection(tracks: Tracks, row: int, pose: Fields) -> Fields:
    score = {"class_id": tracks.labels[int(tracks.label[row])], "score": float(tracks.score[row])}
    box = {"center": pose["pose"], "size": _vector(tracks.size[row].tolist())}
    return {"results": [{"hypothesis": score, "pose": pose}], "bbox": box, "id": str(int(tracks.id[row]))}


def _markers(tracks: Tracks, row: int) -> Iterator[Fields]:
    """Yield the markers of a track."""
    identity, existence = int(tracks.id[row]), float(tracks.existence[row])
    (x, y, z), size, velocity = tracks.center[row].tolist(), tracks.size[row].tolist(), tracks.velocity[row].tolist()
    colour = dict(zip("rgb", _COLOURS[identity % len(_COLOURS)], strict=True))
    one = {"id": identity % 2**31, "color": colour | {"a": 1.0}}
    box = {"ns": "boxes", "type": _CUBE, "pose": _pose([x, y, z], float(tracks.yaw[row])), "scale": _vector(size)}
    yield one | box | {"color": colour | {"a": 0.2 + 0.5 * existence}}
    if (speed := math.hypot(*velocity)) >= STANDING:
        course = _pose([x, y, z], math.atan2(velocity[1], velocity[0]))
        yield one | {"ns": "velocity", "type": _ARROW, "pose": course, "scale": _vector([speed, 0.2, 0.2])}
    text = f"{tracks.labels[int(tracks.label[row])]} {identity} {existence:.2f}"
    label = {"ns": "labels", "type": _TEXT, "pose": _pose([x, y, z + 0.5 * size[2] + 0.6], 0.0), "scale": {"z": 0.8}}
    yield one | label | {"color": dict.fromkeys("rgba", 1.0), "text": text}


def _pose(center: list[float], yaw: float) -> Fields:
    return {"position": _vector(center), "orientation": {"z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}}


def _vector(xyz: list[float]) -> Fields:
    return dict(zip("xyz", xyz, strict=True))


def _spread(covariance: NDArray[np.float64], place: dict[int, int]) -> NDArray[np.float64]:
    """Return a row-major covariance (36,) over x, y, z and the rotations about them, from the columns of `place`."""
    full = np.zeros((_SIZE, _SIZE))
    to, of = list(place), list(place.values())
    full[np.ix_(to, to)] = covariance[np.ix_(of, of)]
    return full.ravel()

"""ROS 2 messages of a sensor as arrays: detections, point clouds, stamps.

Metres, radians, nanoseconds. Coordinates stay in the frame that the message names (`header.frame_id`). An error names
the field of the message, as `detections[3].bbox.size.x`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.ros2.tracks import CLASS_NAMES, DETECTION_ARRAY
from optipmb_schemas.ros2.types import AUTOWARE

__all__ = ["CLOUD", "DETECTIONS", "Boxes", "boxes_of", "frame_of", "points_of", "stamp_of"]

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
DETECTIONS: Final = (DETECTION_ARRAY, *(f"{package}/DetectedObjects" for package in AUTOWARE))
"""Types of messages that hold detections."""

_FLOATS: Final = {7: "f4", 8: "f8"}
"""Number types of `sensor_msgs/PointField` that coordinates may have."""
_BOX, _CYLINDER, _POLYGON = 0, 1, 2
_NORM: Final = 1e-2
"""How far the norm of a quaternion may be from one: some detectors write 32-bit numbers."""
_SECOND: Final = 10**9
_UNKNOWN: Final = (0.0,) * 36
"""The covariance of an unknown pose, row by row."""


@dataclass(frozen=True)
class Boxes:
    """The M detected objects of one message, in its frame; columns as in `optipmb_schemas.Detections`."""

    labels: tuple[str, ...]
    label: NDArray[np.int64]
    """(M,) index into `labels`."""
    center: NDArray[np.float64]
    """(M, 3) m."""
    size: NDArray[np.float64]
    """(M, 3) length, width, height, m; NaN where unknown, 0 in the message."""
    yaw: NDArray[np.float64]
    """(M,) rad; NaN where unknown: a quaternion of zeros, or `orientation_availability` is `UNAVAILABLE`."""
    score: NDArray[np.float64]
    """(M,) in [0, 1]; an object of score 0 is left out and counted by the service."""
    velocity: NDArray[np.float64] | None
    """(M, 2) over ground along x and y of the frame, m/s; rows of NaN, or None for all, where unknown."""
    position_covariance: NDArray[np.float64] | None = None
    """(M, 3, 3) m^2; matrices of NaN, or None for all, where it is unknown or was not asked for."""


def stamp_of(header: Any) -> int:
    """Return the stamp of a header in nanoseconds.

    Raises:
        MessageError: it is negative, or its nanoseconds are a second or more.
    """
    second, rest = int(header.stamp.sec), int(header.stamp.nanosec)
    if second < 0 or rest >= _SECOND:
        raise invalid("header.stamp", "seconds from 0 and nanoseconds below 10^9", f"{second}, {rest}")
    return second * _SECOND + rest


def frame_of(header: Any) -> str:
    """Return the frame of a header without the leading slash that older systems write."""
    return str(header.frame_id).removeprefix("/")


def boxes_of(
    message: Any,
    classes: Mapping[str, str] | None = None,
    *,
    covariance: bool = False,
    left_out: list[MessageError] | None = None,
) -> Boxes:
    """Return the objects of a message of one of the types `DETECTIONS`.

    Of several classes of an object the likeliest counts. The score is `hypothesis.score`, or, in Autoware's messages,
    `existence_probability`, and where a detector leaves that at 0 the probability of the class.

    Args:
        message: the message.
        classes: names of classes by those in the message; others stay as they are.
        covariance: whether the covariances of positions are read. One of zeros is unknown, and so is one that a message
            of Autoware says it does not have.
        left_out: gets the errors of objects that cannot be used, which are left out; None: the first one is raised.

    Raises:
        MessageError: a value is not allowed; the path names it.
    """
    vision = hasattr(message, "detections")
    rows: list[_Box] = []
    for i, one in enumerate(message.detections if vision else message.objects):
        try:
            rows.append(_of_vision(i, one) if vision else _of_autoware(i, one))
        except MessageError as error:
            if left_out is None:
                raise
            left_out.append(error)
    names = [(classes or {}).get(row.label, row.label) for row in rows]
    labels = tuple(dict.fromkeys(names))
    velocity = np.array([row.velocity for row in rows], dtype=np.float64).reshape(-1, 2)
    spread = np.array([row.covariance for row in rows], dtype=np.float64).reshape(-1, 6, 6)[:, :3, :3].copy()
    spread[~spread.any(axis=(1, 2))] = np.nan
    return Boxes(
        labels=labels,
        label=np.array([labels.index(name) for name in names], dtype=np.int64),
        center=np.array([row.center for row in rows], dtype=np.float64).reshape(-1, 3),
        size=np.array([row.size for row in rows], dtype=np.float64).reshape(-1, 3),
        yaw=np.array([row.yaw for row in rows], dtype=np.float64),
        score=np.array([row.score for row in rows], dtype=np.float64),
        velocity=None if np.isnan(velocity).all() else velocity,
        position_covariance=spread if covariance and not np.isnan(spread).all() else None,
    )


def points_of(message: Any) -> NDArray[np.float32]:
    """Return the points (P, 3) of a `PointCloud2`; those without a return are left out.

    Raises:
        MessageError: it has no x, y and z of 32 or 64 bits, or its sizes contradict each other.
    """
    height, width = int(message.height), int(message.width)
    step, row = int(message.point_step), int(message.row_step)
    order = ">" if message.is_bigendian else "<"
    fields = {str(field.name): field for field in message.fields}
    formats, offsets = [], []
    for name in "xyz":
        field = fields.get(name)
        if field is None or int(field.datatype) not in _FLOATS:
            received = "none" if field is None else f"datatype {field.datatype}"
            raise invalid("fields", f"{name} of 32 or 64 bits (datatype 7 or 8)", received)
        formats.append(order + _FLOATS[int(field.datatype)])
        offsets.append(int(field.offset))
        if offsets[-1] + np.dtype(formats[-1]).itemsize > step:
            raise invalid("point_step", f"room for {name} at offset {offsets[-1]}", step)
    if height and width and (row < step * width or len(message.data) < row * height):
        raise invalid("data", f"{height} rows of {row} bytes with {width} points of {step}", message.data)
    point = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step})
    shape, strides = (height, width), (row, step)
    grid: NDArray[Any] = np.ndarray(shape, point, np.ascontiguousarray(message.data), strides=strides)
    xyz = np.empty((height * width, 3), dtype=np.float32)
    for column, name in enumerate("xyz"):
        xyz[:, column] = grid[name].ravel()
    finite = np.isfinite(xyz).all(axis=1)
    return xyz if finite.all() else np.ascontiguousarray(xyz[finite])


@dataclass(frozen=True)
class _Box:
    label: str
    center: Sequence[float]
    size: Sequence[float]
    yaw: float
    score: float
    covariance: Sequence[float]
    velocity: Sequence[float] = (math.nan, math.nan)


def _of_vision(number: int, detection: Any) -> _Box:
    path = f"detections[{number}]"
    if not detection.results:
        raise invalid(f"{path}.results", "at least one hypothesis", "none")
    result: Any = max(detection.results, key=lambda one: float(_hypothesis(one).score))
    best = _hypothesis(result)
    box = detection.bbox
    return _Box(
        label=str(best.class_id if hasattr(best, "class_id") else best.id),
        center=_vector(f"{path}.bbox.center.position", box.center.position),
        size=_size(f"{path}.bbox.size", box.size),
        yaw=_yaw(f"{path}.bbox.center.orientation", box.center.orientation),
        score=_score(f"{path}.results.hypothesis.score", float(best.score)),
        covariance=_covariance(f"{path}.results.pose.covariance", result.pose.covariance),
    )


def _hypothesis(result: Any) -> Any:
    """Return the object with class and score; versions before 4 of vision_msgs have no hypothesis around them."""
    return getattr(result, "hypothesis", result)


def _of_autoware(number: int, detected: Any) -> _Box:
    path = f"objects[{number}]"
    if not detected.classification:
        raise invalid(f"{path}.classification", "at least one class", "none")
    best = max(detected.classification, key=lambda one: float(one.probability))
    kinematics = detected.kinematics
    pose, where = kinematics.pose_with_covariance.pose, f"{path}.kinematics.pose_with_covariance.pose"
    yaw = _yaw(f"{where}.orientation", pose.orientation)
    center, size = _shape(f"{path}.shape", detected.shape, _vector(f"{where}.position", pose.position), yaw)
    score = float(detected.existence_probability) or float(best.probability)
    velocity = (math.nan, math.nan)
    if kinematics.has_twist:
        twist = f"{path}.kinematics.twist_with_covariance.twist.linear"
        along, across, _ = _vector(twist, kinematics.twist_with_covariance.twist.linear)
        turn = 0.0 if math.isnan(yaw) else yaw  # the twist is in the frame of the object
        cos, sin = math.cos(turn), math.sin(turn)
        velocity = (cos * along - sin * across, sin * along + cos * across)
    return _Box(
        label=CLASS_NAMES.get(int(best.label), "unknown"),
        center=center,
        size=size,
        yaw=yaw if kinematics.orientation_availability else math.nan,
        score=_score(f"{path}.existence_probability", score),
        covariance=_covariance(f"{where}.covariance", kinematics.pose_with_covariance.covariance)
        if kinematics.has_position_covariance
        else _UNKNOWN,
        velocity=velocity,
    )


def _shape(path: str, shape: Any, center: list[float], yaw: float) -> tuple[list[float], list[float]]:
    """Return the centre and size of the upright box around a shape that stands at `center` with `yaw`."""
    kind = int(shape.type)
    if kind == _BOX:
        return center, _size(f"{path}.dimensions", shape.dimensions)
    if kind == _CYLINDER:
        diameter, _, height = _vector(f"{path}.dimensions", shape.dimensions)
        if not (diameter > 0 and height > 0):
            raise invalid(f"{path}.dimensions", "a positive diameter (x) and height (z)", f"{diameter:g}, {height:g}")
        return center, [diameter, diameter, height]
    if kind != _POLYGON:
        raise invalid(f"{path}.type", "0 (box), 1 (cylinder) or 2 (polygon)", kind)
    height = _vector(f"{path}.dimensions", shape.dimensions)[2]
    corners = np.array([_vector(f"{path}.footprint", point)[:2] for point in shape.footprint.points])
    if len(corners) < 3 or not height > 0:  # noqa: PLR2004 - a polygon
        raise invalid(f"{path}.footprint", "three corners or more, and a height in dimensions.z", len(corners))
    low, high = corners.min(axis=0), corners.max(axis=0)
    length, width = (high - low).tolist()
    along, across = ((high + low) / 2).tolist()
    turn = 0.0 if math.isnan(yaw) else yaw
    cos, sin = math.cos(turn), math.sin(turn)
    moved = [center[0] + cos * along - sin * across, center[1] + sin * along + cos * across, center[2]]
    return moved, [length, width, height]


def _vector(path: str, value: Any) -> list[float]:
    vector = [float(value.x), float(value.y), float(value.z)]
    for axis, number in zip("xyz", vector, strict=True):
        if not math.isfinite(number):
            raise invalid(f"{path}.{axis}", "a finite number", number)
    return vector


def _size(path: str, value: Any) -> list[float]:
    size = _vector(path, value)
    for axis, number in zip("xyz", size, strict=True):
        if number < 0:
            raise invalid(f"{path}.{axis}", "a positive length, or 0 where unknown", number)
    return [number or math.nan for number in size]


def _covariance(path: str, value: Any) -> Sequence[float]:
    if len(value) != len(_UNKNOWN):
        raise invalid(path, f"{len(_UNKNOWN)} numbers", len(value))
    covariance: list[float] = np.asarray(value, np.float64).tolist()
    return covariance


def _score(path: str, value: float) -> float:
    if not 0 <= value <= 1:
        raise invalid(path, "a score in [0, 1]", value)
    return value


def _yaw(path: str, value: Any) -> float:
    """Return the direction of the x axis of a rotation, seen from above; NaN of a quaternion of zeros."""
    w, x, y, z = float(value.w), float(value.x), float(value.y), float(value.z)
    if w == x == y == z == 0.0:
        return math.nan
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1) <= _NORM:
        raise invalid(path, "a unit quaternion", f"norm {norm:.6g}")
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)

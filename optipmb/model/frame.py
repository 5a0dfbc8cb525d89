"""A frame: what the tracker is given at one stamp, already checked, in the world frame.

Conventions: the world frame is fixed, right-handed, z up; metres, seconds, radians; yaw counter-clockwise from x. A
box is its geometric centre, its size (length along the heading, width, height) and its yaw. A sensor's pose maps its
coordinates to the world.

A score of 0.4 is a sure object for one detector and a doubtful one for another. A class of the profile may carry a
curve c, through which every score z_s goes before anything reads it, the score filter included:

    z_s <- c(z_s),   c(0) = 0,   c(d_i) = s_i,   c(1) = 1,   straight in between

where d (`detector`) and s (`calibrated`) ascend strictly within (0, 1): the order of detections stays, and no ties are
made.

R of a class has sigma^2 for x and for y (eq. Single Object Measurement Model). A detection may bring a covariance of
its own, R_xy (not in the paper), kept as rho = R_xy / sigma^2 in the columns behind a measured position. S = P_xy +
sigma^2 rho, R has sigma^2 rho, and P^0 and R_x of `optipmb.filter.calibration` have their variances of x and y times
rho. The gate widens by the larger variance that rho adds (`optipmb.filter.hypotheses.gate_widening`). Without a curve
and with rho = I everything is as without, to the last bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, Self

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.attributes import readings_of
from optipmb.model.class_names import class_indices
from optipmb.model.errors import FrameError
from optipmb.model.lost_objects import EMBEDDING
from optipmb.model.rows import read_only

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from optipmb.model.attributes import Readings
    from optipmb.model.parameters import Parameters, ScoreCalibration
    from optipmb.model.rows import Array, Index

SHORTEST: Final = 1e-6
"""Least length of one."""
LONGEST_MODEL: Final = 64
"""Most characters of the name of a model."""
UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from one; it is normalised afterwards."""

NARROWEST: Final = 1e-3
"""Least width of an interval of angles, rad."""

FARTHEST: Final = 1e9
"""Largest range, m: more than any two coordinates are apart."""

TURN_TOLERANCE: Final = 1e-9
"""By how much an interval may be wider than the full turn, rad."""

_NO_LIMIT: Final = 2.0
"""No sine and no cosine is larger."""

MAX_YAW: Final = 6.4
"""Largest yaw, rad: a turn, and what rounding adds."""
MAX_COORDINATE = 1e8
"""Coordinates beyond this (metres) are not positions on Earth; the limit keeps squares far from overflow."""

MAX_SPEED = 1e3
"""No object on a road is faster (m/s); squared, such a velocity would drown a covariance."""


@dataclass(frozen=True)
class Pose:
    """World from sensor: ``world = rotation @ sensor + translation``.

    Attributes:
        translation: (3,) float64, m.
        quaternion: (4,) float64, unit, w x y z.

    Its arrays cannot be written to: many frames may share a pose.

    Raises:
        FrameError: wrong shape, not finite, or no unit quaternion.
    """

    translation: Array
    quaternion: Array

    def __post_init__(self) -> None:
        translation = _shaped("pose.translation", self.translation, (3,))
        quaternion = _shaped("pose.quaternion", self.quaternion, (4,))
        # Comparing a few numbers one by one is faster than as an array; the array names the wrong one.
        w, x, y, z = quaternion.tolist()
        if not all(abs(value) <= MAX_COORDINATE for value in translation.tolist()):
            _bounded("pose.translation", translation, MAX_COORDINATE)
        if not all(abs(value) <= 2.0 for value in (w, x, y, z)):  # noqa: PLR2004 - no unit quaternion is near
            _bounded("pose.quaternion", quaternion, 2.0)
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise FrameError("pose.quaternion", "a unit quaternion (w, x, y, z)", f"norm {norm:.6g}")
        self.__dict__.update(translation=translation, quaternion=read_only(quaternion / norm))

    @property
    def is_identity(self) -> bool:
        """Whether sensor and world have the same coordinates, exactly."""
        return self.translation.tolist() == [0.0] * 3 and self.quaternion.tolist() in _UNTURNED

    @cached_property
    def rotation(self) -> Array:
        """Rotation matrix (3, 3) of the quaternion."""
        w, x, y, z = self.quaternion.tolist()
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return read_only(np.array(rows))


_UNTURNED: Final = ([1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0])
"""The quaternions of no rotation."""


class Intervals(Protocol):
    """A field of view in another form, as messages have it."""

    @property
    def azimuth(self) -> Array:
        """(2,) rad."""

    @property
    def elevation(self) -> Array:
        """(2,) rad."""

    @property
    def range(self) -> Array:
        """(2,) m."""


@dataclass(frozen=True)
class FieldOfView:
    """Where a sensor detects objects; `azimuth`, `elevation` and `range` are intervals, each a pair.

    Attributes:
        azimuth: from, to, rad in [-2 pi, 2 pi]: the sector counter-clockwise from the one to the other, so that
            (2.5, -2.5) looks backwards. (-pi, pi), the default, is the full circle.
        elevation: from, to, rad in [-pi/2, pi/2].
        range: from, to, m in [0, 1e9].
        pose: world from sensor; None: the `pose` given to `make_frame`, else the axes of the world.

    Raises:
        FrameError: an interval is none, not finite, beyond its bounds, or narrower than a milliradian.
    """

    azimuth: tuple[float, float] = (-math.pi, math.pi)
    elevation: tuple[float, float] = (-0.5 * math.pi, 0.5 * math.pi)
    range: tuple[float, float] = (0.0, FARTHEST)
    pose: Pose | None = None

    def __post_init__(self) -> None:
        bounds = (
            ("azimuth", -2.0 * math.pi, 2.0 * math.pi),
            ("elevation", -0.5 * math.pi, 0.5 * math.pi),
            ("range", 0.0, FARTHEST),
        )
        for name, low, high in bounds:
            object.__setattr__(self, name, _interval(name, getattr(self, name), low, high))
        if not self.elevation[1] - self.elevation[0] >= NARROWEST:
            raise FrameError(
                "field_of_view.elevation", f"an end at least {NARROWEST:g} above the beginning", str(self.elevation)
            )
        if not self.range[1] > self.range[0]:
            raise FrameError("field_of_view.range", "an end beyond the beginning", str(self.range))
        if not NARROWEST <= self.width <= 2.0 * math.pi + TURN_TOLERANCE:
            raise FrameError(
                "field_of_view.azimuth", f"a sector of {NARROWEST:g} rad to a full turn", str(self.azimuth)
            )

    @classmethod
    def of(cls, view: Intervals | None, pose: Pose | None) -> Self | None:
        """Return one of the same intervals, None where there is none.

        Raises:
            FrameError: an interval is none.
        """
        if view is None:
            return None
        azimuth, elevation, distance = ((one[0], one[1]) for one in (view.azimuth, view.elevation, view.range))
        return cls(azimuth, elevation, distance, pose)

    def at(self, pose: Pose) -> Self:
        """Return the same intervals with a pose of the sensor."""
        placed = object.__new__(type(self))
        placed.__dict__.update(self.__dict__, pose=pose)
        return placed

    @property
    def width(self) -> float:
        """Width of the sector of azimuth, rad."""
        begin, end = self.azimuth
        return end - begin if end >= begin else end - begin + 2.0 * math.pi

    @cached_property
    def limits(self) -> Array:
        """The intervals as `shares_in_view` compares them, (7,).

        The direction (2,) of the middle of the sector, the cosine of half its width; the sines of the elevations; the
        ranges. An interval that holds all angles has limits that no rounding reaches.
        """
        middle = self.azimuth[0] + 0.5 * self.width
        full = self.width >= 2.0 * math.pi - TURN_TOLERANCE
        low, high = self.elevation
        return np.array(
            [
                math.cos(middle),
                math.sin(middle),
                -_NO_LIMIT if full else math.cos(0.5 * self.width),
                -_NO_LIMIT if low <= -0.5 * math.pi + TURN_TOLERANCE else math.sin(low),
                _NO_LIMIT if high >= 0.5 * math.pi - TURN_TOLERANCE else math.sin(high),
                *self.range,
            ]
        )


def check_view(view: object) -> None:
    """Raise a `FrameError` unless it is a field of view or None."""
    if view is not None and not isinstance(view, FieldOfView):
        raise FrameError("field_of_view", "a FieldOfView or None", type(view).__name__)


def _interval(name: str, values: object, low: float, high: float) -> tuple[float, float]:
    path, expected = f"field_of_view.{name}", f"two numbers from {low:g} to {high:g}"
    try:
        given = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FrameError(path, expected, repr(values)[:80]) from error
    # A float32 of the limit may be a little beyond it.
    if given.shape != (2,) or not ((given >= low - 1e-6) & (given <= high + 1e-6)).all():
        raise FrameError(path, expected, repr(values)[:80])
    begin, end = np.clip(given, low, high).tolist()
    return begin, end


@dataclass(frozen=True)
class PointCloud:
    """A LiDAR scan.

    Attributes:
        xyz: (P, 3) float32 in the sensor frame, m; read where it lies, never copied or written. Points that are not
            finite are in no box.
        pose: world from sensor at the stamp of the frame.

    Raises:
        FrameError: wrong shape or dtype.
    """

    xyz: NDArray[np.float32]
    pose: Pose

    def __post_init__(self) -> None:
        if not isinstance(self.xyz, np.ndarray):
            raise FrameError("cloud.xyz", "(P, 3) float32", type(self.xyz).__name__)
        if self.xyz.dtype != np.float32 or self.xyz.ndim != 2 or self.xyz.shape[1] != 3:  # noqa: PLR2004 - x, y, z
            raise FrameError("cloud.xyz", "(P, 3) float32", f"{self.xyz.shape} {self.xyz.dtype}")
        # A read-only view: one type for the kernels whether the points came from a file or lie in a message.
        view = np.ascontiguousarray(self.xyz).view()
        view.flags.writeable = False
        object.__setattr__(self, "xyz", view)


class Embedding(NamedTuple):
    """Appearance of the detections of a frame.

    Attributes:
        model: name and version of the model.
        vectors: (M, E) float32; a row of NaN where unknown.
    """

    model: str
    vectors: NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """Detections of one stamp in the world frame; made by `make_frame`, which checks and copies them.

    Attributes:
        stamp_ns: sensor time, nanoseconds.
        center: (M, 3) m.
        size: (M, 3) length, width, height, m; NaN where unknown, as is the z of a centre.
        yaw: (M,) rad; NaN where unknown.
        velocity: (M, 2) over ground, m/s; a row of NaN where the detector gives none.
        score: (M,) in (0, 1]; what the thresholds of the class mean by it (`optipmb.model.frame`).
        label: (M,) int64, index into the classes of the parameters.
        source: (M,) int64, index of the object in the arrays that the caller gave.
        labels: names of the classes of the parameters, which `label` points into.
        cloud: the scan of the same stamp, or None.
        field_of_view: of the sensor, with its pose; None: it sees everything.
        position_covariance: (M, 3) R_xx, R_xy and R_yy of each position, m^2; NaN, or None: R of the class.
        pose: world from sensor; None: the sensor stands at the origin of the world.
        embedding: appearance of the detections; None: unknown.
        readings: attributes of the detections; None: unknown.

    The arrays cannot be written to, so that they stay as they were checked.

    Raises:
        FrameError: wrong shapes, types or values.
    """

    stamp_ns: int
    center: Array
    size: Array
    yaw: Array
    velocity: Array
    score: Array
    label: Index
    source: Index
    labels: tuple[str, ...]
    cloud: PointCloud | None = None
    field_of_view: FieldOfView | None = None
    position_covariance: Array | None = None
    pose: Pose | None = None
    embedding: Embedding | None = None
    readings: Readings | None = None

    def __post_init__(self) -> None:
        count = np.shape(self.score)[0] if np.ndim(self.score) == 1 else 0
        arrays = {name: _shaped(name, getattr(self, name), (count, *shape)) for name, shape in _COLUMNS}
        indices = {name: _integers(name, getattr(self, name)) for name in ("label", "source")}
        for name, index in indices.items():
            if index.shape != (count,):
                raise FrameError(name, f"shape ({count},)", str(index.shape))
        if self.position_covariance is not None:
            column = _shaped("position_covariance", self.position_covariance, (count, 3))
            _all("position_covariance", semidefinite(column), "a covariance R_xx, R_xy, R_yy, or NaN alone", column)
            arrays["position_covariance"] = column
        if self.embedding is not None:
            checked = embedding_of(self.embedding.model, self.embedding.vectors, count)
            self.__dict__["embedding"] = checked
        if not 0 <= self.stamp_ns < 2**63:
            raise FrameError("stamp_ns", "whole nanoseconds in [0, 2^63)", repr(self.stamp_ns))
        check_view(self.field_of_view)
        center, size, yaw, velocity, score = (arrays[name] for name, _ in _COLUMNS)
        given = indices["label"], len(self.labels), center, size, yaw, score, velocity
        if not allowed(*given):
            _refuse(*given)
        self.__dict__.update(arrays | indices)


_COLUMNS: Final[tuple[tuple[str, tuple[int, ...]], ...]] = (
    ("center", (3,)),
    ("size", (3,)),
    ("yaw", ()),
    ("velocity", (2,)),
    ("score", ()),
)


def make_frame(
    parameters: Parameters,
    *,
    stamp_ns: int,
    labels: Sequence[str],
    label: ArrayLike,
    center: ArrayLike,
    score: ArrayLike,
    size: ArrayLike | None = None,
    yaw: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    pose: Pose | None = None,
    cloud: PointCloud | None = None,
    field_of_view: FieldOfView | None = None,
    position_covariance: ArrayLike | None = None,
    embedding: ArrayLike | None = None,
    embedding_model: str | None = None,
    attributes: Sequence[Mapping[str, Any] | None] | None = None,
) -> tuple[Frame, int]:
    """Check the detections of one stamp and bring them to the world frame and to the classes of the parameters.

    Args:
        parameters: whose classes are meant.
        stamp_ns: sensor time, nanoseconds, not negative.
        labels: names of the classes that `label` points into. Names that mean the same as one class of the parameters
            are that class: `car`, `Car` and `vehicle.car`.
        label: (M,) integers.
        center: (M, 3) geometric centres, m, in the world frame, or in the sensor frame when `pose` is given. A z that
            is NaN is unknown.
        size: (M, 3) length, width, height, m, all positive; None, or NaN, where unknown.
        yaw: (M,) rad, in the same frame; None, or NaN, where unknown.
        score: (M,) in [0, 1], as the detector gives it; an object of score 0 is left out, for its detector says that
            there is none. The frame has the calibrated scores where a class has a `score_calibration`.
        velocity: (M, 2) over ground along the axes of the same frame, m/s; None, or rows of NaN, where unknown.
        pose: world from sensor, or None when the arrays are in the world frame already. The identity is the same as
            None, to the last bit: a heading does not go through sine and cosine.
        cloud: the scan of the same stamp.
        field_of_view: where the sensor detects objects, in the frame of its own `pose`, else of `pose`. Outside it
            objects are neither detected nor missed. None: it sees everything.
        position_covariance: (M, 3, 3) of the errors of the centres along the axes of the same frame, m^2, in place of R
            of the class; a matrix of NaN, or None, where the detector gives none.
        embedding: (M, E) appearance of each detection, E from 2 to 512, of any length; a row of NaN where unknown.
        embedding_model: model and version of these vectors; required with them.
        attributes: up to 8 texts by name of each detection, as `{"plate": "AB 12"}` or with a score in (0, 1]
            `{"plate": ("AB 12", 0.8)}`, names and texts of up to 32 bytes; None where unknown.

    Returns:
        The frame, and how many objects were left out: their class is not in the parameters, or their score is 0.

    Raises:
        FrameError: wrong shapes or values; `path` names the field and the element.
    """
    if not isinstance(stamp_ns, (int, np.integer)) or not 0 <= stamp_ns < 2**63:
        raise FrameError("stamp_ns", "whole nanoseconds in [0, 2^63)", repr(stamp_ns))
    check_view(field_of_view)
    which = _integers("label", label)
    m = which.shape[0]
    center, score = _shaped("center", center, (m, 3)), _shaped("score", score, (m,))
    size = _unknown(m, 3) if size is None else _shaped("size", size, (m, 3))
    yaw = _unknown(m) if yaw is None else _shaped("yaw", yaw, (m,))
    velocity = _unknown(m, 2) if velocity is None else _shaped("velocity", velocity, (m, 2))
    scored = read_only(np.where(score == 0.0, 1.0, score))  # objects of score 0 are left out
    given = which, len(labels), center, size, yaw, scored, velocity
    if not allowed(*given):
        _refuse(*given)
    spread = position_covariance
    spread = None if spread is None else _shaped("position_covariance", spread, (m, 3, 3))
    columns = which, center, size, yaw, score, velocity
    looks = None if embedding is None else embedding_of(embedding_model, embedding, m)
    named = tuple(labels)
    texts = None if attributes is None else readings_of(attributes, m)
    rest = pose, cloud, field_of_view, spread, looks, texts
    return frame_of_checked(parameters, int(stamp_ns), named, columns, *rest)


def frame_of_checked(
    parameters: Parameters,
    stamp_ns: int,
    labels: tuple[str, ...],
    columns: tuple[Any, ...],
    pose: Pose | None,
    cloud: PointCloud | None,
    field_of_view: FieldOfView | None,
    position_covariance: Array | None,
    embedding: Embedding | None = None,
    readings: Readings | None = None,
) -> tuple[Frame, int]:
    """Make a frame as `make_frame` does, of arrays that the caller has checked: only covariances are checked here.

    Every value is one that `make_frame` allows, and every array has the type, the shape and the order of one in a
    frame. The arrays are not copied but become read-only. `columns` are label, center, size, yaw, score and velocity;
    size, yaw and velocity may be None.

    Raises:
        FrameError: a covariance is none, or an object is too far in the world frame.
    """
    label, center, size, yaw, score, velocity = columns
    m = label.shape[0]
    size = _unknown(m, 3) if size is None else size
    yaw = _unknown(m) if yaw is None else yaw
    velocity = _unknown(m, 2) if velocity is None else velocity
    rotation = None
    if pose is not None and not pose.is_identity:
        rotation = pose.rotation
        center = _to_world(center, rotation, pose.translation)
        heading = np.empty((m, 2))
        heading[:, 0], heading[:, 1] = np.cos(yaw), np.sin(yaw)
        heading = heading @ rotation[:2, :2].T
        yaw = np.arctan2(heading[:, 1], heading[:, 0])
        velocity = velocity @ rotation[:2, :2].T
    spread = None if position_covariance is None else horizontal_covariance(position_covariance, rotation)
    names = parameters.labels
    known = class_indices(labels, names)[label]
    score = calibrate_scores(parameters, known, score)
    source = _every_row(m)
    if m and (known[known.argmin()] < 0 or not score[score.argmin()] > 0.0):
        source = ((known >= 0) & (score > 0.0)).nonzero()[0]
        center, size, yaw, velocity = center[source], size[source], yaw[source], velocity[source]
        score, known = score[source], known[source]
        spread = None if spread is None else spread[source]
        embedding = embedding and embedding._replace(vectors=read_only(embedding.vectors[source]))
    columns = center, size, yaw, velocity, score, known, source
    if field_of_view is not None and field_of_view.pose is None and pose is not None:
        field_of_view = field_of_view.at(pose)
    sensor = pose if pose is not None or field_of_view is None else field_of_view.pose
    rest = names, cloud, field_of_view, spread, sensor, embedding, readings
    for column in columns if spread is None else (*columns, spread):
        column.flags.writeable = False
    if rotation is not None and not allowed(known, len(names), center, size, yaw, score, velocity):
        # Too far in the world only: the constructor names the object.
        return Frame(stamp_ns, *columns, *rest), m - source.shape[0]
    frame = object.__new__(Frame)
    frame.__dict__.update(zip(Frame.__dataclass_fields__, (stamp_ns, *columns, *rest), strict=True))
    return frame, m - source.shape[0]


def embedding_of(model: str | None, vectors: ArrayLike, count: int) -> Embedding:
    """Check the vectors of so many detections.

    Raises:
        FrameError: there is no model, the shape is none, or a row is neither a vector of `SHORTEST` or more nor NaN.
    """
    if not model or len(model) > LONGEST_MODEL:
        raise FrameError("embedding_model", f"the model of the vectors, 1 to {LONGEST_MODEL} characters", repr(model))
    with np.errstate(over="ignore"):  # what overflows becomes infinite, and is refused
        given = _array("embedding", vectors, np.float32)
    least, most = EMBEDDING
    if not count and not given.size:
        given = given.reshape(0, least)
    if given.shape[:-1] != (count,) or not least <= given.shape[1] <= most:
        raise FrameError("embedding", f"shape ({count}, {least} to {most})", str(given.shape))
    unknown = np.isnan(given).all(axis=1, keepdims=True)
    _all("embedding", np.isfinite(given) | unknown, "a finite number, or a whole row of NaN", given)
    length = np.sqrt((given.astype(np.float64) ** 2).sum(axis=1))
    _all("embedding", (length >= SHORTEST) | unknown[:, 0], f"a vector of length {SHORTEST:g} or more", length)
    return Embedding(model, given)


@lru_cache(64)
def _every_row(count: int) -> Index:
    """Return the rows of so many objects of which none is left out."""
    return read_only(np.arange(count))


@lru_cache(64)
def _unknown(count: int, *shape: int) -> Array:
    """Return a column of so many objects whose detector does not give it."""
    return read_only(np.full((count, *shape), np.nan))


def _to_world(center: Array, rotation: Array, translation: Array) -> Array:
    """Return centres in the world. A centre without z is at the height of the sensor, and has no z in the world."""
    moved: Array = center @ rotation.T + translation
    if np.isnan(moved.sum()):
        flat = np.isnan(center[:, 2])
        moved[flat] = np.column_stack((center[flat, :2], np.zeros(flat.sum()))) @ rotation.T + translation
        moved[flat, 2] = np.nan
    return moved


@kernel
def allowed(label: Index, n_labels: int, center: Array, size: Array, yaw: Array, score: Array, velocity: Array) -> bool:
    """Tell whether all values are allowed; `_refuse` says which one is not."""
    good = True
    for m in range(label.shape[0]):  # NaN compares as not good
        good &= 0 <= label[m] < n_labels
        good &= abs(yaw[m]) <= MAX_YAW or np.isnan(yaw[m])
        good &= 0.0 < score[m] <= 1.0
        for s in range(3):
            good &= abs(center[m, s]) <= MAX_COORDINATE or (s == 2 and np.isnan(center[m, s]))  # noqa: PLR2004 - z
            good &= 0.0 < size[m, s] <= MAX_COORDINATE or np.isnan(size[m, s])
        unknown = np.isnan(velocity[m, 0]) and np.isnan(velocity[m, 1])
        good &= unknown or (abs(velocity[m, 0]) <= MAX_SPEED and abs(velocity[m, 1]) <= MAX_SPEED)
    return good


def _refuse(label: Index, n_labels: int, center: Array, size: Array, yaw: Array, score: Array, velocity: Array) -> None:
    """Raise for the first value that is not allowed."""
    _all("label", (label >= 0) & (label < n_labels), f"an index below {n_labels}", label)
    z_known = np.where(np.isnan(center) & (np.arange(3) == 2), 0.0, center)  # noqa: PLR2004 - z may be unknown
    size_known, yaw_known = np.where(np.isnan(size), 1.0, size), np.where(np.isnan(yaw), 0.0, yaw)
    bounds = (("center", z_known, MAX_COORDINATE), ("size", size_known, MAX_COORDINATE))
    for path, values, bound in (*bounds, ("score", score, 1.0)):
        _bounded(path, values, bound)
    expected = f"radians from -{MAX_YAW:g} to {MAX_YAW:g} (numpy.radians converts degrees)"
    _all("yaw", np.abs(yaw_known) <= MAX_YAW, expected, yaw)
    _all("size", size_known > 0, "a positive length", size)
    _all("score", score > 0, "a score in (0, 1]", score)
    unknown = np.isnan(velocity).all(axis=1, keepdims=True)
    expected = f"at most {MAX_SPEED:g} m/s, or a whole row of NaN"
    _all("velocity", (np.abs(velocity) <= MAX_SPEED) | unknown, expected, velocity)


def _shaped(path: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return a copy as float64 of exactly `shape`; an empty list stands for any shape with no rows."""
    array: Array = _array(path, values, np.float64)
    if array.shape != shape:
        if array.size or 0 not in shape:
            raise FrameError(path, f"shape {shape}", str(array.shape))
        array = array.reshape(shape)
    return array


def _integers(path: str, values: ArrayLike) -> Index:
    """Return a copy as int64 of one dimension."""
    array = _array(path, values, None)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise FrameError(path, "(M,) integers", f"{array.shape} {array.dtype}")
    return read_only(array.astype(np.int64))


def _bounded(path: str, values: Array, bound: float) -> None:
    _all(path, np.abs(values) <= bound, f"a finite number of size at most {bound:g}", values)


def _array(path: str, values: ArrayLike, dtype: type[np.floating[Any]] | None) -> NDArray[Any]:
    try:
        # A copy in one piece: a frame shares no memory with the caller.
        return read_only(np.array(values, dtype=dtype, order="C"))
    except (TypeError, ValueError) as error:
        raise FrameError(path, "an array of numbers", repr(values)[:80]) from error


def _all(path: str, good: NDArray[np.bool_], expected: str, values: NDArray[np.generic]) -> None:
    """Raise for the first element that is not `good`; NaN compares as not good."""
    if not good.all():
        where = tuple(int(i) for i in np.argwhere(~good)[0])
        element = "".join(f"[{i}]" for i in where)
        raise FrameError(path + element, expected, str(values[where]))


def calibrated(curve: ScoreCalibration, score: Array) -> Array:
    """Return c(z_s) of scores (M,) in [0, 1]."""
    given, meant = (0.0, *curve.detector, 1.0), (0.0, *curve.calibrated, 1.0)
    return np.minimum(np.interp(score, given, meant), 1.0)  # rounding may not pass one


def calibrate_scores(parameters: Parameters, label: Index, score: Array) -> Array:
    """Return scores (M,) in [0, 1], calibrated where their class has a curve; without curves the same array."""
    for index, table in enumerate(parameters.classes.values()):
        if table.score_calibration is not None:
            score = np.where(label == index, calibrated(table.score_calibration, score), score)
    return score


PLAIN: Final = 2
"""Columns of measured positions, x and y; five with rho_xx, rho_xy and rho_yy."""

LEAST_VARIANCE: Final = 1e-8
"""Least variance of a position along any axis, m^2."""

LARGEST_VARIANCE: Final = 1e8
"""Largest variance, m^2."""

SYMMETRY: Final = 1e-6
"""Share of the largest variance by which opposite entries may differ, as float32 rounds them."""


def horizontal_covariance(covariance: Array, rotation: Array | None) -> Array:
    """Check covariances of positions and return their part of x and y in the world.

    Args:
        covariance: (M, 3, 3) of x, y and z along the axes of the arrays, m^2; of NaN where unknown.
        rotation: (3, 3) from these axes to the world; None: they are the same.

    Returns:
        (M, 3) variance of x, covariance of x and y, variance of y; NaN where unknown.

    Raises:
        FrameError: one is not symmetric, or a variance along some axis is out of bounds; names the object.
    """
    unknown: NDArray[np.bool_] = np.all(np.isnan(covariance), axis=(1, 2))
    known = np.where(unknown[:, None, None], np.eye(3), covariance)
    expected = (
        f"a symmetric covariance with variances from {LEAST_VARIANCE:g} to {LARGEST_VARIANCE:g} m^2 along every axis"
    )
    good: NDArray[np.bool_] = np.all(np.abs(known) <= LARGEST_VARIANCE, axis=(1, 2))  # NaN is not
    known[~good] = 0.0
    difference = np.abs(known - known.transpose(0, 2, 1)).max(axis=(1, 2))
    known = 0.5 * (known + known.transpose(0, 2, 1))
    good &= difference <= SYMMETRY * known.max(axis=(1, 2))
    variance = np.linalg.eigvalsh(known)
    good &= (variance[:, 0] >= LEAST_VARIANCE) & (variance[:, 2] <= LARGEST_VARIANCE)
    if not good.all():
        row = int(np.argmin(good))
        raise FrameError(f"position_covariance[{row}]", expected, str(covariance[row].tolist())[:200])
    if rotation is not None:
        known = rotation @ known @ rotation.T
    horizontal = np.column_stack((known[:, 0, 0], known[:, 0, 1], known[:, 1, 1]))
    horizontal[unknown] = np.nan
    return horizontal


def semidefinite(horizontal: Array) -> NDArray[np.bool_]:
    """Tell which rows (M, 3) of R_xx, R_xy and R_yy are a covariance, up to rounding, or NaN."""
    xx, xy, yy = horizontal.T
    good = (xx > 0.0) & (yy > 0.0) & (xy * xy <= (1.0 + SYMMETRY) * xx * yy) & (np.maximum(xx, yy) < np.inf)
    return np.asarray(good | np.isnan(horizontal).all(axis=1), np.bool_)

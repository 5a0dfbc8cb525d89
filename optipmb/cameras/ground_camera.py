"""Positions on the ground, with covariances, of the boxes of a calibrated camera.

    camera = optipmb.GroundCamera.read("gate.toml")
    tracks = optipmb.OnlineTracker("generic").update({"box": boxes, "class": names}, t=t, camera=camera)

The foot of a box is the middle of its lower edge, u = (x1 + x2) / 2 and v = y2. Its ray meets the ground at range r.
With w, h: width and height of the box, L, W: length and width of the class, the covariance of the centre sums

    J diag(s_u^2, s_v^2) J'        J = d(ground) / d(u, v), by differences of half a pixel
        s_u^2 = p^2 + (q w)^2      p, q: `error.pixel`
        s_v^2 = p^2 + (q h)^2 + (f tilt)^2, and (0.1 h)^2 of a foot that another box hides
    (r s_H / H)^2 along the ray    H: height of the camera, s_H: `error.height`
    max(0.1, 0.07 L)^2 across it

A flat ray has a second range that is independent of the ground. With the height H_c of the class and the elevations of
the edges it is H_c / (tan(top) - tan(bottom)), with the relative variance sd_c^2 + 2 (p^2 + (q h)^2) / h^2. The two are
weighted by inverse variances.

The centre lies (L cos a + W sin a) / 2 behind the foot, with a from the width that is seen, L sin a + W cos a. Of a box
that the border of the image cuts, and of a foot without a box, a is unknown: it is (L + W) / 4.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from optipmb.cameras.camera_files import FilePath, read_calibration
from optipmb.cameras.camera_lens import Intrinsics, Lens
from optipmb.model.class_names import common_name, like
from optipmb.model.errors import FrameError, ParameterError
from optipmb.model.frame import UNIT_TOLERANCE, FieldOfView, Pose
from optipmb.model.parameters import ParameterTable, Positive, checked
from optipmb.model.table import usual_size

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from optipmb.model.rows import Array

HORIZON: Final = math.tan(0.003)
"""Slope below the ground plane from which a ray meets it."""
FLAT: Final = math.tan(0.35)
"""Slope of a ray up to which the height of a box gives a range."""
BORDER_PX: Final = 3.0
"""Distance from the border of the image up to which it cuts a box."""
HIDING_PX: Final = 2.0
"""Least distance of the lower edge of a box below a foot that it hides."""
_HALVES: Final = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
_STRAIGHT_DOWN: Final = 1e-6  # m from the base to the middle of the image, up to which no direction is ahead
_RANGES: Final = np.geomspace(0.1, 2000.0, 1000)  # m, where the end of the field of view is sought

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]


def _unit(quaternion: Quadruple) -> Quadruple:
    if abs(math.hypot(*quaternion) - 1.0) > UNIT_TOLERANCE:
        raise ValueError("a unit quaternion (w, x, y, z)")
    return quaternion


def _plane(ground: Any) -> Any:
    return (0.0, 0.0, 1.0, -ground) if isinstance(ground, int | float) else ground


def _upward(plane: Quadruple) -> Quadruple:
    if plane[2] == 0.0:
        raise ValueError("a height (m), or a plane a, b, c, d that is not vertical")
    length = math.copysign(math.hypot(*plane[:3]), plane[2])
    return (plane[0] / length, plane[1] / length, plane[2] / length, plane[3] / length)


class Pinhole(Lens):
    """A lens at a place above a plane.

    Attributes:
        position: of the camera's centre, m, in the world or in the frame of the vehicle.
        quaternion: w x y z, from the axes of the camera (x right, y down, z forward) to that frame.
        ground: its plane a, b, c, d: a x + b y + c z + d = 0; a file may have its height, m.
    """

    intrinsics: Intrinsics
    position: Triple
    quaternion: Annotated[Quadruple, AfterValidator(_unit)]
    ground: Annotated[Quadruple, BeforeValidator(_plane), AfterValidator(_upward)] = (0.0, 0.0, 1.0, 0.0)

    @model_validator(mode="after")
    def _above(self) -> Self:
        if not self.height > 0.0:
            raise ParameterError("position", "a camera above the ground", f"{-self.height:g} m below it")
        return self

    @cached_property
    def pose(self) -> Pose:
        """Frame of the position from the axes of the camera."""
        return Pose(np.array(self.position), np.array(self.quaternion))

    @cached_property
    def up(self) -> Array:
        """Normal (3,) of the ground."""
        return np.array(self.ground[:3])

    @cached_property
    def height(self) -> float:
        """Height of the camera above the ground, m."""
        return float(self.up @ np.array(self.position) + self.ground[3])

    @cached_property
    def base(self) -> Array:
        """Place (2,) on the ground below the camera."""
        return (np.array(self.position) - self.height * self.up)[:2]

    def lifted(self, places: Array, height: float) -> Array:
        """Return the points (..., 3) at a height above places (..., 2) on the ground."""
        a, b, c, d = self.ground
        z = -(places @ np.array([a, b]) + d) / c
        return np.asarray(np.concatenate([places, z[..., None]], axis=-1) + height * self.up)

    def sloped(self, pixels: Array) -> tuple[Array, Array]:
        """Return slopes (...) above the plane of the rays of pixels (..., 2), and unit vectors (..., 3) along it."""
        rays = self.rays(pixels) @ self.pose.rotation.T
        rise = rays @ self.up
        along = rays - rise[..., None] * self.up
        length = np.maximum(np.linalg.norm(along, axis=-1), 1e-12)  # of a ray straight down
        return rise / length, along / length[..., None]

    def on_ground(self, pixels: Array) -> Array:
        """Return the places (..., 2) that pixels (..., 2) show; NaN beyond the horizon."""
        slope, along = self.sloped(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(slope < -HORIZON, -self.height / slope, np.nan)
        return np.asarray(self.base + reach[..., None] * along[..., :2])

    def project(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3); NaN of those behind the camera."""
        return self.pixels((points - self.pose.translation) @ self.pose.rotation)


class Homography(Lens):
    """A map from pixels, straightened where there are intrinsics, to the ground.

    Attributes:
        matrix: (3, 3) from u, v, 1 to x, y, 1 in m, up to a factor.
        reference: a pixel on the ground: its side of the horizon is the ground.
        position: x and y of the camera, m; without it the field of view is unknown.
    """

    matrix: tuple[Triple, Triple, Triple]
    reference: Pair
    position: Pair | None = None

    @model_validator(mode="after")
    def _invertible(self) -> Self:
        matrix = np.array(self.matrix)
        rows = matrix / np.maximum(np.abs(matrix).max(axis=1, keepdims=True), 1e-300)
        if np.linalg.matrix_rank(rows, tol=1e-15) < 3:  # noqa: PLR2004 - 3 x 3
            raise ParameterError("matrix", "a matrix that has an inverse", "a singular one")
        if not np.isfinite(self._place).all():
            raise ParameterError("reference", "a pixel on the ground", f"{self.reference}, on the horizon")
        if np.linalg.det(self._near) > 0.0:
            expected = "a map as a camera above the ground sees it: x, y and z up are right-handed, v points down"
            raise ParameterError("matrix", expected, "a mirrored one; is y down in the map, or are u and v exchanged?")
        return self

    @cached_property
    def _place(self) -> Array:
        """Place (2,) of the reference, from which all are measured: coordinates of maps have millions of metres."""
        matrix, at = np.array(self.matrix), np.append(self.flat(np.array(self.reference)), 1.0)
        mapped = matrix @ at
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(
                np.where(abs(mapped[2]) > 1e-12 * np.abs(matrix[2] * at).max(), mapped[:2] / mapped[2], np.nan)
            )

    @cached_property
    def _near(self) -> Array:
        """The matrix (3, 3) to places from `_place`, with the sign that makes the third coordinate positive there."""
        matrix = np.array(self.matrix)
        matrix = matrix * np.sign(matrix[2] @ np.append(self.flat(np.array(self.reference)), 1.0))
        return np.asarray(np.vstack([matrix[:2] - self._place[:, None] * matrix[2], matrix[2]]))

    @cached_property
    def base(self) -> Array | None:
        """Place (2,) on the ground below the camera, None where it is unknown."""
        return None if self.position is None else np.array(self.position)

    def on_ground(self, pixels: Array) -> Array:
        """Return the places (..., 2) that pixels (..., 2) show; NaN beyond the horizon."""
        return np.asarray(_mapped(self._near, self.flat(pixels)) + self._place)

    @staticmethod
    def lifted(places: Array, height: float) -> Array:
        """Return the points (..., 3) at places (..., 2); a homography knows no heights."""
        return np.insert(places, 2, height, axis=-1)

    def project(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) on the ground, whose z is not read."""
        inverse = np.linalg.inv(self._near)
        return self.curved(_mapped(np.asarray(inverse, np.float64), points[..., :2] - self._place))


def _mapped(matrix: Array, points: Array) -> Array:
    mapped = np.insert(points, 2, 1.0, axis=-1) @ matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(
            mapped[..., 2:] > 1e-12 * np.abs(mapped).max(-1, keepdims=True), mapped[..., :2] / mapped[..., 2:], np.nan
        )


class CameraErrors(ParameterTable):
    """Standard deviations of the calibration and of the boxes; None: the usual one of the mount.

    Attributes:
        pixel: px, and share of the width or height of a box.
        tilt: rad, of the camera against the ground.
        height: m, of the camera above the ground.
        largest: m, along the ray; detections with a larger one are left out.
        range: source of the distance.
    """

    pixel: tuple[Positive, Annotated[float, Field(ge=0.0, le=1.0)]] = (1.0, 0.04)
    tilt: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    height: Annotated[float, Field(ge=0.0, le=100.0)] | None = None
    largest: Positive = 8.0
    range: Literal["ground", "height", "both"] | None = None


class ClassSize(ParameterTable):
    """Length, width and height of the objects of a class, m, and the relative spread of their heights."""

    size: tuple[Positive, Positive, Positive] | None = None
    height_sd: Positive | None = None


class _Boxes(NamedTuple):
    """Boxes of a frame, (M, ...); of feet without a box width and height are NaN."""

    edges: Array  # (M, 4)
    foot: Array  # (M, 2)
    width: Array
    height: Array
    size: Array  # (M, 4) of the class: length, width, height, spread of heights


class GroundCamera(ParameterTable):
    """Calibration of a camera: places on the ground from pixels.

    Attributes:
        image: width and height of the image that the boxes are in, px.
        mount: whether the camera is fixed in the world, or on a vehicle whose poses are known.
        pinhole, homography: one of them.
        error: standard deviations.
        classes: `class` in the file; the default size is the usual one of the name.
    """

    image: tuple[Annotated[int, Field(ge=8, le=100_000)], Annotated[int, Field(ge=8, le=100_000)]]
    mount: Literal["fixed", "vehicle"] = "fixed"
    pinhole: Pinhole | None = None
    homography: Homography | None = None
    error: CameraErrors = CameraErrors()
    classes: dict[str, ClassSize] = Field(default={}, alias="class")

    @classmethod
    def read(cls, path: FilePath) -> Self:
        """Return the camera of a TOML file, whose `intrinsics` may name a file of ROS or OpenCV in its folder.

        Raises:
            ParameterError: the file cannot be read, or a value is not allowed; names the file and the value.
        """
        try:
            return cls.parse(read_calibration(path))
        except ParameterError as error:
            where = f"{path}: {error.path}" if error.path else str(path)
            raise ParameterError(where, error.expected, error.received) from error

    @classmethod
    def parse(cls, document: Mapping[str, Any]) -> Self:
        """Return the camera of nested dictionaries, as the file has them.

        Raises:
            ParameterError: a value is not allowed; names it.
        """
        return checked(cls, document, "camera")

    @model_validator(mode="after")
    def _sees_ground(self) -> Self:
        if (self.pinhole is None) == (self.homography is None):
            both = "both" if self.pinhole is not None else "neither"
            raise ParameterError("pinhole", "this table or homography, one of them", both)
        if self._geometry.base is not None and self.field_of_view is None:
            name = "pinhole.quaternion" if self.pinhole is not None else "homography.matrix"
            expected = f"an image that shows ground to within {self.error.largest:g} m (error.largest)"
            raise ParameterError(name, expected, "none that is seen, or so exact")
        return self

    @property
    def _geometry(self) -> Pinhole | Homography:
        geometry = self.pinhole or self.homography
        assert geometry is not None  # noqa: S101 - `_sees_ground`
        return geometry

    def ground(self, pixels: ArrayLike) -> Array:
        """Return the places (..., 2) on the ground that pixels (..., 2) show, m; NaN beyond the horizon."""
        return self._geometry.on_ground(np.asarray(pixels, np.float64))

    def project(self, points: ArrayLike) -> Array:
        """Return the pixels (..., 2) of points (..., 3), m, NaN behind the camera; of a homography, on the ground."""
        return self._geometry.project(np.asarray(points, np.float64))

    def detections(
        self,
        box: ArrayLike | None = None,
        label: ArrayLike = (),
        score: ArrayLike | None = None,
        *,
        foot: ArrayLike | None = None,
        pose: Pose | None = None,
    ) -> dict[str, Any]:
        """Return the detections of the boxes of a frame, in the frame of the camera's position.

        Args:
            box: (M, 4) x1 y1 x2 y2, px, y down; or
            foot: (M, 2) u v, where objects stand.
            label: (M,) class names.
            score: (M,); None: 1.
            pose: of the vehicle; required if the camera is on one, and refused if it is fixed.

        Returns:
            `center` (K, 3) with z NaN, `position_covariance` (K, 3, 3), `label`, `score`; `row` (K,) of each in the
            arguments; `left_out`, counts by reason: `horizon`, `cut` by the border, `far`.

        Raises:
            FrameError: wrong shapes or values, which name the row; or a pose where there may be none, or none.
        """
        if (pose is None) == (self.mount == "vehicle"):
            fixed, vehicle = "none, for the camera is fixed in the world", "the pose of the vehicle at each frame"
            expected = f"{fixed if pose else vehicle} (mount = {self.mount})"
            raise FrameError("pose", expected, "a pose" if pose else "none")
        names = np.asarray(label).astype(np.str_)
        boxes = self._boxes(box, foot, names)
        count = len(boxes.foot)
        scores = np.ones(count) if score is None else np.asarray(score, np.float64)
        if scores.shape != (count,) or names.shape != (count,):
            raise FrameError("box", f"{count} labels and scores, one for each box", f"{names.shape}, {scores.shape}")
        place, covariance, spread = self._placed(boxes)
        u, v = boxes.foot.T
        width, height = self.image
        cut = (v > height - BORDER_PX) | (v < 0.0) | (u < 0.0) | (u > width)
        horizon = ~cut & np.isnan(spread)
        far = ~cut & ~horizon & (spread > self.error.largest)
        row = np.flatnonzero(~(cut | horizon | far))
        center, whole = np.full((len(row), 3), np.nan), np.tile(np.eye(3), (len(row), 1, 1))
        center[:, :2], whole[:, :2, :2] = place[row], covariance[row]
        reasons = {"horizon": horizon, "cut": cut, "far": far}
        return {
            "center": center,
            "position_covariance": whole,
            "label": names[row],
            "score": scores[row],
            "row": row,
            "left_out": {name: int(those.sum()) for name, those in reasons.items() if those.any()},
        }

    def _boxes(self, box: ArrayLike | None, foot: ArrayLike | None, names: Any) -> _Boxes:
        """Return checked boxes with the sizes of their classes."""
        if (box is None) == (foot is None):
            raise FrameError("box", "box (x1 y1 x2 y2) or foot (u v)", "both" if foot is not None else "neither")
        name, columns = ("box", 4) if foot is None else ("foot", 2)
        try:
            given = np.array(box if foot is None else foot, dtype=np.float64)
        except (TypeError, ValueError):
            raise FrameError(name, f"(M, {columns}) numbers, px", "others") from None
        given = given.reshape(0, columns) if not given.size else given
        if given.ndim != 2 or given.shape[1] != columns:  # noqa: PLR2004 - rows and columns
            raise FrameError(name, f"(M, {columns}) numbers, px", str(given.shape))
        good = np.abs(given).max(axis=1, initial=0.0) <= 1e6  # noqa: PLR2004 - also false for NaN
        if foot is None:
            good &= (given[:, 2:] >= given[:, :2]).all(axis=1)
            edges, foot = given, np.column_stack([0.5 * (given[:, 0] + given[:, 2]), given[:, 3]])
        else:
            edges = np.tile(given, 2)
        if not good.all():
            row = int(np.flatnonzero(~good)[0])
            order = ", x1 <= x2, y1 <= y2" if columns == 4 else ""  # noqa: PLR2004 - a box
            raise FrameError(f"{name}[{row}]", f"finite pixels up to 1e6{order}", str(given[row].tolist()))
        classes, which = np.unique(names, return_inverse=True)
        size = np.array([self._size(one) for one in classes.tolist()]).reshape(-1, 4)[which]
        width, height = (edges[:, 2:] - edges[:, :2]).T if columns == 4 else np.full((2, len(given)), np.nan)  # noqa: PLR2004 - a box
        return _Boxes(edges, np.asarray(foot, np.float64).reshape(-1, 2), width, height, size)

    def _size(self, name: str) -> tuple[float, ...]:
        """Return length, width, height and spread of heights of a class."""
        own = self.classes.get(like(name, tuple(self.classes)) or "", ClassSize())
        kind = common_name(name)
        spread = 0.08 if kind == "pedestrian" else 0.1
        if own.size is None and kind in {"car", "truck", "bus"}:
            spread = 0.14  # mean heights of cars differ by a sixth between countries
        spread = own.height_sd or spread
        return (*(own.size or usual_size(name)), spread)

    def _placed(self, boxes: _Boxes) -> tuple[Array, Array, Array]:
        """Return centres (M, 2), covariances (M, 2, 2) and standard deviations along the ray (M,); NaN: no place."""
        geometry, (px, share), base = self._geometry, self.error.pixel, self._geometry.base
        known = ~np.isnan(boxes.width)
        width, height = np.nan_to_num(boxes.width), np.nan_to_num(boxes.height)
        var_u, var_box = px**2 + (share * width) ** 2, px**2 + (share * height) ** 2
        var_v = var_box + self._hidden(boxes) * (0.1 * height) ** 2
        if self.pinhole is not None:
            var_v += (self.pinhole.intrinsics[1] * self._usual(self.error.tilt, 0.001, 0.02)) ** 2
        steps = boxes.foot[:, None] + _HALVES
        ground = geometry.on_ground(steps)
        place, by_u, by_v = ground[:, 0], ground[:, 1] - ground[:, 2], ground[:, 3] - ground[:, 4]
        along = -by_v if base is None else place - base
        reach = np.linalg.norm(along, axis=1)
        along = along / np.maximum(reach, 1e-12)[:, None]
        in_u, in_v = (np.column_stack([_dot(along, by), _dot(along @ _QUARTER, by)]) for by in (by_u, by_v))
        inner = _outer(in_u, var_u) + _outer(in_v, var_v)
        aside = np.abs(in_u[:, 1])  # m across the ray in a pixel
        if (pinhole := self.pinhole) is not None:
            inner[:, 0, 0] += (reach * self._usual(self.error.height, 0.02, 0.05) / pinhole.height) ** 2
            if self.range != "ground":
                own, own_variance, usable, flat = self._heights(pinhole, boxes, steps, var_box)
                alone = np.isnan(reach) | (self.range == "height")
                gain = np.where(alone, 1.0, inner[:, 0, 0] / (inner[:, 0, 0] + own_variance))
                joint = np.where(alone, own, reach + gain * (own - reach))
                along, reach = np.where(usable[:, None], flat[:, 0], along), np.where(usable, joint, reach)
                turn_u, turn_v = (reach * _dot(along @ _QUARTER, flat[:, k] - flat[:, k + 1]) for k in (1, 3))
                shared = np.where(alone, 0.0, (1.0 - gain) * inner[:, 0, 1])
                across = turn_u**2 * var_u + turn_v**2 * var_v
                new = np.stack([gain * own_variance, shared, shared, across], axis=1).reshape(-1, 2, 2)
                inner, aside = np.where(usable[:, None, None], new, inner), np.where(usable, np.abs(turn_u), aside)
                place = np.where(usable[:, None], pinhole.base + reach[:, None] * along, place)
        x1, x2, seen = boxes.edges[:, 0], boxes.edges[:, 2], width * aside
        behind, spread, beyond = _behind(boxes, seen, known & ((x1 < BORDER_PX) | (x2 > self.image[0] - BORDER_PX)))
        inner[:, 0, 0] += spread**2
        inner[:, 1, 1] += np.maximum(0.1, 0.07 * boxes.size[:, 0]) ** 2 + beyond**2
        axes = np.stack([along, along @ _QUARTER], axis=2)
        return place + behind[:, None] * along, axes @ inner @ axes.transpose(0, 2, 1), np.sqrt(inner[:, 0, 0])

    @staticmethod
    def _heights(pinhole: Pinhole, boxes: _Boxes, steps: Array, variance: Array) -> tuple[Array, Array, Any, Array]:
        """Return ranges (M,) by the heights of boxes, their variances, which are usable, and the rays on the ground."""
        slope, flat = pinhole.sloped(steps)
        top = boxes.edges[:, 1]
        rise = pinhole.sloped(np.column_stack([boxes.foot[:, 0], top]))[0] - slope[:, 0]
        usable = (slope[:, 0] > -FLAT) & (top > BORDER_PX) & (boxes.height > 0.0) & (rise > 0.0)
        level = np.linalg.norm(flat[..., :2], axis=2)
        own = boxes.size[:, 2] / np.where(usable, rise, 1.0) * level[:, 0]
        relative = boxes.size[:, 3] ** 2 + 2.0 * variance / np.where(usable, boxes.height, 1.0) ** 2
        return own, own**2 * relative, usable, flat[..., :2] / level[..., None]

    def _usual(self, given: float | None, fixed: float, vehicle: float) -> float:
        return given if given is not None else fixed if self.mount == "fixed" else vehicle

    @property
    def range(self) -> str:
        """Source of the distance: `ground`, `height` or `both`."""
        if self.homography is not None:
            return "ground"
        return self.error.range or ("ground" if self.mount == "fixed" else "both")

    @staticmethod
    def _hidden(boxes: _Boxes) -> Any:
        """Return (M,) whether the foot of a box is in another box that ends lower."""
        u, v = boxes.foot.T[:, :, None]
        x1, y1, x2, y2 = boxes.edges.T[:, None]
        return ((x1 <= u) & (u <= x2) & (y1 <= v) & (v + HIDING_PX < y2)).any(axis=1)

    @cached_property
    def field_of_view(self) -> FieldOfView | None:
        """Sector of the ground that holds all that the image shows, with errors up to `error.largest`.

        Its pose is in the frame of the camera's position. None for a homography without a position. Places beside the
        image that are in the sector count as looked at: an object there is missed a little early.
        """
        geometry, (width, height), base = self._geometry, self.image, self._geometry.base
        if base is None:
            return None
        size = max((self._size(name) for name in self.classes or ("car",)), key=lambda one: one[0])
        columns, rows = np.linspace(0.0, width, 33), np.linspace(0.0, height, 33)
        sides = (columns, height), (columns, 0.0), (0.0, rows), (width, rows)
        pixels = np.stack([np.column_stack(np.broadcast_arrays(u, v)) for u, v in sides])
        ends = geometry.on_ground(pixels) - base  # (4, 33, 2)
        u, v = geometry.project(geometry.lifted(base, 0.0))
        down = bool(0.0 <= u <= width and 0.0 <= v <= height)  # the base is in the image
        ahead = geometry.on_ground(np.array([0.5 * width, 0.5 * height])) - base if down else ends[0, 16]
        length = float(np.linalg.norm(ahead))
        if not (down or length > 0.0):  # the middle of the lower border is no ground
            return None
        ahead = ahead / length if length > _STRAIGHT_DOWN else np.array([1.0, 0.0])
        points = base + _RANGES[:, None] * ahead
        foot = geometry.project(geometry.lifted(points, 0.0))
        tall = foot[:, 1] - geometry.project(geometry.lifted(points, size[2]))[:, 1]
        wide = tall * size[1] / size[2]
        edges = foot[:, [0, 1, 0, 1]] + np.column_stack([-0.5 * wide, -tall, 0.5 * wide, 0.0 * tall])
        spread = self._placed(_Boxes(edges, foot, wide, tall, np.tile(size, (len(foot), 1))))[2]
        reach = np.linalg.norm(ends, axis=2)
        far = float(_RANGES[spread <= self.error.largest].max(initial=0.0))
        far = far if np.isnan(reach).any() else min(far, float(reach.max()))  # beyond the horizon, or all is ground
        sector, near = (-math.pi, math.pi), 0.0
        if not down:
            angles = np.arctan2(ends @ (ahead @ _QUARTER), ends @ ahead)
            sector = float(np.nanmin(angles)), float(np.nanmax(angles))
            near = float(np.nanmin(reach))
        if not (near < far and sector[0] < sector[1]):
            return None
        half = 0.5 * math.atan2(ahead[1], ahead[0])
        pose = Pose(geometry.lifted(base, 0.0), np.array([math.cos(half), 0.0, 0.0, math.sin(half)]))
        return FieldOfView(sector, range=(near, far), pose=pose)

    def view_from(self, pose: Pose | None) -> FieldOfView | None:
        """Return the field of view in the world, for a pose of the vehicle."""
        view = self.field_of_view
        if view is None or pose is None or view.pose is None:
            return view
        (w, *vector), (other, *rest) = pose.quaternion, view.pose.quaternion
        turned = other * np.array(vector) + w * np.array(rest) + np.cross(vector, rest)
        quaternion = np.array([w * other - np.dot(vector, rest), *turned])
        return view.at(Pose(pose.rotation @ view.pose.translation + pose.translation, quaternion))


_QUARTER: Final = np.array([[0.0, 1.0], [-1.0, 0.0]])  # turns rows to the left


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.einsum("mi,mi->m", one, other))


def _outer(vector: Array, variance: Array) -> Array:
    return np.asarray(vector[:, :, None] * vector[:, None] * variance[:, None, None])


def _behind(boxes: _Boxes, seen: Array, cut: Any) -> tuple[Array, Array, Array]:
    """Return how far centres are behind the feet (M,), and its standard deviations along and across the ray."""
    length, wide = boxes.size[:, 0], boxes.size[:, 1]
    whole = np.hypot(length, wide)
    turn = np.arcsin(np.clip(seen, wide, whole) / whole) - np.arctan2(wide, length)
    sure = ~np.isnan(boxes.width) & ~cut
    behind = np.where(sure, 0.5 * (length * np.cos(turn) + wide * np.sin(turn)), 0.25 * (length + wide))
    spread = np.abs(length - wide)
    along = np.where(sure, 0.15 * spread + 0.1, spread / math.sqrt(12.0))
    return behind, along, np.where(cut, 0.5 * np.maximum(0.0, length - seen), 0.0)

"""Calibration of a camera from points whose pixels and places are known.

With the intrinsics of the lens: the pose, by the direct linear transform of the rays, then by least squares of the
pixels (Levenberg-Marquardt). Without: the homography of pixels and ground, by the normalised direct linear transform.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, quaternion_of

if TYPE_CHECKING:
    from optipmb import GroundCamera

LARGEST_RMS: Final = 20.0
"""Root mean square of the residuals, px, from which a calibration is refused."""
IN_PLANE: Final = 4
"""Least points on the ground; no residual is left of so many."""
_IN_SPACE: Final = 6
_FLAT: Final = 1e-6  # m, difference of heights up to which points are of one
_ON_LINE: Final = 1e-3  # height of the flattest triangle of three points, as a part of its longest side


@dataclass(frozen=True)
class Fit:
    """A calibration, and how well the points fit it."""

    document: dict[str, Any]  # as in the file
    camera: "GroundCamera"
    pixels: Floats  # (N, 2) of the points
    points: Floats  # (N, 3) m
    residual_px: Floats  # (N,)
    residual_m: Floats  # (N,) on the ground; NaN where the ground is not seen

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, px."""
        return float(np.sqrt(np.mean(self.residual_px**2)))


def fit(path: Path, pixels: Floats, points: Floats, image: tuple[int, int], lens: Mapping[str, Any] | None) -> Fit:
    """Return the calibration of a camera.

    Args:
        path: of the points, for errors.
        pixels: (N, 2).
        points: (N, 3) in the world, m.
        image: width and height, px.
        lens: `intrinsics`, `distortion` and `model`; None: they are unknown.

    Raises:
        DatasetError: The points are too few, three of four are on one line, or some are beyond the horizon.
    """
    from optipmb import GroundCamera, ParameterError  # noqa: PLC0415  loads the tracker

    flat = bool(np.ptp(points[:, 2]) < _FLAT)
    least = IN_PLANE if flat or lens is None else _IN_SPACE
    if len(points) < least:
        raise DatasetError(path, f"at least {least} points", str(len(points)))
    if len(points) == IN_PLANE and (_on_line(points[:, :2]) or _on_line(pixels)):
        raise DatasetError(path, "four points of which no three are on one line", "three on a line")
    if (outside := (pixels < -1.0).any(axis=1) | (pixels > np.array(image) + 1.0).any(axis=1)).any():
        row = int(np.argmax(outside))
        how = f"pixels u, v of the image of {image[0]} x {image[1]}"
        raise DatasetError(path, how, f"{pixels[row].tolist()} of point {row + 1}: are u and v exchanged?")
    document: dict[str, Any] = {"image": list(image), "error": {"largest": 1e4}}
    middle = np.append(points[:, :2].mean(axis=0), 0.0)  # coordinates of maps have millions of metres
    near = points - middle
    if lens is None:
        if not flat:
            raise DatasetError(
                path, "points on the ground, of one z, or --intrinsics", f"z differs by {np.ptp(points[:, 2]):g}"
            )
        matrix = _homography(pixels, near[:, :2])
        side = np.insert(pixels, 2, 1.0, axis=1) @ matrix[2]
        matrix[:2] += middle[:2, None] * matrix[2]
        document["homography"] = {"matrix": matrix.tolist(), "reference": pixels.mean(axis=0).tolist()}
        seen = bool((side > 0.0).all() or (side < 0.0).all())
    else:
        rotation, position, seen = _pose(pixels, near, lens, flat=flat)
        place = {"position": (position + middle).tolist(), "quaternion": quaternion_of(rotation).tolist()}
        document["pinhole"] = {**lens, **place, "ground": float(points[0, 2]) if flat else 0.0}
    if not seen:
        raise DatasetError(path, "points on one side of the horizon, in front of the camera", "points on both sides")
    try:
        camera = GroundCamera.parse(document)
    except ParameterError as error:
        raise DatasetError(path, f"points of a camera that sees ground: {error.expected}", error.received) from error
    off = np.linalg.norm(camera.project(points) - pixels, axis=1)
    away = np.linalg.norm(camera.ground(pixels) - points[:, :2], axis=1)
    return Fit(document, camera, pixels, points, off, away if flat else np.full(len(points), np.nan))


def odd_point(path: Path, found: Fit, lens: Mapping[str, Any] | None) -> tuple[int, float] | None:
    """Return the point whose removal lowers the RMS most, if by half, and how far it is off then, px."""
    best: tuple[float, int, float] | None = None
    for point in range(len(found.points)):
        kept = np.arange(len(found.points)) != point
        try:
            rest = fit(path, found.pixels[kept], found.points[kept], found.camera.image, lens)
        except DatasetError:
            continue
        off = float(np.linalg.norm(rest.camera.project(found.points[point]) - found.pixels[point]))
        if len(rest.points) > IN_PLANE and (best is None or rest.rms < best[0]):
            best = (rest.rms, point, off)
    return None if best is None or best[0] > 0.5 * found.rms else best[1:]


def horizon_row(camera: "GroundCamera") -> float:
    """Return the row of the horizon in the middle column of the image, px."""
    u = 0.5 * camera.image[0]
    rows = np.linspace(-2.0 * camera.image[1], 2.0 * camera.image[1], 40_001)
    ground = np.isfinite(camera.ground(np.column_stack([np.full(len(rows), u), rows]))).all(axis=1)
    return float(rows[np.argmax(ground)])


def error_at(camera: "GroundCamera", reach: float, off: float) -> float:
    """Return the error on the ground, m, of a pixel that is too high, at a range straight ahead; NaN: not seen."""
    view = camera.field_of_view
    if view is None or view.pose is None:
        return float("nan")
    place = view.pose.rotation @ [reach, 0.0, 0.0] + view.pose.translation
    pixel = camera.project(place)
    return float(np.linalg.norm(camera.ground(pixel - (0.0, off)) - camera.ground(pixel)))


def toml(document: Mapping[str, Any]) -> str:
    """Return a calibration as TOML."""
    lines = [f"{name} = {_toml(value)}" for name, value in document.items() if not isinstance(value, dict)]
    for name, table in document.items():
        if isinstance(table, dict):
            lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, list | tuple) else repr(value).replace("'", '"')


def _on_line(points: Floats) -> bool:
    for left_out in range(len(points)):
        a, b, c = np.delete(points, left_out, axis=0)
        longest = max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a))
        if abs(np.linalg.det(np.stack([b - a, c - a]))) <= _ON_LINE * longest**2:
            return True
    return False


def _linear(source: Floats, target: Floats) -> Floats:
    """Return the matrix (3, K + 1) that maps points (N, K) to points (N, 2) of a plane, up to a factor."""
    moved, scaled = ((one - one.mean(axis=0)) / max(float(one.std()), 1e-9) for one in (source, target))
    points = np.insert(moved, moved.shape[1], 1.0, axis=1)
    zero = np.zeros_like(points)
    rows = np.vstack(
        [np.hstack([points, zero, -scaled[:, :1] * points]), np.hstack([zero, points, -scaled[:, 1:] * points])]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, -1)
    from_source, from_target = (_normal(one) for one in (source, target))
    return np.asarray(np.linalg.inv(from_target) @ matrix @ from_source)


def _normal(points: Floats) -> Floats:
    size = points.shape[1]
    matrix = np.eye(size + 1) / max(float(points.std()), 1e-9)
    matrix[:size, size] = -points.mean(axis=0) / max(float(points.std()), 1e-9)
    matrix[size, size] = 1.0
    return matrix


def _homography(pixels: Floats, ground: Floats) -> Floats:
    matrix = _linear(pixels, ground)
    return np.asarray(matrix / np.abs(matrix).max())


def _pose(pixels: Floats, points: Floats, lens: Mapping[str, Any], *, flat: bool) -> tuple[Floats, Floats, bool]:
    """Return world from camera (3, 3), the camera's place (3,), and whether all points are in front of it."""
    from scipy.optimize import least_squares  # noqa: PLC0415  an extra
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  as above

    from optipmb.cameras.camera_lens import Lens  # noqa: PLC0415  loads the tracker

    own = Lens.model_validate(lens)
    rays = own.rays(pixels)
    used = points[:, :2] if flat else points
    matrix = _linear(used, rays[:, :2] / rays[:, 2:])
    matrix /= np.linalg.norm(matrix[:, :2], axis=0).mean()
    if (np.insert(used, used.shape[1], 1.0, axis=1) @ matrix[2]).sum() < 0.0:
        matrix = -matrix
    if flat:
        across = np.cross(matrix[:, 0], matrix[:, 1])
        shift = matrix[:, 2] - across * points[0, 2]
        matrix = np.column_stack([matrix[:, :2], across, shift])
    left, _, right = np.linalg.svd(matrix[:, :3])
    start = left @ np.diag([1.0, 1.0, float(np.linalg.det(left @ right))]) @ right

    def off(values: Floats) -> Floats:
        moved = points @ Rotation.from_rotvec(values[:3]).as_matrix().T + values[3:]
        return np.nan_to_num(own.pixels(moved) - pixels, nan=1e4).ravel()

    first = np.concatenate([Rotation.from_matrix(start).as_rotvec(), matrix[:, 3]])
    values = least_squares(off, first, method="lm").x
    rotation = Rotation.from_rotvec(values[:3]).as_matrix()
    front = bool(((points @ rotation.T + values[3:])[:, 2] > 0.0).all())
    return rotation.T, -rotation.T @ values[3:], front

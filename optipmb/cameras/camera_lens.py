"""The lens of a camera: pixels from rays and back, by the models of OpenCV.

With x = X / Z, y = Y / Z in the axes of the camera and r^2 = x^2 + y^2, a lens of the model `opencv` has its image at

    x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)

and likewise in y, with p1 and p2 exchanged. A `fisheye` has it at theta (1 + k1 theta^2 + .. + k4 theta^8) from the
middle, theta the angle from the axis. Both are inverted by Newton's method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from optipmb.model.errors import ParameterError
from optipmb.model.parameters import ParameterTable, Positive

if TYPE_CHECKING:
    from optipmb.model.rows import Array

Intrinsics = tuple[Positive, Positive, float, float]
STEPS: Final = 30
"""Most steps of Newton's method."""
EXACT: Final = 1e-10
"""Error of an inverted distortion, as a part of the focal length, from which a pixel has no ray."""


class Lens(ParameterTable):
    """A lens without a place.

    Attributes:
        intrinsics: fx, fy, cx, cy, px.
        distortion: k1 k2 p1 p2 (k3 (k4 k5 k6)), or k1 k2 k3 k4 of a fisheye.
        model: of the distortion.
    """

    intrinsics: Intrinsics | None = None
    distortion: Annotated[tuple[float, ...], Field(max_length=8)] = ()
    model: Literal["opencv", "fisheye"] = "opencv"

    @model_validator(mode="after")
    def _counted(self) -> Self:
        counts = (0, 4, 5, 8) if self.model == "opencv" else (0, 4)
        if len(self.distortion) not in counts:
            expected = f"{', '.join(map(str, counts[:-1]))} or {counts[-1]} numbers"
            raise ParameterError("distortion", expected, str(len(self.distortion)))
        if self.distortion and self.intrinsics is None:
            raise ParameterError("intrinsics", "four numbers beside a distortion", "none")
        return self

    def rays(self, pixels: Array) -> Array:
        """Return the rays (..., 3) of pixels (..., 2): x right, y down, z forward; NaN where the lens has none."""
        fx, fy, cx, cy = self._numbers
        bent = (pixels - (cx, cy)) / (fx, fy)
        if self.model == "fisheye":
            return _fisheye_rays(bent, self._terms)
        flat = _straightened(bent, self._terms) if any(self.distortion) else bent
        return np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)

    def pixels(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in the axes of the camera; NaN of those behind it."""
        fx, fy, cx, cy = self._numbers
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == "fisheye":
                away = np.hypot(points[..., 0], points[..., 1])
                angle = np.arctan2(away, points[..., 2])
                bent = points[..., :2] * (_fisheye(angle, self._terms)[0] / np.where(away > 0.0, away, 1.0))[..., None]
            else:
                flat = np.where(points[..., 2:] > 0.0, points[..., :2] / points[..., 2:], np.nan)
                bent = _bent(flat, self._terms)[0]
        return np.asarray(bent * (fx, fy) + (cx, cy))

    def flat(self, pixels: Array) -> Array:
        """Return the pixels (..., 2) that a lens without distortion would have in their place."""
        if self.intrinsics is None:
            return pixels
        fx, fy, cx, cy = self._numbers
        return np.asarray(self.rays(pixels)[..., :2] * (fx, fy) + (cx, cy))

    def curved(self, flat: Array) -> Array:
        """Return the pixels (..., 2) of a lens without distortion as this one has them: the inverse of `flat`."""
        if self.intrinsics is None:
            return flat
        fx, fy, cx, cy = self._numbers
        return self.pixels(np.insert((flat - (cx, cy)) / (fx, fy), 2, 1.0, axis=-1))

    @property
    def _numbers(self) -> tuple[float, float, float, float]:
        return self.intrinsics or (1.0, 1.0, 0.0, 0.0)

    @property
    def _terms(self) -> tuple[float, ...]:
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))


def _bent(flat: Array, terms: tuple[float, ...]) -> tuple[Array, Array, Array, Array]:
    """Return the distorted points (..., 2) and the derivatives d x / d x, d x / d y = d y / d x and d y / d y."""
    k1, k2, p1, p2, k3, k4, k5, k6 = terms
    x, y = flat[..., 0], flat[..., 1]
    rr = x * x + y * y
    below = 1.0 + rr * (k4 + rr * (k5 + rr * k6))
    scale = (1.0 + rr * (k1 + rr * (k2 + rr * k3))) / below
    slope = 2.0 * (k1 + rr * (2.0 * k2 + rr * 3.0 * k3) - scale * (k4 + rr * (2.0 * k5 + rr * 3.0 * k6))) / below
    bent_x = x * scale + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x)
    bent_y = y * scale + 2.0 * p2 * x * y + p1 * (rr + 2.0 * y * y)
    xx = scale + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    yy = scale + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return np.stack([bent_x, bent_y], -1), xx, x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y, yy


def _straightened(bent: Array, terms: tuple[float, ...]) -> Array:
    """Return the points (..., 2) whose distortion is `bent`; NaN where the distortion has no inverse."""
    flat = bent.copy()
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            now, xx, xy, yy = _bent(flat, terms)
            ex, ey = np.moveaxis(now - bent, -1, 0)
            if not (np.abs(ex) + np.abs(ey) > EXACT).any():
                break
            flat -= np.stack([yy * ex - xy * ey, xx * ey - xy * ex], -1) / (xx * yy - xy * xy)[..., None]
        good = (np.abs(ex) + np.abs(ey) <= EXACT) & (xx > 0.0) & (xx * yy > xy * xy)
    return np.where(good[..., None], flat, np.nan)


def _fisheye(angle: Array, terms: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the distance from the middle at an angle from the axis, and its derivative."""
    k1, k2, k3, k4 = terms[:4]
    a = angle * angle
    polynomial = 1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4)))
    return angle * polynomial, 1.0 + a * (3.0 * k1 + a * (5.0 * k2 + a * (7.0 * k3 + a * 9.0 * k4)))


def _fisheye_rays(bent: Array, terms: tuple[float, ...]) -> Array:
    away = np.hypot(bent[..., 0], bent[..., 1])
    angle = np.minimum(away, 0.5 * np.pi)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            error, slope = _fisheye(angle, terms)
            error = error - away
            if not (np.abs(error) > EXACT).any():
                break
            angle = angle - error / slope
        good = (np.abs(error) <= EXACT) & (slope > 0.0) & (angle >= 0.0) & (angle <= np.pi)
    angle = np.where(good, angle, np.nan)
    side = bent * (np.sin(angle) / np.where(away > 0.0, away, 1.0))[..., None]
    return np.concatenate([side, np.cos(angle)[..., None]], axis=-1)

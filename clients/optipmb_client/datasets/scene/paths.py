"""Paths in the plane that are walked by arc length.

Conventions: metres, world frame. A path holds points at equal distances `STEP` along itself, so that a place on it is
found by index. The side of a path is positive to the right of the direction of travel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optipmb_client.geometry import Floats, Ints

STEP = 0.25
"""Distance between neighbouring points of a path."""


@dataclass(frozen=True)
class Path:
    """A smooth curve sampled every `STEP` metres."""

    points: Floats
    """(K, 2)"""

    @property
    def length(self) -> float:
        """Arc length in metres."""
        return (len(self.points) - 1) * STEP

    def at(self, s: Floats | float) -> Floats:
        """Return the points (..., 2) at arc lengths (...); beyond an end it goes on straight."""
        which = np.zeros(np.shape(s), dtype=np.int64)
        return interpolate(self.points[None], which, np.asarray(s, dtype=np.float64), len(self.points))


def side_by_side(paths: Sequence[Path]) -> Floats:
    """Return the points (N, K, 2) of paths, the shorter ones with their last point repeated."""
    longest = max((len(path.points) for path in paths), default=0)
    padded = [np.pad(path.points, ((0, longest - len(path.points)), (0, 0)), "edge") for path in paths]
    return np.stack(padded) if padded else np.empty((0, 0, 2))


def interpolate(points: Floats, which: Ints, s: Floats, count: Ints | int) -> Floats:
    """Return places (..., 2) on one of many paths (N, K, 2) at arc lengths (...); `count` (...) of its points count."""
    place = s / STEP
    # Not np.clip, which takes three times as long for the few numbers that these are.
    index = np.maximum(np.minimum(np.floor(place).astype(np.int64), count - 2), 0)
    part = (place - index)[..., None]
    return np.asarray(points[which, index] * (1.0 - part) + points[which, index + 1] * part, dtype=np.float64)


def resample(points: Floats) -> tuple[Path, Floats]:
    """Return the path along corner points (K, 2), and the arc length (K,) of each of them on it."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    s = np.arange(int(np.floor(arc[-1] / STEP)) + 1) * STEP
    return Path(np.column_stack([np.interp(s, arc, points[:, 0]), np.interp(s, arc, points[:, 1])])), arc


def smooth(path: Path, window: float) -> tuple[Path, Floats]:
    """Return the path averaged over `window` metres, which turns corners and jumps of curvature into bends.

    The second result maps old places to new ones: the new arc length (K,) of each old point.
    """
    half = max(1, round(0.5 * window / STEP))
    padded = np.pad(path.points, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    total = np.cumsum(np.vstack([np.zeros((1, 2)), padded]), axis=0)
    return resample((total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1))


def normals(path: Path) -> Floats:
    """Return the unit vectors (K, 2) to the right of the path."""
    tangent = np.gradient(path.points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    return np.column_stack([tangent[:, 1], -tangent[:, 0]])


def wander(path: Path, rng: np.random.Generator, amplitude: float, wavelength: float) -> Path:
    """Return the path with a slow sideways sway of about `amplitude` metres."""
    s = np.arange(len(path.points)) * STEP
    waves = wavelength * rng.uniform(0.6, 1.8, size=3)
    phases = rng.uniform(0.0, 2.0 * np.pi, size=3)
    sway = amplitude / np.sqrt(3.0) * np.sin(2.0 * np.pi * s[:, None] / waves + phases).sum(axis=1)
    return Path(path.points + sway[:, None] * normals(path))


def curvature(path: Path) -> Floats:
    """Return the unsigned curvature (K,) in 1/m."""
    first = np.gradient(path.points, STEP, axis=0)
    second = np.gradient(first, STEP, axis=0)
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(np.abs(cross) / np.maximum(np.linalg.norm(first, axis=1), 1e-9) ** 3, dtype=np.float64)


def speed_limit(path: Path, cruise: float, sideways: float, braking: float) -> Floats:
    """Return the speed (K,) that keeps the sideways acceleration below a bound and is reached by braking in time."""
    free = np.minimum(cruise, np.sqrt(sideways / np.maximum(curvature(path), 1e-6)))
    slope = 2.0 * braking * STEP * np.arange(len(free))
    # v(s)^2 <= v(t)^2 + 2 b (t - s) for every later t: a running minimum from the end.
    return np.asarray(np.sqrt(np.minimum.accumulate((free**2 + slope)[::-1])[::-1] - slope), dtype=np.float64)

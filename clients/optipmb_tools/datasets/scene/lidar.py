"""A spinning LiDAR among boxes on flat ground, by ray casting.

Conventions: the sensor stands level at the origin of its frame, x forward, z up, metres, radians. The scan is taken at
one instant. Rays are beams (elevations) by azimuths. As all boxes stand upright, a ray meets the sides of a box at a
horizontal distance that depends on its azimuth alone, and its top, its bottom and the ground at one that depends on its
elevation alone; so the test of a box against its sector of the scan is one comparison per ray, for all boxes at once.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.geometry import Bools, Floats, Ints, box_corners, wrap_angle

BEAMS: Floats = np.array(
    np.radians(np.concatenate([np.linspace(-24.0, -6.5, 12), np.linspace(-5.5, 3.5, 20)])), dtype=np.float64
)
"""Elevations of the 32 beams: sparse on the near ground, dense where objects are."""
AZIMUTHS = 900
RANGE = 80.0
GROUND = -1  # owner of a ray that ends on the ground
NOTHING = -2  # owner of a ray that ends nowhere

_PARALLEL = 1e-12  # slopes below this count as this, which keeps divisions finite
_TANGENT = np.tan(BEAMS)
_COSINE = np.cos(BEAMS)
_STEP = 2.0 * np.pi / AZIMUTHS
_AZIMUTH = np.linspace(-np.pi, np.pi, AZIMUTHS, endpoint=False)
# Of every ray, beam by beam: the level part of a unit along it and the upward one, and where the level part points.
_LEVEL, _UP = np.repeat(_COSINE, AZIMUTHS), np.repeat(np.sin(BEAMS), AZIMUTHS)
_FORWARD, _LEFT = np.tile(np.cos(_AZIMUTH), len(BEAMS)), np.tile(np.sin(_AZIMUTH), len(BEAMS))


@dataclass(frozen=True)
class Scan:
    """What a scan hit."""

    xyz: NDArray[np.float32]  # (P, 3) returned points with noise
    owner: Ints  # (P,) index of the box that returned the point, or `GROUND`
    points: Ints  # (N,) returned points on each box
    covered: Floats  # (N,) fraction of the rays that would meet the box but are stopped before it; NaN where none would


def cast(center: Floats, size: Floats, yaw: Floats, height: float) -> tuple[Floats, Ints, Floats]:
    """Return where the rays end, without noise.

    Args:
        center: (N, 3) of the boxes, sensor frame.
        size: (N, 3)
        yaw: (N,)
        height: of the sensor above the ground.

    Returns:
        Horizontal distance (beams, azimuths), owner (beams, azimuths), and the covered fraction (N,).
    """
    with np.errstate(divide="ignore"):
        ground = np.where(_TANGENT < 0.0, -height / _TANGENT, np.inf)
    distance = np.repeat(ground[:, None], AZIMUTHS, axis=1)
    owner = np.full(distance.shape, GROUND, dtype=np.int64)
    far = distance > RANGE * _COSINE[:, None]
    distance[far], owner[far] = np.inf, NOTHING
    bearing = np.arctan2(center[:, 1], center[:, 0])
    corners = box_corners(center, size, yaw)[:, :4, :2]
    spread = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    first = np.ceil((bearing + spread.min(axis=1) + np.pi) / _STEP).astype(np.int64)
    last = np.floor((bearing + spread.max(axis=1) + np.pi) / _STEP).astype(np.int64)
    # The azimuths of all boxes one after the other: (C,) of which box, and which.
    width = np.maximum(last - first + 1, 0)
    box = np.repeat(np.arange(len(center)), width)
    column = (np.arange(len(box)) - np.repeat(np.cumsum(width) - width - first, width)) % AZIMUTHS
    enter, leave = _sides(center[box], size[box], yaw[box], _AZIMUTH[column])
    low, high = _heights(center[:, 2] - 0.5 * size[:, 2], center[:, 2] + 0.5 * size[:, 2])
    near = np.maximum(enter[:, None], low[box])
    hit = (near <= np.minimum(leave[:, None], high[box])) & (near < RANGE * _COSINE)
    aimed = np.bincount(box, hit.sum(axis=1), len(center))
    # Of the boxes that a ray meets the nearest one is taken, of equally near ones the first.
    place, beam = np.nonzero(hit)
    ray, met, reach = beam * AZIMUTHS + column[place], box[place], near[place, beam]
    order = np.lexsort((reach, ray))
    nearest = order[np.diff(ray[order], prepend=-1) > 0]
    nearest = nearest[reach[nearest] < distance.ravel()[ray[nearest]]]
    np.put(distance, ray[nearest], reach[nearest])
    np.put(owner, ray[nearest], met[nearest])
    stopped = aimed - np.bincount(owner[owner >= 0], minlength=len(center))
    return distance, owner, np.where(aimed > 0, stopped / np.maximum(aimed, 1.0), np.nan)


def _sides(center: Floats, size: Floats, yaw: Floats, azimuth: Floats) -> tuple[Floats, Floats]:
    """Return the horizontal distances (C,) at which rays of these azimuths enter and leave the outlines of C boxes."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    origin = (-cos * center[:, 0] - sin * center[:, 1], sin * center[:, 0] - cos * center[:, 1])
    enter, leave = np.zeros(len(azimuth)), np.full(len(azimuth), np.inf)
    for axis, way in enumerate((np.cos(azimuth - yaw), np.sin(azimuth - yaw))):
        slope = np.where(np.abs(way) < _PARALLEL, _PARALLEL, way)
        a, b = (-0.5 * size[:, axis] - origin[axis]) / slope, (0.5 * size[:, axis] - origin[axis]) / slope
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    return enter, leave


def _heights(bottom: Floats, top: Floats) -> tuple[Floats, Floats]:
    """Return the horizontal distances (N, beams) between which the beams are between two heights (N,)."""
    slope = np.where(np.abs(_TANGENT) < _PARALLEL, _PARALLEL, _TANGENT)
    a, b = bottom[:, None] / slope, top[:, None] / slope
    return np.maximum(np.minimum(a, b), 0.0), np.maximum(a, b)


def scan(center: Floats, size: Floats, yaw: Floats, height: float, rng: np.random.Generator) -> Scan:
    """Return a scan with range noise and lost returns; arguments as in `cast`."""
    distance, owner, covered = cast(center, size, yaw, height)
    ray = np.flatnonzero(owner != NOTHING)
    target = owner.ravel()[ray]
    reach = distance.ravel()[ray] / _LEVEL[ray]
    part = reach / RANGE
    lost = np.where(target == GROUND, 0.05 + 0.5 * part, 0.03 + 0.12 * part**2)
    kept: Bools = rng.random(len(reach)) >= lost
    reach = reach + rng.laplace(0.0, 0.012, len(reach)) * (1.0 + part)
    ray, target, reach = ray[kept], target[kept], reach[kept]
    level = reach * _LEVEL[ray]
    xyz = np.empty((len(ray), 3), dtype=np.float32)
    for axis, values in enumerate((level * _FORWARD[ray], level * _LEFT[ray], reach * _UP[ray])):
        xyz[:, axis] = values
    return Scan(
        xyz,
        target,
        np.bincount(target[target >= 0], minlength=len(center)).astype(np.int64),
        covered,
    )

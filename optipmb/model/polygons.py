"""Polygons in the world frame: checks, and whether a place is inside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb.model.rows import Array


LEAST_CORNERS: Final = 3


@kernel
def inside(corners: Array, x: float, y: float) -> bool:
    """Return whether a place is inside the polygon with these corners (K, 2)."""
    found, count = False, corners.shape[0]
    for j in range(count):
        x1, y1 = corners[j]
        x2, y2 = corners[(j + 1) % count]
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
            found = not found
    return found


def check_polygon(path: str, polygon: Sequence[tuple[float, float]], most: int) -> None:
    """Refuse a polygon of fewer than 3 or more than `most` corners, with others than finite places, or crossed edges.

    Raises:
        ParameterError: with the path.
    """
    if not LEAST_CORNERS <= len(polygon) <= most:
        raise ParameterError(path, f"{LEAST_CORNERS} to {most} points", str(len(polygon)))
    if np.shape(polygon) != (len(polygon), 2) or not np.isfinite(polygon).all():
        raise ParameterError(path, "points of two finite numbers", str(polygon)[:200])
    if crosses_itself(polygon):
        raise ParameterError(path, "edges that do not cross", "others")


def crosses_itself(polygon: Sequence[tuple[float, float]]) -> bool:
    """Return whether two edges that are no neighbours touch, or one turns back on itself."""
    edges = np.array([(*one, *two) for one, two in zip(polygon, (*polygon[1:], polygon[0]), strict=True)])

    def side(x: Array, y: Array) -> Array:
        x1, y1, x2, y2 = (one[:, None] for one in edges.T)
        return np.asarray(np.sign((x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)))

    first, second = side(edges[:, 0], edges[:, 1]), side(edges[:, 2], edges[:, 3])
    apart = first * second > 0
    low, high = np.minimum(edges[:, :2], edges[:, 2:]), np.maximum(edges[:, :2], edges[:, 2:])
    boxes = ((low[:, None] <= high[None]) & (high[:, None] >= low[None])).all(axis=2)
    count = len(edges)
    step = (np.arange(count)[:, None] - np.arange(count)[None]) % count
    others = (step > 1) & (step < count - 1)
    return bool((~apart & ~apart.T & boxes & others).any()) or len(set(polygon)) < count

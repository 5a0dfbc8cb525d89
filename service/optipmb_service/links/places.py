"""Places in an area: where the world frames of streams lie, and which places are in a declared region."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.world.zones import Shapes, Zone, locate

if TYPE_CHECKING:
    from optipmb.model.rows import Array
    from optipmb_service.settings import LinkRegion

INSIDE: Final = 2
"""Value of `locate` inside a polygon."""


class WorldFrame(NamedTuple):
    """Place of a world frame in the plane of an area.

    Attributes:
        plane: frames of one number lie in one plane; places of different ones cannot be compared.
        x, y, yaw: origin and direction of the x axis.
    """

    plane: int = 0
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def turned(self, vector: Array) -> Array:
        """Return vectors (N, 2) along the axes of the plane."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return np.column_stack((cos * vector[:, 0] - sin * vector[:, 1], sin * vector[:, 0] + cos * vector[:, 1]))


def area_m2(region: LinkRegion) -> float:
    """Return the area of a region; infinite without a polygon."""
    if not region.polygon:
        return np.inf
    x, y = np.array(region.polygon).T
    return float(0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)))


def inside(region: LinkRegion, stream: str, place: Array) -> Array:
    """Return which places (N, 2) in the world frame of a stream are in a region."""
    named = np.full(len(place), fnmatchcase(stream, region.streams))
    if not region.polygon or not named.any():
        return named
    center = np.column_stack((place, np.zeros(len(place))))
    shapes = Shapes.of((Zone("region", polygon=region.polygon, margin=0.0),))
    found: Array = locate(center, np.full_like(place, np.nan), *shapes)[0][:, 0] == INSIDE
    return found

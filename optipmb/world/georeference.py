"""Latitude, longitude, height and true heading of a world frame whose origin is known.

    place = optipmb.Georeference((48.2650130, 11.6712300, 489.0), x_heading=90.0)
    lat, lon, alt, heading = place.to_geographic(tracks.center, tracks.yaw)

The world is the plane that touches the ellipsoid at the origin (z is up there), so it is exact at any distance: the
conversion goes through Earth-centred coordinates, without a map projection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np

from optipmb.model.errors import ParameterError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from optipmb.model.rows import Array

FARTHEST: Final = 100_000.0
"""Distance from the origin, m, beyond which coordinates are taken to be of another frame."""

_A: Final = 6_378_137.0  # WGS84: semi-major axis, m
_F: Final = 1.0 / 298.257223563  # flattening
_B: Final = _A * (1.0 - _F)
_E2: Final = _F * (2.0 - _F)


class Geographic(NamedTuple):
    """Geographic positions on WGS84; NaN beyond 100 km from the origin."""

    lat: Array
    """degrees, north positive"""
    lon: Array
    """degrees, east positive"""
    alt: Array
    """m above the ellipsoid"""
    heading: Array
    """degrees clockwise from true north at the position, in [0, 360)"""


@dataclass(frozen=True)
class Georeference:
    """Place of a world frame on the WGS84 ellipsoid.

    Args:
        origin: latitude and longitude of the world's origin in degrees, and its height above the ellipsoid in m.
        x_heading: direction of the world's x axis, degrees clockwise from true north; 90: x is east, y is north.

    Raises:
        ParameterError: a number is not finite or out of range.
    """

    origin: tuple[float, float, float]
    x_heading: float = 90.0

    def __post_init__(self) -> None:
        numbers = (*self.origin, self.x_heading)
        bounds = {"latitude": 90.0, "longitude": 180.0, "height": FARTHEST, "x_heading": 360.0}
        if len(numbers) != len(bounds):
            raise ParameterError("origin", "latitude, longitude and height", str(self.origin))
        for (name, most), value in zip(bounds.items(), numbers, strict=True):
            if not abs(value) <= most:
                raise ParameterError(f"origin.{name}", f"a number in [{-most:g}, {most:g}]", str(value))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the place that a text names: `LAT,LON,HEIGHT`, or `LAT,LON,HEIGHT,X_HEADING`.

        Raises:
            ParameterError: it names none.
        """
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in {3, 4}:
            raise ParameterError("origin", "LAT,LON,HEIGHT or LAT,LON,HEIGHT,X_HEADING", repr(text))
        return cls((numbers[0], numbers[1], numbers[2]), *numbers[3:])

    def to_geographic(self, center: ArrayLike, yaw: ArrayLike = 0.0) -> Geographic:
        """Return the positions of centres (N, 3) in the world, and the headings of yaws (N,), rad."""
        center = np.asarray(center, np.float64).reshape(-1, 3)
        center = np.where(np.linalg.norm(center, axis=1, keepdims=True) <= FARTHEST, center, np.nan)
        axes, place = self._axes()
        x, y, z = (center @ axes + place).T
        away = np.hypot(x, y)
        slope = np.arctan2(z * _A, away * _B)
        for _ in range(2):  # Bowring's formula: one round leaves 1e-9 m near the ground
            sine = z + _E2 / (1.0 - _E2) * _B * np.sin(slope) ** 3
            lat = np.arctan2(sine, away - _E2 * _A * np.cos(slope) ** 3)
            slope = np.arctan2((1.0 - _F) * np.sin(lat), np.cos(lat))
        lon = np.arctan2(y, x)
        alt = away * np.cos(lat) + z * np.sin(lat) - _A * np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
        yaw = np.broadcast_to(np.asarray(yaw, np.float64), lat.shape)
        dx, dy, dz = (np.stack((np.cos(yaw), np.sin(yaw)), axis=1) @ axes[:2]).T
        east = dy * np.cos(lon) - dx * np.sin(lon)
        north = dz * np.cos(lat) - np.sin(lat) * (dx * np.cos(lon) + dy * np.sin(lon))
        heading = np.degrees(np.arctan2(east, north)) % 360.0 % 360.0  # twice: -1e-20 % 360 is 360
        return Geographic(np.degrees(lat), np.degrees(lon), alt, heading)

    def to_world(self, lat: ArrayLike, lon: ArrayLike, alt: ArrayLike | None = None) -> Array:
        """Return positions (N, 3) in the world; without heights, those at the height of the origin."""
        lat, lon, alt = np.broadcast_arrays(
            *(np.asarray(one, np.float64) for one in (lat, lon, self.origin[2] if alt is None else alt))
        )
        axes, place = self._axes()
        return np.asarray((_earth_centred(np.radians(lat), np.radians(lon), alt) - place) @ axes.T)

    def _axes(self) -> tuple[Array, Array]:
        """Return the axes x, y, z of the world as rows (3, 3), and its origin (3,), Earth-centred."""
        lat, lon, turn = (math.radians(one) for one in (*self.origin[:2], self.x_heading))
        east = np.array([-math.sin(lon), math.cos(lon), 0.0])
        up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
        x = math.sin(turn) * east + math.cos(turn) * np.cross(up, east)
        origin = _earth_centred(np.array(lat), np.array(lon), np.array(self.origin[2]))
        return np.stack((x, np.cross(up, x), up)), origin


def _earth_centred(lat: Array, lon: Array, alt: Array) -> Array:
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    away = (normal + alt) * np.cos(lat)
    return np.stack((away * np.cos(lon), away * np.sin(lon), ((1.0 - _E2) * normal + alt) * np.sin(lat)), axis=-1)

"""Rules of an area: which streams are linked, where their world frames lie, passages and exits."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.joining.rejoin import Declared, Kinds, motion_of
from optipmb.model.class_names import common_name
from optipmb.world.zones import Shapes, Zone, locate

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb.model.rows import Array, Index
    from optipmb.world.zones import Point

KINDS: Final = ("", "car", "bicycle", "pedestrian")
"""Kinds of objects that are distinguished, by the common name of one of their classes; `""`: any other class."""
_KIND_OF: Final = {motion_of(name): number for number, name in enumerate(KINDS)}
AREA_M2: Final = 1e4
"""Area over which new objects are spread where nothing is known of them."""
MOTION: Final = Kinds(
    np.array([motion_of(name) for name in KINDS]),
    np.arange(len(KINDS)),
    np.full(len(KINDS), AREA_M2),
    Declared.of(None),
)


@lru_cache(maxsize=64)
def kinds_of(labels: tuple[str, ...]) -> Index:
    """Return the kind of each class; classes without a common name are of no kind, which fits all."""
    return np.array([_KIND_OF[motion_of(one)] if common_name(one) else 0 for one in labels], dtype=np.int64)


class Placement(NamedTuple):
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


@dataclass(frozen=True)
class Region:
    """Part of the view of streams: a polygon in their world frame; without one all of it."""

    streams: str = "*/*/*"
    polygon: tuple[Point, ...] = ()

    @property
    def area_m2(self) -> float:
        """Area of the polygon; infinite without one."""
        if not self.polygon:
            return np.inf
        x, y = np.array(self.polygon).T
        return float(0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)))

    def holds(self, stream: str, place: Array) -> Array:
        """Return which places (N, 2) in the world frame of a stream are inside."""
        named = np.full(len(place), fnmatchcase(stream, self.streams))
        if not self.polygon or not named.any():
            return named
        center = np.column_stack((place, np.zeros(len(place))))
        shapes = Shapes.of((Zone("region", polygon=self.polygon, margin=0.0),))
        inside: Array = locate(center, np.full_like(place, np.nan), *shapes)[0][:, 0] == INSIDE
        return inside


INSIDE: Final = 2
"""Value of `locate` inside a polygon."""


@dataclass(frozen=True)
class Passage:
    """Way between two views that objects take in a known time, s."""

    begin: Region
    end: Region
    s: tuple[float, float]


@dataclass(frozen=True)
class Rules:
    """How the tracks of an area are linked.

    Args:
        name: of the area.
        place: returns the place of a stream's world frame.
        passages: known ways between views.
        exits: regions whose ends are final, and whose beginnings are new objects.
        min_probability: least probability of a link.
        gap_s: longest time between two views.
        most: objects that are kept; then the oldest ended ones are dropped.
        embedding_model: model whose vectors are compared; empty: none are.
    """

    name: str
    place: Callable[[str], Placement] = lambda _: Placement()
    passages: tuple[Passage, ...] = ()
    exits: tuple[Region, ...] = ()
    min_probability: float = 0.97
    gap_s: float = 120.0
    most: int = 10_000
    embedding_model: str = ""

"""A world that moves under its objects: the same density in other coordinates (not in the paper).

After a loop closure, a fix of a satellite receiver or a change of map, a localisation moves each point p to

    p' = R(theta) p + t

in the new world, R a turn about z. Means and covariances move; speeds, turn rates and all without a place stay. The
motion model prefers no place or direction, so that tracks go on as if the world had always been so. The motion is
exact: it adds nothing to covariances.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Self, TypeVar

import numpy as np

from optipmb.model.density import PHI, Bernoullis, Poissons
from optipmb.model.errors import DensityError
from optipmb.model.frame import MAX_COORDINATE, Pose
from optipmb.model.lost_objects import PLACES, Lost, Tracklets
from optipmb.model.rows import read_only

if TYPE_CHECKING:
    from optipmb.model.density import Density
    from optipmb.model.lost_objects import Rejoining
    from optipmb.model.rows import Array

Place = tuple[float, float, float]
_Rows = TypeVar("_Rows", Bernoullis, Poissons)
_Tracks = TypeVar("_Tracks", Tracklets, Lost)


class Relocation(NamedTuple):
    """The motion from one world frame to the next.

    Attributes:
        x, y, z: t, m.
        theta: turn about z, rad.
    """

    x: float
    y: float
    z: float
    theta: float

    @classmethod
    def of(cls, pose: Pose) -> Self:
        """Return the motion that a pose of the old world in the new one is, but for its tilt."""
        w, _, _, z = pose.quaternion.tolist()
        x, y, height = pose.translation.tolist()
        return cls(x, y, height, 2.0 * math.atan2(z, w))

    def place(self, place: Place) -> Place:
        """Return where a place comes to."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        x, y, z = place
        return cos * x - sin * y + self.x, sin * x + cos * y + self.y, z + self.z

    def points(self, points: Array) -> Array:
        """Return where points (N, 2) come to."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        x, y = points[:, 0], points[:, 1]
        return np.column_stack((cos * x - sin * y + self.x, sin * x + cos * y + self.y))

    def pose(self, pose: Pose) -> Pose:
        """Return a pose in the new world."""
        cos, sin = math.cos(0.5 * self.theta), math.sin(0.5 * self.theta)
        w, x, y, z = pose.quaternion.tolist()
        turned = (cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w)
        x, y, z = pose.translation.tolist()
        return Pose(np.array(self.place((x, y, z))), np.array(turned))

    def density(self, density: Density) -> Density:
        """Return a density in the new world.

        Raises:
            DensityError: an object would be beyond all positions on Earth.
        """
        if not any(self):
            return density
        bernoulli, poisson = self._rows(density.bernoulli), self._rows(density.poisson)
        rejoining, sensor = density.rejoining, density.sensor
        if rejoining is not None:
            rejoining = self._rejoining(rejoining)
        if sensor is not None:
            cos, sin = math.cos(self.theta), math.sin(self.theta)
            vx, vy, turn, *evidence = sensor.tolist()
            v = cos * vx - sin * vy + turn * self.y, sin * vx + cos * vy - turn * self.x
            sensor = read_only(np.array([*v, turn, *evidence]))
        return replace(density, bernoulli=bernoulli, poisson=poisson, rejoining=rejoining, sensor=sensor)

    def _rejoining(self, state: Rejoining) -> Rejoining:
        turn = self._replace(x=0.0, y=0.0)

        def tracks(rows: _Tracks) -> _Tracks:
            points = {name: self.points(getattr(rows, name)) for name in ("begin", "end")}
            ways = {name: turn.points(getattr(rows, name)) for name in ("begin_velocity", "end_velocity")}
            return rows.replaced(yaw=rows.yaw + self.theta, **points, **ways)

        places = self.points(state.places.place.reshape(-1, 2)).reshape(-1, PLACES * 2)
        return replace(
            state,
            live=tracks(state.live),
            places=state.places.replaced(place=places),
            lost=tracks(state.lost),
            beginnings=state.beginnings.replaced(place=self.points(state.beginnings.place)),
            ends=state.ends.replaced(place=self.points(state.ends.place)),
            returns=state.returns.replaced(
                **{name: self.points(getattr(state.returns, name)) for name in ("start", "end")}
            ),
        )

    def _rows(self, rows: _Rows) -> _Rows:
        turn = np.eye(6)
        turn[:2, :2] = (math.cos(self.theta), -math.sin(self.theta)), (math.sin(self.theta), math.cos(self.theta))
        moved = type(rows).of(rows.words.copy())
        mean, auxiliary, covariance = moved.mean, moved.auxiliary, moved.covariance
        mean[:, :2] = self.points(mean[:, :2])
        heading = mean[:, PHI] + self.theta
        mean[:, PHI] = heading - 2.0 * math.pi * np.ceil((heading - math.pi) / (2.0 * math.pi))
        covariance[...] = turn @ covariance @ turn.T
        farthest = np.abs(mean[:, :2]).max(initial=0.0)
        if self.z:
            auxiliary[:, 3] += self.z
            farthest = max(farthest, np.nanmax(np.abs(auxiliary[:, 3]), initial=0.0))
        if farthest > MAX_COORDINATE:
            raise DensityError(f"{rows.part}.mean", f"coordinates up to {MAX_COORDINATE:g} m", f"{farthest:g}")
        return moved

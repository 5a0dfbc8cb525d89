"""Road users that follow their routes: who is where at which time.

Conventions: world frame, z up with the ground at 0, metres, seconds. Object 0 of the vehicles carries the sensor.

Vehicles follow one another by the intelligent driver model (Treiber, Hennecke and Helbing, 2000), keep the speed that a
bend allows, wait at the stop line until nobody whose way conflicts with theirs is on the crossing, and let pedestrians
cross. A body lies on its path with both axles, as a car does that is steered at its front. Pedestrians step aside for
each other, as much as a body is wide: two in one place would be one object to any detector. None of this is a motion
model of a tracker.
"""

import math
from dataclasses import dataclass

import numpy as np

from optipmb_client.datasets.scene.crossing import Crossing
from optipmb_client.datasets.scene.paths import STEP, Path, interpolate, resample, side_by_side, smooth
from optipmb_client.datasets.scene.routes import Route
from optipmb_client.geometry import Bools, Floats, Ints

_ACCELERATION = 1.6
_COMFORT = 2.0
_HARD = 6.0
_HEADWAY = 1.2
_STANDSTILL = 2.0
"""Gap to the vehicle in front when both stand, in metres."""
_AT_LINE = 0.6
_LOOK_AHEAD = 45.0
_FREE = 1e4
_WALK_ACCELERATION = 1.0
_APART = 1.1
"""Distance of two pedestrians, in metres, below which they give way."""
_FORESIGHT = 3.0
"""Seconds ahead within which they do so."""
_GIVE_WAY = 2.5
"""Acceleration per metre that the distance will be too small."""
_GIVE_WAY_LIMIT = 1.0
_BACK_TO_WAY, _DAMPING = 0.5, 1.5
"""Acceleration back to the own way per metre beside it, and per metre a second."""
_TO_THE_RIGHT = 0.05
"""So many metres two that would meet head-on count as right of each other."""
_BESIDE: Floats = np.array([-0.3, 0.0, 0.3])
"""Places on a pedestrian's way, from its own, that give the direction."""
_SETTLING = 60
"""Steps before the scene begins in which those who start in one place move apart."""


@dataclass(frozen=True)
class Motion:
    """Where some road users were at each frame."""

    center: Floats
    """(F, O, 2)"""
    yaw: Floats
    """(F, O)"""
    velocity: Floats
    """(F, O, 2)"""


class Vehicles:
    """The state of all driving vehicles and cyclists."""

    def __init__(self, routes: list[Route], size: Floats) -> None:
        self._routes = routes
        # Shorter routes go on at their last point; nobody gets there before the scene ends.
        self._points = side_by_side([route.path for route in routes])
        longest = self._points.shape[1]
        self._limit = np.stack([np.pad(r.limit, (0, longest - len(r.limit)), "edge") for r in routes])
        self._length, self._width = size[:, 0], size[:, 1]
        self._s = np.array([route.start for route in routes])
        self._all = np.arange(len(routes))
        self._next = [0] * len(routes)
        self._speed = self._limit[self._all, (self._s / STEP).astype(np.int64)] * 0.9

    def state(self) -> tuple[Floats, Floats, Floats]:
        """Return centres (N, 2), yaws (N,) and velocities (N, 2)."""
        front, rear = self._axles()
        along = front - rear
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return 0.5 * (front + rear), np.arctan2(along[:, 1], along[:, 0]), self._speed[:, None] * along

    def _axles(self) -> tuple[Floats, Floats]:
        reach = 0.3 * self._length
        return (
            interpolate(self._points, self._all, self._s + reach, self._points.shape[1]),
            interpolate(self._points, self._all, self._s - reach, self._points.shape[1]),
        )

    def step(self, h: float, crossing: Crossing) -> None:
        """Drive on for h seconds."""
        limit = self._limit[self._all, np.minimum((self._s / STEP).astype(np.int64), self._limit.shape[1] - 1)]
        gap, lead = self._leaders()
        acceleration = np.minimum(
            _follow(self._speed, limit, gap, lead, _STANDSTILL),
            _follow(self._speed, limit, self._lines(h, crossing), np.zeros(len(gap)), _AT_LINE),
        )
        speed = np.maximum(self._speed + h * np.clip(acceleration, -_HARD, _ACCELERATION), 0.0)
        self._s = self._s + 0.5 * h * (self._speed + speed)
        self._speed = speed

    def _leaders(self) -> tuple[Floats, Floats]:
        """Return the free way (N,) before each vehicle and the speed (N,) of what ends it."""
        center, yaw, velocity = self.state()
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        # A vehicle is three discs along its length.
        part = np.array([-1.0, 0.0, 1.0])
        reach = 0.5 * np.maximum(self._length - self._width, 0.0)
        discs = center[:, None] + part[None, :, None] * (reach[:, None] * heading)[:, None]
        ahead = np.arange(1.0, _LOOK_AHEAD, 1.0)
        along = self._s[:, None] + 0.5 * self._length[:, None] + ahead
        way = interpolate(self._points, self._all[:, None], along, self._points.shape[1])
        # Who is too far away to be met is left out. Way and discs of each pair: (P, A, 2) and (P, 3, 2).
        apart = np.linalg.norm(center[:, None] - center, axis=2)
        far = _LOOK_AHEAD + 0.5 * (self._length[:, None] + self._length) + self._width[:, None] + self._width
        one, two = np.nonzero((apart < far) & (self._all[:, None] != self._all))
        (x, y), (disc_x, disc_y) = np.moveaxis(way[one], 2, 0), np.moveaxis(discs[two], 2, 0)
        squared = [(x - disc_x[:, k, None]) ** 2 + (y - disc_y[:, k, None]) ** 2 for k in range(len(part))]
        close = np.sqrt(np.minimum(np.minimum(squared[0], squared[1]), squared[2]))
        touch = np.zeros((len(center), len(ahead), len(center)), dtype=np.bool_)
        touch[one, :, two] = close < 0.5 * (self._width[one] + self._width[two])[:, None] + 0.35
        hit = touch.any(axis=2)
        first = np.asarray(hit.argmax(axis=1), dtype=np.int64)
        blocked = np.take_along_axis(hit, first[:, None], axis=1)[:, 0]
        other = touch[self._all, first].argmax(axis=1)
        lead = np.einsum("nd,nd->n", velocity[other], heading)
        return np.where(blocked, ahead[first] + 0.3, _FREE), np.where(blocked, np.maximum(lead, 0.0), 0.0)

    def _lines(self, h: float, crossing: Crossing) -> Floats:
        """Return the way (N,) to the stop line of each vehicle that has no leave to cross it."""
        front, rear = self._s + 0.5 * self._length, self._s - 0.5 * self._length
        movements: dict[int, int] = {}
        distance: dict[int, float] = {}
        for i, route in enumerate(self._routes):
            if self._next[i] < len(route.gates) and rear[i] > route.gates[self._next[i]].clear:
                crossing.vehicles.pop(i, None)
                self._next[i] += 1
            if self._next[i] < len(route.gates):
                gate = route.gates[self._next[i]]
                movements[i], distance[i] = gate.movement, gate.stop - float(front[i])
                if i in crossing.vehicles:
                    crossing.vehicles[i] = (gate.movement, float(rear[i]) - gate.stop)
        crossing.ask(movements, distance, {i: self._speed[i] ** 2 / (2.0 * 1.5) + 8.0 for i in distance})
        crossing.grant(movements, h)
        free = np.full(len(front), _FREE)
        for i, gap in distance.items():
            if i not in crossing.vehicles:
                free[i] = max(gap, 0.05)
        return free


def _follow(speed: Floats, desired: Floats, gap: Floats, lead: Floats, standstill: float) -> Floats:
    """Return the acceleration of the intelligent driver model."""
    wanted = standstill + np.maximum(
        0.0,
        speed * _HEADWAY * (standstill / _STANDSTILL)
        + speed * (speed - lead) / (2.0 * np.sqrt(_ACCELERATION * _COMFORT)),
    )
    free = 1.0 - (speed / np.maximum(desired, 0.1)) ** 4
    return np.asarray(
        _ACCELERATION * (np.maximum(free, -1.5) - (wanted / np.maximum(gap, 0.05)) ** 2), dtype=np.float64
    )


class Walkers:
    """The state of all pedestrians."""

    def __init__(self, routes: list[Route]) -> None:
        self._routes = routes
        self._points = side_by_side([route.path for route in routes])
        self._count = np.array([[len(route.path.points)] for route in routes], dtype=np.int64).reshape(-1, 1)
        self._all = np.arange(len(routes))[:, None]
        self._s = [route.start for route in routes]
        self._speed = [0.8 * float(r.limit[int(r.start / STEP)]) for r in routes]
        self._gate = [sum(g.stop < r.start for g in r.gates) for r in routes]
        self._pause = [sum(p.stop < r.start for p in r.pauses) for r in routes]
        self._rest = [0.0] * len(routes)
        self._waited = [0.0] * len(routes)
        self._aside, self._drift = np.zeros((len(routes), 2)), np.zeros((len(routes), 2))
        for _ in range(_SETTLING):
            self._give_way(0.05)
        self._drift[:] = 0.0

    def state(self) -> tuple[Floats, Floats, Floats]:
        """Return centres (N, 2), yaws (N,) and velocities (N, 2)."""
        places = np.array(self._s)[:, None] + _BESIDE
        before, center, after = interpolate(self._points, self._all, places, self._count).transpose(1, 0, 2)
        along = after - before
        along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        velocity = np.asarray(self._speed)[:, None] * along + self._drift
        return center + self._aside, np.arctan2(along[:, 1], along[:, 0]), velocity

    def step(self, h: float, crossing: Crossing) -> None:
        """Walk on for h seconds."""
        self._give_way(h)
        crossing.impatient = set()
        for i, route in enumerate(self._routes):
            s = self._s[i]
            stop = min(self._kerb(i, h, crossing), self._resting_place(i, h))
            speed = self._speed[i]
            index = min(int(s / STEP), len(route.limit) - 1)
            wanted = min(float(route.limit[index]), math.sqrt(max(0.0, 2.0 * _WALK_ACCELERATION * (stop - s - 0.05))))
            new = speed + min(max(wanted - speed, -2.0 * _WALK_ACCELERATION * h), _WALK_ACCELERATION * h)
            self._s[i] = s + 0.5 * h * (speed + new)
            self._speed[i] = new

    def _give_way(self, h: float) -> None:
        """Step aside, for h seconds, for those who are or will be too near."""
        center, yaw, velocity = self.state()
        offset, approach = center[:, None] - center, velocity[:, None] - velocity
        squared = np.maximum((approach**2).sum(axis=2), 1e-9)
        ahead = np.clip(-(offset * approach).sum(axis=2) / squared, 0.0, _FORESIGHT)
        right = np.column_stack([np.sin(yaw), -np.cos(yaw)])
        nearest = offset + ahead[:, :, None] * approach + _TO_THE_RIGHT * right[:, None]
        distance = np.maximum(np.linalg.norm(nearest, axis=2), 1e-9)
        np.fill_diagonal(distance, np.inf)
        push = (_GIVE_WAY * np.maximum(_APART - distance, 0.0) / distance)[:, :, None] * nearest
        given = push.sum(axis=1)
        given *= np.minimum(1.0, _GIVE_WAY_LIMIT / np.maximum(np.linalg.norm(given, axis=1), 1e-9))[:, None]
        self._drift += h * (given - _BACK_TO_WAY * self._aside - _DAMPING * self._drift)
        self._aside += h * self._drift

    def _kerb(self, i: int, h: float, crossing: Crossing) -> float:
        """Return the arc length at which pedestrian i must stop for traffic."""
        gates = self._routes[i].gates
        if self._gate[i] < len(gates) and self._s[i] > gates[self._gate[i]].clear:
            crossing.walkers.pop(i, None)
            self._gate[i] += 1
        if self._gate[i] >= len(gates):
            return np.inf
        gate = gates[self._gate[i]]
        if i not in crossing.walkers and gate.stop - self._s[i] < 0.5:  # noqa: PLR2004 - half a metre before the kerb
            self._waited[i] += h
            if crossing.wait_on_foot(gate.movement, self._waited[i]):
                crossing.walkers[i] = gate.movement
                self._waited[i] = 0.0
        return np.inf if i in crossing.walkers else gate.stop

    def _resting_place(self, i: int, h: float) -> float:
        """Return the arc length at which pedestrian i stands for a while."""
        pauses = self._routes[i].pauses
        if self._pause[i] >= len(pauses):
            return np.inf
        pause = pauses[self._pause[i]]
        if pause.stop - self._s[i] < 0.2:  # noqa: PLR2004 - close enough to count as there
            self._rest[i] += h
            if self._rest[i] >= pause.seconds:
                self._rest[i] = 0.0
                self._pause[i] += 1
                return np.inf
        return pause.stop


def simulate(
    vehicles: list[Route], size: Floats, walkers: list[Route], times: Floats, step: float = 0.05
) -> tuple[Motion, Motion]:
    """Return the motion of vehicles and of pedestrians at equally spaced times (F,) that start at 0."""
    cars, people, crossing = Vehicles(vehicles, size), Walkers(walkers), Crossing()
    records: tuple[list[tuple[Floats, Floats, Floats]], list[tuple[Floats, Floats, Floats]]] = ([], [])
    period = float(times[1] - times[0]) if len(times) > 1 else step
    count = max(1, round(period / step))
    for _ in times:
        records[0].append(cars.state())
        records[1].append(people.state())
        for _ in range(count):
            people.step(period / count, crossing)
            cars.step(period / count, crossing)
    driven, walked = (Motion(*(np.stack(column) for column in zip(*record, strict=True))) for record in records)
    return driven, walked


def drive_legs(legs: tuple[tuple[Floats, bool], ...], times: Floats, offset: float, reach: float) -> Motion:
    """Return the motion (O = 1) of one vehicle that drives legs over and over, with a rest after each.

    Args:
        legs: corner points (K, 2) in the direction in which the car looks, and whether it is driven backwards.
        times: (F,)
        offset: how far into the round it is at time 0, in seconds.
        reach: distance of the axles from the middle.

    """
    tracks = [_track(points) for points, _ in legs]
    speed = [1.5 if backwards else 2.5 for _, backwards in legs]
    rest = [1.5, 1.0, 1.0, 6.0]
    spent = [_ride(stop - start, v, np.empty(0))[2] for (_, start, stop), v in zip(tracks, speed, strict=True)]
    ends = np.cumsum([a + b for a, b in zip(spent, rest, strict=True)])
    clock = (times + offset) % ends[-1]
    leg: Ints = np.searchsorted(ends, clock, side="right").astype(np.int64)
    center, yaw, velocity = np.empty((len(times), 1, 2)), np.empty((len(times), 1)), np.empty((len(times), 1, 2))
    for k, ((path, start, stop), (_, backwards)) in enumerate(zip(tracks, legs, strict=True)):
        rows: Bools = leg == k
        driven, pace, _ = _ride(stop - start, speed[k], clock[rows] - (ends[k] - spent[k] - rest[k]))
        s = stop - driven if backwards else start + driven
        front, rear = path.at(s + reach), path.at(s - reach)
        along = (front - rear) / np.linalg.norm(front - rear, axis=1, keepdims=True)
        center[rows, 0] = 0.5 * (front + rear)
        yaw[rows, 0] = np.arctan2(along[:, 1], along[:, 0])
        velocity[rows, 0] = (-pace if backwards else pace)[:, None] * along
    return Motion(center, yaw, velocity)


def _track(points: Floats) -> tuple[Path, float, float]:
    """Return a path through corner points that goes on straight at both ends, and the arc lengths of its end points."""
    lead = 4.0
    first, last = points[0] - points[1], points[-1] - points[-2]
    longer = np.vstack(
        [points[0] + lead * first / np.hypot(*first), points, points[-1] + lead * last / np.hypot(*last)]
    )
    path, arc = resample(longer)
    bent, places = smooth(path, 1.0)
    start, stop = np.interp(arc[[1, -2]], np.arange(len(places)) * STEP, places)
    return bent, float(start), float(stop)


def _ride(length: float, speed: float, time: Floats, acceleration: float = 0.9) -> tuple[Floats, Floats, float]:
    """Return way and speed at times after starting from rest, and the time until rest after `length` metres."""
    speed = min(speed, float(np.sqrt(acceleration * length)))
    ramp = speed / acceleration
    whole = length / speed + ramp
    t = np.clip(time, 0.0, whole)
    left = np.minimum(t, whole - t)
    pace = np.minimum(speed, acceleration * left)
    near = 0.5 * acceleration * np.minimum(left, ramp) ** 2 + speed * np.maximum(left - ramp, 0.0)
    return np.where(t < 0.5 * whole, near, length - near), pace, whole

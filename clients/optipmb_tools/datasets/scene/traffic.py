"""Road users of a generated scene: who is where at which time, and what hides them.

Conventions: world frame, metres, seconds, z up with the ground at 0, traffic on the right.

A street runs round a block. It has a lane and a cycle lane in each direction, parked cars, poles at the kerbs, and a
crosswalk with lights in the middle of either long side. In the block stand a building and up to two cars that drive out
of their places and back into them.

Everybody follows a closed circuit and, on it, the next one ahead by the intelligent driver model (Treiber, Hennecke and
Helbing, 2000). Circuits meet at the crosswalks alone, where the lights let either vehicles or pedestrians pass. None of
this is a motion model of a tracker.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optipmb_tools.datasets.interface import Area
from optipmb_tools.datasets.scene.detector import CLASSES, SIZES
from optipmb_tools.geometry import Floats, Ints

_CAR, _PEDESTRIAN, _CYCLIST = (CLASSES.index(name) for name in ("Car", "Pedestrian", "Cyclist"))

HALF_LENGTH, HALF_WIDTH, CORNER = 32.0, 25.0, 15.0
"""Of the middle of the street round the block, and the radius of its corners."""
LANE, CYCLE_LANE, PARKING, KERB, PAVEMENT = 1.75, 4.4, 6.6, 8.2, 10.6
"""Distances of the strips from the middle of the street."""
_LINES = (-5.3, -3.5, 0.0, 3.5, 5.3)  # between lanes, cycle lanes and parked cars
_WALLS = 12.6  # distance of the end of the pavement
_STRIPES = 3.0  # length of the stripes of a crosswalk
_BLOCK = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
_WALKING_LANES = (0.5, 1.5)  # distances of pedestrians from the middle of their way, on its right
_WAY = 20.0  # length of the pavement on either side of a crosswalk
_LINE = 4.2  # distance of the vehicles' stop lines from the middle of the crosswalk
_WAITING = 6.0  # distance of waiting pedestrians from the middle of the street
_SIGN = ((1.0, 1.0), (-1.0, -1.0))  # both sides of the block, of which one is the other turned by pi

_CYCLE_S = 36.0
_GREEN_S, _WALK_S = (0.0, 15.0), (20.0, 22.5)
"""Parts of the cycle of the lights in which vehicles and pedestrians may pass; then the crosswalk is cleared."""
_BRAKING = 3.5  # a road user that would have to brake harder passes the lights
_HARDEST = 6.0
_AT_LINE = 0.5
_PAUSE_EVERY_S, _PAUSE_S = 40.0, 6.0
_PAUSE_ZONE = (5.0, 30.0)  # distance to the next crosswalk at which a pedestrian may stand for a while
_FREE = 1e4
_STEP = 0.05
_PARKED_SHARE = 0.35
_TURNED = 0.15  # share of the parked cars that stand the other way round
_MEMORY_S = 0.8  # how long it lasts that an object is easy or hard to recognise


@dataclass(frozen=True)
class World:
    """The road users of a scene at each of its frames."""

    label: Ints  # (O,) index into `CLASSES`
    size: Floats  # (O, 3)
    center: Floats  # (F, O, 3)
    yaw: Floats  # (F, O)
    velocity: Floats  # (F, O, 2)
    ease: Floats  # (F, O) how easily each is recognised, about standard normal
    carrier: Floats  # (F, 3) x, y and yaw of the vehicle that carries the sensor


class Driver(NamedTuple):
    """Parameters of the intelligent driver model, each a column (N,) or of one kind of road user."""

    acceleration: Floats | float
    braking: Floats | float
    headway: Floats | float
    standstill: Floats | float
    sideways: Floats | float  # acceleration in bends
    clearing: Floats | float  # length of the crossing that is entered only when there is room behind it


_DRIVERS = {
    _CAR: Driver(1.6, 2.0, 1.2, 2.0, 2.2, 2.0 * _LINE),
    _CYCLIST: Driver(1.2, 1.8, 1.0, 1.5, 2.2, 2.0 * _LINE),
    _PEDESTRIAN: Driver(1.0, 1.0, 0.5, 0.5, 1.0, 2.0 * _WAITING),
}


class Circuit:
    """A closed way with rounded corners of a right angle, and two stops before crosswalks.

    Args:
        kind: of its road users.
        corners: (C, 2)
        radius: of the corners.
        stops: (2, 2) where lights may stop somebody.
        crosswalks: of the two stops.
    """

    def __init__(self, kind: int, corners: Floats, radius: float, stops: Floats, crosswalks: tuple[int, int]) -> None:
        self.kind = kind
        self.crosswalks = crosswalks
        closed = _rounded(corners, radius)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))
        self.length = float(arc[-1])
        self.spacing = self.length / round(self.length / 0.25)
        s = np.arange(round(self.length / self.spacing)) * self.spacing
        self.points: Floats = np.column_stack([np.interp(s, arc, closed[:, axis]) for axis in (0, 1)])
        self.stops = self.spacing * np.linalg.norm(self.points - stops[:, None], axis=2).argmin(axis=1)
        self.limit = self._speed_limit()

    def _speed_limit(self) -> Floats:
        """Return the speed (K,) that bends allow and that is reached by braking in time."""
        driver = _DRIVERS[self.kind]
        ahead = np.roll(self.points, -1, axis=0) - self.points
        heading = np.arctan2(ahead[:, 1], ahead[:, 0])
        bend = np.abs(np.angle(np.exp(1j * (heading - np.roll(heading, 1))))) / self.spacing
        free = np.tile(driver.sideways / np.maximum(bend, 1e-3), 2)
        slope = driver.braking * self.spacing * np.arange(len(free))
        # v(s)^2 <= v(t)^2 + b (t - s) for every later t: a running minimum from the end.
        square = np.minimum.accumulate((free + slope)[::-1])[::-1] - slope
        return np.asarray(np.sqrt(square[: len(self.points)]), dtype=np.float64)


def _rounded(corners: Floats, radius: float) -> Floats:
    """Return the points of a closed way with rounded corners."""
    turn = np.linspace(0.0, 0.5 * np.pi, 33)[:, None]
    parts = []
    for before, corner, after in zip(np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0), strict=True):
        into, out = ((way / np.hypot(*way)) * radius for way in (corner - before, after - corner))
        parts.append(corner - into * (1.0 - np.sin(turn)) + out * (1.0 - np.cos(turn)))
    return np.vstack([*parts, parts[0][:1]])


def _circuits() -> dict[int, list[Circuit]]:
    """Return the circuits of each kind of road user."""
    found: dict[int, list[Circuit]] = {_CAR: [], _CYCLIST: [], _PEDESTRIAN: []}
    for kind, offset in ((_CAR, LANE), (_CYCLIST, CYCLE_LANE)):
        for side in (1.0, -1.0):  # outside counter-clockwise, inside clockwise
            half = np.array([HALF_LENGTH, HALF_WIDTH]) + side * offset
            stops = np.array([[side * y * _LINE, y * half[1]] for _, y in _SIGN])
            found[kind].append(Circuit(kind, (_BLOCK * half)[:: int(side)], CORNER + side * offset, stops, (0, 1)))
    for crosswalk, (turn, _) in enumerate(_SIGN):
        for d in _WALKING_LANES:
            end = _WAY + d
            there = [[-end, PAVEMENT - d], [-d, PAVEMENT - d], [-d, -PAVEMENT - d], [end, -PAVEMENT - d]]
            back = [[end, -PAVEMENT + d], [d, -PAVEMENT + d], [d, PAVEMENT + d], [-end, PAVEMENT + d]]
            middle = np.array([0.0, HALF_WIDTH])
            stops = np.array([[-d, _WAITING], [d, -_WAITING]])
            corners = turn * (np.array([*there, *back]) + middle)
            lights = crosswalk, crosswalk
            found[_PEDESTRIAN].append(Circuit(_PEDESTRIAN, corners, min(0.8, 0.9 * d), turn * (stops + middle), lights))
    return found


class Traffic:
    """Road users on their circuits.

    Args:
        members: the circuits with the sizes (N, 3) of those on each; ordered by circuit they are all road users.
        rng: the source of all chance.
    """

    def __init__(self, members: Sequence[tuple[Circuit, Floats]], rng: np.random.Generator) -> None:
        counts = [len(size) for _, size in members]
        circuits = [circuit for circuit, _ in members]
        which = np.repeat(np.arange(len(circuits)), counts)
        longest = max(len(one.points) for one in circuits)
        self._points = np.stack([np.resize(one.points, (longest, 2)) for one in circuits])
        self._limit = np.stack([np.resize(one.limit, longest) for one in circuits])
        self._which, self._all = which, np.arange(len(which))
        self._number = np.array([len(one.points) for one in circuits])[which]
        self._spacing = np.array([one.spacing for one in circuits])[which]
        self._round = np.array([one.length for one in circuits])[which]
        self._stops = np.array([one.stops for one in circuits])[which].reshape(-1, 2)
        kind = np.array([one.kind for one in circuits])[which]
        self._driver = Driver(*np.array([_DRIVERS[one] for one in kind.tolist()]).T)
        self._walks = kind == _PEDESTRIAN
        self._length = np.concatenate([size[:, 0] for _, size in members])
        place = np.concatenate([np.arange(count) for count in counts])
        crowd = np.array(counts)[which]
        self._leader = self._all + np.where(place + 1 < crowd, 1, 1 - crowd)
        self._s = (place + 0.4 * rng.random(len(which))) / np.maximum(crowd, 1) * self._round
        low, high = (np.array(one)[kind] for one in ((7.5, 1.1, 3.5), (11.0, 1.7, 6.0)))
        self._cruise = rng.uniform(low, high)
        self._pause = rng.uniform(0.0, _PAUSE_EVERY_S, len(which))
        self._phase = rng.uniform(0.0, _CYCLE_S, 2)[np.array([one.crosswalks for one in circuits])[which]]
        self._speed = np.zeros(len(which))
        self._time = -_CYCLE_S
        while self._time < 0.0:  # those who begin in the way of others clear it
            self.step(_STEP)

    def state(self) -> tuple[Floats, Floats, Floats]:
        """Return centres (N, 2), yaws (N,) and velocities (N, 2); a body lies on its way with both axles."""
        reach = np.maximum(0.3 * self._length, 0.3)
        front, rear = self._at(self._s + reach), self._at(self._s - reach)
        along = front - rear
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return 0.5 * (front + rear), np.arctan2(along[:, 1], along[:, 0]), self._speed[:, None] * along

    def _at(self, s: Floats) -> Floats:
        place = s / self._spacing
        index = np.floor(place).astype(np.int64)
        part = (place - index)[:, None]
        here, following = (self._points[self._which, (index + i) % self._number] for i in (0, 1))
        return np.asarray(here * (1.0 - part) + following * part, dtype=np.float64)

    def step(self, h: float) -> None:
        """Move on for h seconds."""
        self._time += h
        driver, speed = self._driver, self._speed
        lead = speed[self._leader]
        gap = (self._s[self._leader] - self._s) % self._round
        gap = np.where(self._leader == self._all, _FREE, gap - 0.5 * (self._length + self._length[self._leader]))
        ahead = (self._stops - (self._s + 0.5 * self._length)[:, None]) % self._round[:, None]
        light = ahead.argmin(axis=1)
        line = ahead[self._all, light]
        phase = (self._time + self._phase[self._all, light]) % _CYCLE_S
        begin, end = (np.where(self._walks, *both) for both in zip(_WALK_S, _GREEN_S, strict=True))
        full = (lead < 1.0) & (gap - line < driver.clearing + self._length + 1.0)
        waits = ((phase < begin) | (phase >= end) | full) & (line > speed**2 / (2.0 * _BRAKING))
        limit = self._limit[self._which, (self._s / self._spacing).astype(np.int64) % self._number]
        desired = np.minimum(self._cruise, limit)
        rests = (self._time + self._pause) % _PAUSE_EVERY_S < _PAUSE_S
        rests &= self._walks & (line > _PAUSE_ZONE[0]) & (line < _PAUSE_ZONE[1])
        desired = np.where(rests, 0.02, desired)
        change = np.minimum(
            self._follow(desired, gap, lead, driver.standstill),
            self._follow(desired, np.where(waits, line, _FREE), np.zeros(len(line)), _AT_LINE),
        )
        new = np.maximum(speed + h * np.clip(change, -_HARDEST, driver.acceleration), 0.0)
        self._s = (self._s + 0.5 * h * (speed + new)) % self._round
        self._speed = new

    def _follow(self, desired: Floats, gap: Floats, lead: Floats, standstill: Floats | float) -> Floats:
        driver, speed = self._driver, self._speed
        closing = speed * (speed - lead) / (2.0 * np.sqrt(driver.acceleration * driver.braking))
        wanted = standstill + np.maximum(0.0, speed * driver.headway * (standstill / driver.standstill) + closing)
        free = np.maximum(1.0 - (speed / desired) ** 4, -1.5)
        return np.asarray(driver.acceleration * (free - (wanted / np.maximum(gap, 0.05)) ** 2), dtype=np.float64)


def build_world(counts: tuple[int, int, int], times: Floats, rng: np.random.Generator) -> World:
    """Return a scene.

    Args:
        counts: vehicles without the one that carries the sensor, pedestrians, cyclists.
        times: (F,) from 0, equally spaced.
        rng: the source of all chance.
    """
    vehicles, pedestrians, cyclists = counts
    parked, busy = round(_PARKED_SHARE * vehicles), min(2, vehicles // 8)
    moving = vehicles - parked - busy
    label = np.repeat([_CAR, _CYCLIST, _PEDESTRIAN], [1 + vehicles, cyclists, pedestrians])
    size = SIZES[label] * np.exp(0.06 * rng.standard_normal((len(label), 3)).clip(-2.5, 2.5))
    on_street = np.flatnonzero((label != _CAR) | (np.arange(len(label)) <= moving))
    members, order = [], []
    for kind, circuits in _circuits().items():
        rows = on_street[label[on_street] == kind]
        for i, circuit in enumerate(circuits):
            order.append(rows[i :: len(circuits)])
            members.append((circuit, size[order[-1]]))
    center, yaw, velocity = _drive(Traffic(members, rng), np.argsort(np.concatenate(order)), times)
    still, headings = _parked(rng, parked)
    rounds = [_shuttle(sign, times, rng.uniform(0.0, 30.0), 0.3 * size[1 + moving, 0]) for sign in (1.0, -1.0)[:busy]]
    standing = np.zeros((len(times), parked, 2))
    parts = [
        (center[:, 1 : 1 + moving], yaw[:, 1 : 1 + moving], velocity[:, 1 : 1 + moving]),
        *((place[:, None], turn[:, None], pace[:, None]) for place, turn, pace in rounds),
        (standing + still, standing[..., 0] + headings, standing),
        (center[:, 1 + moving :], yaw[:, 1 + moving :], velocity[:, 1 + moving :]),
    ]
    flat, turned, speed = (np.concatenate(column, axis=1) for column in zip(*parts, strict=True))
    height = np.broadcast_to(0.5 * size[1:, 2], flat.shape[:2])
    return World(
        label=label[1:].astype(np.int64),
        size=size[1:],
        center=np.concatenate([flat, height[..., None]], axis=2),
        yaw=turned,
        velocity=speed,
        ease=_ease(rng, len(label) - 1, times),
        carrier=np.column_stack([center[:, 0], yaw[:, 0]]),
    )


def _drive(traffic: Traffic, rows: Ints, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return centres (F, N, 2), yaws (F, N) and velocities (F, N, 2) at some times, with the rows in another order."""
    period = float(times[1] - times[0]) if len(times) > 1 else _STEP
    steps = max(1, round(period / _STEP))
    records = []
    for _ in times:
        records.append(traffic.state())
        for _ in range(steps):
            traffic.step(period / steps)
    center, yaw, velocity = (np.stack(column)[:, rows] for column in zip(*records, strict=True))
    return center, yaw, velocity


def parking_places() -> tuple[Floats, Floats]:
    """Return the places (P, 2) and headings (P,) of parked cars: along the street, on the side that drives that way."""
    long_side, short_side = (np.outer(np.array([-1.0, 1.0]), one).ravel() for one in ((9.0, 15.5), (3.25, 9.75)))
    places, headings = [], []
    for side in (1.0, -1.0):  # the outer strip, and the inner one
        for turn, _ in _SIGN:
            for along, across, heading in (
                (long_side, HALF_WIDTH, np.pi),
                (short_side, HALF_LENGTH, 0.5 * np.pi),
            ):
                strip = np.full(len(along), across + side * PARKING)
                columns = (along, strip) if across == HALF_WIDTH else (strip, along)
                places.append(turn * np.column_stack(columns))
                headings += [heading + np.pi * ((turn < 0.0) + (side < 0.0))] * len(along)
    return np.vstack(places), np.array(headings)


def _parked(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Return places (P, 2) and headings (P,) of cars that stand all the time, some of them the other way round."""
    places, headings = parking_places()
    chosen = rng.choice(len(places), size=count, replace=False)
    yaw = headings[chosen] + 0.03 * rng.standard_normal(count) + np.pi * (rng.random(count) < _TURNED)
    return places[chosen] + 0.1 * rng.standard_normal((count, 2)), np.arctan2(np.sin(yaw), np.cos(yaw))


def _shuttle(sign: float, times: Floats, offset: float, reach: float) -> tuple[Floats, Floats, Floats]:
    """Return centres (F, 2), yaws (F,) and velocities (F, 2) of a car that leaves its place and backs into it again.

    Args:
        sign: 1 or -1: which of the two cars.
        times: (F,)
        offset: time into the round at time 0.
        reach: distance of the axles from the middle.
    """
    turn = np.linspace(0.0, 0.5 * np.pi, 65)
    bend = np.column_stack([8.0 + 5.0 * (1.0 - np.cos(turn)), -7.5 + 5.0 * np.sin(turn)])
    way = np.vstack([[8.0, -13.0], bend, [26.0, -2.5]]) * (1.0, sign)
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    length, starts = 18.0, 4.0
    (_, _, out), (_, _, back) = (_ride(length, speed, np.zeros(1)) for speed in (2.5, 1.5))
    clock = (times + offset) % (out + back + 4.0)
    (there, fast, _), (again, slow, _) = _ride(length, 2.5, clock), _ride(length, 1.5, clock - out - 1.5)
    s = starts + there - again
    front, rear = (
        np.column_stack([np.interp(s + way_on, arc, way[:, axis]) for axis in (0, 1)]) for way_on in (reach, -reach)
    )
    along = (front - rear) / np.linalg.norm(front - rear, axis=1, keepdims=True)
    return 0.5 * (front + rear), np.arctan2(along[:, 1], along[:, 0]), (fast - slow)[:, None] * along


def _ride(length: float, speed: float, time: Floats, acceleration: float = 0.9) -> tuple[Floats, Floats, float]:
    """Return way and speed at times after starting from rest, and the time until rest after `length` metres."""
    ramp = speed / acceleration
    whole = length / speed + ramp
    t = np.clip(time, 0.0, whole)
    left = np.minimum(t, whole - t)
    near = 0.5 * acceleration * np.minimum(left, ramp) ** 2 + speed * np.maximum(left - ramp, 0.0)
    return np.where(t < 0.5 * whole, near, length - near), np.minimum(speed, acceleration * left), whole


def fixed_boxes(*, lasting: bool = False) -> tuple[Floats, Floats]:
    """Return centres (B, 3) and sizes (B, 3) of the building and the poles, along the axes.

    With `lasting` there are another building in the block, which hides cars, and walls before the pavements, which hide
    pedestrians.
    """
    boxes = [(-10.0, 0.0, 4.0, 18.0, 12.0, 8.0)]
    if lasting:
        walls = [(along, HALF_WIDTH + side * KERB) for along in (-15.5, -8.5, 8.5, 15.5) for side in (1.0, -1.0)]
        boxes += [(3.0, 0.0, 4.0, 6.0, 16.0, 8.0)]
        boxes += [(turn * x, turn * y, 1.5, 6.0, 0.4, 3.0) for turn, _ in _SIGN for x, y in walls]
    for turn, _ in _SIGN:
        for side in (KERB, -KERB):
            poles = [(along, HALF_WIDTH + side) for along in (-19.0, -12.0, 12.0, 19.0)]
            poles += [(HALF_LENGTH + side, along) for along in (-6.5, 0.0, 6.5)]
            boxes += [(turn * x, turn * y, 2.5, 0.3, 0.3, 5.0) for x, y in poles]
    table = np.array(boxes)
    return table[:, :3], table[:, 3:]


def street() -> list[Area]:
    """Return the street with its markings, the pavements, and the building in the block."""
    half = np.array([HALF_LENGTH, HALF_WIDTH])
    strips = [("pavement", _WALLS), ("road", KERB), ("pavement", -KERB), ("block", -_WALLS)]
    strips += [("line", offset) for offset in _LINES]
    areas = [Area(kind, _rounded(_BLOCK * (half + offset), CORNER + offset)) for kind, offset in strips]
    center, size = (one[0, :2] for one in fixed_boxes())
    areas.append(Area("building", center + 0.5 * size * _BLOCK))
    stripe = 0.5 * np.array([_STRIPES, 0.5]) * _BLOCK
    across = np.arange(0.5 - KERB, KERB, 1.0)
    return areas + [
        Area("crosswalk", stripe + np.array([0.0, y])) for _, sign in _SIGN for y in sign * HALF_WIDTH + across
    ]


def _ease(rng: np.random.Generator, objects: int, times: Floats) -> Floats:
    """Return how easily each object (F, O) is recognised: its own lasting part, and one that comes and goes."""
    keep = np.exp(-float(times[1] - times[0]) / _MEMORY_S) if len(times) > 1 else 0.0
    noise = rng.standard_normal((len(times), objects))
    for k in range(1, len(times)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1.0 - keep**2) * noise[k]
    return np.asarray(0.5 * rng.standard_normal(objects) + np.sqrt(0.75) * noise, dtype=np.float64)

"""Routes: where each road user of a scene goes, chosen ahead of its way.

Conventions: world frame, metres, seconds. A route is a path with the stops on it: for vehicles the stop lines of the
crossing, for pedestrians the kerbs before a crossing and the places where they stand for a while.
"""

from dataclasses import dataclass

import numpy as np

from optipmb_client.datasets.scene.paths import STEP, Path, resample, smooth, speed_limit, wander
from optipmb_client.datasets.scene.roads import CARRIAGEWAY, MOVEMENTS, PAVEMENT, approach, crossing_way, pavement_graph
from optipmb_client.geometry import Floats

_LEAD = 12.0
"""Spare path in metres, so that no road user comes to an end of its route."""
_STRAIGHT_ON = 2.0
"""How much likelier it is to go straight on than to turn one way."""
_CROSSINGS = 0.5
"""How much likelier it is to cross a road than to stay on the pavement."""
_RESTS = 0.3
"""Share of the pavements on which a pedestrian stands for a while."""


@dataclass(frozen=True)
class Gate:
    """A part of a route that is entered only by leave; arc lengths of where one waits and of where it is left."""

    stop: float
    clear: float
    movement: int
    """Index into `MOVEMENTS`; for pedestrians the arm they cross."""


@dataclass(frozen=True)
class Pause:
    """A place on a route where one stands for some time."""

    stop: float
    seconds: float


@dataclass(frozen=True)
class Route:
    """A path with its gates, pauses and speeds."""

    path: Path
    gates: tuple[Gate, ...]
    pauses: tuple[Pause, ...]
    limit: Floats
    """(K,) speed at each point of the path."""
    start: float
    """Arc length at which the road user is when the scene begins."""


def vehicle_route(rng: np.random.Generator, kind: str, arm: int, ahead: float, length: float, cruise: float) -> Route:
    """Return a route of at least `length` metres for a vehicle `ahead` metres before the stop line of an arm.

    The ways over the crossing are chosen at random, with a preference for going straight on.
    """
    pieces = [approach(kind, arm)]
    marks: list[tuple[int, int, int]] = []  # index of the stop line, of the end of the crossing, movement
    count = len(pieces[0])
    reach = ahead
    while not marks or reach < length + 2 * _LEAD:
        options = [i for i, m in enumerate(MOVEMENTS) if m.kind == kind and m.start == arm]
        weights = np.array([_STRAIGHT_ON if MOVEMENTS[i].stop == (arm + 2) % 4 else 1.0 for i in options])
        movement = int(rng.choice(options, p=weights / weights.sum()))
        way = crossing_way(MOVEMENTS[movement])
        arm = (1, 0, 3, 2)[MOVEMENTS[movement].stop]
        marks.append((count - 1, count + len(way) - 1, movement))
        pieces += [way, approach(kind, arm)]
        count += len(way) + len(pieces[-1])
        reach += _length(way) + _length(pieces[-1])
    path, arc = resample(np.vstack(pieces))
    narrow, new_arc = smooth(path, 4.0)
    places = np.interp(arc, np.arange(len(new_arc)) * STEP, new_arc)
    swayed = wander(narrow, rng, 0.15 if kind == "car" else 0.12, 45.0)
    gates = tuple(Gate(float(places[stop]), float(places[clear]), movement) for stop, clear, movement in marks)
    return Route(swayed, gates, (), speed_limit(swayed, cruise, 2.2, 1.6), gates[0].stop - ahead)


def walking_route(rng: np.random.Generator, length: float, cruise: float, aside: float) -> Route:
    """Return a route of at least `length` metres for somebody who walks `aside` metres to the right."""
    nodes, edges = pavement_graph()
    here = int(rng.integers(len(nodes)))
    points: list[Floats] = []
    marks: list[tuple[float, float, int]] = []
    rests: list[tuple[float, float]] = []
    total = 0.0
    before = -1
    while total < length + 4 * _LEAD:
        onward = [b for a, b in edges if a == here and b != before]
        if not onward:
            onward = [before]
            total += _append(points, _about_turn(nodes[here], nodes[before]))
        weights = np.array([1.0 if edges[here, b] is None else _CROSSINGS for b in onward])
        there = int(rng.choice(onward, p=weights / weights.sum()))
        step = nodes[there] - nodes[here]
        distance = float(np.hypot(*step))
        along = step / distance
        side = aside * np.array([along[1], -along[0]])
        total += _append(points, np.array([nodes[here] + along + side]))
        arm = edges[here, there]
        if arm is not None:
            kerb = PAVEMENT - CARRIAGEWAY - 1.0
            marks.append((total + kerb, total + distance - 2.0 - kerb, arm))
        elif rng.random() < _RESTS:
            rests.append((total + rng.uniform(0.2, 0.8) * distance, rng.uniform(2.0, 8.0)))
        total += _append(points, np.array([nodes[there] - along + side]))
        before, here = here, there
    path, _ = resample(np.array(points))
    bent, arc = smooth(path, 1.6)
    swayed = wander(bent, rng, 0.12, 9.0)

    def place(s: float) -> float:
        return float(np.interp(s / STEP, np.arange(len(arc)), arc))

    return Route(
        swayed,
        tuple(Gate(place(a), place(b), arm) for a, b, arm in marks),
        tuple(Pause(place(s), seconds) for s, seconds in rests),
        speed_limit(swayed, cruise, 1.0, 1.0),
        float(rng.uniform(0.5, 40.0)),
    )


def _append(points: list[Floats], further: Floats) -> float:
    """Append points (K, 2) to a list of points, and return how much longer it has become."""
    old = len(points)
    points += list(further)
    return _length(np.array(points[max(old - 1, 0) :]))


def _about_turn(end: Floats, origin: Floats) -> Floats:
    """Return the points (K, 2) of an about-turn at the end of a pavement, keeping right of its middle."""
    along = (end - origin) / np.hypot(*(end - origin))
    right = np.array([along[1], -along[0]])
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, 9)[:, None]
    return np.asarray(end + 1.1 * (np.cos(angle) * along + np.sin(angle) * right), dtype=np.float64)


def _length(points: Floats) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

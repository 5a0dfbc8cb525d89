"""The town in which scenes are generated.

Conventions: world frame, metres, the crossing at the origin, traffic on the right. Arms are numbered 0 east, 1 north, 2
west, 3 south. The east and north arms are joined by a wide loop, and so are the west and south ones, so that the road
has no end:

               loop
          N ..........
          |           .
    W ----+---- E ....
    .     |
     .... S

Each direction has a driving lane, a cycle lane, a strip for parking and a pavement. Pedestrians cross the arms beside
the crossing. Car parks lie in the quadrants of the loops, buildings in the others.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from optipmb_client.datasets.scene.paths import STEP
from optipmb_client.geometry import Floats

CROSSING = 12.0
"""Distance of the stop lines from the centre."""
ARM = 45.0
"""Length of the arms, and radius of the loops."""
LANE = 1.75
CYCLE_LANE = 4.4
PARKING = 6.6
KERB = 8.2
PAVEMENT = 9.4
"""Distances of the middles of the strips, and of the kerb, from the middle of the road."""
CARRIAGEWAY = 5.4
"""Distance from the middle of the road at which somebody on foot waits to cross; nobody parks there."""

_PARTNER = (1, 0, 3, 2)
_DIRECTION = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
_CLEARANCE = {("car", "car"): 3.0, ("car", "cycle"): 2.2, ("cycle", "car"): 2.2, ("cycle", "cycle"): 1.4}


@dataclass(frozen=True)
class Movement:
    """One way over the crossing."""

    kind: str
    """`car` or `cycle`"""
    start: int
    """Arm it comes from."""
    stop: int
    """Arm it goes to."""


MOVEMENTS = tuple(
    Movement(kind, start, (start + turn) % 4)
    for kind, turns in (("car", (1, 2, 3)), ("cycle", (1, 2)))  # arms onward: 1 is a right turn, 2 straight on, 3 left
    for start in range(4)
    for turn in turns
)
"""All ways over the crossing; cyclists do not turn left."""


def lane_offset(kind: str) -> float:
    """Return how far right of the middle of the road somebody of this kind drives."""
    return LANE if kind == "car" else CYCLE_LANE


def _right(heading: Floats) -> Floats:
    return np.array([heading[1], -heading[0]])


def _arc(center: Floats, start: Floats, sweep: float) -> Floats:
    """Return points along a circle from `start` with both ends, turning by `sweep`, counter-clockwise positive."""
    spoke = start - center
    count = max(2, int(abs(sweep) * float(np.hypot(*spoke)) / STEP))
    angle = np.linspace(0.0, sweep, count)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.column_stack([cos * spoke[0] - sin * spoke[1], sin * spoke[0] + cos * spoke[1]])
    return np.asarray(center + turned, dtype=np.float64)


@cache
def approach(kind: str, arm: int) -> Floats:
    """Return the way (K, 2) from the crossing over the loop back to the stop line of an arm."""
    origin, side = _PARTNER[arm], lane_offset(kind)
    out, back = _DIRECTION[origin], -_DIRECTION[arm]
    first = CROSSING * out + side * _right(out)
    bend = ARM * out + side * _right(out)
    center = ARM * (out + _DIRECTION[arm])
    # The loop turns away from the crossing: clockwise when its partner arm lies to the right of the way out.
    sweep = -1.5 * np.pi if float(_right(out) @ _DIRECTION[arm]) > 0 else 1.5 * np.pi
    last = CROSSING * _DIRECTION[arm] + side * _right(back)
    return np.vstack([first, _arc(center, bend, sweep), last])


@cache
def crossing_way(movement: Movement) -> Floats:
    """Return the way (K, 2) over the crossing from one stop line to the far side."""
    side = lane_offset(movement.kind)
    into, out = -_DIRECTION[movement.start], _DIRECTION[movement.stop]
    first = -CROSSING * into + side * _right(into)
    last = CROSSING * out + side * _right(out)
    turn = float(into[0] * out[1] - into[1] * out[0])
    if turn == 0.0:
        return np.linspace(first, last, round(2 * CROSSING / STEP))
    return np.vstack([_arc(CROSSING * (out - into), first, 0.5 * np.pi * turn), last])


@cache
def conflicts() -> Floats:
    """Return up to where movement a, from its stop line on, keeps movement b from beginning; -inf for not at all.

    Movements (index into `MOVEMENTS`) of one lane follow each other. Others may not be under way together where their
    ways come too close, until the first one has that place behind it.
    """
    table = np.full((len(MOVEMENTS), len(MOVEMENTS)), -np.inf)
    for i, a in enumerate(MOVEMENTS):
        way = crossing_way(a)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        for j, b in enumerate(MOVEMENTS):
            if (a.kind, a.start) != (b.kind, b.start):
                gap = np.linalg.norm(way[:, None] - crossing_way(b)[None], axis=2).min(axis=1)
                close = np.flatnonzero(gap < _CLEARANCE[a.kind, b.kind])
                if len(close):
                    table[i, j] = arc[close[-1]]
    return table


def parking_places() -> tuple[Floats, Floats]:
    """Return the places (P, 2) and headings (P,) of cars parked along the arms and in the car parks.

    The places that the manoeuvring cars need are left out.
    """
    places: list[tuple[float, float]] = []
    headings: list[float] = []
    for arm in range(4):
        out = _DIRECTION[arm]
        for sign in (1.0, -1.0):  # the strip of the way out, and that of the way in
            for along in np.arange(CROSSING + 6.0, ARM - 2.0, 6.5):
                place = along * out + sign * PARKING * _right(out)
                places.append((float(place[0]), float(place[1])))
                headings.append(float(np.arctan2(sign * out[1], sign * out[0])))
    for turn in (1.0, -1.0):
        for i in range(7):
            places.append((turn * (18.0 + 2.8 * i), turn * 16.0))
            headings.append(turn * 0.5 * np.pi)
            if i not in (2, 3):
                places.append((turn * (18.0 + 2.8 * i), turn * 28.0))
                headings.append(-turn * 0.5 * np.pi)
    return np.array(places), np.array(headings)


def manoeuvre(lot: int) -> tuple[tuple[Floats, bool], ...]:
    """Return the legs of a drive in car park 0 or 1: corner points (K, 2) and whether driven backwards.

    Out of the place into the aisle, backwards along the aisle, forward past the place, and backwards into it again.
    Each leg's points run the way the car looks, so a leg driven backwards is followed from its end to its start.
    """
    turn = 1.0 if lot == 0 else -1.0
    x, aisle = 18.0 + 2.8 * 2.5, 22.0
    bend = _arc(np.array([x + 5.0, aisle + 5.0]), np.array([x, aisle + 5.0]), 0.5 * np.pi)
    # It changes from forward to backwards where both of its axles have left the bend, lest its heading jump there.
    past = bend[-1] + np.array([2.0, 0.0])
    out_of_place = np.vstack([[x, aisle + 6.5], bend])
    east = np.array([x + 11.0, aisle])
    west = np.array([x - 4.0, aisle])
    legs = (
        (np.vstack([out_of_place, east]), False),
        (np.vstack([west, east]), True),
        (np.vstack([west, past]), False),
        (np.vstack([out_of_place, past]), True),
    )
    return tuple((turn * points, backwards) for points, backwards in legs)


def fixed_boxes() -> tuple[Floats, Floats]:
    """Return centres (B, 3) and sizes (B, 3) of what hides objects and is none: buildings and poles, along the axes."""
    boxes: list[tuple[float, float, float, float, float, float]] = []
    for x, y in ((-1.0, 1.0), (1.0, -1.0)):
        boxes.append((x * 20.0, y * 24.0, 5.0, 12.0, 20.0, 10.0))
        boxes.append((x * 34.0, y * 19.0, 4.0, 12.0, 10.0, 8.0))
    for x in (-1.0, 1.0):
        for y in (-1.0, 1.0):
            for along in (14.0, 26.0, 38.0):
                boxes.append((x * along, y * KERB, 2.5, 0.3, 0.3, 5.0))
                boxes.append((x * KERB, y * along, 2.5, 0.3, 0.3, 5.0))
    table = np.array(boxes)
    return table[:, :3], table[:, 3:]


def pavement_graph() -> tuple[Floats, dict[tuple[int, int], int | None]]:
    """Return the nodes (12, 2) of the pavements and the directed edges between them.

    Nodes 0 to 3 are the corners of the crossing, the others the ends of the pavements. The value of an edge is the arm
    that it crosses, or None where it stays on the pavement.
    """
    signs = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
    nodes = [(sx * PAVEMENT, sy * PAVEMENT) for sx, sy in signs]
    edges: dict[tuple[int, int], int | None] = {}
    for corner, (sx, sy) in enumerate(signs):
        for end in ((sx * (ARM - 2.0), sy * PAVEMENT), (sx * PAVEMENT, sy * (ARM - 2.0))):
            edges[corner, len(nodes)] = edges[len(nodes), corner] = None
            nodes.append(end)
        # From corner 0 (north-east) to corner 1 (north-west) one crosses the north arm, and so on.
        following = (corner + 1) % 4
        edges[corner, following] = edges[following, corner] = (corner + 1) % 4
    return np.array(nodes), edges

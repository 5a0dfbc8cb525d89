"""Events of zones and lines: what holds for all of them, and a replay by shapely."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from shapely import LineString, Point, Polygon

from optipmb import ParameterError
from optipmb.world.zones import COUNTS, Event, Shapes, Zone, ZoneState, end, locate, observe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

STEP_NS = 100_000_000
LABELS = ("car", "pedestrian")
CROSSING = Zone("crossing", polygon=((0, 0), (20, 0), (20, 12), (0, 12)), dwell_s=(1.0, 4.0))
GATE = Zone("gate", line=((0, -5), (0, 5)))
LOST = [("entered", "appeared"), ("left", "lost")]


@dataclass
class Frame:
    """Tracks of a frame."""

    id: NDArray[np.int64]
    label: NDArray[np.int64]
    center: NDArray[np.float64]
    velocity: NDArray[np.float64]
    yaw: NDArray[np.float64]
    detection: NDArray[np.int64]
    confirmed: NDArray[np.bool_]


def frame(places: dict[int, tuple[float, ...] | None], *, confirmed: bool = True, label: int = 0) -> Any:
    """Return tracks at places; None: not detected, somewhere."""
    center = np.array([(*(place or (99.0, 99.0)), 0.0)[:3] for place in places.values()], np.float64).reshape(-1, 3)
    ids = np.array(list(places), np.int64)
    none = np.zeros((len(ids), 2))
    seen = np.array([-1 if place is None else 0 for place in places.values()], np.int64)
    return Frame(ids, np.full(len(ids), label), center, none, none[:, 0], seen, np.full(len(ids), confirmed))


def events_of(zones: Sequence[Zone], frames: Sequence[Frame]) -> list[Event]:
    """Return the events of frames ten times a second, and check the counts after each."""
    state, found = ZoneState(), []
    for number, one in enumerate(frames):
        state, events = observe(zones, state, number * STEP_NS, one, LABELS)
        found += events
        for zone, counts in state.counts.items():
            for label in LABELS:
                inside, entered, left = (counts.get(name, {}).get(label, 0) for name in COUNTS[:3])
                assert inside == entered - left >= 0, (zone, label)
    return found


def along(*xy: tuple[float, float] | None) -> list[Frame]:
    """Return the frames of one track."""
    return [frame({7: place}) for place in xy]


def walks(seed: int, count: int = 12, steps: int = 300) -> list[Frame]:
    """Return tracks that wander about, are missed now and then, and end."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-15, 30, (count, 2)), rng.normal(0, 0.6, (count, 2))
    last = rng.integers(steps // 3, steps, count)
    first = rng.integers(0, steps // 3, count)
    frames = []
    for step in range(steps):
        speed += rng.normal(0, 0.15, speed.shape) - 0.01 * (place - 8.0) * (np.abs(place - 8.0) > 18)
        place = place + speed
        here = [i for i in range(count) if first[i] <= step < last[i]]
        missed = rng.random(count) < 0.1
        frames.append(frame({i + 1: None if missed[i] else tuple(place[i]) for i in here}))
        frames[-1].label = np.array([i % 2 for i in here], np.int64)
        frames[-1].confirmed = np.array([step >= first[i] + 5 and rng.random() < 0.8 for i in here], np.bool_)
    return frames


def turned(points: Sequence[tuple[float, ...]], angle: float, by: tuple[float, float]) -> NDArray[np.float64]:
    """Return points after a rigid motion."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points)[:, :2] @ np.array([[c, s], [-s, c]]) + by


def heads(events: Sequence[Event], *names: str) -> list[tuple[object, ...]]:
    """Return some columns of events."""
    return [
        tuple(getattr(one, name) for name in names or ("zone", "kind", "n", "id", "label", "at_ns")) for one in events
    ]


def test_a_visit() -> None:
    """In over the border, a time of stay, and out; the times of the border are interpolated."""
    path = [(-1.25 + 0.5 * step, 6.0) for step in range(60)]
    entered, stayed, stayed_long, left = events_of([CROSSING], along(*path))
    assert (entered.kind, entered.how, entered.at_ns, entered.n) == ("entered", "crossed", 250_000_000, 1)
    assert entered.position == pytest.approx((0.0, 6.0, 0.0))
    assert heads([stayed, stayed_long], "kind", "dwell_s") == [("stayed", 1.0), ("stayed", 4.0)]
    assert (stayed.at_ns, stayed_long.at_ns) == (1_250_000_000, 4_250_000_000)
    assert (left.kind, left.how, left.dwell_s) == ("left", "crossed", pytest.approx(4.0))


@pytest.mark.parametrize(
    ("path", "found"),
    [
        ([(5, 5)] * 8, [("entered", "appeared")]),
        ([(5, 5)] * 4 + [(5, -9)] * 9, []),  # too short
        ([(5, 5)] * 8 + [None] * 15 + [(5, 5)] * 9, [("entered", "appeared")]),  # not seen for 1.6 s
        ([(5, 5)] * 8 + [None] * 25, [("entered", "appeared"), ("left", "lost")]),
        ([(5, 5)] * 8 + [None] * 25 + [(5, 5)] * 8, [*LOST, ("entered", "appeared")]),
        ([(5, 5)] * 8 + [None] * 25 + [(5, -9), *[(5, 5)] * 8], [*LOST, ("entered", "crossed")]),
        ([(5, -9), *[(5, 5)] * 8, *[(5, -0.2), (5, 0.2)] * 20], [("entered", "crossed")]),  # within the margin
        ([(5, -9), *[(5, 5)] * 8, (5, -0.4)], [("entered", "crossed"), ("left", "crossed")]),
        ([(5, 5, 9)] * 8, []),  # another storey
    ],
)  # fmt: skip
def test_how_an_object_enters_and_leaves(path: list[tuple[float, float] | None], found: list[tuple[str, str]]) -> None:
    """Objects there at first appeared; unseen for two seconds they are lost; short visits give nothing."""
    zone = replace(CROSSING, dwell_s=(), z=(-1, 6))
    assert heads(events_of([zone], along(*path)), "kind", "how") == found


@pytest.mark.parametrize(
    ("path", "directions"),
    [
        ([(2, 0), (-2, 0)], ["left"]),
        ([(-2, 0), (2, 0), (-2, 0)], ["right", "left"]),
        ([(2, 0), (0.2, 0), (-0.2, 0), (0.2, 0), (2, 0)], []),  # dithers
        ([(2, 0), (0.2, 0), (-0.2, 0), (-2, 0)], ["left"]),
        ([(2, 0), (2, 9), (-2, 9), (-2, 0)], []),  # round the end
        ([(2, 0), None, None, (-2, 0)], ["left"]),
        ([(0.1, 0), (-2, 0)], []),  # began at the line
    ],
)
def test_how_a_line_is_crossed(path: list[tuple[float, float] | None], directions: list[str]) -> None:
    """From beyond the margin to beyond it, seen from the first point to the last."""
    assert [one.direction for one in events_of([GATE], along(*path))] == directions


@pytest.mark.parametrize("share", [0.1, 0.25, 0.9])
def test_a_crossing_is_where_and_when_the_way_meets_the_line(share: float) -> None:
    """Place and time lie as far from the frame before as the line does."""
    gate = Zone("gate", line=((10.0 * share, -50.0), (10.0 * share, 50.0)), margin=0.2)
    (crossed,) = events_of([gate], along((0.0, 0.0), (10.0, -4.0)))
    assert crossed.at_ns == round(share * STEP_NS)
    assert crossed.position == pytest.approx((10.0 * share, -4.0 * share, 0.0))


def test_a_bent_line_is_crossed_where_it_is() -> None:
    """Not where the way crosses the chord between its ends."""
    bend = Zone("bend", line=((0, 0), (0, 10), (10, 10)))
    (crossing,) = events_of([bend], along((-2, 5), (12, 5)))
    assert crossing.position == pytest.approx((0.0, 5.0, 0.0))
    assert crossing.at_ns == round(STEP_NS * 2 / 14)


def test_events_wait_until_the_track_is_confirmed() -> None:
    """They come with the frame that confirms it, with their own times; otherwise never."""
    frames = [frame({7: (5, 5)}, confirmed=step >= 12) for step in range(14)]
    state, found = ZoneState(), []
    for number, one in enumerate(frames):
        state, events = observe([CROSSING], state, number * STEP_NS, one, LABELS)
        found.append(len(events))
    assert found == [0] * 12 + [2, 0]
    assert not events_of([CROSSING], frames[:12])
    assert heads(end([CROSSING], state)[1], "kind", "how") == [("left", "ended")]


def test_classes_are_counted_by_a_filter() -> None:
    """A zone for pedestrians does not see cars; a visit keeps the class with which it began."""
    walk = replace(CROSSING, classes=("pedestrian",), dwell_s=())
    assert not events_of([walk], [frame({7: (5, 5)})] * 9)
    changing = [frame({7: (5, 5)}, label=label) for label in (1,) * 9 + (0,) * 3] + [frame({7: (5, -9)})]
    assert heads(events_of([walk], changing), "kind", "label") == [("entered", "pedestrian"), ("left", "pedestrian")]


SHAPES = (
    CROSSING,
    Zone(
        "star", polygon=((5, -10), (8, 5), (25, 6), (9, 9), (10, 28), (3, 10), (-14, 12), (2, 3)), margin=0.0, min_s=0.0
    ),
    Zone("bend", line=((-12, 4), (3, 4), (3, 18), (25, 20)), margin=0.5),
    Zone("gate", line=((0, -15), (2, 30)), margin=0.0),
)


@pytest.mark.parametrize("seed", range(4))
def test_what_holds_for_all_paths(seed: int) -> None:
    """Visits alternate; a reversed line swaps directions; a cut line keeps crossings; so does a motion of the world."""
    frames = walks(seed)
    events = events_of(SHAPES, frames)
    assert len(events) > 40
    for zone, identity in {(one.zone, one.id) for one in events if one.kind in {"entered", "left"}}:
        kinds = [
            one.kind for one in events if (one.zone, one.id) == (zone, identity) and one.kind in {"entered", "left"}
        ]
        assert kinds == ["entered", "left"] * (len(kinds) // 2) + ["entered"] * (len(kinds) % 2)
    for key, number in Counter((one.zone, one.kind) for one in events).items():
        assert sorted(one.n for one in events if (one.zone, one.kind) == key) == list(range(1, number + 1))
    lines = [one for one in SHAPES if one.line]
    backward = events_of([replace(one, line=one.line[::-1]) for one in lines], frames)
    swap = {"left": "right", "right": "left"}
    crossed = [(one.zone, one.id, one.at_ns, one.direction) for one in events if one.kind == "crossed"]
    assert [(zone, i, at, swap[way]) for zone, i, at, way in crossed] == heads(
        backward, "zone", "id", "at_ns", "direction"
    )
    whole = Zone("gate", line=((0, -15), (2, 30)), margin=0.0)
    cut = replace(whole, line=((0, -15), (0.6, -1.5), (2, 30)))  # a point of the line
    assert heads(events_of([whole], frames), "id", "direction") == heads(events_of([cut], frames), "id", "direction")
    moved = [replace(one, center=np.hstack([turned(one.center, 0.7, (100, -40)), one.center[:, 2:]])) for one in frames]
    shapes = [
        replace(one, **{name: tuple(map(tuple, turned(getattr(one, name), 0.7, (100, -40)).tolist()))})
        for one in SHAPES
        for name in ("polygon" if one.polygon else "line",)
    ]
    names = ("zone", "kind", "n", "id", "label")
    again = events_of(shapes, moved)
    assert heads(again, *names) == heads(events, *names)
    np.testing.assert_allclose([one.at_ns for one in again], [one.at_ns for one in events], atol=1000)


def crossed(line: LineString, a: NDArray[np.float64], b: NDArray[np.float64]) -> int:
    """Return how often a move crosses a line to the left less to the right."""
    path, corners = LineString([a, b]), np.asarray(line.coords)
    pieces = (piece for piece in pairwise(corners) if path.intersects(LineString(piece)))
    return int(sum(np.sign(np.linalg.det([end_ - begin, b - a])) for begin, end_ in pieces))


@pytest.mark.parametrize("seed", range(4))
def test_places_and_crossings_are_those_of_shapely(seed: int) -> None:
    """The kernel says of random moves what shapely says."""
    rng = np.random.default_rng(seed)
    center, before = rng.uniform((-15, -12, -4), (27, 30, 9), (400, 3)), rng.uniform(-15, 30, (400, 2))
    before[:20] = np.nan
    zones = [replace(one, z=(-1, 6)) if one.polygon else one for one in SHAPES]
    where, net = locate(center, before, *Shapes.of(zones))
    for k, zone in enumerate(zones):
        shape = Polygon(zone.polygon) if zone.polygon else LineString(zone.line)
        for place, last, found, crossings in zip(center, before, where[:, k], net[:, k], strict=True):
            far = shape.distance(Point(place[:2]))
            if zone.line:
                assert found == (far < zone.margin)
                assert crossings == (0 if np.isnan(last[0]) else crossed(shape, last, place[:2]))
                continue
            beyond = max(-1 - place[2], place[2] - 6, 0)
            inside = shape.contains(Point(place[:2]))
            expected = 2 if inside and not beyond else int(max(far, beyond) <= zone.margin)
            assert (found, crossings) == (expected, 0)
    assert {0, 1, 2} == set(where.ravel().tolist())
    assert {-1, 0, 1} <= set(net.ravel().tolist())


@pytest.mark.parametrize("seed", range(4))
def test_shapely_finds_the_same_visits_and_crossings(seed: int) -> None:
    """Of zones and lines without dead band or least time, from the detected positions alone."""
    star, gate = SHAPES[1], SHAPES[3]
    star, frames = replace(star, lost_s=1e6), walks(seed)
    area, line = Polygon(star.polygon), LineString(gate.line)
    for one in frames:
        one.confirmed[:] = True
    found = Counter((one.zone, one.kind, one.id, one.direction) for one in events_of([star, gate], frames))
    expected: Counter[tuple[str, str, int, str]] = Counter()
    known: dict[int, tuple[NDArray[np.float64], bool]] = {}
    for one in frames:
        for row in np.flatnonzero(one.detection >= 0).tolist():
            identity, place = int(one.id[row]), one.center[row, :2]
            inside = area.contains(Point(place))
            before, was = known.get(identity, (place, False))
            if inside is not was:
                expected["star", "entered" if inside else "left", identity, ""] += 1
            if (before != place).any() and (net := crossed(line, before, place)):
                expected["gate", "crossed", identity, "left" if net > 0 else "right"] += 1
            known[identity] = place, inside
    assert found == expected
    assert found.total() > 20


@pytest.mark.parametrize(
    "shape",
    [
        {},
        {"polygon": ((0, 0), (1, 0), (1, 1)), "line": ((0, 0), (1, 1))},
        {"polygon": ((0, 0), (4, 4), (4, 0), (0, 4))},
        {"polygon": ((0, 0), (1, 1))},
        {"line": ((0, 0),)},
    ],
)
def test_a_wrong_shape_is_refused(shape: dict[str, tuple[tuple[float, float], ...]]) -> None:
    """With the name of the zone: neither or both shapes, edges that cross, too few points."""
    with pytest.raises(ParameterError, match="gate"):
        Zone("gate", **shape)

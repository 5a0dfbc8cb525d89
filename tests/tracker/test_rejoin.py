"""Tracks joined over gaps while tracking: what objects are, when they are decided, and the state between frames."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gaps
import numpy as np
import pytest
from optipmb_tools.run.rejoining import tracklets
from scipy.stats import lognorm

import optipmb
from optipmb import OnlineTracker, ParameterError, Passage, Rejoin, Relocation, Tracker, generic_parameters
from optipmb.joining import places, records
from optipmb.model.lost_objects import Ends, Returns, Tracklets
from optipmb.warm import kernels

GENERIC = generic_parameters(gaps.CLASSES, 0.1)
HIDDEN = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
"""A car that is hidden for four seconds and goes on as before."""


def steps(frames: list[dict[str, Any]], how: Rejoin, change: Any = None) -> Iterator[optipmb.StepResult]:
    """Yield the results of a tracker, whose density `change` replaces before each frame."""
    tracker = Tracker(GENERIC, rejoin=how)
    density = tracker.initial()
    for given in frames:
        result = tracker.step(density, optipmb.make_frame(GENERIC, **given)[0])
        density = result.density if change is None else change(result.density)
        yield result


def objects(frames: list[dict[str, Any]], how: Rejoin, change: Any = None) -> list[dict[int, tuple[int, float]]]:
    """Return object and probability of each track of each frame."""
    found = []
    for one in steps(frames, how, change):
        assert one.joined is not None
        columns = one.joined.object.tolist(), one.joined.probability.tolist()
        found.append(dict(zip(one.tracks.id.tolist(), zip(*columns, strict=True), strict=True)))
    return found


def test_a_car_behind_a_building_is_the_same_object() -> None:
    """After 0.3 s of detections the second track has the object of the first, and a probability; before it has -1."""
    tracker, found = OnlineTracker(GENERIC, rejoin=Rejoin()), {}
    for one in HIDDEN:
        given = {name: value for name, value in one.items() if name not in {"labels", "stamp_ns"}}
        tracks = tracker.update(given, stamp_ns=one["stamp_ns"])
        assert tracks.object is not None
        found[one["stamp_ns"]] = dict(zip(tracks.id.tolist(), tracks.object.tolist(), strict=True))
    assert found[200_000_000] == {1: -1}
    assert found[2_900_000_000] == {1: 1}
    assert found[7_200_000_000] == {2: -1}
    assert found[7_300_000_000] == found[9_900_000_000] == {2: 1}
    assert tracks.object_probability is not None
    assert 0.99 <= tracks.object_probability[0] < 1.0
    assert tracks.columns()["object"].tolist() == [1]


def test_where_an_object_was_lost_a_join_needs_more() -> None:
    """A car is less likely the one before the gap if yet another one, of another plate, was lost where it begins."""

    def chance(y: float) -> float:
        tracker = Tracker(GENERIC, rejoin=Rejoin())
        density = tracker.initial()
        for one in gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)), (0, 2, (56, y), (0, 0))):
            texts = [{"plate": "A" if abs(place) < 1.0 else "B"} for place in one["center"][:, 1]]
            result = tracker.step(density, optipmb.make_frame(GENERIC, **one, attributes=texts)[0])
            density = result.density
        assert result.joined is not None
        return float(result.joined.candidate_probability[0])

    assert chance(3.0) < chance(60.0) < 1.0


@pytest.mark.parametrize("more", [(), ((7, 10, (0, -2.5), (8, 0)),)])
def test_without_a_sure_candidate_it_is_a_new_object(more: Any) -> None:
    """A gap beyond the limit, or two cars that appear as mirror images ahead, make new objects."""
    first = (7, 10, (0, 2.5 if more else 0), (8, 0))
    last = objects(gaps.cars((0, 3, (0, 0), (8, 0)), first, *more), Rejoin(gap_s=60.0 if more else 3.0))[-1]
    assert all(number == identity for identity, (number, _) in last.items())
    assert all(probability == 1.0 for _, probability in last.values())


def box(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float], ...]:
    return (x0, y0), (x1, y0), (x1, y1), (x0, y1)


def last_objects(frames: list[dict[str, Any]], how: Rejoin) -> list[int]:
    return [number for number, _ in objects(frames, how)[-1].values()]


def test_what_is_there_at_the_start_has_not_begun_there() -> None:
    """A parked car that is seen from the first frame on, and not for six seconds, is the same object."""
    assert last_objects(gaps.cars((0, 2, (0, 0), (0, 0)), (8, 10, (0, 0), (0, 0))), Rejoin()) == [1]


def test_another_sensor_sees_what_was_there() -> None:
    """What begins with the first frame of a sensor in a session counts nothing as a beginning, and later ones do."""
    frames = gaps.cars((0, 10, (0, 0), (0, 0)), (5, 10, (30, 0), (0, 0)), (8, 10, (60, 0), (0, 0)))

    def change(density: optipmb.Density) -> optipmb.Density:
        state = density.rejoining
        if density.stamp_ns != 49 * 10**8 or state is None:
            return density
        return replace(density, rejoining=state.with_sensor(5 * 10**9))

    *_, last = steps(frames, Rejoin(), change)
    assert last.density.rejoining is not None
    assert last.density.rejoining.beginnings.new.round(1).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("exit_", [box(20, -2, 30, 2), box(50, -2, 62, 2)], ids=["lost", "begun"])
def test_what_is_lost_or_begins_in_an_exit_is_not_joined(exit_: Any) -> None:
    """What is lost inside does not return, and what begins inside is new; another exit changes nothing."""
    assert last_objects(HIDDEN, Rejoin(exits=(box(30, 10, 40, 20), exit_))) == [2]
    assert last_objects(HIDDEN, Rejoin(exits=(box(30, 10, 40, 20),))) == [1]


@pytest.mark.parametrize(("s", "expected"), [((2.0, 8.0), 1), ((6.0, 8.0), 2)])
def test_a_passage_joins_its_ends(s: tuple[float, float], expected: int) -> None:
    """A car that is seen again at its other end, within the time, is the same object; without it that is new."""
    frames = gaps.cars((0, 3, (0, 0), (8, 0)), (8, 10, (20, 104), (0, -8)))
    way = Passage(box(18, -3, 30, 3), box(15, 34, 25, 46), s)
    assert last_objects(frames, Rejoin(passages=(way,))) == [expected]
    assert last_objects(frames, Rejoin()) == [2]


@pytest.mark.parametrize("gap_s", [60.0, 3.0])
def test_ends_teach_where_objects_return(gap_s: float) -> None:
    """The end of a track that is joined counts with the probability of the join; after the gap, with none."""
    *_, last = steps(HIDDEN, Rejoin(gap_s=gap_s))
    assert last.density.rejoining is not None
    assert last.joined is not None
    ends = last.density.rejoining.ends
    assert ends.id.tolist() == [1]
    assert ends.place[0] == pytest.approx((23.2, 0.0), abs=0.3)
    assert ends.returned.tolist() == pytest.approx([last.joined.probability[0] if gap_s > 4.0 else 0.0])


def test_the_probability_of_a_return_is_that_of_ends_around() -> None:
    """Ends near a place, of the same kind, count by their distance, with two more that return every second time."""
    ends = Ends.of(np.zeros(4 * Ends.width))
    ends.id[:], ends.kind[:], ends.returned[:] = range(4), (0, 0, 1, 0), (1.0, 0.2, 1.0, 1.0)
    ends.place[:] = (0, 0), (3, 0), (0, 0), (30, 0)
    weight = np.exp(-0.5)
    expected = (1.0 + 1.0 + 0.2 * weight) / (2.0 + 1.0 + weight)
    assert places.return_score(records.ends_in(ends.words), 0, np.zeros(2)) == pytest.approx(np.log(expected / 0.5))


def test_learned_scores_are_a_mixture_of_returns() -> None:
    """Place, time in proportion to the speed and weight of each return count as in plain numpy; others do not."""
    chance, count = np.random.default_rng(3), 5
    tracks = Tracklets.of(np.zeros(2 * Tracklets.width))
    tracks.id[:], tracks.first_ns[:], tracks.last_ns[:] = (1, 9), (0, 20 * 10**9), (10**9, 30 * 10**9)
    tracks.begin[1], tracks.end_velocity[0], tracks.begin_velocity[1] = (20.0, 1.0), (1.1, 0.0), (0.9, 0.1)
    tracks.end_variance[:], tracks.begin_variance[:] = 0.01, 0.02
    returns = Returns.of(np.zeros(count * Returns.width))
    returns.id[:], returns.kind[:] = (2, 3, 4, 5, 9), (0, 0, 0, 1, 0)
    returns.start[:], returns.end[:] = chance.normal(0.0, 2.0, (2, count, 2))
    returns.end[:, 0] += 20.0
    returns.seconds[:], returns.speed[:], returns.weight[:] = (15, 22, 19, 19, 19), 1.2, (0.3, 0.9, 0.6, 1.0, 1.0)
    returns.speed[2] = np.nan
    one, others = records.tracklets_in(tracks.words), records.returns_in(returns.words)
    score, share = places.learned_score(one, 0, one, 1, 0, others)
    speeds, variances = np.array((1.1, np.hypot(0.9, 0.1))), np.array((0.01, 0.02))
    weights = 1.0 / (variances + (places.PACE * speeds) ** 2)
    speed = (weights * speeds).sum() / weights.sum()
    deviation = np.hypot(1.0 / np.sqrt(weights.sum()) / speed, places.PACE)
    near = returns.weight[:3] * np.exp(-0.5 * (returns.start[:3] ** 2).sum(axis=1) / 9.0)
    square = ((returns.end[:3] - tracks.begin[1]) ** 2).sum(axis=1)
    median = returns.seconds[:3] * np.array((1.2 / speed, 1.2 / speed, 1.0))
    spread = np.array((deviation, deviation, 2.0 * places.PACE))
    density = lognorm.pdf(19.0, spread, scale=median) * np.exp(-0.5 * square / 9.0) / (18.0 * np.pi)
    assert share == pytest.approx(places.LEARNED * near.sum() / (near.sum() + places.FIRST_RETURNS))
    assert score == pytest.approx(np.log(0.5 * share * (near * density).sum() / near.sum()))
    tracks.begin[1] = 3.0, 4.0
    assert places.learned_score(one, 0, one, 1, 0, others) == (-np.inf, 0.0)


def test_passages_are_learned() -> None:
    """In a corridor with a dead zone hardly anybody is joined at first, and many are after some minutes."""
    recording = gaps.record("corridor", 22, 400.0)
    tracks = gaps.tracked(recording.frames, GENERIC, Rejoin())
    found = tracklets(tracks, GENERIC.labels)
    before, after, probability = gaps.decided(tracks, found)
    late = found.first_ns[after] > 200 * 10**9
    owner = gaps.owners(tracks, recording.source)
    judged = gaps.judge(found, (before[late], after[late], probability[late]), owner)
    right, wrong, _ = judged.counts(0.0)
    assert right >= 10
    assert wrong == 0
    assert (~late).sum() < right


@pytest.fixture(scope="module", params=["street", "square"])
def frames(request: pytest.FixtureRequest) -> list[dict[str, Any]]:
    return gaps.record(request.param, 7, 40.0).frames


SOME = Rejoin(min_probability=0.6)


def test_an_object_is_one_track_in_a_frame(frames: list[dict[str, Any]]) -> None:
    """The object of a track is -1, then for ever that of a confirmed track of no higher id; once in a frame."""
    confirmed: set[int] = set()
    known: dict[int, tuple[int, float]] = {}
    joins = 0
    for one in steps(frames, SOME):
        assert one.joined is not None
        confirmed |= set(one.tracks.id[one.tracks.confirmed].tolist())
        number, probability = one.joined.object, one.joined.probability
        assert len(np.unique(number[number >= 0])) == (number >= 0).sum()
        assert set(number[number >= 0].tolist()) <= confirmed
        assert (number <= one.tracks.id).all()
        joins += one.joined.joins
        for identity, *value in zip(one.tracks.id.tolist(), number.tolist(), probability.tolist(), strict=True):
            before = known.get(identity, (-1, 1.0))
            assert before in ((-1, 1.0), tuple(value))
            known[identity] = value[0], value[1]
    assert joins == sum(number not in {-1, identity} for identity, (number, _) in known.items()) > 0
    assert all(0.0 < probability <= 1.0 for _, probability in known.values())


def test_objects_follow_from_the_stored_state(frames: list[dict[str, Any]]) -> None:
    """A density that is written and read between all frames gives the same objects, and the same bytes."""

    def read(density: optipmb.Density) -> optipmb.Density:
        parts = optipmb.bytes_of(density)
        columns = optipmb.columns_in(parts, len(density.labels))
        found = optipmb.density_of(density.stamp_ns, density.next_id, columns, density.labels)
        assert optipmb.bytes_of(found) == parts
        return found

    assert objects(frames, SOME, read) == objects(frames, SOME)


def test_a_stored_state_that_does_not_fit_is_refused(frames: list[dict[str, Any]]) -> None:
    """An object above the id of its track, or places of other tracks, are named."""
    *_, last = steps(frames, SOME)
    columns = optipmb.columns_of(last.density)
    state = last.density.stamp_ns, last.density.next_id
    for name, value in (
        ("rejoin.tracks.object", columns["rejoin.tracks.id"] + 1),
        ("rejoin.lost.label", columns["rejoin.lost.label"] + 9),
        ("rejoin.places.count", columns["rejoin.places.count"] - 90),
    ):
        with pytest.raises(optipmb.DensityError, match=name):
            optipmb.density_of(*state, columns | {name: value}, last.density.labels)


def test_a_world_that_moves_keeps_objects() -> None:
    """A motion of the world while the car is hidden changes no join."""
    motion = Relocation(100.0, -30.0, 2.0, 1.2)

    def there(one: dict[str, Any]) -> dict[str, Any]:
        center = np.array([motion.place(tuple(place)) for place in one["center"].tolist()]).reshape(-1, 3)
        return one | {"center": center, "yaw": one["yaw"] + motion.theta}

    moved = [there(one) if one["stamp_ns"] >= 5 * 10**9 else one for one in HIDDEN]

    def change(density: optipmb.Density) -> optipmb.Density:
        return motion.density(density) if density.stamp_ns == 49 * 10**8 else density

    (number, probability), *_ = objects(moved, Rejoin(), change)[-1].values()
    (expected, other), *_ = objects(HIDDEN, Rejoin())[-1].values()
    assert number == expected == 1
    assert probability == pytest.approx(other, abs=1e-4)


def test_the_oldest_lost_objects_are_dropped() -> None:
    """No more than `most` are kept, those lost last, and the others are counted."""
    cars = [(0.2 * n, 0.2 * n + 1.0, (10.0 * n, 0.0), (0.0, 0.0)) for n in range(30)]
    dropped = 0
    for one in steps(gaps.cars(*cars), Rejoin(most=4)):
        assert one.joined is not None
        assert one.density.rejoining is not None
        assert len(one.density.rejoining.lost) <= 4
        dropped += one.joined.dropped
    lost = one.density.rejoining.lost
    assert dropped > 10
    assert lost.id.min() > dropped


def test_without_joining_the_state_is_dropped() -> None:
    """A tracker that does not join tracks steps the same density, and forgets what joining needs."""
    *_, last = steps(HIDDEN[:20], Rejoin())
    frame, _ = optipmb.make_frame(GENERIC, **HIDDEN[20])
    plain, joining = Tracker(GENERIC), Tracker(GENERIC, rejoin=Rejoin())
    one, other = (tracker.step(last.density, frame) for tracker in (plain, joining))
    assert one.joined is None
    assert one.density.rejoining is None
    assert one.tracks.words.tobytes() == other.tracks.words.tobytes()


@pytest.mark.parametrize(
    ("value", "path"),
    [({"gap_s": 0.0}, "gap_s"), ({"min_probability": 0.4}, "min_probability"), ({"most": 0}, "most"),
     ({"decide_s": 5.1}, "decide_s"), ({"gap_s": float("nan")}, "gap_s"),
     ({"exits": (box(0, 0, 1, 1)[:2],)}, r"exits\[0\]: expected 3 to 100 points"),
     ({"exits": ((*box(0, 0, 1, 1), (0.5, -1)),)}, r"exits\[0\]: expected edges that do not cross"),
     ({"exits": (box(0, 0, 1, float("inf")),)}, r"exits\[0\]"), ({"exits": (box(0, 0, 1, 1),) * 65}, "exits"),
     ({"passages": (Passage(box(0, 0, 1, 1), (), (0, 1)),)}, r"passages\[0\].to"),
     ({"passages": (Passage(box(0, 0, 1, 1), box(0, 0, 1, 1), (0, 61)),)}, r"passages\[0\].s")],
)  # fmt: skip
def test_settings_out_of_bounds_are_named(value: dict[str, Any], path: str) -> None:
    """A value out of its bounds raises an error that names it."""
    with pytest.raises(ParameterError, match=f"rejoin.{path}"):
        Rejoin(**value)


def test_whole_numbers_compile_nothing_anew() -> None:
    """Limits in whole seconds give the same objects with the machine code that is there."""
    found = objects(HIDDEN, Rejoin(gap_s=60.0, decide_s=1.0, most=1000))
    before = {name: len(getattr(one, "signatures", ())) for name, one in kernels().items()}
    for most in (1000, 1000.0):
        assert objects(HIDDEN, Rejoin(gap_s=60, decide_s=1, most=most)) == found
    assert {name: len(getattr(one, "signatures", ())) for name, one in kernels().items()} == before


def test_most_joins_are_right() -> None:
    """In a street and a car park of the generator at most one join in thirty is wrong, and many gaps are bridged."""
    judged = gaps.Judged()
    for name in ("street", "car park"):
        recording = gaps.record(name, 41, 60.0)
        tracks = gaps.tracked(recording.frames, GENERIC, Rejoin())
        found = tracklets(tracks, GENERIC.labels)
        judged += gaps.judge(found, gaps.decided(tracks, found), gaps.owners(tracks, recording.source))
    right, wrong, _ = judged.counts(0.0)
    assert right >= 20
    assert wrong <= right / 30

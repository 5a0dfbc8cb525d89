"""What a user sees: tracks through turns, crossings, occlusion, silence and crowds, with the profiles that ship."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scenes import boxes, steps

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

KITTI = optipmb.load_profile("kitti-paper")
NUSCENES = optipmb.load_profile("nuscenes-paper")
HERE = optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0]))


def cloud(points: NDArray[np.float64]) -> optipmb.PointCloud:
    """A scan by a sensor at the origin."""
    return optipmb.PointCloud(np.asarray(points, dtype=np.float32).reshape(-1, 3), HERE)


def drive(control: Callable[[float], tuple[float, float]], seconds: float, period: float) -> NDArray[np.float64]:
    """States [x, y, v, phi] of an object with v(0) = 8 whose (turn rate, acceleration) at each time is given."""
    state, rows, h = np.array([5.0, -3.0, 8.0, 0.4]), [], 1e-3
    for k in range(round(seconds / h)):
        if k % round(period / h) == 0:
            rows.append(state.copy())
        omega, a = control(k * h)
        state += h * np.array([state[2] * math.cos(state[3]), state[2] * math.sin(state[3]), a, omega])
    return np.array(rows)


MANOEUVRES: dict[str, Callable[[float], tuple[float, float]]] = {
    "straight": lambda _: (0.0, 0.0),
    "roundabout": lambda _: (0.5, 0.0),
    "slalom": lambda t: (0.8 * math.sin(1.5 * t), 0.0),
    "stop and go": lambda t: (0.0, -2.0 if 1 < t < 5 else 2.0 if 7 < t < 10 else 0.0),
    "reverse": lambda t: (0.1, -2.0 if 1 < t < 6.5 else 0.0),
}


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
@pytest.mark.parametrize("velocity", ["known", "unknown"])
@pytest.mark.parametrize("profile", optipmb.profiles())
def test_one_object_keeps_one_track(profile: str, velocity: str, manoeuvre: str) -> None:
    """Under every profile, a perfectly detected car that turns, stops or reverses has one id, near the truth."""
    parameters = optipmb.load_profile(profile)
    label = parameters.labels[0] if "Car" in parameters.labels else "car"
    rows = drive(MANOEUVRES[manoeuvre], 12.0, parameters.nominal_period)
    frames = []
    for k, (x, y, v, phi) in enumerate(rows):
        measured = (v * math.cos(phi), v * math.sin(phi)) if velocity == "known" else None
        seconds = k * parameters.nominal_period
        frames.append(boxes(parameters, seconds, (x, y), yaw=phi, velocity=measured, label=label))
    results = steps(parameters, frames)
    assert [result.tracks.id.tolist() for result in results] == [[1]] * len(rows)
    pairs = list(zip(results, rows, strict=True))
    error = [float(np.hypot(*(result.tracks.center[0, :2] - row[:2]))) for result, row in pairs]
    assert max(error) < 0.5
    turned = [math.cos(result.tracks.yaw[0] - row[3]) for result, row in pairs]
    assert min(turned) > math.cos(0.35)
    late = [
        float(np.abs(result.tracks.velocity[0] - row[2] * np.array([math.cos(row[3]), math.sin(row[3])])).max())
        for result, row in pairs[6:]
    ]
    assert max(late) < 2.5


def test_two_crossing_objects_keep_their_ids() -> None:
    """Two cars meet at a crossing, 0.6 s apart: each id stays with its car."""
    period, frames, truth = 0.1, [], []
    for k in range(60):
        t = k * period
        one, other = (-24 + 8 * t, 0.0), (0.0, -29 + 8 * t)
        truth.append((one, other))
        frames.append(boxes(KITTI, t, [one, other], yaw=[0.0, math.pi / 2]))
    for result, places in zip(steps(KITTI, frames), truth, strict=True):
        np.testing.assert_array_equal(result.tracks.id, [1, 2])
        np.testing.assert_allclose(result.tracks.center[:, :2], places, atol=1.0)


def test_oncoming_objects_keep_their_ids() -> None:
    """Two cars pass each other within two metres: position alone would do, heading and speed must not confuse."""
    frames = []
    for k in range(50):
        t = 0.1 * k
        frames.append(boxes(KITTI, t, [(-20 + 8 * t, 0.0), (20 - 8 * t, 2.2)], yaw=[0.0, math.pi]))
    results = steps(KITTI, frames)
    first, last = results[0].tracks, results[-1].tracks
    assert [len(result.tracks) for result in results] == [2] * 50
    for i in range(2):
        assert last.velocity[i, 0] == pytest.approx(-8 * np.sign(first.center[i, 0]), abs=0.5)


def cars_at(x: list[float], t: float, tracker: optipmb.OnlineTracker) -> optipmb.OnlineTracks:
    """Detect cars along a road and give them to the tracker."""
    n = len(x)
    boxes = {"center": [[one, 5.0, 0.8] for one in x], "size": [[4.4, 1.8, 1.5]] * n, "yaw": [0.0] * n}
    return tracker.update({**boxes, "score": [0.9] * n}, t=t, label=["car"] * n)


def test_no_track_goes_along_a_row_of_parked_cars() -> None:
    """At 2 Hz a car is missed where the next of its row is first detected: from then on each place keeps its id."""
    tracker, owner = optipmb.OnlineTracker(optipmb.generic_parameters(["car"], 0.5)), {}
    cars_at([0.0], 0.0, tracker)
    cars_at([6.5], 0.5, tracker)
    for k in range(2, 12):
        tracks = cars_at([6.5 * n for n in range(k + 1)], 0.5 * k, tracker)
        for track, x in zip(tracks.id.tolist(), tracks.center[:, 0].round(1).tolist(), strict=True):
            assert owner.setdefault(x, track) == track
    assert sorted(owner) == [6.5 * n for n in range(12)]
    assert np.nanmax(np.abs(tracks.velocity)) < 0.1


@pytest.mark.parametrize("headway", [0.8, 1.5])
def test_cars_that_follow_one_another_keep_their_ids(headway: float) -> None:
    """At 2 Hz and 15 m/s."""
    tracker = optipmb.OnlineTracker(optipmb.generic_parameters(["car"], 0.5))
    for k in range(10):
        tracks = cars_at([15.0 * (0.5 * k - headway * n) for n in range(4)], 0.5 * k, tracker)
    assert tracks.id.tolist() == [1, 2, 3, 4]
    assert np.abs(tracks.velocity - [15.0, 0.0]).max() < 0.5


def occlusion(*, hidden: bool, parameters: optipmb.Parameters) -> list[optipmb.StepResult]:
    """A standing car, seen for a second, then missed; its box is empty of points (`hidden`) or full of them."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(-0.45, 0.45, (100, 3)) * [4.0, 1.8, 1.5] + np.array([10.0, 0, 0])
    frames = []
    for k in range(20):
        seen = k < 10
        scan = cloud(inside) if seen or not hidden else cloud(np.array([[50.0, 50, 0]]))
        xy = [(10.0, 0.0)] if seen else []
        label = "Car" if "Car" in parameters.labels else "car"
        frames.append(boxes(parameters, k * parameters.nominal_period, xy, cloud=scan, velocity=(0, 0), label=label))
    return steps(parameters, frames)


def test_an_occluded_object_is_believed_in_for_longer() -> None:
    """ADP: without points in its box a missed object is hidden; with points it should have been seen."""
    hidden, visible = (occlusion(hidden=hidden, parameters=NUSCENES) for hidden in (True, False))
    existence = [[float(result.density.bernoulli.existence[0]) for result in run[10:12]] for run in (hidden, visible)]
    assert existence[0][0] > existence[1][0] + 0.02
    assert existence[0][1] > existence[1][1] + 0.05
    lives = [sum(len(result.density.bernoulli.id) for result in run) for run in (hidden, visible)]
    assert lives[0] > lives[1]
    assert all(result.diagnostics.cloud_used for result in hidden)


def test_extraction_goes_on_for_longer_behind_an_occlusion() -> None:
    """The occluded track is also reported for longer, where eta_ext2 decides and not the count of misses."""
    document = NUSCENES.model_dump()
    document["classes"]["car"] |= {"extract_misses": 50, "max_misses": 50, "extract_known": 0.5, "extract_new": 0.5}
    parameters = optipmb.parse_parameters(document)
    runs = [occlusion(hidden=hidden, parameters=parameters) for hidden in (True, False)]
    shown = [sum(len(result.tracks) for result in run) for run in runs]
    assert shown[0] > shown[1] > 10


def test_a_track_born_backwards_drives_backwards() -> None:
    """A box that is always turned by pi: the velocity over ground is right, its sign along the yaw negative."""
    frames = [boxes(KITTI, 0.1 * k, (6.0 * 0.1 * k, 0.0), yaw=math.pi) for k in range(30)]
    tracks = steps(KITTI, frames)[-1].tracks
    np.testing.assert_allclose(tracks.velocity, [[6.0, 0.0]], atol=0.3)
    assert abs(tracks.yaw[0]) > 3.0


def test_no_detections_at_all() -> None:
    """Empty frames, with and without cloud, are frames: nothing comes out, time goes on."""
    frames = [boxes(KITTI, 0.1 * k, cloud=cloud(np.zeros((0, 3))) if k % 2 else None) for k in range(5)]
    results = steps(KITTI, frames)
    assert [len(result.tracks) for result in results] == [0] * 5
    assert results[-1].density.stamp_ns == 400_000_000
    assert results[-1].density.next_id == 1


def test_a_thousand_detections() -> None:
    """A thousand objects at once: a thousand tracks, each following its own."""
    grid = np.stack(np.meshgrid(np.arange(40) * 6.0, np.arange(25) * 6.0), axis=-1).reshape(-1, 2)
    frames = [boxes(KITTI, 0.1 * k, grid + np.array([0.5 * k, 0.0]), velocity=(5.0, 0.0)) for k in range(4)]
    for result in steps(KITTI, frames):
        np.testing.assert_array_equal(result.tracks.id, np.arange(1, 1001))
        assert len(set(result.tracks.detection.tolist())) == 1000


@pytest.mark.parametrize("stop", [30, 0])
def test_a_stopped_car_that_reports_its_old_velocity_keeps_its_track(stop: int) -> None:
    """One id, confirmed, at its place and at rest, also if it has never moved; another car keeps its speed."""
    tracker, x = optipmb.OnlineTracker("generic"), 0.0
    for k in range(90):
        x += 0.5 * (k < stop)
        center = [[x, 0.0, 0.0], [0.8 * k, 10.0, 0.0]]
        given = {"center": center, "velocity": [[5.0, 0.0], [8.0, 0.0]], "size": [[4.5, 1.9, 1.6]] * 2}
        tracks = tracker.update(t=0.1 * k, yaw=[0.0, 0.0], score=[0.9, 0.8], label=["car", "car"], **given)
    assert tracks.id.tolist() == [1, 2]
    assert tracks.confirmed.all()
    assert np.abs(tracks.center[:, :2] - [[x, 0.0], [71.2, 10.0]]).max() < 0.1
    assert np.abs(tracks.velocity - [[0.0, 0.0], [8.0, 0.0]]).max() < 0.3


@pytest.mark.parametrize(("doubt", "count"), [(0.1, 2), (0.6, 1)])
def test_people_side_by_side_are_two_where_both_are_sure(doubt: float, count: int) -> None:
    """Boxes half a metre apart are of two people with `generic`, and of one where the detector doubts the second."""
    tracker = optipmb.OnlineTracker("generic")
    for k in range(20):
        boxes = {
            "center": [[0.1 * k, 0.0, 0.9], [0.1 * k, 0.52, 0.9]],
            "size": [[0.7, 0.7, 1.75]] * 2,
            "yaw": [0.0, 0.0],
        }
        tracks = tracker.update({**boxes, "score": [0.95, 1.0 - doubt]}, t=0.1 * k, label=["pedestrian"] * 2)
    assert len(tracks) == count


@pytest.mark.parametrize(("doubt", "count"), [(0.1, 2), (0.6, 1)])
def test_points_of_people_in_a_crowd_are_two_where_both_are_sure(doubt: float, count: int) -> None:
    """Points without a size may be a third of a metre apart, unless the detector doubts the second."""
    tracker = optipmb.OnlineTracker("generic")
    for k in range(20):
        points = {"x": [0.1 * k] * 2, "y": [0.0, 0.35], "score": [0.95, 1.0 - doubt], "class": ["pedestrian"] * 2}
        tracks = tracker.update(points, t=0.1 * k)
    assert len(tracks) == count


def test_who_is_missed_in_a_crowd_leaves_the_next_one_alone() -> None:
    """Of three people who walk .6 m apart the middle one is missed for half a second: all keep their ids and places."""
    tracker, seen = optipmb.OnlineTracker("generic"), []
    for k in range(40):
        who = [0, 2] if 20 <= k < 25 else [0, 1, 2]
        points = {"x": [0.1 * k] * len(who), "y": [0.6 * one for one in who], "score": [0.9] * len(who)}
        tracks = tracker.update({**points, "class": ["pedestrian"] * len(who)}, t=0.1 * k)
        seen.append(dict(zip(tracks.id.tolist(), np.round(tracks.center[:, 1], 1).tolist(), strict=True)))
    assert seen[-1] == seen[19] == {1: 0.0, 2: 0.6, 3: 1.2}


def test_a_stamp_that_goes_back_is_refused() -> None:
    """The tracker does not go back in time, and says by the path which field was wrong; equal stamps are fine."""
    tracker = optipmb.Tracker(KITTI)
    density = tracker.step(tracker.initial(), boxes(KITTI, 1.0, (0, 0))).density
    with pytest.raises(optipmb.FrameError) as caught:
        tracker.step(density, boxes(KITTI, 0.999999999, (0, 0)))
    assert caught.value.path == "stamp_ns"
    tracker.step(density, boxes(KITTI, 1.0, (0, 0)))


def test_a_flipped_heading_does_not_turn_the_track() -> None:
    """Where the detector may turn a box by pi, the yaw stays and the id too, moving or standing."""
    rng = np.random.default_rng(4)
    for speed in (0.0, 6.0):
        frames = []
        for k in range(40):
            yaw = 0.3 + rng.normal(0, 0.05) + math.pi * (k > 5 and rng.random() < 0.4)
            xy = (speed * 0.1 * k * math.cos(0.3), speed * 0.1 * k * math.sin(0.3))
            frames.append(boxes(KITTI, 0.1 * k, xy, yaw=yaw))
        for result in steps(KITTI, frames):
            np.testing.assert_array_equal(result.tracks.id, [1])
            assert abs(math.remainder(result.tracks.yaw[0] - 0.3, 2 * math.pi)) < 0.5


@pytest.mark.parametrize("label", KITTI.labels)
def test_ten_seconds_of_silence_end_every_track(label: str) -> None:
    """After a gap past the limit nothing old is left to be associated: the object gets a new id."""
    first = boxes(KITTI, 0, (0, 0), label=label)
    gap = steps(KITTI, [first, boxes(KITTI, 10, (0, 0), label=label)])
    np.testing.assert_array_equal(gap[1].tracks.id, [2])


def test_an_irregular_stream_keeps_its_track() -> None:
    """Between 20 ms and 300 ms apart, the same object at constant speed keeps its id and its speed."""
    rng = np.random.default_rng(2)
    stamps = np.cumsum(rng.uniform(0.02, 0.3, 60))
    frames = [boxes(KITTI, t, (7.0 * t, 0.0)) for t in stamps]
    results = steps(KITTI, frames)
    assert {result.tracks.id.tolist()[0] for result in results} == {1}
    np.testing.assert_allclose(results[-1].tracks.velocity, [[7.0, 0.0]], atol=0.3)

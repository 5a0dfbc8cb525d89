"""A sensor misses nothing that lies outside its field of view, and several sensors feed one density by turns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import boxes

import optipmb
from optipmb.filter.field_of_view import count_looks, in_view, shares_in_view, show
from optipmb.filter.hypotheses import close_gates

KITTI, NUSCENES = optipmb.load_profile("kitti"), optipmb.load_profile("nuscenes")
CARS = {"kitti": (KITTI, "Car"), "nuscenes": (NUSCENES, "car")}
HASTY = {"nuscenes-paper": (optipmb.load_profile("nuscenes-paper"), "car")}
FORWARD = optipmb.FieldOfView(azimuth=(-1.0, 1.0), range=(0.5, 80.0))
BACKWARD = optipmb.FieldOfView(azimuth=(math.pi - 1.0, -math.pi + 1.0), range=(0.5, 80.0))
BOX = np.array([[4.0, 2.0, 1.5, 0.0]])
SEEDS = pytest.mark.parametrize("seed", range(3))


def turned(yaw: float, pitch: float = 0.0, translation: Any = (0.0, 0.0, 0.0)) -> optipmb.Pose:
    """A sensor that looks along a yaw, and down by a pitch."""
    (a, b), (c, d) = ((math.cos(one / 2), math.sin(one / 2)) for one in (yaw, pitch))
    return optipmb.Pose(np.array(translation, float), np.array([a * c, -b * d, a * d, b * c]))


def contains(view: optipmb.FieldOfView, points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Whether points of the sensor frame are in view, by angles."""
    x, y, z = points.T
    away, flat = np.linalg.norm(points, axis=1), np.hypot(x, y)
    turn = (np.arctan2(y, x) - view.azimuth[0]) % (2 * np.pi)
    up = np.arctan2(z, flat)
    near, far = view.range
    return (turn <= view.width) & (view.elevation[0] <= up) & (up <= view.elevation[1]) & (near <= away) & (away <= far)


def shares(
    view: optipmb.FieldOfView, mean: Any, covariance: Any, auxiliary: Any, pose: optipmb.Pose
) -> np.ndarray[Any, Any]:
    """The kernel."""
    share = np.empty(len(mean))
    shares_in_view(mean, covariance, auxiliary, pose.rotation, pose.translation, view.limits, share)
    return share


@SEEDS
def test_shares_are_the_quadrature_over_the_box_and_its_position(seed: int) -> None:
    """The nodes of Gauss and Hermite along and across, Simpson's along the height, in plain numpy."""
    rng = np.random.default_rng(seed)
    mean, root = rng.uniform(-20, 20, (40, 6)), rng.normal(0, 1, (40, 6, 6))
    covariance, auxiliary = root @ root.transpose(0, 2, 1), np.c_[rng.uniform(0.5, 10, (40, 3)), rng.normal(0, 1, 40)]
    pose = turned(rng.uniform(-3, 3), rng.uniform(-0.3, 0.3), rng.normal(0, 3, 3))
    view = optipmb.FieldOfView(tuple(rng.uniform(-6, 6, 2)), (-0.4, 0.2), (2.0, 22.0))
    wanted = []
    for m, p, box in zip(mean, covariance, auxiliary, strict=True):
        axes = np.array([[math.cos(m[3]), -math.sin(m[3])], [math.sin(m[3]), math.cos(m[3])]])
        along = np.linalg.cholesky(np.diag(box[:2] ** 2) / 12 + axes.T @ p[:2, :2] @ axes) * math.sqrt(3)
        total = 0.0
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                for k in (-1, 0, 1):
                    weight = math.prod(2 / 3 if one == 0 else 1 / 6 for one in (i, j, k))
                    point = np.r_[m[:2] + axes @ along @ [i, j], box[3] + 0.5 * k * box[2]]
                    total += weight * contains(view, ((point - pose.translation) @ pose.rotation)[None])[0]
        wanted.append(total)
    found = shares(view, mean, covariance, auxiliary, pose)
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.count_nonzero((found > 0) & (found < 1)) > 0


@SEEDS
def test_a_point_is_in_view_by_its_angles(seed: int) -> None:
    """Cosines and sines decide as angles do, also behind the sensor and across the half turn."""
    rng = np.random.default_rng(seed)
    points, pose = rng.normal(0, 5, (300, 3)), turned(rng.uniform(-3, 3), 0.2)
    for azimuth in (
        (-1.0, 1.0),
        (2.5, -2.5),
        (2.5, 4.0),
        (-math.pi, math.pi),
        (0.0, 2 * math.pi),
        (0.1, 6.0),
        (-6.2, -1),
    ):
        view = optipmb.FieldOfView(azimuth, (-0.7, 0.4), (1.0, 9.0))
        found = [in_view(*point, pose.rotation, view.limits) for point in points]
        np.testing.assert_array_equal(found, contains(view, points @ pose.rotation))


def test_a_box_at_the_border_is_partly_in_view() -> None:
    """All inside: 1, all outside: 0, cut across: the share on this side."""
    half = optipmb.FieldOfView(azimuth=(-math.pi / 2, math.pi / 2))
    behind = optipmb.FieldOfView(azimuth=(math.pi / 2, -math.pi / 2))
    mean = np.zeros((4, 6))
    mean[:, 0], mean[:, 1] = [5.0, -5.0, 1.0, -1.0], 10.0
    found = shares(half, mean, np.zeros((4, 6, 6)), np.repeat(BOX, 4, axis=0), turned(0.0))
    np.testing.assert_allclose(found, [1.0, 0.0, 5 / 6, 1 / 6])
    other = shares(behind, mean, np.zeros((4, 6, 6)), np.repeat(BOX, 4, axis=0), turned(0.0))
    np.testing.assert_allclose(other, 1.0 - found)
    low = optipmb.FieldOfView(elevation=(-math.pi / 2, 0.0))
    np.testing.assert_allclose(shares(low, mean[:1], np.zeros((1, 6, 6)), BOX, turned(0.0)), 5 / 6)
    near = optipmb.FieldOfView(range=(0.0, 8.0))
    assert not shares(near, mean[:1], np.zeros((1, 6, 6)), BOX, turned(0.0))[0]
    assert shares(near, mean[:1], np.diag([0, 16.0, 0, 0, 0, 0])[None], BOX, turned(0.0))[0] > 0.0


@SEEDS
def test_looks_are_counted_as_plain_arithmetic_says(seed: int) -> None:
    """Time since the last look, at most a period where others came between; misses stand still for the rest."""
    rng = np.random.default_rng(seed)
    before, now, period = 5_000_000_000, 5_000_000_000 + int(rng.integers(0, 200_000_000)), 0.1
    share, looked = rng.choice([0.0, 0.25, 1.0], 30), before - rng.choice([0, 50_000_000, 3_000_000_000], 30)
    since = looked - rng.integers(0, 10**9, 30)
    time, missed = count_looks(share, looked, since, (now, before, (now - before) * 1e-9, period))
    covered = np.minimum(now - looked, max(now - before, 100_000_000))
    np.testing.assert_array_equal(time, covered * 1e-9)
    counted = (now - missed) - (before - since)
    np.testing.assert_allclose(counted, share * covered, atol=0.5)


def test_gates_are_closed_for_what_cannot_be_detected() -> None:
    """A radius in which nothing lies, where p_d is zero."""
    radius = np.array([1.0, 2.0, 3.0])
    close_gates(np.array([0.5, 0.0, 1e-9]), radius)
    np.testing.assert_array_equal(radius, [1.0, -1.0, 3.0])


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"azimuth": (1.0, 1.0)}, "azimuth"),
        ({"azimuth": (math.pi, -math.pi)}, "azimuth"),
        ({"azimuth": (-4.0, 4.0)}, "azimuth"),
        ({"azimuth": (0.0, np.nan)}, "azimuth"),
        ({"azimuth": (0.0, 7.0)}, "azimuth"),
        ({"azimuth": (0.0, 1.0, 2.0)}, "azimuth"),
        ({"azimuth": "wide"}, "azimuth"),
        ({"elevation": (0.1, -0.1)}, "elevation"),
        ({"elevation": (0.0, 2.0)}, "elevation"),
        ({"range": (-1.0, 5.0)}, "range"),
        ({"range": (5.0, 5.0)}, "range"),
        ({"range": (0.0, np.inf)}, "range"),
        ({"range": None}, "range"),
    ],
)
def test_what_is_no_field_of_view_is_refused(given: dict[str, Any], path: str) -> None:
    """The field is named."""
    with pytest.raises(optipmb.FrameError) as refused:
        optipmb.FieldOfView(**given)
    assert refused.value.path == f"field_of_view.{path}"


def test_a_frame_takes_nothing_else_for_a_field_of_view() -> None:
    """Neither from `make_frame` nor by hand."""
    with pytest.raises(optipmb.FrameError, match="field_of_view"):
        boxes(KITTI, 0.0, (0, 0), field_of_view=(-1.0, 1.0))
    with pytest.raises(optipmb.FrameError, match="field_of_view"):
        replace(boxes(KITTI, 0.0, (0, 0)), field_of_view="front")


def test_the_field_of_view_is_in_the_frame_of_the_boxes() -> None:
    """It has the pose of the frame unless it has its own."""
    pose, other = turned(1.0), turned(2.0)
    assert boxes(KITTI, 0.0, (0, 0), pose=pose, field_of_view=FORWARD).field_of_view == replace(FORWARD, pose=pose)
    own = replace(FORWARD, pose=other)
    assert boxes(KITTI, 0.0, (0, 0), pose=pose, field_of_view=own).field_of_view == own
    assert boxes(KITTI, 0.0, (0, 0), field_of_view=FORWARD).field_of_view == FORWARD


def drive(
    profile: str, views: tuple[optipmb.FieldOfView | None, optipmb.FieldOfView | None], rear_s: float
) -> list[tuple[float, list[int]]]:
    """Overtake a car: a front sensor at 20 Hz sees it first, one behind at a slower rate then; both know their pose."""
    parameters, label = (CARS | HASTY)[profile]
    tracker, found = optipmb.Tracker(parameters), []
    density = tracker.initial()
    events = [(0.05 * k, False) for k in range(100)] + [(rear_s * k + 0.01, True) for k in range(int(5 / rear_s))]
    for t, rear in sorted(events):
        ego = 20.0 * t
        place = np.array([30.0 + 8.0 * t - ego, 3.5, 0.0])  # from the vehicle
        seen = contains(BACKWARD if rear else FORWARD, place[None])[0]
        frame = boxes(
            parameters,
            t,
            place[:2] if seen else (),
            velocity=None if profile == "kitti" else (8.0, 0.0),
            label=label,
            pose=turned(0.0, translation=(ego, 0.0, 0.0)),
            field_of_view=views[rear],
        )
        result = tracker.step(density, frame)
        density = result.density
        found.append((t, density.bernoulli.id.tolist()))
    return found


@pytest.mark.parametrize("profile", CARS | HASTY)
def test_a_car_that_leaves_the_front_view_for_the_rear_one_keeps_its_id(profile: str) -> None:
    """It is seen ahead, then by no sensor, then twice a second behind, while the front sensor streams on."""
    assert {tuple(ids) for _, ids in drive(profile, (FORWARD, BACKWARD), 0.5)} == {(1,)}


def test_without_fields_of_view_the_front_sensor_ends_the_car() -> None:
    """It goes a few tenths of a second after it left the front view, and is another one with each look behind."""
    found = drive("nuscenes-paper", (None, None), 0.5)
    lost = next(t for t, ids in found if t > 1.0 and not ids)
    left = (30.0 - 3.5 / math.tan(1.0)) / 12.0
    assert 0.1 < lost - left < 0.4
    assert max(one for _, ids in found for one in ids) > 3


@pytest.mark.parametrize("profile", CARS)
def test_what_nobody_looks_at_coasts(profile: str) -> None:
    """For seconds: existence falls by survival alone, score and counters stay, no evidence is counted."""
    parameters, label = CARS[profile]
    tracker = optipmb.Tracker(parameters)
    density = tracker.initial()
    for k in range(5):
        density = tracker.step(density, boxes(parameters, 0.1 * k, (20, 0), label=label)).density
    before = density.bernoulli
    for k in range(5, 45):
        result = tracker.step(density, boxes(parameters, 0.1 * k, field_of_view=BACKWARD))
        density = result.density
    after, elapsed = density.bernoulli, 4.0
    survival = parameters.classes[label].survival ** (elapsed / parameters.nominal_period)
    np.testing.assert_allclose(after.existence, before.existence * survival)
    for name in ("id", "score", "evidence", "heading_odds", "seen_ns", "label", "auxiliary"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    assert density.misses is not None
    assert (density.missed_from_ns[0], density.misses.looked_ns[0]) == (density.stamp_ns, 400_000_000)
    assert result.tracks.time_since_detection == pytest.approx([elapsed])


def test_what_is_looked_at_again_is_missed_from_then_on() -> None:
    """A car that is gone when it should come into view dies as soon as one that was in view all the time."""

    def lives(hidden: int) -> int:
        tracker = optipmb.Tracker(KITTI)
        density = tracker.initial()
        for k in range(5):
            density = tracker.step(density, boxes(KITTI, 0.1 * k, (20, 0))).density
        for k in range(5, 5 + hidden):
            density = tracker.step(density, boxes(KITTI, 0.1 * k, field_of_view=BACKWARD)).density
        k = 0
        while len(density.bernoulli):
            density = tracker.step(density, boxes(KITTI, 0.1 * (5 + hidden + k), field_of_view=FORWARD)).density
            k += 1
        return k

    assert lives(0) == lives(30)


def test_looks_weigh_by_the_time_since_the_last_one() -> None:
    """A sensor at 10 Hz ends a car in the same time whether or not another one looks elsewhere just before it."""

    def lives(offset: float) -> int:
        tracker = optipmb.Tracker(KITTI)
        density = tracker.initial()
        for k in range(5):
            density = tracker.step(density, boxes(KITTI, 0.1 * k, (20, 0), field_of_view=FORWARD)).density
        while len(density.bernoulli):
            k += 1
            if offset:
                density = tracker.step(density, boxes(KITTI, 0.1 * k - offset, field_of_view=BACKWARD)).density
            density = tracker.step(density, boxes(KITTI, 0.1 * k, field_of_view=FORWARD)).density
        return k

    assert len({lives(0.0), lives(0.01), lives(0.05), lives(0.09)}) == 1


@pytest.mark.parametrize("profile", CARS)
def test_what_left_the_view_ends(profile: str) -> None:
    """Cars pass one after the other: no object is kept longer than 6 s and its misses, none published 7.5 s unseen."""
    parameters, label = CARS[profile]
    tracker, own = optipmb.Tracker(parameters), parameters.classes[label]
    density, unseen, kept = tracker.initial(), 0.0, 0
    for k in range(300):
        x = 60.0 - 12.0 * (0.1 * k % 5.0)
        frame = boxes(parameters, 0.1 * k, (x, 3.5), yaw=math.pi, label=label, field_of_view=FORWARD)
        if x <= 4.0:
            frame = boxes(parameters, 0.1 * k, field_of_view=FORWARD)
        result = tracker.step(density, frame)
        density = result.density
        unseen = max(unseen, result.tracks.time_since_detection.max(initial=0.0))
        kept = max(kept, len(density.bernoulli), len(density.poisson))
    assert 5.0 < unseen < 6.0 + (own.extract_misses + 1) * parameters.nominal_period
    assert kept <= 4


def test_components_out_of_view_neither_age_nor_lose_weight() -> None:
    """A low score announces an object; when the sensor looks there again some periods later, it is still announced."""
    tracker = optipmb.Tracker(KITTI)
    low = 0.5 * (KITTI.classes["Car"].score_filter + KITTI.classes["Car"].birth_score)
    density = tracker.step(tracker.initial(), boxes(KITTI, 0.0, (20, 0), score=low)).density
    weight = density.poisson.weight.copy()
    for k in range(1, 4):
        density = tracker.step(density, boxes(KITTI, 0.1 * k, field_of_view=BACKWARD)).density
    survival = KITTI.classes["Car"].survival ** (0.3 / KITTI.nominal_period)
    np.testing.assert_allclose(density.poisson.weight, weight * survival)
    found = tracker.step(density, boxes(KITTI, 0.4, (20, 0), score=low, field_of_view=FORWARD))
    assert found.density.bernoulli.id.tolist() == [1]


@pytest.mark.parametrize("half", [10, 30, 40, 50])
def test_what_is_detected_outside_the_field_of_view_keeps_its_id(half: float) -> None:
    """A view stated too narrow makes no new objects: a detection shows what the sensor sees."""
    view = optipmb.FieldOfView(azimuth=(-math.radians(half), math.radians(half)))
    tracker, density = optipmb.Tracker(KITTI), optipmb.Tracker(KITTI).initial()
    for k in range(20):
        place = 14.0 + 0.3 * k, 15.0
        density = tracker.step(density, boxes(KITTI, 0.1 * k, place, field_of_view=view)).density
    assert density.bernoulli.id.tolist() == [1]


@SEEDS
def test_places_out_of_view_show_what_is_in_their_gate(seed: int) -> None:
    """As plain numpy says."""
    rng = np.random.default_rng(seed)
    mean, places, gate = rng.uniform(-9, 9, (30, 6)), rng.uniform(-9, 9, (6, 2)), rng.uniform(0.5, 4, 30)
    share = rng.uniform(0, 1, 30)
    near = (np.linalg.norm(mean[:, None, :2] - places, axis=2) <= gate[:, None]).any(axis=1)
    wanted = np.where(near, 1.0, share)
    show(mean, gate, places, share)
    np.testing.assert_array_equal(share, wanted)


def test_a_parked_car_at_the_border_is_missed_in_proportion() -> None:
    """A sixth of it in view: it lives several times as long as one in full view."""

    def lives(view: optipmb.FieldOfView) -> int:
        tracker = optipmb.Tracker(KITTI)
        density, k = tracker.initial(), 0
        for k in range(20):
            density = tracker.step(density, boxes(KITTI, 0.1 * k, (-1.0, 10.0), size=(4.0, 2.0, 1.5))).density
        while len(density.bernoulli) and k < 400:
            k += 1
            density = tracker.step(density, boxes(KITTI, 0.1 * k, field_of_view=view)).density
        return k - 19

    whole = lives(optipmb.FieldOfView())
    part = lives(optipmb.FieldOfView(azimuth=(-math.pi / 2, math.pi / 2)))
    assert part > 2 * whole


@pytest.mark.parametrize("profile", CARS)
def test_a_sensor_that_sees_everything_may_say_so(profile: str) -> None:
    """The full circle without limits gives the tracks of no field of view."""
    parameters, label = CARS[profile]
    rng = np.random.default_rng(1)
    plain, wide = optipmb.Tracker(parameters), optipmb.Tracker(parameters)
    one, other = plain.initial(), wide.initial()
    for k in range(40):
        place = [(8.0 * 0.1 * k, 0.0), (30.0, -5.0), (50.0, 0.5 * k)]
        place = [xy for xy in place if rng.random() < 0.7]
        given = {"label": label, "score": rng.uniform(0.3, 1.0, len(place)), "pose": turned(0.3, 0.1)}
        first = plain.step(one, boxes(parameters, 0.1 * k, place, **given))
        view = optipmb.FieldOfView()
        second = wide.step(other, boxes(parameters, 0.1 * k, place, field_of_view=view, **given))
        one, other = first.density, second.density
        for name, column in first.tracks.columns():
            np.testing.assert_allclose(getattr(second.tracks, name), column, atol=1e-12, err_msg=name)


def test_the_online_tracker_takes_fields_of_view() -> None:
    """They fit the frame; no object outside dies."""
    tracker = optipmb.OnlineTracker("kitti")
    given = {"x": [20.0], "y": [0.0], "z": [0.0], "l": [4.0], "w": [2.0], "h": [1.5], "yaw": [0.0], "score": [0.9]}
    tracker.update({**given, "class": ["Car"]}, t=0.0, field_of_view=FORWARD)
    for k in range(1, 30):
        tracker.update(t=0.1 * k, field_of_view=BACKWARD)
    assert tracker.density.bernoulli.id.tolist() == [1]


def test_misses_are_stored_with_the_density() -> None:
    """Times without a look survive storage; impossible stamps and other lengths are refused."""
    tracker = optipmb.Tracker(KITTI)
    density = tracker.step(tracker.initial(), boxes(KITTI, 0.0, (20, 0))).density
    assert density.misses is None
    density = tracker.step(density, boxes(KITTI, 0.1, field_of_view=BACKWARD)).density
    columns = optipmb.columns_in(optipmb.bytes_of(density), len(density.labels))
    again = optipmb.density_of(density.stamp_ns, density.next_id, columns, density.labels)
    assert again.misses is not None
    assert (again.misses.missed_from_ns.tolist(), again.misses.looked_ns.tolist()) == ([100_000_000], [0])
    after = [tracker.step(one, boxes(KITTI, 0.2, (20, 0))).density for one in (density, again)]
    for name, column in optipmb.columns_of(after[0]).items():
        np.testing.assert_array_equal(optipmb.columns_of(after[1])[name], column, err_msg=name)
    for name, value in (
        ("missed_from_ns", [-1]),
        ("looked_ns", [10**12]),
        ("missed_from_ns", [0, 0]),
        ("looked_ns", [0.5]),
    ):
        wrong = columns | {f"misses.{name}": np.array(value)}
        with pytest.raises(optipmb.DensityError, match="misses"):
            optipmb.density_of(density.stamp_ns, density.next_id, wrong, density.labels)
    short = replace(density, misses=density.misses.take(np.zeros(0, np.int64)))
    with pytest.raises(optipmb.DensityError):
        tracker.step(short, boxes(KITTI, 0.2))


def test_without_the_birth_model_and_without_limits_frames_are_taken_too() -> None:
    """The ablation's components of measurements have their places in view; a frame without limits sees all again."""
    for modules in (optipmb.Modules(habm=False), optipmb.Modules(rpp=False, adp=False)):
        tracker = optipmb.Tracker(KITTI, modules)
        density = tracker.initial()
        for k, view in enumerate((FORWARD, BACKWARD, None, FORWARD, None)):
            place = (20, 0) if view is not BACKWARD else ()
            density = tracker.step(density, boxes(KITTI, 0.1 * k, place, field_of_view=view)).density
        assert density.bernoulli.id.tolist() == [1]

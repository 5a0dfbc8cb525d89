"""Detections without heading, size or height: their kernels against numpy, and what a user sees of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from class_rows import class_row, class_rows
from compare import density_bytes, tracks_bytes
from numpy.typing import NDArray
from scenes import Options, SceneFrame, frame_of, partial, random_parameters, scene

import optipmb
from optipmb.filter.geometry import boxes_overlap, iou_exceeds
from optipmb.filter.predict import heading_unknown, predict_state
from optipmb.filter.unknown_heading import find_heading, lose_heading, show_heading, take_heading
from optipmb.filter.update import ukf_updates
from optipmb.model.stages import Measurements

Array = NDArray[np.float64]
NAN = math.nan
SEEDS = range(4)


def turned(angle: float) -> Array:
    """The matrix (2, 2) of a turn."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def state(rng: np.random.Generator) -> tuple[Array, Array]:
    """A state of unknown heading: x, y, speed, direction; covariance of position and of velocity along and across."""
    mean = np.array([*rng.normal(0, 50, 2), rng.uniform(0.1, 9), rng.uniform(-3, 3), 0.0, 0.0])
    root, covariance = rng.normal(0, 1, (4, 4)), np.zeros((6, 6))
    covariance[:4, :4] = root @ root.T + 0.1 * np.eye(4)
    return mean, covariance


def plain(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """The same state as x, y and the velocity along the axes of the world."""
    axes = np.eye(4)
    axes[2:, 2:] = turned(mean[3])
    return np.array([*mean[:2], *(axes[2:, 2] * mean[2])]), axes @ covariance[:4, :4] @ axes.T


def assert_same(found: tuple[Array, Array], wanted: tuple[Array, Array]) -> None:
    """Mean and covariance agree to 1e-9."""
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_prediction_is_that_of_a_linear_model(seed: int) -> None:
    """F P F' + Q with constant velocity, in the axes of the world; the direction stays."""
    rng = np.random.default_rng(seed)
    (mean, covariance), dt = state(rng), float(rng.uniform(0.05, 3))
    own = class_row(process_noise=[0.2, 0.2, 0.7, 9.0, 9.0, 9.0], birth_unknown=[9.0, 9.0, 9.0, 9.0, 9.0, 1.5])
    out, spread = np.empty(6), np.empty((6, 6))
    assert predict_state(mean, covariance, dt, own, (np.empty((6, 6)), np.empty((12, 6))), out, spread) == 0
    step = np.eye(4) + dt * np.eye(4, k=2)
    m, p = plain(mean, covariance)
    gained = 0.7**2 * dt + (3.0 * 1.5 * dt) ** 2
    assert_same(plain(out, spread), (step @ m, step @ p @ step.T + np.diag([0.04 * dt] * 2 + [gained] * 2)))
    assert out[3] == mean[3]
    assert heading_unknown(spread)
    assert (spread == spread.T).all()


@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_update_is_the_linear_kalman_filter(seed: int, *, velocity: bool) -> None:
    """K = P H' (H P H' + R)^-1 in the axes of the world, and no velocity across in the axes of the state."""
    rng = np.random.default_rng(seed)
    mean, covariance = state(rng)
    covariance[2:4, 2:4] += 1e6 * np.eye(2)  # so that the update finds no heading
    z = mean[:2] + rng.normal(0, 1, 2)
    measured = rng.normal(0, 3, 2) if velocity else np.full(2, NAN)
    zero = np.zeros(1, np.int64)
    own = class_rows(1, noise_position=0.5, noise_velocity=1e4)
    given = Measurements(z[None], np.array([NAN]), measured[None], np.ones((1, 4)), np.ones(1), zero, zero)
    out, spread = np.empty((1, 6)), np.empty((1, 6, 6))
    assert ukf_updates(zero, zero, mean[None], covariance[None], given, own, out, spread) == 0
    m, p = plain(mean, covariance)
    rows = np.eye(4) if velocity else np.eye(4)[:2]
    noise = np.diag([0.25, 0.25, 1e8, 1e8][: len(rows)])
    gain = p @ rows.T @ np.linalg.inv(rows @ p @ rows.T + noise)
    z_all = np.array([*z, *measured])[: len(rows)]
    np.testing.assert_allclose(plain(out[0], spread[0])[0], m + gain @ (z_all - rows @ m), rtol=1e-7)
    np.testing.assert_allclose(plain(out[0], spread[0])[1], p - gain @ rows @ p, rtol=1e-6, atol=1e-4)
    assert out[0, 2] >= 0.0
    assert (spread[0, 4:] == 0.0).all()


def test_without_a_heading_the_update_of_a_known_one_leaves_its_row_out() -> None:
    """The posterior equals the limit of a heading whose noise grows, as H is linear without a velocity."""
    rng = np.random.default_rng(3)
    root, mean = rng.normal(0, 0.2, (6, 6)), np.array([3.0, -2.0, 7.0, 0.4, 0.1, 0.5])
    covariance = (root @ root.T + 0.05 * np.eye(6))[None]
    zero, found = np.zeros(1, np.int64), []
    for yaw, noise in ((NAN, 0.1), (0.5, 1e7)):
        own = class_rows(1, noise_position=0.5, noise_heading=noise)
        place, velocity = np.array([[3.4, -2.3]]), np.full((1, 2), NAN)
        given = Measurements(place, np.array([yaw]), velocity, np.ones((1, 4)), np.ones(1), zero, zero)
        out, spread = np.empty((1, 6)), np.empty((1, 6, 6))
        ukf_updates(zero, zero, mean[None], covariance, given, own, out, spread)
        found.append((out, spread))
    assert_same(*found)


def test_a_heading_is_found_taken_and_lost() -> None:
    """By a velocity of four deviations, by a detection, and by doubt; position and velocity stay."""
    own = class_row(birth_unknown=[0.3, 0.3, 9.0, 0.2, 0.25, 1.25], noise_heading=0.125)
    mean, covariance = state(np.random.default_rng(0))
    mean[2] = 8.0
    covariance[2:4, 2:4] = np.diag([3.9, 3.0])
    slow, fast = mean.copy(), mean.copy()
    slow[2] = 7.8
    unknown, known = covariance.copy(), covariance.copy()
    find_heading(slow, unknown, own)
    find_heading(fast, known, own)
    assert heading_unknown(unknown)
    np.testing.assert_array_equal(fast, mean)
    np.testing.assert_allclose(known[3, :4], covariance[3, :4] / [8, 8, 8, 64], rtol=1e-12)
    assert (known[4, 4], known[5, 5]) == (0.25**2, 1.25**2)
    assert not heading_unknown(known)

    lose_heading(fast, known)
    assert heading_unknown(known)
    np.testing.assert_allclose(fast[:4], mean[:4], rtol=1e-12)
    np.testing.assert_allclose(
        known[2:4, 2:4], covariance[2:4, 2:4] * np.outer([1, s := math.hypot(1, math.sqrt(3.9) / 8)], [1, s])
    )
    backwards, spread = np.array([0.0, 0.0, -2.0, 0.5, 0.1, 0.3]), np.eye(6)
    lose_heading(backwards, spread)
    np.testing.assert_allclose(backwards, [0, 0, 2, 0.5 - math.pi, 0, 0])

    take_heading(slow, unknown, mean[3] + math.pi / 3, own)
    assert slow[2] == pytest.approx(3.9)
    assert slow[3] == pytest.approx(math.remainder(mean[3] + math.pi / 3, math.tau))
    assert unknown[3, 3] == 0.125**2
    assert (unknown[3, :3] == 0.0).all()

    for speed, wanted in ((0.0, math.pi**2 / 3), (10.0, 0.03)):
        shown = covariance.copy()
        show_heading(speed, shown)
        assert shown[3, 3] == pytest.approx(wanted)
        np.testing.assert_array_equal(shown[:3, :3], covariance[:3, :3])


@pytest.mark.parametrize("seed", SEEDS)
def test_boxes_of_unknown_heading_overlap_alike_in_all_axes(seed: int) -> None:
    """An unknown heading copies the other box's, two make squares that face each other; turning changes nothing."""
    rng = np.random.default_rng(seed)
    first, second = (np.array([*rng.normal(0, 1.5, 2), *rng.uniform(1, 5, 2), rng.uniform(-3, 3)]) for _ in range(2))
    threshold, angle = float(rng.uniform(0.02, 0.5)), float(rng.uniform(-3, 3))
    assert boxes_overlap(first, second, threshold) == iou_exceeds(first, second, threshold)
    parallel = second.copy()
    parallel[4] = first[4]
    blind, other = second.copy(), first.copy()
    blind[4] = NAN
    wanted = iou_exceeds(first, parallel, threshold)
    assert boxes_overlap(first, blind, threshold) == boxes_overlap(blind, first, threshold) == wanted
    other[4] = NAN
    squares = [np.array([0.0, 0.0, *[math.sqrt(one[2] * one[3])] * 2, 0.0]) for one in (first, second)]
    squares[1][0] = math.hypot(*(second - first)[:2])
    wanted = iou_exceeds(squares[0], squares[1], threshold)
    assert boxes_overlap(other, blind, threshold) == wanted
    for box in (other, blind):
        box[:2] = turned(angle) @ box[:2] + 7.0
    assert boxes_overlap(other, blind, threshold) == wanted
    assert math.isnan(blind[4])


def run(parameters: optipmb.Parameters, frames: list[SceneFrame]) -> list[optipmb.StepResult]:
    """The results of all frames of a scene."""
    tracker = optipmb.Tracker(parameters)
    density, results = tracker.initial(), []
    for given in frames:
        results.append(tracker.step(density, frame_of(parameters, given)))
        density = results[-1].density
    return results


def points(tracker: optipmb.OnlineTracker, k: int, **more: Any) -> optipmb.OnlineTracks:
    """A car at 8 m/s along y and a pedestrian that stands, seen as points."""
    return tracker.update({"x": [5.0, 9.0], "y": [0.8 * k, -4.0], "class": ["car", "person"]}, t=0.1 * k, **more)


@pytest.mark.parametrize("profile", optipmb.profiles())
def test_points_are_tracked_and_a_heading_comes_from_motion(profile: str) -> None:
    """Both keep their ids; what moves has a heading after a second at most, and what stands says that it has none."""
    tracker = optipmb.OnlineTracker(profile, unknown_classes="leave out")
    found = [points(tracker, k) for k in range(12)]
    if len(found[-1]) < 2:  # a profile of fewer classes
        assert len(tracker.parameters.classes) < 2
        return
    assert {tuple(one.id.tolist()) for one in found[2:]} == {(1, 2)}
    last = found[-1]
    car, person = (int(np.flatnonzero(last.center[:, 0].round() == x)[0]) for x in (5, 9))
    assert last.measured[[car, person]].tolist() == [1, 0]
    assert last.yaw[car] == pytest.approx(math.pi / 2, abs=0.02)
    assert last.heading_confidence[person] == 0.5
    assert last.covariance[person, 3, 3] > 1.0
    assert optipmb.sound(last.tracks)


def test_a_point_has_the_box_of_its_class_until_one_is_measured() -> None:
    """The size of the profile, else by the class's name; a first size, heading and height hold at once."""
    document = optipmb.load_profile("kitti").model_dump()
    document["classes"]["Car"]["default_size"] = (3.5, 1.5, 1.25)
    tracker = optipmb.OnlineTracker(optipmb.parse_parameters(document))
    first = points(tracker, 0)
    car = int(np.flatnonzero(first.center[:, 0] == 5.0)[0])
    assert first.size.tolist()[car] == [3.5, 1.5, 1.25]
    assert first.size.tolist()[1 - car] == [0.7, 0.7, 1.75]
    assert first.center[:, 2].tolist() == (0.5 * first.size[:, 2]).tolist()
    assert first.measured.tolist() == [0, 0]
    whole = {"center": [[5.0, 0.8, 2.0]], "size": [[4.5, 2.0, 1.5]], "yaw": [1.5], "score": [0.6], "class": ["car"]}
    second = tracker.update(whole, t=0.1)
    car = int(np.flatnonzero(second.detection == 0)[0])
    assert second.measured[car] == 7
    assert second.size[car].tolist() == [4.5, 2.0, 1.5]
    assert second.center[car, 2] == 2.0
    assert second.yaw[car] == pytest.approx(1.5, abs=1e-6)
    third = points(tracker, 2)
    assert third.size[int(np.flatnonzero(third.center[:, 0] < 7)[0])].tolist() == [4.5, 2.0, 1.5]
    assert optipmb.OnlineTracker("kitti").update(whole | {"score": [0.95]}, t=0.1).measured.tolist() == [7]


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [(0.0, 0.1, True), (0.0, 3.1, True), (0.0, 1.5, False), (0.0, math.nan, True), (math.nan, 1.5, True)],
)
def test_a_detection_far_ahead_is_of_the_object_unless_it_has_turned(
    first: float, second: float, *, same: bool
) -> None:
    """A car that moves 8 m in half a second keeps its id but where both headings are known and differ, modulo pi."""
    tracker = optipmb.OnlineTracker(optipmb.generic_parameters(("car",), 0.5))
    ids = []
    for t, yaw in ((0.0, first), (0.5, second)):
        box = {"center": [[16.0 * t, 0.0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [yaw], "score": [0.95]}
        tracks = tracker.update(box | {"class": ["car"]}, t=t)
        ids += tracks.id[tracks.detection == 0].tolist()
    assert (ids == [1, 1]) is same


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_detections_does_not_matter(seed: int) -> None:
    """Also where equal detections differ only in unknown values."""
    rng = np.random.default_rng(seed)
    parameters = optipmb.parse_parameters(random_parameters(seed + 40))
    frames = []
    for given in scene(seed, Options(frames=30)):
        rows = rng.random((3, len(given.score))) < 0.5
        rows[:, : len(rows[0]) // 2] = False
        again = partial(given, *rows)
        twice = again.taken(np.r_[np.arange(len(given.score)), np.arange(len(given.score))])
        frames.append(replace(twice, yaw=np.r_[again.yaw, np.full(len(given.score), NAN)]))
    orders = [rng.permutation(len(given.score)) for given in frames]
    shuffled = [given.taken(order) for given, order in zip(frames, orders, strict=True)]
    for one, other in zip(run(parameters, frames), run(parameters, shuffled), strict=True):
        assert tracks_bytes(one.tracks, without=("detection",)) == tracks_bytes(other.tracks, without=("detection",))
        assert density_bytes(one.density) == density_bytes(other.density)


@pytest.mark.parametrize("seed", range(3))
def test_partial_detections_leave_a_valid_density_that_can_be_stored(seed: int) -> None:
    """With clouds, fields of view, groups and modules; its bytes give the density again, and tracks are sound."""
    rng = np.random.default_rng(seed)
    parameters = optipmb.parse_parameters(random_parameters(seed, calibrated=seed % 2 == 0))
    tracker = optipmb.Tracker(parameters, optipmb.Modules(habm=seed != 2, rpp=seed != 3))
    density, known = tracker.initial(), set()
    for given in scene(seed, Options(frames=40)):
        frame = frame_of(parameters, partial(given, *(rng.random((3, len(given.score))) < 0.7)))
        view = optipmb.FieldOfView(azimuth=(-1.5, 1.5)) if seed > 3 else None
        result = tracker.step(density, replace(frame, field_of_view=view))
        density = result.density
        assert optipmb.sound(result.tracks)
        known |= set(() if result.measured is None else result.measured.tolist())
        optipmb.predict_tracks(density, [1.0], parameters)
        paths = optipmb.predict_tracks(result.tracks, [0.5, 1.0], parameters)
        assert np.isfinite(paths.covariance).all()
        columns = optipmb.columns_in(optipmb.bytes_of(density), len(parameters.labels))
        again = optipmb.density_of(density.stamp_ns, density.next_id, columns, parameters.labels)
        assert density_bytes(again) == density_bytes(density)
    assert {0, 7} < known


def test_a_sensor_that_stands_higher_changes_no_height_that_is_unknown() -> None:
    """Positions of a point come from a tilted sensor as from its own height, and the height stays unknown."""
    parameters = optipmb.load_profile("kitti")
    tilted = np.array([0.9, 0.05, 0.1, 0.3])
    pose = optipmb.Pose(np.array([5.0, 6.0, 7.0]), tilted / np.linalg.norm(tilted))
    given: dict[str, Any] = {"stamp_ns": 0, "labels": ("Car",), "label": [0, 0], "score": [0.9, 0.9], "pose": pose}
    center = np.array([[3.0, 4.0, NAN], [3.0, 4.0, 0.0]])
    frame, _ = optipmb.make_frame(parameters, center=center, **given)
    np.testing.assert_allclose(frame.center[0, :2], frame.center[1, :2], rtol=1e-12)
    assert np.isnan(frame.center[:, 2]).tolist() == [True, False]
    assert np.isnan(frame.yaw).all()
    assert np.isnan(frame.size).all()

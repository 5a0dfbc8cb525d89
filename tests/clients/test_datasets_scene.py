"""Generated scenes: physically sane, calibrated and reproducible."""

import hashlib
import itertools
import subprocess
import sys
from typing import TypeAlias

import numpy as np
import pytest
from boxes import points_in_box
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets.scene.dataset import RADIUS, SceneSequence
from optipmb_tools.datasets.scene.detector import FALSE, MIN_SCORE, Found
from optipmb_tools.datasets.scene.lidar import GROUND
from optipmb_tools.datasets.scene.traffic import HALF_WIDTH, fixed_boxes
from optipmb_tools.geometry import rotation_of, wrap_angle

RATE = 10.0
Observed: TypeAlias = list[list[tuple[np.ndarray, Found]]]
CAR, PEDESTRIAN, CYCLIST = range(3)


def scene(seed: int = 0, frames: int = 150, **options: float) -> SceneSequence:
    sequence = open_dataset("scene", seed=seed, frames=frames, **options).sequences(["all"])[0]
    assert isinstance(sequence, SceneSequence)
    return sequence


@pytest.fixture(scope="module")
def scenes() -> list[SceneSequence]:
    return [scene(seed, 300) for seed in range(4)]


@pytest.fixture(scope="module")
def observed(scenes: list[SceneSequence]) -> Observed:
    """For each frame of two scenes, the points of the boxes and the detections; truth needs no further scans."""
    kept = []
    for sequence in scenes[:2]:
        seen = (sequence.observe(frame) for frame in range(len(sequence)))
        kept.append([(view.points, found) for view, found in seen])
    return kept


def digest(sequence: SceneSequence) -> str:
    total = hashlib.sha256()
    for frame in sequence.frames():
        assert frame.cloud is not None
        columns = (frame.label, frame.center, frame.size, frame.yaw, frame.score, frame.cloud.xyz, *frame.pose)
        for column in columns:
            total.update(np.ascontiguousarray(column).tobytes())
    truth = sequence.truth()
    for column in (truth.id, truth.center, truth.yaw, truth.velocity, truth.points, truth.covered):
        total.update(np.ascontiguousarray(column).tobytes())
    return total.hexdigest()


def test_the_same_seed_gives_the_same_bytes_in_another_process() -> None:
    """Detections, clouds, poses and truth do not depend on the order of access; another seed or scene differs."""
    here = scene(5, 4)
    here.truth()
    program = (
        "import sys; sys.path[:0] = sys.argv[1:]; "
        "from test_datasets_scene import digest, scene; print(digest(scene(5, 4)))"
    )
    folders = [path for path in sys.path if path.endswith("support")] + [str(__file__).rpartition("/")[0]]
    there = subprocess.run([sys.executable, "-c", program, *folders], capture_output=True, text=True, check=True)
    assert digest(here) == digest(here) == there.stdout.strip()
    assert digest(here) != digest(scene(6, 4))
    other = open_dataset("scene", seed=5, frames=4).sequences(["0001"])[0]
    assert isinstance(other, SceneSequence)
    assert digest(here) != digest(other)


def weighed(column: np.ndarray) -> float:
    """Return one number that changes with any value of a column and with its place."""
    return float(column.ravel() @ np.cos(np.arange(column.size)))


def test_a_seed_gives_the_scene_that_it_gave_before() -> None:
    """Figures that were measured on scenes hold in the next release: objects, their traffic, detections and clouds."""
    sequence = scene(7, 20, velocity=1)
    frames, truth = list(sequence.frames()), sequence.truth()
    clouds = [frame.cloud.xyz for frame in frames if frame.cloud is not None]
    detected = ("center", "size", "yaw", "velocity", "score")
    found = {name: np.concatenate([getattr(frame, name) for frame in frames]) for name in detected}
    found |= {"cloud": np.concatenate(clouds).astype(np.float64)}
    found |= {f"true {name}": getattr(truth, name) for name in ("id", "center", "yaw", "velocity", "points", "covered")}
    assert {name: weighed(column) for name, column in found.items()} == pytest.approx(
        {
            "center": 988.789204, "size": 17.7176306, "yaw": -3.13737891, "velocity": 35.0721884,
            "score": -0.332010159, "cloud": -726.378632, "true id": -28.0849198, "true center": -59.9147632,
            "true yaw": -46.3768611, "true velocity": -33.281936, "true points": 4220.28845, "true covered": 3.45176526,
        },
        rel=1e-6,
    )  # fmt: skip


def test_clouds_and_velocities_are_options() -> None:
    """Without velocities all else is equal; with them, they are near the true ones."""
    plain, rich = scene(2, 5), scene(2, 5, clouds=0, velocity=1)
    assert plain.has_clouds
    assert not rich.has_clouds
    for a, b in zip(plain.frames(), rich.frames(), strict=True):
        assert b.cloud is None
        assert a.velocity is None
        assert b.velocity is not None
        assert b.velocity.shape == (len(b), 2)
        np.testing.assert_array_equal(a.center, b.center)


def test_detected_velocities_are_over_ground_along_the_axes_of_the_sensor() -> None:
    """Turned by the sensor's pose, detected velocities agree with the true ones in every driving direction."""
    sequence = scene(1, 60, velocity=1)
    error = []
    for frame in sequence.frames():
        _, found = sequence.observe(frame.index)
        assert frame.velocity is not None
        real = found.source != FALSE
        turned = frame.velocity[real] @ rotation_of(frame.pose.quaternion)[:2, :2].T
        error.append(turned - sequence._world.velocity[frame.index, found.source[real]])
    assert np.quantile(np.linalg.norm(np.vstack(error), axis=1), 0.5) < 0.6


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("frames", 0, "a number from 1"),
        ("vehicles", 51, "a number from 0 to 50"),
        ("rate", 0.1, "a number from 0.5"),
        ("seed", 0.5, "a number from 0"),
        ("colour", 1, "an unknown option"),
    ],
)
def test_options_out_of_their_bounds_are_reported(option: str, value: float, expected: str) -> None:
    """The error names the option and its bounds."""
    with pytest.raises(DatasetError, match=f"option {option}: .*{expected}"):
        open_dataset("scene", **{option: value})


def test_scenes_have_names_of_four_digits() -> None:
    """Other names, splits of other datasets, and a root are refused."""
    dataset = open_dataset("scene")
    assert [sequence.name for sequence in dataset.sequences(["0003", "all", "0003"])] == ["0003", "0000"]
    for name in ("train", "1", "00000", "no"):
        with pytest.raises(DatasetError, match="four digits"):
            dataset.sequences([name])
    with pytest.raises(DatasetError, match="nothing, for scenes are generated"):
        open_dataset("scene", "/data")


@pytest.mark.parametrize("crowd", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (50, 100, 30)])
def test_any_crowd_makes_a_scene(crowd: tuple[int, int, int]) -> None:
    """An empty town, single road users, and as many as are allowed."""
    vehicles, pedestrians, cyclists = crowd
    sequence = scene(0, 3, vehicles=vehicles, pedestrians=pedestrians, cyclists=cyclists)
    assert len(list(sequence.frames())) == 3
    truth = sequence.truth()
    assert len(np.unique(truth.id)) <= sum(crowd)
    assert np.bincount(sequence._world.label, minlength=3).tolist() == [vehicles, pedestrians, cyclists]


def test_one_frame_is_a_scene_too() -> None:
    """The shortest scene, at the lowest and the highest rate."""
    for rate in (0.5, 50.0):
        (frame,) = scene(0, 1, rate=rate).frames()
        assert frame.stamp_ns == 0
        assert len(frame) > 0


def test_everything_happens_that_makes_tracking_hard(scenes: list[SceneSequence]) -> None:
    """Cars stop and start again, turn, reverse and park; pedestrians stand, cross roads and turn round."""
    reversing = stopping = turning = standing = crossing = 0
    for sequence in scenes:
        world = sequence._world
        speed = np.linalg.norm(world.velocity, axis=2)
        heading = np.stack([np.cos(world.yaw), np.sin(world.yaw)], axis=2)
        along = (world.velocity * heading).sum(axis=2)
        cars, people = world.label == CAR, world.label == PEDESTRIAN
        reversing += int((along[:, cars] < -0.5).any(axis=0).sum())
        still = speed < 0.05
        restarted = still[:-10] & (speed[10:] > 0.5)
        stopping += int((restarted[:, cars] & (speed[:-10, cars].max(axis=0) > 5.0)).any(axis=0).sum())
        turned = np.abs(np.unwrap(world.yaw, axis=0) - world.yaw[0])
        turning += int((turned[:, cars].max(axis=0) > 1.2).sum())
        standing += int((still[:, people].any(axis=0) & (speed[:, people].max(axis=0) > 0.8)).sum())
        from_middle = np.abs(np.abs(world.center[:, people, 1]) - HALF_WIDTH)
        crossing += int((from_middle < 3.0).any(axis=0).sum())
    assert reversing >= 8
    assert stopping >= 10
    assert turning >= 10
    assert standing >= 10
    assert crossing >= 10


def test_returned_points_lie_on_boxes_or_on_the_ground() -> None:
    """Each point is within 15 cm of the surface of its box or of the ground, also with neighbours."""
    sequence = scene(3, 40)
    place, extent = fixed_boxes()
    for frame in (0, 20, 39):
        view, _ = sequence.observe(frame)
        world = sequence._world
        center, yaw = sequence._local(
            frame, np.vstack([world.center[frame], place]), np.concatenate([world.yaw[frame], np.zeros(len(place))])
        )
        size = np.vstack([world.size, extent])
        xyz = view.xyz.astype(np.float64)
        assert np.abs(xyz[view.owner == GROUND, 2] + 1.75).max() < 0.15
        for box in np.unique(view.owner[view.owner >= 0]):
            points = xyz[view.owner == box]
            assert points_in_box(points, center[box], size[box], float(yaw[box]), margin=0.15).all()
            assert not points_in_box(points, center[box], size[box], float(yaw[box]), margin=-0.15).any()
            assert view.points[box] == len(points)


def test_the_cloud_has_the_pose_of_the_sensor() -> None:
    """In the world frame the ground is at height 0."""
    frame = next(scene(0, 1).frames())
    assert frame.cloud is not None
    world = frame.cloud.xyz @ rotation_of(frame.cloud.pose.quaternion).T + frame.cloud.pose.translation
    assert abs(np.median(world[:, 2])) < 0.02
    assert world[:, 2].min() > -0.2


def test_truth_holds_what_is_in_range(scenes: list[SceneSequence], observed: Observed) -> None:
    """All within 60 m of the sensor, ids without gaps of more than a second, one box per id and frame."""
    for sequence in scenes[: len(observed)]:
        truth = sequence.truth()
        reach = np.linalg.norm(truth.center[:, :2] - sequence._world.carrier[truth.frame, :2], axis=1)
        assert reach.max() <= RADIUS
        assert len(np.unique(truth.frame * 100_000 + truth.id)) == len(truth)
        assert (np.diff(truth.frame) >= 0).all()
        for identity in np.unique(truth.id):
            assert np.diff(truth.frame[truth.id == identity]).max(initial=0) <= RATE + 1


def found_in(scenes: list[SceneSequence], observed: Observed) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Give the points of all objects and whether each was found, and scores and truth of all detections."""
    points, hits, scores, real = [], [], [], []
    for sequence, frames in zip(scenes, observed, strict=False):
        for frame, (returned, found) in enumerate(frames):
            rows = sequence._in_range(frame)
            points.append(returned[rows])
            hits.append(np.isin(rows, found.source))
            scores.append(found.score)
            real.append(found.source != FALSE)
    return tuple(np.concatenate(part) for part in (points, hits, scores, real))  # type: ignore[return-value]  # four parts


def test_detection_and_scores_mean_something(scenes: list[SceneSequence], observed: Observed) -> None:
    """More points are found more often, no points never; the share of true detections at a score is that score."""
    points, hits, scores, real = found_in(scenes, observed)
    edges = [1, 3, 8, 20, 60, 200, 100_000]
    rates = [hits[(points >= a) & (points < b)].mean() for a, b in itertools.pairwise(edges)]
    assert not hits[points == 0].any()
    assert (np.diff(rates) > 0).all(), rates
    assert rates[0] < 0.6
    assert rates[-1] > 0.95
    bins = np.linspace(MIN_SCORE, 1.0, 7)
    which = np.digitize(scores, bins[1:-1])
    shares = np.array([real[which == k].mean() for k in range(6)])
    means = np.array([scores[which == k].mean() for k in range(6)])
    assert (np.diff(shares) > 0).all(), shares
    np.testing.assert_allclose(shares, means, atol=0.06)
    assert 0.02 < (~real).mean() < 0.4


def test_errors_of_detections_are_those_of_a_detector(scenes: list[SceneSequence], observed: Observed) -> None:
    """Centimetres with many points, decimetres with few; headings are right but for a few that are turned round."""
    errors, flips, many = [], [], []
    for sequence, frames in zip(scenes, observed, strict=False):
        world = sequence._world
        for frame, (returned, found) in enumerate(frames):
            rows = np.flatnonzero((found.source != FALSE) & (found.label == CAR))
            source = found.source[rows]
            center, yaw = sequence._local(frame, world.center[frame, source], world.yaw[frame, source])
            errors.append(np.linalg.norm(found.center[rows, :2] - center[:, :2], axis=1))
            flips.append(np.abs(wrap_angle(found.yaw[rows] - yaw)) > 0.5 * np.pi)
            many.append(returned[source] > 100)
    error, flip, rich = np.concatenate(errors), np.concatenate(flips), np.concatenate(many)
    assert 0.03 < np.median(error[rich]) < 0.2
    assert 1.5 * np.median(error[rich]) < np.median(error[~rich]) < 0.7
    assert 0.0 < flip.mean() < 0.04

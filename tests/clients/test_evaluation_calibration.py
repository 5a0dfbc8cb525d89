"""Calibration: a consistent tracker passes, others do not; a file next to the results holds its input."""

from pathlib import Path

import numpy as np
import pytest
from evaluation_cases import parked, tracks_of, truth_of
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.evaluation.calibration import CalibrationResult, calibration, evaluate_calibration
from optipmb_tools.evaluation.cases import Rules
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings
from optipmb_tools.geometry import Floats
from optipmb_tools.results import FullTable, full_path, read_full, write_full
from optipmb_tools.run.tracking import Tracking, track

import optipmb

NEAR = Rules("distance", 2.0)
COVARIANCE = np.array([[0.09, 0.03], [0.03, 0.04]])


def full_of(center: Floats, existence: Floats, covariance: Floats, frames: int, objects: int) -> FullTable:
    count = frames * objects
    whole = np.zeros((count, 6, 6))
    whole[:] = np.eye(6)
    whole[:, :2, :2] = covariance
    zero = np.zeros(count)
    return FullTable(
        labels=("Car",),
        frame=np.repeat(np.arange(frames), objects),
        id=np.tile(np.arange(objects), frames),
        label=np.zeros(count, dtype=np.int64),
        center=center,
        size=np.ones((count, 3)),
        yaw=zero,
        velocity=np.zeros((count, 2)),
        yaw_rate=zero,
        acceleration=zero,
        existence=existence,
        score=zero + 0.9,
        covariance=whole,
        age=zero,
        time_since_detection=zero,
        detection=np.zeros(count, dtype=np.int64),
        box2d=np.full((count, 4), np.nan),
    )


def made(scale: float = 1.0, existence: Floats | None = None, exists: np.ndarray | None = None) -> CalibrationResult:
    """Evaluate Gaussian errors; `scale` is the factor by which the reported covariances are too large."""
    frames, objects = 100, 40
    rows = parked(objects, frames)
    chance = np.random.default_rng(7)
    places = np.array([[x, y, 0.0] for _, _, x, y in rows])
    places[:, :2] += chance.multivariate_normal([0.0, 0.0], COVARIANCE, len(rows))
    probability = np.full(len(rows), 0.95) if existence is None else existence
    full = full_of(places, probability, scale * COVARIANCE, frames, objects)
    tracks = tracks_of([(f, i, x, y, 0.9) for (f, i, _, _), (x, y, _) in zip(rows, places.tolist(), strict=True)])
    truth = truth_of(rows)
    return calibration(truth if exists is None else truth.take(exists), tracks, full, "Car", NEAR)


def test_a_consistent_tracker_has_a_nees_of_two() -> None:
    """Errors drawn from the reported covariances: the mean is 2, in the band, and 95 % lie in the ellipse."""
    found = made()
    assert found.mean == pytest.approx(2.0, abs=0.1)
    assert found.band[0] < found.mean < found.band[1]
    assert found.interval[0] < 2.0 < found.interval[1]
    assert found.coverage == pytest.approx(0.95, abs=0.01)
    summary = found.summary()
    assert (summary["samples"], summary["objects"]) == (4000, 40)
    assert summary["error"] == pytest.approx(summary["expected_error"], rel=0.05)


@pytest.mark.parametrize(("scale", "coverage"), [(0.25, 0.53), (4.0, 0.999)])
def test_wrong_covariances_are_noticed(scale: float, coverage: float) -> None:
    """Covariances told too small or too large move the NEES out of the band by the inverse factor."""
    found = made(scale)
    assert found.mean == pytest.approx(2.0 / scale, rel=0.05)
    assert not found.band[0] < found.mean < found.band[1]
    assert not found.interval[0] < 2.0 < found.interval[1]
    assert found.coverage == pytest.approx(coverage, abs=0.03)


def test_the_band_is_known() -> None:
    """For 100 samples of two dimensions the band of the mean is 1.628 to 2.411 (chi-square with 200 degrees, / 100)."""
    none = np.empty(0)
    found = CalibrationResult(np.ones(100), np.arange(100), none, none, none, np.empty(0, np.bool_))
    assert found.band == pytest.approx((1.628, 2.411), abs=0.002)


def test_the_interval_takes_objects_as_samples() -> None:
    """Of two objects with errors 1, 1 and 3, 3 the standard error of the mean is 1, and nothing is known from one."""
    none = np.empty(0)
    nees = np.array([1.0, 1.0, 3.0, 3.0])
    two = CalibrationResult(nees, np.array([0, 0, 1, 1]), none, none, none, np.empty(0, np.bool_))
    assert two.interval == pytest.approx((2.0 - 1.96, 2.0 + 1.96), abs=1e-3)
    one = CalibrationResult(nees, np.zeros(4, dtype=np.int64), none, none, none, np.empty(0, np.bool_))
    assert np.isnan(one.interval).all()
    both = two + one
    assert both.owner.tolist() == [0, 0, 1, 1, 2, 2, 2, 2]


def test_existence_is_compared_with_what_is_there() -> None:
    """Objects that exist as often as reported have deciles on the diagonal, with all tracks counted."""
    chance = np.random.default_rng(3)
    told = chance.random(4000)
    deciles = made(existence=told, exists=np.asarray(chance.random(4000) < told)).deciles
    assert sum(decile.count for decile in deciles) == 4000
    for decile in deciles:
        assert decile.low <= decile.predicted <= decile.high
        assert decile.observed == pytest.approx(decile.predicted, abs=0.08)
    doubted = made(existence=np.full(4000, 1.0), exists=np.asarray(chance.random(4000) < 0.5)).deciles
    assert (doubted[9].count, doubted[9].predicted) == (4000, 1.0)
    assert doubted[9].observed == pytest.approx(0.5, abs=0.03)


def test_nothing_to_compare_is_no_error() -> None:
    """Without tracks, and without sequences, no figure is defined and none fails."""
    none = full_of(np.zeros((0, 3)), np.zeros(0), COVARIANCE, 0, 0)
    for found in (
        calibration(truth_of(parked(2, 3)), tracks_of([]), none, "Car", NEAR),
        evaluate_calibration([], "Car", NEAR),
    ):
        summary = found.summary()
        assert summary["NEES"] is summary["coverage"] is summary["error"] is None
        assert summary["samples"] == 0


def test_tracks_of_another_run_are_refused() -> None:
    """Results with tracks that the full file lacks belong to another run."""
    full = full_of(np.zeros((4, 3)), np.ones(4), COVARIANCE, 2, 2)
    other = tracks_of([(0, 7, 0.0, 0.0, 0.9)])
    with pytest.raises(DatasetError, match="the same tracks as in the result file"):
        calibration(truth_of(parked(2, 2)), other, full, "Car", NEAR)


def test_track_keeps_everything_on_demand(tmp_path: Path) -> None:
    """With `full`, a second file holds all columns of the same tracks, and the results keep their bytes."""
    dataset = open_dataset("scene", frames=20, vehicles=6, pedestrians=3, cyclists=2)
    sequences, scene = list(dataset.sequences(["0000"])), optipmb.load_profile("scene")
    (result,) = track(dataset, sequences, tmp_path, Tracking(scene, full=True))
    beside = full_path(result.file)
    content = beside.read_bytes()
    full = read_full(beside)
    (recording,) = load_recordings("scene", sequences, tmp_path)
    assert recording.full is not None
    assert full.frame.tolist() == recording.tracks.frame.tolist()
    assert full.id.tolist() == recording.tracks.id.tolist()
    assert full.center == pytest.approx(recording.tracks.center, abs=1e-5)
    assert (np.linalg.eigvalsh(full.covariance) > 0).all()
    assert ((full.existence > 0) & (full.existence <= 1)).all()
    (cars, *_) = evaluate_figures("scene", [recording], ("Car", "Pedestrian", "Cyclist"))
    assert cars.calibration is not None
    assert 0 < len(cars.calibration.nees) <= len(cars.calibration.existence)
    list(track(dataset, sequences, tmp_path, Tracking(scene, full=True)))
    assert beside.read_bytes() == content
    list(track(dataset, sequences, tmp_path, Tracking(scene)))
    assert not beside.exists()


def test_no_tracks_at_all_are_kept_too(tmp_path: Path) -> None:
    """A sequence without any track gives a file without rows."""
    write_full(tmp_path / "none.npz", {})
    full = read_full(tmp_path / "none.npz")
    assert (len(full), full.covariance.shape) == (0, (0, 6, 6))


def test_other_files_are_refused_in_one_line(tmp_path: Path) -> None:
    """A missing file, one of another kind, and one that lacks a column are named."""
    path = tmp_path / "a.npz"
    with pytest.raises(DatasetError, match=r"a\.npz: .*No such file"):
        read_full(path)
    path.write_text("something else")
    with pytest.raises(DatasetError, match="another kind of file"):
        read_full(path)
    np.savez(path, labels=np.array(["Car"]), frame=np.zeros(3, dtype=np.int64))
    with pytest.raises(DatasetError, match="id, received none"):
        read_full(path)

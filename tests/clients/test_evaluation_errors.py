"""Errors of boxes: tracks against their own detections, in every direction, and headings against their variance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optipmb_tools.datasets import DataSequence, DetectionFrame, open_dataset
from optipmb_tools.evaluation.cases import Rules
from optipmb_tools.evaluation.errors import DIRECTIONS, ErrorResult, evaluate_errors
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings
from optipmb_tools.run.tracking import Tracking, track

import optipmb

NEAR = Rules("distance", 2.0)


def result(count: int, *, seed: int = 0) -> ErrorResult:
    """Gaussian errors of known size: tracks half as far off as their detections, every tenth without one."""
    rng = np.random.default_rng(seed)
    scale = np.arange(1, 8) / 100.0
    detection = 2.0 * scale * rng.normal(size=(count, 7))
    detection[::10] = np.nan
    return ErrorResult(
        track=scale * rng.normal(size=(count, 7)),
        detection=detection,
        heading_variance=np.full(count, 0.04**2),
        distance=np.linspace(0.0, 60.0, count),
        speed=np.linspace(0.0, 10.0, count),
    )


def test_errors_are_root_mean_squares_of_the_detected() -> None:
    """Each direction has its own size, for tracks and for detections, over the same boxes."""
    found = result(20_000).figures(np.ones(20_000, dtype=np.bool_))
    assert found["boxes"] == 18_000
    assert list(found["track"].values()) == pytest.approx(np.arange(1, 8) / 100.0, rel=0.05)
    assert list(found["detection"].values()) == pytest.approx(np.arange(1, 8) / 50.0, rel=0.05)
    assert found["heading"]["NEES"] == pytest.approx(1.0, rel=0.05)
    assert found["heading"]["coverage"] == pytest.approx(0.95, abs=0.01)


def test_backward_boxes_are_counted_and_not_measured() -> None:
    """A heading off by pi is backward, and its error modulo pi is small; the NEES does not forgive it."""
    one = result(1000)
    one.track[:100, 3] += np.pi * np.sign(-one.track[:100, 3])
    found = one.figures(np.ones(1000, dtype=np.bool_))
    assert found["heading"]["backward"] == pytest.approx(0.1)
    assert found["track"]["heading"] == pytest.approx(0.04, rel=0.1)
    assert found["heading"]["coverage"] < 0.9


def test_groups_cut_by_range_and_by_speed() -> None:
    """Every box is in one range and one speed; without boxes there is no row."""
    one = result(600)
    groups = dict(one.groups())
    assert sum(int(rows.sum()) for name, rows in groups.items() if name.endswith(" m")) == 600
    assert sum(int(rows.sum()) for name, rows in groups.items() if name.endswith("m/s")) == 600
    near = replace(one, distance=np.zeros(600))
    assert "from 40 m" in one.summary()["groups"]
    assert "from 40 m" not in near.summary()["groups"]


class Shifted:
    """A sequence whose detections were moved after it was tracked."""

    def __init__(self, given: DataSequence, by: float) -> None:
        self._given, self._by = given, by

    def __getattr__(self, name: str) -> object:
        return getattr(self._given, name)

    def frames(self) -> list[DetectionFrame]:
        return [replace(frame, center=frame.center + np.array([0.0, 0.0, self._by])) for frame in self._given.frames()]


def test_detections_are_those_of_the_tracks(tmp_path: Path) -> None:
    """Tracked offline and evaluated: both columns are there, and detections that are raised by 3 m are 3 m too high."""
    dataset = open_dataset("scene", frames=80)
    sequences = dataset.sequences(["all"])[:1]
    list(track(dataset, sequences, tmp_path, Tracking(optipmb.load_profile("scene"), full=True)))
    recordings = load_recordings("scene", sequences, tmp_path)
    (car,) = evaluate_figures("scene", recordings, ["Car"])
    assert car.errors is not None
    figures = car.summary()["errors"]["groups"]["all"]
    assert figures["boxes"] > 50
    assert all(0.0 <= figures[kind][name] < 1.0 for kind in ("track", "detection") for name in DIRECTIONS)
    one = recordings[0]
    assert one.full is not None
    raised = evaluate_errors([(Shifted(one.sequence, 3.0), one.truth, one.tracks, one.full)], "Car", NEAR)
    assert raised.detection[raised.detected, 2].mean() == pytest.approx(
        car.errors.detection[car.errors.detected, 2].mean() + 3.0
    )


def test_other_detections_are_noticed(tmp_path: Path) -> None:
    """With tracks of some classes and detections of all, headings are judged, and the reason is given."""
    dataset = open_dataset("scene", frames=80)
    sequences = dataset.sequences(["all"])[:1]
    list(track(dataset, sequences, tmp_path, Tracking(optipmb.load_profile("scene"), ["Car"], full=True)))
    one = load_recordings("scene", sequences, tmp_path)[0]
    assert one.full is not None
    found = evaluate_errors([(one.sequence, one.truth, one.tracks, one.full)], "Car", NEAR).summary()
    assert "that the tracks were made of" in str(found["without detections"])
    assert found["groups"]["all"]["boxes"] == 0
    assert found["groups"]["all"]["heading"]["boxes"] > 50

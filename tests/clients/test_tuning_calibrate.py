"""What tuning finds out for tracks to say of themselves, on recordings and scenes that are made to order."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_tools.datasets import open_dataset
from optipmb_tools.tuning.calibrate import calibrate, measured_calibration
from optipmb_tools.tuning.clips import Clip, load, of_class, track_clip
from optipmb_tools.tuning.scoring import rules_of, scorer_of
from optipmb_tools.tuning.values import only, with_calibration
from tuning_cases import Habits, recorded

import optipmb

PAPER = optipmb.load_profile("kitti-paper")
CARS = only(PAPER, "Car")
RULES = rules_of("scene")
SCORER = scorer_of("scene", "Car", [])


def clips_of(seeds: range, habits: Habits) -> list[Clip]:
    recordings = [recorded(habits, seed, frames=60, objects=12, name=f"{seed:04d}") for seed in seeds]
    return [of_class(load(one, PAPER, RULES), "Car", RULES) for one in recordings]


def biased(clip: Clip, seed: int, deviation: float) -> Clip:
    """The same detections, with an error that lasts as long as the sequence: one for each car, which never meet."""
    rng = np.random.default_rng(seed)
    error = deviation * rng.standard_normal((2000, 2))
    frames = []
    for frame in clip.frames:
        center = frame.center.copy()
        center[:, :2] += error[np.round(center[:, 0] / 100.0).astype(int) + 1000]
        frames.append(replace(frame, center=center))
    return replace(clip, frames=tuple(frames))


@pytest.mark.parametrize("lasting", [0.0, 0.3])
def test_covariances_come_true_where_they_were_not_measured(lasting: float) -> None:
    """An error of the detector that lasts is found, and elsewhere the errors are then as large as is said."""
    slow = Habits(position=0.1, found=0.95)
    known = [biased(clip, i, lasting) for i, clip in enumerate(clips_of(range(4), slow))]
    other = [biased(clip, 100 + i, lasting) for i, clip in enumerate(clips_of(range(10, 14), slow))]
    found = calibrate(known, SCORER, CARS, 0.8)
    assert found is not None
    assert (max(found.along) > 0.15) == (lasting > 0)
    before = measured_calibration(other, SCORER, CARS)
    after = measured_calibration(other, SCORER, with_calibration(CARS, "Car", found))
    assert after.mean < 2.6
    assert after.interval[0] < 2.3
    if lasting:
        assert before.mean > 5.0
        assert after.mean > 1.3


def test_existence_comes_true_on_other_scenes() -> None:
    """Of the tracks that are said to exist with some probability, about this share does, in scenes not measured on."""
    sequences = open_dataset("scene", frames=100, clouds=False).sequences([f"{i:04d}" for i in range(4)])
    clips = [of_class(load(one, PAPER, RULES), "Car", RULES) for one in sequences]
    found = calibrate(clips[:2], SCORER, CARS)
    assert found is not None
    assert found.existence[0] < 0.5
    assert found.existence[-1] > 0.9
    for result, most in (
        (measured_calibration(clips[2:], SCORER, CARS), 1.0),
        (measured_calibration(clips[2:], SCORER, with_calibration(CARS, "Car", found)), 0.15),
    ):
        off = [abs(one.predicted - one.observed) for one in result.deciles if one.count >= 100]
        assert max(off) < most
    assert len(off) >= 2


def test_with_little_to_measure_nothing_is_said() -> None:
    """A handful of tracks gives no calibration; then existence is r and the covariance is P."""
    (clip,) = clips_of(range(1), Habits())
    assert calibrate([replace(clip, frames=clip.frames[:4])], SCORER, CARS) is None


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000), found=st.floats(0.5, 0.95), false=st.floats(0.1, 3.0))
def test_whatever_the_detector_a_calibration_is_valid(seed: int, found: float, false: float) -> None:
    """Knots ascend, probabilities do not descend, and none is certain: the profile accepts the measured curve."""
    clips = clips_of(range(seed, seed + 2), Habits(found=found, false=false))
    told = calibrate(clips, SCORER, CARS, 0.8)
    assert told is not None
    assert 0.0 < told.existence[0] <= told.existence[-1] < 1.0
    assert list(told.evidence) == sorted(set(told.evidence))


def test_a_missed_track_has_no_detection() -> None:
    """A track that was not detected in a frame has no detection there."""
    (clip,) = clips_of(range(1), Habits(found=0.7))
    full = track_clip(clip, CARS)
    assert ((full.detection < 0) == (full.time_since_detection > 0)).all()
    assert (full.detection < 0).any()

"""A curve brings a detector's scores to the scale of a profile's thresholds, before anything reads them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from compare import density_bytes
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene

import optipmb
from optipmb.model.frame import calibrated

KITTI = optipmb.load_profile("kitti")
CURVE = {"detector": [0.2, 0.3, 0.6], "calibrated": [0.1, 0.6, 0.7]}


def with_curve(name: str = "Car", **changes: Any) -> optipmb.Parameters:
    """KITTI's profile with a curve for one class."""
    document = KITTI.model_dump()
    document["classes"][name]["score_calibration"] = CURVE | changes
    return optipmb.parse_parameters(document)


def by_hand(score: float) -> float:
    """The curve written out."""
    for low, high, start, end in ((0.0, 0.2, 0.0, 0.1), (0.2, 0.3, 0.1, 0.6), (0.3, 0.6, 0.6, 0.7)):
        if score < high:
            return start + (end - start) * (score - low) / (high - low)
    return 0.7 + 0.3 * (score - 0.6) / 0.4


def test_a_profile_without_a_curve_leaves_scores_as_they_are() -> None:
    """To the last bit, in every profile that was not made for another detector."""
    scores = np.random.default_rng(3).uniform(1e-9, 1.0, 500)
    for name in optipmb.profiles():
        parameters = optipmb.load_profile(name)
        for label, table in parameters.classes.items():
            if table.score_calibration is None:
                frame, _ = optipmb.make_frame(parameters, **arguments(scores, label))
                assert frame.score.tobytes() == scores.tobytes()
            else:
                assert name in {"nuscenes-megvii", "kitti-second-iou", "kitti-virconv"}


def arguments(scores: np.ndarray, label: str = "Car") -> dict[str, Any]:
    """Detections of one class with these scores."""
    count = len(scores)
    return {
        "stamp_ns": 0, "labels": [label], "label": np.zeros(count, dtype=np.int64), "center": np.zeros((count, 3)),
        "size": np.ones((count, 3)), "yaw": np.zeros(count), "score": scores,
    }  # fmt: skip


def test_a_frame_has_the_scores_that_were_brought_over_by_hand() -> None:
    """Every detection of the class has its calibrated score, and the other classes have their own."""
    given_scene = next(iter(scene(7))).columns()
    plain, _ = optipmb.make_frame(KITTI, **given_scene)
    frame, left_out = optipmb.make_frame(with_curve(), **given_scene)
    cars = plain.label == 0
    assert cars.any()
    assert not cars.all()
    assert left_out == 0
    np.testing.assert_allclose(frame.score[cars], [by_hand(score) for score in plain.score[cars]], rtol=1e-14)
    assert frame.score[~cars].tobytes() == plain.score[~cars].tobytes()


def test_tracks_are_those_of_detections_whose_scores_were_brought_over() -> None:
    """All that reads a score, from the score filter on, has the calibrated one, once."""
    parameters = with_curve()
    tracker, other = optipmb.Tracker(parameters), optipmb.Tracker(KITTI)
    density, expected = tracker.initial(), other.initial()
    followed = 0
    for given_frame in scene(11):
        columns = given_frame.columns()
        score, cars = np.array(columns["score"]), np.asarray(columns["label"]) == columns["labels"].index("Car")
        curve = parameters.classes["Car"].score_calibration
        assert curve is not None
        score[cars] = calibrated(curve, score[cars])
        found = tracker.step(density, optipmb.make_frame(parameters, **columns)[0])
        wanted = other.step(expected, optipmb.make_frame(KITTI, **columns | {"score": score})[0])
        density, expected = found.density, wanted.density
        assert density_bytes(density) == density_bytes(expected)
        assert found.tracks.score.tobytes() == wanted.tracks.score.tobytes()
        followed += len(found.tracks.score)
    assert followed


@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20), st.integers(0, 10**6))
def test_the_order_of_detections_stays(scores: list[float], seed: int) -> None:
    """A higher score stays at least as high, 0 and 1 stay, and nothing leaves [0, 1], for any curve."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 33))
    knots = {name: np.sort(rng.uniform(1e-6, 1.0 - 1e-6, count)).tolist() for name in ("detector", "calibrated")}
    curve = optipmb.ScoreCalibration(**{name: tuple(values) for name, values in knots.items()})
    found = calibrated(curve, np.array([0.0, *sorted(scores), 1.0]))
    assert found[0] == 0.0
    assert found[-1] == 1.0
    assert (np.diff(found) >= -1e-15).all()
    assert ((found >= 0.0) & (found <= 1.0)).all()


def test_a_score_of_zero_is_still_left_out() -> None:
    """Also where the curve makes it of a score too small for a number."""
    curve = {"detector": [0.5, 0.6], "calibrated": [1e-300, 0.5]}
    frame, left_out = optipmb.make_frame(with_curve(**curve), **arguments(np.array([0.0, 1e-200, 0.55])))
    assert left_out == 2
    assert frame.source.tolist() == [2]


@pytest.mark.parametrize(
    ("changes", "path", "text"),
    [
        ({"calibrated": [0.1, 0.6]}, "", "as many values of calibrated as of detector, 3, received 2"),
        ({"detector": [0.2, 0.2, 0.6]}, "", "ascending detector"),
        ({"calibrated": [0.1, 0.8, 0.7]}, "", "ascending calibrated"),
        ({"detector": [0.2], "calibrated": [0.1]}, ".detector", "at least 2 items"),
        ({"detector": [0.01 * i for i in range(1, 34)]}, ".detector", "at most 32 items"),
        ({"detector": [0.0, 0.3, 0.6]}, ".detector.0", "greater than 0"),
        ({"calibrated": [0.1, 0.6, 1.0]}, ".calibrated.2", "less than 1"),
        ({"calibrated": [0.1, float("nan"), 0.7]}, ".calibrated.1", "finite number"),
        ({"knots": 3}, ".knots", "a known field"),
    ],
)
def test_a_curve_that_cannot_be_is_refused(changes: dict[str, Any], path: str, text: str) -> None:
    """With the path of the field and the expected value."""
    with pytest.raises(optipmb.ParameterError) as caught:
        with_curve(**changes)
    assert caught.value.path == f"classes.Car.score_calibration{path}"
    assert text in str(caught.value)

"""What tracks say of themselves: existence and covariance by a calibration, in cases whose answers are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scenes import boxes, steps

import optipmb

PAPER = optipmb.load_profile("kitti-paper")


def with_calibration(**changes: Any) -> optipmb.Parameters:
    """The paper's profile with a calibration of cars: two knots, at log odds of minus and plus three."""
    calibration = {
        "memory": 0.5,
        "missed": 2.0,
        "evidence": [-3.0, 3.0],
        "existence": [0.1, 0.9],
        "along": [0.6, 0.2],
        "across": [0.3, 0.1],
    }
    document = PAPER.model_dump()
    document["classes"]["Car"]["calibration"] = calibration | changes
    return optipmb.parse_parameters(document)


def follow(parameters: optipmb.Parameters, scores: list[float | None], period: float = 0.1) -> list[optipmb.Tracks]:
    """Tracks of a standing car that heads up and left, detected with these scores; None where it is missed."""
    frames = (
        boxes(parameters, k * period, [(5.0, 1.0)] if score else [], yaw=0.75 * math.pi, score=score or 1.0)
        for k, score in enumerate(scores)
    )
    return [result.tracks for result in steps(parameters, frames)]


def odds(score: float) -> float:
    """Logarithm of score to one minus score."""
    return math.log(score / (1.0 - score))


def test_existence_follows_the_mean_log_odds_of_the_latest_detections() -> None:
    """By hand: evidence fades by half in a period, a miss counts as -2, the curve is a straight line."""
    tracks = follow(with_calibration(), [0.8, 0.9, None])
    first = 0.5 * odds(0.8)
    second = 0.5 * first + 0.5 * odds(0.9)
    third = 0.5 * second - 0.5 * 2.0
    told = [float(one.existence[0]) for one in tracks]
    assert told == pytest.approx([0.5 + 0.8 * evidence / 6.0 for evidence in (first, second, third)])


def test_evidence_counts_time_and_not_frames() -> None:
    """At half the frame rate a detection weighs as much as two with the same score."""
    fast = follow(with_calibration(), [0.8, 0.95, 0.95, 0.6, 0.6])
    slow = follow(with_calibration(), [0.8, 0.95, 0.6], period=0.2)
    assert [float(one.existence[0]) for one in fast[::2]] == pytest.approx([float(one.existence[0]) for one in slow])


def test_beyond_the_knots_the_curves_are_level() -> None:
    """The surest and the least sure tracks have the probabilities of the outer knots, and nothing is above one."""
    tracks = follow(with_calibration(), [1.0] * 6 + [None] * 3)
    assert tracks[4].existence[0] == 0.9
    least = follow(with_calibration(evidence=[2.0, 3.0]), [0.7] * 2)
    assert least[1].existence[0] == 0.1


def test_the_lasting_error_lies_along_and_across_the_heading() -> None:
    """Covariances are the filter's with factors on speed and turn rate, and the lasting error turned with the box."""
    plain = follow(PAPER, [1.0] * 6)[-1]
    told = follow(with_calibration(speed=0.5, turn_rate=2.0), [1.0] * 6)[-1]
    factors = np.array([1.0, 1.0, 0.5, 1.0, 2.0, 1.0])
    added = told.covariance[0] - plain.covariance[0] * np.outer(factors, factors)
    ahead = np.array([math.cos(plain.yaw[0]), math.sin(plain.yaw[0])])
    left = np.array([-ahead[1], ahead[0]])
    wanted = 0.2**2 * np.outer(ahead, ahead) + 0.1**2 * np.outer(left, left)
    np.testing.assert_allclose(added[:2, :2], wanted, atol=1e-15)
    assert not added[2:].any()
    assert not added[:, 2:].any()


def test_the_ellipse_of_a_doubtful_track_is_larger() -> None:
    """With `generic`, whose errors grow with doubt: cars with scores of 0.6 and 0.95 before anything is learned."""
    tracker = optipmb.OnlineTracker("generic")
    for k in range(10):
        boxes = {"center": [[0.0, 0.0, 0.8], [0.0, 30.0, 0.8]], "size": [[4.5, 1.9, 1.6]] * 2, "yaw": [0.0] * 2}
        tracks = tracker.update(t=0.1 * k, **boxes, score=[0.95, 0.6], label=["car"] * 2)
    sure, doubtful = (np.sqrt(np.linalg.det(one[:2, :2])) for one in tracks.covariance)
    assert doubtful > 2.0 * sure


def test_a_parked_car_hardly_moves() -> None:
    """Velocities are weighted by v^4 / (v^4 + (3 P_vv)^2): hardly any where the speed is not certain."""
    told, plain = (followed(one) for one in (with_calibration(speed=0.5), PAPER))
    v = math.hypot(*plain.velocity[0])
    assert 0.0 < v < 0.3
    weight = v**4 / (v**4 + (3 * told.covariance[0, 2, 2]) ** 2)
    np.testing.assert_allclose(told.velocity, plain.velocity * weight, rtol=1e-12)


def followed(parameters: optipmb.Parameters) -> optipmb.Tracks:
    """Tracks of a standing car whose detections are 0.1 m off in turn."""
    return steps(parameters, [boxes(parameters, 0.1 * k, [(5.0 + 0.1 * (k % 2), 1.0)]) for k in range(6)])[-1].tracks


def test_a_calibration_leaves_the_recursion_alone() -> None:
    """Positions, ids, scores and extraction stay the same; the score takes the weight of the evidence."""
    scores = [0.4, 0.9, None, 0.8, None, None, 0.7]
    plain, told = follow(PAPER, scores), follow(with_calibration(), scores)
    for one, other in zip(plain, told, strict=True):
        for name in ("id", "center", "size", "yaw", "yaw_rate", "score", "detection"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    paper, half, evidence = (
        [float(one.score[0]) for one in follow(with_calibration(score_of_evidence=weight), scores) if len(one)]
        for weight in (False, 0.5, True)
    )
    assert paper == [float(one.score[0]) for one in plain if len(one)]
    assert all(0.0 <= value <= 1.0 for value in evidence)
    assert evidence != paper
    np.testing.assert_allclose(half, np.mean([paper, evidence], axis=0), rtol=1e-15)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"existence": [0.9, 0.1]}, "does not descend"),
        ({"evidence": [3.0, -3.0]}, "ascending evidence"),
        ({"along": [0.1]}, "as many values of along"),
        ({"memory": 1.0}, "less than 1"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(changes: dict[str, Any], text: str) -> None:
    """The error names the field and the expected value."""
    with pytest.raises(optipmb.ParameterError, match=text) as caught:
        with_calibration(**changes)
    assert caught.value.path.startswith("classes.Car.calibration")

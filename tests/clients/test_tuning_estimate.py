"""Estimates from data without tracking: known noise is found again."""

import math

import numpy as np
import pytest
from optipmb_tools.datasets import open_dataset
from optipmb_tools.tuning.clips import load, of_class
from optipmb_tools.tuning.estimate import Estimate, estimate, fit_motion, spread, usual
from optipmb_tools.tuning.scoring import rules_of
from optipmb_tools.tuning.values import only
from tuning_cases import Habits, Recorded, recorded

import optipmb

PARAMETERS = optipmb.load_profile("kitti")


def estimated(*sequences: Recorded) -> Estimate:
    rules = rules_of("scene")
    clips = [of_class(load(sequence, PARAMETERS, rules), "Car", rules) for sequence in sequences]
    return estimate(clips, "Car", only(PARAMETERS, "Car"), rules)


@pytest.mark.parametrize("habits", [Habits(), Habits(position=0.05, heading=0.02), Habits(0.4, 0.3, 0.8)])
def test_measurement_noise_is_found_again(habits: Habits) -> None:
    """R is what the detector was given, to a few percent."""
    found = estimated(recorded(habits)).values
    assert found["measurement_noise.position"] == pytest.approx(habits.position, rel=0.05)
    assert found["measurement_noise.heading"] == pytest.approx(habits.heading, rel=0.05)
    if habits.velocity is None:
        assert "measurement_noise.velocity" not in found
    else:
        assert found["measurement_noise.velocity"] == pytest.approx(habits.velocity, rel=0.05)


def test_turned_boxes_are_counted_and_do_not_count_as_noise() -> None:
    """Flips are a rate of their own; the spread of headings excludes them."""
    found = estimated(recorded(Habits(flips=0.1)))
    assert found.flip_rate == pytest.approx(0.1, abs=0.01)
    assert found.values["measurement_noise.heading"] == pytest.approx(0.08, rel=0.05)
    assert estimated(recorded(Habits())).flip_rate == 0.0


def test_found_and_false_ones_are_counted() -> None:
    """p_d0 and the clutter rate are the detector's, of the detections that pass the score filter."""
    found = estimated(recorded(Habits(found=0.7, false=2.0), frames=400))
    assert found.detection == pytest.approx(0.7, abs=0.01)
    passing = (0.6 - PARAMETERS.classes["Car"].score_filter) / 0.5
    assert found.clutter == pytest.approx(2.0 * passing, rel=0.15)
    assert found.lasting == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("acceleration", "turn_rate"), [(1.0, 0.02), (0.4, 0.1)])
def test_process_noise_is_found_again(acceleration: float, turn_rate: float) -> None:
    """Q of acceleration and turn rate agrees with the motion within a third."""
    habits = Habits(acceleration=acceleration, turn_rate=turn_rate)
    found = estimated(*(recorded(habits, seed, name=f"{seed:04d}") for seed in range(3))).values
    assert found["process_noise.acceleration"] == pytest.approx(acceleration, rel=0.35)
    assert found["process_noise.turn_rate"] == pytest.approx(turn_rate, rel=0.35)


def test_a_birth_of_unknown_speed_expects_the_speeds_that_there_are() -> None:
    """P^0 of the speed is the root mean square of the objects' speeds."""
    assert estimated(recorded(Habits())).values["birth.unknown_speed"] == pytest.approx(10.0, rel=0.05)


def test_nothing_is_estimated_from_nothing() -> None:
    """A class without detections on labels gets no values, and no error."""
    found = estimated(recorded(Habits(found=0.0), frames=20))
    assert found.values == {}
    assert found.pairs == 0
    assert math.isnan(found.flip_rate)
    assert found.to_json()["flip_rate"] is None


def test_the_noise_of_generated_scenes_is_theirs() -> None:
    """The detector of the scenes errs by decimetres, turns one car in a hundred, and finds most of them."""
    parameters = optipmb.load_profile("kitti")
    rules = rules_of("scene")
    clips = [load(one, parameters, rules) for one in open_dataset("scene", frames=60).sequences(["0000", "0001"])]
    found = estimate([of_class(clip, "Car", rules) for clip in clips], "Car", only(parameters, "Car"), rules)
    assert 0.05 < found.values["measurement_noise.position"] < 0.3
    assert 0.0 < found.flip_rate < 0.03
    assert found.detection > 0.8
    precision = [one.precision for one in found.bins if one.detections > 50]
    assert precision == sorted(precision)
    assert all(one.low <= one.score <= one.high for one in found.bins)


def test_a_few_gross_errors_do_not_carry_a_spread_away() -> None:
    """Five percent of wild errors change the winsorised spread by less than half, the plain one manyfold."""
    rng = np.random.default_rng(0)
    errors = rng.standard_normal(10_000)
    errors[:500] *= 50.0
    assert spread(errors) < 1.5
    assert usual(errors) == pytest.approx(1.0, abs=0.1)
    assert errors.std() > 5.0


def test_the_variances_of_a_fit_are_those_of_its_errors() -> None:
    """Speed, acceleration, heading and turn rate of many noisy pieces scatter about the truth as their fits say."""
    rng = np.random.default_rng(0)
    pieces, points = 400, 12
    time = np.linspace(0.0, pieces, pieces * points, endpoint=False)
    yaw = 0.1 + rng.normal(0.0, 0.02, len(time))
    position = np.column_stack((5.0 * time * np.cos(0.1), 5.0 * time * np.sin(0.1))) + rng.normal(
        0.0, 0.1, (len(time), 2)
    )
    found = fit_motion(time, position, yaw, 1.0)
    errors = np.column_stack((found.speed - 5.0, found.acceleration, found.heading - 0.1, found.turn_rate))
    np.testing.assert_allclose((errors**2).mean(axis=0), found.variance.mean(axis=0), rtol=0.2)

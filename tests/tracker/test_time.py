"""What holds at one frame rate holds at another: gates, misses, limits and Poisson components in time, not frames."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import boxes

import optipmb

KITTI, NUSCENES = optipmb.load_profile("kitti"), optipmb.load_profile("nuscenes")
CARS = {"kitti": (KITTI, "Car"), "nuscenes": (NUSCENES, "car")}
RATES = [0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]


def ids(parameters: optipmb.Parameters, label: str, rate: float, speed: float, seconds: float) -> list[list[int]]:
    """The ids of a car on its way, detected without velocity at a rate, with an error of a decimetre."""
    tracker, rng = optipmb.Tracker(parameters), np.random.default_rng(0)
    density, found = tracker.initial(), []
    for k in range(max(8, int(seconds * rate))):
        place = (speed * k / rate + rng.normal(0, 0.1), rng.normal(0, 0.1))
        result = tracker.step(density, boxes(parameters, k / rate, place, label=label, score=0.95))
        density = result.density
        found.append(result.tracks.id.tolist())
    return found


@pytest.mark.parametrize("speed", [0.0, 10.0, 18.0, 25.0, 30.0])
@pytest.mark.parametrize("profile", CARS)
def test_a_car_at_two_hertz_without_velocity_is_followed_to_thirty_metres_a_second(profile: str, speed: float) -> None:
    """One id from the first frame to the last."""
    assert ids(*CARS[profile], 2.0, speed, 10.0) == [[1]] * 20


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("profile", CARS)
def test_a_stream_of_any_rate_keeps_the_id_of_a_slow_car(profile: str, rate: float) -> None:
    """From one frame in five seconds to fifty in one."""
    speed = min(2.0, rate)
    assert {tuple(one) for one in ids(*CARS[profile], rate, speed, 4.0)} == {(1,)}


@pytest.mark.parametrize("profile", CARS)
def test_a_missed_car_dies_after_the_same_time_at_every_rate(profile: str) -> None:
    """At the nominal rate and up to twenty-five times it; slower streams keep it for one more frame at least."""
    parameters, label = CARS[profile]
    nominal = 1.0 / parameters.nominal_period
    times = []
    for rate in (nominal, 2 * nominal, 5 * nominal, 25 * nominal):
        tracker = optipmb.Tracker(parameters)
        density, k = tracker.initial(), 0
        for k in range(int(rate) + 2):
            density = tracker.step(density, boxes(parameters, k / rate, (0, 0), label=label)).density
        seen = k
        while len(density.bernoulli):
            k += 1
            density = tracker.step(density, boxes(parameters, k / rate)).density
        times.append((k - seen) / rate)
    assert max(times) - min(times) <= 1.0 / nominal + 1e-9, times


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("profile", CARS)
def test_a_component_lives_until_the_next_frame_at_least(profile: str, rate: float) -> None:
    """A low score announces an object, and the next one finds it, however far apart the frames are."""
    parameters, label = CARS[profile]
    low = 0.5 * (parameters.classes[label].score_filter + parameters.classes[label].birth_score)
    low = min(low, parameters.classes[label].birth_score - 1e-3) if profile == "kitti" else 0.2
    tracker = optipmb.Tracker(
        parameters
        if profile == "kitti"
        else optipmb.parse_parameters(
            {
                **parameters.model_dump(),
                "classes": {label: parameters.classes[label].model_dump() | {"score_filter": 0.1, "birth_score": 0.3}},
            }
        )
    )
    density, found = tracker.initial(), []
    for k in range(3):
        result = tracker.step(density, boxes(tracker.parameters, k / rate, (0, 0), label=label, score=low))
        density = result.density
        found.append(len(density.bernoulli))
    assert found == [0, 1, 1]


def test_the_papers_profiles_keep_the_papers_gates_and_motion() -> None:
    """What goes beyond the paper is off in them."""
    for name in ("kitti-paper", "nuscenes-paper"):
        parameters = optipmb.load_profile(name)
        assert not parameters.detection_over_time
        for one in parameters.classes.values():
            assert (one.motion, one.acceleration_time) == ("ctra", None)
            assert (one.gate_deviations, one.ground_clearance) == (0.0, 0.0)
            assert not one.birth_over_clutter


@pytest.mark.parametrize("brake", [2.0, 4.0, 6.0])
@pytest.mark.parametrize("profile", ["kitti", "scene"])
def test_a_braking_car_does_not_run_backwards_behind_cover(profile: str, brake: float) -> None:
    """Seen while it brakes from 10 m/s, hidden before it stands: it goes on, slows down, and never returns."""
    parameters = optipmb.load_profile(profile)
    tracker = optipmb.Tracker(parameters)
    density, stop, k, places = tracker.initial(), 10.0 / brake, 0, []
    while k * 0.1 < stop - 0.3:
        t = k * 0.1
        density = tracker.step(density, boxes(parameters, t, (10 * t - 0.5 * brake * t * t, 0.0))).density
        k += 1
    for j in range(25):
        density = tracker.step(density, boxes(parameters, (k + j) * 0.1)).density
        places.append(float(density.bernoulli.mean[0, 0]))
    assert (np.diff(places) > -0.01).all(), places
    assert places[-1] - places[0] < 10.0

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


def made(kind: str, rate: float) -> optipmb.Parameters:
    """The default for any detector: the service's, or one made for the rate."""
    return optipmb.load_profile("generic") if kind == "generic" else optipmb.generic_parameters(["car"], 1.0 / rate)


def file_of_cars(
    parameters: optipmb.Parameters, rate: float, speed: float, *, velocity: bool, gaps: str
) -> tuple[dict[int, set[int]], int]:
    """The ids that four cars in one lane are given, farther apart than they drive unseen, and how many there are.

    With gaps, nothing is detected in the last of every three seconds: frames are empty, or there are none.
    """
    tracker, rng, found = optipmb.Tracker(parameters), np.random.default_rng(0), dict[int, set[int]]()
    density, cars = tracker.initial(), np.arange(4)
    apart = 10.0 + 2.5 * speed * (1.0 / rate + (gaps != ""))
    for k in range(max(10, int(7.0 * rate))):
        t = k / rate
        center = np.column_stack((speed * t + apart * cars, np.zeros(4), np.ones(4)))
        center[:, :2] += rng.normal(0.0, 0.1, (4, 2))
        driven = np.column_stack((np.full(4, speed), np.zeros(4))) + rng.normal(0.0, 0.3, (4, 2))
        seen = cars if not gaps or t % 3.0 < 2.0 else cars[:0]
        if gaps == "no frames" and not len(seen):
            continue
        frame, _ = optipmb.make_frame(
            parameters,
            stamp_ns=round(t * 1e9),
            labels=("car",),
            label=np.zeros(len(seen), np.int64),
            center=center[seen],
            size=np.tile([4.5, 1.9, 1.6], (len(seen), 1)),
            yaw=rng.normal(0.0, 0.03, 4)[seen],
            score=np.full(len(seen), 0.9),
            velocity=driven[seen] if velocity else None,
        )
        result = tracker.step(density, frame)
        density = result.density
        for identity, car in zip(result.tracks.id.tolist(), result.tracks.detection.tolist(), strict=True):
            if car >= 0:
                found.setdefault(car, set()).add(identity)
    return found, density.next_id - 1


@pytest.mark.parametrize("velocity", [False, True], ids=["positions", "velocities"])
@pytest.mark.parametrize("kind", ["generic", "auto"])
def test_cars_keep_their_ids_at_any_rate_and_speed(kind: str, *, velocity: bool) -> None:
    """From 0.5 to 50 Hz and up to 30 m/s; without velocities where a car drives at most 30 m from frame to frame."""
    for rate in RATES[1:]:
        for speed in (0.0, 15.0, 30.0):
            if velocity or speed <= 30.0 * rate:
                found, count = file_of_cars(made(kind, rate), rate, speed, velocity=velocity, gaps="")
                assert count == len(found) == 4, (rate, speed, found)


@pytest.mark.parametrize("gaps", ["empty frames", "no frames"])
@pytest.mark.parametrize("kind", ["generic", "auto"])
def test_cars_keep_their_ids_over_gaps_of_a_second(kind: str, gaps: str) -> None:
    """Every three seconds, from 2 to 50 Hz."""
    for rate in (2.0, 5.0, 10.0, 20.0, 50.0):
        for speed, velocity in ((0.0, False), (10.0, False), (30.0, False), (30.0, True)):
            found, count = file_of_cars(made(kind, rate), rate, speed, velocity=velocity, gaps=gaps)
            assert count == len(found) == 4, (rate, speed, found)


@pytest.mark.parametrize("rate", [2.0, 5.0, 10.0, 20.0, 50.0])
@pytest.mark.parametrize("kind", ["generic", "auto"])
def test_an_object_is_kept_for_two_seconds_at_every_rate(kind: str, rate: float) -> None:
    """Within one period of the stream or of the profile, whether it was detected once or for long."""
    parameters = made(kind, rate)
    tracker = optipmb.Tracker(parameters)
    for detected in (1, int(2 * rate)):
        density = tracker.initial()
        for k in range(detected):
            density = tracker.step(density, boxes(parameters, k / rate, (0, 0), label="car", score=0.9)).density
        k = detected - 1
        while len(density.bernoulli):
            k += 1
            density = tracker.step(density, boxes(parameters, k / rate)).density
        assert abs((k - detected + 1) / rate - 2.0) <= max(1.0 / rate, parameters.nominal_period) + 1e-9


def test_the_papers_profiles_keep_the_papers_gates_and_motion() -> None:
    """What goes beyond the paper is off in them."""
    for name in ("kitti-paper", "nuscenes-paper"):
        parameters = optipmb.load_profile(name)
        assert parameters.detection_time == 0.0
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

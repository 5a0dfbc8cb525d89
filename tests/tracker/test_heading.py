"""Which way an object faces: turned boxes cost nothing, evidence turns a track, and it publishes its doubt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from class_rows import class_row
from numpy.typing import NDArray
from scenes import boxes, steps

import optipmb
from optipmb.filter.lightweight import follow_sign, turn_around
from optipmb.filter.predict import predict_state

Array = NDArray[np.float64]
DRIVES = 100
FRAMES = 24


def drives(parameters: optipmb.Parameters, label: str, seed: int) -> list[tuple[Array, Array]]:
    """Centres (100, 2) and headings (100,) of objects in bends, far from each other, in every frame."""
    rng = np.random.default_rng(seed)
    dt, gate = parameters.nominal_period, parameters.classes[label].gate
    speed, turn = rng.uniform(0.0, min(15.0, 0.25 * gate / dt), DRIVES), rng.uniform(-0.3, 0.3, DRIVES)
    place, yaw = 200.0 * np.column_stack([np.arange(DRIVES) % 10, np.arange(DRIVES) // 10]), rng.uniform(-3, 3, DRIVES)
    found = []
    for _ in range(FRAMES):
        found.append((place, yaw))
        yaw = yaw + dt * turn
        place = place + dt * speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return found


def seen(
    parameters: optipmb.Parameters,
    label: str,
    path: list[tuple[Array, Array]],
    turned: NDArray[np.int64],
    *,
    velocity: bool,
) -> list[optipmb.StepResult]:
    """The results for these objects, detected with noise, each turned by pi in one frame."""
    rng, frames, dt = np.random.default_rng(1), [], parameters.nominal_period
    for k, (place, yaw) in enumerate(path):
        after = path[min(k + 1, len(path) - 1)][0]
        moving = (after - place) / dt if velocity and k + 1 < len(path) else None
        xy = place + rng.normal(0, 0.05, place.shape)
        facing = yaw + rng.normal(0, 0.03, len(yaw)) + np.pi * (turned == k)
        frames.append(boxes(parameters, k * dt, xy, yaw=np.angle(np.exp(1j * facing)), velocity=moving, label=label))
    return steps(parameters, frames)


@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("profile", optipmb.profiles())
def test_one_turned_box_costs_no_id(profile: str, *, velocity: bool) -> None:
    """In 100 random drives of every class each object keeps the id that it got first, and in the end faces forwards."""
    parameters = optipmb.load_profile(profile)
    for seed, label in enumerate(parameters.labels):
        path = drives(parameters, label, seed)
        turned = np.random.default_rng(seed).integers(1, FRAMES - 8, DRIVES)
        results = seen(parameters, label, path, turned, velocity=velocity)
        assert results[-1].density.next_id == DRIVES + 1, label
        tracks = results[-1].tracks
        assert len(tracks) == DRIVES, label
        # Ids follow the order of the measurements; places tell which object is which.
        near = np.linalg.norm(tracks.center[:, None, :2] - path[-1][0], axis=2).argmin(axis=1)
        off = tracks.yaw - path[-1][1][near]
        if parameters.classes[label].heading_sign is not None:
            assert (np.cos(off) > 0.0).all(), label
            assert (tracks.heading_confidence > 0.5).all()


def one_class(**changes: float) -> optipmb.Parameters:
    """The cars of the kitti profile with other values of `heading_sign`."""
    document = optipmb.load_profile("kitti").model_dump()
    document["classes"] = {"Car": document["classes"]["Car"]}
    document["classes"]["Car"]["heading_sign"] |= changes
    return optipmb.parse_parameters(document)


def test_a_track_that_was_born_backwards_turns() -> None:
    """A first box turned by pi is outvoted by the second and third, and the velocity over ground stays the same."""
    parameters = one_class(motion=0.0)
    said = []
    frames = [boxes(parameters, 0.1 * k, (1.0 * k, 0.0), yaw=math.pi if k == 0 else 0.0) for k in range(12)]
    for result in steps(parameters, frames):
        said.append((float(np.cos(result.tracks.yaw[0])), float(result.tracks.heading_confidence[0])))
    facing = [cos for cos, _ in said]
    assert facing[0] == pytest.approx(-1.0)
    assert all(cos > 0.9 for cos in facing[2:])
    assert said[2][1] < 0.8 < said[-1][1]
    assert result.tracks.velocity[0, 0] == pytest.approx(10.0, abs=1.5)


def test_driving_says_which_way_is_forward() -> None:
    """A car whose boxes all face backwards is turned by its motion, where motion counts for more."""
    parameters = one_class(motion=3.0)
    frames = [boxes(parameters, 0.1 * k, (1.0 * k, 0.0), yaw=math.pi) for k in range(15)]
    assert abs(steps(parameters, frames)[-1].tracks.yaw[0]) < 0.1


def test_the_doubt_is_in_the_variance_and_ends() -> None:
    """The heading of a newborn has p (1 - p) pi^2 more variance but for a tail; in the end nothing is added."""
    document = one_class().model_dump()
    document["classes"]["Car"]["reported_noise"] = None
    parameters = optipmb.parse_parameters(document)
    for result in steps(parameters, [boxes(parameters, 0.1 * k, (1.0 * k, 0.0)) for k in range(20)]):
        density = result.density
        p = float(result.tracks.heading_confidence[0])
        added = result.tracks.covariance[0, 3, 3] - density.bernoulli.covariance[0, 3, 3]
        assert p == pytest.approx(1.0 / (1.0 + math.exp(-density.bernoulli.heading_odds[0])))
        assert added == pytest.approx(max(p * (1 - p) - 0.025 * 0.975, 0.0) * math.pi**2, abs=1e-12)
    assert p > 0.999
    assert added == 0.0


def test_the_sign_fades_with_time_and_not_with_frames() -> None:
    """At any frame rate the log odds tend to b_d z_s / (1 - lambda), in the same time."""
    parameters = one_class(motion=0.0)
    found = []
    for rate in (1, 4):
        frames = [boxes(parameters, 0.1 * k / rate, (0.0, 0.0)) for k in range(10 * rate + 1)]
        found.append(float(steps(parameters, frames)[-1].density.bernoulli.heading_odds[0]))
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    assert found[0] == pytest.approx(0.9 * (1 - 0.9**11) / 0.1, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_turned_state_describes_the_same_motion(seed: int) -> None:
    """Predicting the turned state gives the turned prediction: nothing but the heading's name changes."""
    rng = np.random.default_rng(seed)
    mean, root = rng.normal(0, 1, 6), rng.normal(0, 0.3, (6, 6))
    covariance = root @ root.T + 1e-3 * np.eye(6)
    noise = rng.uniform(0.1, 1, 6)

    def predicted(m: Array, p: Array) -> tuple[Array, Array]:
        out, spread = np.empty(6), np.empty((6, 6))
        own = class_row(process_noise=noise, acceleration_time=math.inf)
        predict_state(m, p, 0.5, own, (np.empty((6, 6)), np.empty((12, 6))), out, spread)
        return out, spread

    straight = predicted(mean, covariance)
    turned = mean.copy(), covariance.copy()
    turn_around(*turned)
    around = predicted(*turned)
    turn_around(*straight)
    np.testing.assert_allclose(around[0], straight[0], atol=1e-9)
    np.testing.assert_allclose(around[1], straight[1], atol=1e-9)


def test_without_parameters_the_sign_stays() -> None:
    """With zeros for lambda, b_d and b_v the log odds stay zero and no state is turned."""
    mean, covariance = np.array([0.0, 0.0, -9.0, 0.0, 0.0, 0.0]), 0.01 * np.eye(6)
    assert follow_sign(0.0, 0.0, class_row(), 0.9, math.pi, mean, covariance) == 0.0
    assert mean[3] == 0.0

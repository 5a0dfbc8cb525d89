"""Detections with a covariance of their own, against numpy's formulas."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from class_rows import class_rows

import optipmb
from optipmb.filter.hypotheses import gate
from optipmb.filter.preprocess import preprocess
from optipmb.filter.update import birth_states, ukf_updates
from optipmb.model.stages import Measurements
from optipmb.model.table import ClassTable

CARS, FRAMES, DT_NS = 6, 12, 100_000_000
HALF = np.pi / 6


def drive(parameters: optipmb.Parameters, **given: Any) -> list[optipmb.StepResult]:
    """Cars that drive apart, seen with noise, faintly at first, and with velocities now and then."""
    rng, tracker = np.random.default_rng(3), optipmb.Tracker(parameters)
    density, results = tracker.initial(), []
    label = np.arange(CARS) % len(parameters.labels)
    yaw = np.linspace(0, 5, CARS)
    ahead = np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros(CARS)))
    for k in range(FRAMES):
        frame, _ = optipmb.make_frame(
            parameters,
            stamp_ns=k * DT_NS,
            labels=parameters.labels,
            label=label,
            center=(20.0 + 0.8 * k) * ahead + rng.normal(0, 0.1, (CARS, 3)),
            size=np.full((CARS, 3), [4.0, 1.8, 1.5]),
            yaw=yaw + rng.normal(0, 0.05, CARS),
            score=np.where(np.arange(CARS) < 2 + k, 0.9, 0.35),
            velocity=8.0 * ahead[:, :2] if k % 3 else None,
            **{name: value(label) for name, value in given.items()},
        )
        results.append(tracker.step(density, frame))
        density = results[-1].density
    assert len(results[-1].tracks) >= CARS - 1
    return results


def bytes_of(results: list[optipmb.StepResult]) -> list[bytes]:
    """Everything that the steps gave."""
    return [
        column.tobytes()
        for one in results
        for column in (
            *optipmb.columns_of(one.density).values(),
            one.tracks.words,
        )
    ]


@pytest.mark.parametrize("profile", ["kitti", "kitti-paper", "nuscenes", "nuscenes-paper", "generic"])
def test_the_covariance_of_the_profile_changes_no_byte(profile: str) -> None:
    """Detections whose covariance is R of their class, or unknown, give the density and tracks of those without.

    Where a profile learns R, only unknown ones do.
    """
    parameters = optipmb.load_profile(profile)
    sigma = np.array([one.measurement_noise.position for one in parameters.classes.values()])

    def same(label: Any) -> Any:
        given = sigma[label][:, None, None] ** 2 * np.eye(3)
        given[1 - parameters.self_calibration :: 2 - parameters.self_calibration] = np.nan
        return given

    expected = bytes_of(drive(parameters))
    assert bytes_of(drive(parameters, position_covariance=same)) == expected
    far = bytes_of(
        drive(parameters, position_covariance=lambda label: np.full((len(label), 3, 3), 0.3) + 2 * np.eye(3))
    )
    assert far != expected


def pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state, its covariance, and a covariance of a position that is far from a circle."""
    root = rng.normal(0, 0.3, (6, 6))
    mean = np.array([3.0, -2.0, 7.0, 0.4, 0.1, 0.5]) + rng.normal(0, 0.1, 6)
    turned = np.array([[np.cos(HALF), -np.sin(HALF)], [np.sin(HALF), np.cos(HALF)]])
    return mean, root @ root.T + 0.05 * np.eye(6), turned @ np.diag([2.0, 0.1]) @ turned.T


def updated(mean: Any, covariance: Any, z: Any, spread: Any, velocity: Any) -> tuple[Any, Any]:
    """The kernel's update with a detection of covariance `spread`, under sigma = 0.5."""
    position = np.array([[z[0], z[1], *(spread[[0, 0, 1], [0, 1, 1]] / 0.25)]])
    out, out_spread = np.empty((1, 6)), np.empty((1, 6, 6))
    zero = np.zeros(1, np.int64)
    classes = class_rows(1, noise_position=0.5, noise_velocity=0.7, noise_heading=0.2)
    measured = Measurements(position, np.array([z[2]]), np.array([velocity]), np.empty((1, 4)), np.empty(1), zero, zero)
    assert ukf_updates(zero, zero, mean[None], covariance[None], measured, classes, out, out_spread) == 0
    return out[0], out_spread[0]


def test_the_centre_of_a_long_object_is_uncertain_along_it() -> None:
    """R is that of the class, and along the heading a tenth of the length where that is more; known R stays."""
    parameters = optipmb.generic_parameters(("boat", "car"), 0.1)
    sigma = np.array([one.measurement_noise.position for one in parameters.classes.values()])
    yaw = np.array([0.7, -2.0, np.nan, 0.7, 0.7, 0.7])
    length, label = np.array([25.0, 12.0, 25.0, 2.0, 25.0, np.nan]), np.array([0, 0, 0, 0, 1, 0])
    known = np.full((6, 3, 3), np.nan)
    known[0] = np.diag([0.5, 0.4, 0.3])
    more = np.where((label == 0) & (length > 3.0), (0.1 * length / sigma[label]) ** 2 - 1.0, 0.0)
    for given in (None, known):
        frame, _ = optipmb.make_frame(
            parameters,
            stamp_ns=0,
            labels=("boat", "car"),
            label=label,
            center=np.column_stack((50.0 * np.arange(6), np.zeros((6, 2)))),
            size=np.column_stack((length, length / 5.0, np.full(6, 3.0))),
            yaw=yaw,
            score=np.linspace(0.9, 0.8, 6),
            position_covariance=given,
        )
        z, chosen, *_ = preprocess(frame, ClassTable.of(parameters))
        np.testing.assert_array_equal(chosen, np.arange(6))
        for k, (xx, xy, yy) in enumerate(z.position[:, 2:]):
            ahead = np.array([np.cos(yaw[k]), np.sin(yaw[k])])
            expected = np.eye(2) + more[k] * (np.eye(2) if np.isnan(yaw[k]) else np.outer(ahead, ahead))
            if given is not None and k == 0:
                expected = known[0, :2, :2] / sigma[0] ** 2
            np.testing.assert_allclose([[xx, xy], [xy, yy]], expected, rtol=1e-12, atol=1e-12)


def test_a_ship_of_which_parts_are_hit_stays_one_track() -> None:
    """The centre of a ship of 30 m jumps by metres, and it is not seen for three seconds now and then."""
    tracker, ids, rng = (
        optipmb.OnlineTracker(optipmb.generic_parameters(("boat",), 0.5)),
        set(),
        np.random.default_rng(4),
    )
    for k in range(120):
        seen = int(k % 20 < 15)
        center = [[2.0 * k + rng.normal(0.0, 2.0), rng.normal(0.0, 0.2), 0.0]]
        box = {"center": center, "size": [[30.0, 7.0, 5.0]], "yaw": [0.0], "score": [0.9]}
        tracks = tracker.update(
            {name: np.array(one)[:seen] for name, one in box.items()}, t=0.5 * k, label=["boat"][:seen]
        )
        ids |= set(tracks.id[tracks.confirmed].tolist())
    assert len(ids) == 1


def test_the_update_is_the_kalman_filter_with_that_covariance() -> None:
    """Without a velocity H is linear: numpy's K = P H' (H P H' + R)^-1 with the full R gives the same posterior."""
    rng, h = np.random.default_rng(0), np.eye(6)[[0, 1, 3]]
    for _ in range(20):
        mean, covariance, spread = pair(rng)
        z = h @ mean + rng.normal(0, 0.5, 3)
        noise = np.zeros((3, 3))
        noise[:2, :2], noise[2, 2] = spread, 0.2**2
        gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + noise)
        found, found_spread = updated(mean, covariance, z, spread, [np.nan, np.nan])
        np.testing.assert_allclose(found, mean + gain @ (z - h @ mean), rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found_spread, covariance - gain @ h @ covariance, rtol=1e-9, atol=1e-10)


def test_turning_the_world_turns_the_update() -> None:
    """With a velocity too: the full covariance does what the diagonal one does in its own axes."""
    rng = np.random.default_rng(1)
    cos, sin = np.cos(HALF), np.sin(HALF)
    back = np.array([[cos, sin], [-sin, cos]])
    whole = np.eye(6)
    whole[:2, :2] = back
    for _ in range(20):
        mean, covariance, spread = pair(rng)
        z = np.array([*(mean[:2] + rng.normal(0, 0.5, 2)), mean[3] + 0.1])
        velocity = np.array([6.5, 3.0])
        one, one_spread = updated(mean, covariance, z, spread, velocity)
        turned = whole @ mean
        turned[3] -= HALF
        z_turned = np.array([*(back @ z[:2]), z[2] - HALF])
        other, other_spread = updated(
            turned, whole @ covariance @ whole.T, z_turned, back @ spread @ back.T, back @ velocity
        )
        expected = whole @ one
        expected[3] -= HALF
        np.testing.assert_allclose(other, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other_spread, whole @ one_spread @ whole.T, rtol=1e-8, atol=1e-9)


def test_the_likelihood_of_a_pair_has_the_covariance_of_its_detection() -> None:
    """It is ln N(z; z_hat, P_xy + Sigma), another for each detection of an object."""
    rng = np.random.default_rng(4)
    mean, covariance, spread = pair(rng)
    position = mean[:2] + rng.normal(0, 1.0, (5, 2))
    spreads = spread * np.linspace(0.5, 4.0, 5)[:, None, None]
    columns = np.column_stack((position, spreads[:, [0, 0, 1], [0, 1, 1]] / 0.25))
    zeros = np.zeros(5, np.int64)
    _, measurement, found = gate(
        mean[None],
        covariance[None],
        zeros[:1],
        np.array([50.0]),
        columns,
        zeros,
        class_rows(1, noise_position=0.5),
        False,
    )
    assert measurement.tolist() == list(range(5))
    for m in range(5):
        total, away = covariance[:2, :2] + spreads[m], position[m] - mean[:2]
        squared = away @ np.linalg.solve(total, away)
        expected = -np.log(2 * np.pi) - 0.5 * np.log(np.linalg.det(total)) - 0.5 * squared
        assert found[m] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("deviation", "same"), [(None, False), (0.1, False), (2.0, True), (4.0, True)])
def test_a_detection_outside_the_gate_keeps_its_id_where_its_covariance_allows(
    deviation: float | None, *, same: bool
) -> None:
    """Half a metre beyond the gate is a new track, unless the covariance of the detection is large enough."""
    parameters = optipmb.load_profile("kitti-paper")
    tracker, ids = optipmb.OnlineTracker(parameters), []
    for k in range(6):
        away = parameters.classes["Car"].gate + 0.5 if k == 5 else 0.0
        boxes: Any = {"center": [[10.0 + away, 0.0, 0.0]], "size": [[4.0, 1.8, 1.5]], "yaw": [0.0], "score": [0.9]}
        if deviation is not None and k == 5:
            boxes["position_covariance"] = deviation**2 * np.eye(3)[None]
        tracks = tracker.update({**boxes, "label": [0]}, t=0.1 * k)
        ids.append({int(one) for one, row in zip(tracks.id, tracks.detection, strict=True) if row >= 0})
    assert ids[4] == ids[0]
    assert (ids[5] == ids[0]) == same


def test_a_birth_is_as_uncertain_as_its_detection() -> None:
    """P^0 of x and y is the class's times the covariance in units of R; the rest stays."""
    _, _, spread = pair(np.random.default_rng(5))
    position = np.array([[1.0, 2.0, *(spread[[0, 0, 1], [0, 1, 1]] / 0.25)]])
    known = np.array([[0.9, 0.9, 3.0, 0.3, 0.2, 1.0]])
    mean, covariance = np.empty((1, 6)), np.empty((1, 6, 6))
    zero = np.zeros(1, np.int64)
    velocity = np.full((1, 2), np.nan)
    measured = Measurements(position, np.zeros(1), velocity, np.empty((1, 4)), np.empty(1), zero, zero)
    birth_states(zero, measured, class_rows(1, birth_known=known, birth_unknown=known), mean, covariance)
    expected = np.diag(known[0] ** 2)
    expected[:2, :2] = 0.9**2 * spread / 0.25
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-12)


def test_a_covariance_of_the_sensor_is_turned_to_the_world() -> None:
    """Along the axes of a tilted sensor: Sigma_world = T Sigma T', of which x and y count."""
    tilted = np.array([0.8, 0.1, -0.3, 0.5])
    pose = optipmb.Pose(np.array([5.0, 6.0, 7.0]), tilted / np.linalg.norm(tilted))
    root = np.random.default_rng(6).normal(0, 1, (2, 3, 3))
    given = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)
    boxes: Any = {"center": np.ones((2, 3)), "size": np.ones((2, 3)), "yaw": [0, 1], "score": [0.0, 0.5]}
    frame, left_out = optipmb.make_frame(
        optipmb.load_profile("kitti"),
        stamp_ns=0,
        labels=("Car",),
        label=[0, 0],
        pose=pose,
        position_covariance=given,
        **boxes,
    )
    assert left_out == 1
    world = pose.rotation @ given[1] @ pose.rotation.T
    assert frame.position_covariance is not None
    np.testing.assert_allclose(frame.position_covariance, [[world[0, 0], world[0, 1], world[1, 1]]], rtol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        -np.eye(3),
        np.zeros((3, 3)),
        np.full((3, 3), 1.0),
        np.diag([1.0, 1.0, 1e9]),
        np.diag([1.0, 1e-9, 1.0]),
        np.array([[1.0, 0.5, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([[1.0, np.nan, 0.0], [np.nan, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.diag([np.inf, 1.0, 1.0]),
    ],
)
def test_what_is_no_covariance_is_refused_by_its_object(wrong: np.ndarray) -> None:
    """Not positive definite, not symmetric, not finite, or too large or small: the error names the object."""
    tracker = optipmb.OnlineTracker("kitti")
    boxes: Any = {
        "center": np.ones((2, 3)),
        "size": np.ones((2, 3)),
        "yaw": [0, 1],
        "score": [0.9, 0.5],
        "label": [0, 0],
    }
    with pytest.raises(optipmb.FrameError) as caught:
        tracker.update(boxes, t=0.0, position_covariance=np.stack([np.eye(3), wrong]))
    assert caught.value.path == "position_covariance[1]"
    assert "symmetric covariance" in caught.value.expected
    with pytest.raises(optipmb.FrameError, match="position_covariance"):
        tracker.update(boxes, t=0.0, position_covariance=np.eye(3))
    frame, _ = optipmb.make_frame(
        tracker.parameters,
        stamp_ns=0,
        labels=("Car",),
        position_covariance=[np.eye(3), np.full((3, 3), np.nan)],
        **boxes,
    )
    for row in ([-1.0, 0.0, 1.0], [1.0, 1.1, 1.0], [1.0, np.nan, 1.0], [np.inf, 0.0, 1.0]):
        with pytest.raises(optipmb.FrameError, match=r"position_covariance\[1\]"):
            replace(frame, position_covariance=[[1.0, 0.0, 1.0], row])
    assert replace(frame, cloud=None).position_covariance is not None
    assert tracker.density.stamp_ns < 0
    tracker.update(boxes, t=0.0, position_covariance=np.full((2, 3, 3), np.nan))
    assert tracker.density.stamp_ns == 0

"""A world that moves: a density and a frame in other coordinates, against plain formulas and the run without."""

from __future__ import annotations

import math

import numpy as np
import pytest

import optipmb

GENERIC = optipmb.load_profile("generic")
MOTION = optipmb.Relocation(40.0, -7.0, 1.5, 2.5)


def frames(count: int = 12, moved_from: int = 99) -> list[optipmb.Frame]:
    """Cars that drive about a sensor that drives, one of them without a velocity; from a number on in another world."""
    rng, found = np.random.default_rng(3), []
    yaw = np.array([3.1, -3.1, 0.4, 1.7])
    for k in range(count):
        way = 5.0 * 0.1 * k * np.column_stack((np.cos(yaw), np.sin(yaw)))
        center = np.column_stack((np.array([[20.0, 5.0], [35.0, -9.0], [-12.0, 14.0], [4.0, -20.0]]) + way, np.ones(4)))
        velocity = 5.0 * np.column_stack((np.cos(yaw), np.sin(yaw)))
        velocity[3] = np.nan
        pose = optipmb.Pose(np.array([0.5 * k, 1.0, 1.8]), np.array([math.cos(0.1), 0.0, 0.0, math.sin(0.1)]))
        rotation = pose.rotation  # boxes are in the axes of the sensor
        placed = MOTION.pose(pose) if k >= moved_from else pose
        cloud = optipmb.PointCloud(rng.normal(0.0, 20.0, (500, 3)).astype(np.float32), placed)
        frame, _ = optipmb.make_frame(
            GENERIC,
            stamp_ns=k * 100_000_000,
            labels=("car",),
            label=np.zeros(4, np.int64),
            center=(center + rng.normal(0.0, 0.05, (4, 3)) - pose.translation) @ rotation,
            size=np.tile([4.5, 1.9, 1.6], (4, 1)),
            yaw=yaw - 0.2,
            score=np.array([0.9, 0.85, 0.8, 0.75]),
            velocity=velocity @ rotation[:2, :2],
            pose=placed,
            cloud=cloud,
            field_of_view=optipmb.FieldOfView(azimuth=(-2.8, 2.8), range=(0.0, 60.0)),
        )
        found.append(frame)
    return found


@pytest.mark.parametrize("at", [0, 1, 6])
def test_a_moved_run_is_the_run_moved(at: int) -> None:
    """Whenever the world moves, density and tracks equal the moved ones of a run without."""
    tracker = optipmb.Tracker(GENERIC)
    still = moved = tracker.initial()
    for k, (frame, later) in enumerate(zip(frames(), frames(moved_from=at), strict=True)):
        one = tracker.step(still, frame)
        other = tracker.step(MOTION.density(moved) if k == at else moved, later)
        still, moved = one.density, other.density
    np.testing.assert_array_equal(one.tracks.id, other.tracks.id)
    np.testing.assert_array_equal(one.tracks.detection, other.tracks.detection)
    assert len(one.tracks) == 4
    np.testing.assert_allclose(MOTION.points(one.tracks.center[:, :2]), other.tracks.center[:, :2], atol=1e-9)
    for name, column in optipmb.columns_of(MOTION.density(still)).items():
        expected, found = column, optipmb.columns_of(moved)[name]
        if name.endswith(".mean"):
            expected, found = expected.copy(), found.copy()
            expected[:, 3], found[:, 3] = np.cos(expected[:, 3]), np.cos(found[:, 3])
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=name)


def test_motions_are_those_of_plain_formulas() -> None:
    """Matrices move each row; values without a place stay, and headings are within half a turn."""
    tracker, density = optipmb.Tracker(GENERIC), None
    for frame in frames():
        density = tracker.step(density or tracker.initial(), frame).density
    assert density is not None
    turn = np.array([[math.cos(2.5), -math.sin(2.5)], [math.sin(2.5), math.cos(2.5)]])
    moved, both = MOTION.density(density), np.eye(6)
    both[:2, :2] = turn
    for rows, others in ((density.bernoulli, moved.bernoulli), (density.poisson, moved.poisson)):
        for n in range(len(rows)):
            np.testing.assert_allclose(others.mean[n, :2], turn @ rows.mean[n, :2] + MOTION[:2], rtol=1e-12)
            np.testing.assert_allclose(others.covariance[n], both @ rows.covariance[n] @ both.T, atol=1e-12)
            assert math.isclose(math.cos(others.mean[n, 3]), math.cos(rows.mean[n, 3] + 2.5), abs_tol=1e-12)
            assert -math.pi < others.mean[n, 3] <= math.pi
        np.testing.assert_array_equal(others.mean[:, [2, 4, 5]], rows.mean[:, [2, 4, 5]])
        np.testing.assert_array_equal(others.auxiliary, rows.auxiliary + np.array([0.0, 0.0, 0.0, 1.5]))
    pose = optipmb.Pose(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.5, -0.5, 0.5]))
    about = np.eye(3)
    about[:2, :2] = turn
    np.testing.assert_allclose(MOTION.pose(pose).rotation, about @ pose.rotation, atol=1e-12)
    np.testing.assert_allclose(MOTION.pose(pose).translation, about @ pose.translation + MOTION[:3], atol=1e-12)
    origin = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    assert pytest.approx(optipmb.Relocation.of(MOTION.pose(origin))) == MOTION


def test_no_motion_is_the_same_density() -> None:
    """Byte for byte."""
    density = optipmb.Tracker(GENERIC).step(optipmb.Tracker(GENERIC).initial(), frames(1)[0]).density
    assert optipmb.bytes_of(optipmb.Relocation(0.0, 0.0, 0.0, 0.0).density(density)) == optipmb.bytes_of(density)


def test_a_motion_off_the_earth_is_refused() -> None:
    """The error names the column, before any number overflows."""
    density = optipmb.Tracker(GENERIC).step(optipmb.Tracker(GENERIC).initial(), frames(1)[0]).density
    with pytest.raises(optipmb.DensityError, match=r"\.mean"):
        optipmb.Relocation(2e8, 0.0, 0.0, 0.0).density(density)

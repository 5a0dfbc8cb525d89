"""Predicted paths against the textbook's motion, step by step."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from typing import Any

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_rows

import optipmb
from optipmb.filter.paths import MAX_HORIZONS, predict_paths

KITTI = optipmb.load_profile("kitti")
LABELS = ("Car", "Pedestrian", "Cyclist")


def frame(stamp_ns: int, k: int | None) -> optipmb.Frame:
    """A turning car, a pedestrian and a cyclist in frame k, or nothing."""
    there = slice(0 if k is None else 3)
    t = 0.1 * (k or 0)
    center = [[8 * t, 2 * t * t, 0.8], [20.0, t, 0.9], [-5 * t, 30.0, 0.9]]
    found, _ = optipmb.make_frame(
        KITTI,
        stamp_ns=stamp_ns,
        labels=LABELS,
        label=np.arange(3)[there],
        center=np.array(center)[there],
        size=np.array([[4.0, 1.7, 1.5], [0.6, 0.6, 1.7], [1.8, 0.6, 1.7]])[there],
        yaw=np.array([0.5 * t, 1.5, 3.1])[there],
        score=np.array([0.95, 0.9, 0.9])[there],
    )
    return found


def followed() -> tuple[optipmb.Tracker, optipmb.StepResult]:
    """The tracker and its result after a second."""
    tracker = optipmb.Tracker(KITTI)
    density = tracker.initial()
    for k in range(10):
        result = tracker.step(density, frame(k * 100_000_000, k))
        density = result.density
    assert len(result.tracks) == 3
    return tracker, result


@pytest.mark.parametrize("tau", [math.inf, 1.5])
def test_states_are_predicted_as_numpy_does_step_by_step(tau: float) -> None:
    """In steps of at most a period the mean moves by itself, the turn rate and acceleration weighed by their doubt."""
    rng = np.random.default_rng(0)
    mean, root = rng.normal(0, [50, 50, 8, 1, 0.3, 1], (6, 6)), rng.normal(0, 0.2, (6, 6, 6))
    covariance = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(6)
    label, noise = np.arange(6) % 2, rng.uniform(0.1, 1.0, (2, 6))
    horizons, straight = np.array([0.1, 0.25, 1.0, 1.001]), np.array([False, True])
    classes = class_rows(2, process_noise=noise, acceleration_time=tau, constant_velocity=straight)
    means, covariances = predict_paths(mean, covariance, label, horizons, 0.1, classes)
    for n in range(6):
        c, m, spread = label[n], mean[n].copy(), covariance[n]
        doubt = np.diag(spread)[4:]
        m[4:] *= 0.0 if straight[c] else m[4:] ** 2 / (m[4:] ** 2 + doubt)
        for h, (ahead, steps) in enumerate(((0.1, 1), (0.15, 2), (0.75, 8), (0.001, 1))):
            for _ in range(steps):
                moved = (
                    textbook.constant_velocity(m, ahead / steps)
                    if straight[c]
                    else textbook.ctra(m, ahead / steps, tau)
                )
                _, spread = textbook.predict(
                    m, spread, np.diag(noise[c] ** 2), ahead / steps, tau, straight=bool(straight[c])
                )
                m = moved
            m[3] = textbook.wrap(m[3])
            np.testing.assert_allclose(means[n, h], m, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(covariances[n, h], spread, rtol=1e-8, atol=1e-9)


def test_a_path_goes_where_an_object_of_unknown_turn_rate_does() -> None:
    """A walker at 1.4 m/s whose heading may turn far in 3 s is still predicted to go 4.2 m, not half a metre."""
    mean, covariance = np.array([[0.0, 0.0, 1.4, 0.3, 0.4, 0.0]]), np.diag([0.04, 0.04, 0.04, 0.1, 1.0, 0.1])[None]
    classes = class_rows(1, process_noise=[[0.05, 0.05, 0.8, 1.6, 0.5, 0.3]], acceleration_time=math.inf)
    found, _ = predict_paths(mean, covariance, np.zeros(1, np.int64), np.array([3.0]), 0.5, classes)
    assert np.hypot(*found[0, 0, :2]) > 4.0


def test_tracks_are_predicted_from_what_they_report() -> None:
    """A track's path follows from its box, speed and covariance."""
    _, result = followed()
    tracks = result.tracks
    paths = optipmb.predict_tracks(tracks, [0.001], KITTI)
    np.testing.assert_array_equal(paths.id, tracks.id)
    np.testing.assert_array_equal(paths.label, tracks.label)
    ahead = tracks.center[:, :2] + 0.001 * tracks.velocity
    np.testing.assert_allclose(paths.position[:, 0], ahead, atol=1e-4)
    np.testing.assert_allclose(paths.yaw[:, 0], tracks.yaw, atol=1e-2)
    np.testing.assert_allclose(paths.covariance[:, 0], tracks.covariance, rtol=0.05, atol=0.02)


def test_a_doubtful_heading_changes_no_motion() -> None:
    """Only the variance of the heading has the doubt in it, at each horizon as in the track."""
    _, result = followed()
    sure = result.tracks.replaced(heading_confidence=np.ones(3))
    unsure = sure.replaced(heading_confidence=np.full(3, 0.6))
    doubt = (0.6 * 0.4 - 0.025 * 0.975) * np.pi**2
    unsure.covariance[:, 3, 3] += doubt
    a, b = (optipmb.predict_tracks(one, [0.5, 2.0], KITTI) for one in (sure, unsure))
    np.testing.assert_allclose(b.mean, a.mean, rtol=1e-9, atol=1e-9)
    b.covariance[:, :, 3, 3] -= doubt
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-9, atol=1e-9)


def test_a_step_gives_the_paths_that_the_profile_asks_for() -> None:
    """With horizons in the profile they equal `predict_tracks`; tracks and densities are the same bytes."""
    document = KITTI.model_dump()
    assert "horizons" not in document
    asking = optipmb.parse_parameters(document | {"horizons": [0.5, 1.0, 3.0]})
    tracker, other = optipmb.Tracker(KITTI), optipmb.Tracker(asking)
    online = optipmb.OnlineTracker(asking)
    a, b = tracker.initial(), other.initial()
    for k in range(4):
        given = frame(k * 100_000_000, k)
        without, found = tracker.step(a, given), other.step(b, given)
        a, b = without.density, found.density
        assert without.paths is None
        assert found.paths is not None
        paths = optipmb.predict_tracks(found.tracks, [0.5, 1.0, 3.0], KITTI)
        for field in fields(paths):
            assert getattr(paths, field.name).tobytes() == getattr(found.paths, field.name).tobytes()
        assert without.tracks.words.tobytes() == found.tracks.words.tobytes()
    assert len(found.paths) == 3
    boxes = {"center": [[0, 0, 1]], "size": [[4, 2, 1.5]], "yaw": [0], "score": [0.9], "label": ["Car"]}
    told = online.update(boxes, t=0.0)
    assert told.paths is not None
    assert told.paths.position.shape == (1, 3, 2)
    assert optipmb.OnlineTracker(KITTI).update(boxes, t=0.0).paths is None


@pytest.mark.parametrize("horizons", [[0.0], [1.0, 1.0], [30.1], [math.nan], np.linspace(0.1, 1, 101).tolist()])
def test_a_profile_of_other_horizons_is_refused(horizons: list[float]) -> None:
    """The profile has the bounds of `predict_tracks`, and the error names the field."""
    with pytest.raises(optipmb.ParameterError) as caught:
        optipmb.parse_parameters(KITTI.model_dump() | {"horizons": horizons})
    assert caught.value.path.startswith("horizons")
    assert optipmb.parse_parameters(KITTI.model_dump() | {"horizons": [30.0]}).horizons == (30.0,)


def test_no_objects_and_no_horizons_have_empty_paths() -> None:
    """Shapes hold for none of either."""
    tracker, result = followed()
    assert optipmb.predict_tracks(tracker.initial(), [1.0], KITTI).mean.shape == (0, 1, 6)
    assert optipmb.predict_tracks(result.tracks, [], KITTI).covariance.shape == (3, 0, 6, 6)


@pytest.mark.parametrize(
    ("horizons", "path"),
    [
        ([0.0], "horizons[0]"),
        ([1.0, 1.0], "horizons[1]"),
        ([1.0, np.nan], "horizons[1]"),
        ([np.inf], "horizons[0]"),
        ([31.0], "horizons[0]"),
        ([[1.0]], "horizons"),
        (1.0, "horizons"),
        (["soon"], "horizons"),
        (np.linspace(0.1, 1, MAX_HORIZONS + 1), "horizons"),
    ],
)
def test_other_horizons_are_refused_by_name(horizons: Any, path: str) -> None:
    """Not above zero, not ascending, not finite, too far, too many, or no list of numbers."""
    _, result = followed()
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.predict_tracks(result.tracks, horizons, KITTI)
    assert caught.value.path == path


def test_tracks_of_another_profile_are_refused() -> None:
    """Classes that the profile lacks, tracks that are not sound, a density of other classes or with other columns.

    The error names the value, the expected and the received.
    """
    _, result = followed()
    tracks, density = result.tracks, result.density
    for wrong, text in (
        (tracks.replaced(label=tracks.label + 1), "tracks.label: expected indices below"),
        (
            tracks.replaced(yaw=tracks.yaw * np.nan),
            "tracks.yaw[0]: expected a number from -100000 to 100000, received nan",
        ),
        (tracks.replaced(id=tracks.id[::-1]), "tracks.id[1]: expected ids that ascend, from 0, received"),
    ):
        with pytest.raises(optipmb.FrameError, match=re.escape(text)):
            optipmb.predict_tracks(wrong, [1.0], KITTI)
    other_class = density.bernoulli.replaced(label=density.bernoulli.label + 7)
    for other, text in (
        (replace(density, labels=("car",)), "density.labels: expected the classes of profile kitti, ('Car',"),
        (replace(density, bernoulli=other_class), "bernoulli.label: expected indices below 3, received 7 to 9"),
    ):
        with pytest.raises(optipmb.DensityError, match=re.escape(text)):
            optipmb.predict_tracks(other, [1.0], KITTI)

"""Updates at values that no scene of the oracle has: turned boxes, and mixtures on both sides of pi."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import oracle_formulas as textbook
import pytest
from numpy.typing import NDArray

from optipmb.filter.update import moment_match, ukf_update, workspace

Array = NDArray[np.float64]


def random_state(rng: np.random.Generator) -> tuple[Array, Array]:
    """A predicted state and covariance; the heading may lie near the cut at pi."""
    mean = rng.normal(0, [100, 100, 8, 0.2, 0.4, 1.0])
    mean[3] = textbook.wrap(mean[3] + rng.choice([0.0, math.pi]))
    root = rng.normal(size=(6, 6)) * np.array([[0.5], [0.5], [1.0], [0.2], [0.2], [0.5]])
    return mean, root @ root.T + 1e-6 * np.eye(6)


def measurement(rng: np.random.Generator, mean: Array, *, velocity: bool) -> textbook.Measurement:
    """A measurement near the state, or turned by any angle."""
    known = textbook.measure(mean, with_velocity=True)[2:4] + rng.normal(0, 1, 2) if velocity else None
    yaw = mean[3] + rng.uniform(-3, 3)
    return textbook.Measurement(mean[:2] + rng.normal(0, 1, 2), known, yaw, np.ones(4), 0, 0.9, 0)


def noise(rng: np.random.Generator) -> SimpleNamespace:
    """Measurement noise of one class."""
    deviations = SimpleNamespace(
        position=rng.uniform(0.05, 1), velocity=rng.uniform(0.1, 2), heading=rng.uniform(0.02, 1)
    )
    return SimpleNamespace(measurement_noise=deviations, velocity_gate=0.0)


def updated(mean: Array, covariance: Array, z: textbook.Measurement, c: SimpleNamespace) -> tuple[Array, Array]:
    """One update by the kernel."""
    velocity = z.velocity if z.velocity is not None else [np.nan, np.nan]
    r = c.measurement_noise
    sigma = np.array([r.position, r.position, r.velocity, r.velocity, r.heading, 0.0])
    vector = np.array([*z.xy, *velocity, z.yaw])
    out, spread = np.full(6, np.nan), np.full((6, 6), np.nan)
    buffers = workspace()
    for buffer in buffers:
        buffer[:] = np.nan  # any content will do
    assert ukf_update(mean, covariance, vector, sigma, buffers, out, spread) == 0
    return out, spread


def assert_same_gaussian(found: tuple[Array, Array], wanted: tuple[Array, Array]) -> None:
    """Equal to 1e-9, headings modulo 2 pi."""
    difference = found[0] - wanted[0]
    difference[3] = textbook.wrap(difference[3])
    np.testing.assert_allclose(difference, 0, atol=1e-9)
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-9 * max(1.0, np.abs(wanted[1]).max()))


@pytest.mark.parametrize("velocity", [True, False])
def test_a_box_turned_by_pi_is_the_same_measurement(*, velocity: bool) -> None:
    """The innovation is taken modulo pi."""
    rng = np.random.default_rng(3)
    mean, covariance = random_state(rng)
    z = measurement(rng, mean, velocity=velocity)
    z.yaw = mean[3] + 0.2
    flipped = textbook.Measurement(**(vars(z) | {"yaw": z.yaw + math.pi}))
    c = noise(rng)
    assert_same_gaussian(updated(mean, covariance, z, c), updated(mean, covariance, flipped, c))


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_a_mixture_keeps_its_mean_and_covariance(seed: int, count: int) -> None:
    """Moment matching equals the textbook sums, also where headings lie on both sides of pi."""
    rng = np.random.default_rng(seed)
    parts = [random_state(rng) for _ in range(count)]
    for mean, _ in parts:
        mean[3] = textbook.wrap(math.pi + rng.normal(0, 0.3))
    weights = rng.dirichlet(np.ones(count))
    out, spread = np.full(6, np.nan), np.full((6, 6), np.nan)
    means, covariances = np.stack([m for m, _ in parts]), np.stack([p for _, p in parts])
    moment_match(np.log(weights) - 700.0, means, covariances, out, spread)
    assert_same_gaussian((out, spread), textbook.moment_match(list(weights), parts))

"""The update kernels against the textbook unscented and linear Kalman filters, mixtures, and the birth model."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_rows
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from optipmb.association import NEW
from optipmb.preprocess import Measurements
from optipmb.update import birth_states, moment_match, ukf_update, ukf_updates, workspace

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
    return SimpleNamespace(measurement_noise=deviations)


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
@pytest.mark.parametrize("seed", range(10))
def test_the_update_is_the_textbook_ukf(seed: int, *, velocity: bool) -> None:
    """Mean and covariance equal K = C S^-1, m + K nu, P - K S K' written out with matrices."""
    rng = np.random.default_rng(seed)
    mean, covariance = random_state(rng)
    z, c = measurement(rng, mean, velocity=velocity), noise(rng)
    assert_same_gaussian(updated(mean, covariance, z, c), textbook.ukf_update(mean, covariance, z, c))


@pytest.mark.parametrize("seed", range(10))
def test_without_velocity_the_update_is_the_linear_kalman_filter(seed: int) -> None:
    """H = [x, y, phi] is linear: m + P H' (H P H' + R)^-1 nu and (I - K H) P."""
    rng = np.random.default_rng(seed)
    mean, covariance = random_state(rng)
    z, c = measurement(rng, mean, velocity=False), noise(rng)
    rows = np.zeros((3, 6))
    rows[0, 0] = rows[1, 1] = rows[2, 3] = 1
    r = c.measurement_noise
    innovation = np.array([*z.xy, z.yaw]) - rows @ mean
    innovation[2] = math.atan(math.tan(innovation[2]))
    innovations = rows @ covariance @ rows.T + np.diag([r.position, r.position, r.heading]) ** 2
    gain = covariance @ rows.T @ np.linalg.inv(innovations)
    wanted = mean + gain @ innovation, (np.eye(6) - gain @ rows) @ covariance
    assert_same_gaussian(updated(mean, covariance, z, c), wanted)


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


@pytest.mark.parametrize("seed", range(5))
def test_an_update_never_widens(seed: int) -> None:
    """The posterior covariance is positive definite and below the prior."""
    rng = np.random.default_rng(seed)
    mean, covariance = random_state(rng)
    _, posterior = updated(mean, covariance, measurement(rng, mean, velocity=True), noise(rng))
    assert np.linalg.eigvalsh(posterior).min() > 0
    assert np.linalg.eigvalsh(covariance - posterior).min() > -1e-12


def test_states_without_a_measurement_stay_as_predicted() -> None:
    """A negative index copies the state, bit for bit; the others take the noise of their measurement's class."""
    rng = np.random.default_rng(0)
    states = [random_state(rng) for _ in range(4)]
    mean, covariance = np.stack([m for m, _ in states]), np.stack([p for _, p in states])
    zs = [measurement(rng, mean[2], velocity=True), measurement(rng, mean[0], velocity=False)]
    classes = [noise(rng), noise(rng)]
    rows, chosen, label = np.array([0, 1, 2, 3, 0, NEW]), np.array([1, -1, 0, -1, -1, 0]), np.array([1, 0])
    out, spread = np.full((6, 6), np.nan), np.full((6, 6, 6), np.nan)
    ukf_updates(
        rows,
        chosen,
        mean,
        covariance,
        Measurements(
            np.stack([z.xy for z in zs]),
            np.array([z.yaw for z in zs]),
            np.stack([z.velocity if z.velocity is not None else [np.nan, np.nan] for z in zs]),
            np.empty((2, 4)),
            np.empty(2),
            label,
            label,
        ),
        class_rows(
            2,
            noise_position=[c.measurement_noise.position for c in classes],
            noise_velocity=[c.measurement_noise.velocity for c in classes],
            noise_heading=[c.measurement_noise.heading for c in classes],
        ),
        out,
        spread,
    )
    for k, (n, m) in enumerate(zip(rows, chosen, strict=True)):
        if n == NEW:
            assert np.isnan(out[k]).all()
            assert np.isnan(spread[k]).all()
        elif m < 0:
            np.testing.assert_array_equal(out[k], mean[n])
            np.testing.assert_array_equal(spread[k], covariance[n])
        else:
            wanted = textbook.ukf_update(mean[n], covariance[n], zs[m], classes[label[m]])
            assert_same_gaussian((out[k], spread[k]), wanted)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("seed", range(6))
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


def test_a_mixture_is_matched_by_what_its_samples_say() -> None:
    """Mean and covariance of a large sample of the mixture agree with the matched Gaussian."""
    rng = np.random.default_rng(8)
    parts = [random_state(rng) for _ in range(3)]
    for k, (mean, _) in enumerate(parts):
        mean[3] = 0.1 * k
    weights = np.array([0.5, 0.3, 0.2])
    out, spread = np.full(6, np.nan), np.full((6, 6), np.nan)
    means, covariances = np.stack([m for m, _ in parts]), np.stack([p for _, p in parts])
    moment_match(np.log(weights), means, covariances, out, spread)
    counts = (weights * 200_000).astype(int)
    sample = np.concatenate([rng.multivariate_normal(m, p, k) for (m, p), k in zip(parts, counts, strict=True)])
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose((sample.mean(axis=0) - out) / scale, 0, atol=0.02)
    np.testing.assert_allclose((np.cov(sample.T) - spread) / np.outer(scale, scale), 0, atol=0.02)


@settings(deadline=None)  # the first call compiles
@given(
    velocity=st.one_of(st.none(), st.tuples(st.floats(-20, 20), st.floats(-20, 20))),
    yaw=st.floats(-10, 10),
    threshold=st.sampled_from([0.0, 2.0]),
)
@example(velocity=(0.0, 2.0), yaw=1.0, threshold=2.0)  # at the threshold the velocity gives the heading
@example(velocity=(0.0, 0.0), yaw=1.0, threshold=0.0)
def test_a_birth_is_the_textbook_birth(velocity: tuple[float, float] | None, yaw: float, threshold: float) -> None:
    """m0 and P0 with, without and below the speed that gives a heading."""
    known, unknown = np.arange(1.0, 7.0), np.arange(11.0, 17.0)
    mean, covariance = np.full((1, 6), np.nan), np.full((1, 6, 6), np.nan)
    birth_states(
        np.array([1]),
        Measurements(
            np.array([[np.nan, np.nan], [3.0, 4.0]]),
            np.array([np.nan, yaw]),
            np.array([(9.0, 9.0), velocity if velocity is not None else (np.nan, np.nan)]),
            np.empty((2, 4)),
            np.empty(2),
            np.array([0, 1]),
            np.array([0, 1]),
        ),
        class_rows(
            2,
            birth_heading_speed=[99.0, threshold],
            birth_known=[np.zeros(6), known],
            birth_unknown=[np.zeros(6), unknown],
        ),
        mean,
        covariance,
    )
    spread = known if velocity is not None else unknown
    np.testing.assert_array_equal(covariance[0], np.diag(spread**2))
    measured = None if velocity is None else np.array(velocity)
    z = textbook.Measurement(np.array([3.0, 4.0]), measured, yaw, np.ones(4), 0, 0.9, 0)
    birth = SimpleNamespace(position=1, speed=3, unknown_speed=13, heading=4, turn_rate=5, acceleration=6)
    wanted, _ = textbook.birth(z, SimpleNamespace(birth=birth, birth_heading_speed=threshold))
    np.testing.assert_allclose(np.exp(1j * mean[0, 3]), np.exp(1j * wanted[3]), atol=1e-12)
    np.testing.assert_allclose(np.delete(mean[0], 3), np.delete(wanted, 3), atol=1e-12)
    assert -math.pi < mean[0, 3] <= math.pi

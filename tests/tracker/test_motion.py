"""The motion against numerical integration, at all times and turns; states are compared by the oracle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_row
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp

from optipmb.filter.predict import (
    TINY_PIVOT,
    ctra_displacement,
    predict_state,
    square_root,
    travel,
    turn_integrals,
    wrap,
)

if TYPE_CHECKING:
    from collections.abc import Callable

Array = NDArray[np.float64]
COMPILING = settings(deadline=None)  # the first call compiles
SPEEDS = st.floats(-40, 40)
TURNS = st.one_of(st.floats(-3, 3), st.sampled_from([0.0, 1e-300, 1e-12, -1e-9, 1e-6, 1e-3, -0.0]))


def random_state(rng: np.random.Generator) -> tuple[Array, Array]:
    """A motion state and a full covariance of plausible size, far from the origin of the world."""
    mean = rng.normal(0, [100, 100, 8, 1.5, 0.4, 1.0])
    root = rng.normal(size=(6, 6)) * np.array([[0.5], [0.5], [2.0], [0.3], [0.3], [0.8]])
    return mean, root @ root.T + 1e-6 * np.eye(6)


@COMPILING
@given(st.floats(-50, 50))
@example(math.pi)
@example(-math.pi)
@example(3 * math.pi)
@example(math.nextafter(-math.pi, 0))
@example(math.nextafter(math.pi, 9))
@example(-1e-17)
def test_a_wrapped_angle_is_the_same_direction_in_the_half_open_interval(angle: float) -> None:
    """The result lies in (-pi, pi] and differs from the angle by whole turns."""
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    turns = (angle - wrapped) / (2 * math.pi)
    assert abs(turns - round(turns)) < 1e-14
    if -math.pi < angle <= math.pi:
        assert wrapped == angle


@COMPILING
@given(v=SPEEDS, omega=TURNS, a=st.floats(-10, 10), dt=st.floats(1e-6, 10))
@example(v=10.0, omega=0.1, a=1.0, dt=1.0)  # where the series ends
@example(v=10.0, omega=math.nextafter(0.1, 0), a=1.0, dt=1.0)
@example(v=0.0, omega=-0.0999, a=10.0, dt=1.0)
def test_the_displacement_is_the_integral_of_the_velocity(v: float, omega: float, a: float, dt: float) -> None:
    """Along and across agree with quadrature, with the series for small turns as well as with the closed form."""
    along, across = ctra_displacement(v, omega, a, dt)
    for found, turn in ((along, math.cos), (across, math.sin)):

        def speed(t: float, turn: Callable[[float], float] = turn) -> float:
            return (v + a * t) * turn(omega * t)

        wanted = quad(speed, 0, dt, epsabs=1e-12, epsrel=1e-12, limit=200, full_output=1)[0]
        assert found == pytest.approx(wanted, rel=1e-10, abs=1e-11 * (1 + dt * (abs(v) + abs(a) * dt)))


@pytest.mark.parametrize("seed", range(3))
def test_the_quadrature_of_the_oracle_solves_the_differential_equation(seed: int) -> None:
    """The oracle's own transition is checked too: it solves x' = v cos phi, y' = v sin phi, v' = a, phi' = omega."""
    rng = np.random.default_rng(seed)
    x, dt = random_state(rng)[0], rng.uniform(0.05, 5)

    def derivative(_: float, s: Array) -> list[float]:
        return [s[2] * math.cos(s[3]), s[2] * math.sin(s[3]), s[5], s[4], 0.0, 0.0]

    solution = solve_ivp(derivative, (0, dt), x, method="DOP853", rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(textbook.ctra(x, dt), solution.y[:, -1], rtol=1e-9, atol=1e-9)


def test_a_covariance_without_full_rank_is_repaired_and_counted() -> None:
    """A pivot that rounding made zero or negative is lifted, so that the filter goes on; the repair is reported."""
    covariance = np.diag([1.0, 1.0, 1.0, 0.0, -1e-18, 1.0])
    root = np.full((6, 6), np.nan)
    assert square_root(covariance, root) == 2
    assert np.isfinite(root).all()
    np.testing.assert_allclose(root @ root.T, np.diag([1.0, TINY_PIVOT, TINY_PIVOT, 1.0, 1.0, 1.0]), atol=1e-15)


def predicted(
    mean: Array,
    covariance: Array,
    dt: float,
    noise: Array,
    tau: float = math.inf,
    *,
    straight: bool = False,
) -> tuple[Array, Array]:
    """One state through the kernel, with buffers that hold rubbish."""
    root, points = np.full((6, 6), np.nan), np.full((12, 6), np.nan)
    out, spread = np.full(6, np.nan), np.full((6, 6), np.nan)
    own = class_row(process_noise=noise, acceleration_time=tau, constant_velocity=straight)
    assert predict_state(mean, covariance, dt, own, (root, points), out, spread) == 0
    return out, spread


def moved(v: float, omega: float, a: float, dt: float, tau: float) -> tuple[float, float, float, float]:
    """Way, speed and acceleration of `travel`, of the decay and the turn over dt."""
    return travel(v, omega, a, dt, tau, math.exp(-dt / tau), turn_integrals(omega * dt))


@COMPILING
@given(
    v=SPEEDS,
    omega=TURNS,
    a=st.floats(-10, 10).filter(lambda a: a == 0.0 or abs(a) > 1e-3),
    dt=st.floats(1e-3, 10),
    tau=st.floats(0.1, 10),
)
@example(v=2.0, omega=0.3, a=-5.0, dt=3.0, tau=1.0)  # would turn round
@example(v=0.0, omega=0.0, a=-1.0, dt=3.0, tau=1.0)  # stands
@example(v=1e-17, omega=0.0, a=-1.0, dt=3.0, tau=1.0)
@example(v=-3.0, omega=0.0, a=2.0, dt=5.75, tau=2.0)  # stops within the digits of a double
def test_the_way_under_a_decaying_acceleration_is_its_integral(
    v: float, omega: float, a: float, dt: float, tau: float
) -> None:
    """Along and across agree with quadrature, and no speed changes its sign."""
    along, across, speed, acceleration = moved(v, omega, a, dt, tau)
    state = textbook.ctra(np.array([0.0, 0.0, v, 0.0, omega, a]), dt, tau)
    scale = 1 + dt * (abs(v) + 10 * tau)
    np.testing.assert_allclose([along, across], state[:2], rtol=1e-8, atol=1e-9 * scale)
    np.testing.assert_allclose([speed, acceleration], state[[2, 5]], rtol=1e-9, atol=1e-9)
    assert speed * np.sign(v) >= -1e-12


def test_a_way_in_two_parts_is_the_way() -> None:
    """Half the time twice gives the state of the whole time: CTRA with decay is a model of continuous time."""
    whole = moved(8.0, 0.4, -3.0, 1.2, 0.8)
    along, across, speed, acceleration = moved(8.0, 0.4, -3.0, 0.6, 0.8)
    more = moved(speed, 0.4, acceleration, 0.6, 0.8)
    cos, sin = math.cos(0.24), math.sin(0.24)
    parts = along + cos * more[0] - sin * more[1], across + sin * more[0] + cos * more[1], *more[2:]
    np.testing.assert_allclose(parts, whole, rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_prediction_turns_with_the_world(seed: int) -> None:
    """A state in a world turned about z is predicted to the turned prediction: no direction is preferred."""
    rng = np.random.default_rng(seed)
    mean, covariance = random_state(rng)
    angle = rng.uniform(-3, 3)
    turn = np.eye(6)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    heading = np.array([0, 0, 0, angle, 0, 0])
    noise = np.array([0.2, 0.2, 1.0, 0.1, 0.3, 0.5])
    one = predicted(mean, covariance, 0.7, noise)
    other = predicted(turn @ mean + heading, turn @ covariance @ turn.T, 0.7, noise)
    difference = other[0] - (turn @ one[0] + heading)
    difference[3] = wrap(difference[3])
    np.testing.assert_allclose(difference, 0, atol=1e-10)
    np.testing.assert_allclose(other[1], turn @ one[1] @ turn.T, atol=1e-10 * np.abs(one[1]).max())

"""Gating, costs and assignment against naive loops and the full matrix of the paper's Fig. 3."""

from __future__ import annotations

import math

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_rows
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from optipmb.filter.association import associate as associate_pairs
from optipmb.filter.hypotheses import (
    CLUTTER,
    DEVIATIONS_2,
    FALSE_SHARE,
    FEW,
    FROM_POISSON,
    NEWBORN,
    Hypotheses,
    crowd,
    detection_costs,
    exclude_neighbours,
    first_detections,
    gate,
    gate_radii,
    gate_widening,
    pairs_of_few,
    pairs_of_many,
)
from optipmb.model.density import Bernoullis, objects_in
from optipmb.model.stages import UNASSIGNED, Measurements

Array = NDArray[np.float64]
NOTHING = np.zeros(0)
NO_INDEX = np.zeros(0, np.int64)


def random_objects(rng: np.random.Generator, count: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """Means, covariances and classes of objects in a crowd."""
    mean = rng.normal(0, 4, (count, 6))
    root = rng.normal(0, 0.5, (count, 6, 6))
    return mean, root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(6), rng.integers(0, 2, count)


@pytest.mark.parametrize("measurements", [0, 40, FEW, FEW + 1, 300])
@pytest.mark.parametrize("count", [0, 1, 5, 60])
@pytest.mark.parametrize("seed", range(2))
def test_the_gate_holds_every_pair_of_a_class_within_the_distance(seed: int, count: int, measurements: int) -> None:
    """The search finds the pairs of the double loop, in its order, with their textbook likelihoods."""
    rng = np.random.default_rng(seed)
    mean, covariance, label = random_objects(rng, count)
    position, measured = rng.normal(0, 4, (measurements, 2)), rng.integers(0, 2, measurements)
    position[:3] = position[:1]  # several at one place
    distance, noise = np.array([1.5, 5.0]), np.array([0.2, 0.7])
    radius = distance[label] * rng.uniform(0.5, 1.5, count)
    radius[::9] = -1.0  # closed
    classes = class_rows(2, noise_position=noise)
    found = gate(mean, covariance, label, radius, position, measured, classes, False)

    def pairs(widening: Array) -> list[tuple[int, int]]:
        return [
            (n, m)
            for n in range(count)
            for m in range(measurements)
            if label[n] == measured[m]
            and radius[n] >= 0.0
            and math.dist(mean[n, :2], position[m]) <= math.sqrt(radius[n] ** 2 + widening[m])
        ]

    wanted = pairs(np.zeros(measurements))
    assert list(zip(found[0].tolist(), found[1].tolist(), strict=True)) == wanted
    likelihood = [textbook.log_likelihood(position[m], mean[n], covariance[n], noise[label[n]]) for n, m in wanted]
    np.testing.assert_allclose(found[2], likelihood, rtol=1e-10, atol=1e-10)
    for widening in (np.zeros(measurements), rng.choice([0.0, 1.0, 9.0], measurements)):
        targets = position, measured, widening
        few, many = pairs_of_few(mean, label, radius, targets, 2), pairs_of_many(mean, label, radius, targets, 2, 2**62)
        assert list(zip(*few, strict=True)) == sorted(zip(*many, strict=True)) == pairs(widening)
        assert (np.diff(many[0]) >= 0).all()


@pytest.mark.parametrize("seed", range(2))
def test_a_gate_widens_by_what_r_is_above_that_of_the_class(seed: int) -> None:
    """`chi^2 max(0, lambda_1(R_m) - sigma^2)`, with numpy's eigenvalues; nothing without covariances."""
    rng = np.random.default_rng(seed)
    sigma, label, root = np.array([0.2, 0.7]), rng.integers(0, 2, 30), rng.normal(0, 0.5, (30, 2, 2))
    own = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(2)
    rho = own[:, [0, 0, 1], [0, 1, 1]] / sigma[label, None] ** 2
    classes = class_rows(2, noise_position=sigma)
    found = gate_widening(np.column_stack([rng.normal(0, 9, (30, 2)), rho]), label, classes)
    beyond = np.linalg.eigvalsh(own)[:, 1] - sigma[label] ** 2
    assert 0 < (beyond < 0).sum() < 30
    np.testing.assert_allclose(found, DEVIATIONS_2 * np.maximum(beyond, 0.0), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(gate_widening(np.zeros((30, 2)), label, classes), 0.0)


def test_the_edge_of_the_gate_is_inside() -> None:
    """A measurement at exactly the gating distance passes, on all sides; one float farther does not."""
    position = np.array([[3.0, 0], [-3, 0], [0, 3], [0, -3], [np.nextafter(3, 4), 0], [-np.nextafter(3, 4), 0]])
    objects = np.zeros((1, 6)), np.eye(6)[None], np.zeros(1, np.int64), np.array([3.0])
    _, measurement, _ = gate(*objects, position, np.zeros(6, np.int64), class_rows(1, noise_position=[1.0]), False)
    np.testing.assert_array_equal(measurement, [0, 1, 2, 3])


def test_costs_stay_finite_where_likelihoods_vanish() -> None:
    """Far in the tail, where exp would be zero, the cost still orders the hypotheses."""
    arguments = np.array([0, 0]), np.array([0, 1]), np.array([-2000.0, -3000.0]), np.array([0.5]), np.array([0.9])
    association = np.full(2, np.nan)
    cost = detection_costs(*arguments, association)
    assert cost[0] < cost[1] < math.inf
    np.testing.assert_array_equal(association, 0)


@pytest.mark.parametrize("over_clutter", [False, True])
def test_a_component_worse_than_clutter_takes_no_birth_from_a_high_score(*, over_clutter: bool) -> None:
    """With e below lambda_c a high score is newborn where the profile says so; a low score stays with its component."""
    log_e = np.log([0.001, 0.001, 0.1])
    measured = np.array([0.9, 0.1, 0.9]), np.zeros(3), np.zeros(3, np.int64), np.full(3, 0.01)
    classes = class_rows(1, birth_intensity=0.002, birth_score=0.5)
    classes["birth_over_clutter"] = over_clutter
    kind, _, existence = first_detections(np.arange(3), log_e, *measured, classes)
    np.testing.assert_array_equal(kind, [NEWBORN if over_clutter else FROM_POISSON, FROM_POISSON, FROM_POISSON])
    r = 1.0 if over_clutter else 0.001 / 0.011
    np.testing.assert_allclose(existence, [r, 0.001 / 0.011, 0.1 / 0.11])


def test_a_score_too_low_to_announce_is_clutter_with_a_component_or_without() -> None:
    """It may continue a track, and starts none."""
    measured = np.array([0.1, 0.1, 0.2]), np.zeros(3), np.zeros(3, np.int64), np.full(3, 0.01)
    classes = class_rows(1, birth_intensity=0.002, birth_score=0.5, announce_score=0.15)
    kind, cost, existence = first_detections(np.array([0, 2]), np.log([0.1, 0.1]), *measured, classes)
    np.testing.assert_array_equal(kind, [CLUTTER, CLUTTER, FROM_POISSON])
    np.testing.assert_allclose(cost, [-math.log(0.01), -math.log(0.01), -math.log(0.11)])
    np.testing.assert_allclose(existence, [0.0, 0.0, 0.1 / 0.11])


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_tell_clutter_and_narrow_the_gate(seed: int) -> None:
    """In a crowd, as the double loop does; a pair beyond the measurement's neighbour stays within 99 % of S."""
    rng = np.random.default_rng(seed)
    mean, covariance, label = random_objects(rng, 30)
    position, measured, score = rng.normal(0, 4, (60, 2)), rng.integers(0, 2, 60), rng.uniform(0.1, 1.0, 60)
    position[:9, 0] += 1000.0 * np.arange(9)  # alone
    gates, noise = np.array([1.5, 5.0]), np.array([0.2, 0.7])
    classes = class_rows(2, gate=gates, clutter_intensity=0.001, noise_position=noise, crowded=[seed != 2, True])
    columns = np.full(60, np.nan), np.full((60, 2), np.nan), np.full((60, 4), np.nan), score, measured, measured
    z = Measurements(position, *columns)
    spacing, clutter = crowd(z, classes)
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    near = (measured[:, None] == measured) & (apart <= gates[measured, None]) & ~np.eye(60, dtype=np.bool_)
    near &= classes["crowded"][measured, None]
    np.testing.assert_allclose(spacing, np.where(near, apart, np.inf).min(axis=1), rtol=1e-12)
    expected = 0.001 + FALSE_SHARE * (near * score).sum(axis=1) / (math.pi * gates[measured] ** 2)
    np.testing.assert_allclose(clutter, expected, rtol=1e-12)

    pairs = np.argwhere(label[:, None] == measured).astype(np.int64)
    n, m = np.ascontiguousarray(pairs.T)
    objects = Bernoullis.of(np.zeros(30 * Bernoullis.width)).replaced(mean=mean, covariance=covariance)
    found = np.zeros(len(n))
    exclude_neighbours(n, m, found, objects_in(objects.words), z, spacing, classes)
    off = position[m] - mean[n, :2]
    spread = covariance[n, :2, :2] + noise[measured[m], None, None] ** 2 * np.eye(2)
    squared = (off * np.linalg.solve(spread, off[..., None])[..., 0]).sum(axis=1)
    far = (np.linalg.norm(off, axis=1) > spacing[m]) & (squared > DEVIATIONS_2)
    np.testing.assert_array_equal(found == -np.inf, far)
    assert 0 < far.sum() < len(far)


@pytest.mark.parametrize("dt", [0.0, 0.05, 0.1, 0.5])
def test_gates_widen_with_unknown_speed(dt: float) -> None:
    """A gate is eta, at least k standard deviations of v over dt; a NaN or an infinity widens none."""
    covariance = np.zeros((4, 6, 6))
    covariance[:, 2, 2] = [0.0, 100.0, np.nan, np.inf]
    label, eta, k = np.array([0, 0, 0, 1]), np.array([4.0, 1.0]), np.array([3.0, 0.0])
    found = gate_radii(covariance, label, dt, class_rows(2, gate=eta, gate_deviations=k))
    np.testing.assert_allclose(found, [eta[0], max(eta[0], 30.0 * dt), eta[0], eta[1]])


@given(st.lists(st.floats(-4000, 600), min_size=1, max_size=6))
@settings(deadline=None)  # the first call compiles
def test_first_detections_hold_over_all_magnitudes(log_e: list[float]) -> None:
    """E is summed as logarithms: no overflow, no underflow, r in [0, 1]."""
    arguments = np.zeros(len(log_e), np.int64), np.array(log_e), np.array([0.5]), np.zeros(1)
    classes = class_rows(1, birth_intensity=1e-4, birth_score=0.5)
    _, cost, existence = first_detections(*arguments, np.zeros(1, np.int64), np.array([1e-3]), classes)
    total = np.logaddexp.reduce([*log_e, math.log(1e-3)])
    assert cost[0] == pytest.approx(-total, rel=1e-10, abs=1e-10)
    assert existence[0] == pytest.approx(math.exp(np.logaddexp.reduce(log_e) - total), rel=1e-9, abs=1e-300)


def hypotheses(cost: Array, first: Array) -> Hypotheses:
    """The hypotheses of a cost matrix (N, M), infinite where the gate is closed."""
    row, measurement = (np.ascontiguousarray(one) for one in np.nonzero(np.isfinite(cost)))  # as kernels know them
    kind = np.full(first.size, CLUTTER)
    return Hypotheses(
        row,
        measurement,
        cost[row, measurement],
        NO_INDEX,
        NO_INDEX,
        NOTHING,
        kind,
        first,
        np.zeros(first.size),
        NOTHING,
    )


def associate(given: Hypotheses, count: int) -> NDArray[np.int64]:
    """The best global hypothesis, of the columns that count."""
    return associate_pairs(given.row, given.measurement, given.detection_cost, given.first_cost, count)


def total(cost: Array, first: Array, assigned: NDArray[np.int64]) -> float:
    """Cost of a global hypothesis."""
    objects = np.flatnonzero(assigned != UNASSIGNED)
    free = np.setdiff1d(np.arange(first.size), assigned[objects])
    return float(cost[objects, assigned[objects]].sum() + first[free].sum())


def least(cost: Array, first: Array) -> float:
    """The least cost of a global hypothesis, by scipy on the whole matrix of the paper's Fig. 3."""
    matrix = np.full((first.size, cost.shape[0] + first.size), np.inf)
    matrix[:, : cost.shape[0]] = cost.T
    np.fill_diagonal(matrix[:, cost.shape[0] :], first)
    return float(matrix[linear_sum_assignment(matrix)].sum())


@given(
    cost=arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.one_of(st.integers(-4, 4).map(float), st.floats(-1e3, 1e3), st.just(math.inf)),
    ),
    data=st.data(),
)
@settings(deadline=None, max_examples=100)  # the first call compiles
def test_the_total_is_that_of_the_hungarian_algorithm(cost: Array, data: st.DataObject) -> None:
    """Any matrix, wide or tall, with ties, closed gates and costs of all sizes: scipy finds no lower total."""
    wanted = st.lists(
        st.integers(-4, 4).map(float) | st.floats(-1e3, 1e3), min_size=cost.shape[1], max_size=cost.shape[1]
    )
    first = np.array(data.draw(wanted))
    assigned = associate(hypotheses(cost, first), cost.shape[0])
    used = assigned[assigned != UNASSIGNED]
    assert len(set(used.tolist())) == len(used)
    assert total(cost, first, assigned) == pytest.approx(least(cost, first), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_one_crowd_of_hundreds_has_the_total_of_the_hungarian_algorithm(seed: int) -> None:
    """All gates overlap: one cluster, and paths of many moves."""
    rng = np.random.default_rng(seed)
    places, seen = rng.uniform(0, 10, (200, 2)), rng.uniform(0, 10, (220, 2))
    cost = np.linalg.norm(places[:, None] - seen, axis=2)
    cost[cost > 6] = np.inf
    first = rng.uniform(0.2, 8, 220)
    assigned = associate(hypotheses(cost, first), 200)
    assert total(cost, first, assigned) == pytest.approx(least(cost, first), rel=1e-12)


def test_at_equal_cost_the_earlier_object_gets_the_earlier_measurement() -> None:
    """The order of objects and measurements settles ties, also along chains."""
    none = UNASSIGNED
    for cost, wanted in (
        ([[1, 1, 1]], [0]),
        ([[1], [1], [1]], [0, none, none]),
        ([[1, 1], [1, 1]], [0, 1]),
        ([[1, 1, 9], [1, 1, 9], [1, 1, 9]], [0, 1, none]),
        ([[1, 2], [2, 3]], [0, 1]),  # the other way round costs as much
        ([[2, 1], [9, 1]], [0, 1]),  # a later object takes the cheaper total
        ([[9, 1, 9], [9, 1, 1]], [1, 2]),
    ):
        matrix = np.array(cost, np.float64)
        assigned = associate(hypotheses(matrix, np.full(matrix.shape[1], 4.0)), len(cost))
        np.testing.assert_array_equal(assigned, wanted, err_msg=str(cost))


@given(cost=arrays(np.float64, (6, 6), elements=st.integers(-2, 2).map(float)))
@settings(deadline=None)
def test_ties_depend_on_the_matrix_alone(cost: Array) -> None:
    """Neither earlier calls nor other clusters change an assignment."""
    first = np.zeros(6)
    alone = associate(hypotheses(cost, first), 6)
    two = np.full((13, 12), np.inf)
    two[:6, :6] = cost[::-1]
    two[7:, 6:] = cost
    beside = associate(hypotheses(two, np.zeros(12)), 13)[7:]
    np.testing.assert_array_equal(np.where(beside == UNASSIGNED, UNASSIGNED, beside - 6), alone)

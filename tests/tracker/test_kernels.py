"""The kernels that loop over a frame against their plain numpy twins: sorting, neighbours, selection, bookkeeping."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import oracle_formulas as textbook
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from optipmb.association import UNASSIGNED
from optipmb.birth import birth_states, first_states, moment_match
from optipmb.calibration import SURE, calibrate_rows
from optipmb.density import whole_periods
from optipmb.extract import read_tracks, select_tracks
from optipmb.geometry import box_iou, iou_exceeds
from optipmb.hypotheses import CLUTTER, FROM_POISSON, NEWBORN
from optipmb.lightweight import update_light_weight
from optipmb.motion import predict_state
from optipmb.neighbours import NOBODY, block, empty_torus, insert
from optipmb.predict import predict_components
from optipmb.preprocess import select, sort_canonically
from optipmb.prune import NEW, select_objects
from optipmb.undetected import fill_components, select_births, select_components, select_undetected
from optipmb.update import ukf_updates

Array = NDArray[np.float64]
COMPILING = settings(deadline=None)  # the first call compiles
NOW = 10_000_000_000
PERIOD = 0.1
SEEDS = pytest.mark.parametrize("seed", range(5))


def stamps(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Stamps up to a second ago, many of them at half periods."""
    return NOW - rng.integers(0, 21, count) * 50_000_000


def periods(since: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole periods to now, with numpy."""
    return np.floor((NOW - since) * 1e-9 / PERIOD + 0.5).astype(np.int64)


def test_periods_are_counted_to_the_nearest() -> None:
    """The kernel counts as numpy does, also at half periods."""
    since = NOW - np.arange(0, 2_000_000_000, 12_345_678)
    assert [whole_periods(int(one), NOW, PERIOD) for one in since] == periods(since).tolist()


@COMPILING
@given(seed=st.integers(0, 10_000), count=st.integers(0, 70), kinds=st.integers(1, 5))
def test_the_canonical_order_is_a_lexicographic_one(seed: int, count: int, kinds: int) -> None:
    """The merge sort orders as `numpy.lexsort` by the same keys, with ties in all of them."""
    rng = np.random.default_rng(seed)
    score, yaw = rng.integers(0, kinds, count) / 4, rng.integers(0, kinds, count) - 1.0
    center, size = rng.integers(0, kinds, (count, 3)) - 0.5, rng.integers(0, kinds, (count, 3)) + 0.5
    source = rng.permutation(count)
    order = rng.permutation(count)
    sort_canonically(order, score, center, size, yaw, source)
    keys = (source, yaw, size[:, 2], size[:, 1], size[:, 0], center[:, 2], center[:, 1], center[:, 0], -score)
    np.testing.assert_array_equal(order, np.lexsort(keys))


@SEEDS
def test_only_scores_from_the_filter_on_are_chosen(seed: int) -> None:
    """What is chosen passes the score filter of its class, in canonical order; boxes far apart are all kept."""
    rng = np.random.default_rng(seed)
    score, label = rng.choice([0.2, 0.3, 0.5], 40), rng.integers(0, 2, 40)
    center = np.column_stack([np.arange(40) * 100.0, np.zeros((40, 2))])
    chosen = np.full(40, -1)
    thresholds = np.array([0.3, 0.5])
    above, kept = select(
        center,
        np.ones((40, 3)),
        np.zeros(40),
        score,
        label,
        np.arange(40),
        thresholds,
        np.array([0.1, 0.1]),
        np.arange(2),
        chosen,
    )
    wanted = np.flatnonzero(score >= thresholds[label])
    assert above == kept == wanted.size
    np.testing.assert_array_equal(chosen[:kept], wanted[np.argsort(-score[wanted], kind="stable")])


@COMPILING
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 60),
    extent=st.sampled_from([0.0, 1.0, 30.0, 1e6, 3e7]),
    size=st.sampled_from([0.0, 0.5, 3.0, 1e4]),
    share=st.floats(0, 1),
)
def test_a_search_finds_every_neighbour_once(seed: int, count: int, extent: float, size: float, share: float) -> None:
    """Whatever the extent and the size of the cells, nobody within reach is lost and nobody is met twice."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 1, (count, 2)) * extent + rng.choice([0.0, -1e6, 1e6])
    head, following, side = empty_torus(count)
    for number, (x, y) in enumerate(points):
        insert(head, following, side, number, x, y, size)
    x, y = points[0]
    met = []
    first_x, last_x, first_y, last_y = block(x, y, share * size, size)
    for i in range(first_x, last_x + 1):
        for j in range(first_y, last_y + 1):
            number = head[(i & (side - 1)) * side + (j & (side - 1))]
            while number != NOBODY:
                met.append(int(number))
                number = following[number]
    assert len(set(met)) == len(met)
    near = np.abs(points - points[0]).max(axis=1) <= share * size
    assert set(np.flatnonzero(near).tolist()) <= set(met)


@COMPILING
@given(
    a=st.tuples(st.just(0.0), st.just(0.0), st.floats(0.05, 9), st.floats(0.05, 9), st.floats(-4, 4)).map(np.array),
    b=st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(0.05, 9), st.floats(0.05, 9), st.floats(-4, 4)).map(
        np.array
    ),
    threshold=st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.9, 1.0]),
)
@example(  # they touch, and clipping leaves 1e-16 by rounding
    a=np.array([0.0, 0.0, 5.7, 2.3, -1.8]),
    b=np.array([-0.3375076506666007, -3.2071932566874595, 0.7, 3.8, -1.8]),
    threshold=0.0,
)
def test_cheap_rejections_change_no_decision(a: Array, b: Array, threshold: float) -> None:
    """Whether an overlap exceeds a threshold is what the clipped overlap itself says."""
    overlap = box_iou(a, b)
    assert iou_exceeds(a, b, threshold) == (overlap > threshold)
    assert not iou_exceeds(a, b, overlap)
    assert overlap == 0.0 or iou_exceeds(a, b, np.nextafter(overlap, 0.0))


@SEEDS
def test_components_within_their_limit_are_predicted(seed: int) -> None:
    """The rows that numpy keeps, each predicted on its own, with p_s of its class."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.5, (30, 6, 6))
    mean, covariance = rng.normal(0, 3, (30, 6)), root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(6)
    label, weight, since = rng.integers(0, 2, 30), rng.uniform(0, 1, 30), stamps(rng, 30)
    limit, survival, noise = np.array([3, 6]), np.array([0.9, 0.99]), rng.uniform(0.1, 1, (2, 6))
    tau, straight, before = np.array([np.inf, 0.5]), np.array([False, seed > 2]), NOW - 700_000_000
    kept, out, spread, carried = np.empty(30, np.int64), np.empty((30, 6)), np.empty((30, 6, 6)), np.empty(30)
    count, repaired = predict_components(
        *(mean, covariance, label, weight, since, limit, survival, 0.2, before, NOW, PERIOD, noise, tau, straight),
        *(kept, out, spread, carried),
    )
    wanted = np.flatnonzero((periods(since) - 1 <= limit[label]) | (since >= before))
    assert repaired == 0
    np.testing.assert_array_equal(kept[:count], wanted)
    np.testing.assert_array_equal(carried[:count], weight[wanted] * survival[label[wanted]])
    alone, alone_spread = np.empty(6), np.empty((6, 6))
    for k, n in enumerate(wanted):
        buffers = np.empty((6, 6)), np.empty((12, 6))
        c = label[n]
        predict_state(mean[n], covariance[n], 0.2, noise[c], tau[c], straight[c], *buffers, alone, alone_spread)
        np.testing.assert_array_equal(out[k], alone)
        np.testing.assert_array_equal(spread[k], alone_spread)


@SEEDS
def test_objects_survive_by_existence_and_misses(seed: int) -> None:
    """Known objects by the misdetection formula and both limits, then first-time detections that nobody took."""
    rng = np.random.default_rng(seed)
    n, m = 30, 20
    label, measured = rng.integers(0, 2, n), rng.integers(0, 2, m)
    r, p_d, seen = rng.uniform(1e-4, 1, n), rng.uniform(0.1, 0.9, n), stamps(rng, n)
    assigned = np.full(n, UNASSIGNED)
    assigned[rng.permutation(n)[:10]] = rng.permutation(m)[:10]
    kind, first = rng.choice([FROM_POISSON, CLUTTER, NEWBORN], m), rng.uniform(0, 0.2, m)
    max_misses, floor = np.array([4, 12]), np.array([0.05, 0.1])
    row, measurement, existence = np.empty(n + m, np.int64), np.empty(n + m, np.int64), np.empty(n + m)
    count, known, hits = select_objects(
        r,
        seen,
        label,
        p_d,
        assigned,
        kind,
        first,
        measured,
        NOW,
        PERIOD,
        max_misses,
        floor,
        row,
        measurement,
        existence,
    )
    detected = assigned != UNASSIGNED
    posterior = np.where(detected, 1.0, r * (1 - p_d) / (1 - r + r * (1 - p_d)))
    alive = detected | ((posterior >= floor[label]) & (periods(seen) <= max_misses[label]))
    free = ~np.isin(np.arange(m), assigned) & (kind != CLUTTER) & (first >= floor[measured])
    np.testing.assert_array_equal(row[:count], [*np.flatnonzero(alive), *[NEW] * free.sum()])
    np.testing.assert_array_equal(measurement[:count], [*assigned[alive], *np.flatnonzero(free)])
    np.testing.assert_array_equal(existence[:count], [*posterior[alive], *first[free]])
    assert (known, hits) == (alive.sum(), detected.sum())


@SEEDS
def test_components_survive_unless_marked_or_old(seed: int) -> None:
    """Those in no J^m (components of this very frame aside) and young enough, with weight mu (1 - p_d)."""
    rng = np.random.default_rng(seed)
    weight, p_d, label = rng.uniform(0, 2, 25), rng.uniform(0, 1, 25), rng.integers(0, 2, 25)
    born, marked = stamps(rng, 25), rng.integers(0, 25, 8)
    steps, kept, left = np.array([2, 9]), np.empty(25, np.int64), np.empty(25)
    count = select_components(weight, p_d, label, born, 15, marked, NOW, PERIOD, steps, kept, left)
    stays = (periods(born) <= steps[label]) & ~np.isin(np.arange(25), marked[marked < 15])
    np.testing.assert_array_equal(kept[:count], np.flatnonzero(stays))
    np.testing.assert_array_equal(left[:count], (weight * (1 - p_d))[stays])


@SEEDS
def test_the_light_weight_filter_is_its_formulas(seed: int) -> None:
    """Box, confidence, counters and ids of detected, missed and new objects."""
    rng = np.random.default_rng(seed)
    label, auxiliary, born = rng.integers(0, 3, 6), rng.uniform(1, 5, (6, 4)), stamps(rng, 6)
    seen, extracted, identity = stamps(rng, 6), rng.random(6) < 0.5, np.arange(10, 16)
    measured, boxes, score = rng.integers(0, 3, 5), rng.uniform(1, 5, (5, 4)), rng.uniform(0.1, 1, 5)
    row, measurement = np.array([0, 2, 3, 5, NEW, NEW]), np.array([4, -1, 1, -1, 0, 2])
    evidence, memory, missed = rng.normal(0, 2, 6), np.array([1.0, 0.5, 0.9]), np.array([0.0, 1.5, 2.5])
    score[4] = 1.0
    odds, yaw = rng.uniform(0, 2, 6), rng.uniform(-3, 3, 5)
    sign = np.array([[0.0, 0.0, 0.0, 0.0], [0.9, 1.0, 0.7, 0.5], [0.5, 2.0, 0.1, 3.0]])  # lambda, b_d, b_v, v_0
    mean, root = rng.normal(0, 3, (6, 6)), rng.normal(0, 0.5, (6, 6, 6))
    covariance = root @ root.transpose(0, 2, 1)
    states, spreads = mean.copy(), covariance.copy()
    out = [np.empty(6, np.int64), np.empty((6, 4)), *(np.empty(6, np.int64) for _ in range(3)), np.empty(6)]
    weighed, facing, flags, shown = np.empty(6), np.empty(6), np.empty(6, np.bool_), np.empty(6, np.bool_)
    confirmed = rng.random(6) < 0.5
    known = label, auxiliary, identity, born, seen, evidence, odds, extracted, confirmed
    times = NOW, NOW - 150_000_000, PERIOD, memory, missed
    given = (row, measurement, *known, 77, measured, boxes, score, yaw, *times, *sign.T.copy(), states, spreads)
    update_light_weight(*given, *out, weighed, facing, flags, shown)
    old, new = row >= 0, row == NEW
    m, hit = measurement, measurement >= 0
    np.testing.assert_array_equal(out[0], [*label[row[old]], *measured[m[new]]])
    before = np.concatenate([auxiliary[row[old]], boxes[m[new]]])
    z = score[m][:, None]
    np.testing.assert_array_equal(out[1], np.where(hit[:, None], (1 - z) * before + z * boxes[m], before))
    np.testing.assert_array_equal(out[2], [*identity[row[old]], 77, 78])
    birth = np.array([*born[row[old]], NOW, NOW])
    np.testing.assert_array_equal(out[3], birth)
    np.testing.assert_array_equal(out[4], np.where(hit, NOW, [*seen[row[old]], 0, 0]))
    confidence = (1 - np.exp(-(1 + (NOW - birth) * 1e-9 / PERIOD))) * score[m]
    np.testing.assert_allclose(out[5], np.where(hit, confidence, 0.0), rtol=1e-15)
    np.testing.assert_array_equal(flags, [*extracted[row[old]], False, False])
    np.testing.assert_array_equal(shown, [*confirmed[row[old]], False, False])
    with np.errstate(divide="ignore"):
        latest = np.where(hit, np.clip(np.log(score[m] / (1 - score[m])), -SURE, SURE), -missed[out[0]])
    kept = memory[out[0]] ** np.where(birth == NOW, 1.0, 1.5)
    np.testing.assert_allclose(weighed, kept * [*evidence[row[old]], 0, 0] + (1 - kept) * latest, rtol=1e-12)
    for k in range(6):
        z = textbook.Measurement(np.zeros(2), None, yaw[m[k]], np.ones(4), 0, score[m[k]], 0)
        followed = SimpleNamespace(
            **dict(zip(("memory", "detection", "motion", "speed"), sign[out[0][k]], strict=True))
        )
        c, before = SimpleNamespace(heading_sign=followed), odds[row[k]] if old[k] else 0.0
        wanted = before, mean[k], covariance[k]
        if hit[k]:
            wanted = textbook.follow_sign(c, before, 1.0 if birth[k] == NOW else 1.5, z, mean[k], covariance[k])
        for found, value in zip((facing[k], states[k], spreads[k]), wanted, strict=True):
            np.testing.assert_allclose(found, value, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("both", [True, False])
@SEEDS
def test_tracks_are_selected_by_two_thresholds(seed: int, *, both: bool) -> None:
    """Never extracted: from the first threshold on; known: from the second on and seen of late."""
    rng = np.random.default_rng(seed)
    r, seen, label, known = rng.uniform(0, 1, 50), stamps(rng, 50), rng.integers(0, 2, 50), rng.random(50) < 0.5
    first, second, misses = np.array([0.2, 0.4]), np.array([0.5, 0.8]), np.array([3, 8])
    flags, rows = known.copy(), np.empty(50, np.int64)
    count = select_tracks(r, seen, label, NOW, PERIOD, first, second, misses, both, flags, rows)
    again = (r >= second[label]) & (periods(seen) < misses[label])
    wanted = np.where(known & both, again, r >= first[label])
    np.testing.assert_array_equal(rows[:count], np.flatnonzero(wanted))
    np.testing.assert_array_equal(flags, known | wanted)


@pytest.mark.parametrize("calibrated", [True, False])
def test_tracks_are_read_off_the_states(*, calibrated: bool) -> None:
    """Every column of the tracks, in the units that they promise, and calibrated where there is a calibration."""
    rng = np.random.default_rng(0)
    mean, auxiliary, born, seen = rng.normal(0, 3, (9, 6)), rng.uniform(1, 5, (9, 4)), stamps(rng, 9), stamps(rng, 9)
    mean[:, 3] = [textbook.wrap(angle) for angle in mean[:, 3]]
    rows, measurement, source = np.array([1, 4, 8]), np.arange(9) % 3 - 1, np.array([50, 60])
    position, yaw = rng.normal(0, 3, (2, 2)), rng.uniform(-3, 3, 2)
    less = SimpleNamespace(position=0.1, heading=0.2)
    noise = SimpleNamespace(position=0.3, heading=0.3)
    left = [np.array([1 / (r**-2 - 0.3**-2), 0.0, 0.0, 1 / (r**-2 - 0.3**-2)]) for r in (0.1, 0.2)]
    shapes = [(3, 3), (3, 3), (3,), (3,), (3, 2), (3,), (3,), (3,), (3,)]
    out = [np.empty(shape) for shape in shapes]
    detection = np.empty(3, np.int64)
    identity, label, r, score = np.arange(9) * 3, rng.integers(0, 4, 9), rng.uniform(0, 1, 9), rng.uniform(0, 1, 9)
    root = rng.normal(0, 1, (9, 6, 6))
    covariance = root @ root.transpose(0, 2, 1)
    ids, labels, told = np.empty(3, np.int64), np.empty(3, np.int64), [np.empty(3), np.empty(3), np.empty((3, 6, 6))]
    evidence, odds, followed = rng.normal(0, 3, 9), rng.uniform(0, 3, 9), np.array([True, False, True, False])
    known = identity, label, mean, covariance, r, score, auxiliary, born, seen, evidence, odds
    bends = np.sort(rng.normal(0, 2, (4, 3)), axis=1)
    curves = bends, rng.uniform(0, 1, (4, 3)), rng.uniform(0, 1, (4, 3)), rng.uniform(0, 1, (4, 3)), np.full(4, True)
    knots = np.full(4, 3 if calibrated else 0)
    given = *known, measurement, source, position, yaw, NOW, *left, followed, knots, *curves
    high, low = np.array([0.6, 0.7, 0.8, 0.9]), np.array([0.1, 0.2, 0.3, 0.4])
    before, now = np.arange(9) % 2 == 0, np.empty(3, np.bool_)
    after = before.copy()
    read_tracks(rows, *given, high, low, after, ids, labels, *out[:7], *told, *out[7:], detection, now)
    wanted_now = told[0] >= np.where(before[rows], low[label[rows]], high[label[rows]])
    np.testing.assert_array_equal(now, wanted_now)
    np.testing.assert_array_equal(after, np.where(np.isin(np.arange(9), rows), after, before))
    np.testing.assert_array_equal(after[rows], wanted_now)
    x, spread = np.empty((3, 6)), np.empty((3, 6, 6))
    for k, n in enumerate(rows):
        m = measurement[n]
        z = None if m < 0 else textbook.Measurement(position[m], None, yaw[m], np.ones(4), 0, 0.9, 0)
        c = SimpleNamespace(reported_noise=less if left[0][label[n]] else None, measurement_noise=noise)
        x[k], spread[k] = textbook.report(c, z, mean[n], covariance[n])
    x[:, 3] = [textbook.wrap(angle) for angle in x[:, 3]]
    wanted_told = [r[rows], score[rows], spread]
    calibrate_rows(label[rows], evidence[rows], x[:, 3].copy(), knots, *curves, *wanted_told)
    facing = np.where(followed[label[rows]], 1 / (1 + np.exp(-odds[rows])), 1.0)
    wanted_told[2][:, 3, 3] += np.maximum(facing * (1 - facing) - 0.025 * 0.975, 0) * np.pi**2
    assert np.array_equal(wanted_told[0], r[rows]) != calibrated
    np.testing.assert_allclose(told[2], wanted_told[2], rtol=1e-9, atol=1e-12)
    copies = zip((ids, labels, *told[:2]), (identity[rows], label[rows], *wanted_told[:2]), strict=True)
    for copy, column in copies:
        np.testing.assert_array_equal(copy, column)
    heading = np.column_stack([np.cos(x[:, 3]), np.sin(x[:, 3])])
    wanted = [
        np.column_stack([x[:, :2], auxiliary[rows, 3]]),
        auxiliary[rows, :3],
        x[:, 3],
        facing,
        x[:, 2:3] * heading,
    ]
    wanted += [x[:, 4], x[:, 5], (NOW - born[rows]) * 1e-9, (NOW - seen[rows]) * 1e-9]
    for found, expected in zip(out, wanted, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(detection, np.append(source, -1)[measurement[rows]])


@SEEDS
def test_announced_objects_are_matched_mixtures(seed: int) -> None:
    """Each is the mixture of its updated components with weights e^j / e; newborns are births."""
    rng = np.random.default_rng(seed)
    count, pairs = 6, 20
    kind = np.array([FROM_POISSON, NEWBORN, FROM_POISSON, FROM_POISSON, CLUTTER])
    rows = np.array([0, 1, 3])
    component, announced = np.sort(rng.integers(0, count, pairs)), rng.choice([0, 2, 3], pairs)
    log_e = rng.normal(-500, 2, pairs)
    root = rng.normal(0, 0.5, (count, 6, 6))
    mean, covariance = rng.normal(0, 3, (count, 6)), root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(6)
    measured = rng.normal(0, 3, (5, 2)), rng.normal(0, 3, (5, 2)), rng.normal(0, 1, 5), np.array([0, 0, 0, 1, 0])
    noise = rng.uniform(0.1, 1, 2), rng.uniform(0.1, 1, 2), rng.uniform(0.1, 1, 2), np.array([0, 2])
    out, spread = np.full((3, 6), np.nan), np.full((3, 6, 6), np.nan)
    given = rows, kind, component, announced, log_e, mean, covariance
    births = rng.uniform(0, 2, 2), rng.uniform(0.1, 1, (2, 6)), rng.uniform(0.1, 1, (2, 6))
    assert first_states(*given, *measured, *births, *noise, out, spread) == 0
    born, born_spread = np.empty((1, 6)), np.empty((1, 6, 6))
    position, velocity, yaw, label = measured
    birth_states(rows[1:2], position, yaw, velocity, label, *births, born, born_spread)
    np.testing.assert_array_equal(out[1], born[0])
    np.testing.assert_array_equal(spread[1], born_spread[0])
    for k, m in ((0, 0), (2, 3)):
        members = np.flatnonzero(announced == m)
        parts, spreads = np.empty((members.size, 6)), np.empty((members.size, 6, 6))
        ukf_updates(component[members], announced[members], mean, covariance, *measured, *noise, parts, spreads)
        weight = np.exp(log_e[members] - log_e[members].max())
        one, one_spread = np.empty((1, 6)), np.empty((1, 6, 6))
        moment_match(np.array([0, members.size]), weight / weight.sum(), parts, spreads, one, one_spread)
        np.testing.assert_allclose(out[k], one[0], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(spread[k], one_spread[0], rtol=1e-12, atol=1e-12)


@SEEDS
def test_low_scores_are_born_with_what_association_leaves(seed: int) -> None:
    """Clutter makes components of weight mu_ab (1 - p_a), unless that is zero."""
    rng = np.random.default_rng(seed)
    kind, association = rng.choice([FROM_POISSON, CLUTTER, NEWBORN], 20), rng.choice([0.0, 0.3, 1.0], 20)
    label, rate = rng.integers(0, 2, 20), np.array([0.5, 2.0])
    rows, weight = np.empty(20, np.int64), np.empty(20)
    count = select_births(kind, association, label, rate, rows, weight)
    wanted = np.flatnonzero((kind == CLUTTER) & (association < 1))
    np.testing.assert_array_equal(rows[:count], wanted)
    np.testing.assert_array_equal(weight[:count], rate[label[wanted]] * (1 - association[wanted]))


@pytest.mark.parametrize("adaptive", [True, False])
@SEEDS
def test_what_is_undetected_stays_or_is_born(seed: int, *, adaptive: bool) -> None:
    """The components that stay and behind them, under HABM, the births, each as the kernel of its own selects them."""
    rng = np.random.default_rng(seed)
    weight, p_d, label, born = rng.uniform(0, 2, 9), rng.uniform(0, 1, 9), rng.integers(0, 2, 9), stamps(rng, 9)
    old = weight, p_d, label, born, 6, rng.integers(0, 9, 4), NOW, PERIOD, np.array([2, 9])
    kind, association = rng.choice([FROM_POISSON, CLUTTER, NEWBORN], 7), rng.choice([0.0, 0.3, 1.0], 7)
    new = kind, association, rng.integers(0, 2, 7), np.array([0.5, 2.0])
    chosen, carried = np.empty(16, np.int64), np.empty(16)
    stay, count = select_undetected(*old, adaptive, *new, chosen, carried)
    kept, left, rows, fresh = np.empty(9, np.int64), np.empty(9), np.empty(7, np.int64), np.empty(7)
    assert stay == select_components(*old, kept, left)
    assert count - stay == (select_births(*new, rows, fresh) if adaptive else 0)
    np.testing.assert_array_equal(chosen[:count], [*kept[:stay], *rows[: count - stay]])
    np.testing.assert_array_equal(carried[:count], [*left[:stay], *fresh[: count - stay]])


@SEEDS
def test_components_that_stay_and_those_that_are_born_stand_in_order(seed: int) -> None:
    """First the columns of the rows that stay, then birth, box, class and stamp of the measurements."""
    rng = np.random.default_rng(seed)
    mean, covariance, label = rng.normal(0, 1, (8, 6)), rng.normal(0, 1, (8, 6, 6)), rng.integers(0, 3, 8)
    auxiliary, born, kept, rows = rng.normal(0, 1, (8, 4)), stamps(rng, 8), np.array([1, 5]), np.array([2, 0, 3])
    measured, boxes = rng.integers(0, 3, 4), rng.normal(0, 1, (4, 4))
    out = np.zeros((5, 6)), np.zeros((5, 6, 6)), np.empty(5, np.int64), np.empty((5, 4)), np.empty(5, np.int64)
    position, yaw, velocity = rng.normal(0, 9, (4, 2)), rng.normal(0, 1, 4), rng.normal(0, 2, (4, 2))
    births = rng.uniform(0, 2, 3), rng.uniform(0.1, 1, (3, 6)), rng.uniform(0.1, 1, (3, 6))
    old = np.concatenate([kept, rows]), kept.size, mean, covariance, label, auxiliary, born
    fill_components(*old, position, yaw, velocity, measured, boxes, NOW, *births, *out)
    np.testing.assert_array_equal(out[0][:2], mean[kept])
    np.testing.assert_array_equal(out[1][:2], covariance[kept])
    state, spread = np.empty((3, 6)), np.empty((3, 6, 6))
    birth_states(rows, position, yaw, velocity, measured, *births, state, spread)
    np.testing.assert_array_equal(out[0][2:], state)
    np.testing.assert_array_equal(out[1][2:], spread)
    np.testing.assert_array_equal(out[2], [*label[kept], *measured[rows]])
    np.testing.assert_array_equal(out[3], [*auxiliary[kept], *boxes[rows]])
    np.testing.assert_array_equal(out[4], [*born[kept], NOW, NOW, NOW])

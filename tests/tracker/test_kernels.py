"""The kernels that loop over a frame against their plain numpy twins: sorting, neighbours, selection, bookkeeping."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_rows
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from read_only import read_only

from optipmb.association import NEW, UNASSIGNED, Survivors, forbid_births, surviving_objects
from optipmb.calibration import SURE, calibrate_rows
from optipmb.density import (
    OBJECT,
    BernoulliArrays,
    Bernoullis,
    Moment,
    PoissonArrays,
    Poissons,
    components_in,
    objects_in,
    whole_periods,
)
from optipmb.extract import Tracks, extract, select_tracks
from optipmb.geometry import END_OF_CHAIN, bev_iou, block, box_iou, empty_torus, insert, iou_exceeds
from optipmb.hypotheses import CLUTTER, FROM_POISSON, NEWBORN, Hypotheses
from optipmb.lightweight import light_weight_filter
from optipmb.predict import predict_density, predict_state
from optipmb.preprocess import Measurements, select, sort_canonically
from optipmb.undetected import AGED, MARKED, update_undetected, with_births
from optipmb.update import birth_states, first_detected_states, moment_match, ukf_updates

Array = NDArray[np.float64]
COMPILING = settings(deadline=None)  # the first call compiles
NOW = 10_000_000_000
PERIOD = 0.1
MOMENT = Moment(NOW, NOW - 150_000_000, 0.15, PERIOD)
SEEDS = pytest.mark.parametrize("seed", range(5))


def stamps(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Stamps up to a second ago, many of them at half periods."""
    return NOW - rng.integers(0, 21, count) * 50_000_000


def periods(since: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole periods to now, with numpy."""
    return np.floor((NOW - since) * 1e-9 / PERIOD + 0.5).astype(np.int64)


def objects_of(**columns: Any) -> Any:
    """Objects as kernels know them, of the columns that count."""
    return BernoulliArrays(**dict(Bernoullis.empty().columns()) | columns)


def components_of(**columns: Any) -> Any:
    """Poisson components, likewise."""
    return PoissonArrays(**dict(Poissons.empty().columns()) | columns)


def hypotheses_of(**columns: Any) -> Hypotheses:
    """Hypotheses, likewise."""
    index, number = np.zeros(0, np.int64), np.zeros(0)
    return Hypotheses(index, index, number, index, index, number, index, number, number, number)._replace(**columns)


def random_measurements(rng: np.random.Generator, count: int) -> Measurements:
    """Measurements of two classes, every third without a velocity."""
    velocity = rng.normal(0, 3, (count, 2))
    velocity[::3] = np.nan
    return Measurements(
        rng.normal(0, 3, (count, 2)),
        rng.uniform(-3, 3, count),
        velocity,
        rng.uniform(1, 5, (count, 4)),
        rng.uniform(0.1, 1, count),
        rng.integers(0, 2, count),
        np.arange(count),
    )


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
    sort_canonically(order, *read_only(score, center, size, yaw, source))
    keys = (source, yaw, size[:, 2], size[:, 1], size[:, 0], center[:, 2], center[:, 1], center[:, 0], -score)
    np.testing.assert_array_equal(order, np.lexsort(keys))


@SEEDS
def test_only_scores_from_the_filter_on_are_chosen(seed: int) -> None:
    """The columns of measurements above the filter of their class, in canonical order; boxes far apart are all kept."""
    rng = np.random.default_rng(seed)
    score, label = rng.choice([0.2, 0.3, 0.5], 40), rng.integers(0, 2, 40)
    center = np.column_stack([np.arange(40) * 100.0, np.zeros((40, 2))])
    thresholds = np.array([0.3, 0.5])
    classes = class_rows(2, score_filter=thresholds, nms_iou=0.1, suppressed_with=[0, 1])
    size, yaw, velocity, source = (
        rng.uniform(1, 5, (40, 3)),
        rng.normal(0, 1, 40),
        rng.normal(0, 2, (40, 2)),
        np.arange(40),
    )
    velocity[3], center[:, 2] = np.nan, rng.normal(0, 1, 40)
    given = read_only(center, size, yaw, velocity, score, label, source)
    above, chosen, columns = select(tuple(given), 2, classes, 10**6)
    wanted = np.flatnonzero(score >= thresholds[label])
    assert above == wanted.size
    np.testing.assert_array_equal(chosen, wanted[np.argsort(-score[wanted], kind="stable")])
    rows = center[:, :2], yaw, velocity, np.column_stack([size, center[:, 2]]), score, label, source
    for found, column in zip(columns, rows, strict=True):
        np.testing.assert_array_equal(found, column[chosen])


@COMPILING
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 60),
    extent=st.sampled_from([0.0, 1.0, 30.0, 1e6, 3e7]),
    size=st.sampled_from([0.0, 0.5, 3.0, 1e4]),
    share=st.floats(0, 1),
)
def test_a_search_finds_every_neighbour_once(seed: int, count: int, extent: float, size: float, share: float) -> None:
    """For any extent and cell size no point within reach is lost or met twice."""
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
            while number != END_OF_CHAIN:
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
    """The objects and components that numpy keeps, each predicted on its own, with p_s of its class; the rest stays."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.5, (30, 6, 6))
    mean, covariance = rng.normal(0, 3, (30, 6)), root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(6)
    label, weight, since = rng.integers(0, 2, 30), rng.uniform(0, 1, 30), stamps(rng, 30)
    limits, survival, noise = np.array([[3, 6], [5, 2]]), np.array([0.9, 0.99]), rng.uniform(0.1, 1, (2, 6))
    before = NOW - 700_000_000
    classes = class_rows(2, acceleration_time=[np.inf, 0.5], constant_velocity=[False, seed > 2], process_noise=noise)
    classes["max_misses"], classes["poisson_steps"] = limits
    classes["survival"] = survival
    both = {"mean": mean, "covariance": covariance, "label": label, "auxiliary": rng.uniform(1, 5, (30, 4))}
    objects = Bernoullis(
        **both,
        existence=weight,
        id=np.arange(30),
        born_ns=stamps(rng, 30),
        seen_ns=stamps(rng, 30),
        **{name: rng.normal(0, 1, 30) for name in ("score", "evidence", "heading_odds")},
        extracted=rng.random(30) < 0.5,
        confirmed=rng.random(30) < 0.5,
    )
    components = Poissons(**both, weight=weight, born_ns=since)
    given = objects.words, since, components.words, (NOW, before, 0.2, PERIOD)
    kept, *found, repaired = predict_density(*given, classes)
    assert repaired == 0
    known, undetected = Bernoullis.of(found[0]), Poissons.of(found[1])
    alone, alone_spread = np.empty(6), np.empty((6, 6))
    for old, new, probability, limit in (
        (objects, known, known.existence, limits[0]),
        (components, undetected, undetected.weight, limits[1]),
    ):
        wanted = np.flatnonzero((periods(since) - 1 <= limit[label]) | (since >= before))
        if old is objects:
            np.testing.assert_array_equal(kept, wanted)
        np.testing.assert_array_equal(probability, weight[wanted] * (survival ** (0.2 / PERIOD))[label[wanted]])
        assert len(new) == len(wanted)
        for k, n in enumerate(wanted):
            buffers = np.empty((6, 6)), np.empty((12, 6))
            predict_state(mean[n], covariance[n], 0.2, classes[label[n]], buffers, alone, alone_spread)
            np.testing.assert_array_equal(new.mean[k], alone)
            np.testing.assert_array_equal(new.covariance[k], alone_spread)
        for name, column in new.columns():
            if name not in {"mean", "covariance", "existence", "weight"}:
                np.testing.assert_array_equal(column, getattr(old, name)[wanted])


@SEEDS
def test_objects_survive_by_existence_and_misses(seed: int) -> None:
    """Known objects by the misdetection formula and both limits, then free first-time detections."""
    rng = np.random.default_rng(seed)
    n, m = 30, 20
    label, measured = rng.integers(0, 2, n), rng.integers(0, 2, m)
    r, p_d, seen = rng.uniform(1e-4, 1, n), rng.uniform(0.1, 0.9, n), stamps(rng, n)
    assigned = np.full(n, UNASSIGNED)
    assigned[rng.permutation(n)[:10]] = rng.permutation(m)[:10]
    kind, first = rng.choice([FROM_POISSON, CLUTTER, NEWBORN], m), rng.uniform(0, 0.2, m)
    max_misses, floor = np.array([4, 12]), np.array([0.05, 0.1])
    objects = objects_of(existence=r, label=label)
    hypotheses = hypotheses_of(first_kind=kind, first_existence=first)
    classes = class_rows(2, max_misses=max_misses, min_existence=floor)
    row, measurement, existence, known, hits = surviving_objects(
        objects, p_d, assigned, hypotheses, measured, seen, MOMENT, classes
    )
    detected = assigned != UNASSIGNED
    posterior = np.where(detected, 1.0, r * (1 - p_d) / (1 - r + r * (1 - p_d)))
    alive = detected | ((posterior >= floor[label]) & (periods(seen) <= max_misses[label]))
    free = ~np.isin(np.arange(m), assigned) & (kind != CLUTTER) & (first >= floor[measured])
    np.testing.assert_array_equal(row, [*np.flatnonzero(alive), *[NEW] * free.sum()])
    np.testing.assert_array_equal(measurement, [*assigned[alive], *np.flatnonzero(free)])
    np.testing.assert_array_equal(existence, [*posterior[alive], *first[free]])
    assert (known, hits) == (alive.sum(), detected.sum())


@SEEDS
def test_births_are_forbidden_as_set_logic_says(seed: int) -> None:
    """A free detection is clutter if its box overlaps a gated, extracted, missed object.

    It was detected a period ago at most, or is at least ten old and has missed fewer periods than its class says.
    """
    rng = np.random.default_rng(seed)
    n, m = 60, 20
    label, extracted, seen = rng.integers(0, 2, n), rng.random(n) < 0.7, NOW - rng.integers(0, 12, n) * 50_000_000
    born, misses = NOW - rng.integers(15, 25, n) * 50_000_000, np.array([rng.integers(2, 6), 5])
    mean, auxiliary = rng.normal(0, 2, (n, 6)), rng.uniform(1, 5, (n, 4))
    assigned = np.where(rng.random(n) < 0.3, rng.integers(0, m // 2, n), UNASSIGNED)
    z = random_measurements(rng, m)
    row, measurement = np.nonzero(rng.random((n, m)) < 0.5)
    kind, first = rng.choice([FROM_POISSON, CLUTTER, NEWBORN], m), rng.uniform(0.1, 1, m)
    known = np.tile(np.eye(6), (n, 1, 1))  # headings
    objects = objects_of(
        label=label, extracted=extracted, mean=mean, covariance=known, auxiliary=auxiliary, born_ns=born
    )
    limit = np.array([0.1, 1.0])
    overlap = bev_iou(
        np.column_stack([mean[:, :2], auxiliary[:, :2], mean[:, 3]]),
        np.column_stack([z.position, z.auxiliary[:, :2], z.yaw]),
    )
    longest = np.where(periods(born) >= 10, np.maximum(misses[label] - 1, 1), 1)
    active = (assigned == UNASSIGNED) & extracted & (periods(seen) <= longest)
    taken = active[row] & (overlap[row, measurement] > limit[label[row]])
    forbidden = np.isin(np.arange(m), measurement[taken]) & ~np.isin(np.arange(m), assigned)
    assert 0 < forbidden.sum() < m
    hypotheses = hypotheses_of(row=row, measurement=measurement, first_kind=kind.copy(), first_existence=first.copy())
    classes = class_rows(2, birth_overlap=limit, extract_misses=misses)
    forbid_births(objects, assigned, hypotheses, z, seen, MOMENT, classes)
    np.testing.assert_array_equal(hypotheses.first_kind, np.where(forbidden, CLUTTER, kind))
    forgotten = forbidden & (kind != CLUTTER)
    np.testing.assert_array_equal(hypotheses.first_existence, np.where(forgotten, 0.0, first))


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
    after = objects_in(np.zeros(6 * OBJECT))
    states, spreads = after.mean, after.covariance
    states[:], spreads[:] = mean, covariance
    confirmed = rng.random(6) < 0.5
    objects = objects_of(
        label=label,
        auxiliary=auxiliary,
        id=identity,
        born_ns=born,
        seen_ns=seen,
        evidence=evidence,
        heading_odds=odds,
        extracted=extracted,
        confirmed=confirmed,
    )
    measurements = random_measurements(rng, 5)._replace(label=measured, auxiliary=boxes, score=score, yaw=yaw)
    classes = class_rows(3, memory=memory, missed_evidence=missed)
    for column, name in zip(sign.T, ("memory", "detection", "motion", "speed"), strict=True):
        classes[f"sign_{name}"] = column
    survivors = Survivors(row, measurement, rng.uniform(0, 1, 6), 4, 2)
    new = row == NEW
    after.label[:] = np.where(new, measured[measurement], label[row])
    light_weight_filter(survivors, after, objects, 77, measurements, MOMENT, classes)
    existence, *out, weighed, facing, flags, shown = after[2:]
    np.testing.assert_array_equal(existence, survivors.existence)
    old = row >= 0
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
    np.testing.assert_array_equal([flags, shown], [[*one[row[old]], False, False] for one in (extracted, confirmed)])
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
    flags = known.copy()
    classes = class_rows(2, extract_new=first, extract_known=second, extract_misses=misses)
    rows = select_tracks(objects_of(existence=r, label=label, extracted=flags), seen, MOMENT, both, classes)
    again = (r >= second[label]) & (periods(seen) < misses[label])
    wanted = np.where(known & both, again, r >= first[label])
    np.testing.assert_array_equal(rows, np.flatnonzero(wanted))
    np.testing.assert_array_equal(flags, known | wanted)


@pytest.mark.parametrize("calibrated", [True, False])
def test_tracks_are_read_off_the_states(*, calibrated: bool) -> None:
    """Every column of the tracks, in the units that they promise, and calibrated where there is a calibration."""
    rng = np.random.default_rng(0)
    mean, auxiliary, born, seen = rng.normal(0, 3, (9, 6)), rng.uniform(1, 5, (9, 4)), stamps(rng, 9), stamps(rng, 9)
    mean[:, 3] = [textbook.wrap(angle) for angle in mean[:, 3]]
    rows, measurement = np.array([1, 4, 8]), np.arange(9) % 3 - 1
    measured = random_measurements(rng, 2)._replace(source=np.array([50, 60]))
    position, yaw, source = measured.position, measured.yaw, measured.source
    less = SimpleNamespace(position=0.1, heading=0.2)
    noise = SimpleNamespace(position=0.3, heading=0.3)
    left = [np.array([1 / (r**-2 - 0.3**-2), 0.0, 0.0, 1 / (r**-2 - 0.3**-2)]) for r in (0.1, 0.2)]
    identity, label, r, score = np.arange(9) * 3, rng.integers(0, 4, 9), rng.uniform(0, 1, 9), rng.uniform(0, 1, 9)
    root = rng.normal(0, 1, (9, 6, 6))
    covariance = root @ root.transpose(0, 2, 1)
    evidence, odds, followed = rng.normal(0, 3, 9), rng.uniform(0, 3, 9), np.array([True, False, True, False])
    high, low = np.array([0.6, 0.7, 0.8, 0.9]), np.array([0.1, 0.2, 0.3, 0.4])
    classes = class_rows(4, sign_known=followed, score_of_evidence=1.0, confirm_from=high, confirm_until=low)
    classes["reported_position"], classes["reported_heading"] = left
    classes["knots"] = 3 if calibrated else 0
    classes["knot_evidence"][:, :3] = np.sort(rng.normal(0, 2, (4, 3)), axis=1)
    for name in ("existence", "along", "across"):
        classes[f"knot_{name}"][:, :3] = rng.uniform(0, 1, (4, 3))
    classes["extract_new"] = 2.0  # tracks extracted before are again, and no others
    classes["extract_misses"] = 1000
    before, extracted = np.arange(9) % 2 == 0, np.isin(np.arange(9), rows)
    columns = mean, covariance, r, label, auxiliary, identity, born, seen, score, evidence, odds, extracted, before
    objects = Bernoullis(**dict(zip(Bernoullis.described, columns, strict=True)))
    words = extract(objects.words, seen, measurement, tuple(measured), tuple(MOMENT), True, classes)
    (ids, labels, center, size, heading_, facing_, velocity, rate, acceleration, *told, age, since, detection, now) = (
        column for _, column in Tracks.of(words).columns()
    )
    out = center, size, heading_, facing_, velocity, rate, acceleration, age, since
    wanted_now = told[0] >= np.where(before[rows], low[label[rows]], high[label[rows]])
    np.testing.assert_array_equal([now, objects.confirmed[rows]], [wanted_now, wanted_now])
    np.testing.assert_array_equal(np.delete(objects.confirmed, rows), np.delete(before, rows))
    x, spread = np.empty((3, 6)), np.empty((3, 6, 6))
    for k, n in enumerate(rows):
        m = measurement[n]
        z = None if m < 0 else textbook.Measurement(position[m], None, yaw[m], np.ones(4), 0, 0.9, 0)
        c = SimpleNamespace(reported_noise=less if left[0][label[n]] else None, measurement_noise=noise)
        x[k], spread[k] = textbook.report(c, z, mean[n], covariance[n])
    x[:, 3] = [textbook.wrap(angle) for angle in x[:, 3]]
    heading = np.column_stack([np.cos(x[:, 3]), np.sin(x[:, 3])])
    wanted_told = [r[rows], score[rows], x[:, 2:3] * heading, spread]
    calibrate_rows(label[rows], evidence[rows], x[:, 3].copy(), classes, *wanted_told)
    facing = np.where(followed[label[rows]], 1 / (1 + np.exp(-odds[rows])), 1.0)
    spread[:, 3, 3] += np.maximum(facing * (1 - facing) - 0.025 * 0.975, 0) * np.pi**2
    assert np.array_equal(wanted_told[0], r[rows]) != calibrated
    np.testing.assert_allclose(told[2], spread, rtol=1e-9, atol=1e-12)
    copies = zip((ids, labels, *told[:2]), (identity[rows], label[rows], *wanted_told[:2]), strict=True)
    for copy, column in copies:
        np.testing.assert_array_equal(copy, column)
    wanted = [
        np.column_stack([x[:, :2], auxiliary[rows, 3]]),
        auxiliary[rows, :3],
        x[:, 3],
        facing,
        wanted_told[2],
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
    measured = random_measurements(rng, 5)._replace(label=np.array([0, 0, 0, 1, 0]))
    classes = class_rows(2, birth_heading_speed=rng.uniform(0, 2, 2))
    for name in ("noise_position", "noise_velocity", "noise_heading", "birth_known", "birth_unknown"):
        classes[name] = rng.uniform(0.1, 1, classes[name].shape)
    out, spread = np.full((3, 6), np.nan), np.full((3, 6, 6), np.nan)
    hypotheses = hypotheses_of(first_kind=kind, component=component, announced=announced, log_e=log_e)
    components = components_of(mean=mean, covariance=covariance)
    assert first_detected_states(rows, hypotheses, components, measured, classes, out, spread) == 0
    born, born_spread = np.empty((1, 6)), np.empty((1, 6, 6))
    birth_states(rows[1:2], measured, classes, born, born_spread)
    np.testing.assert_array_equal(out[1], born[0])
    np.testing.assert_array_equal(spread[1], born_spread[0])
    for k, m in ((0, 0), (2, 3)):
        members = np.flatnonzero(announced == m)
        parts, spreads = np.empty((members.size, 6)), np.empty((members.size, 6, 6))
        ukf_updates(component[members], announced[members], mean, covariance, measured, classes, parts, spreads)
        one, one_spread = np.empty(6), np.empty((6, 6))
        moment_match(log_e[members], parts, spreads, one, one_spread)
        np.testing.assert_array_equal(out[k], one)
        np.testing.assert_array_equal(spread[k], one_spread)


@pytest.mark.parametrize("adaptive", [True, False])
@SEEDS
def test_what_is_undetected_stays_or_is_born(seed: int, *, adaptive: bool) -> None:
    """Components in no J^m and young enough, weight mu (1 - p_d); with HABM clutter too, weight mu_ab (1 - p_a).

    Scores below the threshold announce nothing and mark no component; the fates say where each went.
    """
    rng = np.random.default_rng(seed)
    weight, p_d, label, born = rng.uniform(0, 2, 25), rng.uniform(0, 1, 25), rng.integers(0, 2, 25), stamps(rng, 25)
    components = components_of(
        mean=rng.normal(0, 1, (25, 6)),
        covariance=rng.normal(0, 1, (25, 6, 6)),
        weight=weight,
        label=label,
        auxiliary=rng.normal(0, 1, (25, 4)),
        born_ns=born,
    )
    marked, kind = rng.integers(0, 25, 8), rng.choice([FROM_POISSON, CLUTTER, NEWBORN], 20)
    association, measured = rng.choice([0.0, 0.3, 1.0], 20), random_measurements(rng, 20)
    announced, least, predicted = rng.integers(0, 20, 8), np.array([0.0, 0.4]), 25 if adaptive else 15
    hypotheses = hypotheses_of(component=marked, announced=announced, first_kind=kind, association=association)
    steps, rate = np.array([2, 9]), np.array([0.5, 2.0])
    births = rng.uniform(0, 2, 2), rng.uniform(0.1, 1, (2, 6)), rng.uniform(0.1, 1, (2, 6))
    classes = class_rows(2, poisson_steps=steps, adaptive_birth_rate=rate, announce_score=least)
    classes["birth_heading_speed"], classes["birth_known"], classes["birth_unknown"] = births
    found, fate = update_undetected(components, p_d, predicted, hypotheses, measured, MOMENT, classes)
    high = measured.score >= least[measured.label]
    used = np.isin(np.arange(25), marked[(marked < predicted) & high[announced]])
    stays = np.flatnonzero((periods(born) <= steps[label]) & ~used)
    new = np.flatnonzero((kind == CLUTTER) & (association < 1) & high & adaptive)
    carried = [*(weight * (1 - p_d))[stays], *rate[measured.label[new]] * (1 - association[new])]
    wanted = with_births(components, stays, new, np.array(carried), measured, NOW, classes)
    np.testing.assert_array_equal(found, wanted)
    rows = np.where(np.r_[used, np.zeros(20, bool)], MARKED, AGED)
    rows[np.r_[stays, 25 + new]] = np.arange(len(carried))
    np.testing.assert_array_equal(fate, rows)


@SEEDS
def test_components_that_stay_and_those_that_are_born_stand_in_order(seed: int) -> None:
    """First the columns of the rows that stay, then birth, box, class and stamp of the measurements."""
    rng = np.random.default_rng(seed)
    components = components_of(
        mean=rng.normal(0, 1, (8, 6)),
        covariance=rng.normal(0, 1, (8, 6, 6)),
        label=rng.integers(0, 2, 8),
        auxiliary=rng.normal(0, 1, (8, 4)),
        born_ns=stamps(rng, 8),
    )
    kept, rows, weight = np.array([1, 5]), np.array([2, 0, 3]), rng.uniform(0, 1, 5)
    measured = random_measurements(rng, 4)
    classes = class_rows(2, birth_heading_speed=[0.5, 1.5], birth_known=[[0.5], [0.6]], birth_unknown=[[0.7], [0.8]])
    out = components_in(with_births(components, kept, rows, weight, measured, NOW, classes))
    np.testing.assert_array_equal(out[0][:2], components.mean[kept])
    np.testing.assert_array_equal(out[1][:2], components.covariance[kept])
    state, spread = np.empty((3, 6)), np.empty((3, 6, 6))
    birth_states(rows, measured, classes, state, spread)
    np.testing.assert_array_equal(out[0][2:], state)
    np.testing.assert_array_equal(out[1][2:], spread)
    np.testing.assert_array_equal(out[2], weight)
    np.testing.assert_array_equal(out[3], [*components.label[kept], *measured.label[rows]])
    np.testing.assert_array_equal(out[4], [*components.auxiliary[kept], *measured.auxiliary[rows]])
    np.testing.assert_array_equal(out[5], [*components.born_ns[kept], NOW, NOW, NOW])

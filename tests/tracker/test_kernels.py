"""Kernels at values that no scene of the oracle has: ties, places far away, boxes that touch."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from read_only import read_only

from optipmb.filter.geometry import END_OF_CHAIN, block, box_iou, empty_torus, insert, iou_exceeds
from optipmb.filter.preprocess import sort_canonically

Array = NDArray[np.float64]
COMPILING = settings(deadline=None)  # the first call compiles


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

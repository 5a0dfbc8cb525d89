"""The exact overlap of boxes against slow references."""

import numpy as np
import pytest
from boxes import points_in_box
from hypothesis import given
from hypothesis import strategies as st
from optipmb_tools.evaluation.overlap import intersection_area, iou_3d
from optipmb_tools.geometry import Floats

Boxes = tuple[Floats, Floats, Floats]


def box(x: float, y: float, length: float, width: float, yaw: float, z: float = 0.0, height: float = 1.0) -> Boxes:
    return np.array([[x, y, z]]), np.array([[length, width, height]]), np.array([yaw])


def draw(rng: np.random.Generator, count: int) -> Boxes:
    return rng.uniform(-2, 2, (count, 3)), rng.uniform(0.3, 5, (count, 3)), rng.uniform(-np.pi, np.pi, count)


def test_known_overlaps() -> None:
    """Apart, touching, half, a quarter turn, one in the other, and the octagon of a square turned by 45 degrees."""
    unit = box(0, 0, 2, 2, 0)
    cases = [
        (box(5, 0, 2, 2, 0.3), 0.0),
        (box(2, 0, 2, 2, 0), 0.0),
        (box(1, 0, 2, 2, 0), 2.0),
        (box(0, 0, 6, 1, 0.5 * np.pi), 2.0),
        (box(0.2, 0.1, 1, 0.5, 1.0), 0.5),
        (box(0, 0, 2, 2, 0.25 * np.pi), 8.0 * (np.sqrt(2.0) - 1.0)),
    ]
    for other, area in cases:
        assert intersection_area(unit, other)[0] == pytest.approx(area, abs=1e-12)
        assert intersection_area(other, unit)[0] == pytest.approx(area, abs=1e-12)


@given(st.integers(0, 2**32))
def test_a_box_overlaps_itself_wholly(seed: int) -> None:
    """Equal boxes, and a box turned round, have an intersection over union of 1."""
    boxes = draw(np.random.default_rng(seed), 20)
    turned = (boxes[0], boxes[1], boxes[2] + np.pi)
    np.testing.assert_allclose(iou_3d(boxes, boxes), 1.0, atol=1e-12)
    np.testing.assert_allclose(iou_3d(boxes, turned), 1.0, atol=1e-9)


@given(st.integers(0, 2**32))
def test_overlap_is_symmetric_and_within_bounds(seed: int) -> None:
    """The order of the two makes no difference, and no overlap is larger than the smaller box."""
    rng = np.random.default_rng(seed)
    first, second = draw(rng, 50), draw(rng, 50)
    area = intersection_area(first, second)
    np.testing.assert_allclose(area, intersection_area(second, first), atol=1e-9)
    smaller = np.minimum(first[1][:, 0] * first[1][:, 1], second[1][:, 0] * second[1][:, 1])
    assert ((area >= 0.0) & (area <= smaller + 1e-9)).all()


def test_overlap_agrees_with_counted_points() -> None:
    """The share of a fine grid that lies in both boxes gives the same volume to two hundredths."""
    rng = np.random.default_rng(5)
    first, second = draw(rng, 30), draw(rng, 30)
    exact = iou_3d(first, second)
    assert (exact > 0.02).sum() > 10
    for i in range(30):
        low = first[0][i] - 0.5 * np.linalg.norm(first[1][i])
        high = first[0][i] + 0.5 * np.linalg.norm(first[1][i])
        points = rng.uniform(low, high, (40_000, 3))
        inside = [points_in_box(points, b[0][i], b[1][i], float(b[2][i])) for b in (first, second)]
        common = (inside[0] & inside[1]).mean() * np.prod(high - low)
        union = np.prod(first[1][i]) + np.prod(second[1][i]) - common
        assert common / union == pytest.approx(exact[i], abs=0.02)


def test_boxes_one_above_the_other_do_not_overlap() -> None:
    """In three dimensions the heights count: half of the height in common, and none."""
    assert iou_3d(box(0, 0, 2, 2, 0), box(0, 0, 2, 2, 0, z=0.5))[0] == pytest.approx(1 / 3)
    assert iou_3d(box(0, 0, 2, 2, 0), box(0, 0, 2, 2, 0, z=1.5))[0] == 0.0


def test_no_pairs_are_no_overlaps() -> None:
    """Empty columns give an empty column."""
    nothing = (np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert iou_3d(nothing, nothing).shape == (0,)

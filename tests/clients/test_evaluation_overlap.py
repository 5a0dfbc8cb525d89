"""The exact overlap of boxes equals the tracker's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optipmb_tools.evaluation.overlap import iou_3d
from optipmb_tools.geometry import Floats

import optipmb

Boxes = tuple[Floats, Floats, Floats]


def box(x: float, y: float, length: float, width: float, yaw: float, z: float = 0.0, height: float = 1.0) -> Boxes:
    return np.array([[x, y, z]]), np.array([[length, width, height]]), np.array([yaw])


def draw(rng: np.random.Generator, count: int) -> Boxes:
    return rng.uniform(-2, 2, (count, 3)), rng.uniform(0.3, 5, (count, 3)), rng.uniform(-np.pi, np.pi, count)


@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.5 * np.pi, np.pi]))
def test_the_overlap_in_the_plane_is_that_of_the_tracker(seed: int, turn: float) -> None:
    """Boxes at random places, with common sides, one inside the other, and turned."""
    rng = np.random.default_rng(seed)
    first, second = draw(rng, 50), draw(rng, 50)
    center, size, yaw = (one.copy() for one in second)
    center[:25], yaw[:25] = first[0][:25], first[2][:25] + turn
    size[:10] = first[1][:10]
    level = (np.zeros(50), np.ones(50))
    for boxes in (first, (center, size, yaw)):
        boxes[0][:, 2], boxes[1][:, 2] = level
    flat = [np.column_stack((one[0][:, :2], one[1][:, :2], one[2])) for one in (first, (center, size, yaw))]
    expected = optipmb.bev_iou(*flat).diagonal()
    np.testing.assert_allclose(iou_3d(first, (center, size, yaw)), expected, atol=1e-9)


def test_boxes_one_above_the_other_do_not_overlap() -> None:
    """In three dimensions the heights count: half of the height in common, and none."""
    assert iou_3d(box(0, 0, 2, 2, 0), box(0, 0, 2, 2, 0, z=0.5))[0] == pytest.approx(1 / 3)
    assert iou_3d(box(0, 0, 2, 2, 0), box(0, 0, 2, 2, 0, z=1.5))[0] == 0.0


def test_no_pairs_are_no_overlaps() -> None:
    """Empty columns give an empty column."""
    nothing = (np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert iou_3d(nothing, nothing).shape == (0,)

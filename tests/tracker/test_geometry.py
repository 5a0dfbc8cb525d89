"""Overlap of boxes, suppression and points in boxes against naive geometry."""

from __future__ import annotations

import math

import numpy as np
import oracle_formulas as textbook
import pytest
from class_rows import class_rows
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import optipmb
from optipmb.filter.detection_probability import CELLS, NOWHERE, SIDE, boxes_in_sensor, boxes_of_cells, cells_of_points
from optipmb.filter.hypotheses import UNLIMITED
from optipmb.filter.preprocess import SAME_PLACE, non_maximum_suppression

Array = NDArray[np.float64]
COMPILING = settings(deadline=None)  # the first call compiles
LENGTHS = st.floats(0.05, 20)
ANGLES = st.one_of(st.floats(-7, 7), st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 2, math.pi / 4]))
PLACES = st.one_of(st.floats(-15, 15), st.sampled_from([0.0, 1.0, 2.0]))
BOXES = st.tuples(PLACES, PLACES, LENGTHS, LENGTHS, ANGLES).map(np.array)


def overlap(a: Array, b: Array) -> float:
    """IoU of two boxes by the product."""
    return float(optipmb.bev_iou(a[None], b[None])[0, 0])


@COMPILING
@given(a=BOXES, b=BOXES)
@example(a=np.array([0, 0, 4, 2, 0.0]), b=np.array([0, 0, 4, 2, 0.0]))  # the same box
@example(a=np.array([0, 0, 4, 2, 0.3]), b=np.array([0, 0, 2, 1, 0.3]))  # one inside the other
@example(a=np.array([0, 0, 2, 2, 0.0]), b=np.array([2, 0, 2, 2, 0.0]))  # a common edge
@example(a=np.array([0, 0, 2, 2, 0.0]), b=np.array([2, 2, 2, 2, 0.0]))  # a common corner
@example(a=np.array([0, 0, 8, 1, 0.0]), b=np.array([0, 0, 8, 1, math.pi / 2]))  # a cross
@example(a=np.array([0, 0, 2, 2, 0.0]), b=np.array([0, 0, 2, 2, math.pi / 4]))  # an octagon
def test_iou_is_that_of_clipped_polygons(a: Array, b: Array) -> None:
    """Every overlap equals the Sutherland-Hodgman polygon's, and stays in [0, 1]."""
    found = overlap(a, b)
    assert 0.0 <= found <= 1.0 + 1e-12
    assert found == pytest.approx(textbook.iou(a, b), abs=1e-9)


@COMPILING
@given(a=BOXES, b=BOXES, angle=ANGLES, shift=st.tuples(PLACES, PLACES))
def test_iou_is_symmetric_and_moves_with_the_world(
    a: Array, b: Array, angle: float, shift: tuple[float, float]
) -> None:
    """Swapping the boxes, turning a box by pi, or moving both leaves the overlap."""

    def moved(box: Array) -> Array:
        c, s = math.cos(angle), math.sin(angle)
        x, y = c * box[0] - s * box[1] + shift[0], s * box[0] + c * box[1] + shift[1]
        return np.array([x, y, box[2], box[3], box[4] + angle])

    found = overlap(a, b)
    assert overlap(b, a) == pytest.approx(found, abs=1e-9)
    assert overlap(a, b + np.array([0, 0, 0, 0, math.pi])) == pytest.approx(found, abs=1e-9)
    assert overlap(moved(a), moved(b)) == pytest.approx(found, abs=1e-9)


@pytest.mark.parametrize("group", [[0, 1, 2], [0, 1, 0]])
@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_suppression_is_the_greedy_one_per_group(seed: int, *, mixed: bool, group: list[int]) -> None:
    """A box goes when a better KEPT one of its group overlaps it by more than its class, scores and sizes allow."""
    rng = np.random.default_rng(seed)
    boxes = rng.uniform([0, 0, 1, 1, -3], [12, 12, 5, 2, 3], (60, 5))
    if mixed:  # specks next to giants, many at the same x
        boxes[:, 0] = np.round(boxes[:, 0])
        boxes[:, 2:4] = 10 ** rng.uniform(-0.5, 1.2, (60, 2))
    label, score = rng.integers(0, 3, 60), np.sort(rng.uniform(0.5, 1.0, 60))[::-1].copy()
    points = rng.random(60) < 0.5
    thresholds, sure = np.array([0.0, 0.1, 0.5]), np.array([0.2, 0.0, 0.6])
    standing: list[int] = []
    wanted: list[int] = []
    for i in range(60):
        c = label[i]
        rivals = [k for k in standing if group[label[k]] == group[c]]
        overlap = {k: textbook.iou(boxes[i], boxes[k]) for k in rivals}
        limit = {k: max(thresholds[c], sure[c]) for k in rivals}
        if sure[c] > thresholds[c]:
            both = [k for k in rivals if points[i] and points[k] and score[i] * score[k] >= 0.64]
            limit |= {k: max(sure[c], SAME_PLACE) for k in both}
        if any(overlap[k] > limit[k] for k in rivals):
            continue
        standing.append(i)
        if all(overlap[k] <= thresholds[c] or score[i] * score[k] >= 0.64 for k in rivals if k in wanted):
            wanted.append(i)
    classes = class_rows(3, nms_iou=thresholds, sure_nms_iou=sure, suppressed_with=group)
    found = non_maximum_suppression(boxes, score, label, points, classes, UNLIMITED)
    np.testing.assert_array_equal(np.flatnonzero(found), wanted)
    assert 0 < len(wanted) < 60


def random_pose(rng: np.random.Generator, *, far: float = 20.0) -> optipmb.Pose:
    """Any rotation of the sensor, upside down included."""
    quaternion = rng.normal(size=4)
    return optipmb.Pose(translation=rng.normal(0, far, 3), quaternion=quaternion / np.linalg.norm(quaternion))


def naive_counts(cloud: optipmb.PointCloud, center: Array, size: Array, yaw: Array) -> list[int]:
    """Every point against every box, in the world frame."""
    world = cloud.xyz.astype(np.float64) @ cloud.pose.rotation.T + cloud.pose.translation
    return [
        textbook.count_inside(world, c[:2], phi, np.array([*s, c[2]]))
        for c, s, phi in zip(center, size, yaw, strict=True)
    ]


@pytest.mark.parametrize("boxes", [1, 3, 200])
@pytest.mark.parametrize("seed", range(3))
def test_points_in_boxes_counts_every_point(seed: int, boxes: int) -> None:
    """Counts equal the naive ones for any pose of the sensor and any heap of boxes."""
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    center, size = rng.uniform(-20, 20, (boxes, 3)), rng.uniform(0.3, 8, (boxes, 3))
    yaw = rng.uniform(-7, 7, boxes)
    world = np.concatenate([rng.uniform(-30, 30, (2000, 3)), center[rng.integers(boxes, size=500)]])
    world[2000:] += rng.normal(0, 1, (500, 3))
    cloud = optipmb.PointCloud(((world - pose.translation) @ pose.rotation).astype(np.float32), pose)
    found = optipmb.points_in_boxes(cloud, center, size, yaw)
    np.testing.assert_array_equal(found, naive_counts(cloud, center, size, yaw))
    assert found.sum() > 0


@pytest.mark.parametrize(
    "quaternion", [[1, 0, 0, 0], [0, 0, 0, 1], [0, 1, 0, 0], [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]]
)
def test_faces_edges_and_corners_belong_to_the_box(quaternion: list[float]) -> None:
    """The 27 points of a box's corners, edge middles, face middles and centre are inside; the next float is not."""
    pose = optipmb.Pose(translation=np.zeros(3), quaternion=np.array(quaternion, dtype=np.float64))
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    sensor = np.round(grid @ pose.rotation).astype(np.float32)
    arguments = np.zeros((1, 3)), np.full((1, 3), 2.0 + 1e-12), np.zeros(1)
    assert optipmb.points_in_boxes(optipmb.PointCloud(sensor, pose), *arguments)[0] == 27
    outside = sensor * np.float32(1 + 1e-6)
    assert optipmb.points_in_boxes(optipmb.PointCloud(outside, pose), *arguments)[0] == 1


def test_points_that_are_not_finite_are_in_no_box() -> None:
    """NaN and infinite points, as drivers send for missing returns, are passed over."""
    pose = optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0]))
    rows = [[np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, -np.inf, 0], [0, 0, np.inf], [0, 0, 0]]
    cloud = optipmb.PointCloud(np.array(rows, np.float32), pose)
    assert optipmb.points_in_boxes(cloud, np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))[0] == 1


@pytest.mark.parametrize("seed", range(3))
def test_points_at_the_faces_of_boxes_fall_into_their_cells(seed: int) -> None:
    """Each point has the cell that plain numpy computes, a cell of the box on whose face it lies, to the last bit."""
    rng = np.random.default_rng(seed)
    center, half = rng.normal(0, 10.0 ** rng.uniform(-1, 3), (50, 3)), 10.0 ** rng.uniform(-3, 1, (50, 3))
    _, low, high = boxes_in_sensor(center, half, np.zeros(50), np.eye(3))
    grid = [(np.float32(low[:, s].min()), np.float32(CELLS / np.ptp(np.r_[low[:, s], high[:, s]]))) for s in range(2)]
    heights = np.float32(low[:, 2].min()), np.float32(high[:, 2].max())
    boxes, start, occupied = boxes_of_cells(low, high, *grid)
    signs = rng.integers(-1, 2, (50, 3))
    points = np.concatenate([(center + signs * half).astype(np.float32), rng.normal(0, 2e3, (500, 3))])
    points = np.concatenate([points, np.full((1, 3), np.nan)]).astype(np.float32)
    found = np.empty(len(points), np.uint32)
    cells_of_points(points.reshape(-1), *grid, heights, found)
    with np.errstate(invalid="ignore"):
        place = [(points[:, s] - origin) * per_metre + np.float32(1.0) for s, (origin, per_metre) in enumerate(grid)]
    columns = [np.clip(np.nan_to_num(one), 0, CELLS + 1).astype(np.int32) for one in place]
    outside = ~((points[:, 2] >= heights[0]) & (points[:, 2] <= heights[1]))
    np.testing.assert_array_equal(found, np.where(outside, NOWHERE, columns[0] * SIDE + columns[1]))
    for n, cell in enumerate(found[:50]):
        assert n in boxes[start[cell] : start[cell + 1]]
        assert occupied[cell]
    assert not occupied[NOWHERE]


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), spread=st.sampled_from([0.0, 1.0, 1e3, 1e5]))
def test_points_in_boxes_holds_far_from_the_origin(seed: int, spread: float) -> None:
    """Boxes and sensor may stand at map coordinates; a box may be a speck among giants."""
    rng = np.random.default_rng(seed)
    pose = random_pose(rng, far=spread)
    count = int(rng.integers(1, 6))
    center = pose.translation + rng.normal(0, 5, (count, 3))
    size = 10 ** rng.uniform(-2, 2, (count, 3))
    yaw = rng.uniform(-3, 3, count)
    points = rng.normal(0, 5, (300, 3)).astype(np.float32)
    cloud = optipmb.PointCloud(points, pose)
    world = points.astype(np.float64) @ pose.rotation.T + pose.translation
    # A point within rounding of a face may fall on either side.
    for i in range(count):
        c, s = math.cos(yaw[i]), math.sin(yaw[i])
        local = (world - center[i]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        assume(np.abs(np.abs(local) - size[i] / 2).min() > 1e-7)
    np.testing.assert_array_equal(
        optipmb.points_in_boxes(cloud, center, size, yaw), naive_counts(cloud, center, size, yaw)
    )

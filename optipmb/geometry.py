"""Overlap of boxes on the ground plane, and LiDAR points inside boxes.

A bird's-eye box is a row [x, y, length, width, yaw]; a box is the geometric centre, the size (length, width, height)
and the yaw. Both computations first throw out what circles or grid cells show to be far apart.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import PointCloud

    Array = NDArray[np.float64]

MAX_CORNERS = 16
"""Two rectangles intersect in at most eight corners; clipping keeps a few more for a moment."""

CERTAIN = 1.0 - 1e-9
"""A bound below this share of a threshold is below the threshold, whatever rounding did to either."""

GRID_CELLS = 128
"""Cells along one side of the grid that finds the boxes near a point."""


@kernel
def corners(x: float, y: float, length: float, width: float, yaw: float, out: Array) -> None:
    """Write the four corners of a bird's-eye box, counter-clockwise, to the first rows of `out`."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    for i in range(4):
        along = 0.5 * length if i in {0, 3} else -0.5 * length
        across = 0.5 * width if i < 2 else -0.5 * width  # noqa: PLR2004 - the first two corners are on the left
        out[i, 0] = x + cos_yaw * along - sin_yaw * across
        out[i, 1] = y + sin_yaw * along + cos_yaw * across


@kernel
def intersection_area(first: Array, second: Array) -> float:
    """Area that two bird's-eye boxes, (5,) each, have in common: `second`, clipped by the four edges of `first`."""
    dx, dy = second[0] - first[0], second[1] - first[1]
    reach = 0.5 * (math.hypot(first[2], first[3]) + math.hypot(second[2], second[3]))
    if dx * dx + dy * dy >= reach * reach:
        return 0.0
    # In the axes of `first`, its edges are |x| = length / 2 and |y| = width / 2.
    cos_yaw, sin_yaw = math.cos(first[4]), math.sin(first[4])
    polygon = np.empty((MAX_CORNERS, 2))
    clipped = np.empty((MAX_CORNERS, 2))
    corners(
        cos_yaw * dx + sin_yaw * dy, -sin_yaw * dx + cos_yaw * dy, second[2], second[3], second[4] - first[4], polygon
    )
    count = 4
    for edge in range(4):
        axis = edge % 2
        side = 1.0 if edge < 2 else -1.0  # noqa: PLR2004 - two edges on the positive side, two on the negative
        limit = 0.5 * first[2 + axis]
        kept = 0
        for i in range(count):
            j = (i + 1) % count
            here = limit - side * polygon[i, axis]
            there = limit - side * polygon[j, axis]
            if here >= 0.0:
                clipped[kept] = polygon[i]
                kept += 1
            if (here >= 0.0) != (there >= 0.0):
                t = here / (here - there)
                clipped[kept, 0] = polygon[i, 0] + t * (polygon[j, 0] - polygon[i, 0])
                clipped[kept, 1] = polygon[i, 1] + t * (polygon[j, 1] - polygon[i, 1])
                kept += 1
        count = kept
        for i in range(count):
            polygon[i] = clipped[i]
        if count == 0:
            return 0.0
    doubled = 0.0
    for i in range(count):
        j = (i + 1) % count
        doubled += polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
    return max(0.5 * doubled, 0.0)


@kernel
def box_iou(first: Array, second: Array) -> float:
    """Intersection over union of two bird's-eye boxes, (5,) each."""
    common = intersection_area(first, second)
    if common == 0.0:
        return 0.0
    union: float = first[2] * first[3] + second[2] * second[3] - common
    return common / union


@kernel
def iou_exceeds(first: Array, second: Array, threshold: float) -> bool:
    """Tell whether `box_iou` is above a threshold; most boxes that are not too close show it before any clipping.

    The intersection is at most the smaller box, and at most what `first` shares with the rectangle around `second`
    that is parallel to it. A bound that rounding could put on the wrong side of the threshold decides nothing.
    """
    area, other = first[2] * first[3], second[2] * second[3]
    shared = min(area, other)
    if shared < CERTAIN * threshold * (area + other - shared):
        return False
    cos_yaw, sin_yaw = math.cos(first[4]), math.sin(first[4])
    dx, dy = second[0] - first[0], second[1] - first[1]
    turn = second[4] - first[4]
    cos_turn, sin_turn = abs(math.cos(turn)), abs(math.sin(turn))
    inside = 1.0
    for axis in range(2):
        offset = abs(cos_yaw * dx + sin_yaw * dy if axis == 0 else cos_yaw * dy - sin_yaw * dx)
        half = 0.5 * first[2 + axis]
        other_half = 0.5 * (cos_turn * second[2 + axis] + sin_turn * second[3 - axis])
        inside *= max(min(half, offset + other_half) - max(-half, offset - other_half), 0.0)
    shared = min(shared, inside)
    if shared < CERTAIN * threshold * (area + other - shared):
        return False
    return box_iou(first, second) > threshold


@kernel
def bev_iou(first: Array, second: Array) -> Array:
    """Rotated intersection over union on the ground plane.

    Args:
        first: (N, 5) boxes [x, y, length, width, yaw], float64.
        second: (M, 5) boxes.

    Returns:
        (N, M) in [0, 1].
    """
    result = np.empty((first.shape[0], second.shape[0]))
    for n in range(first.shape[0]):
        for m in range(second.shape[0]):
            result[n, m] = box_iou(first[n], second[m])
    return result


def points_in_boxes(cloud: PointCloud, center: Array, size: Array, yaw: Array) -> NDArray[np.int64]:
    """Count the points of a cloud in each box: PTS(x) of the adaptive detection probability (Section IV.F).

    The boxes go to the points, not the points to the boxes: each box is turned into the sensor frame once.

    Args:
        cloud: the scan with its pose.
        center: (N, 3) centres in the world frame, m.
        size: (N, 3) length, width, height, m.
        yaw: (N,) rad.

    Returns:
        (N,) int64; faces belong to the box.
    """
    counts = np.zeros(center.shape[0], np.int64)
    if counts.size and cloud.xyz.shape[0]:
        local = (center - cloud.pose.translation) @ cloud.pose.rotation
        _count_points(cloud.xyz, local, 0.5 * size, yaw, cloud.pose.rotation, counts)
    return counts


@kernel
def _count_points(
    xyz: NDArray[np.float32], center: Array, half: Array, yaw: Array, rotation: Array, counts: NDArray[np.int64]
) -> None:
    n_boxes = center.shape[0]
    # Box axes in the sensor frame (rows: along, across, up) and the reach of each box along the sensor's x and y.
    axes = np.empty((n_boxes, 3, 3))
    low = np.empty((n_boxes, 2))
    high = np.empty((n_boxes, 2))
    for n in range(n_boxes):
        cos_yaw, sin_yaw = math.cos(yaw[n]), math.sin(yaw[n])
        for s in range(3):
            axes[n, 0, s] = cos_yaw * rotation[0, s] + sin_yaw * rotation[1, s]
            axes[n, 1, s] = -sin_yaw * rotation[0, s] + cos_yaw * rotation[1, s]
            axes[n, 2, s] = rotation[2, s]
        for s in range(2):
            reach = 0.0
            for k in range(3):
                reach += abs(axes[n, k, s]) * half[n, k]
            reach += 1e-9 * (1.0 + abs(center[n, s]))  # rounding must not push a face out of its cell
            low[n, s] = center[n, s] - reach
            high[n, s] = center[n, s] + reach
    x0, y0 = low[:, 0].min(), low[:, 1].min()
    cell_x = max((high[:, 0].max() - x0) / GRID_CELLS, 1e-6)
    cell_y = max((high[:, 1].max() - y0) / GRID_CELLS, 1e-6)

    # The grid as one list of boxes sorted by cell: `start[c]` to `start[c + 1]` are the boxes that touch cell c.
    first = np.empty((n_boxes, 2), np.int64)
    last = np.empty((n_boxes, 2), np.int64)
    start = np.zeros(GRID_CELLS * GRID_CELLS + 1, np.int64)
    for n in range(n_boxes):
        first[n, 0] = min(int((low[n, 0] - x0) / cell_x), GRID_CELLS - 1)
        first[n, 1] = min(int((low[n, 1] - y0) / cell_y), GRID_CELLS - 1)
        last[n, 0] = min(int((high[n, 0] - x0) / cell_x), GRID_CELLS - 1)
        last[n, 1] = min(int((high[n, 1] - y0) / cell_y), GRID_CELLS - 1)
        for i in range(first[n, 0], last[n, 0] + 1):
            for j in range(first[n, 1], last[n, 1] + 1):
                start[i * GRID_CELLS + j + 1] += 1
    for c in range(GRID_CELLS * GRID_CELLS):
        start[c + 1] += start[c]
    boxes = np.empty(start[-1], np.int64)
    fill = start[:-1].copy()
    for n in range(n_boxes):
        for i in range(first[n, 0], last[n, 0] + 1):
            for j in range(first[n, 1], last[n, 1] + 1):
                boxes[fill[i * GRID_CELLS + j]] = n
                fill[i * GRID_CELLS + j] += 1

    for p in range(xyz.shape[0]):
        x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2])
        column, row = (x - x0) / cell_x, (y - y0) / cell_y
        if not (0.0 <= column <= GRID_CELLS and 0.0 <= row <= GRID_CELLS):  # also false for NaN
            continue
        cell = min(int(column), GRID_CELLS - 1) * GRID_CELLS + min(int(row), GRID_CELLS - 1)
        for k in range(start[cell], start[cell + 1]):
            n = boxes[k]
            dx, dy, dz = x - center[n, 0], y - center[n, 1], z - center[n, 2]
            if (
                abs(axes[n, 0, 0] * dx + axes[n, 0, 1] * dy + axes[n, 0, 2] * dz) <= half[n, 0]
                and abs(axes[n, 1, 0] * dx + axes[n, 1, 1] * dy + axes[n, 1, 2] * dz) <= half[n, 1]
                and abs(axes[n, 2, 0] * dx + axes[n, 2, 1] * dy + axes[n, 2, 2] * dz) <= half[n, 2]
            ):
                counts[n] += 1

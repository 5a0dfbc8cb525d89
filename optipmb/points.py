"""LiDAR points inside boxes: PTS(x) of the adaptive detection probability (Section IV.F).

The boxes go to the points, not the points to the boxes: each box is turned into the sensor frame once, and put into
the cells of a grid that it touches. The points are read where they lie, block by block. A first loop without branches
notes which points of a block fall into cells of boxes; most do not, and are done. A second one tests the others.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel, long_kernel
from optipmb.errors import FrameError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.frame import PointCloud

    Array = NDArray[np.float64]
    Small = NDArray[np.int32]

CELLS: Final = 128
"""Cells along one side of the grid; around it lies a border, for what is outside."""

SIDE: Final = CELLS + 2

RANGE: Final = 250.0
"""Along each axis the grid reaches at most so far from the sensor, m. Boxes and points beyond share the border: they
are rare, and a box far away must not make the cells so wide that every point falls into one of boxes."""

BLOCK: Final = 512
"""Points that are looked at together; what is noted of them stays in the fastest cache."""


def points_in_boxes(cloud: PointCloud, center: Array, size: Array, yaw: Array) -> NDArray[np.int64]:
    """Count the points of a cloud in each box.

    Args:
        cloud: the scan with its pose.
        center: (N, 3) centres in the world frame, m.
        size: (N, 3) length, width, height, m.
        yaw: (N,) rad.

    Returns:
        (N,) int64; faces belong to the box.

    Raises:
        FrameError: other shapes.
    """
    boxes = np.shape(center)[0] if np.ndim(center) else 0
    for path, values, shape in (("center", center, (boxes, 3)), ("size", size, (boxes, 3)), ("yaw", yaw, (boxes,))):
        if np.shape(values) != shape:
            raise FrameError(path, f"shape {shape}", str(np.shape(values)))
    counts = np.zeros(boxes, np.int64)
    if counts.size and cloud.xyz.shape[0]:
        local = (center - cloud.pose.translation) @ cloud.pose.rotation
        count_points(cloud.xyz, local, 0.5 * size, np.array(yaw, np.float64), cloud.pose.rotation, counts)
    return counts


@long_kernel
def count_points(
    xyz: NDArray[np.float32], center: Array, half: Array, yaw: Array, rotation: Array, counts: NDArray[np.int64]
) -> None:
    """Add to `counts` (N,) the points in each box.

    Args:
        xyz: (P, 3) in the sensor frame.
        center: (N, 3) centres in the sensor frame, N > 0.
        half: (N, 3) half the sizes.
        yaw: (N,) yaw in the world.
        rotation: (3, 3) world from sensor.
        counts: (N,) is added to.
    """
    axes, low, high = boxes_in_sensor(center, half, yaw, rotation)
    x0, y0, z0 = max(low[:, 0].min(), -RANGE), max(low[:, 1].min(), -RANGE), low[:, 2].min()
    x1, y1, z1 = min(high[:, 0].max(), RANGE), min(high[:, 1].max(), RANGE), high[:, 2].max()
    per_x, per_y = CELLS / max(x1 - x0, 1e-6), CELLS / max(y1 - y0, 1e-6)
    boxes, start, occupied = boxes_of_cells(low, high, x0, y0, per_x, per_y)

    near, cell_of = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    for first in range(0, xyz.shape[0], BLOCK):
        count = 0
        for p in range(first, min(first + BLOCK, xyz.shape[0])):
            cell = column(xyz[p, 0], x0, per_x) * SIDE + column(xyz[p, 1], y0, per_y)
            z = float(xyz[p, 2])
            near[count], cell_of[count] = p, cell
            count += occupied[cell] & (z >= z0) & (z <= z1)  # false for NaN
        for k in range(count):
            p, cell = near[k], cell_of[k]
            x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2])
            for b in range(start[cell], start[cell + 1]):
                n = boxes[b]
                dx, dy, dz = x - center[n, 0], y - center[n, 1], z - center[n, 2]
                counts[n] += (
                    (abs(axes[n, 0, 0] * dx + axes[n, 0, 1] * dy + axes[n, 0, 2] * dz) <= half[n, 0])
                    & (abs(axes[n, 1, 0] * dx + axes[n, 1, 1] * dy + axes[n, 1, 2] * dz) <= half[n, 1])
                    & (abs(axes[n, 2, 0] * dx + axes[n, 2, 1] * dy + axes[n, 2, 2] * dz) <= half[n, 2])
                )


@kernel
def column(coordinate: float, origin: float, per_metre: float) -> int:
    """Return the column of the grid along one axis, in 0 to CELLS + 1; a border column for NaN."""
    place = (coordinate - origin) * per_metre + 1.0
    place = place if place > 0.0 else 0.0  # noqa: FURB136 - max() would keep NaN
    place = place if place < CELLS + 1.0 else CELLS + 1.0  # noqa: FURB136 - as above
    return int(place)


@kernel
def boxes_in_sensor(center: Array, half: Array, yaw: Array, rotation: Array) -> tuple[Array, Array, Array]:
    """Return the axes (N, 3, 3) of boxes in the sensor frame (rows: along, across, up), and their extents (N, 3)."""
    count = center.shape[0]
    axes, low, high = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    for n in range(count):
        cos_yaw, sin_yaw = math.cos(yaw[n]), math.sin(yaw[n])
        for s in range(3):
            axes[n, 0, s] = cos_yaw * rotation[0, s] + sin_yaw * rotation[1, s]
            axes[n, 1, s] = -sin_yaw * rotation[0, s] + cos_yaw * rotation[1, s]
            axes[n, 2, s] = rotation[2, s]
        for s in range(3):
            reach = 0.0
            for k in range(3):
                reach += abs(axes[n, k, s]) * half[n, k]
            reach += 1e-9 * (1.0 + abs(center[n, s]))  # rounding must not push a face out of its cell
            low[n, s] = center[n, s] - reach
            high[n, s] = center[n, s] + reach
    return axes, low, high


@kernel
def boxes_of_cells(
    low: Array, high: Array, x0: float, y0: float, per_x: float, per_y: float
) -> tuple[Small, Small, NDArray[np.uint8]]:
    """Sort boxes into the cells that they touch.

    Returns:
        Boxes, cell after cell; (SIDE^2 + 1,) where each cell starts in them; (SIDE^2,) whether it has any.
    """
    start = np.zeros(SIDE * SIDE + 1, np.int32)
    occupied = np.zeros(SIDE * SIDE, np.uint8)
    for n in range(low.shape[0]):
        for i in range(column(low[n, 0], x0, per_x), column(high[n, 0], x0, per_x) + 1):
            for j in range(column(low[n, 1], y0, per_y), column(high[n, 1], y0, per_y) + 1):
                start[i * SIDE + j + 1] += 1
                occupied[i * SIDE + j] = 1
    for cell in range(SIDE * SIDE):
        start[cell + 1] += start[cell]
    boxes = np.empty(start[-1], np.int32)
    fill = start[:-1].copy()
    for n in range(low.shape[0]):
        for i in range(column(low[n, 0], x0, per_x), column(high[n, 0], x0, per_x) + 1):
            for j in range(column(low[n, 1], y0, per_y), column(high[n, 1], y0, per_y) + 1):
                boxes[fill[i * SIDE + j]] = n
                fill[i * SIDE + j] += 1
    return boxes, start, occupied

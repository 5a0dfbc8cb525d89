"""Adaptive detection probability (ADP, Section IV.G): an object without LiDAR points in its box is hidden, not gone.

To count the points PTS(x), each box is turned into the sensor frame once, and put into the cells of a grid that it
touches. The points are read in place, block by block. A first loop computes the cells of a block in single precision,
eight points at a time. A second one notes the few points in cells of boxes, which a third one tests in double
precision.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel, long_kernel
from optipmb.model.density import OMEGA, PHI, components_in, objects_in
from optipmb.model.errors import FrameError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.filter.field_of_view import Looks
    from optipmb.model.density import Density, Moment
    from optipmb.model.frame import PointCloud
    from optipmb.model.rows import Array, Index
    from optipmb.model.table import Classes, ClassTable

    Coordinates = NDArray[np.float32]
    Small = NDArray[np.uint32]
    Cells = tuple[np.float32, np.float32]

LEAST_SHARE: Final = 0.02
"""Least share of the time that p_d holds for that a look counts for."""


def detection_probability(
    prior: Density, cloud: PointCloud | None, looks: Looks | None, moment: Moment, table: ClassTable
) -> Array:
    """Compute p_d(x_+) of the predicted objects and, behind them, of the Poisson components, (N + J,) in [0, 1).

    ``p_d = p_d0 min[1, (1 - s_d) PTS / PTS_0 + s_d]`` with the points PTS counted in the predicted box: position and
    heading from the motion state, size and height from the auxiliary state; points up to `ground_clearance` above the
    bottom of the box are returns of the ground and do not count. Without a cloud p_d = p_d0, and so where heading, size
    or height are unknown.

    It holds for the time of the look (`over_time`) and for the part in view; `looks` None: everything is in view.
    """
    objects, components = prior.bernoulli, prior.poisson
    share = moment.dt / table.detection_time if table.detection_time > 0.0 else 1.0
    p_d: Array
    if cloud is None and looks is None:
        p_d = usual_probability(objects.words, components.words, share, table.classes)
        return p_d
    label = np.concatenate((objects.label, components.label))
    p_d = table["detection"][label]
    if cloud is not None and label.size:
        auxiliary = np.concatenate((objects.auxiliary, components.auxiliary))
        turning = np.concatenate((objects.covariance[:, OMEGA, OMEGA], components.covariance[:, OMEGA, OMEGA]))
        known = (turning != 0.0) & ~np.isnan(auxiliary).any(axis=1)
        auxiliary = table.known_boxes(label, auxiliary)
        mean = np.concatenate((objects.mean, components.mean))
        cut = np.minimum(table["ground_clearance"][label], auxiliary[:, 2])
        center = np.column_stack((mean[:, :2], auxiliary[:, 3] + 0.5 * cut))
        size = auxiliary[:, :3].copy()
        size[:, 2] -= cut
        points = points_in_boxes(cloud, center, size, mean[:, PHI].copy())
        s_d = table["detection_floor"][label]
        share_seen = np.minimum(1.0, (1.0 - s_d) * points / table["expected_points"][label] + s_d)
        p_d *= np.where(known, share_seen, 1.0)
    shares = np.full(len(p_d), share)
    if looks is not None:
        p_d *= np.concatenate((looks.in_view, looks.poisson_in_view))
        shares[: len(objects)] = looks.time / table.detection_time if table.detection_time > 0.0 else 1.0
    hold(p_d, shares)
    return p_d


@kernel
def usual_probability(object_words: Array, component_words: Array, share: float, classes: Classes) -> Array:
    """Return p_d0 over a share of its time for each object and, behind them, each component, (N + J,)."""
    usual = np.empty(len(classes))
    for c in range(len(classes)):
        usual[c] = over_time(classes[c].detection, share)
    first, second = objects_in(object_words).label, components_in(component_words).label
    out = np.empty(first.shape[0] + second.shape[0])
    for n in range(first.shape[0]):
        out[n] = usual[first[n]]
    for j in range(second.shape[0]):
        out[first.shape[0] + j] = usual[second[j]]
    return out


@kernel
def hold(p_d: Array, share: Array) -> None:
    """Replace probabilities (N,) by those of `over_time`, each over its share."""
    for n in range(p_d.shape[0]):
        p_d[n] = over_time(p_d[n], share[n])


@kernel
def over_time(p_d: float, share: float) -> float:
    """Return the probability of a detection within a share of the time that p_d holds for, ``1 - (1 - p_d)^share``.

    A detector that looks twice as often does not see twice as much: what hides an object hides it in the next look as
    well. So p_d holds for `detection_time`, and a miss weighs by the time that it lasts. Looks farther apart are
    independent: the share is at most one. It is at least `LEAST_SHARE`, so that frames of equal stamps can
    be associated.
    """
    return p_d if share >= 1.0 else 1.0 - (1.0 - p_d) ** max(share, LEAST_SHARE)


CELLS: Final = 128
"""Cells along one side of the grid; a border around it collects the points outside."""

SIDE: Final = CELLS + 2

NOWHERE: Final = SIDE * SIDE
"""The cell of points that are in no box, for their height."""

RANGE: Final = 250.0
"""Along each axis the grid reaches at most so far from the sensor, m. Boxes and points beyond share the border: they
are rare, and a box far away must not make the cells so wide that every point falls into one of boxes."""

BLOCK: Final = 512
"""Points per block: their notes stay in the fastest cache."""


def points_in_boxes(cloud: PointCloud, center: Array, size: Array, yaw: Array) -> Index:
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
def count_points(xyz: Coordinates, center: Array, half: Array, yaw: Array, rotation: Array, counts: Index) -> None:
    """Add to `counts` (N,), N > 0, the points in each box.

    Points (P, 3), centres (N, 3) and halves of the sizes are in the sensor frame, yaws (N,) in the world; `rotation` is
    world from sensor.
    """
    axes, low, high = boxes_in_sensor(center, half, yaw, rotation)
    left, right = np.float32(max(low[:, 0].min(), -RANGE)), np.float32(min(high[:, 0].max(), RANGE))
    rear, front = np.float32(max(low[:, 1].min(), -RANGE)), np.float32(min(high[:, 1].max(), RANGE))
    x_cells = left, np.float32(CELLS / max(float(right - left), 1e-6))
    y_cells = rear, np.float32(CELLS / max(float(front - rear), 1e-6))
    heights = np.float32(low[:, 2].min()), np.float32(high[:, 2].max())
    boxes, start, occupied = boxes_of_cells(low, high, x_cells, y_cells)

    flat = xyz.reshape(xyz.size)
    near, cell_of = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.uint32)  # numba tests the sign of signed ones
    for first in range(0, xyz.shape[0], BLOCK):
        block = flat[3 * first : 3 * min(first + BLOCK, xyz.shape[0])]
        cells_of_points(block, x_cells, y_cells, heights, cell_of)
        count = np.int64(0)  # in Python a plain one would take the type of its summands
        for p in range(block.shape[0] // 3):
            near[count] = p
            count += occupied[cell_of[p]]
        for k in range(count):
            p = near[k]
            cell = cell_of[p]
            x, y, z = float(block[3 * p]), float(block[3 * p + 1]), float(block[3 * p + 2])
            for b in range(start[cell], start[cell + 1]):
                n = boxes[b]
                dx, dy, dz = x - center[n, 0], y - center[n, 1], z - center[n, 2]
                counts[n] += (
                    (abs(axes[n, 0, 0] * dx + axes[n, 0, 1] * dy + axes[n, 0, 2] * dz) <= half[n, 0])
                    & (abs(axes[n, 1, 0] * dx + axes[n, 1, 1] * dy + axes[n, 1, 2] * dz) <= half[n, 1])
                    & (abs(axes[n, 2, 0] * dx + axes[n, 2, 1] * dy + axes[n, 2, 2] * dz) <= half[n, 2])
                )


@kernel
def cells_of_points(block: Coordinates, x_cells: Cells, y_cells: Cells, heights: Cells, cell_of: Small) -> None:
    """Write the cell of each point to `cell_of`; NOWHERE where it is above or below all boxes, or NaN.

    A loop without branches, which the compiler vectorizes. `block` has x, y, z of one point after the other, `x_cells`
    and `y_cells` where the grid begins and its cells per metre, `heights` the lowest and highest z of a box.
    """
    lowest, highest = heights
    for p in range(block.shape[0] // 3):
        z = block[3 * p + 2]
        cell = column(block[3 * p], x_cells) * np.int32(SIDE) + column(block[3 * p + 1], y_cells)
        cell_of[p] = cell if (z >= lowest) & (z <= highest) else np.int32(NOWHERE)


@kernel
def column(coordinate: np.float32, cells: Cells) -> np.int32:
    """Return the column of the grid along one axis, in 0 to CELLS + 1; a border column for NaN.

    It is monotonic, however it is rounded: what lies between the ends of a box has a column between theirs.
    """
    origin, per_metre = cells
    place = (coordinate - origin) * per_metre + np.float32(1.0)
    place = place if place > np.float32(0.0) else np.float32(0.0)  # noqa: FURB136 - max() would keep NaN
    place = place if place < np.float32(CELLS + 1.0) else np.float32(CELLS + 1.0)  # noqa: FURB136 - as above
    return np.int32(place)


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
            reach += 1e-6 * (1.0 + reach + abs(center[n, s]))  # rounding must not push a face out of its cell
            low[n, s] = center[n, s] - reach
            high[n, s] = center[n, s] + reach
    return axes, low, high


@kernel
def boxes_of_cells(low: Array, high: Array, x_cells: Cells, y_cells: Cells) -> tuple[Small, Small, NDArray[np.uint8]]:
    """Sort boxes into the cells that they touch.

    Returns:
        Boxes, cell after cell; (SIDE^2 + 1,) where each cell starts in them; (SIDE^2 + 1,) whether it has any, which
        NOWHERE, the last, has not.
    """
    start = np.zeros(SIDE * SIDE + 1, np.uint32)
    occupied = np.zeros(SIDE * SIDE + 1, np.uint8)
    for n in range(low.shape[0]):
        for i in range(column(np.float32(low[n, 0]), x_cells), column(np.float32(high[n, 0]), x_cells) + 1):
            for j in range(column(np.float32(low[n, 1]), y_cells), column(np.float32(high[n, 1]), y_cells) + 1):
                start[i * SIDE + j + 1] += 1
                occupied[i * SIDE + j] = 1
    for cell in range(SIDE * SIDE):
        start[cell + 1] += start[cell]
    boxes = np.empty(start[-1], np.uint32)
    fill = start[:-1].copy()
    for n in range(low.shape[0]):
        for i in range(column(np.float32(low[n, 0]), x_cells), column(np.float32(high[n, 0]), x_cells) + 1):
            for j in range(column(np.float32(low[n, 1]), y_cells), column(np.float32(high[n, 1]), y_cells) + 1):
                boxes[fill[i * SIDE + j]] = n
                fill[i * SIDE + j] += 1
    return boxes, start, occupied

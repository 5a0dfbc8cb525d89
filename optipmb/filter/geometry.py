"""Overlap of boxes on the ground plane, and a grid in which neighbours are found.

A bird's-eye box is a row [x, y, length, width, yaw]. What circles or parallel rectangles show to be far apart is never
clipped.

The plane is cut into square cells and wrapped around a torus of `side` by `side` of them: cells far apart may share a
slot, and distance separates their contents. Each slot heads a chain through `following`. A search reaches at
most one cell size, so it visits at most four cells along each axis, and the torus has at least so many.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.errors import FrameError

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Index


MAX_CORNERS = 16
"""Two rectangles intersect in at most eight corners; clipping keeps a few more for a moment."""

ROUNDING = 1e-12
"""Share of the squared sides of two boxes that rounding changes in their clipped intersection, at most."""


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
                clipped[kept, 0], clipped[kept, 1] = polygon[i, 0], polygon[i, 1]
                kept += 1
            if (here >= 0.0) != (there >= 0.0):
                t = here / (here - there)
                clipped[kept, 0] = polygon[i, 0] + t * (polygon[j, 0] - polygon[i, 0])
                clipped[kept, 1] = polygon[i, 1] + t * (polygon[j, 1] - polygon[i, 1])
                kept += 1
        count = kept
        for i in range(count):
            polygon[i, 0], polygon[i, 1] = clipped[i, 0], clipped[i, 1]
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
    margin = ROUNDING * (first[2] * first[2] + first[3] * first[3] + second[2] * second[2] + second[3] * second[3])
    shared = min(area, other)
    if shared + margin < threshold * (area + other - shared):
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
    if shared + margin < threshold * (area + other - shared):
        return False
    return box_iou(first, second) > threshold


@kernel
def boxes_overlap(first: Array, second: Array, threshold: float) -> bool:
    """Tell whether `box_iou` is above a threshold, of boxes whose yaw may be unknown, NaN.

    A box of unknown yaw takes the yaw of the other. Two of them are squares of their areas that face each other. So the
    result does not depend on the axes of the world.
    """
    if not (math.isnan(first[4]) or math.isnan(second[4])):
        return iou_exceeds(first, second, threshold)
    first, second = first.copy(), second.copy()
    if math.isnan(first[4]) and math.isnan(second[4]):
        first[4] = math.atan2(second[1] - first[1], second[0] - first[0])
        first[2] = first[3] = math.sqrt(first[2] * first[3])
        second[2] = second[3] = math.sqrt(second[2] * second[3])
    if math.isnan(first[4]):
        first[4] = second[4]
    second[4] = first[4] if math.isnan(second[4]) else second[4]
    return iou_exceeds(first, second, threshold)


def bev_iou(first: Array, second: Array) -> Array:
    """Rotated intersection over union on the ground plane.

    Args:
        first: (N, 5) boxes [x, y, length, width, yaw].
        second: (M, 5) boxes.

    Returns:
        (N, M) in [0, 1].

    Raises:
        FrameError: other shapes.
    """
    for path, boxes in (("first", first), ("second", second)):
        if np.ndim(boxes) != 2 or np.shape(boxes)[1] != 5:  # noqa: PLR2004 - x, y, length, width, yaw
            raise FrameError(path, "(N, 5)", str(np.shape(boxes)))
    result: Array = overlaps(np.array(first, np.float64), np.array(second, np.float64))
    return result


@kernel
def overlaps(first: Array, second: Array) -> Array:
    """Compute `bev_iou` of checked boxes."""
    result = np.empty((first.shape[0], second.shape[0]))
    for n in range(first.shape[0]):
        for m in range(second.shape[0]):
            result[n, m] = box_iou(first[n], second[m])
    return result


END_OF_CHAIN: Final = -1
"""End of a chain."""

SMALLEST_SIDE: Final = 4
SMALLEST_CELL: Final = 1e-3
"""Cells are not smaller than this, m: their numbers stay far from overflow."""

SLACK: Final = 1e-12
"""Searches reach so much farther, relative to the coordinate, that rounding loses no point; less than half a cell."""


@kernel
def empty_torus(count: int) -> tuple[Index, Index, int]:
    """Return the heads of the chains of an empty torus for so many points, their links, and its side."""
    side = SMALLEST_SIDE
    while side * side < count:
        side *= 2
    return np.full(side * side, END_OF_CHAIN), np.empty(count, np.int64), side


@kernel
def cell(coordinate: float, size: float) -> int:
    """Return the number of the cell along one axis; `size` is the side of the cells, m."""
    return math.floor(coordinate / max(size, SMALLEST_CELL))


@kernel
def insert(head: Index, following: Index, side: int, number: int, x: float, y: float, size: float) -> None:
    """Put the point with this number, at (x, y), in front of the chain of its cell."""
    slot = (cell(x, size) & (side - 1)) * side + (cell(y, size) & (side - 1))
    following[number] = head[slot]
    head[slot] = number


@kernel
def block(x: float, y: float, reach: float, size: float) -> tuple[int, int, int, int]:
    """Return the first and the last cell along x, then along y, within `reach` <= `size` of (x, y)."""
    widest = max(size, SMALLEST_CELL)  # however far out, a search visits a few cells
    x_reach, y_reach = reach + min(SLACK * (1.0 + abs(x)), widest), reach + min(SLACK * (1.0 + abs(y)), widest)
    return cell(x - x_reach, size), cell(x + x_reach, size), cell(y - y_reach, size), cell(y + y_reach, size)

"""Neighbours on the ground plane: what may be near a place, found without looking at everything.

The plane is cut into square cells and wrapped around a torus of `side` by `side` of them, so that a few cells serve a
world of any extent: cells far apart may share a slot, and their contents are then told apart by their distance. Each
slot heads a chain through `following`. A search reaches at most one cell size and so visits at most four cells along
each axis; the torus has at least so many, so that no slot is visited twice.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Index = NDArray[np.int64]

NOBODY: Final = -1
"""End of a chain."""

SMALLEST_SIDE: Final = 4
SMALLEST_CELL: Final = 1e-3
"""Cells are not smaller than this, m: their numbers stay far from overflow."""

SLACK: Final = 1e-12
"""Searches reach so much farther, relative to the coordinate, that rounding loses nobody; less than half a cell."""


@kernel
def empty_torus(count: int) -> tuple[Index, Index, int]:
    """Return the heads of the chains of an empty torus for so many points, their links, and its side."""
    side = SMALLEST_SIDE
    while side * side < count:
        side *= 2
    return np.full(side * side, NOBODY), np.empty(count, np.int64), side


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
    """Return the first and the last cell along x, then along y, of what is within `reach` <= `size` of (x, y)."""
    widest = max(size, SMALLEST_CELL)  # however far out, a search visits a few cells
    x_reach, y_reach = reach + min(SLACK * (1.0 + abs(x)), widest), reach + min(SLACK * (1.0 + abs(y)), widest)
    return cell(x - x_reach, size), cell(x + x_reach, size), cell(y - y_reach, size), cell(y + y_reach, size)

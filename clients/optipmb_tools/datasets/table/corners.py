"""Boxes and headings that a table has in other numbers: corners, bounds along the axes, sine and cosine."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb_tools.datasets.table.columns import ALIASES, normalised

if TYPE_CHECKING:
    from collections.abc import Collection

    from optipmb_tools.datasets.table.findings import Reading
    from optipmb_tools.geometry import Floats
    from optipmb_tools.table_files import Columns

_CORNER: Final = re.compile(r"(?:.*_)?corners?(?:_3d)?_?(\d)_?([012xyz])")
_BOUND: Final = re.compile(r"(?:.*_)?(?:([xyz])_?(min|max)|(min|max)_?([xyz]))")
_FACE: Final = 4  # corners of a box from above
_AXES: Final = "xyz"
CORNERED: Final = "yaw of corners"
"""Column of headings whose sense the corners do not tell."""


def with_boxes(reading: Reading, columns: Columns, found: Collection[str]) -> Columns:
    """Return columns of centres, sizes and headings in place of equivalent ones.

    Args:
        reading: Gets the findings.
        columns: Of the table.
        found: Meanings that columns have already.
    """
    if "l" not in found:
        columns = _of_corners(reading, columns)
    if "x" not in found:
        columns = _of_bounds(reading, columns)
    if "yaw" not in found:
        columns = _of_sines(reading, columns)
    return columns


def _of_corners(reading: Reading, columns: Columns) -> Columns:
    """Return columns with boxes in place of four corners from above, or eight; the length is the longer side."""
    names: dict[tuple[int, int], str] = {}
    for name in columns:
        if match := _CORNER.fullmatch(re.sub(r"[^a-z0-9]+", "_", name.lower())):
            names[int(match[1]), "012".find(match[2]) if match[2].isdigit() else _AXES.find(match[2])] = name
    axes = 1 + max((axis for _, axis in names), default=0)
    count = len(names) // axes
    numeric = all(columns[name].dtype.kind in "if" for name in names.values())
    if count not in {_FACE, 2 * _FACE} or len(names) != count * axes or axes == 1 or not numeric:
        return columns
    order = sorted(names)
    points = np.stack([columns[names[place]] for place in order], axis=1).reshape(-1, count, axes).astype(np.float64)
    steps = points[:, :, :2] - points[:, :1, :2]
    length = np.linalg.norm(steps, axis=2)
    rank = np.argsort(length, axis=1, kind="stable")
    rows = np.arange(len(points))
    short, long = rank[:, count // _FACE], rank[:, 2 * count // _FACE]
    along = steps[rows, long]
    boxes = {
        "x": points[:, :, 0].mean(axis=1),
        "y": points[:, :, 1].mean(axis=1),
        "l": length[rows, long],
        "w": length[rows, short],
        CORNERED: np.arctan2(along[:, 1], along[:, 0]),
    }
    if axes == len(_AXES):
        boxes |= {"z": points[:, :, 2].mean(axis=1), "h": np.ptp(points[:, :, 2], axis=1)}
    reading.note("sizes", f"boxes have {count} corners: their length is the longer side, the heading along it")
    return {name: one for name, one in columns.items() if name not in names.values()} | boxes


def _of_bounds(reading: Reading, columns: Columns) -> Columns:
    """Return columns with the centres of bounds along x, y and z."""
    names: dict[tuple[str, str], str] = {}
    for name in columns:
        if match := _BOUND.fullmatch(normalised(name).base):
            names[match[1] or match[4], match[2] or match[3]] = name
    if len(names) != 2 * len(_AXES) or any(columns[name].dtype.kind not in "if" for name in names.values()):
        return columns
    centres: dict[str, Floats] = {
        axis: 0.5 * (columns[names[axis, "min"]] + columns[names[axis, "max"]]) for axis in _AXES
    }
    reading.note("sizes", "centres are the middles of bounds along the axes, which tell neither sizes nor headings")
    return {name: one for name, one in columns.items() if name not in names.values()} | centres


def _of_sines(reading: Reading, columns: Columns) -> Columns:
    """Return columns with headings in place of their sines and cosines."""
    known = {normalised(name).base: name for name in columns}
    for base in ALIASES["yaw"]:
        for pair in ((f"sin_{base}", f"cos_{base}"), (f"{base}_sin", f"{base}_cos")):
            names = [known[one] for one in pair if one in known]
            if len(names) == len(pair) and all(columns[name].dtype.kind in "if" for name in names):
                reading.note("yaw", f"headings are computed from {names[0]} and {names[1]}")
                yaw = np.arctan2(columns[names[0]], columns[names[1]])
                return {name: one for name, one in columns.items() if name not in names} | {"yaw": yaw}
    return columns

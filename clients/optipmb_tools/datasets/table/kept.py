"""Rows of a table that have a box."""

from dataclasses import replace
from typing import Final

import numpy as np

from optipmb_tools.datasets.table.angles import no_angle
from optipmb_tools.datasets.table.draft import Draft, leave_out
from optipmb_tools.datasets.table.findings import Reading
from optipmb_tools.datasets.table.sizes import LARGEST_SIZE
from optipmb_tools.files import LARGEST
from optipmb_tools.geometry import Bools

_READ: Final = ("x", "y", "z", "l", "w", "h", "yaw", "score", "class")


def step(reading: Reading, draft: Draft) -> Draft:
    """Keep the rows with a box that can be used, and free the columns that were read.

    Their arrays would double the memory of a long table.
    """
    for role, text in ((draft.height, "z = 0"), ("h", "a height of 1.5 m"), ("score", "a score of 1")):
        if role not in draft.roles and (draft.scored if role == "score" else not (draft.scored and draft.centres)):
            reading.note(role, f"no column for {role}: {text} for every box")
    empty = np.isnan(draft.center[:, :2]).all(axis=1) & (draft.centres | np.isnan(draft.size[:, :2]).all(axis=1))
    kept = np.asarray(~(empty | draft.stamps.skipped))
    if draft.scored:
        kept = leave_out(reading, kept, _slots(reading, draft), "at 0, 0 of a list that is not full")
    if draft.scored:
        kept = leave_out(reading, kept, _doubled(draft), "that another one repeats")
    read = {draft.roles[role].name for role in _READ if role in draft.roles}
    read -= set(map(str.strip, reading.options.get("attributes", "").split(",")))
    return replace(draft, columns=draft.columns | dict.fromkeys(read, np.empty(0)), kept=_valid(reading, draft, kept))


def boxes(reading: Reading, draft: Draft) -> Draft:
    """Take the rows that are kept."""
    del reading
    row = np.flatnonzero(draft.kept)
    arrays = {name: getattr(draft, name) for name in ("center", "size", "yaw", "score", "name", "id", "covariance")}
    if len(row) < draft.rows:
        arrays = {name: None if one is None else one[row] for name, one in arrays.items()}
    return replace(draft, row=row, **arrays)


def _slots(reading: Reading, draft: Draft) -> Bools:
    """Return the rows at 0, 0 without a size, of which some frame has several: no two things are at one place."""
    zero = (draft.center[:, :2] == 0.0).all(axis=1) & (draft.unsized | draft.centres)
    frame = np.unique(np.column_stack([draft.series, draft.stamps.ns])[zero], axis=0, return_counts=True)[1]
    mark = (draft.center[:, :2] == -1.0).all(axis=1)
    if 1 < mark.sum() < len(mark):
        text = f"{int(mark.sum())} rows are at -1, -1, as a mark for no place"
        reading.doubt("rows", text, "--option missing=-1 invalid=skip")
    return np.asarray(zero & bool((frame > 1).any()), dtype=np.bool_)


def _doubled(draft: Draft) -> Bools:
    """Return the rows that are equal to another one of their recording in all columns."""
    stamp, series, center = draft.stamps.ns, draft.series, draft.center
    order = np.lexsort((center[:, 1], center[:, 0], stamp, series))
    same = (np.diff(stamp[order]) == 0) & (np.diff(series[order]) == 0)
    same &= (np.diff(center[order, 0]) == 0.0) & (np.diff(center[order, 1]) == 0.0)
    first, second = order[:-1][same], order[1:][same]
    equal = np.ones(len(first), dtype=np.bool_)
    for one in draft.columns.values():
        a, b = one[first], one[second]
        equal &= (a == b) | ((a != a) & (b != b))  # noqa: PLR0124  NaN differs from itself
    again = np.zeros(draft.rows, dtype=np.bool_)
    again[second[equal]] = True
    return again


def _valid(reading: Reading, draft: Draft, kept: Bools) -> Bools:
    """Return the rows with a box that can be used; refuse one that cannot, unless the user leaves them out."""
    center, size, yaw, score = draft.center, draft.size, draft.yaw, draft.score
    good = kept
    marks = "" if "missing" in reading.options else ", missing=NUMBER names a mark for no value"
    option = f"--option invalid=skip leaves such rows out{marks}"
    for what, values, fine in (
        ("finite x, y and z", center, (np.abs(center) <= LARGEST).all(axis=1)),
        ("positive length, width and height", size, (np.isfinite(size) & (size > 0.0)).all(axis=1) | draft.unsized),
        (
            f"sizes up to {LARGEST_SIZE:g} m, or --option size_factor=0.01 or 0.001, length_factor for all lengths",
            size,
            ~(size > LARGEST_SIZE).any(axis=1),
        ),
        ("finite yaw", yaw, ~np.isinf(yaw)),
        ("a yaw within a turn", yaw, ~no_angle(reading, yaw, draft.yaw_unit)),
        ("finite score", score, np.isfinite(score)),
        ("class", draft.name, np.asarray(draft.name != "", dtype=np.bool_)),
    ):
        bad = kept & ~fine
        if not reading.skips:
            reading.first("rows", bad, what, values, option)
        good = good & fine
    return leave_out(reading, kept, ~good, "with values that are missing, not finite or out of range")

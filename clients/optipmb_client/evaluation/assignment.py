"""Who belongs to whom, in all frames of a sequence at once.

Conventions: pairs that may match are rows of columns: row (P,) and column (P,) name the truth box and the track box of
each pair, frame (P,) when it is. Each frame is solved on its own, and in it each row and each column is taken at most
once. Most pairs meet no other that wants their row or column; they are taken without any solving, so that only
contested ones cost time.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from optipmb_client.geometry import Bools, Floats, Ints

Solver = Callable[[Ints, Ints, Floats], Ints]
"""Rows, columns and values of pairs -> the indices of those to take."""


def most_pairs(row: Ints, column: Ints, cost: Floats) -> Ints:
    """Return which pairs to take so that most are taken, and of those ways the one of least total cost."""
    # A pair that may not match costs more than all others together, so it is taken only where nothing else is left.
    return _solve(row, column, cost, 1e6)


def best_pairs(row: Ints, column: Ints, gain: Floats) -> Ints:
    """Return which pairs to take so that their total gain is the greatest; gains are positive."""
    return _solve(row, column, -gain, 0.0)


def _solve(row: Ints, column: Ints, cost: Floats, other: float) -> Ints:
    """Return the pairs of the assignment of least cost when all pairs that are not given cost `other`."""
    row_names, place = np.unique(row, return_inverse=True)
    column_names, where = np.unique(column, return_inverse=True)
    table = np.full((len(row_names), len(column_names)), other)
    table[place, where] = cost
    index = np.full(table.shape, -1, dtype=np.int64)
    index[place, where] = np.arange(len(row))
    taken = index[linear_sum_assignment(table)]
    return np.asarray(taken[taken >= 0], dtype=np.int64)


def uncontested(row: Ints, column: Ints) -> Bools:
    """Return which pairs (P,) share neither their row nor their column with another pair."""
    return np.asarray((_uses(row) == 1) & (_uses(column) == 1), dtype=np.bool_)


def by_frame(frame: Ints, pairs: Ints) -> list[Ints]:
    """Return the given pairs, each an index into frame (P,), as one array for each frame, in order of frames."""
    order = pairs[np.argsort(frame[pairs], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(order) else []


def assign_frames(frame: Ints, row: Ints, column: Ints, value: Floats, solver: Solver) -> Ints:
    """Return the pairs that a solver takes in every frame, in ascending order.

    Args:
        frame: (P,)
        row: (P,) unlike in different frames.
        column: (P,) unlike in different frames.
        value: (P,) what the solver weighs.
        solver: one that takes every uncontested pair.

    """
    alone = uncontested(row, column)
    contested = by_frame(frame, np.flatnonzero(~alone))
    taken = [pairs[solver(row[pairs], column[pairs], value[pairs])] for pairs in contested]
    return np.sort(np.concatenate([np.flatnonzero(alone), *taken]))


def _uses(names: Ints) -> Ints:
    """Return for each name (P,), zero or more, how often it occurs."""
    return np.asarray(np.bincount(names)[names], dtype=np.int64) if len(names) else names

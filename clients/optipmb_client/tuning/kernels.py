"""The loops of the evaluation, compiled: matching frame by frame and counting, for one case and one set of tracks.

Conventions: the rows of a case are ordered by frame. `pairs` are ordered by truth row, so that those of a frame are
neighbours; `bounds` (G + 1,) cuts them into frames. Identities of objects and tracks count from 0 without holes. The
results are those of `optipmb_client.evaluation`, whose functions these loops repeat; a test holds the two together.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

from optipmb_client.geometry import Bools, Floats, Ints

_F = TypeVar("_F", bound=Callable[..., Any])

FORBIDDEN = 1e6
"""Cost of a pair that may not match: more than all others together, so it is taken only where nothing else is left."""


def kernel(function: _F) -> _F:
    """Compile a function at its first call; later processes load the machine code from beside the source."""
    return cast("_F", numba.njit(cache=True, nogil=True)(function))


@kernel
def assign(cost: Floats) -> Ints:
    """Return the column of each row in the assignment of least total cost (Hungarian algorithm with potentials).

    Args:
        cost: (R, C) with R <= C.

    """
    rows, columns = cost.shape
    row_potential, column_potential = np.zeros(rows + 1), np.zeros(columns + 1)
    owner = np.zeros(columns + 1, dtype=np.int64)  # row of each column, from 1; 0 = none
    way = np.zeros(columns + 1, dtype=np.int64)
    for row in range(1, rows + 1):
        owner[0] = row
        here = 0
        least = np.full(columns + 1, np.inf)
        used = np.zeros(columns + 1, dtype=np.bool_)
        while True:
            used[here] = True
            current = owner[here]
            step, following = np.inf, 0
            for column in range(1, columns + 1):
                if used[column]:
                    continue
                reduced = cost[current - 1, column - 1] - row_potential[current] - column_potential[column]
                if reduced < least[column]:
                    least[column], way[column] = reduced, here
                if least[column] < step:
                    step, following = least[column], column
            for column in range(columns + 1):
                if used[column]:
                    row_potential[owner[column]] += step
                    column_potential[column] -= step
                else:
                    least[column] -= step
            here = following
            if owner[here] == 0:
                break
        while here:
            owner[here] = owner[way[here]]
            here = way[here]
    chosen = np.full(rows, -1, dtype=np.int64)
    for column in range(1, columns + 1):
        if owner[column]:
            chosen[owner[column] - 1] = column - 1
    return chosen


@kernel
def _best_pairs(rows: Ints, columns: Ints, cost: Floats) -> Bools:
    """Return which pairs (P,) to take so that most are taken and, of those ways, the one of least total cost."""
    count = rows.shape[0]
    taken = np.zeros(count, dtype=np.bool_)
    if count == 1:
        taken[0] = True
        return taken
    row_names, column_names = np.unique(rows), np.unique(columns)
    if row_names.shape[0] == count and column_names.shape[0] == count:
        taken[:] = True
        return taken
    row, column = np.searchsorted(row_names, rows), np.searchsorted(column_names, columns)
    turned = row_names.shape[0] > column_names.shape[0]
    if turned:
        row, column = column, row
    shape = (min(row_names.shape[0], column_names.shape[0]), max(row_names.shape[0], column_names.shape[0]))
    table = np.full(shape, FORBIDDEN)
    index = np.full(shape, -1, dtype=np.int64)
    for pair in range(count):
        table[row[pair], column[pair]] = cost[pair]
        index[row[pair], column[pair]] = pair
    chosen = assign(table)
    for i in range(shape[0]):
        if index[i, chosen[i]] >= 0:
            taken[index[i, chosen[i]]] = True
    return taken


@kernel
def match(
    truth_row: Ints,
    track_row: Ints,
    cost: Floats,
    bounds: Ints,
    truth_id: Ints,
    track_id: Ints,
    kept: Bools,
    continuity: bool,  # noqa: FBT001  a compiled function takes no keywords
) -> Ints:
    """Return the pair (T,) that each truth row is matched by, -1 for none.

    With continuity, an object stays with the track it matched last where the two may match; of several objects that
    claim one track, the first has it.
    """
    result = np.full(truth_id.shape[0], -1, dtype=np.int64)
    last = np.full(truth_id.max() + 1 if truth_id.shape[0] else 0, -1, dtype=np.int64)
    used = np.zeros(track_id.shape[0], dtype=np.bool_)
    for group in range(bounds.shape[0] - 1):
        start, stop = bounds[group], bounds[group + 1]
        if continuity:
            for pair in range(start, stop):
                truth, track = truth_row[pair], track_row[pair]
                if kept[track] and not used[track] and last[truth_id[truth]] == track_id[track]:
                    result[truth] = pair
                    used[track] = True
        free = np.empty(stop - start, dtype=np.int64)
        count = 0
        for pair in range(start, stop):
            if kept[track_row[pair]] and not used[track_row[pair]] and result[truth_row[pair]] < 0:
                free[count] = pair
                count += 1
        if count:
            free = free[:count]
            taken = _best_pairs(truth_row[free], track_row[free], cost[free])
            for i in range(count):
                if taken[i]:
                    result[truth_row[free[i]]] = free[i]
                    used[track_row[free[i]]] = True
        for pair in range(start, stop):
            truth = truth_row[pair]
            if result[truth] == pair:
                last[truth_id[truth]] = track_id[track_row[pair]]
    return result


@kernel
def switches(
    order: Ints,
    truth_id: Ints,
    ignored: Bools,
    follower: Ints,
    memory: bool,  # noqa: FBT001  as above
) -> int:
    """Return how often the track of an object changes.

    Args:
        order: (T,) truth rows by object, then by frame.
        truth_id: (T,) of the rows.
        ignored: (T,) of the rows.
        follower: (T,) id of the matched track, -1 for none.
        memory: whether the last track is remembered over frames in which the object is missed or ignored.

    """
    count = 0
    old = -1
    for i in range(order.shape[0]):
        row = order[i]
        if i == 0 or truth_id[row] != truth_id[order[i - 1]]:
            old = -1
        if ignored[row] or follower[row] < 0:
            if not memory:
                old = -1
            continue
        if old not in (-1, follower[row]):
            count += 1
        old = follower[row]
    return count


@kernel
def match_similar(truth_row: Ints, track_row: Ints, weight: Floats, bounds: Ints) -> Bools:
    """Return which pairs (P,) are matched so that in each frame the total weight is the largest (as HOTA does)."""
    chosen = np.zeros(truth_row.shape[0], dtype=np.bool_)
    for group in range(bounds.shape[0] - 1):
        start, stop = bounds[group], bounds[group + 1]
        row_names, column_names = np.unique(truth_row[start:stop]), np.unique(track_row[start:stop])
        row = np.searchsorted(row_names, truth_row[start:stop])
        column = np.searchsorted(column_names, track_row[start:stop])
        turned = row_names.shape[0] > column_names.shape[0]
        if turned:
            row, column = column, row
        shape = (min(row_names.shape[0], column_names.shape[0]), max(row_names.shape[0], column_names.shape[0]))
        table = np.zeros(shape)
        index = np.full(shape, -1, dtype=np.int64)
        for i in range(stop - start):
            table[row[i], column[i]] = -weight[start + i]
            index[row[i], column[i]] = start + i
        found = assign(table)
        for i in range(shape[0]):
            if index[i, found[i]] >= 0:
                chosen[index[i, found[i]]] = True
    return chosen

"""Matching of ends and beginnings with the largest sum of scores, and the loss of this sum without each pair."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index

    Flags = NDArray[np.bool_]


@kernel
def _push(state: tuple[Array, Index, Flags, Index, Index], node: int, at: float) -> None:
    """Shorten the distance of a node, and queue it."""
    distance, _, queued, queue, ends = state
    distance[node] = at
    if not queued[node]:
        queue[ends[1]], queued[node], ends[1] = node, True, (ends[1] + 1) % queue.shape[0]


@kernel
def _shortest(
    source: int,
    through: bool,
    graph: tuple[Index, Index, Array, Index, Index],
    mates: Index,
    state: tuple[Array, Index, Flags, Index, Index],
    nodes: Index,
) -> None:
    """Find the shortest paths from a node in the residual graph of a matching (Bellman and Ford, with a queue).

    From a row over pairs that are not taken, from a column back over its taken pair, and with `through` over one node
    for all rows and columns that have no partner.

    Args:
        source: the node: a row, a column behind the rows, or the free one behind all.
        through: whether paths go on from the free node.
        graph: of the pairs row, column, value; first pair of each row and the pairs by row.
        mates: pair of each node, or -1.
        state: receives the distances and the pair before each column; marks; queue, and where it begins and ends.
        nodes: all of the connected part.
    """
    i, j, value, first, by_row = graph
    distance, via, queued, queue, ends = state
    free, rows = mates.shape[0], first.shape[0] - 1
    for node in nodes:
        distance[node] = math.inf
    distance[free] = math.inf
    ends[0] = ends[1] = 0
    _push(state, source, 0.0)
    while ends[0] != ends[1]:
        u = queue[ends[0]]
        ends[0], queued[u] = (ends[0] + 1) % queue.shape[0], False
        at = distance[u]
        if u == free:
            for node in nodes:
                if through and (mates[node] >= 0) == (node >= rows) and at < distance[node]:
                    _push(state, node, at)
            continue
        if u < rows:
            for p in by_row[first[u] : first[u + 1]]:
                node = rows + j[p]
                if p != mates[u] and at - value[p] < distance[node]:
                    via[node] = p
                    _push(state, node, at - value[p])
        if u >= rows and mates[u] >= 0:
            at += value[mates[u]]
            if at < distance[i[mates[u]]]:
                _push(state, i[mates[u]], at)
        elif at < distance[free]:
            via[free] = u
            _push(state, free, at)


@kernel
def _parts(i: Index, j: Index, rows: int, count: int) -> Index:
    """Return the connected part of each node."""
    part = np.arange(count)
    for p in range(i.shape[0]):
        a, b = i[p], rows + j[p]
        while part[a] != a:
            part[a] = part[part[a]]
            a = part[a]
        while part[b] != b:
            part[b] = part[part[b]]
            b = part[b]
        part[max(a, b)] = min(a, b)
    for node in range(count):
        part[node] = part[part[node]]
    return part


@kernel
def _grouped(group: Index, count: int) -> tuple[Index, Index]:
    """Return the first place of each group, and the rows by group, in their order."""
    first = np.zeros(count + 1, np.int64)
    for one in group:
        first[one + 1] += 1
    return np.cumsum(first), np.argsort(group, kind="mergesort")


@kernel
def _augment(source: int, i: Index, j: Index, rows: int, mates: Index, via: Index) -> None:
    """Change the partners along the shortest path from a row to the free node."""
    column = via[mates.shape[0]]
    if column < rows:  # this row has no partner any more
        own = mates[column]
        mates[column] = -1
        column = rows + j[own]
    while True:
        p = via[column]
        row = i[p]
        before = mates[row]
        mates[column] = mates[row] = p
        if row == source:
            return
        column = rows + j[before]


@kernel
def match(i: Index, j: Index, value: Array, wanted: Flags, rows: int) -> tuple[Flags, Array, Array]:
    """Find the matching with the largest sum, and its margins.

    Args:
        i: (P,) rows, each below `rows`.
        j: (P,) columns.
        value: (P,) positive multiples of `QUANTUM`.
        wanted: (M,) columns whose margins and odds are wanted.
        rows: how many there are.

    Returns:
        Which pairs are taken (P,); the loss of the sum without each wanted pair (P,); and of each wanted column (M,)
        the largest sum with it less the largest one without, -inf where it has no pair.
    """
    columns = wanted.shape[0]
    count = rows + columns
    part = _parts(i, j, rows, count)
    start, nodes = _grouped(part, count)
    first, by_row = _grouped(i, rows)
    graph, mates = (i, j, value, first, by_row), np.full(count, -1)
    distance, via = np.full(count + 1, math.inf), np.full(count + 1, -1)
    state = distance, via, np.zeros(count + 1, np.bool_), np.empty(count + 2, np.int64), np.zeros(2, np.int64)
    for source in range(rows):
        if first[source] < first[source + 1]:
            _shortest(source, False, graph, mates, state, nodes[start[part[source]] : start[part[source] + 1]])
            if distance[count] < 0.0:
                _augment(source, i, j, rows, mates, via)
    taken, margin, odds = np.zeros(i.shape[0], np.bool_), np.zeros(i.shape[0]), np.full(columns, -math.inf)
    for row in range(rows):
        if mates[row] >= 0:
            taken[mates[row]] = True
    known = -1
    for node in rows + np.flatnonzero(wanted):  # by part would be shorter, but columns of a part are few
        mine, p = nodes[start[part[node]] : start[part[node] + 1]], mates[node]
        if p >= 0:
            _shortest(i[p], True, graph, mates, state, mine)
            margin[p], odds[node - rows], known = value[p] + distance[node], value[p] + distance[count], -1
        elif mine.shape[0] > 1:
            if known != part[node]:
                _shortest(count, True, graph, mates, state, mine)
                known = part[node]
            odds[node - rows] = -distance[node]
    return taken, margin, odds

"""The best global hypothesis (Section IV.E).

Each measurement goes to one object, or is a first-time detection of its own.

A pair can only be in the best hypothesis when it is cheaper than the first-time detection of its measurement. The
pairs that are fall into connected clusters; most have one object or one measurement and are settled by a minimum,
the others by the Hungarian algorithm on their own small matrices. The total cost is that of the algorithm on the
whole matrix of the paper's Fig. 3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.hypotheses import Hypotheses

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

UNASSIGNED = -1


def associate(hypotheses: Hypotheses, n_objects: int) -> Index:
    """Find the global hypothesis of least cost.

    Args:
        hypotheses: all local hypotheses of the frame.
        n_objects: number N of predicted objects.

    Returns:
        (N,) the measurement of each object, `UNASSIGNED` for the missed ones.
    """
    row, measurement, cost = hypotheses.row, hypotheses.measurement, hypotheses.detection_cost
    assigned = np.empty(n_objects, np.int64)
    pairs, start = np.empty_like(row), np.empty(row.shape[0] + 1, np.int64)
    ambiguous = settle(row, measurement, cost, hypotheses.first_cost, assigned, pairs, start)
    for c in range(ambiguous):
        cluster = pairs[start[c] : start[c + 1]]
        objects, measurements, gain = gain_matrix(cluster, row, measurement, cost, hypotheses.first_cost)
        i, j = linear_sum_assignment(gain)
        won = gain[i, j] < 0.0
        assigned[objects[i[won]]] = measurements[j[won]]
    return assigned


@kernel
def settle(
    row: Index, measurement: Index, cost: Array, first_cost: Array, assigned: Index, pairs_out: Index, start_out: Index
) -> int:
    """Settle what a minimum settles, and list the clusters that need the Hungarian algorithm.

    Args:
        row: (K,) object of each pair.
        measurement: (K,) measurement of each pair.
        cost: (K,) w of each pair.
        first_cost: (M,) w of the first-time detection of each measurement.
        assigned: (N,) receives the measurement of each settled object, `UNASSIGNED` for the others.
        pairs_out: (K,) receives the pairs of the clusters that are left, cluster after cluster.
        start_out: (K + 1,) receives where each of those clusters starts and the last one ends.

    Returns:
        The number of clusters that are left.
    """
    assigned[:] = UNASSIGNED
    useful = np.empty(row.shape[0], np.int64)
    gain = np.empty(row.shape[0])
    count = 0
    for k in range(row.shape[0]):
        gain[count] = cost[k] - first_cost[measurement[k]]
        if gain[count] < 0.0:
            useful[count] = k
            count += 1
    useful = useful[:count]
    rows, columns = row[useful], measurement[useful]
    order, start = clusters(rows, columns, assigned.shape[0], first_cost.shape[0])
    left = settle_small(rows, columns, gain, order, start, assigned)
    start_out[0] = 0
    for c in range(left.shape[0]):
        start_out[c + 1] = start_out[c]
        for k in range(start[left[c]], start[left[c] + 1]):
            pairs_out[start_out[c + 1]] = useful[order[k]]
            start_out[c + 1] += 1
    clusters_left: int = left.shape[0]
    return clusters_left


@kernel
def gain_matrix(
    cluster: Index, row: Index, measurement: Index, cost: Array, first_cost: Array
) -> tuple[Index, Index, Array]:
    """Lay out one cluster as a matrix of what each pair saves; zero: the measurement keeps its first-time detection.

    Returns:
        (I,) objects, (J,) measurements, both ascending, and (I, J) gains, none positive.
    """
    objects, measurements = np.unique(row[cluster]), np.unique(measurement[cluster])
    gain = np.zeros((objects.shape[0], measurements.shape[0]))
    for k in cluster:
        i, j = np.searchsorted(objects, row[k]), np.searchsorted(measurements, measurement[k])
        gain[i, j] = cost[k] - first_cost[measurement[k]]
    return objects, measurements, gain


@kernel
def _root(parent: Index, node: int) -> int:
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def clusters(rows: Index, columns: Index, n_objects: int, n_measurements: int) -> tuple[Index, Index]:
    """Split pairs into connected clusters.

    Args:
        rows: (K,) object of each pair.
        columns: (K,) measurement of each pair.
        n_objects: number of objects.
        n_measurements: number of measurements.

    Returns:
        (K,) pairs ordered by cluster (and as given within one), and (number of clusters + 1,) where each cluster
        starts.
    """
    parent = np.arange(n_objects + n_measurements)
    for k in range(rows.shape[0]):
        a, b = _root(parent, rows[k]), _root(parent, n_objects + columns[k])
        parent[max(a, b)] = min(a, b)
    number = np.full(n_objects + n_measurements, -1)
    cluster = np.empty(rows.shape[0], np.int64)
    size = np.zeros(rows.shape[0] + 1, np.int64)
    count = 0
    for k in range(rows.shape[0]):
        root = _root(parent, rows[k])
        if number[root] < 0:
            number[root] = count
            count += 1
        cluster[k] = number[root]
        size[cluster[k] + 1] += 1
    start = np.cumsum(size[: count + 1])
    fill = start.copy()
    order = np.empty(rows.shape[0], np.int64)
    for k in range(rows.shape[0]):
        order[fill[cluster[k]]] = k
        fill[cluster[k]] += 1
    return order, start


@kernel
def settle_small(rows: Index, columns: Index, gain: Array, order: Index, start: Index, assigned: Index) -> Index:
    """Settle the clusters with one object or one measurement by their best pair; return the other clusters."""
    left = np.empty(start.shape[0], np.int64)
    count = 0
    for c in range(start.shape[0] - 1):
        best = order[start[c]]
        one_row, one_column = True, True
        for k in range(start[c] + 1, start[c + 1]):
            pair = order[k]
            one_row = one_row and rows[pair] == rows[best]
            one_column = one_column and columns[pair] == columns[best]
            if gain[pair] < gain[best]:
                best = pair
        if one_row or one_column:
            assigned[rows[best]] = columns[best]
        else:
            left[count] = c
            count += 1
    return left[:count].copy()

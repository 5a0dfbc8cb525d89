"""The best global hypothesis (Section IV.E).

Each measurement goes to one object, or is a first-time detection of its own. A pair lowers the total cost only when it
is cheaper than the first-time detection of its measurement; no other pair is in the best hypothesis. Of those that are,
the assignment of least cost is found by shortest augmenting paths, after Jonker and Volgenant (1987): objects come in
one after the other, and each comes by the cheapest chain of moves, which ends at a free measurement or at an object
that is then missed. Prices on objects and measurements keep all lengths non-negative, so that Dijkstra's algorithm
finds the chain. A search goes along pairs, so it never leaves the cluster that shares gates with its object; most end
after one step. The total cost is that of the Hungarian algorithm on the whole matrix of the paper's Fig. 3.

Where several hypotheses have the least cost, the order of objects and measurements decides, and nothing else: an object
that comes later takes nothing from an earlier one unless the total becomes lower, and of measurements that cost the
same it takes the first. Objects are ordered by id and measurements by score, so the older track gets the better
detection.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

UNASSIGNED: Final = -1
"""No measurement of an object, no object of a measurement."""


@kernel
def associate(row: Index, measurement: Index, cost: Array, first_cost: Array, n_objects: int) -> Index:
    """Find the global hypothesis of least cost, by shortest augmenting paths over the pairs.

    The gain of a pair is what it costs more than the first-time detection of its measurement; a missed object gains
    zero. Prices u of objects and v of measurements keep ``gain - u - v >= 0`` on every pair that lowers the total, with
    equality on those assigned, ``u <= 0``, and ``v = 0`` on free measurements.

    Args:
        row: (K,) object of each pair, ascending.
        measurement: (K,) measurement of each pair.
        cost: (K,) w of each pair.
        first_cost: (M,) w of the first-time detection of each measurement.
        n_objects: number N of predicted objects.

    Returns:
        (N,) the measurement of each object, `UNASSIGNED` for the missed ones.
    """
    n_measurements = first_cost.shape[0]
    assigned = np.full(n_objects, UNASSIGNED)
    start = np.zeros(n_objects + 1, np.int64)  # where the pairs of each object start
    for n in row:
        start[n + 1] += 1
    start = np.cumsum(start)
    gain = np.empty(row.shape[0])
    for k in range(row.shape[0]):
        gain[k] = cost[k] - first_cost[measurement[k]]

    owner = np.full(n_measurements, UNASSIGNED)
    u, v = np.zeros(n_objects), np.zeros(n_measurements)
    length = np.full(n_measurements, math.inf)  # of the shortest path to each measurement; infinite: not reached
    before = np.empty(n_measurements, np.int64)  # the object in front of it on that path
    reached = np.empty(n_measurements, np.int64)  # measurements in the order in which they were reached
    settled = np.zeros(n_measurements, np.bool_)
    for newcomer in range(n_objects):
        count = 0
        n, here = newcomer, 0.0  # the object that the search stands at, and how far that is
        missed, shortest_miss = newcomer, math.inf
        while True:
            if here - u[n] < shortest_miss:
                missed, shortest_miss = n, here - u[n]
            for k in range(start[n], start[n + 1]):
                m = measurement[k]
                if gain[k] < 0.0 and not settled[m]:
                    through = here + (gain[k] - u[n] - v[m])
                    if through < length[m]:
                        if length[m] == math.inf:
                            reached[count] = m
                            count += 1
                        length[m], before[m] = through, n
            end, here = UNASSIGNED, shortest_miss
            for i in range(count):
                m = reached[i]
                if not settled[m] and length[m] < here:
                    end, here = m, length[m]
            if end == UNASSIGNED or owner[end] == UNASSIGNED:
                break
            settled[end] = True
            n = owner[end]

        u[newcomer] += here
        for i in range(count):
            m = reached[i]
            if settled[m]:
                u[owner[m]] += here - length[m]
                v[m] -= here - length[m]
                settled[m] = False
            length[m] = math.inf

        # Along the path every object takes the measurement behind it, and leaves the one in front to its successor.
        if end == UNASSIGNED:
            end, assigned[missed] = assigned[missed], UNASSIGNED
        while end != UNASSIGNED:
            n = before[end]
            owner[end] = n
            end, assigned[n] = assigned[n], end
    return assigned

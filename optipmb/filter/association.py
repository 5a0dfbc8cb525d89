"""The best global hypothesis, and which objects it leaves (Section IV.E).

Each measurement goes to one object, or is a first-time detection of its own. A pair lowers the total cost only when it
is cheaper than the first-time detection of its measurement. Of those pairs, the assignment of least cost is found by
shortest augmenting paths, after Jonker and Volgenant (1987): objects come in one after the other, and each comes by the
cheapest chain of moves, which ends at a free measurement or at an object that is then missed. Prices on objects and
measurements keep all lengths non-negative, so that Dijkstra's algorithm finds the chain. A search goes along pairs and
never leaves the cluster that shares gates with its object. The Hungarian algorithm finds the same total cost on the
whole matrix of the paper's Fig. 3. Where several hypotheses have the least cost, the order of objects (by id) and
measurements (by score) decides: the older track gets the better detection.

Two objects are not in the same place (not in the paper). A box next to its object, or a track that has drifted, leaves
an object missed and a detection without an object, for which the paper starts a second track. But a detection whose box
overlaps the predicted box of a missed object by more than `birth_overlap` is of that object. Such a first-time
detection is the clutter hypothesis, r = 0, and announces a Poisson component (eq. HABM). Many short tracks are false:
they forbid births for a nominal period after their last detection. A track of at least `LASTING` nominal periods
forbids them while it is extracted without a detection, for fewer periods than eta_cnt. All costs remain the paper's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.geometry import boxes_overlap
from optipmb.filter.hypotheses import CLUTTER
from optipmb.filter.predict import heading_unknown
from optipmb.model.density import PHI, X, Y, whole_periods
from optipmb.model.stages import NEW, UNASSIGNED, Survivors
from optipmb.model.table import known_length

if TYPE_CHECKING:
    from optipmb.filter.hypotheses import Hypotheses
    from optipmb.model.density import Bernoullis, Moment
    from optipmb.model.rows import Array, Index
    from optipmb.model.stages import Measurements
    from optipmb.model.table import Classes


@kernel
def associate(row: Index, measurement: Index, cost: Array, first_cost: Array, n_objects: int) -> Index:
    """Find the global hypothesis of least cost, by shortest augmenting paths over the pairs.

    The gain of a pair is its cost less the first-time cost of its measurement; a missed object gains zero. Prices u of
    objects and v of measurements keep ``gain - u - v >= 0`` on every pair that lowers the total, with equality on
    assigned pairs, ``u <= 0``, and ``v = 0`` on free measurements.

    Returns:
        (N,) the measurement of each object, `UNASSIGNED` where it is missed.
    """
    n_measurements = first_cost.shape[0]
    assigned = np.full(n_objects, UNASSIGNED)
    start = np.zeros(n_objects + 1, np.int64)  # where the pairs of each object start
    for n in row:
        start[n + 1] += 1
    for n in range(n_objects):
        start[n + 1] += start[n]
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


LASTING: Final = 10
"""Nominal periods since its birth from which a track is not a short one: a second of a LiDAR at 10 Hz."""

EVERYTHING: Final = 1.0
"""No two boxes overlap by more: no birth is forbidden."""


@kernel
def forbid_births(
    objects: Bernoullis,
    assigned: Index,
    hypotheses: Hypotheses,
    measurements: Measurements,
    missed_from_ns: Index,
    moment: Moment,
    classes: Classes,
) -> None:
    """Turn first-time detections on missed objects into clutter: writes `first_kind` and `first_existence`.

    Objects that were never extracted forbid nothing.
    """
    used = np.zeros(len(measurements.yaw), np.bool_)
    for m in assigned:
        if m != UNASSIGNED:
            used[m] = True
    predicted, detected = np.empty(5), np.empty(5)
    for k in range(hypotheses.row.shape[0]):
        n, m = hypotheses.row[k], hypotheses.measurement[k]
        own = classes[objects.label[n]]
        overlap = own.birth_overlap
        if overlap >= EVERYTHING or assigned[n] != UNASSIGNED or used[m] or hypotheses.first_kind[m] == CLUTTER:
            continue
        lasting = whole_periods(objects.born_ns[n], moment.stamp_ns, moment.period) >= LASTING
        longest = max(own.extract_misses - 1, 1) if lasting else 1
        if not objects.extracted[n] or whole_periods(missed_from_ns[n], moment.stamp_ns, moment.period) > longest:
            continue
        predicted[0], predicted[1], predicted[4] = objects.mean[n, X], objects.mean[n, Y], objects.mean[n, PHI]
        if heading_unknown(objects.covariance[n]):
            predicted[4] = np.nan
        detected[0], detected[1] = measurements.position[m, 0], measurements.position[m, 1]
        detected[4] = measurements.yaw[m]
        for s in range(2):
            predicted[2 + s] = known_length(objects.auxiliary[n, s], s, own)
            detected[2 + s] = known_length(measurements.auxiliary[m, s], s, own)
        if boxes_overlap(predicted, detected, overlap):
            hypotheses.first_kind[m], hypotheses.first_existence[m] = CLUTTER, 0.0


@kernel
def surviving_objects(
    objects: Bernoullis,
    p_d: Array,
    assigned: Index,
    hypotheses: Hypotheses,
    measured_label: Index,
    missed_from_ns: Index,
    moment: Moment,
    classes: Classes,
) -> Survivors:
    """Select the objects of the posterior: likely enough (`min_existence`), not missed too long (`max_misses`).

    The second limit is ours: with p_s = 1, as the paper sets it for KITTI, r stays 1 through any number of misses.
    A detected object has r = 1; a missed one ``r (1 - p_d) / [1 - r + r (1 - p_d)]`` (eq. Misdetect Hypothesis
    Update); a free measurement makes an object unless it is clutter.
    """
    capacity = assigned.shape[0] + measured_label.shape[0]
    row, measurement, existence = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    free = np.ones(measured_label.shape[0], np.bool_)
    count, detected = 0, 0
    for n in range(assigned.shape[0]):
        m, r = assigned[n], objects.existence[n]
        if m != UNASSIGNED:
            free[m] = False
            r = 1.0
            detected += 1
        else:
            own = classes[objects.label[n]]
            r = r * (1.0 - p_d[n]) / (1.0 - r + r * (1.0 - p_d[n]))
            misses = whole_periods(missed_from_ns[n], moment.stamp_ns, moment.period)
            if not r >= own.min_existence or misses > own.max_misses:
                continue
        row[count], measurement[count], existence[count] = n, m, r
        count += 1
    known = count
    for m in range(measured_label.shape[0]):
        r = hypotheses.first_existence[m]
        if free[m] and hypotheses.first_kind[m] != CLUTTER and r >= classes[measured_label[m]].min_existence:
            row[count], measurement[count], existence[count] = NEW, m, r
            count += 1
    return Survivors(row[:count], measurement[:count], existence[:count], known, detected)

"""What stays after the update (Section IV.E and redundant PPP pruning, RPP, Section IV.G).

It is decided before the update is computed, so that nothing is computed for what goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.association import UNASSIGNED
from optipmb.compiled import kernel
from optipmb.density import whole_periods
from optipmb.hypotheses import CLUTTER

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis, Poissons
    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

NEW: Final = -1
"""`Survivors.row` of a first-time detection."""


@dataclass(frozen=True, slots=True)
class Survivors:
    """The local hypotheses of the best global hypothesis that outlive pruning: one per object of the posterior.

    Known objects come first, in their order; then the new ones, in the order of their measurements.

    Attributes:
        row: (K,) predicted object, or `NEW`.
        measurement: (K,) its measurement, or `UNASSIGNED`.
        existence: (K,) posterior existence probability r.
        known: how many are known objects.
    """

    row: Index
    measurement: Index
    existence: Array
    known: int

    def __len__(self) -> int:
        return len(self.row)


def surviving_objects(
    bernoulli: Bernoullis,
    p_d: Array,
    assigned: Index,
    hypotheses: Hypotheses,
    measurements: Measurements,
    stamp_ns: int,
    table: ClassTable,
) -> Survivors:
    """Select the objects of the posterior: likely enough (`min_existence`), not missed too long (`max_misses`).

    The second limit is ours: with p_s = 1, as the paper sets it for KITTI, r stays 1 through any number of misses.

    Args:
        bernoulli: predicted objects.
        p_d: (N,) their detection probabilities.
        assigned: (N,) the measurement of each, `UNASSIGNED` for the missed ones.
        hypotheses: of this frame.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
    """
    capacity = len(bernoulli) + len(measurements)
    row, measurement, existence = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    known, count = select_objects(
        bernoulli.existence,
        bernoulli.seen_ns,
        bernoulli.label,
        p_d,
        assigned,
        hypotheses.first_kind,
        hypotheses.first_existence,
        measurements.label,
        stamp_ns,
        table.period,
        table.max_misses,
        table.min_existence,
        row,
        measurement,
        existence,
    )
    return Survivors(row[:count], measurement[:count], existence[:count], known)


@kernel
def select_objects(
    existence: Array,
    seen_ns: Index,
    label: Index,
    p_d: Array,
    assigned: Index,
    first_kind: Index,
    first_existence: Array,
    measured_label: Index,
    stamp_ns: int,
    period: float,
    max_misses: Index,
    min_existence: Array,
    row: Index,
    measurement: Index,
    existence_out: Array,
) -> tuple[int, int]:
    """Write the rows of `Survivors`.

    A detected object has r = 1; a missed one ``r (1 - p_d) / [1 - r + r (1 - p_d)]`` (eq. Misdetect Hypothesis
    Update); of the measurements that no object took, those that are not clutter make one.

    Returns:
        The number of known objects, and of all.
    """
    free = np.ones(measured_label.shape[0], np.bool_)
    count = 0
    for n in range(existence.shape[0]):
        m, r = assigned[n], existence[n]
        if m != UNASSIGNED:
            free[m] = False
            r = 1.0
        else:
            r = r * (1.0 - p_d[n]) / (1.0 - r + r * (1.0 - p_d[n]))
            if not r >= min_existence[label[n]] or whole_periods(seen_ns[n], stamp_ns, period) > max_misses[label[n]]:
                continue
        row[count], measurement[count], existence_out[count] = n, m, r
        count += 1
    known = count
    for m in range(measured_label.shape[0]):
        if free[m] and first_kind[m] != CLUTTER and first_existence[m] >= min_existence[measured_label[m]]:
            row[count], measurement[count], existence_out[count] = NEW, m, first_existence[m]
            count += 1
    return known, count


def surviving_components(
    poisson: Poissons, p_d: Array, n_predicted: int, hypotheses: Hypotheses, stamp_ns: int, table: ClassTable
) -> tuple[Index, Array]:
    """Select the Poisson components that stay under RPP.

    Components that took part in any first-time detection hypothesis are marked and go, so that they cannot start a
    second track; the others go after eta_step nominal periods.

    The weight of an undetected object is ``mu_+ (1 - p_d)``. The paper's eq. PPP Update prints ``mu_+ p_d``, which is
    the weight of an object that was detected; the standard PMBM recursion, and the sense of the sentence around it,
    is the former.

    Args:
        poisson: the components.
        p_d: (J,) their detection probabilities.
        n_predicted: how many of them were predicted; those behind were made by the measurements of this frame
            (without HABM), and are not used up by the very measurement that has just made them.
        hypotheses: of this frame.
        stamp_ns: stamp of the frame.
        table: parameters as columns.

    Returns:
        (K,) rows that stay, and (K,) their weights.
    """
    kept, weight = np.empty(len(poisson), np.int64), np.empty(len(poisson))
    if not len(poisson):
        return kept, weight
    count = select_components(
        poisson.weight,
        p_d,
        poisson.label,
        poisson.born_ns,
        n_predicted,
        hypotheses.component,
        stamp_ns,
        table.period,
        table.poisson_steps,
        kept,
        weight,
    )
    return kept[:count], weight[:count]


@kernel
def select_components(
    weight: Array,
    p_d: Array,
    label: Index,
    born_ns: Index,
    n_predicted: int,
    component: Index,
    stamp_ns: int,
    period: float,
    poisson_steps: Index,
    kept: Index,
    weight_out: Array,
) -> int:
    """Write the rows that stay and their weights ``mu_+ (1 - p_d)`` (eq. PPP Update); return how many."""
    marked = np.zeros(weight.shape[0], np.bool_)
    for j in component:
        marked[j] = j < n_predicted
    count = 0
    for j in range(weight.shape[0]):
        if not marked[j] and whole_periods(born_ns[j], stamp_ns, period) <= poisson_steps[label[j]]:
            kept[count], weight_out[count] = j, weight[j] * (1.0 - p_d[j])
            count += 1
    return count

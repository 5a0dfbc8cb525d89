"""Which objects stay after the update (Section IV.E).

It is decided before the update is computed, so that nothing is computed for what goes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.association import UNASSIGNED
from optipmb.compiled import kernel
from optipmb.density import whole_periods
from optipmb.hypotheses import CLUTTER
from optipmb.records import INDEX, record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

NEW: Final = -1
"""`Survivors.row` of a first-time detection."""


@record
class Survivors:
    """The local hypotheses of the best global hypothesis that outlive pruning: one per object of the posterior.

    Known objects come first, in their order; then the new ones, in the order of their measurements.

    Attributes:
        row: (K,) predicted object, or `NEW`.
        measurement: (K,) its measurement, or `UNASSIGNED`.
        existence: (K,) posterior existence probability r.
        known: how many are known objects.
        detected: how many of those have a measurement.
    """

    row: Index
    measurement: Index
    existence: Array
    known: int
    detected: int

    def __len__(self) -> int:
        return len(self.row)


def surviving_objects(
    bernoulli: Bernoullis,
    p_d: Array,
    assigned: Index,
    hypotheses: Hypotheses,
    measurements: Measurements,
    missed_from_ns: Index,
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
        missed_from_ns: (N,) stamps from which misses count.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
    """
    capacity = len(bernoulli) + len(measurements)
    row, measurement, existence = np.empty(capacity, INDEX), np.empty(capacity, INDEX), np.empty(capacity)
    count, known, detected = select_objects(
        bernoulli.existence,
        missed_from_ns,
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
    return Survivors(row[:count], measurement[:count], existence[:count], known, detected)


@kernel
def select_objects(
    existence: Array,
    missed_from_ns: Index,
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
) -> tuple[int, int, int]:
    """Write the rows of `Survivors`.

    A detected object has r = 1; a missed one ``r (1 - p_d) / [1 - r + r (1 - p_d)]`` (eq. Misdetect Hypothesis
    Update); of the measurements that no object took, those that are not clutter make one.

    Returns:
        The number of rows, of known objects among them, and of detected ones among those.
    """
    free = np.ones(measured_label.shape[0], np.bool_)
    count, detected = 0, 0
    for n in range(existence.shape[0]):
        m, r = assigned[n], existence[n]
        if m != UNASSIGNED:
            free[m] = False
            r = 1.0
            detected += 1
        else:
            r = r * (1.0 - p_d[n]) / (1.0 - r + r * (1.0 - p_d[n]))
            misses = whole_periods(missed_from_ns[n], stamp_ns, period)
            if not r >= min_existence[label[n]] or misses > max_misses[label[n]]:
                continue
        row[count], measurement[count], existence_out[count] = n, m, r
        count += 1
    known = count
    for m in range(measured_label.shape[0]):
        if free[m] and first_kind[m] != CLUTTER and first_existence[m] >= min_existence[measured_label[m]]:
            row[count], measurement[count], existence_out[count] = NEW, m, first_existence[m]
            count += 1
    return count, known, detected

"""Which objects stay after the update (Section IV.E).

It is decided before the update is computed, so that nothing is computed for what goes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.association import UNASSIGNED
from optipmb.compiled import kernel
from optipmb.density import whole_periods
from optipmb.hypotheses import CLUTTER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.hypotheses import Hypotheses
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

NEW: Final = -1
"""`Survivors.row` of a first-time detection."""


class Survivors(NamedTuple):
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


@kernel
def surviving_objects(
    objects: Bernoullis,
    p_d: Array,
    assigned: Index,
    hypotheses: Hypotheses,
    measured_label: Index,
    missed_from_ns: Index,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> Survivors:
    """Select the objects of the posterior: likely enough (`min_existence`), not missed too long (`max_misses`).

    The second limit is ours: with p_s = 1, as the paper sets it for KITTI, r stays 1 through any number of misses.
    A detected object has r = 1; a missed one ``r (1 - p_d) / [1 - r + r (1 - p_d)]`` (eq. Misdetect Hypothesis
    Update); of the measurements that no object took, those that are not clutter make one.

    Args:
        objects: predicted objects.
        p_d: (N,) their detection probabilities.
        assigned: (N,) the measurement of each, `UNASSIGNED` for the missed ones.
        hypotheses: of this frame.
        measured_label: (M,) z_c.
        missed_from_ns: (N,) stamps from which misses count.
        stamp_ns: stamp of the frame.
        period: nominal period, s.
        classes: (C,) parameters.
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
            misses = whole_periods(missed_from_ns[n], stamp_ns, period)
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

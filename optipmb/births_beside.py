"""Births that an object forbids: two objects are not in the same place (not in the paper).

A single box that lies beside its object, or a track that has drifted, leaves an object missed and a detection without
an object. The paper starts a second track there, which then takes the object over. But a box that overlaps that of
another by more than eta_iou is of the same object: so non-maximum suppression has it, and so it is between a detection
and the predicted box of an object that is missed now. Such a first-time detection is the clutter hypothesis (eq.
Clutter Hypothesis), r = 0, and announces a Poisson component (eq. HABM), from which what is there after all is born
later.

How long a missed object forbids births depends on how sure it is. Many short tracks are false, and what is detected
beside them may well be the first of an object: they forbid it for a nominal period after their last detection. A track
of at least `LASTING` nominal periods forbids it as long as it is extracted without a detection, for fewer periods than
eta_cnt: a new track would stand beside it in the output, and a drifted state is found again by its detections.

It is decided for the best global hypothesis, as pruning is, so that all costs remain those of the paper.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.association import UNASSIGNED
from optipmb.compiled import kernel
from optipmb.density import PHI, X, Y, whole_periods
from optipmb.geometry import iou_exceeds
from optipmb.hypotheses import CLUTTER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassRow

    Index = NDArray[np.int64]

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
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
) -> None:
    """Turn first-time detections on objects that are missed into clutter, in `hypotheses`.

    Args:
        objects: predicted objects; those that were never extracted forbid nothing.
        assigned: (N,) measurement of each, or `UNASSIGNED`.
        hypotheses: of this frame; `first_kind` and `first_existence` are written.
        measurements: Z_k.
        missed_from_ns: (N,) stamps from which misses count.
        stamp_ns: stamp of the frame.
        period: nominal period, s.
        classes: (C,) parameters: `birth_overlap` and eta_cnt.
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
        lasting = whole_periods(objects.born_ns[n], stamp_ns, period) >= LASTING
        longest = max(own.extract_misses - 1, 1) if lasting else 1
        if not objects.extracted[n] or whole_periods(missed_from_ns[n], stamp_ns, period) > longest:
            continue
        predicted[0], predicted[1], predicted[4] = objects.mean[n, X], objects.mean[n, Y], objects.mean[n, PHI]
        detected[0], detected[1] = measurements.position[m, 0], measurements.position[m, 1]
        detected[4] = measurements.yaw[m]
        for s in range(2):
            predicted[2 + s], detected[2 + s] = objects.auxiliary[n, s], measurements.auxiliary[m, s]
        if iou_exceeds(predicted, detected, overlap):
            hypotheses.first_kind[m], hypotheses.first_existence[m] = CLUTTER, 0.0

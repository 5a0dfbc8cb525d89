"""The Poisson intensity of undetected objects after a frame: what stays of it, and what is born (eq. PPP Update).

Redundant components go (RPP, Section IV.H), and measurements that were taken for clutter announce objects that later
frames may find (hybrid adaptive birth model, HABM, Section IV.G).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optipmb.birth import birth_states
from optipmb.compiled import kernel
from optipmb.density import COMPONENT, Poissons, components_in, copy_state, whole_periods
from optipmb.hypotheses import CLUTTER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassRow, ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def update_undetected(
    components: Poissons,
    p_d: Array,
    n_predicted: int,
    hypotheses: Hypotheses,
    measurements: Measurements,
    stamp_ns: int,
    period: float,
    classes: Sequence[ClassRow],
    adaptive: bool,
) -> Array:
    """Return the array of the Poisson components that stay under RPP, and of lambda_b.

    Components that took part in any first-time detection hypothesis are marked and go, so that they cannot start a
    second track; the others go after eta_step nominal periods.

    The weight of an undetected object is ``mu_+ (1 - p_d)``. The paper's eq. PPP Update prints ``mu_+ p_d``, which is
    the weight of an object that was detected; the standard PMBM recursion, and the sense of the sentence around it,
    is the former.

    lambda_b has a component for each low-scored measurement of M_low, of weight ``mu_b = mu_ab (1 - p_a)`` (eq. HABM);
    a zero weight makes none.

    Args:
        components: the components.
        p_d: (J,) their detection probabilities.
        n_predicted: how many of them were predicted; those behind were made by the measurements of this frame
            (without HABM), and are not used up by the very measurement that has just made them.
        hypotheses: of this frame.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        period: nominal period, s.
        classes: (C,) parameters.
        adaptive: whether HABM is on; off: nothing is born here.
    """
    marked = np.zeros(p_d.shape[0], np.bool_)
    for j in hypotheses.component:
        marked[j] = j < n_predicted
    capacity = p_d.shape[0] + measurements.score.shape[0]
    chosen, weight = np.empty(capacity, np.int64), np.empty(capacity)
    old = 0
    for j in range(p_d.shape[0]):
        steps = whole_periods(components.born_ns[j], stamp_ns, period)
        if not marked[j] and steps <= classes[components.label[j]].poisson_steps:
            chosen[old], weight[old] = j, components.weight[j] * (1.0 - p_d[j])
            old += 1
    count = old
    for m in range(measurements.score.shape[0]):
        born = classes[measurements.label[m]].adaptive_birth_rate * (1.0 - hypotheses.association[m])
        if adaptive and hypotheses.first_kind[m] == CLUTTER and born > 0.0:
            chosen[count], weight[count] = m, born
            count += 1
    return with_births(components, chosen[:old], chosen[old:count], weight[:count], measurements, stamp_ns, classes)


@kernel
def with_births(
    components: Poissons,
    kept: Index,
    born: Index,
    weight: Array,
    measurements: Measurements,
    stamp_ns: int,
    classes: Sequence[ClassRow],
) -> Array:
    """Return the array of the components that stay and, behind them, of those that are born.

    Args:
        components: the components.
        kept: (K,) which of them stay.
        born: (L,) measurements that make a component each.
        weight: (K + L,) weights of all.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        classes: (C,) parameters.
    """
    old, count = kept.shape[0], weight.shape[0]
    words = np.empty(count * COMPONENT)
    new = components_in(words)
    mean, covariance, label, auxiliary, born_ns = new.mean, new.covariance, new.label, new.auxiliary, new.born_ns
    new.weight[:] = weight
    for k in range(old):
        j = kept[k]
        copy_state(components.mean, components.covariance, j, mean, covariance, k)
        for s in range(4):
            auxiliary[k, s] = components.auxiliary[j, s]
        label[k], born_ns[k] = components.label[j], components.born_ns[j]
    birth_states(born, measurements, classes, mean[old:], covariance[old:])
    for k in range(old, count):
        m = born[k - old]
        for s in range(4):
            auxiliary[k, s] = measurements.auxiliary[m, s]
        label[k], born_ns[k] = measurements.label[m], stamp_ns
    return words


def with_measurement_births(
    poisson: Poissons, measurements: Measurements, stamp_ns: int, table: ClassTable
) -> Poissons:
    """Add a component of weight `baseline_birth_rate` for every measurement: GNN-PMB's birth model, the baseline."""
    weight = np.concatenate((poisson.weight, table["baseline_birth_rate"][measurements.label]))
    kept, born = np.arange(len(poisson)), np.arange(measurements.score.shape[0])
    components = components_in(poisson.words)
    return Poissons.of(with_births(components, kept, born, weight, measurements, stamp_ns, table.classes))

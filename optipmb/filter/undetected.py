"""The Poisson intensity of undetected objects after a frame: surviving components and births (eq. PPP Update).

Redundant components go (RPP, Section IV.H), and measurements that were taken for clutter announce objects that later
frames may find (hybrid adaptive birth model, HABM, Section IV.G).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.hypotheses import CLUTTER
from optipmb.filter.update import birth_states
from optipmb.model.density import COMPONENT, Poissons, components_in, copy_state, whole_periods

if TYPE_CHECKING:
    from optipmb.filter.hypotheses import Hypotheses
    from optipmb.model.density import Density, Moment
    from optipmb.model.rows import Array, Index
    from optipmb.model.stages import Measurements
    from optipmb.model.table import Classes, ClassTable


AGED: Final = -1
MARKED: Final = -2
"""Fate of a Poisson component that goes: too old, or part of a first-time detection."""


@kernel
def update_undetected(
    components: Poissons,
    p_d: Array,
    n_predicted: int,
    hypotheses: Hypotheses,
    measurements: Measurements,
    moment: Moment,
    classes: Classes,
) -> tuple[Array, Index]:
    """Return the array of the Poisson components that stay under RPP, and of lambda_b; and the fate of each, (J + M,).

    The fate of a component, and behind them of a measurement, is its row in the array; `AGED` or `MARKED` where a
    component goes, `AGED` where a measurement makes none.

    Components that took part in any first-time detection hypothesis are marked and go, so that they cannot start a
    second track; the others go after eta_step nominal periods.

    The weight of an undetected object is ``mu_+ (1 - p_d)``. The paper's eq. PPP Update prints ``mu_+ p_d``, which is
    the weight of an object that was detected; the standard PMBM recursion, and the sense of the sentence around it,
    is the former.

    lambda_b has a component for each low-scored measurement of M_low, of weight ``mu_b = mu_ab (1 - p_a)`` (eq. HABM);
    a zero weight makes none.

    `n_predicted` components were predicted. The others were made by the measurements of this frame, which do not use
    them up; then HABM is off, and nothing is born here.
    """
    adaptive = n_predicted == p_d.shape[0]
    capacity = p_d.shape[0] + measurements.score.shape[0]
    fate = np.full(capacity, AGED, np.int64)
    for k in range(hypotheses.component.shape[0]):
        j, m = hypotheses.component[k], hypotheses.announced[k]
        if j < n_predicted and measurements.score[m] >= classes[measurements.label[m]].announce_score:
            fate[j] = MARKED
    chosen, weight = np.empty(capacity, np.int64), np.empty(capacity)
    old = 0
    for j in range(p_d.shape[0]):
        steps = whole_periods(components.born_ns[j], moment.stamp_ns, moment.period)
        if fate[j] != MARKED and steps <= classes[components.label[j]].poisson_steps:
            chosen[old], weight[old], fate[j] = j, components.weight[j] * (1.0 - p_d[j]), old
            old += 1
    count = old
    for m in range(measurements.score.shape[0]):
        own = classes[measurements.label[m]]
        born = own.adaptive_birth_rate * (1.0 - hypotheses.association[m])
        low = measurements.score[m] < own.announce_score
        if adaptive and hypotheses.first_kind[m] == CLUTTER and born > 0.0 and not low:
            chosen[count], weight[count], fate[p_d.shape[0] + m] = m, born, count
            count += 1
    kept, born_of = chosen[:old], chosen[old:count]
    return with_births(components, kept, born_of, weight[:count], measurements, moment.stamp_ns, classes), fate


@kernel
def with_births(
    components: Poissons,
    kept: Index,
    born: Index,
    weight: Array,
    measurements: Measurements,
    stamp_ns: int,
    classes: Classes,
) -> Array:
    """Return the array of the components in `kept` (K,) and, behind them, of births by measurements (L,).

    `weight` (K + L,) has the weights of all.
    """
    old, count = kept.shape[0], weight.shape[0]
    words = np.empty(count * COMPONENT)
    new = components_in(words)
    mean, covariance, label, auxiliary, born_ns = new.mean, new.covariance, new.label, new.auxiliary, new.born_ns
    for k in range(count):
        new.weight[k] = weight[k]
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


def with_measurement_births(prior: Density, measurements: Measurements, table: ClassTable) -> Density:
    """Add a component of weight `baseline_birth_rate` for every measurement: GNN-PMB's birth model, the baseline."""
    poisson, stamp_ns = prior.poisson, prior.stamp_ns
    weight = np.concatenate((poisson.weight, table["baseline_birth_rate"][measurements.label]))
    kept, born = np.arange(len(poisson)), np.arange(measurements.score.shape[0])
    words = with_births(components_in(poisson.words), kept, born, weight, measurements, stamp_ns, table.classes)
    return replace(prior, poisson=Poissons.of(words))

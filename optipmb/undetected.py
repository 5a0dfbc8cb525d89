"""The Poisson intensity of undetected objects after a frame: what stays of it, and what is born (eq. PPP Update).

Redundant components go (RPP, Section IV.G), and measurements that were taken for clutter announce objects that later
frames may find (hybrid adaptive birth model, HABM, Section IV.F).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optipmb.birth import birth_states
from optipmb.compiled import kernel
from optipmb.density import Poissons, copy_state, whole_periods
from optipmb.hypotheses import CLUTTER
from optipmb.records import INDEX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


def update_undetected(
    poisson: Poissons,
    p_d: Array,
    n_predicted: int,
    hypotheses: Hypotheses,
    measurements: Measurements,
    stamp_ns: int,
    table: ClassTable,
    *,
    adaptive: bool,
) -> Poissons:
    """Select the Poisson components that stay under RPP, and add lambda_b.

    Components that took part in any first-time detection hypothesis are marked and go, so that they cannot start a
    second track; the others go after eta_step nominal periods.

    The weight of an undetected object is ``mu_+ (1 - p_d)``. The paper's eq. PPP Update prints ``mu_+ p_d``, which is
    the weight of an object that was detected; the standard PMBM recursion, and the sense of the sentence around it,
    is the former.

    lambda_b has a component for each low-scored measurement of M_low, of weight ``mu_b = mu_ab (1 - p_a)`` (eq. HABM);
    a zero weight makes none.

    Args:
        poisson: the components.
        p_d: (J,) their detection probabilities.
        n_predicted: how many of them were predicted; those behind were made by the measurements of this frame
            (without HABM), and are not used up by the very measurement that has just made them.
        hypotheses: of this frame.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
        adaptive: whether HABM is on; off: nothing is born here.
    """
    capacity = len(poisson) + len(measurements)
    chosen, weight = np.empty(capacity, INDEX), np.empty(capacity)
    old, count = select_undetected(
        poisson.weight,
        p_d,
        poisson.label,
        poisson.born_ns,
        n_predicted,
        hypotheses.component,
        stamp_ns,
        table.period,
        table.poisson_steps,
        adaptive,
        hypotheses.first_kind,
        hypotheses.association,
        measurements.label,
        table.adaptive_birth_rate,
        chosen,
        weight,
    )
    return with_births(poisson, chosen, old, weight[:count], measurements, stamp_ns, table)


def with_measurement_births(
    poisson: Poissons, measurements: Measurements, stamp_ns: int, table: ClassTable
) -> Poissons:
    """Add a component of weight mu_ab for every measurement: GNN-PMB's birth model, the baseline of the ablation."""
    old = len(poisson)
    chosen = np.concatenate((np.arange(old), np.arange(len(measurements))))
    weight = np.concatenate((poisson.weight, table.adaptive_birth_rate[measurements.label]))
    return with_births(poisson, chosen, old, weight, measurements, stamp_ns, table)


def with_births(
    poisson: Poissons,
    chosen: Index,
    old: int,
    weight: Array,
    measurements: Measurements,
    stamp_ns: int,
    table: ClassTable,
) -> Poissons:
    """Put the components that stay and those that are born together.

    Args:
        poisson: the components.
        chosen: (>= K,) which of them stay, and behind those the measurements that make a component each.
        old: how many stay.
        weight: (K,) weights of all.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
    """
    count = weight.shape[0]
    if not count:
        return poisson if not len(poisson) else Poissons.empty()
    joined = Poissons.unfilled(weight)
    fill_components(
        chosen,
        old,
        poisson.mean,
        poisson.covariance,
        poisson.label,
        poisson.auxiliary,
        poisson.born_ns,
        measurements.position,
        measurements.yaw,
        measurements.velocity,
        measurements.label,
        measurements.auxiliary,
        stamp_ns,
        table.birth_heading_speed,
        table.birth_known,
        table.birth_unknown,
        joined.mean,
        joined.covariance,
        joined.label,
        joined.auxiliary,
        joined.born_ns,
    )
    return joined


@kernel
def select_undetected(
    weight: Array,
    p_d: Array,
    label: Index,
    born_ns: Index,
    n_predicted: int,
    component: Index,
    stamp_ns: int,
    period: float,
    poisson_steps: Index,
    adaptive: bool,
    first_kind: Index,
    association: Array,
    measured_label: Index,
    birth_rate: Array,
    chosen: Index,
    weight_out: Array,
) -> tuple[int, int]:
    """Write the components that stay, behind them the measurements of lambda_b, and the weights of both.

    Returns:
        How many components stay, and how many there are with those that are born.
    """
    old = select_components(
        weight, p_d, label, born_ns, n_predicted, component, stamp_ns, period, poisson_steps, chosen, weight_out
    )
    if not adaptive:
        return old, old
    born = select_births(first_kind, association, measured_label, birth_rate, chosen[old:], weight_out[old:])
    return old, old + born


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


@kernel
def select_births(
    first_kind: Index, association: Array, label: Index, birth_rate: Array, rows: Index, weight: Array
) -> int:
    """Write the measurements of lambda_b and their weights ``mu_ab (1 - p_a)`` (eq. HABM); return how many they are."""
    count = 0
    for m in range(first_kind.shape[0]):
        born = birth_rate[label[m]] * (1.0 - association[m])
        if first_kind[m] == CLUTTER and born > 0.0:
            rows[count], weight[count] = m, born
            count += 1
    return count


@kernel
def fill_components(
    chosen: Index,
    old: int,
    mean: Array,
    covariance: Array,
    label: Index,
    auxiliary: Array,
    born_ns: Index,
    position: Array,
    yaw: Array,
    velocity: Array,
    measured_label: Index,
    measured_auxiliary: Array,
    stamp_ns: int,
    heading_speed: Array,
    known: Array,
    unknown: Array,
    mean_out: Array,
    covariance_out: Array,
    label_out: Index,
    auxiliary_out: Array,
    born_ns_out: Index,
) -> None:
    """Copy the `old` components that `chosen` has in front, and put behind them those of the measurements behind."""
    for k in range(old):
        j = chosen[k]
        copy_state(mean, covariance, j, mean_out, covariance_out, k)
        for s in range(4):
            auxiliary_out[k, s] = auxiliary[j, s]
        label_out[k], born_ns_out[k] = label[j], born_ns[j]
    count = label_out.shape[0]
    birth_states(
        chosen[old:count],
        position,
        yaw,
        velocity,
        measured_label,
        heading_speed,
        known,
        unknown,
        mean_out[old:],
        covariance_out[old:],
    )
    for k in range(old, count):
        m = chosen[k]
        for s in range(4):
            auxiliary_out[k, s] = measured_auxiliary[m, s]
        label_out[k], born_ns_out[k] = measured_label[m], stamp_ns

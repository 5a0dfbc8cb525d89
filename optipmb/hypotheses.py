"""Local data association hypotheses and their costs (Section IV.D and the birth model of IV.F).

Three kinds: an object is missed, an object is detected by a measurement, a measurement detects something for the
first time. The costs need the position alone (eq. Simplified measurement model), so the full update is left to the
hypotheses that win (`optipmb.update`). Likelihoods are kept as logarithms: weights of 1e-300 are ordinary here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.gating import gate, gate_radii
from optipmb.records import INDEX, record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis, Poissons
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

FROM_POISSON: Final = 0
"""First-time detection of what a Poisson component announced."""
CLUTTER: Final = 1
"""No component, low score: taken for clutter now, and announced as a Poisson component for later (M_low)."""
NEWBORN: Final = 2
"""No component, high score: a newborn object (M_high)."""


@record
class Hypotheses:
    """All local hypotheses of one frame. Pairs are ordered by object or component, then by measurement.

    Attributes:
        row: (K,) object of each object-measurement pair in the gate.
        measurement: (K,) measurement of each of those pairs.
        detection_cost: (K,) w of each of those pairs (eq. Detection Hypothesis Update).
        component: (L,) component of each component-measurement pair in the gate, the sets J^m.
        announced: (L,) measurement of each of those pairs.
        log_e: (L,) ln e^j of each of those pairs (eq. First-Time Detection Hypothesis Update 2).
        first_kind: (M,) `FROM_POISSON`, `CLUTTER` or `NEWBORN`.
        first_cost: (M,) w of the first-time detection of each measurement.
        first_existence: (M,) r of the Bernoulli that it would make.
        association: (M,) p_a, probability that an existing object made the measurement (eq. Association Probability).
    """

    row: Index
    measurement: Index
    detection_cost: Array
    component: Index
    announced: Index
    log_e: Array
    first_kind: Index
    first_cost: Array
    first_existence: Array
    association: Array


def enumerate_hypotheses(
    bernoulli: Bernoullis,
    p_d: Array,
    poisson: Poissons,
    p_d_poisson: Array,
    measurements: Measurements,
    dt: float,
    table: ClassTable,
) -> Hypotheses:
    """Enumerate the hypotheses that pass the class gate and the distance gate, with their costs.

    Resolutions: a likelihood outside the gate counts as zero in p_a, as its cost is infinite; mu_+ in e^j already
    contains the survival probability that Algorithm 1 writes beside it.

    Args:
        bernoulli: predicted detected objects.
        p_d: (N,) their detection probabilities.
        poisson: predicted Poisson components.
        p_d_poisson: (J,) theirs.
        measurements: Z_k.
        dt: s since the last frame.
        table: parameters as columns.
    """
    count = len(measurements)
    first_kind, first_cost = np.empty(count, INDEX), np.empty(count)
    first_existence, association = np.empty(count), np.empty(count)
    pairs = local_hypotheses(
        bernoulli.mean,
        bernoulli.covariance,
        bernoulli.label,
        bernoulli.existence,
        p_d,
        poisson.mean,
        poisson.covariance,
        poisson.label,
        poisson.weight,
        p_d_poisson,
        dt,
        table.period,
        table.gate,
        table.gate_growth,
        table.gate_deviations,
        measurements.position,
        measurements.label,
        measurements.score,
        table.noise_position,
        table.clutter_intensity,
        table.birth_intensity,
        table.birth_score,
        table.birth_over_clutter,
        first_kind,
        first_cost,
        first_existence,
        association,
    )
    return Hypotheses(*pairs, first_kind, first_cost, first_existence, association)


@kernel
def local_hypotheses(
    mean: Array,
    covariance: Array,
    label: Index,
    existence: Array,
    p_d: Array,
    mean_poisson: Array,
    covariance_poisson: Array,
    label_poisson: Index,
    weight: Array,
    p_d_poisson: Array,
    dt: float,
    period: float,
    distance: Array,
    growth: Array,
    deviations: Array,
    position: Array,
    measured_label: Index,
    score: Array,
    noise_position: Array,
    clutter_intensity: Array,
    birth_intensity: Array,
    birth_score: Array,
    birth_over_clutter: NDArray[np.bool_],
    first_kind: Index,
    first_cost: Array,
    first_existence: Array,
    association: Array,
) -> tuple[Index, Index, Array, Index, Index, Array]:
    """Enumerate the local hypotheses: return the columns of `Hypotheses` over pairs, write those over measurements."""
    radius = gate_radii(covariance, label, dt, period, distance, growth, deviations)
    radius_poisson = gate_radii(covariance_poisson, label_poisson, dt, period, distance, growth, deviations)
    close_gates(p_d, radius)
    close_gates(p_d_poisson, radius_poisson)
    row, measurement, log_likelihood = gate(mean, covariance, label, radius, position, measured_label, noise_position)
    detection_cost = detection_costs(row, measurement, log_likelihood, existence, p_d, association)
    component, announced, log_e = gate(
        mean_poisson, covariance_poisson, label_poisson, radius_poisson, position, measured_label, noise_position
    )
    for k in range(component.shape[0]):
        j = component[k]
        log_e[k] = math.log(weight[j] * p_d_poisson[j]) + log_e[k]
    first_detections(
        announced,
        log_e,
        score,
        association,
        measured_label,
        clutter_intensity,
        birth_intensity,
        birth_score,
        birth_over_clutter,
        first_kind,
        first_cost,
        first_existence,
    )
    return row, measurement, detection_cost, component, announced, log_e


@kernel
def close_gates(p_d: Array, radius: Array) -> None:
    """Write a negative radius, in which nothing lies, for what cannot be detected: no cost is that of p_d = 0.

    Args:
        p_d: (N,) detection probabilities.
        radius: (N,) gating distances, m; some are replaced.
    """
    for n in range(p_d.shape[0]):
        if p_d[n] == 0.0:
            radius[n] = -1.0


@kernel
def detection_costs(
    row: Index, measurement: Index, log_likelihood: Array, existence: Array, p_d: Array, association: Array
) -> Array:
    """Compute the cost of each detection hypothesis and the association probability of each measurement.

    ``w = -ln [r p_d N(z; z_hat, S) / (1 - r + r (1 - p_d))]`` (eq. Detection Hypothesis Update) and
    ``p_a = min[1, sum_n N(z; z_hat^n, S^n)]`` (eq. Association Probability).

    Args:
        row: (K,) object of each pair, ascending.
        measurement: (K,) measurement of each pair.
        log_likelihood: (K,) ln N of each pair.
        existence: (N,) r.
        p_d: (N,) detection probabilities.
        association: (M,) receives p_a.

    Returns:
        (K,) costs.
    """
    cost = np.empty(row.shape[0])
    association[:] = 0.0
    before, missed, detected = -1, 0.0, 0.0
    for k in range(row.shape[0]):
        if row[k] != before:  # what the pairs of an object share
            before = row[k]
            r, p = existence[before], p_d[before]
            missed, detected = math.log(1.0 - r + r * (1.0 - p)), math.log(r * p)
        cost[k] = missed - detected - log_likelihood[k]
        association[measurement[k]] += math.exp(log_likelihood[k])
    for m in range(association.shape[0]):
        association[m] = min(association[m], 1.0)
    return cost


@kernel
def first_detections(
    measurement: Index,
    log_e: Array,
    score: Array,
    association: Array,
    label: Index,
    clutter_intensity: Array,
    birth_intensity: Array,
    birth_score: Array,
    birth_over_clutter: NDArray[np.bool_],
    kind: Index,
    cost: Array,
    existence: Array,
) -> None:
    """Compute kind, cost and existence of the first-time detection hypothesis of each measurement.

    With components in the gate (eq. First-Time Detection Hypothesis Update 1): ``w = -ln(e + lambda_c)``, ``r = e /
    (e + lambda_c)``. Without, by the hybrid adaptive birth model: a low score is clutter (eq. Clutter Hypothesis),
    ``w = -ln lambda_c``, ``r = 0``; a high score is newborn (eq. Newborn Hypothesis), ``w = -ln[mu_b0 (1 - p_a) / A
    + lambda_c]``, ``r = 1``.

    Where `birth_over_clutter` is set, a component that explains a high score no better than clutter does, ``e <
    lambda_c``, announces nothing: the measurement is newborn, and not lost between a component that it does not fit
    and a birth that the component forbids.

    Args:
        measurement: (L,) measurement of each announced pair.
        log_e: (L,) ln e^j.
        score: (M,) z_s.
        association: (M,) p_a.
        label: (M,) z_c.
        clutter_intensity: (C,) lambda_c.
        birth_intensity: (C,) mu_b0 / A.
        birth_score: (C,) eta_score.
        birth_over_clutter: (C,) whether a high score needs a component that is likelier than clutter.
        kind: (M,) receives `FROM_POISSON`, `CLUTTER` or `NEWBORN`.
        cost: (M,) receives w.
        existence: (M,) receives r.
    """
    n_measurements = score.shape[0]
    log_sum = np.full(n_measurements, -math.inf)  # ln e, e = sum_j e^j
    kind[:] = CLUTTER
    for k in range(measurement.shape[0]):
        m = measurement[k]
        kind[m] = FROM_POISSON
        larger, smaller = max(log_sum[m], log_e[k]), min(log_sum[m], log_e[k])
        log_sum[m] = larger if smaller == -math.inf else larger + math.log1p(math.exp(smaller - larger))
    for m in range(n_measurements):
        c = label[m]
        clutter = clutter_intensity[c]
        shadowed = birth_over_clutter[c] and score[m] >= birth_score[c] and log_sum[m] < math.log(clutter)
        if kind[m] == FROM_POISSON and not shadowed:
            ratio = math.exp(min(log_sum[m] - math.log(clutter), 700.0))  # e / lambda_c
            cost[m] = -math.log(clutter) - math.log1p(ratio)
            existence[m] = ratio / (1.0 + ratio)
        elif score[m] < birth_score[c]:
            cost[m] = -math.log(clutter)
            existence[m] = 0.0
        else:
            kind[m] = NEWBORN
            cost[m] = -math.log(birth_intensity[c] * (1.0 - association[m]) + clutter)
            existence[m] = 1.0

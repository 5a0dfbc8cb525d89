"""Local data association hypotheses and their costs (Section IV.D and the birth model of IV.G).

Three kinds: an object is missed, an object is detected by a measurement, a measurement detects something for the
first time. The costs need the position alone (eq. Simplified measurement model), so the full update is left to the
hypotheses that win (`optipmb.update`). Likelihoods are kept as logarithms: weights of 1e-300 are ordinary here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.class_posterior import weigh_by_class
from optipmb.compiled import kernel
from optipmb.gating import gate, gate_radii

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis, Poissons
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

FROM_POISSON: Final = 0
"""First-time detection of what a Poisson component announced."""
CLUTTER: Final = 1
"""No component, low score: taken for clutter now, and announced as a Poisson component for later (M_low)."""
NEWBORN: Final = 2
"""No component, high score: a newborn object (M_high)."""


class Hypotheses(NamedTuple):
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


@kernel
def local_hypotheses(
    objects: Bernoullis,
    class_probability: Array,
    p_d: Array,
    components: Poissons,
    p_d_poisson: Array,
    measurements: Measurements,
    dt: float,
    confusion: Array,
    classes: Sequence[ClassRow],
) -> Hypotheses:
    """Enumerate the hypotheses that pass the class gate and the distance gate, with their costs.

    Resolutions: a likelihood outside the gate counts as zero in p_a, as its cost is infinite; mu_+ in e^j already
    contains the survival probability that Algorithm 1 writes beside it. Where classes have groups, the gate of an
    object is open to its group, and the likelihood has the factor p(d) of `optipmb.class_posterior`.

    Args:
        objects: predicted detected objects.
        class_probability: (N, C) their pi_+.
        p_d: (N,) their detection probabilities.
        components: predicted Poisson components.
        p_d_poisson: (J,) theirs.
        measurements: Z_k.
        dt: s since the last frame.
        confusion: (C, C) Lambda; (0, 0) where no classes have a group in common.
        classes: (C,) parameters.
    """
    grouped = confusion.shape[0] > 0
    position, label = measurements.position, measurements.label
    radius = gate_radii(objects.covariance, objects.label, dt, classes)
    radius_poisson = gate_radii(components.covariance, components.label, dt, classes)
    close_gates(p_d, radius)
    close_gates(p_d_poisson, radius_poisson)
    row, measurement, log_likelihood = gate(
        objects.mean, objects.covariance, objects.label, radius, position, label, classes, grouped
    )
    if grouped:
        weigh_by_class(row, measurement, log_likelihood, class_probability, measurements, confusion, classes)
    association = np.empty(label.shape[0])
    detection_cost = detection_costs(row, measurement, log_likelihood, objects.existence, p_d, association)
    component, announced, log_e = gate(
        components.mean, components.covariance, components.label, radius_poisson, position, label, classes, False
    )
    for k in range(component.shape[0]):
        j = component[k]
        log_e[k] = math.log(components.weight[j] * p_d_poisson[j]) + log_e[k]
    kind, cost, existence = first_detections(announced, log_e, measurements.score, association, label, classes)
    return Hypotheses(row, measurement, detection_cost, component, announced, log_e, kind, cost, existence, association)


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
    classes: Sequence[ClassRow],
) -> tuple[Index, Array, Array]:
    """Compute kind, cost and existence of the first-time detection hypothesis of each measurement.

    With components in the gate (eq. First-Time Detection Hypothesis Update 1): ``w = -ln(e + lambda_c)``, ``r = e /
    (e + lambda_c)``. Without, by the hybrid adaptive birth model: a low score is clutter (eq. Clutter Hypothesis),
    ``w = -ln lambda_c``, ``r = 0``; a high score is newborn (eq. Newborn Hypothesis), ``w = -ln[mu_b0 (1 - p_a) / A
    + lambda_c]``, ``r = 1``.

    Where `birth_over_clutter` is set, a component that explains a high score no better than clutter does, ``e <
    lambda_c``, announces nothing: the measurement is newborn, and not lost between a component that it does not fit
    and a birth that the component forbids.

    A score below `announce_score` is clutter, with components or without.

    Args:
        measurement: (L,) measurement of each announced pair.
        log_e: (L,) ln e^j.
        score: (M,) z_s.
        association: (M,) p_a.
        label: (M,) z_c.
        classes: (C,) parameters: lambda_c, mu_b0 / A, eta_score, `announce_score` and
            `birth_over_clutter`.

    Returns:
        (M,) `FROM_POISSON`, `CLUTTER` or `NEWBORN`, (M,) w and (M,) r.
    """
    n_measurements = score.shape[0]
    kind, cost, existence = np.empty(n_measurements, np.int64), np.empty(n_measurements), np.empty(n_measurements)
    log_sum = np.full(n_measurements, -math.inf)  # ln e, e = sum_j e^j
    kind[:] = CLUTTER
    for k in range(measurement.shape[0]):
        m = measurement[k]
        kind[m] = FROM_POISSON
        larger, smaller = max(log_sum[m], log_e[k]), min(log_sum[m], log_e[k])
        log_sum[m] = larger if smaller == -math.inf else larger + math.log1p(math.exp(smaller - larger))
    for m in range(n_measurements):
        own = classes[label[m]]
        clutter = own.clutter_intensity
        if score[m] < own.announce_score:
            kind[m] = CLUTTER
        shadowed = own.birth_over_clutter and score[m] >= own.birth_score and log_sum[m] < math.log(clutter)
        if kind[m] == FROM_POISSON and not shadowed:
            ratio = math.exp(min(log_sum[m] - math.log(clutter), 700.0))  # e / lambda_c
            cost[m] = -math.log(clutter) - math.log1p(ratio)
            existence[m] = ratio / (1.0 + ratio)
        elif score[m] < own.birth_score:
            cost[m] = -math.log(clutter)
            existence[m] = 0.0
        else:
            kind[m] = NEWBORN
            cost[m] = -math.log(own.birth_intensity * (1.0 - association[m]) + clutter)
            existence[m] = 1.0
    return kind, cost, existence

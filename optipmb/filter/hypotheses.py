"""Gates, and local data association hypotheses with their costs (Section IV.D and the birth model of IV.G).

Three kinds: an object is missed, an object is detected by a measurement, a measurement detects something for the
first time. The costs need the position alone (eq. Simplified measurement model), so the full update is left to the
hypotheses that win (`optipmb.filter.update`). Likelihoods are kept as logarithms: weights of 1e-300 are ordinary here.
The pairs of a step are counted before it looks at them: they are what a frame costs.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.class_posterior import weigh_by_class
from optipmb.filter.geometry import END_OF_CHAIN, block, empty_torus, insert
from optipmb.filter.predict import heading_unknown, wrap
from optipmb.model.density import OMEGA, PHI, STATE, A, V, X, Y
from optipmb.model.errors import EffortError
from optipmb.model.frame import PLAIN

if TYPE_CHECKING:
    from optipmb.filter.class_posterior import Groups
    from optipmb.model.density import Bernoullis, Density, Moment, Poissons
    from optipmb.model.rows import Array, Index
    from optipmb.model.stages import Measurements
    from optipmb.model.table import Classes, ClassTable

    Targets = tuple[Array, Index, Array]  # positions, classes or groups, and widening of measurements

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
    components: Poissons,
    p_d: Array,
    measurements: Measurements,
    groups: Groups,
    dt: float,
    classes: Classes,
) -> Hypotheses:
    """Enumerate the hypotheses that pass the class gate and the distance gate, with their costs.

    Resolutions: a likelihood outside the gate counts as zero in p_a, as its cost is infinite; mu_+ in e^j already
    contains the survival probability, which Algorithm 1 writes out. Where classes have groups, the gate of an
    object is open to its group, and the likelihood has the factor p(d) of `optipmb.filter.class_posterior`.
    """
    grouped, count = groups.confusion.shape[0] > 0, objects.label.shape[0]
    position, label = measurements.position, measurements.label
    radius = gate_radii(objects.covariance, objects.label, dt, classes)
    radius_poisson = gate_radii(components.covariance, components.label, dt, classes)
    close_gates(p_d[:count], radius)
    close_gates(p_d[count:], radius_poisson)
    row, measurement, log_likelihood = gate(
        objects.mean, objects.covariance, objects.label, radius, position, label, classes, grouped
    )
    exclude_turned(row, measurement, log_likelihood, objects, measurements, classes)
    spacing, clutter = crowd(measurements, classes)
    exclude_neighbours(row, measurement, log_likelihood, objects, measurements, spacing, classes)
    if grouped:
        weigh_by_class(row, measurement, log_likelihood, measurements, groups, classes)
    association = np.empty(label.shape[0])
    detection_cost = detection_costs(row, measurement, log_likelihood, objects.existence, p_d[:count], association)
    component, announced, log_e = gate(
        components.mean, components.covariance, components.label, radius_poisson, position, label, classes, False
    )
    for k in range(component.shape[0]):
        j = component[k]
        log_e[k] = math.log(components.weight[j] * p_d[count + j]) + log_e[k]
    kind, cost, existence = first_detections(announced, log_e, measurements.score, association, label, clutter, classes)
    return Hypotheses(row, measurement, detection_cost, component, announced, log_e, kind, cost, existence, association)


@kernel
def close_gates(p_d: Array, radius: Array) -> None:
    """Write a negative radius, in which nothing lies, for objects that cannot be detected: p_d = 0 has no cost."""
    for n in range(p_d.shape[0]):
        if p_d[n] == 0.0:
            radius[n] = -1.0


TURNED: Final = 1.5
"""Standard deviations of a heading beyond which a detection outside eta_dist is not of the object."""


@kernel
def exclude_turned(
    row: Index,
    measurement: Index,
    log_likelihood: Array,
    objects: Bernoullis,
    measurements: Measurements,
    classes: Classes,
) -> None:
    """Write a likelihood of zero for pairs outside eta_dist whose headings do not agree, modulo pi.

    This is not in the paper. A gate that is wide for an unknown speed holds the neighbours of a parked car that is
    missed. An object that went so far in a frame kept to its heading. Unknown headings exclude nothing.
    """
    widening = gate_widening(measurements.position, measurements.label, classes)
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        if math.isnan(measurements.yaw[m]) or heading_unknown(objects.covariance[n]):
            continue
        own, position = classes[objects.label[n]], measurements.position[m]
        squared = (position[0] - objects.mean[n, X]) ** 2 + (position[1] - objects.mean[n, Y]) ** 2
        turn = 0.5 * wrap(2.0 * (measurements.yaw[m] - objects.mean[n, PHI]))
        variance = objects.covariance[n, PHI, PHI] + own.noise_heading**2
        if squared > own.gate**2 + widening[m] and turn**2 > TURNED**2 * variance:
            log_likelihood[k] = -math.inf


FALSE_SHARE: Final = 0.05
"""False detections in a crowd, relative to people."""


@kernel
def crowd(measurements: Measurements, classes: Classes) -> tuple[Array, Array]:
    """Return the distance of each measurement to the next of its class within eta_dist (M,), and lambda_c (M,).

    This is not in the paper, which spreads clutter evenly over an area. Where a class is `crowded`, false detections
    are also expected where objects are, `FALSE_SHARE` of them:

        lambda_c = mu_c / A + FALSE_SHARE sum_m' z_s' / (pi eta_dist^2)     m' within eta_dist of m

    Without a neighbour the distance is infinite.
    """
    position, label, count = measurements.position, measurements.label, measurements.label.shape[0]
    spacing, clutter = np.full(count, math.inf), np.empty(count)
    head, following, side = empty_torus(count)
    for m in range(count):
        own = classes[label[m]]
        clutter[m] = own.clutter_intensity
        if own.crowded:
            insert(head, following, side, m, position[m, 0], position[m, 1], 2.0 * own.gate)
    for m in range(count):
        own = classes[label[m]]
        if not own.crowded:
            continue
        squared, expected = own.gate**2, 0.0
        first_x, last_x, first_y, last_y = block(position[m, 0], position[m, 1], own.gate, 2.0 * own.gate)
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                k = head[(i & (side - 1)) * side + (j & (side - 1))]
                while k != END_OF_CHAIN:
                    dx, dy = position[k, 0] - position[m, 0], position[k, 1] - position[m, 1]
                    if k != m and label[k] == label[m] and dx * dx + dy * dy <= squared:
                        spacing[m] = min(spacing[m], math.hypot(dx, dy))
                        expected += measurements.score[k]
                    k = following[k]
        clutter[m] += FALSE_SHARE * expected / (math.pi * squared)
    return spacing, clutter


@kernel
def exclude_neighbours(
    row: Index,
    measurement: Index,
    log_likelihood: Array,
    objects: Bernoullis,
    measurements: Measurements,
    spacing: Array,
    classes: Classes,
) -> None:
    """Write a likelihood of zero for pairs farther apart than the measurement is from its neighbour.

    This is not in the paper. Where people stand closer than the gate is wide, one who is missed would take the next
    one's detection. Pairs within the ellipse of 99 % stay.
    """
    position = measurements.position
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        dx, dy = position[m, 0] - objects.mean[n, X], position[m, 1] - objects.mean[n, Y]
        if dx * dx + dy * dy <= spacing[m] ** 2:
            continue
        variance, covariance = classes[measurements.label[m]].noise_position ** 2, objects.covariance[n]
        rho_xx, rho_xy, rho_yy = 1.0, 0.0, 1.0
        if position.shape[1] > PLAIN:
            rho_xx, rho_xy, rho_yy = position[m, 2], position[m, 3], position[m, 4]
        s_xx, s_yy = covariance[X, X] + variance * rho_xx, covariance[Y, Y] + variance * rho_yy
        s_xy = covariance[X, Y] + variance * rho_xy
        squared = s_yy * dx * dx - 2.0 * s_xy * dx * dy + s_xx * dy * dy
        if squared > DEVIATIONS_2 * (s_xx * s_yy - s_xy * s_xy):
            log_likelihood[k] = -math.inf


HEADWAY: Final = 0.75
"""Time, s, by which hardly any vehicle follows another one, from centre to centre."""

SLOW: Final = 0.5
"""Standard deviation of the speed of an object that stands or hardly moves, m/s."""


@kernel
def halt(objects: Bernoullis, measurements: Measurements, moment: Moment, classes: Classes) -> None:
    """Predict in place that an object stands whose speed is new and that is detected again where it was last.

    This is not in the paper. Where a parked car is missed and the next of its row is detected, one detection each, the
    gate of the unknown speed takes them for one fast car, which then goes along the row. Another car does not follow
    within `HEADWAY`: a parallel box at the place that the object would have left, sure enough to start a track, is the
    object. Weaker ones may be echoes of what moves on, and detections with velocities need no such guess.
    """
    for n in range(objects.label.shape[0]):
        own, mean, covariance = classes[objects.label[n]], objects.mean[n], objects.covariance[n]
        known, passed = objects.seen_ns[n] - objects.born_ns[n], (moment.stamp_ns - objects.seen_ns[n]) * 1e-9
        way = mean[V] * passed
        if known > HEADWAY * 1e9 or passed > HEADWAY or abs(way) <= own.gate or heading_unknown(covariance):
            continue
        phi = mean[PHI] - 0.5 * mean[OMEGA] * passed
        cos_phi, sin_phi = math.cos(phi), math.sin(phi)
        x, y = mean[X] - way * cos_phi, mean[Y] - way * sin_phi
        across_2 = 2.0 * own.noise_position**2
        along_2 = across_2 + (SLOW * passed) ** 2
        for m in range(measurements.label.shape[0]):
            dx, dy = measurements.position[m, 0] - x, measurements.position[m, 1] - y
            along, across = cos_phi * dx + sin_phi * dy, cos_phi * dy - sin_phi * dx
            turn = 0.5 * wrap(2.0 * (measurements.yaw[m] - phi))
            if (
                measurements.score[m] >= own.birth_score
                and math.isnan(measurements.velocity[m, 0])
                and classes[measurements.label[m]].group == own.group
                and along**2 / along_2 + across**2 / across_2 <= DEVIATIONS_2
                and turn**2 <= (TURNED * own.noise_heading) ** 2
            ):
                mean[X], mean[Y], mean[PHI], mean[V], mean[OMEGA], mean[A] = x, y, phi, 0.0, 0.0, 0.0
                for s in range(STATE):
                    for t in range(STATE):
                        covariance[s, t] = own.birth_unknown[s] ** 2 if s == t else 0.0
                covariance[V, V] = SLOW**2
                break


@kernel
def detection_costs(
    row: Index, measurement: Index, log_likelihood: Array, existence: Array, p_d: Array, association: Array
) -> Array:
    """Compute the cost of each detection hypothesis and the association probability of each measurement.

    ``w = -ln [r p_d N(z; z_hat, S) / (1 - r + r (1 - p_d))]`` (eq. Detection Hypothesis Update) and
    ``p_a = min[1, sum_n N(z; z_hat^n, S^n)]`` (eq. Association Probability), which `association` (M,) receives.
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
    measurement: Index, log_e: Array, score: Array, association: Array, label: Index, clutter: Array, classes: Classes
) -> tuple[Index, Array, Array]:
    """Compute kind, cost and existence of the first-time detection hypothesis of each measurement.

    With components in the gate (eq. First-Time Detection Hypothesis Update 1): ``w = -ln(e + lambda_c)``, ``r = e /
    (e + lambda_c)``. Without, by the hybrid adaptive birth model: a low score is clutter (eq. Clutter Hypothesis),
    ``w = -ln lambda_c``, ``r = 0``; a high score is newborn (eq. Newborn Hypothesis), ``w = -ln[mu_b0 (1 - p_a) / A
    + lambda_c]``, ``r = 1``.

    Where `birth_over_clutter` is set, a component that explains a high score no better than clutter does, ``e <
    lambda_c``, announces nothing: the measurement is newborn, and not lost between a component that it does not fit
    and a birth that the component forbids.

    A score below `announce_score` is clutter, with components or without. `clutter` (M,) has lambda_c.
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
        own, lambda_c = classes[label[m]], clutter[m]
        if score[m] < own.announce_score:
            kind[m] = CLUTTER
        shadowed = own.birth_over_clutter and score[m] >= own.birth_score and log_sum[m] < math.log(lambda_c)
        if kind[m] == FROM_POISSON and not shadowed:
            ratio = math.exp(min(log_sum[m] - math.log(lambda_c), 700.0))  # e / lambda_c
            cost[m] = -math.log(lambda_c) - math.log1p(ratio)
            existence[m] = ratio / (1.0 + ratio)
        elif score[m] < own.birth_score:
            cost[m] = -math.log(lambda_c)
            existence[m] = 0.0
        else:
            kind[m] = NEWBORN
            cost[m] = -math.log(own.birth_intensity * (1.0 - association[m]) + lambda_c)
            existence[m] = 1.0
    return kind, cost, existence


DEVIATIONS_2: Final = 9.21
"""Squared standard deviations of a position in the plane that 99 % of detections are within: chi^2 of 2 dimensions."""

MAX_RADIUS: Final = 1e6
"""No gate is wider, m, however uncertain a speed and however long a silence."""

UNLIMITED: Final = 2**62
"""More pairs than any frame has."""

FEW: Final = 256
"""Up to so many measurements it is faster to look at all of them than to find the neighbours among them."""


@kernel
def gate_radii(covariance: Array, label: Index, dt: float, classes: Classes) -> Array:
    """Compute the gating distance of each object.

    It is eta_dist, and at least the way that its speed may deviate: so many standard deviations of v over dt. The paper
    has eta_dist alone, at the one frame rate of a data set.
    """
    radius = np.empty(label.shape[0])
    for n in range(label.shape[0]):
        own = classes[label[n]]
        radius[n] = own.gate
        reach = own.gate_deviations * math.sqrt(max(covariance[n, V, V], 0.0)) * dt
        if reach > radius[n]:  # noqa: PLR1730 - max() would keep NaN
            radius[n] = reach
        radius[n] = min(radius[n], MAX_RADIUS)
    return radius


@kernel
def gate_widening(position: Array, label: Index, classes: Classes) -> Array:
    """Compute by how much each detection widens the gates that it may lie in.

    eta_dist is chosen for detections with R of their class. What R_m of a detection has beyond it widens the gate, as
    variances add up: ``eta^2 + chi^2 max(0, lambda_1(R_m) - sigma^2)``, lambda_1 the larger eigenvalue, chi^2 the
    quantile `DEVIATIONS_2`. A detection that is more accurate than its class has the gate of the class.

    Returns:
        (M,) m^2, to be added to the squares of gating distances.
    """
    widening = np.zeros(label.shape[0])
    if position.shape[1] > PLAIN:
        for m in range(label.shape[0]):
            rho_xx, rho_xy, rho_yy = position[m, 2], position[m, 3], position[m, 4]
            largest = 0.5 * (rho_xx + rho_yy) + math.hypot(0.5 * (rho_xx - rho_yy), rho_xy)
            variance = classes[label[m]].noise_position ** 2
            widening[m] = min(DEVIATIONS_2 * variance * max(0.0, largest - 1.0), MAX_RADIUS**2)
    return widening


@kernel
def gate(
    mean: Array,
    covariance: Array,
    label: Index,
    radius: Array,
    position: Array,
    measured_label: Index,
    classes: Classes,
    by_group: bool,
) -> tuple[Index, Index, Array]:
    """Find the measurements of an object's class or group within its gate and their position likelihoods.

    Arguments of its own:
        radius: (N,) gating distances, m, for detections with R of their class; nothing lies in a negative one.
        by_group: whether the gate is open to all classes of the object's group.

    Returns:
        Objects, measurements and log-likelihoods ln N(z_xy; z_hat, S) of the pairs (eq. Predicted Measurement),
        ordered by object, then measurement.
    """
    widening = gate_widening(position, measured_label, classes)
    kind, measured_kind = label, measured_label
    if by_group:
        kind, measured_kind = groups(label, classes), groups(measured_label, classes)
    targets = position, measured_kind, widening
    if position.shape[0] <= FEW:
        row, measurement = pairs_of_few(mean, kind, radius, targets, len(classes))
    else:
        row, measurement = pairs_of_many(mean, kind, radius, targets, len(classes), UNLIMITED)
        sort_measurements(row, measurement)
    log_likelihood = np.empty(row.shape[0])
    own_noise = position.shape[1] > PLAIN
    rho_xx, rho_xy, rho_yy = 1.0, 0.0, 1.0
    before = -1
    s_xx = s_xy = s_yy = determinant = constant = 0.0
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        if n != before or own_noise or by_group:  # what the pairs of an object share
            before = n
            variance = classes[measured_label[m]].noise_position ** 2
            if own_noise:
                rho_xx, rho_xy, rho_yy = position[m, 2], position[m, 3], position[m, 4]
            s_xx, s_yy = covariance[n, 0, 0] + variance * rho_xx, covariance[n, 1, 1] + variance * rho_yy
            s_xy = covariance[n, 0, 1] + variance * rho_xy
            determinant = s_xx * s_yy - s_xy * s_xy
            constant = -math.log(2.0 * math.pi) - 0.5 * math.log(determinant)
        dx, dy = position[m, 0] - mean[n, 0], position[m, 1] - mean[n, 1]
        squared = (s_yy * dx * dx - 2.0 * s_xy * dx * dy + s_xx * dy * dy) / determinant
        log_likelihood[k] = constant - 0.5 * squared
    return row, measurement, log_likelihood


@kernel
def sort_measurements(row: Index, measurement: Index) -> None:
    """Sort the measurements of each object."""
    begin = 0
    for k in range(row.shape[0]):
        if row[k] != row[begin]:
            begin = k
        m, slot = measurement[k], k
        while slot > begin and measurement[slot - 1] > m:
            measurement[slot] = measurement[slot - 1]
            slot -= 1
        measurement[slot] = m


@kernel
def groups(label: Index, classes: Classes) -> Index:
    """Return the group (N,) of each class of `label` (N,)."""
    group = np.empty(label.shape[0], np.int64)
    for n in range(label.shape[0]):
        group[n] = classes[label[n]].group
    return group


@kernel
def pairs_of_few(mean: Array, label: Index, radius: Array, targets: Targets, classes: int) -> tuple[Index, Index]:
    """Find the pairs within the gates by looking at every measurement of a class; arguments and order as in `gate`."""
    position, measured_label, widening = targets
    n_measurements = position.shape[0]
    capacity = 2 * (mean.shape[0] + n_measurements) + 16 if mean.shape[0] else 0
    row, measurement = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    # The measurements, class after class.
    start = np.zeros(classes + 2, np.int64)
    for c in measured_label:
        start[c + 2] += 1
    for c in range(classes):
        start[c + 2] += start[c + 1]
    x, y, which = np.empty(n_measurements), np.empty(n_measurements), np.empty(n_measurements, np.int64)
    wider = np.empty(n_measurements)
    for m in range(n_measurements):
        k = start[measured_label[m] + 1]
        x[k], y[k], wider[k], which[k] = position[m, 0], position[m, 1], widening[m], m
        start[measured_label[m] + 1] += 1  # in the end where the next class starts

    count = 0
    for n in range(mean.shape[0]):
        if count + n_measurements > capacity:
            capacity = 2 * (count + n_measurements)
            row, measurement = _grown(row, capacity), _grown(measurement, capacity)
        if radius[n] < 0.0:
            continue
        eta_2, x_n, y_n = radius[n] * radius[n], mean[n, 0], mean[n, 1]
        for k in range(start[label[n]], start[label[n] + 1]):
            dx, dy = x[k] - x_n, y[k] - y_n
            limit = eta_2 + wider[k]
            if dx * dx <= limit and dx * dx + dy * dy <= limit:  # most are too far along x already
                row[count], measurement[count] = n, which[k]
                count += 1
    return row[:count], measurement[:count]


@kernel
def pairs_of_many(
    mean: Array, label: Index, radius: Array, targets: Targets, classes: int, most: int
) -> tuple[Index, Index]:
    """Find the pairs within the gates by looking at neighbours, until there are more than `most`; ordered by object.

    The measurements stand in a torus of cells twice as wide as the widest gate of their class, so that a gate touches
    at most three cells along each axis.
    """
    position, measured_label, widening = targets
    capacity = 2 * (mean.shape[0] + position.shape[0]) + 16 if mean.shape[0] else 0
    row, measurement = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    widest, wider = np.zeros(classes), np.zeros(classes)
    for m in range(position.shape[0]):
        wider[measured_label[m]] = max(wider[measured_label[m]], widening[m])
    for n in range(mean.shape[0]):
        widest[label[n]] = max(widest[label[n]], math.sqrt(radius[n] * radius[n] + wider[label[n]]))
    head, following, side = empty_torus(position.shape[0])
    for m in range(position.shape[0]):
        insert(head, following, side, m, position[m, 0], position[m, 1], 2.0 * widest[measured_label[m]])
    count = 0
    for n in range(mean.shape[0]):
        eta = radius[n]
        if eta < 0.0 or count > most:
            continue
        eta_2 = eta * eta
        reach = math.sqrt(eta_2 + wider[label[n]])
        first_x, last_x, first_y, last_y = block(mean[n, 0], mean[n, 1], reach, 2.0 * widest[label[n]])
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                m = head[(i & (side - 1)) * side + (j & (side - 1))]
                while m != END_OF_CHAIN:
                    dx, dy = position[m, 0] - mean[n, 0], position[m, 1] - mean[n, 1]
                    if dx * dx + dy * dy <= eta_2 + widening[m] and measured_label[m] == label[n]:
                        if count == capacity:
                            capacity *= 2
                            row, measurement = _grown(row, capacity), _grown(measurement, capacity)
                        row[count], measurement[count] = n, m
                        count += 1
                    m = following[m]
    return row[:count], measurement[:count]


@kernel
def _grown(array: Index, capacity: int) -> Index:
    larger = np.empty(capacity, array.dtype)
    for k in range(array.shape[0]):
        larger[k] = array[k]
    return larger


def check_effort(prior: Density, measurements: Measurements, dt: float, table: ClassTable, most: int) -> None:
    """Refuse a frame with too many pairs in the gates.

    Measurements count that lie in the gate of a predicted object or Poisson component, or of a measurement, which may
    be an object of the next step.

    Raises:
        EffortError: there are more than `most`.
    """
    bernoulli, poisson, count = prior.bernoulli, prior.poisson, measurements.score.shape[0]
    if (len(bernoulli) + len(poisson) + count) * count <= most:
        return
    positions = np.concatenate((bernoulli.mean[:, :2], poisson.mean[:, :2], measurements.position[:, :2]))
    labels = np.concatenate((bernoulli.label, poisson.label, measurements.label))
    radius = np.concatenate(
        (
            gate_radii(bernoulli.covariance, bernoulli.label, dt, table.classes),
            gate_radii(poisson.covariance, poisson.label, dt, table.classes),
            table["gate"][measurements.label],
        )
    )
    widening = gate_widening(measurements.position, measurements.label, table.classes)
    group = table["group"]
    targets = measurements.position, group[measurements.label], widening
    if len(pairs_of_many(positions, group[labels], radius, targets, len(table.classes), most)[0]) > most:
        raise EffortError("center", f"at most {most} pairs of an object and a detection in its gate", "more")

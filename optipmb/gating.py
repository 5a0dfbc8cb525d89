"""Gates: which measurements are near enough to an object to be its own (Section IV.D), and how likely they are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import V
from optipmb.neighbours import NOBODY, block, empty_torus, insert
from optipmb.position_noise import PLAIN

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

DEVIATIONS_2: Final = 9.21
"""Squared standard deviations of a position in the plane that 99 % of detections are within: chi^2 of 2 dimensions."""

MAX_RADIUS: Final = 1e6
"""No gate is wider, m, however uncertain a speed and however long a silence."""

FEW: Final = 256
"""Up to so many measurements it is faster to look at all of them than to find the neighbours among them."""


@kernel
def gate_radii(
    covariance: Array,
    label: Index,
    dt: float,
    classes: Sequence[ClassRow],
) -> Array:
    """Compute the gating distance of each object.

    It is eta_dist, and at least the way that its speed may deviate: so many standard deviations of v over dt. The paper
    has eta_dist alone, at the one frame rate of a data set.

    Args:
        covariance: (N, 6, 6) predicted covariances.
        label: (N,) classes.
        dt: s since the last frame.
        classes: (C,) parameters: eta_dist, and how many standard deviations of v.

    Returns:
        (N,) m.
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
def gate_widening(position: Array, label: Index, classes: Sequence[ClassRow]) -> Array:
    """Compute by how much each detection widens the gates that it may lie in.

    eta_dist is chosen for detections with R of their class. What R_m of a detection has beyond it widens the gate, as
    variances add up: ``eta^2 + chi^2 max(0, lambda_1(R_m) - sigma^2)``, lambda_1 the larger eigenvalue, chi^2 the
    quantile `DEVIATIONS_2`. A detection that is more accurate than its class has the gate of the class.

    Args:
        position: (M, 2) z_xy, or (M, 5) with rho, R_m = sigma^2 rho.
        label: (M,) z_c.
        classes: (C,) parameters: sigma.

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
    classes: Sequence[ClassRow],
    by_group: bool,
) -> tuple[Index, Index, Array]:
    """Find the measurements of an object's class or group within its gate and their position likelihoods.

    Args:
        mean: (N, 6) predicted means.
        covariance: (N, 6, 6) predicted covariances.
        label: (N,) classes.
        radius: (N,) gating distances, m, for detections with R of their class; nothing lies in a negative one.
        position: (M, 2) z_xy, or (M, 5) with rho.
        measured_label: (M,) z_c.
        classes: (C,) parameters: sigma of R_xy = sigma^2 rho, and rho = I without one.
        by_group: whether the gate is open to all classes of the object's group.

    Returns:
        Objects, measurements and log-likelihoods ln N(z_xy; z_hat, S) of the pairs (eq. Predicted Measurement),
        ordered by object, then measurement.
    """
    widening = gate_widening(position, measured_label, classes)
    kind, measured_kind = label, measured_label
    if by_group:
        kind, measured_kind = groups(label, classes), groups(measured_label, classes)
    if position.shape[0] <= FEW:
        row, measurement = pairs_of_few(mean, kind, radius, position, measured_kind, widening, len(classes))
    else:
        row, measurement = pairs_of_many(mean, kind, radius, position, measured_kind, widening, len(classes))
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
def groups(label: Index, classes: Sequence[ClassRow]) -> Index:
    """Return the group (N,) of each class of `label` (N,)."""
    group = np.empty(label.shape[0], np.int64)
    for n in range(label.shape[0]):
        group[n] = classes[label[n]].group
    return group


@kernel
def pairs_of_few(
    mean: Array,
    label: Index,
    radius: Array,
    position: Array,
    measured_label: Index,
    widening: Array,
    classes: int,
) -> tuple[Index, Index]:
    """Find the pairs within the gates by looking at every measurement of a class; arguments and order as in `gate`."""
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
    mean: Array,
    label: Index,
    radius: Array,
    position: Array,
    measured_label: Index,
    widening: Array,
    classes: int,
) -> tuple[Index, Index]:
    """Find the pairs within the gates by looking at neighbours; arguments and order as in `gate`.

    The measurements stand in a torus of cells twice as wide as the widest gate of their class, so that a gate touches
    at most three cells along each axis.
    """
    capacity = 2 * (mean.shape[0] + position.shape[0]) + 16 if mean.shape[0] else 0
    row, measurement = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    widest, most = np.zeros(classes), np.zeros(classes)
    for m in range(position.shape[0]):
        most[measured_label[m]] = max(most[measured_label[m]], widening[m])
    for n in range(mean.shape[0]):
        widest[label[n]] = max(widest[label[n]], math.sqrt(radius[n] * radius[n] + most[label[n]]))
    head, following, side = empty_torus(position.shape[0])
    for m in range(position.shape[0]):
        insert(head, following, side, m, position[m, 0], position[m, 1], 2.0 * widest[measured_label[m]])
    count = 0
    for n in range(mean.shape[0]):
        eta = radius[n]
        if eta < 0.0:
            continue
        begin, eta_2 = count, eta * eta
        reach = math.sqrt(eta_2 + most[label[n]])
        first_x, last_x, first_y, last_y = block(mean[n, 0], mean[n, 1], reach, 2.0 * widest[label[n]])
        for i in range(first_x, last_x + 1):
            for j in range(first_y, last_y + 1):
                m = head[(i & (side - 1)) * side + (j & (side - 1))]
                while m != NOBODY:
                    dx, dy = position[m, 0] - mean[n, 0], position[m, 1] - mean[n, 1]
                    if dx * dx + dy * dy <= eta_2 + widening[m] and measured_label[m] == label[n]:
                        if count == capacity:
                            capacity *= 2
                            row, measurement = _grown(row, capacity), _grown(measurement, capacity)
                        slot = count  # keep the measurements of this object in ascending order
                        while slot > begin and measurement[slot - 1] > m:
                            measurement[slot] = measurement[slot - 1]
                            slot -= 1
                        measurement[slot] = m
                        row[count] = n
                        count += 1
                    m = following[m]
    return row[:count], measurement[:count]


@kernel
def _grown(array: Index, capacity: int) -> Index:
    larger = np.empty(capacity, array.dtype)
    larger[: array.shape[0]] = array
    return larger

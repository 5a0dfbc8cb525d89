"""Motion states of the posterior: the unscented update (eq. UKF Update) and births (Sections IV.D.2 and IV.G).

The update runs for the pairs of the best global hypothesis only: costs need the position alone. z_M = [x, y, v_x, v_y,
phi] = H(x_M) + w (eq. Single Object Measurement Model); a detection without velocity leaves the two velocity rows out,
and H is then linear. Sigma points and square root are as in `optipmb.filter.predict`. The innovation of phi is taken
modulo pi, in (-pi/2, pi/2]; the sign of the heading is followed apart (`optipmb.filter.lightweight`).

A birth starts at the measurement: m^0 = [z_x, z_y, speed, heading, 0, 0] under P^0 of its class, with speed and heading
of the measured velocity. Two cases that the paper leaves open: without a velocity the object starts with the detected
heading and v = 0 under a wide prior; and the direction of a velocity slower than `birth_heading_speed` is mostly noise,
so the box gives the heading, and the speed is the velocity along it.

A detection without heading (NaN) leaves the last row out. An object is born without heading then, and stays so until
one is known (`optipmb.filter.unknown_heading`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.hypotheses import FROM_POISSON
from optipmb.filter.predict import ORDER, SPREAD, WEIGHT, heading_unknown, square_root, wrap
from optipmb.filter.unknown_heading import LOST, face_along, find_heading, lose_heading, take_heading
from optipmb.model.density import OMEGA, PHI, STATE, A, V, X, Y, copy_state
from optipmb.model.frame import PLAIN
from optipmb.model.stages import NEW

if TYPE_CHECKING:
    from optipmb.filter.hypotheses import Hypotheses
    from optipmb.model.density import Poissons
    from optipmb.model.rows import Array, Index
    from optipmb.model.stages import Measurements
    from optipmb.model.table import Classes

    Buffers = tuple[Array, Array, Array, Array, Array, Array]

MEASURED = 5
"""Rows of z_M with a velocity and a heading."""


@kernel
def workspace() -> Buffers:
    """Return the buffers of an update, to be used for one state after the other: root, chi, psi, nu, factor and W."""
    return (
        np.empty((STATE, STATE)),
        np.empty((2 * STATE, STATE)),
        np.empty((2 * STATE, MEASURED)),
        np.empty(MEASURED),
        np.empty((MEASURED, MEASURED)),
        np.empty((STATE, MEASURED)),
    )


@kernel
def ukf_updates(
    row: Index,
    measurement: Index,
    mean: Array,
    covariance: Array,
    measurements: Measurements,
    classes: Classes,
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Update the states `row` (K,) with their measurements; a negative measurement leaves the state as predicted.

    Nothing is written where `row` is `NEW`.

    Returns:
        How many covariances had to be repaired.
    """
    position, velocity = measurements.position, measurements.velocity
    repaired = 0
    z = np.empty(MEASURED)
    sigma = np.empty(MEASURED + 1)
    buffers = workspace()
    own_noise = position.shape[1] > PLAIN
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        if n == NEW:
            continue
        if m < 0:
            copy_state(mean, covariance, n, mean_out, covariance_out, k)
            continue
        own = classes[measurements.label[m]]
        z[0], z[1], z[4] = position[m, 0], position[m, 1], measurements.yaw[m]
        z[2], z[3] = velocity[m, 0], velocity[m, 1]
        sigma[0] = sigma[1] = own.noise_position
        sigma[MEASURED] = 0.0
        if own_noise:
            variance = own.noise_position * own.noise_position
            sigma[0], sigma[1] = math.sqrt(variance * position[m, 2]), math.sqrt(variance * position[m, 4])
            sigma[MEASURED] = variance * position[m, 3]
        sigma[2] = sigma[3] = own.noise_velocity
        sigma[4] = own.noise_heading
        if own.velocity_gate > 0.0 and velocity_doubtful(z, sigma, mean[n], covariance[n], own.velocity_gate):
            z[2] = z[3] = math.nan
        if ukf_update(mean[n], covariance[n], z, sigma, buffers, mean_out[k], covariance_out[k]) > 0:
            repaired += 1
        if heading_unknown(covariance_out[k]):
            if math.isnan(z[4]):
                find_heading(mean_out[k], covariance_out[k], own)
            else:
                take_heading(mean_out[k], covariance_out[k], z[4], own)
        elif math.isnan(z[4]) and covariance_out[k, PHI, PHI] > LOST * LOST:
            lose_heading(mean_out[k], covariance_out[k])
    return repaired


@kernel
def velocity_doubtful(z: Array, sigma: Array, mean: Array, covariance: Array, deviations: float) -> bool:
    """Tell whether the velocity of a detection, or its position, lies beyond so many deviations of the prediction.

    Some detectors report the motion of an object after it has stopped. Its boxes stay behind the predicted ones then,
    until its velocity is left out; after that the velocity is far from the one that the boxes show. `z`, `sigma`,
    `mean` and `covariance` are as in `ukf_update`, and the distances ``nu' S^-1 nu``.
    """
    limit = deviations * deviations
    s_xx, s_yy = covariance[X, X] + sigma[0] ** 2, covariance[Y, Y] + sigma[1] ** 2
    s_xy = covariance[X, Y] + sigma[MEASURED]
    dx, dy = z[0] - mean[X], z[1] - mean[Y]
    if s_yy * dx * dx - 2.0 * s_xy * dx * dy + s_xx * dy * dy > limit * (s_xx * s_yy - s_xy * s_xy):
        return True
    cos, sin, v = math.cos(mean[PHI]), math.sin(mean[PHI]), mean[V]
    along, across = cos * z[2] + sin * z[3] - v, cos * z[3] - sin * z[2]
    arm = 1.0 if heading_unknown(covariance) else v * v  # without heading, phi stands for the speed across
    s_along, s_across = covariance[V, V] + sigma[2] ** 2, arm * covariance[PHI, PHI] + sigma[3] ** 2
    far: bool = along * along / s_along + across * across / s_across > limit
    return far


@kernel
def ukf_update(
    mean: Array, covariance: Array, z: Array, sigma: Array, buffers: Buffers, mean_out: Array, covariance_out: Array
) -> int:
    """Update one state with one measurement (eq. UKF Update).

    With C the cross covariance, S the innovation covariance and nu the innovation: ``K = C S^-1``, ``m = m_+ + K nu``,
    ``P = P_+ - K S K'``, computed through the Cholesky factor L of S as ``W = C L^-T``, ``P = P_+ - W W'``.

    Arguments of its own:
        covariance: (6, 6) P_+.
        z: (5,) z_M; NaN at 2 and 3 where the velocity is unknown, at 4 where the heading is.
        sigma: (6,) standard deviations of the measurement noise, ``R = diag(sigma^2)``, and last the covariance of z_x
            and z_y in R.
        buffers: of `workspace`, with any content.

    Returns:
        Number of pivots that had to be repaired.
    """
    with_velocity = not (math.isnan(z[2]) or math.isnan(z[3]))
    straight = heading_unknown(covariance)  # and takes no heading here
    with_heading = not (straight or math.isnan(z[4]))
    size = (MEASURED if with_velocity else 3) - (not with_heading)
    root, chi, psi, innovation, factor, weighted = buffers
    repaired = square_root(covariance, root)
    v, phi = mean[V], mean[PHI]

    # Deviations of the sigma points (chi) and of their measurements (psi) from the centre.
    innovation[:] = 0.0
    cos_phi = sin_phi = 0.0
    if with_velocity:
        cos_phi, sin_phi = math.cos(phi), math.sin(phi)
    vx0, vy0 = v * cos_phi, v * sin_phi
    for i in range(2 * STATE):
        step = SPREAD if i % 2 == 0 else -SPREAD
        for row in range(STATE):
            chi[i, ORDER[row]] = step * root[row, i // 2]
        psi[i, 0], psi[i, 1] = chi[i, X], chi[i, Y]
        if straight and with_velocity:
            psi[i, 2], psi[i, 3] = chi[i, V], chi[i, PHI]
        elif with_velocity:
            cos_point, sin_point = cos_phi, sin_phi
            if chi[i, PHI] != 0.0:  # only the columns of v and phi turn the heading
                cos_point, sin_point = math.cos(phi + chi[i, PHI]), math.sin(phi + chi[i, PHI])
            psi[i, 2] = (v + chi[i, V]) * cos_point - vx0
            psi[i, 3] = (v + chi[i, V]) * sin_point - vy0
        if with_heading:
            psi[i, size - 1] = chi[i, PHI]
        for r in range(size):
            innovation[r] -= WEIGHT * psi[i, r]
    for i in range(2 * STATE):
        for r in range(size):
            psi[i, r] += innovation[r]  # the mean of psi is minus the innovation so far
    innovation[0] += z[0] - mean[X]
    innovation[1] += z[1] - mean[Y]
    if straight and with_velocity:
        innovation[2] += cos_phi * z[2] + sin_phi * z[3] - v
        innovation[3] += cos_phi * z[3] - sin_phi * z[2]
    elif with_velocity:
        innovation[2] += z[2] - vx0
        innovation[3] += z[3] - vy0
    if with_heading:
        turn = innovation[size - 1] + z[4] - phi
        innovation[size - 1] = 0.5 * wrap(2.0 * turn)

    # S = Psi' W Psi + R, factored in place; then W = C L^-T and u = L^-1 nu.
    for r in range(size):
        for s in range(r + 1):
            value = 0.0
            for i in range(2 * STATE):
                value += psi[i, r] * psi[i, s]
            value *= WEIGHT
            if r == s:
                deviation = sigma[4] if with_heading and r == size - 1 else sigma[r]
                value += deviation * deviation
            elif r == 1 and sigma[MEASURED] != 0.0:
                value += sigma[MEASURED]
            for k in range(s):
                value -= factor[r, k] * factor[s, k]
            factor[r, s] = math.sqrt(value) if r == s else value / factor[s, s]
    for r in range(size):
        for k in range(r):
            innovation[r] -= factor[r, k] * innovation[k]
        innovation[r] /= factor[r, r]
    for s in range(STATE):
        for r in range(size):
            value = 0.0
            for i in range(2 * STATE):
                value += chi[i, s] * psi[i, r]
            value *= WEIGHT
            for k in range(r):
                value -= weighted[s, k] * factor[r, k]
            weighted[s, r] = value / factor[r, r]
    for s in range(STATE):
        gained = 0.0
        for r in range(size):
            gained += weighted[s, r] * innovation[r]
        mean_out[s] = mean[s] + gained
        for t in range(s + 1):
            value = covariance[s, t]
            for r in range(size):
                value -= weighted[s, r] * weighted[t, r]
            covariance_out[s, t] = value
            covariance_out[t, s] = value
    if straight:
        across, mean_out[PHI] = mean_out[PHI] - phi, phi
        face_along(mean_out, covariance_out, across)
        return 0
    mean_out[PHI] = wrap(mean_out[PHI])
    return repaired


@kernel
def birth_states(
    rows: Index, measurements: Measurements, classes: Classes, mean_out: Array, covariance_out: Array
) -> None:
    """Compute m^0 and P^0 of the measurements in `rows` (K,) (eq. Newborn Hypothesis).

    P^0 is diagonal, but rho of `optipmb.model.frame` scales its part of x and y.
    """
    position, velocity, yaw = measurements.position, measurements.velocity, measurements.yaw
    own_noise = position.shape[1] > PLAIN
    for k in range(rows.shape[0]):
        m = rows[k]
        own = classes[measurements.label[m]]
        speed, heading = 0.0, yaw[m]
        spread = own.birth_unknown
        straight = math.isnan(heading)
        if straight:
            heading = math.atan2(position[m, 1], position[m, 0])
        if not (math.isnan(velocity[m, 0]) or math.isnan(velocity[m, 1])):
            spread = own.birth_known
            speed = math.hypot(velocity[m, 0], velocity[m, 1])
            if (speed >= own.birth_heading_speed or straight) and speed > 0.0:
                heading = math.atan2(velocity[m, 1], velocity[m, 0])
            else:
                speed = velocity[m, 0] * math.cos(heading) + velocity[m, 1] * math.sin(heading)
        mean_out[k] = 0.0
        mean_out[k, 0], mean_out[k, 1] = position[m, 0], position[m, 1]
        mean_out[k, 2], mean_out[k, 3] = speed, wrap(heading)
        covariance_out[k] = 0.0
        for s in range(STATE):
            covariance_out[k, s, s] = spread[s] * spread[s]
        if own_noise:
            covariance_out[k, 0, 0] *= position[m, 2]
            covariance_out[k, 1, 1] *= position[m, 4]
            covariance_out[k, 0, 1] = covariance_out[k, 1, 0] = spread[0] * spread[1] * position[m, 3]
        if straight:
            covariance_out[k, PHI, PHI] = spread[V] * spread[V]
            covariance_out[k, OMEGA, OMEGA] = covariance_out[k, A, A] = 0.0
            find_heading(mean_out[k], covariance_out[k], own)


@kernel
def first_detected_states(
    rows: Index,
    hypotheses: Hypotheses,
    components: Poissons,
    measurements: Measurements,
    classes: Classes,
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Compute the states of the objects that the measurements in `rows` (K,), none of them clutter, detect first.

    A newborn is N(m^0, P^0) (eq. Newborn Hypothesis). An announced object is the mixture of its components J^m, each
    updated by the measurement, with weights ``e^j / e``, matched by one Gaussian (eq. First-Time Detection Hypothesis
    Update 1).

    Returns:
        How many covariances had to be repaired.
    """
    first_kind, announced, log_e = hypotheses.first_kind, hypotheses.announced, hypotheses.log_e
    birth_states(rows, measurements, classes, mean_out, covariance_out)
    # The pairs of each measurement, one measurement after the other.
    first = np.zeros(first_kind.shape[0] + 1, np.int64)
    for m in announced:
        first[m + 1] += 1
    for m in range(first_kind.shape[0]):
        first[m + 1] += first[m]
    fill, of_measurement = first.copy(), np.empty(announced.shape[0], np.int64)
    for pair in range(announced.shape[0]):
        of_measurement[fill[announced[pair]]] = pair
        fill[announced[pair]] += 1

    repaired = 0
    for k in range(rows.shape[0]):
        m = rows[k]
        if first_kind[m] != FROM_POISSON:
            continue
        pairs = of_measurement[first[m] : first[m + 1]]
        parts, spreads = np.empty((pairs.shape[0], STATE)), np.empty((pairs.shape[0], STATE, STATE))
        given = hypotheses.component[pairs], announced[pairs], components.mean, components.covariance
        repaired += ukf_updates(*given, measurements, classes, parts, spreads)
        moment_match(log_e[pairs], parts, spreads, mean_out[k], covariance_out[k])
    return repaired


@kernel
def moment_match(log_weight: Array, mean: Array, covariance: Array, mean_out: Array, covariance_out: Array) -> None:
    """Replace a Gaussian mixture (L,) by one Gaussian of the same mean and covariance.

    Headings are averaged as differences from the heading of the heaviest component, taken in (-pi, pi]. Where one of
    them is unknown, the heaviest component stands for all. Weights need not sum to one.
    """
    count, largest, others, straight = log_weight.shape[0], -math.inf, 0.0, False
    weight = np.empty(count)
    for j in range(count):
        largest = max(largest, log_weight[j])
    for j in range(count):
        weight[j] = math.exp(log_weight[j] - largest)
        straight |= heading_unknown(covariance[j])
        if j > 0:
            others += weight[j]
    total, heaviest = weight[0] + others, 0  # in the order in which numpy adds a few numbers
    for j in range(count):
        weight[j] /= total
        if weight[j] > weight[heaviest]:
            heaviest = j
    if straight:
        for s in range(STATE):
            mean_out[s] = mean[heaviest, s]
            for t in range(STATE):
                covariance_out[s, t] = covariance[heaviest, s, t]
        return
    deviation, shift = np.empty((count, STATE)), np.zeros(STATE)
    for j in range(count):
        for s in range(STATE):
            deviation[j, s] = mean[j, s] - mean[heaviest, s]
        deviation[j, PHI] = wrap(deviation[j, PHI])
        for s in range(STATE):
            shift[s] += weight[j] * deviation[j, s]
    for s in range(STATE):
        mean_out[s] = mean[heaviest, s] + shift[s]
        for t in range(s + 1):
            value = 0.0
            for j in range(count):
                spread = (deviation[j, s] - shift[s]) * (deviation[j, t] - shift[t])
                value += weight[j] * (covariance[j, s, t] + spread)
            covariance_out[s, t] = covariance_out[t, s] = value
    mean_out[PHI] = wrap(mean_out[PHI])

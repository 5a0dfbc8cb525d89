"""Measurement update of the motion state by the unscented Kalman filter (eq. UKF Update).

It runs for the pairs of the best global hypothesis only: costs need the position alone, nothing else uses the result.

z_M = [x, y, v_x, v_y, phi] = H(x_M) + w (eq. Single Object Measurement Model); a detection without velocity leaves
the two velocity rows out, and H is then linear. Sigma points and square root are those of `optipmb.motion`. The
innovation of phi is taken modulo pi, in (-pi/2, pi/2]: detectors turn boxes around, and which way an object faces is
followed apart (`optipmb.heading`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import PHI, STATE, V, X, Y, copy_state
from optipmb.motion import ORDER, SPREAD, WEIGHT, square_root, wrap
from optipmb.position_noise import PLAIN
from optipmb.prune import NEW

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.preprocess import Measurements
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]
    Buffers = tuple[Array, Array, Array, Array, Array, Array]

MEASURED = 5
"""Rows of z_M with a velocity; three without."""


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
    classes: Sequence[ClassRow],
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Update states with the measurement of each; a negative measurement leaves the state as predicted.

    Args:
        row: (K,) state that each result is made of; where it is `NEW`, there is none, and nothing is written.
        measurement: (K,) index of the associated measurement, or negative.
        mean: (N, 6) predicted means.
        covariance: (N, 6, 6) predicted covariances.
        measurements: Z_k.
        classes: (C,) parameters: R.
        mean_out: (K, 6) receives the posterior means.
        covariance_out: (K, 6, 6) receives the posterior covariances.

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
        if ukf_update(mean[n], covariance[n], z, sigma, buffers, mean_out[k], covariance_out[k]) > 0:
            repaired += 1
    return repaired


@kernel
def ukf_update(
    mean: Array,
    covariance: Array,
    z: Array,
    sigma: Array,
    buffers: Buffers,
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Update one state with one measurement (eq. UKF Update).

    With C the cross covariance, S the innovation covariance and nu the innovation: ``K = C S^-1``, ``m = m_+ + K nu``,
    ``P = P_+ - K S K'``, computed through the Cholesky factor L of S as ``W = C L^-T``, ``P = P_+ - W W'``.

    Args:
        mean: (6,) m_+.
        covariance: (6, 6) P_+.
        z: (5,) z_M; NaN at 2 and 3 where the velocity is unknown.
        sigma: (6,) standard deviations of the measurement noise, ``R = diag(sigma^2)``, and last the covariance of z_x
            and z_y in R.
        buffers: of `workspace`; what they hold does not matter.
        mean_out: (6,) receives m.
        covariance_out: (6, 6) receives P.

    Returns:
        Number of pivots that had to be repaired.
    """
    with_velocity = not (math.isnan(z[2]) or math.isnan(z[3]))
    size = MEASURED if with_velocity else 3
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
        if with_velocity:
            cos_point, sin_point = cos_phi, sin_phi
            if chi[i, PHI] != 0.0:  # only the columns of v and phi turn the heading
                cos_point, sin_point = math.cos(phi + chi[i, PHI]), math.sin(phi + chi[i, PHI])
            psi[i, 2] = (v + chi[i, V]) * cos_point - vx0
            psi[i, 3] = (v + chi[i, V]) * sin_point - vy0
        psi[i, size - 1] = chi[i, PHI]
        for r in range(size):
            innovation[r] -= WEIGHT * psi[i, r]
    for i in range(2 * STATE):
        for r in range(size):
            psi[i, r] += innovation[r]  # the mean of psi is minus the innovation so far
    innovation[0] += z[0] - mean[X]
    innovation[1] += z[1] - mean[Y]
    if with_velocity:
        innovation[2] += z[2] - vx0
        innovation[3] += z[3] - vy0
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
                deviation = sigma[r] if r < size - 1 else sigma[4]
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
    mean_out[PHI] = wrap(mean_out[PHI])
    return repaired

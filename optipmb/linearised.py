"""Measurement update where the velocity is measured and the heading may hardly be known (not in the paper).

The UKF with kappa = 0 puts its sigma points at sqrt(6) deviations. Where the heading's is near one radian they lie
beyond half a turn, and the posterior claims to know far more than it does. A class with `linearisations` is updated by
iterated posterior linearisation instead (Garcia-Fernandez et al., 2015): H is replaced by the linear function A x + b,
with error covariance Omega, that is best in the mean square over the posterior of the iteration before; the Kalman
update of the prior with it is the next. The first posterior is that of position and heading alone, which are linear.
The moments of the velocity v e^{i phi} are exact (`optipmb.motion.polar_moments`).

A heading that is measured modulo pi has a posterior with several modes, one for each of the three nearest headings
z_phi + j pi that the prior allows. The velocity decides between them, if the object moves. Each mode is updated by
itself, has the likelihood of the measurement as its weight, and is described with the heading nearer to that of the
heaviest, as x or as T x (`optipmb.heading`); one Gaussian of the same mean and covariance replaces them. It is given
with the heading nearer to that of the prior: its sign is a state of its own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import PHI, STATE, V, X, Y
from optipmb.heading import turn_around
from optipmb.motion import polar_moments, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

MODES: Final = 3
"""Headings modulo pi that a mode is made of: the nearest, and one half turn to either side."""

UNLIKELY: Final = 12.0
"""A mode is left out where the heading alone makes it less likely than the nearest by a factor of e to this."""

LINEAR: Final = 3
"""Rows x, y and phi; behind them those of the velocity."""


@kernel
def linearised_update(
    mean: Array,
    covariance: Array,
    z: Array,
    sigma: Array,
    iterations: int,
    buffers: tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array],
    mean_out: Array,
    covariance_out: Array,
) -> None:
    """Update one state with a measurement that has a velocity: each of its modes, and the Gaussian of them all.

    Args:
        mean: (6,) m_+.
        covariance: (6, 6) P_+.
        z: (5,) z_M.
        sigma: (6,) as in `optipmb.update.ukf_update`.
        iterations: how often the velocity is linearised, at least once.
        buffers: of `optipmb.update.workspace`; what they hold does not matter.
        mean_out: (6,) receives m.
        covariance_out: (6, 6) receives P.
    """
    _, _, _, innovation, factor, weighted, weight, means, covariances = buffers
    nearest = 0.5 * wrap(2.0 * (z[4] - mean[PHI]))
    most = 2.0 * UNLIKELY * (covariance[PHI, PHI] + sigma[4] * sigma[4]) + nearest * nearest
    count, heaviest = 0, 0
    for j in range(MODES):
        turn = nearest if j == 0 else nearest + math.pi if j == 1 else nearest - math.pi
        if j > 0 and turn * turn > most:
            continue
        weight[count] = linearised_mode(
            mean,
            covariance,
            z,
            turn,
            sigma,
            iterations,
            (innovation, factor, weighted),
            means[count],
            covariances[count],
        )
        if weight[count] > weight[heaviest]:
            heaviest = count
        count += 1
    largest, total = weight[heaviest], 0.0
    for k in range(count):
        if math.cos(means[k, PHI] - means[heaviest, PHI]) < 0.0:
            turn_around(means[k], covariances[k])
        weight[k] = math.exp(weight[k] - largest)
        total += weight[k]
    for k in range(count):
        weight[k] /= total
    ends = np.array([0, count])
    moment_match(ends, weight, means, covariances, mean_out.reshape(1, STATE), covariance_out.reshape(1, STATE, STATE))
    if math.cos(mean_out[PHI] - mean[PHI]) < 0.0:
        turn_around(mean_out, covariance_out)


@kernel
def linearised_mode(
    mean: Array,
    covariance: Array,
    z: Array,
    turn: float,
    sigma: Array,
    iterations: int,
    buffers: tuple[Array, Array, Array],
    mean_out: Array,
    covariance_out: Array,
) -> float:
    """Update one state by iterated posterior linearisation, the heading that is measured taken as phi_+ + turn.

    Args:
        mean: (6,) m_+.
        covariance: (6, 6) P_+.
        z: (5,) z_M; its heading is not read.
        turn: innovation of the heading, rad.
        sigma: (6,) as in `optipmb.update.ukf_update`.
        iterations: how often the velocity is linearised.
        buffers: nu, factor and W; what they hold does not matter.
        mean_out: (6,) receives m.
        covariance_out: (6, 6) receives P.

    Returns:
        Logarithm of the likelihood of the measurement, but for a constant.
    """
    innovation, factor, weighted = buffers
    likelihood = 0.0
    for iteration in range(iterations + 1):
        # P_+ A', S and the innovation about the prior, of the linear rows.
        for r in range(STATE):
            weighted[r, 0], weighted[r, 1], weighted[r, 2] = covariance[r, X], covariance[r, Y], covariance[r, PHI]
        innovation[0], innovation[1], innovation[2] = z[0] - mean[X], z[1] - mean[Y], turn
        for q in range(LINEAR):
            factor[0, q], factor[1, q], factor[2, q] = weighted[X, q], weighted[Y, q], weighted[PHI, q]
        factor[0, 0] += sigma[0] * sigma[0]
        factor[1, 1] += sigma[1] * sigma[1]
        factor[1, 0] += sigma[5]
        factor[2, 2] += sigma[4] * sigma[4]
        size = LINEAR
        if iteration > 0:  # and those of the velocity, about the posterior so far
            size = LINEAR + 2
            v, phi = mean_out[V], mean_out[PHI]
            p_v, c, s = covariance_out[V, V], covariance_out[V, PHI], covariance_out[PHI, PHI]
            w_x, w_y, along_x, along_y, o_xx, o_xy, o_yy = polar_moments(v, 0.0, phi, p_v, c, s)
            for r in range(STATE):
                weighted[r, 3] = along_x * covariance[r, V] - w_y * covariance[r, PHI]
                weighted[r, 4] = along_y * covariance[r, V] + w_x * covariance[r, PHI]
            ahead, back = mean[V] - v, mean[PHI] - phi
            innovation[3] = z[2] - (w_x + along_x * ahead - w_y * back)
            innovation[4] = z[3] - (w_y + along_y * ahead + w_x * back)
            for q in range(size):
                factor[3, q] = along_x * weighted[V, q] - w_y * weighted[PHI, q]
                factor[4, q] = along_y * weighted[V, q] + w_x * weighted[PHI, q]
            factor[3, 3] += sigma[2] * sigma[2] + o_xx
            factor[4, 4] += sigma[3] * sigma[3] + o_yy
            factor[4, 3] += o_xy

        # S factored in place; then W = P_+ A' L^-T and u = L^-1 nu. The next iteration reads no more than v and phi.
        first, end = (0, STATE) if iteration == iterations else (V, PHI + 1)
        likelihood = 0.0
        for r in range(size):
            for q in range(r + 1):
                value = factor[r, q]
                for k in range(q):
                    value -= factor[r, k] * factor[q, k]
                factor[r, q] = math.sqrt(value) if r == q else value / factor[q, q]
            for k in range(r):
                innovation[r] -= factor[r, k] * innovation[k]
            innovation[r] /= factor[r, r]
            likelihood -= 0.5 * innovation[r] * innovation[r] + math.log(factor[r, r])
            for t in range(first, end):
                for k in range(r):
                    weighted[t, r] -= weighted[t, k] * factor[r, k]
                weighted[t, r] /= factor[r, r]
        for r in range(first, end):
            mean_out[r] = mean[r]
            for k in range(size):
                mean_out[r] += weighted[r, k] * innovation[k]
            for t in range(first, r + 1):
                value = covariance[r, t]
                for k in range(size):
                    value -= weighted[r, k] * weighted[t, k]
                covariance_out[r, t] = value
                covariance_out[t, r] = value
    mean_out[PHI] = wrap(mean_out[PHI])
    return likelihood


@kernel
def moment_match(
    start: Index, weight: Array, mean: Array, covariance: Array, mean_out: Array, covariance_out: Array
) -> None:
    """Replace Gaussian mixtures by single Gaussians of the same mean and covariance.

    Headings are averaged as differences from the heading of the heaviest component, taken in (-pi, pi].

    Args:
        start: (K + 1,) where the components of each mixture start.
        weight: (L,) weights, summing to one within each mixture.
        mean: (L, 6) component means.
        covariance: (L, 6, 6) component covariances.
        mean_out: (K, 6) receives the means.
        covariance_out: (K, 6, 6) receives the covariances.
    """
    for k in range(start.shape[0] - 1):
        first, last = start[k], start[k + 1]
        heaviest = first
        for j in range(first, last):
            if weight[j] > weight[heaviest]:
                heaviest = j
        deviation = np.empty((last - first, STATE))
        shift = np.zeros(STATE)
        for j in range(first, last):
            for s in range(STATE):
                deviation[j - first, s] = mean[j, s] - mean[heaviest, s]
            deviation[j - first, PHI] = wrap(deviation[j - first, PHI])
            for s in range(STATE):
                shift[s] += weight[j] * deviation[j - first, s]
        for s in range(STATE):
            mean_out[k, s] = mean[heaviest, s] + shift[s]
            for t in range(s + 1):
                value = 0.0
                for j in range(first, last):
                    spread = (deviation[j - first, s] - shift[s]) * (deviation[j - first, t] - shift[t])
                    value += weight[j] * (covariance[j, s, t] + spread)
                covariance_out[k, s, t] = value
                covariance_out[k, t, s] = value
        mean_out[k, PHI] = wrap(mean_out[k, PHI])

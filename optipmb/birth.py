"""How new objects enter: births at measurements (Section IV.G) and first-time detections (IV.D.2).

A birth starts at the measurement: m^0 = [z_x, z_y, speed, heading, 0, 0] under the covariance P^0 of its class. The
paper takes speed and heading from the measured velocity. Two cases that it leaves open: without a velocity the
object starts with the detected heading and v = 0 under a wide prior; and a velocity slower than
`birth_heading_speed` is mostly noise whose direction says nothing, so the heading is that of the box and the speed
is the velocity along it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import PHI, STATE, copy_state
from optipmb.hypotheses import FROM_POISSON
from optipmb.motion import wrap
from optipmb.position_noise import PLAIN
from optipmb.update import ukf_updates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Poissons
    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def birth_states(
    rows: Index, measurements: Measurements, classes: Sequence[ClassRow], mean_out: Array, covariance_out: Array
) -> None:
    """Compute m^0 and P^0 of the measurements in `rows` (eq. Newborn Hypothesis).

    Args:
        rows: (K,) measurements.
        measurements: Z_k; where it has rho of `optipmb.position_noise`, P^0_xy is that of the class times rho.
        classes: (C,) parameters: P^0, and the speed from which the heading is that of the velocity.
        mean_out: (K, 6) receives the means.
        covariance_out: (K, 6, 6) receives the covariances, diagonal but for x and y.
    """
    position, velocity, yaw = measurements.position, measurements.velocity, measurements.yaw
    own_noise = position.shape[1] > PLAIN
    for k in range(rows.shape[0]):
        m = rows[k]
        own = classes[measurements.label[m]]
        speed, heading = 0.0, yaw[m]
        spread = own.birth_unknown
        if not (math.isnan(velocity[m, 0]) or math.isnan(velocity[m, 1])):
            spread = own.birth_known
            speed = math.hypot(velocity[m, 0], velocity[m, 1])
            if speed >= own.birth_heading_speed and speed > 0.0:
                heading = math.atan2(velocity[m, 1], velocity[m, 0])
            else:
                speed = velocity[m, 0] * math.cos(heading) + velocity[m, 1] * math.sin(heading)
        mean_out[k] = 0.0
        mean_out[k, 0], mean_out[k, 1], mean_out[k, 2], mean_out[k, 3] = (
            position[m, 0],
            position[m, 1],
            speed,
            wrap(heading),
        )
        covariance_out[k] = 0.0
        for s in range(STATE):
            covariance_out[k, s, s] = spread[s] * spread[s]
        if own_noise:
            covariance_out[k, 0, 0] *= position[m, 2]
            covariance_out[k, 1, 1] *= position[m, 4]
            covariance_out[k, 0, 1] = covariance_out[k, 1, 0] = spread[0] * spread[1] * position[m, 3]


@kernel
def first_detected_states(
    rows: Index,
    hypotheses: Hypotheses,
    components: Poissons,
    measurements: Measurements,
    classes: Sequence[ClassRow],
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Compute the states of the objects that the measurements in `rows` detect for the first time.

    A newborn is N(m^0, P^0) (eq. Newborn Hypothesis). An announced object is the mixture of its components J^m, each
    updated by the measurement, with weights ``e^j / e``, matched by one Gaussian (eq. First-Time Detection Hypothesis
    Update 1).

    Args:
        rows: (K,) measurements, none of them clutter.
        hypotheses: of this frame.
        components: predicted Poisson components.
        measurements: Z_k.
        classes: (C,) parameters.
        mean_out: (K, 6) receives the means.
        covariance_out: (K, 6, 6) receives the covariances.

    Returns:
        How many covariances had to be repaired.
    """
    first_kind, announced, log_e = hypotheses.first_kind, hypotheses.announced, hypotheses.log_e
    birth_states(rows, measurements, classes, mean_out, covariance_out)
    wanted = np.flatnonzero(first_kind[rows] == FROM_POISSON)
    if wanted.shape[0] == 0:
        return 0
    # The pairs of each measurement, one measurement after the other.
    first = np.zeros(first_kind.shape[0] + 1, np.int64)
    for m in announced:
        first[m + 1] += 1
    first = np.cumsum(first)
    fill = first.copy()
    of_measurement = np.empty(announced.shape[0], np.int64)
    for pair in range(announced.shape[0]):
        of_measurement[fill[announced[pair]]] = pair
        fill[announced[pair]] += 1

    # The mixtures, one after the other, with weights e^j / e; the largest e^j of each is taken out first.
    start = np.zeros(wanted.shape[0] + 1, np.int64)
    pairs = np.empty(announced.shape[0], np.int64)
    weight = np.empty(announced.shape[0])
    for i in range(wanted.shape[0]):
        m = rows[wanted[i]]
        begin, end = start[i], start[i] + first[m + 1] - first[m]
        start[i + 1] = end
        pairs[begin:end] = of_measurement[first[m] : first[m + 1]]
        largest = log_e[pairs[begin:end]].max()
        others = 0.0
        for k in range(begin, end):
            weight[k] = math.exp(log_e[pairs[k]] - largest)
            if k > begin:
                others += weight[k]
        total = weight[begin] + others  # in the order in which numpy adds a few numbers
        for k in range(begin, end):
            weight[k] /= total

    pairs = pairs[: start[-1]]
    parts, spreads = np.empty((pairs.shape[0], STATE)), np.empty((pairs.shape[0], STATE, STATE))
    repaired = ukf_updates(
        hypotheses.component[pairs],
        announced[pairs],
        components.mean,
        components.covariance,
        measurements,
        classes,
        parts,
        spreads,
    )
    matched, matched_spread = np.empty((wanted.shape[0], STATE)), np.empty((wanted.shape[0], STATE, STATE))
    moment_match(start, weight, parts, spreads, matched, matched_spread)
    for i in range(wanted.shape[0]):
        copy_state(matched, matched_spread, i, mean_out, covariance_out, wanted[i])
    return repaired


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

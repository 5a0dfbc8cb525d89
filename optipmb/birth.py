"""How new objects enter: the hybrid adaptive birth model (HABM, Section IV.F) and first-time detections (IV.D.2).

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
from optipmb.density import STATE, Bernoullis, Poissons
from optipmb.hypotheses import CLUTTER, FROM_POISSON, NEWBORN
from optipmb.motion import wrap
from optipmb.update import moment_match, update_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.hypotheses import Hypotheses
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@kernel
def birth_states(
    position: Array,
    yaw: Array,
    velocity: Array,
    label: Index,
    heading_speed: Array,
    known: Array,
    unknown: Array,
) -> tuple[Array, Array]:
    """Compute m^0 and P^0 of each measurement.

    Args:
        position: (M, 2) z_xy.
        yaw: (M,) z_phi.
        velocity: (M, 2) z_v, NaN where unknown.
        label: (M,) z_c.
        heading_speed: (C,) speed from which the heading is that of the velocity.
        known: (C, 6) standard deviations of P^0 with a velocity.
        unknown: (C, 6) without.

    Returns:
        (M, 6) means and (M, 6, 6) diagonal covariances.
    """
    mean = np.zeros((position.shape[0], STATE))
    covariance = np.zeros((position.shape[0], STATE, STATE))
    for m in range(position.shape[0]):
        speed, heading = 0.0, yaw[m]
        spread = unknown[label[m]]
        if not (math.isnan(velocity[m, 0]) or math.isnan(velocity[m, 1])):
            spread = known[label[m]]
            speed = math.hypot(velocity[m, 0], velocity[m, 1])
            if speed >= heading_speed[label[m]] and speed > 0.0:
                heading = math.atan2(velocity[m, 1], velocity[m, 0])
            else:
                speed = velocity[m, 0] * math.cos(heading) + velocity[m, 1] * math.sin(heading)
        mean[m, 0], mean[m, 1], mean[m, 2], mean[m, 3] = position[m, 0], position[m, 1], speed, wrap(heading)
        for s in range(STATE):
            covariance[m, s, s] = spread[s] * spread[s]
    return mean, covariance


def births(measurements: Measurements, rows: Index, table: ClassTable) -> tuple[Array, Array]:
    """Compute m^0 (K, 6) and P^0 (K, 6, 6) of the measurements that `rows` names."""
    return birth_states(
        measurements.position[rows],
        measurements.yaw[rows],
        measurements.velocity[rows],
        measurements.label[rows],
        table.birth_heading_speed,
        table.birth_known,
        table.birth_unknown,
    )


def announce(measurements: Measurements, rows: Index, weight: Array, stamp_ns: int, table: ClassTable) -> Poissons:
    """Make a Poisson component of each measurement in `rows`, with the given weights; a zero weight makes none."""
    rows, weight = rows[weight > 0.0], weight[weight > 0.0]
    mean, covariance = births(measurements, rows, table)
    return Poissons(
        mean=mean,
        covariance=covariance,
        weight=weight,
        label=measurements.label[rows],
        auxiliary=measurements.auxiliary[rows],
        born_ns=np.full(rows.shape[0], stamp_ns, np.int64),
    )


def adaptive_births(measurements: Measurements, hypotheses: Hypotheses, stamp_ns: int, table: ClassTable) -> Poissons:
    """Make lambda_b of the low-scored measurements M_low, of weight ``mu_b = mu_ab (1 - p_a)`` (eq. HABM)."""
    low = np.flatnonzero(hypotheses.first_kind == CLUTTER)
    weight = table.adaptive_birth_rate[measurements.label[low]] * (1.0 - hypotheses.association[low])
    return announce(measurements, low, weight, stamp_ns, table)


def measurement_births(measurements: Measurements, stamp_ns: int, table: ClassTable) -> Poissons:
    """Make a component of weight mu_ab of every measurement: GNN-PMB's birth model, the baseline of the ablation."""
    every = np.arange(len(measurements))
    return announce(measurements, every, table.adaptive_birth_rate[measurements.label], stamp_ns, table)


def new_objects(
    measurements: Measurements,
    free: NDArray[np.bool_],
    hypotheses: Hypotheses,
    poisson: Poissons,
    stamp_ns: int,
    table: ClassTable,
) -> tuple[Bernoullis, Index, int]:
    """Make the Bernoullis of the first-time detections that the best global hypothesis contains.

    A newborn is N(m^0, P^0) with r = 1 (eq. Newborn Hypothesis). An announced object is the mixture of its
    components, each updated by the measurement, matched by one Gaussian (eq. First-Time Detection Hypothesis Update
    1). Clutter makes none.

    Args:
        measurements: Z_k.
        free: (M,) measurements that no object took.
        hypotheses: of this frame.
        poisson: predicted components.
        stamp_ns: stamp of the frame.
        table: parameters as columns.

    Returns:
        The Bernoullis in the order of their measurements, without ids (all zero); the measurement of each; the
        number of covariances that had to be repaired.
    """
    kind = hypotheses.first_kind
    alive = hypotheses.first_existence >= table.min_existence[measurements.label]
    rows = np.flatnonzero(free & alive & (kind != CLUTTER))
    mean, covariance = births(measurements, rows, table)
    announced = np.flatnonzero(kind[rows] == FROM_POISSON)
    repaired = 0
    if announced.size:
        mean[announced], covariance[announced], repaired = _announced_states(
            measurements, rows[announced], hypotheses, poisson, table
        )
    count = rows.shape[0]
    objects = Bernoullis(
        mean=mean,
        covariance=covariance,
        existence=np.where(kind[rows] == NEWBORN, 1.0, hypotheses.first_existence[rows]),
        label=measurements.label[rows],
        auxiliary=measurements.auxiliary[rows],
        id=np.zeros(count, np.int64),
        born_ns=np.full(count, stamp_ns, np.int64),
        seen_ns=np.full(count, stamp_ns, np.int64),
        score=np.zeros(count),
        evidence=np.zeros(count),
        extracted=np.zeros(count, np.bool_),
    )
    return objects, rows, repaired


def _announced_states(
    measurements: Measurements, rows: Index, hypotheses: Hypotheses, poisson: Poissons, table: ClassTable
) -> tuple[Array, Array, int]:
    """Compute the moment-matched posterior of the components in J^m for each measurement in `rows` (ascending)."""
    pairs = hypotheses.announced
    wanted = np.isin(pairs.measurement, rows)
    by_measurement = np.argsort(pairs.measurement[wanted], kind="stable")
    component = pairs.row[wanted][by_measurement]
    measurement = pairs.measurement[wanted][by_measurement]
    log_e = hypotheses.log_e[wanted][by_measurement]
    start = np.append(np.searchsorted(measurement, rows), measurement.size)
    # e^j / e, with the largest e^j of each measurement taken out first.
    weight = np.exp(log_e - np.repeat(np.maximum.reduceat(log_e, start[:-1]), np.diff(start)))
    weight /= np.repeat(np.add.reduceat(weight, start[:-1]), np.diff(start))
    mean, covariance, repaired = update_states(
        poisson.mean[component], poisson.covariance[component], measurement, measurements, table
    )
    mean_out, covariance_out = np.empty((rows.size, STATE)), np.empty((rows.size, STATE, STATE))
    moment_match(start, weight, mean, covariance, mean_out, covariance_out)
    return mean_out, covariance_out, repaired

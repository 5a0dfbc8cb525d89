"""Track extraction with two thresholds (OTE, Section IV.G), and the tracks that come out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import calibrate_rows
from optipmb.compiled import kernel
from optipmb.density import OMEGA, PHI, STATE, A, V, X, Y, copy_state, objects_in, whole_periods
from optipmb.heading import doubt, sign_probability
from optipmb.position_noise import PLAIN
from optipmb.preprocess import Measurements
from optipmb.records import record
from optipmb.reported import follow_box

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.records import Columns
    from optipmb.table import ClassRow, ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]
    Flags = NDArray[np.bool_]


@record
class Tracks:
    """The extracted tracks of one frame in the world frame, one row per track, ascending ids.

    Attributes:
        id: (N,) int64, unique in the session and never reused.
        label: (N,) int64, index into the classes of the parameters.
        center: (N, 3) geometric centre of the box, m.
        size: (N, 3) length, width, height, m.
        yaw: (N,) heading, rad, in (-pi, pi].
        heading_confidence: (N,) probability that the object faces along `yaw` and not the other way; one where the
            profile does not follow it (`optipmb.heading`).
        velocity: (N, 2) over ground, m/s.
        yaw_rate: (N,) rad/s.
        acceleration: (N,) along the heading, m/s^2.
        existence: (N,) existence probability: calibrated (`optipmb.calibration`), or r without a calibration.
        score: (N,) confidence score x_s, zero while missed; with a weight of the evidence where the profile has one.
        covariance: (N, 6, 6) of [x, y, v, phi, omega, a], with the lasting error of the detector, and with the doubt
            which way the object faces.
        age: (N,) s since the first detection.
        time_since_detection: (N,) s since the last one.
        detection: (N,) int64, index of this frame's detection in the caller's arrays, -1 while missed.
        confirmed: (N,) bool: the existence reached `confirm_from` and has not fallen below `confirm_until` since.
            People and planners look at confirmed tracks; the others may be of nothing.
    """

    id: NDArray[np.int64]
    label: NDArray[np.int64]
    center: Array
    size: Array
    yaw: Array
    heading_confidence: Array
    velocity: Array
    yaw_rate: Array
    acceleration: Array
    existence: Array
    score: Array
    covariance: Array
    age: Array
    time_since_detection: Array
    detection: NDArray[np.int64]
    confirmed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.id)


def extract(
    bernoulli: Bernoullis,
    missed_from_ns: Index,
    measurement: Index,
    measurements: Measurements,
    stamp_ns: int,
    table: ClassTable,
    *,
    two_thresholds: bool,
) -> Tracks:
    """Extract the tracks, and mark in `bernoulli` the objects that were extracted, and those that are confirmed.

    Args:
        bernoulli: the posterior, not yet given away.
        missed_from_ns: (N,) stamps from which misses count.
        measurement: (N,) measurement of each object, negative where missed.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as a table.
        two_thresholds: whether OTE is on.
    """
    return Tracks(
        *extract_tracks(
            bernoulli.words,
            missed_from_ns,
            measurement,
            tuple(measurements),
            stamp_ns,
            two_thresholds,
            table.period,
            table.classes,
        )
    )


@kernel
def extract_tracks(
    objects: Array,
    missed_from_ns: Index,
    measurement: Index,
    measurements: Columns,
    stamp_ns: int,
    two_thresholds: bool,
    period: float,
    classes: Sequence[ClassRow],
) -> Columns:
    """Return the columns of `Tracks`, calibrated where there is a calibration; `extracted` and `confirmed` are written.

    Arguments as in `extract`.
    """
    objects, measurements = objects_in(objects), Measurements(*measurements)
    rows = select_tracks(objects, missed_from_ns, stamp_ns, two_thresholds, period, classes)
    count = rows.shape[0]
    state, covariance = np.empty((count, STATE)), np.empty((count, STATE, STATE))
    center, size, velocity = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
    heading_confidence = np.ones(count)
    age, time_since_detection, detection = np.empty(count), np.empty(count), np.full(count, -1)
    for k in range(count):
        n = rows[k]
        own = classes[objects.label[n]]
        copy_state(objects.mean, objects.covariance, n, state, covariance, k)
        m = measurement[n]
        if m >= 0:
            detection[k] = measurements.source[m]
        if m >= 0 and own.reported_position + own.reported_heading > 0.0:
            position = measurements.position[m]
            r_x = r_y = own.reported_position
            if position.shape[0] > PLAIN:
                r_x, r_y = r_x * position[2], r_y * position[4]
            follow_box(
                position[0],
                position[1],
                measurements.yaw[m],
                r_x,
                r_y,
                own.reported_heading,
                state[k],
                covariance[k],
            )
        v, phi = state[k, V], state[k, PHI]
        center[k, 0], center[k, 1], center[k, 2] = state[k, X], state[k, Y], objects.auxiliary[n, 3]
        for s in range(3):
            size[k, s] = objects.auxiliary[n, s]
        if own.sign_known:
            heading_confidence[k] = sign_probability(objects.heading_odds[n])
            covariance[k, PHI, PHI] += doubt(heading_confidence[k])
        velocity[k, 0], velocity[k, 1] = v * math.cos(phi), v * math.sin(phi)
        age[k] = (stamp_ns - objects.born_ns[n]) * 1e-9
        time_since_detection[k] = (stamp_ns - objects.seen_ns[n]) * 1e-9
    label, yaw, existence, score = (
        objects.label[rows],
        state[:, PHI].copy(),
        objects.existence[rows],
        objects.score[rows],
    )
    calibrate_rows(label, objects.evidence[rows], yaw, classes, existence, score, covariance)
    confirmed = confirm(rows, label, existence, classes, objects.confirmed)
    return (
        objects.id[rows],
        label,
        center,
        size,
        yaw,
        heading_confidence,
        velocity,
        state[:, OMEGA].copy(),  # yaw_rate
        state[:, A].copy(),  # acceleration
        existence,
        score,
        covariance,
        age,
        time_since_detection,
        detection,
        confirmed,
    )


@kernel
def select_tracks(
    objects: Bernoullis,
    missed_from_ns: Index,
    stamp_ns: int,
    two_thresholds: bool,
    period: float,
    classes: Sequence[ClassRow],
) -> Index:
    """Return the rows that are extracted, and mark them in `extracted`.

    A track that never was: from ``r >= eta_ext1``. A known one: while ``r >= eta_ext2`` and ``x_cnt < eta_cnt``. The
    baseline of the ablation has the first threshold alone.
    """
    rows, count = np.empty(missed_from_ns.shape[0], np.int64), 0
    for n in range(missed_from_ns.shape[0]):
        own, r = classes[objects.label[n]], objects.existence[n]
        if objects.extracted[n] and two_thresholds:
            misses = whole_periods(missed_from_ns[n], stamp_ns, period)
            now = r >= own.extract_known and misses < own.extract_misses
        else:
            now = r >= own.extract_new
        if now:
            objects.extracted[n] = True
            rows[count] = n
            count += 1
    return rows[:count]


@kernel
def confirm(rows: Index, label: Index, existence: Array, classes: Sequence[ClassRow], confirmed: Flags) -> Flags:
    """Confirm tracks with hysteresis: from one existence on, and until it falls below another.

    Args:
        rows: (K,) objects.
        label: (K,) their classes.
        existence: (K,) of the tracks, as published.
        classes: (C,) parameters: `confirm_from` and `confirm_until`.
        confirmed: (N,) whether they were; is written.

    Returns:
        (K,) whether they are.
    """
    now = np.empty(rows.shape[0], np.bool_)
    for k in range(rows.shape[0]):
        own = classes[label[k]]
        now[k] = existence[k] >= (own.confirm_until if confirmed[rows[k]] else own.confirm_from)
        confirmed[rows[k]] = now[k]
    return now

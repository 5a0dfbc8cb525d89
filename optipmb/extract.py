"""Track extraction with two thresholds (OTE, Section IV.G), and the tracks that come out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import calibrate_rows
from optipmb.compiled import kernel
from optipmb.density import OMEGA, PHI, STATE, A, V, X, Y, copy_state, whole_periods
from optipmb.heading import doubt, sign_probability
from optipmb.position_noise import PLAIN
from optipmb.records import FLAG, INDEX, record
from optipmb.reported import follow_box

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


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

    A track that never was: from ``r >= eta_ext1``. A known one: while ``r >= eta_ext2`` and ``x_cnt < eta_cnt``. The
    baseline of the ablation has the first threshold alone.

    Args:
        bernoulli: the posterior, not yet given away.
        missed_from_ns: (N,) stamps from which misses count.
        measurement: (N,) measurement of each object, negative where missed.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as columns.
        two_thresholds: whether OTE is on.
    """
    rows = np.empty(len(bernoulli), INDEX)
    count = select_tracks(
        bernoulli.existence,
        missed_from_ns,
        bernoulli.label,
        stamp_ns,
        table.period,
        table.extract_new,
        table.extract_known,
        table.extract_misses,
        two_thresholds,
        bernoulli.extracted,
        rows,
    )
    tracks = Tracks(
        np.empty(count, INDEX),  # id
        np.empty(count, INDEX),  # label
        np.empty((count, 3)),  # center
        np.empty((count, 3)),  # size
        np.empty(count),  # yaw
        np.empty(count),  # heading_confidence
        np.empty((count, 2)),  # velocity
        np.empty(count),  # yaw_rate
        np.empty(count),  # acceleration
        np.empty(count),  # existence
        np.empty(count),  # score
        np.empty((count, STATE, STATE)),  # covariance
        np.empty(count),  # age
        np.empty(count),  # time_since_detection
        np.empty(count, INDEX),  # detection
        np.empty(count, FLAG),  # confirmed
    )
    read_tracks(
        rows,
        bernoulli.id,
        bernoulli.label,
        bernoulli.mean,
        bernoulli.covariance,
        bernoulli.existence,
        bernoulli.score,
        bernoulli.auxiliary,
        bernoulli.born_ns,
        bernoulli.seen_ns,
        bernoulli.evidence,
        bernoulli.heading_odds,
        measurement,
        measurements.source,
        measurements.position,
        measurements.yaw,
        stamp_ns,
        table.reported_position,
        table.reported_heading,
        table.sign_known,
        table.knots,
        table.knot_evidence,
        table.knot_existence,
        table.knot_along,
        table.knot_across,
        table.score_of_evidence,
        table.confirm_from,
        table.confirm_until,
        bernoulli.confirmed,
        tracks.id,
        tracks.label,
        tracks.center,
        tracks.size,
        tracks.yaw,
        tracks.heading_confidence,
        tracks.velocity,
        tracks.yaw_rate,
        tracks.acceleration,
        tracks.existence,
        tracks.score,
        tracks.covariance,
        tracks.age,
        tracks.time_since_detection,
        tracks.detection,
        tracks.confirmed,
    )
    return tracks


@kernel
def confirm(
    rows: Index,
    label: Index,
    existence: Array,
    confirm_from: Array,
    confirm_until: Array,
    confirmed: NDArray[np.bool_],
    confirmed_out: NDArray[np.bool_],
) -> None:
    """Confirm tracks with hysteresis: from one existence on, and until it falls below another.

    Args:
        rows: (>= K,) objects, in front.
        label: (N,) classes.
        existence: (K,) of the tracks, as they are told.
        confirm_from: (C,) existence from which a track is confirmed.
        confirm_until: (C,) existence below which it is so no longer.
        confirmed: (N,) whether they were; is written.
        confirmed_out: (K,) receives whether they are.
    """
    for k in range(existence.shape[0]):
        n = rows[k]
        c = label[n]
        confirmed[n] = existence[k] >= (confirm_until[c] if confirmed[n] else confirm_from[c])
        confirmed_out[k] = confirmed[n]


@kernel
def select_tracks(
    existence: Array,
    missed_from_ns: Index,
    label: Index,
    stamp_ns: int,
    period: float,
    extract_new: Array,
    extract_known: Array,
    extract_misses: Index,
    two_thresholds: bool,
    extracted: NDArray[np.bool_],
    rows: Index,
) -> int:
    """Write the rows that are extracted, mark them in `extracted`, and return how many they are."""
    count = 0
    for n in range(existence.shape[0]):
        c = label[n]
        if extracted[n] and two_thresholds:
            misses = whole_periods(missed_from_ns[n], stamp_ns, period)
            now = existence[n] >= extract_known[c] and misses < extract_misses[c]
        else:
            now = existence[n] >= extract_new[c]
        if now:
            extracted[n] = True
            rows[count] = n
            count += 1
    return count


@kernel
def read_tracks(
    rows: Index,
    identity: Index,
    label: Index,
    mean: Array,
    covariance: Array,
    existence: Array,
    score: Array,
    auxiliary: Array,
    born_ns: Index,
    seen_ns: Index,
    evidence: Array,
    heading_odds: Array,
    measurement: Index,
    source: Index,
    position: Array,
    measured_yaw: Array,
    stamp_ns: int,
    reported_position: Array,
    reported_heading: Array,
    sign_known: NDArray[np.bool_],
    knots: Index,
    knot_evidence: Array,
    knot_existence: Array,
    knot_along: Array,
    knot_across: Array,
    score_of_evidence: Array,
    confirm_from: Array,
    confirm_until: Array,
    confirmed: NDArray[np.bool_],
    identity_out: Index,
    label_out: Index,
    center: Array,
    size: Array,
    yaw: Array,
    heading_confidence: Array,
    velocity: Array,
    yaw_rate: Array,
    acceleration: Array,
    existence_out: Array,
    score_out: Array,
    covariance_out: Array,
    age: Array,
    time_since_detection: Array,
    detection: Index,
    confirmed_out: NDArray[np.bool_],
) -> None:
    """Write the columns of `Tracks` of the objects at the front of `rows`, calibrated where there are `knots`.

    `confirmed` is written as by `confirm`.
    """
    state = np.empty((identity_out.shape[0], STATE))
    for k in range(identity_out.shape[0]):
        n = rows[k]
        c = label[n]
        identity_out[k], label_out[k] = identity[n], label[n]
        existence_out[k], score_out[k] = existence[n], score[n]
        copy_state(mean, covariance, n, state, covariance_out, k)
        m = measurement[n]
        if m >= 0 and reported_position[c] + reported_heading[c] > 0.0:
            x, y, z_phi = position[m, 0], position[m, 1], measured_yaw[m]
            r_x = r_y = reported_position[c]
            if position.shape[1] > PLAIN:
                r_x, r_y = r_x * position[m, 2], r_y * position[m, 4]
            follow_box(x, y, z_phi, r_x, r_y, reported_heading[c], state[k], covariance_out[k])
        v, phi = state[k, V], state[k, PHI]
        center[k, 0], center[k, 1], center[k, 2] = state[k, X], state[k, Y], auxiliary[n, 3]
        for s in range(3):
            size[k, s] = auxiliary[n, s]
        yaw[k], yaw_rate[k], acceleration[k] = phi, state[k, OMEGA], state[k, A]
        heading_confidence[k] = 1.0
        if sign_known[c]:
            heading_confidence[k] = sign_probability(heading_odds[n])
            covariance_out[k, PHI, PHI] += doubt(heading_confidence[k])
        velocity[k, 0], velocity[k, 1] = v * math.cos(phi), v * math.sin(phi)
        age[k], time_since_detection[k] = (stamp_ns - born_ns[n]) * 1e-9, (stamp_ns - seen_ns[n]) * 1e-9
        detection[k] = source[m] if m >= 0 else -1
    calibrate_rows(
        label_out,
        evidence[rows[: identity_out.shape[0]]],
        yaw,
        knots,
        knot_evidence,
        knot_existence,
        knot_along,
        knot_across,
        score_of_evidence,
        existence_out,
        score_out,
        covariance_out,
    )
    confirm(rows, label, existence_out, confirm_from, confirm_until, confirmed, confirmed_out)

"""Track extraction with two thresholds (OTE, Section IV.H), and the tracks that come out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.calibration import calibrate_rows
from optipmb.compiled import kernel
from optipmb.density import OMEGA, PHI, STATE, A, V, X, Y, copy_state, misses_counted_from, objects_in, whole_periods
from optipmb.errors import FrameError
from optipmb.heading import doubt, sign_probability
from optipmb.position_noise import PLAIN
from optipmb.preprocess import Measurements
from optipmb.reported import follow_box
from optipmb.rows import Column, Rows, arrays_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.records import Columns
    from optipmb.table import ClassRow, ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]
    Flags = NDArray[np.bool_]


class Tracks(Rows):
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

    part = "tracks"
    refused = FrameError
    __slots__ = ()

    id = Column(np.int64)
    label = Column(np.int64)
    center = Column(np.float64, 3)
    size = Column(np.float64, 3)
    yaw = Column(np.float64)
    heading_confidence = Column(np.float64)
    velocity = Column(np.float64, 2)
    yaw_rate = Column(np.float64)
    acceleration = Column(np.float64)
    existence = Column(np.float64)
    score = Column(np.float64)
    covariance = Column(np.float64, STATE, STATE)
    age = Column(np.float64)
    time_since_detection = Column(np.float64)
    detection = Column(np.int64)
    confirmed = Column(np.bool_)


TRACK: Final = Tracks.width
TrackArrays: Final = arrays_of(Tracks, "TrackArrays", __name__)


@kernel
def tracks_in(words: Array) -> Tracks:
    """Return the columns of the array of `Tracks`, which are views of it; flags are the integers 0 and 1."""
    n = words.shape[0] // TRACK
    whole = words.view(np.int64)
    columns: Tracks = TrackArrays(
        whole[:n],  # id
        whole[n : 2 * n],  # label
        words[2 * n : 5 * n].reshape(n, 3),  # center
        words[5 * n : 8 * n].reshape(n, 3),  # size
        words[8 * n : 9 * n],  # yaw
        words[9 * n : 10 * n],  # heading_confidence
        words[10 * n : 12 * n].reshape(n, 2),  # velocity
        words[12 * n : 13 * n],  # yaw_rate
        words[13 * n : 14 * n],  # acceleration
        words[14 * n : 15 * n],  # existence
        words[15 * n : 16 * n],  # score
        words[16 * n : 52 * n].reshape(n, STATE, STATE),
        words[52 * n : 53 * n],  # age
        words[53 * n : 54 * n],  # time_since_detection
        whole[54 * n : 55 * n],  # detection
        whole[55 * n : 56 * n],  # confirmed
    )
    return columns


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
        missed_from_ns: `Density.missed_from_ns` of the posterior.
        measurement: (N,) measurement of each object, negative where missed.
        measurements: Z_k.
        stamp_ns: stamp of the frame.
        table: parameters as a table.
        two_thresholds: whether OTE is on.
    """
    return Tracks.of(
        extract_tracks(
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
    object_words: Array,
    missed_from_ns: Index,
    measurement: Index,
    measurements: Columns,
    stamp_ns: int,
    two_thresholds: bool,
    period: float,
    classes: Sequence[ClassRow],
) -> Array:
    """Return the array of `Tracks`, calibrated where there is a calibration; `extracted` and `confirmed` are written.

    Arguments as in `extract`; `object_words` is the array of the posterior.
    """
    objects, z = objects_in(object_words), Measurements(*measurements)
    rows = select_tracks(
        objects, misses_counted_from(objects, missed_from_ns), stamp_ns, two_thresholds, period, classes
    )
    count = rows.shape[0]
    words, state = np.empty(count * TRACK), np.empty((count, STATE))
    tracks = tracks_in(words)
    center, size, velocity, covariance = tracks.center, tracks.size, tracks.velocity, tracks.covariance
    for k in range(count):
        n = rows[k]
        own = classes[objects.label[n]]
        copy_state(objects.mean, objects.covariance, n, state, covariance, k)
        m = measurement[n]
        tracks.detection[k] = z.source[m] if m >= 0 else -1
        if m >= 0 and own.reported_position + own.reported_heading > 0.0:
            position = z.position[m]
            r_x = r_y = own.reported_position
            if position.shape[0] > PLAIN:
                r_x, r_y = r_x * position[2], r_y * position[4]
            follow_box(
                position[0],
                position[1],
                z.yaw[m],
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
        tracks.heading_confidence[k] = 1.0
        if own.sign_known:
            tracks.heading_confidence[k] = sign_probability(objects.heading_odds[n])
            covariance[k, PHI, PHI] += doubt(tracks.heading_confidence[k])
        velocity[k, 0], velocity[k, 1] = v * math.cos(phi), v * math.sin(phi)
        tracks.age[k] = (stamp_ns - objects.born_ns[n]) * 1e-9
        tracks.time_since_detection[k] = (stamp_ns - objects.seen_ns[n]) * 1e-9
        tracks.id[k], tracks.label[k], tracks.yaw[k] = objects.id[n], objects.label[n], phi
        tracks.yaw_rate[k], tracks.acceleration[k] = state[k, OMEGA], state[k, A]
        tracks.existence[k], tracks.score[k] = objects.existence[n], objects.score[n]
    label, existence = tracks.label, tracks.existence
    calibrate_rows(label, objects.evidence[rows], tracks.yaw, classes, existence, tracks.score, covariance)
    confirm(rows, label, existence, classes, objects.confirmed, tracks.confirmed)
    return words


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
def confirm(
    rows: Index, label: Index, existence: Array, classes: Sequence[ClassRow], confirmed: Flags, now: Flags
) -> None:
    """Confirm tracks with hysteresis: from one existence on, and until it falls below another.

    Args:
        rows: (K,) objects.
        label: (K,) their classes.
        existence: (K,) of the tracks, as published.
        classes: (C,) parameters: `confirm_from` and `confirm_until`.
        confirmed: (N,) whether they were, the integers 0 and 1; is written.
        now: (K,) receives whether they are.
    """
    for k in range(rows.shape[0]):
        own = classes[label[k]]
        now[k] = existence[k] >= (own.confirm_until if confirmed[rows[k]] else own.confirm_from)
        confirmed[rows[k]] = now[k]

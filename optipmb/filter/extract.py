"""Track extraction with two thresholds (OTE, Section IV.H)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.calibration import calibrate_rows, follow_box, use_history
from optipmb.filter.lightweight import doubt, sign_probability
from optipmb.filter.predict import heading_unknown
from optipmb.filter.unknown_heading import show_heading
from optipmb.model.density import (
    OMEGA,
    PHI,
    STATE,
    A,
    Moment,
    V,
    X,
    Y,
    copy_state,
    misses_counted_from,
    objects_in,
    whole_periods,
)
from optipmb.model.frame import PLAIN
from optipmb.model.stages import Measurements
from optipmb.model.table import known_length
from optipmb.model.tracks import TRACK, tracks_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Bernoullis
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.table import Classes

    Flags = NDArray[np.bool_]


@kernel
def extract(
    object_words: Array,
    missed_from_ns: Index,
    measurement: Index,
    measurements: Columns,
    moment: Columns,
    two_thresholds: bool,
    classes: Classes,
) -> tuple[Array, Index]:
    """Return the array of `Tracks` and the object (K,) of each, and mark extracted and confirmed objects.

    They are marked in the array of the new posterior. `measurement` (N,) is negative where an object is missed;
    `two_thresholds` tells whether OTE is on.
    """
    objects, z, now = objects_in(object_words), Measurements(*measurements), Moment(*moment)
    rows = select_tracks(objects, misses_counted_from(objects, missed_from_ns), now, two_thresholds, classes)
    count = rows.shape[0]
    words, state = np.empty(count * TRACK), np.empty((count, STATE))
    tracks = tracks_in(words)
    center, size, velocity, covariance = tracks.center, tracks.size, tracks.velocity, tracks.covariance
    for k in range(count):
        n = rows[k]
        own = classes[objects.label[n]]
        copy_state(objects.mean, objects.covariance, n, state, covariance, k)
        straight = heading_unknown(covariance[k])
        if straight:
            show_heading(state[k, V], covariance[k])
        m = measurement[n]
        tracks.detection[k] = z.source[m] if m >= 0 else -1
        if m >= 0 and own.reported_position + own.reported_heading > 0.0:
            position = z.position[m]
            r_x = r_y = own.reported_position
            if position.shape[0] > PLAIN:
                r_x, r_y = r_x * position[2], r_y * position[4]
            r_phi = 0.0 if straight or math.isnan(z.yaw[m]) else own.reported_heading
            box, noise = (position[0], position[1], z.yaw[m]), (r_x, r_y, r_phi)
            follow_box(box, noise, state[k], covariance[k])
        v, phi = state[k, V], state[k, PHI]
        center[k, 0], center[k, 1], center[k, 2] = state[k, X], state[k, Y], objects.auxiliary[n, 3]
        for s in range(3):
            size[k, s] = known_length(objects.auxiliary[n, s], s, own)
        if math.isnan(center[k, 2]):
            center[k, 2] = 0.5 * size[k, 2]
        tracks.heading_confidence[k] = 0.5 if straight else 1.0
        if own.sign_known and not straight:
            tracks.heading_confidence[k] = sign_probability(objects.heading_odds[n])
            covariance[k, PHI, PHI] += doubt(tracks.heading_confidence[k])
        velocity[k, 0], velocity[k, 1] = v * math.cos(phi), v * math.sin(phi)
        tracks.age[k] = (now.stamp_ns - objects.born_ns[n]) * 1e-9
        tracks.time_since_detection[k] = (now.stamp_ns - objects.seen_ns[n]) * 1e-9
        tracks.id[k], tracks.label[k], tracks.yaw[k] = objects.id[n], objects.label[n], phi
        tracks.yaw_rate[k], tracks.acceleration[k] = state[k, OMEGA], state[k, A]
        tracks.existence[k], tracks.score[k] = objects.existence[n], objects.score[n]
    label, existence = tracks.label, tracks.existence
    evidence = objects.evidence[rows]
    calibrate_rows(label, evidence, tracks.yaw, classes, existence, tracks.score, velocity, covariance)
    for k in range(count):
        n, own = rows[k], classes[label[k]]
        if own.history_known:
            share = (objects.hits[n] - 1.0) / max(objects.looks[n] - 1.0, 1.0)
            existence[k] = use_history(existence[k], tracks.age[k], share, velocity[k], own)
    confirm(rows, label, existence, measurement, classes, objects.confirmed, tracks.confirmed)
    return words, rows


@kernel
def select_tracks(
    objects: Bernoullis, missed_from_ns: Index, moment: Moment, two_thresholds: bool, classes: Classes
) -> Index:
    """Return the rows that are extracted, and mark them in `extracted`.

    A track that never was: from ``r >= eta_ext1``. A known one: while ``r >= eta_ext2`` and ``x_cnt < eta_cnt``. The
    baseline of the ablation has the first threshold alone.
    """
    rows, count = np.empty(missed_from_ns.shape[0], np.int64), 0
    for n in range(missed_from_ns.shape[0]):
        own, r = classes[objects.label[n]], objects.existence[n]
        if objects.extracted[n] and two_thresholds:
            misses = whole_periods(missed_from_ns[n], moment.stamp_ns, moment.period)
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
    rows: Index, label: Index, existence: Array, measurement: Index, classes: Classes, confirmed: Flags, now: Flags
) -> None:
    """Confirm tracks with hysteresis: write `now` (K,) by the published existence, and `confirmed` of their objects.

    A confirmed track stays so while it is detected; `measurement` (N,) is negative where an object is missed.
    """
    for k in range(rows.shape[0]):
        n, own = rows[k], classes[label[k]]
        stays = confirmed[n] and (measurement[n] >= 0 or existence[k] >= own.confirm_until)
        confirmed[n] = now[k] = stays or existence[k] >= own.confirm_from

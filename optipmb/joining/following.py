"""Tracks that are detected now, as they end and begin: places, velocities and sizes by their detections."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.joining.records import copy_rows, layout_of, places_in, tracklets_in
from optipmb.model.density import OMEGA, objects_in
from optipmb.model.lost_objects import PLACES, Places, Tracklets
from optipmb.model.tracks import tracks_in

if TYPE_CHECKING:
    from optipmb.model.density import Bernoullis
    from optipmb.model.rows import Array, Index
    from optipmb.model.tracks import Tracks

FIT_NS: Final = 10**9
LEAST_FIT_S: Final = 0.25
"""A velocity is the slope of places over `FIT_NS`, and unknown over less than `LEAST_FIT_S`."""
SPACING_NS: Final = 80_000_000
"""Least distance of the places of a live track that are kept, at most `PLACES`, ns."""
_NS: Final = 1e-9
TRACKLET: Final = Tracklets.width
TRACKLETS: Final = layout_of(Tracklets)
PLACE_COLUMNS: Final = layout_of(Places)


@kernel
def slope(seen: Places, n: int, noise: float) -> tuple[float, float, float]:
    """Return the velocity of the line through the places of a row, and the variance of either component.

    It is NaN over less than `LEAST_FIT_S`. `noise` is the standard deviation of a place.
    """
    newest = (seen.count[n] - 1) % PLACES
    first_ns, last_ns, many = seen.stamp_ns[n, newest], seen.stamp_ns[n, newest], min(seen.count[n], PLACES)
    t = x = y = count = 0.0
    for k in range(many):
        stamp_ns = seen.stamp_ns[n, k]
        if stamp_ns >= last_ns - FIT_NS:
            count += 1.0
            t += (stamp_ns - last_ns) * _NS
            x += seen.place[n, 2 * k]
            y += seen.place[n, 2 * k + 1]
            first_ns = min(first_ns, stamp_ns)
    if (last_ns - first_ns) * _NS < LEAST_FIT_S:
        return math.nan, math.nan, math.nan
    t, x, y = t / count, x / count, y / count
    spread = vx = vy = rest = 0.0
    for k in range(many):
        if seen.stamp_ns[n, k] >= first_ns:
            offset = (seen.stamp_ns[n, k] - last_ns) * _NS - t
            spread += offset**2
            vx += offset * (seen.place[n, 2 * k] - x)
            vy += offset * (seen.place[n, 2 * k + 1] - y)
    vx, vy = vx / spread, vy / spread
    for k in range(many):
        if seen.stamp_ns[n, k] >= first_ns:
            offset = (seen.stamp_ns[n, k] - last_ns) * _NS - t
            rest += (seen.place[n, 2 * k] - x - offset * vx) ** 2 + (seen.place[n, 2 * k + 1] - y - offset * vy) ** 2
    return vx, vy, (2.0 * noise**2 + 0.5 * rest) / count / spread


@kernel
def _fit(rows: Tracklets, k: int, seen: Places, n: int, noise: float) -> None:
    """Write the velocity at the last detection, of the places in row `n`, to row `k`."""
    vx, vy, variance = slope(seen, n, noise)
    rows.end_velocity[k, 0], rows.end_velocity[k, 1], rows.end_variance[k] = vx, vy, variance


@kernel
def _detect(
    rows: Tracklets,
    seen: Places,
    tracks: Tracks,
    objects: Bernoullis,
    places: tuple[Index, Index, Index],
    stamp_ns: int,
    motion: Array,
) -> None:
    """Write the detections of a frame, of rows of the live tracks, of the tracks and of the objects (`places`)."""
    for i in range(places[0].shape[0]):
        k, n, spot = places[0][i], places[1][i], places[2][i]
        own, turns = objects.auxiliary[spot], objects.covariance[spot, OMEGA, OMEGA]
        sized = not (math.isnan(own[0]) or math.isnan(own[1]) or math.isnan(own[2]))
        parts = turns != 0.0, sized, not math.isnan(own[3])
        noise = motion[tracks.label[n], 0]
        x, y, count = tracks.center[n, 0], tracks.center[n, 1], seen.count[k]
        if count == 0 or stamp_ns - seen.stamp_ns[k, (count - 1) % PLACES] >= SPACING_NS:
            slot = count % PLACES
            seen.stamp_ns[k, slot], seen.place[k, 2 * slot], seen.place[k, 2 * slot + 1] = stamp_ns, x, y
            seen.count[k] = count + 1
        rows.label[k], rows.last_ns[k], rows.detections[k] = tracks.label[n], stamp_ns, rows.detections[k] + 1
        rows.end[k, 0], rows.end[k, 1] = x, y
        if stamp_ns - rows.first_ns[k] <= FIT_NS:
            _fit(rows, k, seen, k, noise)
            rows.begin_velocity[k, 0], rows.begin_velocity[k, 1] = rows.end_velocity[k, 0], rows.end_velocity[k, 1]
            rows.begin_variance[k] = rows.end_variance[k]
        rows.yaw[k] = tracks.yaw[n] if parts[0] else math.nan
        for s in range(3):
            if parts[max(1, s)]:
                size, known = math.log(tracks.size[n, s]), rows.size[k, s]
                rows.size[k, s] = size if math.isnan(known) else known + (size - known) / rows.detections[k]


@kernel
def _places_of(live: Tracklets, tracks: Tracks, identity: Index) -> tuple[Index, Index, Index, Index]:
    """Return rows before a frame, of the tracks and of the objects of each live track, and the rows that have ended.

    Live are the objects of the density that were live or are detected; -1: there is no such row.
    """
    before, now = live.id.shape[0], tracks.id.shape[0]
    row, source = np.empty(identity.shape[0], np.int64), np.empty(identity.shape[0], np.int64)
    spot, ended = np.empty(identity.shape[0], np.int64), np.empty(before, np.int64)
    count = old = n = gone = 0
    for at in range(identity.shape[0]):
        one = identity[at]
        while old < before and live.id[old] < one:
            ended[gone], gone, old = old, gone + 1, old + 1
        while n < now and tracks.id[n] < one:
            n += 1
        known, shown = old < before and live.id[old] == one, n < now and tracks.id[n] == one
        if known or (shown and tracks.detection[n] >= 0):
            row[count], source[count], spot[count] = old if known else -1, n if shown else -1, at
            count += 1
        old += known
    while old < before:
        ended[gone], gone, old = old, gone + 1, old + 1
    return row[:count], source[:count], spot[:count], ended[:gone]


@kernel
def _carried(words: Array, row: Index, layout: Index) -> Array:
    """Return the words with rows as they were before a frame; rows -1 are zero."""
    width = layout[-1, 0] + layout[-1, 1]
    same = row.shape[0] * width == words.shape[0]
    for k in range(row.shape[0]):
        same &= row[k] == k
    if same:
        return words.copy()
    target, stays = np.zeros(row.shape[0] * width), np.flatnonzero(row >= 0)
    copy_rows(words, row[stays], target, stays, layout)
    return target


@kernel
def _with_lost(lost_words: Array, live_words: Array, place_words: Array, rows: Index, motion: Array) -> Array:
    """Return the words of the lost objects with rows of live tracks that have ended."""
    lost, live = tracklets_in(lost_words), tracklets_in(live_words)
    merged = np.empty(lost_words.shape[0] + rows.shape[0] * TRACKLET)
    places = np.searchsorted(lost.id, live.id[rows]) + np.arange(rows.shape[0])
    others = np.ones(lost.id.shape[0] + rows.shape[0], np.bool_)
    others[places] = False
    copy_rows(lost_words, np.arange(lost.id.shape[0]), merged, np.flatnonzero(others), TRACKLETS)
    copy_rows(live_words, rows, merged, places, TRACKLETS)
    after, seen = tracklets_in(merged), places_in(place_words)
    for n in range(rows.shape[0]):
        _fit(after, places[n], seen, rows[n], motion[live.label[rows[n]], 0])
    return merged


@kernel
def follow(
    given: tuple[Array, Array, Array],
    track_words: Array,
    object_words: Array,
    stamp_ns: int,
    motion: Array,
) -> tuple[Array, Array, Array]:
    """Return live tracks, their places and the lost objects after a frame; words of the records.

    Args:
        given: the same before it.
        track_words: of the tracks of the frame.
        object_words: of the objects of the density.
        stamp_ns: of the frame.
        motion: `Kinds.motion`.
    """
    live_words, place_words, lost_words = given
    live, tracks, objects = tracklets_in(live_words), tracks_in(track_words), objects_in(object_words)
    before_ns = np.max(live.last_ns) if live.id.shape[0] else -1
    row, source, spot, ended = _places_of(live, tracks, objects.id)
    words, spots = _carried(live_words, row, TRACKLETS), _carried(place_words, row, PLACE_COLUMNS)
    rows, seen = tracklets_in(words), places_in(spots)
    hits, hit = np.empty(row.shape[0], np.int64), 0
    for k in range(row.shape[0]):
        n = source[k]
        if row[k] < 0:
            rows.id[k], rows.object[k], rows.first_ns[k], rows.probability[k] = tracks.id[n], -1, stamp_ns, 1.0
            rows.begin[k], rows.size[k] = tracks.center[n, :2], math.nan
            rows.candidate[k], rows.candidate_probability[k] = -1, math.nan
        if n >= 0 and tracks.detection[n] >= 0:
            hits[hit], hit = k, hit + 1
        elif row[k] >= 0 and live.last_ns[row[k]] == before_ns:
            _fit(rows, k, seen, k, motion[rows.label[k], 0])
        if n >= 0:
            rows.confirmed[k] |= tracks.confirmed[n]
    hits = hits[:hit]
    _detect(rows, seen, tracks, objects, (hits, source[hits], spot[hits]), stamp_ns, motion)
    leaves = ended[live.object[ended] >= 0]
    if leaves.shape[0]:
        lost_words = _with_lost(lost_words, live_words, place_words, leaves, motion)
    return words, spots, lost_words

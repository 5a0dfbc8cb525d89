"""Appearance of tracks: vectors of a re-identification model, and the distances between vectors of one object.

A detection may bring a vector e. Where tracks are joined over gaps (`optipmb.joining.decision`), the vector of a track
is the direction of

    a(t) = sum_k exp(-(t - t_k) / `MEMORY_S`) e_k / |e_k|

over its detections, and the distance of two vectors is the one between their directions, in [0, 2]: the square root of
twice the cosine distance. What a distance says depends on the model, so distances are counted while tracking. When a
track is decided, its a(t_1) is kept. Later its distance from a(t) - exp(-(t - t_1) / `MEMORY_S`) a(t_1), the sum over
the detections since, is one of the same object. Its distances from other tracks of the class that are detected in the
same frame are distances of different objects. With the histograms h of both, the log ratio of "j continues i" gets the
term

    log [p_same(d) / p_different(d)],   p(d) = (h_(d-1) + 2 h_d + h_(d+1)) / (4 sum h) + 1 / (2 n)

within bounds, where n is the smaller sum; nothing while that is below `LEAST_COUNTS`.

An object may look otherwise after a gap, from its other side. So distances over gaps are counted too, of the pairs that
are sure by motion alone. From `LEAST_GAPS` of these on, they take the place of the distances within a track. Before, a
distance counts against a join by no more than `UNSURE`, and not at all while most of these are rather distances of
different objects.
"""

from __future__ import annotations

import math
from hashlib import blake2b
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.errors import FrameError
from optipmb.model.lost_objects import DISTANCES, Appearance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.frame import Embedding
    from optipmb.model.lost_objects import Rejoining, Tracklets
    from optipmb.model.rows import Array, Index

    Singles = NDArray[np.float32]
    Flags = NDArray[np.bool_]

MEMORY_S: Final = 1.0
APART_NS: Final = 500_000_000
LATEST_NS: Final = 10 * 10**9
"""Distances within a track are counted from `APART_NS` after it was decided, so far apart, until `LATEST_NS`."""
OTHERS: Final = 8
"""Most other tracks whose distances one track counts in a frame."""
LEAST_COUNTS: Final = 200
MOST_COUNTS: Final = 10_000
"""Counts of a histogram at which it is halved."""
LEAST_GAPS: Final = 100
MANY_GAPS: Final = 2000
BOUNDS: Final = (-6.0, 4.0)
UNSURE: Final = -1.0
MANY: Final = 8.0
"""Least and largest term, least one before `LEAST_GAPS`, and largest one from `MANY_GAPS` on."""
_NS: Final = 1e-9
_SEEN: Final = 0
_FIRST: Final = 1
_COUNTED: Final = 2
"""Columns of `Appearance.stamp_ns`."""


class Vectors(NamedTuple):
    """Vectors of tracks and lost objects, as the kernels that join them read them.

    Attributes:
        id: (U,) int64, ascending, of the tracks, including tracks that have just ended.
        total: (U, W) `Appearance.total`.
        lost_id: (L,) int64, ascending, of the objects that were lost before the frame.
        lost: (L, W) `Appearance.lost`.
        counts: (C, 3, `DISTANCES`) `Appearance.counts`; those over gaps are counted by the decisions of a frame.
    """

    id: Index
    total: Singles
    lost_id: Index
    lost: Singles
    counts: Array


_NO_IDS: Final = np.zeros(0, np.int64)
_NO_VECTORS: Final = np.zeros((0, 0), np.float32)
NOTHING: Final = Vectors(_NO_IDS, _NO_VECTORS, _NO_IDS, _NO_VECTORS, np.zeros((0, 3, DISTANCES)))
"""Where no detection has brought a vector."""


@kernel
def distance(a: Singles, b: Singles, share: float) -> float:
    """Return the distance of the directions of a and b - `share` a, NaN where one is zero."""
    own = other = both = 0.0
    for s in range(a.shape[0]):
        one = float(a[s])
        two = b[s] - share * one
        own += one * one
        other += two * two
        both += one * two
    return math.sqrt(max(0.0, 2.0 - 2.0 * both / math.sqrt(own * other))) if own * other > 0.0 else math.nan


@kernel
def bin_of(d: float) -> int:
    """Return the bin of a distance."""
    return min(int(0.5 * d * DISTANCES), DISTANCES - 1)


@kernel
def vector_of(vectors: Vectors, identity: int) -> Singles:
    """Return the vector of a track or lost object."""
    row = np.searchsorted(vectors.id, identity)
    found: Singles
    if row < vectors.id.shape[0] and vectors.id[row] == identity:
        found = vectors.total[row]
    else:
        found = vectors.lost[np.searchsorted(vectors.lost_id, identity)]
    return found


@kernel
def appearance_score(vectors: Vectors, i: int, j: int, kind: int) -> float:
    """Return log [p_same(d) / p_different(d)] of two ids of a kind; 0 where it is not known."""
    counts = vectors.counts[kind]
    within, different, gaps = counts[0].sum(), counts[1].sum(), counts[2].sum()
    over = gaps >= LEAST_GAPS
    same = gaps if over else within
    least = min(same, different)
    if min(within, different) < LEAST_COUNTS:
        return 0.0
    d = distance(vector_of(vectors, i), vector_of(vectors, j), 0.0)
    if math.isnan(d):
        return 0.0
    at = bin_of(d)
    below, above = max(at - 1, 0), min(at + 1, DISTANCES - 1)
    p, q = counts[2 if over else 0], counts[1]
    ratio = (0.25 * (p[below] + 2.0 * p[at] + p[above]) / same + 0.5 / least) / (
        0.25 * (q[below] + 2.0 * q[at] + q[above]) / different + 0.5 / least
    )
    least_term = BOUNDS[0]
    if not over:
        alike = 0.0
        for k in range(DISTANCES):
            alike += counts[2, k] * (p[k] * different > q[k] * within)
        least_term = UNSURE if alike >= 0.5 * gaps else 0.0
    return min(max(math.log(ratio), least_term), MANY if gaps >= MANY_GAPS else BOUNDS[1])


@kernel
def count_distance(vectors: Vectors, i: int, j: int, kind: int) -> None:
    """Count the distance of two ids of a kind over a gap."""
    d, counts = distance(vector_of(vectors, i), vector_of(vectors, j), 0.0), vectors.counts[kind, 2]
    if not math.isnan(d):
        counts[bin_of(d)] += 1.0
        if counts.sum() >= MOST_COUNTS:
            counts *= 0.5


@kernel
def _rows_with(
    live: tuple[Index, Flags], old: tuple[Singles, Singles, Index], identity: Index
) -> tuple[Index, Index, Flags, tuple[Singles, Singles, Index]]:
    """Return ids (U,), row of each detected track, whether tracks are decided, and their arrays with rows for new ones.

    Args:
        live: (N,) ids of the live tracks, ascending, and which of them are decided.
        old: `total`, `first` and `stamp_ns` of these.
        identity: (K,) ids, ascending, of the tracks that are detected.
    """
    before, width = live[0].shape[0], old[0].shape[1]
    most = before + identity.shape[0]
    ids, row, decided = np.empty(most, np.int64), np.empty(identity.shape[0], np.int64), np.zeros(most, np.bool_)
    total, first = np.zeros((most, width), np.float32), np.zeros((most, width), np.float32)
    stamps = np.full((most, 3), -1)
    u = n = 0
    for k in range(identity.shape[0] + 1):
        while n < before and (k == identity.shape[0] or live[0][n] <= identity[k]):
            ids[u], decided[u] = live[0][n], live[1][n]
            for s in range(3):
                stamps[u, s] = old[2][n, s]
            for s in range(width):
                total[u, s], first[u, s] = old[0][n, s], old[1][n, s]
            u, n = u + 1, n + 1
        if k < identity.shape[0]:
            if u == 0 or ids[u - 1] != identity[k]:
                ids[u], u = identity[k], u + 1
            row[k] = u - 1
    return ids[:u], row, decided[:u], (total[:u], first[:u], stamps[:u])


@kernel
def _add(arrays: tuple[Singles, Singles, Index], n: int, decided: bool, vector: Singles, stamp_ns: int) -> None:
    """Add the vector of a detection to row `n`."""
    total, first, stamps = arrays
    if decided and stamps[n, _FIRST] < 0 <= stamps[n, _SEEN]:
        for s in range(total.shape[1]):
            first[n, s] = total[n, s]
        stamps[n, _FIRST] = stamps[n, _COUNTED] = stamps[n, _SEEN]
    square = 0.0
    for s in range(vector.shape[0]):
        square += float(vector[s]) ** 2
    left, scale = math.exp((stamps[n, _SEEN] - stamp_ns) * _NS / MEMORY_S), 1.0 / math.sqrt(square)
    for s in range(vector.shape[0]):
        total[n, s] = left * total[n, s] + scale * vector[s]
    stamps[n, _SEEN] = stamp_ns


@kernel
def _count(arrays: tuple[Singles, Singles, Index], rows: Index, kind: Index, counts: Array, stamp_ns: int) -> None:
    """Count the distances of decided tracks, rows (K,), from their kept vectors, and from each other."""
    total, first, stamps = arrays
    for a in range(rows.shape[0]):
        n, c = rows[a], kind[a]
        since_ns = stamp_ns - stamps[n, _FIRST]
        if stamps[n, _FIRST] < 0 or since_ns > LATEST_NS or stamp_ns - stamps[n, _COUNTED] < APART_NS:
            continue
        stamps[n, _COUNTED] = stamp_ns
        d = distance(first[n], total[n], math.exp(-since_ns * _NS / MEMORY_S))
        if math.isnan(d):
            continue
        counts[c, 0, bin_of(d)] += 1.0
        others = 0
        for step in range(1, rows.shape[0]):
            other = (a + step) % rows.shape[0]
            if kind[other] == c and others < OTHERS:
                counts[c, 1, bin_of(distance(first[n], total[rows[other]], 0.0))] += 1.0
                others += 1
        for s in range(2):
            if counts[c, s].sum() >= MOST_COUNTS:
                for at in range(DISTANCES):
                    counts[c, s, at] *= 0.5


@kernel
def see(
    live: tuple[Index, Flags],
    old: tuple[Singles, Singles, Index, Array],
    detected: tuple[Index, Index, Index],
    vectors: Singles,
    stamp_ns: int,
) -> tuple[Index, Singles, Singles, Index, Array]:
    """Add the vectors of a frame to the vectors of the tracks, and count distances.

    Args:
        live: (N,) ids of the live tracks, ascending, and which of them are decided.
        old: `total`, `first`, `stamp_ns` and `counts` of `Appearance` before the frame.
        detected: (K,) ids, ascending, of the tracks that are detected, their kinds, and the rows of their vectors.
        vectors: (M, E) of the detections; of NaN where unknown. None (0, E): nothing is counted.
        stamp_ns: of the frame.

    Returns:
        The ids (U,) of both, and the same arrays after the frame with rows for these.
    """
    identity, kind, source = detected
    ids, row, decided, arrays = _rows_with(live, old[:3], identity)
    counts, known, count = old[3].copy(), np.empty(row.shape[0], np.int64), 0
    for k in range(row.shape[0]):
        if vectors.shape[0] > 0 and not math.isnan(vectors[source[k], 0]):
            _add(arrays, row[k], decided[row[k]], vectors[source[k]], stamp_ns)
            if decided[row[k]]:
                known[count], count = k, count + 1
    _count(arrays, row[known[:count]], kind[known[:count]], counts, stamp_ns)
    return ids, arrays[0], arrays[1], arrays[2], counts


def seen(
    before: Rejoining,
    model: str,
    embedding: Embedding | None,
    detected: tuple[Index, Index, Index],
    kind: Index,
    stamp_ns: int,
) -> tuple[Appearance, Index] | None:
    """Return the appearance of live tracks with the vectors of a frame, and ids (U,) of its rows; None: there is none.

    Args:
        before: the state before the frame.
        model: whose vectors are compared.
        embedding: the vectors of the detections.
        detected: (K,) ids and classes of the tracks that are detected, and the rows of their detections.
        kind: (C,) of the classes.
        stamp_ns: of the frame.

    Raises:
        FrameError: vectors of another length than before.
    """
    number = int.from_bytes(blake2b(model.encode(), digest_size=8).digest(), "little", signed=True)
    old = before.appearance
    if old is not None and old.model[0] != number:
        old = None
    vectors = embedding.vectors if embedding is not None and embedding.model == model else _NO_VECTORS
    if old is None and not len(vectors):
        return None
    if old is None:
        old = Appearance.empty(number, vectors.shape[1], len(before.live), len(before.lost), len(kind))
    elif len(vectors) and vectors.shape[1] != old.model[1]:
        expected = f"{old.model[1]} numbers for each detection, as of the same model before"
        raise FrameError("embedding", expected, str(vectors.shape[1]))
    identity, label, source = detected
    live = before.live.id, before.live.object >= 0
    given = old.total, old.first, old.stamp_ns, old.counts
    ids, total, first, stamps, counts = see(live, given, (identity, kind[label], source), vectors, stamp_ns)
    return Appearance(old.model, total, first, stamps, old.lost, counts), ids


def aligned(appearance: Appearance, ids: Index, before: Tracklets, live: Tracklets, lost: Tracklets) -> Appearance:
    """Return the vectors of the live tracks and of the lost objects after a frame.

    Args:
        appearance: what `seen` returns.
        ids: (U,) of its rows.
        before: the lost objects before the frame.
        live: the live tracks after it.
        lost: the lost objects after it.
    """
    total, first, stamps, vectors = appearance.total, appearance.first, appearance.stamp_ns, appearance.lost
    if not np.array_equal(before.id, lost.id):
        identity = np.concatenate((before.id, ids))
        order = np.argsort(identity, kind="stable")
        chosen = order[np.searchsorted(identity, lost.id, sorter=order)]
        vectors = np.concatenate((vectors, total))[chosen]
    if len(live) < len(ids):
        rows = np.searchsorted(ids, live.id)
        total, first, stamps = total[rows], first[rows], stamps[rows]
    return Appearance(appearance.model, total, first, stamps, vectors, appearance.counts)

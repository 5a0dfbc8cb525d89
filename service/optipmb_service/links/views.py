"""Overlapping views: evidence that two tracks are one object, and the biases between two streams.

At a common time, two tracks of one object at x_i and x_j differ by

    d = x_i - x_j = b + a R (x_j - c) + t v + e,   e ~ N(0, 1.5 (P_i + P_j))

with the bias of place b, of angle a (R turns by 90 degrees) and of clock t of the two streams. The four are least
squares over linked pairs with a prior, of which the weight of a sample halves with its square error, and which are
forgotten. The evidence of a pair adds log N(d) - log (density of tracks without a partner there), a sample for as many
independent ones as fit between two, and is forgotten over `EVIDENCE_S`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from optipmb.joining.evidence import QUANTUM
from optipmb.joining.matching import match

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index

    Table = NDArray[np.void]

GRID_NS: Final = 200_000_000
"""Time between two common times."""
REACH_M: Final = 5.0
"""Farthest apart two tracks of one object are before the bias is known."""
SHARED: Final = 1.5
"""Factor on covariances for the motion noise that both tracks share."""
CORRELATION_S: Final = 0.5
EVIDENCE_S: Final = 2.0
FORGOTTEN_S: Final = 600.0
PRIOR: Final = np.array([1.0, 1.0, np.radians(1.5), 0.15])
"""Standard deviations of b (m), a (rad) and t (s) before anything is known."""
LASTING: Final = 0.25
"""Weight of a sample for the bias: errors of a track last longer than `CORRELATION_S`."""
SAMPLE: Final = (-6.0, 8.0)
"""Bounds of what one sample says."""
LEAST_SAMPLES: Final = 2
MOST_PAIRS: Final = 40_000
"""Pairs that are looked at; with more, only nearer ones are."""
CELL_M: Final = 20.0
"""Cells in which tracks without a partner are counted."""
LEAST: Final = -4.0
"""Evidence at which a pair that is not linked is forgotten."""
WITHDRAWN: Final = 0.2
"""Probability below which a link is withdrawn."""
SURE: Final = 0.9
"""Probability from which a pair counts for the bias before it is linked."""

PAIR: Final = np.dtype([
    ("a", "i8"), ("b", "i8"), ("evidence", "f8"), ("stamp_ns", "i8"), ("samples", "i4"), ("probability", "f4"),
    ("linked", "i1"), ("how", "i1"),
])  # fmt: skip
"""Two objects by number, the one of the earlier stream first; `how`: 0 overlap, 1 passage, 2 appearance."""
BIAS: Final = np.dtype([
    ("a", "i8"), ("b", "i8"), ("center", "f8", 2), ("info", "f8", (4, 4)), ("eta", "f8", 4), ("pairs", "f8"),
    ("estimate", "f8", 4), ("covariance", "f8", (4, 4)),
])  # fmt: skip
"""Two streams by number, c, the weights of the least squares, linked pairs, and (b, a, t) with its covariance."""


class Present(NamedTuple):
    """Tracks at one time, in the plane of the area."""

    number: Index  # (N,) of the object
    stream: Index
    kind: Index
    plane: Index
    stamp_ns: Index  # of the message
    place: Array  # (N, 2)
    velocity: Array
    covariance: Array  # (N, 3) xx, xy, yy


def keys_of(pairs: Table) -> Index:
    """Return one number for each pair of numbers."""
    return np.asarray((pairs["a"] << 31) | pairs["b"])


def near(now: Present) -> tuple[Index, bool]:
    """Return pairs (P, 2) of rows of different streams that may be one object, and whether all were looked at."""
    if len(now.number) < 2:  # noqa: PLR2004 - a pair
        return np.zeros((0, 2), np.int64), True
    tree = cKDTree(np.column_stack((now.place, now.plane * 1e3)))
    reach, whole = REACH_M, True
    while tree.count_neighbors(tree, reach) > 2 * MOST_PAIRS + len(now.number):
        reach, whole = 0.5 * reach, False
        if reach < 1e-3:  # noqa: PLR2004 - all at one place
            return np.zeros((0, 2), np.int64), False
    pairs = tree.query_pairs(reach, output_type="ndarray").astype(np.int64)
    one, other = pairs[:, 0], pairs[:, 1]
    fits = (now.kind[one] == now.kind[other]) | (now.kind[one] == 0) | (now.kind[other] == 0)
    pairs = pairs[fits & (now.stream[one] != now.stream[other])]
    turned = now.stream[pairs[:, 0]] > now.stream[pairs[:, 1]]
    pairs[turned] = pairs[turned][:, ::-1]
    return pairs, whole


def biases_of(biases: Table, streams: Index, place: Array) -> tuple[Table, Index]:
    """Return the biases with rows for all pairs of streams (P, 2), and the row of each pair."""
    both: Index = streams[:, 0] << 31 | streams[:, 1]
    key, first, which = np.unique(both, return_index=True, return_inverse=True)
    new = ~np.isin(key, keys_of(biases))
    if new.any():
        more = np.zeros(int(new.sum()), BIAS)
        more["a"], more["b"] = streams[first[new]].T
        more["center"] = [place[which == n].mean(axis=0) for n in np.flatnonzero(new)]
        more["covariance"] = np.diag(PRIOR**2)
        biases = np.concatenate((biases, more))
        biases = biases[np.argsort(keys_of(biases), kind="stable")]
    return biases, np.searchsorted(keys_of(biases), key)[which]


def _design(bias: Table, now: Present, a: Index, b: Index) -> tuple[Array, Array, Array]:
    """Return what a turn and the clock move each pair by, (P, 2) each, and H^T H of both axes (P, 4, 4)."""
    arm = now.place[b] - bias["center"]
    turn = np.column_stack((-arm[:, 1], arm[:, 0]))
    speed = 0.5 * (now.velocity[a] + now.velocity[b])
    square = np.zeros((len(a), 4, 4))
    square[:, 0, 0] = square[:, 1, 1] = 1.0
    for axis in range(2):
        square[:, axis, 2] = square[:, 2, axis] = turn[:, axis]
        square[:, axis, 3] = square[:, 3, axis] = speed[:, axis]
    square[:, 2, 2], square[:, 3, 3] = (turn**2).sum(axis=1), (speed**2).sum(axis=1)
    square[:, 2, 3] = square[:, 3, 2] = (turn * speed).sum(axis=1)
    return turn, speed, square


def unmatched(now: Present, alone: Array) -> Array:
    """Return the density of tracks without a partner around each track (N,), 1/m^2, of all streams but its own."""
    cell = np.floor(now.place / CELL_M).astype(np.int64)
    key = (cell[:, 0] * 1_000_003 + cell[:, 1]) * 64 + now.plane
    _, where = np.unique(key, return_inverse=True)
    _, own = np.unique(where * (now.stream.max() + 1) + now.stream, return_inverse=True)
    every, mine = np.bincount(where, alone), np.bincount(own, alone)
    _, first = np.unique(own, return_index=True)
    streams = np.bincount(where[first])  # streams in a cell
    others = np.maximum(streams[where] - 1, 1)
    return np.asarray((0.5 + (every[where] - mine[own]) / others) / CELL_M**2)


def within(parts: Index, now: Present) -> Index:
    """Return pairs (P, 2) of rows of different streams that are of one part."""
    order = np.lexsort((now.stream, parts))
    found = [np.zeros((0, 2), np.int64)]
    for step in range(1, int(np.bincount(parts).max())):
        one, other = order[:-step], order[step:]
        same = (parts[one] == parts[other]) & (now.stream[one] != now.stream[other])
        found.append(np.column_stack((one, other))[same])
    return np.concatenate(found)[:MOST_PAIRS]


def sample(pairs: Table, biases: Table, now: Present, parts: Index, stamp_ns: int) -> tuple[Table, Table, bool]:
    """Return pairs and biases after a common time, and whether all pairs were looked at.

    Args:
        pairs: `PAIR`, ascending.
        biases: `BIAS`, ascending.
        now: the tracks, ascending numbers.
        parts: of the tracks.
        stamp_ns: the time.
    """
    rows, whole = near(now)
    rows = np.concatenate((rows, within(parts, now)))
    kept = pairs[pairs["how"] == 0]
    kept = kept[np.isin(kept["a"], now.number) & np.isin(kept["b"], now.number)]
    found = np.unique(np.concatenate((now.number[rows[:, 0]] << 31 | now.number[rows[:, 1]], keys_of(kept))))
    new = found[~np.isin(found, keys_of(pairs))]
    if len(new):
        more = np.zeros(len(new), PAIR)
        more["a"], more["b"] = new >> 31, new & (2**31 - 1)
        pairs = np.concatenate((pairs, more))
        pairs = pairs[np.argsort(keys_of(pairs), kind="stable")]
    at = np.searchsorted(keys_of(pairs), found)
    at = at[pairs["how"][at] == 0]
    a, b = np.searchsorted(now.number, pairs["a"][at]), np.searchsorted(now.number, pairs["b"][at])
    fresh = np.minimum(now.stamp_ns[a], now.stamp_ns[b]) > pairs["stamp_ns"][at]
    at, a, b = at[fresh], a[fresh], b[fresh]
    if len(at) == 0:
        return pairs, biases, whole
    biases, which = biases_of(biases, np.column_stack((now.stream[a], now.stream[b])), now.place[b])
    own = biases[which]
    turn, speed, square = _design(own, now, a, b)
    d = now.place[a] - now.place[b]
    estimate = own["estimate"]
    rest = d - estimate[:, :2] - estimate[:, 2:3] * turn - estimate[:, 3:] * speed
    noise = SHARED * (now.covariance[a] + now.covariance[b])
    unsure = 0.5 * (own["covariance"] * square).sum(axis=(1, 2))
    xx, xy, yy = noise[:, 0] + unsure, noise[:, 1], noise[:, 2] + unsure
    determinant = xx * yy - xy**2
    chi = (yy * rest[:, 0] ** 2 - 2.0 * xy * rest[:, 0] * rest[:, 1] + xx * rest[:, 1] ** 2) / determinant
    linked = pairs["linked"][at] > 0
    joined = pairs[pairs["linked"] > 0]
    alone = ~np.isin(now.number, np.concatenate((joined["a"], joined["b"])))
    density = unmatched(now, alone.astype(np.float64))
    says = -0.5 * chi - 0.5 * np.log(determinant) - np.log(2.0 * np.pi * np.maximum(density[a], density[b]))
    since = np.where(pairs["samples"][at] > 0, (stamp_ns - pairs["stamp_ns"][at]) * 1e-9, CORRELATION_S)
    weight = np.minimum(since / CORRELATION_S, 1.0)
    before = pairs["evidence"][at] * np.exp(-since / EVIDENCE_S)
    pairs["evidence"][at] = before + weight * np.clip(says, *SAMPLE)
    pairs["samples"][at] += 1
    pairs["stamp_ns"][at] = stamp_ns
    sure = linked | (pairs["probability"][at] >= SURE)
    weight = np.where(sure, LASTING * weight / (1.0 + 0.25 * chi) / (0.5 * (noise[:, 0] + noise[:, 2])), 0.0)
    biases = _fitted(biases, which, weight, (turn, speed, square, d), sure)
    return pairs, biases, whole


def _fitted(biases: Table, which: Index, weight: Array, design: tuple[Array, ...], sure: Array) -> Table:
    turn, speed, square, d = design
    count = len(biases)
    used = np.flatnonzero(weight > 0.0)
    if len(used) == 0:
        return biases
    left = np.exp(-GRID_NS * 1e-9 / FORGOTTEN_S)
    moved = np.column_stack((d, (turn * d).sum(axis=1), (speed * d).sum(axis=1))) * weight[:, None]
    for k in range(4):
        biases["eta"][:, k] = left * biases["eta"][:, k] + np.bincount(which, moved[:, k], count)
        for m in range(4):
            added = np.bincount(which, weight * square[:, k, m], count)
            biases["info"][:, k, m] = left * biases["info"][:, k, m] + added
    biases["pairs"] = np.bincount(which, sure, count)
    biases["covariance"] = np.linalg.inv(biases["info"] + np.diag(PRIOR**-2.0))
    biases["estimate"] = (biases["covariance"] @ biases["eta"][:, :, None])[:, :, 0]
    return biases


def decide(pairs: Table, now: Present, least: float) -> Table:
    """Return the pairs with their probabilities: one assignment for each two streams."""
    stamp = pairs["how"] == 0
    stamp &= np.isin(pairs["a"], now.number) & np.isin(pairs["b"], now.number)
    at = np.flatnonzero(stamp)
    if len(at) == 0:
        return pairs
    a, b = np.searchsorted(now.number, pairs["a"][at]), np.searchsorted(now.number, pairs["b"][at])
    evidence = pairs["evidence"][at]
    probability = 1.0 / (1.0 + np.exp(-evidence))
    good = np.flatnonzero((evidence > 0.0) & (pairs["samples"][at] >= LEAST_SAMPLES))
    wide = int(now.stream.max()) + 1
    row, i = np.unique(a[good] * wide + now.stream[b[good]], return_inverse=True)
    column, j = np.unique(b[good] * wide + now.stream[a[good]], return_inverse=True)
    value = np.round(evidence[good] / QUANTUM) * QUANTUM
    taken, margin, _ = match(i, j, value, np.ones(len(column), np.bool_), len(row))
    sure = 1.0 / (1.0 + np.exp(-margin))
    of_row, of_column = np.zeros(len(row)), np.zeros(len(column))
    of_row[i[taken]], of_column[j[taken]] = sure[taken], sure[taken]
    probability[good] = np.where(taken, sure, np.minimum(probability[good], 1.0 - np.maximum(of_row[i], of_column[j])))
    chosen = np.zeros(len(at), np.bool_)
    chosen[good] = taken
    pairs["probability"][at] = np.where(chosen, probability, np.minimum(probability, 0.5))
    linked = pairs["linked"][at] > 0
    pairs["linked"][at] = (linked & (probability >= WITHDRAWN)) | (chosen & (probability >= least))
    return pairs

"""Joining of the tracks of a recording over gaps, by the scores and the matching of `optipmb.joining`.

Beginnings before and after a track count for the rate of new objects, with the probabilities to be new that `TURNS`
turns estimate. Objects in view when a recording starts have not begun then, and count nothing.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from optipmb_client.errors import UsageError
from optipmb_schemas import Tracks
from optipmb_schemas.json_form import shown

from optipmb import ParameterError, Parameters, Rejoin
from optipmb.joining.decision import Kinds
from optipmb.joining.evidence import QUANTUM, motion_of, pair_scores, size_score
from optipmb.joining.following import FIT_NS, LEAST_FIT_S
from optipmb.joining.matching import match
from optipmb.joining.places import KERNEL_M, Passage, Polygon, with_declared
from optipmb.model.lost_objects import SETTLES_NS, Tracklets
from optipmb_tools.geometry import Floats, Ints
from optipmb_tools.results import stacked
from optipmb_tools.results.output import ObjectIds

AROUND_S: Final = 60.0
"""Beginnings up to this long before and after count for the rate of new objects."""
TURNS: Final = 4
AT_ONCE: Final = 256
"""Beginnings that are compared together; bounds the memory."""


@dataclass(frozen=True)
class RejoinOptions:
    """Which tracks are joined."""

    gap_s: float = 60.0  # longest gap
    min_probability: float = 0.9
    exits: tuple[Polygon, ...] = ()
    passages: tuple[Passage, ...] = ()

    def __post_init__(self) -> None:
        try:
            Rejoin(self.gap_s, self.min_probability, exits=self.exits, passages=self.passages)
        except ParameterError as error:
            if error.path.startswith(("rejoin.exits", "rejoin.passages")):
                path = error.path.removeprefix("rejoin.")
                raise UsageError(f"--places: {path}: expected {error.expected}, received {error.received}") from error
            option = "--rejoin" if error.path.endswith("gap_s") else "--min-probability"
            raise UsageError(f"{option}: expected {error.expected}, received {error.received}") from error

    def objects(self, tracks: Mapping[int, Tracks], parameters: Parameters) -> ObjectIds:
        """Return the object of each track of a recording, given the tracks by frame in a fixed world frame."""
        found = tracklets(tracks, parameters.labels)
        kinds = Kinds.of(parameters, Rejoin(self.gap_s, exits=self.exits, passages=self.passages))
        before, after, probability = joins(found, kinds, self.gap_s)
        sure = probability >= self.min_probability
        before, after, probability = before[sure], after[sure], probability[sure]
        identity, product = found.id.copy(), np.ones(len(found))
        until = np.full(len(found), np.iinfo(np.int64).max)
        until[before] = found.first_ns[after]
        for k in np.argsort(found.first_ns[after], kind="stable").tolist():  # earlier tracks first
            identity[after[k]] = identity[before[k]]
            product[after[k]] = product[before[k]] * probability[k]
        return ObjectIds(found.id, identity, product, until)


def places_in(path: Path) -> tuple[tuple[Polygon, ...], tuple[Passage, ...]]:
    """Return the exits and passages of a file of settings.

    Raises:
        UsageError: it cannot be read, or has not one table `[rejoin.PATTERN]`, or another content.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))["rejoin"]
        (own,) = tables.values()
        ways = [Passage(_polygon(one["from"]), _polygon(one["to"]), tuple(one["s"])) for one in own.get("passages", ())]
        return tuple(map(_polygon, own.get("exits", ()))), tuple(ways)
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        expected = "a file of settings with one table [rejoin.PATTERN], whose exits and passages are polygons"
        raise UsageError(f"--places {path}: expected {expected}, received {error!r:.120}") from error


def _polygon(corners: Sequence[Sequence[float]]) -> Polygon:
    return tuple((float(x), float(y)) for x, y in corners)


def tracklets(tracks: Mapping[int, Tracks], labels: Sequence[str]) -> Tracklets:
    """Return the confirmed tracks of a recording."""
    parts = [tracks[index] for index in sorted(tracks)]
    identity, label, yaw, size = (stacked(parts, name) for name in ("id", "label", "yaw", "size"))
    place, detected = stacked(parts, "center")[:, :2], stacked(parts, "detection") >= 0
    stamp = np.repeat(np.array([one.stamp_ns for one in parts], dtype=np.int64), [len(one.id) for one in parts])
    confirmed = np.concatenate([np.empty(0, np.bool_), *(shown(one) for one in parts)])
    measured = np.concatenate([np.empty(0, np.int64), *(_measured(one) for one in parts)])
    yaw = np.where(measured & 1, yaw, np.nan)
    size = np.where(measured[:, None] & (2, 2, 4), size, np.nan)
    used = np.flatnonzero(np.isin(identity, identity[confirmed]) & detected)
    used = used[np.argsort(identity[used], kind="stable")]
    starts = np.flatnonzero(np.diff(identity[used], prepend=-1))
    tracks_of = np.split(used, starts)[1:]
    first, last = (np.array([rows[end] for rows in tracks_of], dtype=np.int64) for end in (0, -1))
    count = len(tracks_of)
    found = Tracklets.of(np.zeros(count * Tracklets.width))
    found.id[:] = found.object[:] = identity[first]
    found.first_ns[:], found.last_ns[:] = stamp[first], stamp[last]
    found.begin[:], found.end[:], found.yaw[:], found.probability[:] = place[first], place[last], yaw[last], 1.0
    for k, rows in enumerate(tracks_of):
        when = stamp[rows]
        found.label[k], found.detections[k] = np.bincount(label[rows]).argmax(), len(rows)
        known = np.count_nonzero(~np.isnan(size[rows]), axis=0)
        found.size[k] = np.log(np.nansum(size[rows], axis=0) / np.where(known, known, np.nan))
        noise = motion_of(labels[found.label[k]]).noise
        early, late = rows[when <= when[0] + FIT_NS], rows[when >= when[-1] - FIT_NS]
        found.begin_velocity[k], found.begin_variance[k] = _slope(stamp[early], place[early], noise)
        found.end_velocity[k], found.end_variance[k] = _slope(stamp[late], place[late], noise)
    return found


def _measured(tracks: Tracks) -> Ints:
    return np.full(len(tracks.id), 7) if tracks.measured is None else tracks.measured.astype(np.int64)


def _slope(stamp_ns: Ints, place: Floats, noise: float) -> tuple[Floats, float]:
    """Return the velocity of the line through places (K, 2), and the variance of its components."""
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    if time[-1] < LEAST_FIT_S:
        return np.full(2, np.nan), np.nan
    offset = time - time.mean()
    spread = float(offset @ offset)
    velocity = offset @ (place - place.mean(axis=0)) / spread
    rest = place - place.mean(axis=0) - offset[:, None] * velocity
    return velocity, (2.0 * noise**2 + 0.5 * float((rest**2).sum())) / len(time) / spread


def joins(found: Tracklets, kinds: Kinds, gap_s: float) -> tuple[Ints, Ints, Floats]:
    """Return the best joins: rows of the earlier and of the later tracks, and their probabilities."""
    kind, area = kinds.kind[found.label], kinds.area[found.label]
    order = np.argsort(found.first_ns, kind="stable")
    parts = [_pairs(found, one, kinds, gap_s) for one in np.split(order, range(AT_ONCE, len(order), AT_ONCE))]
    before, after, score = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    score += _size_scores(found.size, kind, before, after)
    settled = (found.first_ns - found.first_ns.min(initial=2**62) >= SETTLES_NS).astype(np.float64)
    new = settled.copy()
    for _ in range(TURNS):
        total = np.round((score - np.log(rates(found, kind, area, new))[after]) / QUANTUM) * QUANTUM
        chosen, margin, nodes, odds = matching(before, after, total)
        new = settled.copy()
        new[nodes] *= 1.0 / (1.0 + np.exp(odds))
    return before[chosen], after[chosen], 1.0 / (1.0 + np.exp(-margin))


def _pairs(found: Tracklets, later: Ints, kinds: Kinds, gap_s: float) -> tuple[Ints, Ints, Floats]:
    """Return the rows of tracks before and after a gap, these among `later`, and their s without sizes and rate."""
    order = np.argsort(found.last_ns, kind="stable")
    first = found.first_ns[later]
    low, high = (np.searchsorted(found.last_ns[order], one) for one in (first - round(gap_s * 1e9), first))
    count = high - low
    after = np.repeat(later, count)
    before = order[np.arange(len(after)) - np.repeat(np.cumsum(count) - high, count)]
    score = pair_scores(found.words, before, after, kinds.kind, kinds.motion, gap_s)
    score = with_declared(score, found.words, before, after, kinds.declared)
    near = score > -np.inf
    return before[near], after[near], score[near]


def _size_scores(size: Floats, kind: Ints, before: Ints, after: Ints) -> Floats:
    """Return `optipmb.joining.evidence.size_score` of pairs (P,) by the sizes (N, 3) of all tracks."""
    count, mean, square = np.zeros((3, int(kind.max(initial=-1)) + 1, 3))
    for axis, one in np.ndindex(3, len(count)):
        own = size[:, axis][(kind == one) & ~np.isnan(size[:, axis])]
        if len(own):
            count[one, axis], mean[one, axis], square[one, axis] = len(own), own.mean(), len(own) * own.var()
    rows = zip(before.tolist(), after.tolist(), kind[after].tolist(), strict=True)
    return np.array([size_score(size[i], size[j], count[c], mean[c], square[c], 2) for i, j, c in rows])


def rates(found: Tracklets, kind: Ints, area: Floats, new: Floats) -> Floats:
    """Return lambda (N,) where each track begins, per m^2 and s, given the probabilities (N,) that others are new."""
    time = (found.first_ns - found.first_ns.min()) * 1e-9 if len(found) else np.empty(0)
    end = (found.last_ns.max() - found.first_ns.min()) * 1e-9 if len(found) else 0.0
    result = np.empty(len(found))
    for rows in np.split(np.arange(len(found)), range(AT_ONCE, len(found), AT_ONCE)):
        weight = new * (kind[rows, None] == kind) * (np.abs(time[rows, None] - time) <= AROUND_S)
        weight[np.arange(len(rows)), rows] = 0.0
        square = ((found.begin[rows, None] - found.begin) ** 2).sum(axis=2)
        around = (weight * np.exp(-0.5 * square / KERNEL_M**2)).sum(axis=1) / (2.0 * np.pi * KERNEL_M**2)
        seconds = np.minimum(time[rows] + AROUND_S, end) - np.maximum(time[rows] - AROUND_S, 0.0)
        result[rows] = 0.5 * ((1.0 + weight.sum(axis=1)) / area[rows] + around) / np.maximum(seconds, 1.0)
    return result


def matching(before: Ints, after: Ints, score: Floats) -> tuple[Ints, Floats, Ints, Floats]:
    """Find the matching with the largest sum of scores.

    Args:
        before: (P,) a node on the one side.
        after: (P,) a node on the other side.
        score: (P,) multiples of `QUANTUM`; pairs that are not positive are never chosen.

    Returns:
        The chosen pairs, what the sum loses without each, the nodes `after` of positive pairs, and the largest sum with
        each of these less the largest one without.
    """
    pairs = np.flatnonzero(score > 0.0)
    rows, i = np.unique(before[pairs], return_inverse=True)
    nodes, j = np.unique(after[pairs], return_inverse=True)
    taken, margin, odds = match(i, j, score[pairs], np.ones(len(nodes), np.bool_), len(rows))
    return pairs[taken], margin[taken], nodes, odds

"""Joining of whole tracks over gaps: which tracks of a recording are of the same object.

Track i ends at its last detection. Track j begins at its first, a time T later, at the place y with the velocity w. The
log ratio of "j continues i" and "j is a new object" is

    s_ij = log [P f(T) p(y, w | i, T) p(size_j | size_i)] - log [lambda(y) p(w | new) p(size_j | class)]

P is the probability that an object returns, and f(T) = 1 / (T log(1 + gap / T_0)) is log-uniform in T.
p(y, w | i, T) is a mixture along and across the heading of i: the object stays, keeps its velocity up to white noise of
its acceleration, wanders (its velocity is an Ornstein-Uhlenbeck process), or is anywhere in reach. lambda is the rate
of new objects, half uniform over the area of the class, half around other beginnings. Each beginning counts with the
probability that it was new, which `TURNS` turns estimate.

The joins are the matching of ends and beginnings with the largest sum of positive s_ij. A join has the probability
1 / (1 + exp(-m)) with the margin m: the largest sum less the largest one without that pair. Two equal candidates have
one half each.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final, NamedTuple, Self

import numpy as np
from optipmb_client.errors import UsageError
from optipmb_schemas import Tracks
from optipmb_schemas.json_form import shown
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching, shortest_path

from optipmb import Parameters
from optipmb.class_names import common_name
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.results import stacked
from optipmb_tools.results.output import Objects


class Motion(NamedTuple):
    """How objects of a class move while nothing detects them."""

    noise: float  # standard deviation of a place, m
    keeps_along: float  # of a kept velocity after one second, m/s
    keeps_across: float
    wanders_along: float  # of the velocity of an object that wanders, m/s
    wanders_across: float
    memory: float  # time constant of a wandering velocity, s
    new: float  # standard deviation of the velocity of a new object, m/s
    limit: float  # largest speed, m/s


_VEHICLE: Final = Motion(0.45, 0.8, 0.35, 4.0, 0.8, 5.0, 8.0, 35.0)
_TWO_WHEELED: Final = Motion(0.3, 0.6, 0.4, 2.5, 0.8, 5.0, 4.0, 12.0)
_OTHER: Final = _TWO_WHEELED._replace(limit=20.0)
_MOTIONS: Final = {
    **dict.fromkeys(("car", "truck", "bus", "trailer"), _VEHICLE),
    **dict.fromkeys(("bicycle", "motorcycle"), _TWO_WHEELED),
    "pedestrian": Motion(0.2, 0.3, 0.3, 0.8, 0.8, 4.0, 1.2, 3.0),
}
"""By the common name of a class."""

MOVING: Final = 0.7
"""Speed from which an object counts as moving, m/s."""
STANDS: Final = 0.3
"""Standard deviation of the velocity of a new object that stands, m/s."""
STANDING: Final = 1.0 / 3.0
"""Share of new objects that stand."""
WEIGHTS: Final = np.array([[0.75, 0.05, 0.1, 0.1], [0.1, 0.5, 0.3, 0.1]])
"""Weights of staying, keeping the velocity, wandering and anywhere in reach; second row: of moving objects."""
RETURNS: Final = 0.5
SHORTEST_S: Final = 0.2
"""T_0."""
REACH_M: Final = 3.0
FIT_NS: Final = 10**9
LEAST_FIT_S: Final = 0.25
"""A velocity is the slope of places over `FIT_NS`, and unknown over less than `LEAST_FIT_S`."""
SIZE_NOISE: Final = 0.06
"""Standard deviation of the logarithm of a track's mean size."""
SIZE_BOUNDS: Final = (-6.0, 2.5)
AROUND_S: Final = 60.0
"""Beginnings up to this long before and after count for the rate of new objects."""
KERNEL_M: Final = 3.0
TURNS: Final = 4
AT_ONCE: Final = 256
"""Beginnings that are compared together; bounds the memory."""
QUANTUM: Final = 2.0**-20
"""Scores are multiples of it, so sums are exact and equal candidates have equal sums."""


@dataclass(frozen=True)
class Rejoin:
    """Which tracks are joined."""

    gap_s: float = 60.0  # longest gap
    min_probability: float = 0.98

    def __post_init__(self) -> None:
        if not 0.0 < self.gap_s <= 600.0:  # noqa: PLR2004  the bounds are named in the message
            raise UsageError(f"--rejoin: expected a gap in (0, 600] s, received {self.gap_s:g}")
        if not 0.5 <= self.min_probability < 1.0:  # noqa: PLR2004  as above
            raise UsageError(f"--min-probability: expected a number in [0.5, 1), received {self.min_probability:g}")

    def objects(self, tracks: Mapping[int, Tracks], parameters: Parameters) -> Objects:
        """Return the object of each track of a recording, given the tracks by frame in a fixed world frame."""
        found = tracklets(tracks, parameters.labels)
        before, after, probability = joins(found, parameters, self.gap_s)
        sure = probability >= self.min_probability
        before, after, probability = before[sure], after[sure], probability[sure]
        identity, product = found.id.copy(), np.ones(len(found))
        until = np.full(len(found), np.iinfo(np.int64).max)
        until[before] = found.first_ns[after]
        for k in np.argsort(found.first_ns[after], kind="stable").tolist():  # earlier tracks first
            identity[after[k]] = identity[before[k]]
            product[after[k]] = product[before[k]] * probability[k]
        return Objects(found.id, identity, product, until)


@dataclass(frozen=True)
class Tracklets:
    """Confirmed tracks in order of their ids, world frame, m, s, rad; unknown values are NaN."""

    id: Ints  # (N,)
    label: Ints  # (N,) most frequent class
    first_ns: Ints  # (N,) stamp of the first detection
    last_ns: Ints  # (N,) of the last
    begin: Floats  # (N, 2) place at the first detection
    end: Floats  # (N, 2) at the last
    begin_velocity: Floats  # (N, 2) over the first second
    begin_variance: Floats  # (N,) of either component
    end_velocity: Floats  # (N, 2) over the last second
    end_variance: Floats  # (N,)
    yaw: Floats  # (N,) last heading
    size: Floats  # (N, 3) logarithms of the mean length, width and height

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: Ints) -> Self:
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))


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
    found = Tracklets(
        id=identity[first],
        label=np.empty(count, dtype=np.int64),
        first_ns=stamp[first],
        last_ns=stamp[last],
        begin=place[first],
        end=place[last],
        begin_velocity=np.empty((count, 2)),
        begin_variance=np.empty(count),
        end_velocity=np.empty((count, 2)),
        end_variance=np.empty(count),
        yaw=yaw[last],
        size=np.empty((count, 3)),
    )
    for k, rows in enumerate(tracks_of):
        when = stamp[rows]
        found.label[k] = np.bincount(label[rows]).argmax()
        found.size[k] = np.log(size[rows].mean(axis=0))
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


def motion_of(name: str) -> Motion:
    """Return how objects of a class move."""
    return _MOTIONS.get(common_name(name) or "", _OTHER)


def joins(found: Tracklets, parameters: Parameters, gap_s: float) -> tuple[Ints, Ints, Floats]:
    """Return the best joins: rows of the earlier and of the later tracks, and their probabilities."""
    names = parameters.labels
    groups = [parameters.classes[name].group or name for name in names]
    kind = np.array([groups.index(one) for one in groups])[found.label]
    area = np.array([parameters.classes[name].area for name in names])[found.label]
    motion = np.array([motion_of(name) for name in names])[found.label]
    order = np.argsort(found.first_ns, kind="stable")
    parts = [_pairs(found, one, kind, motion, gap_s) for one in np.split(order, range(AT_ONCE, len(order), AT_ONCE))]
    before, after = (np.concatenate(rows) for rows in list(zip(*parts, strict=True))[:2])
    score = np.concatenate([part[2] for part in parts]) + size_scores(found.size, kind, before, after)
    new = np.ones(len(found))
    for _ in range(TURNS):
        total = np.round((score - np.log(rates(found, kind, area, new))[after]) / QUANTUM) * QUANTUM
        chosen, margin, nodes, odds = matching(before, after, total)
        new = np.ones(len(found))
        new[nodes] = 1.0 / (1.0 + np.exp(odds))
    return before[chosen], after[chosen], 1.0 / (1.0 + np.exp(-margin))


def _pairs(found: Tracklets, later: Ints, kind: Ints, motion: Floats, gap_s: float) -> tuple[Ints, Ints, Floats]:
    """Return the rows of tracks before and after a gap, these among `later`, and their s without sizes and rate."""
    order = np.argsort(found.last_ns, kind="stable")
    first = found.first_ns[later]
    low, high = (np.searchsorted(found.last_ns[order], one) for one in (first - round(gap_s * 1e9), first))
    count = high - low
    after = np.repeat(later, count)
    before = order[np.arange(len(after)) - np.repeat(np.cumsum(count) - high, count)]
    gap = (found.first_ns[after] - found.last_ns[before]) * 1e-9
    reach = Motion(*motion[before].T).limit * gap + REACH_M
    near = np.linalg.norm(found.begin[after] - found.end[before], axis=1) <= reach
    near &= (kind[before] == kind[after]) & (found.id[before] < found.id[after])
    before, after, gap, reach = before[near], after[near], gap[near], reach[near]
    i, j, own = found.take(before), found.take(after), Motion(*motion[before].T)
    known = ~np.isnan(i.end_variance)
    velocity = np.where(known[:, None], i.end_velocity, 0.0)
    # The axes along and across the heading; without one, of the motion.
    angle = np.where(np.isnan(i.yaw), np.arctan2(velocity[:, 1], velocity[:, 0]), i.yaw)
    axes = np.stack((np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)), axis=1).reshape(-1, 2, 2)
    offset, velocity, begun = (
        np.einsum("pij,pj->pi", axes, one) for one in (j.begin - i.end, velocity, j.begin_velocity)
    )
    variance = np.where(known, i.end_variance, own.new**2)
    moved = motion_scores(Gaps(offset, velocity, variance, begun, j.begin_variance, gap, reach), own)
    lasting = np.log(RETURNS / (np.maximum(gap, SHORTEST_S) * np.log1p(gap_s / SHORTEST_S)))
    return before, after, moved + lasting


class Gaps(NamedTuple):
    """Gaps between two tracks, along and across the heading of the earlier one."""

    offset: Floats  # (P, 2) of the first place from the last
    velocity: Floats  # (P, 2) at the last place
    variance: Floats  # (P,) of either component
    later: Floats  # (P, 2) velocity w at the first place, NaN where unknown
    later_variance: Floats  # (P,)
    seconds: Floats  # (P,) T
    reach: Floats  # (P,) largest distance, m


def motion_scores(gaps: Gaps, motion: Motion) -> Floats:
    """Return log [p(y, w | i, T) / p(w | new)] of gaps (P,), and log p(y | i, T) where w is unknown.

    Args:
        gaps: columns (P,).
        motion: of the classes, columns (P,).
    """
    modes, noise = np.zeros((3, len(gaps.seconds))), 2.0 * np.asarray(motion.noise) ** 2
    for axis in (0, 1):
        for mode, model in enumerate(models(motion, axis, gaps)):
            place = gaps.offset[:, axis] - model.place * gaps.velocity[:, axis]
            speed = gaps.later[:, axis] - model.speed * gaps.velocity[:, axis]
            spread = model.variance + noise, model.covariance, model.speed_variance + gaps.later_variance
            modes[mode] += _log_normal(place, speed, *spread)
    known = ~np.isnan(gaps.later_variance)
    square = np.where(known, (gaps.later**2).sum(axis=1), 0.0)
    drives, stands = (np.asarray(sd) ** 2 + np.where(known, gaps.later_variance, 1.0) for sd in (motion.new, STANDS))
    parts = (
        np.log(share / (2.0 * np.pi * one)) - 0.5 * square / one
        for share, one in ((1.0 - STANDING, drives), (STANDING, stands))
    )
    new = np.logaddexp(*parts)
    modes -= np.where(known, new, 0.0)
    moving = np.linalg.norm(gaps.velocity, axis=1) > MOVING
    weights = np.log(WEIGHTS[moving.astype(np.int64)]).T
    anywhere = -np.log(np.pi * gaps.reach**2)
    return np.asarray(np.logaddexp.reduce(weights + np.vstack((modes, anywhere)), axis=0))


class Model(NamedTuple):
    """Place and velocity after a gap on one axis: factors on the velocity before it, and covariance."""

    place: Floats
    speed: Floats
    variance: Floats
    covariance: Floats
    speed_variance: Floats


def models(motion: Motion, axis: int, gaps: Gaps) -> Iterator[Model]:
    """Yield the motion of an object that stays, that keeps its velocity, and that wanders; columns (P,)."""
    t, v = gaps.seconds, gaps.variance
    zero = np.zeros(len(t))
    yield Model(zero, zero, zero, zero, zero)
    q = np.asarray((motion.keeps_along, motion.keeps_across)[axis]) ** 2
    yield Model(t, zero + 1.0, q * t**3 / 3.0 + v * t**2, q * t**2 / 2.0 + v * t, q * t + v)
    tau, s = motion.memory, np.asarray((motion.wanders_along, motion.wanders_across)[axis]) ** 2
    left = np.exp(-t / tau)
    way = tau * (1.0 - left)
    variance = s * (2.0 * tau * t - tau**2 * (3.0 - 4.0 * left + left**2)) + v * way**2
    yield Model(way, left, variance, s * way**2 / tau + v * way * left, s * (1.0 - left**2) + v * left**2)


def _log_normal(place: Floats, speed: Floats, var_p: Floats, cov: Floats, var_s: Floats) -> Floats:
    """Return the log density of errors of place and speed, of the place alone where the speed is NaN."""
    determinant = var_p * var_s - cov**2
    square = (var_s * place**2 - 2.0 * cov * place * speed + var_p * speed**2) / determinant
    both = -0.5 * (square + np.log(determinant)) - np.log(2.0 * np.pi)
    alone = -0.5 * (place**2 / var_p + np.log(2.0 * np.pi * var_p))
    return np.where(np.isnan(speed), alone, both)


def size_scores(size: Floats, kind: Ints, before: Ints, after: Ints) -> Floats:
    """Return log [p(size_j | size_i) / p(size_j | class)] of pairs (P,), within bounds; unknown parts count nothing.

    Logarithms of sizes are normal in a class, with the mean and variance of its tracks, and measured with an error.
    """
    total = np.zeros(len(before))
    for axis, one in np.ndindex(3, int(kind.max(initial=-1)) + 1):
        own = size[:, axis][(kind == one) & ~np.isnan(size[:, axis])]
        if len(own) < 2:  # noqa: PLR2004  one size has no variance
            continue
        mean, variance = own.mean(), own.var(ddof=1)
        share = max(0.0, 1.0 - SIZE_NOISE**2 / max(variance, SIZE_NOISE**2))  # correlation of two tracks of an object
        rows = kind[after] == one
        i, j = size[before[rows], axis] - mean, size[after[rows], axis] - mean
        rest = 1.0 - share**2
        ratio = -0.5 * ((j - share * i) ** 2 / rest - j**2) / max(variance, SIZE_NOISE**2) - 0.5 * np.log(rest)
        total[rows] += np.nan_to_num(ratio)
    return np.clip(total, *SIZE_BOUNDS)


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
    if not len(pairs):
        return pairs, np.empty(0), pairs, np.empty(0)
    _, i = np.unique(before[pairs], return_inverse=True)
    nodes, j = np.unique(after[pairs], return_inverse=True)
    count, value = int(i.max()) + 1, score[pairs]
    # A row that takes its own column has no partner. Each row takes one column, so one more for all changes nothing.
    own = np.arange(count)
    columns = (np.concatenate((i, own)), np.concatenate((j, len(nodes) + own)))
    table = coo_array((np.concatenate((value + 1.0, np.ones(count))), columns)).tocsr()
    taken = min_weight_full_bipartite_matching(table, maximize=True)[1][i] == j
    graph = coo_array((np.ones(len(i)), (i, count + j)), shape=(count + len(nodes), count + len(nodes)))
    part = connected_components(graph, directed=False)[1][i]
    margin, odds = value.copy(), np.empty(len(nodes))
    odds[j] = value
    order = np.argsort(part, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if len(rows) > 1:
            margin[rows], odds[np.unique(j[rows])] = _alternatives(i[rows], j[rows], value[rows], taken[rows])
    return pairs[taken], margin[taken], nodes, odds


def _alternatives(i: Ints, j: Ints, value: Floats, taken: Bools) -> tuple[Floats, Floats]:
    """Return the loss (P,) without each taken pair, and the odds of each column, given a best matching.

    A matching differs from a best one by cycles in its residual graph: from a row over pairs that are not taken, back
    over taken ones, and through one node for all rows and columns that have no partner.
    """
    _, i = np.unique(i, return_inverse=True)
    columns, j = np.unique(j, return_inverse=True)
    j = j + i.max() + 1
    free = int(j.max()) + 1
    mine, its = i[taken], j[taken]
    idle, without = np.setdiff1d(i, mine), np.setdiff1d(j, its)
    start = np.concatenate((i[~taken], its, mine, without, np.full(len(idle) + len(its), free)))
    end = np.concatenate((j[~taken], mine, np.full(len(mine) + len(without), free), idle, its))
    cost = np.zeros(len(start))
    cost[: len(i)] = np.concatenate((-value[~taken], value[taken]))
    graph = coo_array((cost, (start, end)), shape=(free + 1, free + 1)).tocsr()
    distance = shortest_path(graph, method="J", indices=np.append(mine, free))
    pairs = np.arange(len(mine))
    loss, odds = np.zeros(len(value)), -distance[-1, free - len(columns) : free]
    loss[taken] = value[taken] + distance[pairs, its]
    odds[its - (free - len(columns))] = value[taken] + distance[pairs, free]
    return loss, odds

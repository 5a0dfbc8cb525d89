"""Evidence that a track continues a lost one: how objects move and are sized (not in the paper).

Track i ends at its last detection. Track j begins at its first, a time T later, at the place y with the velocity w. The
part of their log ratio (`optipmb.joining.decision`) that does not depend on the place is

    log [P f(T) p(y, w | i, T) p(size_j | size_i)] - log [p(w | new) p(size_j | class)]

P is the probability that an object returns, and f(T) = 1 / (T log(1 + gap / T_0)) is log-uniform in T.
p(y, w | i, T) is a mixture along and across the heading of i: the object stays, keeps its velocity up to white noise of
its acceleration, wanders (its velocity is an Ornstein-Uhlenbeck process), or is anywhere in reach.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.joining.records import tracklets_in
from optipmb.model.attributes import WORDS, leading
from optipmb.model.class_names import common_name

if TYPE_CHECKING:
    from optipmb.model.attributes import Attributes
    from optipmb.model.lost_objects import Statistics, Tracklets
    from optipmb.model.rows import Array, Index


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
_MOTIONS: Final = MappingProxyType(
    {
        **dict.fromkeys(("car", "truck", "bus", "trailer"), _VEHICLE),
        **dict.fromkeys(("bicycle", "motorcycle"), _TWO_WHEELED),
        "pedestrian": Motion(0.2, 0.3, 0.3, 0.8, 0.8, 4.0, 1.2, 3.0),
    }
)
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
ALIKE: Final = (3.0, 6.0)
"""Term of an equal attribute, and of all of them at most."""
KNOWN: Final = (0.5, 2.0 / 3.0)
"""Least evidence of an attribute that is known, and least share of it."""
SIZE_NOISE: Final = 0.06
"""Standard deviation of the logarithm of a track's mean size."""
SIZE_BOUNDS: Final = (-6.0, 2.5)
QUANTUM: Final = 2.0**-20
"""Scores are multiples of it, so sums are exact and equal candidates have equal sums."""
_NS: Final = 1e-9


def motion_of(name: str) -> Motion:
    """Return how objects of a class move."""
    return _MOTIONS.get(common_name(name) or "", _OTHER)


@kernel
def keeps(t: float, v: float, noise: float) -> tuple[float, float, float, float, float]:
    """Return factors on the velocity before a gap of `t` s for place and speed, and variances and covariance of these.

    The velocity has the variance `v` before the gap, and white noise of its acceleration. Returns the factors of place
    and speed, the variance of the place, the covariance and the variance of the speed.
    """
    q = noise**2
    return t, 1.0, q * t**3 / 3.0 + v * t**2, q * t**2 / 2.0 + v * t, q * t + v


@kernel
def wanders(t: float, v: float, spread: float, memory: float) -> tuple[float, float, float, float, float]:
    """Return the same as `keeps` for an Ornstein-Uhlenbeck process of the velocity."""
    s = spread**2
    left = math.exp(-t / memory)
    way = memory * (1.0 - left)
    variance = s * (2.0 * memory * t - memory**2 * (3.0 - 4.0 * left + left**2)) + v * way**2
    return way, left, variance, s * way**2 / memory + v * way * left, s * (1.0 - left**2) + v * left**2


@kernel
def _deviation(
    model: tuple[float, float, float, float, float], offset: float, v: float, w: float, noise: float, w_variance: float
) -> tuple[float, float]:
    """Return square and determinant of the normal density of place and speed; of the place alone where `w` is NaN."""
    place, var_p = offset - model[0] * v, model[2] + noise
    if math.isnan(w_variance):
        return place**2 / var_p, var_p
    speed, cov, var_s = w - model[1] * v, model[3], model[4] + w_variance
    determinant = var_p * var_s - cov**2
    return (var_s * place**2 - 2.0 * cov * place * speed + var_p * speed**2) / determinant, determinant


@kernel
def log_sum(a: float, b: float) -> float:
    """Return log(exp(a) + exp(b))."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high))


@kernel
def reach_of(t: float, own: Array) -> float:
    """Return the largest distance that an object moves in a gap of `t` s, m; `own` (8,) are the fields of `Motion`."""
    reach: float = own[7] * t + REACH_M
    return reach


@kernel
def motion_score(
    offset: tuple[float, float],
    velocity: tuple[float, float],
    variance: float,
    later: tuple[float, float],
    w_variance: float,
    t: float,
    own: Array,
) -> float:
    """Return log [p(y, w | i, T) / p(w | new)], and log p(y | i, T) where w is unknown.

    Args:
        offset: of the first place from the last, along and across the heading, m.
        velocity: at the last place, m/s.
        variance: of either component.
        later: velocity w at the first place, NaN where unknown.
        w_variance: of either component.
        t: T, s.
        own: (8,) the fields of `Motion`.
    """
    noise, known = 2.0 * own[0] ** 2, not math.isnan(w_variance)
    rest = (0.0, 0.0, 0.0, 0.0, 0.0)
    a = _deviation(rest, offset[0], velocity[0], later[0], noise, w_variance)
    b = _deviation(rest, offset[1], velocity[1], later[1], noise, w_variance)
    c = _deviation(keeps(t, variance, own[1]), offset[0], velocity[0], later[0], noise, w_variance)
    d = _deviation(keeps(t, variance, own[2]), offset[1], velocity[1], later[1], noise, w_variance)
    e = _deviation(wanders(t, variance, own[3], own[5]), offset[0], velocity[0], later[0], noise, w_variance)
    f = _deviation(wanders(t, variance, own[4], own[5]), offset[1], velocity[1], later[1], noise, w_variance)
    new = math.log(2.0 * math.pi)
    if known:
        square = later[0] ** 2 + later[1] ** 2
        drives, stands = own[6] ** 2 + w_variance, STANDS**2 + w_variance
        new += log_sum(
            math.log((1.0 - STANDING) / drives) - 0.5 * square / drives,
            math.log(STANDING / stands) - 0.5 * square / stands,
        )
    moving = 1 if velocity[0] ** 2 + velocity[1] ** 2 > MOVING**2 else 0
    total = WEIGHTS[moving, 3] / (math.pi * reach_of(t, own) ** 2)
    total += WEIGHTS[moving, 0] * math.exp(-0.5 * (a[0] + b[0]) - new) / math.sqrt(a[1] * b[1])
    total += WEIGHTS[moving, 1] * math.exp(-0.5 * (c[0] + d[0]) - new) / math.sqrt(c[1] * d[1])
    total += WEIGHTS[moving, 2] * math.exp(-0.5 * (e[0] + f[0]) - new) / math.sqrt(e[1] * f[1])
    return math.log(total)


@kernel
def pair_score(i: Tracklets, n: int, j: Tracklets, k: int, kind: Index, motion: Array, gap_s: float) -> float:
    """Return s_ij of row `n` before a gap and row `k` behind it without sizes and rate; -inf: they cannot be joined."""
    t = (j.first_ns[k] - i.last_ns[n]) * _NS
    if not 0.0 < t <= gap_s or kind[i.label[n]] != kind[j.label[k]] or i.id[n] >= j.id[k]:
        return -math.inf
    own = motion[i.label[n]]
    x, y = j.begin[k, 0] - i.end[n, 0], j.begin[k, 1] - i.end[n, 1]
    if x**2 + y**2 > reach_of(t, own) ** 2:
        return -math.inf
    vx, vy, variance = i.end_velocity[n, 0], i.end_velocity[n, 1], i.end_variance[n]
    if math.isnan(variance):
        vx, vy, variance = 0.0, 0.0, own[6] ** 2
    # The axes along and across the heading; without one, of the motion.
    angle = math.atan2(vy, vx) if math.isnan(i.yaw[n]) else i.yaw[n]
    cos, sin = math.cos(angle), math.sin(angle)
    wx, wy = j.begin_velocity[k, 0], j.begin_velocity[k, 1]
    offset, later = (cos * x + sin * y, cos * y - sin * x), (cos * wx + sin * wy, cos * wy - sin * wx)
    velocity = (cos * vx + sin * vy, cos * vy - sin * vx)
    moved = motion_score(offset, velocity, variance, later, j.begin_variance[k], t, own)
    return moved + math.log(RETURNS / (max(t, SHORTEST_S) * math.log1p(gap_s / SHORTEST_S)))


@kernel
def pair_scores(words: Array, before: Index, after: Index, kind: Index, motion: Array, gap_s: float) -> Array:
    """Return `pair_score` of rows (P,) of `Tracklets`."""
    rows, scores = tracklets_in(words), np.empty(before.shape[0])
    for p in range(before.shape[0]):
        scores[p] = pair_score(rows, before[p], rows, after[p], kind, motion, gap_s)
    return scores


@kernel
def size_score(i: Array, j: Array, count: Array, mean: Array, square: Array, least: int) -> float:
    """Return log [p(size_j | size_i) / p(size_j | class)] within bounds; unknown parts count nothing.

    Logarithms of sizes (3,) are normal in a class, with the mean and variance of its tracks, and measured with an
    error. `count`, `mean` and `square` (3,) are the columns of `Statistics`; `least` tracks of known size are needed.
    """
    total = 0.0
    for axis in range(3):
        if count[axis] < least or math.isnan(i[axis]) or math.isnan(j[axis]):
            continue
        variance = max(square[axis] / (count[axis] - 1.0), SIZE_NOISE**2)
        share = 1.0 - SIZE_NOISE**2 / variance  # correlation of two tracks of an object
        rest = 1.0 - share**2
        a, b = i[axis] - mean[axis], j[axis] - mean[axis]
        total += -0.5 * ((b - share * a) ** 2 / rest - b**2) / variance - 0.5 * math.log(rest)
    return min(max(total, SIZE_BOUNDS[0]), SIZE_BOUNDS[1])


class KnownTexts(NamedTuple):
    """Attributes of objects that are known, ascending ids."""

    id: Index  # (R,)
    name: Index  # (R, W) bytes
    text: Index  # (R, W)

    @classmethod
    def of(cls, attributes: Attributes | None) -> KnownTexts:
        """Return the attributes with enough evidence."""
        if attributes is None:
            return NO_TEXTS
        rows, share = leading(attributes)
        rows = rows[(attributes.evidence[rows] >= KNOWN[0]) & (share >= KNOWN[1])]
        return cls(attributes.id[rows], attributes.name[rows], attributes.text[rows])


NO_TEXTS: Final = KnownTexts(np.zeros(0, np.int64), *np.zeros((2, 0, WORDS), np.int64))


@kernel
def attribute_score(known: KnownTexts, i: int, j: int) -> float:
    """Return the log ratio of two ids by known attributes: -inf where one differs, bounded where they are equal."""
    total, ids = 0.0, known.id
    for a in range(np.searchsorted(ids, i), np.searchsorted(ids, i, "right")):
        for b in range(np.searchsorted(ids, j), np.searchsorted(ids, j, "right")):
            if (known.name[a] == known.name[b]).all():
                if not (known.text[a] == known.text[b]).all():
                    return -math.inf
                total += ALIKE[0]
    return min(total, ALIKE[1])


@kernel
def count_sizes(known: Statistics, c: int, size: Array) -> None:
    """Count the sizes (3,) of a track in the statistics of a class."""
    for s in range(3):
        if not math.isnan(size[s]):
            known.count[c, s] += 1.0
            apart = size[s] - known.mean[c, s]
            known.mean[c, s] += apart / known.count[c, s]
            known.square[c, s] += apart * (size[s] - known.mean[c, s])

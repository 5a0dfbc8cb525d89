"""The same object after a gap: which new track continues which lost one (not in the paper).

Track i ends at its last detection. Track j begins at its first, a time T later, at the place y with the velocity w. The
log ratio of "j continues i" and "j is a new object" is

    s_ij = log [P f(T) p(y, w | i, T) p(size_j | size_i)] - log [lambda(y) p(w | new) p(size_j | class)]

P is the probability that an object returns, and f(T) = 1 / (T log(1 + gap / T_0)) is log-uniform in T.
p(y, w | i, T) is a mixture along and across the heading of i: the object stays, keeps its velocity up to white noise of
its acceleration, wanders (its velocity is an Ornstein-Uhlenbeck process), or is anywhere in reach. lambda is the rate
of new objects, half uniform over the area of the class, half around other beginnings. Each beginning counts with the
probability that it was new; objects in view when a session or one of its sensors starts count nothing.

Exits and passages may be declared. Objects lost in an exit do not return, and objects that begin there are new. An
object lost at the start of a passage may be seen again at its end after a time within bounds, which adds a part to
p(y, T | i): most objects keep their speed on the way, the time of the others is uniform. Passages that are not declared
are learned: each beginning is kept with the tracks that it may continue, weighted by the odds of these. Objects lost
near the place of one return near the place of the other, after a time in proportion to the speeds.

The joins are the matching of ends and beginnings with the largest sum of positive s_ij. A join has the probability
1 / (1 + exp(-m)) with the margin m: the largest sum less the largest one without that pair. Two equal candidates have
one half each.

`Rejoining` is the state of a tracker that joins while it tracks: it decides on a track when it is confirmed and was
detected for `Rejoin.decide_s`. `optipmb track --rejoin` joins the tracks of a recording by the same scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.joining.appearance import NOTHING, Vectors, aligned, appearance_score, count_distance, seen
from optipmb.model.class_names import common_name
from optipmb.model.density import OMEGA, objects_in
from optipmb.model.errors import ParameterError
from optipmb.model.frame import LONGEST_MODEL
from optipmb.model.lost_objects import PLACES, Beginnings, Lost, Places, Rejoining, Returns, Statistics, Tracklets
from optipmb.model.polygons import check_polygon, inside
from optipmb.model.rows import arrays_of, views_of
from optipmb.model.tracks import Tracks, tracks_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Bernoullis, Density
    from optipmb.model.frame import Embedding
    from optipmb.model.parameters import Parameters
    from optipmb.model.rows import Array, Columns, Index, Rows

    Flags = NDArray[np.bool_]


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
FIT_NS: Final = 10**9
LEAST_FIT_S: Final = 0.25
"""A velocity is the slope of places over `FIT_NS`, and unknown over less than `LEAST_FIT_S`."""
SIZE_NOISE: Final = 0.06
"""Standard deviation of the logarithm of a track's mean size."""
SIZE_BOUNDS: Final = (-6.0, 2.5)
KERNEL_M: Final = 3.0
QUANTUM: Final = 2.0**-20
"""Scores are multiples of it, so sums are exact and equal candidates have equal sums."""

SPACING_NS: Final = 80_000_000
"""Least distance of the places of a live track that are kept, at most `PLACES`, ns."""
RECENT_NS: Final = 120 * 10**9
"""Beginnings that count for the rate of new objects while tracking."""
MOST_SHAPES: Final = 64
"""Exits and passages of a `Rejoin`, and"""
MOST_CORNERS: Final = 100
"""corners of each of their polygons."""
RETURNS_BY_PASSAGE: Final = 0.9
PACE: Final = 0.12
"""Standard deviation of the speed in a passage from the one before or behind it, relative."""
SURE: Final = 4.6
"""Score from which a pair is sure by motion alone, above 0 and above all others of both tracks."""
BY_PACE: Final = 0.95
"""Share of the objects in a passage that keep their speed; the time of the others is uniform within the bounds."""
RIVAL_NS: Final = 3 * 10**9
"""Tracks that began so lately compete for lost objects."""
LEAST_SIZES: Final = 5
"""Tracks of a class from which its sizes count while tracking."""
LEARNED_NS: Final = 600 * 10**9
"""Time in which returns teach where others return."""
ELSEWHERE_M: Final = 6.0
"""Returns nearer to where they were lost teach nothing: motion says more, and at a door others come out."""
LEARNED: Final = 0.8
"""Share of the returns that are like others, if many are known; it is half from"""
FIRST_RETURNS: Final = 0.5
"""this sum of weights on."""
LEAST_WEIGHT: Final = 0.002
MOST_RETURNS: Final = 500
MOST_BEGINNINGS: Final = 2000
MOST_SCORES: Final = 20_000
MOST_PAIRS: Final = 4000
"""Bounds of a frame: pairs that are scored, of which those of the longest lost are left out, and pairs of the matching,
of which the lowest are."""
_NS: Final = 1e-9

_BOUNDS: Final = MappingProxyType(
    {
        "gap_s": (math.nextafter(0.0, 1.0), 600.0, "a time in (0, 600] s"),
        "min_probability": (0.5, math.nextafter(1.0, 0.0), "a number in [0.5, 1)"),
        "decide_s": (0.0, 5.0, "a time in [0, 5] s"),
        "most": (1, 10_000, "a number in [1, 10000]"),
    }
)
"""Least and largest values of `Rejoin`."""


Polygon = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Passage:
    """Way on which objects are not detected.

    Args:
        start: polygon in which they are lost, m, world frame.
        end: polygon in which they are seen again.
        s: shortest and longest time between, s.
    """

    start: Polygon
    end: Polygon
    s: tuple[float, float]


@dataclass(frozen=True)
class Rejoin:
    """Joining of tracks while tracking.

    Args:
        gap_s: longest gap, s.
        min_probability: least probability of a join; below it a track is a new object.
        decide_s: time from the first detection of a track to its decision, s.
        most: lost objects that are kept; then the oldest are dropped.
        embedding_model: model whose vectors are compared; None: none are.
        exits: polygons of the world frame, m, as doors: objects lost inside are gone, and others are new.
        passages: ways on which objects are not detected.

    Raises:
        ParameterError: a value is out of its bounds.
    """

    gap_s: float = 60.0
    min_probability: float = 0.97
    decide_s: float = 0.3
    most: int = 1000
    embedding_model: str | None = None
    exits: tuple[Polygon, ...] = ()
    passages: tuple[Passage, ...] = ()

    def __post_init__(self) -> None:
        for name, (least, most, expected) in _BOUNDS.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ParameterError(f"rejoin.{name}", expected, f"{value:g}")
        if self.embedding_model is not None and not 1 <= len(self.embedding_model) <= LONGEST_MODEL:
            expected = f"1 to {LONGEST_MODEL} characters"
            raise ParameterError("rejoin.embedding_model", expected, str(len(self.embedding_model)))
        if (count := len(self.exits) + len(self.passages)) > MOST_SHAPES:
            raise ParameterError("rejoin.exits", f"at most {MOST_SHAPES} exits and passages", str(count))
        for k, one in enumerate(self.exits):
            check_polygon(f"rejoin.exits[{k}]", one, MOST_CORNERS)
        for k, way in enumerate(self.passages):
            path = f"rejoin.passages[{k}]"
            check_polygon(f"{path}.from", way.start, MOST_CORNERS)
            check_polygon(f"{path}.to", way.end, MOST_CORNERS)
            low, high = way.s
            if not 0.0 <= low < high <= self.gap_s:
                expected = f"two ascending times in [0, {self.gap_s:g}] s, the second within gap_s"
                raise ParameterError(f"{path}.s", expected, str(way.s))


TrackletArrays: Final = arrays_of(Tracklets, "TrackletArrays", __name__)
tracklets_in: Final = views_of(Tracklets, TrackletArrays, "tracklets_in", __file__)
PlaceArrays: Final = arrays_of(Places, "PlaceArrays", __name__)
places_in: Final = views_of(Places, PlaceArrays, "places_in", __file__)
BeginningArrays: Final = arrays_of(Beginnings, "BeginningArrays", __name__)
beginnings_in: Final = views_of(Beginnings, BeginningArrays, "beginnings_in", __file__)
ReturnArrays: Final = arrays_of(Returns, "ReturnArrays", __name__)
returns_in: Final = views_of(Returns, ReturnArrays, "returns_in", __file__)
StatisticArrays: Final = arrays_of(Statistics, "StatisticArrays", __name__)
statistics_in: Final = views_of(Statistics, StatisticArrays, "statistics_in", __file__)


def _layout(rows: type[Rows]) -> Index:
    return np.array([(one.begin, one.end - one.begin) for one in rows.described.values()], dtype=np.int64)


_TRACKLET: Final = Tracklets.width
_PLACE: Final = Places.width
_BEGINNING: Final = Beginnings.width
_RETURN: Final = Returns.width
_TRACKLETS: Final = _layout(Tracklets)
_PLACES: Final = _layout(Places)
_BEGINNINGS: Final = _layout(Beginnings)
_RETURNS: Final = _layout(Returns)
"""First word and words of each column."""


class Declared(NamedTuple):
    """Exits and passages as arrays.

    Attributes:
        corners: (K, 2) of all polygons: of the exits, then start and end of each passage.
        first: (Z + 1,) first corner of each polygon.
        seconds: (Q, 2) shortest and longest time of each passage.
        area: (Q,) of the ends of passages, m^2.
    """

    corners: Array
    first: Index
    seconds: Array
    area: Array

    @classmethod
    def of(cls, settings: Rejoin | None) -> Declared:
        """Return what settings declare."""
        exits, passages = (settings.exits, settings.passages) if settings is not None else ((), ())
        shapes = [*exits, *(one for way in passages for one in (way.start, way.end))]
        ends = [np.array(way.end, np.float64) for way in passages]
        turned = [one[:, 0] * np.roll(one[:, 1], -1) - one[:, 1] * np.roll(one[:, 0], -1) for one in ends]
        return cls(
            np.array([place for one in shapes for place in one], np.float64).reshape(-1, 2),
            np.cumsum([0, *map(len, shapes)]).astype(np.int64),
            np.array([way.s for way in passages], np.float64).reshape(-1, 2),
            np.array([0.5 * abs(one.sum()) for one in turned], np.float64),
        )


class Kinds(NamedTuple):
    """What joining knows of classes, and of the place."""

    motion: Array  # (C, 8) fields of `Motion`
    kind: Index  # (C,) first class of its group
    area: Array  # (C,) m^2
    declared: Declared

    @classmethod
    def of(cls, parameters: Parameters, settings: Rejoin | None = None) -> Kinds:
        """Return what joining knows of the classes of a profile, and what settings declare."""
        groups = [one.group or name for name, one in parameters.classes.items()]
        motion = np.array([motion_of(name) for name in parameters.labels])
        kind = np.array([groups.index(one) for one in groups], dtype=np.int64)
        area = np.array([one.area for one in parameters.classes.values()])
        return cls(motion, kind, area, Declared.of(settings))


def motion_of(name: str) -> Motion:
    """Return how objects of a class move."""
    return _MOTIONS.get(common_name(name) or "", _OTHER)


# Scores


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
def _log_sum(a: float, b: float) -> float:
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high))


@kernel
def motion_score(
    offset: tuple[float, float],
    velocity: tuple[float, float],
    variance: float,
    later: tuple[float, float],
    w_variance: float,
    t: float,
    reach: float,
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
        reach: largest distance, m.
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
        new += _log_sum(
            math.log((1.0 - STANDING) / drives) - 0.5 * square / drives,
            math.log(STANDING / stands) - 0.5 * square / stands,
        )
    moving = 1 if velocity[0] ** 2 + velocity[1] ** 2 > MOVING**2 else 0
    total = WEIGHTS[moving, 3] / (math.pi * reach**2)
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
    reach = own[7] * t + REACH_M
    if x**2 + y**2 > reach**2:
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
    moved = motion_score(offset, velocity, variance, later, j.begin_variance[k], t, reach, own)
    return moved + math.log(RETURNS / (max(t, SHORTEST_S) * math.log1p(gap_s / SHORTEST_S)))


@kernel
def _within(declared: Declared, shape: int, place: Array) -> bool:
    """Return whether a place (2,) is inside a declared polygon."""
    corners: Array = declared.corners[declared.first[shape] : declared.first[shape + 1]]
    return inside(corners, place[0], place[1])


@kernel
def _in_exit(declared: Declared, place: Array) -> bool:
    for shape in range(declared.first.shape[0] - 1 - 2 * declared.area.shape[0]):
        if _within(declared, shape, place):
            return True
    return False


@kernel
def _pace(before: tuple[Array, float], after: tuple[Array, float]) -> tuple[float, float]:
    """Return the speed between two velocities with variances, and its relative deviation; NaN where none is known."""
    total = weights = 0.0
    for velocity, variance in (before, after):
        speed = math.hypot(velocity[0], velocity[1])
        if not math.isnan(variance) and speed > 0.0:
            weight = 1.0 / (variance + (PACE * speed) ** 2)
            total, weights = total + weight * speed, weights + weight
    speed = total / weights if weights > 0.0 else math.nan
    return speed, 1.0 / (math.sqrt(weights) * speed)


@kernel
def _log_normal(x: float, median: float, deviation: float) -> float:
    return math.exp(-0.5 * (math.log(x / median) / deviation) ** 2) / (math.sqrt(2.0 * math.pi) * deviation * x)


@kernel
def learned_score(i: Tracklets, n: int, j: Tracklets, k: int, kind: int, returns: Returns) -> tuple[float, float]:
    """Return log p(y, T | i) by the returns of others from near row `n`, -inf where none is known, and its weight."""
    x, y = j.begin[k, 0] - i.end[n, 0], j.begin[k, 1] - i.end[n, 1]
    if returns.id.shape[0] == 0 or x**2 + y**2 < ELSEWHERE_M**2:
        return -math.inf, 0.0
    t, total, weights, far = (j.first_ns[k] - i.last_ns[n]) * _NS, 0.0, 0.0, (5.0 * KERNEL_M) ** 2
    speed, deviation = _pace((i.end_velocity[n], i.end_variance[n]), (j.begin_velocity[k], j.begin_variance[k]))
    for r in range(returns.id.shape[0]):
        x, y = returns.start[r, 0] - i.end[n, 0], returns.start[r, 1] - i.end[n, 1]
        square = x**2 + y**2
        if square > far or returns.kind[r] != kind or returns.id[r] == j.id[k]:
            continue
        weight = returns.weight[r] * math.exp(-0.5 * square / KERNEL_M**2)
        weights += weight
        x, y = returns.end[r, 0] - j.begin[k, 0], returns.end[r, 1] - j.begin[k, 1]
        square = x**2 + y**2
        if square > far:
            continue
        ratio = returns.speed[r] / speed
        known = ratio > 0.0
        spread = math.sqrt(deviation**2 + PACE**2) if known else 2.0 * PACE
        time = _log_normal(t, returns.seconds[r] * (ratio if known else 1.0), spread)
        total += weight * time * math.exp(-0.5 * square / KERNEL_M**2) / (2.0 * math.pi * KERNEL_M**2)
    share = LEARNED * weights / (weights + FIRST_RETURNS)
    return math.log(RETURNS * share * total / weights) if total > 0.0 else -math.inf, share


@kernel
def passage_score(i: Tracklets, n: int, j: Tracklets, k: int, declared: Declared) -> float:
    """Return log p(y, T | i, a declared passage) of row `n` before it and row `k` behind it; -inf: there is none."""
    t, total, passages = (j.first_ns[k] - i.last_ns[n]) * _NS, 0.0, declared.area.shape[0]
    for q in range(passages):
        low, high = declared.seconds[q]
        shape = declared.first.shape[0] - 1 + 2 * (q - passages)
        if not (low <= t <= high and _within(declared, shape, i.end[n]) and _within(declared, shape + 1, j.begin[k])):
            continue
        density = 1.0 / (high - low)
        way = math.hypot(j.begin[k, 0] - i.end[n, 0], j.begin[k, 1] - i.end[n, 1])
        known = (i.end_velocity[n], i.end_variance[n]), (j.begin_velocity[k], j.begin_variance[k])
        speed, deviation = _pace(known[0], known[1])
        if way > 0.0 and speed > 0.0:
            density = (1.0 - BY_PACE) * density + BY_PACE * _log_normal(t, way / speed, deviation)
        total += RETURNS_BY_PASSAGE * density / declared.area[q]
    return math.log(total) if total > 0.0 else -math.inf


@kernel
def _settles_ns(declared: Declared, place: Array) -> int:
    """Return the time after a start in which what begins at a place was there before: in a passage, its longest."""
    seconds, passages = 0.0, declared.area.shape[0]
    for q in range(passages):
        if _within(declared, declared.first.shape[0] + 2 * (q - passages), place):
            seconds = max(seconds, declared.seconds[q, 1])
    return int(seconds / _NS)


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


@kernel
def pair_scores(words: Array, before: Index, after: Index, kind: Index, motion: Array, gap_s: float) -> Array:
    """Return `pair_score` of rows (P,) of `Tracklets`."""
    rows, scores = tracklets_in(words), np.empty(before.shape[0])
    for p in range(before.shape[0]):
        scores[p] = pair_score(rows, before[p], rows, after[p], kind, motion, gap_s)
    return scores


# Matching


@kernel
def _shortest(
    source: int,
    through: bool,
    graph: tuple[Index, Index, Array, Index, Index, Index],
    mates: Index,
    state: tuple[Array, Index, Flags, Index],
    nodes: Index,
) -> None:
    """Find the shortest paths from a node in the residual graph of a matching (Bellman and Ford, with a queue).

    From a row over pairs that are not taken, from a column back over its taken pair, and with `through` over one node
    for all rows and columns that have no partner.

    Args:
        source: the node: a row, a column behind the rows, or the free one behind all.
        through: whether paths go on from the free node.
        graph: of the pairs row, column, value; first pair of each row and the pairs by row; first node.
        mates: pair of each node, or -1.
        state: receives the distances and the pair before each column; marks; queue.
        nodes: all of the connected part.
    """
    i, j, value, first, by_row, _ = graph
    distance, via, queued, queue = state
    free, rows = mates.shape[0], first.shape[0] - 1
    for node in nodes:
        distance[node] = math.inf
    distance[free], distance[source] = math.inf, 0.0
    size, head, tail = queue.shape[0], 0, 1
    queue[0], queued[source] = source, True
    while head != tail:
        u = queue[head]
        head, queued[u] = (head + 1) % size, False
        at = distance[u]
        if u == free:
            if not through:
                continue
            for node in nodes:
                if (mates[node] >= 0) == (node >= rows) and at < distance[node]:
                    distance[node] = at
                    if not queued[node]:
                        queue[tail], queued[node], tail = node, True, (tail + 1) % size
            continue
        if u < rows:
            for p in by_row[first[u] : first[u + 1]]:
                node = rows + j[p]
                if p != mates[u] and at - value[p] < distance[node]:
                    distance[node], via[node] = at - value[p], p
                    if not queued[node]:
                        queue[tail], queued[node], tail = node, True, (tail + 1) % size
            step, target = 0.0, free
        elif mates[u] >= 0:
            step, target = value[mates[u]], i[mates[u]]
        else:
            step, target = 0.0, free
        if at + step < distance[target]:
            distance[target] = at + step
            if target == free:
                via[free] = u
            if not queued[target]:
                queue[tail], queued[target], tail = target, True, (tail + 1) % size


@kernel
def _parts(i: Index, j: Index, rows: int, count: int) -> tuple[Index, Index, Index]:
    """Return the connected part of each node, and the nodes by part with the first of each."""
    part = np.arange(count)
    for p in range(i.shape[0]):
        a, b = i[p], rows + j[p]
        while part[a] != a:
            part[a] = part[part[a]]
            a = part[a]
        while part[b] != b:
            part[b] = part[part[b]]
            b = part[b]
        part[max(a, b)] = min(a, b)
    for node in range(count):
        part[node] = part[part[node]]
    first = np.zeros(count + 1, np.int64)
    for node in range(count):
        first[part[node] + 1] += 1
    first = np.cumsum(first)
    at, nodes = first.copy(), np.empty(count, np.int64)
    for node in range(count):
        nodes[at[part[node]]] = node
        at[part[node]] += 1
    return part, nodes, first


@kernel
def match(i: Index, j: Index, value: Array, wanted: Flags, rows: int) -> tuple[Flags, Array, Array]:
    """Find the matching with the largest sum, and its margins.

    Args:
        i: (P,) rows, each below `rows`.
        j: (P,) columns.
        value: (P,) positive multiples of `QUANTUM`.
        wanted: (M,) columns whose margins and odds are wanted.
        rows: how many there are.

    Returns:
        Which pairs are taken (P,); what the sum loses without each wanted one (P,); and of each wanted column (M,) the
        largest sum with it less the largest one without, -inf where it has no pair.
    """
    columns = wanted.shape[0]
    count = rows + columns
    part, nodes, start = _parts(i, j, rows, count)
    first = np.zeros(rows + 1, np.int64)
    for row in i:
        first[row + 1] += 1
    first = np.cumsum(first)
    by_row = np.argsort(i, kind="mergesort")
    mates = np.full(count, -1)
    state = (
        np.full(count + 1, math.inf),
        np.full(count + 1, -1),
        np.zeros(count + 1, np.bool_),
        np.empty(count + 2, np.int64),
    )
    distance, via = state[0], state[1]
    graph = i, j, value, first, by_row, start
    for source in range(rows):
        if first[source] == first[source + 1]:
            continue
        _shortest(source, False, graph, mates, state, nodes[start[part[source]] : start[part[source] + 1]])
        if not distance[count] < 0.0:
            continue
        column = via[count]
        if column < rows:  # this row has no partner any more
            row = column
            column = rows + j[mates[row]]
            mates[row] = -1
        row = -1
        while row != source:
            p = via[column]
            row = i[p]
            mates[column], column_before = p, mates[row]
            mates[row] = p
            if row != source:
                column = rows + j[column_before]
    taken, margin, odds = np.zeros(i.shape[0], np.bool_), np.zeros(i.shape[0]), np.full(columns, -math.inf)
    for row in range(rows):
        if mates[row] >= 0:
            taken[mates[row]] = True
    known = -1
    for node in range(count):  # by part would be shorter, but columns of a part are few
        if node < rows or not wanted[node - rows]:
            continue
        mine = nodes[start[part[node]] : start[part[node] + 1]]
        p = mates[node]
        if p >= 0:
            _shortest(i[p], True, graph, mates, state, mine)
            margin[p], odds[node - rows], known = value[p] + distance[node], value[p] + distance[count], -1
        elif mine.shape[0] > 1:
            if known != part[node]:
                _shortest(count, True, graph, mates, state, mine)
                known = part[node]
            odds[node - rows] = -distance[node]
    return taken, margin, odds


# While tracking


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
def _copy(source: Array, rows: Index, target: Array, places: Index, layout: Index) -> None:
    """Write rows of the words of a record to places in another's, column by column."""
    width = layout[-1, 0] + layout[-1, 1]
    many, most = source.shape[0] // width, target.shape[0] // width
    for c in range(layout.shape[0]):
        begin, size = layout[c, 0], layout[c, 1]
        for k in range(rows.shape[0]):
            n, place = begin * many + rows[k] * size, begin * most + places[k] * size
            for s in range(size):
                target[place + s] = source[n + s]


@kernel
def _selected(source: Array, rows: Index, layout: Index) -> Array:
    """Return the words of the rows."""
    target = np.empty(rows.shape[0] * (layout[-1, 0] + layout[-1, 1]))
    _copy(source, rows, target, np.arange(rows.shape[0]), layout)
    return target


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
    identity, spot = objects.id, np.empty(objects.id.shape[0], np.int64)
    before, now, before_ns = live.id.shape[0], tracks.id.shape[0], np.max(live.last_ns) if live.id.shape[0] else -1
    row, source = np.empty(identity.shape[0], np.int64), np.empty(identity.shape[0], np.int64)
    ended = np.empty(before, np.int64)
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
    same = count == before
    for k in range(count):
        same &= row[k] == k
    if same:
        words, spots = live_words.copy(), place_words.copy()
    else:
        words, spots = np.zeros(count * _TRACKLET), np.zeros(count * _PLACE)
        stays = np.flatnonzero(row[:count] >= 0)
        _copy(live_words, row[stays], words, stays, _TRACKLETS)
        _copy(place_words, row[stays], spots, stays, _PLACES)
    rows, seen = tracklets_in(words), places_in(spots)
    hits, hit = np.empty(count, np.int64), 0
    for k in range(count):
        n = source[k]
        if row[k] < 0:
            rows.id[k], rows.object[k], rows.first_ns[k], rows.probability[k] = tracks.id[n], -1, stamp_ns, 1.0
            rows.begin[k], rows.size[k] = tracks.center[n, :2], math.nan
        if n >= 0 and tracks.detection[n] >= 0:
            hits[hit], hit = k, hit + 1
        elif row[k] >= 0 and live.last_ns[row[k]] == before_ns:
            _fit(rows, k, seen, k, motion[rows.label[k], 0])
        if n >= 0:
            rows.confirmed[k] |= tracks.confirmed[n]
    hits = hits[:hit]
    _detect(rows, seen, tracks, objects, (hits, source[hits], spot[hits]), stamp_ns, motion)
    leaves = ended[:gone][live.object[ended[:gone]] >= 0]
    if leaves.shape[0]:
        lost = tracklets_in(lost_words)
        merged = np.empty(lost_words.shape[0] + leaves.shape[0] * _TRACKLET)
        places = np.searchsorted(lost.id, live.id[leaves]) + np.arange(leaves.shape[0])
        others = np.ones(lost.id.shape[0] + leaves.shape[0], np.bool_)
        others[places] = False
        _copy(lost_words, np.arange(lost.id.shape[0]), merged, np.flatnonzero(others), _TRACKLETS)
        _copy(live_words, leaves, merged, places, _TRACKLETS)
        after, seen = tracklets_in(merged), places_in(place_words)
        for n in range(leaves.shape[0]):
            _fit(after, places[n], seen, leaves[n], motion[live.label[leaves[n]], 0])
        return words, spots, merged
    return words, spots, lost_words


@kernel
def _around(begun: Beginnings, kind: int, identity: int, x: float, y: float) -> float:
    """Return how many other tracks of a kind began around a place, per m^2."""
    total, far = 0.0, (5.0 * KERNEL_M) ** 2
    for n in range(begun.id.shape[0]):
        square = (begun.place[n, 0] - x) ** 2 + (begun.place[n, 1] - y) ** 2
        if square < far and begun.kind[n] == kind and begun.id[n] != identity:
            total += begun.new[n] * math.exp(-0.5 * square / KERNEL_M**2)
    return total / (2.0 * math.pi * KERNEL_M**2)


@kernel
def _newest(stamp_ns: Index, most: int) -> Index:
    """Return the rows of the newest stamps, at most so many, ascending."""
    if stamp_ns.shape[0] <= most:
        return np.arange(stamp_ns.shape[0])
    return np.sort(np.argsort(-stamp_ns, kind="mergesort")[:most])


@kernel
def _scores(
    tables: tuple[Tracklets, Tracklets, Beginnings, Returns, Statistics],
    ends: Index,
    young: Index,
    due: Flags,
    moment: tuple[int, float],
    kinds: Columns,
    vectors: Vectors,
) -> tuple[Array, Array]:
    """Return s_ij (E, M) of ends and beginnings, NaN or -inf where they are not joined, and its part by appearance.

    Only pairs connected with a decision by pairs that may be joined are scored.

    Args:
        tables: lost objects, live tracks, beginnings, returns and statistics of classes.
        ends: (E,) rows of the lost objects and, behind these, of live tracks.
        young: (M,) rows of live tracks that began lately.
        due: (M,) those on which to decide.
        moment: stamp and `Rejoin.gap_s`.
        kinds: the fields of `Kinds`.
        vectors: of the tracks and of the lost objects.
    """
    (lost, live, begun, returns, known), (motion, kind, area, plan), (stamp_ns, gap_s) = tables, kinds, moment
    declared, many = Declared(*plan), lost.id.shape[0]
    score, looks = np.full((ends.shape[0], young.shape[0]), math.nan), np.zeros((ends.shape[0], young.shape[0]))
    wanted, used, grows = due.copy(), np.zeros(ends.shape[0], np.bool_), True
    news = np.zeros(area.shape[0])
    for n in range(begun.id.shape[0]):
        news[begun.kind[n]] += begun.new[n]
    while grows:
        grows = False
        for m in range(young.shape[0]):
            k = young[m]
            c = kind[live.label[k]]
            seconds = max(min(RECENT_NS, stamp_ns - known.since_ns[c]) * _NS, 1.0)
            # The own beginning of a track that was decided on is among the others, with at most one.
            everywhere = max(1.0 + news[c] - (live.object[k] >= 0), 1e-12) / area[live.label[k]]
            least_log, log_rate = math.log(0.5 * everywhere / seconds), math.nan
            if _in_exit(declared, live.begin[k]):
                least_log = math.inf
            for at in range(ends.shape[0]):
                if not math.isnan(score[at, m]) or not (wanted[m] or used[at]):
                    continue
                table, n = (lost, ends[at]) if ends[at] < many else (live, ends[at] - many)
                value = pair_score(table, n, live, k, kind, motion, gap_s)
                if value > -math.inf:
                    way, share = passage_score(table, n, live, k, declared), 0.0
                    if way == -math.inf:
                        way, share = learned_score(table, n, live, k, c, returns)
                    value = _log_sum(value + math.log1p(-share), way)
                    sizes = known.count[c], known.mean[c], known.square[c]
                    value += size_score(table.size[n], live.size[k], sizes[0], sizes[1], sizes[2], LEAST_SIZES)
                    if vectors.total.shape[1] > 0:
                        looks[at, m] = appearance_score(vectors, table.id[n], live.id[k], c)
                if value + max(looks[at, m], 0.0) > least_log and not _in_exit(declared, table.end[n]):
                    if math.isnan(log_rate):
                        around = _around(begun, c, live.id[k], live.begin[k, 0], live.begin[k, 1])
                        log_rate = math.log(0.5 * (everywhere + around) / seconds)
                    value = round((value + looks[at, m] - log_rate) / QUANTUM) * QUANTUM
                else:
                    value = -math.inf
                score[at, m] = value
                if value > 0.0:
                    grows |= not (wanted[m] and used[at])
                    wanted[m] = used[at] = True
    return score, looks


@kernel
def _count_gaps(
    score: Array,
    tables: tuple[Tracklets, Tracklets],
    ends: Index,
    young: Index,
    due: Flags,
    kind: Index,
    vectors: Vectors,
) -> None:
    """Count the distances of pairs that are sure by their scores without appearance."""
    lost, live = tables
    many = lost.id.shape[0]
    for m in np.flatnonzero(due):
        best = -1
        for at in range(ends.shape[0]):
            if score[at, m] >= SURE and (best < 0 or score[at, m] > score[best, m]):
                best = at
        if best < 0:
            continue
        rest = 0.0
        for at in range(ends.shape[0]):
            if at != best and score[at, m] > rest:
                rest = score[at, m]
        for other in range(young.shape[0]):
            if other != m and score[best, other] > rest:
                rest = score[best, other]
        if score[best, m] - rest >= SURE:
            k = young[m]
            one = lost.id[ends[best]] if ends[best] < many else live.id[ends[best] - many]
            count_distance(vectors, one, live.id[k], kind[live.label[k]])


@kernel
def _measure(known: Statistics, c: int, size: Array) -> None:
    """Count the sizes (3,) of a track in the statistics of a class."""
    for s in range(3):
        if not math.isnan(size[s]):
            known.count[c, s] += 1.0
            apart = size[s] - known.mean[c, s]
            known.mean[c, s] += apart / known.count[c, s]
            known.square[c, s] += apart * (size[s] - known.mean[c, s])


@kernel
def _continue(live: Tracklets, k: int, table: Tracklets, row: int, probability: float) -> None:
    """Let live row `k` go on with the object of a row before the gap."""
    live.object[k], live.probability[k] = table.object[row], table.probability[row] * probability
    share = table.detections[row] / (table.detections[row] + live.detections[k])
    for s in range(3):
        size, own = table.size[row, s], live.size[k, s]
        live.size[k, s] = own if math.isnan(size) else size if math.isnan(own) else own + share * (size - own)
    live.detections[k] += table.detections[row]


@kernel
def _with_beginnings(
    begun_words: Array, live: Tracklets, rows: Index, odds: Array, stamp_ns: int, kinds: Columns, known: Statistics
) -> Array:
    """Return the words of the beginnings of the last time, and of rows of live tracks with their odds to be joined."""
    begun, kind, declared = beginnings_in(begun_words), kinds[1], Declared(*kinds[3])
    recent = np.flatnonzero(begun.stamp_ns >= stamp_ns - RECENT_NS)
    recent = recent[max(0, recent.shape[0] + rows.shape[0] - MOST_BEGINNINGS) :]
    more = np.empty((recent.shape[0] + rows.shape[0]) * _BEGINNING)
    found = beginnings_in(more)
    _copy(begun_words, recent, more, np.arange(recent.shape[0]), _BEGINNINGS)
    for n in range(rows.shape[0]):
        at, k = recent.shape[0] + n, rows[n]
        c = kind[live.label[k]]
        found.id[at], found.kind[at], found.stamp_ns[at] = live.id[k], c, live.first_ns[k]
        settled = live.first_ns[k] >= known.settled_ns[c] + _settles_ns(declared, live.begin[k])
        found.place[at], found.new[at] = live.begin[k], settled / (1.0 + math.exp(odds[n]))
    return more


@kernel
def _with_returns(
    return_words: Array,
    tables: tuple[Tracklets, Tracklets],
    ends: Index,
    young: Index,
    score: Array,
    stamp_ns: int,
    kind: Index,
) -> Array:
    """Return the words of the returns of the last time, and of pairs (E, M) with their scores."""
    lost, live = tables
    many, returns = lost.id.shape[0], returns_in(return_words)
    weight = np.zeros(score.shape)
    for m in range(young.shape[0]):
        total = 1.0
        for at in range(ends.shape[0]):
            table, n = (lost, ends[at]) if ends[at] < many else (live, ends[at] - many)
            x, y = live.begin[young[m], 0] - table.end[n, 0], live.begin[young[m], 1] - table.end[n, 1]
            if score[at, m] > -math.inf:
                weight[at, m] = math.exp(score[at, m]) if x**2 + y**2 >= ELSEWHERE_M**2 else 0.0
                total += math.exp(score[at, m])
        weight[:, m] /= total
    before, after = np.nonzero(weight >= LEAST_WEIGHT)
    recent = np.flatnonzero(returns.stamp_ns >= stamp_ns - LEARNED_NS)
    recent = recent[max(0, recent.shape[0] + before.shape[0] - MOST_RETURNS) :]
    before, after = before[:MOST_RETURNS], after[:MOST_RETURNS]
    more = np.empty((recent.shape[0] + before.shape[0]) * _RETURN)
    found = returns_in(more)
    _copy(return_words, recent, more, np.arange(recent.shape[0]), _RETURNS)
    for p in range(before.shape[0]):
        at, k, end = recent.shape[0] + p, young[after[p]], ends[before[p]]
        table, n = (lost, end) if end < many else (live, end - many)
        found.id[at], found.kind[at], found.stamp_ns[at] = live.id[k], kind[live.label[k]], live.first_ns[k]
        found.start[at], found.end[at] = table.end[n], live.begin[k]
        found.seconds[at] = (live.first_ns[k] - table.last_ns[n]) * _NS
        later = live.begin_velocity[k], live.begin_variance[k]
        found.speed[at] = _pace((table.end_velocity[n], table.end_variance[n]), later)[0]
        found.weight[at] = weight[before[p], after[p]]
    return more


@kernel
def decide(
    given: tuple[Array, Array, Array, Array, Array],
    young: Index,
    due: Flags,
    stamp_ns: int,
    kinds: Columns,
    limits: tuple[float, float],
    vectors: Vectors,
) -> tuple[Array, Array, Array, Index]:
    """Decide on new tracks: write their objects to the words of the live tracks, and sizes to the words of the classes.

    Args:
        given: words of the live tracks, the lost objects, the beginnings, the returns and the classes.
        young: (M,) rows of live tracks that began lately.
        due: (M,) those on which to decide.
        stamp_ns: of the frame.
        kinds: the fields of `Kinds`.
        limits: `Rejoin.gap_s` and `min_probability`.
        vectors: of the tracks and of the lost objects.

    Returns:
        The words of the lost objects, the beginnings and the returns, and the rows of live tracks that were joined:
        they are not detected any more, and end.
    """
    live_words, lost_words, begun_words, return_words, class_words = given
    live, lost, known = tracklets_in(live_words), tracklets_in(lost_words), statistics_in(class_words)
    kind, many = kinds[1], lost.id.shape[0]
    coasting = np.flatnonzero((live.object >= 0) & (live.last_ns < stamp_ns))
    ends = np.concatenate((np.arange(many), many + coasting))
    ends = ends[_newest(np.concatenate((lost.last_ns, live.last_ns[coasting])), MOST_SCORES // max(young.shape[0], 1))]
    tables = lost, live, beginnings_in(begun_words), returns_in(return_words), known
    score, looks = _scores(tables, ends, young, due, (stamp_ns, limits[0]), kinds, vectors)
    if vectors.total.shape[1] > 0:
        _count_gaps(score - looks, (lost, live), ends, young, due, kind, vectors)
    decided = np.flatnonzero(due)
    return_words = _with_returns(return_words, (lost, live), ends, young[decided], score[:, decided], stamp_ns, kind)
    before, after = np.nonzero(score > 0.0)
    gain = np.empty(before.shape[0])
    for p in range(before.shape[0]):
        gain[p] = score[before[p], after[p]]
    if before.shape[0] > MOST_PAIRS:
        best = np.sort(np.argsort(-gain, kind="mergesort")[:MOST_PAIRS])
        before, after, gain = before[best], after[best], gain[best]
    taken, margin, odds = match(before, after, gain, due, ends.shape[0])
    kept, gone = np.ones(many, np.bool_), np.zeros(live.id.shape[0], np.bool_)
    for k in young[decided]:
        _measure(known, kind[live.label[k]], live.size[k])
        live.object[k] = live.id[k]
    for n in np.flatnonzero(taken):
        probability = 1.0 / (1.0 + math.exp(-margin[n]))
        if not due[after[n]] or probability < limits[1]:
            continue
        k, row = young[after[n]], ends[before[n]]
        if row < many:
            kept[row] = False
            _continue(live, k, lost, row, probability)
        else:
            gone[row - many] = True
            _continue(live, k, live, row - many, probability)
    if not kept.all():
        lost_words = _selected(lost_words, np.flatnonzero(kept), _TRACKLETS)
    begun_words = _with_beginnings(begun_words, live, young[decided], odds[decided], stamp_ns, kinds, known)
    return lost_words, begun_words, return_words, np.flatnonzero(gone)


@kernel
def advance(
    given: Columns,
    moment: tuple[Array, Array, int],
    kinds: Columns,
    limits: tuple[float, float, float, int],
    vectors: Columns,
) -> tuple[Array, Array, Array, Array, Array, Array, Index, Array, Index, int, int]:
    """Return the words of `Rejoining` after a frame.

    Args:
        given: those before it.
        moment: words of the tracks of the frame and of the objects of the density, and the stamp.
        kinds: the fields of `Kinds`.
        limits: the first fields of `Rejoin`.
        vectors: the fields of `Vectors`.

    Returns:
        The words; object and probability (N,) of the tracks of the frame; ids of the objects that were joined while
        they were not detected; and the numbers of joins and of lost objects that were dropped because there were too
        many.
    """
    live_words, place_words, lost_words, begun_words, return_words, class_words = given
    gap_s, least, decide_s, most = limits
    track_words, object_words, stamp_ns = moment
    live_words, place_words, lost_words = follow(
        (live_words, place_words, lost_words), track_words, object_words, stamp_ns, kinds[0]
    )
    live = tracklets_in(live_words)
    count = live.id.shape[0]
    young, due, decides = np.empty(count, np.int64), np.empty(count, np.bool_), False
    rivals = 0
    for k in range(count):
        undecided = live.object[k] < 0
        if not live.confirmed[k] or not (
            undecided or (live.object[k] == live.id[k] and live.first_ns[k] >= stamp_ns - RIVAL_NS)
        ):
            continue
        young[rivals] = k
        due[rivals] = (
            undecided
            and live.last_ns[k] == stamp_ns
            and live.detections[k] > 1
            and (stamp_ns - live.first_ns[k]) * _NS >= decide_s
        )
        decides |= due[rivals]
        rivals += 1
    joined, ends = 0, np.empty(0, np.int64)
    if decides:
        class_words = class_words.copy()
        had = live.object.copy()
        lost_words, begun_words, return_words, rows = decide(
            (live_words, lost_words, begun_words, return_words, class_words),
            young[:rivals],
            due[:rivals],
            stamp_ns,
            kinds,
            (gap_s, least),
            Vectors(*vectors),
        )
        joined = np.sum((had < 0) & (live.object >= 0) & (live.object != live.id))
        if rows.shape[0]:
            ends, stays = live.id[rows], np.ones(count, np.bool_)
            stays[rows] = False
            others = np.flatnonzero(stays)
            live_words = _selected(live_words, others, _TRACKLETS)
            place_words = _selected(place_words, others, _PLACES)
            live = tracklets_in(live_words)
    lost = tracklets_in(lost_words)
    dropped, inside = 0, 0
    for last_ns in lost.last_ns:
        inside += (stamp_ns - last_ns) * _NS <= gap_s
    if inside < lost.last_ns.shape[0] or inside > most:
        rows = np.flatnonzero((stamp_ns - lost.last_ns) * _NS <= gap_s)
        dropped = max(0, inside - most)
        lost_words = _selected(lost_words, rows[_newest(lost.last_ns[rows], most)], _TRACKLETS)
    shown = tracks_in(track_words)
    objects, probability, k = np.full(shown.id.shape[0], -1), np.ones(shown.id.shape[0]), 0
    for n in range(shown.id.shape[0]):
        while k < live.id.shape[0] and live.id[k] < shown.id[n]:
            k += 1
        if k < live.id.shape[0] and live.id[k] == shown.id[n]:
            objects[n], probability[n] = live.object[k], live.probability[k]
    words = live_words, place_words, lost_words, begun_words, return_words, class_words
    return *words, objects, probability, ends, joined, dropped


class Joined(NamedTuple):
    """Tracks of a frame with their objects.

    Attributes:
        density: the posterior; objects that were joined while they were not detected are no longer in it.
        tracks: of the frame, without these objects.
        object: (N,) int64 id of the first track of the object, -1 while that is not decided.
        probability: (N,) that all joins of the object are right, 1 without a join.
        joins: of the frame.
        dropped: lost objects that were dropped because there were too many.
    """

    density: Density
    tracks: Tracks
    object: Index
    probability: Array
    joins: int
    dropped: int


def rejoin_tracks(
    before: Rejoining | None,
    density: Density,
    tracks: Tracks,
    settings: Rejoin,
    kinds: Kinds,
    embedding: Embedding | None,
    detections: tuple[Index, Index],
) -> Joined:
    """Return the tracks of a frame with their objects.

    Args:
        before: the state before the frame; None before the first.
        density: the posterior. While the sensor is found to move without poses nothing is joined: places do not stay.
        tracks: of the frame.
        settings: the limits.
        kinds: of the classes.
        embedding: vectors of the detections.
        detections: row of each measurement among them, and (K,) the measurement of each object of the density.

    Raises:
        FrameError: vectors of another length than before.
    """
    state = before or Rejoining.empty(len(kinds.kind), density.stamp_ns)
    parts = state.live, state.places, state.lost, state.beginnings, state.returns, state.classes
    given = tuple(one.words for one in parts)
    gap_s = settings.gap_s if density.sensor_motion is None else 0.0
    limits = gap_s, settings.min_probability, settings.decide_s, settings.most
    looks, vectors, (chosen, measurement) = None, NOTHING, detections
    if (model := settings.embedding_model) is not None and (embedding is not None or state.appearance is not None):
        rows = tracks.detection >= 0
        identity = tracks.id[rows]
        source = chosen[measurement[np.searchsorted(density.bernoulli.id, identity)]]
        looks = seen(state, model, embedding, (identity, tracks.label[rows], source), kinds.kind, density.stamp_ns)
    if looks is not None:
        appearance, ids = looks
        vectors = Vectors(ids, appearance.total, state.lost.id, appearance.lost, appearance.counts)
    *words, objects, probability, ended, joins, dropped = advance(
        given,
        (tracks.words, density.bernoulli.words, density.stamp_ns),
        (*kinds[:3], tuple(kinds.declared)),
        limits,
        tuple(vectors),
    )
    live, places, lost, begun, returns, known = words
    after = Rejoining(
        Tracklets.of(live),
        Places.of(places),
        Lost.of(lost),
        Beginnings.of(begun),
        Returns.of(returns),
        Statistics.of(known),
    )
    if looks is not None:
        after = replace(after, appearance=aligned(*looks, state.lost, after.live, after.lost))
    density = replace(density, rejoining=after)
    if len(ended):
        stays = ~np.isin(tracks.id, ended)
        density, tracks = _without(density, ended), tracks.take(stays)
        objects, probability = objects[stays], probability[stays]
    return Joined(density, tracks, objects, probability, joins, dropped)


def _without(density: Density, identity: Index) -> Density:
    stays = ~np.isin(density.bernoulli.id, identity)
    own, pi, misses = density.self_calibration, density.class_probability, density.misses
    if own is not None:
        own = replace(own, objects=own.objects[stays], innovations=own.innovations[stays])
    return replace(
        density,
        bernoulli=density.bernoulli.take(stays),
        misses=None if misses is None else misses.take(stays),
        class_probability=None if pi is None else pi[stays],
        self_calibration=own,
    )

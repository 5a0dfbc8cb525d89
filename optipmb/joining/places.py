"""Places where objects begin, are gone, and return: learned while tracking, or declared as exits and passages.

lambda is the rate of new objects, half uniform over the area of the class, half around other beginnings and ends. Each
beginning counts with the probability that it was new; objects in view when a session or one of its sensors starts count
nothing. Each object that is lost counts `BY_END`: where one leaves, others come, also where none was seen to come yet.

Objects lost in an exit do not return, and objects that begin there are new. An object lost at the start of a passage
may be seen again at its end after a time within bounds, which adds a part to p(y, T | i): most objects keep their speed
on the way, the time of the others is uniform. Passages that are not declared are learned: each beginning is kept with
the tracks that it may continue, weighted by the odds of these. Objects lost near the place of one return near the place
of the other, after a time in proportion to the speeds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.joining.evidence import RETURNS, log_sum
from optipmb.joining.records import beginnings_in, copy_rows, ends_in, layout_of, returns_in, tracklets_in
from optipmb.model.lost_objects import Beginnings, Ends, Returns
from optipmb.model.polygons import inside

if TYPE_CHECKING:
    from optipmb.model.lost_objects import Statistics, Tracklets
    from optipmb.model.rows import Array, Columns, Index

KERNEL_M: Final = 3.0
RECENT_NS: Final = 120 * 10**9
"""Beginnings that count for the rate of new objects while tracking."""
MOST_SHAPES: Final = 64
"""Exits and passages of a `Rejoin`, and"""
MOST_CORNERS: Final = 100
"""corners of each of their polygons."""
RETURNS_BY_PASSAGE: Final = 0.9
PACE: Final = 0.12
"""Standard deviation of the speed in a passage from the one before or behind it, relative."""
BY_PACE: Final = 0.95
"""Share of the objects in a passage that keep their speed; the time of the others is uniform within the bounds."""
BY_END: Final = 0.1
"""Beginnings that an end stands for: with it, joins are right about as often as their probabilities say."""
LEARNED_NS: Final = 600 * 10**9
"""Time in which returns teach where others return."""
ELSEWHERE_M: Final = 6.0
"""Returns nearer to where they were lost teach nothing: motion says more, and at a door others come out."""
LIKELY: Final = (0.02, 0.8)
"""Bounds of the probability that an object returns which was lost at a place."""
PRIOR_ENDS: Final = 2.0
"""Ends that weigh as much as the probability without any ends, `RETURNS`."""
MOST_ENDS: Final = 500
LEARNED: Final = 0.8
"""Share of the returns that are like others, if many are known; it is half from"""
FIRST_RETURNS: Final = 0.5
"""this sum of weights on."""
LEAST_WEIGHT: Final = 0.002
MOST_RETURNS: Final = 500
MOST_BEGINNINGS: Final = 2000
_NS: Final = 1e-9
BEGINNING: Final = Beginnings.width
RETURN: Final = Returns.width
END: Final = Ends.width
BEGINNING_COLUMNS: Final = layout_of(Beginnings)
RETURN_COLUMNS: Final = layout_of(Returns)
END_COLUMNS: Final = layout_of(Ends)

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


class DeclaredPlaces(NamedTuple):
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
    def of(cls, exits: tuple[Polygon, ...] = (), passages: tuple[Passage, ...] = ()) -> DeclaredPlaces:
        """Return the exits and passages as arrays."""
        shapes = [*exits, *(one for way in passages for one in (way.start, way.end))]
        ends = [np.array(way.end, np.float64) for way in passages]
        turned = [one[:, 0] * np.roll(one[:, 1], -1) - one[:, 1] * np.roll(one[:, 0], -1) for one in ends]
        return cls(
            np.array([place for one in shapes for place in one], np.float64).reshape(-1, 2),
            np.cumsum([0, *map(len, shapes)]).astype(np.int64),
            np.array([way.s for way in passages], np.float64).reshape(-1, 2),
            np.array([0.5 * abs(one.sum()) for one in turned], np.float64),
        )


@kernel
def within_shape(declared: DeclaredPlaces, shape: int, place: Array) -> bool:
    """Return whether a place (2,) is inside a declared polygon."""
    corners: Array = declared.corners[declared.first[shape] : declared.first[shape + 1]]
    return inside(corners, place[0], place[1])


@kernel
def in_exit(declared: DeclaredPlaces, place: Array) -> bool:
    """Return whether a place (2,) is inside an exit."""
    for shape in range(declared.first.shape[0] - 1 - 2 * declared.area.shape[0]):
        if within_shape(declared, shape, place):
            return True
    return False


@kernel
def settles_ns(declared: DeclaredPlaces, place: Array) -> int:
    """Return the time after a start in which what begins at a place was there before: in a passage, its longest."""
    seconds, passages = 0.0, declared.area.shape[0]
    for q in range(passages):
        if within_shape(declared, declared.first.shape[0] + 2 * (q - passages), place):
            seconds = max(seconds, declared.seconds[q, 1])
    return int(seconds / _NS)


@kernel
def pace_between(before: tuple[Array, float], after: tuple[Array, float]) -> tuple[float, float]:
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
def passage_score(i: Tracklets, n: int, j: Tracklets, k: int, declared: DeclaredPlaces) -> float:
    """Return log p(y, T | i, a declared passage) of row `n` before it and row `k` behind it; -inf: there is none."""
    t, total, passages = (j.first_ns[k] - i.last_ns[n]) * _NS, 0.0, declared.area.shape[0]
    for q in range(passages):
        low, high = declared.seconds[q]
        shape = declared.first.shape[0] - 1 + 2 * (q - passages)
        if not (
            low <= t <= high
            and within_shape(declared, shape, i.end[n])
            and within_shape(declared, shape + 1, j.begin[k])
        ):
            continue
        density = 1.0 / (high - low)
        way = math.hypot(j.begin[k, 0] - i.end[n, 0], j.begin[k, 1] - i.end[n, 1])
        known = (i.end_velocity[n], i.end_variance[n]), (j.begin_velocity[k], j.begin_variance[k])
        speed, deviation = pace_between(known[0], known[1])
        if way > 0.0 and speed > 0.0:
            density = (1.0 - BY_PACE) * density + BY_PACE * _log_normal(t, way / speed, deviation)
        total += RETURNS_BY_PASSAGE * density / declared.area[q]
    return math.log(total) if total > 0.0 else -math.inf


@kernel
def with_declared(score: Array, words: Array, before: Index, after: Index, declared: DeclaredPlaces) -> Array:
    """Return scores (P,) of rows of `Tracklets` with passages; -inf where one is lost, or the other begins, in an exit.

    Args:
        score: `optipmb.joining.evidence.pair_scores`.
        words: of the tracks.
        before: (P,) rows before the gap.
        after: (P,) rows behind it.
        declared: the exits and passages.
    """
    rows, result = tracklets_in(words), score.copy()
    for p in range(score.shape[0]):
        if in_exit(declared, rows.end[before[p]]) or in_exit(declared, rows.begin[after[p]]):
            result[p] = -math.inf
        elif score[p] > -math.inf:
            result[p] = log_sum(score[p], passage_score(rows, before[p], rows, after[p], declared))
    return result


@kernel
def learned_score(i: Tracklets, n: int, j: Tracklets, k: int, kind: int, returns: Returns) -> tuple[float, float]:
    """Return log p(y, T | i) by the returns of others from near row `n`, -inf where none is known, and its weight."""
    x, y = j.begin[k, 0] - i.end[n, 0], j.begin[k, 1] - i.end[n, 1]
    if returns.id.shape[0] == 0 or x**2 + y**2 < ELSEWHERE_M**2:
        return -math.inf, 0.0
    t, total, weights, far = (j.first_ns[k] - i.last_ns[n]) * _NS, 0.0, 0.0, (5.0 * KERNEL_M) ** 2
    speed, deviation = pace_between((i.end_velocity[n], i.end_variance[n]), (j.begin_velocity[k], j.begin_variance[k]))
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
def return_score(ends: Ends, kind: int, place: Array) -> float:
    """Return the log ratio of the probability that an object returns which was lost at a place (2,), and `RETURNS`."""
    total, returned, far = PRIOR_ENDS, PRIOR_ENDS * RETURNS, (5.0 * KERNEL_M) ** 2
    for n in range(ends.id.shape[0]):
        square = (ends.place[n, 0] - place[0]) ** 2 + (ends.place[n, 1] - place[1]) ** 2
        if square < far and ends.kind[n] == kind:
            weight = math.exp(-0.5 * square / KERNEL_M**2)
            total, returned = total + weight, returned + weight * ends.returned[n]
    return math.log(min(max(returned / total, LIKELY[0]), LIKELY[1]) / RETURNS)


@kernel
def with_ends(end_words: Array, table: Tracklets, rows: Index, returned: Array, stamp_ns: int, kind: Index) -> Array:
    """Return the words of the ends of the last time, and of rows that have returned, or not (`returned`, of all)."""
    if rows.shape[0] == 0:
        return end_words
    recent = np.flatnonzero(ends_in(end_words).stamp_ns >= stamp_ns - LEARNED_NS)
    rows = rows[:MOST_ENDS]
    recent = recent[max(0, recent.shape[0] + rows.shape[0] - MOST_ENDS) :]
    more = np.empty((recent.shape[0] + rows.shape[0]) * END)
    found = ends_in(more)
    copy_rows(end_words, recent, more, np.arange(recent.shape[0]), END_COLUMNS)
    for p in range(rows.shape[0]):
        at, n = recent.shape[0] + p, rows[p]
        found.id[at], found.kind[at], found.stamp_ns[at] = table.id[n], kind[table.label[n]], stamp_ns
        found.place[at], found.returned[at] = table.end[n], returned[n]
    return more


@kernel
def beginnings_around(begun: Beginnings, kind: int, identity: int, x: float, y: float) -> float:
    """Return how many other tracks of a kind began around a place, per m^2."""
    total, far = 0.0, (5.0 * KERNEL_M) ** 2
    for n in range(begun.id.shape[0]):
        square = (begun.place[n, 0] - x) ** 2 + (begun.place[n, 1] - y) ** 2
        if square < far and begun.kind[n] == kind and begun.id[n] != identity:
            total += begun.new[n] * math.exp(-0.5 * square / KERNEL_M**2)
    return total / (2.0 * math.pi * KERNEL_M**2)


@kernel
def ends_around(i: Tracklets, rows: Index, j: Tracklets, k: int, kind: Index) -> float:
    """Return how many tracks of rows ended around the place at which row `k` began later, per m^2."""
    total, far = 0.0, (5.0 * KERNEL_M) ** 2
    for n in rows:
        square = (i.end[n, 0] - j.begin[k, 0]) ** 2 + (i.end[n, 1] - j.begin[k, 1]) ** 2
        if square < far and kind[i.label[n]] == kind[j.label[k]] and i.last_ns[n] < j.first_ns[k]:
            total += math.exp(-0.5 * square / KERNEL_M**2)
    return total / (2.0 * math.pi * KERNEL_M**2)


@kernel
def with_beginnings(
    begun_words: Array, live: Tracklets, rows: Index, odds: Array, stamp_ns: int, kinds: Columns, known: Statistics
) -> Array:
    """Return the words of the beginnings of the last time, and of rows of live tracks with their odds to be joined."""
    begun, kind, declared = beginnings_in(begun_words), kinds[1], DeclaredPlaces(*kinds[3])
    recent = np.flatnonzero(begun.stamp_ns >= stamp_ns - RECENT_NS)
    recent = recent[max(0, recent.shape[0] + rows.shape[0] - MOST_BEGINNINGS) :]
    more = np.empty((recent.shape[0] + rows.shape[0]) * BEGINNING)
    found = beginnings_in(more)
    copy_rows(begun_words, recent, more, np.arange(recent.shape[0]), BEGINNING_COLUMNS)
    for n in range(rows.shape[0]):
        at, k = recent.shape[0] + n, rows[n]
        c = kind[live.label[k]]
        found.id[at], found.kind[at], found.stamp_ns[at] = live.id[k], c, live.first_ns[k]
        settled = live.first_ns[k] >= known.settled_ns[c] + settles_ns(declared, live.begin[k])
        found.place[at], found.new[at] = live.begin[k], settled / (1.0 + math.exp(odds[n]))
    return more


@kernel
def with_returns(
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
    more = np.empty((recent.shape[0] + before.shape[0]) * RETURN)
    found = returns_in(more)
    copy_rows(return_words, recent, more, np.arange(recent.shape[0]), RETURN_COLUMNS)
    for p in range(before.shape[0]):
        at, k, end = recent.shape[0] + p, young[after[p]], ends[before[p]]
        table, n = (lost, end) if end < many else (live, end - many)
        found.id[at], found.kind[at], found.stamp_ns[at] = live.id[k], kind[live.label[k]], live.first_ns[k]
        found.start[at], found.end[at] = table.end[n], live.begin[k]
        found.seconds[at] = (live.first_ns[k] - table.last_ns[n]) * _NS
        later = live.begin_velocity[k], live.begin_variance[k]
        found.speed[at] = pace_between((table.end_velocity[n], table.end_variance[n]), later)[0]
        found.weight[at] = weight[before[p], after[p]]
    return more

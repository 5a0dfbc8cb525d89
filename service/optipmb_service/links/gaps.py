"""Views apart: which new object of a view is one that another view has lost, and the ways that teach it.

An object that ended at e and one that began at y, a time T later, are one with the odds

    P p(T, y | e) / lambda(y)

p is the sum of the motion of joining over gaps (`optipmb.joining.evidence`, where the world frames can be compared), of
declared passages, and of what beginnings have taught: each of them counts for all ends it may continue, with its odds,
at the places of both and the time between them, and that times the speed, the more the steadier each of the two was.
lambda is the rate of new objects, in which each beginning counts with the probability that it was new. Kernels of
`KERNEL_M` around places stand for cells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.joining.evidence import QUANTUM, REACH_M, RETURNS, SHORTEST_S, Motion, pair_scores
from optipmb.joining.matching import match
from optipmb.joining.places import KERNEL_M
from optipmb.model.lost_objects import Tracklets
from optipmb_service.links.kinds import AREA_M2, MOTION
from optipmb_service.links.places import area_m2, inside

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index
    from optipmb_service.settings import LinkPassage, LinkRegion, LinkSettings

    Table = NDArray[np.void]

EXAMPLE: Final = np.dtype([
    ("begin", "i8"), ("end", "i8"), ("e", "f8", 2), ("y", "f8", 2), ("time", "f8"), ("way", "f8"), ("weight", "f8"),
])  # fmt: skip
"""A pair of streams, places of an end and a beginning, logarithms of the time and of time times speed, and odds."""
PLACE: Final = np.dtype([("stream", "i8"), ("place", "f8", 2), ("stamp_ns", "i8"), ("weight", "f8")])
"""Where an object ended, or began with a probability that it was new."""
MOST_PLACES: Final = 1000
MOST_SCORES: Final = 20_000
LEAST_WEIGHT: Final = 0.01
SPREAD: Final = 0.12
"""Width of a kernel in the logarithm of a time."""
UNKNOWN_ENDS: Final = 1.0
"""Ends that count against a way before any has been seen."""
DECLARED: Final = 0.9
"""Share of the objects in a declared passage that come out of it."""
ANYHOW: Final = 0.05
"""Share of objects that come back elsewhere than they moved to; where that place is not known, it is `RETURNS`."""
LEAST_SPEED: Final = 0.3
MOST_ODDS: Final = 1e12
LIMIT: Final = Motion._fields.index("limit")


class End(NamedTuple):
    """Ends or beginnings (N,) of objects.

    Attributes:
        number: of the object.
        stream: by number.
        place: (N, 2) in the plane of the area.
        local: (N, 2) in the world frame of the stream.
        velocity: (N, 2) in the plane.
        stamp_ns: of the last or first detection.
        known: whether there was a beginning or an end, and not the start of a stream.
    """

    number: Index
    stream: Index
    plane: Index
    kind: Index
    place: Array
    local: Array
    velocity: Array
    variance: Array
    size: Array
    stamp_ns: Index
    known: NDArray[np.bool_]


class Learned(NamedTuple):
    """What ends and beginnings have taught."""

    examples: Table
    ends: Table
    beginnings: Table

    @classmethod
    def empty(cls) -> Learned:
        return cls(np.zeros(0, EXAMPLE), np.zeros(0, PLACE), np.zeros(0, PLACE))

    def ended(self, ends: End) -> Learned:
        """Return this with further ends."""
        return self._replace(ends=_added(self.ends, ends, np.ones(len(ends.number))))


def _added(places: Table, which: End, weight: Array) -> Table:
    more = np.zeros(len(which.number), PLACE)
    more["stream"], more["place"], more["stamp_ns"] = which.stream, which.place, which.stamp_ns
    more["weight"] = weight * which.known
    return np.concatenate((places, more))[-MOST_PLACES:]


def _kernel(offset: Array) -> Array:
    """Return the kernel of places (..., 2), one at the middle."""
    return np.asarray(np.exp(-0.5 * (offset**2).sum(axis=-1) / KERNEL_M**2))


def rates(learned: Learned, young: End, stamp_ns: int) -> tuple[Array, Array]:
    """Return the rate of new objects at each beginning, 1/(m^2 s), and of its whole stream, 1/s."""
    begun = learned.beginnings
    same = (young.stream[:, None] == begun["stream"]) * begun["weight"]
    near = (same * _kernel(young.place[:, None] - begun["place"])).sum(axis=1) / (2.0 * np.pi * KERNEL_M**2)
    since = np.where(young.stream[:, None] == begun["stream"], begun["stamp_ns"], stamp_ns)
    seconds = np.maximum((stamp_ns - since.min(axis=1, initial=stamp_ns)) * 1e-9, 10.0)
    whole = 1.0 + same.sum(axis=1)
    return 0.5 * (whole / AREA_M2 + near) / seconds, whole / seconds


def _moved(lost: End, young: End, gap_s: float) -> Array:
    """Return the score of joining over gaps (L, Y), where places can be compared."""
    count, many = len(lost.number), len(young.number)
    both = [np.concatenate(one) for one in zip(lost, young, strict=True)]
    rows = End._make(both)
    total, unknown = count + many, np.full((count + many, 2), np.nan)
    words = Tracklets(
        id=np.arange(total),
        label=rows.kind,
        object=np.zeros(total, np.int64),
        first_ns=rows.stamp_ns,
        last_ns=rows.stamp_ns,
        detections=np.ones(total, np.int64),
        confirmed=np.ones(total, np.bool_),
        probability=np.ones(total),
        begin=rows.place,
        end=rows.place,
        begin_velocity=rows.velocity,
        begin_variance=rows.variance,
        end_velocity=rows.velocity,
        end_variance=rows.variance,
        yaw=unknown[:, 0],
        size=rows.size,
        candidate=np.full(total, -1),
        candidate_probability=unknown[:, 0],
    ).words
    before, after = np.divmod(np.arange(count * many), many)
    scores = pair_scores(words, before, count + after, MOTION.kind, MOTION.motion, gap_s).reshape(count, many)
    return np.where(lost.plane[:, None] == young.plane, scores, -np.inf)


def _taught(learned: Learned, lost: End, young: End, seconds: Array) -> Array:
    """Return P p(T, y | e) of what beginnings have taught (L, Y), 1/(m^2 s)."""
    known = learned.examples
    near_end = _kernel(lost.place[:, None] - known["e"]) * (lost.stream[:, None] == known["begin"])  # (L, K)
    near_begin = _kernel(young.place[:, None] - known["y"]) * (young.stream[:, None] == known["end"])  # (Y, K)
    speed = np.maximum(np.hypot(*lost.velocity.T), LEAST_SPEED)
    ends = learned.ends
    many = (_kernel(lost.place[:, None] - ends["place"]) * (lost.stream[:, None] == ends["stream"])).sum(axis=1)
    total = np.zeros(seconds.shape)
    time = np.log(seconds)
    for n in range(len(lost.number)):
        used = np.flatnonzero(near_end[n] * known["weight"] > 1e-4)  # noqa: PLR2004 - it adds nothing
        if len(used) == 0:
            continue
        own, weight = known[used], near_end[n, used] * known["weight"][used]
        values, precision, kernels = {"time": time[n], "way": time[n] + np.log(speed[n])}, [], []
        for column, value in values.items():
            mean = np.average(own[column], weights=weight)
            precision.append(1.0 / (np.average((own[column] - mean) ** 2, weights=weight) + SPREAD**2))
            kernels.append(np.exp(-0.5 * ((value[:, None] - own[column]) / SPREAD) ** 2))
        found = np.average(kernels, axis=0, weights=np.square(precision))
        found = found / (np.sqrt(2.0 * np.pi) * SPREAD * seconds[n][:, None])
        total[n] = (found * weight * near_begin[:, used]).sum(axis=1) / (UNKNOWN_ENDS + many[n])
    return total / (2.0 * np.pi * KERNEL_M**2)


def _declared(passage: LinkPassage, seconds: Array) -> Array:
    """Return the density of the time (L, Y), 1/s: uniform between the bounds, with an edge of a tenth."""
    low, high = passage.s
    edge = 0.1 * (high - low) + 1e-3
    beyond = np.maximum(np.maximum(low - seconds, seconds - high), 0.0)
    return np.asarray(np.exp(-0.5 * (beyond / edge) ** 2) / (high - low + 2.5 * edge))


def _inside(region: LinkRegion, names: dict[int, str], which: End) -> NDArray[np.bool_]:
    held = np.zeros(len(which.number), np.bool_)
    for stream in np.unique(which.stream).tolist():
        at = np.flatnonzero(which.stream == stream)
        held[at] = inside(region, names[stream], which.local[at])
    return held


def decide(
    settings: LinkSettings,
    names: dict[int, str],
    learned: Learned,
    ends: tuple[End, End, NDArray[np.bool_]],
    more: Array,
    stamp_ns: int,
) -> tuple[Index, Array, NDArray[np.bool_], Learned]:
    """Return the row of the lost object of each beginning (Y,), -1 for a new one, its probability, and the examples.

    After the probability comes whether it would be less than `min_probability` without appearance.

    Args:
        settings: of the area.
        names: of the streams.
        learned: until now.
        ends: lost objects (L,), beginnings (Y,), and which of these are to be decided.
        more: (L, Y) of what appearance says.
        stamp_ns: now.
    """
    lost, young, due = ends
    rate, whole = rates(learned, young, stamp_ns)
    seconds = np.maximum((young.stamp_ns - lost.stamp_ns[:, None]) * 1e-9, 1e-3)
    fits = (young.stamp_ns > lost.stamp_ns[:, None]) & (seconds <= settings.gap_s)
    fits &= (lost.kind[:, None] == young.kind) | (lost.kind[:, None] == 0) | (young.kind == 0)
    # No object is faster than its kind allows, also on learned ways.
    apart = np.hypot(*np.moveaxis(young.place - lost.place[:, None], 2, 0))
    reach = MOTION.motion[lost.kind, LIMIT][:, None] * seconds + REACH_M
    fits &= (lost.plane[:, None] != young.plane) | (apart <= reach)
    gone, new = np.zeros(len(lost.number), np.bool_), np.zeros(len(young.number), np.bool_)

    for exit_ in settings.exits:
        gone, new = gone | _inside(exit_, names, lost), new | _inside(exit_, names, young)
    fits &= ~gone[:, None] & ~new
    odds = np.exp(np.minimum(_moved(lost, young, settings.gap_s), 50.0)) + _taught(learned, lost, young, seconds)
    somehow = np.where(lost.plane[:, None] == young.plane, ANYHOW, RETURNS)
    odds = odds / rate + somehow / (seconds * np.log1p(settings.gap_s / SHORTEST_S)) / whole
    for passage in settings.passages:
        way = _inside(passage.from_, names, lost)[:, None] & _inside(passage.to, names, young)
        if not way.any():
            continue
        mouth = np.minimum(whole, rate * (area_m2(passage.to) + 2.0 * np.pi * KERNEL_M**2))
        odds = odds + way * DECLARED * _declared(passage, seconds) / mouth
    alone = np.where(fits, odds, 0.0)
    alone = alone / (1.0 + alone.sum(axis=0))
    odds = np.minimum(np.where(fits, odds * np.exp(more), 0.0), MOST_ODDS)
    share = odds / (1.0 + odds.sum(axis=0))
    score = np.where(odds > 1.0, np.log(np.maximum(odds, 1e-300)), 0.0)
    before, after = map(np.ascontiguousarray, np.nonzero(score > 0.0))  # as the kernel is compiled for
    value = np.round(score[before, after] / QUANTUM) * QUANTUM
    partner, sure = np.full(len(young.number), -1), np.zeros(len(young.number))
    if len(before):
        taken, margin, _ = match(before, after, value, due, len(lost.number))
        at = np.flatnonzero(taken & due[after])
        partner[after[at]], sure[after[at]] = before[at], 1.0 / (1.0 + np.exp(-margin[at]))
    partner[sure < settings.min_probability] = -1
    needed = alone[partner, np.arange(len(partner))] < settings.min_probability if len(before) else partner >= 0
    return partner, sure, needed, _learnt(learned, lost, young, share, seconds, due & ~new)


def _learnt(learned: Learned, lost: End, young: End, share: Array, seconds: Array, due: NDArray[np.bool_]) -> Learned:
    """Return the state after the beginnings that were decided."""
    before, after = np.nonzero((share >= LEAST_WEIGHT) & due & young.known)
    more = np.zeros(len(before), EXAMPLE)
    more["begin"], more["end"] = lost.stream[before], young.stream[after]
    more["e"], more["y"] = lost.place[before], young.place[after]
    more["time"] = np.log(seconds[before, after])
    speed = np.hypot(*lost.velocity[before].T)
    more["way"] = more["time"] + np.log(np.maximum(speed, LEAST_SPEED))
    more["weight"] = share[before, after]
    examples = np.concatenate((learned.examples, more))[-MOST_PLACES:]
    begun = End._make(one[due] for one in young)
    beginnings = _added(learned.beginnings, begun, 1.0 - share.sum(axis=0)[due])
    return learned._replace(examples=examples, beginnings=beginnings)

"""Motion of a sensor whose frames have no pose, from what most detections have in common (not in the paper).

Boxes in the axes of a moving sensor all move from frame to frame. A profile with `sensor_motion` finds the rigid motion
of the plane that takes most objects of the last frame to detections of this one, q = R(theta) p + t, and carries the
density into the axes of the new frame: what stands stays where it was, and speeds are those over ground. Tracks are in
the axes of the sensor, as the boxes are. Frames with a pose, and a sensor that stands, change nothing.

The motion is found by votes of pairs of one class for t, for each of some angles theta around a guess, and refined by
least squares over the pairs that it brings together. The guess is the motion of the frame before.

Cars that approach a standing sensor together look like a sensor that drives towards parked cars: relative motion alone
does not tell them apart, nor does the sign of headings, which detectors turn around. But a vehicle moves along its
axis. Boxes that slip sideways stand, and the sensor moves. A motion is therefore weighed against none: each object
drives along its axis, either way and up to the speed of its class, in the axes of the sensor (0) or in the axes that
the motion leads to (1). With c_0 and c_1 the distances of the nearest detection, in squared standard deviations, a
frame gives the evidence

    sum_n (c_0 - c_1) / 2 - max_n (c_0 - c_1) / 2 - `FITTED`

without the strongest object, so that one wrong box shows nothing, and less what three fitted numbers gain by chance.
The motion is used when the sum over frames is enough, after a time that is long enough (`Density.sensor_motion`). Of
traffic, and of rows of parked cars along the way, there is no evidence. Once the sensor is known to move, objects that
drive are predicted before they are compared.

A motion that is not found again is carried on for `CARRIED_S`, and looked for in a range that grows with that time. A
sensor that moved for two seconds is on a vehicle (`Density.on_vehicle`): after a stop, its next motion needs no
evidence. Recordings are tracked from their first frame on with that knowledge (`UNKNOWN_MOTION`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.predict import heading_unknown
from optipmb.model.density import ENOUGH, LEAST_MOVED_S, NO_FRAME, OMEGA, PHI, PROVEN, V, X, Y, objects_in
from optipmb.model.relocation import Relocation
from optipmb.model.rows import read_only

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Bernoullis, Density
    from optipmb.model.frame import Frame
    from optipmb.model.rows import Array, Index
    from optipmb.model.table import Classes, ClassTable


MOST: Final = 64
"""Objects nearest to the sensor, and detections of the highest scores, that are compared: the work is bounded."""
CREW: Final = 4
"""Objects that a motion has to bring together with detections, and"""
SHARE: Final = 0.35
"""their share of all, before a sensor is taken to move; half of both while it moves."""
SURE: Final = 0.5
"""Existence from which an object is compared."""
NEAR: Final = 0.6
"""Distance, m, up to which an object and a detection are together."""
CELL: Final = 0.75
"""Side of a cell that collects votes, m."""
ANGLE: Final = 0.0125
"""Distance of the angles that are tried, rad."""
MOST_CELLS: Final = 64
MOST_ANGLES: Final = 32
"""Cells along an axis and angles to either side: no motion beyond them is found."""
STILL: Final = 0.15
"""Mean distance of the objects to detections, from 0 to 1, below which a sensor stands: nothing is looked for."""
LEAST_MOTION: Final = 0.15
"""Mean motion of the objects, m, from which a sensor may be taken to move."""
NEARER: Final = 0.05
"""Share of their distance to detections by which a motion has to bring objects nearer."""
KEPT: Final = 0.95
"""Part of the evidence for a motion that stays over a tenth of a second without more."""
FASTEST: Final = (30.0, 0.6)
"""Speed, m/s, and turn rate, rad/s, that a motion is looked for up to."""
CHANGE: Final = (6.0, 1.5)
"""Acceleration, m/s^2, and angular acceleration, rad/s^2, by which a motion may differ from the guess."""
TWO: Final = 2.0
"""Weight, in points, from which a motion is fitted."""
SHORTEST_S: Final = 0.005
"""Time between frames below which a sensor does not move."""
LONGEST_S: Final = 2.0
"""Time between frames from which a motion is no guess of the next."""
UNKNOWN: Final = 3.0
"""Standard deviations of an unknown speed of its class that an object moves within."""
APART: Final = 0.35
"""Standard deviation of the distance between an object and its next detection, m."""
TURNED: Final = 0.1
"""Standard deviation of the axis of a box, rad."""
MOST_SIDEWAYS: Final = 2.0
"""Evidence that an object gives at most."""
FITTED: Final = 1.5
"""Evidence that a motion gains by chance: half of its three numbers."""
FORWARDS: Final = 0.96
"""Cosine of the angle to an axis of the sensor up to which it drives along it."""
CORNERING: Final = 5.0
"""Largest acceleration across the way, m/s^2."""
FARTHEST: Final = 80.0
"""Largest mean distance of objects from the origin, m, where that is the sensor and not the origin of a world."""
MOVING: Final = 2.0
"""Speed, m/s, from which an object is predicted: slower ones are taken to stand, or all could drift with the sensor."""
STANDING: Final = (0.3, 0.01)
"""Speed, m/s, and turn rate, rad/s, below which a sensor may be taken to stand again."""


CARRIED_S: Final = 1.5
"""Time for which a motion is carried on that is not found again, s."""
STOPPED: Final = 0.6
"""Share of the objects that are in their places, from which a sensor without a motion has stopped."""
UNKNOWN_MOTION: Final = read_only(np.array([0.0, 0.0, 0.0, PROVEN, LEAST_MOVED_S]))
"""`Density.sensor` of a sensor that is known to be on a vehicle, before its motion is found."""
LEAST_EVIDENCE: Final = 0.1
"""Evidence of a motion that is not found again which counts as none: the estimate ends."""
ROUNDING: Final = 1e-6
"""Margin of comparisons of places, m."""
EVIDENCE, SECONDS = 3, 4
"""Places in `Density.sensor`."""
NOTHING: Final = np.zeros(0)
"""In place of `Density.sensor` where that is None."""
STAYS, MOVES, BEGINS = range(3)
"""How a density follows the sensor: not at all, by its motion, or by that and with speeds over ground from now on."""


class Pairs(NamedTuple):
    """Objects and detections that may belong together.

    Attributes:
        start: (N, 2) places of the objects.
        label: (N,) their classes.
        target: (M, 2) places of the detections, ascending along x.
        target_label: (M,) their classes.
    """

    start: Array
    label: Index
    target: Array
    target_label: Index


def follow_sensor(density: Density, frame: Frame, table: ClassTable) -> tuple[Density, Array | None]:
    """Return a density in the axes of a frame, and `Density.sensor` after it, by the motion of the sensor.

    The density stays where the sensor stands. A frame with a pose ends the estimate.
    """
    dt, before = (frame.stamp_ns - density.stamp_ns) * 1e-9, density.sensor
    if density.stamp_ns == NO_FRAME or dt < SHORTEST_S:
        return density, before
    if dt > LONGEST_S or (frame.pose is not None and not frame.pose.is_identity):
        return density, None
    given = NOTHING if before is None else before.copy()  # which may be written to, as one type for the kernel
    detections = frame.score, frame.center, frame.label
    step, motion, after = next_motion(density.bernoulli.words, given, detections, dt, density.stamp_ns, table.classes)
    if step == BEGINS:
        density = _over_ground(density, motion, dt, frame)
    if step != STAYS:
        density = _relocation(motion).density(density)
    return density, read_only(after) if after.shape[0] else None


@kernel
def next_motion(
    object_words: Array,
    sensor: Array,
    detections: tuple[Array, Array, Index],
    dt: float,
    before_ns: int,
    classes: Classes,
) -> tuple[int, Array, Array]:
    """Find the motion of the sensor from the frame before to this one.

    Arguments of its own:
        object_words: array of the `Bernoullis` of the frame before.
        sensor: (5,) `Density.sensor`, or `NOTHING`.
        detections: score, center and label of all detections of the frame.
        dt: s since the frame before.
        before_ns: stamp of that frame.

    Returns:
        `STAYS`, `MOVES` or `BEGINS`; the motion t and theta (3,), zero where the density stays; and the next `sensor`.
    """
    objects, (score, center, label) = objects_in(object_words), detections
    distance = np.full(objects.label.shape[0], math.inf)
    for n in range(objects.label.shape[0]):
        sure = objects.seen_ns[n] == before_ns and objects.existence[n] >= SURE
        if sure and 0 <= objects.label[n] < len(classes):  # others are refused in the prediction
            distance[n] = math.hypot(objects.mean[n, X], objects.mean[n, Y])
    doubt = np.empty(score.shape[0])
    for d in range(score.shape[0]):
        doubt[d] = -score[d]
    rows, best = least(distance, MOST), least(doubt, MOST)
    along = np.empty(best.shape[0])
    for k in range(best.shape[0]):
        along[k] = center[best[k], 0]
    order = least(along, MOST)
    start, target = np.empty((rows.shape[0], 2)), np.empty((order.shape[0], 2))
    start_label, target_label = np.empty(rows.shape[0], np.int64), np.empty(order.shape[0], np.int64)
    for k in range(rows.shape[0]):
        n = rows[k]
        start[k, 0], start[k, 1], start_label[k] = objects.mean[n, X], objects.mean[n, Y], objects.label[n]
    for k in range(order.shape[0]):
        d = best[order[k]]
        target[k, 0], target[k, 1], target_label[k] = center[d, 0], center[d, 1], label[d]
    pairs = Pairs(start, start_label, target, target_label)
    if in_use(sensor) and sensor[:EVIDENCE].any():
        return kept_on(sensor, pairs, driven(objects, rows, dt), dt)
    stays, found = np.zeros(3), begun(pairs, dt)
    if found.shape[0] and in_use(sensor):
        return MOVES, found, moving(found, dt, sensor[EVIDENCE], 0.0)
    if found.shape[0]:
        after = weighed(sensor, pairs, objects, rows, found, dt, classes)
        return (BEGINS, found, moving(found, dt, ENOUGH, 0.0)) if in_use(after) else (STAYS, stays, after)
    after = sensor.copy()
    if sensor.shape[0] and not in_use(sensor):
        after[EVIDENCE] *= KEPT ** (10.0 * dt)
        after = after[: 0 if after[EVIDENCE] <= LEAST_EVIDENCE else after.shape[0]].copy()
    return STAYS, stays, after


@kernel
def kept_on(sensor: Array, pairs: Pairs, ahead: Array, dt: float) -> tuple[int, Array, Array]:
    """Return as `next_motion` does how a sensor that moves goes on.

    Arguments of its own:
        sensor: (5,) `Density.sensor`.
        ahead: (N, 2) where the objects are after dt, over ground.
    """
    guess, stays = sensor[:EVIDENCE] * dt, np.zeros(3)
    evidence, lost = sensor[EVIDENCE], sensor[SECONDS] - LEAST_MOVED_S
    found = continued(pairs, ahead, guess, dt, lost)
    if found.shape[0]:
        if math.hypot(found[0], found[1]) >= STANDING[0] * dt or abs(found[2]) >= STANDING[1] * dt:
            return MOVES, found, moving(found, dt, min(evidence + dt, PROVEN), 0.0)
    elif lost < CARRIED_S and together(pairs, stays).sum() < STOPPED * pairs.start.shape[0]:
        return MOVES, guess, moving(guess, dt, evidence, lost + dt)
    return STAYS, stays, moving(stays, dt, evidence, 0.0) if evidence >= PROVEN else np.zeros(0)


@kernel
def in_use(sensor: Array) -> bool:
    """Tell whether a motion has enough evidence, as `Density.sensor_motion` does."""
    return bool(sensor.shape[0] > 0 and sensor[EVIDENCE] >= ENOUGH and sensor[SECONDS] >= LEAST_MOVED_S)


@kernel
def moving(motion: Array, dt: float, evidence: float, lost: float) -> Array:
    """Return `Density.sensor` of a sensor that made a motion, which was found so many seconds ago."""
    return np.array([motion[0] / dt, motion[1] / dt, motion[2] / dt, evidence, LEAST_MOVED_S + lost])


@kernel
def least(value: Array, most: int) -> Index:
    """Return the rows of the least values, at most so many and ascending, the first of equal ones; none of infinity."""
    rows, count = np.empty(min(most, value.shape[0]), np.int64), 0
    for n in range(value.shape[0]):
        if value[n] == math.inf or (count == most and value[n] >= value[rows[most - 1]]):
            continue
        k = min(count, most - 1)
        while k > 0 and value[rows[k - 1]] > value[n]:
            rows[k] = rows[k - 1]
            k -= 1
        rows[k] = n
        count = min(count + 1, most)
    return rows[:count]


@kernel
def driven(objects: Bernoullis, rows: Index, dt: float) -> Array:
    """Return where objects (K,) that move are after dt, over ground (K, 2)."""
    out = np.empty((rows.shape[0], 2))
    for k in range(rows.shape[0]):
        n = rows[k]
        way, phi = objects.mean[n, V] * dt, objects.mean[n, PHI]
        dx, dy = way * math.cos(phi), way * math.sin(phi)
        moves = math.hypot(dx, dy) > MOVING * dt
        out[k, 0] = objects.mean[n, X] + (dx if moves else 0.0)
        out[k, 1] = objects.mean[n, Y] + (dy if moves else 0.0)
    return out


@kernel
def continued(pairs: Pairs, start: Array, guess: Array, dt: float, lost: float) -> Array:
    """Return the motion near the guess, the guess itself where there are few objects; (0,) without any.

    `lost` is the time for which it was not found, s.
    """
    reach, turn = 1.0 + CHANGE[0] * dt * (dt + lost), 0.02 + CHANGE[1] * dt * (dt + lost)
    trust = (0.15 / (0.05 + dt * (dt + lost))) ** 2
    ahead = Pairs(start, pairs.label, pairs.target, pairs.target_label)
    found, count, _ = common_motion(ahead, guess, reach, turn, trust)
    if count >= max(CREW // 2, 0.5 * SHARE * start.shape[0]):
        return found
    return guess if start.shape[0] < CREW else np.zeros(0)


@kernel
def begun(pairs: Pairs, dt: float) -> Array:
    """Return a motion that a sensor may have begun; (0,) where it seems to stand."""
    start, none, zero = pairs.start, np.zeros(0), np.zeros(3)
    count = start.shape[0]
    apart = count - together(pairs, zero).sum()
    far = 0.0
    for n in range(count):
        far += math.hypot(start[n, 0], start[n, 1])
    if count < CREW or apart < STILL * count or far > FARTHEST * count:
        return none
    found, joined, cost = common_motion(pairs, zero, FASTEST[0] * dt, FASTEST[1] * dt, 0.0)
    if joined < max(CREW, SHARE * count) or cost > (1.0 - NEARER) * apart:
        return none
    moved, held, size = taken(start, found), together(pairs, found), 0.0
    for n in range(count):
        if held[n] > 0.0:
            size += math.hypot(moved[n, 0] - start[n, 0], moved[n, 1] - start[n, 1])
    return found if size >= LEAST_MOTION * joined and drives(found, dt) else none


@kernel
def weighed(
    before: Array, pairs: Pairs, objects: Bernoullis, rows: Index, motion: Array, dt: float, classes: Classes
) -> Array:
    """Return `Density.sensor` with a motion and its evidence, which adds to that of a similar motion before."""
    count = rows.shape[0]
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    ahead, turned = np.empty((count, 2)), np.empty((count, 2))
    reach, walks = np.empty(count), np.empty(count, np.bool_)
    for k in range(count):
        n, own = rows[k], classes[pairs.label[k]]
        ahead[k, 0], ahead[k, 1] = math.cos(objects.mean[n, PHI]), math.sin(objects.mean[n, PHI])
        turned[k, 0], turned[k, 1] = cos * ahead[k, 0] - sin * ahead[k, 1], sin * ahead[k, 0] + cos * ahead[k, 1]
        reach[k] = UNKNOWN * dt * own.birth_unknown[V]
        walks[k] = own.constant_velocity or heading_unknown(objects.covariance[n])
    moved = Pairs(taken(pairs.start, motion), pairs.label, pairs.target, pairs.target_label)
    here, there = sideways(pairs, ahead, reach, walks), sideways(moved, turned, reach, walks)
    evidence, strongest, seconds = 0.0, 0.0, dt
    for k in range(count):
        gained = here[k] - there[k]
        evidence, strongest = evidence + gained, max(strongest, gained)
    evidence = evidence - strongest - FITTED
    rate = motion[0] / dt, motion[1] / dt, motion[2] / dt
    if before.shape[0]:
        off = math.hypot(rate[0] - before[0], rate[1] - before[1])
        if off < 1.0 + CHANGE[0] * dt and abs(rate[2] - before[2]) < 0.1 + CHANGE[1] * dt:
            evidence += before[EVIDENCE] * KEPT ** (10.0 * dt)
            seconds += before[SECONDS]
    return np.array([rate[0], rate[1], rate[2], max(evidence, 0.0), seconds])


@kernel
def drives(motion: Array, dt: float) -> bool:
    """Tell whether a vehicle can have made a motion: forwards along an axis of the sensor, not too fast in a bend."""
    way, half = math.hypot(motion[0], motion[1]), 0.5 * motion[2]
    x = math.cos(half) * motion[0] + math.sin(half) * motion[1]
    y = math.cos(half) * motion[1] - math.sin(half) * motion[0]
    return bool(-min(x, y) >= FORWARDS * way and way * abs(motion[2]) <= CORNERING * dt * dt)


def _over_ground(density: Density, motion: Array, dt: float, frame: Frame) -> Density:
    """Return a density whose speeds, learnt in the axes of the sensor, are over ground."""
    objects = density.bernoulli
    if np.isfinite(frame.velocity).any():
        return density
    mean = objects.mean.copy()
    apparent = (_relocation(motion).points(mean[:, :2]) - mean[:, :2]) / dt
    along = apparent[:, 0] * np.cos(mean[:, PHI]) + apparent[:, 1] * np.sin(mean[:, PHI])
    mean[:, V] -= np.where(objects.seen_ns > objects.born_ns, along, 0.0)
    free = (objects.covariance[:, OMEGA, OMEGA] == 0.0) & (objects.seen_ns > objects.born_ns)
    if free.any():  # the whole velocity of objects of unknown heading
        v, phi = objects.mean[free, V, None], objects.mean[free, PHI]
        over = v * np.column_stack((np.cos(phi), np.sin(phi))) - apparent[free]
        mean[free, V], mean[free, PHI] = np.hypot(*over.T), np.arctan2(over[:, 1], over[:, 0])
    return replace(density, bernoulli=objects.replaced(mean=mean))


@kernel
def taken(points: Array, motion: Array) -> Array:
    """Return points (N, 2) where a motion (3,), t and theta, takes them."""
    out, cos, sin = np.empty((points.shape[0], 2)), math.cos(motion[2]), math.sin(motion[2])
    for n in range(points.shape[0]):
        out[n, 0] = cos * points[n, 0] - sin * points[n, 1] + motion[0]
        out[n, 1] = sin * points[n, 0] + cos * points[n, 1] + motion[1]
    return out


def _relocation(motion: Array) -> Relocation:
    x, y, theta = motion.tolist()
    return Relocation(x, y, 0.0, theta)


@kernel
def first_beyond(target: Array, x: float) -> int:
    """Return the row of the first target that is not below a place along x, by less than `ROUNDING`."""
    low, high = 0, target.shape[0]
    while low < high:
        middle = (low + high) // 2
        if target[middle, 0] < x - ROUNDING:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def nearest(x: float, y: float, label: int, target: Array, target_label: Index, most: float) -> tuple[int, float]:
    """Return the nearest target of a class and its squared distance, -1 and `most` where none is nearer than that.

    Targets ascend along x.
    """
    best, least = -1, most
    for m in range(first_beyond(target, x - math.sqrt(most)), target.shape[0]):
        dx, dy = target[m, 0] - x, target[m, 1] - y
        if dx > 0.0 and dx * dx >= least:
            break
        squared = dx * dx + dy * dy
        if target_label[m] == label and squared < least:
            best, least = m, squared
    return best, least


@kernel
def together(pairs: Pairs, motion: Array) -> Array:
    """Return how near each start (N,) comes to a target of its class: 1 in its place, 0 from `NEAR` on."""
    start, held = pairs.start, np.zeros(pairs.start.shape[0])
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    for n in range(start.shape[0]):
        x = cos * start[n, 0] - sin * start[n, 1] + motion[0]
        y = sin * start[n, 0] + cos * start[n, 1] + motion[1]
        held[n] = 1.0 - nearest(x, y, pairs.label[n], pairs.target, pairs.target_label, NEAR * NEAR)[1] / (NEAR * NEAR)
    return held


@kernel
def sideways(pairs: Pairs, ahead: Array, reach: Array, walks: NDArray[np.bool_]) -> Array:
    """Return how far the nearest target is from where each object can have moved to, (N,) up to `MOST_SIDEWAYS`.

    Half the square in standard deviations: across its axis, along which it drives as far as its reach; a walker reaches
    a circle. `ahead` (N, 2) are the axes of the objects, `reach` (N,) is how far they can move, m, and `walks` (N,)
    whether they can move any way.
    """
    out = np.full(pairs.start.shape[0], MOST_SIDEWAYS)
    for n in range(out.shape[0]):
        for m in range(pairs.target.shape[0]):
            if pairs.target_label[m] != pairs.label[n]:
                continue
            dx, dy = pairs.target[m, 0] - pairs.start[n, 0], pairs.target[m, 1] - pairs.start[n, 1]
            along, across = abs(dx * ahead[n, 0] + dy * ahead[n, 1]), dy * ahead[n, 0] - dx * ahead[n, 1]
            if walks[n]:
                along, across = math.hypot(dx, dy), 0.0
            beyond, turned = max(along - reach[n], 0.0), 0.0 if walks[n] else TURNED * min(along, reach[n])
            squared = (across * across + beyond * beyond) / (APART * APART + turned * turned)
            out[n] = min(out[n], 0.5 * squared)
    return out


@kernel
def common_motion(pairs: Pairs, guess: Array, reach: float, turn: float, trust: float) -> tuple[Array, int, float]:
    """Find the motion that most points have in common.

    Args:
        pairs: points, and where they may have come to.
        guess: (3,) t and theta around which it is looked for.
        reach: how far t may be from the guess along each axis, m.
        turn: how far theta may be, rad.
        trust: weight of the guess in the least squares, in points.

    Returns:
        The motion (3,), how many points it brings to targets, and the sum of their distances, each from 0 to 1.
    """
    start, target = pairs.start, pairs.target
    motion, votes_best, far_best = guess.copy(), 0, math.inf
    side = min(MOST_CELLS, 2 * math.ceil(reach / CELL) + 2)
    low = -0.5 * CELL * side
    angles = min(MOST_ANGLES, math.ceil(turn / ANGLE))
    near = within(pairs, guess, 0.5 * CELL * side, angles * ANGLE)
    votes, cells = np.zeros((side + 2, side + 2), np.int64), np.empty((near.shape[0], 2), np.int64)
    for a in range(-angles, angles + 1):
        theta = guess[2] + a * ANGLE
        cos, sin = math.cos(theta), math.sin(theta)
        count, last, x, y = 0, -1, 0.0, 0.0
        for k in range(near.shape[0]):
            n, m = near[k, 0], near[k, 1]
            if n != last:
                x = cos * start[n, 0] - sin * start[n, 1] + guess[0]
                y = sin * start[n, 0] + cos * start[n, 1] + guess[1]
                last = n
            i, j = math.floor((target[m, 0] - x - low) / CELL), math.floor((target[m, 1] - y - low) / CELL)
            if 0 <= i < side and 0 <= j < side:
                if votes[i + 1, j + 1] == 0:
                    cells[count, 0], cells[count, 1] = i, j
                    count += 1
                votes[i + 1, j + 1] += 1
        for k in range(4 * count):  # squares of four cells, which meet in a corner of the cell of a pair
            i, j = cells[k // 4, 0] + k % 2, cells[k // 4, 1] + k // 2 % 2
            found = votes[i, j] + votes[i + 1, j] + votes[i, j + 1] + votes[i + 1, j + 1]
            if found < votes_best:
                continue
            dx, dy = low + CELL * i, low + CELL * j
            far = dx * dx + dy * dy + (20.0 * a * ANGLE) ** 2
            if found > votes_best or (found == votes_best and far < far_best):
                votes_best, far_best = found, far
                motion[0], motion[1], motion[2] = guess[0] + dx, guess[1] + dy, theta
        for k in range(count):
            votes[cells[k, 0] + 1, cells[k, 1] + 1] = 0
    for limit in (2.0 * CELL, 1.5 * CELL, NEAR, NEAR, NEAR):
        _refine(pairs, limit, guess, trust, motion)
    held = together(pairs, motion)
    count = 0
    for n in range(held.shape[0]):
        count += held[n] > 0.0
    return motion, count, held.shape[0] - held.sum()


@kernel
def within(pairs: Pairs, guess: Array, reach: float, turn: float) -> Index:
    """Return the pairs of a class (K, 2) that motions near the guess may bring together: at most so far and turned."""
    start, target, count = pairs.start, pairs.target, 0
    near, moved = np.empty((start.shape[0] * target.shape[0], 2), np.int64), taken(start, guess)
    for n in range(start.shape[0]):
        most = reach + turn * math.hypot(start[n, 0], start[n, 1]) + ROUNDING
        for m in range(first_beyond(target, moved[n, 0] - most), target.shape[0]):
            dx, dy = target[m, 0] - moved[n, 0], target[m, 1] - moved[n, 1]
            if dx > most:
                break
            if pairs.target_label[m] == pairs.label[n] and abs(dy) <= most:
                near[count, 0], near[count, 1] = n, m
                count += 1
    return near[:count]


@kernel
def _refine(pairs: Pairs, limit: float, guess: Array, trust: float, motion: Array) -> None:
    """Fit `motion` to the pairs that it brings within a limit, and to the guess at four places, by least squares."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    start, target = pairs.start, pairs.target
    total = p_x = p_y = q_x = q_y = 0.0
    joined, weights = np.empty((start.shape[0] + 4, 4)), np.empty(start.shape[0] + 4)
    count = 0
    for n in range(start.shape[0]):
        x = cos * start[n, 0] - sin * start[n, 1] + motion[0]
        y = sin * start[n, 0] + cos * start[n, 1] + motion[1]
        m = nearest(x, y, pairs.label[n], target, pairs.target_label, limit * limit)[0]
        if m >= 0:
            joined[count, 0], joined[count, 1] = start[n, 0], start[n, 1]
            joined[count, 2], joined[count, 3] = target[m, 0], target[m, 1]
            weights[count] = 1.0
            count += 1
    cos, sin = math.cos(guess[2]), math.sin(guess[2])
    for x, y in ((15.0, 0.0), (-15.0, 0.0), (0.0, 15.0), (0.0, -15.0)):
        joined[count, 0], joined[count, 1] = x, y
        joined[count, 2], joined[count, 3] = cos * x - sin * y + guess[0], sin * x + cos * y + guess[1]
        weights[count] = 0.25 * trust
        count += 1
    for k in range(count):
        w = weights[k]
        total += w
        p_x += w * joined[k, 0]
        p_y += w * joined[k, 1]
        q_x += w * joined[k, 2]
        q_y += w * joined[k, 3]
    if total < TWO:
        return
    p_x, p_y, q_x, q_y = p_x / total, p_y / total, q_x / total, q_y / total
    dot = cross = 0.0
    for k in range(count):
        x, y, u, v = joined[k, 0] - p_x, joined[k, 1] - p_y, joined[k, 2] - q_x, joined[k, 3] - q_y
        dot += weights[k] * (x * u + y * v)
        cross += weights[k] * (x * v - y * u)
    theta = math.atan2(cross, dot) if dot != 0.0 or cross != 0.0 else motion[2]
    cos, sin = math.cos(theta), math.sin(theta)
    motion[0], motion[1], motion[2] = q_x - (cos * p_x - sin * p_y), q_y - (sin * p_x + cos * p_y), theta

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
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import ENOUGH, LEAST_MOVED_S, NO_FRAME, OMEGA, PHI, V
from optipmb.relocation import Relocation
from optipmb.rows import read_only

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Density
    from optipmb.frame import Frame
    from optipmb.rows import Array, Index
    from optipmb.table import ClassTable


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


class Pairs(NamedTuple):
    """Objects and detections that may belong together.

    Attributes:
        start: (N, 2) places of the objects.
        label: (N,) their classes.
        target: (M, 2) places of the detections.
        target_label: (M,) their classes.
    """

    start: Array
    label: Index
    target: Array
    target_label: Index


def follow_sensor(density: Density, frame: Frame, table: ClassTable) -> Density:
    """Find the motion of the sensor and carry a density into the axes of the frame.

    The density stays where the sensor stands. A frame with a pose ends the estimate.
    """
    dt = (frame.stamp_ns - density.stamp_ns) * 1e-9
    if density.stamp_ns == NO_FRAME or dt < SHORTEST_S:
        return density
    unknown = density if density.sensor is None else replace(density, sensor=None)
    if dt > LONGEST_S or (frame.pose is not None and not frame.pose.is_identity):
        return unknown
    objects = density.bernoulli
    recent = np.flatnonzero((objects.seen_ns == density.stamp_ns) & (objects.existence >= SURE))
    rows = recent[np.argsort(np.hypot(*objects.mean[recent, :2].T), kind="stable")[:MOST]]
    best = np.argsort(-frame.score, kind="stable")[:MOST]
    start, target = np.ascontiguousarray(objects.mean[rows, :2]), np.ascontiguousarray(frame.center[best, :2])
    pairs = Pairs(start, objects.label[rows], target, frame.label[best])
    ahead = np.column_stack((np.cos(objects.mean[rows, PHI]), np.sin(objects.mean[rows, PHI])))
    free = objects.covariance[rows, OMEGA, OMEGA] == 0.0  # to move in any direction: their heading is unknown
    before = None if density.sensor_motion is None else density.sensor_motion * dt
    if before is not None:
        found = _continued(pairs, objects.mean[rows, V, None] * dt * ahead, before, dt)
        if found is not None:
            still = math.hypot(found[0], found[1]) < STANDING[0] * dt and abs(found[2]) < STANDING[1] * dt
            return unknown if still else _carried(density, found, dt)
    found = _begun(pairs, dt)
    after = _fading(density, dt) if found is None else _weighed(density, pairs, ahead, free, found, dt, table)
    if found is not None and after.sensor_motion is not None:
        return _carried(after if before is not None else _over_ground(after, found, dt, frame), found, dt)
    if before is not None and together(pairs, np.zeros(3)).sum() < SHARE * len(rows):
        return _carried(density, before, dt)  # neither continued nor stopped: left to the next frame
    return after


def _continued(pairs: Pairs, driven: Array, guess: Array, dt: float) -> Array | None:
    """Return the motion near the guess, the guess itself where there are few objects; None without any."""
    start = pairs.start + np.where(np.hypot(*driven.T)[:, None] > MOVING * dt, driven, 0.0)
    reach, turn, trust = 1.0 + CHANGE[0] * dt * dt, 0.02 + CHANGE[1] * dt * dt, (0.15 / (0.05 + dt * dt)) ** 2
    found, count, _ = common_motion(pairs._replace(start=start), guess, reach, turn, trust)
    if count >= max(CREW // 2, 0.5 * SHARE * len(start)):
        return found
    return guess if len(start) < CREW else None


def _begun(pairs: Pairs, dt: float) -> Array | None:
    """Return a motion that a sensor may have begun; None where it seems to stand."""
    start, few = pairs.start, len(pairs.start) < CREW
    apart = 1.0 - together(pairs, np.zeros(3))
    if few or apart.sum() < STILL * len(start) or np.hypot(*start.T).mean() > FARTHEST:
        return None
    found, count, cost = common_motion(pairs, np.zeros(3), FASTEST[0] * dt, FASTEST[1] * dt, 0.0)
    if count < max(CREW, SHARE * len(start)) or cost > (1.0 - NEARER) * apart.sum():
        return None
    size = np.hypot(*(taken(start, found) - start)[together(pairs, found) > 0.0].T)
    clear = size.mean() >= LEAST_MOTION
    return found if clear and _drives(found, dt) else None


def _weighed(
    density: Density, pairs: Pairs, ahead: Array, free: NDArray[np.bool_], motion: Array, dt: float, table: ClassTable
) -> Density:
    """Return a density with a motion and its evidence, which adds to the evidence of a similar motion before."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turned = ahead @ np.array([[cos, sin], [-sin, cos]])
    reach = (UNKNOWN * dt * table["birth_unknown"][:, V])[pairs.label]
    walks = table["constant_velocity"][pairs.label] | free
    standing = sideways(pairs, ahead, reach, walks)
    moving = sideways(pairs._replace(start=taken(pairs.start, motion)), turned, reach, walks)
    gained = standing - moving
    evidence, seconds, rate = gained.sum() - max(gained.max(), 0.0) - FITTED, dt, motion / dt
    before = density.sensor if density.sensor_motion is None else None
    if before is not None:
        off = rate - before[:3]
        if math.hypot(off[0], off[1]) < 1.0 + CHANGE[0] * dt and abs(off[2]) < 0.1 + CHANGE[1] * dt:
            evidence, seconds = evidence + before[3] * KEPT ** (10.0 * dt), seconds + before[4]
    return replace(density, sensor=read_only(np.array([*rate, max(evidence, 0.0), seconds])))


def _fading(density: Density, dt: float) -> Density:
    """Return a density with less evidence of a motion that was not found again."""
    if density.sensor is None or density.sensor_motion is not None:
        return density if density.sensor is None else replace(density, sensor=None)
    return replace(density, sensor=read_only(density.sensor * [1.0, 1.0, 1.0, KEPT ** (10.0 * dt), 1.0]))


def _drives(motion: Array, dt: float) -> bool:
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
    apparent = (taken(mean[:, :2], motion) - mean[:, :2]) / dt
    along = apparent[:, 0] * np.cos(mean[:, PHI]) + apparent[:, 1] * np.sin(mean[:, PHI])
    mean[:, V] -= np.where(objects.seen_ns > objects.born_ns, along, 0.0)
    free = (objects.covariance[:, OMEGA, OMEGA] == 0.0) & (objects.seen_ns > objects.born_ns)
    if free.any():  # the whole velocity of objects of unknown heading
        v, phi = objects.mean[free, V, None], objects.mean[free, PHI]
        over = v * np.column_stack((np.cos(phi), np.sin(phi))) - apparent[free]
        mean[free, V], mean[free, PHI] = np.hypot(*over.T), np.arctan2(over[:, 1], over[:, 0])
    return replace(density, bernoulli=objects.replaced(mean=mean))


def _carried(density: Density, motion: Array, dt: float) -> Density:
    """Return a density in the axes of a sensor that made a motion."""
    moved = _relocation(motion).density(density)
    return replace(moved, sensor=read_only(np.array([*motion / dt, ENOUGH, LEAST_MOVED_S])))


def taken(points: Array, motion: Array) -> Array:
    """Return points (N, 2) where a motion (3,), t and theta, takes them."""
    return _relocation(motion).points(points)


def _relocation(motion: Array) -> Relocation:
    x, y, theta = motion.tolist()
    return Relocation(x, y, 0.0, theta)


@kernel
def nearest(x: float, y: float, label: int, target: Array, target_label: Index, most: float) -> tuple[int, float]:
    """Return the nearest target of a class and its squared distance, -1 and `most` where none is nearer than that."""
    best, least = -1, most
    for m in range(target.shape[0]):
        dx, dy = target[m, 0] - x, target[m, 1] - y
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
    start, label, target, target_label = pairs.start, pairs.label, pairs.target, pairs.target_label
    motion, votes_best, far_best = guess.copy(), 0, math.inf
    side = min(MOST_CELLS, 2 * math.ceil(reach / CELL) + 2)
    low = -0.5 * CELL * side
    votes, voters = np.zeros((side + 2, side + 2), np.int64), np.empty((start.shape[0] * target.shape[0], 2), np.int64)
    angles = min(MOST_ANGLES, math.ceil(turn / ANGLE))
    for a in range(-angles, angles + 1):
        theta = guess[2] + a * ANGLE
        cos, sin = math.cos(theta), math.sin(theta)
        count = 0
        for n in range(start.shape[0]):
            x = cos * start[n, 0] - sin * start[n, 1] + guess[0]
            y = sin * start[n, 0] + cos * start[n, 1] + guess[1]
            for m in range(target.shape[0]):
                i, j = math.floor((target[m, 0] - x - low) / CELL), math.floor((target[m, 1] - y - low) / CELL)
                if target_label[m] == label[n] and 0 <= i < side and 0 <= j < side:
                    votes[i + 1, j + 1] += 1
                    voters[count, 0], voters[count, 1] = i, j
                    count += 1
        for k in range(4 * count):  # squares of four cells, which meet in a corner of the cell of a pair
            i, j = voters[k // 4, 0] + k % 2, voters[k // 4, 1] + k // 2 % 2
            found = votes[i, j] + votes[i + 1, j] + votes[i, j + 1] + votes[i + 1, j + 1]
            dx, dy = low + CELL * i, low + CELL * j
            far = dx * dx + dy * dy + (20.0 * a * ANGLE) ** 2
            if found > votes_best or (found == votes_best and far < far_best):
                votes_best, far_best = found, far
                motion[0], motion[1], motion[2] = guess[0] + dx, guess[1] + dy, theta
        for k in range(count):
            votes[voters[k, 0] + 1, voters[k, 1] + 1] = 0
    for limit in (2.0 * CELL, 1.5 * CELL, NEAR, NEAR, NEAR):
        _refine(pairs, limit, guess, trust, motion)
    held = together(pairs, motion)
    count = 0
    for n in range(held.shape[0]):
        count += held[n] > 0.0
    return motion, count, held.shape[0] - held.sum()


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

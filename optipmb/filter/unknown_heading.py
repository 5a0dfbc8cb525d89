"""States of objects whose heading neither a detection nor their motion has shown yet (not in the paper).

Radars, people counters and cameras on a ground plane give points. Such an object moves at constant velocity in any
direction, so its state is linear. It is kept in the six entries of the motion state, in axes along its velocity:

    m = [x, y, v, phi, 0, 0]      velocity v along phi, none across
    P                             row and column phi hold the velocity ACROSS phi, m/s; omega and a have zeros

A variance of omega that is zero marks these rows; no other state has one. Turning the world turns them like all states.
Birth, prediction and update are a Kalman filter of position and velocity. Two detections of an object give the state of
a two-point initialisation. After one detection phi is the direction from the origin of the world: it does not depend on
the axes and carries no information.

The heading becomes known where a detection brings one, or where the velocity reaches `CERTAIN` standard deviations: row
and column phi are divided by v, and omega and a begin as at a birth. It is lost where a detection without heading finds
it less certain than `LOST`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.predict import heading_unknown, wrap
from optipmb.model.density import OMEGA, PHI, STATE, A, V, objects_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Bernoullis
    from optipmb.model.rows import Array, Index
    from optipmb.model.table import ClassRow

CERTAIN: Final = 4.0
"""Standard deviations that a velocity has to be away from zero to show the heading."""

LOST: Final = 0.6
"""Standard deviation, rad, from which a heading that is not measured any more is as good as unknown."""

UNIFORM: Final = math.pi**2 / 3.0
"""Variance of a heading of which nothing is known, rad^2."""


@kernel
def scale_across(covariance: Array, factor: float) -> None:
    """Multiply row and column phi of a covariance (6, 6)."""
    for s in range(STATE):
        covariance[s, PHI] *= factor
        covariance[PHI, s] *= factor


@kernel
def turn_axes(covariance: Array, cos: float, sin: float) -> None:
    """Turn the axes of the velocity, rows and columns v and phi of a covariance (6, 6)."""
    for s in range(STATE):
        along, across = covariance[s, V], covariance[s, PHI]
        covariance[s, V], covariance[s, PHI] = cos * along + sin * across, cos * across - sin * along
    for s in range(STATE):
        along, across = covariance[V, s], covariance[PHI, s]
        covariance[V, s], covariance[PHI, s] = cos * along + sin * across, cos * across - sin * along
    covariance[PHI, V] = covariance[V, PHI]


@kernel
def face_along(mean: Array, covariance: Array, across: float) -> None:
    """Turn the axes of a state so that it has no velocity across."""
    speed = math.hypot(mean[V], across)
    if speed > 0.0:
        turn_axes(covariance, mean[V] / speed, across / speed)
        mean[PHI], mean[V] = wrap(mean[PHI] + math.atan2(across, mean[V])), speed


@kernel
def begin_turning(covariance: Array, own: ClassRow) -> None:
    """Give a state whose heading is known now the turn rate and acceleration of a birth."""
    for s in (OMEGA, A):
        covariance[s, s] = own.birth_unknown[s] * own.birth_unknown[s]


@kernel
def find_heading(mean: Array, covariance: Array, own: ClassRow) -> None:
    """Take the heading of a state from its velocity, where that is certain."""
    if mean[V] * mean[V] > CERTAIN * CERTAIN * max(covariance[V, V], covariance[PHI, PHI]):
        scale_across(covariance, 1.0 / mean[V])
        begin_turning(covariance, own)


@kernel
def take_heading(mean: Array, covariance: Array, yaw: float, own: ClassRow) -> None:
    """Take the heading of a state from a detection: its velocity is the part along it."""
    turn = yaw - mean[PHI]
    turn_axes(covariance, math.cos(turn), math.sin(turn))
    mean[V], mean[PHI] = mean[V] * math.cos(turn), wrap(yaw)
    scale_across(covariance, 0.0)
    covariance[PHI, PHI] = own.noise_heading * own.noise_heading
    begin_turning(covariance, own)


@kernel
def lose_heading(mean: Array, covariance: Array) -> None:
    """Give up the heading of a state, whose velocity stays."""
    scale_across(covariance, math.sqrt(mean[V] * mean[V] + covariance[V, V]))
    if mean[V] < 0.0:
        mean[V], mean[PHI] = -mean[V], wrap(mean[PHI] + math.pi)
        for s in range(STATE):
            for t in (V, PHI):
                if s not in (V, PHI):
                    covariance[s, t], covariance[t, s] = -covariance[s, t], -covariance[t, s]
    mean[OMEGA] = mean[A] = 0.0
    for s in (OMEGA, A):
        for t in range(STATE):
            covariance[s, t] = covariance[t, s] = 0.0


@kernel
def show_heading(speed: float, covariance: Array) -> None:
    """Give row and column phi the unit rad, for tracks; of a heading that may be any the variance is `UNIFORM`."""
    scale_across(covariance, 1.0 / max(speed, math.sqrt(covariance[PHI, PHI] / UNIFORM)))


@kernel
def all_measured(object_words: Array) -> bool:
    """Tell whether heading, size and height of all objects are known, of the array of `Bernoullis`."""
    objects, good = objects_in(object_words), True
    for n in range(objects.label.shape[0]):
        good &= not heading_unknown(objects.covariance[n])
        for s in range(4):
            good &= not math.isnan(objects.auxiliary[n, s])
    return bool(good)


def measured_bits(objects: Bernoullis, rows: Index) -> NDArray[np.uint8]:
    """Return `StepResult.measured` of some objects."""
    known = ~np.isnan(objects.auxiliary[rows])
    heading = objects.covariance[rows, OMEGA, OMEGA] != 0.0
    bits: NDArray[np.uint8] = np.uint8(1) * heading + np.uint8(2) * known[:, :3].all(axis=1) + np.uint8(4) * known[:, 3]
    return bits

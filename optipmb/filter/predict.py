"""PMB prediction by unscented transforms of the motion models (Sections IV.A and IV.C).

A class moves by CTRA, the model of the paper, or at constant velocity: v and phi stay, omega and a are zero and take no
part. In CTRA the acceleration may decay, ``a(t) = a e^(-t/tau)`` (Singer's model): a driver brakes for a while, not for
ever, and not through a standstill. Without decay (tau infinite) the acceleration is constant, as in the paper.

The unscented transform uses the symmetric set of 2n = 12 points at distance sqrt(n) along the columns of a matrix
square root, all of weight 1/12 (kappa = 0): no weight is negative, so the transformed covariance is positive
semi-definite for any function.

The square root is the Cholesky factor of the covariance with the state REORDERED as [v, phi, omega, a, x, y],
position last. Then the columns that bend (v, phi, omega, a) do not depend on the axes of the world, and the columns
of x and y pass through unbent: turning the world turns the result, exactly. A factor taken in the usual order would
make the tracker prefer compass directions.

Where the heading's standard deviation nears one radian the twelve points lie beyond half a turn, and the transform
claims to know more than it does.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.class_posterior import UNGROUPED, predict_classes
from optipmb.model.density import (
    CLASSES,
    COMPONENT,
    NO_FRAME,
    OBJECT,
    OMEGA,
    PHI,
    STATE,
    A,
    Bernoullis,
    Density,
    Moment,
    Poissons,
    V,
    X,
    Y,
    check_fitting,
    components_in,
    labels_within,
    misses_counted_from,
    objects_in,
    whole_periods,
)
from optipmb.model.errors import DensityError

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.table import Classes, ClassRow, ClassTable

    Turn = tuple[float, float, float, float]

SPREAD = math.sqrt(STATE)
"""Distance of the sigma points in units of the square root, sqrt(n + kappa)."""

WEIGHT = 1.0 / (2 * STATE)
"""Weight of each sigma point."""

ORDER = (2, 3, 4, 5, 0, 1)
"""Row of the square root -> entry of the state."""

SMALL_TURN = 0.1
"""Turn angle (rad) below which the integrals of the motion are summed as series; the closed form divides by its
square."""

START = 5.0
"""Bound of an acceleration that raises the speed, in ``|v| / tau`` (`travel`)."""

BRAKING = 3.0
"""Bound of an acceleration that lowers the speed, in ``|v| / tau`` (`travel`)."""

ACCELERATIONS = 3.0
"""Standard deviations of the acceleration of objects of unknown heading, which no state follows."""

TINY_PIVOT = 1e-12
"""A pivot of the square root is lifted to this: a covariance that lost rank in rounding is repaired, and counted."""


@kernel
def wrap(angle: float) -> float:
    """Return the angle in (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = angle - 2.0 * math.pi * np.floor((angle + math.pi) / (2.0 * math.pi))
    return wrapped if wrapped > -math.pi else math.pi


@kernel
def small_turn(u: float) -> tuple[float, float]:
    """Sum ``int_0^1 cos(u t) dt`` and ``int_0^1 sin(u t) dt`` as series, for turns u below `SMALL_TURN`, rad."""
    u2 = u * u
    sinc = 1.0 - u2 / 6.0 * (1.0 - u2 / 20.0 * (1.0 - u2 / 42.0))
    cosc = u / 2.0 * (1.0 - u2 / 12.0 * (1.0 - u2 / 30.0 * (1.0 - u2 / 56.0)))
    return sinc, cosc


@kernel
def turn_integrals(u: float) -> Turn:
    """Return cos u, sin u and the integrals of `small_turn`, for any turn u, rad."""
    cos_u, sin_u = math.cos(u), math.sin(u)
    if abs(u) < SMALL_TURN:
        sinc, cosc = small_turn(u)
        return cos_u, sin_u, sinc, cosc
    return cos_u, sin_u, sin_u / u, (1.0 - cos_u) / u


@kernel
def ctra_displacement(v: float, omega: float, a: float, dt: float) -> tuple[float, float]:
    """Integrate the speed v + a t along a heading that turns with omega, from 0 to dt (eq. Motion Predict).

    Returns:
        The way along the starting heading and the way across it (to the left), m:
        ``along = int (v + a t) cos(omega t) dt``, ``across = int (v + a t) sin(omega t) dt``.
    """
    u = omega * dt
    cos_u, sin_u, sinc, cosc = turn_integrals(u)
    if abs(u) < SMALL_TURN:
        u2 = u * u
        ramp_cos = 0.5 - u2 / 8.0 + u2 * u2 / 144.0 - u2 * u2 * u2 / 5760.0
        ramp_sin = u / 3.0 - u * u2 / 30.0 + u * u2 * u2 / 840.0 - u * u2 * u2 * u2 / 45360.0
    else:
        ramp_cos = (cos_u + u * sin_u - 1.0) / (u * u)
        ramp_sin = (sin_u - u * cos_u) / (u * u)
    along = dt * (v * sinc + a * dt * ramp_cos)
    across = dt * (v * cosc + a * dt * ramp_sin)
    return along, across


@kernel
def travel(
    v: float, omega: float, a: float, dt: float, tau: float, kept: float, turn: Turn
) -> tuple[float, float, float, float]:
    """Move for dt under an acceleration that decays with time constant tau and never turns the speed round.

    ``v(t) = v + a tau (1 - e^(-t/tau))``; the way is the integral of ``v(t) [cos(omega t), sin(omega t)]``, with
    ``int e^(-t/tau) e^(i omega t) dt = (1 - e^(-dt/tau) e^(i omega dt)) / (1/tau - i omega)``.

    An acceleration against v is bounded by ``BRAKING |v| / tau``, and so that the object stands at the end of dt at
    most; one along v is bounded by ``START |v| / tau``. Both bounds are zero at a standstill, where the way would
    otherwise jump with the sign of v: objects that stand start by the process noise.

    Args:
        v: speed, m/s.
        omega: turn rate, rad/s.
        a: acceleration, m/s^2.
        dt: time, s, positive.
        tau: time constant, s, finite.
        kept: ``e^(-dt/tau)``, which the sigma points of an object share.
        turn: `turn_integrals` of omega dt, which sigma points of one turn rate share.

    Returns:
        The way along the starting heading and across it, m, the speed and the acceleration afterwards.
    """
    limit = (min(BRAKING, 1.0 / (1.0 - kept)) if v * a < 0.0 else START) * abs(v) / tau
    a = min(max(a, -limit), limit)
    cos_u, sin_u, sinc, cosc = turn
    final, beta = v + a * tau, 1.0 / tau  # the speed that it comes to in the end
    along, across = dt * (final * sinc + 0.0), dt * (final * cosc + 0.0)  # 0.0 and not -0.0
    real, imaginary = 1.0 - kept * cos_u, -kept * sin_u
    scale = a * tau / (beta * beta + omega * omega)
    along -= scale * (real * beta - imaginary * omega)
    across -= scale * (real * omega + imaginary * beta)
    return along, across, v + a * tau * (1.0 - kept), a * kept


@kernel
def decay_and_turn(omega: float, dt: float, tau: float) -> tuple[float, Turn]:
    """Return `kept` and `turn` of `travel`; unused values where the acceleration does not decay."""
    if tau == math.inf:
        return 1.0, (1.0, 0.0, 1.0, 0.0)
    return math.exp(-dt / tau), turn_integrals(omega * dt)


@kernel
def displacement(
    v: float, phi: float, omega: float, a: float, dt: float, tau: float, decay: tuple[float, Turn]
) -> tuple[float, float, float, float]:
    """Move one state, `decay` as of `decay_and_turn`: return the ways along x and y, the speed and the acceleration."""
    if tau == math.inf:
        along, across = ctra_displacement(v, omega, a, dt)
        v += a * dt
    else:
        along, across, v, a = travel(v, omega, a, dt, tau, *decay)
    cos_phi, sin_phi = math.cos(phi), math.sin(phi)
    return cos_phi * along - sin_phi * across, sin_phi * along + cos_phi * across, v, a


@kernel
def square_root(covariance: Array, root: Array) -> int:
    """Factor a (6, 6) covariance, rows and columns in `ORDER`, into a lower `root`; return the pivots repaired."""
    repaired = 0
    for i in range(STATE):
        for j in range(i + 1):
            value = covariance[ORDER[i], ORDER[j]]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            if i == j:
                if not value > TINY_PIVOT:
                    value = TINY_PIVOT
                    repaired += 1
                root[i, i] = math.sqrt(value)
            else:
                root[i, j] = value / root[j, j]
        for j in range(i + 1, STATE):
            root[i, j] = 0.0
    return repaired


@kernel
def heading_unknown(covariance: Array) -> bool:
    """Tell whether a state is one of `optipmb.filter.unknown_heading`."""
    return bool(covariance[OMEGA, OMEGA] == 0.0)


@kernel
def predict_without_heading(
    mean: Array, covariance: Array, dt: float, own: ClassRow, mean_out: Array, covariance_out: Array
) -> None:
    """Predict a state of `optipmb.filter.unknown_heading`: arguments as in `predict_state`.

    The velocity gains the noise of a speed in both directions, and what an acceleration of `ACCELERATIONS` standard
    deviations of a birth changes over dt.
    """
    cos_phi, sin_phi = math.cos(mean[PHI]), math.sin(mean[PHI])
    for s in range(STATE):
        mean_out[s] = mean[s]
    mean_out[X] += dt * mean[V] * cos_phi
    mean_out[Y] += dt * mean[V] * sin_phi
    for s in range(STATE):
        for t in range(STATE):
            covariance_out[s, t] = covariance[s, t]
    for t in range(STATE):
        along, across = covariance_out[V, t], covariance_out[PHI, t]
        covariance_out[X, t] += dt * (cos_phi * along - sin_phi * across)
        covariance_out[Y, t] += dt * (sin_phi * along + cos_phi * across)
    for s in range(STATE):
        along, across = covariance_out[s, V], covariance_out[s, PHI]
        covariance_out[s, X] += dt * (cos_phi * along - sin_phi * across)
        covariance_out[s, Y] += dt * (sin_phi * along + cos_phi * across)
    for s in range(STATE):
        for t in range(s):
            covariance_out[t, s] = covariance_out[s, t]
    gained = own.process_noise[V] ** 2 * dt + (ACCELERATIONS * own.birth_unknown[A] * dt) ** 2
    for s in range(4):
        covariance_out[s, s] += gained if s >= V else own.process_noise[s] ** 2 * dt


@kernel
def predict_state(
    mean: Array,
    covariance: Array,
    dt: float,
    own: ClassRow,
    buffers: tuple[Array, Array],
    mean_out: Array,
    covariance_out: Array,
) -> int:
    """Predict one state by the unscented transform of its motion model (eq. Motion Predict).

    The buffers receive the square root (6, 6), and the transformed points (12, 6) as deviations from the transformed
    centre: the mean is added last, so that large world coordinates cost no digits.

    Returns:
        Number of pivots that had to be repaired.
    """
    if heading_unknown(covariance):
        predict_without_heading(mean, covariance, dt, own, mean_out, covariance_out)
        return 0
    straight, tau, process_noise = own.constant_velocity, own.acceleration_time, own.process_noise
    root, points = buffers
    repaired = square_root(covariance, root)
    v, phi = mean[V], mean[PHI]
    omega, a = (0.0, 0.0) if straight else (mean[OMEGA], mean[A])
    kept, turn0 = decay_and_turn(omega, dt, tau)
    dx0, dy0, v0, a0 = displacement(v, phi, omega, a, dt, tau, (kept, turn0))
    cos_phi, sin_phi = math.cos(phi), math.sin(phi)
    for column in range(STATE):
        for side in range(2):
            step = SPREAD if side == 0 else -SPREAD
            point = points[2 * column + side]
            for row in range(STATE):
                point[ORDER[row]] = step * root[row, column]
            if column < STATE - 2:  # the columns of x and y leave the motion itself as it is at the centre
                if straight:
                    along, across, speed, acceleration = (v + point[V]) * dt, 0.0, v + point[V], point[A]
                elif tau == math.inf:
                    speed, acceleration = v + point[V], a + point[A]
                    along, across = ctra_displacement(speed, omega + point[OMEGA], acceleration, dt)
                    speed += acceleration * dt
                else:
                    turn, rate = turn0, omega + point[OMEGA]
                    if rate != omega:  # the column of a leaves the turn as it is at the centre
                        turn = turn_integrals(rate * dt)
                    along, across, speed, acceleration = travel(v + point[V], rate, a + point[A], dt, tau, kept, turn)
                point[V], point[A] = speed - v0, acceleration - a0
                cos_point, sin_point = cos_phi, sin_phi
                if point[PHI] != 0.0:  # only the columns of v and phi turn the heading
                    cos_point, sin_point = math.cos(phi + point[PHI]), math.sin(phi + point[PHI])
                point[X] += cos_point * along - sin_point * across - dx0
                point[Y] += sin_point * along + cos_point * across - dy0
                if not straight:
                    point[PHI] += point[OMEGA] * dt
    mean_out[X], mean_out[Y] = mean[X] + (dx0 + centred(points, X)), mean[Y] + (dy0 + centred(points, Y))
    mean_out[V] = v0 + centred(points, V)
    mean_out[PHI] = wrap(phi + omega * dt + centred(points, PHI))
    mean_out[OMEGA] = omega + centred(points, OMEGA)
    mean_out[A] = a0 + centred(points, A)
    for s in range(STATE):
        c0 = c1 = c2 = c3 = c4 = c5 = 0.0  # six sums side by side, which the processor adds at once
        for i in range(2 * STATE):
            deviation = points[i, s]
            c0 += deviation * points[i, 0]
            c1 += deviation * points[i, 1]
            c2 += deviation * points[i, 2]
            c3 += deviation * points[i, 3]
            c4 += deviation * points[i, 4]
            c5 += deviation * points[i, 5]
        row = covariance_out[s]
        row[0], row[1], row[2] = c0 * WEIGHT, c1 * WEIGHT, c2 * WEIGHT
        row[3], row[4], row[5] = c3 * WEIGHT, c4 * WEIGHT, c5 * WEIGHT
        if not (straight and s >= OMEGA):
            row[s] += process_noise[s] ** 2 * dt
    return repaired


@kernel
def centred(points: Array, s: int) -> float:
    """Subtract the mean of the points (12, 6) from their entry s, and return it."""
    shift = 0.0
    for i in range(2 * STATE):
        shift += WEIGHT * points[i, s]
    for i in range(2 * STATE):
        points[i, s] -= shift
    return shift


LONGEST_STEP_S: Final = 6.0
"""Longest time between two frames, s, over which an object is followed although its class forgets it sooner."""


def predict(density: Density, moment: Moment, table: ClassTable) -> tuple[Density, int]:
    """Carry the density from its stamp to the stamp of a frame.

    Means and covariances follow the motion model of the class. The survival probability p_s holds for one nominal
    period of the stream: over dt it is ``p_s ** (dt / period)``, so that a stream at twice the rate does not forget
    twice as fast.
    Objects and components that a silent stream has carried past their limits (`max_misses`, `poisson_steps`) are
    removed before they could be associated. Those seen in the last frame live until the next look, as in a slow stream:
    components always, objects up to `LONGEST_STEP_S`.

    Returns:
        The predicted density and how many covariances had to be repaired.

    Raises:
        DensityError: the parts of the density do not fit together, or a label is of no class.
    """
    misses, pi = density.misses, density.class_probability
    given = density.bernoulli.words, density.missed_from_ns, UNGROUPED if pi is None else pi, density.poisson.words
    try:
        kept, objects, likely, components, repaired = predict_density(
            *given, tuple(moment), table.confusion, table.classes
        )
    except ValueError as error:
        check_fitting(density, density.labels)  # names the column
        raise DensityError(CLASSES, "probabilities of the classes of each object's group", "others") from error
    if misses is not None and kept.shape[0] < len(misses):
        misses = misses.take(kept)
    parts = Bernoullis.of(objects), Poissons.of(components)
    pi = likely if len(table.confusion) else None
    return Density(moment.stamp_ns, density.next_id, *parts, density.labels, misses, pi), repaired


@kernel
def predict_density(
    object_words: Array,
    missed_from_ns: Index,
    class_probability: Array,
    component_words: Array,
    moment: Columns,
    confusion: Array,
    classes: Classes,
) -> tuple[Index, Array, Array, Array, int]:
    """Predict the objects and components that are within the limit of their class (eq. PPP_prediction, MB_prediction).

    `class_probability` and `confusion` are those of `predict_classes`.

    Returns:
        The (K,) objects that stay, the array of the predicted objects, pi_+, the array of the predicted components, and
        how many covariances had to be repaired.

    Raises:
        ValueError: a label is of no class, or a column has another length: kernels would read beyond an array; or
            posteriors are of other classes.
    """
    if not labels_within(object_words, component_words, len(classes)):
        raise ValueError("labels of classes that there are not")
    now, label = Moment(*moment), objects_in(object_words).label
    if missed_from_ns.shape[0] not in (0, label.shape[0]):
        raise ValueError("misses of other objects")
    if now.before_ns == NO_FRAME or now.dt == 0.0:
        every = np.arange(label.shape[0])
        pi = predict_classes(every, label, class_probability, 0.0, confusion, classes)
        return every, object_words, pi, component_words, 0
    survival, periods = np.empty(len(classes)), now.dt / now.period
    for c in range(len(classes)):
        survival[c] = classes[c].survival ** periods

    old = objects_in(object_words)
    seen_from_ns = now.before_ns if now.dt <= LONGEST_STEP_S else now.stamp_ns
    since_ns = misses_counted_from(old, missed_from_ns)
    kept = rows_within(old.label, since_ns, seen_from_ns, False, now, classes)
    predicted = np.empty(kept.shape[0] * OBJECT)
    new = objects_in(predicted)
    repaired = predict_rows(kept, old, new, now.dt, classes)
    for k in range(kept.shape[0]):
        n = kept[k]
        new.existence[k] = old.existence[n] * survival[old.label[n]]
        new.id[k], new.seen_ns[k] = old.id[n], old.seen_ns[n]
        new.score[k], new.evidence[k], new.heading_odds[k] = old.score[n], old.evidence[n], old.heading_odds[n]
        new.hits[k], new.looks[k] = old.hits[n], old.looks[n]
        new.extracted[k], new.confirmed[k] = old.extracted[n], old.confirmed[n]

    pi = predict_classes(kept, old.label, class_probability, periods, confusion, classes)
    undetected = components_in(component_words)
    chosen = rows_within(undetected.label, undetected.born_ns, now.before_ns, True, now, classes)
    carried = np.empty(chosen.shape[0] * COMPONENT)
    later = components_in(carried)
    repaired += predict_rows(chosen, undetected, later, now.dt, classes)
    for k in range(chosen.shape[0]):
        later.weight[k] = undetected.weight[chosen[k]] * survival[undetected.label[chosen[k]]]
    return kept, predicted, pi, carried, repaired


@kernel
def rows_within(
    label: Index, since_ns: Index, seen_from_ns: int, undetected: bool, moment: Moment, classes: Classes
) -> Index:
    """Return the rows within `poisson_steps` of their class, if `undetected`, else `max_misses`.

    Periods count from `since_ns` (N,); rows with a stamp from `seen_from_ns` on stay.
    """
    kept, count = np.empty(label.shape[0], np.int64), 0
    for n in range(label.shape[0]):
        own = classes[label[n]]
        limit = own.poisson_steps if undetected else own.max_misses
        # The frame at hand may still bring the detection that is missing, hence one period less.
        if since_ns[n] < seen_from_ns and whole_periods(since_ns[n], moment.stamp_ns, moment.period) - 1 > limit:
            continue
        kept[count] = n
        count += 1
    return kept[:count]


@kernel
def predict_rows(
    rows: Index, old: Bernoullis | Poissons, new: Bernoullis | Poissons, dt: float, classes: Classes
) -> int:
    """Predict m_+ and P_+ of some rows (K,) of objects or components over dt, s, positive; `new` receives them.

    Returns:
        How many covariances had to be repaired.
    """
    buffers = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    repaired = 0
    for k in range(rows.shape[0]):
        n = rows[k]
        own = classes[old.label[n]]
        if predict_state(old.mean[n], old.covariance[n], dt, own, buffers, new.mean[k], new.covariance[k]):
            repaired += 1
        new.label[k], new.born_ns[k] = old.label[n], old.born_ns[n]
        for s in range(4):
            new.auxiliary[k, s] = old.auxiliary[n, s]
    return repaired

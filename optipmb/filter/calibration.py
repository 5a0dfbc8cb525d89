"""What a track publishes of itself: its box, its existence probability and its covariance (not in the paper).

The recursion is right where its model is. Two assumptions fail with real detectors. A detection is given to one object
for certain, which makes r one, although false boxes follow each other too; and errors of detections are taken as
independent, although they are nearly the same in neighbouring frames, which makes P too small. Both are corrected in
the published tracks, so that the recursion stays the paper's:

    evidence    e_k = lambda e_{k-1} + (1 - lambda) l_k,     l_k = ln[z_s / (1 - z_s)], or -l_miss where missed
    existence   p = f(e_k), with a history logit p = o + w_e logit f(e_k) + w_T ln(1 + T) + w_s s + w_v min(v, `WALK`)
    share       s = min((h - 1) / (rho (n - 1)), `FULL_SHARE`), zero in the first look
    covariance  F P F + U diag(along(e_k), across(e_k))^2 U' on x and y, U turned by the heading
    score       (1 - w) x_s + w (1 + e_k / e_max) / 2        e_max the bound of l_k
    velocity    v v^4 / [v^4 + (3 P_vv)^2]                   below one standard deviation hardly any

f, along and across are piecewise linear and were measured on training data, as were the factors F of speed and turn
rate: process noise that lets a braking car stay one track is more than most objects show. lambda holds for one period.
Evidence is of the last half second. The history is of the whole track: T seconds since its first detection, h of its n
looks detected, at the recall rho of the class, and its published speed v, as standing clutter lasts too. The first
detection made the track and tells nothing: a single one seldom shows it.
Without a calibration in the profile, existence is r, the covariance is P, and the evidence stays zero.

The state rests on measurement noise R that is larger than a detector's usual error, so that a half-hidden car whose box
jumps stays one track. The published box is the estimate with a smaller noise R' of position and heading from the same
prediction. As the posterior (m, P) has used the detection already, that is one more update with the noise that is left:

    R_x^-1 = R'^-1 - R^-1,    G = P_bb (P_bb + R_x)^-1,    b = (x, y, phi)
    m_b + G nu,    (I - G) P_bb,    (I - G) P_bo;          nu_phi modulo pi, as in `optipmb.filter.update`

Speed, turn rate and acceleration, o, stay (the gain of a Schmidt-Kalman filter). A missed object publishes its state,
and so does a class without `reported_noise`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from optipmb.compiled import kernel
from optipmb.filter.predict import wrap
from optipmb.model.density import OMEGA, PHI, STATE, V, X, Y

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Index
    from optipmb.model.table import Classes, ClassRow

    Box = tuple[float, float, float]

SURE: Final = 14.0
"""Bound of the log odds of a detection, either sign: a score of one in a million from certain."""

FULL_SHARE: Final = 1.2
"""Most that the share of detected looks counts for, in units of the recall."""

WALK: Final = 2.0
"""Speed from which more does not make an object surer, m/s."""

UNSURE: Final = 3.0
"""Variances of a speed at whose square half of the velocity is published: parked cars hardly move."""


@kernel
def log_odds(score: float) -> float:
    """Return ln[z_s / (1 - z_s)] of a score in [0, 1], bounded by `SURE`."""
    if score <= 0.0 or score >= 1.0:
        return math.copysign(SURE, score - 0.5)
    return min(max(math.log(score) - math.log1p(-score), -SURE), SURE)


@kernel
def use_history(existence: float, age: float, share: float, velocity: Array, own: ClassRow) -> float:
    """Return p by f(e_k), T in seconds, (h - 1) / (n - 1) and the published velocity (2,)."""
    odds = own.history_offset + own.history_existence * log_odds(existence)
    odds += own.history_duration * math.log1p(age)
    odds += own.history_share * min(share / own.recall, FULL_SHARE)
    odds += own.history_speed * min(math.hypot(velocity[0], velocity[1]), WALK)
    return 1.0 / (1.0 + math.exp(-odds))


@kernel
def calibrate_rows(
    label: Index,
    evidence: Array,
    yaw: Array,
    classes: Classes,
    existence: Array,
    score: Array,
    velocity: Array,
    covariance: Array,
) -> None:
    """Replace existence, score, velocity and covariance of the state by the published ones, by `evidence` e_k (K,).

    Rows whose class has no calibration stay.
    """
    for row in range(existence.shape[0]):
        own = classes[label[row]]
        count = own.knots
        if count == 0:
            continue
        e = evidence[row]
        k = 0
        while k < count and own.knot_evidence[k] <= e:
            k += 1
        low, high = max(k - 1, 0), min(k, count - 1)
        share = 0.0
        if high > low:
            share = (e - own.knot_evidence[low]) / (own.knot_evidence[high] - own.knot_evidence[low])
        existence[row] = own.knot_existence[low] + share * (own.knot_existence[high] - own.knot_existence[low])
        along = own.knot_along[low] + share * (own.knot_along[high] - own.knot_along[low])
        across = own.knot_across[low] + share * (own.knot_across[high] - own.knot_across[low])
        for s, factor in ((V, own.factor_speed), (OMEGA, own.factor_turn_rate)):
            for t in range(STATE):
                covariance[row, s, t] *= factor
                covariance[row, t, s] *= factor
        squared = velocity[row, 0] ** 2 + velocity[row, 1] ** 2
        doubt = UNSURE * covariance[row, V, V]
        weight = squared * squared / (squared * squared + doubt * doubt) if squared > 0.0 else 0.0
        velocity[row, 0] *= weight
        velocity[row, 1] *= weight
        cos, sin = math.cos(yaw[row]), math.sin(yaw[row])
        covariance[row, 0, 0] += along * along * cos * cos + across * across * sin * sin
        covariance[row, 1, 1] += along * along * sin * sin + across * across * cos * cos
        mixed = (along * along - across * across) * cos * sin
        covariance[row, 0, 1] += mixed
        covariance[row, 1, 0] += mixed
        w = own.score_of_evidence
        score[row] = (1.0 - w) * score[row] + w * (0.5 + 0.5 * e / SURE)


BOX: Final = (X, Y, PHI)
"""The entries of the state that a box shows, b."""


@kernel
def follow_box(box: Box, noise: Box, mean: Array, covariance: Array) -> None:
    """Update the box of a state, m (6,) and P (6, 6) in place, with its detection z once more.

    The entries of z are taken one after the other, as R_x is diagonal; where its variance is zero the state stays.
    """
    x, y, yaw = box
    if noise[2] != 0.0:  # else it may be unknown
        yaw = mean[PHI] + 0.5 * wrap(2.0 * (yaw - mean[PHI]))
    for s in BOX:
        if s == PHI:
            variance = noise[2]
            innovation = yaw - mean[PHI]
        else:
            variance = noise[0] if s == X else noise[1]
            innovation = (x if s == X else y) - mean[s]
        if variance == 0.0:
            continue
        total = covariance[s, s] + variance
        shift = (covariance[X, s] / total, covariance[Y, s] / total, covariance[PHI, s] / total)
        for i in range(len(BOX)):
            mean[BOX[i]] += shift[i] * innovation
        for t in range(STATE):
            of_row = covariance[s, t]
            for i in range(len(BOX)):
                covariance[BOX[i], t] -= shift[i] * of_row
        for b in BOX:
            for t in range(STATE):
                covariance[t, b] = covariance[b, t]
    mean[PHI] = wrap(mean[PHI])

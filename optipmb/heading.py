"""Which way an object faces: the sign of its heading, as state (not in the paper).

Detectors turn boxes by pi now and then. The update therefore takes the innovation of the heading modulo pi
(`optipmb.update`) and learns nothing of its sign. The sign has a state of its own, h, the log odds that the object
faces along phi and not the other way. With lambda the memory over one nominal period, over which it fades,

    h_k = kappa h_{k-1} + (1 - kappa) / (1 - lambda) l_k,     kappa = lambda^(dt / period)
    l_k = b_d z_s cos(z_phi - phi) + b_v sign(v)              the second term where |v| >= v_0 + 2 sd(v)

where the object is detected; a missed frame leaves h as it is. Where h falls below zero the state is turned: phi + pi,
-v, -a and -h, that is x -> T x with T = diag(1, 1, -1, 1, 1, -1) beside the pi, and P -> T P T. Both states describe
the same motion, so nothing that is predicted or associated depends on the turn.

A track tells the probability p = 1 / (1 + e^-h) that its heading is right, and in the variance of the heading what the
doubt adds to it, p (1 - p) pi^2 beyond what stands outside an interval of 95 % anyway. Without `heading_sign` in the
profile the sign stays that of the birth.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from optipmb.compiled import kernel
from optipmb.density import PHI, STATE, A, V
from optipmb.motion import wrap

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from optipmb.table import ClassRow

    Array = NDArray[np.float64]

TAIL: Final = 0.025
"""Probability beyond an interval of 95 %, on either side."""

CERTAIN: Final = 2.0
"""Standard deviations by which a speed has to be above v_0 to say which way is forward."""


@kernel
def follow_sign(
    odds: float,
    kept: float,
    own: ClassRow,
    score: float,
    yaw: float,
    mean: Array,
    covariance: Array,
) -> float:
    """Return h_k of a detected object, and turn its state in place where the sign has changed.

    Args:
        odds: h_{k-1}; zero before the first detection.
        kept: kappa.
        own: parameters of its class: lambda, b_d, b_v and v_0.
        score: z_s.
        yaw: z_phi.
        mean: (6,) posterior mean.
        covariance: (6, 6) posterior covariance.
    """
    latest = own.sign_detection * score * math.cos(yaw - mean[PHI])
    if abs(mean[V]) >= own.sign_speed + CERTAIN * math.sqrt(covariance[V, V]):
        latest += math.copysign(own.sign_motion, mean[V])
    odds = kept * odds + (1.0 - kept) / (1.0 - own.sign_memory) * latest
    if odds < 0.0:
        turn_around(mean, covariance)
        odds = -odds
    return odds


@kernel
def turn_around(mean: Array, covariance: Array) -> None:
    """Describe the same motion with the opposite heading: x -> T x and phi + pi, P -> T P T."""
    mean[PHI] = wrap(mean[PHI] + math.pi)
    mean[V], mean[A] = -mean[V], -mean[A]
    for s in range(STATE):
        if s not in (V, A):
            for t in (V, A):
                covariance[s, t] = -covariance[s, t]
                covariance[t, s] = -covariance[t, s]


@kernel
def sign_probability(odds: float) -> float:
    """Return 1 / (1 + e^-h), the probability that the object faces along phi; h is not negative."""
    return 1.0 / (1.0 + math.exp(-odds))


@kernel
def doubt(probability: float) -> float:
    """Return the variance that the doubt about the sign adds to a heading, rad^2.

    The two headings have the variance p (1 - p) pi^2 about their mean. A doubt of less than `TAIL` lies outside an
    interval of 95 %, so that much is left out, and headings that are nearly certain have an interval that holds.
    """
    return max(probability * (1.0 - probability) - TAIL * (1.0 - TAIL), 0.0) * math.pi**2

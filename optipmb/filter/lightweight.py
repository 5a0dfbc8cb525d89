"""The light-weight filter of the non-motion states (Section IV.F): box size, height, counters and confidence.

It has the sign of the heading too (not in the paper). Detectors turn boxes by pi now and then, so the update takes the
innovation of the heading modulo pi. The sign has a state of its own, h, the log odds that the object faces along phi.
With lambda the memory over one nominal period,

    h_k = kappa h_{k-1} + (1 - kappa) / (1 - lambda) l_k,     kappa = lambda^(dt / period)
    l_k = b_d z_s cos(z_phi - phi) + b_v sign(v)              the second term where |v| >= v_0 + 2 sd(v)

where the object is detected. Where h falls below zero the state is turned: phi + pi, -v, -a and -h, and P -> T P T with
T = diag(1, 1, -1, 1, 1, -1). Both states describe the same motion. A track publishes the probability 1 / (1 + e^-h)
that its heading is right, and adds the doubt to the variance of the heading. Without `heading_sign` in the profile the
sign of the birth stays. A detection without heading has no vote; a heading that motion has shown begins with b_v, and
h stays without votes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.calibration import log_odds
from optipmb.filter.predict import heading_unknown, wrap
from optipmb.model.density import PHI, STATE, A, V
from optipmb.model.stages import NEW

if TYPE_CHECKING:
    from optipmb.model.density import Bernoullis, Moment
    from optipmb.model.rows import Array
    from optipmb.model.stages import Measurements, Survivors
    from optipmb.model.table import Classes, ClassRow


@kernel
def light_weight_filter(
    survivors: Survivors,
    posterior: Bernoullis,
    objects: Bernoullis,
    next_id: int,
    measurements: Measurements,
    moment: Moment,
    classes: Classes,
) -> None:
    """Update the non-motion states of all objects, new and old.

    Detected: ``x_A = (1 - z_s) x_A + z_s z_A``, ``x_cnt = 0``, ``x_s = [1 - exp(-x_len)] z_s`` (eq. Confidence
    Score). Missed: x_A stays, ``x_s = 0``. New: x_A = z_A before, ids from `next_id` on. The counters are kept as
    stamps, so that they mean the same at every frame rate: x_cnt is the number of nominal periods since `seen_ns`,
    x_len is one more than the (real) number since `born_ns`. The evidence follows `optipmb.filter.calibration`, the
    sign of the heading turns the motion states where it changes. `extracted` and `confirmed` stay. `posterior` has the
    motion states and classes, and receives all other columns.
    """
    stamp_ns, label = moment.stamp_ns, posterior.label
    mean, covariance, auxiliary, identity = posterior.mean, posterior.covariance, posterior.auxiliary, posterior.id
    born_ns, seen_ns, score, evidence = posterior.born_ns, posterior.seen_ns, posterior.score, posterior.evidence
    heading_odds, extracted, confirmed = posterior.heading_odds, posterior.extracted, posterior.confirmed
    hits, looks = posterior.hits, posterior.looks
    # What the evidence keeps over the time since the frame before; in a first detection over one nominal period.
    periods = moment.dt / moment.period
    memory_of_frame, sign_memory_of_frame = np.empty(len(classes)), np.empty(len(classes))
    for c in range(len(classes)):
        memory_of_frame[c], sign_memory_of_frame[c] = classes[c].memory ** periods, classes[c].sign_memory ** periods
    for k in range(survivors.row.shape[0]):
        n, m = survivors.row[k], survivors.measurement[k]
        posterior.existence[k] = survivors.existence[k]
        if n == NEW:
            identity[k] = next_id
            born_ns[k], extracted[k], confirmed[k] = stamp_ns, False, False
            evidence[k] = heading_odds[k] = hits[k] = looks[k] = 0.0
            for s in range(4):
                auxiliary[k, s] = measurements.auxiliary[m, s]
            next_id += 1
        else:
            identity[k] = objects.id[n]
            born_ns[k], seen_ns[k], extracted[k] = objects.born_ns[n], objects.seen_ns[n], objects.extracted[n]
            confirmed[k], evidence[k] = objects.confirmed[n], objects.evidence[n]
            heading_odds[k], hits[k], looks[k] = objects.heading_odds[n], objects.hits[n], objects.looks[n]
            for s in range(4):
                auxiliary[k, s] = objects.auxiliary[n, s]
        own, first = classes[label[k]], born_ns[k] == stamp_ns
        score[k] = 0.0
        looks[k] += 1.0
        latest = -own.missed_evidence
        if m >= 0:
            z_s = measurements.score[m]
            for s in range(4):
                z = measurements.auxiliary[m, s]
                if math.isnan(auxiliary[k, s]):
                    auxiliary[k, s] = z
                if not math.isnan(z):
                    auxiliary[k, s] = (1.0 - z_s) * auxiliary[k, s] + z_s * z
            x_len = 1.0 + (stamp_ns - born_ns[k]) * 1e-9 / moment.period
            score[k] = (1.0 - math.exp(-x_len)) * z_s
            seen_ns[k] = stamp_ns
            hits[k] += 1.0
            latest = log_odds(z_s)
            if own.sign_memory == 0.0 or heading_unknown(covariance[k]):  # the sign is not followed
                heading_odds[k] = 0.0
            else:
                kept = own.sign_memory if first else sign_memory_of_frame[label[k]]
                heading_odds[k] = follow_sign(
                    heading_odds[k], kept, own, z_s, measurements.yaw[m], mean[k], covariance[k]
                )
        kept = own.memory if first else memory_of_frame[label[k]]
        evidence[k] = kept * evidence[k] + (1.0 - kept) * latest


TAIL: Final = 0.025
"""Probability beyond an interval of 95 %, on either side."""

CERTAIN: Final = 2.0
"""Standard deviations by which a speed has to be above v_0 to say which way is forward."""


@kernel
def follow_sign(
    odds: float, kept: float, own: ClassRow, score: float, yaw: float, mean: Array, covariance: Array
) -> float:
    """Return h_k of a detected object by its `odds` h_{k-1}, and turn its state in place where the sign has changed.

    `kept` is kappa; the odds are zero before the first detection.
    """
    blind = math.isnan(yaw)
    latest = 0.0 if blind else own.sign_detection * score * math.cos(yaw - mean[PHI])
    if abs(mean[V]) >= own.sign_speed + CERTAIN * math.sqrt(covariance[V, V]):
        latest += math.copysign(own.sign_motion, mean[V])
    elif blind:
        return odds if odds > 0.0 else own.sign_motion
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

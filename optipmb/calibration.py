"""What a track says of itself, in numbers that come true: its existence probability and its covariance.

The recursion of the paper is right where its model is. Two of its assumptions fail with real detectors. A detection is
given to one object for certain, which makes r one, although boxes that the detector imagines follow each other too; and
errors of detections are taken as independent, although those of neighbouring frames are nearly the same, which makes P
too small. Both are mended where tracks leave the tracker, so that the recursion itself stays the paper's:

    evidence    e_k = lambda e_{k-1} + (1 - lambda) l_k,     l_k = ln[z_s / (1 - z_s)], or -l_miss where missed
    existence   f(e_k)
    covariance  P + U diag(along(e_k), across(e_k))^2 U'     on x and y, U turned by the heading

The evidence is the mean of the log odds of the track's latest detections, with weights that fade. f, along and across
are piecewise linear and were measured on training data: how often tracks with such evidence are of an object, and how
far the lasting error of the detector carries them off. lambda holds for one nominal period.

Without a calibration in the profile, existence is r, the covariance is P, and the evidence stays zero.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.density import PHI

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.preprocess import Measurements
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

SURE: Final = 7.0
"""Log odds of the surest detection and of the least sure one: what scores say beyond 0.999 they do not know."""


def weighed_evidence(
    bernoulli: Bernoullis, measurement: Index, measurements: Measurements, periods: Array, table: ClassTable
) -> Array:
    """Compute the evidence after a frame.

    Args:
        bernoulli: the objects.
        measurement: (N,) index of the measurement of each, negative where missed.
        measurements: Z_k.
        periods: (N,) nominal periods that the frame stands for.
        table: parameters as columns.

    Returns:
        (N,) log odds.
    """
    label = bernoulli.label
    score = np.append(measurements.score, 0.5)[measurement]
    with np.errstate(divide="ignore"):  # a score of one has infinite log odds and is bounded
        odds = np.clip(np.log(score) - np.log1p(-score), -SURE, SURE)
    latest = np.where(measurement >= 0, odds, -table.missed_evidence[label])
    kept = table.memory[label] ** periods
    evidence: Array = kept * bernoulli.evidence + (1.0 - kept) * latest
    return evidence


def calibrated(bernoulli: Bernoullis, table: ClassTable) -> tuple[Array, Array, Array]:
    """Return existence probability (N,), confidence score (N,) and covariance (N, 6, 6) of objects as they are told."""
    existence, score = bernoulli.existence.copy(), bernoulli.score.copy()
    covariance = bernoulli.covariance.copy()
    calibrate_rows(
        bernoulli.label,
        bernoulli.evidence,
        bernoulli.mean,
        table.knots,
        table.knot_evidence,
        table.knot_existence,
        table.knot_along,
        table.knot_across,
        table.score_of_evidence,
        existence,
        score,
        covariance,
    )
    return existence, score, covariance


@kernel
def calibrate_rows(
    label: Index,
    evidence: Array,
    mean: Array,
    knots: Index,
    knot_evidence: Array,
    knot_existence: Array,
    knot_along: Array,
    knot_across: Array,
    score_of_evidence: NDArray[np.bool_],
    existence: Array,
    score: Array,
    covariance: Array,
) -> None:
    """Overwrite existence, score and covariance of the rows whose class has a calibration.

    Args:
        label: (N,) classes.
        evidence: (N,) e_k.
        mean: (N, 6) motion states.
        knots: (C,) number of knots of each class, zero without a calibration.
        knot_evidence: (C, K) where the curves bend, ascending.
        knot_existence: (C, K) f there.
        knot_along: (C, K) standard deviation of the lasting error along the heading, m.
        knot_across: (C, K) across it, m.
        score_of_evidence: (C,) whether the score is the evidence, brought to [0, 1].
        existence: (N,) in: r, out: f(e_k).
        score: (N,) in: x_s, out: the score that is told.
        covariance: (N, 6, 6) in: P, out: with the lasting error.
    """
    for n in range(label.shape[0]):
        c = label[n]
        count = knots[c]
        if count == 0:
            continue
        e = evidence[n]
        k = 0
        while k < count and knot_evidence[c, k] <= e:
            k += 1
        low, high = max(k - 1, 0), min(k, count - 1)
        share = 0.0
        if high > low:
            share = (e - knot_evidence[c, low]) / (knot_evidence[c, high] - knot_evidence[c, low])
        existence[n] = knot_existence[c, low] + share * (knot_existence[c, high] - knot_existence[c, low])
        along = knot_along[c, low] + share * (knot_along[c, high] - knot_along[c, low])
        across = knot_across[c, low] + share * (knot_across[c, high] - knot_across[c, low])
        cos, sin = math.cos(mean[n, PHI]), math.sin(mean[n, PHI])
        covariance[n, 0, 0] += along * along * cos * cos + across * across * sin * sin
        covariance[n, 1, 1] += along * along * sin * sin + across * across * cos * cos
        mixed = (along * along - across * across) * cos * sin
        covariance[n, 0, 1] += mixed
        covariance[n, 1, 0] += mixed
        if score_of_evidence[c]:
            score[n] = 0.5 + 0.5 * e / SURE

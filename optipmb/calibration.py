"""What a track says of itself, in numbers that come true: its existence probability and its covariance.

The recursion of the paper is right where its model is. Two of its assumptions fail with real detectors. A detection is
given to one object for certain, which makes r one, although boxes that the detector imagines follow each other too; and
errors of detections are taken as independent, although those of neighbouring frames are nearly the same, which makes P
too small. Both are mended where tracks leave the tracker, so that the recursion itself stays the paper's:

    evidence    e_k = lambda e_{k-1} + (1 - lambda) l_k,     l_k = ln[z_s / (1 - z_s)], or -l_miss where missed
    existence   f(e_k)
    covariance  P + U diag(along(e_k), across(e_k))^2 U'     on x and y, U turned by the heading
    score       (1 - w) x_s + w (1 + e_k / e_max) / 2        e_max the bound of l_k

The evidence is the mean of the log odds of the track's latest detections, with weights that fade. f, along and across
are piecewise linear and were measured on training data: how often tracks with such evidence are of an object, and how
far the lasting error of the detector carries them off. lambda holds for one nominal period.

Without a calibration in the profile, existence is r, the covariance is P, and the evidence stays zero.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from optipmb.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

SURE: Final = 14.0
"""Log odds of the surest detection, and minus those of the least sure one: a score of one in a million from certain."""


@kernel
def log_odds(score: float) -> float:
    """Return ln[z_s / (1 - z_s)] of a score in (0, 1], bounded by `SURE`."""
    odds = math.log(score) - math.log1p(-score)  # a score of one has infinite log odds
    return min(max(odds, -SURE), SURE)


@kernel
def calibrate_rows(
    label: Index,
    evidence: Array,
    yaw: Array,
    classes: Sequence[ClassRow],
    existence: Array,
    score: Array,
    covariance: Array,
) -> None:
    """Overwrite existence, score and covariance of the rows whose class has a calibration.

    Args:
        label: (K,) classes.
        evidence: (K,) e_k.
        yaw: (K,) headings.
        classes: (C,) parameters: the knots of f, along and across, and w.
        existence: (K,) in: r, out: f(e_k).
        score: (K,) in: x_s, out: the published score.
        covariance: (K, 6, 6) in: P, out: with the lasting error.
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
        cos, sin = math.cos(yaw[row]), math.sin(yaw[row])
        covariance[row, 0, 0] += along * along * cos * cos + across * across * sin * sin
        covariance[row, 1, 1] += along * along * sin * sin + across * across * cos * cos
        mixed = (along * along - across * across) * cos * sin
        covariance[row, 0, 1] += mixed
        covariance[row, 1, 0] += mixed
        w = own.score_of_evidence
        score[row] = (1.0 - w) * score[row] + w * (0.5 + 0.5 * e / SURE)

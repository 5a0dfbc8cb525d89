"""The curve from a detector's scores to those of a reference detector, of equal precision on the same labels.

The precision of a score is the share of detections with about this score that belong to a label. Detections are put
into groups of neighbouring scores, equally many in each where scores do not tie. Isotonic regression of the groups'
precision on their mean log odds (pool adjacent violators: Barlow et al., 1972) merges them into blocks of ascending
precision, for both detectors. The curve has a knot for each block of the detector: from its score to the score at which
the reference, linear in log odds between its own blocks, has the same precision. Outside the precisions that the
reference reaches nothing was measured, and the curve has one knot at their end.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import isotonic_regression

from optipmb import ScoreCalibration
from optipmb_tools.geometry import Bools, Floats
from optipmb_tools.tuning.pairing import Pairs

__all__ = ["counted_scores", "score_curve"]

GROUPS = 25
LEAST_TRUE = 50
"""With fewer detections on labels, of either detector, there is no curve."""
_BOUND = 1e-6
_DIGITS = 3


def counted_scores(pairs: Sequence[Pairs]) -> tuple[Floats, Bools]:
    """Return the scores of the detections that belong to a label or to none without excuse, and which do."""
    score = np.concatenate([one.score for one in pairs]) if pairs else np.empty(0)
    true = np.concatenate([one.object >= 0 for one in pairs]) if pairs else np.empty(0, dtype=np.bool_)
    counted = true | (np.concatenate([one.false for one in pairs]) if pairs else true)
    return score[counted], true[counted]


def score_curve(own: Sequence[Pairs], reference: Sequence[Pairs]) -> ScoreCalibration | None:
    """Return the curve from a detector's scores to the reference's; None where there is too little to measure it.

    Args:
        own: all detections of one class, paired with its labels.
        reference: the same of the reference detector.
    """
    samples = [counted_scores(pairs) for pairs in (own, reference)]
    if min(int(true.sum()) for _, true in samples) < LEAST_TRUE:
        return None
    (odds, precision), (known_odds, known) = (_blocks(score, true) for score, true in samples)
    # Of the knots at or beyond an end of the reference's precisions, the innermost.
    first = max(int(np.searchsorted(precision, known[0], side="right")) - 1, 0)
    last = int(np.searchsorted(precision, known[-1], side="left"))
    within = slice(first, last + 1)
    meant = np.interp(precision[within], known, known_odds)
    knots: list[tuple[float, float]] = []
    for pair in zip(_scores(odds[within]), _scores(meant), strict=True):
        if not knots or (pair[0] > knots[-1][0] and pair[1] > knots[-1][1]):  # equal only by rounding
            knots.append(pair)
    if len(knots) <= 1:  # a curve has two
        return None
    return ScoreCalibration(detector=tuple(one for one, _ in knots), calibrated=tuple(one for _, one in knots))


def _blocks(score: Floats, true: Bools) -> tuple[Floats, Floats]:
    """Return the mean log odds and the precision of blocks of scores; both ascend strictly."""
    bounded = np.clip(score, _BOUND, 1.0 - _BOUND)
    odds = np.log(bounded / (1.0 - bounded))
    edges = np.unique(np.quantile(odds, np.linspace(0.0, 1.0, GROUPS + 1)[1:-1], method="nearest"))
    _, group = np.unique(np.searchsorted(edges, odds, side="right"), return_inverse=True)
    count = np.bincount(group).astype(np.float64)
    found = isotonic_regression(np.bincount(group, true) / count, weights=count)
    starts = found.blocks[:-1]
    weight = np.add.reduceat(count, starts)
    return np.add.reduceat(np.bincount(group, odds), starts) / weight, np.asarray(found.x[starts], dtype=np.float64)


def _scores(odds: Floats) -> list[float]:
    """Return the scores of log odds, with as many digits as the smaller of score and rest needs."""
    scores = 1.0 / (1.0 + np.exp(-odds))
    places = _DIGITS - 1 - np.floor(np.log10(np.minimum(scores, 1.0 - scores))).astype(np.int64)
    return [round(score, place) for score, place in zip(scores.tolist(), places.tolist(), strict=True)]

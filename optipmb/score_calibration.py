"""Scores of one detector, brought to the scores that the thresholds of a profile were chosen with.

A score of 0.4 is a sure object for one detector and a doubtful one for another. A class of the profile may therefore
carry a curve c, through which every detection's score z_s goes before anything reads it, the score filter included:

    z_s <- c(z_s),   c(0) = 0,   c(d_i) = s_i,   c(1) = 1,   straight in between

where d (`detector`) and s (`calibrated`) ascend strictly within (0, 1). So c is a bijection of [0, 1] that keeps the
order of detections and makes no ties. Without a curve scores stay as they are, to the last bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.parameters import Parameters, ScoreCalibration


def calibrated(curve: ScoreCalibration, score: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return c(z_s) of scores (M,) in [0, 1]."""
    given, meant = (0.0, *curve.detector, 1.0), (0.0, *curve.calibrated, 1.0)
    return np.minimum(np.interp(score, given, meant), 1.0)  # rounding may not pass one


def calibrate_scores(
    parameters: Parameters, label: NDArray[np.int64], score: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return scores, those of the classes that have a curve gone through it.

    Args:
        parameters: the profile.
        label: (M,) index into its classes; -1 for a class that it lacks.
        score: (M,) in [0, 1]; the same array comes back where no class has a curve.
    """
    for index, table in enumerate(parameters.classes.values()):
        if table.score_calibration is not None:
            score = np.where(label == index, calibrated(table.score_calibration, score), score)
    return score

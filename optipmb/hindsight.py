"""Existence of tracks in hindsight: from their frame and later ones (not in the paper).

The existence probability of a track rises and falls with the scores of its detections. Objects are detected again, and
clutter ends, so the frames after a frame tell more about its tracks. The existence of a track of frame k becomes

    logit p'_k = mean of logit p_j over the frames j of the track from k on, within a time

with log odds of at most `SURE`. The track is confirmed from `confirm_from` on, without hysteresis, so that the result
depends on those frames alone. Recordings and outputs with a delay use this function.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import SURE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb.extract import Tracks
    from optipmb.parameters import Parameters
    from optipmb.rows import Array


def with_hindsight(tracks: Tracks, later: Iterable[Tracks], parameters: Parameters) -> Tracks:
    """Return the tracks of a frame with existence and `confirmed` of hindsight.

    Args:
        tracks: of the frame.
        later: of the frames within the time after it, in the same session.
        parameters: the profile.
    """
    total, count = _log_odds(tracks.existence), np.ones(len(tracks))
    for one in later:
        _, place, row = np.intersect1d(tracks.id, one.id, assume_unique=True, return_indices=True)
        total[place] += _log_odds(one.existence[row])
        count[place] += 1.0
    existence = 1.0 / (1.0 + np.exp(-total / count))
    confirm_from = np.array([one.confirm_from for one in parameters.classes.values()])
    return tracks.replaced(existence=existence, confirmed=existence >= confirm_from[tracks.label])


def _log_odds(existence: Array) -> Array:
    with np.errstate(divide="ignore"):
        odds: Array = np.log(existence) - np.log1p(-existence)
    return np.asarray(np.clip(odds, -SURE, SURE))

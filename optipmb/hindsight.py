"""Existence and velocity of tracks in hindsight: from their frame and later ones (not in the paper).

The existence probability of a track rises and falls with the scores of its detections. Objects are detected again, and
clutter ends, so the frames after a frame tell more about its tracks. The existence of a track of frame k becomes

    logit p'_k = mean of logit p_j over the frames j of the track from k on, within a time

with log odds of at most `SURE`. The track is confirmed from `confirm_from` on, without hysteresis, so that the result
depends on those frames alone. Recordings and outputs with a delay use this function.

Tracks are thus confirmed from their first frames on, in which their speed is hardly known. The velocity of a track is
the mean of its velocities in the later frames j, taken back over the time d between with their acceleration a along the
heading u and turn rate omega:

    v' = sum w_j R(-omega_j d) (v_j - a_j d u_j) / sum w_j,    w_j = 1 / (P_vv,j + `AGILITY` d^2)

It is weighted as in `optipmb.calibration`, with the variance 1 / max w_j. The covariance of the frame stays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.calibration import SURE, UNSURE
from optipmb.density import V

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb.extract import Tracks
    from optipmb.parameters import Parameters
    from optipmb.rows import Array


AGILITY: Final = 0.3
"""Variance of the acceleration that a track does not tell, m^2/s^4."""
LEAST_VARIANCE: Final = 1e-6
"""Of a speed, m^2/s^2."""


def with_hindsight(
    tracks: Tracks, later: Iterable[Tracks], parameters: Parameters, *, same_axes: bool = False
) -> Tracks:
    """Return the tracks of a frame with existence and `confirmed` of hindsight, and velocity with `same_axes`.

    Args:
        tracks: of the frame.
        later: of the frames within the time after it, in the same session.
        parameters: the profile.
        same_axes: all frames are in the same axes; with an estimated motion of the sensor they are not.
    """
    total, count = _log_odds(tracks.existence), np.ones(len(tracks))
    weight = 1.0 / np.maximum(tracks.covariance[:, V, V], LEAST_VARIANCE)
    most, velocity = weight.copy(), weight[:, None] * tracks.velocity
    for one in later:
        _, place, row = np.intersect1d(tracks.id, one.id, assume_unique=True, return_indices=True)
        total[place] += _log_odds(one.existence[row])
        count[place] += 1.0
        if same_axes:
            seconds = one.age[row] - tracks.age[place]
            own = 1.0 / (np.maximum(one.covariance[row, V, V], LEAST_VARIANCE) + AGILITY * seconds**2)
            along = np.exp(1j * one.yaw[row])
            before = one.velocity[row] @ (1.0, 1j) - one.acceleration[row] * seconds * along
            before *= own * np.exp(-1j * one.yaw_rate[row] * seconds)
            most[place] = np.maximum(most[place], own)
            weight[place] += own
            velocity[place] += np.column_stack((before.real, before.imag))
    existence = 1.0 / (1.0 + np.exp(-total / count))
    confirm_from = np.array([one.confirm_from for one in parameters.classes.values()])
    found = tracks.replaced(existence=existence, confirmed=existence >= confirm_from[tracks.label])
    if not same_axes:
        return found
    velocity /= weight[:, None]
    squared, doubt = (velocity**2).sum(axis=1), UNSURE / most
    return found.replaced(velocity=velocity * (squared**2 / (squared**2 + doubt**2))[:, None])


def _log_odds(existence: Array) -> Array:
    with np.errstate(divide="ignore"):
        odds: Array = np.log(existence) - np.log1p(-existence)
    return np.asarray(np.clip(odds, -SURE, SURE))

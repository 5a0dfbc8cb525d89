"""Existence, `confirmed` and velocity of tracks in hindsight: a decision about each whole track (not in the paper).

Row by row an object is shown late, and again and again for a moment only. Where later frames are known, a track is
shown as a whole, from its first detection to its last, gaps included, or not at all:

    logit p = `TOGETHER` (mean of logit p_j over the frames j of the track up to its last detection - `AGAINST` / h)

with log odds of at most `SURE`, and h detections: a track of few needs them surer. It is confirmed from `confirm_from`
on, at most from `EVEN`. The frames after the last detection keep their existence, and are not confirmed. Recordings and
outputs with a delay use this function.

Tracks are thus shown from their first frames on, in which their speed is hardly known. The velocity of a track is the
mean of its velocities in the frames j of some time after it, taken back over the time d between with their acceleration
a along the heading u and turn rate omega:

    v' = sum w_j R(-omega_j d) (v_j - a_j d u_j) / sum w_j,    w_j = 1 / (P_vv,j + `AGILITY` d^2)

It is weighted as in `optipmb.filter.calibration`, with the variance 1 / max w_j. The covariance of the frame stays.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.calibration import SURE, UNSURE
from optipmb.model.density import V

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from optipmb.model.parameters import Parameters
    from optipmb.model.rows import Array, Index


AGILITY: Final = 0.3
"""Variance of the acceleration that a track does not tell, m^2/s^4."""
LEAST_VARIANCE: Final = 1e-6
"""Of a speed, m^2/s^2."""
ROUNDING: Final = 1e-6
"""Of the difference of two ages, s."""
AGAINST: Final = 2.0
"""Log odds against a track, which its detections have to outweigh together."""
TOGETHER: Final = 1.6
"""Log odds of all frames of a track, in units of their mean."""
EVEN: Final = 0.5
"""Existence from which showing a track is right more often than not."""


def with_hindsight(
    frames: Sequence[Any], parameters: Parameters, *, velocity_s: float = 0.0, show: float | None = None
) -> list[dict[str, NDArray[Any]]]:
    """Return the columns of the tracks of consecutive frames that differ in hindsight, for each frame.

    These are `existence` and `confirmed` of whole tracks, and `velocity` with `velocity_s`.

    Args:
        frames: tracks, or messages with the same columns, of one session.
        parameters: the profile.
        velocity_s: time of later frames by which velocities are estimated, s; zero where axes change between frames,
            as with an estimated motion of the sensor.
        show: existence from which tracks are confirmed; None: as the profile says.
    """
    if not frames:
        return []
    columns = ("id", "label", "existence", "age", "time_since_detection")
    identity, label, existence, age, unseen = (
        np.concatenate([getattr(one, name) for one in frames]) for name in columns
    )
    order = np.argsort(identity, kind="stable")
    first = np.flatnonzero(np.diff(identity[order], prepend=-1))
    track = np.repeat(np.arange(len(first)), np.diff(first, append=len(order)))
    place, back = np.arange(len(order)), np.argsort(order, kind="stable")
    detected = np.where(unseen[order] == 0.0, place, -1)
    shown = place <= np.maximum.reduceat(detected, first)[track] if len(order) else detected >= 0
    total = np.bincount(track, np.where(shown, _log_odds(existence[order]), 0.0), len(first))
    odds = total / np.maximum(np.bincount(track, shown, len(first)), 1.0)
    odds = TOGETHER * (odds - AGAINST / np.maximum(np.bincount(track, detected >= 0, len(first)), 1.0))
    existence[order] = np.where(shown, 1.0 / (1.0 + np.exp(-odds[track])), existence[order])
    least = np.array([min(one.confirm_from, EVEN) if show is None else show for one in parameters.classes.values()])
    changed: dict[str, NDArray[Any]] = {"existence": existence, "confirmed": shown[back] & (existence >= least[label])}
    if velocity_s > 0.0:
        variance = np.concatenate([one.covariance[:, V, V] for one in frames])
        motion = (
            np.concatenate([getattr(one, name) for one in frames]) for name in ("acceleration", "yaw", "yaw_rate")
        )
        velocity = np.concatenate([one.velocity for one in frames])
        given = np.column_stack((np.maximum(variance, LEAST_VARIANCE), *motion, age, velocity))[order]
        changed["velocity"] = later_velocities(track, given, velocity_s)[back]
    ends = np.cumsum([len(one.id) for one in frames])[:-1]
    parts = {name: np.split(column, ends) for name, column in changed.items()}
    return [{name: part[k] for name, part in parts.items()} for k in range(len(frames))]


def _log_odds(existence: Array) -> Array:
    with np.errstate(divide="ignore"):
        odds: Array = np.log(existence) - np.log1p(-existence)
    return np.asarray(np.clip(odds, -SURE, SURE))


@kernel
def later_velocities(track: Index, given: Array, seconds: float) -> Array:
    """Return v' (R, 2) of rows ordered by track and time.

    `given` (R, 7): variance of the speed, acceleration, heading, turn rate, age, velocity.
    """
    count = track.shape[0]
    out = np.empty((count, 2))
    for i in range(count):
        most = total = x = y = 0.0
        j = i
        while j < count and track[j] == track[i] and given[j, 4] - given[i, 4] <= seconds + ROUNDING:
            variance, acceleration, yaw, turn_rate = given[j, 0], given[j, 1], given[j, 2], given[j, 3]
            dt = given[j, 4] - given[i, 4]
            weight = 1.0 / (variance + AGILITY * dt * dt)
            vx = given[j, 5] - acceleration * dt * math.cos(yaw)
            vy = given[j, 6] - acceleration * dt * math.sin(yaw)
            cos, sin = math.cos(turn_rate * dt), math.sin(turn_rate * dt)
            x += weight * (cos * vx + sin * vy)
            y += weight * (cos * vy - sin * vx)
            most, total = max(most, weight), total + weight
            j += 1
        x, y = x / total, y / total
        squared, doubt = x * x + y * y, UNSURE / most
        share = squared * squared / (squared * squared + doubt * doubt)
        out[i, 0], out[i, 1] = share * x, share * y
    return out

"""Where tracks are going: their states at times ahead, by the motion model of their class (eq. Motion Predict).

Between two horizons the state is predicted in equal steps of at most one nominal period, each as in
`optipmb.filter.predict`. One long step would be another motion: its noise of speed and heading would reach no position.
The covariance is the filter's. The mean is the motion of the state itself and not the mean of the sigma points: where
the heading may turn far in the time ahead, the latter hardly moves at all, and no object goes that way. Uncertain turn
rates and accelerations count less: each has the weight ``x^2 / (x^2 + P_xx)`` of least mean square error.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.lightweight import doubt
from optipmb.filter.predict import decay_and_turn, displacement, heading_unknown, predict_state, wrap
from optipmb.filter.unknown_heading import scale_across, show_heading
from optipmb.model.density import OMEGA, PHI, STATE, A, Density, V, X, Y, check_fitting, copy_state
from optipmb.model.errors import DensityError, FrameError
from optipmb.model.parameters import HORIZONS, MAX_HORIZON_S, MAX_HORIZONS
from optipmb.model.rows import record
from optipmb.model.table import ClassTable
from optipmb.model.tracks import sound, unsound

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb.model.parameters import Parameters
    from optipmb.model.rows import Array, Index
    from optipmb.model.table import Classes
    from optipmb.model.tracks import Tracks


MAX_STEPS: Final = 1000
"""Most steps of a path, however short the nominal period."""

ROUNDING: Final = 1e-6
"""Share of a period by which a step may be longer, so that rounding of a horizon costs no step more."""


@record
class PredictedPaths:
    """The states of tracks at times ahead, in the world frame, rows as in the tracks.

    Attributes:
        id: (N,) int64 track ids.
        label: (N,) int64, index into the classes of the parameters.
        horizons: (H,) s after the stamp of the tracks.
        mean: (N, H, 6) [x, y, v, phi, omega, a]: m, m/s along the heading, rad in (-pi, pi], rad/s, m/s^2.
        covariance: (N, H, 6, 6) of those, with the doubt which way the object faces, as in `Tracks`.
    """

    id: Index
    label: Index
    horizons: Array
    mean: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.id)

    @property
    def position(self) -> Array:
        """(N, H, 2) x and y, m."""
        return self.mean[:, :, :2]

    @property
    def yaw(self) -> Array:
        """(N, H) headings, rad, in (-pi, pi]."""
        return self.mean[:, :, PHI]


def predict_tracks(
    tracks: Tracks | Density, horizons: Sequence[float] | Array, parameters: Parameters
) -> PredictedPaths:
    """Predict where objects will be, by the motion model of their class.

    The doubt which way an object faces (`optipmb.filter.lightweight`) takes no part: both headings describe the same
    motion.

    Args:
        tracks: tracks of a step, or a density, of which all detected objects are predicted.
        horizons: times after the stamp of the tracks, s: positive, ascending, at most `MAX_HORIZONS` of them, up to
            `MAX_HORIZON_S`.
        parameters: the profile that the tracks were made with.

    Raises:
        FrameError: the horizons are not so; or the tracks are not `sound`, or of classes that the profile lacks.
        DensityError: the columns of the density do not fit together, or to the classes of the profile.
    """
    times = _horizons(horizons)
    table = ClassTable.of(parameters)
    if isinstance(tracks, Density):
        if tracks.labels != parameters.labels:
            classes = f"the classes of profile {parameters.name}, {parameters.labels}"
            raise DensityError("density.labels", classes, str(tracks.labels)[:200])
        check_fitting(tracks, parameters.labels)
        objects = tracks.bernoulli
        return _predict(objects.id, objects.label, objects.mean, objects.covariance, times, table)
    if not sound(tracks):
        raise FrameError(*unsound(tracks))
    label = tracks.label
    if label.size and not 0 <= label.min() <= label.max() < len(parameters.labels):
        classes = f"indices below {len(parameters.labels)}"
        raise FrameError("tracks.label", classes, f"{label.min()} to {label.max()}")
    return paths_of(tracks, times, table)


def paths_of(tracks: Tracks, times: Array, table: ClassTable) -> PredictedPaths:
    """Predict tracks that are known to be of the classes of the table, to times that are known to ascend."""
    speed = tracks.velocity[:, 0] * np.cos(tracks.yaw) + tracks.velocity[:, 1] * np.sin(tracks.yaw)
    mean = np.column_stack((tracks.center[:, :2], speed, tracks.yaw, tracks.yaw_rate, tracks.acceleration))
    unsure = _doubts(tracks.heading_confidence)
    covariance = tracks.covariance.copy()
    covariance[:, PHI, PHI] -= unsure
    paths = _predict(tracks.id, tracks.label, mean, covariance, times, table)
    paths.covariance[:, :, PHI, PHI] += unsure[:, None]
    return paths


def tracks_ahead(tracks: Tracks, seconds: float, table: ClassTable) -> Tracks:
    """Predict tracks that are known to be of the classes of the table by a time: motion, ages and existence.

    Boxes, scores and `confirmed` stay; no track has a detection.
    """
    paths = paths_of(tracks, np.array([seconds]), table)
    mean, later = paths.mean[:, 0], type(tracks).of(tracks.words.copy())
    later.center[:, :2], later.yaw[:], later.yaw_rate[:], later.acceleration[:] = mean[:, :2], *mean[:, PHI:].T
    later.velocity[:, 0], later.velocity[:, 1] = mean[:, V] * np.cos(later.yaw), mean[:, V] * np.sin(later.yaw)
    later.covariance[:] = paths.covariance[:, 0]
    later.existence[:] *= table["survival"][tracks.label] ** (seconds / table.period)
    later.age[:] += seconds
    later.time_since_detection[:] += seconds
    later.detection[:] = -1
    return later


def _horizons(values: Sequence[float] | Array) -> Array:
    try:
        times = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise FrameError("horizons", HORIZONS, repr(values)[:200]) from None
    if times.ndim != 1 or times.size > MAX_HORIZONS:
        raise FrameError("horizons", HORIZONS, f"an array of shape {times.shape}")
    before = np.concatenate((np.zeros(1), times[:-1]))[: times.size]
    wrong = np.flatnonzero(~((times > before) & (times <= MAX_HORIZON_S)))
    if wrong.size:
        raise FrameError(f"horizons[{wrong[0]}]", HORIZONS, f"{times[wrong[0]]:g}")
    return times


def _predict(
    identity: Index, label: Index, mean: Array, covariance: Array, times: Array, table: ClassTable
) -> PredictedPaths:
    found = predict_paths(mean, covariance, label, times, table.period, table.classes)
    return PredictedPaths(identity.copy(), label.copy(), times, *found)


@kernel
def _doubts(heading_confidence: Array) -> Array:
    unsure = np.empty(heading_confidence.shape[0])
    for n in range(unsure.shape[0]):
        unsure[n] = doubt(heading_confidence[n])
    return unsure


@kernel
def predict_paths(
    mean: Array, covariance: Array, label: Index, horizons: Array, period: float, classes: Classes
) -> tuple[Array, Array]:
    """Predict states to the horizons, in equal steps of at most a nominal period; return (N, H, 6) and (N, H, 6, 6)."""
    buffers = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    shape = label.shape[0], horizons.shape[0]
    mean_out, covariance_out = np.empty((*shape, STATE)), np.empty((*shape, STATE, STATE))
    state, spread = np.empty((2, STATE)), np.empty((2, STATE, STATE))
    for n in range(mean.shape[0]):
        own = classes[label[n]]
        copy_state(mean, covariance, n, state, spread, 0)
        straight = heading_unknown(spread[0]) and spread[0, PHI, PHI] > 0.0
        if straight:  # in the units of a track
            scale_across(spread[0], math.sqrt(spread[0, V, V] / spread[0, PHI, PHI]))
        for s in (OMEGA, A):
            squared = state[0, s] * state[0, s]
            state[0, s] *= 0.0 if own.constant_velocity or squared == 0.0 else squared / (squared + spread[0, s, s])
        before = 0.0
        for h in range(horizons.shape[0]):
            ahead = horizons[h] - before
            steps = max(1, math.ceil(min(ahead / period - ROUNDING, MAX_STEPS * ahead / horizons[-1])))
            for _ in range(steps):
                dt, v, phi, omega, a = ahead / steps, state[0, V], state[0, PHI], state[0, OMEGA], state[0, A]
                predict_state(state[0], spread[0], dt, own, buffers, state[1], spread[1])
                decay = decay_and_turn(omega, dt, own.acceleration_time)
                dx, dy, v, a = displacement(v, phi, omega, a, dt, own.acceleration_time, decay)
                state[1, X], state[1, Y], state[1, V], state[1, A] = state[0, X] + dx, state[0, Y] + dy, v, a
                state[1, PHI], state[1, OMEGA] = wrap(phi + omega * dt), omega
                copy_state(state, spread, 1, state, spread, 0)
            copy_state(state, spread, 0, mean_out[n], covariance_out[n], h)
            if straight:
                show_heading(state[0, V], covariance_out[n, h])
            before = horizons[h]
    return mean_out, covariance_out

"""The tracks of one frame, and whether their numbers are sound."""

from __future__ import annotations

from typing import Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.density import STATE
from optipmb.model.errors import FrameError
from optipmb.model.rows import Array, Column, Rows, arrays_of, views_of

MAX_PLACE: Final = 1e9
"""Largest coordinate of a track, m: ten times what a detection may have."""

MAX_VALUE: Final = 1e5
"""Largest size, heading, speed, turn rate and acceleration, in the units of `Tracks`."""

MAX_COVARIANCE: Final = 1e30
"""Largest entry of a covariance, in the units of `Tracks`."""

MAX_AGE: Final = 1e12
"""Longest age, s."""


class Tracks(Rows):
    """The extracted tracks of one frame in the world frame, one row per track, ascending ids.

    Attributes:
        id: (N,) int64, unique in the session and never reused.
        label: (N,) int64, index into the classes of the parameters.
        center: (N, 3) geometric centre of the box, m.
        size: (N, 3) length, width, height, m.
        yaw: (N,) heading, rad, in (-pi, pi].
        heading_confidence: (N,) probability that the object faces along `yaw` and not the other way; one where the
            profile does not follow it (`optipmb.filter.lightweight`).
        velocity: (N, 2) over ground, m/s; with a calibration near zero where the speed is not certain.
        yaw_rate: (N,) rad/s.
        acceleration: (N,) along the heading, m/s^2.
        existence: (N,) existence probability: calibrated (`optipmb.filter.calibration`), or r without a calibration.
        score: (N,) confidence score x_s, zero while missed; with a weight of the evidence where the profile has one.
        covariance: (N, 6, 6) of [x, y, v, phi, omega, a], with the lasting error of the detector, and with the doubt
            which way the object faces.
        age: (N,) s since the first detection.
        time_since_detection: (N,) s since the last one.
        detection: (N,) int64, index of this frame's detection in the caller's arrays, -1 while missed.
        confirmed: (N,) bool: the existence reached `confirm_from` and has not fallen below `confirm_until` since in a
            frame that missed it. People and planners look at confirmed tracks; the others may be of nothing.
    """

    part = "tracks"
    refused = FrameError
    __slots__ = ()

    id = Column(np.int64)
    label = Column(np.int64)
    center = Column(np.float64, 3, low=-MAX_PLACE, high=MAX_PLACE)
    size = Column(np.float64, 3, low=5e-324, high=MAX_VALUE)
    yaw = Column(np.float64, low=-MAX_VALUE, high=MAX_VALUE)
    heading_confidence = Column(np.float64, low=0.0, high=1.0)
    velocity = Column(np.float64, 2, low=-MAX_VALUE, high=MAX_VALUE)
    yaw_rate = Column(np.float64, low=-MAX_VALUE, high=MAX_VALUE)
    acceleration = Column(np.float64, low=-MAX_VALUE, high=MAX_VALUE)
    existence = Column(np.float64, low=0.0, high=1.0)
    score = Column(np.float64, low=0.0, high=1.0)
    covariance = Column(np.float64, STATE, STATE, low=-MAX_COVARIANCE, high=MAX_COVARIANCE)
    age = Column(np.float64, low=0.0, high=MAX_AGE)
    time_since_detection = Column(np.float64, low=0.0, high=MAX_AGE)
    detection = Column(np.int64)
    confirmed = Column(np.bool_)


TRACK: Final = Tracks.width
TrackArrays: Final = arrays_of(Tracks, "TrackArrays", __name__)
tracks_in: Final = views_of(Tracks, TrackArrays, "tracks_in", __file__)


def sound(tracks: Tracks) -> bool:
    """Tell whether all numbers of the tracks are finite and within bounds, and the ids ascend.

    Existence, score and heading confidence lie in [0, 1], sizes are positive, ages are not negative, coordinates are at
    most `MAX_PLACE`, covariances `MAX_COVARIANCE`, ages `MAX_AGE`, all others `MAX_VALUE`.
    """
    return bool(all_within(tracks.words))


def unsound(tracks: Tracks) -> tuple[str, str, str]:
    """Return the first fault of tracks that are not `sound`: path, expected, received."""
    for name, values in tracks.columns():
        low, high = Tracks.described[name].low, Tracks.described[name].high
        for place in np.argwhere(~((low <= values) & (values <= high)) & (low <= high))[:1]:
            least = f"from {low:g}" if low <= 0.0 else "above 0"
            return f"tracks.{name}[{place[0]}]", f"a number {least} to {high:g}", f"{values[tuple(place)]:g}"
    row = int((np.diff(tracks.id, prepend=-1) <= 0).argmax())
    return f"tracks.id[{row}]", "ids that ascend, from 0", str(tracks.id[row])


_BOUNDS_OF_WORDS: Final = np.array(
    [(one.low, one.high) for one in Tracks.described.values() for _ in range(one.begin, one.end)]
)
"""(`TRACK`, 2) bounds of each word of a row, NaN where it is an integer."""


@kernel
def all_within(words: Array) -> bool:
    """Tell whether the columns of the array of `Tracks` are within the bounds of `sound`; NaN is in none."""
    count = words.shape[0] // TRACK
    good, before = True, -1
    for identity in tracks_in(words).id:
        good &= identity > before
        before = identity
    for k in range(TRACK):
        low, high = _BOUNDS_OF_WORDS[k, 0], _BOUNDS_OF_WORDS[k, 1]
        if low <= high:
            for value in words[k * count : (k + 1) * count]:
                good &= low <= value <= high
    return bool(good)

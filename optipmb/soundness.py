"""Whether tracks hold numbers that a receiver can work with, found out in one pass.

What comes out of the filter is sound as long as its covariances are. A covariance that came in with deviations of
kilometres can grow past every bound, and whoever gives tracks away should know before anybody plans with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.extract import tracks_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.extract import Tracks

    Array = NDArray[np.float64]

MAX_PLACE: Final = 1e9
"""Largest coordinate of a track, m: ten times what a detection may have."""

MAX_VALUE: Final = 1e5
"""Largest size, heading, speed, turn rate and acceleration, in the units of `Tracks`."""

MAX_COVARIANCE: Final = 1e30
"""Largest entry of a covariance, in the units of `Tracks`."""

MAX_AGE: Final = 1e12
"""Longest age, s."""

_BOUNDS: Final[tuple[tuple[str, float, float], ...]] = (
    ("center", -MAX_PLACE, MAX_PLACE),
    ("size", 5e-324, MAX_VALUE),
    ("yaw", -MAX_VALUE, MAX_VALUE),
    ("heading_confidence", 0.0, 1.0),
    ("velocity", -MAX_VALUE, MAX_VALUE),
    ("yaw_rate", -MAX_VALUE, MAX_VALUE),
    ("acceleration", -MAX_VALUE, MAX_VALUE),
    ("existence", 0.0, 1.0),
    ("score", 0.0, 1.0),
    ("covariance", -MAX_COVARIANCE, MAX_COVARIANCE),
    ("age", 0.0, MAX_AGE),
    ("time_since_detection", 0.0, MAX_AGE),
)


def sound(tracks: Tracks) -> bool:
    """Tell whether all numbers of the tracks are finite and within bounds, and the ids ascend.

    Existence, score and heading confidence lie in [0, 1], sizes are positive, ages are not negative, coordinates are at
    most `MAX_PLACE`, covariances `MAX_COVARIANCE`, ages `MAX_AGE`, all others `MAX_VALUE`.
    """
    return bool(all_within(tracks.words))


def unsound(tracks: Tracks) -> tuple[str, str, str]:
    """Return what is wrong with tracks that are not `sound`: path of the first value, expected, received."""
    for name, low, high in _BOUNDS:
        values = getattr(tracks, name)
        for place in np.argwhere(~((low <= values) & (values <= high)))[:1]:
            least = f"from {low:g}" if low <= 0.0 else "above 0"
            return f"tracks.{name}[{place[0]}]", f"a number {least} to {high:g}", f"{values[tuple(place)]:g}"
    row = int((np.diff(tracks.id, prepend=-1) <= 0).argmax())
    return f"tracks.id[{row}]", "ids that ascend, from 0", str(tracks.id[row])


@kernel
def all_within(words: Array) -> bool:
    """Tell whether the columns of the array of `Tracks` are within the bounds of `sound`; NaN is in none."""
    tracks = tracks_in(words)
    center, size, velocity, covariance = tracks.center, tracks.size, tracks.velocity, tracks.covariance
    good = True
    before = -1
    for n in range(tracks.id.shape[0]):
        good &= tracks.id[n] > before
        before = tracks.id[n]
        for s in range(3):
            good &= abs(center[n, s]) <= MAX_PLACE
            good &= 0.0 < size[n, s] <= MAX_VALUE
        good &= abs(tracks.yaw[n]) <= MAX_VALUE
        good &= 0.0 <= tracks.heading_confidence[n] <= 1.0
        good &= abs(velocity[n, 0]) <= MAX_VALUE and abs(velocity[n, 1]) <= MAX_VALUE
        good &= abs(tracks.yaw_rate[n]) <= MAX_VALUE
        good &= abs(tracks.acceleration[n]) <= MAX_VALUE
        good &= 0.0 <= tracks.existence[n] <= 1.0
        good &= 0.0 <= tracks.score[n] <= 1.0
        good &= 0.0 <= tracks.age[n] <= MAX_AGE
        good &= 0.0 <= tracks.time_since_detection[n] <= MAX_AGE
        for s in range(covariance.shape[1]):
            for t in range(covariance.shape[2]):
                good &= abs(covariance[n, s, t]) <= MAX_COVARIANCE
    return good

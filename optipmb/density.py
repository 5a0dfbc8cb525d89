"""The PMB density (eq. PMB) as arrays: a Poisson intensity of undetected objects, a multi-Bernoulli of detected ones.

One row per component, structure of arrays, so that kernels run over contiguous memory and a density can be kept,
compared, hashed and stored as it is. The columns of a record lie in one array (`optipmb.rows`), which is never written
after the density is made.

Motion state x_M = [x, y, v, phi, omega, a]: position on the ground plane (m), speed along the heading (m/s, negative
when reversing), heading (rad, in (-pi, pi]), turn rate (rad/s), acceleration (m/s^2).
Auxiliary state x_A = [length, width, height, z]: box size and height of the box's centre, m.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.records import record
from optipmb.rows import Column, Rows, arrays_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

X: Final = 0
Y: Final = 1
V: Final = 2
PHI: Final = 3
OMEGA: Final = 4
A: Final = 5
STATE: Final = 6
"""Length of the motion state, and the index of each of its entries."""

NO_FRAME: Final = -1
"""`Density.stamp_ns` before the first frame."""

FROM_LAST_DETECTION: Final = np.zeros(0, np.int64)
"""In place of stamps from which misses count, where every frame looks at all objects."""


class Bernoullis(Rows):
    """The detected potential objects.

    Attributes:
        mean: (N, 6) posterior mean m of the motion state.
        covariance: (N, 6, 6) posterior covariance P.
        existence: (N,) existence probability r.
        label: (N,) int64 class c, index into the classes of the parameters.
        auxiliary: (N, 4) auxiliary state x_A.
        id: (N,) int64 track id t, unique in the session, ascending.
        born_ns: (N,) int64 stamp of the first detection.
        seen_ns: (N,) int64 stamp of the last detection; x_cnt and x_len are its and born_ns's distance to now.
        score: (N,) confidence score x_s.
        evidence: (N,) mean log odds of the latest detections (`optipmb.calibration`).
        heading_odds: (N,) log odds that the object faces along phi and not the other way (`optipmb.heading`).
        extracted: (N,) bool, whether the track was ever extracted (t in T).
        confirmed: (N,) bool, whether the track was confirmed when it was last extracted (`optipmb.extract`).
    """

    part = "bernoulli"
    __slots__ = ()

    mean = Column(np.float64, STATE)
    covariance = Column(np.float64, STATE, STATE)
    existence = Column(np.float64)
    label = Column(np.int64)
    auxiliary = Column(np.float64, 4)
    id = Column(np.int64)
    born_ns = Column(np.int64)
    seen_ns = Column(np.int64)
    score = Column(np.float64)
    evidence = Column(np.float64)
    heading_odds = Column(np.float64)
    extracted = Column(np.bool_)
    confirmed = Column(np.bool_)


class Misses(Rows):
    """From when the misses of each detected object count, where sensors have fields of view; a row for each.

    Attributes:
        missed_from_ns: (N,) int64 stamp of the last detection, later by the time in which no sensor looked at it.
        looked_ns: (N,) int64 stamp of the last frame with the object in view.
    """

    part = "misses"
    __slots__ = ()

    missed_from_ns = Column(np.int64)
    looked_ns = Column(np.int64)


class Poissons(Rows):
    """The Gaussian components of the Poisson intensity of undetected objects (eq. PPP Posterior).

    Attributes:
        mean: (N, 6) m^u.
        covariance: (N, 6, 6) P^u.
        weight: (N,) mu^u, expected number of objects.
        label: (N,) int64 class.
        auxiliary: (N, 4) box of the detection that made the component.
        born_ns: (N,) int64 stamp of that detection, later by the time in which no sensor looked at the component.
    """

    part = "poisson"
    __slots__ = ()

    mean = Column(np.float64, STATE)
    covariance = Column(np.float64, STATE, STATE)
    weight = Column(np.float64)
    label = Column(np.int64)
    auxiliary = Column(np.float64, 4)
    born_ns = Column(np.int64)


# Kernels take no records but their arrays, and named tuples of the columns inside them.
OBJECT: Final = Bernoullis.width
COMPONENT: Final = Poissons.width
BernoulliArrays: Final = arrays_of(Bernoullis, "BernoulliArrays", __name__)
PoissonArrays: Final = arrays_of(Poissons, "PoissonArrays", __name__)


@kernel
def objects_in(words: Array) -> Bernoullis:
    """Return the columns of the array of `Bernoullis`, which are views of it; flags are the integers 0 and 1."""
    n = words.shape[0] // OBJECT
    whole = words.view(np.int64)
    columns: Bernoullis = BernoulliArrays(
        words[: 6 * n].reshape(n, STATE),
        words[6 * n : 42 * n].reshape(n, STATE, STATE),
        words[42 * n : 43 * n],  # existence
        whole[43 * n : 44 * n],  # label
        words[44 * n : 48 * n].reshape(n, 4),
        whole[48 * n : 49 * n],  # id
        whole[49 * n : 50 * n],  # born_ns
        whole[50 * n : 51 * n],  # seen_ns
        words[51 * n : 52 * n],  # score
        words[52 * n : 53 * n],  # evidence
        words[53 * n : 54 * n],  # heading_odds
        whole[54 * n : 55 * n],  # extracted
        whole[55 * n : 56 * n],  # confirmed
    )
    return columns


@kernel
def misses_counted_from(objects: Bernoullis, missed_from_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the stamps (N,) from which the misses of objects count; x_cnt is their distance to now.

    Args:
        objects: the columns of the objects.
        missed_from_ns: `Density.missed_from_ns`.
    """
    return missed_from_ns if missed_from_ns.shape[0] > 0 else objects.seen_ns


@kernel
def components_in(words: Array) -> Poissons:
    """Return the columns of the array of `Poissons`, which are views of it."""
    n = words.shape[0] // COMPONENT
    whole = words.view(np.int64)
    columns: Poissons = PoissonArrays(
        words[: 6 * n].reshape(n, STATE),
        words[6 * n : 42 * n].reshape(n, STATE, STATE),
        words[42 * n : 43 * n],  # weight
        whole[43 * n : 44 * n],  # label
        words[44 * n : 48 * n].reshape(n, 4),
        whole[48 * n : 49 * n],  # born_ns
    )
    return columns


BINS: Final = 26
COUNTS: Final = 5
SLOTS: Final = 3
SLOT: Final = BINS + 2
"""Shapes of `SelfCalibration`; a slot has looks and ticks of 0.1 ms behind the bins."""
NO_BIN: Final = -1


ENOUGH: Final = 3.0
"""Evidence for a motion of the sensor from which it is used, and"""
LEAST_MOVED_S: Final = 0.25
"""the time over which it has to be found before, s."""


@record
class SelfCalibration:
    """Counts of the detections of a stream by score.

    Attributes:
        classes: (C, `COUNTS`, `BINS`) of the classes.
        objects: (N, `SLOTS`, `SLOT`) uint16 of each detected object: detections by bin, looks and ticks of its slots,
            the oldest first.
        components: (J,) int64 bin of the detection of each Poisson component, `NO_BIN` where it is not known.
    """

    classes: Array
    objects: NDArray[np.uint16]
    components: NDArray[np.int64]

    @classmethod
    def of(cls, density: Density) -> SelfCalibration:
        """Return the counts of a density; without any, those before the first frame."""
        if density.self_calibration is not None:
            return density.self_calibration
        return cls(
            np.zeros((len(density.labels), COUNTS, BINS)),
            np.zeros((len(density.bernoulli), SLOTS, SLOT), np.uint16),
            np.full(len(density.poisson), NO_BIN, np.int64),
        )


@record
class Density:
    """The whole state of a session between two frames.

    Attributes:
        stamp_ns: stamp of the last frame, `NO_FRAME` before the first.
        next_id: the id of the next new track; ids are never reused.
        bernoulli: detected potential objects.
        poisson: undetected potential objects.
        labels: names of the classes that the labels point into, those of the parameters.
        misses: of the detected objects; None while no frame has had a field of view: every frame looks at all of them.
        class_probability: (N, C) posterior of each detected object over the classes (`optipmb.class_posterior`); None
            where the profile has no groups.
        self_calibration: counts of scores; None where the profile does not calibrate them itself.
        sensor: (5,) velocity, m/s, and turn rate, rad/s, with which what stands passes a sensor without poses, the
            evidence that it moves so, and the time over which that was found, s (`optipmb.sensor_motion`); None where
            it stands or frames have poses.
    """

    stamp_ns: int
    next_id: int
    bernoulli: Bernoullis
    poisson: Poissons
    labels: tuple[str, ...]
    misses: Misses | None = None
    class_probability: NDArray[np.float64] | None = None
    self_calibration: SelfCalibration | None = None
    sensor: NDArray[np.float64] | None = None

    @property
    def sensor_motion(self) -> NDArray[np.float64] | None:
        """Velocity, m/s, and turn rate, rad/s, (3,) of `sensor`; None where the evidence is not enough to use them."""
        sensor = self.sensor
        if sensor is None or sensor[3] < ENOUGH or sensor[4] < LEAST_MOVED_S:
            return None
        return sensor[:3]

    @property
    def missed_from_ns(self) -> NDArray[np.int64]:
        """Stamps (N,) from which the misses of the objects count; (0,) where that is their last detection."""
        return FROM_LAST_DETECTION if self.misses is None else self.misses.missed_from_ns

    @classmethod
    def empty(cls, labels: tuple[str, ...], next_id: int = 1) -> Density:
        """Return the density before the first frame; `next_id` lets a restarted session go on with fresh ids."""
        return cls(NO_FRAME, next_id, Bernoullis.empty(), Poissons.empty(), labels)


@kernel
def whole_periods(since_ns: int, now_ns: int, period: float) -> int:
    """Count the nominal periods (s) from a stamp to now, to the nearest: step counters for any frame rate."""
    return math.floor((now_ns - since_ns) * 1e-9 / period + 0.5)


@kernel
def copy_state(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    n: int,
    mean_out: NDArray[np.float64],
    covariance_out: NDArray[np.float64],
    k: int,
) -> None:
    """Write the mean and the covariance of row `n` to row `k`: entry by entry, which is four times as fast as rows."""
    for s in range(STATE):
        mean_out[k, s] = mean[n, s]
        for t in range(STATE):
            covariance_out[k, s, t] = covariance[n, s, t]

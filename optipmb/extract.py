"""Track extraction with two thresholds (OTE, Section IV.G), and the tracks that come out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optipmb.calibration import calibrated
from optipmb.density import OMEGA, PHI, A, V, whole_periods

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.density import Bernoullis
    from optipmb.table import ClassTable

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tracks:
    """The extracted tracks of one frame in the world frame, one row per track, ascending ids.

    Attributes:
        id: (N,) int64, unique in the session and never reused.
        label: (N,) int64, index into the classes of the parameters.
        center: (N, 3) geometric centre of the box, m.
        size: (N, 3) length, width, height, m.
        yaw: (N,) heading, rad, in (-pi, pi].
        velocity: (N, 2) over ground, m/s.
        yaw_rate: (N,) rad/s.
        acceleration: (N,) along the heading, m/s^2.
        existence: (N,) existence probability: calibrated (`optipmb.calibration`), or r without a calibration.
        score: (N,) confidence score x_s, zero while missed; or the evidence, where the profile asks for it.
        covariance: (N, 6, 6) of [x, y, v, phi, omega, a], with the lasting error of the detector.
        age: (N,) s since the first detection.
        time_since_detection: (N,) s since the last one.
        detection: (N,) int64, index of this frame's detection in the caller's arrays, -1 while missed.
    """

    id: NDArray[np.int64]
    label: NDArray[np.int64]
    center: Array
    size: Array
    yaw: Array
    velocity: Array
    yaw_rate: Array
    acceleration: Array
    existence: Array
    score: Array
    covariance: Array
    age: Array
    time_since_detection: Array
    detection: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.id)


def extraction(bernoulli: Bernoullis, stamp_ns: int, table: ClassTable, *, two_thresholds: bool) -> NDArray[np.bool_]:
    """Tell which objects are extracted.

    A track that never was: from ``r >= eta_ext1``. A known one: while ``r >= eta_ext2`` and ``x_cnt < eta_cnt``. The
    baseline of the ablation has the first threshold alone.
    """
    first: NDArray[np.bool_] = bernoulli.existence >= table.extract_new[bernoulli.label]
    if not two_thresholds:
        return first
    misses = whole_periods(bernoulli.seen_ns, stamp_ns, table.period)
    again = (bernoulli.existence >= table.extract_known[bernoulli.label]) & (
        misses < table.extract_misses[bernoulli.label]
    )
    return np.where(bernoulli.extracted, again, first)


def seconds(nanoseconds: NDArray[np.int64]) -> Array:
    """Convert differences of stamps to seconds."""
    return np.asarray(nanoseconds * 1e-9, dtype=np.float64)


def tracks_of(bernoulli: Bernoullis, detection: NDArray[np.int64], stamp_ns: int, table: ClassTable) -> Tracks:
    """Read the tracks off the extracted Bernoullis; `detection` (N,) is what each was associated with."""
    mean = bernoulli.mean
    existence, score, covariance = calibrated(bernoulli, table)
    v, phi = mean[:, V], mean[:, PHI]
    return Tracks(
        id=bernoulli.id,
        label=bernoulli.label,
        center=np.column_stack((mean[:, :2], bernoulli.auxiliary[:, 3])),
        size=bernoulli.auxiliary[:, :3].copy(),
        yaw=phi.copy(),
        velocity=np.column_stack((v * np.cos(phi), v * np.sin(phi))),
        yaw_rate=mean[:, OMEGA].copy(),
        acceleration=mean[:, A].copy(),
        existence=existence,
        score=score,
        covariance=covariance,
        age=seconds(stamp_ns - bernoulli.born_ns),
        time_since_detection=seconds(stamp_ns - bernoulli.seen_ns),
        detection=detection,
    )

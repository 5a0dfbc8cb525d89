"""Calibration: covariances and existence probabilities of tracks against the truth.

Conventions: world frame, centres in the plane, metres. For a track that is matched to an object at an offset
e = (x, y) and whose position has the covariance P, the normalised estimation error squared is

    NEES = e' P^-1 e

For a consistent tracker it is chi-square distributed with 2 degrees of freedom: its mean is 2, and 95 % of the errors
lie in the 95 % ellipse, NEES <= 5.99. A larger mean says that the covariances are too small. The mean of N independent
values lies with 95 % in the band of the chi-square distribution with 2 N degrees of freedom, divided by N (Bar-Shalom
et al., 2001, section 5.4). Errors of one track in successive frames are not independent; the interval that follows the
band is the interval of the mean itself, with whole objects as its independent samples.

An existence probability is reliable when, of all tracks that are said to exist with about that probability, this share
are matched to an object. The table has one row for each tenth.

Matches are made in each frame on its own: most pairs up to 2 m apart, then the least total distance. Boxes that
`optipmb_tools.evaluation.cases.counted` ignores are ignored here too.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from optipmb_tools.datasets import Truth
from optipmb_tools.evaluation.cases import Rules, assign_frames, counted, most_pairs, prepare
from optipmb_tools.evaluation.figures import defined
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.results import FullTable, ResultTable

DECILES = 10

_DIMENSIONS = 2
_LEVEL = 0.95
NORMAL_95 = 1.959963984540054  # a standard normal variable is between minus and plus this with 95 %


@dataclass(frozen=True)
class Decile:
    """One row of the reliability table."""

    low: float
    high: float
    count: int  # track boxes that are said to exist with a probability from `low` to `high`
    predicted: float  # their mean probability; NaN where there are none
    observed: float  # share of these boxes that is matched to an object; NaN without any


@dataclass(frozen=True)
class CalibrationResult:
    """Samples of one class; results of several sequences add up."""

    nees: Floats  # (N,) of the matched track boxes
    owner: Ints  # (N,) which object each is of; objects of all sequences are numbered through
    error: Floats  # (N,) distance, metres
    spread: Floats  # (N,) distance to be expected, metres: the root of the trace of P
    existence: Floats  # (K,) probability of every track box that counts
    true: Bools  # (K,) whether it is matched

    def __add__(self, other: "CalibrationResult") -> "CalibrationResult":
        shifted = other.owner + (self.owner.max() + 1 if len(self.owner) else 0)
        columns = {name: np.concatenate([value, getattr(other, name)]) for name, value in vars(self).items()}
        return CalibrationResult(**{**columns, "owner": np.concatenate([self.owner, shifted])})

    @property
    def mean(self) -> float:
        """Average NEES; NaN without samples."""
        return float(self.nees.mean()) if len(self.nees) else float("nan")

    @property
    def band(self) -> tuple[float, float]:
        """Where the average NEES of a consistent tracker is with 95 %, if samples are independent."""
        count = len(self.nees)
        tail = 0.5 * (1.0 - _LEVEL)
        low, high = (2.0 * gammaincinv(0.5 * _DIMENSIONS * count, q) / max(count, 1) for q in (tail, 1.0 - tail))
        return (float(low), float(high)) if count else (float("nan"), float("nan"))

    @property
    def interval(self) -> tuple[float, float]:
        """Where the average NEES is known to be with 95 %, objects being independent; NaN with fewer than two."""
        count = len(np.unique(self.owner))
        if count <= 1:
            return float("nan"), float("nan")
        sums = np.bincount(self.owner, self.nees - self.mean)
        error = np.sqrt((sums**2).sum() * count / (count - 1)) / len(self.nees)
        return self.mean - NORMAL_95 * float(error), self.mean + NORMAL_95 * float(error)

    @property
    def coverage(self) -> float:
        """Share of the errors in the 95 % ellipse; NaN without samples."""
        limit = 2.0 * gammaincinv(0.5 * _DIMENSIONS, _LEVEL)
        return float((self.nees <= limit).mean()) if len(self.nees) else float("nan")

    @property
    def deciles(self) -> tuple[Decile, ...]:
        """The reliability table, from the lowest probability on."""
        place = np.minimum((self.existence * DECILES).astype(np.int64), DECILES - 1)
        count = np.bincount(place, minlength=DECILES)
        predicted = np.bincount(place, self.existence, DECILES)
        observed = np.bincount(place, self.true, DECILES)
        return tuple(
            Decile(
                low=i / DECILES,
                high=(i + 1) / DECILES,
                count=int(count[i]),
                predicted=float(predicted[i] / count[i]) if count[i] else float("nan"),
                observed=float(observed[i] / count[i]) if count[i] else float("nan"),
            )
            for i in range(DECILES)
        )

    def summary(self) -> dict[str, object]:
        """Return the figures by name; None where undefined."""
        return {
            "NEES": defined(self.mean),
            "band": [defined(value) for value in self.band],
            "interval": [defined(value) for value in self.interval],
            "coverage": defined(self.coverage),
            "error": defined(_root_mean_square(self.error)),
            "expected_error": defined(_root_mean_square(self.spread)),
            "samples": len(self.nees),
            "objects": len(np.unique(self.owner)),
            "existence": [
                {
                    "from": decile.low,
                    "to": decile.high,
                    "count": decile.count,
                    "predicted": defined(decile.predicted),
                    "observed": defined(decile.observed),
                }
                for decile in self.deciles
            ],
        }


def evaluate_calibration(
    parts: Iterable[tuple[Truth, ResultTable, FullTable]], name: str, rules: Rules
) -> CalibrationResult:
    """Return the figures of one class over all sequences.

    Each sequence has its truth, its tracks and all columns of the tracks, in the world frame; rules compare centres.

    Raises:
        DatasetError: the two kinds of tracks are not of one run.
    """
    none = np.empty(0)
    start = CalibrationResult(none, np.empty(0, np.int64), none, none, none, np.empty(0, np.bool_))
    return sum((calibration(truth, tracks, full, name, rules) for truth, tracks, full in parts), start)


@dataclass(frozen=True)
class Sample:
    """The tracks of one sequence that count, and the objects that they are of."""

    row: Ints  # (K,) in the tracks with all columns
    true: Bools  # (K,) whether the track is matched to an object
    offset: Floats  # (K, 2) offset of the track from its object, metres; NaN where it has none
    owner: Ints  # (K,) id of the object, -1 where it has none


def sample(truth: Truth, tracks: ResultTable, full: FullTable, name: str, rules: Rules) -> Sample:
    """Match the tracks of one class in one sequence; arguments and errors as for `evaluate_calibration`."""
    case = counted(prepare(truth, tracks, name, rules), rules)
    taken = assign_frames(case.pair_frame, case.truth_row, case.track_row, case.cost, most_pairs)
    truth_row, track_row = case.truth_row[taken], case.track_row[taken]
    known = rows_of(full.frame, full.id, case.track_frame, case.track_id)
    if (known < 0).any():
        raise DatasetError("the tracks with all columns", "the same tracks as in the result file", "others")
    place = rows_of(truth.frame, truth.id, case.truth_frame[truth_row], case.truth_id[truth_row])
    offset = np.full((len(known), 2), np.nan)
    offset[track_row] = full.center[known[track_row], :2] - truth.center[place, :2]
    owner = np.full(len(known), -1, dtype=np.int64)
    owner[track_row] = case.truth_id[truth_row]
    return Sample(known, owner >= 0, offset, owner)


def calibration(truth: Truth, tracks: ResultTable, full: FullTable, name: str, rules: Rules) -> CalibrationResult:
    """Return the figures of one class in one sequence; arguments as for `evaluate_calibration`."""
    found = sample(truth, tracks, full, name, rules)
    offset = found.offset[found.true]
    covariance = full.covariance[found.row[found.true], :2, :2]
    return CalibrationResult(
        nees=_nees(offset, covariance),
        owner=np.unique(found.owner[found.true], return_inverse=True)[1].astype(np.int64),
        error=np.asarray(np.linalg.norm(offset, axis=1), dtype=np.float64),
        spread=np.sqrt(np.trace(covariance, axis1=1, axis2=2)),
        existence=full.existence[found.row],
        true=found.true,
    )


def _nees(offset: Floats, covariance: Floats) -> Floats:
    """Return e' P^-1 e (N,) of e (N, 2) and P (N, 2, 2)."""
    if not len(offset):
        return np.empty(0)
    return np.asarray(np.einsum("ni,ni->n", offset, np.linalg.solve(covariance, offset[..., None])[..., 0]))


def rows_of(frame: Ints, identity: Ints, frames: Ints, identities: Ints) -> Ints:
    """Return the row of each wanted frame and id in a table, -1 where it has none."""
    place = {key: row for row, key in enumerate(zip(frame.tolist(), identity.tolist(), strict=True))}
    wanted = zip(frames.tolist(), identities.tolist(), strict=True)
    return np.array([place.get(key, -1) for key in wanted], dtype=np.int64)


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")

"""IDF1: how long objects keep one track (Ristani et al., 2016); and errors of velocities.

Conventions: world frame, metres, seconds. Every object of a sequence belongs to one track at most, and the other way
round, so that IDTP, the number of frames in which they are matched, is the greatest:

    IDF1 = 2 IDTP / (truth boxes + track boxes)

An object whose velocity the truth does not tell moves from the place before to the place after, a frame each.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optipmb_tools.datasets import Truth
from optipmb_tools.evaluation.calibration import rows_of
from optipmb_tools.evaluation.cases import Case, Rules, assign_frames, best_pairs, counted, most_pairs, prepare
from optipmb_tools.evaluation.figures import defined, ratio
from optipmb_tools.geometry import Floats, Ints
from optipmb_tools.results import ResultTable


@dataclass(frozen=True)
class IdentityResult:
    """Counts of boxes of one class; results of several sequences add up."""

    true: int = 0  # IDTP
    boxes: int = 0  # of truth and of tracks

    def __add__(self, other: "IdentityResult") -> "IdentityResult":
        return IdentityResult(self.true + other.true, self.boxes + other.boxes)

    def summary(self) -> dict[str, float | None]:
        """Return the figure by its usual name; None where undefined."""
        return {"IDF1": defined(ratio(2 * self.true, self.boxes))}


def evaluate_identity(cases: Iterable[Case], rules: Rules) -> IdentityResult:
    """Return the figures of one class over all sequences, from cases with all pairs that may match."""
    return sum((_identity(counted(case, rules)) for case in cases), IdentityResult())


def _identity(case: Case) -> IdentityResult:
    """Return the figures of one sequence in which everything counts."""
    pairs = np.column_stack((case.truth_id[case.truth_row], case.track_id[case.track_row]))
    found, frames = np.unique(pairs, axis=0, return_counts=True)
    taken = best_pairs(found[:, 0], found[:, 1], frames.astype(np.float64))
    return IdentityResult(int(frames[taken].sum()), len(case.truth_frame) + len(case.track_frame))


def velocity_errors(stamps: Ints, truth: Truth, tracks: ResultTable, name: str, rules: Rules) -> Floats:
    """Return the errors (N,), m/s, of the velocities of matched tracks of one class.

    Args:
        stamps: (F,) of the frames, ns.
        truth: Objects in the world frame.
        tracks: Tracks in the world frame; without velocities there are no errors.
        name: Of the class.
        rules: They compare centres.
    """
    if tracks.velocity is None:
        return np.empty(0)
    case = counted(prepare(truth, tracks, name, rules), rules)
    taken = assign_frames(case.pair_frame, case.truth_row, case.track_row, case.cost, most_pairs)
    truth_row, track_row = case.truth_row[taken], case.track_row[taken]
    own = rows_of(truth.frame, truth.id, case.truth_frame[truth_row], case.truth_id[truth_row])
    row = rows_of(tracks.frame, tracks.id, case.track_frame[track_row], case.track_id[track_row])
    error = np.linalg.norm(tracks.velocity[row] - _true_velocity(stamps, truth)[own], axis=1)
    return np.asarray(error[np.isfinite(error)], dtype=np.float64)


def _true_velocity(stamps: Ints, truth: Truth) -> Floats:
    """Return velocities (R, 2) of the truth; NaN where it has none, and no place a frame before and after."""
    before = rows_of(truth.frame, truth.id, truth.frame - 1, truth.id)
    after = rows_of(truth.frame, truth.id, truth.frame + 1, truth.id)
    seconds = (stamps[truth.frame[after]] - stamps[truth.frame[before]])[:, None] * 1e-9
    moved = truth.center[after, :2] - truth.center[before, :2]
    moving = np.where(((before >= 0) & (after >= 0))[:, None], moved / np.where(seconds > 0.0, seconds, np.nan), np.nan)
    return np.where(np.isnan(truth.velocity), moving, truth.velocity)

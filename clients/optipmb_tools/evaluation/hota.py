"""HOTA: higher order tracking accuracy (Luiten et al., 2020), for any similarity of truth and tracks.

Conventions: shares, not percent. A pair matches at a level alpha = 0.05, 0.10, ..., 0.95 when its similarity S reaches
alpha. With TP matched, FN missed and FP false boxes at a level, and for a matched pair c of a truth object and a track
the numbers of boxes TPA(c) in which the two are matched to each other, FNA(c) and FPA(c) in which the object and the
track are not,

    DetA = TP / (TP + FN + FP)          AssA = 1/TP sum over c of TPA(c) / (TPA(c) + FNA(c) + FPA(c))
    HOTA = sqrt(DetA AssA)              LocA = 1/TP sum over c of S(c)

at each level; the figures are means over the levels. In a frame, tracks and truth are matched so that the sum of A S is
the greatest, where A of an object and a track says how well their whole lives agree, before any matching:

    A = P / (G + K - P),    P = sum over frames of S / (sum of S with the object + sum of S with the track - S)

with G and K the numbers of boxes of the object and of the track. Over several sequences boxes are counted together.

The centre HOTA of the OptiPMB paper has S = max(0, 1 - d / 2 m) with d the distance of the centres in the plane.
KITTI's benchmark ranks by the HOTA of image boxes, with their intersection over union as S.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optipmb_tools.evaluation.cases import Case, Rules, assign_frames, best_pairs, counted, similarity
from optipmb_tools.evaluation.figures import defined
from optipmb_tools.geometry import Bools, Floats, Ints

ALPHAS: Floats = np.arange(0.05, 0.99, 0.05)  # (19,) levels

_EPSILON = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class HotaResult:
    """Sums of HOTA by level; results of several sequences add up."""

    true: Floats  # (19,) TP
    missed: Floats  # (19,) FN
    false: Floats  # (19,) FP
    association: Floats  # (19,) sum over TP of TPA / (TPA + FNA + FPA)
    location: Floats  # (19,) sum over TP of S

    def __add__(self, other: "HotaResult") -> "HotaResult":
        return HotaResult(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def deta(self) -> float:
        """Detection accuracy."""
        return _mean(self._deta)

    @property
    def assa(self) -> float:
        """Association accuracy; 0 at levels where nothing is matched."""
        return _mean(self._assa)

    @property
    def hota(self) -> float:
        """Higher order tracking accuracy."""
        return _mean(np.sqrt(self._deta * self._assa))

    @property
    def loca(self) -> float:
        """Localisation accuracy, over the levels where something is matched; NaN where there are none."""
        matched = self.true > 0
        return _mean(self.location[matched] / self.true[matched])

    @property
    def _deta(self) -> Floats:
        boxes = self.true + self.missed + self.false
        return np.where(self._any, self.true / np.maximum(boxes, 1.0), np.nan)

    @property
    def _assa(self) -> Floats:
        return np.where(self._any, self.association / np.maximum(self.true, 1.0), np.nan)

    @property
    def _any(self) -> Bools:
        return np.asarray(self.true + self.missed + self.false > 0, dtype=np.bool_)

    def summary(self) -> dict[str, float | None]:
        """Return the figures by their usual names; None where undefined."""
        figures = {"HOTA": self.hota, "DetA": self.deta, "AssA": self.assa, "LocA": self.loca}
        return {name: defined(value) for name, value in figures.items()}


NOTHING = HotaResult(*(np.zeros(len(ALPHAS)) for _ in range(5)))  # of a sequence without truth and without tracks


def evaluate_hota(cases: Iterable[Case], rules: Rules) -> HotaResult:
    """Return the figures of one class over all sequences, from cases with all pairs that are similar at all."""
    return sum((_hota(part, similarity(part, rules)) for part in (counted(case, rules) for case in cases)), NOTHING)


def _hota(case: Case, alike: Floats) -> HotaResult:
    """Return the figures of one sequence in which everything counts, with the similarity (P,) of its pairs."""
    pairs = np.flatnonzero(alike > 0.0)
    truth, track, alike = case.truth_row[pairs], case.track_row[pairs], alike[pairs]
    lives = _Lives(case, truth, track)
    taken = assign_frames(case.truth_frame[truth], truth, track, lives.agreement(case, truth, track, alike), best_pairs)
    matched = alike[taken][:, None] >= ALPHAS - _EPSILON  # (M, 19)
    true = matched.sum(axis=0).astype(np.float64)
    return HotaResult(
        true=true,
        missed=len(case.truth_frame) - true,
        false=len(case.track_frame) - true,
        association=lives.association(taken, matched),
        location=(alike[taken][:, None] * matched).sum(axis=0),
    )


class _Lives:
    """The pairs of objects and tracks that some pair of boxes is of, and how long those live."""

    def __init__(self, case: Case, truth: Ints, track: Ints) -> None:
        _, object_of, boxes = np.unique(case.truth_id, return_inverse=True, return_counts=True)
        _, track_of, others = np.unique(case.track_id, return_inverse=True, return_counts=True)
        key = object_of[truth] * (len(others) + 1) + track_of[track]
        _, first, self._pair = np.unique(key, return_index=True, return_inverse=True)
        self._boxes = (boxes[object_of[truth]] + others[track_of[track]])[first]  # (L,) G + K

    def agreement(self, case: Case, truth: Ints, track: Ints, alike: Floats) -> Floats:
        """Return A S (P,) of the pairs of boxes."""
        at_truth = np.bincount(truth, alike, len(case.truth_frame))
        at_track = np.bincount(track, alike, len(case.track_frame))
        possible = np.bincount(self._pair, alike / (at_truth[truth] + at_track[track] - alike), len(self._boxes))
        return np.asarray((possible / (self._boxes - possible))[self._pair] * alike, dtype=np.float64)

    def association(self, taken: Ints, matched: Bools) -> Floats:
        """Return the sum over matches (M, 19), of the pairs taken (M,), of TPA / (TPA + FNA + FPA), by level (19,)."""
        if not len(taken):
            return np.zeros(len(ALPHAS))
        count = np.stack([np.bincount(self._pair[taken], level, len(self._boxes)) for level in matched.T], axis=1)
        return np.asarray((count * count / (self._boxes[:, None] - count)).sum(axis=0), dtype=np.float64)


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")

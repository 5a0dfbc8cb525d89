"""CLEAR MOT: misses, false tracks and changes of identity (Bernardin and Stiefelhagen, 2008).

Conventions: counts are of boxes, that is of objects in frames. With GT truth boxes that are not ignored,

    MOTA = 1 - (FN + FP + IDS) / GT

MOTP is the mean of the measure over the true positives: the intersection over union, or the distance in metres. A
figure that would be a quotient by zero is NaN. MT and ML count the truth objects followed in more than 80 % and in less
than 20 % of their frames; FRAG counts how often following one goes on after a break.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from optipmb_tools.evaluation.cases import Case, Rules, lives, match_frames, track_changes
from optipmb_tools.evaluation.figures import defined, ratio

_MOSTLY = 0.8
_HARDLY = 0.2


class Switch(NamedTuple):
    """A change of the track that follows a truth object."""

    sequence: str
    frame: int
    truth: int  # id of the object
    old: int  # id of the track until then
    new: int  # id of the track from this frame on


class Miss(NamedTuple):
    """A truth box that no track matched."""

    sequence: str
    frame: int
    truth: int  # id of the object


@dataclass(frozen=True)
class Counts:
    """Counts of boxes and objects of one class; results of several sequences add up."""

    truth: int = 0  # truth boxes that count (GT)
    true: int = 0  # matched ones (TP)
    false: int = 0  # track boxes that match nothing (FP)
    missed: int = 0  # truth boxes that count and that nothing matches (FN)
    switches: int = 0  # changes of identity (IDS)
    fragments: int = 0  # FRAG
    objects: int = 0  # truth objects of which at least one box counts
    mostly_tracked: int = 0
    mostly_lost: int = 0
    similarity: float = 0.0  # sum of the measure over the matched boxes

    def __add__(self, other: Self) -> Self:
        return type(self)(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def errors(self) -> int:
        """FP + FN + IDS."""
        return self.false + self.missed + self.switches

    @property
    def mota(self) -> float:
        """Multiple object tracking accuracy, at most 1."""
        return 1.0 - ratio(self.errors, self.truth)

    @property
    def motp(self) -> float:
        """Multiple object tracking precision: the mean measure of matched boxes."""
        return ratio(self.similarity, self.true)

    @property
    def precision(self) -> float:
        """Share of true ones among the track boxes that count."""
        return ratio(self.true, self.true + self.false)

    @property
    def recall(self) -> float:
        """Share of matched ones among the truth boxes."""
        return ratio(self.true, self.true + self.missed)

    def figures(self) -> dict[str, float]:
        """Return the figures of boxes by their usual names."""
        return {
            "MOTA": self.mota,
            "MOTP": self.motp,
            "precision": self.precision,
            "recall": self.recall,
            "GT": self.truth,
            "TP": self.true,
            "FP": self.false,
            "FN": self.missed,
            "IDS": self.switches,
            "FRAG": self.fragments,
        }


@dataclass(frozen=True)
class ClearResult(Counts):
    """CLEAR figures of one class; results of several sequences add up."""

    changes: tuple[Switch, ...] = ()  # of identity, in order of sequences and frames
    misses: tuple[Miss, ...] = ()

    def summary(self) -> dict[str, float | None]:
        """Return the figures by their usual names; None where undefined."""
        objects = {"MT": self.mostly_tracked, "ML": self.mostly_lost, "objects": self.objects}
        return {name: defined(value) for name, value in {**self.figures(), **objects}.items()}


def clear(case: Case, rules: Rules) -> ClearResult:
    """Return the CLEAR figures of a prepared case."""
    match = match_frames(case, continuity="latest" if rules.continuity else None)
    counts, hit = ~case.ignored, match >= 0
    used = np.zeros(len(case.track_frame), dtype=np.bool_)
    used[match[hit]] = True
    followed = lives(case.truth_id[counts], case.truth_frame[counts], hit[counts])
    new, old = track_changes(case, match, counts, memory=rules.memory)
    columns = (case.truth_frame[new], case.truth_id[new], case.track_id[match[old]], case.track_id[match[new]])
    changes = (Switch(case.sequence, *row) for row in zip(*(one.tolist() for one in columns), strict=True))
    missed = np.flatnonzero(counts & ~hit)
    return ClearResult(
        truth=int(counts.sum()),
        true=int((counts & hit).sum()),
        false=int((~used & ~case.excused).sum()),
        missed=len(missed),
        switches=len(new),
        fragments=followed.breaks,
        objects=len(followed.share),
        mostly_tracked=int((followed.share > _MOSTLY).sum()),
        mostly_lost=int((followed.share < _HARDLY).sum()),
        similarity=float(case.similarity[case.matched(match) & counts[case.truth_row]].sum()),
        changes=tuple(sorted(changes)),
        misses=tuple(Miss(case.sequence, int(case.truth_frame[i]), int(case.truth_id[i])) for i in missed),
    )


def combine(results: Iterable[ClearResult]) -> ClearResult:
    """Return the figures of several sequences together."""
    return sum(results, ClearResult())


@dataclass(frozen=True)
class Sweep:
    """CLEAR figures over thresholds on the mean score of a track."""

    thresholds: tuple[float, ...]
    results: tuple[ClearResult, ...]

    @property
    def best(self) -> int:
        """Index of the threshold with the highest MOTA, the lowest threshold of equals."""
        mota = np.array([result.mota for result in self.results])
        return int(np.argmax(np.nan_to_num(mota, nan=-np.inf)))


def sweep(cases: list[Case], rules: Rules, steps: int = 40) -> Sweep:
    """Return the figures of all cases together when only tracks with a mean score from a threshold on are kept.

    The thresholds are the lowest mean score, which keeps all, and `steps - 1` further quantiles of the mean scores.
    """
    means = [case.mean_scores() for case in cases]
    scores = np.concatenate([np.unique(mean) for mean in means]) if means else np.empty(0)
    # A threshold is a score, not a value between two, so that a track at its own threshold is kept.
    levels = np.quantile(scores, np.arange(steps) / steps, method="higher") if len(scores) else np.zeros(1)
    thresholds = np.unique(levels)
    results = tuple(
        combine(clear(case.keep(mean >= level), rules) for case, mean in zip(cases, means, strict=True))
        for level in thresholds
    )
    return Sweep(tuple(thresholds.tolist()), results)

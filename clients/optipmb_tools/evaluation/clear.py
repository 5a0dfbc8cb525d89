"""CLEAR MOT: misses, false tracks and changes of identity (Bernardin and Stiefelhagen, 2008).

Conventions: counts are of boxes, that is of objects in frames. With GT truth boxes that are not ignored,

    MOTA = 1 - (FN + FP + IDS) / GT

MOTP is the mean of the measure over the true positives: the intersection over union, or the distance in metres. A
figure that would be a quotient by zero is NaN. MT and ML count the truth objects followed in more than 80 % and in less
than 20 % of their frames; FRAG counts how often following one goes on after a break.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optipmb_tools.datasets import Truth
from optipmb_tools.evaluation.cases import Case, Rules, by_frame, most_pairs, prepare, uncontested
from optipmb_tools.evaluation.figures import defined
from optipmb_tools.geometry import Bools, Ints
from optipmb_tools.results import ResultTable

_MOSTLY = 0.8
_HARDLY = 0.2


class Switch(NamedTuple):
    """A change of the track that follows a truth object."""

    sequence: str
    frame: int
    truth: int
    """Id of the object."""
    old: int
    """Id of the track until then."""
    new: int
    """Id of the track from this frame on."""


class Miss(NamedTuple):
    """A truth box that no track matched."""

    sequence: str
    frame: int
    truth: int
    """Id of the object."""


@dataclass(frozen=True)
class ClearResult:
    """CLEAR figures of one class; those of several sequences add up."""

    truth: int = 0
    """Truth boxes that count (GT)."""
    true: int = 0
    """Matched ones (TP)."""
    false: int = 0
    """Track boxes that match nothing (FP)."""
    fragments: int = 0
    """FRAG"""
    objects: int = 0
    """Truth objects of which at least one box counts."""
    mostly_tracked: int = 0
    mostly_lost: int = 0
    similarity: float = 0.0
    """Sum of the measure over the matched boxes."""
    switches: tuple[Switch, ...] = ()
    misses: tuple[Miss, ...] = ()

    def __add__(self, other: "ClearResult") -> "ClearResult":
        return ClearResult(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def missed(self) -> int:
        """Truth boxes that count and that nothing matches (FN)."""
        return self.truth - self.true

    @property
    def mota(self) -> float:
        """Multiple object tracking accuracy, at most 1."""
        return 1.0 - _ratio(self.missed + self.false + len(self.switches), self.truth)

    @property
    def motp(self) -> float:
        """Multiple object tracking precision: the mean measure of matched boxes."""
        return _ratio(self.similarity, self.true)

    @property
    def precision(self) -> float:
        """Share of true ones among the track boxes that count."""
        return _ratio(self.true, self.true + self.false)

    @property
    def recall(self) -> float:
        """Share of found ones among the truth boxes that count."""
        return _ratio(self.true, self.truth)

    def summary(self) -> dict[str, float | int | None]:
        """Return the figures by their usual names; None for those that are not defined."""
        figures = {
            "MOTA": self.mota,
            "MOTP": self.motp,
            "precision": self.precision,
            "recall": self.recall,
            "GT": self.truth,
            "TP": self.true,
            "FP": self.false,
            "FN": self.missed,
            "IDS": len(self.switches),
            "FRAG": self.fragments,
            "MT": self.mostly_tracked,
            "ML": self.mostly_lost,
            "objects": self.objects,
        }
        return {name: defined(value) for name, value in figures.items()}


def evaluate_clear(
    truth: Truth, tracks: ResultTable, name: str, rules: Rules | None = None, *, sequence: str = ""
) -> ClearResult:
    """Return the CLEAR figures of one class in one sequence.

    Args:
        truth: annotations.
        tracks: results in the same frame of reference.
        name: the class.
        rules: how to compare; by default boxes that overlap by a quarter match.
        sequence: name of the sequence, for the lists of switches and misses.

    """
    rules = rules or Rules()
    return clear(prepare(truth, tracks, name, rules, sequence), rules)


def clear(case: Case, rules: Rules) -> ClearResult:
    """Return the CLEAR figures of a prepared case."""
    match, similarity = match_frames(case, rules)
    counts = ~case.ignored
    hit = match >= 0
    used = np.zeros(len(case.track_frame), dtype=np.bool_)
    used[match[hit]] = True
    switches: list[Switch] = []
    fragments = objects = mostly = hardly = 0
    for rows in by_frame(case.truth_id, np.arange(len(case.truth_id))):
        if not counts[rows].any():
            continue
        objects += 1
        share = hit[rows][counts[rows]].mean()
        mostly += int(share > _MOSTLY)
        hardly += int(share < _HARDLY)
        switches += _switches(case, rows, match, rules)
        fragments += _fragments(hit[rows][counts[rows]])
    missed = np.flatnonzero(counts & ~hit)
    return ClearResult(
        truth=int(counts.sum()),
        true=int((counts & hit).sum()),
        false=int((~used & ~case.excused).sum()),
        fragments=fragments,
        objects=objects,
        mostly_tracked=mostly,
        mostly_lost=hardly,
        similarity=float(similarity[counts & hit].sum()),
        switches=tuple(sorted(switches)),
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


def match_frames(case: Case, rules: Rules) -> tuple[Ints, np.ndarray]:
    """Return the track row (T,) that each truth row matches, -1 for none, and the measure (T,) of the match.

    In each frame the matches of most pairs with the least total cost are taken; with continuity, pairs that matched
    before and still may are taken first. Of several objects that were with one track, the one that was last keeps it.
    """
    match = np.full(len(case.truth_frame), -1, dtype=np.int64)
    similarity = np.full(len(case.truth_frame), np.nan)
    alone = uncontested(case.truth_row, case.track_row)
    match[case.truth_row[alone]] = case.track_row[alone]
    similarity[case.truth_row[alone]] = case.similarity[alone]
    contested = np.flatnonzero(~alone)
    earlier = _earlier_rows(case) if rules.continuity and len(contested) else np.empty(0, dtype=np.int64)
    for pairs in by_frame(case.pair_frame, contested):
        truth, track = case.truth_row[pairs], case.track_row[pairs]
        chosen = _kept(case, pairs, match, earlier) if rules.continuity else np.zeros(len(pairs), dtype=np.bool_)
        free = ~np.isin(truth, truth[chosen]) & ~np.isin(track, track[chosen])
        if free.any():
            chosen[np.flatnonzero(free)[most_pairs(truth[free], track[free], case.cost[pairs][free])]] = True
        match[truth[chosen]] = track[chosen]
        similarity[truth[chosen]] = case.similarity[pairs][chosen]
    return match, similarity


def _kept(case: Case, pairs: Ints, match: Ints, earlier: Ints) -> Bools:
    """Return which pairs of one frame are of an object and the track that it matched last."""
    kept = np.zeros(len(pairs), dtype=np.bool_)
    since: dict[int, tuple[int, int]] = {}
    for place, (truth, track) in enumerate(
        zip(case.truth_row[pairs].tolist(), case.track_row[pairs].tolist(), strict=True)
    ):
        row = int(earlier[truth])
        while row >= 0 and match[row] < 0:
            row = int(earlier[row])
        if row >= 0 and case.track_id[match[row]] == case.track_id[track]:
            frame = int(case.truth_frame[row])
            if track not in since or frame > since[track][0]:
                since[track] = frame, place
    kept[[place for _, place in since.values()]] = True
    return kept


def _earlier_rows(case: Case) -> Ints:
    """Return for each truth row (T,) the row of the same object before it, -1 for the first."""
    order = np.lexsort((case.truth_frame, case.truth_id))
    earlier = np.full(len(order), -1, dtype=np.int64)
    same = case.truth_id[order[1:]] == case.truth_id[order[:-1]]
    earlier[order[1:][same]] = order[:-1][same]
    return earlier


def _switches(case: Case, rows: Ints, match: Ints, rules: Rules) -> list[Switch]:
    """Return the changes of track on one object's rows, in order of frames."""
    found: list[Switch] = []
    old: int | None = None
    for row in rows:
        if case.ignored[row] or match[row] < 0:
            old = old if rules.memory else None
            continue
        new = int(case.track_id[match[row]])
        if old not in (None, new):
            found.append(Switch(case.sequence, int(case.truth_frame[row]), int(case.truth_id[row]), old, new))
        old = new
    return found


def _fragments(hit: Bools) -> int:
    """Return how often following goes on after a break."""
    first = np.flatnonzero(hit)
    if not len(first):
        return 0
    return int(np.sum(np.diff(hit[first[0] :].astype(np.int64)) == 1))


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")

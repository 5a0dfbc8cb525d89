"""KITTI 3D tracking by the protocol of AB3DMOT (Weng et al., 2020, arXiv 2008.08063).

Conventions: shares, not percent. Tracks are ranked by the mean of their scores. With GT truth boxes that count and
L = 40 recall points r = 1/L, 2/L, ..., 1, each at the score threshold where the share of truth boxes that are found is
nearest to r,

    MOTA_r  = 1 - (FP_r + FN_r + IDS_r) / GT
    sMOTA_r = min(1, max(0, 1 - (FP_r + FN_r + IDS_r - (1 - r) GT) / (r GT)))
    MOTP_r  = mean 3D intersection over union of the matched boxes

and sAMOTA, AMOTA and AMOTP are the sums of sMOTA_r, MOTA_r and MOTP_r over the points that are reached, divided by L: a
recall point that is missing counts zero. The single figures are those at the threshold with the highest MOTA.

Where the paper leaves a choice, its published evaluation decides, so that figures can be compared:

- Each frame is matched on its own: most pairs, then the greatest total overlap.
- Truth boxes that are largely invisible, cut by the image's border, or vans (for cars) do not count, whether they are
  found or not; but boxes that match them do count in MOTP, TP, precision, recall and in the recall points.
- Unmatched tracks at most 25 pixels high, or with more than half of their image box in a DontCare region, do not count.
- The track of an object changes only between two frames that follow each other in the object's life; both FRAG and the
  share of an object's life that is followed treat the first and the last frame of the life in a way of their own.
- AMOTA sums MOTA_r as it is, negative too. Among equal values of MOTA the highest threshold is the best one, and if no
  threshold has a MOTA above zero, all tracks are kept.

Two accidents of the published code are not repeated. There a track exactly at a threshold is kept or not as its mean
score is rounded, and a box that was matched at one threshold cannot be excused at another. Either may change a count by
one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optipmb_tools.evaluation.cases import Case, by_frame, most_pairs, uncontested
from optipmb_tools.evaluation.clear import Counts
from optipmb_tools.evaluation.figures import defined, ratio
from optipmb_tools.geometry import Floats, Ints

IOU_LIMITS = (0.25, 0.5, 0.7)  # 3D intersections over union at which figures are usually given
POINTS = 40  # recall points (L)

_MOSTLY = 0.8
_HARDLY = 0.2


@dataclass(frozen=True)
class Point:
    """The counts at one recall point."""

    recall: float  # r
    threshold: float
    counts: Counts  # TP has the matched boxes of truth that does not count, too

    @property
    def smota(self) -> float:
        """MOTA scaled to its largest value at the recall, in [0, 1]; NaN where no truth counts."""
        counts, recall = self.counts, self.recall
        scaled = 1.0 - ratio(counts.errors - (1.0 - recall) * counts.truth, recall * counts.truth)
        return float(np.clip(scaled, 0.0, 1.0))


@dataclass(frozen=True)
class Ab3dmotResult:
    """Figures of one class over all sequences, at one least overlap."""

    limit: float  # least 3D intersection over union of a match
    points: tuple[Point, ...]  # the recall points that are reached, in ascending order of recall; at most 40
    threshold: float  # lowest mean score of the tracks that are kept for the highest MOTA; minus infinity keeps all
    best: Counts  # at that threshold

    @property
    def samota(self) -> float:
        """Average of sMOTA_r over 40 recall points."""
        return self._average([point.smota for point in self.points])

    @property
    def amota(self) -> float:
        """Average of MOTA_r over 40 recall points."""
        return self._average([point.counts.mota for point in self.points])

    @property
    def amotp(self) -> float:
        """Average of MOTP_r over 40 recall points."""
        return self._average([_overlap(point.counts) for point in self.points])

    def _average(self, values: list[float]) -> float:
        return sum(values) / POINTS if self.best.truth else float("nan")

    def summary(self) -> dict[str, float | int | None]:
        """Return the figures by their usual names; None where undefined."""
        best = self.best
        figures = {
            "sAMOTA": self.samota,
            "AMOTA": self.amota,
            "AMOTP": self.amotp,
            "points": len(self.points),
            "score": self.threshold,
            **best.figures(),
            "MOTP": _overlap(best),
            "MT": ratio(best.mostly_tracked, best.objects),
            "ML": ratio(best.mostly_lost, best.objects),
        }
        return {name: defined(value) for name, value in figures.items()}


def evaluate_ab3dmot(cases: Sequence[Case], limit: float = IOU_LIMITS[0]) -> Ab3dmotResult:
    """Return the figures of one class.

    Args:
        cases: the class in each sequence, by `cases.ab3dmot_rules` with at most this limit.
        limit: least 3D intersection over union of a match.
    """
    sequences = [_Sequence(case.pairs(case.similarity >= limit)) for case in cases]
    matches = [sequence.match(-np.inf) for sequence in sequences]
    counts = (sequence.counts(-np.inf, match) for sequence, match in zip(sequences, matches, strict=True))
    everything = sum(counts, Counts())
    scores = [sequence.means[match[match >= 0]] for sequence, match in zip(sequences, matches, strict=True)]
    points = tuple(
        Point(recall, threshold, sum((sequence.counts(threshold) for sequence in sequences), Counts()))
        for threshold, recall in recall_points(
            np.concatenate([np.empty(0), *scores]), everything.true + everything.missed
        )
    )
    good = [point for point in points if point.counts.mota > 0.0]
    if not good:
        return Ab3dmotResult(limit, points, -np.inf, everything)
    best = max(good, key=lambda point: point.counts.mota)  # the first of equals
    return Ab3dmotResult(limit, points, best.threshold, best.counts)


def recall_points(scores: Floats, count: int) -> list[tuple[float, float]]:
    """Return the thresholds and the recalls of the points that are reached.

    From the highest on, each score adds 1 / count to the recall; a point is set at the first score that is not farther
    from it than the next score is, and the last score sets one in any case.

    Args:
        scores: (S,) mean scores of the tracks of all matched boxes.
        count: number of truth boxes, found or not.
    """
    found: list[tuple[float, float]] = []
    recall = 0.0
    ordered = np.sort(scores)[::-1].tolist()
    for place, score in enumerate(ordered, start=1):
        here, following = place / count, (place + 1) / count
        if place < len(ordered) and following - recall < recall - here:
            continue
        found.append((score, recall))
        recall += 1.0 / POINTS
    return found[1:]  # the first one is at recall 0


class _Sequence:
    """One sequence, prepared so that counting at a threshold costs little."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.means = case.mean_scores()
        self._track = np.unique(case.track_id, return_inverse=True)[1]
        alone = uncontested(case.truth_row, case.track_row)
        self._alone = np.flatnonzero(alone)
        self._contests = [
            _Contest(case, pairs, self.means[case.track_row[pairs]])
            for pairs in by_frame(case.pair_frame, np.flatnonzero(~alone))
        ]
        # Truth rows in the order of objects, and of frames in each object.
        self._order = np.lexsort((case.truth_frame, case.truth_id))
        identity = case.truth_id[self._order]
        self._first = np.append(True, identity[1:] != identity[:-1])[: len(identity)]
        self._last = np.append(self._first[1:], True)[: len(identity)]
        self._object = np.cumsum(self._first) - 1
        self._ignored = case.ignored[self._order]
        self._life = np.bincount(self._object, ~self._ignored) if len(identity) else np.empty(0)

    def match(self, threshold: float) -> Ints:
        """Return the track row (T,) that each truth row matches, -1 for none, with tracks from a mean score on."""
        case = self.case
        match = np.full(len(case.truth_frame), -1, dtype=np.int64)
        kept = [self._alone[self.means[case.track_row[self._alone]] >= threshold]]
        kept += [contest.solve(threshold) for contest in self._contests]
        pairs = np.concatenate(kept)
        match[case.truth_row[pairs]] = case.track_row[pairs]
        return match

    def counts(self, threshold: float, match: Ints | None = None) -> Counts:
        """Return the counts with the tracks from a mean score on."""
        case = self.case
        match = self.match(threshold) if match is None else match
        hit = match >= 0
        unused = self.means >= threshold
        unused[match[hit]] = False
        return Counts(
            truth=int((~case.ignored).sum()),
            true=int(hit.sum()),
            false=int((unused & ~case.excused).sum()),
            missed=int((~hit & ~case.ignored).sum()),
            similarity=float(case.similarity[case.matched(match)].sum()),
            **self._lives(match),
        )

    def _lives(self, match: Ints) -> dict[str, int]:
        """Return the counts along the lives of objects."""
        match = match[self._order]
        track = np.where(match >= 0, np.append(self._track, -1)[match], -1)
        first, last, ignored = self._first, self._last, self._ignored
        found = track != -1
        before = np.append(-1, track[:-1])[: len(track)]
        after = np.append(track[1:], -1)[: len(track)]
        # The track followed until now: none after a frame that does not count, except that the first frame always does.
        known = np.where(ignored & ~first, -1, track)
        settled = first | ignored | found
        latest = np.maximum.accumulate(np.where(settled, np.arange(len(track)), 0))
        followed = np.append(-1, known[latest][:-1])[: len(track)]
        going_on = ~first & ~ignored & found
        changed = going_on & (followed != -1) & (before != -1) & (followed != track)
        resumed = going_on & (before != track) & np.where(last, True, (followed != -1) & (after != -1))
        tracked = np.bincount(self._object, found & (first | ~ignored), minlength=len(self._life))
        share = tracked[self._life > 0] / self._life[self._life > 0]
        return {
            "switches": int(changed.sum()),
            "fragments": int(resumed.sum()),
            "objects": len(share),
            "mostly_tracked": int((share > _MOSTLY).sum()),
            "mostly_lost": int((share < _HARDLY).sum()),
        }


class _Contest:
    """The contested pairs of one frame; solved once for every set of tracks that thresholds leave."""

    def __init__(self, case: Case, pairs: Ints, means: Floats) -> None:
        order = np.argsort(-means, kind="stable")
        self._pairs = pairs[order]
        self._means = means[order]
        self._case = case
        self._solved: dict[int, Ints] = {}

    def solve(self, threshold: float) -> Ints:
        """Return the pairs that are taken of those whose tracks have a mean score from a threshold on."""
        count = int(np.searchsorted(-self._means, -threshold, "right"))
        if count not in self._solved:
            pairs = self._pairs[:count]
            case = self._case
            taken = most_pairs(case.truth_row[pairs], case.track_row[pairs], case.cost[pairs]) if count else pairs
            self._solved[count] = pairs[taken]
        return self._solved[count]


def _overlap(counts: Counts) -> float:
    """Return the mean overlap of the matched boxes, 0 where there are none."""
    return counts.motp if counts.true else 0.0

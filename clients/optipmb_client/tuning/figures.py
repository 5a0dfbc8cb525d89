"""Figures of one class from tracks in memory, fast enough to be asked for thousands of times.

Conventions: a case is what `optipmb_client.evaluation.prepare` makes of one sequence; cases are joined into one before
counting, so every figure is over all their sequences together. Scores of tracks are the mean scores of whole tracks.

    sMOTA(r) = min(1, max(0, 1 - (FP + FN + IDS - (1 - r) GT) / (r GT)))

sAMOTA and AMOTA are the means of sMOTA and MOTA over forty recalls r, AMOTP that of MOTP; recalls that are not reached
count zero (Weng et al., AB3DMOT, 2020). MOTA and the counts are those at the threshold of these with the highest MOTA.
HOTA (Luiten et al., 2020) is of the same tracks, with the similarity max(0, 1 - d / 2 m) of centres in the plane.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optipmb_client.evaluation import Case, Rules
from optipmb_client.geometry import Bools, Floats, Ints
from optipmb_client.tuning.kernels import match, match_similar, switches

__all__ = ["Counts", "Figures", "Joined", "count", "figures", "hota", "join", "recall_thresholds"]

RECALLS = 40
HOTA_DISTANCE = 2.0
_ALPHAS = np.arange(0.05, 0.99, 0.05)


@dataclass(frozen=True)
class Joined:
    """The cases of several sequences as one."""

    truth_id: Ints
    """(T,) from 0 on"""
    ignored: Bools
    """(T,)"""
    order: Ints
    """(T,) rows by object, then by frame"""
    track_id: Ints
    """(K,) from 0 on"""
    excused: Bools
    """(K,)"""
    mean: Floats
    """(K,) mean score of the track"""
    truth_row: Ints
    """(P,) ascending"""
    track_row: Ints
    """(P,)"""
    cost: Floats
    """(P,)"""
    similarity: Floats
    """(P,)"""
    bounds: Ints
    """(G + 1,) where the pairs of a frame begin"""

    @property
    def truth(self) -> int:
        """Truth boxes that count."""
        return int((~self.ignored).sum())


def join(cases: Sequence[Case]) -> Joined:
    """Return several cases as one; they keep their order."""
    truth_id, track_id, truth_row, track_row, group = [], [], [], [], []
    objects = tracks = rows = found = frames = 0
    for case in cases:
        names, identity = np.unique(case.truth_id, return_inverse=True)
        truth_id.append(identity.astype(np.int64) + objects)
        objects += len(names)
        names, identity = np.unique(case.track_id, return_inverse=True)
        track_id.append(identity.astype(np.int64) + tracks)
        tracks += len(names)
        truth_row.append(case.truth_row + rows)
        track_row.append(case.track_row + found)
        group.append(case.truth_frame[case.truth_row] + frames)
        rows += len(case.truth_id)
        found += len(case.track_id)
        frames += 1 + int(max(case.truth_frame.max(initial=0), case.track_frame.max(initial=0)))
    joined, pairs = np.concatenate(truth_row), np.concatenate(group)
    order = np.argsort(joined, kind="stable")
    identity = np.concatenate(truth_id)
    starts = np.flatnonzero(np.diff(pairs[order], prepend=-1))
    return Joined(
        truth_id=identity,
        ignored=np.concatenate([case.ignored for case in cases]),
        order=np.argsort(identity, kind="stable"),
        track_id=np.concatenate(track_id),
        excused=np.concatenate([case.excused for case in cases]),
        mean=np.concatenate([case.mean_scores() for case in cases]),
        truth_row=joined[order],
        track_row=np.concatenate(track_row)[order],
        cost=np.concatenate([case.cost for case in cases])[order],
        similarity=np.concatenate([case.similarity for case in cases])[order],
        bounds=np.append(starts, len(order)).astype(np.int64),
    )


@dataclass(frozen=True)
class Counts:
    """What matching gives for the tracks from a threshold on."""

    threshold: float
    truth: int
    true: int
    false: int
    switches: int
    similarity: float
    """Sum over the true ones."""

    @property
    def missed(self) -> int:
        """Truth boxes that nothing matches."""
        return self.truth - self.true

    @property
    def errors(self) -> int:
        """FP + FN + IDS."""
        return self.false + self.missed + self.switches

    @property
    def mota(self) -> float:
        """MOTA; NaN without truth."""
        return 1.0 - self.errors / self.truth if self.truth else math.nan

    @property
    def motp(self) -> float:
        """MOTP; NaN without matches."""
        return self.similarity / self.true if self.true else math.nan


def count(case: Joined, rules: Rules, threshold: float = -math.inf) -> tuple[Counts, Ints]:
    """Return the counts for the tracks with a mean score from `threshold` on, and the pair (T,) of each truth row."""
    kept = case.mean >= threshold
    pair = match(
        case.truth_row,
        case.track_row,
        case.cost,
        case.bounds,
        case.truth_id,
        case.track_id,
        kept,
        rules.continuity,
    )
    hit = pair >= 0
    used = case.track_row[pair[hit]]
    follower = np.full(len(pair), -1, dtype=np.int64)
    follower[hit] = case.track_id[used]
    free = kept & ~case.excused
    free[used] = False
    counted = pair[hit & ~case.ignored]
    return (
        Counts(
            threshold=threshold,
            truth=case.truth,
            true=len(counted),
            false=int(free.sum()),
            switches=int(switches(case.order, case.truth_id, case.ignored, follower, rules.memory)),
            similarity=float(case.similarity[counted].sum()),
        ),
        pair,
    )


def recall_thresholds(scores: Floats, truth: int, steps: int = RECALLS) -> list[tuple[float, float]]:
    """Return (threshold, recall) of the scores of true positives at which the recalls 1/steps .. 1 are reached best.

    Scores are walked through from the highest; each recall takes the score whose own recall is nearest. There are fewer
    than `steps` where the highest recalls are not reached.
    """
    ordered = np.sort(scores)[::-1]
    wanted, found = 0.0, []
    for i, score in enumerate(ordered.tolist()):
        here = (i + 1) / truth
        after = (i + 2) / truth if i < len(ordered) - 1 else here
        if after - wanted < wanted - here and i < len(ordered) - 1:
            continue
        found.append((score, wanted))
        wanted += 1.0 / steps
    return found[1:]


@dataclass(frozen=True)
class Figures:
    """Figures of one class."""

    samota: float
    amota: float
    amotp: float
    best: Counts
    """At the threshold with the highest MOTA."""
    hota: float
    deta: float
    assa: float

    @property
    def mota(self) -> float:
        """MOTA at the best threshold."""
        return self.best.mota

    @property
    def motp(self) -> float:
        """MOTP at the best threshold."""
        return self.best.motp

    def to_json(self) -> dict[str, float | int | None]:
        """Return the figures by their usual names; None for those that are not defined."""
        values = {
            "sAMOTA": self.samota,
            "AMOTA": self.amota,
            "AMOTP": self.amotp,
            "MOTA": self.mota,
            "MOTP": self.motp,
            "HOTA": self.hota,
            "DetA": self.deta,
            "AssA": self.assa,
            "IDS": self.best.switches,
            "FP": self.best.false,
            "FN": self.best.missed,
            "GT": self.best.truth,
            "threshold": self.best.threshold,
        }
        return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}


def figures(case: Joined, rules: Rules, near: Joined | None = None) -> Figures:
    """Return the figures of a joined case.

    Args:
        case: truth and tracks with the pairs that may match by the rules.
        rules: of the case.
        near: the same truth and tracks with the pairs of centres within two metres, for HOTA; without it HOTA is NaN.

    """
    everything, pair = count(case, rules)
    hit = pair >= 0
    scores = case.mean[case.track_row[pair[hit & ~case.ignored]]]
    points = recall_thresholds(scores, case.truth) if case.truth else []
    counts = [count(case, rules, threshold)[0] for threshold, _ in points]
    best = max(counts, key=lambda one: one.mota, default=everything)
    scaled = [
        min(1.0, max(0.0, 1.0 - (one.errors - (1.0 - recall) * one.truth) / (recall * one.truth)))
        for one, (_, recall) in zip(counts, points, strict=True)
    ]
    alike = (math.nan,) * 3 if near is None else hota(near, case, rules, best.threshold)
    return Figures(
        samota=math.fsum(scaled) / RECALLS,
        amota=math.fsum(max(0.0, one.mota) for one in counts) / RECALLS,
        amotp=math.fsum(one.motp for one in counts if one.true) / RECALLS,
        best=best,
        hota=alike[0],
        deta=alike[1],
        assa=alike[2],
    )


def hota(near: Joined, case: Joined, rules: Rules, threshold: float = -math.inf) -> tuple[float, float, float]:
    """Return HOTA, DetA and AssA of the tracks with a mean score from `threshold` on.

    Ignored truth does not take part, nor do tracks that match it by the rules, nor unmatched tracks that are excused.
    """
    _, pair = count(case, rules, threshold)
    kept = case.mean >= threshold
    hit = pair >= 0
    used = np.zeros(len(kept), dtype=np.bool_)
    used[case.track_row[pair[hit]]] = True
    kept &= used | ~case.excused
    kept[case.track_row[pair[hit & case.ignored]]] = False
    counts = ~near.ignored
    use = kept[near.track_row] & counts[near.truth_row] & (near.similarity < HOTA_DISTANCE)
    truth_row, track_row = near.truth_row[use], near.track_row[use]
    alike = 1.0 - near.similarity[use] / HOTA_DISTANCE
    gt, tracks = int(counts.sum()), int(kept.sum())
    if not len(alike):
        return (0.0, 0.0, 0.0) if gt or tracks else (math.nan,) * 3
    group = np.searchsorted(near.bounds, np.flatnonzero(use), side="right")
    bounds = np.append(np.flatnonzero(np.diff(group, prepend=-1)), len(group)).astype(np.int64)
    rows = np.bincount(truth_row, alike, len(near.truth_id))[truth_row]
    columns = np.bincount(track_row, alike, len(kept))[track_row]
    share = alike / np.maximum(rows + columns - alike, np.finfo(np.float64).eps)
    truth_id, track_id = near.truth_id[truth_row], near.track_id[track_row]
    keys, which = np.unique(truth_id * (near.track_id.max() + 1) + track_id, return_inverse=True)
    length = np.empty(len(keys))
    length[which] = (np.bincount(near.truth_id[counts], minlength=near.truth_id.max() + 1)[truth_id]
                     + np.bincount(near.track_id[kept], minlength=near.track_id.max() + 1)[track_id])
    potential = np.bincount(which, share, len(keys))
    aligned = potential / (length - potential)
    chosen = match_similar(truth_row, track_row, aligned[which] * alike, bounds)
    deta, assa = np.empty(len(_ALPHAS)), np.empty(len(_ALPHAS))
    for i, alpha in enumerate(_ALPHAS):
        matched = chosen & (alike >= alpha - np.finfo(np.float64).eps)
        true = int(matched.sum())
        common = np.bincount(which[matched], minlength=len(keys))
        assa[i] = float((common * common / np.maximum(1.0, length - common)).sum()) / max(1, true)
        deta[i] = true / max(1, gt + tracks - true)
    return float(np.sqrt(deta * assa).mean()), float(deta.mean()), float(assa.mean())

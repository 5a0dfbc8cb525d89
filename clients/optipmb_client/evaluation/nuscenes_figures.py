"""The figures of the nuScenes tracking benchmark, from matchings.

Conventions: counts are of boxes; GT = TP + FN + IDS, for a switch is no true positive here. A figure that is not
defined is NaN. Durations count keyframes of half a second.

    MOTAR = max(0, 1 - (IDS + FP + FN - (1 - r) GT) / (r GT)),  r = TP / GT
    MOTA  = max(0, 1 - (IDS + FP + FN) / GT)
    MOTP  = mean distance over TP and IDS, metres
    recall = (TP + IDS) / GT

AMOTA and AMOTP are the means of MOTAR and MOTP over 40 recalls from 0.1 to 1, each at the score threshold that reaches
the recall; recalls that no threshold reaches count 0 and 2 m. All other figures are those at the threshold with the
highest MOTA. The name MOTAR is the benchmark's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from optipmb_client.evaluation.nuscenes_matching import Event, Matching, Pairing, match
from optipmb_client.evaluation.nuscenes_scene import NuScenesConfig
from optipmb_client.geometry import Floats, Ints

_PERIOD_S = 0.5
_MOSTLY = 0.8
_HARDLY = 0.2
_DECIMALS = 12


@dataclass(frozen=True)
class NuScenesFigures:
    """Figures of one class at one threshold, by their official names."""

    threshold: float
    """Lowest mean score of a track."""
    recall: float
    motar: float
    gt: float
    mota: float
    motp: float
    mt: float
    """Objects tracked in at least 80 % of their frames."""
    ml: float
    """Objects tracked in less than 20 % of their frames."""
    faf: float
    """False positives in a hundred frames."""
    tp: float
    fp: float
    fn: float
    ids: float
    frag: float
    """Breaks in the tracking of an object."""
    tid: float
    """Mean time until an object is tracked, seconds."""
    lgd: float
    """Mean longest time for which an object is not tracked, seconds."""

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by name; None for those that are not defined."""
        return {item.name: plain(getattr(self, item.name)) for item in fields(self)}


@dataclass(frozen=True)
class NuScenesClass:
    """Figures of one class."""

    amota: float
    amotp: float
    best: NuScenesFigures
    """At the threshold with the highest MOTA."""
    recalls: tuple[float, ...]
    """From 1 down."""
    curve: tuple[NuScenesFigures | None, ...]
    """At each of `recalls`; None where it is not reached."""

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by name; None for those that are not defined."""
        return {"amota": plain(self.amota), "amotp": plain(self.amotp), **self.best.to_json()}


UNDEFINED = NuScenesFigures(*(math.nan,) * len(fields(NuScenesFigures)))


def plain(value: float) -> float | None:
    """Return a figure, or None for NaN, which JSON does not have."""
    return None if math.isnan(value) else value


def evaluate_class(pairings: Sequence[Pairing], config: NuScenesConfig) -> NuScenesClass:
    """Return the figures of one class over all scenes."""
    recalls = np.linspace(config.min_recall, 1.0, config.thresholds).round(_DECIMALS)
    named = tuple(recalls[::-1].tolist())
    count = sum(len(pairing.truth_id) for pairing in pairings)
    if not count:
        return NuScenesClass(math.nan, math.nan, UNDEFINED, named, (None,) * len(named))
    thresholds = score_thresholds(_true_scores(pairings), count, recalls)[::-1]
    known = {
        threshold: figures(pairings, [match(pairing, threshold) for pairing in pairings], threshold)
        for threshold in np.unique(thresholds[~np.isnan(thresholds)]).tolist()
    }
    curve = tuple(known.get(threshold) for threshold in thresholds.tolist())
    if not known:
        return NuScenesClass(0.0, config.worst_motp, _worst(pairings, config), named, curve)
    return NuScenesClass(
        amota=_average([point.motar if point else math.nan for point in curve], 0.0),
        amotp=_average([point.motp if point else math.nan for point in curve], config.worst_motp),
        # The curve begins at the highest recall, which so wins among equals.
        best=max((point for point in curve if point), key=lambda point: point.mota),
        recalls=named,
        curve=curve,
    )


def score_thresholds(scores: Floats, count: int, recalls: Floats) -> Floats:
    """Return the thresholds (H,) that reach recalls (H,); NaN where the recall is not reached.

    Args:
        scores: (S,) of the true positives, in any order.
        count: number of truth boxes.
        recalls: (H,) ascending.

    """
    if not len(scores):
        return np.full(len(recalls), np.nan)
    ordered = np.sort(scores)[::-1]
    reached = np.arange(1, len(ordered) + 1) / count
    thresholds = np.interp(recalls, reached, ordered, right=0.0)
    thresholds[recalls > reached[-1]] = np.nan
    return np.asarray(thresholds, dtype=np.float64)


def figures(pairings: Sequence[Pairing], matchings: Sequence[Matching], threshold: float) -> NuScenesFigures:
    """Return the figures of one class from the matchings of all scenes at a threshold."""
    events = np.concatenate([matching.event for matching in matchings])
    gt = len(events)
    tp, ids, fn = (int((events == kind).sum()) for kind in (Event.MATCH, Event.SWITCH, Event.MISS))
    fp = sum(matching.false_positives for matching in matchings)
    frames = sum(matching.frames for matching in matchings)
    metres = sum(float(np.nansum(matching.distance)) for matching in matchings)
    paths = _Paths.of(pairings, matchings)
    share = tp / gt
    return NuScenesFigures(
        threshold=threshold,
        recall=(tp + ids) / gt,
        motar=max(0.0, 1.0 - (ids + fp + fn - (1.0 - share) * gt) / (share * gt)) if tp else math.nan,
        gt=float(gt),
        mota=max(0.0, 1.0 - (ids + fp + fn) / gt),
        motp=metres / (tp + ids) if tp + ids else math.nan,
        mt=float((paths.share >= _MOSTLY).sum()),
        ml=float((paths.share < _HARDLY).sum()),
        faf=100.0 * fp / frames,
        tp=float(tp),
        fp=float(fp),
        fn=float(fn),
        ids=float(ids),
        frag=float(paths.breaks),
        tid=_PERIOD_S * _mean(paths.delay),
        lgd=_PERIOD_S * _mean(paths.longest),
    )


@dataclass(frozen=True)
class _Paths:
    """How well each object was followed."""

    share: Floats
    """(O,) of its frames in which it is tracked."""
    delay: Ints
    """(O',) frames until objects that are tracked at all first are."""
    longest: Ints
    """(O',) the most frames in a row in which objects that are tracked at all are not."""
    breaks: int
    """Times without tracking between times with it."""

    @classmethod
    def of(cls, pairings: Sequence[Pairing], matchings: Sequence[Matching]) -> "_Paths":
        """Return it for all objects of one class.

        The rows are put in order of objects and time, and cut into runs of equal state within one object. An object is
        in every frame from its first to its last, so rows are frames.
        """
        number = np.cumsum([0, *(pairing.objects for pairing in pairings)])
        owner = np.concatenate([pairing.truth_id + first for pairing, first in zip(pairings, number[:-1], strict=True)])
        order = np.argsort(owner, kind="stable")
        owner = owner[order]
        tracked = np.concatenate([matching.event for matching in matchings])[order] != Event.MISS
        start = np.flatnonzero(np.append(True, (np.diff(owner) != 0) | (np.diff(tracked.astype(np.int64)) != 0)))
        length = np.diff(np.append(start, len(owner)))
        run_owner, missed = owner[start], ~tracked[start]
        first = np.append(True, np.diff(run_owner) != 0)
        last = np.append(first[1:], True)
        count = int(number[-1])
        found = np.bincount(owner, tracked, count)
        longest = np.zeros(count, dtype=np.int64)
        np.maximum.at(longest, run_owner[missed], length[missed])
        delay = np.zeros(count, dtype=np.int64)
        delay[run_owner[first & missed]] = length[first & missed]
        return cls(
            share=found / np.bincount(owner, minlength=count),
            delay=delay[found > 0],
            longest=longest[found > 0],
            breaks=int((missed & ~first & ~last).sum()),
        )


def _true_scores(pairings: Sequence[Pairing]) -> Floats:
    """Return the scores of the matches when all tracks are there; switches are none."""
    scores = []
    for pairing in pairings:
        found = match(pairing)
        scores.append(pairing.track_score[found.track_row[found.event == Event.MATCH]])
    return np.concatenate(scores)


def _worst(pairings: Sequence[Pairing], config: NuScenesConfig) -> NuScenesFigures:
    """Return what stands for the figures of a class of which nothing is found."""
    gt = float(sum(len(pairing.truth_id) for pairing in pairings))
    return NuScenesFigures(
        threshold=math.nan,
        recall=0.0,
        motar=0.0,
        gt=gt,
        mota=0.0,
        motp=config.worst_motp,
        mt=0.0,
        ml=float(sum(pairing.objects for pairing in pairings)),
        faf=500.0,
        tp=0.0,
        fp=math.nan,
        fn=gt,
        ids=math.nan,
        frag=math.nan,
        tid=20.0,
        lgd=20.0,
    )


def _average(values: list[float], worst: float) -> float:
    """Return the mean with `worst` for NaN; NaN when there is nothing else."""
    array = np.array(values)
    known = ~np.isnan(array)
    return float(np.where(known, array, worst).mean()) if known.any() else math.nan


def _mean(values: Ints) -> float:
    return float(values.mean()) if len(values) else math.nan

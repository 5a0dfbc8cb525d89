"""The figures that tuning looks at, of one class over several sequences, by the functions of `evaluation`.

Conventions: scores of tracks are the mean scores of whole tracks. The averages over recalls are those of AB3DMOT's
protocol, with 3D overlap for KITTI and with the distance of centres up to two metres elsewhere, and those of the
nuScenes benchmark for nuScenes. All single figures are those at the threshold with the highest MOTA.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from optipmb_client.evaluation import Case, Rules, clear, combine
from optipmb_client.evaluation.ab3dmot import evaluate_ab3dmot
from optipmb_client.evaluation.assignment import assign_frames, best_pairs
from optipmb_client.geometry import Bools, Floats, Ints

__all__ = ["HOTA_DISTANCE", "Figures", "ab3dmot_figures", "distance_figures", "hota"]

HOTA_DISTANCE = 2.0
"""Metres at which the similarity of two centres is zero."""
_ALPHAS: Floats = np.arange(0.05, 0.99, 0.05)


@dataclass(frozen=True)
class Figures:
    """Figures of one class; NaN where they are not defined."""

    samota: float
    amota: float
    amotp: float
    mota: float
    motp: float
    hota: float
    deta: float
    assa: float
    ids: float
    frag: float
    fp: float
    fn: float
    gt: float
    threshold: float
    """Lowest mean score of the tracks that the single figures are of."""

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by their usual names; None for those that are not defined."""
        return {
            _NAMES.get(item.name, item.name): _plain(getattr(self, item.name)) for item in fields(self)
        }


_NAMES = {
    "samota": "sAMOTA",
    "amota": "AMOTA",
    "amotp": "AMOTP",
    "mota": "MOTA",
    "motp": "MOTP",
    "hota": "HOTA",
    "deta": "DetA",
    "assa": "AssA",
    "ids": "IDS",
    "frag": "FRAG",
    "fp": "FP",
    "fn": "FN",
    "gt": "GT",
}


def _plain(value: float) -> Any:
    if not math.isfinite(value):
        return None
    return int(value) if value == int(value) and abs(value) > 1 else value


def ab3dmot_figures(cases: Sequence[Case], near: Sequence[Case], limit: float) -> Figures:
    """Return the figures of AB3DMOT's protocol.

    Args:
        cases: by the rules of the protocol.
        near: the same with the pairs of centres within two metres, for HOTA.
        limit: least overlap of a pair that matches.

    """
    found = evaluate_ab3dmot(cases, limit)
    best = found.best
    alike = hota([_counted(case, other, found.threshold) for case, other in zip(cases, near, strict=True)])
    return Figures(
        samota=found.samota,
        amota=found.amota,
        amotp=found.amotp,
        mota=best.mota,
        motp=best.motp,
        hota=alike[0],
        deta=alike[1],
        assa=alike[2],
        ids=best.switches,
        frag=best.fragments,
        fp=best.false,
        fn=best.missed,
        gt=best.truth,
        threshold=found.threshold,
    )


def distance_figures(cases: Sequence[Case], rules: Rules) -> Figures:
    """Return the figures where boxes match by the distance of their centres.

    The averages are those of AB3DMOT's protocol with the similarity 1 - d / limit; the single figures are those of
    CLEAR MOT, where changes of identity over breaks count too.
    """
    similar = [replace(case, similarity=1.0 - case.similarity / rules.limit) for case in cases]
    found = evaluate_ab3dmot(similar, 0.0)
    best = combine(clear(case.keep(case.mean_scores() >= found.threshold), rules) for case in cases)
    alike = hota([_counted(case, case, found.threshold) for case in cases])
    return Figures(
        samota=found.samota,
        amota=found.amota,
        amotp=rules.limit * (1.0 - found.amotp),
        mota=best.mota,
        motp=best.motp,
        hota=alike[0],
        deta=alike[1],
        assa=alike[2],
        ids=len(best.switches),
        frag=best.fragments,
        fp=best.false,
        fn=best.missed,
        gt=best.truth,
        threshold=found.threshold,
    )


def _counted(case: Case, near: Case, threshold: float) -> Case:
    """Return what takes part in HOTA.

    Truth that is ignored does not, nor do tracks below the threshold, tracks that match ignored truth by the rules of
    the case, and unmatched ones that are excused.
    """
    kept = case.mean_scores() >= threshold
    pairs = np.flatnonzero(kept[case.track_row])
    frame, row, column = case.truth_frame[case.truth_row[pairs]], case.truth_row[pairs], case.track_row[pairs]
    taken = assign_frames(frame, row, column, 2.0 - case.cost[pairs] / (1.0 + case.cost[pairs].max(initial=0.0)), best_pairs)
    used = np.zeros(len(kept), dtype=np.bool_)
    used[column[taken]] = True
    kept &= used | ~case.excused
    kept[column[taken][case.ignored[row[taken]]]] = False
    return _without_truth(near.keep(kept), near.ignored)


def _without_truth(case: Case, dropped: Bools) -> Case:
    place = np.cumsum(~dropped) - 1
    pairs = ~dropped[case.truth_row]
    return replace(
        case,
        truth_frame=case.truth_frame[~dropped],
        truth_id=case.truth_id[~dropped],
        ignored=case.ignored[~dropped],
        truth_row=place[case.truth_row[pairs]].astype(np.int64),
        track_row=case.track_row[pairs],
        cost=case.cost[pairs],
        similarity=case.similarity[pairs],
    )


def hota(cases: Sequence[Case]) -> tuple[float, float, float]:
    """Return HOTA, DetA and AssA (Luiten et al., 2020) of centres: similarity max(0, 1 - d / 2 m), d in `similarity`."""
    parts = [_alignment(case) for case in cases]
    gt, tracks = sum(len(case.truth_id) for case in cases), sum(len(case.track_id) for case in cases)
    if not gt:
        return (math.nan,) * 3
    deta, assa = np.empty(len(_ALPHAS)), np.empty(len(_ALPHAS))
    for i, alpha in enumerate(_ALPHAS):
        true, together = 0, 0.0
        for which, alike, length in parts:
            matched = alike >= alpha - np.finfo(np.float64).eps
            common = np.bincount(which[matched], minlength=len(length))
            together += float((common * common / np.maximum(1.0, length - common)).sum())
            true += int(matched.sum())
        assa[i] = together / max(1, true)
        deta[i] = true / max(1, gt + tracks - true)
    return float(np.sqrt(deta * assa).mean()), float(deta.mean()), float(assa.mean())


def _alignment(case: Case) -> tuple[Ints, Floats, Floats]:
    """Return the matched pairs of a sequence: which couple of ids each is of, its similarity; and per couple the boxes
    that the two ids have together.
    """
    use = case.similarity < HOTA_DISTANCE
    row, column = case.truth_row[use], case.track_row[use]
    alike = 1.0 - case.similarity[use] / HOTA_DISTANCE
    if not len(row):
        return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
    truth_id = np.unique(case.truth_id, return_inverse=True)[1]
    track_id = np.unique(case.track_id, return_inverse=True)[1]
    rows, columns = np.bincount(row, alike)[row], np.bincount(column, alike)[column]
    share = alike / np.maximum(rows + columns - alike, np.finfo(np.float64).eps)
    couples, which = np.unique(np.column_stack([truth_id[row], track_id[column]]), axis=0, return_inverse=True)
    length: Floats = (np.bincount(truth_id)[couples[:, 0]] + np.bincount(track_id)[couples[:, 1]]).astype(np.float64)
    potential = np.bincount(which, share, len(couples))
    weight = (potential / (length - potential))[which] * alike
    taken = assign_frames(case.truth_frame[row], row, column, weight, best_pairs)
    return which[taken].astype(np.int64), alike[taken], length

"""The figures that tuning looks at, of one class over several sequences, by the functions of `evaluation`.

Conventions: scores of tracks are the mean scores of whole tracks. The averages over recalls are those of AB3DMOT's
protocol, with 3D overlap for KITTI and with the distance of centres up to two metres elsewhere, and those of the
nuScenes benchmark for nuScenes. All single figures are those at the threshold with the highest MOTA; HOTA is that of
centres in the plane.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from optipmb_client.evaluation import Case, ClearResult, Rules, clear, combine
from optipmb_client.evaluation.ab3dmot import Ab3dmotResult, Counts, evaluate_ab3dmot
from optipmb_client.evaluation.hota import HotaResult, evaluate_hota

__all__ = ["Figures", "ab3dmot_figures", "distance_figures"]


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
    hota_all: float
    """HOTA of all tracks, whatever their score."""

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by their usual names; None for those that are not defined."""
        return {_NAMES.get(item.name, item.name): _plain(getattr(self, item.name)) for item in fields(self)}


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
    "hota_all": "HOTA, all",
}


def _plain(value: float) -> Any:
    if not math.isfinite(value):
        return None
    return int(value) if value == int(value) and abs(value) > 1 else value


def ab3dmot_figures(cases: Sequence[Case], near: Sequence[Case], rules: Rules, near_rules: Rules) -> Figures:
    """Return the figures of AB3DMOT's protocol.

    Args:
        cases: by the rules of the protocol.
        near: the same truth and tracks with the pairs of near centres, for HOTA.
        rules: of `cases`.
        near_rules: of `near`.

    """
    found = evaluate_ab3dmot(cases, rules.limit)
    return _figures(found, found.best, found.best.switches, near, near_rules)


def distance_figures(near: Sequence[Case], rules: Rules) -> Figures:
    """Return the figures where boxes match by the distance of their centres.

    The averages are those of AB3DMOT's protocol with the similarity 1 - d / limit; the single figures are those of
    CLEAR MOT, where changes of identity over breaks count too.
    """
    similar = [replace(case, similarity=1.0 - case.cost / rules.limit) for case in near]
    found = evaluate_ab3dmot(similar, 0.0)
    best = combine(clear(case, rules) for case in _from_score(near, found.threshold))
    figures = _figures(found, best, len(best.switches), near, rules)
    return replace(figures, amotp=rules.limit * (1.0 - found.amotp))


def _figures(
    found: Ab3dmotResult, best: Counts | ClearResult, switches: int, near: Sequence[Case], rules: Rules
) -> Figures:
    alike = _hota(near, rules, found.threshold)
    return Figures(
        samota=found.samota,
        amota=found.amota,
        amotp=found.amotp,
        mota=best.mota,
        motp=best.motp,
        hota=alike.hota,
        deta=alike.deta,
        assa=alike.assa,
        ids=switches,
        frag=best.fragments,
        fp=best.false,
        fn=best.missed,
        gt=best.truth,
        threshold=found.threshold,
        hota_all=_hota(near, rules, -math.inf).hota,
    )


def _hota(near: Sequence[Case], rules: Rules, threshold: float) -> HotaResult:
    return evaluate_hota(_from_score(near, threshold), rules)


def _from_score(cases: Sequence[Case], threshold: float) -> list[Case]:
    return [case.keep(case.mean_scores() >= threshold) for case in cases]

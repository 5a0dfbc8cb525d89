"""Which score ranks tracks best: the averages over recalls hang on it, and so does the best threshold.

Benchmarks rank a track by the mean of its scores. The same tracks are ranked by several scores that are known when a
frame is published: that of the paper, x_s = [1 - exp(-x_len)] z_s; the mean of the detections' scores so far; the
existence probability; the product and the mean of it and x_s; the evidence (`optipmb.calibration`), and the mean of it
and x_s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optipmb import Parameters
from optipmb_client.geometry import Floats
from optipmb_client.results.full import FullTable
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.folds import deal
from optipmb_client.tuning.material import Clip, track_fully
from optipmb_client.tuning.objective import metric
from optipmb_client.tuning.scoring import Scorer
from optipmb_client.tuning.values import with_values

__all__ = ["Ranking", "rank"]

_GROUPS = 5


@dataclass(frozen=True)
class Ranking:
    """One score."""

    score: str
    figures: Figures
    value: float
    gain: float
    """Of the objective over x_s."""
    error: float
    """Standard error of the gain, by leaving out groups of sequences; 0 where there are too few to tell."""


def rank(clips: Sequence[Clip], scorer: Scorer, parameters: Parameters, objective: str) -> tuple[Ranking, ...]:
    """Return how well each score ranks the same tracks.

    Args:
        clips: with the class of the scorer only.
        scorer: of the class.
        parameters: of the tracks, with a calibration.
        objective: one of `optipmb_client.tuning.objective.METRICS`.

    """
    probe = with_values(parameters, scorer.name, {"calibration.score_of_evidence": 1.0})
    tracked = [track_fully(clip, probe) for clip in clips]
    scores_of = [_scores(clip, full, parameters.nominal_period) for clip, (_, full) in zip(clips, tracked, strict=True)]
    scores = {
        name: [replace(tracks, score=one[name]) for (tracks, _), one in zip(tracked, scores_of, strict=True)]
        for name in scores_of[0]
    }
    objects = [len(set(clip.truth.id[~clip.truth.ignored].tolist())) for clip in clips]
    groups = deal(objects, _GROUPS)
    parts = [tuple(range(len(clips))), *(tuple(i for i in range(len(clips)) if i not in group) for group in groups)]
    found: list[Ranking] = []
    first: Floats | None = None
    for name, tables in scores.items():
        measured = [scorer.measure(clip, table) for clip, table in zip(clips, tables, strict=True)]
        figures = [scorer.figures([measured[i] for i in part]) for part in parts]
        values = np.array(
            [metric(objective, one, sum(objects[i] for i in part)) for one, part in zip(figures, parts, strict=True)]
        )
        first = values if first is None else first
        gains = values - first
        error = math.sqrt((len(groups) - 1) * float(np.var(gains[1:]))) if groups else 0.0
        found.append(Ranking(name, figures[0], float(values[0]), float(gains[0]), error))
    return tuple(found)


def _scores(clip: Clip, full: FullTable, period: float) -> dict[str, Floats]:
    detected = np.zeros(len(full))
    known = {
        (index, source): score
        for index, frame in enumerate(clip.frames)
        for source, score in zip(frame.source.tolist(), frame.score.tolist(), strict=True)
    }
    for row in np.flatnonzero(full.detection >= 0).tolist():
        detected[row] = known[int(full.frame[row]), int(full.detection[row])]
    paper = (1.0 - np.exp(-1.0 - full.age / period)) * detected
    return {
        "x_s": paper,
        "mean": _mean_so_far(full, detected),
        "existence": full.existence,
        "x_s * existence": paper * full.existence,
        "(x_s + existence) / 2": 0.5 * (paper + full.existence),
        "(x_s + evidence) / 2": 0.5 * (paper + full.score),
        "evidence": full.score,
    }


def _mean_so_far(full: FullTable, values: Floats) -> Floats:
    """Return for each row the mean of its track's values until then."""
    order = np.lexsort((full.frame, full.id))
    mean = np.empty(len(values))
    for rows in np.split(order, np.flatnonzero(np.diff(full.id[order])) + 1) if len(order) else []:
        mean[rows] = np.cumsum(values[rows]) / np.arange(1, len(rows) + 1)
    return mean

"""The objective: the mean score of candidates over sequences, and how certain a gain is.

A gain over other parameters is the difference of the scores over all sequences. Its standard error is that of the
jackknife (Efron, 1982): the difference is taken again without each of five folds of whole sequences, since objects of
one sequence have much in common. A search subtracts this margin, so that it leaves the start only for what helps in
most places, not for the luck of one sequence. Tracking one sequence is a task; the same parameters give the same score
with any executor.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from optipmb import Parameters, warm_up
from optipmb_tools.datasets import Truth
from optipmb_tools.geometry import Floats
from optipmb_tools.run.bulk import Executor, Here, values
from optipmb_tools.tuning.clips import Clip, track_clip
from optipmb_tools.tuning.scoring import Figures, Measured, Scorer, metric

MARGIN_FOLDS = 5
"""Folds of sequences for the standard error."""
MARGIN = 1.0
"""Standard errors that are subtracted from a gain."""
_REMEMBERED = 6
_NOTHING = 1e-9


def folds_of(weights: Sequence[int], count: int) -> list[tuple[int, ...]]:
    """Return folds of sequences that weigh about the same; those without weight are in none.

    Args:
        weights: of the sequences, such as their number of truth boxes.
        count: number of folds; fewer when fewer sequences have any weight, and none when only one has.

    """
    heavy = sorted((i for i, weight in enumerate(weights) if weight), key=lambda i: (-weights[i], i))
    count = min(count, len(heavy))
    if count < 2:  # noqa: PLR2004  a fold must leave something
        return []
    folds: list[list[int]] = [[] for _ in range(count)]
    for i in heavy:
        min(folds, key=lambda fold: sum(weights[j] for j in fold)).append(i)
    return [tuple(sorted(fold)) for fold in folds]


def without_folds(clips: Sequence[int], weights: Sequence[int]) -> list[tuple[int, ...]]:
    """Return the sequences, and then the sequences without each of the folds for the standard error."""
    folds = folds_of([weight if i in clips else 0 for i, weight in enumerate(weights)], MARGIN_FOLDS)
    return [tuple(clips), *(tuple(i for i in clips if i not in fold) for fold in folds)]


def standard_error(gains: Floats) -> float:
    """Return the jackknife's standard error of a gain; 0 where there are too few sequences to tell.

    Args:
        gains: of all sequences, and of the sequences without each fold.

    """
    count = len(gains) - 1
    return math.sqrt((count - 1) * float(np.var(gains[1:]))) if count else 0.0


@dataclass(frozen=True)
class Gain:
    """Gain of one set of parameters over another."""

    value: float
    """Score of the first, over all sequences."""
    gain: float
    error: float
    """Standard error of the gain."""
    positive: int
    """In how many of `groups` choices of sequences, each without one fold, there is a gain."""
    groups: int

    @property
    def score(self) -> float:
        """Score less the margin."""
        return self.value - MARGIN * self.error


class Objective:
    """Sequences of one class, in one or more variants of their detections, and the score of candidates on them.

    Args:
        variants: the same sequences once or several times: plain, degraded.
        scorer: compares tracks with the truth.
        metric: one of `METRICS`.
        executor: where they are tracked; by default in this process.
        note: is called when a process has died.
    """

    def __init__(
        self,
        variants: Sequence[Sequence[Clip]],
        scorer: Scorer,
        metric: str,
        executor: Executor | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.variants = variants
        self.scorer = scorer
        self.metric = metric
        self.names = tuple(clip.name for clip in variants[0])
        own = [self._own(clip) for clip in variants[0]]
        self.boxes = tuple(int((~truth.ignored).sum()) for truth in own)
        """Truth boxes of each sequence that count."""
        self._objects = [len(set(truth.id[~truth.ignored].tolist())) for truth in own]
        self._known: OrderedDict[tuple[str, int, int], Measured] = OrderedDict()
        self._scores: dict[tuple[str, tuple[int, ...]], Floats] = {}
        self._note = note
        self._executor = executor or Here()
        self._executor.start(_measure, (variants, scorer))
        warm_up()

    def _own(self, clip: Clip) -> Truth:
        return clip.truth.take(clip.truth.names == self.scorer.name)

    def measure(
        self, parameters: Parameters, clips: Sequence[int], variants: Sequence[int] | None = None
    ) -> list[list[Measured]]:
        """Track some sequences and measure the tracks, for each variant, or each of some."""
        key = parameters.model_dump_json()
        chosen = range(len(self.variants)) if variants is None else variants
        wanted = [(key, variant, clip) for variant in chosen for clip in clips]
        missing = [place for place in wanted if place not in self._known]
        tasks = [_Task(self.names[clip], variant, clip, parameters) for _, variant, clip in missing]
        found: list[Measured] = values(self._executor, tasks, lambda task: f"sequence {task.name}", self._note)
        self._known.update(zip(missing, found, strict=True))
        for place in wanted:
            self._known.move_to_end(place)
        result = [[self._known[(key, variant, clip)] for clip in clips] for variant in chosen]
        while len(self._known) > _REMEMBERED * len(self.variants) * len(self.names):
            self._known.popitem(last=False)
        return result

    def figures(self, measured: Sequence[Sequence[Measured]]) -> tuple[Figures, ...]:
        """Return the figures of each variant."""
        return tuple(self.scorer.figures(one) for one in measured)

    def value(self, figures: Sequence[Figures], clips: Sequence[int]) -> float:
        """Return the mean of the metric over the variants."""
        objects = sum(self._objects[i] for i in clips)
        return sum(metric(self.metric, one, objects) for one in figures) / len(figures)

    def plain_value(self, parameters: Parameters, clips: Sequence[int]) -> float:
        """Return the metric of the detections as they are."""
        return self.value(self.figures(self.measure(parameters, clips, (0,))), clips)

    def gain(self, parameters: Parameters, over: Parameters, clips: Sequence[int]) -> Gain:
        """Return the gain of parameters over others, on some sequences."""
        found = self._values(parameters, clips)
        gains = found - self._values(over, clips)
        positive = int((gains[1:] > _NOTHING).sum())
        return Gain(float(found[0]), float(gains[0]), standard_error(gains), positive, len(gains) - 1)

    def _values(self, parameters: Parameters, clips: Sequence[int]) -> Floats:
        """Return the scores on the sequences and on the sequences without each fold."""
        key = parameters.model_dump_json(), tuple(clips)
        if key not in self._scores:
            measured, place = self.measure(parameters, clips), {clip: i for i, clip in enumerate(clips)}
            parts = without_folds(clips, self.boxes)
            chosen = ([[variant[place[i]] for i in part] for variant in measured] for part in parts)
            values = [self.value(self.figures(one), part) for one, part in zip(chosen, parts, strict=True)]
            self._scores[key] = np.array(values)
        return self._scores[key]


@dataclass(frozen=True)
class _Task:
    """One sequence in one variant, with some parameters."""

    name: str
    variant: int
    clip: int
    parameters: Parameters


def _measure(shared: tuple[Sequence[Sequence[Clip]], Scorer], task: _Task) -> Measured:
    variants, scorer = shared
    clip = variants[task.variant][task.clip]
    return scorer.measure(clip, track_clip(clip, task.parameters))

"""Figures and scores of tracks: each sequence is measured on its own, and any choice of sequences is summed up.

Conventions: scores of tracks are the mean scores of whole tracks. The averages over recalls follow AB3DMOT's protocol,
with 3D overlap for KITTI and with the distance of centres up to two metres elsewhere, and for nuScenes its own
benchmark. All single figures are those at the threshold with the highest MOTA, `threshold`; HOTA is computed of centres
in the plane, `HOTA, all` of all tracks.

The score of a candidate is the mean of the metric over all variants of the detections. A gain over other parameters is
the difference of the scores over all sequences. Its standard error comes from the jackknife (Efron, 1982): the
difference is taken again without each of five folds of whole sequences, since objects of one sequence have much in
common. A search subtracts this margin, so that it leaves the start only for values that help in most places. Tracking
one sequence is a task; the same parameters give the same score with any executor.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optipmb import Parameters, warm_up
from optipmb_tools.datasets import DataSequence
from optipmb_tools.datasets.nuscenes import NuScenesSequence
from optipmb_tools.evaluation import Rules, combine, default_rules
from optipmb_tools.evaluation.ab3dmot import evaluate_ab3dmot
from optipmb_tools.evaluation.cases import Case, ab3dmot_rules, prepare
from optipmb_tools.evaluation.clear import Counts, clear
from optipmb_tools.evaluation.figures import defined
from optipmb_tools.evaluation.hota import HotaResult, evaluate_hota
from optipmb_tools.evaluation.nuscenes import (
    NuScenesConfig,
    NuScenesScene,
    evaluate_class,
    pair,
    prepare_scene,
)
from optipmb_tools.geometry import Bools, Floats, to_sensor
from optipmb_tools.results import ResultTable
from optipmb_tools.results.nuscenes import NUSCENES_CLASSES
from optipmb_tools.run.bulk import Executor, Here, values
from optipmb_tools.tuning.clips import Clip, track_clip

Figures = dict[str, float]
"""Figures of one class by their names in `evaluation.FIGURES`; NaN where they are not defined."""

METRICS: Mapping[str, str] = {
    "combination": "mean of sAMOTA, AMOTA, MOTA and HOTA, less a tenth of the switches per object",
    "samota": "sAMOTA",
    "amota": "AMOTA",
    "mota": "MOTA at the best threshold",
    "hota": "HOTA of centres at that threshold",
    "both": "three parts AMOTA, one part the HOTA of all tracks, less a tenth of the switches per object",
}
_SINGLE = {"samota": "sAMOTA", "amota": "AMOTA", "mota": "MOTA", "hota": "HOTA"}
_SWITCH = 0.1
MARGIN_FOLDS = 5  # folds of sequences for the standard error
MARGIN = 1.0  # standard errors that are subtracted from a gain
_REMEMBERED = 6
_NOTHING = 1e-9


def metric(name: str, figures: Figures, objects: int) -> float:
    """Return one of `METRICS`; figures that are not defined count zero."""
    known = {key: 0.0 if math.isnan(value) else value for key, value in figures.items()}
    if name in _SINGLE:
        return known[_SINGLE[name]]
    if name == "both":
        mean = 0.75 * known["AMOTA"] + 0.25 * known["HOTA, all"]
    else:
        mean = sum(known[one] for one in _SINGLE.values()) / len(_SINGLE)
    return mean - _SWITCH * known["IDS"] / max(1, objects)


def plain_figures(figures: Figures) -> dict[str, float | int | None]:
    """Return figures for JSON: whole numbers as such, None where undefined."""
    return {
        name: int(value) if (known := defined(value)) is not None and value == int(value) and abs(value) > 1 else known
        for name, value in figures.items()
    }


@dataclass(frozen=True)
class Measured:
    """One sequence: truth and tracks with the pairs that may match."""

    case: Case  # by the rules of the benchmark
    near: Case  # by the distance of the centres, for HOTA
    official: Case | None = None  # by the rules of the nuScenes benchmark


@dataclass(frozen=True)
class Scorer:
    """Compares tracks with the truth, for one class."""

    name: str  # the class
    rules: Rules  # which labels are ignored, and which tracks are excused
    near: Rules  # by the distance of centres, for HOTA
    scenes: Mapping[str, NuScenesScene] | None = None  # by sequence, where the nuScenes benchmark gives the figures

    @property
    def config(self) -> NuScenesConfig:
        """Settings of the nuScenes benchmark with this class only."""
        return NuScenesConfig(class_range={self.name: NuScenesConfig().class_range[self.name]})

    def counts(self, clip: Clip, tracks: ResultTable) -> Bools:
        """Return which of the tracks of a clip (R,), in the world frame, are in the range of the benchmark."""
        if self.scenes is None:
            return np.ones(len(tracks), dtype=np.bool_)
        distance = np.linalg.norm(tracks.center[:, :2] - self.scenes[clip.name].ego[tracks.frame], axis=1)
        return np.asarray(distance < self.config.class_range[self.name], dtype=np.bool_)

    def measure(self, clip: Clip, tracks: ResultTable) -> Measured:
        """Compare the tracks of a clip, in the world frame, with its truth."""
        official = None
        if self.scenes is not None:
            scene, label = self.scenes[clip.name], NUSCENES_CLASSES.index(self.name)
            boxes = scene.tracks(tracks, self.config)
            official = pair(scene.truth, boxes, label, self.config.match_distance)
            tracks = tracks.take(self.counts(clip, tracks))
        near = prepare(clip.world, tracks, self.name, self.near, clip.name)
        if self.rules.measure == "distance":
            return Measured(near, near, official)
        when = tracks.frame
        center, yaw = to_sensor(clip.rotation[when], clip.translation[when], tracks.center, tracks.yaw)
        local = replace(tracks, center=center, yaw=yaw)
        return Measured(prepare(clip.truth, local, self.name, self.rules, clip.name), near, official)

    def figures(self, measured: Sequence[Measured]) -> Figures:
        """Return the figures of some sequences together."""
        near = [one.near for one in measured]
        if self.rules.measure == "distance":
            found = evaluate_ab3dmot([replace(one, similarity=1.0 - one.cost / self.near.limit) for one in near], 0.0)
            amotp = self.near.limit * (1.0 - found.amotp)
            # Of CLEAR MOT, where changes of identity over breaks count too.
            best: Counts = combine(clear(case.from_score(found.threshold), self.near) for case in near)
        else:
            found = evaluate_ab3dmot([one.case for one in measured], self.rules.limit)
            amotp, best = found.amotp, found.best
        hota = self._hota(near, found.threshold)
        figures = {
            "sAMOTA": found.samota,
            "AMOTA": found.amota,
            "AMOTP": amotp,
            "MOTA": best.mota,
            "MOTP": best.motp,
            "HOTA": hota.hota,
            "DetA": hota.deta,
            "AssA": hota.assa,
            "IDS": best.switches,
            "FRAG": best.fragments,
            "FP": best.false,
            "FN": best.missed,
            "GT": best.truth,
            "threshold": found.threshold,
            "HOTA, all": self._hota(near, -math.inf).hota,
        }
        if self.scenes is not None:
            official = [one.official for one in measured if one.official is not None]
            own = evaluate_class(official, self.config).figures()
            figures |= {name: own[name.lower()] for name in _OFFICIAL}
        return figures

    def _hota(self, near: Sequence[Case], threshold: float) -> HotaResult:
        return evaluate_hota([case.from_score(threshold) for case in near], self.near)


_OFFICIAL = ("AMOTA", "AMOTP", "MOTA", "MOTP", "IDS", "FRAG", "FP", "FN", "GT", "threshold")


def rules_of(dataset: str) -> Rules:
    """Return the rules by which boxes of a dataset are compared here."""
    return ab3dmot_rules() if dataset == "kitti" else default_rules(dataset)


def scorer_of(dataset: str, name: str, sequences: Sequence[DataSequence]) -> Scorer:
    """Return the scorer of a class of a dataset."""
    scorer = Scorer(name, rules_of(dataset), default_rules(dataset, "distance"))
    scenes = [sequence for sequence in sequences if isinstance(sequence, NuScenesSequence)]
    if not scenes or len(scenes) < len(sequences):
        return scorer
    return replace(scorer, scenes={scene.name: prepare_scene(scene, scorer.config) for scene in scenes})


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

    Gains are of all sequences, then of the sequences without each fold.
    """
    count = len(gains) - 1
    return math.sqrt((count - 1) * float(np.var(gains[1:]))) if count else 0.0


@dataclass(frozen=True)
class Gain:
    """Gain of one set of parameters over another."""

    value: float  # score of the first, over all sequences
    gain: float
    error: float  # standard error of the gain
    positive: int  # in how many of `groups` choices of sequences, each without one fold, there is a gain
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
        own = [clip.truth.take(clip.truth.names == scorer.name) for clip in variants[0]]
        self.boxes = tuple(int((~truth.ignored).sum()) for truth in own)
        """Truth boxes of each sequence that count."""
        self._objects = [len(set(truth.id[~truth.ignored].tolist())) for truth in own]
        self._known: OrderedDict[tuple[str, int, int], Measured] = OrderedDict()
        self._scores: dict[tuple[str, tuple[int, ...]], Floats] = {}
        self._note = note
        self._executor = executor or Here()
        self._executor.start(_measure, (variants, scorer))
        warm_up()

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

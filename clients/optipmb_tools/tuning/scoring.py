"""Figures and scores of tracks: each sequence is measured on its own, and any choice of sequences is summed up.

Conventions: scores of tracks are the mean scores of whole tracks. The averages over recalls follow AB3DMOT's protocol,
with 3D overlap for KITTI and with the distance of centres up to two metres elsewhere, and for nuScenes its own
benchmark. All single figures are those at the threshold with the highest MOTA, `threshold`; HOTA is computed of centres
in the plane, `HOTA, all` of all tracks.

The score of a candidate is the metric over all its sequences. Tracking one sequence is a task; the same parameters give
the same score with any executor.
"""

import math
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
from optipmb_tools.geometry import Bools, to_sensor
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


class Objective:
    """Sequences of one class, and the score of candidates on them.

    Args:
        clips: the sequences.
        scorer: compares tracks with the truth.
        metric: one of `METRICS`.
        executor: where they are tracked; by default in this process.
        note: is called when a process has died.
    """

    def __init__(
        self,
        clips: Sequence[Clip],
        scorer: Scorer,
        metric: str,
        executor: Executor | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.clips = clips
        self.scorer = scorer
        self.metric = metric
        own = [clip.truth.take(clip.truth.names == scorer.name) for clip in clips]
        self.boxes = tuple(int((~truth.ignored).sum()) for truth in own)
        """Truth boxes of each sequence that count."""
        self._objects = [len(set(truth.id[~truth.ignored].tolist())) for truth in own]
        self._note = note
        self._executor = executor or Here()
        self._executor.start(_measure, (clips, scorer))
        warm_up()

    def figures(self, parameters: Parameters, clips: Sequence[int]) -> Figures:
        """Return the figures of some sequences, tracked with some parameters."""
        tasks = [(clip, parameters) for clip in clips]
        measured: list[Measured] = values(
            self._executor, tasks, lambda task: f"sequence {self.clips[task[0]].name}", self._note
        )
        return self.scorer.figures(measured)

    def value(self, figures: Figures, clips: Sequence[int]) -> float:
        return metric(self.metric, figures, sum(self._objects[i] for i in clips))


def _measure(shared: tuple[Sequence[Clip], Scorer], task: tuple[int, Parameters]) -> Measured:
    clips, scorer = shared
    clip, parameters = task
    return scorer.measure(clips[clip], track_clip(clips[clip], parameters))

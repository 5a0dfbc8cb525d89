"""How well tracks agree with the truth: from a clip and its tracks to something small, and from those to figures.

A scorer measures each sequence on its own, so that processes can share the work, and sums up any choice of sequences:
all of them, those of a fold, or all but one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from optipmb_client.datasets import DataSequence
from optipmb_client.datasets.nuscenes import NuScenesSequence
from optipmb_client.evaluation import Case, Rules, default_rules
from optipmb_client.evaluation.ab3dmot import ab3dmot_rules
from optipmb_client.evaluation.cases import prepare
from optipmb_client.evaluation.figures import CENTRE_DISTANCE
from optipmb_client.evaluation.nuscenes_figures import evaluate_class
from optipmb_client.evaluation.nuscenes_matching import Pairing, pair
from optipmb_client.evaluation.nuscenes_scene import NuScenesConfig, NuScenesScene, prepare_scene
from optipmb_client.geometry import Bools, to_sensor
from optipmb_client.results import ResultTable
from optipmb_client.results.nuscenes import NUSCENES_CLASSES
from optipmb_client.tuning.figures import Figures, ab3dmot_figures, distance_figures
from optipmb_client.tuning.material import Clip

__all__ = ["BoxScorer", "Measured", "NuScenesScorer", "Scorer", "rules_of", "scorer_of"]


@dataclass(frozen=True)
class Measured:
    """One sequence: truth and tracks with the pairs that may match."""

    case: Case
    """By the rules of the benchmark."""
    near: Case
    """By the distance of the centres, for HOTA."""
    official: Pairing | None = None
    """By the rules of the nuScenes benchmark."""


class Scorer(Protocol):
    """Compares tracks with the truth, for one class."""

    @property
    def name(self) -> str:
        """The class."""

    @property
    def rules(self) -> Rules:
        """What is ignored, and what is excused."""

    @property
    def near(self) -> Rules:
        """By the distance of centres."""

    def counts(self, clip: Clip, tracks: ResultTable) -> Bools:
        """Return which of the tracks of a clip (R,), in the world frame, the benchmark looks at."""

    def measure(self, clip: Clip, tracks: ResultTable) -> Measured:
        """Compare the tracks of a clip, in the world frame, with its truth."""

    def figures(self, measured: Sequence[Measured]) -> Figures:
        """Return the figures of some sequences together."""


@dataclass(frozen=True)
class BoxScorer:
    """The figures of one class by some rules."""

    name: str
    rules: Rules
    near: Rules
    """By the distance of centres, for HOTA; the same where the rules are so themselves."""

    def counts(self, clip: Clip, tracks: ResultTable) -> Bools:  # noqa: ARG002  part of the protocol
        """Return which tracks (R,) the benchmark looks at: all."""
        return np.ones(len(tracks), dtype=np.bool_)

    def measure(self, clip: Clip, tracks: ResultTable) -> Measured:
        """Compare the tracks of a clip, in the world frame, with its truth."""
        near = prepare(clip.world, tracks, self.name, self.near, clip.name)
        if self.rules.measure == "distance":
            return Measured(near, near)
        when = tracks.frame
        center, yaw = to_sensor(clip.rotation[when], clip.translation[when], tracks.center, tracks.yaw)
        local = replace(tracks, center=center, yaw=yaw)
        return Measured(prepare(clip.truth, local, self.name, self.rules, clip.name), near)

    def figures(self, measured: Sequence[Measured]) -> Figures:
        """Return the figures of some sequences together."""
        near = [one.near for one in measured]
        if self.rules.measure == "distance":
            return distance_figures(near, self.near)
        return ab3dmot_figures([one.case for one in measured], near, self.rules, self.near)


@dataclass(frozen=True)
class NuScenesScorer:
    """The figures of one class by the nuScenes benchmark; HOTA and sAMOTA by the distance of the centres."""

    boxes: BoxScorer
    scenes: dict[str, NuScenesScene]
    config: NuScenesConfig

    @property
    def name(self) -> str:
        """The class."""
        return self.boxes.name

    @property
    def rules(self) -> Rules:
        """What is ignored, and what is excused."""
        return self.boxes.rules

    @property
    def near(self) -> Rules:
        """By the distance of centres."""
        return self.boxes.near

    def counts(self, clip: Clip, tracks: ResultTable) -> Bools:
        """Return which tracks (R,) are within the range of the class."""
        ego = self.scenes[clip.name].ego[tracks.frame]
        distance = np.linalg.norm(tracks.center[:, :2] - ego, axis=1)
        return np.asarray(distance < self.config.class_range[self.name], dtype=np.bool_)

    def measure(self, clip: Clip, tracks: ResultTable) -> Measured:
        """Compare the tracks of a clip, in the world frame, with its truth."""
        scene = self.scenes[clip.name]
        label = NUSCENES_CLASSES.index(self.name)
        found = pair(
            scene.truth,
            scene.tracks(tracks, self.config),
            label,
            len(scene.stamp_us),
            self.config.match_distance,
        )
        return replace(self.boxes.measure(clip, tracks.take(self.counts(clip, tracks))), official=found)

    def figures(self, measured: Sequence[Measured]) -> Figures:
        """Return the figures of some sequences together."""
        found = evaluate_class([one.official for one in measured if one.official is not None], self.config)
        best = found.best
        return replace(
            self.boxes.figures(measured),
            amota=found.amota,
            amotp=found.amotp,
            mota=best.mota,
            motp=best.motp,
            ids=best.ids,
            frag=best.frag,
            fp=best.fp,
            fn=best.fn,
            gt=best.gt,
            threshold=best.threshold,
        )


def rules_of(dataset: str) -> Rules:
    """Return the rules by which boxes of a dataset are compared here."""
    return ab3dmot_rules() if dataset == "kitti" else default_rules(dataset)


def scorer_of(dataset: str, name: str, sequences: Sequence[DataSequence]) -> Scorer:
    """Return the scorer of a class of a dataset."""
    boxes = BoxScorer(name, rules_of(dataset), default_rules(dataset, "distance", CENTRE_DISTANCE))
    scenes = [sequence for sequence in sequences if isinstance(sequence, NuScenesSequence)]
    if not scenes or len(scenes) < len(sequences):
        return boxes
    config = NuScenesConfig(class_range={name: NuScenesConfig().class_range[name]})
    return NuScenesScorer(boxes, {scene.name: prepare_scene(scene, config) for scene in scenes}, config)

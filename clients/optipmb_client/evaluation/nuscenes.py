"""The nuScenes tracking benchmark: results in the official layout against the official tables.

The definitions are those of the benchmark (tracking_nips_2019), written down in the modules that this one puts
together: `nuscenes_scene` (what is compared), `nuscenes_matching`, `nuscenes_figures`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from optipmb_client.datasets.nuscenes import NuScenesDataset
from optipmb_client.evaluation.nuscenes_figures import NuScenesClass, NuScenesFigures, evaluate_class, plain
from optipmb_client.evaluation.nuscenes_matching import pair
from optipmb_client.evaluation.nuscenes_scene import NuScenesConfig, NuScenesScene, prepare_scene
from optipmb_client.files import DatasetError
from optipmb_client.results import ResultTable
from optipmb_client.results.nuscenes import NUSCENES_CLASSES, read_nuscenes_results, result_table

_SUMMED = ("mt", "ml", "tp", "fp", "fn", "ids", "frag")


@dataclass(frozen=True)
class NuScenesScores:
    """Figures of all classes."""

    scenes: tuple[str, ...]
    classes: Mapping[str, NuScenesClass]
    overall: Mapping[str, float]
    """By official name, over the classes that the truth has: sums of the counts, means of everything else, also of the
    number of truth boxes."""

    def to_json(self) -> dict[str, Any]:
        """Return everything but the curves as plain values; None for figures that are not defined."""
        return {
            "scenes": list(self.scenes),
            "overall": {name: plain(value) for name, value in self.overall.items()},
            "classes": {name: scores.to_json() for name, scores in self.classes.items()},
        }


def evaluate_nuscenes(
    root: Path, results: Path, sequences: Sequence[str] = (), config: NuScenesConfig | None = None
) -> NuScenesScores:
    """Return the figures of a result file.

    Args:
        root: the folder of the dataset.
        results: a file in the layout of tracking submissions, or the folder with `tracking_results.json`.
        sequences: scenes and splits to evaluate; by default those of which the file has samples.
        config: other settings than the official ones.

    Raises:
        DatasetError: the data or the results are not there or not in their layout, a scene has no annotations, or the
            results lack a sample of it.

    """
    config = config or NuScenesConfig()
    dataset = NuScenesDataset(root, clouds=False)
    submission = read_nuscenes_results(results)
    scenes = dataset.tables.scenes.values()
    names = sequences or [s.name for s in scenes if any(token in submission.rows for token in s.tokens)]
    if not names:
        raise DatasetError(submission.path, f"samples of scenes in {dataset.tables.folder}", "none")
    pairs = []
    for sequence in dataset.sequences(names):
        if not len(sequence.annotations()):
            raise DatasetError(dataset.tables.folder, f"annotations of {sequence.name}", "none")
        table = result_table(submission, sequence.name, sequence.samples)
        pairs.append((prepare_scene(sequence, config), table))
    return evaluate_scenes(pairs, config)


def evaluate_scenes(
    pairs: Sequence[tuple[NuScenesScene, ResultTable]], config: NuScenesConfig | None = None
) -> NuScenesScores:
    """Return the figures of tracks that are in memory.

    Args:
        pairs: scenes, made by `prepare_scene` with the same settings, and their tracks in the world frame; frames count
            the keyframes of the scene.
        config: other settings than the official ones.

    """
    config = config or NuScenesConfig()
    scenes = [(scene, scene.tracks(table, config)) for scene, table in pairs]
    classes = {}
    for name in config.class_range:
        label = NUSCENES_CLASSES.index(name)
        classes[name] = evaluate_class(
            [pair(scene.truth, tracks, label, len(scene.stamp_us), config.match_distance) for scene, tracks in scenes],
            config,
        )
    return NuScenesScores(tuple(scene.name for scene, _ in pairs), classes, _overall(classes))


def _overall(classes: Mapping[str, NuScenesClass]) -> dict[str, float]:
    overall = {
        "amota": _gather([scores.amota for scores in classes.values()]),
        "amotp": _gather([scores.amotp for scores in classes.values()]),
    }
    for item in fields(NuScenesFigures):
        if item.name != "threshold":
            values = [getattr(scores.best, item.name) for scores in classes.values()]
            overall[item.name] = _gather(values, summed=item.name in _SUMMED)
    return overall


def _gather(values: list[float], *, summed: bool = False) -> float:
    known = [value for value in values if not math.isnan(value)]
    if summed:
        return math.fsum(known)
    return math.fsum(known) / len(known) if known else math.nan

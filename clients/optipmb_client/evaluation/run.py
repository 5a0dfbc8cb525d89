"""Result files of a dataset against its truth.

Conventions: truth is carried to the sensor frame of each frame, where the result files have their boxes; so a tilt of
the sensor changes nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from optipmb_client.datasets import DataSequence
from optipmb_client.evaluation.cases import Case, Measure, Rules, prepare
from optipmb_client.evaluation.clear import ClearResult, Sweep, clear, combine, sweep
from optipmb_client.evaluation.tracks import read_compared

_ALIKE = {"Car": ("Van",), "Pedestrian": ("Person", "Person_sitting")}


def default_rules(dataset: str, measure: Measure | None = None, limit: float | None = None) -> Rules:
    """Return the usual rules of a dataset.

    kitti: AB3DMOT's: 3D intersection over union of a quarter, each frame matched on its own, identity changes counted
    from one frame to the next, vans ignored for cars and sitting persons for pedestrians, no false tracks that are at
    most 25 pixels high or in unannotated regions. Others: centres within 2 metres in the plane, with continuity and
    memory.
    """
    if dataset == "kitti":
        measure = measure or "iou_3d"
        least = limit if limit is not None else (0.25 if measure == "iou_3d" else 2.0)
        return Rules(measure, least, continuity=False, memory=False, neighbours=_ALIKE, min_height=25.0, regions=True)
    measure = measure or "distance"
    return Rules(measure, limit if limit is not None else (2.0 if measure == "distance" else 0.25))


@dataclass(frozen=True)
class ClassResult:
    """The figures of one class."""

    name: str
    total: ClearResult
    """All tracks, all sequences."""
    sequences: dict[str, ClearResult]
    """All tracks, by sequence."""
    sweep: Sweep
    """All sequences, over thresholds on the mean score of a track."""


def evaluate_files(
    sequences: Sequence[DataSequence],
    results: Path,
    names: Sequence[str],
    rules: Rules,
    warn: Callable[[str], None] | None = None,
) -> list[ClassResult]:
    """Return the figures of each class from the tracks of each sequence.

    Args:
        sequences: what to compare with; each must have a truth.
        results: the folder of the result files, or a table of tracks.
        names: classes; those that occur neither in the truth nor in the results are left out.
        rules: how to compare.
        warn: is called with each assumption.

    Raises:
        DatasetError: a sequence has no truth, or its result file is missing or wrong.

    """
    cases: dict[str, list[Case]] = {name: [] for name in names}
    pairs = read_compared(sequences, results, names, warn)
    for sequence, (truth, table) in zip(sequences, pairs, strict=True):
        local = truth.to_sensor(sequence.poses)
        for name in names:
            cases[name].append(prepare(local, table, name, rules, sequence.name))
    return [
        _class_result(name, parts, rules)
        for name, parts in cases.items()
        if any(len(part.truth_id) or len(part.track_id) for part in parts)
    ]


def _class_result(name: str, cases: list[Case], rules: Rules) -> ClassResult:
    single = {case.sequence: clear(case, rules) for case in cases}
    return ClassResult(name, combine(single.values()), single, sweep(cases, rules))

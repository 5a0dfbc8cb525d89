"""Result files drawn: which tracks are shown, and what they are compared with."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optipmb_client.animation import animate_tracks
from optipmb_client.datasets import DataSequence
from optipmb_client.evaluation import ClassResult
from optipmb_client.evaluation.tracks import read_tracks
from optipmb_client.pictures import Panel, draw_tracks
from optipmb_client.results import ResultTable


def draw_results(
    picture: Path,
    sequence: DataSequence,
    folders: Sequence[Path],
    results: Sequence[Sequence[ClassResult]],
    score: float | None = None,
) -> None:
    """Draw the result files of a sequence from above.

    Args:
        picture: The PNG file, or the GIF file of a moving picture of the first tracker.
        sequence: What was tracked.
        folders: Where its result files are, or tables of tracks: one for each tracker.
        results: Figures of the classes of each tracker; their misses and identity changes are marked.
        score: Least mean score of the tracks that are shown; default: the best threshold of each class, by `results`.

    Raises:
        DatasetError: There is no such result file, or it is wrong.
        ClientError: matplotlib is not installed.
    """
    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(folder) for folder in folders]
    panels = []
    for folder, name, own in zip(folders, names, results, strict=True):
        table = read_tracks(folder, sequence).to_world(sequence.poses)
        best = [result.sweep.results[result.sweep.best] for result in own]
        panels.append(Panel(_from_score(table, own, score), best, name if len(names) > 1 else ""))
    if picture.suffix == ".gif":
        animate_tracks(picture, sequence, panels[0].tracks, sequence.truth())
    else:
        draw_tracks(picture, sequence, panels, sequence.truth())


def _from_score(table: ResultTable, results: Sequence[ClassResult], score: float | None) -> ResultTable:
    """Return the tracks whose mean score reaches the threshold of their class."""
    if not len(table):
        return table
    best = {result.name: result.sweep.thresholds[result.sweep.best] for result in results}
    least = np.array([score if score is not None else best.get(label, 0.0) for label in table.labels])
    _, which = np.unique(table.id, return_inverse=True)
    mean = np.round(np.bincount(which, table.score) / np.bincount(which), 12)  # as thresholds are
    return table.take(np.asarray(mean[which] >= least[table.label], dtype=np.bool_))

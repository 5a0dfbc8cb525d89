"""Result files drawn: which tracks are shown, and what they are compared with."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optipmb_client.animation import animate_tracks
from optipmb_client.datasets import DataSequence
from optipmb_client.evaluation import ClassResult
from optipmb_client.evaluation.tracks import read_tracks
from optipmb_client.pictures import draw_tracks
from optipmb_client.results import ResultTable

__all__ = ["draw_results"]


def draw_results(
    picture: Path,
    sequence: DataSequence,
    folder: Path,
    results: Sequence[ClassResult] = (),
    score: float | None = None,
) -> None:
    """Draw the result file of a sequence from above.

    Args:
        picture: The PNG file, or the GIF file of a moving picture.
        sequence: What was tracked.
        folder: Where its result file is, or a table of tracks.
        results: Figures of the classes; their misses and identity changes are marked.
        score: Least mean score of the tracks that are shown; default: the best threshold of each class, by `results`.

    Raises:
        DatasetError: There is no such result file, or it is wrong.
        ClientError: matplotlib is not installed.
    """
    table = read_tracks(folder, sequence).to_world(sequence.poses)
    shown = _from_score(table, results, score)
    if picture.suffix == ".gif":
        animate_tracks(picture, sequence, shown, sequence.truth())
        return
    best = [result.sweep.results[result.sweep.best] for result in results]
    draw_tracks(picture, sequence, shown, sequence.truth(), best)


def _from_score(table: ResultTable, results: Sequence[ClassResult], score: float | None) -> ResultTable:
    """Return the tracks whose mean score reaches the threshold of their class."""
    if not len(table):
        return table
    best = {result.name: result.sweep.thresholds[result.sweep.best] for result in results}
    least = np.array([score if score is not None else best.get(label, 0.0) for label in table.labels])
    _, which = np.unique(table.id, return_inverse=True)
    mean = np.round(np.bincount(which, table.score) / np.bincount(which), 12)  # as thresholds are
    return table.take(np.asarray(mean[which] >= least[table.label], dtype=np.bool_))

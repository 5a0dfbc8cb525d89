"""Figures of several trackers and classes in several processes; the results are those of one process."""

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from optipmb_client.datasets import DatasetArguments
from optipmb_client.evaluation.figures import ClassFigures, Settings, evaluate_figures, load_recordings

__all__ = ["FiguresJob", "run_jobs"]


@dataclass(frozen=True)
class FiguresJob:
    """The figures of one class of one tracker, in words that another process understands."""

    data: DatasetArguments
    sequences: tuple[str, ...]
    tracks: Path
    name: str
    settings: Settings
    threshold: float | None
    """Of the tracks that are also evaluated without the others; None: as `evaluate_figures` chooses it."""


def run_jobs(work: Sequence[FiguresJob], processes: int) -> Iterator[list[ClassFigures]]:
    """Yield the figures of each job, none for a class that neither truth nor tracks have, in their order.

    Raises:
        DatasetError: as `load_recordings`.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy the locks of numba's threads
    with ProcessPoolExecutor(min(processes, len(work)), context) as pool:
        yield from pool.map(_run, work)


def _run(job: FiguresJob) -> list[ClassFigures]:
    sequences = list(job.data.open().sequences(list(job.sequences)))
    recordings = load_recordings(job.data.name, sequences, job.tracks)
    thresholds = {} if job.threshold is None else {job.name: job.threshold}
    return evaluate_figures(job.data.name, recordings, (job.name,), job.settings, thresholds)

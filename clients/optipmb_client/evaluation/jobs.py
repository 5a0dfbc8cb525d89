"""Figures of several trackers and classes, one task for each class of each tracker."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from optipmb_client.datasets import DataSequence, DatasetArguments
from optipmb_client.evaluation.figures import ClassFigures, Recording, Settings, evaluate_figures, load_recordings

__all__ = ["Evaluation", "FiguresTask", "figures_of"]


@dataclass(frozen=True)
class Evaluation:
    """What all tasks share; can be sent to another process without `here`."""

    data: DatasetArguments
    names: tuple[str, ...]
    """Of the sequences."""
    settings: Settings
    classes: tuple[str, ...] = ()
    """By whose names those of truth and tracks are called."""
    here: Sequence[DataSequence] | None = None
    """The sequences, where this process has opened them."""
    _loaded: dict[Path, Sequence[Recording]] = field(default_factory=dict)

    @cached_property
    def sequences(self) -> Sequence[DataSequence]:
        """The sequences; a process opens them once."""
        return self.here or self.data.open().sequences(self.names)

    def recordings(self, tracks: Path) -> Sequence[Recording]:
        """Return truth and tracks; those of the last tracker are kept."""
        if tracks not in self._loaded:
            self._loaded.clear()
            self._loaded[tracks] = load_recordings(self.data.name, self.sequences, tracks, self.classes)
        return self._loaded[tracks]


@dataclass(frozen=True)
class FiguresTask:
    """One class of one tracker."""

    tracks: Path
    name: str
    threshold: float | None
    """Of the tracks that are also evaluated without the others; None: as `evaluate_figures` chooses it."""

    def __str__(self) -> str:
        return f"{self.name} of {self.tracks}"


def figures_of(shared: Evaluation, task: FiguresTask) -> list[ClassFigures]:
    """Return the figures of one class of one tracker; none for a class that neither truth nor tracks have.

    Raises:
        DatasetError: as `load_recordings`.
    """
    thresholds: Mapping[str, float] = {} if task.threshold is None else {task.name: task.threshold}
    recordings = shared.recordings(task.tracks)
    return evaluate_figures(shared.data.name, recordings, (task.name,), shared.settings, thresholds)

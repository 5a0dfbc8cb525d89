"""Tracking the recordings of a dataset, one task each: in this process, in several, or on a Ray cluster."""

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from optipmb import Modules, Parameters
from optipmb_client.bulk import Done, Executor, Failed, Here, Outcome, in_order, run
from optipmb_client.datasets import DataSequence, Dataset, DatasetArguments
from optipmb_client.errors import ClientError, UsageError
from optipmb_client.files import remove_unfinished
from optipmb_client.offline import track_whole
from optipmb_client.recording import Latency, Results, horizons_for, latency
from optipmb_client.results.nuscenes import NUSCENES_MAX_BOXES
from optipmb_client.table_files import Columns

SHOWN: Final = 20  # recordings that failed, named in the error


@dataclass(frozen=True)
class TrackedSequence:
    """What tracking one sequence took and gave. `step` are the durations of the tracker's steps."""

    name: str
    file: Path
    frames: int
    clouds: int
    detections: int
    left_out: dict[str, int]
    """Number of detections of each class that the profile lacks, or that are below its score filter."""
    estimated: int  # frames in which the motion of the sensor was estimated
    cut: tuple[int, int]  # number of boxes beyond those that a benchmark accepts in a sample, and of the samples
    tracks: int
    confirmed: int  # tracks that were confirmed in some frame
    seconds: float
    step: Latency | None


@dataclass(frozen=True)
class Opened:
    """A dataset that this process has opened, and in the process that was asked also the sequences."""

    dataset: Dataset
    sequences: Mapping[str, DataSequence] | None = None
    on_frame: Callable[[], None] = lambda: None

    def sequence(self, name: str) -> DataSequence:
        """Return a sequence; elsewhere one that is read for this call, as so many cannot all be kept."""
        if self.sequences is not None:
            return self.sequences[name]
        (sequence,) = self.dataset.sequences([name])
        return sequence


@dataclass(frozen=True)
class Tracking:
    """What all sequences of a run share; can be sent to another process without `here`."""

    data: DatasetArguments | None
    out: Path
    parameters: Parameters
    classes: tuple[str, ...]
    modules: Modules | None
    full: bool
    smooth: bool
    here: Opened | None

    @functools.cached_property
    def opened(self) -> Opened:
        """The dataset; a process opens it once."""
        if self.here is not None:
            return self.here
        if self.data is None:
            raise UsageError("several processes need to know which data to open")
        return Opened(self.data.open())


class RecordingsFailed(ClientError):  # noqa: N818  as its siblings
    """Some of several recordings failed; the others are tracked, and their results are written.

    Attributes:
        failures: Name of the recording and what was wrong.
    """

    def __init__(self, failures: Mapping[str, Failed], count: int) -> None:
        self.failures = dict(failures)
        names = " ".join([*itertools.islice(failures, SHOWN), *(["…"] if len(failures) > SHOWN else [])])
        super().__init__(f"{len(failures)} of {count} recordings failed, the others are tracked: {names}")


def _track_one(shared: Tracking, name: str) -> tuple[TrackedSequence, Path | Columns]:
    """Track one sequence and write its results; idempotent. Gives the rows where all sequences share one table."""
    opened = shared.opened
    sequence = opened.sequence(name)
    found = track_whole(
        shared.parameters, sequence, shared.classes, shared.modules, smooth=shared.smooth, on_frame=opened.on_frame
    )
    written = Results(opened.dataset, shared.out, full=shared.full).write(sequence, found.tracks)
    limited = opened.dataset.name == "nuscenes" and isinstance(written, Path)
    counts = [len(one.id) for one in found.tracks.values()] if limited else []
    beyond = [count - NUSCENES_MAX_BOXES for count in counts if count > NUSCENES_MAX_BOXES]
    return TrackedSequence(
        name,
        written if isinstance(written, Path) else shared.out,
        len(found.tracks),
        found.clouds,
        found.detections,
        found.left_out,
        found.estimated,
        (sum(beyond), len(beyond)),
        len({int(number) for one in found.tracks.values() for number in one.id}),
        len({int(number) for one in found.tracks.values() for number in one.id[one.confirmed == 1]}),
        found.seconds,
        latency(found.steps_ns),
    ), written


def track(  # noqa: PLR0913  one argument per decision of the caller
    dataset: Dataset,
    sequences: Sequence[DataSequence],
    out: Path,
    *,
    parameters: Parameters,
    data: DatasetArguments | None = None,
    classes: Sequence[str] = (),
    modules: Modules | None = None,
    full: bool = False,
    smooth: bool = False,
    executor: Executor | None = None,
    on_frame: Callable[[], None] = lambda: None,
    note: Callable[[str], None] = lambda _: None,
) -> Iterator[TrackedSequence]:
    """Track sequences, one task each, and write their results into `out`, a folder or a table.

    Yields each sequence when it and those before it are done and written. With `full`, all that is known of the tracks
    is written too. With `smooth`, states are given all frames of their track (`optipmb_client.smoothing`). The results
    are the same bytes with any executor; those of other processes open `data`. What fails does not stop the others.

    Raises:
        RecordingsFailed: Some of several sequences failed; raised when all others are done and written.
        UsageError, ClientError: All of them failed.
    """
    executor = executor or Here()
    if (horizons := horizons_for(out)) is not None:
        parameters = parameters.model_copy(update={"horizons": horizons})
    names = tuple(one.name for one in sequences)
    opened = Opened(dataset, {one.name: one for one in sequences}, on_frame) if executor.here else None
    executor.start(_track_one, Tracking(data, out, parameters, tuple(classes), modules, full, smooth, opened))
    results = Results(dataset, out, full=full)
    outcomes = run(executor, names, lambda name: f"recording {name}", note)
    failures: dict[str, Failed] = {}
    collected = _collected(outcomes, sequences, results, opened, on_frame, note)
    for name, one in zip(names, in_order(collected), strict=True):
        if isinstance(one, Failed):
            failures[name] = one
        else:
            yield one
    if len(failures) == len(names) > 0:
        raise failures[names[0]].error()
    results.close(sequences)
    if opened is None:
        remove_unfinished(results.files)
    if failures:
        raise RecordingsFailed(failures, len(names))


def _collected(
    outcomes: Iterable[Outcome],
    sequences: Sequence[DataSequence],
    results: Results,
    opened: Opened | None,
    on_frame: Callable[[], None],
    note: Callable[[str], None],
) -> Iterator[tuple[int, TrackedSequence | Failed]]:
    """Yield the place of each sequence that ended and what came of it; its results are taken, its frames counted."""
    for outcome in outcomes:
        sequence, result = sequences[outcome.place], outcome.result
        if isinstance(result, Done):
            tracked, written = result.value
            if results.take(sequence, written):
                yield outcome.place, tracked
            else:
                result = Failed(f"{written} is on another machine: --out needs a folder that all machines share")
        if isinstance(result, Failed):
            if len(sequences) > 1:
                note(f"recording {sequence.name} failed: {result.reason}")
            yield outcome.place, result
        if opened is None:
            for _ in range(len(sequence)):
                on_frame()

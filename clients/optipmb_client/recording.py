"""What offline tracking and replay share: which frames and objects of a dataset are used, and what tracking them gave.

Both paths must give the same bytes, so everything that decides about content stands here and is used by both.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from optipmb_schemas import Tracks

from optipmb_client.class_names import class_like
from optipmb_client.datasets import DataSequence, Dataset, DetectionFrame, Truth
from optipmb_client.errors import UsageError
from optipmb_client.results.full import full_path, write_full
from optipmb_client.results.table import join, track_columns
from optipmb_client.table_files import Columns, is_table, write_table


@dataclass(frozen=True)
class Latency:
    """Quantiles of some durations, in milliseconds."""

    p50_ms: float
    p99_ms: float
    max_ms: float


def latency(durations_ns: Sequence[int]) -> Latency | None:
    """Return the quantiles of durations in nanoseconds; None when there are none."""
    if not durations_ns:
        return None
    p50, p99, most = np.quantile(np.asarray(durations_ns, dtype=np.float64) / 1e6, [0.5, 0.99, 1.0])
    return Latency(float(p50), float(p99), float(most))


class Preloaded:
    """A sequence whose frames and clouds are all in memory, so that reading or generating them takes no time later."""

    def __init__(self, sequence: DataSequence) -> None:
        self.name = sequence.name
        self.labels = sequence.labels
        self.has_clouds = sequence.has_clouds
        self.poses = sequence.poses
        self._frames = list(sequence.frames())
        self._truth = sequence.truth()
        self.points = sum(len(frame.cloud.xyz) for frame in self._frames if frame.cloud is not None)

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self) -> Iterator[DetectionFrame]:
        """Iterate over the frames, in order."""
        return iter(self._frames)

    def truth(self) -> Truth | None:
        """Return the annotations of the sequence."""
        return self._truth


def selected_frames(sequence: DataSequence, classes: Sequence[str]) -> Iterator[DetectionFrame]:
    """Iterate over the frames of a sequence with the objects of the `classes` only; all objects when there are none.

    Raises:
        UsageError: The sequence has no detections of one of the classes.
    """
    for frame in sequence.frames():
        if not classes:
            yield frame
            continue
        wanted = [(name, class_like(name, frame.labels)) for name in classes]
        unknown = [name for name, known in wanted if known is None]
        if unknown:
            known = ", ".join(frame.labels)
            raise UsageError(f"sequence {sequence.name} has no detections of class {unknown[0]!r} (it has: {known})")
        rows = np.isin(frame.label, [i for i, name in enumerate(frame.labels) if name in dict(wanted).values()])
        yield frame.take(rows)


def horizons_for(out: Path) -> tuple[float, ...] | None:
    """Return the horizons of the predicted paths that a result needs: a bag of ROS 2; None: those of the profile."""
    if out.suffix != ".mcap":
        return None
    from optipmb_schemas.ros2.tracks import HORIZONS  # noqa: PLC0415  packages of an extra

    return HORIZONS


class Results:
    """Where the tracks of a run go: a result file for each sequence in a folder, or one table of all of them.

    `write` may be called in another process than `take` and `close`, on an object made of the same arguments.

    Args:
        dataset: What was tracked; it knows the format of its result files.
        out: The folder, or a file with the suffix of a table.
        full: Whether all that is known of the tracks is written: into a file beside each result file, or into further
            columns of the table; what an earlier run left beside a result file is removed otherwise.
    """

    def __init__(self, dataset: Dataset, out: Path, *, full: bool = False) -> None:
        self._dataset = dataset
        self._out = out
        self._full = full
        self._table = is_table(out) and not out.is_dir()
        self._taken: dict[str, Path | Columns] = {}

    def write(self, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path | Columns:
        """Write the tracks of a sequence by frame index; return the file, or its rows of the table of all."""
        if self._table:
            return track_columns(sequence, tracks, full=self._full)
        with self._dataset.writer(self._out, sequence) as writer:
            for index in sorted(tracks):
                writer.add(index, sequence.poses[index], tracks[index])
        if self._full:
            write_full(full_path(writer.path), tracks)
        else:
            full_path(writer.path).unlink(missing_ok=True)
        return writer.path

    def take(self, sequence: DataSequence, written: Path | Columns) -> bool:
        """Keep what `write` returned; return whether it is here: another machine may have written it elsewhere."""
        here = not isinstance(written, Path) or written.is_file()
        if here:
            self._taken[sequence.name] = written
        return here

    @property
    def files(self) -> list[Path]:
        """The result files so far."""
        return [written for written in self._taken.values() if isinstance(written, Path)]

    def close(self, sequences: Sequence[DataSequence]) -> None:
        """Write what holds all sequences: the table in the order of their names, or the file of the benchmark.

        Sequences that were not taken are missing in the table; a file of the benchmark is written of all or not at all.
        """
        parts = {name: written for name, written in self._taken.items() if not isinstance(written, Path)}
        if parts:
            write_table(self._out, join([parts[name] for name in sorted(parts)]))
        elif hasattr(self._dataset, "join") and all(one.name in self._taken for one in sequences):
            self._dataset.join(self._out, sequences)

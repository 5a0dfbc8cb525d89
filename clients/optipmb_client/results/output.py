"""Output of a run, the same for offline tracking and replay: result files in a folder, or one table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from optipmb_schemas import Tracks

from optipmb_client.datasets import DataSequence, Dataset
from optipmb_client.results.full import full_path, write_full
from optipmb_client.results.table import join, track_columns
from optipmb_client.table_files import Columns, is_table, write_table


@dataclass(frozen=True)
class Latency:
    """Quantiles of durations, in milliseconds."""

    p50_ms: float
    p99_ms: float
    max_ms: float


def latency(durations_ns: Sequence[int]) -> Latency | None:
    """Return the quantiles of durations in nanoseconds; None when there are none."""
    if not durations_ns:
        return None
    p50, p99, most = np.quantile(np.asarray(durations_ns, dtype=np.float64) / 1e6, [0.5, 0.99, 1.0])
    return Latency(float(p50), float(p99), float(most))


def horizons_for(out: Path) -> tuple[float, ...] | None:
    """Return the horizons of the predicted paths that a result needs: a bag of ROS 2; None: those of the profile."""
    if out.suffix != ".mcap":
        return None
    from optipmb_schemas.ros2.tracks import HORIZONS  # noqa: PLC0415  packages of an extra

    return HORIZONS


class Results:
    """Result files of a run: one for each sequence in a folder, or one table of all of them.

    `write` may be called in another process than `take` and `close`, on an object with the same arguments.

    Args:
        dataset: What was tracked; it knows the format of its result files.
        out: The folder, or a file with the suffix of a table.
        full: Whether all columns of the tracks are written: into a file beside each result file, or into further
            columns of the table. Otherwise a file that an earlier run left beside a result file is removed.
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
            return track_columns(sequence.name, tracks, sequence, full=self._full)
        path = self._dataset.write(self._out, sequence, tracks)
        if self._full:
            write_full(full_path(path), tracks)
        else:
            full_path(path).unlink(missing_ok=True)
        return path

    def take(self, sequence: DataSequence, written: Path | Columns) -> bool:
        """Keep what `write` returned; return whether it is here: another machine may have written it elsewhere."""
        here = not isinstance(written, Path) or written.is_file()
        if here:
            self._taken[sequence.name] = written
        return here

    @property
    def files(self) -> list[Path]:
        """Result files so far."""
        return [written for written in self._taken.values() if isinstance(written, Path)]

    def close(self, sequences: Sequence[DataSequence]) -> None:
        """Write the table in the order of the names, or the file of a benchmark that holds all sequences.

        Sequences that were not taken are missing in the table; a file of a benchmark is written of all or not at all.
        """
        parts = {name: written for name, written in self._taken.items() if not isinstance(written, Path)}
        if parts:
            write_table(self._out, join([parts[name] for name in sorted(parts)]))
        elif all(one.name in self._taken for one in sequences):
            self._dataset.join(self._out, sequences)

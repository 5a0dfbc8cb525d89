"""What offline tracking and replay share: which frames and objects of a dataset are used, and what tracking them gave.

Both paths must give the same bytes, so everything that decides about content stands here and is used by both.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optipmb_client.datasets import DataSequence, Dataset, DetectionFrame, Truth
from optipmb_client.errors import UsageError
from optipmb_client.results.full import FullRows, full_path, write_full

__all__ = ["Latency", "Preloaded", "latency", "selected_frames", "write_results"]


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
        unknown = [name for name in classes if name not in frame.labels]
        if unknown:
            known = ", ".join(frame.labels)
            raise UsageError(f"sequence {sequence.name} has no detections of class {unknown[0]!r} (it has: {known})")
        rows = np.isin(frame.label, [frame.labels.index(name) for name in classes])
        yield replace(
            frame,
            label=frame.label[rows],
            center=frame.center[rows],
            size=frame.size[rows],
            yaw=frame.yaw[rows],
            score=frame.score[rows],
            velocity=None if frame.velocity is None else frame.velocity[rows],
        )


def write_results(
    dataset: Dataset, sequence: DataSequence, out: Path, tracks: Mapping[int, FullRows], *, full: bool = False
) -> Path:
    """Write the result file of a sequence from its tracks by frame index, in order of frames; return its path.

    With `full`, a file with all columns is put beside it; without, one of an earlier run is removed.
    """
    with dataset.writer(out, sequence) as writer:
        for index in sorted(tracks):
            writer.add(index, sequence.poses[index], tracks[index])
    if full:
        write_full(full_path(writer.path), tracks)
    else:
        full_path(writer.path).unlink(missing_ok=True)
    return writer.path

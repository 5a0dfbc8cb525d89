"""Sensors that share one density: the sequences of a recording as one, their frames in the order of the service.

That order is by stamp, equal stamps by the name of the sensor. A service with the setting
`fuse` gives the same tracks for the same frames.
"""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks

from optipmb_tools.datasets.interface import DataSequence, Dataset, DetectionFrame, chosen
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Ints, Pose


class FusedSequence(DataSequence):
    """The sequences of several sensors of one recording as one."""

    def __init__(self, sensors: Sequence[DataSequence]) -> None:
        self.sensors = tuple(sorted(sensors, key=lambda one: one.sensor))
        first = self.sensors[0]
        self.name = first.recording
        self.labels: tuple[str, ...] = tuple(dict.fromkeys(label for one in self.sensors for label in one.labels))
        self.has_clouds: bool = any(one.has_clouds for one in self.sensors)
        if first.recording_columns:
            self.key_columns, self.time_column = first.recording_columns, first.time_column

    def __len__(self) -> int:
        return sum(map(len, self.sensors))

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in the order in which the service tracks them."""
        for index, (_, number, frame) in enumerate(self._merged()):
            yield replace(frame, index=index, sensor=self.sensors[number].sensor)

    def _merged(self) -> Iterator[tuple[int, int, DetectionFrame]]:
        streams = (_numbered(number, one) for number, one in enumerate(self.sensors))
        return heapq.merge(*streams, key=lambda one: one[:2])

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        """Sensor and own frame of each frame."""
        return [(number, frame.index) for _, number, frame in self._merged()]

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of each frame."""
        poses = [one.poses for one in self.sensors]
        return [poses[number][index] for number, index in self._places]

    @cached_property
    def times(self) -> NDArray[Any]:
        """(F,) as the table has them."""
        times = [one.times for one in self.sensors if one.times is not None]
        return np.array([times[number][index] for number, index in self._places])

    @cached_property
    def frame_columns(self) -> dict[str, NDArray[np.str_]]:
        """The column (F,) with the sensor of each frame."""
        names = np.array([one.sensor for one in self.sensors], dtype=np.str_)
        return {self.sensors[0].sensor_column: names[[number for number, _ in self._places]]}

    def rows(self, frame: int) -> Ints | None:
        """Return the row (M,) of each detection of a frame in the table that it came from."""
        number, index = self._places[frame]
        return self.sensors[number].rows(index)


def _numbered(number: int, sequence: DataSequence) -> Iterator[tuple[int, int, DetectionFrame]]:
    for frame in sequence.frames():
        yield frame.stamp_ns, number, frame


class FusedDataset(Dataset):
    """A data set whose sensors share a density: one sequence for each recording.

    Raises:
        DatasetError: The sequences of the data set do not say of which sensor they are.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.name = dataset.name
        self.notes: tuple[str, ...] = tuple(dataset.notes)
        found: dict[str, list[DataSequence]] = {}
        for one in dataset.sequences(["all"]):
            if not one.sensor:
                raise DatasetError("--fuse", "frames that name their sensor: a column `sensor`, streams", one.name)
            found.setdefault(one.recording, []).append(one)
        self._fused = {name: FusedSequence(sensors) for name, sensors in found.items()}

    @cached_property
    def profile(self) -> str:
        return self._dataset.profile

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the recordings of these names, or `all`."""
        return chosen(names, self._fused, f"recordings: {', '.join(self._fused)}", lambda one: one.replace("/", "."))

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write the results of a recording."""
        return self._dataset.write(out, sequence, tracks)

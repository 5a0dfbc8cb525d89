"""Sensors that share one density: the sequences of a recording as one, their frames in the order of the service.

That order is by stamp, equal stamps by the name of the sensor. So the tracks are those of a service with the setting
`fuse` for the same frames.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

from optipmb_client.datasets.interface import DataSequence, Dataset, DetectionFrame, Truth
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Ints, Pose
from optipmb_client.results import ResultWriter


class OfSensor(DataSequence, Protocol):
    """A sequence that says of which sensor it is."""

    @property
    def recording(self) -> str:
        """What the sequences of sensors that go together have in common, and their name as one."""

    @property
    def sensor(self) -> str:
        """Name of the sensor, by which frames with equal stamps are ordered."""

    @property
    def columns(self) -> dict[str, str]:
        """Columns of a table of tracks that are the same for the whole recording; empty: those of every dataset."""

    @property
    def sensor_column(self) -> str:
        """The column with the name of the sensor."""


class OfTable(OfSensor, Protocol):
    """A sequence of a table, which has columns of its own."""

    @property
    def time_column(self) -> str:
        """The column with the times."""

    @property
    def times(self) -> NDArray[Any]:
        """(F,) as the table has them."""


def _of_sensor(one: DataSequence) -> TypeGuard[OfSensor]:
    return bool(getattr(one, "sensor", ""))


def _of_table(one: OfSensor) -> TypeGuard[OfTable]:
    return bool(one.columns)


class FusedSequence:
    """The sequences of several sensors as one.

    Args:
        sensors: of one recording, by the names of the sensors.
    """

    def __init__(self, sensors: Sequence[OfSensor]) -> None:
        self.sensors = tuple(sorted(sensors, key=lambda one: one.sensor))
        self.name = self.sensors[0].recording
        self.labels = tuple(dict.fromkeys(label for one in self.sensors for label in one.labels))
        self.has_clouds = any(one.has_clouds for one in self.sensors)
        first = self.sensors[0]
        if _of_table(first):
            self.key_columns, self.time_column = first.columns, first.time_column

    def __len__(self) -> int:
        return sum(map(len, self.sensors))

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in the order in which the service tracks them."""
        for index, (_, _, frame) in enumerate(self._merged()):
            row_of = np.array([self.labels.index(name) for name in frame.labels], dtype=np.int64)
            label = row_of[frame.label] if len(frame) else frame.label
            yield replace(frame, index=index, labels=self.labels, label=label)

    def _merged(self) -> Iterator[tuple[int, int, DetectionFrame]]:
        streams = (_numbered(number, one) for number, one in enumerate(self.sensors))
        return heapq.merge(*streams, key=lambda one: one[:2])

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        """The sensor, and the frame of its own, of each frame."""
        return [(number, frame.index) for _, number, frame in self._merged()]

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of each frame."""
        poses = [one.poses for one in self.sensors]
        return [poses[number][index] for number, index in self._places]

    @cached_property
    def times(self) -> NDArray[Any]:
        """(F,) as the table has them."""
        times = [one.times for one in self.sensors if _of_table(one)]
        return np.array([times[number][index] for number, index in self._places])

    @property
    def frame_columns(self) -> dict[str, NDArray[np.str_]]:
        """Further columns (F,) of a table of tracks: the sensor of each frame."""
        names = np.array([one.sensor for one in self.sensors], dtype=np.str_)
        return {self.sensors[0].sensor_column: names[[number for number, _ in self._places]]}

    def rows(self, frame: int) -> Ints:
        """Return the rows of the table, or else the places in the frame, of the detections (M,) of a frame."""
        number, index = self._places[frame]
        rows: Callable[[int], Ints] | None = getattr(self.sensors[number], "rows", None)
        return self._counted if rows is None else rows(index)

    @cached_property
    def _counted(self) -> Ints:
        return np.arange(max((len(frame) for _, _, frame in self._merged()), default=0), dtype=np.int64)

    def truth(self) -> Truth | None:
        """Return None: truth is given for each sensor."""
        return None


def _numbered(number: int, sequence: DataSequence) -> Iterator[tuple[int, int, DetectionFrame]]:
    for frame in sequence.frames():
        yield frame.stamp_ns, number, frame


class FusedDataset:
    """A dataset whose sensors share a density: one sequence for each recording.

    Args:
        dataset: its sequences say of which sensor they are.

    Raises:
        DatasetError: they do not.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.name = dataset.name
        found: dict[str, list[OfSensor]] = {}
        for one in dataset.sequences(["all"]):
            if not _of_sensor(one):
                raise DatasetError("--fuse", "frames that name their sensor: a column `sensor`, streams", one.name)
            found.setdefault(one.recording, []).append(one)
        self._fused = {name: FusedSequence(sensors) for name, sensors in found.items()}

    @property
    def profile(self) -> str:
        """The parameter profile that fits it."""
        return self._dataset.profile

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed, a line each."""
        return tuple(getattr(self._dataset, "notes", ()))

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the recordings of these names, or `all`."""
        chosen: dict[str, DataSequence] = {}
        for name in names:
            for one in self._fused if name == "all" else (name.replace("/", "."),):
                if one not in self._fused:
                    raise DatasetError("--sequences", f"recordings: {', '.join(self._fused)}", repr(name))
                chosen[one] = self._fused[one]
        return list(chosen.values())

    def writer(self, out: Path, sequence: DataSequence) -> ResultWriter:
        """Return a writer of the results of a recording."""
        return self._dataset.writer(out, sequence)

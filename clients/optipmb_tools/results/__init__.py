"""Result files in the formats of the benchmarks, and tables of tracks.

Conventions: columns with one row per box; metres, radians, z up; `label` indexes `labels`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import Tracks

from optipmb_tools.geometry import Bools, Floats, Ints, PoseLike, stack_poses, to_sensor, to_world


@dataclass(frozen=True)
class BoxTable:
    """Boxes of one sequence, ordered by frame, in one frame of reference."""

    labels: tuple[str, ...]
    frame: Ints  # (R,)
    id: Ints  # (R,)
    label: Ints  # (R,) index into `labels`
    center: Floats  # (R, 3)
    size: Floats  # (R, 3) length, width, height
    yaw: Floats  # (R,)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def names(self) -> NDArray[np.str_]:
        """(R,) class names."""
        return np.asarray(self.labels, dtype=np.str_)[self.label] if self.labels else np.empty(0, dtype=np.str_)

    def take(self, rows: Ints | Bools) -> Self:
        """Return the chosen rows."""
        columns = [field.name for field in fields(self) if field.name not in _NOT_OF_ROWS]
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def of_class(self, name: str) -> Self:
        """Return the rows of one class."""
        return self.take(np.isin(self.label, [i for i, label in enumerate(self.labels) if label == name]))

    def to_world(self, poses: Sequence[PoseLike]) -> Self:
        """Return the boxes carried from the sensor frame of each row's frame to the world."""
        rotation, translation = stack_poses(poses)
        center, yaw = to_world(rotation[self.frame], translation[self.frame], self.center, self.yaw)
        return replace(self, center=center, yaw=yaw)

    def to_sensor(self, poses: Sequence[PoseLike]) -> Self:
        """Return the boxes carried from the world to the sensor frame of each row's frame; velocities stay."""
        rotation, translation = stack_poses(poses)
        center, yaw = to_sensor(rotation[self.frame], translation[self.frame], self.center, self.yaw)
        return replace(self, center=center, yaw=yaw)


_NOT_OF_ROWS: Final = {"labels", "notes", "regions", "labelled"}  # fields that have no value for each row


@dataclass(frozen=True)
class ResultTable(BoxTable):
    """All boxes of all tracks of one sequence."""

    score: Floats  # (R,)
    box2d: Floats  # (R, 4) x1 y1 x2 y2 in pixels; NaN where there is no image
    notes: tuple[str, ...] = ()  # assumptions about them, a line each


def empty_table(labels: tuple[str, ...] = ()) -> ResultTable:
    """Return a table without rows."""
    none = np.empty(0, dtype=np.int64)
    return ResultTable(
        labels, none, none, none, np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty((0, 4))
    )


def column_shape(name: str) -> tuple[int, ...]:
    """Return the shape of one row of a column of tracks."""
    return tuple(length for length in Tracks.arrays[name].shape if isinstance(length, int))


def stacked(parts: Sequence[Any], name: str) -> NDArray[Any]:
    """Return a column of the tracks of many frames, one frame below the other."""
    empty = np.empty((0, *column_shape(name)), Tracks.arrays[name].dtype)
    return np.concatenate([empty, *(getattr(part, name) for part in parts)])

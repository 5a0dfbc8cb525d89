"""Tracks as tables: what a writer takes and what a reader gives.

Conventions: columns with one row per box; metres, radians, z up; `label` indexes `labels`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, Self

import numpy as np

from optipmb_client.geometry import Bools, Floats, Ints, PoseLike, stack_poses, to_sensor, to_world


class TrackRows(Protocol):
    """The tracks of one frame, in the world frame; messages and in-process results both are of this shape."""

    @property
    def id(self) -> Ints:
        """(N,)."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Class names."""

    @property
    def label(self) -> Ints:
        """(N,) index into labels."""

    @property
    def center(self) -> Floats:
        """(N, 3)."""

    @property
    def size(self) -> Floats:
        """(N, 3) length, width, height."""

    @property
    def yaw(self) -> Floats:
        """(N,)."""

    @property
    def velocity(self) -> Floats:
        """(N, 2)."""

    @property
    def score(self) -> Floats:
        """(N,)."""

    @property
    def existence(self) -> Floats:
        """(N,) probability."""

    @property
    def confirmed(self) -> Bools | Ints | None:
        """(N,) flags; None where unknown."""


class ResultWriter(Protocol):
    """Takes the tracks of one sequence frame by frame; the file appears complete at `close`, or not at all."""

    @property
    def path(self) -> Path:
        """The finished file."""

    def add(self, index: int, pose: PoseLike, tracks: TrackRows) -> None:
        """Write the tracks (world frame) of frame `index`, whose sensor stood at `pose`."""

    def close(self) -> None:
        """Put the file in its place."""

    def discard(self) -> None:
        """Drop what was written."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: object, error: object, trace: object) -> None: ...


@dataclass(frozen=True)
class ResultTable:
    """All boxes of all tracks of one sequence, ordered by frame, in one frame of reference that the maker names."""

    labels: tuple[str, ...]
    frame: Ints
    """(R,)"""
    id: Ints
    """(R,)"""
    label: Ints
    """(R,)"""
    center: Floats
    """(R, 3)"""
    size: Floats
    """(R, 3)"""
    yaw: Floats
    """(R,)"""
    score: Floats
    """(R,)"""
    box2d: Floats
    """(R, 4) x1 y1 x2 y2 in pixels; NaN where there is no image."""
    notes: tuple[str, ...] = ()
    """Assumptions about them, a line each."""

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Ints | Bools) -> "ResultTable":
        """Return the chosen rows."""
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return replace(self, **columns)

    def of_class(self, name: str) -> "ResultTable":
        """Return the rows of one class."""
        return self.take(np.isin(self.label, [i for i, label in enumerate(self.labels) if label == name]))

    def to_world(self, poses: Sequence[PoseLike]) -> "ResultTable":
        """Return the table carried from the sensor frame of each row's frame to the world."""
        rotation, translation = stack_poses(poses)
        center, yaw = to_world(rotation[self.frame], translation[self.frame], self.center, self.yaw)
        return replace(self, center=center, yaw=yaw)

    def to_sensor(self, poses: Sequence[PoseLike]) -> "ResultTable":
        """Return the table carried from the world to the sensor frame of each row's frame."""
        rotation, translation = stack_poses(poses)
        center, yaw = to_sensor(rotation[self.frame], translation[self.frame], self.center, self.yaw)
        return replace(self, center=center, yaw=yaw)


_COLUMNS = ("frame", "id", "label", "center", "size", "yaw", "score", "box2d")


def empty_table(labels: tuple[str, ...] = ()) -> ResultTable:
    """Return a table without rows."""
    none = np.empty(0, dtype=np.int64)
    return ResultTable(
        labels, none, none, none, np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty((0, 4))
    )


def collect(frames: Sequence[tuple[int, TrackRows]]) -> ResultTable:
    """Return the tracks of many frames (index, tracks) as one table in the world frame, without image boxes.

    Raises:
        ValueError: the frames do not share one tuple of labels.

    """
    if not frames:
        return empty_table()
    labels = frames[0][1].labels
    if any(tracks.labels != labels for _, tracks in frames):
        raise ValueError("the frames of one table share one tuple of labels")
    count = sum(len(tracks.id) for _, tracks in frames)
    return ResultTable(
        labels=labels,
        frame=np.concatenate([np.full(len(tracks.id), index, dtype=np.int64) for index, tracks in frames]),
        id=np.concatenate([tracks.id for _, tracks in frames]),
        label=np.concatenate([tracks.label for _, tracks in frames]),
        center=np.concatenate([tracks.center for _, tracks in frames]),
        size=np.concatenate([tracks.size for _, tracks in frames]),
        yaw=np.concatenate([tracks.yaw for _, tracks in frames]),
        score=np.concatenate([tracks.score for _, tracks in frames]),
        box2d=np.full((count, 4), np.nan),
    )

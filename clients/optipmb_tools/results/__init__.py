"""Result files in the formats of the benchmarks, and tables of tracks.

Conventions: columns with one row per box; metres, radians, z up; `label` indexes `labels`.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Self
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import PATHS, Tracks

from optipmb_tools.files import DatasetError, write_whole
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
        columns = [field.name for field in fields(self) if field.name not in _NOT_OF_ROWS]
        taken: dict[str, Any] = {name: one[rows] for name in columns if (one := getattr(self, name)) is not None}
        return replace(self, **taken)

    def of_class(self, name: str) -> Self:
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
    confirmed: Bools | None = None  # (R,) None where the file does not tell
    velocity: Floats | None = None  # (R, 2) in the world, NaN where unknown; None where the file does not tell

    @property
    def shown(self) -> Self:
        """The rows that are shown, the confirmed ones; all where the file does not tell."""
        return self if self.confirmed is None else self.take(self.confirmed)


_DECIMALS: Final = 12
"""Of ranks: rounding in the sum must not tell tracks of equal scores apart."""


def ranks(identity: Ints, score: Floats) -> Floats:
    """Return the rank of the track of each row (R,), by which AMOTA, sAMOTA and thresholds sort tracks.

    The mean score of the frames that detect the track, times the share of its frames that do: as predicted rows have
    score zero, the mean of all rows.
    """
    _, which = np.unique(identity, return_inverse=True)
    count = np.maximum(np.bincount(which), 1)
    return np.asarray(np.round(np.bincount(which, score) / count, _DECIMALS)[which])


def column_shape(name: str) -> tuple[int, ...]:
    """Return the shape of one row of a column of tracks."""
    return tuple(length for length in Tracks.arrays[name].shape if isinstance(length, int))


def stacked(parts: Sequence[Any], name: str) -> NDArray[Any]:
    """Return a column of the tracks of many frames, one frame below the other."""
    empty = np.empty((0, *column_shape(name)), Tracks.arrays[name].dtype)
    return np.concatenate([empty, *(getattr(part, name) for part in parts)])


@dataclass(frozen=True, kw_only=True)
class FullTable(ResultTable):
    """The tracks of one sequence in the world frame, with their probabilities and covariances."""

    velocity: Floats  # (R, 2)
    yaw_rate: Floats  # (R,)
    acceleration: Floats  # (R,) along the heading
    existence: Floats  # (R,) probability
    covariance: Floats  # (R, 6, 6) of x, y, speed, heading, turn rate, acceleration
    age: Floats  # (R,) since the first detection
    time_since_detection: Floats  # (R,)
    detection: Ints  # (R,) index of the detection in its frame, -1 while missed


# In the order of the message
_COLUMNS: Final = tuple(
    name for name in Tracks.arrays if name in {field.name for field in fields(FullTable)} - {"confirmed"}
)


def full_table(labels: tuple[str, ...], tracks: Mapping[int, Any]) -> FullTable:
    """Return the tracks of each frame (`optipmb.Tracks`, or messages) as one table, without image boxes."""
    order = sorted(tracks)
    parts = [tracks[index] for index in order]
    frame = np.repeat(np.array(order, dtype=np.int64), [len(one.id) for one in parts])
    columns: dict[str, Any] = {name: stacked(parts, name) for name in _COLUMNS}
    return FullTable(labels=labels, frame=frame, box2d=np.full((len(frame), 4), np.nan), **columns)


def full_path(result: Path) -> Path:
    """Return the path of the file that belongs to a result file."""
    return result.with_suffix(".npz")


def write_full(path: Path, tracks: Mapping[int, Tracks]) -> None:
    """Write the tracks of a sequence by frame index; the file appears complete, or not at all.

    Result files of the benchmarks have no room for covariances and probabilities. This file holds them too, each
    column as a numpy array, one row per track and frame, ordered by frame and, in a frame, as in the result file; where
    tracks have predicted paths, these too, named as in messages. The same tracks always give the same bytes.
    """
    parts = [tracks[index] for index in sorted(tracks)]
    table = full_table(parts[0].labels if parts else (), tracks)
    columns = {name: getattr(table, name) for name in _COLUMNS}
    horizons = [one.horizons for one in parts if one.horizons is not None]
    if horizons and len(horizons) == len(parts) and len({one.tobytes() for one in horizons}) == 1:
        columns |= {name: np.concatenate([getattr(one, name) for one in parts]) for name in PATHS[1:]}
        columns["horizons"] = horizons[0]
    columns |= {"labels": np.array(table.labels, dtype=np.str_), "frame": table.frame}
    content = io.BytesIO()
    with ZipFile(content, "w", ZIP_DEFLATED) as archive:  # as numpy's own savez, but without the time of day
        for name, column in columns.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, column, allow_pickle=False)
    write_whole(path, content.getvalue())


def read_full(path: Path) -> FullTable:
    """Return the tracks of a sequence.

    Raises:
        DatasetError: The file is missing, no such file, or lacks a column.
    """
    what = "a file of tracks with all columns"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    except (BadZipFile, ValueError, EOFError) as error:
        raise DatasetError(path, what, "another kind of file") from error
    rows = len(arrays["frame"]) if arrays.get("frame", np.empty(())).ndim == 1 else -1
    for name in ("labels", "frame", *_COLUMNS):
        shape = (rows, *(column_shape(name) if name in _COLUMNS else ()))
        if name not in arrays or (name != "labels" and arrays[name].shape != shape):
            raise DatasetError(path, f"{what}: {name}", f"shape {arrays[name].shape}" if name in arrays else "none")
    columns: dict[str, Any] = {name: arrays[name] for name in ("frame", *_COLUMNS)}
    return FullTable(labels=tuple(map(str, arrays["labels"])), box2d=np.full((rows, 4), np.nan), **columns)

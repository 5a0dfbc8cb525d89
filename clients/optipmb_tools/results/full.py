"""All columns of the tracks of one sequence, in a file next to its result file: `NAME.npz` next to `NAME.txt`.

Result files of the benchmarks have no room for covariances and probabilities. This one holds every column of the tracks
as a numpy array, one row per track and frame, in the world frame, ordered by frame and, in a frame, as in the result
file; where tracks have predicted paths, these too, named as in messages. The same tracks always give the same bytes.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import numpy as np
from optipmb_schemas import PATHS, Tracks

from optipmb_tools.files import DatasetError, write_whole
from optipmb_tools.geometry import Floats, Ints
from optipmb_tools.results import BoxTable, column_shape, stacked


@dataclass(frozen=True)
class FullTable(BoxTable):
    """All tracks of one sequence in the world frame."""

    velocity: Floats  # (R, 2)
    yaw_rate: Floats  # (R,)
    acceleration: Floats  # (R,) along the heading
    existence: Floats  # (R,) probability
    score: Floats  # (R,)
    covariance: Floats  # (R, 6, 6) of x, y, speed, heading, turn rate, acceleration
    age: Floats  # (R,) since the first detection
    time_since_detection: Floats  # (R,)
    detection: Ints  # (R,) index of the detection in its frame, -1 while missed


COLUMNS: Final = tuple(field.name for field in fields(FullTable) if field.name not in {"labels", "frame"})
"""Columns of tracks in the order of the fields of `FullTable`."""


def full_path(result: Path) -> Path:
    """Return the path of the file that belongs to a result file."""
    return result.with_suffix(".npz")


def write_full(path: Path, tracks: Mapping[int, Tracks]) -> None:
    """Write the tracks of a sequence by frame index; the file appears complete, or not at all."""
    order = sorted(tracks)
    parts = [tracks[index] for index in order]
    count = [len(one.id) for one in parts]
    columns = {name: stacked(parts, name) for name in COLUMNS}
    labels = parts[0].labels if parts else ()
    horizons = [one.horizons for one in parts if one.horizons is not None]
    if horizons and len(horizons) == len(order) and len({one.tobytes() for one in horizons}) == 1:
        columns |= {name: np.concatenate([getattr(one, name) for one in parts]) for name in PATHS[1:]}
        columns["horizons"] = horizons[0]
    columns |= {"labels": np.array(labels, dtype=np.str_), "frame": np.repeat(np.array(order, dtype=np.int64), count)}
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
    for name in ("labels", "frame", *COLUMNS):
        shape = (rows, *(column_shape(name) if name in COLUMNS else ()))
        if name not in arrays or (name != "labels" and arrays[name].shape != shape):
            raise DatasetError(path, f"{what}: {name}", f"shape {arrays[name].shape}" if name in arrays else "none")
    labels = tuple(str(label) for label in arrays.pop("labels"))
    return FullTable(labels, *(arrays[name] for name in ("frame", *COLUMNS)))

"""Everything that is known of the tracks of one sequence, beside its result file: `NAME.npz` beside `NAME.txt`.

Result files of the benchmarks have no room for covariances and probabilities. This one holds every column of the tracks
as a numpy array, one row per track and frame, in the world frame, ordered by frame and, in a frame, as in the result
file; where tracks have predicted paths, these too, named as in messages. The same tracks always give the same bytes.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import PATHS

from optipmb_client.files import AtomicText, DatasetError
from optipmb_client.geometry import Floats, Ints
from optipmb_client.results.rows import TrackRows

_STATE = 6


class FullRows(TrackRows, Protocol):
    """The tracks of one frame with all that is known of them."""

    @property
    def yaw_rate(self) -> Floats:
        """(N,)."""

    @property
    def acceleration(self) -> Floats:
        """(N,)."""

    @property
    def covariance(self) -> Floats:
        """(N, 6, 6)."""

    @property
    def age(self) -> Floats:
        """(N,)."""

    @property
    def time_since_detection(self) -> Floats:
        """(N,)."""

    @property
    def detection(self) -> Ints:
        """(N,)."""

    @property
    def horizons(self) -> Floats | None:
        """(H,)."""

    @property
    def path_position(self) -> Floats | None:
        """(N, H, 2)."""

    @property
    def path_yaw(self) -> NDArray[np.float32] | None:
        """(N, H)."""

    @property
    def path_covariance(self) -> NDArray[np.float32] | None:
        """(N, H, 2, 2)."""


@dataclass(frozen=True)
class FullTable:
    """All tracks of one sequence in the world frame, ordered by frame: metres, radians, seconds."""

    labels: tuple[str, ...]
    frame: Ints
    """(R,)"""
    id: Ints
    """(R,)"""
    label: Ints
    """(R,) index into `labels`."""
    center: Floats
    """(R, 3)"""
    size: Floats
    """(R, 3) length, width, height."""
    yaw: Floats
    """(R,)"""
    velocity: Floats
    """(R, 2)"""
    yaw_rate: Floats
    """(R,)"""
    acceleration: Floats
    """(R,) along the heading."""
    existence: Floats
    """(R,) probability"""
    score: Floats
    """(R,)"""
    covariance: Floats
    """(R, 6, 6) of x, y, speed, heading, turn rate, acceleration."""
    age: Floats
    """(R,) since the first detection."""
    time_since_detection: Floats
    """(R,)"""
    detection: Ints
    """(R,) index of the detection in its frame, -1 while missed."""

    def __len__(self) -> int:
        return len(self.frame)


_TAILS = {"center": (3,), "size": (3,), "velocity": (2,), "covariance": (_STATE, _STATE)}
_WHOLE = {"id", "label", "detection"}
_COLUMNS = tuple(field.name for field in fields(FullTable) if field.name not in {"labels", "frame"})


def full_path(result: Path) -> Path:
    """Return the path of the file that belongs to a result file."""
    return result.with_suffix(".npz")


def write_full(path: Path, tracks: Mapping[int, FullRows]) -> None:
    """Write the tracks of a sequence by frame index; the file appears complete, or not at all."""
    order = sorted(tracks)
    count = [len(tracks[index].id) for index in order]
    columns: dict[str, np.ndarray] = {
        name: np.concatenate(
            [np.empty((0, *_TAILS.get(name, ())), _kind(name)), *(getattr(tracks[i], name) for i in order)]
        )
        for name in _COLUMNS
    }
    labels = tracks[order[0]].labels if order else ()
    horizons = [one for index in order if (one := tracks[index].horizons) is not None]
    if horizons and len(horizons) == len(order) and len({one.tobytes() for one in horizons}) == 1:
        columns |= {name: np.concatenate([getattr(tracks[i], name) for i in order]) for name in PATHS[1:]}
        columns["horizons"] = horizons[0]
    columns |= {"labels": np.array(labels, dtype=np.str_), "frame": np.repeat(np.array(order, dtype=np.int64), count)}
    content = io.BytesIO()
    with ZipFile(content, "w", ZIP_DEFLATED) as archive:  # as numpy's own savez, but without the time of day
        for name, column in columns.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, column, allow_pickle=False)
    file = AtomicText(path)
    try:
        file.write_bytes(content.getvalue())
        file.close()
    finally:
        file.discard()


def read_full(path: Path) -> FullTable:
    """Return the tracks of a sequence.

    Raises:
        DatasetError: the file is missing, no such file, or lacks a column.

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
        shape = (rows, *_TAILS.get(name, ()))
        if name not in arrays or (name != "labels" and arrays[name].shape != shape):
            raise DatasetError(path, f"{what}: {name}", f"shape {arrays[name].shape}" if name in arrays else "none")
    labels = tuple(str(label) for label in arrays.pop("labels"))
    return FullTable(labels, *(arrays[name] for name in ("frame", *_COLUMNS)))


def _kind(name: str) -> type[np.int64] | type[np.float64]:
    return np.int64 if name in _WHOLE else np.float64

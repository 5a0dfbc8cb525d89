"""Tracks as tables: one row per track and frame, in the world frame, in order of frames and, in a frame, of ids.

Columns: what names the recording and the time in the table of detections (for other datasets `sequence` and
`stamp_ns`), then frame (its number in the table of detections, or else counted from 0), id, class, x, y, z, l, w, h,
yaw, vx, vy, yaw_rate, acceleration, score, existence, age, time_since_detection and detection_row: the row of the table
(from 0; for other datasets the place in the frame) of the detection that the track was given, no value while it is
missed. A velocity has no value until it is known: from the second detection on, where the detector gives none. On
request the upper triangle of the covariance of (x, y, v, phi, omega, a) follows, `cov_x_x` to `cov_a_a`.
Metres, seconds, radians. The same tracks always give the same bytes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from optipmb_client.geometry import Ints, PoseLike
from optipmb_client.results.rows import TrackRows
from optipmb_client.table_files import Columns, write_table

if TYPE_CHECKING:
    from optipmb_client.results.full import FullRows

__all__ = ["COVARIANCE", "TableResultWriter", "TrackColumns", "join"]

_STATE: Final = ("x", "y", "v", "phi", "omega", "a")
COVARIANCE: Final = {f"cov_{_STATE[i]}_{_STATE[j]}": (i, j) for i in range(6) for j in range(i, 6)}
"""Column -> place in the covariance (6, 6)."""


class _Stamped(Protocol):
    @property
    def name(self) -> str: ...

    def frames(self) -> Iterator[Any]: ...


class TrackColumns:
    """Collects the tracks of one sequence as columns.

    Args:
        sequence: what was tracked; frames may be added in any order.
        full: whether the covariance is kept.
    """

    def __init__(self, sequence: _Stamped, *, full: bool = False) -> None:
        self._sequence = sequence
        self._full = full
        self._tracks: dict[int, FullRows] = {}

    def add(self, index: int, tracks: TrackRows) -> None:
        """Take the tracks (world frame) of frame `index`."""
        self._tracks[index] = cast("FullRows", tracks)

    def columns(self) -> Columns:
        """Return all rows."""
        sequence = self._sequence
        order = sorted(self._tracks)
        frame = np.repeat(np.array(order, dtype=np.int64), [len(self._tracks[i].id) for i in order])
        names = [name for i in order for name in np.asarray(self._tracks[i].labels, np.str_)[self._tracks[i].label]]
        columns = self._place(frame)
        numbers = getattr(sequence, "numbers", None)
        columns |= {"frame": frame if numbers is None else numbers[frame]}
        columns |= {"id": self._all("id"), "class": np.array(names, dtype=np.str_)}
        for name, parts in (("center", "xyz"), ("size", "lwh"), ("velocity", ("vx", "vy"))):
            values = self._all(name, len(parts))
            if name == "velocity":
                values = np.where(self._moving(values)[:, None], values, np.nan)
            columns |= {part: values[:, place] for place, part in enumerate(parts)}
            if name == "size":
                columns["yaw"] = self._all("yaw")
        for name in ("yaw_rate", "acceleration", "score", "existence", "age", "time_since_detection"):
            columns[name] = self._all(name)
        rows = getattr(sequence, "rows", None)
        detection = [
            (rows(i)[one] if rows is not None else one) if one >= 0 else np.nan
            for i in order
            for one in self._tracks[i].detection.tolist()
        ]
        columns["detection_row"] = np.array(detection, dtype=np.float64)
        if self._full:
            covariance = self._all("covariance", 36).reshape(-1, 6, 6)
            columns |= {name: covariance[:, i, j] for name, (i, j) in COVARIANCE.items()}
        return columns

    def _moving(self, velocity: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell of which tracks (N,) a velocity is known: it was detected, or there were two detections."""
        once = self._all("age") == self._all("time_since_detection")
        return np.asarray(~(once & (velocity == 0.0).all(axis=1)), dtype=np.bool_)

    def _place(self, frame: Ints) -> Columns:
        """Return the columns that say where and when."""
        keys = getattr(self._sequence, "key_columns", None)
        others: Columns = getattr(self._sequence, "frame_columns", {})
        if keys is not None:
            columns = {name: np.full(len(frame), value) for name, value in keys.items()}
            columns |= {name: values[frame] for name, values in others.items()}
            return columns | {self._sequence.time_column: self._sequence.times[frame]}  # type: ignore[attr-defined]  # a table
        stamps = np.array([one.stamp_ns for one in self._sequence.frames()], dtype=np.int64)
        columns = {"sequence": np.full(len(frame), self._sequence.name)}
        return columns | {name: values[frame] for name, values in others.items()} | {"stamp_ns": stamps[frame]}

    def _all(self, name: str, width: int = 0) -> NDArray[Any]:
        order = sorted(self._tracks)
        parts = [np.asarray(getattr(self._tracks[i], name)) for i in order]
        empty = np.empty(0, dtype=np.int64 if name == "id" else np.float64)
        flat = np.concatenate([empty, *(part.reshape(-1) for part in parts)])
        return flat.reshape(-1, width) if width else flat


def join(parts: Sequence[Columns]) -> Columns:
    """Return tables with the same columns as one, one below the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


class TableResultWriter:
    """Writes the tracks of one sequence as a table of its own; use it as a context manager, or call `close`."""

    def __init__(self, path: Path, sequence: _Stamped) -> None:
        self._path = path
        self._collected = TrackColumns(sequence)

    @property
    def path(self) -> Path:
        """The finished file."""
        return self._path

    def add(self, index: int, pose: PoseLike, tracks: TrackRows) -> None:  # noqa: ARG002  the table is in the world
        """Take the tracks (world frame) of frame `index`."""
        self._collected.add(index, tracks)

    def close(self) -> None:
        """Write the file."""
        write_table(self._path, self._collected.columns())

    def discard(self) -> None:
        """Drop what was taken."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None:
            self.close()

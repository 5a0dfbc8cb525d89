"""Tracks as tables: one row per track and frame, in the world frame, in order of frames and, in a frame, of ids.

Columns: what names the recording and the time in the table of detections (for other datasets `sequence` and
`stamp_ns`), then frame (its number in the table of detections, or else counted from 0), id, class, x, y, z, l, w, h,
yaw, vx, vy, yaw_rate, acceleration, score, existence, age, time_since_detection and detection_row: the row of the table
(from 0; for other datasets the place in the frame) of the detection that the track was given, no value while it is
missed. A velocity has no value until it is known: from the second detection on, where the detector gives none. On
request the upper triangle of the covariance of (x, y, v, phi, omega, a) follows, `cov_x_x` to `cov_a_a`.
Metres, seconds, radians. The same tracks always give the same bytes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from optipmb_schemas import Tracks

from optipmb_client.geometry import Ints, PoseLike
from optipmb_client.results.rows import ResultWriter, stacked
from optipmb_client.table_files import Columns, write_table

_STATE: Final = ("x", "y", "v", "phi", "omega", "a")
COVARIANCE: Final = {f"cov_{_STATE[i]}_{_STATE[j]}": (i, j) for i in range(6) for j in range(i, 6)}
"""Column -> place in the covariance (6, 6)."""


class Named(Protocol):
    """What was tracked; the sequence of a table of detections says more of its columns and rows."""

    @property
    def name(self) -> str:
        """Value of the column `sequence`."""


def track_columns(sequence: Named, tracks: Mapping[int, Tracks], *, full: bool = False) -> Columns:
    """Return the tracks (world frame) of a sequence by frame index as columns, with `full` also the covariance."""
    order = sorted(tracks)
    parts = [tracks[index] for index in order]
    frame = np.repeat(np.array(order, dtype=np.int64), [len(one.id) for one in parts])
    names = [name for one in parts for name in np.asarray(one.labels, np.str_)[one.label]]
    numbers, rows = getattr(sequence, "numbers", None), getattr(sequence, "rows", None)
    columns = _place(sequence, frame, parts)
    columns |= {"frame": frame if numbers is None else numbers[frame]}
    columns |= {"id": stacked(parts, "id"), "class": np.array(names, dtype=np.str_)}
    age, unseen, velocity = (stacked(parts, name) for name in ("age", "time_since_detection", "velocity"))
    unknown = (age == unseen) & (velocity == 0.0).all(axis=1)  # detected once, by a detector that gives none
    columns |= dict(zip("xyz", stacked(parts, "center").T, strict=True))
    columns |= dict(zip("lwh", stacked(parts, "size").T, strict=True))
    columns["yaw"] = stacked(parts, "yaw")
    columns |= dict(zip(("vx", "vy"), np.where(unknown[:, None], np.nan, velocity).T, strict=True))
    columns |= {name: stacked(parts, name) for name in ("yaw_rate", "acceleration", "score", "existence")}
    columns |= {"age": age, "time_since_detection": unseen}
    detection = [
        (rows(index)[one] if rows is not None else one) if one >= 0 else np.nan
        for index, part in zip(order, parts, strict=True)
        for one in part.detection.tolist()
    ]
    columns["detection_row"] = np.array(detection, dtype=np.float64)
    if full:
        covariance = stacked(parts, "covariance")
        columns |= {name: covariance[:, i, j] for name, (i, j) in COVARIANCE.items()}
    return columns


def _place(sequence: Any, frame: Ints, parts: Sequence[Tracks]) -> Columns:
    """Return the columns that say where and when."""
    others: Columns = {name: values[frame] for name, values in getattr(sequence, "frame_columns", {}).items()}
    if (keys := getattr(sequence, "key_columns", None)) is not None:
        columns = {name: np.full(len(frame), value) for name, value in keys.items()}
        return columns | others | {sequence.time_column: sequence.times[frame]}
    stamps = np.repeat(np.array([one.stamp_ns for one in parts], dtype=np.int64), [len(one.id) for one in parts])
    return {"sequence": np.full(len(frame), sequence.name)} | others | {"stamp_ns": stamps}


def join(parts: Sequence[Columns]) -> Columns:
    """Return tables with the same columns as one, one below the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


class TableResultWriter(ResultWriter):
    """Writes the tracks of one sequence as a table of its own."""

    def __init__(self, path: Path, sequence: Named) -> None:
        super().__init__(path)
        self._sequence = sequence
        self._tracks: dict[int, Tracks] = {}

    def add(self, index: int, pose: PoseLike, tracks: Tracks) -> None:  # noqa: ARG002  the table is in the world
        """Take the tracks (world frame) of frame `index`."""
        self._tracks[index] = tracks

    def close(self) -> None:
        """Write the file."""
        write_table(self.path, track_columns(self._sequence, self._tracks))

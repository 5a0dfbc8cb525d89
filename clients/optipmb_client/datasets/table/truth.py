"""Tables of objects with ids, which are truth or tracks, at the frames of detections.

Conventions: a row belongs to the frame that is nearest in time, within half a frame. Of several rows of an object at a
frame the nearest one counts. A frame without a row has no object or no label: where the frames with rows lie `SPARSE`
times as far apart as all frames, only these are labelled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_client.datasets.interface import Regions, Truth
from optipmb_client.datasets.table.rows import NO_ID, Boxes, read_tables
from optipmb_client.datasets.table.values import Reading
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Bools, Floats, Ints, Pose, stack_poses, to_world
from optipmb_client.table_files import line_of, read_table

SPARSE: Final = 1.5
_WRITTEN: Final = frozenset({"existence", "age", "time_since_detection", "detection_row"})
"""Columns by which a table of tracks that OptiPMB wrote is known."""
_HEAD: Final = 4096
_UNITS: Final = {"yaw": "radians", "heading": "x", "sizes": "lwh", "axes": "z-up"}
"""Options that such a table is read with, beside those of the user about its times and classes."""
_PLACES: Final = ("time", "rate", "column.stamp", "column.frame", "column.recording", "column.sensor")


@dataclass
class TableOptions:
    """Options by which all tables of a dataset are read: detections, truth and tracks."""

    options: Mapping[str, str] = field(default_factory=dict)
    recordings: set[str] = field(default_factory=set)  # names and keys of all recordings
    named: dict[str, DatasetError | None] = field(default_factory=dict)  # as `Reading.named`, of all tables

    def check(self) -> None:
        """Raise for an option that names a column or class of no table."""
        for error in filter(None, self.named.values()):
            raise error


@dataclass(frozen=True)
class ObjectTable:
    """A table of objects with ids, and the assumptions about it."""

    path: Path
    boxes: Boxes
    options: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def at(self, key: str, stamps: Ints, numbers: NDArray[Any] | None) -> tuple[Ints, Ints, Bools, list[str]]:
        """Return the boxes of a recording at the frames of a sequence.

        Args:
            key: of the recording.
            stamps: (F,) of the frames.
            numbers: (F,) of the frames, by which tables without stamps are matched.

        Returns:
            Boxes (R,) ordered by frame; their frames (R,), -1 where at none; the frames (F,) with rows; notes.

        Raises:
            DatasetError: the table has no ids, or one id twice at a stamp.
        """
        boxes, times, frames = self.boxes, self.boxes.frame_stamp, stamps
        if boxes.id is None:
            raise DatasetError(self.path, "a column of ids (id, track_id …; --option column.id=NAME)", "none")
        counted = [one for one in (boxes.frame_number, numbers) if one is not None and one.dtype.kind in "if"]
        if len(counted) > 1 and np.array_equal(counted[0], boxes.frame_time):
            times, frames = counted
        rows = np.flatnonzero(boxes.frame_key[boxes.row] == key)
        known = boxes.id[rows] != NO_ID
        notes = [] if known.all() else [f"{self.path}: {int((~known).sum())} rows with no id, or -1, are left out"]
        rows = rows[known]
        time, identity = times[boxes.row[rows]], boxes.id[rows]
        order = np.lexsort((identity, time))
        twice = order[1:][(np.diff(time[order]) == 0) & (np.diff(identity[order]) == 0)]
        if len(twice):
            line = self.line(int(rows[twice.min()]))
            raise DatasetError(self.path, "an id once per frame", "an id again at the same stamp", line=line)
        frame = match_stamps(frames, time)
        order = np.lexsort((np.abs(np.append(frames, 0)[frame] - time), identity, frame))
        again = (np.diff(frame[order]) == 0) & (np.diff(identity[order]) == 0) & (frame[order[1:]] >= 0)
        if again.any():
            notes.append(f"{self.path}: of several rows of an object at a frame the nearest counts, in time")
        kept = np.sort(order[np.append(True, ~again)[: len(order)]])
        kept = kept[np.argsort(frame[kept], kind="stable")]
        seen = np.isin(np.arange(len(frames)), match_stamps(frames, times[boxes.frame_key == key]))
        return rows[kept], frame[kept], seen, notes

    def line(self, box: int) -> int:
        """Return the line of a box, counted from 1."""
        return line_of(self.path, int(self.boxes.row[box]), self.options)

    def in_world(self, rows: Ints) -> tuple[Floats, Floats, Floats]:
        """Return centre (R, 3), yaw (R,) and velocity (R, 2) of some boxes in the world frame."""
        boxes = self.boxes
        center, yaw = boxes.center[rows], boxes.yaw[rows]
        velocity = np.full((len(rows), 2), np.nan) if boxes.velocity is None else boxes.velocity[rows]
        if boxes.frame_pose is not None:
            pose = boxes.frame_pose[boxes.row[rows]]
            rotation, translation = stack_poses([Pose(row[:3], row[3:]) for row in pose])
            center, yaw = to_world(rotation, translation, center, yaw)
            velocity = np.einsum("nij,nj->ni", rotation[:, :2, :2], velocity)
        return center, yaw, velocity


def read_objects(path: Path, files: Sequence[Path], tables: TableOptions) -> list[ObjectTable]:
    """Return the tables of truth or tracks that a file or folder is, judged together.

    Tables that OptiPMB wrote have known units and columns: only options of times and classes apply to them.

    Raises:
        DatasetError: a column is missing or a value is wrong; names the line.
    """
    options = tables.options
    columns = {file: read_table(file, {} if _is_written(file) else options) for file in files}
    written = all(one.keys() >= _WRITTEN for one in columns.values())
    if written:
        results = {f"class.{value}" for name, value in options.items() if name.startswith("class.")}
        kept = {*_PLACES, *(name for name in options.keys() - results if name.startswith("class."))}
        options = _UNITS | {name: value for name, value in options.items() if name in kept}
    reading = Reading(path, options, named=tables.named)
    found = read_tables(files, reading, scored=False, loaded=columns)
    notes = () if written else tuple(f"{path}: {note}" for note in reading.notes)
    return [ObjectTable(file, boxes, options, notes) for file, boxes in found]


def _is_written(file: Path) -> bool:
    """Tell by its first bytes whether a file is a text table that OptiPMB wrote, in its own encoding."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        head = opened.read(_HEAD)
    return all(name.encode() in head for name in _WRITTEN)


def match_stamps(stamps: NDArray[Any], wanted: NDArray[Any]) -> Ints:
    """Return the frame nearest to each `wanted` stamp (R,), -1 where it is more than half a frame away."""
    if not len(stamps):
        return np.full(len(wanted), -1, dtype=np.int64)
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 2e9
    after = np.clip(np.searchsorted(stamps, wanted), 1, max(1, len(stamps) - 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    nearest = np.where(abs(stamps[after] - wanted) < abs(wanted - stamps[before]), after, before)
    return np.where(abs(stamps[nearest] - wanted) <= 0.5 * period, nearest, -1)


def truth_at(name: str, stamps: Ints, numbers: NDArray[Any] | None, table: ObjectTable, key: str) -> Truth:
    """Return the objects of a recording at the frames of its detections; arguments as for `ObjectTable.at`.

    Raises:
        DatasetError: none of them is at a frame, or as for `ObjectTable.at`.
    """
    boxes, path = table.boxes, table.path
    rows, frame, seen, notes = table.at(key, stamps, numbers)
    outside, count, steps = int((frame < 0).sum()), int(seen.sum()), np.diff(stamps[seen])
    if outside == len(rows) and outside and len(stamps):
        raise DatasetError(path, f"boxes at the stamps of {name}", "none of its stamps")
    if outside:
        notes.append(f"{path}: {outside} rows are at no frame of {name}: left out")
    rows, frame = rows[outside:], frame[outside:]
    sparse = 0 < count < len(stamps) and (not len(steps) or np.median(steps) >= SPARSE * np.median(np.diff(stamps)))
    if count < len(stamps):
        meaning = "only these are compared" if sparse else "the others count as frames without objects"
        notes.append(f"{path}: truth has {count} of {len(stamps)} frames of {name}: {meaning}")
    center, yaw, velocity = table.in_world(rows)
    labels = tuple(dict.fromkeys(boxes.name[rows].tolist()))
    zero = np.zeros(len(rows), dtype=np.int64)
    return Truth(
        labels=labels,
        frame=frame,
        id=zero if boxes.id is None else boxes.id[rows],
        label=np.array([labels.index(one) for one in boxes.name[rows].tolist()], dtype=np.int64),
        center=center,
        size=boxes.size[rows],
        yaw=yaw,
        velocity=velocity,
        occlusion=zero,
        truncation=zero,
        covered=np.full(len(rows), np.nan),
        points=np.full(len(rows), -1, dtype=np.int64),
        box2d=np.full((len(rows), 4), np.nan),
        ignored=np.zeros(len(rows), dtype=np.bool_),
        regions=Regions(np.empty(0, dtype=np.int64), np.empty((0, 4))),
        labelled=seen if sparse else None,
        notes=tuple(notes),
    )

"""Tables of detections as a data set: a file is one recording, or several by a column that names them.

The truth is a table of the same kind with a column of object ids; a table of detections that has such a column is its
own truth. A row of a table of objects, truth or tracks, belongs to the frame that is nearest in time, within half a
frame. Of several rows of an object at a frame the nearest one counts. A frame without a row has no object or no label:
where the frames with rows lie `SPARSE` times as far apart as all frames, only these are labelled.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import FieldOfView, Tracks

from optipmb_tools import openlabel
from optipmb_tools.datasets.interface import (
    DETECTION_COLUMNS,
    IDENTITY,
    DataSequence,
    Dataset,
    DetectionFrame,
    Truth,
    chosen,
)
from optipmb_tools.datasets.table import pixels
from optipmb_tools.datasets.table.columns import ALIASES
from optipmb_tools.datasets.table.draft import TableRows
from optipmb_tools.datasets.table.findings import Finding, Reading, Understood
from optipmb_tools.datasets.table.names import NO_ID
from optipmb_tools.datasets.table.read import read_tables
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints, Pose, stack_poses, to_world
from optipmb_tools.results.output import track_columns, write_tracks
from optipmb_tools.table_files import SUFFIXES, Columns, line_of, read_table, tables_in, unique_texts

# Options, besides `column.MEANING=NAME` and `class.NAME=NAME`; `tracks` are tables that are yet to be read by them
OPTIONS: Final = (
    *("time", "rate", "group", "yaw", "heading", "quaternion", "sizes", "axes", "velocity", "score", "invalid"),
    *("missing", "size_factor", "length_factor", "attributes"),
    *("poses", "truth", "tracks", "decimal", "encoding", "date", "origin", "boxes"),
    *pixels.OPTIONS,
)
GAP: Final = 1.5
SPARSE: Final = 1.5
_WRITTEN: Final = frozenset({"existence", "confirmed", "age", "time_since_detection", "detection_row"})
"""Columns by which a table of tracks that OptiPMB wrote is known."""
_HEAD: Final = 4096
_UNITS: Final = {"yaw": "radians", "heading": "x", "sizes": "lwh", "axes": "z-up"}
"""Options that such a table is read with, in addition to the user's options about its times and classes."""
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
    boxes: TableRows
    options: Mapping[str, str]
    notes: tuple[str, ...] = ()
    confirmed: Bools | None = None  # (R,) of every row; None without such a column
    object: Ints | None = None  # (R,) id of the first track of the object, -1: none; None without such a column

    def at(self, key: str, stamps: Ints, numbers: NDArray[Any] | None) -> tuple[Ints, Ints, Bools, list[str]]:
        """Return the boxes of a recording at the frames of a sequence.

        Args:
            key: of the recording.
            stamps: (F,) of the frames.
            numbers: (F,) of the frames, by which tables without stamps are matched.

        Returns:
            TableRows (R,) ordered by frame; their frames (R,), -1 where at none; the frames (F,) with rows; notes.

        Raises:
            DatasetError: The table has no ids, or one id twice at a stamp.
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
        DatasetError: A column is missing or a value is wrong; names the line.
    """
    options = tables.options
    columns = {file: read_table(file, {} if _is_written(file) else options) for file in files}
    written = all(one.keys() >= _WRITTEN for one in columns.values())
    if written:
        results = {f"class.{value}" for name, value in options.items() if name.startswith("class.")}
        kept = {*_PLACES, *(name for name in options.keys() - results if name.startswith("class."))}
        options = _UNITS | {name: value for name, value in options.items() if name in kept}
    reading = Reading(path, openlabel.options_of(files) | dict(options), named=tables.named)
    found = read_tables(files, reading, scored=False, loaded=columns)
    notes = () if written else tuple(reading.notes)
    return [
        ObjectTable(
            file, boxes, options, notes, _confirmed(columns[file]), _objects(columns[file]) if written else None
        )
        for file, boxes in found
    ]


def _confirmed(columns: Columns) -> Bools | None:
    return np.isin(columns["confirmed"].astype(str), ("1", "1.0", "True", "true")) if "confirmed" in columns else None


def _objects(columns: Columns) -> Ints | None:
    return columns["object"].astype(np.int64) if "object" in columns else None


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


def span(stamps: Ints) -> str:
    """Return the first and the last stamp, for messages."""
    return f"{stamps.min() / 1e9:.9g} to {stamps.max() / 1e9:.9g} s" if len(stamps) else "no stamps"


def truth_at(name: str, stamps: Ints, numbers: NDArray[Any] | None, table: ObjectTable, key: str) -> Truth:
    """Return the objects of a recording at the frames of its detections; arguments as for `ObjectTable.at`.

    Raises:
        DatasetError: None of them is at a frame, or as for `ObjectTable.at`.
    """
    boxes, path = table.boxes, table.path
    rows, frame, seen, notes = table.at(key, stamps, numbers)
    outside, count, steps = int((frame < 0).sum()), int(seen.sum()), np.diff(stamps[seen])
    if outside == len(rows) and outside and len(stamps):
        given = boxes.frame_stamp[boxes.row[rows]]
        raise DatasetError(path, f"boxes at the stamps of {name}, {span(stamps)}", f"none of its stamps, {span(given)}")
    if outside:
        notes.append(f"{path}: {outside} rows are at no frame of {name}: left out")
    rows, frame = rows[outside:], frame[outside:]
    sparse = 0 < count < len(stamps) and (not len(steps) or np.median(steps) >= SPARSE * np.median(np.diff(stamps)))
    if count < len(stamps):
        meaning = "only these are compared" if sparse else "the others count as frames without objects"
        notes.append(f"{path}: truth has {count} of {len(stamps)} frames of {name}: {meaning}")
    center, yaw, velocity = table.in_world(rows)
    names, label = unique_texts(boxes.name[rows])
    return Truth.of(
        tuple(names.tolist()),
        frame,
        id=np.zeros(len(rows), dtype=np.int64) if boxes.id is None else boxes.id[rows],
        label=label,
        center=center,
        size=boxes.size[rows],
        yaw=yaw,
        velocity=velocity,
        labelled=seen if sparse else None,
        notes=tuple(notes),
    )


class TableSequence(DataSequence):
    """The boxes of one recording and sensor."""

    tables: TableOptions

    def __init__(
        self, name: str, stem: str, boxes: TableRows, key: str, truth: tuple[ObjectTable, str] | None, origin: int = 0
    ) -> None:
        self.name = name
        self.key_columns = dict(zip(boxes.key_columns, boxes.keys[key], strict=True))
        self.time_column = boxes.time_column
        self.sensor_column = boxes.sensor_column
        self.sensor = self.key_columns.get(boxes.sensor_column, "")
        self.recording_columns = {
            column: value for column, value in self.key_columns.items() if column != boxes.sensor_column
        }
        self.recording = ".".join(map(_plain, self.recording_columns.values())) or stem
        self._boxes = boxes
        self._truth = truth
        self._origin = origin
        self.reports = boxes.reports
        self.is_truth = truth is not None and truth[0].boxes is boxes
        self.apart = boxes.apart
        rows = np.flatnonzero(boxes.frame_key == key)
        self._stamps, first, frame = np.unique(boxes.frame_stamp[rows], return_index=True, return_inverse=True)
        self.times: NDArray[Any] = boxes.frame_time[rows[first]]
        self.numbers = None if boxes.frame_number is None else boxes.frame_number[rows[first]]
        self._poses = None if boxes.frame_pose is None else boxes.frame_pose[rows[first]]
        frame_of_row = np.full(len(boxes.frame_stamp), -1, dtype=np.int64)
        frame_of_row[rows] = frame
        mine = np.flatnonzero(frame_of_row[boxes.row] >= 0)
        self._order = mine[np.argsort(frame_of_row[boxes.row[mine]], kind="stable")]
        bounds = np.arange(len(self._stamps) + 1)
        self._start = np.searchsorted(frame_of_row[boxes.row[self._order]], bounds)
        names, self._label = unique_texts(boxes.name[self._order])
        self.labels: tuple[str, ...] = tuple(names.tolist())

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds, of any origin; `frames` counts from an origin before them."""
        return self._stamps

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of each frame; the identity where the table has none."""
        if self._poses is None:
            return [IDENTITY] * len(self)
        return [Pose(row[:3], row[3:]) for row in self._poses]

    @cached_property
    def attributes(self) -> list[str]:
        """Names of the texts of its detections."""
        found = self._boxes.attributes
        return [] if found is None else sorted({name for texts in found for name in texts})

    def rows(self, frame: int) -> Ints:
        """Return the rows of the table, from 0, of the detections (M,) of a frame."""
        return self._boxes.row[self._of(frame)]

    def _of(self, frame: int) -> Ints:
        return self._order[self._start[frame] : self._start[frame + 1]]

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order."""
        boxes = self._boxes
        for index in range(len(self)):
            rows = self._of(index)
            stamp_ns = int(self._stamps[index]) - self._origin
            label = self._label[self._start[index] : self._start[index + 1]]
            known = (one for one in (*DETECTION_COLUMNS[1:], "attributes") if getattr(boxes, one) is not None)
            columns = {name: getattr(boxes, name)[rows] for name in known}
            pose, view = self.poses[index], None
            if boxes.reports is not None and len(rows) == 1:
                pose = Pose(np.nan_to_num(columns["center"][0]), IDENTITY.quaternion)
                columns["center"] = columns["center"] - pose.translation
                view = _view(boxes.reports.distance)
            if boxes.camera is not None:
                pose, columns, view = pixels.seen_from(boxes.camera, pose, columns)
            yield DetectionFrame(index, stamp_ns, pose, self.labels, label, field_of_view=view, **columns)

    def truth(self) -> Truth | None:
        """Return the objects of the table of truth, at the stamps of these frames.

        Raises:
            DatasetError: As `truth_at`.
        """
        return None if self._truth is None else truth_at(self.name, self._stamps, self.numbers, *self._truth)


def _view(reach: float) -> FieldOfView:
    """Return a look at everything up to a distance in metres."""
    half, quarter = np.array([-np.pi, np.pi]), np.array([-0.5 * np.pi, 0.5 * np.pi])
    return FieldOfView(azimuth=half, elevation=quarter, range=np.array([0.0, reach]))


class TableDataset(Dataset):
    """The recordings of a table, or of all tables of a folder.

    Args:
        path: the file or folder.
        options: see `OPTIONS`.
        lenient: Whether errors become findings (`Reading`), where nothing is to be tracked.
        findings: Gets the assumptions and errors, also of a table that cannot be read.
        understood: Gets the columns that were found, with `lenient`.

    Raises:
        DatasetError: A file, a column, a value or an option is wrong.
        ClientError: pyarrow is not installed.
    """

    name = "table"
    profile = "auto"

    def __init__(
        self,
        path: Path,
        options: Mapping[str, str] | None = None,
        *,
        lenient: bool = False,
        findings: list[Finding] | None = None,
        understood: list[Understood] | None = None,
    ) -> None:
        options = dict(options or {})
        for name in options:
            role = name.removeprefix("column.")
            if name not in OPTIONS and not name.startswith("class.") and (role == name or role not in ALIASES):
                known = ", ".join((*OPTIONS, *(f"column.{one}" for one in ALIASES), "class.NAME"))
                raise DatasetError(f"--option {name}", f"one of {known}", "an unknown option")
        truth = options.pop("truth", None)
        files = _tables(path)
        self._sequences: dict[str, TableSequence] = {}
        notes: list[str] = []
        self.path = path
        tracks = options.pop("tracks", None)
        shared = TableOptions({name: value for name, value in options.items() if name not in pixels.OPTIONS})
        others = read_objects(Path(truth), _tables(Path(truth)), shared) if truth is not None else []
        notes += [note for one in others for note in one.notes]
        read_by = openlabel.options_of(files) | options
        reading = Reading(path, read_by, lenient, named=shared.named)
        reading.findings = reading.findings if findings is None else findings
        reading.understood = reading.understood if understood is None else understood
        tables = read_tables(files, reading, scored=True)
        origin = min(int(boxes.frame_stamp.min(initial=0)) for _, boxes in tables)
        if not any(len(boxes.frame_stamp) for _, boxes in tables):
            raise DatasetError(path, "rows", "none")
        for file, boxes in tables:
            own = [ObjectTable(file, boxes, options)] if boxes.id is not None else []
            if not len(boxes.frame_stamp):
                reading.doubt("rows", f"{file.name}: no rows, a recording without frames")
            for key in unique_texts(boxes.frame_key)[0].tolist() or boxes.keys:
                name = _plain(".".join(part for part in (_stem(file), key) if part))
                if len(files) == 1 and key:
                    name = _plain(key)
                where = _truth_of(others or own, key, file)
                sequence = TableSequence(name, _plain(_stem(file)), boxes, key, where, origin)
                sequence.tables = shared
                if name in self._sequences:
                    raise DatasetError(file, "names of recordings that differ", f"{name!r} twice")
                self._sequences[name] = sequence
                _note_gaps(reading, sequence)
                shared.recordings |= {name, key}
        _refuse_single_frames(reading, list(self._sequences.values()))
        notes += reading.notes
        if tracks is None:
            shared.check()
        self.notes: tuple[str, ...] = tuple(dict.fromkeys(notes))

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the recordings of these names, or `all`."""
        return chosen(names, self._sequences, f"recordings: {', '.join(self._sequences)}")

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write `out/NAME.csv`, or the format of the detections."""
        suffix = self.path.suffix if self.path.is_file() and self.path.suffix.lower() in SUFFIXES else ".csv"
        path = out / f"{sequence.name}{suffix}"
        place = self.georeference
        write_tracks(path, lambda: track_columns(sequence.name, tracks, sequence, georeference=place), self.digits)
        return path


def _tables(path: Path) -> list[Path]:
    files = tables_in(path) if path.is_dir() else [path]
    if not files:
        raise DatasetError(path, "a folder with tables (.csv, .parquet, .jsonl, .feather)", "none in it")
    return files


def _plain(text: str) -> str:
    """Return a text as part of the name of a file."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text)


def _stem(file: Path) -> str:
    return file.absolute().name.split(".")[0]


def _truth_of(tables: Sequence[ObjectTable], key: str, file: Path) -> tuple[ObjectTable, str] | None:
    """Return the table with the truth of a recording, and its key there."""
    names = (key, _stem(file), key.split(".", maxsplit=1)[0])
    fitting = [one for one in tables if _stem(one.path) in names] or tables
    only = len(fitting) == 1
    for table in fitting:
        keys = list(table.boxes.keys)
        for one in (*names, *keys[: only and len(keys) == 1]):
            if one in keys and (one or only):
                return table, one
    return None


def _refuse_single_frames(reading: Reading, sequences: Sequence[TableSequence]) -> None:
    """Refuse recordings that have one frame each: nothing can be followed in them."""
    if len(sequences) > 1 and all(len(one) == 1 for one in sequences):
        names = ", ".join(sequences[0].key_columns)
        each = f"{names}: a column that differs in each frame names no recordings" if names else "a file each"
        received = f"{len(sequences)} recordings of one frame"
        reading.refuse("time", f"recordings of several frames, {each}", received, "--option column.recording=none")


def _note_gaps(reading: Reading, sequence: TableSequence) -> None:
    """Note frames that seem to be missing: without a row, an empty frame is unknown."""
    steps = np.diff(sequence.stamps)
    period = float(np.median(steps)) if len(steps) else 0.0
    missing = int(np.sum(np.round(steps[steps > GAP * period] / period) - 1)) if period else 0
    if missing and sequence.reports is None:
        text = f"{sequence.name}: {missing} frames at {1e9 / period:.3g} Hz have no row"
        how = "if nothing was detected in them, a row with their stamp and nothing else says so"
        reading.doubt("time", f"{text}; {how}")

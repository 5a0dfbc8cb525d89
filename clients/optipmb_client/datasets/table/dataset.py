"""Tables of detections as a dataset: a file is one recording, or several by a column that names them.

The truth is a table of the same kind with a column of object ids; a table of detections that has such a column is its
own truth.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb_client.datasets.interface import DataSequence, DetectionFrame, Truth
from optipmb_client.datasets.table.names import ALIASES
from optipmb_client.datasets.table.rows import Boxes, read_tables
from optipmb_client.datasets.table.truth import ObjectTable, TableOptions, read_objects, truth_at
from optipmb_client.datasets.table.values import Finding, Reading
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Ints, Pose
from optipmb_client.results import ResultWriter
from optipmb_client.results.table import TableResultWriter
from optipmb_client.table_files import SUFFIXES, tables_in

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Options beside `column.MEANING=NAME` and `class.NAME=NAME`; `tracks` are tables that are yet to be read by them
OPTIONS: Final = (
    *("time", "rate", "group", "yaw", "heading", "quaternion", "sizes", "axes", "velocity", "score", "invalid"),
    *("poses", "truth", "tracks", "decimal", "encoding", "date"),
)
GAP: Final = 1.5
_HERE: Final = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class TableSequence:
    """The boxes of one recording and sensor."""

    has_clouds = False

    tables: TableOptions

    def __init__(
        self, name: str, stem: str, boxes: Boxes, key: str, truth: tuple[ObjectTable, str] | None, origin: int = 0
    ) -> None:
        self.name = name
        self.key_columns: dict[str, str] = dict(zip(boxes.key_columns, boxes.keys[key], strict=True))
        self.time_column = boxes.time_column
        self.sensor_column = boxes.sensor_column
        self.sensor = self.key_columns.get(boxes.sensor_column, "")
        self.columns = {column: value for column, value in self.key_columns.items() if column != boxes.sensor_column}
        self.recording = ".".join(map(_plain, self.columns.values())) or stem
        self._boxes = boxes
        self._truth = truth
        self._origin = origin
        member = boxes.frame_key == key
        rows = np.flatnonzero(member)
        self._stamps, first, frame = np.unique(boxes.frame_stamp[rows], return_index=True, return_inverse=True)
        self.times: NDArray[Any] = boxes.frame_time[rows[first]]
        """(F,) as the table has them."""
        self.numbers = None if boxes.frame_number is None else boxes.frame_number[rows[first]]
        """(F,) numbers of the frames as the table has them, None where it has none."""
        self._poses = None if boxes.frame_pose is None else boxes.frame_pose[rows[first]]
        frame_of_row = np.full(len(boxes.frame_stamp), -1, dtype=np.int64)
        frame_of_row[rows] = frame
        mine = np.flatnonzero(frame_of_row[boxes.row] >= 0)
        self._order = mine[np.argsort(frame_of_row[boxes.row[mine]], kind="stable")]
        bounds = np.arange(len(self._stamps) + 1)
        self._start = np.searchsorted(frame_of_row[boxes.row[self._order]], bounds)
        names = boxes.name[self._order]
        self.labels: tuple[str, ...] = tuple(dict.fromkeys(names.tolist()))
        self._label = np.array([self.labels.index(name) for name in names.tolist()], dtype=np.int64)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds, of any origin; those of frames are counted from an origin before them."""
        return self._stamps

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """World from sensor of each frame; the identity where the table has none."""
        if self._poses is None:
            return [_HERE] * len(self)
        return [Pose(row[:3], row[3:]) for row in self._poses]

    def rows(self, frame: int) -> Ints:
        """Return the rows of the table, from 0, of the detections (M,) of a frame."""
        return self._boxes.row[self._of(frame)]

    def _of(self, frame: int) -> Ints:
        return self._order[self._start[frame] : self._start[frame + 1]]

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order."""
        boxes = self._boxes
        for index in range(len(self)):
            chosen = self._of(index)
            yield DetectionFrame(
                index=index,
                stamp_ns=int(self._stamps[index]) - self._origin,
                pose=self.poses[index],
                labels=self.labels,
                label=self._label[self._start[index] : self._start[index + 1]],
                center=boxes.center[chosen],
                size=boxes.size[chosen],
                yaw=boxes.yaw[chosen],
                score=boxes.score[chosen],
                velocity=None if boxes.velocity is None else boxes.velocity[chosen],
                position_covariance=None if boxes.position_covariance is None else boxes.position_covariance[chosen],
            )

    def truth(self) -> Truth | None:
        """Return the objects of the table of truth, at the stamps of these frames.

        Raises:
            DatasetError: as `truth_at`.
        """
        return None if self._truth is None else truth_at(self.name, self._stamps, self.numbers, *self._truth)


class TableDataset:
    """The recordings of a table, or of all tables of a folder.

    Args:
        path: the file or folder.
        options: see `OPTIONS`.
        lenient: whether what is wrong becomes a finding (`Reading`), where nothing is to be tracked.

    Raises:
        DatasetError: a file, a column, a value or an option is wrong; says where.
        ClientError: pyarrow is not installed.
    """

    name = "table"
    profile = "auto"

    def __init__(self, path: Path, options: Mapping[str, str] | None = None, *, lenient: bool = False) -> None:
        options = dict(options or {})
        for name in options:
            role = name.removeprefix("column.")
            if name not in OPTIONS and not name.startswith("class.") and (role == name or role not in ALIASES):
                known = ", ".join((*OPTIONS, *(f"column.{one}" for one in ALIASES), "class.NAME"))
                raise DatasetError(f"--option {name}", f"one of {known}", "an unknown option")
        truth = options.pop("truth", None)
        files = _tables(path)
        self._sequences: dict[str, TableSequence] = {}
        self._notes: list[str] = []
        self.path = path
        shared, tracks = TableOptions(options), options.pop("tracks", None)
        others = read_objects(Path(truth), _tables(Path(truth)), shared) if truth is not None else []
        self._notes += [note for one in others for note in one.notes]
        reading = Reading(path, options, lenient, named=shared.named)
        tables = read_tables(files, reading, scored=True)
        self.findings: tuple[Finding, ...] = tuple(reading.findings)
        """What was assumed about the table, and what is wrong with it."""
        self._notes += [f"{path}: {note}" for note in reading.notes]
        origin = min(int(boxes.frame_stamp.min(initial=0)) for _, boxes in tables)
        if not any(len(boxes.frame_stamp) for _, boxes in tables):
            raise DatasetError(path, "rows", "none")
        for file, boxes in tables:
            own = [ObjectTable(file, boxes, options)] if boxes.id is not None else []
            if not len(boxes.frame_stamp):
                self._notes.append(f"{file}: no rows, a recording without frames")
            for key in dict.fromkeys(boxes.frame_key.tolist()) or boxes.keys:
                name = _plain(".".join(part for part in (_stem(file), key) if part))
                if len(files) == 1 and key:
                    name = _plain(key)
                where = _truth_of(others or own, key, file)
                sequence = TableSequence(name, _plain(_stem(file)), boxes, key, where, origin)
                sequence.tables = shared
                if name in self._sequences:
                    raise DatasetError(file, "names of recordings that differ", f"{name!r} twice")
                self._sequences[name] = sequence
                self._notes += _gaps(sequence)
                shared.recordings |= {name, key}
        if tracks is None:
            shared.check()

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed, a line each."""
        return tuple(dict.fromkeys(self._notes))

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the recordings of these names, or `all`."""
        chosen: dict[str, DataSequence] = {}
        for name in names:
            for one in self._sequences if name == "all" else (name,):
                if one not in self._sequences:
                    raise DatasetError("--sequences", f"recordings: {', '.join(self._sequences)}", repr(one))
                chosen[one] = self._sequences[one]
        return list(chosen.values())

    def writer(self, out: Path, sequence: DataSequence) -> ResultWriter:
        """Return a writer of `out/NAME.csv`, or of the format of the detections."""
        suffix = self.path.suffix if self.path.is_file() and self.path.suffix.lower() in SUFFIXES else ".csv"
        return TableResultWriter(out / f"{sequence.name}{suffix}", sequence)


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


def _gaps(sequence: TableSequence) -> list[str]:
    """Say where frames seem to be missing: without a row, nobody knows that the detector found nothing."""
    steps = np.diff(sequence.stamps)
    if not len(steps):
        return []
    period = float(np.median(steps))
    missing = int(np.sum(np.round(steps[steps > GAP * period] / period) - 1)) if period else 0
    if not missing:
        return []
    return [
        (
            f"{sequence.name}: {missing} frames at {1e9 / period:.3g} Hz have no row; "
            "if nothing was detected in them, a row with their stamp and nothing else says so"
        )
    ]

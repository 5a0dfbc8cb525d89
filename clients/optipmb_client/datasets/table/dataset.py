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

from optipmb_client.datasets.interface import DataSequence, DetectionFrame, Regions, Truth
from optipmb_client.datasets.table.names import ALIASES
from optipmb_client.datasets.table.rows import Boxes, read_boxes, read_tables
from optipmb_client.datasets.table.values import Finding, Reading
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Ints, Pose, stack_poses, to_world
from optipmb_client.results import ResultWriter
from optipmb_client.results.table import TableResultWriter
from optipmb_client.table_files import SUFFIXES, tables_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["OPTIONS", "TableDataset", "TableSequence"]

OPTIONS: Final = (
    *("time", "rate", "group", "yaw", "heading", "quaternion", "sizes", "axes", "velocity", "score", "invalid"),
    *("poses", "truth", "decimal", "encoding", "date"),
)
"""Options beside `column.MEANING=NAME` and `class.NAME=NAME`."""
GAP: Final = 1.5
_HERE: Final = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class TableSequence:
    """The boxes of one recording and sensor."""

    has_clouds = False

    def __init__(
        self, name: str, stem: str, boxes: Boxes, key: str, truth: tuple[Boxes, str, Path] | None, origin: int = 0
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
            DatasetError: none of them is at one.
        """
        if self._truth is None:
            return None
        boxes, key, path = self._truth
        if boxes.id is None:
            raise DatasetError(path, "a column of object ids (id, track_id …)", "none")
        member = np.flatnonzero(boxes.frame_key[boxes.row] == key)
        stamp = boxes.frame_stamp[boxes.row[member]]
        frame = match_stamps(self._stamps, stamp)
        inside = frame >= 0
        if not inside.any():
            raise DatasetError(path, f"boxes at the stamps of {self.name}", "none of its stamps")
        chosen = member[inside]
        order = np.argsort(frame[inside], kind="stable")
        return _truth(boxes, chosen[order], frame[inside][order])


def match_stamps(stamps: Ints, wanted: Ints) -> Ints:
    """Return the frame nearest to each `wanted` stamp (R,), -1 where it is more than half a frame away."""
    if not len(stamps):
        return np.full(len(wanted), -1, dtype=np.int64)
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 2e9
    after = np.clip(np.searchsorted(stamps, wanted), 1, max(1, len(stamps) - 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    nearest = np.where(abs(stamps[after] - wanted) < abs(wanted - stamps[before]), after, before)
    return np.where(abs(stamps[nearest] - wanted) <= 0.5 * period, nearest, -1)


def _truth(boxes: Boxes, rows: Ints, frame: Ints) -> Truth:
    center, yaw = boxes.center[rows], boxes.yaw[rows]
    velocity = np.full((len(rows), 2), np.nan) if boxes.velocity is None else boxes.velocity[rows]
    if boxes.frame_pose is not None:
        pose = boxes.frame_pose[boxes.row[rows]]
        rotation, translation = stack_poses([Pose(row[:3], row[3:]) for row in pose])
        center, yaw = to_world(rotation, translation, center, yaw)
        velocity = np.einsum("nij,nj->ni", rotation[:, :2, :2], velocity)
    labels = tuple(dict.fromkeys(boxes.name[rows].tolist()))
    count = len(rows)
    zero = np.zeros(count, dtype=np.int64)
    return Truth(
        labels=labels,
        frame=frame,
        id=np.zeros(0, np.int64) if boxes.id is None else boxes.id[rows],
        label=np.array([labels.index(name) for name in boxes.name[rows].tolist()], dtype=np.int64),
        center=center,
        size=boxes.size[rows],
        yaw=yaw,
        velocity=velocity,
        occlusion=zero,
        truncation=zero,
        covered=np.full(count, np.nan),
        points=np.full(count, -1, dtype=np.int64),
        box2d=np.full((count, 4), np.nan),
        ignored=np.zeros(count, dtype=np.bool_),
        regions=Regions(np.empty(0, dtype=np.int64), np.empty((0, 4))),
    )


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
        others = _read_truth(Path(truth), options, self._notes) if truth is not None else None
        reading = Reading(path, options, lenient)
        tables = read_tables(files, reading, scored=True)
        self.findings: tuple[Finding, ...] = tuple(reading.findings)
        """What was assumed about the table, and what is wrong with it."""
        self._notes += [f"{path}: {note}" for note in reading.notes]
        origin = min(int(boxes.frame_stamp.min(initial=0)) for _, boxes in tables)
        if not any(len(boxes.frame_stamp) for _, boxes in tables):
            raise DatasetError(path, "rows", "none")
        for file, boxes in tables:
            own = (boxes, file) if boxes.id is not None else None
            if not len(boxes.frame_stamp):
                self._notes.append(f"{file}: no rows, a recording without frames")
            for key in dict.fromkeys(boxes.frame_key.tolist()) or boxes.keys:
                name = _plain(".".join(part for part in (_stem(file), key) if part))
                if len(files) == 1 and key:
                    name = _plain(key)
                where = _truth_of(others or own, key, file)
                sequence = TableSequence(name, _plain(_stem(file)), boxes, key, where, origin)
                if name in self._sequences:
                    raise DatasetError(file, "names of recordings that differ", f"{name!r} twice")
                self._sequences[name] = sequence
                self._notes += _gaps(sequence)

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


def _read_truth(path: Path, options: Mapping[str, str], notes: list[str]) -> tuple[Boxes, Path]:
    reading = Reading(
        path, {name: value for name, value in options.items() if not name.startswith(("column.", "class."))}
    )
    boxes = read_boxes(reading, scored=False)
    notes += [f"{path}: {note}" for note in reading.notes]
    return boxes, path


def _truth_of(found: tuple[Boxes, Path] | None, key: str, file: Path) -> tuple[Boxes, str, Path] | None:
    if found is None:
        return None
    boxes, path = found
    keys = dict.fromkeys(boxes.frame_key.tolist())
    for one in (key, _stem(file), key.split(".", maxsplit=1)[0]):
        if one in keys:
            return boxes, one, path
    return (boxes, next(iter(keys)), path) if len(keys) == 1 else None


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

"""Tables of boxes, one row per box: read, checked, in nanoseconds, metres and radians with z up.

The meaning of a column is found by its name: names are compared in lower case, with every run of other characters as
one underscore, and without a unit at the end (`yaw_deg`, `x [m]`). Units in names are kept.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.interface import georeference_of
from optipmb_tools.datasets.motion import SAME_DIRECTION, Moves, find_moves, overlapping
from optipmb_tools.datasets.table.values import (
    COUNTED_HZ,
    SECONDS,
    Reading,
    frame_starts,
    group_stamps,
    median_step,
    read_angle,
    read_axes,
    read_digits,
    read_heading,
    read_scores,
    read_sizes,
    read_stamps,
    read_turn,
    read_velocity,
)
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.table_files import BOX_LISTS, Columns, read_table

NO_CLASS: Final = "object"  # class of all boxes of a table without classes
NO_ID: Final = -1  # id of a box that has none
_UNIT: Final = 1e-3
_MOST_SHOWN: Final = 6
_CROWDED: Final = 0.5  # share of boxes that share their place with another one from which their stamps cannot be right
_LONGEST: Final = 30.0  # boxes that are longer, in metres, are suspicious
LEAST_VARIANCE: Final = 1e-8
LARGEST_VARIANCE: Final = 1e8  # variances of a position along any axis, m^2, as `Detections` have them
_POSE: Final = ("pose_x", "pose_y", "pose_z")
_TURNS: Final = ("w", "x", "y", "z")


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str  # as the table has it
    unit: str | None  # in its name: `deg`, `rad`, `s`, `ms`, `us`, `ns`
    base: str  # its name without the unit, normalised


def _vector(bases: str, part: str, place: int) -> tuple[str, ...]:
    found: list[str] = []
    for base in bases.split():
        found += [f"{base}_{part}", f"{part}_{base}", f"{base}{part}", f"{base}_{place}"]
    return tuple(found)


_CENTER: Final = "center centre pos position loc location translation xyz c p t bbox box"
_SIZE: Final = "size dim dims dimension dimensions extent extents lwh box_size"
_SPEED: Final = "v vel velocity speed"
_POSE_NAMES: Final = "pose ego sensor_pose ego_pose ego_translation pose_translation ego_position sensor_position"
_TURN: Final = "pose ego sensor_pose ego_pose ego_rotation pose_rotation"
_BOX_TURN: Final = "q quat quaternion rotation rot orientation"


def _extent(axis: str, letter: str, word: str, place: int) -> tuple[str, ...]:
    return tuple(name for part in (axis, letter, word) for name in _vector(_SIZE, part, place))


def _turn(bases: str, part: str, place: int) -> tuple[str, ...]:
    return (*(f"{base}_q{part}" for base in bases.split()), *_vector(bases, part, place))


ALIASES: Final[Mapping[str, tuple[str, ...]]] = {
    "stamp": ("stamp", "t", "time", "timestamp", "ts", "sec", "secs", "seconds", "nanoseconds", "sim_time", "datetime",
              "header_stamp", "header_timestamp"),
    "nanosec": ("nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds"),
    "frame": ("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_no", "frame_nr"),
    "x": ("x", "cx", "px", "x_center", "tx", *_vector(_CENTER, "x", 0)),
    "y": ("y", "cy", "py", "y_center", "ty", *_vector(_CENTER, "y", 1)),
    "z": ("z", "cz", "pz", "z_center", "tz", *_vector(_CENTER, "z", 2)),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "longitude"),
    "alt": ("alt", "altitude"),
    "l": ("l", "length", "box_length", "dx", *_extent("x", "l", "length", 0)),
    "w": ("w", "width", "box_width", "dy", *_extent("y", "w", "width", 1)),
    "h": ("h", "height", "box_height", "dz", *_extent("z", "h", "height", 2)),
    "yaw": ("yaw", "heading", "theta", "yaw_angle", "heading_angle", "rotation_z", "rot_z", "rz", "rotation_y", "ry",
            "rot", "rotation", "orientation", "angle"),
    "qw": ("qw", *_vector(_BOX_TURN, "w", 0)),
    "qx": ("qx", *_vector(_BOX_TURN, "x", 1)),
    "qy": ("qy", *_vector(_BOX_TURN, "y", 2)),
    "qz": ("qz", *_vector(_BOX_TURN, "z", 3)),
    "score": ("score", "confidence", "conf", "prob", "probability", "detection_score", "det_score", "tracking_score",
              "score_3d", "scores_3d", "pred_score", "pred_scores", "scores"),
    "class": ("class", "class_name", "cls", "label", "label_name", "category", "category_name", "type", "object_type",
              "obj_type", "class_id", "label_id", "classification", "object_class", "name", "tracking_name",
              "detection_name", "label_3d", "labels_3d", "pred_label", "pred_labels", "names", "labels"),
    "vx": _vector(_SPEED, "x", 0),
    "vy": _vector(_SPEED, "y", 1),
    "cov_xx": ("cov_xx", "cov_x_x", "covariance_xx", "covariance_x_x", "var_x", "variance_x", "x_var", "x_variance"),
    "cov_xy": ("cov_xy", "cov_x_y", "covariance_xy", "covariance_x_y"),
    "cov_yy": ("cov_yy", "cov_y_y", "covariance_yy", "covariance_y_y", "var_y", "variance_y", "y_var", "y_variance"),
    "id": ("id", "track_id", "object_id", "obj_id", "tracking_id", "instance_id", "instance",
           "instance_token", "track", "track_uuid", "object_uuid", "instance_uuid", "uuid", "track_label"),
    "recording": ("recording", "recording_id", "sequence", "sequence_id", "sequence_name", "scene", "scene_name",
                  "scene_id", "session", "log", "log_id", "run", "run_id", "drive", "segment", "bag", "stream"),
    "sensor": ("sensor", "sensor_id", "sensor_name", "node", "lidar", "device"),
    "pose_x": _vector(_POSE_NAMES, "x", 0),
    "pose_y": _vector(_POSE_NAMES, "y", 1),
    "pose_z": _vector(_POSE_NAMES, "z", 2),
    "pose_yaw": ("pose_yaw", "ego_yaw", "sensor_yaw", "pose_heading", "ego_heading"),
    "pose_qw": _turn(_TURN, "w", 0),
    "pose_qx": _turn(_TURN, "x", 1),
    "pose_qy": _turn(_TURN, "y", 2),
    "pose_qz": _turn(_TURN, "z", 3),
}  # fmt: skip
"""Names of each column, the most telling first."""

_LISTED: Final = ("x", "y", "z", "l", "w", "h", "yaw", "vx", "vy")  # meanings of the numbers of a list of `BOX_LISTS`
_UNITS: Final[Mapping[str, str]] = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad", "radians": "rad",
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us", "usec": "us",
    "ns": "ns", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanosecs": "ns", "nanoseconds": "ns",
}  # fmt: skip
_LENGTHS: Final = {"m", "meter", "meters", "metre", "metres", "mps"}


def find_columns(names: Iterable[str], chosen: Mapping[str, str]) -> dict[str, Column]:
    """Return the column of each meaning among `names`; `chosen` are meanings whose column the user has named."""
    known = [_normalised(name) for name in names]
    taken: dict[str, Column] = {}
    used = set(chosen.values())
    for role in ALIASES:
        aliases = _names_of(role)
        if role in chosen:
            unit = next((one.unit for one in known if one.name == chosen[role]), None)
            taken[role] = Column(chosen[role], unit, "")
            continue
        fitting = [one for one in known if one.base in aliases and one.name not in used]
        if role == "nanosec":
            bases = {
                one.base for one in known if "stamp" in taken and one.name == taken["stamp"].name and one.unit == "s"
            }
            parts = [one for one in known if bases and _is_second_half(one)]
            fitting = [Column(one.name, "ns", aliases[0]) for one in parts if one.base in bases or one.base in aliases]
        if fitting:
            best = min(fitting, key=lambda one: (aliases.index(one.base), _is_second_half(one)))
            taken[role] = best
            used.add(best.name)
    return taken


def _names_of(role: str) -> tuple[str, ...]:
    """Return the names of a meaning, the most telling first; those in lists of boxes come before flat columns."""
    if role not in _LISTED:
        return ALIASES[role]
    place = _LISTED.index(role)
    first, last = ([f"{name}_{place}" for name in lists] for lists in (BOX_LISTS, ("bbox", "box")))
    return (*first, *ALIASES[role], *last)


def _is_second_half(column: Column) -> bool:
    """Tell whether a column may be the rest of a stamp, as `stamp.nanosec` of `stamp.sec`; `stamp_ns` is not."""
    return column.unit == "ns" and not _plain(column.name).endswith("ns")


def _plain(name: str) -> str:
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", re.sub(r"3D(?![a-z])", "3d", name))
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


def _normalised(name: str) -> Column:
    base = _plain(name)
    head, _, tail = base.rpartition("_")
    if head and tail in _UNITS:
        return Column(name, _UNITS[tail], head)
    if base in _UNITS and base not in {"s", "ms", "us", "ns"}:
        return Column(name, _UNITS[base], base)
    return Column(name, None, head if head and tail in _LENGTHS else base)


@dataclass(frozen=True)
class Boxes:
    """Rows of one table; a row that stands for an empty frame is left out of all but the frames."""

    frame_stamp: Ints  # (R,) ns, of every row, also those without a box
    frame_key: NDArray[np.str_]  # (R,) recording and sensor of every row
    frame_pose: Floats | None
    """(R, 7) translation and quaternion, world from sensor; None where boxes are in the world frame."""
    frame_time: NDArray[Any]  # (R,) time as the table has it
    frame_number: NDArray[Any] | None  # (R,) number of the frame as the table has it; None where it has none
    row: Ints  # (B,) row of each box, counted from 0
    center: Floats  # (B, 3)
    size: Floats  # (B, 3); NaN in a table that has neither l nor w
    yaw: Floats  # (B,); NaN in a table that has none
    velocity: Floats | None  # (B, 2); rows of NaN where unknown
    position_covariance: Floats | None
    """(B, 3, 3) of the errors of the centres along the axes of the boxes, m^2; of NaN where unknown, None without."""
    score: Floats  # (B,) in (0, 1]
    name: NDArray[np.str_]  # (B,) class
    id: Ints | None  # (B,) object, `NO_ID` where the cell has none; None where the table has no such column
    time_column: str
    key_columns: tuple[str, ...]
    sensor_column: str  # one of `key_columns`, with the sensor; empty: none
    keys: Mapping[str, tuple[str, ...]]  # key -> values of the columns that it stands for

    def rows(self, first: int, last: int) -> "Boxes":
        """Return the table of the rows from `first` up to `last`, which are counted from 0 again."""
        mine = (self.row >= first) & (self.row < last)
        arrays = {name: one for name, one in vars(self).items() if isinstance(one, np.ndarray)}
        parts: dict[str, Any] = {
            name: one[first:last] if name in _OF_ROWS else one[mine] for name, one in arrays.items()
        }
        return replace(self, **parts | {"row": self.row[mine] - first})


_OF_ROWS: Final = ("frame_stamp", "frame_key", "frame_pose", "frame_time", "frame_number")


def read_tables(
    paths: Sequence[Path], reading: Reading, *, scored: bool, loaded: Mapping[Path, Columns] | None = None
) -> list[tuple[Path, Boxes]]:
    """Read the tables of a recording; tables with the same columns share units and conventions.

    Args:
        paths: Files, or folders with a file for each frame. Tables without rows give no boxes.
        reading: Options of the user; receives the findings.
        scored: Whether boxes are detections, which have a score.
        loaded: Tables that were read already.

    Raises:
        DatasetError: A column is missing or a value is not allowed; names the line.
        ClientError: pyarrow is not installed.
    """
    tables = loaded or {path: read_table(path, reading.options) for path in paths}
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, columns in tables.items():
        groups.setdefault(tuple(sorted(columns)), []).append(path)
    found: dict[Path, Boxes] = {}
    for members in groups.values():
        lengths = [len(next(iter(tables[path].values()), ())) for path in members]
        ends = np.cumsum(lengths).tolist()
        starts = [end - length for end, length in zip(ends, lengths, strict=True)]
        reading.files = tuple((path, start) for path, start, n in zip(members, starts, lengths, strict=True) if n)
        columns = _joined([tables[path] for path in members])
        if not columns:
            raise DatasetError(members[0], "a first line with the names of the columns", "no column")
        judged = reading if any(lengths) else replace(reading, findings=[])  # rows that are not there tell nothing
        boxes = _Table(judged, columns).read(scored=scored)
        found |= {path: boxes.rows(start, end) for path, start, end in zip(members, starts, ends, strict=True)}
    return [(path, found[path]) for path in paths]


def _joined(tables: Sequence[Columns]) -> Columns:
    """Return tables with the same columns as one; a column is text where it is text in one of them."""
    filled = [one for one in tables if len(next(iter(one.values()), ()))] or list(tables[:1])
    if len(filled) == 1:
        return filled[0]
    joined: Columns = {}
    for name in filled[0]:
        parts = [one[name] for one in filled]
        kinds = {part.dtype.kind for part in parts}
        if len(kinds) > 1 and kinds != {"i", "f"}:
            texts = [part.astype(np.str_) for part in parts]
            parts = [np.where(np.isin(part, ("nan", "NaT")), "", part) for part in texts]
        joined[name] = np.concatenate(parts)
    return joined


class _Table:
    def __init__(self, reading: Reading, columns: Columns) -> None:
        self._reading = reading
        self._time = replace(reading, lenient=False)  # without stamps nothing can be found
        self._columns = columns
        self._rows = len(next(iter(columns.values())))
        chosen = {
            key.removeprefix("column."): name for key, name in reading.options.items() if key.startswith("column.")
        }
        for role, name in chosen.items():
            reading.name(f"column.{role}", columns, "a column", name)
        self._found = find_columns(columns, {role: name for role, name in chosen.items() if name in columns})

    def _numbers(self, role: str, otherwise: float | None = None) -> Floats:
        """Return a column of numbers, NaN where there is none."""
        column = self._found.get(role)
        if column is None:
            if otherwise is None:
                if error := self._reading.named.get(f"column.{role}"):
                    raise error
                have = f"the columns {', '.join(self._columns)}"
                raise DatasetError(self._reading.path, f"a column {role} (--option column.{role}=NAME)", have)
            return np.full(self._rows, otherwise)
        values = self._columns[column.name]
        if values.dtype.kind not in "if":
            bad = np.array([not _is_number(text) for text in values.tolist()], dtype=np.bool_)
            self._reading.first(role, bad, f"a number in column {column.name}", values)
            values = np.array([float(text) if text and _is_number(text) else np.nan for text in values.tolist()])
        return values.astype(np.float64)

    def _unit(self, role: str) -> str | None:
        return self._found[role].unit if role in self._found else None

    def read(self, *, scored: bool) -> Boxes:
        reading, found = self._reading, self._found
        key, key_columns, keys = self._keys()
        file = np.searchsorted([first for _, first in reading.files], np.arange(self._rows), side="right")
        series = np.unique(key, return_inverse=True)[1] * (len(reading.files) + 1) + file
        stamp, time, time_column = self._stamps(series)
        center = self._centers()
        centres = not {"l", "w"} & found.keys()
        ends = (("l", 1.0 if centres else None), ("w", 1.0 if centres else None), ("h", 1.5))
        size = np.column_stack([self._numbers(role, without) for role, without in ends])
        yaw, yaw_unit = self._yaw(otherwise=None if scored and not centres else 0.0)
        turned = yaw_unit != "none"
        score = self._numbers("score", 1.0)
        names, id_ = self._names(), self._ids()
        points = scored and centres  # not even the height is taken for granted
        self._note_missing(scored=scored, points=points, boxes=turned and not centres)
        empty = np.isnan(center[:, :2]).all(axis=1) & (centres | np.isnan(size[:, :2]).all(axis=1))
        kept = self._valid(np.asarray(~empty), center, size, yaw, score, names)
        if "score" in found and scored:
            score[kept] = read_scores(reading, score[kept], np.flatnonzero(kept))
            self._leave_out(kept, np.isnan(score), "with a score that is none")
            self._leave_out(kept, score == 0.0, "with a score of 0")
        covariance = self._covariances(kept) if scored else None
        row = np.flatnonzero(kept)
        center, size, yaw, names = center[row], size[row], yaw[row], names[row]
        kind = np.unique(names, return_inverse=True)[1].astype(np.int64)
        stated = centres or found["l"].base == "l" or found["l"].base.endswith(("_l", "length"))
        size = read_sizes(reading, size, names, stated=stated)
        camera = read_axes(reading, center)
        if camera:
            yaw = yaw if yaw_unit in {"quaternion", "none"} else read_angle(reading, "yaw", yaw, yaw_unit)
            center, size, yaw = _from_camera(center, size, yaw)
            yaw_unit = "rad"
        read_digits(reading, center)
        plane, sides = center[:, :2], size
        stamp = self._grouped(stamp, series, row, lambda frame: overlapping(frame, plane, sides, kind), scored=scored)
        pose = self._poses(stamp)
        moves = find_moves(series[row], stamp[row] / 1e9, _world(center, row, pose)[:, :2], kind)
        motion = _Motion(row, pose, moves)
        yaw = self._heading(motion, size, yaw, yaw_unit if turned else "none", strict=scored)
        velocity = self._velocity(motion, row)
        if reading.lenient:
            self._suspicious(size, center, stamp[row])
            pairs = (role if role == one.name else f"{role} from {one.name}" for role, one in found.items())
            reading.note("columns", f"columns found: {', '.join(pairs)}")
        unused = [name for name in self._columns if name not in {one.name for one in found.values()}]
        if unused:
            more = f" and {len(unused) - _MOST_SHOWN} more" if len(unused) > _MOST_SHOWN else ""
            reading.note("columns", f"columns not used: {', '.join(unused[:_MOST_SHOWN])}{more}")
        return Boxes(
            frame_stamp=stamp,
            frame_key=key,
            frame_pose=pose,
            frame_time=time,
            frame_number=self._columns[found["frame"].name] if "frame" in found else None,
            row=row,
            center=np.insert(plane, 2, np.nan, axis=1) if points and self._height not in found else center,
            size=np.full_like(size, np.nan) if centres else size,
            yaw=yaw if turned else np.full_like(yaw, np.nan),
            velocity=velocity,
            position_covariance=None if covariance is None else covariance[row],
            score=score[row],
            name=names,
            id=None if id_ is None else id_[row],
            time_column=time_column,
            key_columns=key_columns,
            sensor_column=found["sensor"].name if "sensor" in found else "",
            keys=keys,
        )

    def _note_missing(self, *, scored: bool, points: bool, boxes: bool) -> None:
        """Note assumptions about missing columns."""
        if not boxes:
            meaning = "they are unknown" if scored else "only centres can be compared"
            self._reading.note("sizes", f"no columns for the size or the heading: {meaning}")
        for role, text in ((self._height, "z = 0"), ("h", "a height of 1.5 m"), ("score", "a score of 1")):
            if role not in self._found and (scored if role == "score" else not points):
                self._reading.note(role, f"no column for {role}: {text} for every box")

    @property
    def _height(self) -> str:
        return "alt" if "alt" in self._found else "z"

    def _centers(self) -> Floats:
        """Return centres (R, 3): x, y, z, or latitude and longitude where an origin is given and x is not."""
        origin, found = self._reading.options.get("origin"), self._found
        if "x" in found or "lat" not in found or origin is None:
            return np.column_stack([self._numbers("x"), self._numbers("y"), self._numbers("z", 0.0)])
        alt = self._numbers("alt") if self._height == "alt" else None
        center = georeference_of(origin).to_world(self._numbers("lat"), self._numbers("lon"), alt)
        if alt is None:
            center[:, 2] = self._numbers("z", 0.0)
        return center

    def _stamps(self, series: Ints) -> tuple[Ints, NDArray[Any], str]:
        """Return the stamps (R,) in nanoseconds, the times as the table has them, and the name of their column."""
        reading, found = self._reading, self._found
        rate = _positive(reading.options, "rate", "frames per second")
        column = found.get("stamp")
        if column is None or (rate is not None and "frame" in found):
            return self._counted(series, rate)
        values = self._columns[column.name]
        missing = np.isnat(values) if values.dtype.kind == "M" else values != values  # noqa: PLR0124  NaN differs from itself
        self._time.first("time", missing, f"a stamp in column {column.name}", values)
        if values.dtype.kind == "M":
            reading.note("time", f"stamps are dates in column {column.name}")
            return values.astype("datetime64[ns]").astype(np.int64), values, column.name
        if values.dtype.kind not in "if":
            bad = np.array([not _is_number(text) or not text for text in values.tolist()], dtype=np.bool_)
            expected = f"stamps in column {column.name}: numbers, or dates as YYYY-MM-DD HH:MM:SS.ffffff"
            self._time.first("time", bad if bad.any() else ~bad, expected, values)
            values = np.zeros(self._rows)
        if rate is not None:
            return np.round(values * (1e9 / rate)).astype(np.int64), values, column.name
        if self._rows and "frame" in found and "nanosec" not in found:
            values = self._first_of_frames(values, series)
        if "nanosec" in found:
            whole = np.asarray(values == np.floor(values))
            self._time.first("time", ~whole, f"whole seconds in column {column.name}", values)
            part = self._numbers("nanosec")
            self._time.first("time", ~np.isfinite(part), f"nanoseconds in column {found['nanosec'].name}", part)
            reading.note("time", f"stamps are {column.name} + {found['nanosec'].name}")
            stamp = values.astype(np.int64) * 1_000_000_000 + part.astype(np.int64)
            return stamp, stamp, "stamp_ns"
        return read_stamps(reading, values, series, column.unit), values, column.name

    def _first_of_frames(self, values: NDArray[Any], series: Ints) -> NDArray[Any]:
        """Return the first time of each row's frame, where the frames of the table follow each other in time."""
        number = np.unique(self._columns[self._found["frame"].name], return_inverse=True)[1]
        frame = np.unique(series * len(values) + number, return_inverse=True)[1]
        order = np.lexsort((frame, values, series))
        begins = np.r_[True, np.diff(frame[order]) != 0]
        first = np.empty_like(values)
        first[order] = values[order][np.flatnonzero(begins)[np.cumsum(begins) - 1]]
        if int(begins.sum()) > frame.max() + 1 or np.array_equal(first, values):
            return values
        column = self._found["frame"].name
        self._reading.note("time", f"stamps differ within a frame: each has the first one of its {column}")
        return first

    def _counted(self, series: Ints, rate: float | None) -> tuple[Ints, NDArray[Any], str]:
        """Return what `_stamps` does from the numbers of frames."""
        reading, column = self._reading, self._found.get("frame")
        if column is None:
            expected = "a column of stamps (t, stamp_ns …; --option column.stamp=NAME) or of frames"
            raise DatasetError(reading.path, expected, f"the columns {', '.join(self._columns)}")
        numbers = self._numbers("frame")
        self._time.first("time", ~np.isfinite(numbers), f"the number of a frame in column {column.name}", numbers)
        if rate is None:
            step = median_step(numbers, series) or 1.0
            rate = COUNTED_HZ * step
            steps = "" if step == 1.0 else f" (numbers in steps of {step:g})"
            text = f"no column of stamps: frames of column {column.name} are taken to come at {COUNTED_HZ:g} Hz{steps}"
            reading.note("time", text, "--option rate=HZ")
        else:
            reading.note("time", f"column {column.name} counts frames, {rate:g} a second")
        return np.round(numbers * (1e9 / rate)).astype(np.int64), self._columns[column.name], column.name

    def _grouped(self, stamp: Ints, series: Ints, row: Ints, overlap: Callable[[Ints], Bools], *, scored: bool) -> Ints:
        """Return the stamps (R,) of frames: equal for boxes of a frame that have stamps of their own."""
        reading = self._reading

        def crowded(stamps: Ints) -> float:
            place = np.unique(stamps[row], return_inverse=True)[1]
            frame = np.unique(series[row] * len(stamps) + place, return_inverse=True)[1].astype(np.int64)
            return float(np.mean(overlap(frame))) if len(row) else 0.0

        asked = _positive(reading.options, "group", "seconds", zero=True)
        if asked is not None:
            return group_stamps(stamp, series, asked * 1e9) if asked else stamp
        found = frame_starts(stamp, series)
        if found is not None and crowded(found) < 0.5 * _CROWDED:
            apart = (stamp - found).max() / 1e9
            frames = len(np.unique(found))
            text = f"stamps differ by up to {apart:.3g} s within a frame: grouped into {frames} frames"
            reading.note("time", text, "--option group=SECONDS, 0 for none")
            return found
        share = crowded(stamp) if scored else 0.0
        if share > _CROWDED:
            most = int(np.unique(stamp[row], return_counts=True)[1].max())
            received = f"{share:.0%} of the boxes at the place of another one, up to {most} boxes a stamp"
            text = "have stamps lost digits, or were frames merged?"
            if "time" in reading.options:
                reading.note("time", f"{received}: {text}")
            else:
                option = "--option time=UNIT, if the stamps are right"
                reading.refuse("time", f"boxes apart from each other under one stamp; {text}", received, option)
        return stamp

    def _keys(self) -> tuple[NDArray[np.str_], tuple[str, ...], dict[str, tuple[str, ...]]]:
        names = tuple(self._found[role].name for role in ("recording", "sensor") if role in self._found)
        if not names or not self._rows:
            return np.full(self._rows, ""), names, {"": ("",) * len(names)}
        parts = [self._columns[name].astype(np.str_).tolist() for name in names]
        joined = [".".join(row) for row in zip(*parts, strict=True)]
        return np.array(joined, dtype=np.str_), names, dict(zip(joined, zip(*parts, strict=True), strict=True))

    def _yaw(self, otherwise: float | None) -> tuple[Floats, str | None]:
        """Return headings as the table has them, and the unit that is stated for them; `none` where there are none."""
        quaternion = self._quaternion("q", "yaw") if "yaw" not in self._found else None
        if quaternion is None:
            return self._numbers("yaw", otherwise), self._unit("yaw") if "yaw" in self._found else "none"
        w, x, y, z = quaternion.T
        return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z), "quaternion"

    def _quaternion(self, prefix: str, topic: str) -> Floats | None:
        """Return quaternions w x y z (R, 4); None where the table has none."""
        roles = [f"{prefix}{part}" for part in _TURNS]
        if not all(role in self._found for role in roles):
            return None
        parts = np.column_stack([self._numbers(role) for role in roles])
        named = not self._found[roles[0]].base[-1:].isdigit()
        return read_turn(self._reading, topic, parts, named=named)

    def _heading(self, motion: "_Motion", size: Floats, yaw: Floats, unit: str | None, *, strict: bool) -> Floats:
        reading, moves = self._reading, motion.moves
        long = moves.take(size[moves.start, :2].max(axis=1) > 1.3 * size[moves.start, :2].min(axis=1))
        unposed = motion.pose is None
        moving = unposed and moves.common > _CROWDED
        found = yaw
        if unit != "none":
            found = read_heading(reading, yaw, unit, long, motion.carry, strict=strict and not moving)
        if unposed:
            reading.note("pose", "no columns for the pose of the sensor: boxes are assumed to be in the world frame")
            if moving and (
                not len(long) or float(np.mean(np.abs(long.turn(found[long.start])) < SAME_DIRECTION)) < _FORWARD
            ):
                text = (
                    f"the sensor seems to move, boxes share a motion in {moves.common:.0%} of the frames: add its poses"
                )
                reading.note("pose", text, "pose columns, or --option poses=FILE")
        return found

    def _velocity(self, motion: "_Motion", row: Ints) -> Floats | None:
        """Return velocities (B, 2) along the axes of the boxes; NaN where unknown, None where there are none."""
        if not {"vx", "vy"} <= self._found.keys():
            return None
        velocity = np.column_stack([self._numbers("vx"), self._numbers("vy")])[row]
        velocity[np.isnan(velocity).any(axis=1)] = np.nan
        posed = motion.pose is not None
        axes = read_velocity(self._reading, velocity, motion.moves, motion.carry, posed=posed)
        if axes == "world" and motion.pose is not None:
            flat = np.column_stack([velocity, np.zeros(len(velocity))])
            velocity = _rotated(motion.pose[row, 3:] * _INVERSE, flat)[:, :2]
        return velocity

    def _suspicious(self, size: Floats, center: Floats, stamp: Ints) -> None:
        long = int((size[:, :2] > _LONGEST).any(axis=1).sum())
        if long:
            self._reading.note("rows", f"{long} boxes are longer than {_LONGEST:g} m")
        again = len(stamp) - len(np.unique(np.column_stack([stamp, center]), axis=0))
        if again:
            self._reading.note("rows", f"{again} boxes stand where another one of their stamp does")

    def _names(self) -> NDArray[np.str_]:
        column = self._found.get("class")
        if column is None:
            names = np.full(self._rows, NO_CLASS)
            self._reading.note("class", f"no column for class: every box is of class {NO_CLASS}")
        else:
            values = self._columns[column.name]
            if values.dtype.kind == "f":  # numbers with an empty cell
                values = np.where(np.isnan(values), "", np.char.mod("%g", values))
            names = np.char.strip(values.astype(np.str_))
        renamed = {
            key.removeprefix("class."): name for key, name in self._reading.options.items() if key.startswith("class.")
        }
        have = sorted(set(names.tolist()))
        folded = {name.lower(): name for name in renamed}
        for name in renamed if self._rows else ():
            if not name.isdigit():  # classes are counted: a recording need not have all of them
                self._reading.name(f"class.{name}", have, "a class of the table", name)
            elif name not in have:
                self._reading.note("class", f"no box is of class {name}")
        new = {one: renamed[folded[one.lower()]] if one.lower() in folded else one for one in have}
        return np.array([new[name] for name in names.tolist()], dtype=np.str_)

    def _ids(self) -> Ints | None:
        column = self._found.get("id")
        if column is None:
            return None
        values = self._columns[column.name]
        if values.dtype.kind == "i":
            return values.astype(np.int64)
        texts = values.astype(np.str_)
        numbers = np.unique(texts, return_inverse=True)[1].astype(np.int64)
        return np.where(np.isin(texts, ("", "nan", "-1", "-1.0")), NO_ID, numbers)

    def _poses(self, stamp: Ints) -> Floats | None:
        """Return the poses (R, 7) of the table, or of another one at its stamps."""
        reading = self._reading
        if "poses" in reading.options:
            return _poses_at(reading, Path(reading.options["poses"]), stamp)
        if not all(role in self._found for role in _POSE[:2]):
            return None
        translation = np.column_stack([self._numbers("pose_x"), self._numbers("pose_y"), self._numbers("pose_z", 0.0)])
        pose = np.column_stack([translation, self._turn("pose_")])
        reading.first("pose", np.asarray(~np.isfinite(pose).all(axis=1)), "a pose of finite numbers", translation[:, 0])
        return pose

    def _turn(self, prefix: str) -> Floats:
        """Return the unit quaternions (R, 4) of poses, which the table has as such or as yaws."""
        quaternion = self._quaternion(f"{prefix}q", "pose")
        if quaternion is None:
            role = f"{prefix}yaw"
            turn = read_angle(self._reading, role, self._numbers(role), self._unit(role))
            zero = np.zeros(self._rows)
            return np.column_stack([np.cos(turn / 2), zero, zero, np.sin(turn / 2)])
        norm = np.linalg.norm(quaternion, axis=1)
        self._reading.first("pose", ~(abs(norm - 1.0) < _UNIT), "a pose with a unit quaternion", norm)
        return quaternion

    def trajectory(self) -> tuple[Ints, Floats]:
        """Return the stamps (P,) and poses (P, 7) of a table of poses, in the order of time."""
        series = np.zeros(self._rows, dtype=np.int64)
        stamp, _, _ = self._stamps(series)
        prefix = "" if "x" in self._found else "pose_"
        ends = (("x", None), ("y", None), ("z", 0.0))
        translation = np.column_stack([self._numbers(f"{prefix}{axis}", without) for axis, without in ends])
        pose = np.column_stack([translation, self._turn(prefix)])
        self._reading.first(
            "pose", np.asarray(~np.isfinite(pose).all(axis=1)), "a pose of finite numbers", translation[:, 0]
        )
        stamp, first = np.unique(stamp, return_index=True)
        return stamp, pose[first]

    def _covariances(self, kept: NDArray[np.bool_]) -> Floats | None:
        """Return the covariances (R, 3, 3) of the centres, if the table has them; rows without values are unknown.

        Rows with others are taken out of `kept`, if the user leaves such rows out.
        The height has no column: its variance is the mean of the others, and nothing depends on it.
        """
        if not {"cov_xx", "cov_yy"} & self._found.keys():
            return None
        if self._reading.options.get("axes") == "camera":
            expected = "covariances of positions along axes with z up"
            raise DatasetError(self._reading.path, expected, "columns of them, and camera axes")
        xx, xy, yy = self._numbers("cov_xx"), self._numbers("cov_xy", 0.0), self._numbers("cov_yy")
        unknown = np.isnan(xx) & np.isnan(yy)
        with np.errstate(invalid="ignore"):  # of infinite ones NaN comes, which is not fine either
            least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
        fine = unknown | ((least >= LEAST_VARIANCE) & (np.maximum(xx, yy) <= LARGEST_VARIANCE))
        expected = f"variances of x and y from {LEAST_VARIANCE:g} to {LARGEST_VARIANCE:g} m^2 along every axis, or none"
        bad = np.asarray(kept & ~fine)
        if self._reading.chosen("invalid", ("skip", "refuse")) != "skip":
            self._reading.first("covariance", bad, expected, np.column_stack((xx, xy, yy)))
        self._leave_out(kept, bad, "with covariances that are none")
        covariance = np.zeros((self._rows, 3, 3))
        covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2] = xx, yy, 0.5 * (xx + yy)
        covariance[:, 0, 1] = covariance[:, 1, 0] = xy
        covariance[unknown] = np.nan
        return covariance

    def _leave_out(self, kept: Bools, bad: Bools, what: str) -> None:
        """Take rows out of `kept`, and say how many."""
        count = int((kept & bad).sum())
        if count:
            self._reading.note("rows", f"{count} rows {what} are left out")
            kept &= ~bad

    def _valid(
        self, kept: Bools, center: Floats, size: Floats, yaw: Floats, score: Floats, names: NDArray[np.str_]
    ) -> Bools:
        """Return the rows with a box that can be used; refuse one that cannot, unless the user leaves them out."""
        skip = self._reading.chosen("invalid", ("skip", "refuse")) == "skip"
        good = kept.copy()
        known = np.asarray(names != "", dtype=np.bool_)
        for what, values, fine in (
            ("finite x, y and z", center, np.isfinite(center).all(axis=1)),
            ("positive length, width and height", size, (np.isfinite(size) & (size > 0.0)).all(axis=1)),
            ("finite yaw", yaw, np.isfinite(yaw)),
            ("finite score", score, np.isfinite(score)),
            ("class", names, known),
        ):
            bad = kept & ~fine
            if not skip:
                expected = f"{what} (--option invalid=skip leaves such rows out)"
                self._reading.first("rows", bad, expected, values)
            good &= fine
        self._leave_out(kept, ~good, "with values that are missing, not finite or not positive")
        return good


@dataclass(frozen=True)
class _Motion:
    """Rows of boxes (B,), the poses of their sensor (R, 7), and the moves of the boxes in the world."""

    row: Ints
    pose: Floats | None
    moves: Moves

    def carry(self, yaw: Floats, rows: Ints) -> Floats:
        """Return headings (K,) of boxes in the world from those in the frame of the sensor."""
        if self.pose is None:
            return yaw
        heading = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        turned = _rotated(self.pose[self.row[rows], 3:], heading)
        return np.asarray(np.arctan2(turned[:, 1], turned[:, 0]), dtype=np.float64)


_FORWARD: Final = 0.8  # share of forward moves from which traffic shares a motion, not the sensor
_LEAST_TURN: Final = 1e-6
_INVERSE: Final = np.array([1.0, -1.0, -1.0, -1.0])


def _from_camera(center: Floats, size: Floats, yaw: Floats) -> tuple[Floats, Floats, Floats]:
    from optipmb_tools.camera import sensor_from_kitti  # noqa: PLC0415  of few tables

    return sensor_from_kitti(center, np.ascontiguousarray(size[:, ::-1]), yaw)


def _rotated(quaternion: Floats, vector: Floats) -> Floats:
    """Return vectors (N, 3) turned by unit quaternions (N, 4)."""
    across = 2.0 * np.cross(quaternion[:, 1:], vector)
    return np.asarray(vector + quaternion[:, :1] * across + np.cross(quaternion[:, 1:], across), dtype=np.float64)


def _world(center: Floats, row: Ints, pose: Floats | None) -> Floats:
    return center if pose is None else _rotated(pose[row, 3:], center) + pose[row, :3]


def _poses_at(reading: Reading, path: Path, stamp: Ints) -> Floats:
    """Return the poses (R, 7) of a table of poses at stamps (R,), interpolated.

    Raises:
        DatasetError: a stamp lies before the first or after the last pose.
    """
    columns = read_table(path, reading.options)
    column = find_columns(columns, {}).get("stamp", Column("", None, ""))
    time = reading.options.get("time")
    options = {"time": time} if time in SECONDS and column.unit is None else {}
    own = Reading(path, {name: one for name, one in reading.options.items() if name in {"yaw", "quaternion"}} | options)
    if not len(next(iter(columns.values()), ())):
        raise DatasetError(path, "poses", "no rows")
    known, pose = _Table(own, columns).trajectory()
    for one in own.findings:
        reading.note(one.topic, f"{path.name}: {one.text}", one.option)
    outside = (stamp < known[0]) | (stamp > known[-1])
    expected = (
        f"a stamp between the first and the last pose of {path.name}, {known[0] / 1e9:.9g} to {known[-1] / 1e9:.9g} s"
    )
    reading.first("pose", outside, expected, stamp / 1e9)
    after = np.clip(np.searchsorted(known, stamp), 1, max(1, len(known) - 1))
    before, after = after - 1, np.minimum(after, len(known) - 1)
    part = ((stamp - known[before]) / np.maximum(known[after] - known[before], 1))[:, None]
    first, last = pose[before, 3:], pose[after, 3:]
    cosine = np.einsum("ij,ij->i", first, last)
    last = np.where(cosine[:, None] < 0.0, -last, last)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))[:, None]
    angle = np.maximum(angle, _LEAST_TURN)  # spherical interpolation of Shoemake (1985), linear for small angles
    turn = (np.sin((1.0 - part) * angle) * first + np.sin(part * angle) * last) / np.sin(angle)
    return np.column_stack([pose[before, :3] * (1.0 - part) + pose[after, :3] * part, turn])


def _positive(options: Mapping[str, str], name: str, what: str, *, zero: bool = False) -> float | None:
    text = options.get(name)
    if text is None:
        return None
    if not _is_number(text) or not (0.0 < float(text) < float("inf") or (zero and float(text) == 0.0)):
        raise DatasetError(f"--option {name}", f"{what}, a positive number", repr(text))
    return float(text)


def _is_number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True

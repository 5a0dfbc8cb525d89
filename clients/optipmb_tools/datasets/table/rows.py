"""Tables of boxes, one row per box: read, checked, in nanoseconds, metres and radians with z up."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.interface import Reports, georeference_of
from optipmb_tools.datasets.motion import SPEEDS, Moves, find_moves, find_reports, overlapping, typical_speed
from optipmb_tools.datasets.table.columns import ALIASES, FACTORS, NOTHING, Column, find_columns, normalised, turn_of
from optipmb_tools.datasets.table.columns import turned as turned_names
from optipmb_tools.datasets.table.corners import CORNERED, with_boxes
from optipmb_tools.datasets.table.findings import Reading
from optipmb_tools.datasets.table.pixels import METRES, Placed, place
from optipmb_tools.datasets.table.times import (
    COUNTED_HZ,
    CROWDED,
    DATED,
    SECONDS,
    Stamps,
    may_be_merged,
    may_be_seconds,
    median_step,
    nanoseconds,
    read_clock,
    read_frames,
    read_stamps,
    refuse_gap,
)
from optipmb_tools.datasets.table.values import (
    FULL_TURN,
    LARGEST_SIZE,
    NOISE,
    is_moving,
    no_angle,
    read_angle,
    read_axes,
    read_digits,
    read_heading,
    read_scores,
    read_sizes,
    read_turn,
    read_velocity,
)
from optipmb_tools.files import LARGEST, DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.table_files import NO_VALUE, Columns, frame_numbers, is_number, read_table, unique_texts

if TYPE_CHECKING:
    from optipmb import GroundCamera

NO_CLASS: Final = "object"  # class of all boxes of a table without classes
NO_ID: Final = -1  # id of a box that has none
_UNIT: Final = 1e-3
_MOST_SHOWN: Final = 6
_MOST_SENSORS: Final = 16
_LONGEST: Final = 30.0  # boxes that are longer, in metres, are suspicious
_LOOKED_AT: Final = 200  # texts of a column that tell whether it has numbers
_TILTED: Final = 1 / 12  # of a turn: largest angle about x and y of a box that stands upright
_TWICE: Final = 0.25  # share of boxes at the place of another one from which objects are reported twice
LEAST_VARIANCE: Final = 1e-8
LARGEST_VARIANCE: Final = 1e8  # variances of a position along any axis, m^2, as `Detections` have them
_LENGTHS: Final = ("x", "y", "z", "alt", "l", "w", "h", "vx", "vy", "pose_x", "pose_y", "pose_z")
_MARKS: Final = (-999, -9999, -99999, 999, 9999, 99999, -32768, 32767, 65535)  # numbers that often stand for no value
_SPARED: Final = ("z", "h", "score", "class")  # without a value in any row they are as without a column
_POSE: Final = ("pose_x", "pose_y", "pose_z")
_TURNS: Final = ("w", "x", "y", "z")
_NUMBERED: Final = re.compile(r"(.*[^\W\d_])[\W_]*\d+|\d+[\W_]*([^\W\d_].*)")  # a class, a number of an object
_LAST_OF_FOUR: Final = re.compile(r"(.*[._])?b?box(_?2d)?\.3")
_PIXELS: Final = re.compile(
    r"(.*_)?(px|pixels?|image|img|u|v|bb|xmin|ymin|xmax|ymax|x1|y1|x2|y2|bbox_(left|top|width|height))(_.*)?"
)


@dataclass(frozen=True)
class Boxes:
    """Rows of one table; a row that stands for an empty frame is left out of all but the frames."""

    frame_stamp: Ints  # (R,) ns, of every row, also those without a box
    frame_key: NDArray[np.str_]  # (R,) recording and sensor of every row
    frame_pose: Floats | None
    """(R, 7) translation and quaternion, world from sensor; None where boxes are in the world frame."""
    frame_time: NDArray[Any]  # (R,) time as the table has it
    frame_number: NDArray[Any] | None  # (R,) number of the frame as the table has it; None where it has none
    reports: Reports | None  # where objects report one by one
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
    camera: "GroundCamera | None" = None  # that placed the boxes

    def rows(self, first: int, last: int) -> "Boxes":
        """Return the table of the rows from `first` up to `last`, which are counted from 0 again."""
        if (first, last) == (0, len(self.frame_stamp)):
            return self
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
    tables = dict(loaded or {path: read_table(path, reading.options) for path in paths})
    frames = _is_frame_each(reading, tables)
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, columns in tables.items():
        roles = _columns_of(reading, columns).items()
        groups.setdefault(tuple(sorted(f"{role} {one.name}" for role, one in roles)), []).append(path)
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
        boxes = _Table(judged, columns, frames=frames).read(scored=scored)
        if frames:
            return [(reading.path, boxes)]
        found |= {path: boxes.rows(start, end) for path, start, end in zip(members, starts, ends, strict=True)}
    return [(path, found[path]) for path in paths]


def _is_frame_each(reading: Reading, tables: dict[Path, Columns]) -> bool:
    """Tell whether the tables of a folder are frames of one recording; those without stamps get their file's number."""
    filled = {path: columns for path, columns in tables.items() if len(next(iter(columns.values()), ()))}
    found = {path: _columns_of(reading, columns) for path, columns in filled.items()}
    if len(filled) < 2 or any("recording" in one for one in found.values()):  # noqa: PLR2004  of one nothing is joined
        return False
    for role in ("stamp", "frame"):
        if all(role in one for one in found.values()):
            times = [np.unique(columns[found[path][role].name]) for path, columns in filled.items()]
            if max(map(len, times)) > 1 or len(np.unique(np.concatenate(times))) == 1:
                return False
            order = sorted(zip((one[0] for one in times), filled, strict=True))
            tables |= {path: tables.pop(path) for _, path in order}  # in the order of time
            return True
    if any(one.keys() & {"stamp", "frame"} for one in found.values()) or not reading.path.is_dir():
        return False
    name, numbers = frame_numbers(list(tables))
    for (path, columns), number in zip(tables.items(), numbers, strict=True):
        tables[path] = {**columns, name: np.full(len(next(iter(columns.values()), ())), number)}
    return True


def _joined(tables: Sequence[Columns]) -> Columns:
    """Return the columns that all of some tables have as one; a column is text where it is text in one of them."""
    filled = [one for one in tables if len(next(iter(one.values()), ()))] or list(tables[:1])
    if len(filled) == 1:
        return filled[0]
    joined: Columns = {}
    for name in (one for one in filled[0] if all(one in other for other in filled)):
        parts = [one[name] for one in filled]
        kinds = {part.dtype.kind for part in parts}
        if len(kinds) > 1 and kinds != {"i", "f"}:
            parts = [np.where(np.isin(one := part.astype(np.str_), ("nan", "NaT")), "", one) for part in parts]
        joined[name] = np.concatenate(parts)
    return joined


def _columns_of(reading: Reading, columns: Columns) -> dict[str, Column]:
    """Return the column of each meaning, as the user says or by names and values."""
    chosen = {key.removeprefix("column."): name for key, name in reading.options.items() if key.startswith("column.")}
    for role, name in chosen.items():
        reading.name(f"column.{role}", [*columns, NOTHING], "a column", name)
    if "camera" in reading.options:
        chosen |= dict.fromkeys(METRES, NOTHING)
    taken = {role: name for role, name in chosen.items() if name in columns or name == NOTHING}
    words = {name for name, one in columns.items() if _has_no_number(one)}
    empty = {name for name, one in columns.items() if one.dtype.kind == "f" and len(one) and np.isnan(one).all()}
    found = find_columns([name for name in columns if name not in empty], taken, words)
    if empty:
        found = {role: one for role, one in find_columns(columns, taken, words).items() if role not in _SPARED} | found
    used = {one.name for one in found.values()}
    for role, one in find_columns(columns, taken).items():  # refused when it is read, as a number is expected
        if role not in found and one.name in words - used and _has_units(columns[one.name]):
            found[role] = one
    return found


class _Table:
    def __init__(self, reading: Reading, columns: Columns, *, frames: bool = False) -> None:
        self._reading = reading
        self._frames = frames  # whether each of the files is a frame
        self._time = reading.strict()  # without stamps nothing can be found
        self._columns = columns = _with_frame_numbers(reading, columns)
        self._rows = len(next(iter(columns.values())))
        self._objects: NDArray[np.str_] | None = None  # (R,) names of objects in the column of the class
        marks = [text.strip() for text in reading.options.get("missing", "").split(",") if text.strip()]
        if wrong := [text for text in marks if not is_number(text)]:
            raise DatasetError("--option missing", "numbers, with commas between them", repr(wrong[0]))
        self._marks = [float(text) for text in marks]
        self._columns = columns = with_boxes(reading, columns, _columns_of(reading, columns))
        self._found = _columns_of(reading, columns)
        self._factor = reading.positive("length_factor", "metres of a unit of length") or 1.0
        turn = None if "yaw" in self._found else turn_of(map(normalised, columns))
        self._turn_of, self._turn_columns = turn or ("", [])
        self._placed: Placed | None = None

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
        numbers = self._read_numbers(role, column.name)
        if role in _LENGTHS:
            numbers = numbers * (FACTORS.get(column.unit or "") or self._factor)
        return numbers

    def _read_numbers(self, role: str, name: str) -> Floats:
        values = self._columns[name]
        if values.dtype.kind not in "iuf":
            texts = ["" if text.strip() in NO_VALUE else text for text in values.tolist()]
            if role == "score":  # percent
                texts = [text.strip().removesuffix("%") for text in texts]
            bad = np.array([text != "" and not is_number(text) for text in texts], dtype=np.bool_)
            remedy = f"column.{role}=none ignores it" if bad.all() else "invalid=skip leaves such rows out"
            expected = f"a number in column {name} (--option {remedy})"
            if not self._reading.skips:
                self._reading.first(role, bad, expected, values)
            values = np.array([float(text) if is_number(text) else np.nan for text in texts])
            values[bad] = np.inf
        numbers = values.astype(np.float64)
        for mark in _MARKS if role in _LENGTHS and not self._marks else ():
            near = np.abs(numbers - mark) < 0.1 * abs(mark)
            if 1 < near.sum() < len(near) and (numbers[near] == mark).all():
                text = f"column {name} has {mark} in {near.sum()} rows, as a mark for no value"
                self._reading.doubt("rows", text, f"--option missing={mark}")
        return np.where(np.isin(numbers, self._marks), np.nan, numbers) if self._marks else numbers

    def _unit(self, role: str) -> str | None:
        return self._found[role].unit if role in self._found else None

    def read(self, *, scored: bool) -> Boxes:
        reading, found = self._reading, self._found
        key, key_columns, keys = self._keys()
        file = np.searchsorted([first for _, first in reading.files], np.arange(self._rows), side="right")
        series = unique_texts(key)[1] * (len(reading.files) + 1) + file * (not self._frames)
        stamps = self._stamps(series)
        centres = not {"l", "w"} & found.keys()
        self._refuse_pixels(centres=centres)
        center = self._centers(series, stamps)
        ends = (("l", 1.0 if centres else None), ("w", 1.0 if centres else None), ("h", 1.5))
        factor = reading.positive("size_factor", "a factor of sizes") or 1.0
        size = factor * np.column_stack([self._numbers(role, without) for role, without in ends])
        yaw, yaw_unit = self._yaw(scored=scored)
        turned = yaw_unit != "none"
        score, names, id_ = self._numbers("score", 1.0), self._names(stamps.ns), self._ids()
        self._note_missing(scored=scored, centres=centres, turned=turned)
        empty = np.isnan(center[:, :2]).all(axis=1) & (centres | np.isnan(size[:, :2]).all(axis=1))
        kept = np.asarray(~(empty | stamps.skipped))
        if scored:
            self._leave_out(kept, self._doubled(stamps.ns, series, center), "that another one repeats")
        self._release("x", "y", "z", "l", "w", "h", "yaw", "score", "class")
        kept = self._valid(kept, center, size, yaw, yaw_unit, score, names)
        if "score" in found and scored:
            score[kept] = read_scores(reading, score[kept], np.flatnonzero(kept))
            self._leave_out(kept, np.isnan(score), "with a score that is none")
            self._leave_out(kept, score == 0.0, "with a score of 0")
        covariance = self._covariances(kept) if scored else None
        if len(row := np.flatnonzero(kept)) < self._rows:
            center, size, yaw, names = center[row], size[row], yaw[row], names[row]
        kind = unique_texts(names)[1]
        stated = centres or found["l"].base == "l" or found["l"].base.endswith(("_l", "length"))
        if not centres:
            size = read_sizes(reading, size, names, stated=stated)
        if read_axes(reading, center):
            yaw = yaw if yaw_unit in {"quaternion", "none"} else read_angle(reading, "yaw", yaw, yaw_unit)
            center, size, yaw = _from_camera(center, size, yaw)
            yaw_unit = "rad"
        read_digits(reading, center)
        stamps = self._framed(stamps, series, row, center, size, kind, score, scored=scored)
        self._check_times(stamps, series, row, center, kind)
        pose = self._checked_poses(stamp := stamps.ns)
        world = _world(center, row, pose)[:, :2]
        motion = _Motion(row, pose, find_moves(series[row], stamp[row] / 1e9, world, kind))
        yaw = self._heading(motion, size, yaw, yaw_unit if turned else "none", centres=centres, strict=scored)
        looks = scored and pose is None and "sensor" not in found and self._placed is None
        reports = find_reports(series[row], stamp[row] / 1e9, world, kind) if looks else None
        if reports is not None:
            text = f"objects report one by one: a frame is a look at {reports.distance:.3g} m around its box"
            reading.doubt("time", text, "--option group=SECONDS joins them")
        self._note_columns(size)
        no_height = scored and centres and self._height not in found  # not even that is taken for granted
        return Boxes(
            frame_stamp=stamp,
            frame_key=key,
            frame_pose=pose,
            frame_time=stamps.time,
            frame_number=self._frame_numbers(),
            reports=reports,
            row=row,
            center=np.insert(center[:, :2], 2, np.nan, axis=1) if no_height else center,
            size=np.full_like(size, np.nan) if centres else size,
            yaw=yaw if turned else np.full_like(yaw, np.nan),
            velocity=self._velocity(motion, row),
            position_covariance=None if covariance is None else covariance[row],
            score=score[row],
            name=names,
            id=None if id_ is None else id_[row],
            time_column=stamps.column,
            key_columns=key_columns,
            sensor_column=found["sensor"].name if "sensor" in found else "",
            keys=keys,
            camera=self._placed.camera if self._placed else None,
        )

    def _release(self, *roles: str) -> None:
        """Free columns that were read, whose arrays would double the memory of a long table."""
        self._columns.update({self._found[role].name: np.empty(0) for role in roles if role in self._found})

    def _doubled(self, stamp: Ints, series: Ints, center: Floats) -> Bools:
        """Return the rows that are equal to another one of their recording in all columns."""
        order = np.lexsort((center[:, 1], center[:, 0], stamp, series))
        same = (np.diff(stamp[order]) == 0) & (np.diff(series[order]) == 0)
        same &= (np.diff(center[order, 0]) == 0.0) & (np.diff(center[order, 1]) == 0.0)
        first, second = order[:-1][same], order[1:][same]
        equal = np.ones(len(first), dtype=np.bool_)
        for one in self._columns.values():
            a, b = one[first], one[second]
            equal &= (a == b) | ((a != a) & (b != b))  # noqa: PLR0124  NaN differs from itself
        again = np.zeros(self._rows, dtype=np.bool_)
        again[second[equal]] = True
        return again

    def _place(self, series: Ints, stamps: Stamps) -> Placed | None:
        """Return the pixel boxes of a camera on the ground; None without a camera."""
        if "camera" not in self._reading.options:
            return None
        frame = np.unique(np.column_stack([series, stamps.ns]), axis=0, return_inverse=True)[1].reshape(-1)
        return place(self._reading, list(self._columns), self._read_numbers, frame, self._names(stamps.ns))

    def _checked_poses(self, stamp: Ints) -> Floats | None:
        """Return the poses of the table, which a camera on a vehicle needs, and a fixed one cannot have."""
        pose = self._poses(stamp)
        if self._placed is not None and (pose is None) == (self._placed.camera.mount == "vehicle"):
            wanted, found = ("poses", "none") if pose is None else ("none", "poses")
            expected = f"{wanted} of the vehicle, as mount = {self._placed.camera.mount} (pose columns or poses=FILE)"
            raise DatasetError(self._reading.path, expected, found)
        return pose

    def _refuse_pixels(self, *, centres: bool) -> None:
        """Refuse boxes of an image."""
        found = self._found
        named = [name for name in self._columns if _PIXELS.fullmatch(normalised(name).base)]
        lists = [one for one in self._columns if _LAST_OF_FOUR.fullmatch(one) and f"{one[:-1]}4" not in self._columns]
        named += lists
        flat = {"w", "h"} <= found.keys() and "l" not in found
        if "camera" in self._reading.options:
            return
        if not lists and ("z" in found or not (flat or (centres and named)) or "lat" in found):
            return
        received = f"{', '.join(named or [found['w'].name, found['h'].name])} and no length: boxes in pixels?"
        expected = (
            "boxes in metres, with z up, or --camera FILE, the calibration that places pixel boxes on the ground "
            "(docs/cameras.md)"
        )
        self._reading.refuse("sizes", expected, received, "--option column.l=NAME")

    def _note_columns(self, size: Floats) -> None:
        if self._reading.lenient:
            long = int((size[:, :2] > _LONGEST).any(axis=1).sum())
            if long:
                self._reading.note("rows", f"{long} boxes are longer than {_LONGEST:g} m")
            pairs = (role if role == one.name else f"{role} from {one.name}" for role, one in self._found.items())
            self._reading.note("columns", f"columns found: {', '.join(pairs)}")
        used = {one.name for one in self._found.values()} | set(self._turn_columns)
        used |= set(self._placed.columns if self._placed else ())
        unused = [name for name in self._columns if name not in used]
        stems = {name.rpartition(".")[0] for name in used} - {""}
        unused.sort(key=lambda name: name.rpartition(".")[0] not in stems)  # the rest of a group that is used in part
        if unused:
            more = f" and {len(unused) - _MOST_SHOWN} more" if len(unused) > _MOST_SHOWN else ""
            self._reading.note("columns", f"columns not used: {', '.join(unused[:_MOST_SHOWN])}{more}")

    def _note_missing(self, *, scored: bool, centres: bool, turned: bool) -> None:
        """Note assumptions about missing columns."""
        missing = ["the size"] * centres + ["the heading"] * (not turned)
        if missing:
            meaning = "unknown" if scored else "only centres can be compared"
            self._reading.note("sizes", f"no column for {' or '.join(missing)}: {meaning}")
        if not turned and (others := turned_names(self._columns)):
            text = f"the heading is unknown, though {', '.join(others[:_MOST_SHOWN])} may have it"
            self._reading.doubt("yaw", text, "--option column.yaw=NAME, or none")
        for role, text in ((self._height, "z = 0"), ("h", "a height of 1.5 m"), ("score", "a score of 1")):
            if role not in self._found and (scored if role == "score" else not (scored and centres)):
                self._reading.note(role, f"no column for {role}: {text} for every box")

    @property
    def _height(self) -> str:
        return "alt" if "alt" in self._found else "z"

    def _centers(self, series: Ints, stamps: Stamps) -> Floats:
        """Return centres (R, 3): x, y, z, or latitude and longitude where an origin is given and x is not.

        With a camera they come from its pixel boxes.
        """
        self._placed = self._place(series, stamps)
        if self._placed is not None:
            return np.insert(self._placed.center[:, :2], 2, 0.0, axis=1)
        origin, found = self._reading.options.get("origin"), self._found
        if origin is None and "lat" in found and "lon" in found and "x" not in found:
            expected = "x and y in metres, or an origin for the latitudes (--option origin=LAT,LON,HEIGHT)"
            raise DatasetError(self._reading.path, expected, f"columns {found['lat'].name}, {found['lon'].name}")
        if "x" in found or "lat" not in found or origin is None:
            return np.column_stack([self._numbers("x"), self._numbers("y"), self._numbers("z", 0.0)])
        alt = self._numbers("alt") if self._height == "alt" else None
        center = georeference_of(origin).to_world(self._numbers("lat"), self._numbers("lon"), alt)
        if alt is None:
            center[:, 2] = self._numbers("z", 0.0)
        return center

    def _stamps(self, series: Ints) -> Stamps:
        reading, found = self._reading, self._found
        rate = reading.positive("rate", "frames per second")
        column = found.get("stamp")
        skipped = np.zeros(self._rows, dtype=np.bool_)
        if column is None or (rate is not None and "frame" in found):
            return self._counted(series, rate)
        values = self._columns[column.name]
        missing = np.isnat(values) if values.dtype.kind == "M" else values != values  # noqa: PLR0124  NaN differs from itself
        if values.dtype.kind == "U":
            missing = np.isin(np.char.strip(values), NO_VALUE)
        if missing.any() and not missing.all() and reading.skips:
            skipped = missing
            near = np.maximum.accumulate(np.where(missing, 0, np.arange(self._rows)))
            values = values[np.where(missing[near], np.flatnonzero(~missing)[0], near)]
        else:
            expected = f"a stamp in column {column.name} (--option invalid=skip leaves such rows out)"
            self._time.first("time", missing, expected, values)
        if values.dtype.kind == "M":
            reading.note("time", f"stamps are dates in column {column.name}")
            return Stamps(values.astype("datetime64[ns]").astype(np.int64), values, column.name, skipped)
        shown = values
        if values.dtype.kind == "U" and (clock := read_clock(values)) is not None:
            reading.note("time", f"stamps are times of a day in column {column.name}")
            values = clock
        if values.dtype.kind not in "iuf":
            bad = np.array([not is_number(text) for text in values.tolist()], dtype=np.bool_)
            expected = f"stamps in column {column.name}: numbers, or dates as YYYY-MM-DD HH:MM:SS.ffffff"
            self._time.first("time", bad, expected, values)
            texts = [text.strip() for text in values.tolist()]
            integers = all(text.lstrip("+-").isdigit() for text in texts)  # as nanoseconds with an empty cell
            values = np.array(
                [int(text) for text in texts] if integers else texts, dtype=np.int64 if integers else np.float64
            )
        if rate is not None:
            counted = "nanosec" not in found and bool(np.all((values == np.round(values)) & (values < DATED[0])))
            if counted:
                reading.note("time", f"column {column.name} counts frames, {rate:g} a second")
                return Stamps(nanoseconds(reading, values, 1e9 / rate), values, column.name, skipped)
            reading.doubt("time", f"rate is not used: column {column.name} has times, not numbers of frames")
        if "nanosec" in found:
            whole = np.asarray(values == np.floor(values))
            self._time.first("time", ~whole, f"whole seconds in column {column.name}", values)
            part = self._numbers("nanosec")
            self._time.first("time", ~np.isfinite(part), f"nanoseconds in column {found['nanosec'].name}", part)
            reading.note("time", f"stamps are {column.name} + {found['nanosec'].name}")
            stamp = values.astype(np.int64) * 1_000_000_000 + part.astype(np.int64)
            return Stamps(stamp, stamp, "stamp_ns", skipped)
        unit = "s" if shown is not values else column.unit
        stamp = read_stamps(reading, values, series, unit, self._frame_numbers())
        return Stamps(stamp, shown if shown.dtype.kind == "U" and unit == "s" else values, column.name, skipped)

    def _frame_numbers(self) -> NDArray[Any] | None:
        """Return the numbers of the frames, if the table has several."""
        values = self._columns[self._found["frame"].name] if "frame" in self._found else None
        return None if values is None or (len(values) > 1 and (values == values[0]).all()) else values

    def _counted(self, series: Ints, rate: float | None) -> Stamps:
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
        stamp = nanoseconds(reading, numbers, 1e9 / rate)
        return Stamps(stamp, self._columns[column.name], column.name, np.zeros(self._rows, dtype=np.bool_))

    def _framed(
        self,
        stamps: Stamps,
        series: Ints,
        row: Ints,
        center: Floats,
        size: Floats,
        kind: Ints,
        score: Floats,
        *,
        scored: bool,
    ) -> Stamps:
        """Return the stamps of frames; refuse frames most of whose boxes stand at the places of others."""
        reading = self._reading

        def at_places(stamp: Ints, part: NDArray[Any]) -> Ints:
            frame = series[row]
            for one in (stamp, part):
                place = np.unique(one[row], return_inverse=True)[1]
                frame = np.unique(frame * len(stamp) + place, return_inverse=True)[1].astype(np.int64)
            return overlapping(frame, center[:, :2], size, kind, score[row])

        def crowd(stamp: Ints, part: NDArray[Any] = series) -> float:
            return float(np.mean(at_places(stamp, part) > 1)) if len(row) else 0.0

        column = self._found.get("frame")
        numbers = None if column is None or column.name == stamps.column else self._frame_numbers()
        name = "" if column is None else column.name
        stamps = read_frames(reading, stamps, series, numbers, crowd, name)
        share = crowd(stamps.ns) if scored else 0.0
        if share <= _TWICE:
            return stamps
        used = {one.name for one in self._found.values()}
        parts = (name for name in self._columns if name not in used and self._is_name_of_few(name))
        divider = next((name for name in parts if crowd(stamps.ns, self._columns[name]) < NOISE), None)
        counts = at_places(stamps.ns, series)
        received, option = f"{share:.0%} of the boxes at the place of another one of their stamp and class", ""
        if divider is not None:
            received, option = f"{received}, which differs in column {divider}", f"--option column.sensor={divider}"
        elif share > CROWDED and may_be_merged(stamps.ns, series, float(np.median(counts[counts > 1]))):
            received += ": stamps have lost digits, frames were merged, or two detectors see each object"
            option = "--option time=UNIT, if the stamps are right"
        else:
            received += ": objects are reported twice, by two detectors or before suppression"
        if option and share > CROWDED and "time" not in reading.options:
            reading.refuse("time", "boxes apart from each other under one stamp", received, option)
        else:
            reading.doubt("rows", received, option)
        return stamps

    def _check_times(self, stamps: Stamps, series: Ints, row: Ints, center: Floats, kind: Ints) -> None:
        """Refuse stamps far from all others, and whole milliseconds that may be seconds by the speeds of the boxes."""
        reading = self._reading
        refuse_gap(reading, stamps.ns, series)
        counted = "stamp" not in self._found or {"time", "rate"} & reading.options.keys()
        if counted or not may_be_seconds(stamps, series, self._unit("stamp")):
            return
        speed = typical_speed(series[row], stamps.ns[row] / 1e9, center[:, :2], kind)
        if speed > SPEEDS[0]:
            received = f"whole numbers that may be seconds; in milliseconds, boxes go at {speed:.3g} m/s"
            reading.refuse("time", "a unit of time", received, "--option time=s, or time=ms")

    def _is_name_of_few(self, column: str) -> bool:
        """Tell whether a column may have the names of a few sensors."""
        values = self._columns[column]
        return values.dtype.kind in "iU" and 1 < len(np.unique(values)) <= _MOST_SENSORS

    def _keys(self) -> tuple[NDArray[np.str_], tuple[str, ...], dict[str, tuple[str, ...]]]:
        names = tuple(self._found[role].name for role in ("recording", "sensor") if role in self._found)
        if not names or not self._rows:
            return np.full(self._rows, ""), names, {"": ("",) * len(names)}
        parts = [self._columns[name].astype(np.str_, copy=False) for name in names]
        place = np.zeros(self._rows, dtype=np.int64)
        for part in parts:
            values, own = unique_texts(part)
            place = place * len(values) + own
        _, first, place = np.unique(place, return_index=True, return_inverse=True)
        rows = list(zip(*(part[first].tolist() for part in parts), strict=True))
        joined = [".".join(row) for row in rows]
        keys = {joined[one]: rows[one] for one in np.argsort(first).tolist()}  # in the order of the table
        return np.array(joined, dtype=np.str_)[place], names, keys

    def _yaw(self, *, scored: bool) -> tuple[Floats, str | None]:
        """Return headings as the table has them, and the unit that is stated for them; `none` where there are none."""
        if "yaw" in self._found:
            return self._numbers("yaw"), self._unit("yaw")
        quaternion = None if self._turn_of in {"angles", "matrix"} else self._quaternion("q", "yaw")
        if quaternion is not None:
            w, x, y, z = quaternion.T
            return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z), "quaternion"
        parts = (
            np.column_stack([self._read_numbers("yaw", name) for name in self._turn_columns])
            if self._turn_columns
            else None
        )
        if parts is None:
            return np.full(self._rows, np.nan if scored else 0.0), "none"
        if self._turn_of == "matrix":
            return np.arctan2(parts[:, 3], parts[:, 0]), "quaternion"
        upright = 1 if self._reading.options.get("axes") == "camera" else 2
        turn = 360.0 if np.nanmax(np.abs(parts), initial=0.0) > FULL_TURN else 2.0 * np.pi
        if self._turn_of == "part" or (np.abs(np.delete(parts, upright, axis=1)) > _TILTED * turn).any():
            expected = "a column yaw (--option column.yaw=NAME), a quaternion, a matrix, or angles of upright boxes"
            raise DatasetError(self._reading.path, expected, f"the numbers {', '.join(self._turn_columns)}")
        column = self._turn_columns[upright]
        self._reading.note(
            "yaw", f"yaw is {column}, as boxes stand upright by the other angles", "--option column.yaw=NAME"
        )
        return parts[:, upright], normalised(column).unit

    def _quaternion(self, prefix: str, topic: str) -> Floats | None:
        """Return quaternions w x y z (R, 4); None where the table has none."""
        roles = [f"{prefix}{part}" for part in _TURNS]
        if not {roles[0], roles[3]} <= self._found.keys():
            return None
        named = not self._found[roles[0]].base[-1:].isdigit()
        if not named and not set(roles) <= self._found.keys():
            return None
        parts = np.column_stack([self._numbers(role, 0.0) for role in roles])  # about z alone w and z are enough
        return read_turn(self._reading, topic, parts, named=named)

    def _heading(
        self, motion: "_Motion", size: Floats, yaw: Floats, unit: str | None, *, centres: bool, strict: bool
    ) -> Floats:
        reading, moves = self._reading, motion.moves
        long = moves.take((size[moves.start, :2].max(axis=1) > 1.3 * size[moves.start, :2].min(axis=1)) | centres)
        unposed = motion.pose is None
        found = yaw
        if unit != "none":
            unknown = int(np.isnan(yaw).sum())
            if unknown < len(yaw):
                moving = unposed and is_moving(yaw, long)
                free = "yaw" in self._found and self._found["yaw"].name == CORNERED
                found = read_heading(reading, yaw, unit, long, motion.carry, strict=strict, moving=moving, free=free)
            if unknown:
                reading.note("yaw", f"{unknown} of {len(yaw)} boxes have no heading: it is unknown")
        if unposed and self._placed is None:
            reading.note("pose", "no columns for the pose of the sensor: boxes are assumed to be in the world frame")
            if unit != "none" and is_moving(found, long):
                text = f"the sensor seems to move, boxes share a motion in {moves.common.share:.0%} of the frames"
                reading.doubt("pose", f"{text}: add its poses", "pose columns, or --option poses=FILE")
        return found

    def _velocity(self, motion: "_Motion", row: Ints) -> Floats | None:
        """Return velocities (B, 2) along the axes of the boxes; NaN where unknown, None where there are none."""
        if not {"vx", "vy"} <= self._found.keys():
            return None
        velocity = np.column_stack([self._numbers("vx"), self._numbers("vy")])[row]
        velocity[np.isnan(velocity).any(axis=1)] = np.nan
        if len(motion.moves) and not np.nan_to_num(velocity).any():  # as detectors without velocities write
            self._reading.note("velocity", "every velocity is 0 though boxes move: velocities are unknown")
            return None
        posed = motion.pose is not None
        axes = read_velocity(self._reading, velocity, motion.moves, motion.carry, posed=posed)
        if axes == "world" and motion.pose is not None:
            flat = np.column_stack([velocity, np.zeros(len(velocity))])
            velocity = _rotated(motion.pose[row, 3:] * _INVERSE, flat)[:, :2]
        return velocity

    def _names(self, stamp: Ints) -> NDArray[np.str_]:
        column = self._found.get("class")
        if column is None:
            names, place = np.array([NO_CLASS]), np.zeros(self._rows, dtype=np.int64)
            self._reading.note("class", f"no column for class: every box is of class {NO_CLASS}")
        else:
            values = self._columns[column.name]
            if values.dtype.kind == "f":  # numbers with an empty cell
                values = np.where(np.isnan(values), "", np.char.mod("%g", values))
            names, place = unique_texts(values.astype(np.str_, copy=False))
            names = np.char.strip(names, " \t'\"")
            names = self._without_numbers(np.where(np.isin(names, NO_VALUE), "", names), place, stamp)
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
        return np.array([new[name] for name in names.tolist()], dtype=np.str_)[place]

    def _without_numbers(self, names: NDArray[np.str_], place: Ints, stamp: Ints) -> NDArray[np.str_]:
        """Return the classes of names that are a class and the number of an object, as `car:12`; else the names.

        Args:
            names: The different ones.
            place: (R,) of each row's name.
            stamp: (R,) of the rows.
        """
        split = {name: _NUMBERED.fullmatch(name) for name in names.tolist() if name}
        classes = {name: match[1] or match[2] for name, match in split.items() if match}
        if len(classes) < len(split) or len(set(classes.values())) == len(classes):
            return names
        found = np.array([classes.get(name, name) for name in names.tolist()])

        def most(values: NDArray[np.str_]) -> int:
            kind = np.unique(values, return_inverse=True)[1][place]
            frame = np.unique(stamp, return_inverse=True)[1]
            return int(np.unique(frame * len(values) + kind, return_counts=True)[1].max())

        if most(names) > 1 or most(found) == 1:  # a class may have several boxes in a frame, an object has one
            return names
        column = self._found["class"].name
        self._reading.note(
            "class", f"column {column} has classes and numbers of objects: {names[0]} is of class {found[0]}"
        )
        self._objects = names[place]
        return found

    def _ids(self) -> Ints | None:
        column = self._found.get("id")
        values = self._objects if column is None else self._columns[column.name]
        if values is None:
            return None
        if values.dtype.kind == "i":
            return values.astype(np.int64)
        texts = np.char.strip(values.astype(np.str_))
        numbers = np.unique(texts, return_inverse=True)[1].astype(np.int64)
        return np.where(np.isin(texts, (*NO_VALUE, "-1", "-1.0")), NO_ID, numbers)

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
        stamp = self._stamps(series).ns
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
        if self._placed is not None:
            return self._placed.covariance
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
        if not self._reading.skips:
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
        self,
        kept: Bools,
        center: Floats,
        size: Floats,
        yaw: Floats,
        unit: str | None,
        score: Floats,
        names: NDArray[np.str_],
    ) -> Bools:
        """Return the rows with a box that can be used; refuse one that cannot, unless the user leaves them out."""
        good = kept.copy()
        marks = "" if "missing" in self._reading.options else ", missing=NUMBER names a mark for no value"
        option = f"--option invalid=skip leaves such rows out{marks}"
        for what, values, fine in (
            ("finite x, y and z", center, (np.abs(center) <= LARGEST).all(axis=1)),
            ("positive length, width and height", size, (np.isfinite(size) & (size > 0.0)).all(axis=1)),
            (
                f"sizes up to {LARGEST_SIZE:g} m, or --option size_factor=0.01 or 0.001, length_factor for all lengths",
                size,
                ~(size > LARGEST_SIZE).any(axis=1),
            ),
            ("finite yaw", yaw, ~np.isinf(yaw)),
            ("a yaw within a turn", yaw, ~no_angle(self._reading, yaw, unit)),
            ("finite score", score, np.isfinite(score)),
            ("class", names, np.asarray(names != "", dtype=np.bool_)),
        ):
            bad = kept & ~fine
            if not self._reading.skips:
                self._reading.first("rows", bad, what, values, option)
            good &= fine
        self._leave_out(kept, ~good, "with values that are missing, not finite or out of range")
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


def _with_frame_numbers(reading: Reading, columns: Columns) -> Columns:
    """Return columns with the numbers of frames, or stamps, that their names hold: `frame_12.bin`.

    Raises:
        DatasetError: The names differ in several numbers.
    """
    found = _columns_of(reading, columns)
    if "stamp" in found:
        return columns
    named = (
        [found["frame"].name]
        if "frame" in found
        else [one for one in columns if normalised(one).base in ALIASES["frame"]]
    )
    for name in (one for one in named if _has_no_number(columns[one])):
        texts, place = np.unique(columns[name], return_inverse=True)
        if len(texts) > 1 and all(map(re.compile(r"\d").search, texts.tolist())):
            kind, numbers = frame_numbers([reading.path / text for text in texts.tolist()])
            return columns | {name if kind == "frame" else kind: np.array(numbers)[place]}
    return columns


def _has_units(texts: NDArray[np.str_]) -> bool:
    """Tell whether each text of a column begins with a number, as `87%` and `4.5 m`."""
    return all(re.match(r"[-+]?\.?\d", text.strip()) for text in texts.tolist() if text.strip() not in NO_VALUE)


def _has_no_number(values: NDArray[Any]) -> bool:
    """Tell whether a column has texts, none of which is a number."""
    if values.dtype.kind != "U":
        return False
    texts = [text for text in values[:_LOOKED_AT].tolist() if text.strip() not in NO_VALUE]
    return bool(texts) and not any(map(is_number, texts))

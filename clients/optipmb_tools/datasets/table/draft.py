"""State of the reading of a table, which each step extends."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.interface import Reports
from optipmb_tools.datasets.motion import Moves
from optipmb_tools.datasets.table.columns import FACTORS, TableColumn, candidates
from optipmb_tools.datasets.table.findings import Reading
from optipmb_tools.datasets.table.pixels import Placed
from optipmb_tools.files import DatasetError, is_number
from optipmb_tools.geometry import Bools, Floats, Ints
from optipmb_tools.table_files import NO_VALUE, Columns

if TYPE_CHECKING:
    from optipmb import GroundCamera

_LENGTHS: Final = ("x", "y", "z", "alt", "l", "w", "h", "vx", "vy", "pose_x", "pose_y", "pose_z")
_MOST_NAMED: Final = 24  # columns in an error
_COUNTS: Final = ("stamp", "nanosec", "frame")  # in which a mark for no value is a number
_OF_ROWS: Final = ("frame_stamp", "frame_key", "frame_pose", "frame_time", "frame_number")
_MARKS: Final = (-999, -9999, -99999, 999, 9999, 99999, -32768, 32767, 65535)  # numbers that often stand for no value


def _unset() -> Any:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Stamps:
    """Times of the rows of a table."""

    ns: Ints  # (R,)
    time: NDArray[Any]  # (R,) as the table has it
    column: str  # its name
    skipped: Bools  # (R,) rows without a stamp, which are left out


@dataclass(frozen=True)
class Draft:
    """Values of a table that the steps so far have found: of its rows (R,), and of its boxes (B,) once they are known.

    A step reads fields that earlier steps have set.
    """

    columns: Columns
    rows: int
    scored: bool = False  # whether boxes are detections, which have a score
    framed: bool = False  # whether each of the files is a frame
    roles: Mapping[str, TableColumn] = field(default_factory=dict)
    turn_of: str = ""  # kind of an orientation of several numbers
    turn_columns: tuple[str, ...] = ()
    key: NDArray[np.str_] = field(default_factory=_unset)  # (R,) recording and sensor
    key_columns: tuple[str, ...] = ()
    keys: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    series: Ints = field(default_factory=_unset)  # (R,) number of each row's recording
    stamps: Stamps = field(default_factory=_unset)
    name: NDArray[np.str_] = field(default_factory=_unset)  # class: (R,), then (B,)
    id: Ints | None = None  # (R,), then (B,)
    placed: Placed | None = None
    center: Floats = field(default_factory=_unset)  # (R, 3), then (B, 3)
    size: Floats = field(default_factory=_unset)
    centres: bool = False  # whether boxes have no size
    unsized: Bools = field(default_factory=_unset)  # (R,) rows of unknown size
    yaw: Floats = field(default_factory=_unset)
    yaw_unit: str | None = None  # in the name of the column; `quaternion`, or `none` where there are no headings
    score: Floats = field(default_factory=_unset)
    kept: Bools = field(default_factory=_unset)  # (R,) rows with a box
    covariance: Floats | None = None  # (R, 3, 3), then (B, 3, 3)
    row: Ints = field(default_factory=_unset)  # (B,)
    kind: Ints = field(default_factory=_unset)  # (B,) number of the class
    apart: tuple[str, ...] = ()  # classes whose boxes are things of their own, however close
    pose: Floats | None = None  # (R, 7)
    moves: Moves = field(default_factory=_unset)  # of the boxes, in the world
    velocity: Floats | None = None  # (B, 2)
    reports: Reports | None = None

    @property
    def height(self) -> str:
        """Meaning of the column of heights."""
        return "alt" if "alt" in self.roles else "z"

    def unit(self, role: str) -> str | None:
        """Return the unit in the name of a column."""
        return self.roles[role].unit if role in self.roles else None

    @property
    def frame_numbers(self) -> NDArray[Any] | None:
        """Numbers of the frames, if the table has several."""
        values = self.columns[self.roles["frame"].name] if "frame" in self.roles else None
        return None if values is None or (len(values) > 1 and (values == values[0]).all()) else values


@dataclass(frozen=True)
class TableRows:
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
    apart: tuple[str, ...] = ()  # classes whose boxes are things of their own, however close
    attributes: NDArray[np.object_] | None = None  # (B,) texts by name; None: no columns of the table are attributes
    camera: "GroundCamera | None" = None  # that placed the boxes

    def rows(self, first: int, last: int) -> "TableRows":
        """Return the table of the rows from `first` up to `last`, which are counted from 0 again."""
        if (first, last) == (0, len(self.frame_stamp)):
            return self
        mine = (self.row >= first) & (self.row < last)
        arrays = {name: one for name, one in vars(self).items() if isinstance(one, np.ndarray)}
        parts: dict[str, Any] = {
            name: one[first:last] if name in _OF_ROWS else one[mine] for name, one in arrays.items()
        }
        return replace(self, **parts | {"row": self.row[mine] - first})


def numbers(reading: Reading, draft: Draft, role: str, otherwise: float | None = None) -> Floats:
    """Return a column of numbers, NaN where there is none."""
    column = draft.roles.get(role)
    if column is None:
        if otherwise is None:
            raise missing(reading, draft, role)
        return np.full(draft.rows, otherwise)
    found = column_numbers(reading, draft, role, column.name)
    if role in _LENGTHS:
        asked = reading.positive("length_factor", "metres of a unit of length")
        found = found * (FACTORS.get(column.unit or "") or asked or 1.0)
    return found


def missing(reading: Reading, draft: Draft, role: str) -> DatasetError:
    """Return the error for a column that a table must have; it names all such columns, and those that may be meant."""
    if error := reading.named.get(f"column.{role}"):
        return error
    roles = draft.roles.keys()
    lacks = [] if {"stamp", "frame"} & roles else ["stamp"]
    lacks += [one for one in ("x", "y") if one not in roles and not {"lat", "lon"} <= roles]
    lacks += [one for one in ("l", "w") if one not in roles and {"l", "w"} & roles]
    if role not in lacks or "camera" in reading.options:
        lacks = [role]
    unused = draft.columns.keys() - {one.name for one in draft.roles.values()}
    likely = {one: [name for name in candidates(draft.columns, one) if name in unused] for one in lacks}
    option = " ".join(f"--option column.{one}={'NAME' if not names else names[0]}" for one, names in likely.items())
    if role == "pose_yaw":
        option += ", or column.pose_x=none where boxes are in the world"
    expected = f"{'a column' if len(lacks) == 1 else 'columns'} {', '.join(lacks)} ({option})"
    if "stamp" in lacks:
        option = option.replace("--option column.stamp=NAME", "t, stamp_ns …; --option column.stamp=NAME")
        others = f", and columns {', '.join(lacks[1:])}" if len(lacks) > 1 else ""
        expected = f"a column of stamps ({option}) or of frames{others}"
    have = [*draft.columns]
    numbered = {re.sub(r"\d+", "#", name) for names in likely.values() for name in names if re.search(r"\d", name)}
    sets = [name for names in likely.values() for name in names if re.sub(r"\d+", "#", name) in numbered]
    if len(sets) > len(likely) * 2 and "stamp" not in lacks:  # such a column has one of the objects alone
        expected = f"a row for each box, with columns {', '.join(lacks)}, instead of objects side by side"
        return DatasetError(reading.path, expected, f"the columns {', '.join(sets[:_MOST_NAMED])}")
    more = f" and {len(have) - _MOST_NAMED} more" if len(have) > _MOST_NAMED else ""
    return DatasetError(reading.path, expected, f"the columns {', '.join(have[:_MOST_NAMED])}{more}")


def column_numbers(reading: Reading, draft: Draft, role: str, name: str) -> Floats:
    """Return the numbers of a column, NaN where a cell has none or a mark for none."""
    values = draft.columns[name]
    if values.dtype.kind not in "iuf":
        texts = ["" if text.strip() in NO_VALUE else text for text in values.tolist()]
        if role == "score":  # percent
            texts = [text.strip().removesuffix("%") for text in texts]
        bad = np.array([text != "" and not is_number(text) for text in texts], dtype=np.bool_)
        remedy = f"column.{role}=none ignores it" if bad.all() else "invalid=skip leaves such rows out"
        expected = f"a number in column {name} (--option {remedy})"
        if not reading.skips:
            reading.first(role, bad, expected, values)
        values = np.array([float(text) if is_number(text) else np.nan for text in texts])
        values[bad] = np.inf
    found = values.astype(np.float64)
    for mark in _MARKS if role in _LENGTHS and not reading.marks else ():
        near = np.abs(found - mark) < 0.1 * abs(mark)
        if 1 < near.sum() < len(near) and (found[near] == mark).all():
            text = f"column {name} has {mark} in {near.sum()} rows, as a mark for no value"
            reading.doubt("rows", text, f"--option missing={mark}")
    return np.where(np.isin(found, reading.marks), np.nan, found) if reading.marks and role not in _COUNTS else found


def leave_out(reading: Reading, kept: Bools, bad: Bools, what: str) -> Bools:
    """Return the rows of `kept` that are not `bad`, and say how many are."""
    if count := int((kept & bad).sum()):
        reading.note("rows", f"{count} rows {what} are left out")
    return np.asarray(kept & ~bad)

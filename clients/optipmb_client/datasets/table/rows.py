"""A table of boxes, one row per box: read, checked, in nanoseconds, metres and radians with z up."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_client.datasets.table.names import find_columns
from optipmb_client.datasets.table.values import (
    Reading,
    read_angle,
    read_axes,
    read_scores,
    read_sizes,
    read_stamps,
)
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Floats, Ints, wrap_angle
from optipmb_client.table_files import Columns, read_table

__all__ = ["NO_CLASS", "NO_ID", "Boxes", "line_of", "read_boxes"]

NO_CLASS: Final = "object"
"""Class of all boxes of a table without classes."""
NO_ID: Final = -1
"""Id of a box that has none."""
_UNIT: Final = 1e-3
_MOST_SHOWN: Final = 6
LEAST_VARIANCE: Final = 1e-8
LARGEST_VARIANCE: Final = 1e8
"""Variances of a position along any axis, m^2, as `Detections` have them."""
_POSE: Final = ("pose_x", "pose_y", "pose_z")
_TURNS: Final = ("w", "x", "y", "z")


@dataclass(frozen=True)
class Boxes:
    """The rows of one table; those of a row that stands for an empty frame are left out of all but the frames."""

    frame_stamp: Ints
    """(R,) ns, of every row, also those without a box."""
    frame_key: NDArray[np.str_]
    """(R,) recording and sensor of every row."""
    frame_pose: Floats | None
    """(R, 7) translation and quaternion, world from sensor; None where boxes are in the world frame."""
    frame_time: NDArray[Any]
    """(R,) time as the table has it."""
    row: Ints
    """(B,) row of each box, counted from 0."""
    center: Floats
    """(B, 3)"""
    size: Floats
    """(B, 3); NaN in a table of objects that has neither l nor w."""
    yaw: Floats
    """(B,); NaN in a table of objects that has none."""
    velocity: Floats | None
    """(B, 2); rows of NaN where unknown."""
    position_covariance: Floats | None
    """(B, 3, 3) of the errors of the centres along the axes of the boxes, m^2; of NaN where unknown, None without."""
    score: Floats
    """(B,) in (0, 1]"""
    name: NDArray[np.str_]
    """(B,) class"""
    id: Ints | None
    """(B,) object, `NO_ID` where the cell has none; None where the table has no such column."""
    time_column: str
    key_columns: tuple[str, ...]
    sensor_column: str
    """That of `key_columns` which names the sensor; empty: none does."""
    keys: Mapping[str, tuple[str, ...]]
    """Key -> values of the columns that it stands for."""


def line_of(path: Path, row: int) -> int:
    """Return the line, from 1, of a row, from 0."""
    return row + (2 if path.name.lower().endswith((".csv", ".tsv", ".gz")) else 1)


def read_boxes(reading: Reading, *, scored: bool, columns: Columns | None = None) -> Boxes:
    """Read the table of a `Reading`; what was assumed is noted there.

    Args:
        reading: the file and the options of the user.
        scored: whether boxes are detections, which have a score, a size and a heading.
        columns: of the file, where they were read already.

    Raises:
        DatasetError: a column is missing or a value is not allowed; names the line.
        ClientError: pyarrow is not installed.
    """
    columns = read_table(reading.path) if columns is None else columns
    if not columns or not len(next(iter(columns.values()))):
        raise DatasetError(reading.path, "rows", f"none, columns {', '.join(columns) or 'none'}")
    return _Table(reading, columns).read(scored=scored)


class _Table:
    def __init__(self, reading: Reading, columns: Columns) -> None:
        self._reading = reading
        self._columns = columns
        self._rows = len(next(iter(columns.values())))
        chosen = {
            key.removeprefix("column."): name for key, name in reading.options.items() if key.startswith("column.")
        }
        for role, name in chosen.items():
            if name not in columns:
                option = f"column.{role}"
                error = DatasetError(f"--option {option}", f"a column: {', '.join(columns)}", repr(name))
                reading.unmatched[option] = error
        chosen = {role: name for role, name in chosen.items() if name in columns}
        self._found = find_columns(columns, chosen)

    def _line(self, row: int) -> int:
        return line_of(self._reading.path, row)

    def _numbers(self, role: str, otherwise: float | None = None) -> Floats:
        """Return a column of numbers, NaN where there is none."""
        column = self._found.get(role)
        if column is None:
            if otherwise is None:
                if error := self._reading.unmatched.get(f"column.{role}"):
                    raise error
                have = ", ".join(self._columns)
                raise DatasetError(
                    self._reading.path, f"a column {role} (--option column.{role}=NAME)", f"the columns {have}"
                )
            return np.full(self._rows, otherwise)
        values = self._columns[column.name]
        if values.dtype.kind not in "if":
            bad = np.array([not _is_number(text) for text in values.tolist()])
            self._reading.first(bad, self._line, f"a number in column {column.name}", values)
            values = np.array([float(text) if text else np.nan for text in values.tolist()])
        return values.astype(np.float64)

    def _unit(self, role: str) -> str | None:
        return self._found[role].unit if role in self._found else None

    def read(self, *, scored: bool) -> Boxes:
        reading, found = self._reading, self._found
        stamp, time, time_column = self._stamps()
        key, key_columns, keys = self._keys()
        center = np.column_stack([self._numbers("x"), self._numbers("y"), self._numbers("z", 0.0)])
        centres = not scored and not {"l", "w"} & found.keys()
        side = 1.0 if centres else None
        size = np.column_stack([self._numbers("l", side), self._numbers("w", side), self._numbers("h", 1.5)])
        yaw, turned = self._yaw(otherwise=None if scored else 0.0)
        if centres or not turned:
            reading.note("no columns for the size or the heading: only centres can be compared")
        score = self._numbers("score", 1.0)
        names, id_ = self._names(), self._ids()
        for role, text in (("z", "z = 0"), ("h", "a height of 1.5 m"), ("score", "a score of 1")):
            if role not in found and (scored or role != "score"):
                reading.note(f"no column for {role}: {text} for every box")
        empty = np.isnan(center[:, :2]).all(axis=1) & (centres | np.isnan(size[:, :2]).all(axis=1))
        kept = self._valid(np.asarray(~empty), center, size, yaw, score)
        if "score" in found and scored:
            score[kept] = read_scores(reading, score[kept])
            outside = kept & ((score < 0.0) | (score > 1.0))
            reading.first(outside, self._line, "a score from 0 to 1 (--option score=logit, or percent)", score)
            zero = kept & (score == 0.0)
            if zero.any():
                reading.note(f"{int(zero.sum())} detections with a score of 0 are left out")
                kept &= ~zero
        covariance = self._covariances(kept) if scored else None
        row = np.flatnonzero(kept)
        stated = centres or found["l"].base in {"l", "length", "box_length"} or found["l"].base.endswith("_l")
        size = read_sizes(reading, size[row], names[row], stated=stated)
        angle = read_angle(reading, yaw[row], self._unit("yaw"))
        center, size, angle = read_axes(reading, center[row], size, angle)
        velocity = None
        if "vx" in found and "vy" in found:
            velocity = np.column_stack([self._numbers("vx"), self._numbers("vy")])[row]
            velocity[np.isnan(velocity).any(axis=1)] = np.nan
        unused = [name for name in self._columns if name not in {one.name for one in found.values()}]
        if unused:
            more = f" and {len(unused) - _MOST_SHOWN} more" if len(unused) > _MOST_SHOWN else ""
            reading.note(f"columns not used: {', '.join(unused[:_MOST_SHOWN])}{more}")
        return Boxes(
            frame_stamp=stamp,
            frame_key=key,
            frame_pose=self._poses(),
            frame_time=time,
            row=row,
            center=center,
            size=np.full_like(size, np.nan) if centres else size,
            yaw=wrap_angle(angle) if turned else np.full_like(angle, np.nan),
            velocity=velocity,
            position_covariance=None if covariance is None else covariance[row],
            score=score[row],
            name=names[row],
            id=None if id_ is None else id_[row],
            time_column=time_column,
            key_columns=key_columns,
            sensor_column=self._found["sensor"].name if "sensor" in self._found else "",
            keys=keys,
        )

    def _stamps(self) -> tuple[Ints, NDArray[Any], str]:
        reading, found = self._reading, self._found
        rate = _rate(reading.options)
        column = found.get("stamp") if rate is None else found.get("frame", found.get("stamp"))
        if column is None:
            expected = "a column of stamps (t, stamp_ns …; --option column.stamp=NAME)"
            if "frame" in found:
                expected += ", or the rate of the frames that are counted (--option rate=HZ)"
            raise DatasetError(reading.path, expected, f"the columns {', '.join(self._columns)}")
        values = self._columns[column.name]
        missing = np.isnat(values) if values.dtype.kind == "M" else values != values  # noqa: PLR0124  NaN differs from itself
        reading.first(missing, self._line, f"a stamp in column {column.name}", values)
        if rate is not None:
            return np.round(values.astype(np.float64) * (1e9 / rate)).astype(np.int64), values, column.name
        stamp = read_stamps(reading, values, column.unit)
        if stamp.min() < 0:
            reading.first(stamp < 0, self._line, "a stamp that is not negative", values)
        return stamp, values, column.name

    def _keys(self) -> tuple[NDArray[np.str_], tuple[str, ...], dict[str, tuple[str, ...]]]:
        names = tuple(self._found[role].name for role in ("recording", "sensor") if role in self._found)
        if not names:
            return np.full(self._rows, "", dtype=np.str_), (), {"": ()}
        parts = [self._columns[name].astype(np.str_).tolist() for name in names]
        joined = [".".join(row) for row in zip(*parts, strict=True)]
        return np.array(joined, dtype=np.str_), names, dict(zip(joined, zip(*parts, strict=True), strict=True))

    def _yaw(self, otherwise: float | None) -> tuple[Floats, bool]:
        """Return headings, and whether the table has any."""
        if "yaw" in self._found:
            return self._numbers("yaw"), True
        turns = [f"q{part}" for part in _TURNS]
        if all(role in self._found for role in turns):
            w, x, y, z = (self._numbers(role) for role in turns)
            return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z), True
        return self._numbers("yaw", otherwise), False

    def _names(self) -> NDArray[np.str_]:
        column = self._found.get("class")
        if column is None:
            self._reading.note(f"no column for class: every box is of class {NO_CLASS}")
        names = np.full(self._rows, NO_CLASS) if column is None else self._columns[column.name].astype(np.str_)
        renamed = {
            key.removeprefix("class."): name for key, name in self._reading.options.items() if key.startswith("class.")
        }
        have = ", ".join(sorted(set(names.tolist())))
        for name in sorted(set(renamed) - set(names.tolist())):
            error = DatasetError(f"--option class.{name}", f"a class of the table: {have}", repr(name))
            self._reading.unmatched[f"class.{name}"] = error
        return np.array([renamed.get(name, name) for name in names.tolist()], dtype=np.str_)

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

    def _poses(self) -> Floats | None:
        """Return the poses (R, 7) that the table has."""
        if not all(role in self._found for role in _POSE[:2]):
            self._reading.note("no columns for the pose of the sensor: boxes are assumed to be in the world frame")
            return None
        translation = np.column_stack([self._numbers("pose_x"), self._numbers("pose_y"), self._numbers("pose_z", 0.0)])
        roles = [f"pose_q{part}" for part in _TURNS]
        if all(role in self._found for role in roles):
            quaternion = np.column_stack([self._numbers(role) for role in roles])
            norm = np.linalg.norm(quaternion, axis=1)
            self._reading.first(
                np.asarray(~(abs(norm - 1.0) < _UNIT)), self._line, "a pose with a unit quaternion", norm
            )
        else:
            turn = read_angle(self._reading, self._numbers("pose_yaw"), self._unit("pose_yaw"))
            zero = np.zeros(self._rows)
            quaternion = np.column_stack([np.cos(turn / 2), zero, zero, np.sin(turn / 2)])
        bad = np.asarray(~np.isfinite(translation).all(axis=1))
        self._reading.first(bad, self._line, "a pose of finite numbers", translation[:, 0])
        return np.column_stack([translation, quaternion])

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
            self._reading.first(bad, self._line, expected, np.column_stack((xx, xy, yy)))
        if bad.any():
            self._reading.note(f"{int(bad.sum())} rows with covariances that are none are left out")
            kept &= ~bad
        covariance = np.zeros((self._rows, 3, 3))
        covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2] = xx, yy, 0.5 * (xx + yy)
        covariance[:, 0, 1] = covariance[:, 1, 0] = xy
        covariance[unknown] = np.nan
        return covariance

    def _valid(
        self, kept: NDArray[np.bool_], center: Floats, size: Floats, yaw: Floats, score: Floats
    ) -> NDArray[np.bool_]:
        """Return the rows with a box that can be used; raise for one that cannot, unless the user leaves them out."""
        skip = self._reading.chosen("invalid", ("skip", "refuse")) == "skip"
        good = kept.copy()
        for name, values in (
            ("x, y and z", center),
            ("length, width and height", size),
            ("yaw", yaw),
            ("score", score),
        ):
            fine = np.isfinite(values if values.ndim > 1 else values[:, None]).all(axis=1)
            if values is size:
                fine &= (np.where(np.isfinite(size), size, 1.0) > 0.0).all(axis=1)
            bad = kept & ~fine
            if bad.any() and not skip:
                kind = "positive " if values is size else "finite "
                expected = f"{kind}{name} (--option invalid=skip leaves such rows out)"
                self._reading.first(np.asarray(bad), self._line, expected, values)
            good &= fine
        left = int((kept & ~good).sum())
        if left:
            self._reading.note(f"{left} rows with values that are missing, not finite or not positive are left out")
        return good


def _rate(options: Mapping[str, str]) -> float | None:
    text = options.get("rate")
    if text is None:
        return None
    if not _is_number(text) or not 0.0 < float(text) < float("inf"):
        raise DatasetError("--option rate", "frames per second, a positive number", repr(text))
    return float(text)


def _is_number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True

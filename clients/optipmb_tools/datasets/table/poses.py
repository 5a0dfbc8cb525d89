"""Poses of the sensor, of the table or of another one, and the moves of boxes in the world."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.motion import find_moves
from optipmb_tools.datasets.table import roles, times
from optipmb_tools.datasets.table.angles import read_angle, read_quaternion, read_turn
from optipmb_tools.datasets.table.columns import TableColumn, find_columns
from optipmb_tools.datasets.table.draft import Draft, column_numbers, numbers
from optipmb_tools.datasets.table.findings import Claim, Reading
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Ints, quaternion_of
from optipmb_tools.table_files import Columns, read_table

_UNIT: Final = 1e-3
_LEAST_TURN: Final = 1e-6
_SEVEN: Final = 7  # numbers of a place and a quaternion
_MATRIX: Final = 16


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the poses, and find the moves of boxes in the world."""
    row, stamp = draft.row, draft.stamps.ns
    pose = _checked(reading, draft)
    center = draft.center if pose is None else rotated(pose[row, 3:], draft.center) + pose[row, :3]
    moves = find_moves(draft.series[row], stamp[row] / 1e9, center[:, :2], draft.kind)
    return replace(draft, pose=pose, moves=moves)


def _poses(reading: Reading, draft: Draft) -> Floats | None:
    """Return the poses (R, 7) of the table, or of another one at its stamps."""
    if "poses" in reading.options:
        return _poses_at(reading, Path(reading.options["poses"]), draft.stamps.ns)
    if not {"pose_x", "pose_y"} <= draft.roles.keys():
        return None
    stem = re.escape(re.sub(r"[._]?0([._]0)?$", "", draft.roles["pose_x"].name))
    listed = [name for name in draft.columns if re.fullmatch(rf"{stem}[._]?\d+([._]\d)?", name)]
    if len(listed) in {_SEVEN, _MATRIX - 4, _MATRIX}:
        return _of_list(reading, np.column_stack([column_numbers(reading, draft, "pose", name) for name in listed]))
    return _of_columns(reading, draft, "pose_")


def _of_list(reading: Reading, values: Floats) -> Floats:
    """Return the poses (R, 7) of lists: a place and a quaternion in either order, or a matrix by rows."""
    if values.shape[1] >= _MATRIX - 4:
        rows = values[:, : _MATRIX - 4].reshape(-1, 3, 4)
        turn = np.array([quaternion_of(one) for one in rows[:, :, :3]]).reshape(-1, 4)
        return np.column_stack([rows[:, :, 3], turn])
    claims = []
    for order, part in (("the place", values[:, 3:]), ("the quaternion", values[:, :4])):
        unit = abs(np.linalg.norm(part, axis=1) - 1.0) < _UNIT
        claims.append(Claim(order, Evidence(float(unit.sum()), len(unit)), f"poses are lists, {order} first"))
    first = reading.decide("pose", claims)
    place, turn = (values[:, :3], values[:, 3:]) if first == "the place" else (values[:, 4:], values[:, :4])
    turn = read_turn(reading, "pose", turn, named=False)
    reading.first("pose", ~(abs(np.linalg.norm(turn, axis=1) - 1.0) < _UNIT), "a pose with a unit quaternion", turn)
    return np.column_stack([place, turn])


def _of_columns(reading: Reading, draft: Draft, prefix: str) -> Floats:
    """Return the poses (R, 7) of a table."""
    ends = (("x", None), ("y", None), ("z", 0.0))
    translation = np.column_stack([numbers(reading, draft, f"{prefix}{axis}", without) for axis, without in ends])
    pose = np.column_stack([translation, _turn(reading, draft, prefix)])
    reading.first("pose", np.asarray(~np.isfinite(pose).all(axis=1)), "a pose of finite numbers", translation[:, 0])
    return pose


def _checked(reading: Reading, draft: Draft) -> Floats | None:
    """Return the poses of the table, which a camera on a vehicle needs, and a fixed one cannot have."""
    pose = _poses(reading, draft)
    if draft.placed is not None and (pose is None) == (draft.placed.camera.mount == "vehicle"):
        wanted, found = ("poses", "none") if pose is None else ("none", "poses")
        expected = f"{wanted} of the vehicle, as mount = {draft.placed.camera.mount} (pose columns or poses=FILE)"
        raise DatasetError(reading.path, expected, found)
    return pose


def _turn(reading: Reading, draft: Draft, prefix: str) -> Floats:
    """Return the unit quaternions (R, 4) of poses, which the table has as such or as yaws."""
    quaternion = read_quaternion(reading, draft, f"{prefix}q", "pose")
    if quaternion is None:
        role = f"{prefix}yaw"
        turn = read_angle(reading, role, numbers(reading, draft, role), draft.unit(role))
        zero = np.zeros(draft.rows)
        return np.column_stack([np.cos(turn / 2), zero, zero, np.sin(turn / 2)])
    norm = np.linalg.norm(quaternion, axis=1)
    reading.first("pose", ~(abs(norm - 1.0) < _UNIT), "a pose with a unit quaternion", norm)
    return quaternion


def _trajectory(reading: Reading, columns: Columns) -> tuple[Ints, Floats]:
    """Return the stamps (P,) and poses (P, 7) of a table of poses, in the order of time."""
    rows = len(next(iter(columns.values()), ()))
    draft = Draft(columns, rows, roles=roles.find(reading, columns), series=np.zeros(rows, dtype=np.int64))
    draft = times.step(reading, roles.step(reading, draft))
    pose = _of_columns(reading, draft, "" if "x" in draft.roles else "pose_")
    stamp, first = np.unique(draft.stamps.ns, return_index=True)
    return stamp, pose[first]


def _poses_at(reading: Reading, path: Path, stamp: Ints) -> Floats:
    """Return the poses (R, 7) of a table of poses at stamps (R,), interpolated.

    Raises:
        DatasetError: a stamp lies before the first or after the last pose.
    """
    columns = read_table(path, reading.options)
    column = find_columns(columns, {}).get("stamp", TableColumn("", None, ""))
    time = reading.options.get("time")
    options = {"time": time} if time in times.SECONDS and column.unit is None else {}
    own = Reading(path, {name: one for name, one in reading.options.items() if name in {"yaw", "quaternion"}} | options)
    if not len(next(iter(columns.values()), ())):
        raise DatasetError(path, "poses", "no rows")
    known, pose = _trajectory(own, columns)
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


def rotated(quaternion: Floats, vector: Floats) -> Floats:
    """Return vectors (N, 3) turned by unit quaternions (N, 4)."""
    across = 2.0 * np.cross(quaternion[:, 1:], vector)
    return np.asarray(vector + quaternion[:, :1] * across + np.cross(quaternion[:, 1:], across), dtype=np.float64)

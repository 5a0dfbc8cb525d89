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
from typing import TYPE_CHECKING, Final

import numpy as np
from optipmb_schemas import Tracks

from optipmb_client.results.rows import stacked
from optipmb_client.table_files import Columns

if TYPE_CHECKING:
    from optipmb_client.datasets.interface import DataSequence

_STATE: Final = ("x", "y", "v", "phi", "omega", "a")
COVARIANCE: Final = {f"cov_{_STATE[i]}_{_STATE[j]}": (i, j) for i in range(6) for j in range(i, 6)}
"""Column -> place in the covariance (6, 6)."""


def track_columns(
    name: str, tracks: Mapping[int, Tracks], sequence: "DataSequence | None" = None, *, full: bool = False
) -> Columns:
    """Return tracks (world frame) by frame index as columns, with `full` also the covariance.

    Args:
        name: Value of the column `sequence`.
        tracks: The tracks of each frame.
        sequence: What was tracked; knows the columns and rows of its table of detections, if it came from one.
        full: Whether to add the covariance.
    """
    order = sorted(tracks)
    parts = [tracks[index] for index in order]
    frame = np.repeat(np.array(order, dtype=np.int64), [len(one.id) for one in parts])
    names = [name for one in parts for name in np.asarray(one.labels, np.str_)[one.label]]
    numbers = None if sequence is None else sequence.numbers
    columns: Columns = {} if sequence is None else {one: each[frame] for one, each in sequence.frame_columns.items()}
    if sequence is not None and sequence.time_column and sequence.times is not None:
        keys = {column: np.full(len(frame), value) for column, value in sequence.key_columns.items()}
        columns = keys | columns | {sequence.time_column: sequence.times[frame]}
    else:
        stamps = np.repeat(np.array([one.stamp_ns for one in parts], dtype=np.int64), [len(one.id) for one in parts])
        columns = {"sequence": np.full(len(frame), name)} | columns | {"stamp_ns": stamps}
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
    detection: list[float] = []
    for index, part in zip(order, parts, strict=True):
        rows = None if sequence is None else sequence.rows(index)
        place = part.detection.tolist()
        detection += [np.nan if one < 0 else one if rows is None else rows[one] for one in place]
    columns["detection_row"] = np.array(detection, dtype=np.float64)
    if full:
        covariance = stacked(parts, "covariance")
        columns |= {name: covariance[:, i, j] for name, (i, j) in COVARIANCE.items()}
    return columns


def join(parts: Sequence[Columns]) -> Columns:
    """Return tables with the same columns as one, one below the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}

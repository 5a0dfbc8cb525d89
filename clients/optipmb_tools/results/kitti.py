"""Result files of the KITTI tracking benchmark: one `SSSS.txt` per sequence, one line per box.

A line has 18 fields: frame, id, type, truncated, occluded, alpha, x1, y1, x2, y2, h, w, l, x, y, z, ry, score. Boxes
are in the rectified camera frame of their own frame (x y z = centre of the bottom), image boxes in pixels, `truncated`
and `occluded` are -1 (unknown). Every track is written, nothing is thresholded: one that the image shows less
than half of has the image box 0 0 0 0 and its 3D box as it is: the KITTI evaluation ignores boxes without height, as it
does boxes that are for more than half in unannotated regions. Numbers have six decimals, so the same tracks always give
the same bytes.

A submission leaves rows out: the server of the benchmark sweeps no scores, so every false track counts. It has the
tracks that were confirmed in some frame and whose rank (`optipmb_tools.results.ranks`) is at least the threshold of
their class, and of these the rows with an image box.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from optipmb_schemas import Tracks

from optipmb_tools.camera import Camera, alpha_of, kitti_from_sensor, sensor_from_kitti
from optipmb_tools.datasets.interface import class_like
from optipmb_tools.files import DatasetError, numbers, read_rows, write_whole
from optipmb_tools.geometry import PoseLike, rotation_of, to_sensor
from optipmb_tools.results import ResultTable, ranks

LEAST_SHOWN = 0.5  # part of a projected box that must lie in the image for its line to have an image box

SUBMISSION_SCORES = {"Car": 0.55, "Cyclist": 0.6, "Pedestrian": 0.55}
"""Least mean score of a track in a submission, for the highest HOTA of image boxes (`docs/tuning.md`)."""

_FIELDS = 18
_TYPE = 2


def write_kitti_results(
    path: Path,
    camera: Camera,
    poses: Sequence[PoseLike],
    tracks: Mapping[int, Tracks],
    least: Mapping[str, float] | None = None,
) -> Path:
    """Write the tracks (world frame) of a sequence, by frame index; without any the file is empty.

    Args:
        path: The file; returned.
        camera: Camera of the image boxes.
        poses: World from sensor, one per frame.
        tracks: The tracks of each frame.
        least: For a submission, the least mean score of a track by class; other classes are refused. None: all tracks.
    """
    known = tuple(least or ())
    lines: list[tuple[int, str, float, bool, str]] = []  # id, class, score, whether the image shows it, text
    confirmed: set[int] = set()
    for index in sorted(tracks):
        one, pose = tracks[index], poses[index]
        rotation, translation = rotation_of(np.asarray(pose.quaternion)), np.asarray(pose.translation)
        center, yaw = to_sensor(rotation, translation, one.center, one.yaw)
        image, seen = camera.boxes(center, one.size, yaw, least_shown=LEAST_SHOWN)
        bottom, hwl, rotation_y = kitti_from_sensor(center, one.size, yaw)
        values = np.column_stack([alpha_of(bottom, rotation_y), image, hwl, bottom, rotation_y, one.score])
        values = np.round(values, 6) + 0.0  # turns a rounded -0 into 0, so that equal numbers are written alike
        names = [class_like(name, known) or "" if known else name for name in one.labels]
        if other := [one.labels[label] for label in one.label.tolist() if not names[label]]:
            raise DatasetError("--submission", f"--classes of {', '.join(known)}", f"tracks of {other[0]!r}")
        for identity, label, row, shown in zip(one.id.tolist(), one.label.tolist(), values, seen, strict=True):
            text = " ".join(f"{value:.6f}" for value in row)
            line = f"{index} {identity} {names[label]} -1 -1 {text}\n"
            lines.append((identity, names[label], float(row[-1]), bool(shown), line))
        if known and one.confirmed is not None:
            confirmed.update(one.id[np.asarray(one.confirmed, dtype=np.bool_)].tolist())
    ids, scores = np.array([line[0] for line in lines], np.int64), np.array([line[2] for line in lines])
    kept = (
        line
        for rank, (identity, name, _, shown, line) in zip(ranks(ids, scores).tolist(), lines, strict=True)
        if least is None or (shown and identity in confirmed and rank >= least[name])
    )
    write_whole(path, kept)
    return path


def read_kitti_results(path: Path, labels: Sequence[str] = ()) -> ResultTable:
    """Return the boxes of a result file in the sensor frame of each box's own frame, ordered by frame, then as written.

    Args:
        path: the file; 17 fields, without a score, are accepted too and mean score 1.
        labels: names that come first in the table's labels; further names follow as they appear in the file.

    Raises:
        DatasetError: the file is missing, a line has another number of fields or a field that is no number, a frame is
            negative, or one id stands twice in a frame.
    """
    what = "frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z ry score"
    rows = read_rows(path, "a KITTI result file")
    names = list(labels)
    label = np.empty(len(rows), dtype=np.int64)
    numeric: list[tuple[int, list[str]]] = []
    for i, (line, fields) in enumerate(rows):
        if len(fields) not in (_FIELDS - 1, _FIELDS):
            raise DatasetError(path, f"{_FIELDS} fields ({what})", f"{len(fields)} fields", line=line)
        if fields[_TYPE] not in names:
            names.append(fields[_TYPE])
        label[i] = names.index(fields[_TYPE])
        score = fields[_FIELDS - 1 :] or ["1"]
        numeric.append((line, [*fields[:_TYPE], *fields[_TYPE + 1 : _FIELDS - 1], *score]))
    values = numbers(path, numeric, _FIELDS - 1, what)
    frame, identity = values[:, 0].astype(np.int64), values[:, 1].astype(np.int64)
    _check(path, [line for line, _ in rows], values, frame, identity)
    center, size, yaw = sensor_from_kitti(values[:, 12:15], values[:, 9:12], values[:, 15])
    order = np.argsort(frame, kind="stable")
    return ResultTable(
        labels=tuple(names),
        frame=frame,
        id=identity,
        label=label,
        center=center,
        size=size,
        yaw=yaw,
        score=values[:, 16],
        box2d=values[:, 5:9],
    ).take(order)


def _check(path: Path, lines: list[int], values: np.ndarray, frame: np.ndarray, identity: np.ndarray) -> None:
    bad = np.flatnonzero((values[:, 0] != frame) | (frame < 0))
    if len(bad):
        raise DatasetError(path, "a frame number from 0", f"{values[bad[0], 0]:g}", line=lines[bad[0]])
    seen: set[tuple[int, int]] = set()
    for line, key in zip(lines, zip(frame.tolist(), identity.tolist(), strict=True), strict=True):
        if key in seen:
            raise DatasetError(path, "an id once per frame", f"id {key[1]} again in frame {key[0]}", line=line)
        seen.add(key)

"""The tracks of a run, read for evaluation: a table of anybody's, or the result files of a dataset in a folder."""

from pathlib import Path

import numpy as np

from optipmb_client.datasets import DataSequence, DatasetError
from optipmb_client.datasets.nuscenes import NuScenesSequence
from optipmb_client.datasets.table.dataset import match_stamps
from optipmb_client.datasets.table.rows import Boxes, read_boxes
from optipmb_client.datasets.table.values import Reading
from optipmb_client.results import ResultTable, read_kitti_results
from optipmb_client.results.full import FullTable, full_path, read_full
from optipmb_client.results.nuscenes import NUSCENES_FILE, read_nuscenes_results, result_table
from optipmb_client.table_files import SUFFIXES, is_table

__all__ = ["read_full_tracks", "read_tracks"]


def read_tracks(results: Path, sequence: DataSequence) -> ResultTable:
    """Return the tracks of a sequence in the sensor frame of each frame, where KITTI's result files have them.

    Args:
        results: a table of tracks of one or more sequences, or a folder with `NAME.txt` (KITTI) or a table `NAME.*`;
            for nuScenes also a result file of its benchmark, or its folder.
        sequence: what was tracked.

    Raises:
        DatasetError: there is no such file, or it is wrong, or has frames that the sequence lacks.
    """
    if isinstance(sequence, NuScenesSequence) and (results.suffix == ".json" or (results / NUSCENES_FILE).is_file()):
        scene = result_table(read_nuscenes_results(results), sequence.name, sequence.samples)
        return scene.to_sensor(sequence.poses)
    path = _file(results, sequence.name)
    if is_table(path):
        return _from_table(path, sequence).to_sensor(sequence.poses)
    table = read_kitti_results(path)
    if len(table) and table.frame[-1] >= len(sequence):
        raise DatasetError(path, f"frames from 0 to {len(sequence) - 1}", f"frame {table.frame[-1]}")
    return table


def read_full_tracks(results: Path, sequence: DataSequence) -> FullTable | None:
    """Return all that is known of the tracks; None where it was not written."""
    beside = full_path(_file(results, sequence.name))
    return read_full(beside) if beside.is_file() else None


def _file(results: Path, name: str) -> Path:
    if is_table(results) and not results.is_dir():
        return results
    tables = (results / f"{name}{suffix}" for suffix in SUFFIXES)
    return next((path for path in tables if path.is_file()), results / f"{name}.txt")


def _from_table(path: Path, sequence: DataSequence) -> ResultTable:
    """Return the tracks of a table in the world frame."""
    boxes = read_boxes(Reading(path, {"invalid": "refuse"}), scored=False)
    if boxes.id is None:
        raise DatasetError(path, "a column of track ids (id, track_id …)", "none")
    mine = np.flatnonzero(boxes.frame_key[boxes.row] == _key(path, boxes, sequence))
    stamps = np.array([frame.stamp_ns for frame in sequence.frames()], dtype=np.int64)
    frame = match_stamps(stamps, boxes.frame_stamp[boxes.row[mine]])
    if (frame < 0).any():
        row = int(boxes.row[mine[np.flatnonzero(frame < 0)[0]]])
        raise DatasetError(path, f"stamps of the frames of {sequence.name}", "another stamp", line=row + 2)
    order = np.argsort(frame, kind="stable")
    mine, frame = mine[order], frame[order]
    labels = tuple(dict.fromkeys(boxes.name[mine].tolist()))
    return ResultTable(
        labels=labels,
        frame=frame,
        id=boxes.id[mine],
        label=np.array([labels.index(name) for name in boxes.name[mine].tolist()], dtype=np.int64),
        center=boxes.center[mine],
        size=boxes.size[mine],
        yaw=boxes.yaw[mine],
        score=boxes.score[mine],
        box2d=np.full((len(mine), 4), np.nan),
    )


def _key(path: Path, boxes: Boxes, sequence: DataSequence) -> str:
    keys = dict.fromkeys(boxes.frame_key.tolist())
    columns: dict[str, str] = getattr(sequence, "key_columns", {})
    for one in (".".join(columns.values()), sequence.name):
        if one in keys:
            return str(one)
    if len(keys) == 1:
        return str(next(iter(keys)))
    raise DatasetError(path, f"rows of {sequence.name}", f"those of {', '.join(keys)}")

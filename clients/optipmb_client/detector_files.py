"""Results of detectors as records, one for each box: JSON, and folders with a file for each frame.

Such a folder is of MMDetection3D (`preds/*.json`), or has `.txt` files in the format of KITTI's object benchmark.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from optipmb_client.camera import sensor_from_kitti
from optipmb_client.files import DatasetError, numbers, read_rows, read_text

_Record: TypeAlias = dict[str, Any]
BOX_LISTS: Final = ("bboxes_3d", "boxes_3d", "boxes_lidar", "pred_boxes", "gt_boxes", "boxes", "bbox_3d", "box3d")
"""Names of lists of x, y, z, length, width, height, yaw and, in some, a velocity."""
LISTS: Final = (*BOX_LISTS, "detections", "objects", "predictions", "annotations")
"""Names of lists of all boxes of a frame."""
_KITTI: Final = "h w l x y z rotation_y score"
_FIRST: Final = 8  # field of a line of KITTI's object benchmark where the 3D box begins
_STAMPS: Final = 1_000_000_000
"""From this number on, the number in the name of a file is a stamp, and not that of a frame."""


def frame_files(folder: Path) -> list[Path]:
    """Return the files of a folder with the boxes of a frame each; none where it is no such folder."""
    for suffix in (".json", ".txt"):
        files = sorted(folder.glob(f"*{suffix}"))
        text = next((file.read_bytes().decode(errors="replace") for file in files if file.stat().st_size), "")
        if is_kitti_object(text) if suffix == ".txt" else text[:1] == "{" and '"bboxes_3d"' in text:
            return files
    return []


def is_kitti_object(text: str) -> bool:
    """Tell whether a text begins with a box in the format of KITTI's object benchmark."""
    return re.match(r"[A-Za-z]\w*( +-?\d[-+.e\d]*){14,15} *(\n|$)", text) is not None


def read_frames(folder: Path) -> list[_Record]:
    """Return a record for each box of a folder with a file for each frame, whose name has its number or stamp.

    Raises:
        DatasetError: a file is wrong; says where.
    """
    files = frame_files(folder)
    found = [re.findall(r"\d+", file.stem) for file in files]
    number = [int(digits[-1]) for digits in found if digits]
    if len(set(number)) < len(files):
        number = list(range(len(files)))
    name = "timestamp" if min(number) >= _STAMPS else "frame"
    read = _kitti_frame if files[0].suffix == ".txt" else read_json
    return split_boxes([{name: n} | one for n, file in sorted(zip(number, files, strict=True)) for one in read(file)])


def _kitti_frame(path: Path) -> list[_Record]:
    rows = [(line, fields) for line, fields in read_rows(path, "boxes") if fields[0] != "DontCare"]
    boxes = [(line, fields[_FIRST:] + ["1"] * (len(fields) == _FIRST + 7)) for line, fields in rows]  # labels: no score
    values = numbers(path, boxes, 8, f"{_KITTI} from field {_FIRST + 1} on")
    center, size, yaw = sensor_from_kitti(values[:, 3:6], values[:, :3], values[:, 6])
    lists = np.column_stack((center, size, yaw)).tolist()
    return [{"labels_3d": [fields[0] for _, fields in rows], "scores_3d": values[:, 7].tolist(), "bboxes_3d": lists}]


def read_json(path: Path) -> list[_Record]:
    """Return the records of a JSON file: an array of them, or an object with the boxes of a frame.

    Raises:
        DatasetError: it is something else.
    """
    try:
        content = json.loads(read_text(path, "JSON"))
    except json.JSONDecodeError as error:
        raise DatasetError(path, "JSON", error.msg, line=error.lineno) from error
    if isinstance(content, dict) and isinstance(content.get("results"), dict):
        how = f"--dataset nuscenes --root ROOT --detections {path}"
        raise DatasetError(path, "a table", f"results of nuScenes, which are read by {how}")
    if isinstance(content, dict) and any(name in content for name in LISTS):
        content = [content]
    if not isinstance(content, list) or not all(isinstance(one, dict) for one in content):
        expected = f"an array of objects, or an object with a list {', '.join(LISTS)}"
        raise DatasetError(path, expected, repr(str(content)[:60]))
    for one in content:
        if "box_type_3d" in one:
            _centre(path, one)
    return content


def _centre(path: Path, frame: _Record) -> None:
    """Move the boxes of a frame of MMDetection3D up to their centres; it gives those of their bottoms."""
    kind = frame.pop("box_type_3d")
    if kind != "LiDAR" or any(len(box) not in {7, 9} for box in frame["bboxes_3d"]):
        raise DatasetError(path, "boxes of 7 or 9 numbers, of box_type_3d LiDAR", f"others, of {kind}")
    for box in frame["bboxes_3d"]:
        box[2] += 0.5 * box[5]
    frame["labels_3d"] = [str(label) for label in frame["labels_3d"]]


def split_boxes(records: Sequence[_Record]) -> list[_Record]:
    """Return a record for each box: of a list of boxes in a record, and of the other lists that are as long."""
    names = dict.fromkeys(name for one in records for name in one)

    def lists(name: str) -> list[Any]:
        return [[] if one.get(name) is None else one[name] for one in records]

    def has_boxes(value: object) -> bool:
        return isinstance(value, list) and all(isinstance(box, (list, dict)) for box in value)

    key = next((name for name in LISTS if name in names and all(map(has_boxes, lists(name)))), None)
    if key is None:
        return list(records)
    counts = [len(boxes) for boxes in lists(key)]
    split = [name for name in names if [len(one) if isinstance(one, list) else -1 for one in lists(name)] == counts]
    rows: list[_Record] = []
    for one, count in zip(records, counts, strict=True):
        frame = {name: value for name, value in one.items() if name not in split}
        boxes = [frame | {name: one[name][place] for name in split} for place in range(count)]
        rows += [box | box.pop(key) if isinstance(box[key], dict) else box for box in boxes] or [frame]
    return rows

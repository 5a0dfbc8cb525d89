"""Records of boxes, one for each: of JSON, and of folders with a file for each frame.

Such a folder is of MMDetection3D (`preds/*.json`), or has `.txt` files in the format of KITTI's object benchmark.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from optipmb_tools.files import DatasetError, is_number, numbers, read_rows, read_text

_Record: TypeAlias = dict[str, Any]
BOX_LISTS: Final = ("bboxes_3d", "boxes_3d", "boxes_lidar", "pred_boxes", "gt_boxes", "boxes", "bbox_3d", "box3d")
"""Names of lists of x, y, z, length, width, height, yaw and, in some, a velocity."""
LISTS: Final = (
    *BOX_LISTS,
    "detections",
    "objects",
    "cuboids",
    "predictions",
    "annotations",
)  # names of lists of all boxes of a frame
_PLACE: Final = re.compile(r"(?i)[xyz]|c[xyz]|[xyz]c|[xyz]_?(center|centre|world|m)|lat|lon|lng|latitude|longitude|alt")
_PLACES: Final = re.compile(
    r"(?i)cent(er|re|roid)|pos(ition|e)?$|loc(ation)?|translation|xyz|b?box(?!.*2d)|psr|coordinates"
)
"""Names of coordinates, and of structures and lists of them."""
_LEAST_NUMBERS: Final = 7  # of a box in a list without a name
_LOOKED_AT: Final = 200  # records that tell which lists have boxes
_COCO: Final = "images", "annotations", "categories"
_FIRST: Final = 8  # field of a line of KITTI's object benchmark where the 3D box begins
_STAMPS: Final = 1_000_000_000  # from here on, the number in the name of a file is a stamp, not a frame


def frame_files(folder: Path) -> list[Path]:
    """Return the files of a folder with the boxes of a frame each; none where it is no such folder."""
    for suffix in (".json", ".txt"):
        files = sorted(folder.glob(f"*{suffix}"))
        text = next(filter(None, map(_begin, files)), "")
        if is_kitti_object(text) if suffix == ".txt" else text[:1] == "{" and '"bboxes_3d"' in text:
            return files
    return []


def _begin(file: Path) -> str:
    """Return the text of a file from its first character on; none where it is no text."""
    try:
        return read_text(file, "text").lstrip()
    except DatasetError:
        return ""


def is_kitti_object(text: str) -> bool:
    """Tell whether a text begins with a box in the format of KITTI's object benchmark."""
    return re.match(r"[A-Za-z]\w*([ \t]+-?\d[-+.e\d]*){14,15}[ \t]*(\n|$)", text) is not None


def read_frames(folder: Path, options: Mapping[str, str]) -> list[_Record]:
    """Return a record for each box of a folder with a file for each frame, whose name has its number or stamp.

    Raises:
        DatasetError: A file is wrong; says where.
    """
    files = frame_files(folder)
    name, number = frame_numbers(files)
    read = _kitti_frame if files[0].suffix == ".txt" else read_json
    frames = [{name: n} | one for n, file in sorted(zip(number, files, strict=True)) for one in read(file)]
    return split_boxes(folder, frames, options)


def frame_numbers(files: Sequence[Path]) -> tuple[str, list[float]]:
    """Return `frame`, or `timestamp`, and that number of each file: the one that differs among their names.

    Of several in one order it is the one with the smallest values.

    Raises:
        DatasetError: Several numbers differ in orders of their own, none does, or other parts of the names do.
    """
    parts = [re.split(r"(\d{9,10}\.\d+|\d+)", file.stem) for file in files]
    columns = [
        [float(one) if "." in one else int(one) for one in part[1::2]] for part in parts if part[::2] == parts[0][::2]
    ]
    alike = list(zip(*columns, strict=True)) if len(columns) == len(files) else []
    varying = [one for one in alike if len(set(one)) > 1 or len(files) == 1]
    orders = {tuple(sorted(range(len(files)), key=one.__getitem__)) for one in varying if len(set(one)) == len(files)}
    if len(orders) != 1 or any(len(set(one)) < len(files) for one in varying):
        expected = "names of frames that differ in one number, that of the frame"
        raise DatasetError(files[0].parent, expected, f"{files[0].name} … {files[-1].name}")
    number = min(varying, key=max)
    return "timestamp" if min(number) >= _STAMPS else "frame", list(number)


def _kitti_frame(path: Path) -> list[_Record]:
    rows = [(line, fields) for line, fields in read_rows(path, "boxes") if fields[0] != "DontCare"]
    boxes = [(line, fields[_FIRST:] + ["1"] * (len(fields) == _FIRST + 7)) for line, fields in rows]  # labels: no score
    values = numbers(path, boxes, 8, f"h w l x y z rotation_y score from field {_FIRST + 1} on")
    from optipmb_tools.camera import sensor_from_kitti  # noqa: PLC0415  of one format

    center, size, yaw = sensor_from_kitti(values[:, 3:6], values[:, :3], values[:, 6])
    lists = np.column_stack((center, size, yaw)).tolist()
    return [{"labels_3d": [fields[0] for _, fields in rows], "scores_3d": values[:, 7].tolist(), "bboxes_3d": lists}]


def read_json(path: Path) -> list[_Record]:
    """Return the records of a JSON file: an array, an object with nothing but an array, or the boxes of a frame.

    Raises:
        DatasetError: It is something else.
    """
    try:
        content = json.loads(read_text(path, "JSON"))
    except json.JSONDecodeError as error:
        raise DatasetError(path, "JSON", error.msg, line=error.lineno) from error
    if isinstance(content, dict) and "openlabel" in content:
        from optipmb_tools.openlabel import openlabel_records  # noqa: PLC0415  of one format

        return openlabel_records(path, content["openlabel"])
    if isinstance(content, dict) and isinstance(content.get("results"), dict):
        how = f"--dataset nuscenes --root ROOT --detections {path}"
        raise DatasetError(path, "a table", f"results of nuScenes, which are read by {how}")
    if isinstance(content, dict) and all(map(_are_records, map(content.get, _COCO))):
        content = _of_coco(content)
    if isinstance(content, dict):
        known = any(isinstance(content.get(name), list) for name in LISTS)
        content = [content] if known else _of_columns(content) or _frames(content)
    if not isinstance(content, list) or not all(isinstance(one, dict) for one in content):
        expected = f"an array of objects, or an object with a list {', '.join(LISTS)}"
        raise DatasetError(path, expected, repr(str(content)[:60]))
    for one in content:
        if "box_type_3d" in one:
            _centre(path, one)
    return content


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) for one in value)


def _of_coco(content: _Record) -> list[_Record]:
    """Return the annotations of COCO with the names of their classes, and the fields of their images."""
    names = {str(one["id"]): one.get("name") for one in content["categories"] if one.get("id") is not None}
    images = {str(one.pop("id")): one for one in content["images"] if one.get("id") is not None}
    return [
        images.get(str(one.get("image_id")), {}) | one | {"class": names.get(str(one.get("category_id")))}
        for one in content["annotations"]
    ]


def _of_columns(content: _Record) -> list[_Record]:
    """Return the records of an object of columns: lists, or values by the numbers of rows, as data frames write."""
    if isinstance(content.get("columns"), list) and isinstance(content.get("data"), list):
        return [dict(zip(content["columns"], row, strict=False)) for row in content["data"] if isinstance(row, list)]
    values = list(content.values())
    if len(values) < 2 or any(map(is_number, content)):  # noqa: PLR2004  one column tells nothing
        return []
    if all(isinstance(one, dict) and one and one.keys() == values[0].keys() for one in values):
        counted = all(key.isdigit() for key in values[0])
        values = [list(one.values()) for one in values] if counted else []
    plain = all(isinstance(one, list) and not any(isinstance(part, dict) for part in one) for one in values)
    if not values or not plain or len(set(map(len, values))) > 1:
        return []
    return [dict(zip(content, row, strict=True)) for row in zip(*values, strict=True)]


def _frames(content: _Record) -> Any:
    """Return the one list of records of an object, or a record for each frame where its names name frames."""
    named = all(re.search(r"\d", name) and isinstance(value, (list, dict)) for name, value in content.items())
    if not named:
        inner = content.get("frames", next(iter(content.values())) if len(content) == 1 else None)
        if isinstance(inner, dict):
            return _frames(inner)
        lists = {name: one for name, one in _lists(content) if one and isinstance(one[0], dict)}
        fitting = [one for one in lists.values() if _groups(one) or any(map(_has_place, one))]
        if len(fitting) == 1:
            return fitting[0]
        return [content] if fitting else next(iter(lists.values())) if len(lists) == 1 else content
    stamped = all(is_number(name) and float(name) >= _STAMPS for name in content)
    frames = []
    for name, value in content.items():
        number = int(name) if name.isdigit() else name
        if isinstance(value, list):
            record = {"boxes" if any(isinstance(one, list) for one in value) else "objects": value}
        elif value and all(isinstance(one, dict) for one in value.values()):  # objects by their ids
            record = {"objects": [{"id": key} | one for key, one in value.items()]}
        else:
            record = value
        frames.append({"timestamp" if stamped else "frame": number} | record)
    return frames


def _centre(path: Path, frame: _Record) -> None:
    """Move the boxes of a frame of MMDetection3D, given by their bottoms, up to their centres."""
    kind = frame.pop("box_type_3d")
    if kind != "LiDAR" or any(len(box) not in {7, 9} for box in frame["bboxes_3d"]):
        raise DatasetError(path, "boxes of 7 or 9 numbers, of box_type_3d LiDAR", f"others, of {kind}")
    for box in frame["bboxes_3d"]:
        box[2] += 0.5 * box[5]
    frame["labels_3d"] = [str(label) for label in frame["labels_3d"]]


def split_boxes(path: Path, records: Sequence[_Record], options: Mapping[str, str]) -> list[_Record]:
    """Return a record for each box: of a list of boxes in a record, and of the other lists that are as long.

    The list has one of the names `LISTS`, or it is the only one whose elements may be boxes, at any depth.

    Raises:
        DatasetError: Several lists may be meant, and `--option boxes=NAME` does not say which.
    """
    names = dict.fromkeys(name for one in records for name in one)
    asked = [name for name in options.get("boxes", "").split(",") if name]

    def has_boxes(value: object) -> bool:
        return isinstance(value, list) and all(isinstance(box, (list, dict)) for box in value)

    named = (name for name in LISTS if name in names)
    key = next((str(name) for name in named if all(has_boxes(one.get(name) or []) for one in records)), "")
    if asked or not key:
        found = asked or _groups(records)
        if len(found) > 1 and not asked:
            expected = f"one list of boxes (--option boxes={found[0]}, or boxes={','.join(found)} for all)"
            raise DatasetError(path, expected, f"the lists {', '.join(found)}")
        if not found:
            return list(records)
        if len(found) > 1:
            return [box | {"kind": name} for name in found for box in _split(_lifted(records, name), _last(name))]
        records, key = _lifted(records, found[0]), _last(found[0])
    return _split(records, key)


def _split(records: Sequence[_Record], key: str) -> list[_Record]:
    names = dict.fromkeys(name for one in records for name in one)

    def lists(name: str) -> list[Any]:
        return [[] if one.get(name) is None else one[name] for one in records]

    counts = [len(boxes) for boxes in lists(key)]
    split = [name for name in names if [len(one) if isinstance(one, list) else -1 for one in lists(name)] == counts]
    rows: list[_Record] = []
    for one, count in zip(records, counts, strict=True):
        frame = {name: value for name, value in one.items() if name not in split}
        boxes = [frame | {name: one[name][place] for name in split if one.get(name)} for place in range(count)]
        rows += [box | box.pop(key) if isinstance(box[key], dict) else box for box in boxes] or [frame]
    return rows


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _lifted(records: Sequence[_Record], name: str) -> list[_Record]:
    """Return records with the fields of the structures around a list beside it: `annos.names` becomes `names`."""
    *outer, key = name.split(".")
    for place in outer:
        records = [
            {other: value for other, value in one.items() if other != place} | inner
            if isinstance(inner := one.get(place), dict)
            else one
            for one in records
        ]
    if key not in LISTS and any(isinstance(box, list) for one in records for box in one.get(key) or []):
        return [one | {key: [{"boxes": box} for box in one.get(key) or []]} for one in records]
    return list(records)


def _groups(records: Sequence[_Record]) -> list[str]:
    """Return the names of the lists whose elements may be boxes, with the names of the structures around them."""
    found: dict[str, bool] = {}
    for record in records[:_LOOKED_AT]:
        alone = _has_place(record)
        for name, value in _lists(record):
            if value and all(isinstance(one, (list, dict)) for one in value):
                fits = all(_may_be_box(one, _last(name), alone=alone) for one in value)
                found[name] = found.get(name, True) and fits
    return [name for name, fits in found.items() if fits]


def _lists(record: _Record, before: str = "") -> Iterator[tuple[str, list[Any]]]:
    for name, value in record.items():
        if isinstance(value, list):
            yield f"{before}{name}", value
        elif isinstance(value, dict):
            yield from _lists(value, f"{before}{name}.")


def _has_place(record: _Record) -> bool:
    """Tell whether a record has the coordinates of one thing itself."""
    for name, value in record.items():
        numbers = isinstance(value, dict) or (
            isinstance(value, list) and all(isinstance(one, (int, float)) for one in value)
        )
        if _PLACE.fullmatch(name) and not isinstance(value, (list, dict)):
            return True
        if numbers and value and _PLACES.search(name):
            return True
    return False


def _may_be_box(one: list[Any] | _Record, name: str, *, alone: bool) -> bool:
    """Tell whether an element of a list may be a box; of a thing with a place of its own, a bare point is none."""
    if isinstance(one, list):
        numeric = all(isinstance(part, (int, float)) for part in one)
        return numeric and (name in BOX_LISTS or (len(one) >= _LEAST_NUMBERS and not alone))
    inner = next((part for part in one.values() if isinstance(part, dict) and _has_place(part)), {})
    more = one.keys() - {place for place in one if _PLACE.fullmatch(place)}
    return (_has_place(one) or bool(inner)) and (bool(more) or not alone)

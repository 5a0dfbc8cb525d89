"""The submission layout of the nuScenes benchmarks, for detections and for tracks, and the result files in it.

A file is a map with `meta` and `results`; `results` has a list of boxes for every sample token. Boxes are in the global
frame; a box has `translation` (x y z of its centre, metres), `size` (width, length, height), `rotation` (quaternion
w x y z), `velocity` (x y over ground; null, NaN, or null within a list where unknown), a class, a score and, for
tracks, a `tracking_id`. Columns have the size as length, width, height, and the heading as the direction of the box's x
axis seen from above.

Results are `tracking_results.json`, all samples of all scenes of one run, joined from a file `scenes/NAME.json` for
each scene, so that a run that is interrupted leaves the scenes that it finished. `tracking_id` is the name of the scene
with the id of the track, so that no two scenes share one. Numbers have six decimals, samples are in order of time and
boxes in the order of the tracks, so the same tracks always give the same bytes. A sample holds at most 500 boxes, as
the benchmark demands: of more, those with the highest scores are written.
"""

import functools
import itertools
import json
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from optipmb_schemas import Tracks

from optipmb_tools.datasets.interface import class_like
from optipmb_tools.files import LARGEST, DatasetError, read_text, write_whole
from optipmb_tools.geometry import Floats, Ints
from optipmb_tools.results import ResultTable

NUSCENES_CLASSES = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")
"""The classes of the tracking benchmark; others that a file holds are left out."""
NUSCENES_META = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")  # inputs that a submission declares

Kind: TypeAlias = Literal["detection", "tracking"]
_Row: TypeAlias = "array[float]"

_WIDTH = 14
_UNTRACKED = frozenset(("barrier", "construction_vehicle", "traffic_cone", "vehicle.construction"))
"""Classes of the detection benchmark that the tracking benchmark lacks."""
_LENGTHS = {"translation": 3, "size": 3, "rotation": 4}
_PLANE = 2


@dataclass(frozen=True)
class Submission:
    """A file in the submission layout."""

    path: Path
    meta: Mapping[str, Any]
    rows: Mapping[str, list[tuple[str, _Row]]]  # by sample token: id and numbers of each box
    classes: Mapping[str, int]  # number of boxes of each class name of the file, also of classes that are left out

    @property
    def notes(self) -> Iterator[str]:
        """Classes of the file that are read as another one, or are left out, with the number of their boxes."""
        for name, count in self.classes.items():
            if (known := tracked_class(name)) != name:
                how = f"read as {known}" if known else "left out, for the tracking benchmark lacks it"
                yield f"{self.path}: {count} boxes of class {name}: {how}"

    def boxes(self, *tokens: str) -> dict[str, Any]:
        """Return the boxes of samples as columns, named as in `DetectionFrame`; rows of velocity are NaN where unknown.

        Raises:
            DatasetError: The file does not have the sample, or a box has a number that cannot be one.
        """
        if lacking := [token for token in tokens if token not in self.rows]:
            raise DatasetError(self.path, "every sample, if need be with an empty list", f"no sample {lacking[0]}")
        values = np.array([row for token in tokens for _, row in self.rows[token]], dtype=np.float64).reshape(
            -1, _WIDTH
        )
        velocity = values[:, 12:14]
        velocity[~(np.abs(velocity) <= LARGEST).all(axis=1)] = np.nan
        size, rotation = values[:, [5, 4, 6]], values[:, 7:11]
        good = (
            (np.abs(values[:, :12]) <= LARGEST).all(axis=1)
            & (size > 0).all(axis=1)
            & (np.abs(rotation).max(axis=1) > 0)
        )
        if not good.all():
            places = [f"results.{token}[{number}]" for token in tokens for number in range(len(self.rows[token]))]
            expected = f"finite numbers, a size above 0 and a rotation in {places[int(np.argmin(good))]}"
            raise DatasetError(self.path, expected, "others")
        return {
            "label": values[:, 0].astype(np.int64),  # index into `NUSCENES_CLASSES`
            "center": values[:, 1:4],
            "size": size,
            "yaw": quaternion_yaw(rotation),
            "velocity": velocity,
            "score": values[:, 11],
        }


def quaternion_yaw(quaternion: Floats) -> Floats:
    """Return the headings (N,) in [-pi, pi] of rotations (N, 4) w x y z of any length, seen from above."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z), dtype=np.float64)


def read_submission(path: Path, kind: Kind) -> Submission:
    """Return a file of detections or of tracks.

    Raises:
        DatasetError: It cannot be read or is not in the layout.
    """
    what = f"a nuScenes {kind} file"

    classes: Counter[str] = Counter()

    def convert(record: dict[str, Any]) -> Any:
        # Boxes become rows of numbers as soon as they are read: a million maps would take gigabytes.
        return _row(path, record, kind, classes) if "translation" in record else record

    try:
        content = json.loads(read_text(path, what), object_hook=convert)
    except json.JSONDecodeError as error:
        raise DatasetError(path, f"{what} (JSON)", error.msg, line=error.lineno) from error
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise DatasetError(path, f"{what} with meta and results", "no map of results")
    rows: dict[str, list[tuple[str, _Row]]] = {}
    for token, boxes in results.items():
        if not isinstance(boxes, list) or not all(isinstance(box, tuple) for box in boxes):
            raise DatasetError(path, f"a list of boxes in results.{token}", "something else")
        rows[token] = [box for box in boxes if box]
    meta = content.get("meta")
    return Submission(path, meta if isinstance(meta, dict) else {}, rows, classes)


@functools.lru_cache(maxsize=256)
def tracked_class(name: str) -> str | None:
    """Return the class of the tracking benchmark that a class name means; None for another class."""
    return None if name.lower() in _UNTRACKED else class_like(name, NUSCENES_CLASSES)


def _row(path: Path, record: dict[str, Any], kind: Kind, classes: Counter[str]) -> tuple[str, _Row] | tuple[()]:
    """Return id and numbers of a box; nothing when its class is not tracked. Counts the class in `classes`."""
    token = record.get("sample_token", "?")
    try:
        name = str(record[f"{kind}_name"])
        classes[name] += 1
        label = tracked_class(name)
        if label is None:
            return ()
        numbers = [float(NUSCENES_CLASSES.index(label))]
        for field, length in _LENGTHS.items():
            values = record[field]
            if len(values) != length:
                raise DatasetError(path, f"{length} numbers in {field} (sample {token})", f"{len(values)}")
            numbers += map(float, values)
        numbers.append(float(record[f"{kind}_score"]))
        numbers += _velocity(record.get("velocity"))
        return str(record["tracking_id"]) if kind == "tracking" else "", array("d", numbers)
    except KeyError as error:
        raise DatasetError(path, f"{error.args[0]} in every box (sample {token})", "a box without") from error
    except (TypeError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(path, f"numbers in every box (sample {token})", str(error)) from error


def _velocity(value: Any) -> tuple[float, float]:
    if value is None or len(value) < _PLANE or value[0] is None or value[1] is None:
        return math.nan, math.nan
    return float(value[0]), float(value[1])


NUSCENES_FILE = "tracking_results.json"
NUSCENES_MAX_BOXES = 500  # boxes in one sample that the benchmark accepts

_DIGITS = 18
_END = "\n}}\n"


def scene_file(out: Path, scene: str) -> Path:
    return out / "scenes" / f"{scene}.json"


def write_scene(
    out: Path, scene: str, samples: Sequence[str], meta: Mapping[str, Any], tracks: Mapping[int, Tracks]
) -> Path:
    """Write the tracks (world frame) of one scene, by frame index, with an empty list for samples without tracks.

    The samples are tokens in order of time; `meta` comes from the detections.

    Raises:
        DatasetError: A track is of a class that the benchmark does not have.
    """
    boxes = {index: _boxes(scene, samples[index], one) for index, one in tracks.items()}
    lines = (f"{json.dumps(token)}: {boxes.get(index, '[]')}" for index, token in enumerate(samples))
    path = scene_file(out, scene)
    write_whole(path, [_head(meta), ",\n".join(lines), _END])
    return path


def join_scenes(out: Path, scenes: Sequence[str], meta: Mapping[str, Any]) -> None:
    """Write `tracking_results.json` from the files of these scenes, in their order.

    Raises:
        DatasetError: The file of a scene cannot be read.
    """
    head = _head(meta)
    texts = (read_text(scene_file(out, name), "the results of a scene") for name in scenes)
    parts = ((",\n" if i else "") + text[len(head) : -len(_END)] for i, text in enumerate(texts))
    write_whole(out / NUSCENES_FILE, itertools.chain([head], parts, [_END]))


def _head(meta: Mapping[str, Any]) -> str:
    used = {name: bool(meta.get(name, name == "use_lidar")) for name in NUSCENES_META}
    return f'{{"meta": {json.dumps(used)}, "results": {{\n'


def _boxes(scene: str, token: str, tracks: Tracks) -> str:
    unknown = [name for name in np.asarray(tracks.labels)[tracks.label].tolist() if name not in NUSCENES_CLASSES]
    if unknown:
        raise DatasetError("--profile", f"the classes {', '.join(NUSCENES_CLASSES)}", f"tracks of {unknown[0]!r}")
    rows = np.sort(np.argsort(-tracks.score, kind="stable")[:NUSCENES_MAX_BOXES])
    half = 0.5 * tracks.yaw[rows]
    # The official reader refuses unknown velocities, so they are written as standing still.
    velocity = np.nan_to_num(tracks.velocity[rows])
    size = tracks.size[rows][:, [1, 0, 2]]
    values = np.column_stack([tracks.center[rows], size, np.cos(half), np.sin(half), velocity, tracks.score[rows]])
    values = np.round(values, 6) + 0.0  # turns a rounded -0 into 0, so that equal numbers are written alike
    boxes = [
        {
            "sample_token": token,
            "translation": row[:3],
            "size": row[3:6],
            "rotation": [row[6], 0.0, 0.0, row[7]],
            "velocity": row[8:10],
            "tracking_id": f"{scene}-{identity}",
            "tracking_name": tracks.labels[label],
            "tracking_score": row[10],
        }
        for row, identity, label in zip(values.tolist(), tracks.id[rows], tracks.label[rows], strict=True)
    ]
    return json.dumps(boxes, allow_nan=False)


def read_nuscenes_results(path: Path) -> Submission:
    """Return a result file, or the one in a folder.

    Raises:
        DatasetError: It cannot be read, is not in the layout, or holds more boxes in a sample than the benchmark takes.
    """
    file = path / NUSCENES_FILE if path.is_dir() else path
    results = read_submission(file, "tracking")
    for token, rows in results.rows.items():
        if len(rows) > NUSCENES_MAX_BOXES:
            raise DatasetError(file, f"at most {NUSCENES_MAX_BOXES} boxes in results.{token}", f"{len(rows)}")
    return results


def result_table(results: Submission, scene: str, samples: Sequence[str]) -> ResultTable:
    """Return the tracks of one scene in the world frame; frames count along `samples`.

    Ids are the numbers behind the name of the scene, as the writer has them; other ids are numbered in order of
    appearance.

    Raises:
        DatasetError: A sample is missing, or an id stands twice in a sample.
    """
    boxes = results.boxes(*samples)
    names = [[name for name, _ in results.rows[token]] for token in samples]
    for token, ids in zip(samples, names, strict=True):
        if twice := [name for i, name in enumerate(ids) if name in ids[:i]]:
            raise DatasetError(results.path, f"a tracking_id once in results.{token}", f"{twice[0]!r} again")
    frame = np.repeat(np.arange(len(samples)), list(map(len, names)))
    identity, image = _numbers(scene, list(itertools.chain(*names))), np.full((len(frame), 4), np.nan)
    return ResultTable(labels=NUSCENES_CLASSES, frame=frame, id=identity, box2d=image, **boxes)


def _numbers(scene: str, names: Sequence[str]) -> Ints:
    prefix = f"{scene}-"
    tails = [name.removeprefix(prefix) for name in names]
    ours = all(
        name.startswith(prefix) and len(tail) < _DIGITS and tail.isascii() and tail.isdigit() and str(int(tail)) == tail
        for name, tail in zip(names, tails, strict=True)
    )
    if ours:
        return np.array([int(tail) for tail in tails], dtype=np.int64)
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.int64)

"""The tables of nuScenes: one JSON list of records per table, joined by tokens.

Tables are read record by record and only used fields are kept, so the largest ones (a gigabyte each in the full
release) never stand in memory. Conventions as in the dataset: global frame = world, metres, poses map the inner frame
to the outer one. Stamps are microseconds, as recorded.
"""

import json
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Ints, Pose, pose_of, rotation_of

LIDAR = "LIDAR_TOP"

_CHUNK = 1 << 22
_LONGEST = 1 << 20
_BETWEEN = re.compile(r"[\s,]*")
_VISIBILITY = {"v0-40": 1, "v40-60": 2, "v60-80": 3, "v80-100": 4}
_LENGTHS = (3, 3, 4)


def read_table(folder: Path, table: str, *names: str) -> Iterator[tuple[Any, ...]]:
    """Yield the named fields of every record of a table.

    Raises:
        DatasetError: The file cannot be read or is not a list of records with these fields.
    """
    path = folder / f"{table}.json"
    what = f"the table {table}, a JSON list of records with {', '.join(names)}"
    for number, record in enumerate(_records(path, what)):
        if not isinstance(record, dict):
            raise DatasetError(path, what, f"something else as record {number}")
        try:
            yield tuple([record[name] for name in names])
        except KeyError as error:
            raise DatasetError(path, what, f"record {number} without {error.args[0]}") from error


def _records(path: Path, what: str) -> Iterator[Any]:
    decoder = json.JSONDecoder()
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_CHUNK)
            at = len(text) - len(text.lstrip())
            if text[at : at + 1] != "[":
                raise DatasetError(path, what, "no list")
            at += 1
            while True:
                between = _BETWEEN.match(text, at)
                at = between.end() if between else at
                if text.startswith("]", at):
                    return
                try:
                    record, at = decoder.raw_decode(text, at)
                except json.JSONDecodeError as error:
                    more = file.read(_CHUNK)
                    if not more or len(text) - at > _LONGEST:
                        raise DatasetError(path, what, f"{error.msg} behind {text[max(0, at - 40) : at]!r}") from error
                    text, at = text[at:] + more, 0
                    continue
                yield record
    except OSError as error:
        raise DatasetError(path, what, error.strerror or "an unreadable file") from error
    except UnicodeDecodeError as error:
        raise DatasetError(path, what, "bytes that are not text") from error


@dataclass(frozen=True)
class SceneSamples:
    """The keyframes of one scene, in order of time."""

    name: str
    tokens: tuple[str, ...]
    stamp_us: Ints  # (F,)

    def __len__(self) -> int:
        return len(self.tokens)


@dataclass(frozen=True)
class Keyframe:
    """Where car and LiDAR were at a keyframe."""

    ego: Pose  # world from car, at the time of the scan
    lidar: Pose  # world from LiDAR
    filename: str  # of the scan, below the folder of the tables' folder


@dataclass(frozen=True)
class Annotations:
    """Annotated boxes of one scene, of all categories, ordered by frame and within a frame as in the table."""

    frame: Ints  # (R,)
    instance: Ints  # (R,) index of the object in the table of instances
    category: tuple[str, ...]  # R names, such as vehicle.car
    center: Floats  # (R, 3)
    size: Floats  # (R, 3) length, width, height
    rotation: Floats  # (R, 4) quaternion w x y z
    velocity: Floats  # (R, 2) from the annotations of the same object before and after; NaN where none is near in time
    lidar_points: Ints  # (R,)
    radar_points: Ints  # (R,)
    visibility: Ints  # (R,) seen by cameras: 1: up to 40 %, 2: up to 60 %, 3: up to 80 %, 4: more; 0: unknown

    def __len__(self) -> int:
        return len(self.frame)


class NuScenesTables:
    """The tables in one folder, such as `v1.0-trainval`; each is read when it is first needed, and once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def scenes(self) -> dict[str, SceneSamples]:
        """The scenes by name."""
        names = {token: str(name) for token, name in read_table(self.folder, "scene", "token", "name")}
        samples: dict[str, list[tuple[int, str]]] = {token: [] for token in names}
        for token, stamp, scene in read_table(self.folder, "sample", "token", "timestamp", "scene_token"):
            if scene not in samples:
                raise DatasetError(self.folder / "sample.json", "samples of known scenes", f"sample {token} of {scene}")
            samples[scene].append((int(stamp), token))
        scenes = {}
        for scene, name in sorted(names.items(), key=lambda item: item[1]):
            ordered = sorted(samples[scene])
            stamps = np.array([stamp for stamp, _ in ordered], dtype=np.int64)
            scenes[name] = SceneSamples(name, tuple(token for _, token in ordered), stamps)
        return scenes

    @cached_property
    def keyframes(self) -> dict[str, Keyframe]:
        """The keyframe of the LiDAR of every sample, by the token of the sample."""
        channels = dict(read_table(self.folder, "sensor", "token", "channel"))
        pose = ("token", "translation", "rotation")
        mounted = {
            token: _matrix(translation, rotation)
            for token, translation, rotation, sensor in read_table(
                self.folder, "calibrated_sensor", *pose, "sensor_token"
            )
            if channels.get(sensor) == LIDAR
        }
        fields = ("sample_token", "is_key_frame", "calibrated_sensor_token", "ego_pose_token", "filename")
        scans = [
            (sample, calibrated, ego, filename)
            for sample, key, calibrated, ego, filename in read_table(self.folder, "sample_data", *fields)
            if key and calibrated in mounted
        ]
        wanted = {ego for _, _, ego, _ in scans}
        placed = {
            token: _matrix(translation, rotation)
            for token, translation, rotation in read_table(self.folder, "ego_pose", *pose)
            if token in wanted
        }
        lost = wanted - placed.keys()
        if lost:
            raise DatasetError(self.folder / "ego_pose.json", f"the pose {min(lost)} of a scan", "none")
        return {
            sample: Keyframe(pose_of(placed[ego]), pose_of(placed[ego] @ mounted[calibrated]), filename)
            for sample, calibrated, ego, filename in scans
        }

    def annotations(self, scene: str) -> Annotations:
        """Return the annotations of a scene; there are none in the tables of the test split."""
        scenes, everything = self._annotations
        place = list(self.scenes).index(scene)
        start, stop = np.searchsorted(scenes, [place, place + 1]).tolist()
        return Annotations(*(getattr(everything, column.name)[start:stop] for column in fields(Annotations)))

    @cached_property
    def _annotations(self) -> tuple[Ints, Annotations]:
        """Scene (R,), ascending, of all annotations."""
        folder = self.folder
        place = {
            token: (i, frame)
            for i, scene in enumerate(self.scenes.values())
            for frame, token in enumerate(scene.tokens)
        }
        names = dict(read_table(folder, "category", "token", "name"))
        categories = tuple(dict.fromkeys(names.values()))
        code = {token: categories.index(name) for token, name in names.items()}
        visibility = read_table(folder, "visibility", "token", "level")
        levels = {token: _VISIBILITY.get(level, 0) for token, level in visibility}
        instances = enumerate(read_table(folder, "instance", "token", "category_token"))
        objects = {token: (i, category) for i, (token, category) in instances}
        integers, boxes = array("q"), array("d")
        columns = ("token", "sample_token", "instance_token", "visibility_token", "num_lidar_pts", "num_radar_pts")
        for token, sample, instance, level, lidar, radar, *parts in read_table(
            folder, "sample_annotation", *columns, "translation", "size", "rotation"
        ):
            try:
                number, category = objects[instance]
                integers.extend((*place[sample], number, code[category], levels.get(level, 0), int(lidar), int(radar)))
                if tuple(map(len, parts)) != _LENGTHS:
                    raise ValueError("translation, size or rotation of another length")  # noqa: TRY301  one place for all
                for part in parts:
                    boxes.extend(part)
            except (KeyError, TypeError, ValueError) as error:
                path = folder / "sample_annotation.json"
                raise DatasetError(path, f"known tokens and numbers in record {token}", str(error)) from error
        whole = np.array(integers, dtype=np.int64).reshape(-1, 7)
        box = np.array(boxes, dtype=np.float64).reshape(-1, 10)
        order = np.lexsort((whole[:, 1], whole[:, 0]))
        box = box[order]
        scene, frame, instance, category, level, lidar, radar = whole[order].T
        stamps = [one.stamp_us for one in self.scenes.values()]
        first = np.cumsum([0, *map(len, stamps)])[scene]
        stamp = np.concatenate([np.empty(0, dtype=np.int64), *stamps])[first + frame]
        return scene, Annotations(
            frame=frame,
            instance=instance,
            category=tuple(categories[i] for i in category.tolist()),
            center=box[:, 0:3],
            size=box[:, [4, 3, 5]],
            rotation=box[:, 6:10],
            velocity=box_velocity(instance, stamp, box[:, :2]),
            lidar_points=lidar,
            radar_points=radar,
            visibility=level,
        )


def box_velocity(instance: Ints, stamp_us: Ints, position: Floats, longest_s: float = 1.5) -> Floats:
    """Return the velocities (R, 2) of annotations, as the benchmark defines them.

    The velocity is the difference of the next and the previous position of the same object over their time difference;
    at the ends of its life the annotation itself takes the place of the missing one. It is NaN for objects annotated
    once, and where the times are more than `longest_s` apart, or twice that with a neighbour on both sides.

    Args:
        instance: (R,) which object.
        stamp_us: (R,) microseconds.
        position: (R, 2) metres.
        longest_s: seconds.
    """
    order = np.lexsort((stamp_us, instance))
    same = instance[order][1:] == instance[order][:-1]
    before, after = np.append(False, same), np.append(same, False)
    here = np.arange(len(order))
    first, last = order[here - before], order[here + after]
    seconds = (stamp_us[last] - stamp_us[first]) * 1e-6
    known = (before | after) & (seconds > 0) & (seconds <= longest_s * (1 + (before & after)))
    velocity = np.full((len(order), 2), np.nan)
    velocity[order[known]] = (position[last] - position[first])[known] / seconds[known, None]
    return velocity


def _matrix(translation: Any, rotation: Any) -> Floats:
    """Return the (4, 4) matrix of a pose in a table."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(np.asarray(rotation, dtype=np.float64))
    matrix[:3, 3] = translation
    return matrix

"""nuScenes: the official tables, detections in the official submission layout, LiDAR scans where they are present.

Conventions: the world is the global frame of the dataset. Detections are given in it, so the pose of their frames is
the identity; `poses` of a sequence, and the pose of every cloud, are poses of the LiDAR (LIDAR_TOP). Sequences are
scenes, frames are keyframes (samples, 2 Hz) with the stamps of the samples. Only the seven classes of the tracking
benchmark are kept.

Layout, below the root: the tables in `v1.0-trainval`, `v1.0-mini` or `v1.0-test` (the root may also be that folder
itself), scans in `samples/LIDAR_TOP`, detections in `detections/NAME.json`, splits of one's own in `splits.json` in the
folder of the tables: a map from the name of a split to a list of scene names, as the official tools read it.

A table is a JSON list of records, joined by tokens. It is read record by record and only used fields are kept, so the
largest ones (a gigabyte each in the full release) never stand in memory. Their stamps are microseconds.

The height of a detection is the height of the box's centre, as the layout says. Some public detection files have the
height of its bottom instead: they say so by `"z_origin": "bottom"` in their `meta`, or the caller does by the option
`z_bottom`.
"""

import json
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from optipmb_schemas import Tracks

from optipmb_tools.datasets.interface import (
    IDENTITY,
    Cloud,
    DataSequence,
    Dataset,
    DetectionFrame,
    Points,
    Truth,
    profile_named,
)
from optipmb_tools.files import DatasetError, read_points, read_text
from optipmb_tools.geometry import Bools, Floats, Ints, Pose, pose_of, rotation_of
from optipmb_tools.results.nuscenes import (
    NUSCENES_CLASSES,
    Submission,
    join_scenes,
    quaternion_yaw,
    read_submission,
    write_scene,
)

VERSIONS = ("v1.0-trainval", "v1.0-mini", "v1.0-test")

# Objects at least so far from the car, in metres, do not count in the benchmark
CLASS_RANGE = {
    "bicycle": 40.0,
    "bus": 50.0,
    "car": 50.0,
    "motorcycle": 40.0,
    "pedestrian": 40.0,
    "trailer": 50.0,
    "truck": 50.0,
}

# The class of a category in the tracking benchmark; it has no others
TRACKING_CLASS = {
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}

# Official splits: ranges of the numbers of their scenes, ends included
_RANGES = {
    "train": (
        "1-2 4-11 19-34 41-76 120-135 138-139 149-152 154-155 157-168 170-185 187-188 190-196 199-200 202-204 "
        "206-214 218-220 222 224-264 283-306 315-318 321 323-324 328 347-386 388-403 405-408 410-459 461-465 467-469 "
        "471-472 474-480 499-502 504-515 517-518 525-539 541-546 566 568 570-578 580 582-600 639-679 681 683-689 "
        "695-698 700-701 703-719 726-728 730-731 733-741 744 746-747 749-752 757-765 767-769 786-787 789-792 803-806 "
        "808-813 815-817 819-822 847-856 858 860-866 868-873 875-878 880 882-903 945 947 949 952-953 955-961 975-984 "
        "988-992 994-1025 1044-1058 1074-1102 1104-1110"
    ),
    "val": (
        "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
        "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
    ),
    "test": (
        "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
        "844-846 932-933 935-943 1026-1043"
    ),
    "mini_train": "61 553 655 757 796 1077 1094 1100",
    "mini_val": "103 916",
}
SPLITS = tuple(_RANGES)

_OCCLUSION = np.array([3, 2, 1, 1, 0])  # KITTI's level for each level of visibility
_LEAST_SCORE = 1e-12

LIDAR = "LIDAR_TOP"

_CHUNK = 1 << 22
_LATEST_US = 2**63 // 1000  # stamps are nanoseconds of 64 bits
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
            if not isinstance(scene, str) or scene not in samples:
                raise DatasetError(self.folder / "sample.json", "samples of known scenes", f"sample {token} of {scene}")
            if not isinstance(stamp, int) or not 0 <= stamp < _LATEST_US or not isinstance(token, str):
                expected = "tokens, and stamps in whole microseconds"
                raise DatasetError(self.folder / "sample.json", expected, f"{token!r:.60} at {stamp!r:.60}")
            samples[scene].append((stamp, token))
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


class NuScenesSequence(DataSequence):
    """One scene."""

    labels = NUSCENES_CLASSES

    def __init__(self, samples: SceneSamples, dataset: "NuScenesDataset") -> None:
        self.name = samples.name
        self.samples = samples.tokens  # one per frame
        self.stamp_us = samples.stamp_us  # (F,)
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self.samples)

    @cached_property
    def _keyframes(self) -> tuple[Keyframe, ...]:
        keyframes = self._dataset.tables.keyframes
        for token in self.samples:
            if token not in keyframes:
                path = self._dataset.tables.folder / "sample_data.json"
                raise DatasetError(path, f"a LIDAR_TOP keyframe of sample {token}", "none")
        return tuple(keyframes[token] for token in self.samples)

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds of the samples; no detections are read."""
        return np.asarray(self.stamp_us * 1000, dtype=np.int64)

    @cached_property
    def poses(self) -> tuple[Pose, ...]:
        """World from LiDAR, one per frame."""
        return tuple(keyframe.lidar for keyframe in self._keyframes)

    @property
    def ego_poses(self) -> tuple[Pose, ...]:
        """World from car, one per frame."""
        return tuple(keyframe.ego for keyframe in self._keyframes)

    @cached_property
    def _scans(self) -> tuple[Path | None, ...]:
        if not self._dataset.clouds:
            return (None,) * len(self)
        paths = (self._dataset.root / keyframe.filename for keyframe in self._keyframes)
        return tuple(path if path.is_file() else None for path in paths)

    @cached_property
    def has_clouds(self) -> bool:
        """Whether any keyframe's scan is present."""
        return any(self._scans)

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every keyframe in order, also those without detections.

        Raises:
            DatasetError: The file of detections lacks a sample, or a score is not in [0, 1].
        """
        submission = self._dataset.need_submission()
        for index, token in enumerate(self.samples):
            boxes = submission.boxes(token)
            if ((boxes["score"] < 0.0) | (boxes["score"] > 1.0)).any():
                raise DatasetError(submission.path, f"scores from 0 to 1 in results.{token}", "others")
            boxes["score"] = np.maximum(boxes["score"], _LEAST_SCORE)
            if self._dataset.z_bottom:
                boxes["center"][:, 2] += 0.5 * boxes["size"][:, 2]
            if not np.isfinite(boxes["velocity"]).any():
                del boxes["velocity"]
            stamp_ns = int(self.stamp_us[index]) * 1000
            yield DetectionFrame(index, stamp_ns, IDENTITY, NUSCENES_CLASSES, **boxes, cloud=self._cloud(index))

    def _cloud(self, index: int) -> Cloud | None:
        path = self._scans[index]
        return None if path is None else Cloud(partial(read_sweep, path), *self._keyframes[index].lidar)

    def annotations(self) -> Annotations:
        """Return the annotations of the scene, of all categories."""
        return self._dataset.tables.annotations(self.name)

    def ego_distance(self, frame: Ints, center: Floats) -> Floats:
        """Return the distances (R,) in the plane of boxes (R, 3) from the car in their frames (R,)."""
        ego = np.array([pose.translation[:2] for pose in self.ego_poses]).reshape(-1, 2)
        return np.asarray(np.linalg.norm(center[:, :2] - ego[frame], axis=1), dtype=np.float64)

    def truth(self) -> Truth | None:
        """Return the annotations of the seven classes; None where the scene has none at all.

        Those out of the benchmark's range, or without LiDAR or radar points, are ignored. `id` is the place of the
        object in the table of instances.
        """
        everything = self.annotations()
        if not len(everything):
            return None
        kept, label = tracking_labels(everything)
        frame, center = everything.frame[kept], everything.center[kept]
        reach = np.array([CLASS_RANGE[name] for name in NUSCENES_CLASSES])[label]
        unseen = (everything.lidar_points + everything.radar_points)[kept] == 0
        return Truth.of(
            NUSCENES_CLASSES,
            frame,
            id=everything.instance[kept],
            label=label,
            center=center,
            size=everything.size[kept],
            yaw=quaternion_yaw(everything.rotation[kept]),
            velocity=everything.velocity[kept],
            occlusion=_OCCLUSION[everything.visibility[kept]],
            points=everything.lidar_points[kept],
            ignored=unseen | (self.ego_distance(frame, center) >= reach),
        )


def tracking_labels(annotations: Annotations) -> tuple[Bools, Ints]:
    """Return which annotations (R,) are of a class of the tracking benchmark, and the classes of those (K,)."""
    code = {name: i for i, name in enumerate(NUSCENES_CLASSES)}
    label = np.array([code.get(TRACKING_CLASS.get(name, ""), -1) for name in annotations.category], dtype=np.int64)
    return label >= 0, label[label >= 0]


def read_sweep(path: Path) -> Points:
    """Return the points (P, 3) of a `.pcd.bin` file, in the frame of the LiDAR.

    Raises:
        DatasetError: The file cannot be read, or is no list of five 32-bit numbers per point (x y z intensity ring).
    """
    return read_points(path, "a LiDAR scan", 5)


PROFILES: Final = {"centerpoint": "nuscenes", "megvii": "nuscenes-megvii", "cbgs": "nuscenes-megvii"}
"""Tuned profiles by the detector's name."""


class NuScenesDataset(Dataset):
    """A nuScenes root together with one detector's results; each file is read on first use, and once."""

    name = "nuscenes"

    def __init__(
        self,
        root: Path,
        detections: str | Path | None = None,
        *,
        clouds: bool = True,
        z_bottom: bool | None = None,
        submission: bool = False,
    ) -> None:
        folder = _find_tables(root)
        self.root = folder.parent
        self.tables = NuScenesTables(folder)
        self.clouds = clouds
        self._detections = _find_detector(self.root, detections)
        self._z_bottom = z_bottom
        self._submission = submission

    @cached_property
    def submission(self) -> Submission | None:
        """The detections; None where no detector is named and there is not just one."""
        return None if self._detections is None else read_submission(self._detections, "detection")

    def need_submission(self) -> Submission:
        """Return the detections, which only tracking needs."""
        if self.submission is None:
            names = ", ".join(path.stem for path in _detectors(self.root))
            received = f"several: {names}" if names else "none"
            raise DatasetError(self.root, "the name of a detector, or just one in detections/", received)
        return self.submission

    @cached_property
    def profile(self) -> str:
        """The profile that was tuned with the detector which the file or its `meta` names, else `auto`."""
        if self.submission is None:
            return "auto"
        texts = (str(value) for value in self.submission.meta.values() if not isinstance(value, bool))
        return profile_named(" ".join([self.submission.path.stem, *texts]), PROFILES)

    @cached_property
    def z_bottom(self) -> bool:
        """Whether the height of a detection means the bottom of its box."""
        if self._z_bottom is not None:
            return self._z_bottom
        submission = self.need_submission()
        origin = submission.meta.get("z_origin", "center")
        if origin not in ("center", "bottom"):
            raise DatasetError(submission.path, 'meta.z_origin "center" or "bottom"', repr(origin))
        return bool(origin == "bottom")

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Assumptions about the detections, and the content of a submission."""
        found = list(self.submission.notes) if self.submission is not None else []
        if self.submission is not None and self.profile == "auto":
            found.insert(0, f"{self.submission.path}: neither name nor meta of a known detector: its profile is auto")
        if self.submission is not None and (others := len(self.submission.rows) - len(self._known)):
            folder, count = self.tables.folder.name, len(self.submission.rows)
            found.append(f"{self.submission.path}: {others} of {count} samples are not in {folder}: left out")
        all_written = "submission: all tracks are written, whatever their score, as AMOTA is over all scores"
        return (*found, *((all_written,) if self._submission else ()))

    def sequences(self, names: Sequence[str]) -> list[NuScenesSequence]:
        """Return the scenes of these names, of official splits, and of the splits in `splits.json`.

        `all` are the scenes that the tables have, and the detections if any are given. Scenes of a split that the
        tables lack are left out.

        Raises:
            DatasetError: a named scene is not there, or none is.
        """
        scenes = self.tables.scenes
        splits = own_splits(self.tables.folder) if set(names) - {"all", *scenes, *SPLITS} else {}
        wanted: list[str] = []
        for name in names:
            if name == "all":
                detected = None if self.submission is None else self._known
                wanted += [one.name for one in scenes.values() if detected is None or detected & set(one.tokens)]
            elif name in SPLITS or name in splits:
                members = scenes_of_split(name) if name in SPLITS else splits[name]
                wanted += [scene for scene in members if scene in scenes]
            elif name in scenes:
                wanted.append(name)
            else:
                known = ", ".join([*("all", *SPLITS, *splits), *list(scenes)[:3]])
                more = f" and {len(scenes) - 3} more scenes" if len(scenes) > 3 else ""  # noqa: PLR2004  as many named
                raise DatasetError(self.tables.folder, f"a scene or a split ({known}{more})", repr(name))
        if not wanted:
            raise DatasetError(self.tables.folder, f"scenes of {' '.join(names) or 'some name'}", "none")
        return [NuScenesSequence(scenes[name], self) for name in dict.fromkeys(wanted)]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write `out/scenes/NAME.json`."""
        return write_scene(out, sequence.name, self.tables.scenes[sequence.name].tokens, self._meta, tracks)

    def join(self, out: Path, sequences: Sequence[DataSequence]) -> None:
        """Write `out/tracking_results.json` from the files of these scenes."""
        join_scenes(out, [sequence.name for sequence in sequences], self._meta)

    @property
    def _known(self) -> set[str]:
        """The samples of the detections that the tables have.

        Raises:
            DatasetError: There are none.
        """
        submission = self.need_submission()
        known = submission.rows.keys() & {token for one in self.tables.scenes.values() for token in one.tokens}
        if submission.rows and not known:
            received = f"none of them: the {len(submission.rows)} samples of the file are of another release?"
            raise DatasetError(submission.path, f"samples of {self.tables.folder.name}", received)
        return known

    @property
    def _meta(self) -> Mapping[str, Any]:
        return {} if self.submission is None else self.submission.meta


def _find_tables(root: Path) -> Path:
    """Return the folder of the tables, given it or the one around it."""
    if (root / "scene.json").is_file():
        return root
    found = [root / version for version in VERSIONS if (root / version / "scene.json").is_file()]
    if len(found) == 1:
        return found[0]
    received = "a folder without them" if root.is_dir() else "no such folder"
    if found:
        received = f"{' and '.join(path.name for path in found)}: name one of them, such as {found[0]}"
    raise DatasetError(root, f"a nuScenes root with the tables of one release ({', '.join(VERSIONS)})", received)


def _detectors(base: Path) -> list[Path]:
    return sorted((base / "detections").glob("*.json"))


def _find_detector(base: Path, detections: str | Path | None) -> Path | None:
    """Return the file of a detector, given its name, its path, or nothing when there is just one."""
    if detections is None:
        found = _detectors(base)
        return found[0] if len(found) == 1 else None
    for place in (base / "detections" / f"{detections}.json", Path(detections)):
        if place.is_file():
            return place
    raise DatasetError(base, f"detections/{detections}.json, or the path of a detection file", "no such file")


def scenes_of_split(split: str) -> tuple[str, ...]:
    """Return the names of the scenes of an official split, in order."""
    bounds = (part.partition("-") for part in _RANGES[split].split())
    return tuple(f"scene-{number:04d}" for low, _, high in bounds for number in range(int(low), int(high or low) + 1))


def own_splits(folder: Path) -> dict[str, tuple[str, ...]]:
    """Return the splits of `splits.json` in a folder of tables; none when there is no such file.

    Raises:
        DatasetError: the file is not a map from names to lists of names.
    """
    path = folder / "splits.json"
    if not path.exists():
        return {}
    what = "a map from the name of a split to a list of scene names"
    try:
        content = json.loads(read_text(path, what))
    except json.JSONDecodeError as error:
        raise DatasetError(path, what, error.msg, line=error.lineno) from error
    if not isinstance(content, dict) or not all(isinstance(scenes, list) for scenes in content.values()):
        raise DatasetError(path, what, "something else")
    return {name: tuple(map(str, scenes)) for name, scenes in content.items()}

"""nuScenes: the official tables, detections in the official submission layout, LiDAR scans where they are present.

Conventions: the world is the global frame of the dataset. Detections are given in it, so the pose of their frames is
the identity; `poses` of a sequence, and the pose of every cloud, are those of the LiDAR (LIDAR_TOP). Sequences are
scenes, frames are keyframes (samples, 2 Hz), stamps are those of the samples. Only the seven classes of the tracking
benchmark are kept.

Layout, below the root: the tables in `v1.0-trainval`, `v1.0-mini` or `v1.0-test` (the root may also be that folder
itself), scans in `samples/LIDAR_TOP`, detections in `detections/NAME.json`.

The height of a detection is that of the box's centre, as the layout says. Some public detection files have that of its
bottom instead: they say so by `"z_origin": "bottom"` in their `meta`, or the caller does by the option `z_bottom`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from optipmb_client.datasets.interface import Cloud, DataSequence, DetectionFrame, Points, Regions, Truth
from optipmb_client.datasets.nuscenes_splits import SPLITS, own_splits, scenes_of_split
from optipmb_client.datasets.nuscenes_tables import Annotations, Keyframe, NuScenesTables, SceneSamples
from optipmb_client.files import DatasetError, read_points
from optipmb_client.geometry import Bools, Floats, Ints, Pose
from optipmb_client.results import ResultWriter
from optipmb_client.results.nuscenes import NuScenesResultWriter, join_scenes
from optipmb_client.results.nuscenes_layout import NUSCENES_CLASSES, Submission, quaternion_yaw, read_submission

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

_WORLD = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
_SCAN_COLUMNS = 5
_OCCLUSION = np.array([3, 2, 1, 1, 0])  # KITTI's level for each level of visibility
_LEAST_SCORE = 1e-12


class NuScenesDetections:
    """The detections of one detector; the file is read when it is first needed, and once."""

    def __init__(self, path: Path, *, z_bottom: bool | None = None) -> None:
        self.path = path
        self._z_bottom = z_bottom

    @cached_property
    def submission(self) -> Submission:
        """What the file holds."""
        return read_submission(self.path, "detection")

    @cached_property
    def z_bottom(self) -> bool:
        """Whether the height of a detection is that of the bottom of its box."""
        if self._z_bottom is not None:
            return self._z_bottom
        origin = self.submission.meta.get("z_origin", "center")
        if origin not in ("center", "bottom"):
            raise DatasetError(self.path, 'meta.z_origin "center" or "bottom"', repr(origin))
        return bool(origin == "bottom")

    def frame(self, token: str, index: int, stamp_ns: int, cloud: Cloud | None) -> DetectionFrame:
        """Return the detections of one sample.

        Raises:
            DatasetError: the file does not have the sample, or a score is not in [0, 1].
        """
        boxes = self.submission.boxes(token)
        if len(boxes) and not (boxes.score.min() >= 0.0 and boxes.score.max() <= 1.0):
            raise DatasetError(self.path, f"scores from 0 to 1 in results.{token}", "others")
        center = boxes.center.copy()
        if self.z_bottom:
            center[:, 2] += 0.5 * boxes.size[:, 2]
        return DetectionFrame(
            index=index,
            stamp_ns=stamp_ns,
            pose=_WORLD,
            labels=NUSCENES_CLASSES,
            label=boxes.label,
            center=center,
            size=boxes.size,
            yaw=boxes.yaw,
            score=np.maximum(boxes.score, _LEAST_SCORE),
            velocity=boxes.velocity if np.isfinite(boxes.velocity).any() else None,
            cloud=cloud,
        )


@dataclass(frozen=True)
class _Source:
    """What the sequences of a dataset share."""

    root: Path
    tables: NuScenesTables
    detections: NuScenesDetections | None
    clouds: bool

    def need_detections(self) -> NuScenesDetections:
        """Return the detections, which only tracking needs."""
        if self.detections is None:
            names = ", ".join(path.stem for path in _detectors(self.root))
            received = f"several: {names}" if names else "none"
            raise DatasetError(self.root, "the name of a detector, or just one in detections/", received)
        return self.detections


class NuScenesSequence:
    """One scene."""

    labels = NUSCENES_CLASSES

    def __init__(self, samples: SceneSamples, source: _Source) -> None:
        self.name = samples.name
        self.samples = samples.tokens
        """Tokens of the samples, one per frame."""
        self.stamp_us = samples.stamp_us
        """(F,) microseconds."""
        self._source = source

    def __len__(self) -> int:
        return len(self.samples)

    @cached_property
    def _keyframes(self) -> tuple[Keyframe, ...]:
        keyframes = self._source.tables.keyframes
        for token in self.samples:
            if token not in keyframes:
                path = self._source.tables.folder / "sample_data.json"
                raise DatasetError(path, f"a LIDAR_TOP keyframe of sample {token}", "none")
        return tuple(keyframes[token] for token in self.samples)

    @property
    def poses(self) -> tuple[Pose, ...]:
        """World from LiDAR, one per frame."""
        return tuple(keyframe.lidar for keyframe in self._keyframes)

    @property
    def ego_poses(self) -> tuple[Pose, ...]:
        """World from car, one per frame."""
        return tuple(keyframe.ego for keyframe in self._keyframes)

    @cached_property
    def _scans(self) -> tuple[Path | None, ...]:
        if not self._source.clouds:
            return (None,) * len(self)
        paths = (self._source.root / keyframe.filename for keyframe in self._keyframes)
        return tuple(path if path.is_file() else None for path in paths)

    @property
    def has_clouds(self) -> bool:
        """Whether any keyframe's scan is present."""
        return any(self._scans)

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every keyframe in order, also those without detections."""
        detections = self._source.need_detections()
        for index, token in enumerate(self.samples):
            yield detections.frame(token, index, int(self.stamp_us[index]) * 1000, self._cloud(index))

    def _cloud(self, index: int) -> Cloud | None:
        path, pose = self._scans[index], self._keyframes[index].lidar
        return None if path is None else Cloud(partial(read_sweep, path), pose.translation, pose.quaternion)

    def annotations(self) -> Annotations:
        """Return all annotations of the scene, whatever their category."""
        return self._source.tables.annotations(self.name)

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
        count = len(frame)
        reach = np.array([CLASS_RANGE[name] for name in NUSCENES_CLASSES])[label]
        unseen = (everything.lidar_points + everything.radar_points)[kept] == 0
        return Truth(
            labels=NUSCENES_CLASSES,
            frame=frame,
            id=everything.instance[kept],
            label=label,
            center=center,
            size=everything.size[kept],
            yaw=quaternion_yaw(everything.rotation[kept]),
            velocity=everything.velocity[kept],
            occlusion=_OCCLUSION[everything.visibility[kept]],
            truncation=np.zeros(count, dtype=np.int64),
            covered=np.full(count, np.nan),
            points=everything.lidar_points[kept],
            box2d=np.full((count, 4), np.nan),
            ignored=unseen | (self.ego_distance(frame, center) >= reach),
            regions=Regions(np.empty(0, dtype=np.int64), np.empty((0, 4))),
        )


def tracking_labels(annotations: Annotations) -> tuple[Bools, Ints]:
    """Return which annotations (R,) are of a class of the tracking benchmark, and the classes of those (K,)."""
    code = {name: i for i, name in enumerate(NUSCENES_CLASSES)}
    label = np.array([code.get(TRACKING_CLASS.get(name, ""), -1) for name in annotations.category], dtype=np.int64)
    return label >= 0, label[label >= 0]


def read_sweep(path: Path) -> Points:
    """Return the points (P, 3) of a `.pcd.bin` file, in the frame of the LiDAR.

    Raises:
        DatasetError: the file cannot be read, or is no list of five 32-bit numbers per point (x y z intensity ring).
    """
    return read_points(path, "a LiDAR scan", _SCAN_COLUMNS)


class NuScenesDataset:
    """A nuScenes root together with one detector's results."""

    name = "nuscenes"
    profile = "nuscenes-megvii"

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
        base = folder.parent
        detector = _find_detector(base, detections)
        found = None if detector is None else NuScenesDetections(detector, z_bottom=z_bottom)
        self._source = _Source(base, NuScenesTables(folder), found, clouds)
        self._submission = submission

    @property
    def notes(self) -> Iterator[str]:
        """What was assumed about the detections, and what a submission has."""
        if self._source.detections is not None:
            yield from self._source.detections.submission.notes
        if self._submission:
            yield "submission: all tracks are written, whatever their score, as AMOTA is over all scores"

    @property
    def tables(self) -> NuScenesTables:
        """The tables."""
        return self._source.tables

    def sequences(self, names: Sequence[str]) -> list[NuScenesSequence]:
        """Return the scenes of these names, of official splits, and of those in `splits.json` beside the tables.

        `all` are those that the tables have, and the detections if any are given. Of a split, those that the tables
        have are taken.

        Raises:
            DatasetError: a named scene is not there, or none is.
        """
        scenes = self.tables.scenes
        splits = own_splits(self.tables.folder) if set(names) - {"all", *scenes, *SPLITS} else {}
        wanted: list[str] = []
        for name in names:
            if name == "all":
                wanted += self._detected()
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
        return [NuScenesSequence(scenes[name], self._source) for name in dict.fromkeys(wanted)]

    def writer(self, out: Path, sequence: DataSequence) -> ResultWriter:
        """Return a writer of `out/scenes/NAME.json`."""
        return NuScenesResultWriter(out, sequence.name, self.tables.scenes[sequence.name].tokens, self._meta)

    def join(self, out: Path, sequences: Sequence[DataSequence]) -> None:
        """Write `out/tracking_results.json` from the files of these scenes."""
        join_scenes(out, [sequence.name for sequence in sequences], self._meta)

    @property
    def _meta(self) -> Mapping[str, Any]:
        detections = self._source.detections
        return {} if detections is None else detections.submission.meta

    def _detected(self) -> list[str]:
        detections = self._source.detections
        return [
            scene.name
            for scene in self.tables.scenes.values()
            if detections is None or any(token in detections.submission for token in scene.tokens)
        ]


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

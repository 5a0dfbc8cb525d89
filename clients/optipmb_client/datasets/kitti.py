"""The KITTI tracking benchmark.

Conventions: the sensor frame of detections is the rectified camera frame with its axes named anew, z up (see
`optipmb_client.camera`); the world is the same for the camera of frame 0. Clouds are in the velodyne frame. Frames are
0.1 s apart. Truth boxes are ignored when largely invisible or cut by the image's border, as AB3DMOT's protocol has it.

Layout, below a root that holds `training` or `testing`, or is itself such a folder: `calib/SSSS.txt`,
`poses/SSSS.txt` or `oxts/SSSS.txt`, and, where there are any, `label_02/SSSS.txt` and `velodyne/SSSS/FFFFFF.bin`.
Detections are `detections/DETECTOR/CLASS/SSSS.txt`, in the root or beside it; those of `testing` are in it where there
is `training` too, for sequences have the same names in both. Only tracking needs them: truth, poses and clouds can be
read of a root with several detectors of which none is named, and of one with none.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from optipmb_client.camera import SENSOR_FROM_CAMERA, Camera, sensor_from_kitti
from optipmb_client.datasets.interface import Cloud, DataSequence, DetectionFrame, Points, Regions, Truth
from optipmb_client.datasets.kitti_files import (
    Calibration,
    read_calibration,
    read_detections,
    read_labels,
    read_oxts,
    read_poses,
)
from optipmb_client.files import DatasetError, read_points, read_rows
from optipmb_client.geometry import Floats, Ints, Pose, pose_of, stack_poses, to_world
from optipmb_client.results import ResultWriter
from optipmb_client.results.kitti import SUBMISSION_SCORES, KittiResultWriter

PERIOD_NS = 100_000_000

# AB3DMOT's splits of the training sequences
SPLITS = {
    "train": ("0000", "0002", "0003", "0004", "0005", "0007", "0009", "0011", "0017", "0020"),
    "val": ("0001", "0006", "0008", "0010", "0012", "0013", "0014", "0015", "0016", "0018", "0019"),
}

_TYPE_CODES = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}
_CLASSES = tuple(sorted(_TYPE_CODES))
_OFFICIAL = {name.lower(): name for name in _CLASSES}
_DONT_CARE = "DontCare"
_MAX_OCCLUSION = 2
_SCAN_COLUMNS = 4
_AXES = np.eye(4)
_AXES[:3, :3] = SENSOR_FROM_CAMERA


@dataclass(frozen=True)
class Layout:
    """Where the files of a KITTI root are."""

    root: Path
    base: Path
    detector: Path | None
    """The folder with one folder per class; None where no detector is named and there is not just one."""
    clouds: bool  # clouds are wanted
    still: bool = False  # the sensor is taken to stand still; no poses are read

    @cached_property
    def probability(self) -> bool:
        """Whether the scores of the detector are probabilities already, not logits."""
        return _are_probabilities(self.need_detector())

    def need_detector(self) -> Path:
        """Return the folder of the detector, which only tracking needs."""
        if self.detector is None:
            names = ", ".join(sorted(path.name for path in _detectors(self.root, self.base)))
            received = f"several: {names}" if names else "none"
            raise DatasetError(self.root, "the name of a detector, or just one in detections/", received)
        return self.detector

    def text(self, kind: str, sequence: str) -> Path:
        """Return the path of one of the text files of a sequence."""
        return self.base / kind / f"{sequence}.txt"


class KittiSequence:
    """One sequence; files are read when they are first needed, and once."""

    def __init__(self, name: str, layout: Layout) -> None:
        self.name = name
        self._layout = layout
        folders = [path.parent for path in sorted(layout.detector.glob(f"*/{name}.txt"))] if layout.detector else []
        self._folders = {_OFFICIAL.get(folder.name.lower(), folder.name): folder for folder in folders}
        self.labels = tuple(self._folders) if layout.detector else _CLASSES
        if len(self._folders) < len(folders):
            raise DatasetError(layout.detector or "", "one folder of a class", "several that differ in case")
        if not self.labels:
            raise DatasetError(f"{layout.detector}/CLASS/{name}.txt", "detections of at least one class", "none")

    def __len__(self) -> int:
        return len(self._world_from_camera)

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration of the recording."""
        return read_calibration(self._layout.text("calib", self.name))

    @property
    def camera(self) -> Camera:
        """Camera 2, in whose images the benchmark counts; its image size is that of most sequences."""
        return Camera(self.calibration.projection)

    @cached_property
    def _world_from_camera(self) -> Floats:
        """(F, 4, 4) in camera axes."""
        if self._layout.still:
            return np.tile(np.eye(4), (self._last_frame() + 1, 1, 1))
        poses, oxts = self._layout.text("poses", self.name), self._layout.text("oxts", self.name)
        if poses.exists():
            return read_poses(poses)
        if oxts.exists():
            return read_oxts(oxts, self.calibration)
        instead = "--option poses=none for a sensor that stands still"
        raise DatasetError(poses, f"a pose file, or {oxts}, or {instead}", "neither")

    def _last_frame(self) -> int:
        """Return the last frame that detections, labels, scans or images have; -1 without any."""
        images = (self._layout.base / "image_02" / self.name).glob("*.*")
        frames = [*self._scans, *(int(path.stem) for path in images if path.stem.isdigit())]
        files = [(folder / f"{self.name}.txt", ",") for folder in self._folders.values()]
        for path, separator in (*files, (self._layout.text("label_02", self.name), None)):
            rows = read_rows(path, "frames", separator) if path.is_file() else []
            frames += [int(fields[0]) for _, fields in rows if fields[0].strip().isdigit()]
        return max(frames, default=-1)

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds, which need no detections."""
        return np.arange(len(self), dtype=np.int64) * PERIOD_NS

    @cached_property
    def poses(self) -> tuple[Pose, ...]:
        """World from sensor, one per frame, both z up."""
        return tuple(pose_of(matrix) for matrix in _AXES @ self._world_from_camera @ _AXES.T)

    @cached_property
    def _scans(self) -> dict[int, Path]:
        if not self._layout.clouds:
            return {}
        folder = self._layout.base / "velodyne" / self.name
        return {int(path.stem): path for path in folder.glob("*.bin") if path.stem.isdigit()}

    @property
    def has_clouds(self) -> bool:
        """Whether any frame has a point cloud."""
        return bool(self._scans)

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order, also those without detections."""
        self._layout.need_detector()
        count = len(self)
        files = [
            read_detections(folder / f"{self.name}.txt", count, _TYPE_CODES.get(label))
            for label, folder in self._folders.items()
        ]
        label = np.concatenate([np.full(len(file.frame), i, dtype=np.int64) for i, file in enumerate(files)])
        frame = np.concatenate([file.frame for file in files])
        order = np.argsort(frame, kind="stable")
        center, size, yaw = sensor_from_kitti(
            np.concatenate([file.bottom for file in files]),
            np.concatenate([file.hwl for file in files]),
            np.concatenate([file.rotation_y for file in files]),
        )
        score = np.concatenate([file.score for file in files])
        if not self._layout.probability:
            score = _sigmoid(score)
        bounds = np.searchsorted(frame[order], np.arange(count + 1))
        for index, pose in enumerate(self.poses):
            rows: Ints = order[bounds[index] : bounds[index + 1]]
            yield DetectionFrame(
                index=index,
                stamp_ns=index * PERIOD_NS,
                pose=pose,
                labels=self.labels,
                label=label[rows],
                center=center[rows],
                size=size[rows],
                yaw=yaw[rows],
                score=score[rows],
                cloud=self._cloud(index),
            )

    def _cloud(self, index: int) -> Cloud | None:
        path = self._scans.get(index)
        if path is None:
            return None
        pose = pose_of(_AXES @ self._world_from_camera[index] @ self.calibration.rectified_from_velodyne)
        return Cloud(partial(read_scan, path), pose.translation, pose.quaternion)

    def truth(self) -> Truth | None:
        """Return the annotations in the world frame; None where the sequence has no label file."""
        path = self._layout.text("label_02", self.name)
        if not path.exists():
            return None
        file = read_labels(path, len(self))
        types = np.asarray(file.type, dtype=np.str_)
        kept = types != _DONT_CARE
        labels = tuple(sorted(set(types[kept].tolist())))
        center, size, yaw = sensor_from_kitti(file.bottom[kept], file.hwl[kept], file.rotation_y[kept])
        rotation, translation = stack_poses(self.poses)
        frame = file.frame[kept]
        center, yaw = to_world(rotation[frame], translation[frame], center, yaw)
        occlusion, truncation = file.occlusion[kept], file.truncation[kept]
        count = len(frame)
        return Truth(
            labels=labels,
            frame=frame,
            id=file.id[kept],
            label=np.searchsorted(labels, types[kept]).astype(np.int64) if labels else np.empty(0, dtype=np.int64),
            center=center,
            size=size,
            yaw=yaw,
            velocity=np.full((count, 2), np.nan),
            occlusion=occlusion,
            truncation=truncation,
            covered=np.full(count, np.nan),
            points=np.full(count, -1, dtype=np.int64),
            box2d=file.box2d[kept],
            ignored=(occlusion > _MAX_OCCLUSION) | (truncation > 0),
            regions=Regions(file.frame[~kept], file.box2d[~kept]),
        )


def read_scan(path: Path) -> Points:
    """Return the points (P, 3) of a velodyne file.

    Raises:
        DatasetError: the file cannot be read, or is no list of four 32-bit numbers per point.
    """
    return read_points(path, "a velodyne scan", _SCAN_COLUMNS)


class KittiDataset:
    """A KITTI tracking root, together with the results of a detector for tracking."""

    name = "kitti"
    profile = "kitti"

    def __init__(
        self,
        root: Path,
        detections: str | Path | None = None,
        *,
        clouds: bool = True,
        split: str | None = None,
        poses: str | None = None,
        submission: str | None = None,
    ) -> None:
        halves = [name for name in (split, "training", "testing") if name and (root / name).is_dir()]
        base = root / halves[0] if halves else root
        if not (base / "calib").is_dir() or split not in {None, base.name}:
            received = "a folder without them" if root.is_dir() else "no such folder"
            expected = f"{split}/calib" if split else "training/calib, testing/calib or calib"
            raise DatasetError(root, f"a KITTI tracking root (with {expected})", received)
        if poses not in {None, "none"}:
            raise DatasetError("option poses", "none: the sensor is taken to stand still", repr(poses))
        self._layout = Layout(root, base, _find_detector(root, base, detections), clouds, poses == "none")
        self._submitted = None if submission is None else _thresholds(submission)
        self.notes = ["poses=none: the sensor is taken to stand still, and tracks are in its frame"] if poses else []
        if self._submitted is not None:
            least = ", ".join(f"{name} {score:g}" for name, score in self._submitted.items())
            self.notes.append(f"submission: confirmed tracks from these mean scores on, in the image: {least}")
            if missing := sorted({path.stem for path in (base / "calib").glob("*.txt")} - set(self._present())):
                self.notes.append(f"submission: no detections, so no file, of {' '.join(missing)}")

    def sequences(self, names: Sequence[str]) -> list[KittiSequence]:
        """Return the sequences of these names; `train` and `val` are the splits.

        `all` are those that the detector has, or all where none is chosen.

        Raises:
            DatasetError: a named sequence is not there, or none is.
        """
        present = self._present()
        wanted: list[str] = []
        for name in names:
            wanted += present if name == "all" else SPLITS.get(name, (name,))
        missing = sorted(set(wanted) - set(present))
        if missing:
            raise DatasetError(
                self._layout.base,
                f"{self._needed()} of the sequences asked for",
                f"none for {' '.join(missing)}; there are {' '.join(present) or 'none'}",
            )
        if not wanted:
            raise DatasetError(self._layout.base, "at least one sequence", "none")
        return [KittiSequence(name, self._layout) for name in dict.fromkeys(wanted)]

    def writer(self, out: Path, sequence: DataSequence) -> ResultWriter:
        """Return a writer of `out/SSSS.txt`."""
        camera = KittiSequence(sequence.name, self._layout).camera
        return KittiResultWriter(out / f"{sequence.name}.txt", camera, self._submitted)

    def _present(self) -> list[str]:
        calibrated = {path.stem for path in (self._layout.base / "calib").glob("*.txt")}
        if self._layout.detector is None:
            return sorted(calibrated)
        detected = {path.stem for path in self._layout.detector.glob("*/*.txt")}
        return sorted(calibrated & detected)

    def _needed(self) -> str:
        return "calib" if self._layout.detector is None else f"calib and detections ({self._layout.detector})"


def _thresholds(submission: str) -> dict[str, float]:
    """Return the least mean score of a track by class, given one for all or `default`."""
    if submission == "default":
        return SUBMISSION_SCORES
    if not re.fullmatch(r"0?\.\d+|[01](\.0*)?", submission):
        raise DatasetError("--submission", "a mean score from 0 to 1", repr(submission))
    return dict.fromkeys(SUBMISSION_SCORES, float(submission))


def _find_detector(root: Path, base: Path, detections: str | Path | None) -> Path | None:
    """Return the folder of a detector, given its name or its path, or the only one there is; None where it is open."""
    if detections is None:
        found = _detectors(root, base)
        return found[0] if len(found) == 1 else None
    for place in (*(folder / detections for folder in _detector_folders(root, base)), Path(detections)):
        if any(place.glob("*/*.txt")):
            return place
    raise DatasetError(root, f"detections/{detections}/CLASS/SSSS.txt below or beside it", "no such files")


def _detectors(root: Path, base: Path) -> list[Path]:
    files = (path for folder in _detector_folders(root, base) for path in folder.glob("*/*/*.txt"))
    return list(dict.fromkeys(path.parents[1].resolve() for path in files))


def _detector_folders(root: Path, base: Path) -> list[Path]:
    beside = base.name == "testing" and (base.parent / "training").is_dir()
    places = (base,) if beside else (root, base, base.parent, root.parent)
    return list(dict.fromkeys(place / "detections" for place in places))


def _are_probabilities(detector: Path) -> bool:
    """Tell probabilities from logits: all scores of all files of the detector lie in (0, 1]."""
    column = 6
    for path in sorted(detector.glob("*/*.txt")):
        for _, fields in read_rows(path, "a detection file", ","):
            try:
                if not 0.0 < float(fields[column]) <= 1.0:
                    return False
            except (IndexError, ValueError):
                continue  # the reader of the file names the place when the file is used
    return True


def _sigmoid(logit: Floats) -> Floats:
    # tanh does not overflow; the floor keeps hopeless scores inside (0, 1].
    return np.asarray(np.maximum(0.5 * (1.0 + np.tanh(0.5 * logit)), 1e-12), dtype=np.float64)

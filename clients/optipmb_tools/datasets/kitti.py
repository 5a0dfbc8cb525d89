"""The KITTI tracking benchmark.

Conventions: the sensor frame of detections is the rectified camera frame with its axes renamed, z up (see
`optipmb_tools.camera`); the world is the same for the camera of frame 0. Clouds are in the velodyne frame. Frames are
0.1 s apart. Truth boxes are ignored when largely invisible or cut by the image's border, as AB3DMOT's protocol has it.

Layout, below a root that holds `training` or `testing`, or is itself such a folder: `calib/SSSS.txt`, `poses/SSSS.txt`
or `oxts/SSSS.txt`, and, where there are any, `label_02/SSSS.txt` and `velodyne/SSSS/FFFFFF.bin`. Detections are
`detections/DETECTOR/CLASS/SSSS.txt`, in the root or its parent. Where there is `training` too, the detections of
`testing` are in its folder, for sequences have the same names in both. Only tracking needs them: truth, poses and
clouds can be read of a root with several detectors of which none is named, and of one with none.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Final

import numpy as np
from optipmb_schemas import Tracks

from optipmb_tools.camera import SENSOR_FROM_CAMERA, Camera, sensor_from_kitti
from optipmb_tools.datasets.interface import (
    Cloud,
    DataSequence,
    Dataset,
    DetectionFrame,
    Points,
    Regions,
    Truth,
    profile_named,
)
from optipmb_tools.files import DatasetError, numbers, read_points, read_rows
from optipmb_tools.geometry import Floats, Ints, Pose, pose_of, stack_poses, to_world
from optipmb_tools.results.kitti import SUBMISSION_SCORES, write_kitti_results
from optipmb_tools.table_files import Columns

PERIOD_NS = 100_000_000
EARTH_RADIUS_M = 6_378_137.0  # of the mercator projection that KITTI's development kit uses

# AB3DMOT's splits of the training sequences
SPLITS = {
    "train": ("0000", "0002", "0003", "0004", "0005", "0007", "0009", "0011", "0017", "0020"),
    "val": ("0001", "0006", "0008", "0010", "0012", "0013", "0014", "0015", "0016", "0018", "0019"),
}

_TYPE_CODES = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}
_CLASSES = tuple(sorted(_TYPE_CODES))
_OFFICIAL = {name.lower(): name for name in _CLASSES}
_MAX_OCCLUSION = 2
_AXES = np.eye(4)
_AXES[:3, :3] = SENSOR_FROM_CAMERA

_ROTATION_ERROR = 1e-3  # far more than the rounding of the text, far less than a matrix that is no rotation
_FRAME = re.compile(r"\d{1,6}(\.0*)?")
_DETECTION = "frame type x1 y1 x2 y2 score h w l x y z ry alpha"
_LABEL = "frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z ry"
_WHOLE = ("frame", "id", "truncated", "occluded")  # columns of whole numbers
_PARTS = {"box2d": "x1 y1 x2 y2", "hwl": "h w l", "bottom": "x y z"}
_MATRICES = {
    "P2": ("P2", (3, 4)),
    "R0_rect": ("R0_rect", (3, 3)),
    "R_rect": ("R0_rect", (3, 3)),
    "Tr_velo_to_cam": ("Tr_velo_to_cam", (3, 4)),
    "Tr_velo_cam": ("Tr_velo_to_cam", (3, 4)),
    "Tr_imu_to_velo": ("Tr_imu_to_velo", (3, 4)),
    "Tr_imu_velo": ("Tr_imu_to_velo", (3, 4)),
}


@dataclass(frozen=True)
class KittiCalibration:
    """Matrices of one calibration file."""

    path: Path
    projection: Floats  # P2: (3, 4) image of camera 2 <- rectified camera 0
    rectified_from_velodyne: Floats  # (4, 4)
    velodyne_from_imu: Floats | None  # (4, 4); None where the file has none


class KittiSequence(DataSequence):
    """One sequence; files are read on first use, and once."""

    def __init__(self, name: str, dataset: "KittiDataset") -> None:
        self.name = name
        self._dataset = dataset
        detector = dataset.detector
        folders = [path.parent for path in sorted(detector.glob(f"*/{name}.txt"))] if detector else []
        self._folders = {_OFFICIAL.get(folder.name.lower(), folder.name): folder for folder in folders}
        self.labels: tuple[str, ...] = tuple(self._folders) if detector else _CLASSES
        if len(self._folders) < len(folders):
            raise DatasetError(detector or "", "one folder of a class", "several that differ in case")
        if not self.labels:
            raise DatasetError(f"{detector}/CLASS/{name}.txt", "detections of at least one class", "none")

    def __len__(self) -> int:
        return len(self._world_from_camera)

    @cached_property
    def calibration(self) -> KittiCalibration:
        return read_calibration(self._dataset.text("calib", self.name))

    @property
    def camera(self) -> Camera:
        """Camera 2, in whose images the benchmark counts; its image size is the one of most sequences."""
        return Camera(self.calibration.projection)

    @cached_property
    def _world_from_camera(self) -> Floats:
        """(F, 4, 4) in camera axes."""
        if self._dataset.still:
            return np.tile(np.eye(4), (self._last_frame() + 1, 1, 1))
        poses, oxts = self._dataset.text("poses", self.name), self._dataset.text("oxts", self.name)
        if poses.exists():
            return read_poses(poses)
        if oxts.exists():
            return read_oxts(oxts, self.calibration)
        instead = "--option poses=none for a sensor that stands still"
        raise DatasetError(poses, f"a pose file, or {oxts}, or {instead}", "neither")

    def _last_frame(self) -> int:
        """Return the last frame that detections, labels, scans or images have; -1 without any."""
        images = (self._dataset.base / "image_02" / self.name).glob("*.*")
        frames = [*self._scans, *(int(path.stem) for path in images if path.stem.isdigit())]
        files = [folder / f"{self.name}.txt" for folder in self._folders.values()]
        for path in (*files, self._dataset.text("label_02", self.name)):
            rows = read_rows(path, "frames") if path.is_file() else []
            frames += [int(float(fields[0])) for _, fields in rows if _FRAME.fullmatch(fields[0])]
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
        if not self._dataset.clouds:
            return {}
        folder = self._dataset.base / "velodyne" / self.name
        return {int(path.stem): path for path in folder.glob("*.bin") if path.stem.isdigit()}

    @cached_property
    def has_clouds(self) -> bool:
        """Whether any frame has a point cloud."""
        return bool(self._scans)

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order, also those without detections."""
        self._dataset.need_detector()
        count = len(self)
        files = [
            read_detections(folder / f"{self.name}.txt", count, _TYPE_CODES.get(label))
            for label, folder in self._folders.items()
        ]
        label = np.repeat(np.arange(len(files)), [len(file["frame"]) for file in files])
        frame, bottom, hwl, rotation_y, score = (
            np.concatenate([file[name] for file in files]) for name in ("frame", "bottom", "hwl", "ry", "score")
        )
        order = np.argsort(frame, kind="stable")
        center, size, yaw = sensor_from_kitti(bottom, hwl, rotation_y)
        if not self._dataset.probability:
            # tanh does not overflow; the floor keeps hopeless scores inside (0, 1].
            score = np.maximum(0.5 * (1.0 + np.tanh(0.5 * score)), 1e-12)
        bounds = np.searchsorted(frame[order], np.arange(count + 1))
        for index, pose in enumerate(self.poses):
            rows: Ints = order[bounds[index] : bounds[index + 1]]
            columns = (label[rows], center[rows], size[rows], yaw[rows], score[rows])
            yield DetectionFrame(index, index * PERIOD_NS, pose, self.labels, *columns, cloud=self._cloud(index))

    def _cloud(self, index: int) -> Cloud | None:
        path = self._scans.get(index)
        if path is None:
            return None
        pose = pose_of(_AXES @ self._world_from_camera[index] @ self.calibration.rectified_from_velodyne)
        return Cloud(partial(read_scan, path), pose.translation, pose.quaternion)

    def truth(self) -> Truth | None:
        """Return the annotations in the world frame; None where the sequence has no label file."""
        path = self._dataset.text("label_02", self.name)
        if not path.exists():
            return None
        file = read_labels(path, len(self))
        kept = file["type"] != "DontCare"
        boxes = {name: column[kept] for name, column in file.items()}
        frame, types, occlusion, truncation = (boxes[name] for name in ("frame", "type", "occluded", "truncated"))
        labels = tuple(sorted(set(types.tolist())))
        center, size, yaw = sensor_from_kitti(boxes["bottom"], boxes["hwl"], boxes["ry"])
        rotation, translation = stack_poses(self.poses)
        center, yaw = to_world(rotation[frame], translation[frame], center, yaw)
        return Truth.of(
            labels,
            frame,
            id=boxes["id"],
            label=np.searchsorted(labels, types).astype(np.int64) if labels else np.empty(0, dtype=np.int64),
            center=center,
            size=size,
            yaw=yaw,
            occlusion=occlusion,
            truncation=truncation,
            box2d=boxes["box2d"],
            ignored=(occlusion > _MAX_OCCLUSION) | (truncation > 0),
            regions=Regions(file["frame"][~kept], file["box2d"][~kept]),
        )


PROFILES: Final = {
    **dict.fromkeys(("pointrcnn", "pvrcnn", "casa"), "kitti"),
    "secondiou": "kitti-second-iou",
    "virconv": "kitti-virconv",
}
"""Tuned profiles by the detector's name."""


class KittiDataset(Dataset):
    """A KITTI tracking root, together with the results of a detector for tracking."""

    name = "kitti"

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
        self.root, self.base = root, base
        self.detector = _find_detector(root, base, detections)  # None where none is named and there is not just one
        self.clouds = clouds
        self.still = poses == "none"  # the sensor is taken to stand still; no poses are read
        self._submitted = None if submission is None else _thresholds(submission)
        self.notes: list[str] = (
            ["poses=none: the sensor is taken to stand still, and tracks are in its frame"] if poses else []
        )
        if self._submitted is not None:
            least = ", ".join(f"{name} {score:g}" for name, score in self._submitted.items())
            self.notes.append(f"submission: confirmed tracks from these mean scores on, in the image: {least}")
            if missing := sorted({path.stem for path in (base / "calib").glob("*.txt")} - set(self.present())):
                self.notes.append(f"submission: no detections, so no file, of {' '.join(missing)}")
        detected = set() if self.detector is None else {path.stem for path in self.detector.glob("*/*.txt")}
        if lacking := sorted(detected - set(self.present())):
            text = f"{len(lacking)} of {len(detected)} sequences with detections are left out, without a calib/SSSS.txt"
            self.notes.append(f"{base}: {text}: {' '.join(lacking)}")
        if self.detector is not None and self.profile == "auto":
            self.notes.append(f"{self.detector}: not the name of a known detector: its profile is auto")

    @cached_property
    def profile(self) -> str:
        """The profile that was tuned with the detector of this name, else `auto`."""
        return "auto" if self.detector is None else profile_named(self.detector.name, PROFILES)

    @cached_property
    def probability(self) -> bool:
        """Whether the scores of the detector are probabilities already, not logits: all lie in (0, 1]."""
        for path in sorted(self.need_detector().glob("*/*.txt")):
            for _, fields in read_rows(path, "a detection file"):
                try:
                    if not 0.0 < float(fields[6]) <= 1.0:
                        return False
                except (IndexError, ValueError):
                    continue  # the reader of the file names the place when the file is used
        return True

    def need_detector(self) -> Path:
        """Return the folder of the detector, which only tracking needs."""
        if self.detector is None:
            names = ", ".join(sorted(path.name for path in _detectors(self.root, self.base)))
            received = f"several: {names}" if names else "none"
            raise DatasetError(self.root, "the name of a detector, or just one in detections/", received)
        return self.detector

    def text(self, kind: str, sequence: str) -> Path:
        return self.base / kind / f"{sequence}.txt"

    def present(self) -> list[str]:
        """Return the sequences that have a calibration and, if a detector is named, detections."""
        calibrated = {path.stem for path in (self.base / "calib").glob("*.txt")}
        detected = None if self.detector is None else {path.stem for path in self.detector.glob("*/*.txt")}
        return sorted(calibrated if detected is None else calibrated & detected)

    def sequences(self, names: Sequence[str]) -> list[KittiSequence]:
        """Return the sequences of these names; `train` and `val` are the splits.

        `all` are the sequences that the detector has, or all where none is chosen.

        Raises:
            DatasetError: A named sequence is not there, or none is.
        """
        present = self.present()
        wanted: list[str] = []
        for name in names:
            wanted += present if name == "all" else SPLITS.get(name, (name,))
        missing = sorted(set(wanted) - set(present))
        if missing:
            needed = "calib" if self.detector is None else f"calib and detections ({self.detector})"
            received = f"none for {' '.join(missing)}; there are {' '.join(present) or 'none'}"
            raise DatasetError(self.base, f"{needed} of the sequences asked for", received)
        if not wanted:
            raise DatasetError(self.base, "at least one sequence", "none")
        return [KittiSequence(name, self) for name in dict.fromkeys(wanted)]

    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write `out/SSSS.txt`."""
        one = KittiSequence(sequence.name, self)
        return write_kitti_results(out / f"{one.name}.txt", one.camera, sequence.poses, tracks, self._submitted)


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


def read_scan(path: Path) -> Points:
    """Return the points (P, 3) of a velodyne file.

    Raises:
        DatasetError: The file cannot be read, or is no list of four 32-bit numbers per point.
    """
    return read_points(path, "a velodyne scan", 4)


def read_calibration(path: Path) -> KittiCalibration:
    """Return the calibration of a sequence.

    Names may end in a colon or not, and both spellings in use are known (`R0_rect` and `R_rect`, `Tr_velo_to_cam` and
    `Tr_velo_cam`, `Tr_imu_to_velo` and `Tr_imu_velo`). Other lines are ignored.

    Raises:
        DatasetError: The file cannot be read, or lacks P2, R0_rect or Tr_velo_to_cam, or a matrix is not one.
    """
    found: dict[str, Floats] = {}
    for line, fields in read_rows(path, "a calibration file"):
        if fields[0].rstrip(":") in _MATRICES:
            name, shape = _MATRICES[fields[0].rstrip(":")]
            found[name] = numbers(path, [(line, fields[1:])], shape[0] * shape[1], name).reshape(shape)
    for name in ("P2", "R0_rect", "Tr_velo_to_cam"):
        if name not in found:
            raise DatasetError(path, f"a line {name}", "a file without it")
    rectified = np.eye(4)
    rectified[:3, :3] = found["R0_rect"]
    imu = _homogeneous(found["Tr_imu_to_velo"]) if "Tr_imu_to_velo" in found else None
    return KittiCalibration(path, found["P2"], rectified @ _homogeneous(found["Tr_velo_to_cam"]), imu)


def _homogeneous(matrix: Floats) -> Floats:
    """Return a (3, 4) matrix, or (F, 3, 4) matrices, with the row 0 0 0 1."""
    whole = np.zeros((*matrix.shape[:-2], 4, 4))
    whole[..., :3, :] = matrix
    whole[..., 3, 3] = 1.0
    return whole


def read_poses(path: Path) -> Floats:
    """Return the poses (F, 4, 4) world <- rectified camera of a pose file.

    Raises:
        DatasetError: A line has not 12 numbers, or its rotation is none.
    """
    rows = read_rows(path, "a pose file")
    matrices = numbers(path, rows, 12, "a 3x4 pose, row by row").reshape(-1, 3, 4)
    rotation = matrices[:, :, :3]
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = np.flatnonzero((error > _ROTATION_ERROR) | (np.linalg.det(rotation) < 0))
    if len(bad):
        raise DatasetError(path, "a rotation in the first three columns", "another matrix", line=rows[bad[0]][0])
    return _homogeneous(matrices)


def read_oxts(path: Path, calibration: KittiCalibration) -> Floats:
    """Return the poses (F, 4, 4) world <- rectified camera from GPS/IMU packets; the world is camera frame 0.

    Position is the mercator projection of latitude and longitude, with the scale of the first latitude, and the
    altitude; the rotation is Rz(yaw) Ry(pitch) Rx(roll), as in KITTI's development kit.

    Raises:
        DatasetError: A line has not 30 numbers, or the calibration lacks the place of the IMU.
    """
    if calibration.velodyne_from_imu is None:
        raise DatasetError(calibration.path, "a line Tr_imu_to_velo, to use oxts", "a file without it")
    packet = numbers(path, read_rows(path, "an oxts file"), 30, "an oxts packet")
    if not len(packet):
        return np.empty((0, 4, 4))
    latitude, longitude, altitude, roll, pitch, yaw = packet[:, :6].T
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS_M
    world_from_imu = np.zeros((len(packet), 4, 4))
    world_from_imu[:, :3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    world_from_imu[:, 0, 3] = scale * np.radians(longitude)
    world_from_imu[:, 1, 3] = scale * np.log(np.tan(np.pi * (90.0 + latitude) / 360.0))
    world_from_imu[:, 2, 3] = altitude
    world_from_imu[:, 3, 3] = 1.0
    camera_from_imu = calibration.rectified_from_velodyne @ calibration.velodyne_from_imu
    relative = np.linalg.inv(world_from_imu[0]) @ world_from_imu
    return np.asarray(camera_from_imu @ relative @ np.linalg.inv(camera_from_imu), dtype=np.float64)


def _turn(axis: int, angle: Floats) -> Floats:
    """Return the rotations (F, 3, 3) about a coordinate axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.zeros((len(angle), 3, 3))
    rotation[:, axis, axis] = 1.0
    rotation[:, first, first] = rotation[:, second, second] = np.cos(angle)
    rotation[:, second, first] = np.sin(angle)
    rotation[:, first, second] = -np.sin(angle)
    return rotation


def read_labels(path: Path, frames: int) -> Columns:
    """Return the annotations of a sequence of `frames` frames, ordered by frame, as `read_detections` does.

    Raises:
        DatasetError: A line has not 17 fields, a field is no number, or a frame lies outside the sequence.
    """
    rows = read_rows(path, "a label file")
    count = len(_LABEL.split())
    for line, fields in rows:
        if len(fields) != count:
            raise DatasetError(path, f"{count} fields ({_LABEL})", f"{len(fields)} fields", line=line)
    values = numbers(path, [(line, [*fields[:2], *fields[3:]]) for line, fields in rows], count - 1, _LABEL)
    _check_frames(path, [line for line, _ in rows], values[:, 0], frames)
    order = np.argsort(values[:, 0], kind="stable")
    types = np.array([rows[i][1][2] for i in order], dtype=np.str_)
    return _columns(_LABEL.replace(" type", ""), values[order]) | {"type": types}


def read_detections(path: Path, frames: int, type_code: int | None) -> Columns:
    """Return the detections of a sequence of `frames` frames, ordered by frame.

    Columns are named as the fields of the file; `box2d` (R, 4), `hwl` (R, 3) and `bottom` (R, 3) are several of them.
    Boxes are in the rectified camera frame, scores are logits or probabilities.

    Args:
        path: The file.
        frames: Length of the sequence.
        type_code: Value of the type column; None accepts anything.

    Raises:
        DatasetError: A line has not 15 numbers, a frame lies outside the sequence, a size is not positive, or the type
            is another one.
    """
    rows = read_rows(path, "a detection file")
    values = numbers(path, rows, len(_DETECTION.split()), _DETECTION)
    lines = [line for line, _ in rows]
    _check_frames(path, lines, values[:, 0], frames)
    bad = np.flatnonzero((values[:, 7:10] <= 0).any(axis=1))
    if len(bad):
        raise DatasetError(path, "h w l greater than 0", str(values[bad[0], 7:10].tolist()), line=lines[bad[0]])
    bad = np.flatnonzero(values[:, 1] != (values[:, 1] if type_code is None else type_code))
    if len(bad):
        raise DatasetError(path, f"type {type_code}", f"type {values[bad[0], 1]:g}", line=lines[bad[0]])
    return _columns(_DETECTION, values[np.argsort(values[:, 0], kind="stable")])


def _columns(names: str, values: Floats) -> Columns:
    found = dict(zip(names.split(), values.T, strict=True))
    whole = {name: found[name].astype(np.int64) for name in _WHOLE if name in found}
    parts = {name: np.column_stack([found[one] for one in fields.split()]) for name, fields in _PARTS.items()}
    return found | whole | parts


def _check_frames(path: Path, lines: list[int], frame: Floats, frames: int) -> None:
    bad = np.flatnonzero((frame != np.floor(frame)) | (frame < 0) | (frame >= frames))
    if len(bad):
        raise DatasetError(path, f"a frame from 0 to {frames - 1}", f"{frame[bad[0]]:g}", line=lines[bad[0]])

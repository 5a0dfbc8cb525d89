"""The text files of the KITTI tracking benchmark, as numbers and with nothing interpreted.

Conventions: everything as in the files: the rectified camera frame (x right, y down, z forward), metres, radians,
pixels.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optipmb_client.files import DatasetError, numbers, read_rows
from optipmb_client.geometry import Floats, Ints

EARTH_RADIUS_M = 6_378_137.0  # of the mercator projection that KITTI's development kit uses

_POSE_FIELDS = 12
_ROTATION_ERROR = 1e-3  # far more than the rounding of the text, far less than a matrix that is no rotation
_OXTS_FIELDS = 30
_DETECTION = "frame type x1 y1 x2 y2 score h w l x y z ry alpha"
_DETECTION_FIELDS = 15
_LABEL = "frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z ry"
_LABEL_FIELDS = 17
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
class Calibration:
    """The matrices of one calibration file."""

    path: Path
    projection: Floats  # P2: (3, 4) image of camera 2 <- rectified camera 0
    rectified_from_velodyne: Floats  # (4, 4)
    velodyne_from_imu: Floats | None  # (4, 4); None where the file has none


def read_calibration(path: Path) -> Calibration:
    """Return the calibration of a sequence.

    Names may end in a colon or not, and both spellings in use are known (`R0_rect` and `R_rect`, `Tr_velo_to_cam` and
    `Tr_velo_cam`, `Tr_imu_to_velo` and `Tr_imu_velo`). Other lines are passed over.

    Raises:
        DatasetError: the file cannot be read, or lacks P2, R0_rect or Tr_velo_to_cam, or a matrix is not one.
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
    imu = found.get("Tr_imu_to_velo")
    return Calibration(
        path, found["P2"], rectified @ homogeneous(found["Tr_velo_to_cam"]), None if imu is None else homogeneous(imu)
    )


def homogeneous(matrix: Floats) -> Floats:
    """Return a (3, 4) matrix, or (F, 3, 4) matrices, with the row 0 0 0 1."""
    whole = np.zeros((*matrix.shape[:-2], 4, 4))
    whole[..., :3, :] = matrix
    whole[..., 3, 3] = 1.0
    return whole


def read_poses(path: Path) -> Floats:
    """Return the poses (F, 4, 4) world <- rectified camera of a pose file.

    Raises:
        DatasetError: a line has not 12 numbers, or its rotation is none.
    """
    rows = read_rows(path, "a pose file")
    matrices = numbers(path, rows, _POSE_FIELDS, "a 3x4 pose, row by row").reshape(-1, 3, 4)
    rotation = matrices[:, :, :3]
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = np.flatnonzero((error > _ROTATION_ERROR) | (np.linalg.det(rotation) < 0))
    if len(bad):
        raise DatasetError(path, "a rotation in the first three columns", "another matrix", line=rows[bad[0]][0])
    return homogeneous(matrices)


def read_oxts(path: Path, calibration: Calibration) -> Floats:
    """Return the poses (F, 4, 4) world <- rectified camera from GPS/IMU packets; the world is camera frame 0.

    Position is the mercator projection of latitude and longitude, with the scale of the first latitude, and the
    altitude; the rotation is Rz(yaw) Ry(pitch) Rx(roll), as in KITTI's development kit.

    Raises:
        DatasetError: a line has not 30 numbers, or the calibration lacks the place of the IMU.
    """
    if calibration.velodyne_from_imu is None:
        raise DatasetError(calibration.path, "a line Tr_imu_to_velo, to use oxts", "a file without it")
    packet = numbers(path, read_rows(path, "an oxts file"), _OXTS_FIELDS, "an oxts packet")
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


@dataclass(frozen=True)
class LabelFile:
    """The rows of a label file, ordered by frame."""

    frame: Ints
    id: Ints
    type: tuple[str, ...]
    truncation: Ints
    occlusion: Ints
    alpha: Floats
    box2d: Floats  # (R, 4)
    hwl: Floats  # (R, 3)
    bottom: Floats  # (R, 3)
    rotation_y: Floats


def read_labels(path: Path, frames: int) -> LabelFile:
    """Return the annotations of a sequence of `frames` frames.

    Raises:
        DatasetError: a line has not 17 fields, a field is no number, or a frame lies outside the sequence.
    """
    rows = read_rows(path, "a label file")
    for line, fields in rows:
        if len(fields) != _LABEL_FIELDS:
            raise DatasetError(path, f"{_LABEL_FIELDS} fields ({_LABEL})", f"{len(fields)} fields", line=line)
    values = numbers(path, [(line, [*fields[:2], *fields[3:]]) for line, fields in rows], _LABEL_FIELDS - 1, _LABEL)
    _check_frames(path, [line for line, _ in rows], values[:, 0], frames)
    order = np.argsort(values[:, 0], kind="stable")
    values = values[order]
    return LabelFile(
        frame=values[:, 0].astype(np.int64),
        id=values[:, 1].astype(np.int64),
        type=tuple(rows[i][1][2] for i in order),
        truncation=values[:, 2].astype(np.int64),
        occlusion=values[:, 3].astype(np.int64),
        alpha=values[:, 4],
        box2d=values[:, 5:9],
        hwl=values[:, 9:12],
        bottom=values[:, 12:15],
        rotation_y=values[:, 15],
    )


@dataclass(frozen=True)
class DetectionFile:
    """The rows of a detection file of one class, ordered by frame."""

    frame: Ints
    type: Ints
    box2d: Floats  # (R, 4)
    score: Floats  # (R,) as the detector gave it: a logit or a probability
    hwl: Floats  # (R, 3)
    bottom: Floats  # (R, 3)
    rotation_y: Floats
    alpha: Floats


def read_detections(path: Path, frames: int, type_code: int | None) -> DetectionFile:
    """Return the detections of a sequence of `frames` frames.

    Args:
        path: the file.
        frames: the length of the sequence.
        type_code: what the type column must hold; None accepts anything.

    Raises:
        DatasetError: a line has not 15 numbers, a frame lies outside the sequence, a size is not positive, or the type
        is
            another one.
    """
    rows = read_rows(path, "a detection file", ",")
    values = numbers(path, rows, _DETECTION_FIELDS, _DETECTION)
    lines = [line for line, _ in rows]
    _check_frames(path, lines, values[:, 0], frames)
    bad = np.flatnonzero((values[:, 7:10] <= 0).any(axis=1))
    if len(bad):
        raise DatasetError(path, "h w l greater than 0", str(values[bad[0], 7:10].tolist()), line=lines[bad[0]])
    bad = np.flatnonzero(values[:, 1] != (values[:, 1] if type_code is None else type_code))
    if len(bad):
        raise DatasetError(path, f"type {type_code}", f"type {values[bad[0], 1]:g}", line=lines[bad[0]])
    values = values[np.argsort(values[:, 0], kind="stable")]
    return DetectionFile(
        frame=values[:, 0].astype(np.int64),
        type=values[:, 1].astype(np.int64),
        box2d=values[:, 2:6],
        score=values[:, 6],
        hwl=values[:, 7:10],
        bottom=values[:, 10:13],
        rotation_y=values[:, 13],
        alpha=values[:, 14],
    )


def _check_frames(path: Path, lines: list[int], frame: Floats, frames: int) -> None:
    bad = np.flatnonzero((frame != np.floor(frame)) | (frame < 0) | (frame >= frames))
    if len(bad):
        raise DatasetError(path, f"a frame from 0 to {frames - 1}", f"{frame[bad[0]]:g}", line=lines[bad[0]])

"""Poses, headings and boxes.

Conventions: right-handed frames with z up, metres, radians. A yaw is counter-clockwise from the x axis and lies in
[-pi, pi). A quaternion is w, x, y, z. A pose maps sensor coordinates to world coordinates. A box is given by its
geometric centre, its size (length along the heading, width, height) and its yaw; it stands upright on the xy plane.

A heading is carried between two tilted frames by its projection: the world yaw is the direction of the rotated heading
vector seen from above. The way back solves for the sensor heading whose projection is that yaw, so that a round trip
gives the same yaw again for any tilt.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from optipmb_schemas import Detections

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]

_CORNER_SIGNS = np.array(
    [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]],
    dtype=np.float64,
)


class PoseLike(Protocol):
    """Anything with the two parts of a pose."""

    @property
    def translation(self) -> Floats:
        """(3,) metres."""

    @property
    def quaternion(self) -> Floats:
        """(4,) w x y z."""


class Pose(NamedTuple):
    """World from sensor: x_world = R(quaternion) x_sensor + translation."""

    translation: Floats  # (3,) metres
    quaternion: Floats  # (4,) w x y z, unit length, w >= 0


def wrap_angle(angle: Floats) -> Floats:
    """Return the same directions in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi, dtype=np.float64)


def rotation_of(quaternion: Floats) -> Floats:
    """Return the (3, 3) rotation matrix of a quaternion (4,) of any length."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: Floats) -> Floats:
    """Return the unit quaternion (4,), w >= 0, of the rotation nearest to a (3, 3) matrix.

    The quaternion is the eigenvector of the largest eigenvalue of the matrix K of Bar-Itzhack (2000), which needs no
    case distinction and also repairs the rounding of matrices that were written as text.
    """
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    quaternion = np.linalg.eigh(k)[1][:, -1]
    return np.asarray(-quaternion if quaternion[0] < 0 else quaternion, dtype=np.float64)


def pose_of(matrix: Floats) -> Pose:
    """Return the pose of a (3, 4) or (4, 4) matrix world <- sensor."""
    return Pose(np.array(matrix[:3, 3], dtype=np.float64), quaternion_of(matrix[:3, :3]))


def planar_pose(x: float, y: float, z: float, yaw: float) -> Pose:
    """Return the pose of a sensor that stands level at a place with a yaw."""
    return pose_of(
        np.array([[np.cos(yaw), -np.sin(yaw), 0, x], [np.sin(yaw), np.cos(yaw), 0, y], [0, 0, 1, z]], dtype=np.float64)
    )


def stack_poses(poses: Sequence[PoseLike]) -> tuple[Floats, Floats]:
    """Return the rotations (F, 3, 3) and translations (F, 3) of F poses."""
    if not poses:
        return np.empty((0, 3, 3)), np.empty((0, 3))
    return (
        np.stack([rotation_of(np.asarray(pose.quaternion)) for pose in poses]),
        np.stack([np.asarray(pose.translation, dtype=np.float64) for pose in poses]),
    )


def to_world(rotation: Floats, translation: Floats, center: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Carry boxes from the sensor frame to the world.

    Args:
        rotation: (3, 3), or (N, 3, 3) with one pose per box; world <- sensor.
        translation: (3,) or (N, 3).
        center: (N, 3) in the sensor frame.
        yaw: (N,) in the sensor frame.

    Returns:
        Centres (N, 3) and yaws (N,) in the world frame.
    """
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    forward = np.einsum("...ij,...j->...i", rotation, heading)
    flat = np.isnan(center[..., 2])  # of unknown height: at the sensor's
    moved = np.einsum("...ij,...j->...i", rotation, np.nan_to_num(center) if flat.any() else center) + translation
    moved[flat, 2] = np.nan
    return moved, wrap_angle(np.arctan2(forward[..., 1], forward[..., 0]))


def box_columns(detections: "Detections") -> tuple[Floats, Floats]:
    """Return sizes (M, 3) and yaws (M,) of detections, of NaN where the message has none."""
    count = len(detections.label)
    size = np.full((count, 3), np.nan) if detections.size is None else detections.size
    return size, np.full(count, np.nan) if detections.yaw is None else detections.yaw


def shown_boxes(detections: "Detections") -> tuple[Floats, Floats]:
    """Return sizes and yaws as pictures have them: half a metre where a length is unknown, 0 where a heading is."""
    size, yaw = box_columns(detections)
    return np.nan_to_num(size, nan=0.5), np.nan_to_num(yaw)


def to_sensor(rotation: Floats, translation: Floats, center: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Carry boxes from the world to the sensor frame: the inverse of `to_world`, with the same shapes."""
    flat = np.isnan(center[..., 2])
    away = center - translation
    moved = np.einsum("...ji,...j->...i", rotation, np.nan_to_num(away) if flat.any() else away)
    moved[flat, 2] = np.nan
    # The heading (c, s, 0) of the sensor frame is seen from above along A (c, s) with A the upper left block of R. The
    # adjugate of A gives the direction of its inverse; its sign is the sign of det A, positive while the sensor stands
    # upright.
    a, b = rotation[..., 0, 0], rotation[..., 0, 1]
    c, d = rotation[..., 1, 0], rotation[..., 1, 1]
    sign = np.where(a * d - b * c < 0, -1.0, 1.0)
    x = sign * (d * np.cos(yaw) - b * np.sin(yaw))
    y = sign * (a * np.sin(yaw) - c * np.cos(yaw))
    return moved, wrap_angle(np.arctan2(y, x))


def box_corners(center: Floats, size: Floats, yaw: Floats) -> Floats:
    """Return the corners (N, 8, 3) of N boxes.

    First the bottom: front left, front right, rear right, rear left; then the top in the same order.
    """
    offset = 0.5 * size[:, None, :] * _CORNER_SIGNS[None]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    corners = np.empty_like(offset)
    corners[..., 0] = center[:, None, 0] + cos * offset[..., 0] - sin * offset[..., 1]
    corners[..., 1] = center[:, None, 1] + sin * offset[..., 0] + cos * offset[..., 1]
    corners[..., 2] = center[:, None, 2] + offset[..., 2]
    return corners

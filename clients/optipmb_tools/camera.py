"""The rectified camera frame of KITTI and the z-up sensor frame that stands for it.

Conventions. The camera frame has x right, y down, z forward. The sensor frame is the same frame with its axes
renamed: x_sensor = z_camera (forward), y_sensor = -x_camera (left), z_sensor = -y_camera (up). KITTI gives a box by the
centre of its bottom and by rotation_y = ry about the camera's y axis, with ry = 0 along x_camera; in the sensor frame
its yaw is -ry - pi/2. The alpha angle is ry - atan2(x, z). Pixels: x right, y down.
"""

from dataclasses import dataclass, field

import numpy as np

from optipmb_tools.geometry import Bools, Floats, box_corners, wrap_angle

SENSOR_FROM_CAMERA: Floats = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=np.float64)
"""The relabelling of axes; orthogonal, so its transpose goes back."""

KITTI_IMAGE = (1242.0, 375.0)  # width and height of most images of the KITTI tracking benchmark, in pixels

_NEAR = 0.1  # depth in metres in front of which nothing is projected

_EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])


def sensor_from_kitti(bottom: Floats, hwl: Floats, rotation_y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return centre (N, 3), size (N, 3) and yaw (N,) in the sensor frame.

    Args:
        bottom: (N, 3) centre of the bottom, camera frame.
        hwl: (N, 3) height, width, length.
        rotation_y: (N,).
    """
    center = bottom @ SENSOR_FROM_CAMERA.T
    center[:, 2] += 0.5 * hwl[:, 0]
    return center, np.ascontiguousarray(hwl[:, ::-1]), wrap_angle(-rotation_y - 0.5 * np.pi)


def kitti_from_sensor(center: Floats, size: Floats, yaw: Floats) -> tuple[Floats, Floats, Floats]:
    """Return bottom (N, 3), hwl (N, 3) and rotation_y (N,): the inverse of `sensor_from_kitti`."""
    low = center.copy()
    low[:, 2] -= 0.5 * size[:, 2]
    return low @ SENSOR_FROM_CAMERA, np.ascontiguousarray(size[:, ::-1]), wrap_angle(-yaw - 0.5 * np.pi)


def alpha_of(bottom: Floats, rotation_y: Floats) -> Floats:
    """Return the observation angle alpha (N,) of boxes in the camera frame."""
    return wrap_angle(rotation_y - np.arctan2(bottom[:, 0], bottom[:, 2]))


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: `projection` (3, 4) takes the rectified camera frame to homogeneous pixels."""

    projection: Floats = field(repr=False)
    width: float = KITTI_IMAGE[0]
    height: float = KITTI_IMAGE[1]

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Return pixels (..., 2) and depths (...) of camera frame points (..., 3); pixels count at depth > 0."""
        homogeneous = points @ self.projection[:, :3].T + self.projection[:, 3]
        depth = homogeneous[..., 2]
        return homogeneous[..., :2] / np.where(depth == 0.0, 1.0, depth)[..., None], depth

    def boxes(self, center: Floats, size: Floats, yaw: Floats, least_shown: float = 0.0) -> tuple[Floats, Bools]:
        """Return the image boxes of 3D boxes given in the sensor frame.

        The image box is the smallest that holds the part of the 3D box in front of the camera, clipped to the image.

        Args:
            center: (N, 3)
            size: (N, 3)
            yaw: (N,)
            least_shown: part of the projected box that must lie in the image for the image to show it.

        Returns:
            (N, 4) x1 y1 x2 y2 in pixels, and (N,) whether the image shows it. Others (behind the camera, outside
            its view) get 0 0 0 0: a box without height, which the KITTI evaluation leaves out of account.
        """
        corners = box_corners(center, size, yaw) @ SENSOR_FROM_CAMERA  # (N, 8, 3), camera frame
        start, stop = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
        # Each edge is cut at the near plane; an edge wholly behind it is left out below.
        rise = stop[..., 2] - start[..., 2]
        cut = (_NEAR - start[..., 2]) / np.where(rise == 0, 1.0, rise)
        low = np.where(start[..., 2] < _NEAR, cut, 0.0)
        high = np.where(stop[..., 2] < _NEAR, cut, 1.0)
        ahead = (start[..., 2] >= _NEAR) | (stop[..., 2] >= _NEAR)
        ends = np.stack([start + low[..., None] * (stop - start), start + high[..., None] * (stop - start)], axis=2)
        pixels, _ = self.project(ends)
        shown = np.broadcast_to(ahead[..., None, None], pixels.shape)
        least = np.where(shown, pixels, np.inf).min(axis=(1, 2))
        most = np.where(shown, pixels, -np.inf).max(axis=(1, 2))
        limit = np.array([self.width - 1.0, self.height - 1.0])
        seen = np.asarray((least < limit).all(axis=1) & (most > 0.0).all(axis=1) & ahead.any(axis=1), dtype=np.bool_)
        boxes = np.concatenate([np.clip(least, 0.0, limit), np.clip(most, 0.0, limit)], axis=1)
        with np.errstate(invalid="ignore"):  # unseen boxes have infinite bounds
            whole = np.prod(most - least, axis=1)
        seen &= np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) >= least_shown * np.where(seen, whole, 0.0)
        return np.where(seen[:, None], boxes, 0.0), seen


def synthetic_camera() -> Camera:
    """Return a camera like KITTI's in the sensor's own place, looking along its x axis; generated scenes use it."""
    return Camera(np.array([[720.0, 0.0, 621.0, 0.0], [0.0, 720.0, 187.5, 0.0], [0.0, 0.0, 1.0, 0.0]]))

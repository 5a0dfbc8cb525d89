"""Poses, headings and boxes of the client."""

import numpy as np
import pytest
from boxes import points_in_box
from hypothesis import given
from hypothesis import strategies as st
from optipmb_tools.camera import Camera, kitti_from_sensor, sensor_from_kitti, synthetic_camera
from optipmb_tools.geometry import (
    box_corners,
    planar_pose,
    quaternion_of,
    rotation_of,
    stack_poses,
    to_sensor,
    to_world,
    wrap_angle,
)

ANGLES = st.floats(-np.pi, np.pi)
TILTS = st.floats(-0.6, 0.6)


def tilted(yaw: float, pitch: float, roll: float) -> np.ndarray:
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


@given(ANGLES, ANGLES, ANGLES)
def test_a_rotation_survives_its_quaternion(yaw: float, pitch: float, roll: float) -> None:
    """Matrix to quaternion and back is the same matrix, and the quaternion has length 1 and w >= 0."""
    rotation = tilted(yaw, pitch, roll)
    quaternion = quaternion_of(rotation)
    np.testing.assert_allclose(rotation_of(quaternion), rotation, atol=1e-12)
    assert quaternion[0] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)


@given(ANGLES, TILTS, TILTS, ANGLES)
def test_boxes_survive_the_way_to_the_world_and_back(yaw: float, pitch: float, roll: float, heading: float) -> None:
    """Sensor to world to sensor gives the same centre and yaw to 1e-9, also under a tilt of 30 degrees."""
    rotation, translation = tilted(yaw, pitch, roll), np.array([310.0, -20.0, 3.0])
    center, heads = np.array([[12.0, -3.0, 0.5]]), np.array([heading])
    back, turned = to_sensor(rotation, translation, *to_world(rotation, translation, center, heads))
    np.testing.assert_allclose(back, center, atol=1e-9)
    assert abs(wrap_angle(turned - heads))[0] < 1e-9


def test_one_pose_per_box_is_the_same_as_one_after_the_other() -> None:
    """Stacked poses carry each box by its own pose."""
    rng = np.random.default_rng(1)
    poses = [planar_pose(*rng.normal(size=3), float(rng.uniform(-3, 3))) for _ in range(5)]
    center, yaw = rng.normal(size=(5, 3)), rng.uniform(-3, 3, 5)
    together = to_world(*stack_poses(poses), center, yaw)
    for i, pose in enumerate(poses):
        single = to_world(rotation_of(pose.quaternion), pose.translation, center[i : i + 1], yaw[i : i + 1])
        np.testing.assert_allclose(together[0][i], single[0][0], atol=1e-12)
        assert together[1][i] == pytest.approx(single[1][0], abs=1e-12)


def test_a_heading_east_seen_from_a_sensor_that_looks_north_points_right() -> None:
    """A box at 10 m north with yaw 0 is, for a sensor that looks north, straight ahead and turned by -90 degrees."""
    pose = planar_pose(0.0, 0.0, 0.0, 0.5 * np.pi)
    center, yaw = to_sensor(
        rotation_of(pose.quaternion), pose.translation, np.array([[0.0, 10.0, 0.0]]), np.array([0.0])
    )
    np.testing.assert_allclose(center, [[10.0, 0.0, 0.0]], atol=1e-12)
    assert yaw[0] == pytest.approx(-0.5 * np.pi)


def test_corners_are_in_their_box_and_just_outside_a_smaller_one() -> None:
    """All eight corners are in the box with a hair's margin and none without it when it shrinks."""
    center, size, yaw = np.array([[3.0, 4.0, 1.0]]), np.array([[4.0, 2.0, 1.5]]), np.array([0.7])
    corners = box_corners(center, size, yaw)[0]
    assert points_in_box(corners, center[0], size[0] + 2e-9, 0.7).all()
    assert not points_in_box(corners, center[0], size[0] - 2e-3, 0.7).any()
    front = 0.5 * (corners[0] + corners[1])
    np.testing.assert_allclose(front[:2], center[0, :2] + 2.0 * np.array([np.cos(0.7), np.sin(0.7)]), atol=1e-12)


@given(st.floats(-50, 50), st.floats(-5, 5), st.floats(-50, 80), ANGLES)
def test_boxes_survive_the_way_through_the_camera_frame(x: float, y: float, z: float, rotation_y: float) -> None:
    """KITTI box to the z-up sensor frame and back is the same box."""
    bottom, hwl = np.array([[x, y, z]]), np.array([[1.5, 1.6, 4.0]])
    again = kitti_from_sensor(*sensor_from_kitti(bottom, hwl, np.array([rotation_y])))
    np.testing.assert_allclose(again[0], bottom, atol=1e-12)
    np.testing.assert_allclose(again[1], hwl)
    assert abs(wrap_angle(again[2] - rotation_y))[0] < 1e-9


def test_the_z_up_frame_looks_forward() -> None:
    """A car ahead (z 20), right (x 3), its bottom 1.7 m below the camera, that drives away (ry = -pi/2) has yaw 0."""
    center, size, yaw = sensor_from_kitti(
        np.array([[3.0, 1.7, 20.0]]), np.array([[1.5, 1.6, 4.0]]), np.array([-0.5 * np.pi])
    )
    np.testing.assert_allclose(center, [[20.0, -3.0, -1.7 + 0.75]])
    np.testing.assert_allclose(size, [[4.0, 1.6, 1.5]])
    assert yaw[0] == pytest.approx(0.0, abs=1e-12)


def image_box(center: tuple[float, float, float], camera: Camera | None = None) -> tuple[np.ndarray, bool]:
    boxes, seen = (camera or synthetic_camera()).boxes(np.array([center]), np.full((1, 3), 2.0), np.zeros(1))
    return boxes[0], bool(seen[0])


def test_a_box_ahead_is_projected_by_its_near_face() -> None:
    """A cube 11 m ahead shows its face at 10 m: 720 * 2 / 10 pixels wide, in the middle of the image."""
    box, seen = image_box((11.0, 0.0, 0.0))
    assert seen
    np.testing.assert_allclose(box, [621 - 72, 187.5 - 72, 621 + 72, 187.5 + 72])


@pytest.mark.parametrize("center", [(-11.0, 0.0, 0.0), (11.0, 40.0, 0.0), (11.0, 0.0, 30.0)])
def test_a_box_that_no_image_shows_is_without_height(center: tuple[float, float, float]) -> None:
    """Behind the camera, outside its view and above it: 0 0 0 0."""
    box, seen = image_box(center)
    assert not seen
    np.testing.assert_array_equal(box, np.zeros(4))


def test_a_box_around_the_camera_fills_the_image() -> None:
    """Only the part in front of the camera counts, and it is clipped to the image."""
    box, seen = image_box((0.0, 0.0, 0.0))
    assert seen
    np.testing.assert_array_equal(box, [0.0, 0.0, 1241.0, 374.0])

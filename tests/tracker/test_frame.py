"""Making a frame: the change to world coordinates, classes, and the refusal of everything that is no frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from compare import density_bytes
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes import Options, scene

import optipmb
from optipmb.model.errors import FrameError
from optipmb.model.frame import MAX_COORDINATE, MAX_SPEED, MAX_YAW, _refuse, allowed

KITTI = optipmb.load_profile("kitti")


def columns(count: int = 2, **changes: Any) -> dict[str, Any]:
    """Valid arguments of `make_frame`, changed."""
    valid = {
        "stamp_ns": 5, "labels": ["Car", "Pedestrian"], "label": [0] * count, "center": np.zeros((count, 3)),
        "size": np.ones((count, 3)), "yaw": np.zeros(count), "score": np.full(count, 0.5),
    }  # fmt: skip
    return valid | changes


def changed(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    """A copy with one element replaced."""
    copy = array.copy()
    copy[index] = value
    return copy


BAD: dict[str, tuple[str, dict[str, Any]]] = {
    "stamp before the epoch": ("stamp_ns", {"stamp_ns": -1}),
    "stamp too large": ("stamp_ns", {"stamp_ns": 2**63}),
    "label out of range": ("label[1]", {"label": [0, 2]}),
    "label negative": ("label[0]", {"label": [-1, 0]}),
    "labels as floats": ("label", {"label": [0.0, 1.0]}),
    "labels in two dimensions": ("label", {"label": [[0, 1]]}),
    "center too short": ("center", {"center": np.zeros((1, 3))}),
    "center flat": ("center", {"center": np.zeros((2, 2))}),
    "center NaN": ("center[1][1]", {"center": changed(np.zeros((2, 3)), (1, 1), np.nan)}),
    "height infinite": ("center[1][2]", {"center": changed(np.zeros((2, 3)), (1, 2), np.inf)}),
    "center infinite": ("center[0][0]", {"center": changed(np.zeros((2, 3)), (0, 0), np.inf)}),
    "center beyond the Earth": ("center[0][0]", {"center": changed(np.zeros((2, 3)), (0, 0), 1e12)}),
    "center no numbers": ("center", {"center": [["a", "b", "c"]] * 2}),
    "center ragged": ("center", {"center": [[1, 2, 3], [1, 2]]}),
    "size zero": ("size[0][1]", {"size": changed(np.ones((2, 3)), (0, 1), 0.0)}),
    "size negative": ("size[1][0]", {"size": changed(np.ones((2, 3)), (1, 0), -1.0)}),
    "size infinite": ("size[1][0]", {"size": changed(np.ones((2, 3)), (1, 0), np.inf)}),
    "yaw infinite": ("yaw[1]", {"yaw": [0.0, np.inf]}),
    "yaw of wrong length": ("yaw", {"yaw": [0.0]}),
    "score below zero": ("score[1]", {"score": [0.5, -1e-9]}),
    "score above one": ("score[0]", {"score": [1.5, 0.5]}),
    "score a logit": ("score[0]", {"score": [-3.0, 0.5]}),
    "score NaN": ("score[0]", {"score": [np.nan, 0.5]}),
    "velocity of wrong shape": ("velocity", {"velocity": np.zeros((2, 3))}),
    "velocity no numbers": ("velocity", {"velocity": [["a", "b"], ["c", "d"]]}),
    "velocity ragged": ("velocity", {"velocity": [[1, 2], [1]]}),
    "label ragged": ("label", {"label": [[0], [0, 1]]}),
    "stamp in seconds": ("stamp_ns", {"stamp_ns": 1.5}),
    "velocity half known": ("velocity[1][0]", {"velocity": [[0, 0], [np.nan, 1.0]]}),
    "velocity infinite": ("velocity[0][1]", {"velocity": [[0, np.inf], [0, 0]]}),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_array_is_refused_by_its_path(name: str) -> None:
    """FrameError names the field and the element, and its text is one line."""
    path, changes = BAD[name]
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.make_frame(KITTI, **columns(**changes))
    assert caught.value.path == path
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(path)


@pytest.mark.parametrize(
    ("translation", "quaternion", "path"),
    [
        ([0, 0], [1, 0, 0, 0], "pose.translation"),
        ([0, 0, np.nan], [1, 0, 0, 0], "pose.translation[2]"),
        ([0, 0, 0], [1, 0, 0], "pose.quaternion"),
        ([0, 0, 0], [0, 0, 0, 0], "pose.quaternion"),
        ([0, 0, 0], [1, 1, 0, 0], "pose.quaternion"),
        ([0, 0, 0], [np.inf, 0, 0, 0], "pose.quaternion[0]"),
    ],
)
def test_a_bad_pose_is_refused(translation: list[float], quaternion: list[float], path: str) -> None:
    """Wrong shapes, values that are not finite, and quaternions far from unit length."""
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.Pose(translation=np.array(translation, dtype=float), quaternion=np.array(quaternion, dtype=float))
    assert caught.value.path == path


@pytest.mark.parametrize("xyz", [np.zeros((3, 4), np.float32), np.zeros(3, np.float32), np.zeros((3, 3))])
def test_a_bad_cloud_is_refused(xyz: np.ndarray) -> None:
    """A cloud is (P, 3) float32 and nothing else."""
    pose = optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0]))
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.PointCloud(xyz, pose)
    assert caught.value.path == "cloud.xyz"


def test_an_empty_frame_may_be_given_as_empty_lists() -> None:
    """No detections need no shaped arrays."""
    nothing: Any = []
    arguments: dict[str, Any] = dict.fromkeys(("label", "center", "size", "yaw", "score", "velocity"), nothing)
    frame, ignored = optipmb.make_frame(KITTI, stamp_ns=0, labels=[], **arguments)
    assert ignored == 0
    shapes = frame.center.shape, frame.size.shape, frame.yaw.shape, frame.velocity.shape, frame.score.shape
    assert shapes == ((0, 3), (0, 3), (0,), (0, 2), (0,))


def test_other_classes_are_left_out_and_counted() -> None:
    """Labels become indices of the profile; foreign ones go; source points into the caller's arrays."""
    arguments = columns(4, labels=["Tram", "Cyclist", "Car"], label=[1, 0, 2, 0], score=[0.1, 0.2, 0.3, 0.4])
    frame, ignored = optipmb.make_frame(KITTI, **arguments)
    assert ignored == 2
    np.testing.assert_array_equal(frame.label, [KITTI.labels.index("Cyclist"), KITTI.labels.index("Car")])
    np.testing.assert_array_equal(frame.source, [0, 2])
    np.testing.assert_array_equal(frame.score, [0.1, 0.3])
    assert np.isnan(frame.velocity).all()


def test_names_that_mean_the_same_are_one_class() -> None:
    """A class is found by its own name, else by another name or spelling of it; what could be two is neither."""
    names = ("Car", "car", "Pedestrian", "Cyclist")
    labels = ("car", "Car", "vehicle.car", "CYCLIST", "bicycle", "human.pedestrian.adult", "dog", "")
    np.testing.assert_array_equal(optipmb.class_indices(labels, names), [1, 0, -1, 3, 3, 2, -1, -1])
    exact, _ = optipmb.make_frame(KITTI, **columns(2, labels=["Car", "Cyclist"], label=[0, 1]))
    alike, ignored = optipmb.make_frame(KITTI, **columns(2, labels=["vehicle.car", "bicycle"], label=[0, 1]))
    np.testing.assert_array_equal(alike.label, exact.label)
    assert ignored == 0


@given(seed=st.integers(0, 10_000))
@settings(deadline=None)
def test_a_pose_moves_the_detections_to_the_world(seed: int) -> None:
    """Centres as points, headings and velocities as vectors on the ground plane, of any pose of the sensor."""
    rng = np.random.default_rng(seed)
    quaternion = np.array([1.0, *rng.normal(0, 0.1, 2), rng.normal()])
    pose = optipmb.Pose(translation=rng.normal(0, 100, 3), quaternion=quaternion / np.linalg.norm(quaternion))
    center, yaw, velocity = rng.normal(0, 20, (5, 3)), rng.uniform(-6, 6, 5), rng.normal(0, 8, (5, 2))
    velocity[2] = np.nan
    frame, _ = optipmb.make_frame(KITTI, **columns(5, center=center, yaw=yaw, velocity=velocity, pose=pose))
    for i in range(5):
        np.testing.assert_allclose(frame.center[i], pose.rotation @ center[i] + pose.translation, atol=1e-9)
        heading = pose.rotation @ [math.cos(yaw[i]), math.sin(yaw[i]), 0.0]
        assert math.remainder(frame.yaw[i] - math.atan2(heading[1], heading[0]), 2 * math.pi) == pytest.approx(
            0, abs=1e-9
        )
        if i == 2:
            assert np.isnan(frame.velocity[i]).all()
        else:
            np.testing.assert_allclose(frame.velocity[i], (pose.rotation @ [*velocity[i], 0.0])[:2], atol=1e-9)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_rotation_is_that_of_its_quaternion(quaternion: list[float]) -> None:
    """Orthonormal, right-handed, and equal to v -> q v q*."""
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    rotation = optipmb.Pose(translation=np.zeros(3), quaternion=q).rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    w, u = q[0], q[1:]
    v = np.array([1.0, 2.0, 3.0])
    wanted = 2 * np.dot(u, v) * u + (w * w - np.dot(u, u)) * v + 2 * w * np.cross(u, v)
    np.testing.assert_allclose(rotation @ v, wanted, atol=1e-12)


def test_a_frame_does_not_share_the_callers_arrays() -> None:
    """Writing to the caller's arrays afterwards leaves the frame as it was."""
    arguments = columns(3, velocity=np.zeros((3, 2)))
    frame, _ = optipmb.make_frame(KITTI, **arguments)
    for name in ("center", "size", "yaw", "score", "velocity"):
        arguments[name] += 7
    assert frame.center.max() == frame.yaw.max() == frame.velocity.max() == 0
    assert frame.size.max() == 1


def test_a_pose_cannot_be_changed() -> None:
    """Frames share poses: they are read-only and copies of the caller's arrays."""
    translation, quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    pose = optipmb.Pose(translation, quaternion)
    translation[0], quaternion[:] = 1.0, [0.0, 1.0, 0.0, 0.0]
    for array in (pose.translation, pose.quaternion, pose.rotation):
        assert not array.flags.writeable
    np.testing.assert_array_equal(pose.translation, np.zeros(3))
    np.testing.assert_array_equal(pose.rotation, np.eye(3))


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_detections_does_not_matter_in_sensor_coordinates(seed: int) -> None:
    """Also where a pose is applied, shuffled detections give the same bytes."""
    rng = np.random.default_rng(seed)
    tracker = optipmb.Tracker(KITTI)
    one = other = tracker.initial()
    for given_frame in scene(seed, Options(labels=KITTI.labels, frames=40, clouds=0.0)):
        quaternion = np.array([1.0, *rng.normal(0, 0.05, 2), rng.normal()])
        pose = optipmb.Pose(translation=rng.normal(0, 50, 3), quaternion=quaternion / np.linalg.norm(quaternion))
        shuffled = given_frame.taken(rng.permutation(len(given_frame.score)))
        one = tracker.step(one, optipmb.make_frame(KITTI, pose=pose, **given_frame.columns())[0]).density
        other = tracker.step(other, optipmb.make_frame(KITTI, pose=pose, **shuffled.columns())[0]).density
        assert density_bytes(one) == density_bytes(other)


@settings(max_examples=30)
@given(yaw=st.lists(st.floats(-6.4, 6.4), min_size=2, max_size=2), sign=st.sampled_from([1.0, -1.0]))
def test_the_identity_moves_nothing(yaw: list[float], sign: float) -> None:
    """A frame under the pose that is the identity is the frame without one, to the last bit."""
    center = np.array([[-0.0, 1e-300, 0.1], [1e8, -1e8, 3.0]])
    given_columns = columns(yaw=yaw, center=center, velocity=np.full((2, 2), -0.0))
    identity = optipmb.Pose(np.zeros(3), np.array([sign, 0.0, 0.0, 0.0]))
    (plain, _), (posed, _) = (optipmb.make_frame(KITTI, **given_columns, pose=pose) for pose in (None, identity))
    for name in ("center", "size", "yaw", "velocity", "score", "label", "source"):
        assert getattr(plain, name).tobytes() == getattr(posed, name).tobytes()


COORDINATES = st.sampled_from(
    [0.0, -3.5, MAX_COORDINATE, -MAX_COORDINATE, np.nextafter(MAX_COORDINATE, np.inf), np.nan]
)
LENGTHS = st.sampled_from([1.0, 1e-300, MAX_COORDINATE, 0.0, -1.0, np.inf, np.nan])
SCORES = st.sampled_from([0.5, 1.0, 1e-300, 0.0, -0.5, np.nextafter(1.0, 2.0), np.nan])
SPEEDS = st.sampled_from([0.0, MAX_SPEED, -MAX_SPEED, np.nextafter(MAX_SPEED, np.inf), np.nan, -np.inf])


@settings(deadline=None)  # the first call compiles
@given(data=st.data(), count=st.integers(0, 3), worst=st.integers(0, 6))
def test_values_are_allowed_as_numpy_says(data: st.DataObject, count: int, worst: int) -> None:
    """Bounds, signs, NaN and half-known velocities; refused are exactly the values that are not allowed."""

    def drawn(place: int, shape: tuple[int, ...], values: st.SearchStrategy[float]) -> np.ndarray:
        return data.draw(arrays(np.float64, shape, elements=values)) if place == worst else np.full(shape, 0.5)

    label = data.draw(arrays(np.int64, count, elements=st.integers(-1, 3))) if worst == 0 else np.zeros(count, np.int64)
    center, size = drawn(1, (count, 3), COORDINATES), drawn(2, (count, 3), LENGTHS)
    yaw, score, velocity = drawn(3, (count,), COORDINATES), drawn(4, (count,), SCORES), drawn(5, (count, 2), SPEEDS)
    unknown = np.isnan(velocity).all(axis=1, keepdims=True)
    far = np.abs(np.where(np.isnan(center) & [False, False, True], 0.0, center))
    known_size, known_yaw = np.where(np.isnan(size), 1.0, size), np.where(np.isnan(yaw), 0.0, yaw)
    wanted = (
        bool(((label >= 0) & (label < 3)).all())
        and bool((far <= MAX_COORDINATE).all() and (np.abs(known_yaw) <= MAX_YAW).all())
        and bool(((known_size > 0) & (known_size <= MAX_COORDINATE)).all() and ((score > 0) & (score <= 1)).all())
        and bool(((np.abs(velocity) <= MAX_SPEED) | unknown).all())
    )
    assert allowed(label, 3, center, size, yaw, score, velocity) == wanted
    if wanted:
        _refuse(label, 3, center, size, yaw, score, velocity)
    else:
        with pytest.raises(FrameError):
            _refuse(label, 3, center, size, yaw, score, velocity)

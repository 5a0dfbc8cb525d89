"""A calibrated camera: places of boxes on the ground, their covariances, the field of view, and refusals."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
import pytest

import optipmb
from optipmb.cameras.camera_files import read_lens, read_pose

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

FORWARD: Final = [0.5, -0.5, 0.5, -0.5]
"""Quaternion of a camera that looks along x."""
LENSES: Final = {
    "none": [],
    "four": [-0.28, 0.07, 0.001, -0.0008],
    "five": [-0.28, 0.07, 0.001, -0.0008, 0.01],
    "rational": [0.3, -0.05, 0.0004, 0.0002, 0.002, 0.4, 0.02, 0.001],
}


def pinhole(*, down: float = 0.0, yaw: float = 0.0, lens: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """Give the calibration of a camera 6 m above the ground that looks along x, turned down and to the left."""
    rotation = turn_z(yaw) @ turn_y(down) @ matrix(FORWARD)
    place = {"position": (turn_z(yaw) @ [2.0, 1.0, 6.0]).tolist(), "quaternion": quaternion(rotation).tolist()}
    return {
        "image": [1920, 1080],
        "pinhole": {"intrinsics": [1050.0, 1040.0, 960.0, 540.0], **place, **(lens or {})},
        **more,
    }


def turn_z(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])


def turn_y(angle: float) -> Array:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1.0, 0], [-np.sin(angle), 0, np.cos(angle)]])


def matrix(q: Any) -> Array:
    return optipmb.Pose(np.zeros(3), np.asarray(q, np.float64)).rotation


def quaternion(rotation: Array) -> Array:
    """Give the quaternion w x y z of a rotation, by OpenCV's vector of Rodrigues."""
    vector = cv2.Rodrigues(rotation)[0].ravel().astype(np.float64)
    angle = float(np.linalg.norm(vector))
    return np.array([np.cos(0.5 * angle), *(np.sin(0.5 * angle) * vector / max(angle, 1e-12))])


def seen_by_opencv(document: dict[str, Any], points: Array) -> Array:
    """Give the pixels of points in the world, as OpenCV projects them."""
    one = document["pinhole"]
    rotation = matrix(one["quaternion"]).T
    camera = np.array(
        [[one["intrinsics"][0], 0, one["intrinsics"][2]], [0, one["intrinsics"][1], one["intrinsics"][3]], [0, 0, 1]]
    )
    moved = -rotation @ np.array(one["position"])
    terms = np.array(one.get("distortion", []), np.float64)
    vector = cv2.Rodrigues(rotation)[0]
    if one.get("model") == "fisheye":
        return np.asarray(cv2.fisheye.projectPoints(points[:, None], vector, moved, camera, terms)[0][:, 0])
    return np.asarray(cv2.projectPoints(points, vector, moved, camera, terms)[0][:, 0])


@pytest.mark.parametrize("terms", LENSES.values(), ids=LENSES)
def test_pixels_and_rays_are_those_of_opencv(terms: list[float]) -> None:
    """Points of the world are at OpenCV's pixels, and the pixels show the same places again."""
    document = pinhole(down=0.3, yaw=0.7, lens={"distortion": terms})
    camera = optipmb.GroundCamera.parse(document)
    random = np.random.default_rng(1)
    ground = np.column_stack([random.uniform(8, 60, 500), random.uniform(-15, 15, 500), np.zeros(500)]) @ turn_z(0.7).T
    pixels = seen_by_opencv(document, ground)
    np.testing.assert_allclose(camera.project(ground), pixels, atol=1e-6)
    shown = ((pixels >= 0.0) & (pixels <= camera.image)).all(axis=1)
    assert shown.sum() > 300
    np.testing.assert_allclose(camera.ground(pixels[shown]), ground[shown, :2], atol=1e-6)


def test_a_fisheye_is_that_of_opencv() -> None:
    """The fisheye model is OpenCV's, to angles beyond 60 degrees from the axis."""
    lens = {
        "model": "fisheye",
        "distortion": [0.02, -0.006, 0.001, -0.0002],
        "intrinsics": [500.0, 500.0, 960.0, 540.0],
    }
    document = pinhole(down=0.8, lens=lens)
    camera = optipmb.GroundCamera.parse(document)
    random = np.random.default_rng(2)
    ground = np.column_stack([random.uniform(0, 30, 500), random.uniform(-20, 20, 500), np.zeros(500)])
    pixels = seen_by_opencv(document, ground)
    np.testing.assert_allclose(camera.project(ground), pixels, atol=1e-6)
    np.testing.assert_allclose(camera.ground(pixels), ground[:, :2], atol=1e-6)


def test_ranges_and_covariances_of_a_level_camera() -> None:
    """A level camera has ranges H f / (v - cy), which a pixel changes by r^2 / (H f), by the formulas on paper."""
    errors = {"pixel": [1.5, 0.03], "tilt": 0.002, "height": 0.1}
    camera = optipmb.GroundCamera.parse(pinhole(error=errors))
    found = camera.detections([[900.0, 700.0, 1020.0, 780.0]], ["car"])  # 120 x 80 pixels, in the middle
    reach = 6.0 * 1040.0 / (780.0 - 540.0)
    seen = 120.0 * reach / 1050.0
    turn = np.arcsin(seen / np.hypot(4.5, 1.9)) - np.arctan2(1.9, 4.5)
    behind = 0.5 * (4.5 * np.cos(turn) + 1.9 * np.sin(turn))
    np.testing.assert_allclose(found["center"][0], [2.0 + reach + behind, 1.0, np.nan], atol=1e-6)
    var_v = 1.5**2 + (0.03 * 80.0) ** 2 + (1040.0 * 0.002) ** 2
    var_u = 1.5**2 + (0.03 * 120.0) ** 2
    along = var_v * (reach**2 / (6.0 * 1040.0)) ** 2 + (reach * 0.1 / 6.0) ** 2 + (0.15 * (4.5 - 1.9) + 0.1) ** 2
    across = var_u * (reach / 1050.0) ** 2 + (0.07 * 4.5) ** 2
    np.testing.assert_allclose(found["position_covariance"][0], np.diag([along, across, 1.0]), rtol=1e-4, atol=1e-9)


def test_the_height_of_a_box_gives_a_range_without_ground() -> None:
    """With `range = "height"` the range fits a box as high as its class; `both` weights the two."""
    high: dict[str, Any] = {"class": {"car": {"size": [4.5, 1.9, 1.6], "height_sd": 0.1}}}
    names = ("ground", "height", "both")
    cameras = {one: optipmb.GroundCamera.parse(pinhole(error={"range": one, "tilt": 0.01}, **high)) for one in names}
    box = [[930.0, 690.0, 990.0, 738.0]]
    found = {name: one.detections(box, ["car"]) for name, one in cameras.items()}
    reach = {name: one["center"][0, 0] - 2.0 for name, one in found.items()}
    assert reach["height"] == pytest.approx(1.6 / (48.0 / 1040.0) + 0.5 * 4.5, abs=0.3)
    assert min(reach["ground"], reach["height"]) < reach["both"] < max(reach["ground"], reach["height"])
    variance = {name: one["position_covariance"][0, 0, 0] - 0.49**2 for name, one in found.items()}
    assert 1.0 / variance["both"] == pytest.approx(1.0 / variance["ground"] + 1.0 / variance["height"], rel=1e-6)
    above = [[930.0, 500.0, 990.0, 541.0]]  # its foot is at the horizon
    assert cameras["ground"].detections(above, ["car"])["left_out"] == {"horizon": 1}
    assert len(cameras["both"].detections(above, ["car"])["row"]) == 1


def test_boxes_of_generated_objects_come_back() -> None:
    """Centres of generated objects come back, 93 to 99 % of them within the ellipse that promises 95 %."""
    random = np.random.default_rng(3)
    inside = []
    for _ in range(40):
        document = pinhole(
            down=random.uniform(0.15, 0.5),
            yaw=random.uniform(-3, 3),
            lens={"distortion": LENSES["five"] if random.random() < 0.5 else []},
            error={"pixel": [1.0, 0.02], "largest": 20.0},
        )
        camera = optipmb.GroundCamera.parse(document)
        view = camera.field_of_view
        assert view is not None
        assert view.pose is not None
        for _ in range(20):
            size = np.array([4.5, 1.9, 1.6]) * random.uniform(0.9, 1.1)
            reach, side = random.uniform(*view.range), random.uniform(*view.azimuth)
            center = view.pose.rotation @ [reach * np.cos(side), reach * np.sin(side), 0.0] + view.pose.translation
            corners = (np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0])).reshape(3, 8).T * size) @ turn_z(
                random.uniform(-3, 3)
            ).T + center
            pixels = seen_by_opencv(document, corners)
            box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
            wide, tall = box[2:] - box[:2]
            scale = np.hypot(1.0, 0.02 * np.array([wide, tall, wide, tall]))
            found = camera.detections([box + scale * random.normal(size=4)], ["car"])
            if len(found["row"]):
                error = found["center"][0, :2] - center[:2]
                distance = error @ np.linalg.solve(found["position_covariance"][0, :2, :2], error)
                inside.append(distance < 5.99)
    assert len(inside) > 500
    assert 0.93 <= np.mean(inside) <= 0.99


def mapped(document: dict[str, Any], **more: Any) -> optipmb.GroundCamera:
    """Give a homography that a pinhole camera and its ground are, from five of its pixels."""
    camera = optipmb.GroundCamera.parse(document)
    ground = np.array([[12.0, 1.0], [40.0, -8.0], [40.0, 10.0], [20.0, 5.0]])
    pixels = camera.project(np.insert(ground, 2, 0.0, axis=1))
    rows = []
    for (x, y), (u, v) in zip(ground, pixels, strict=True):
        rows += [[u, v, 1, 0, 0, 0, -x * u, -x * v, -x], [0, 0, 0, u, v, 1, -y * u, -y * v, -y]]
    found = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    table = {"matrix": (-found).tolist(), "reference": [960.0, 1000.0], **more}
    return optipmb.GroundCamera.parse({**document, "pinhole": None, "homography": table})


def test_a_homography_of_a_pinhole_camera_is_that_camera() -> None:
    """The map from pixels to ground that a camera makes gives its places, covariances and field of view."""
    document = pinhole(down=0.3, error={"pixel": [1.0, 0.03], "tilt": 0.0, "height": 0.0})
    camera, flat = optipmb.GroundCamera.parse(document), mapped(document, position=[2.0, 1.0])
    random = np.random.default_rng(4)
    low = np.column_stack([random.uniform(100, 1700, 50), random.uniform(450, 900, 50)])
    box = np.column_stack([low, low + random.uniform(20, 150, (50, 2))])
    names = random.choice(["car", "person", "bus"], 50)
    one, other = camera.detections(box, names), flat.detections(box, names)
    np.testing.assert_array_equal(one["row"], other["row"])
    assert len(one["row"]) > 40
    np.testing.assert_allclose(one["center"], other["center"], atol=1e-9)
    np.testing.assert_allclose(one["position_covariance"], other["position_covariance"], atol=1e-6)
    assert camera.field_of_view is not None
    assert flat.field_of_view is not None
    np.testing.assert_allclose(camera.field_of_view.azimuth, flat.field_of_view.azimuth, atol=0.01)
    unknown = mapped(document)
    assert unknown.field_of_view is None
    middle = [[935.0, 700.0, 985.0, 740.0]]  # above the place below the camera, where lines of the image are rays
    np.testing.assert_allclose(
        unknown.detections(middle, ["car"])["center"], camera.detections(middle, ["car"])["center"], atol=1e-4
    )


def test_a_turned_world_has_turned_detections() -> None:
    """Turning world and camera turns places, covariances and the field of view."""
    box, turn = [[900.0, 500.0, 1020.0, 640.0], [300.0, 600.0, 330.0, 700.0]], turn_z(1.2)
    one, other = (optipmb.GroundCamera.parse(pinhole(down=0.3, yaw=yaw)) for yaw in (0.0, 1.2))
    first, second = one.detections(box, ["car", "person"]), other.detections(box, ["car", "person"])
    np.testing.assert_allclose(second["center"][:, :2], first["center"][:, :2] @ turn[:2, :2].T, atol=1e-9)
    np.testing.assert_allclose(second["position_covariance"], turn @ first["position_covariance"] @ turn.T, atol=1e-9)
    assert one.field_of_view is not None
    assert other.field_of_view is not None
    np.testing.assert_allclose(one.field_of_view.azimuth, other.field_of_view.azimuth, atol=1e-9)
    assert other.field_of_view.pose is not None
    np.testing.assert_allclose(other.field_of_view.pose.rotation, turn, atol=1e-9)


@pytest.mark.parametrize(
    ("box", "reason"),
    [
        ([900.0, 100.0, 1000.0, 200.0], "horizon"),
        ([900.0, 1000.0, 1000.0, 1079.0], "cut"),
        ([900.0, -300.0, 1000.0, -200.0], "cut"),
        ([-500.0, 700.0, -400.0, 800.0], "cut"),
        ([900.0, 500.0, 1000.0, 549.0], "far"),
    ],
)
def test_boxes_without_a_place_are_left_out_and_counted(box: list[float], reason: str) -> None:
    """A box beyond the horizon, cut by the lower border, outside the image or too far has no place, for a reason."""
    found = optipmb.GroundCamera.parse(pinhole()).detections([box, [900.0, 700.0, 960.0, 750.0]], ["car", "car"])
    assert found["left_out"] == {reason: 1}
    assert found["row"].tolist() == [1]


def test_a_hidden_foot_and_a_cut_side_are_less_exact() -> None:
    """A foot in a lower box is less exact along the ray, and a box at the side of the image across it."""
    camera = optipmb.GroundCamera.parse(pinhole(error={"largest": 100.0}))
    box, before = [900.0, 600.0, 1000.0, 700.0], [890.0, 650.0, 1050.0, 800.0]
    free = camera.detections([box], ["car"])["position_covariance"][0]
    hidden = camera.detections([box, before], ["car", "car"])["position_covariance"][0]
    assert hidden[0, 0] > free[0, 0] + 1.0
    inside, cut = ([[x, 600.0, x + 40.0, 700.0]] for x in (10.0, 1.0))
    spread = [
        np.linalg.eigvalsh(camera.detections(one, ["bus"])["position_covariance"][0, :2, :2]) for one in (inside, cut)
    ]
    assert spread[1].sum() > spread[0].sum() + 10.0


def test_no_box_and_a_box_without_height_are_no_error() -> None:
    """A frame without boxes has no detections, and a box without height is one, with a range of the ground alone."""
    camera = optipmb.GroundCamera.parse(pinhole(error={"range": "both"}))
    nothing: list[Any] = [[], np.empty((0, 4)), np.empty(0, np.float32)]
    for none in nothing:
        assert camera.detections(none, [])["center"].shape == (0, 3)
    assert len(camera.detections([[900.0, 700.0, 900.0, 700.0]], ["car"])["row"]) == 1


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"box": [[0, 0, 9, 9], [5, 0, 4, 9]]}, "box[1]"),
        ({"box": [[0, 0, 9, float("nan")]]}, "box[0]"),
        ({"box": [[0, 0, 9]]}, "box"),
        ({"box": [["a", 0, 9, 9]]}, "box"),
        ({"foot": [[1.0, float("inf")]]}, "foot[0]"),
        ({"foot": [[1.0, 2.0]], "box": [[0, 0, 9, 9]]}, "box"),
        ({}, "box"),
        ({"box": [[0, 0, 9, 9]], "label": []}, "box"),
    ],
)
def test_boxes_that_are_none_are_refused(given: dict[str, Any], path: str) -> None:
    """Wrong shapes and values are refused by the name and row of the first one."""
    labels = {"label": ["car"] * len(next(iter(given.values()), []))}
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.GroundCamera.parse(pinhole()).detections(**labels | given)
    assert caught.value.path == path


WRONG: Final[list[tuple[dict[str, Any], str]]] = [
    ({"pinhole": None}, "pinhole"),
    ({"pinhole.quaternion": [1.0, 1.0, 0.0, 0.0]}, "pinhole.quaternion"),
    ({"pinhole.position": [0.0, 0.0, -1.0]}, "pinhole.position"),
    ({"pinhole.position": [0.0, float("nan"), 1.0]}, "pinhole.position.1"),
    ({"pinhole.quaternion": [0.5, 0.5, 0.5, 0.5]}, "pinhole.quaternion"),
    ({"pinhole.ground": [1.0, 0.0, 0.0, 0.0]}, "pinhole.ground"),
    ({"pinhole.distortion": [0.1]}, "pinhole.distortion"),
    ({"pinhole.intrinsics": [0.0, 1.0, 1.0, 1.0]}, "pinhole.intrinsics.0"),
    ({"image": [1920, 0]}, "image.1"),
    ({"mount": "drone"}, "mount"),
    ({"error": {"pixels": [1.0, 0.1]}}, "error.pixels"),
    ({"class": {"car": {"size": [1.0, 2.0]}}}, "class.car.size.2"),
    (
        {"homography": {"matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 0]], "reference": [1, 1]}, "pinhole": None},
        "homography.matrix",
    ),
    (
        {"homography": {"matrix": [[1, 0, 0], [0, 1, 0], [0, 1, -9]], "reference": [1, 9]}, "pinhole": None},
        "homography.reference",
    ),
]


@pytest.mark.parametrize(("change", "path"), WRONG, ids=[f"{number}-{path}" for number, (_, path) in enumerate(WRONG)])
def test_a_calibration_that_is_none_is_refused(change: dict[str, Any], path: str) -> None:
    """Values that are not finite, not of norm one, below the ground, away from it or singular are refused by path."""
    document = pinhole()
    for name, value in change.items():
        table, _, field = name.rpartition(".")
        (document[table] if table else document)[field] = value
    with pytest.raises(optipmb.ParameterError) as caught:
        optipmb.GroundCamera.parse(document)
    assert caught.value.path == path


ROS: Final = """image_width: 1920
image_height: 1080
camera_name: gate
camera_matrix:
  rows: 3
  cols: 3
  data: [1050.0, 0.0, 960.0, 0.0, 1040.0, 540.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.07, 0.001, -0.0008, 0.01]
rectification_matrix:
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def test_intrinsics_of_ros_and_opencv_are_read(tmp_path: Path) -> None:
    """A camera_info of ROS, also with lists in lines, and OpenCV's YAML and XML, as cv2 writes them, are one camera."""
    lens = {"intrinsics": [1050.0, 1040.0, 960.0, 540.0], "distortion": LENSES["five"]}
    camera, terms = np.array([[1050.0, 0, 960], [0, 1040, 540], [0, 0, 1]]), np.array(LENSES["five"])[:, None]
    for name in ("cv.yml", "cv.xml"):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FileStorage_WRITE)
        storage.write("camera_matrix", camera)
        storage.write("distortion_coefficients", terms)
        storage.release()
    (tmp_path / "info.yaml").write_text(ROS)
    listed = "\n".join(f"  - {value}" for value in LENSES["five"])
    (tmp_path / "lines.yaml").write_text(ROS.replace("[-0.28, 0.07, 0.001, -0.0008, 0.01]", f"\n{listed}"))
    expected = optipmb.GroundCamera.parse(pinhole(lens=lens))
    for name in ("cv.yml", "cv.xml", "info.yaml", "lines.yaml"):
        text = f"""image = [1920, 1080]
[pinhole]
intrinsics = "{name}"
position = [2.0, 1.0, 6.0]
quaternion = {expected.pinhole and list(expected.pinhole.quaternion)}
"""
        (tmp_path / "gate.toml").write_text(text)
        found = optipmb.GroundCamera.read(tmp_path / "gate.toml")
        assert found.model_dump() == expected.model_dump(), name


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "gate.toml: expected the calibration of a camera"),
        ({"gate.toml": "image = ["}, "gate.toml: expected the calibration of a camera"),
        (
            {"gate.toml": '[pinhole]\nintrinsics = "none.yaml"'},
            "gate.toml: intrinsics: expected a file of ROS or OpenCV",
        ),
        ({"gate.toml": '[pinhole]\nintrinsics = "a.yaml"', "a.yaml": "K: [1, 2]"}, "camera_matrix of 9 numbers"),
        ({"gate.toml": '[pinhole]\nintrinsics = "a.yaml"', "a.yaml": ROS}, "image: expected 1920 x 1080, as"),
        (
            {
                "gate.toml": 'image = [1920, 1080]\n[pinhole]\nintrinsics = "a.yaml"',
                "a.yaml": ROS.replace("plumb_bob", "fov"),
            },
            "a distortion_model among",
        ),
        ({"gate.toml": '[pinhole]\nintrinsics = "a.yaml"', "a.yaml": "K: [1, x, 2]"}, "expected numbers"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, files: dict[str, str], message: str) -> None:
    """A calibration that is missing, no TOML, or names wrong intrinsics is refused with its path."""
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(optipmb.ParameterError, match=r"gate\.toml") as caught:
        optipmb.GroundCamera.read(tmp_path / "gate.toml")
    assert message in str(caught.value)


def frames(camera: optipmb.GroundCamera) -> list[dict[str, Any]]:
    """Give pixel boxes of a car that passes a camera, and of one beyond the horizon before it."""
    found = []
    for k in range(15):
        middle = np.array([30.0, -6.0 + k, 0.0])
        corners = np.array(np.meshgrid([-2.2, 2.2], [-0.9, 0.9], [0.0, 1.5])).reshape(3, 8).T + middle
        pixels = camera.project(corners)
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        found.append({"box": np.stack([[900.0, 50.0, 950.0, 90.0], box]), "class": ["car", "car"], "score": [0.9, 0.9]})
    return found


def test_the_tracker_takes_pixel_boxes() -> None:
    """Boxes of a camera make tracks on the ground, which count the rows that were given and those left out."""
    camera, tracker = optipmb.GroundCamera.parse(pinhole(down=0.2)), optipmb.OnlineTracker("generic")
    flat = optipmb.OnlineTracker("generic")
    for k, boxes in enumerate(frames(camera)):
        tracks = tracker.update(boxes, t=0.1 * k, camera=camera)
        columns = dict(zip(("x1", "y1", "x2", "y2"), boxes["box"].T, strict=True)) | {"class": boxes["class"]}
        again = flat.update(columns | {"score": boxes["score"]}, t=0.1 * k, camera=camera)
        assert optipmb.bytes_of(tracker.density) == optipmb.bytes_of(flat.density)
    assert tracks.left_out == again.left_out == 1
    assert tracks.detection.tolist() == [1]
    assert abs(tracks.center[0, :2] - [30.0, 8.0]).max() < 1.0
    assert tracks.confirmed.all()
    assert len(tracker.update({"foot": np.empty((0, 2)), "class": []}, t=1.5, camera=camera)) == 1
    assert len(tracker.update(t=1.6, camera=camera)) == 1


@pytest.mark.parametrize(
    ("height", "down", "x", "y"),
    [
        (1.65, 0.0, 4.5, 0.0),  # nearer than the ground in the lower corners
        (1.65, 0.0, 8.0, 6.0),  # at the side
        (6.0, 0.7, 4.5, 3.0),  # at the side, where it is at a larger angle than far away
        (6.0, 0.7, 25.0, 20.0),  # in an upper corner
        (6.0, 0.5 * np.pi, 3.0, 4.5),  # in a corner of a camera that looks down
        (6.0, 0.5 * np.pi, 0.0, 0.0),
    ],
)
def test_objects_keep_their_ids_wherever_the_image_shows_them(height: float, down: float, x: float, y: float) -> None:
    """A person is one track while it has boxes, and ends without, for the image shows its place."""
    document = pinhole(down=down)
    document["pinhole"]["position"] = [0.0, 0.0, height]
    camera, tracker = optipmb.GroundCamera.parse(document), optipmb.OnlineTracker("generic")
    ids: set[int] = set()
    for k in range(60):
        middle = np.array([x, y - 0.05 * min(k, 20), 0.0])
        corners = np.array(np.meshgrid([-0.25, 0.25], [-0.25, 0.25], [0.0, 1.7])).reshape(3, 8).T + middle
        pixels = np.clip(camera.project(corners), 0.0, (1920.0, 1080.0))
        box = [[*pixels.min(axis=0), *pixels.max(axis=0)]] if k <= 20 else []
        tracks = tracker.update({"box": box, "class": ["person"] * len(box)}, t=0.1 * k, camera=camera)
        ids.update(tracks.id.tolist())
        assert len(tracks) or k > 20
    assert ids == {1}
    assert len(tracks) == 0


def test_a_camera_on_a_vehicle_moves_with_its_pose() -> None:
    """A vehicle that stands at a pose gives the density of a camera fixed there, its field of view included."""
    errors = {"tilt": 0.01, "height": 0.03, "range": "both"}
    fixed = optipmb.GroundCamera.parse(pinhole(down=0.2, yaw=0.5, error=errors))
    moved = optipmb.GroundCamera.parse(pinhole(down=0.2, error=errors, mount="vehicle"))
    pose = optipmb.Pose(np.zeros(3), np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)]))
    one, other = optipmb.OnlineTracker("generic"), optipmb.OnlineTracker("generic")
    for k, boxes in enumerate(frames(moved)):
        here = one.update(boxes, t=0.1 * k, camera=fixed)
        there = other.update(boxes, t=0.1 * k, camera=moved, pose=pose)
    np.testing.assert_allclose(here.center, there.center, atol=1e-6)
    np.testing.assert_allclose(here.covariance, there.covariance, atol=1e-6)
    view, other_view = fixed.view_from(None), moved.view_from(pose)
    assert view is not None
    assert other_view is not None
    assert view.pose is not None
    assert other_view.pose is not None
    np.testing.assert_allclose(view.pose.rotation, other_view.pose.rotation, atol=1e-9)
    np.testing.assert_allclose(view.pose.translation, other_view.pose.translation, atol=1e-9)


def test_a_pose_belongs_to_a_camera_on_a_vehicle() -> None:
    """A fixed camera refuses one, which would change nothing; one on a vehicle needs it. The error has the mount."""
    pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))
    for mount, given in (("fixed", pose), ("vehicle", None)):
        with pytest.raises(optipmb.FrameError, match=rf"pose: expected .* \(mount = {mount}\)"):
            optipmb.GroundCamera.parse(pinhole(mount=mount)).detections([[900, 700, 1000, 780]], ["car"], pose=given)


@pytest.mark.parametrize(
    ("mount", "given", "path"),
    [
        ("vehicle", {}, "pose"),
        ("fixed", {"pose": optipmb.Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))}, "pose"),
        ("fixed", {"yaw": [0.0]}, "yaw"),
        ("fixed", {"label": [7], "class": None}, "label"),
        ("fixed", {"label": ["car"]}, "label"),
        ("fixed", {"camera": None}, "box"),
        ("fixed", {"attributes": [None, None]}, "attributes"),
        ("fixed", {"embedding": np.ones((0, 4)), "embedding_model": "any"}, "embedding"),
    ],
)
def test_the_tracker_refuses_what_no_camera_gives(mount: str, given: dict[str, Any], path: str) -> None:
    """A vehicle without a pose, a fixed camera with one, wrong columns, and boxes without a camera are refused."""
    camera = optipmb.GroundCamera.parse(pinhole(mount=mount))
    boxes: dict[str, Any] = {"box": [[900, 700, 1000, 780]], "class": ["car"], "t": 0.0, "camera": camera} | given
    tracker = optipmb.OnlineTracker("generic")
    with pytest.raises(optipmb.FrameError) as caught:
        tracker.update(**{name: value for name, value in boxes.items() if value is not None})
    assert caught.value.path == path


MATRIX = "[[1050.0, 0.0, 960.0], [0.0, 1040.0, 540.0], [0.0, 0.0, 1.0]]"
FLAT = "[1050.0, 0.0, 960.0, 0.0, 1040.0, 540.0, 0.0, 0.0, 1.0]"


@pytest.mark.parametrize(
    "text",
    [
        f"K: {FLAT}  # of the lens\ndistortion_coeffs: [-0.1, 0.02, 0.0, 0.0]\n",
        (
            "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n"
            "  distortion_coeffs: [-0.1, 0.02, 0.0, 0.0]\n  intrinsics: [1050.0, 1040.0, 960.0, 540.0]\n"
        ),
        f'{{"camera_matrix": {MATRIX}, "dist_coeff": [[-0.1, 0.02, 0.0, 0.0]]}}',
        f"M1:\n  data: {FLAT}\nD1:\n  data:\n    - -0.1\n    - 0.02\n    - 0.0\n    - 0.0\n",
        (
            '{"intrinsics": {"fx": 1050.0, "fy": 1040.0, "cx": 960.0, "cy": 540.0}, '
            '"distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.0, "p2": 0.0}}'
        ),
        f"mtx: {MATRIX}\ndist: [-0.1, 0.02, 0.0, 0.0]\nfisheye_model: 0\n",
    ],
)
def test_lenses_of_other_programs_are_read(tmp_path: Path, text: str) -> None:
    """Comments, blocks, JSON, and other names of the matrix and the distortion."""
    (tmp_path / "lens").write_text(text)
    found = read_lens(tmp_path / "lens", [1920, 1080])
    assert found["intrinsics"] == [1050.0, 1040.0, 960.0, 540.0]
    assert found["distortion"] == [-0.1, 0.02, 0.0, 0.0]
    assert found["model"] == "opencv"
    if text.startswith("K"):
        (tmp_path / "lens").write_text(text + "fisheye_model: 1\n")
        assert read_lens(tmp_path / "lens", None)["model"] == "fisheye"


def test_a_matrix_without_a_distortion_is_a_question(tmp_path: Path) -> None:
    """A lens whose distortion has no known name is not taken for a straight one."""
    (tmp_path / "lens.yaml").write_text(f"K: {FLAT}\nlens_terms: [-0.1, 0.02]\n")
    with pytest.raises(optipmb.ParameterError, match=r"distortion: .*says that it has none.*lens_terms"):
        read_lens(tmp_path / "lens.yaml", None)


@pytest.mark.parametrize(
    "text",
    [
        '{"left": {"K": [1, 0, 2, 0, 1, 3, 0, 0, 1], "D": []}, "right": {"K": [4, 0, 2, 0, 4, 3, 0, 0, 1], "D": []}}',
        ('[{"name": "left", "K": [1, 0, 2, 0, 1, 3, 0, 0, 1], "D": []}, '
         '{"name": "right", "K": [4, 0, 2, 0, 4, 3, 0, 0, 1], "D": []}]'),
        ("left:\n  K: [1, 0, 2, 0, 1, 3, 0, 0, 1]\n  D: []\nright:\n  K: [4, 0, 2, 0, 4, 3, 0, 0, 1]\n  D: []\n"),
        ("cams:\n  - name: left\n    intrinsics: [1, 1, 2, 3]\n    D: []\n  - name: right\n"
         "    intrinsics: [4, 4, 2, 3]\n    D: []\n"),
    ],
)  # fmt: skip
def test_one_of_several_sensors_is_named(tmp_path: Path, text: str) -> None:
    """A file with several asks which, and `FILE#SENSOR` says so."""
    (tmp_path / "rig").write_text(text)
    assert read_lens(tmp_path / "rig#right", None)["intrinsics"] == [4.0, 4.0, 2.0, 3.0]
    for name in ("rig", "rig#top"):
        with pytest.raises(optipmb.ParameterError, match="one of the sensors rig#left, rig#right"):
            read_lens(tmp_path / name, None)


@pytest.mark.parametrize(
    "text",
    [
        ('{"front": {"left": {"K": [1, 0, 2, 0, 1, 3, 0, 0, 1], "D": []}}, '
         '"back": {"left": {"K": [4, 0, 2, 0, 4, 3, 0, 0, 1], "D": []}}}'),
        ("cams:\n  - name: left\n    intrinsics: [1, 1, 2, 3]\n    D: []\n  - name: left\n"
         "    intrinsics: [4, 4, 2, 3]\n    D: []\n"),
    ],
)  # fmt: skip
def test_sensors_of_one_name_are_told_apart(tmp_path: Path, text: str) -> None:
    """The error names both, and each name that it gives is of one sensor."""
    (tmp_path / "rig").write_text(text)
    with pytest.raises(optipmb.ParameterError) as error:
        read_lens(tmp_path / "rig", None)
    names = re.findall(r"rig#([\w.]+)", str(error.value))
    assert len(names) == 2
    assert [read_lens(tmp_path / f"rig#{name}", None)["intrinsics"][0] for name in names] == [1.0, 4.0]


def test_poses_of_other_programs_are_read(tmp_path: Path) -> None:
    """R and t, rvec and tvec, and a matrix from the world to the camera give its place and turn."""
    expected = optipmb.GroundCamera.parse(pinhole()).pinhole
    assert expected is not None
    turn = expected.pose.rotation.T
    shift = -turn @ np.array(expected.position)
    rvec = cv2.Rodrigues(turn)[0].ravel()
    whole = np.column_stack([turn, shift]).tolist()
    for document in (
        {"R": turn.tolist(), "t": shift.tolist()},
        {"rvec": rvec.tolist(), "tvec": shift[:, None].tolist()},
        {"extrinsic": [*whole, [0.0, 0.0, 0.0, 1.0]]},
        {"projection": (np.array([[1050.0, 0, 960], [0, 1040, 540], [0, 0, 1]]) @ np.array(whole)).tolist()},
    ):
        (tmp_path / "c.json").write_text(json.dumps(document))
        found = read_pose(tmp_path / "c.json")
        assert np.allclose(found["position"], expected.position)
        assert np.allclose(found["quaternion"], expected.quaternion) or np.allclose(
            found["quaternion"], -np.array(expected.quaternion)
        )


def test_a_map_that_no_camera_sees_is_refused_and_coordinates_may_be_large() -> None:
    """A mirrored matrix is refused; of metres of a grid the places keep their digits."""
    near = np.array([[0.0, -0.02, 10.0], [-0.02, 0.0, 10.0], [0.0, -0.001, 1.0]])
    for sign in (1.0, -1.0):
        far = near.copy()
        far[1] *= sign
        far[:2] += np.array([[691_000.0], [5_336_000.0]]) * far[2]
        document = {"image": [1920, 1080], "homography": {"matrix": far.tolist(), "reference": [960.0, 100.0]}}
        if sign < 0.0:
            with pytest.raises(optipmb.ParameterError, match="mirrored"):
                optipmb.GroundCamera.parse(document)
            continue
        camera = optipmb.GroundCamera.parse(document)
        pixels = np.array([[900.0, 200.0], [1000.0, 50.0]])
        places = camera.ground(pixels)
        assert np.allclose(camera.project(np.insert(places, 2, 0.0, axis=1)), pixels, atol=1e-5)

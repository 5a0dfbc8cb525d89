"""Results of detection frameworks.

The real class of supervision is compared where it is installed. OpenPCDet and MMDetection3D have no wheels, Ultralytics
needs torch and nuscenes-devkit an older numpy: stand-ins have the attributes that their documentation names.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import detectors
import numpy as np
import pytest

import optipmb

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

CLASSES: Final = ("Car", "Pedestrian", "Cyclist")
CAMERA: Final = optipmb.GroundCamera.parse(
    {
        "image": [1920, 1080],
        "pinhole": {
            "intrinsics": [1050.0, 1050.0, 960.0, 540.0],
            "position": [0.0, 0.0, 6.0],
            "quaternion": [0.5, -0.5, 0.5, -0.5],
        },
    }
)
PIXELS: Final = [[900.0, 700.0, 1000.0, 760.0], [300.0, 650.0, 330.0, 720.0]]


def boxes(columns: int = 9) -> Floats:
    """Give random boxes (6, 9): place, three sizes, yaw, velocity, as numbers that single precision has."""
    random = np.random.default_rng(1)
    values = np.column_stack(
        [
            random.uniform(-30, 30, (6, 3)),
            random.uniform(0.5, 6, (6, 3)),
            random.uniform(-3, 3, 6),
            random.normal(size=(6, 2)),
        ]
    )
    return values[:, :columns].astype(np.float32).astype(np.float64)


def corners(found: dict[str, Any]) -> Floats:
    """Give the corners (N, 8, 3) of columns, by the convention of OptiPMB: centre, size, yaw from x."""
    offset = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij")).reshape(3, 8).T
    local = offset * np.asarray(found["size"])[:, None]
    cos, sin = np.cos(found["yaw"])[:, None], np.sin(found["yaw"])[:, None]
    turned = [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1], local[..., 2]]
    return np.asarray(np.stack(turned, axis=2) + np.asarray(found["center"])[:, None])


def same(found: Floats, expected: Floats) -> None:
    """Hold two sets of corners (N, 8, 3) equal, in any order of the corners."""
    for one, other in zip(found, expected, strict=True):
        distance = np.linalg.norm(one[:, None] - other, axis=2)
        assert (distance.min(axis=0) < 1e-9).all()
        assert len(set(distance.argmin(axis=0).tolist())) == 8


def lifted(box: Floats, bottom: float) -> Floats:
    """Give the corners of a box of a LiDAR: x ahead, y left, z up, length along the heading, z from `bottom` of h."""
    x, y, z, length, width, height, yaw = box[:7]
    rows = []
    for ahead in (-0.5 * length, 0.5 * length):
        for left in (-0.5 * width, 0.5 * width):
            for up in (bottom * height, (bottom + 1.0) * height):
                turned = (ahead * np.cos(yaw) - left * np.sin(yaw), ahead * np.sin(yaw) + left * np.cos(yaw))
                rows.append((x + turned[0], y + turned[1], z + up))
    return np.array(rows)


def test_boxes_of_openpcdet() -> None:
    """Centres in the middle of the box, and labels that count from 1; further heads are ignored."""
    given = boxes()
    result = detectors.openpcdet(given, [0.5] * 6, [1, 2, 3, 1, 2, 3]) | {"pred_ious": None}
    found = optipmb.from_detector([result], classes=CLASSES)
    same(corners(found), np.array([lifted(one, -0.5) for one in given]))
    assert found["label"] == [*CLASSES, *CLASSES]
    np.testing.assert_array_equal(found["velocity"], given[:, 7:])


@pytest.mark.parametrize("kind", [detectors.LiDARInstance3DBoxes, detectors.DepthInstance3DBoxes])
def test_boxes_of_mmdet3d(kind: Any) -> None:
    """Places in the middle of the bottom, labels from 0, names from the result where none are given."""
    given = boxes(7)
    result = detectors.mmdet3d(kind(given), [0.5] * 6, [0, 1, 2, 0, 1, 2], metainfo={"classes": CLASSES})
    found = optipmb.from_detector(result)
    same(corners(found), np.array([lifted(one, 0.0) for one in given]))
    assert found["label"] == [*CLASSES, *CLASSES]
    assert "velocity" not in found


def test_boxes_of_a_camera_of_mmdet3d() -> None:
    """Axes right, down, ahead; y at the bottom; length along x and width along z at yaw 0, which turns about y."""
    given, expected = boxes(), []
    for x, y, z, length, height, width, yaw, *_ in given:
        rows = []
        for a in (-0.5 * length, 0.5 * length):
            for b in (-0.5 * width, 0.5 * width):
                for up in (0.0, height):
                    right, ahead = a * np.cos(yaw) + b * np.sin(yaw), -a * np.sin(yaw) + b * np.cos(yaw)
                    rows.append((z + ahead, -(x + right), -(y - up)))
        expected.append(rows)
    result = detectors.mmdet3d(detectors.CameraInstance3DBoxes(given), [0.5] * 6, [0] * 6)
    found = optipmb.from_detector(result, classes=CLASSES)
    same(corners(found), np.array(expected))
    np.testing.assert_array_equal(found["velocity"], np.column_stack([given[:, 8], -given[:, 7]]))


@pytest.mark.parametrize("as_dicts", [True, False])
def test_boxes_of_nuscenes(*, as_dicts: bool) -> None:
    """Width, length, height and a quaternion w x y z; an unknown velocity is NaN, and a score of -1 is 1."""
    rows, expected = [], []
    for x, y, z, length, width, height, yaw, vx, vy in boxes():
        rows.append({
            "detection_name": "car", "translation": (x, y, z), "size": (width, length, height), "velocity": (vx, vy),
            "rotation": (np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)), "detection_score": 0.5,
        })  # fmt: skip
        expected.append(lifted(np.array([x, y, z, length, width, height, yaw]), -0.5))
    rows[0] |= {"velocity": (float("nan"), float("nan")), "detection_score": -1.0}
    found = optipmb.from_detector(rows if as_dicts else [SimpleNamespace(**row) for row in rows])
    same(corners(found), np.array(expected))
    assert found["score"].tolist() == [1.0, *[0.5] * 5]
    assert np.isnan(found["velocity"][0]).all()


def results() -> dict[str, tuple[Any, Any, dict[str, Any]]]:
    """Give each form with objects, without objects, and what its conversion needs."""
    kind, nothing = detectors.LiDARInstance3DBoxes, np.empty((0, 7), np.float32)
    box = SimpleNamespace(
        detection_name="car",
        translation=(9, 1, 1),
        size=(2, 4, 2),
        rotation=(1, 0, 0, 0),
        velocity=(0, 0),
        detection_score=0.9,
    )
    pixels = np.array(PIXELS)
    return {
        "openpcdet": (
            detectors.openpcdet([[9, 1, 1, 4, 2, 2, 0.1]], [0.9], [1]),
            detectors.openpcdet(nothing, [], []),
            {"classes": CLASSES},
        ),
        "mmdet3d": (
            detectors.mmdet3d(kind([[9, 1, 0, 4, 2, 2, 0.1]]), [0.9], [0]),
            detectors.mmdet3d(kind(nothing), [], []),
            {"classes": CLASSES},
        ),
        "nuscenes": ([box], [], {}),
        "supervision": (
            detectors.supervision(pixels, None, None, ["car", "person"]),
            detectors.supervision(np.empty((0, 4)), np.empty(0), np.empty(0, int)),
            {"camera": CAMERA},
        ),
        "ultralytics": (
            detectors.ultralytics(pixels, [0.9, 0.8], [2, 0]),
            detectors.ultralytics(np.empty((0, 4)), [], []),
            {"camera": CAMERA},
        ),
    }


@pytest.mark.parametrize("form", results())
def test_a_tracker_takes_results(form: str) -> None:
    """Each form, and its empty frame, goes through `update(**from_detector(…))`, and alone if it has its classes."""
    full, empty, how = results()[form]
    tracker = optipmb.OnlineTracker("generic")
    tracks = tracker.update(**optipmb.from_detector(full, **how), t=0.0)
    assert len(tracks) == (2 if "camera" in how else 1)
    assert tracker.update(**optipmb.from_detector(empty, form=form, **how), t=0.1).detection.tolist() == [-1] * len(
        tracks
    )
    if "classes" not in how:
        alone = optipmb.OnlineTracker("generic")
        assert alone.update(full, t=0.0, **how).center.tolist() == tracks.center.tolist()
        alone.update(empty, t=0.1, **how)


def test_the_page_prints_what_it_says(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each program of docs/detectors.md, and the text below it."""
    root = Path(__file__).parents[2]
    monkeypatch.chdir(root)
    page = (root / "docs" / "detectors.md").read_text(encoding="utf-8")
    block = r"^```python\n(.*?)^```\n\nIt prints:\n\n```\n(.*?)^```"
    programs = re.findall(block, page, re.DOTALL | re.MULTILINE)
    assert len(programs) == page.count("```python")
    for code, printed in programs:
        exec(compile(code, "detectors.md", "exec"), {})  # noqa: S102 - of this repository
        assert capsys.readouterr().out == printed


def test_results_are_not_changed() -> None:
    """The arrays of the caller stay as they are."""
    given = boxes()
    kept = given.copy()
    optipmb.from_detector({"pred_boxes": given, "pred_scores": [0.5] * 6, "pred_labels": [1] * 6}, classes=CLASSES)
    result = detectors.mmdet3d(SimpleNamespace(), [0.5] * 6, [0] * 6)
    result.pred_instances_3d.bboxes_3d = type("LiDARInstance3DBoxes", (), {"tensor": given})()
    optipmb.from_detector(result, classes=CLASSES)
    np.testing.assert_array_equal(given, kept)


def test_supervision_itself() -> None:
    """The real class of supervision, with objects, without class names, and empty, is read as its stand-in."""
    sv = pytest.importorskip("supervision")
    full = sv.Detections(np.array(PIXELS), confidence=np.array([0.9, 0.8]), class_id=np.array([1, 0]))
    found = optipmb.from_detector(full, classes=("person", "car"), camera=CAMERA)
    assert found["label"] == ["car", "person"]
    assert found["score"].tolist() == [0.9, 0.8]
    np.testing.assert_array_equal(found["box"], PIXELS)
    full.data["class_name"] = np.array(["bus", "car"])
    full.confidence = None
    found = optipmb.from_detector(full, camera=CAMERA)
    assert (found["label"], found["score"].tolist()) == (["bus", "car"], [1.0, 1.0])
    assert len(optipmb.OnlineTracker().update(sv.Detections.empty(), t=0.0, camera=CAMERA)) == 0


BOX: Final = [[9.0, 1, 1, 4, 2, 2, 0.1]]
WRONG: Final[list[tuple[Any, dict[str, Any], str, str]]] = [
    (object(), {}, "boxes", "a result of openpcdet"),
    ({"pred_boxes": BOX}, {}, "boxes", "none of them"),
    (SimpleNamespace(boxes=0, names={}, pred_instances_3d=0), {}, "boxes", "mmdet3d and ultralytics"),
    (detectors.openpcdet(BOX, [0.9], [1]), {}, "classes", "the names of the classes"),
    (detectors.openpcdet(BOX, [0.9], [4]), {"classes": CLASSES}, "pred_labels[0]", "1 to 3, received 4"),
    (detectors.openpcdet(BOX, [0.9], [0]), {"classes": CLASSES}, "pred_labels[0]", "1 to 3, received 0"),
    (detectors.openpcdet(BOX, [0.9, 0.1], [1]), {"classes": CLASSES}, "pred_scores", "1 values, as pred_boxes has"),
    (detectors.openpcdet([[1.0, 2.0]], [0.9], [1]), {"classes": CLASSES}, "pred_boxes", "(N, 7) or (N, 9)"),
    ([detectors.openpcdet(BOX, [0.9], [1])] * 2, {"classes": CLASSES}, "boxes", "one frame at a time"),
    (
        detectors.mmdet3d(SimpleNamespace(tensor=BOX), [0.9], [0]),
        {},
        "pred_instances_3d.bboxes_3d",
        "LiDARInstance3DBoxes",
    ),
    (detectors.supervision(PIXELS, None, [0, 0], None), {"classes": ("car",)}, "camera", "the GroundCamera"),
    (detectors.supervision(PIXELS, None, None, None), {"camera": CAMERA}, "class_id", "2 values"),
    (detectors.ultralytics(PIXELS, [1.0, 1.0], [7, 0]), {"camera": CAMERA}, "boxes.cls[0]", "one of 0, 2, received 7"),
    (detectors.ultralytics(PIXELS, [1.0, 1.0], [0, 0], (540, 960)), {"camera": CAMERA}, "orig_shape", "(1080, 1920)"),
    (SimpleNamespace(boxes=None, obb=1, names={}), {"camera": CAMERA}, "boxes", "oriented boxes (obb)"),
]


@pytest.mark.parametrize(("result", "how", "path", "text"), WRONG, ids=[f"{n}-{one[2]}" for n, one in enumerate(WRONG)])
def test_results_that_are_none_are_refused(result: Any, how: dict[str, Any], path: str, text: str) -> None:
    """An unknown form, two forms, several frames, labels without classes and wrong shapes are named."""
    with pytest.raises(optipmb.FrameError) as caught:
        optipmb.from_detector(result, **how)
    assert caught.value.path == path
    assert text in str(caught.value)


def test_a_map_of_classes_is_by_label() -> None:
    """A dictionary has the names of the labels, wherever they begin."""
    result = {
        "pred_boxes": np.tile([0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], (2, 1)),
        "pred_scores": [0.9, 0.8],
        "pred_labels": [1, 7],
    }
    found = optipmb.from_detector(result, classes={1: "Car", 7: "Pedestrian"})
    assert found["label"] == ["Car", "Pedestrian"]
    with pytest.raises(optipmb.FrameError, match=r"pred_labels\[1\]: expected one of 1, received 7"):
        optipmb.from_detector(result, classes={1: "Car"})
    with pytest.raises(optipmb.FrameError, match="names of classes"):
        optipmb.OnlineTracker().update({"box": [[1, 2, 3, 4]], "class": [2]}, t=0.0, camera=CAMERA)


@pytest.mark.parametrize("result", [{"boxes": [[1, 2, 3, 4]], "labels": [1], "scores": [0.9]}, object()])
def test_boxes_of_an_image_are_told_the_way(result: object) -> None:
    """Results of detectors in images that have no form name the columns that `update` takes with a camera."""
    with pytest.raises(optipmb.FrameError, match=r"update\(\{'box', 'class', 'score'\}, camera=…\)"):
        optipmb.OnlineTracker().update(result, t=0.0)

"""Pixel boxes of JSON senders: by the camera of the settings they become places on the ground."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_client.errors import ClientError
from optipmb_schemas import Detections, MessageError
from optipmb_service.app.configuration import load
from optipmb_service.edges.json_frames import FrameReader, separate
from router import Node
from scipy.spatial.transform import Rotation

from optipmb import GroundCamera

STREAM = "garage/gate/cam"
PAGE = Path(__file__).parents[3] / "docs/cameras.md"
BOXES = [[1135.0, 699.0, 1255.0, 763.0], [900.0, 900.0, 1000.0, 1079.5], [400.0, 640.0, 440.0, 720.0]]
"""The second has its foot outside the image."""


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """The calibration of the page."""
    file = tmp_path / "gate.toml"
    file.write_text(re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0])
    return file


FRIGATE = {"format": "frigate", "only": {"after.camera": "gate"}}


def reader(calibration: Path, **more: Any) -> FrameReader:
    inputs = {"garage/*/cam*": {"camera": str(calibration), "classes": {"Human": "pedestrian"}} | more}
    return FrameReader(load(None, {"inputs": inputs}).settings)


def read(calibration: Path, body: dict[str, Any], mapping: dict[str, Any] | None = None) -> Detections:
    more = {} if mapping is None else {"format": "mapped", "mapping": mapping}
    return reader(calibration, **more).read(json.dumps(body).encode(), STREAM).message


def objects(**fields: Any) -> list[dict[str, Any]]:
    names = ("car", "car", "Human")
    return [{"class": name, "box": box, **fields} for name, box in zip(names, BOXES, strict=True)]


def test_boxes_become_places_with_covariances(calibration: Path) -> None:
    """Those of `GroundCamera`, by the names of the settings; frames without objects say what the camera sees, too."""
    camera = GroundCamera.read(calibration)
    expected = camera.detections(BOXES, ["car", "car", "pedestrian"], [0.5] * 3)
    message = read(calibration, {"objects": objects(score=0.5)})
    np.testing.assert_array_equal(message.center, expected["center"])
    np.testing.assert_array_equal(message.position_covariance, expected["position_covariance"])
    assert [message.labels[label] for label in message.label] == ["car", "pedestrian"]
    view = camera.field_of_view
    empty = read(calibration, {"objects": []})
    for one in (message, empty):
        assert view is not None
        assert one.field_of_view is not None
        assert one.field_of_view.range.tolist() == list(view.range)
    foot = [{"class": "car", "foot": [1195.0, 763.0]}]
    standing = camera.detections(foot=[[1195.0, 763.0]], label=["car"])
    np.testing.assert_array_equal(read(calibration, {"objects": foot}).center, standing["center"])


def test_boxes_of_other_makers(calibration: Path) -> None:
    """Shares of the image, and left, top, width, height, give the same detections as pixels."""
    expected = read(calibration, {"objects": objects()})
    shares = [[x1 / 1920, y1 / 1080, x2 / 1920, y2 / 1080] for x1, y1, x2, y2 in BOXES]
    sides = ("left", "top", "right", "bottom")
    scenes = [
        {"class": {"type": one["class"]}, "bounding_box": dict(zip(sides, share, strict=True))}
        for one, share in zip(objects(), shares, strict=True)
    ]
    axis = {"objects": "frame.observations[]", "class": "class.type", "box_unit": "image"}
    axis |= {"box": [f"bounding_box.{side}" for side in sides]}
    by_shares = read(calibration, {"frame": {"observations": scenes}}, axis)
    np.testing.assert_allclose(by_shares.center, expected.center, atol=1e-6)
    boxes = [[x1, y1, x2 - x1, y2 - y1] for x1, y1, x2, y2 in BOXES]
    groups = {one["class"]: [] for one in objects()}
    for one, box in zip(objects(), boxes, strict=True):
        groups[one["class"]].append({"bounding_box_px": box})
    by_sides = {"objects": "objects.*[]", "class": "@key", "box": "bounding_box_px", "box_form": "xywh"}
    np.testing.assert_allclose(read(calibration, {"objects": groups}, by_sides).center, expected.center, atol=1e-6)


def test_known_makers(calibration: Path) -> None:
    """Axis' scene description and SceneScape's detections, as their schemas have them, become the same detections."""
    expected = read(calibration, {"objects": objects(score=0.5), "time": "2026-11-27T08:00:00.5Z"})
    sides = ("left", "top", "right", "bottom")
    observations, groups = [], {}
    for one in objects():
        x1, y1, x2, y2 = one["box"]
        share = dict(zip(sides, (x1 / 1920, y1 / 1080, x2 / 1920, y2 / 1080), strict=True))
        kind = {"type": one["class"], "score": 0.5}
        observations.append({"bounding_box": share, "class": kind, "track_id": "9", "timestamp": "…"})
        box = {"x": x1, "y": y1, "width": x2 - x1, "height": y2 - y1}
        found = {"id": 1, "category": one["class"], "confidence": 0.5, "bounding_box_px": box}
        groups.setdefault(one["class"], []).append(found)
    listed = [one for group in groups.values() for one in group]
    payloads = {
        "axis": {"frame": {"timestamp": "2026-11-27T08:00:00.500Z", "observations": observations, "operations": []}},
        "scenescape": {"id": "cam1", "timestamp": "2026-11-27T08:00:00.500Z", "rate": 9.8, "objects": groups},
    }
    payloads["scenescape as a list"] = payloads["scenescape"] | {"objects": listed}
    for name, payload in payloads.items():
        found = reader(calibration, format=name.partition(" ")[0]).read(json.dumps(payload).encode(), STREAM).message
        assert (found.stamp_ns, found.labels) == (expected.stamp_ns, expected.labels)
        np.testing.assert_allclose(found.center, expected.center, atol=1e-6)
        np.testing.assert_allclose(found.score, expected.score)


def test_events_of_frigate(calibration: Path) -> None:
    """Each has one object, or none when it has ended or was a false positive; their stream is incomplete by default."""
    expected = read(calibration, {"objects": objects(score=0.5)[:1]})
    after = {
        "camera": "gate",
        "label": "car",
        "score": 0.5,
        "box": BOXES[0],
        "frame_time": 5.25,
        "false_positive": False,
    }

    def made(kind: str, **fields: Any) -> Detections:
        event = {"type": kind, "before": {}, "after": after | fields}
        return reader(calibration, **FRIGATE).read(json.dumps(event).encode(), STREAM).message

    found = made("update")
    np.testing.assert_array_equal(found.center, expected.center)
    assert (found.stamp_ns, found.score.tolist()) == (5_250_000_000, [0.5])
    assert len(made("end").label) == len(made("new", false_positive=True).label) == 0
    with pytest.raises(MessageError, match=r"after.camera: expected 'gate', by `only` in `inputs`, received 'yard'"):
        made("update", camera="yard")
    settings = load(None, {"inputs": {"garage/b/*": FRIGATE | {"complete": True}, "garage/*/cam": FRIGATE}}).settings
    found = [settings.missing_s(stream) for stream in ("garage/a/cam", "garage/b/cam", "garage/a/lidar")]
    assert found == [10.0, None, None]


def test_fused_sessions_miss_objects_as_late_as_their_inputs() -> None:
    """Of a node and of a site: after the longest `missing_s` of the incomplete streams that may feed them."""
    incomplete = {"complete": False, "missing_s": 30}
    given = {
        "fuse": ["garage/a/*", "garage/b/lidar*"],
        "fused": {"all": {"streams": ["yard/*/cam"]}, "lidars": {"streams": ["yard/*/lidar"]}},
        "inputs": {"garage/*/cam*": incomplete, "yard/gate/*": FRIGATE | {"missing_s": 20}},
    }
    settings = load(None, given).settings
    garage = [settings.missing_s(f"garage/{one}") for one in ("a/fused", "b/fused", "c/fused", "c/cam")]
    assert garage == [30.0, None, None, 30.0]
    assert [settings.missing_s(f"yard/fused/{one}") for one in ("all", "lidars")] == [20.0, 20.0]


def test_separate_objects_are_alone_in_view(calibration: Path) -> None:
    """Each frame of an incomplete one looks at its object, and at none that is more than a few metres away."""
    boxes = [[300, 700, 420, 760], [1135, 699, 1255, 763], [1700, 800, 1900, 900]]
    frame = reader(calibration).read(
        json.dumps({"objects": [{"class": "car", "box": box} for box in boxes], "stamp_ns": 5}).encode(), STREAM
    )
    parts = [one.message for one in separate(frame)]
    assert [one.stamp_ns for one in parts] == [5, 1005, 2005]
    for at, part in enumerate(parts):
        np.testing.assert_array_equal(part.center[0], frame.message.center[at])
        assert part.pose is not None
        assert part.field_of_view is not None
        w, x, y, z = part.pose.quaternion
        places = np.nan_to_num(frame.message.center) - part.pose.translation
        places = Rotation.from_quat([x, y, z, w]).inv().apply(places)
        low, high = part.field_of_view.azimuth
        near, far = part.field_of_view.range
        angle, distance = np.arctan2(places[:, 1], places[:, 0]), np.linalg.norm(places, axis=1)
        seen = (low < angle) & (angle < high) & (near < distance) & (distance < far)
        assert seen.tolist() == [one == at for one in range(3)]


@pytest.mark.parametrize(
    ("place", "path", "received"),
    [
        ({"box": [2270, 1398, 2510, 1526]}, "objects[1].box", "2510 x 1526"),
        ({"box": [-400, 700, -10, 760]}, "objects[1].box", "-10 x 760"),
        ({"foot": [2390, 1526]}, "objects[0].foot", "2390 x 1526"),
        ({"foot": [0.62, 0.71]}, "objects[0].foot", "0.62 x 0.71"),
    ],
)
def test_boxes_of_another_image_are_refused(calibration: Path, place: dict[str, Any], path: str, received: str) -> None:
    """Those outside the image, or all as shares of it: the error says the size, and how far they reach."""
    other = {"class": "car", "box": BOXES[0]}
    given = [other, other | place] if "box" in place else [{"class": "car"} | place]
    with pytest.raises(MessageError, match=r"1920 x 1080") as raised:
        read(calibration, {"objects": given})
    assert (raised.value.path, received in raised.value.received) == (path, True)
    shares = [{"class": "car", "box": [0.5, 0.6, 0.6, 0.7]}] * 2
    with pytest.raises(MessageError, match=r"box_unit"):
        read(calibration, {"objects": shares})
    mapping = {"objects": "objects[]", "class": "class", "box": "box", "box_unit": "image"}
    assert len(read(calibration, {"objects": shares}, mapping).label) == 2
    with pytest.raises(MessageError, match=r"1920 x 1080"):
        read(calibration, {"objects": [other]}, mapping)


def test_a_node_converts_its_boxes(calibration: Path, start: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program of the page publishes what the service makes of the same boxes as JSON: the same tracks."""
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    monkeypatch.chdir(calibration.parent)
    endpoint, stamps = start(profile="generic")[1], iter(range(10**18, 2 * 10**18, 10**8))
    monkeypatch.setattr("time.time_ns", lambda: next(stamps))
    with Node(endpoint) as node:
        exec(compile(code.replace('"world"', f'"world", connect="{endpoint}"'), "cameras.md", "exec"), {})  # noqa: S102 - of this repository
        tracks = node.tracks(STREAM, 6)[-1]
    boxes = [{"class": "car", "box": [1135 - 107.5, 699, 1255 - 112.5, 763], "score": 0.9}]
    np.testing.assert_allclose(tracks.center[0, :2], read(calibration, {"objects": boxes}).center[0, :2], atol=1.0)


@pytest.mark.parametrize(
    ("fields", "path"),
    [
        ({"objects": [{"class": "car", "box": [5, 0, 1, 9]}]}, "objects[0].box"),
        ({"objects": [{"class": "car", "box": [0, 0, 9, 9]}, {"class": "car", "position": [0, 0]}]}, "objects[1]"),
        ({"objects": [{"class": "car", "box": [0, 0, 9, 9], "yaw": 1e9}]}, None),
        ({"objects": objects(size=[1, -1, 1])}, "objects[0].size[1]"),
        ({"objects": [*objects()[1:], {"class": "car", "box": BOXES[0], "size": [-1, 1, 1]}]}, "objects[2].size[0]"),
        ({"objects": objects(position_covariance=np.eye(3).tolist())}, "objects[0].position_covariance"),
        ({"objects": objects(), "pose": {"translation": [0, 0, 0], "quaternion": [1, 0, 0, 0]}}, "pose"),
    ],
)
def test_an_error_names_the_box(calibration: Path, fields: dict[str, Any], path: str | None) -> None:
    """Also where boxes before it have no place; what belongs to a box without a place is not looked at."""
    if path is None:
        assert len(read(calibration, fields).label) == 0
        return
    with pytest.raises(MessageError) as raised:
        read(calibration, fields)
    assert raised.value.path == path


def test_a_camera_on_a_vehicle_needs_its_pose(calibration: Path) -> None:
    """With a pose the places are in the frame of the vehicle."""
    calibration.write_text('mount = "vehicle"\n' + calibration.read_text())
    with pytest.raises(MessageError) as raised:
        read(calibration, {"objects": objects()})
    assert (raised.value.code, raised.value.path) == ("missing_field", "pose")
    pose = {"translation": [9, 9, 0], "quaternion": [1, 0, 0, 0]}
    assert read(calibration, {"objects": objects(), "pose": pose}).frame == "sensor"


def test_a_calibration_that_cannot_be_used_is_one_error(calibration: Path) -> None:
    """At the start, with the path in the settings and in the file."""
    calibration.write_text("image = [1920, 1080]")
    with pytest.raises(ClientError, match=r"^setting inputs\.garage/\*/cam\*\.camera: \S+gate\.toml: "):
        reader(calibration)

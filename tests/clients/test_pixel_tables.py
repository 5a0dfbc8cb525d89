"""Tables of pixel boxes with `--camera`, from reading to tracks; the page docs/cameras.md."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from commands import result_of, run_here
from optipmb_tools.datasets.table import TableDataset
from optipmb_tools.files import DatasetError
from optipmb_tools.table_files import read_table, write_table
from real_data import REPOSITORY

import optipmb

GATE = """image = [1920, 1080]
{mount}
[pinhole]
intrinsics = [1050.0, 1050.0, 960.0, 540.0]
position = [0.0, 0.0, 6.0]
quaternion = [0.5, -0.5, 0.5, -0.5]
[error]
range = "ground"
tilt = 0.001
height = 0.02
"""


@pytest.fixture
def camera(tmp_path: Path) -> optipmb.GroundCamera:
    """Give a camera 6 m above the ground, whose calibration is gate.toml."""
    (tmp_path / "gate.toml").write_text(GATE.format(mount=""))
    (tmp_path / "car.toml").write_text(GATE.format(mount='mount = "vehicle"'))
    return optipmb.GroundCamera.read(tmp_path / "gate.toml")


def frames(camera: optipmb.GroundCamera) -> list[np.ndarray]:
    """Give the boxes (2, 4) of each frame: a car that passes, and one beyond the horizon; the third frame has none."""
    corners = np.array(np.meshgrid([-2.2, 2.2], [-0.9, 0.9], [0.0, 1.5])).reshape(3, 8).T
    found = []
    for k in range(30):
        pixels = camera.project(corners + np.array([30.0, -6.0 + 0.6 * k, 0.0]))
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        found.append(np.stack([box, [900.0, 100.0, 950.0, 200.0]]).round(2) if k != 2 else np.empty((0, 4)))
    return found


def write(path: Path, camera: optipmb.GroundCamera, names: str, pose: str = "") -> Path:
    """Write a table with boxes in columns of some names: of corners, or with a width and a height."""
    lines = [f"t,{names},class,score{',pose_x,pose_y,pose_z,pose_yaw' if pose else ''}"]
    for k, boxes in enumerate(frames(camera)):
        if "w" in names:
            boxes = np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])  # noqa: PLW2901  another form
        for box in boxes.tolist() or [[]]:
            values = ",".join(f"{value:.2f}" for value in box) or ",,,"
            lines.append(f"{0.1 * k:.1f},{values},{'car,0.9' if len(box) else ','}{pose}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_check_calls_sizes_unknown(capsys: pytest.CaptureFixture[str]) -> None:
    """Pixel boxes have no size in metres, and the table of classes says so."""
    sample = REPOSITORY / "examples" / "detectors"
    done = run_here(capsys, "check", sample / "pixel_boxes.csv", "--camera", sample / "gate.toml")
    assert "nan" not in done.stdout
    assert re.search(r"^car +car +29 +unknown ", done.stdout, re.MULTILINE)


def test_the_page_does_what_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files, commands and code of docs/cameras.md work as written, and print what stands there."""
    text = (REPOSITORY / "docs" / "cameras.md").read_text(encoding="utf-8")
    calibration, table, commands, code, printed = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)[:5]
    monkeypatch.chdir(tmp_path)
    Path("gate.toml").write_text(calibration)
    Path("boxes.csv").write_text(table)
    for line in commands.splitlines():
        assert run_here(capsys, *line.split()[1:]).returncode == 0
    assert len(read_table(Path("tracks.csv"))["t"]) == 6
    exec(compile(code, "cameras.md", "exec"), {})  # noqa: S102 - of this repository
    assert capsys.readouterr().out == printed


def test_a_table_gives_the_tracks_of_the_tracker(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], camera: optipmb.GroundCamera
) -> None:
    """`optipmb track --camera` and `OnlineTracker.update(camera=)` give the same tracks, an empty frame included."""
    table = write(tmp_path / "boxes.csv", camera, "x1,y1,x2,y2")
    out, gate = tmp_path / "t.csv", tmp_path / "gate.toml"
    options = ["--profile", "generic", "--digits", "full", "--verbose"]
    done = run_here(capsys, "track", table, "--camera", gate, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    assert "29 of 58 boxes have no place on the ground: 29 horizon" in done.stderr
    tracks, tracker = read_table(out), optipmb.OnlineTracker("generic")
    for k, boxes in enumerate(frames(camera)):
        online = tracker.update(
            {"box": boxes, "class": ["car"] * len(boxes), "score": [0.9] * len(boxes)}, t=0.1 * k, camera=camera
        )
        mine = np.flatnonzero(np.isclose(tracks["t"], 0.1 * k))
        np.testing.assert_allclose(tracks["x"][mine], online.center[:, 0], atol=1e-6)
        np.testing.assert_allclose(tracks["y"][mine], online.center[:, 1], atol=1e-6)
    assert np.unique(tracks["id"]).tolist() == [1]
    assert abs(tracks["x"][-1] - 30.0) < 1.0


@pytest.mark.parametrize(
    ("names", "options"),
    [
        ("bbox.x,bbox.y,bbox.w,bbox.h", ()),
        ("bb_left,bb_top,bb_width,bb_height", ()),
        ("bbox.0,bbox.1,bbox.2,bbox.3", ()),
        ("box_xmin,box_ymin,box_xmax,box_ymax", ("--option", "box=xyxy")),
    ],
)
def test_forms_of_boxes_are_one(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    camera: optipmb.GroundCamera,
    names: str,
    options: tuple[str, ...],
) -> None:
    """Corners, left, top, width and height, and lists of four under usual names give the same detections."""
    gate = tmp_path / "gate.toml"
    one = TableDataset(write(tmp_path / "a.csv", camera, "x1,y1,x2,y2"), {"camera": str(gate)})
    table = write(tmp_path / "b.csv", camera, names)
    found = result_of(run_here(capsys, "check", table, "--camera", gate, *options, "--json"))
    (text, _) = [one["text"] for one in found["findings"] if one["topic"] == "camera"]
    assert text.endswith(f"in columns {names.replace(',', ', ')}, 0% outside the image of 1920 x 1080")
    other = TableDataset(table, {"camera": str(gate)} | dict(one.split("=") for one in options[1:]))
    for first, second in zip(*(data.sequences(["all"])[0].frames() for data in (one, other)), strict=True):
        np.testing.assert_allclose(first.center, second.center, atol=0.05)


def test_a_width_is_no_corner(tmp_path: Path, camera: optipmb.GroundCamera) -> None:
    """Boxes read as corners that are sizes are refused with the line, the columns and the option that reads them."""
    table = write(tmp_path / "b.csv", camera, "bbox.0,bbox.1,bbox.2,bbox.3")
    values = {"camera": str(tmp_path / "gate.toml")}
    text = table.read_text().splitlines()
    (tmp_path / "c.csv").write_text("\n".join([text[0], "0.0,500,500,80,40,car,0.9", *text[1:]]))
    with pytest.raises(DatasetError, match=r"c\.csv:2: expected pixel boxes bbox\.0.*box=xywh"):
        TableDataset(tmp_path / "c.csv", values)
    data = TableDataset(tmp_path / "c.csv", values | {"box": "xywh"})
    assert any("outside the image" in note for note in data.notes)


def test_a_vehicle_brings_its_poses(tmp_path: Path, camera: optipmb.GroundCamera) -> None:
    """Boxes of a camera on a vehicle need its poses; at a pose that turns, they lie where the vehicle sees them."""
    gate = {"camera": str(tmp_path / "car.toml")}
    with pytest.raises(DatasetError, match="poses of the vehicle"):
        TableDataset(write(tmp_path / "a.csv", camera, "x1,y1,x2,y2"), gate)
    with pytest.raises(DatasetError, match="none of the vehicle"):
        TableDataset(
            write(tmp_path / "c.csv", camera, "x1,y1,x2,y2", ",0,0,0,0"), {"camera": str(tmp_path / "gate.toml")}
        )
    turned = TableDataset(write(tmp_path / "b.csv", camera, "x1,y1,x2,y2", f",5,7,0,{np.pi / 2}"), gate)
    fixed = TableDataset(tmp_path / "a.csv", {"camera": str(tmp_path / "gate.toml")})
    for here, there in zip(*(data.sequences(["all"])[0].frames() for data in (fixed, turned)), strict=True):
        assert there.field_of_view is not None
        rotations = [optipmb.Pose(*one.pose).rotation for one in (here, there)]
        (x, y), (moved_x, moved_y) = (
            (one.center[:, :2] @ turn[:2, :2].T + one.pose.translation[:2]).T
            for one, turn in zip((here, there), rotations, strict=True)
        )
        np.testing.assert_allclose([5.0 - y, 7.0 + x], [moved_x, moved_y], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("t,x1,y1,x2,y2\n0,1,2,3,4\n", (), "--camera FILE, the calibration"),
        ("t,x,y\n0,1,2\n", ("--camera", "gate.toml"), "expected pixel boxes: columns x1 y1 x2 y2"),
        ("t,x1,y1,x2,y2\n0,1,2,3,4\n", ("--camera", "none.toml"), "none.toml: expected the calibration"),
        ("t,x1,y1,x2,y2\n0,1,,3,4\n", ("--camera", "gate.toml"), "d.csv:2: expected pixel boxes"),
        ("t,u,v\n0,1,inf\n", ("--camera", "gate.toml"), "d.csv:2: expected finite pixels"),
        ("t,u,v\n0,1,5\n", ("--camera", "gate.toml", "--option", "scale=0"), "scale"),
        ("t,u,v\n0,1,5\n", ("--camera", "gate.toml", "--option", "box=ltrb"), "expected xyxy or xywh"),
    ],
)
def test_tables_that_no_camera_places_are_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    camera: optipmb.GroundCamera,
    text: str,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    """Pixels without a camera, a camera without pixels, and boxes that are none end with status 2 and say why."""
    del camera
    (tmp_path / "d.csv").write_text(text)
    words = [str(tmp_path / one) if one.endswith(".toml") else one for one in arguments]
    done = run_here(capsys, "track", tmp_path / "d.csv", *words, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert message in done.stderr


def test_middles_and_shares_are_read(tmp_path: Path, camera: optipmb.GroundCamera) -> None:
    """Boxes by their middles, in pixels or in shares of the image, are those of the corners."""
    plain = write(tmp_path / "a.csv", camera, "x1,y1,x2,y2")
    expected = TableDataset(plain, {"camera": str(tmp_path / "gate.toml")}).sequences(["all"])[0]
    rows = read_table(plain)
    boxes = np.column_stack([rows[name] for name in ("x1", "y1", "x2", "y2")])
    middles = np.column_stack([0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]])
    for names, scale, options in (
        (("xc", "yc", "w", "h"), 1.0, {}),
        (("x", "y", "w", "h"), 1.0, {"box": "cxcywh"}),
        (("x_center", "y_center", "width", "height"), np.array([1920, 1080, 1920, 1080]), {}),
    ):
        values = dict(zip(names, (middles / scale).T, strict=True))
        write_table(tmp_path / "b.csv", {"t": rows["t"], **values, "class": rows["class"], "score": rows["score"]})
        data = TableDataset(tmp_path / "b.csv", {"camera": str(tmp_path / "gate.toml"), **options})
        for one, other in zip(data.sequences(["all"])[0].frames(), expected.frames(), strict=True):
            assert np.allclose(one.center[:, :2], other.center[:, :2], atol=1e-3)


@pytest.mark.parametrize("whole", [True, False])
def test_boxes_of_coco_are_places(tmp_path: Path, camera: optipmb.GroundCamera, *, whole: bool) -> None:
    """Results of COCO and its annotations have left, top, width, height; without an option they are the same places."""
    gate = {"camera": str(tmp_path / "gate.toml")}
    plain = next(iter(TableDataset(write(tmp_path / "a.csv", camera, "x1,y1,x2,y2"), gate).sequences(["all"])))
    boxes = [
        {"image_id": k, "category_id": 3, "bbox": [*box[:2], box[2] - box[0], box[3] - box[1]], "score": 0.9}
        for k, frame in enumerate(frames(camera))
        for box in frame.tolist()
    ]
    images = [{"id": k, "file_name": f"{k}.jpg", "width": 1920, "height": 1080} for k in range(30)]
    content = {"images": images, "annotations": boxes, "categories": [{"id": 3, "name": "car"}]} if whole else boxes
    (tmp_path / "coco.json").write_text(json.dumps(content))
    options = gate | {"rate": "10"} | ({} if whole else {"class.3": "car"})
    sequence = next(iter(TableDataset(tmp_path / "coco.json", options).sequences(["all"])))
    assert sequence.labels == ("car",)
    found = {frame.stamp_ns: frame.center for frame in sequence.frames()}
    for frame in plain.frames():
        if len(frame):
            assert np.allclose(found[frame.stamp_ns][:, :2], frame.center[:, :2], atol=1e-6)


def test_usual_heights_are_named_and_less_exact(tmp_path: Path, camera: optipmb.GroundCamera) -> None:
    """On a vehicle, ranges by the usual height of a class have wider covariances than by one that the file states."""
    del camera
    own = tmp_path / "own.toml"
    text = (tmp_path / "car.toml").read_text().replace('range = "ground"', 'range = "height"')
    (tmp_path / "usual.toml").write_text(text)
    own.write_text(text + "[class.car]\nsize = [4.5, 1.9, 1.6]\n")
    pose = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    box = np.array([[900.0, 560.0, 960.0, 620.0]])
    usual, stated = (
        optipmb.GroundCamera.read(path).detections(box=box, label=["car"], pose=pose)["position_covariance"][0, 0, 0]
        for path in (tmp_path / "usual.toml", own)
    )
    assert usual > 1.5 * stated
    table = write(tmp_path / "a.csv", optipmb.GroundCamera.read(tmp_path / "gate.toml"), "x1,y1,x2,y2", ",0,0,0,0")
    for path, said in ((tmp_path / "usual.toml", True), (own, False)):
        notes = TableDataset(table, {"camera": str(path)}).notes
        assert any("usual heights of car" in one for one in notes) == said

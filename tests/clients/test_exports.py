"""Tracks in the forms of other tools, read by their libraries: GeoJSON, Moving Features JSON and OpenLABEL."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from geojson_pydantic import FeatureCollection
from openlabel_checker.core import check_file
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets.table import TableDataset
from optipmb_tools.table_files import read_table, write_table
from own_tables import FRAMES, boxes
from real_data import REPOSITORY

from optipmb import Georeference

ORIGIN = "48.26,11.67,489,30"
TIMES = ("--origin", ORIGIN, "--option", "time_origin=2026-11-27T08:00:00Z")
POSE = {"pose_x": 3.0, "pose_y": -2.0, "pose_z": 1.0, "pose_yaw": 0.4}


def tracked(capsys: pytest.CaptureFixture[str], out: Path, *arguments: object, **columns: Any) -> tuple[Any, str]:
    """Track a table of three objects; return the content of the file and what was said on it."""
    table = out.parent / "detections.csv"
    write_table(table, boxes(**columns))
    done = run_here(capsys, "track", table, "--out", out, "--profile", "generic", "--jobs", 1, *arguments)
    assert done.returncode == 0, done.stderr
    return (json.loads(out.read_text()) if out.suffix != ".csv" else read_table(out)), done.stderr


def confirmed(columns: dict[str, np.ndarray]) -> dict[int, dict[str, np.ndarray]]:
    """Return the rows of each confirmed track of a table."""
    shown = {name: values[columns["confirmed"] == 1] for name, values in columns.items()}
    return {n: {name: one[shown["id"] == n] for name, one in shown.items()} for n in np.unique(shown["id"]).tolist()}


def test_geojson_has_the_confirmed_tracks_where_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Places lead back to the table within a millimetre, with speeds, headings and times; a known reader takes it."""
    content, _ = tracked(capsys, tmp_path / "t.geojson", *TIMES)
    table, _ = tracked(capsys, tmp_path / "t.csv", *TIMES)
    FeatureCollection.model_validate(content)
    expected = confirmed(table)
    assert [one["properties"]["id"] for one in content["features"]] == list(expected)
    for feature, rows in zip(content["features"], expected.values(), strict=True):
        lon, lat, alt = np.array(feature["geometry"]["coordinates"]).T
        place = Georeference.parse(ORIGIN).to_world(lat, lon, alt)
        np.testing.assert_allclose(place, np.column_stack([rows[name] for name in "xyz"]), atol=1e-3)
        about = feature["properties"]
        speed = [
            None if np.isnan(vx) else float(np.hypot(vx, vy)) for vx, vy in zip(rows["vx"], rows["vy"], strict=True)
        ]
        assert about["speed"] == [None if one is None else pytest.approx(one, abs=2e-3) for one in speed]
        np.testing.assert_allclose(about["heading"], rows["heading"], atol=1e-4)
        assert about["times"][0] == about["start"] == f"2026-11-27T08:00:{rows['t'][0]:012.9f}Z"
        assert (about["class"], len(about["times"])) == (rows["class"][-1], len(lat))


def test_moving_features_are_what_readers_take(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Positions of two numbers, at least two of them, times that differ, units of three letters, ids of their own."""
    content, said = tracked(capsys, tmp_path / "t.mfjson", *TIMES)
    table, _ = tracked(capsys, tmp_path / "t.csv", *TIMES)
    several = {number: rows for number, rows in confirmed(table).items() if len(rows["x"]) > 1}
    assert [one["properties"]["track"] for one in content["features"]] == list(several)
    assert len({one["properties"]["id"] for one in content["features"]}) == len(several)
    assert ("tracks of one frame" in said) == (len(several) < len(confirmed(table)))
    for feature, rows in zip(content["features"], several.values(), strict=True):
        moving, (measures,) = feature["temporalGeometry"], feature["temporalProperties"]
        np.testing.assert_allclose(moving["coordinates"], np.column_stack((rows["lon"], rows["lat"])), atol=1e-9)
        assert len(set(moving["datetimes"])) == len(rows["x"])
        assert measures.pop("datetimes") == moving["datetimes"]
        assert {name: len(one["form"]) for name, one in measures.items()} == dict.fromkeys(measures, 3)
        np.testing.assert_allclose(measures["alt"]["values"], rows["alt"], atol=1e-3)


@pytest.mark.parametrize("pose", [{}, POSE])
def test_openlabel_is_valid_and_read_back_as_the_same_boxes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pose: dict[str, float]
) -> None:
    """All tracks of all frames, to a nanometre, from a sensor with and without poses; the checker finds no fault."""
    columns = {name: np.full(3 * FRAMES, value) for name, value in pose.items()}
    out = tmp_path / "t.openlabel.json"
    content, _ = tracked(capsys, out, "--full", **columns)
    table, _ = tracked(capsys, tmp_path / "t.csv", "--digits", "full", **columns)
    assert check_file(str(out)).issues == []
    whole = content["openlabel"]
    assert ("vehicle" in whole["coordinate_systems"]) == bool(pose)
    (cuboid,) = whole["frames"]["3"]["objects"]["1"]["object_data"]["cuboid"]
    assert [len(one["val"]) for one in cuboid["attributes"]["vec"]] == [2, 21]
    read = read_table(out)
    for name in (*"xyzlwh", "score"):
        np.testing.assert_allclose(read[name], table[name], atol=1e-9)
    np.testing.assert_allclose(np.sin(2 * np.arctan2(read["qz"], read["qw"]) - table["yaw"]), 0, atol=1e-9)
    assert (read["id"].astype(int) == table["id"]).all()
    truth = tmp_path / "detections.csv"
    done = run_here(capsys, "evaluate", truth, "--truth", out, "--tracks", tmp_path / "t.csv", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["classes"]["Car"]["all"]["MOTA"] == 1.0


def document(**changed: Any) -> dict[str, Any]:
    """Return a file of three frames: a cuboid in a lidar on a vehicle, an empty frame, and one that stands."""
    lidar = [1.0, 2.0, 0.5, 0.0, 0.0, 0.3, 4.0, 1.8, 1.5]
    turn = {"matrix4x4": [0.0, -1.0, 0.0, 10.0, 1.0, 0.0, 0.0, 20.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
    transforms = {"move": {"src": "vehicle", "dst": "map", "transform_src_to_dst": turn}}
    velocity = {"vec": [{"name": "velocity", "val": [3.0, 0.0]}], "num": [{"name": "confidence", "val": 0.5}]}
    shape = {"name": "s", "val": lidar, "coordinate_system": "lidar", "attributes": velocity}
    mast = {"quaternion": [0.0, 0.0, 0.0, 1.0], "translation": [0.0, 0.0, 2.0]}
    frames: dict[str, Any] = {
        str(k): {
            "frame_properties": {
                "timestamp": f"2026-11-27T{8 + k:02}:00:00.{k}00000000{zone}",
                "transforms": transforms,
            }
        }
        for k, zone in enumerate(("Z", "+01:00", "+0200"))
    }
    frames["0"]["objects"] = {"8c1f": {"object_data": {"type": "CAR", "cuboid": shape}}}
    frames["2"]["objects"] = {"8c1f": {"object_data": {"type": "CAR", "cuboid": [shape]}}}
    stands = {"name": "b", "val": [5.0, 6.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.8, 0.7, 1.8]}
    content = {
        "coordinate_systems": {
            "map": {"type": "scene_cs", "parent": ""},
            "vehicle": {"type": "local_cs", "parent": "map"},
            "lidar": {"type": "sensor_cs", "parent": "vehicle", "pose_wrt_parent": mast},
        },
        "frames": frames,
        "objects": {
            "8c1f": {"name": "a", "type": "vehicle"},
            "post": {
                "name": "post",
                "type": "PEDESTRIAN",
                "frame_intervals": [{"frame_start": 1, "frame_end": 2}],
                "object_data": {"cuboid": [stands]},
            },
        },
    }
    return {"openlabel": content | changed}


def test_openlabel_of_others_is_carried_to_the_world(tmp_path: Path) -> None:
    """Angles of Euler, shapes alone and in lists, systems in systems, objects that stand, and scores are read."""
    path = tmp_path / "a.json"
    path.write_text(json.dumps(document()))
    dataset = open_dataset("table", path)
    (sequence,) = dataset.sequences(["all"])
    first, second, third = sequence.frames()
    np.testing.assert_allclose(first.center, [[8.0, 21.0, 2.5]])  # R (1, 2) + (10, 20), and the mast
    np.testing.assert_allclose(first.yaw, [0.3 + np.pi / 2])
    assert first.velocity is not None
    np.testing.assert_allclose(first.velocity, [[0.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(first.score, [0.5])
    assert [len(one) for one in (first, second, third)] == [1, 1, 2]
    assert [first.labels[label] for label in (*first.label, *second.label)] == ["CAR", "PEDESTRIAN"]
    assert np.diff([one.stamp_ns for one in (first, second, third)]).tolist() == [100_000_000] * 2
    truth = sequence.truth()
    assert truth is not None
    assert sorted(truth.id.tolist()) == [0, 0, 1, 1]


VELOCITY = "frames.0.objects.8c1f.object_data.cuboid.attributes.vec[0]"


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("frames.0.objects.8c1f.object_data.cuboid.val", [1.0] * 8, "10 or 9 finite numbers"),
        ("frames.0.objects.8c1f.object_data.cuboid.val", "box", "got|received `str`|received"),
        ("frames.0.objects.8c1f.object_data.cuboid.coordinate_system", "radar", "one of map, vehicle, lidar"),
        ("frames.0.frame_properties.transforms", {}, "a transform of vehicle to map in openlabel.frames.0"),
        ("frames.0.frame_properties.timestamp", "noon", "frames.0.frame_properties.timestamp"),
        ("coordinate_systems.map.parent", "lidar", "a coordinate system without parent|transform of map"),
        ("objects.post.frame_intervals", 3, "openlabel.objects.post.frame_intervals"),
        (f"{VELOCITY}.val", "3 m/s", f"array.? at openlabel.{VELOCITY}.val.*received `?str"),
        (f"{VELOCITY}.val", [3.0, "fast"], f"float.? at openlabel.{VELOCITY}.val.1..*received `?str"),
        (f"{VELOCITY}.val", [3.0], f"2 or 3 finite numbers at openlabel.{VELOCITY}.val.*received .3.0."),
    ],
)
def test_a_fault_of_openlabel_is_named_by_its_place(tmp_path: Path, place: str, value: Any, said: str) -> None:
    """One error says where, what was expected and what was received."""
    content = document()
    *parents, last = place.replace("[", ".").replace("]", "").split(".")
    node = content["openlabel"]
    for name in parents:
        node = node[int(name) if name.isdecimal() and isinstance(node, list) else name]
    node[last] = value
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=said.replace("[", r"\[").replace("]", r"\]")):
        TableDataset(path)


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("t.geojson", (), "expected --origin"),
        ("t.mfjson", ("--origin", ORIGIN), "--option time_origin=TIME"),
        ("t.geojson", (*TIMES, "--full"), "--full"),
        ("t.geojson", ("--origin", ORIGIN, "--option", "time_origin=8:00"), "with its zone"),
        ("t.geojson", (*TIMES, "--rejoin"), "expected --ids object or a table"),
    ],
)
def test_what_a_form_cannot_hold_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, arguments: tuple[str, ...], said: str
) -> None:
    """Status 2, one line, and no file."""
    table = tmp_path / "detections.csv"
    write_table(table, boxes())
    done = run_here(capsys, "track", table, "--out", tmp_path / name, "--profile", "generic", *arguments)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr.splitlines()[-1]
    assert not (tmp_path / name).exists()


def test_a_file_of_openlabel_has_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of several, one has to be named."""
    table = tmp_path / "detections.csv"
    write_table(table, boxes(recording=np.repeat(["a", "b"], 3 * FRAMES // 2)))
    done = run_here(capsys, "track", table, "--out", tmp_path / "t.openlabel.json")
    assert done.returncode == 2
    assert "one recording by --sequences, received 2" in done.stderr


def test_the_commands_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each line of docs/standards.md for `optipmb`, in a folder of its own."""
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "standards.md").read_text()
    blocks = "".join(re.findall(r"^```sh\n(.*?)^```", page, re.DOTALL | re.MULTILINE))
    for line in re.findall(r"^optipmb .*", blocks, re.MULTILINE):
        done = run_here(capsys, *shlex.split(line)[1:])
        assert done.returncode == 0, done.stderr
    assert {"tracks.geojson", "tracks.mfjson", "tracks.openlabel.json", "again.csv"} <= {
        one.name for one in tmp_path.iterdir()
    }

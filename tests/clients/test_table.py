"""Own data: tables of detections in four formats, notes on their content, and tables of tracks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import result_of, run_here
from optipmb_tools.datasets import DataSequence, DatasetError, open_dataset
from optipmb_tools.datasets.table import TableDataset, TableSequence, match_stamps
from optipmb_tools.datasets.table.columns import find_columns
from optipmb_tools.run.tracking import Tracking, track_whole
from optipmb_tools.table_files import read_table, write_table
from own_tables import FRAMES, boxes

from optipmb import Georeference, load_profile

CLASSES = ("Car", "Pedestrian")


def table(path: Path, columns: Mapping[str, np.ndarray]) -> Path:
    write_table(path, columns)
    return path


def only(dataset: TableDataset) -> TableSequence:
    (sequence,) = dataset.sequences(["all"])
    assert isinstance(sequence, TableSequence)
    return sequence


def same(one: DataSequence, other: DataSequence) -> None:
    for a, b in zip(one.frames(), other.frames(), strict=True):
        assert a.stamp_ns == b.stamp_ns
        for name in ("center", "size", "yaw", "score"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)
        assert [a.labels[i] for i in a.label] == [b.labels[i] for i in b.label]


def notes_and_frames(path: Path, columns: Mapping[str, np.ndarray], **options: str) -> tuple[str, TableSequence]:
    dataset = TableDataset(table(path, columns), options)
    return " | ".join(dataset.notes), only(dataset)


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".jsonl", ".feather"])
def test_every_format_gives_the_same_frames(tmp_path: Path, suffix: str) -> None:
    """A table reads the same in every format, to the last bit."""
    plain = only(TableDataset(table(tmp_path / "plain.parquet", boxes())))
    other = only(TableDataset(table(tmp_path / f"other{suffix}", boxes())))
    assert len(other) == FRAMES
    same(plain, other)


STAMPS = np.repeat(np.arange(FRAMES) * 100_000_000 + 1_700_000_000_000_000_000, 3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"t": None, "stamp_ns": STAMPS}, ""),
        ({"t": None, "stamp": STAMPS.astype("datetime64[ns]")}, ""),
        ({"yaw": np.tile([0.0, 177.617, 5.72958], FRAMES)}, "yaw is in degrees"),
        ({"yaw": None, "heading_deg": np.tile([0.0, 177.617, 5.72958], FRAMES)}, ""),
        ({"score": np.tile([2.197, 1.386, -0.8473], FRAMES)}, "scores look like logits"),
        ({"score": np.tile([90.0, 80.0, 70.0], FRAMES)}, "scores look like percent"),
        ({"score": np.tile(["90%", "80 %", "70%"], FRAMES)}, "scores look like percent"),
    ],
)
def test_units_are_found_and_said(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    """Units that no name states are found in the values, and one line says so."""
    notes, sequence = notes_and_frames(tmp_path / "d.parquet", boxes(**changed))
    assert said in notes
    frames = list(sequence.frames())
    assert np.diff([frame.stamp_ns for frame in frames]) == pytest.approx(1e8, abs=300)
    assert frames[0].yaw == pytest.approx([0.0, 3.1, 0.1], abs=1e-5)
    assert frames[0].score == pytest.approx([0.9, 0.8, 0.7] if "score" not in changed or said.endswith("percent")
                                            else [0.9, 0.8, 0.3], abs=1e-4)  # fmt: skip


def test_sizes_in_another_order_are_found_where_no_name_says_the_order(tmp_path: Path) -> None:
    """`size` as height, width, length is recognised by the cars; columns l, w, h of that look are read as named."""
    hwl = {"l": None, "w": None, "h": None, "size_0": boxes()["h"], "size_1": boxes()["w"], "size_2": boxes()["l"]}
    notes, sequence = notes_and_frames(tmp_path / "a.csv", boxes(**hwl))
    assert "sizes are height, width, length, as the Car boxes have them (--option sizes=" in notes
    assert next(sequence.frames()).size[0] == pytest.approx([4.5, 1.9, 1.6])
    swapped = boxes(l=boxes()["h"], h=boxes()["l"])
    notes, sequence = notes_and_frames(tmp_path / "b.csv", swapped)
    assert "sizes look like height, width, length, not as their columns are named (--option sizes=hwl)" in notes
    assert next(sequence.frames()).size[0] == pytest.approx([1.6, 1.9, 4.5])
    _, sequence = notes_and_frames(tmp_path / "c.csv", swapped, sizes="hwl")
    assert next(sequence.frames()).size[0] == pytest.approx([4.5, 1.9, 1.6])


def test_camera_axes_are_refused_until_they_are_named(tmp_path: Path) -> None:
    """Boxes whose z runs over the road are not taken for z up; as camera boxes they stand where they are."""
    plain = boxes()
    camera = boxes(x=-plain["y"], y=-(plain["z"] - 0.5 * plain["h"]), z=plain["x"], yaw=-plain["yaw"] - np.pi / 2)
    with pytest.raises(DatasetError, match="axes=camera"):
        notes_and_frames(tmp_path / "a.csv", camera)
    _, sequence = notes_and_frames(tmp_path / "b.csv", camera, axes="camera")
    same(sequence, only(TableDataset(table(tmp_path / "c.csv", plain))))


def test_names_of_columns_are_many(tmp_path: Path) -> None:
    """Lists, dotted names, units in brackets and the names of other tools are found."""
    plain = boxes()
    other = {
        "timestamp [s]": plain["t"],
        "center.x": plain["x"],
        "center.y": plain["y"],
        "center.z": plain["z"],
        "dimensions.length": plain["l"],
        "Width (m)": plain["w"],
        "height_m": plain["h"],
        "Heading_rad": plain["yaw"],
        "confidence": plain["score"],
        "category_name": plain["class"],
        "weather": np.full(3 * FRAMES, "rain"),
    }
    notes, sequence = notes_and_frames(tmp_path / "a.csv", other)
    assert "columns not used: weather" in notes
    same(sequence, only(TableDataset(table(tmp_path / "b.csv", plain))))
    east = {name: values for name, values in {**plain, "pos_east": plain["x"]}.items() if name != "x"}
    with pytest.raises(DatasetError, match=r"a column x \(--option column.x=pos_east\)"):
        notes_and_frames(tmp_path / "c.csv", east)
    same(notes_and_frames(tmp_path / "d.csv", east, **{"column.x": "pos_east"})[1], sequence)
    for before in ("det_", "bbox3d_", "object_"):
        named = {"timeStamp": plain["t"], **{before + name: one for name, one in plain.items() if name != "t"}}
        same(notes_and_frames(tmp_path / f"{before}.csv", named)[1], sequence)
    nested = {"rotation.roll": 0.0 * plain["t"], "rotation.yaw": np.rad2deg(plain["yaw"])}
    turned = {name: one for name, one in plain.items() if name != "yaw"} | nested
    same(notes_and_frames(tmp_path / "e.csv", turned)[1], sequence)


@pytest.mark.parametrize(
    ("names", "stamp", "nanosec"),
    [
        (("sec", "nanosec"), "sec", "nanosec"),
        (("header.stamp.nanosec", "header.stamp.sec"), "header.stamp.sec", "header.stamp.nanosec"),
        (("stamp.nsecs", "stamp.secs"), "stamp.secs", "stamp.nsecs"),
        (("timestampSec", "timestampNsec"), "timestampSec", "timestampNsec"),
        (("t", "sec", "nanosec"), "t", None),
        (("stamp_nanosec",), "stamp_nanosec", None),
    ],
)
def test_nanoseconds_belong_to_a_column_of_seconds(names: tuple[str, ...], stamp: str, nanosec: str | None) -> None:
    """A column of nanoseconds is the second half of a stamp only where the stamp is a column of whole seconds."""
    found = find_columns(names, {})
    assert found["stamp"].name == stamp
    assert (found["nanosec"].name if "nanosec" in found else None) == nanosec


def test_lists_inside_rows_are_columns(tmp_path: Path) -> None:
    """JSON Lines with `center`, `size` and `velocity` as lists read as flat columns do."""
    plain = boxes()
    lines = [
        f'{{"t": {t}, "center": [{x}, {y}, {z}], "size": [{length}, {w}, {h}], "yaw": {yaw}, "score": {s}, '
        f'"class": "{c}", "velocity": [1.0, 2.0]}}'
        for t, x, y, z, length, w, h, yaw, s, c in zip(*(plain[name].tolist() for name in plain), strict=True)
    ]
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(lines))
    sequence = only(TableDataset(path))
    same(sequence, only(TableDataset(table(tmp_path / "b.csv", plain))))
    velocity = next(sequence.frames()).velocity
    assert velocity is not None
    assert velocity.tolist() == [[1.0, 2.0]] * 3


def test_recordings_and_sensors_are_told_apart_by_their_columns(tmp_path: Path) -> None:
    """Each recording and sensor is a sequence of its own; rows in any order come in the order of their stamps."""
    plain = boxes()
    twice = {name: np.concatenate([values, values])[::-1] for name, values in plain.items()}
    twice["log"] = np.repeat(["two", "one"], 3 * FRAMES)
    twice["lidar"] = np.full(6 * FRAMES, "front")
    dataset = TableDataset(table(tmp_path / "a.csv", twice))
    names = [one.name for one in dataset.sequences(["all"])]
    assert names == ["two.front", "one.front"]
    for one in dataset.sequences(["all"]):
        stamps = [frame.stamp_ns for frame in one.frames()]
        assert stamps == sorted(stamps)
        assert len(stamps) == FRAMES


def test_columns_of_covariances_are_those_of_the_positions(tmp_path: Path) -> None:
    """They reach the tracker along the axes of the boxes; a row without values has the noise of the profile."""
    xx, yy = np.tile([0.5, 2.0, np.nan], FRAMES), np.tile([0.25, 1.0, np.nan], FRAMES)
    columns = boxes(cov_xx=xx, cov_x_y=np.tile([0.1, 0.0, 0.0], FRAMES), var_y=yy)
    notes, sequence = notes_and_frames(tmp_path / "a.csv", columns)
    assert "not used" not in notes
    for frame in sequence.frames():
        found = frame.position_covariance
        assert found is not None
        assert found[0].tolist() == [[0.5, 0.1, 0.0], [0.1, 0.25, 0.0], [0.0, 0.0, 0.375]]
        assert found[1].tolist() == [[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.5]]
        assert np.isnan(found[2]).all()
    kitti = load_profile("kitti")
    noisy, plain = (
        list(track_whole(Tracking(kitti), one).tracks.values())
        for one in (sequence, only(TableDataset(table(tmp_path / "b.csv", boxes()))))
    )
    assert noisy[-1].covariance[1, 0, 0] > 1.2 * plain[-1].covariance[1, 0, 0]
    np.testing.assert_array_equal(noisy[-1].covariance[2], plain[-1].covariance[2])


@pytest.mark.parametrize(
    ("columns", "options", "error"),
    [
        ({"cov_xx": 1.0}, {}, "a column cov_yy"),
        ({"cov_xx": 1.0, "cov_yy": -1.0}, {}, "csv:2: expected variances of x and y from 1e-08"),
        ({"cov_xx": 1.0, "cov_yy": 1.0, "cov_xy": 1.0}, {}, "variances of x and y"),
        ({"cov_xx": 1.0, "cov_yy": np.inf}, {}, "variances of x and y"),
        ({"cov_xx": 1.0, "cov_yy": np.nan}, {}, "variances of x and y"),
        ({"cov_xx": 1.0, "cov_yy": 1.0}, {"axes": "camera"}, "z up"),
    ],
)
def test_what_is_no_covariance_is_refused(
    tmp_path: Path, columns: dict[str, float], options: dict[str, str], error: str
) -> None:
    """With the line and the expected value."""
    changed = boxes(**{name: np.full(3 * FRAMES, value) for name, value in columns.items()})
    with pytest.raises(DatasetError, match=error):
        TableDataset(table(tmp_path / "a.csv", changed), options)


def test_rows_with_wrong_covariances_are_left_out_when_asked(tmp_path: Path) -> None:
    """As rows with other wrong values are, and counted."""
    columns = boxes(cov_xx=np.tile([1.0, -1.0, 1.0], FRAMES), cov_yy=np.ones(3 * FRAMES))
    notes, sequence = notes_and_frames(tmp_path / "a.csv", columns, invalid="skip")
    assert f"{FRAMES} rows with covariances that are none are left out" in notes
    assert {len(frame) for frame in sequence.frames()} == {2}


def test_poses_carry_boxes_to_the_world(tmp_path: Path) -> None:
    """With columns of a pose boxes are in the frame of the sensor, and so is the truth, which comes in the world."""
    plain = boxes(ego_x=np.full(3 * FRAMES, 100.0), ego_y=np.zeros(3 * FRAMES), ego_yaw=np.full(3 * FRAMES, np.pi / 2))
    sequence = only(TableDataset(table(tmp_path / "a.csv", {**plain, "id": np.tile([1, 2, 3], FRAMES)})))
    truth = sequence.truth()
    assert truth is not None
    assert truth.center[0] == pytest.approx([100.0, 0.0, 0.8])
    assert truth.yaw[0] == pytest.approx(np.pi / 2)
    assert sequence.poses[0].quaternion == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_a_row_with_a_stamp_alone_is_a_frame_without_detections(tmp_path: Path) -> None:
    """Missing frames are counted and said; rows that hold nothing but their stamp are frames."""
    plain = boxes()
    kept = (plain["t"] < 0.95) | (plain["t"] > 1.25)
    some = {name: values[kept] for name, values in plain.items()}
    notes, sequence = notes_and_frames(tmp_path / "a.csv", some)
    assert "3 frames at 10 Hz have no row" in notes
    assert len(sequence) == FRAMES - 3
    text = (tmp_path / "a.csv").read_text() + "1.0,,,,,,,,,\n1.1,,,,,,,,,\n1.2,,,,,,,,,\n"
    (tmp_path / "b.csv").write_text(text)
    dataset = TableDataset(tmp_path / "b.csv")
    assert "no row" not in " ".join(dataset.notes)
    assert [len(frame) for frame in only(dataset).frames()] == [3] * 10 + [0] * 3 + [3] * 17


def test_stamps_match_the_nearest_frame() -> None:
    """A stamp belongs to the frame that is nearest, within half the time between frames."""
    stamps = np.arange(5) * 100
    assert match_stamps(stamps, np.array([0, 49, 51, 120, 400, 449, 460, -60])).tolist() == [0, 0, 1, 1, 4, 4, -1, -1]


def test_a_table_in_gives_a_table_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb track d.csv --out t.csv`: rows keep the times and name the detections; evaluation finds three tracks."""
    plain = boxes()
    data = table(tmp_path / "d.csv", plain)
    truth = {name: plain[name] for name in ("t", "x", "y", "z", "l", "w", "h", "yaw", "class")}
    table(tmp_path / "truth.csv", {**truth, "id": np.tile([1, 2, 3], FRAMES)})
    done = run_here(capsys, "track", data, "--out", tmp_path / "t.csv")
    assert done.returncode == 0, done.stderr
    assert "profile auto: " not in done.stderr
    tracks = read_table(tmp_path / "t.csv")
    assert sorted(set(tracks["t"].tolist())) == sorted(set(plain["t"].tolist()))
    rows = tracks["detection_row"][~np.isnan(tracks["detection_row"])].astype(int)
    assert len(rows) > 2.8 * FRAMES
    np.testing.assert_allclose(tracks["x"][: len(rows)], plain["x"][rows], atol=0.5)
    assert np.isfinite(tracks["vx"]).all()
    assert not np.isnan(tracks["vx"][tracks["age"] > 0.0]).any()
    asked = ("evaluate", data, "--truth", tmp_path / "truth.csv", "--tracks", tmp_path / "t.csv", "--json")
    figures = result_of(run_here(capsys, *asked))
    for name in CLASSES:
        assert figures["classes"][name]["all"]["MOTA"] == pytest.approx(1.0)
        assert figures["classes"][name]["all"]["IDS"] == 0


def test_latitude_and_longitude_stand_for_x_and_y(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both tables give the same tracks, with their places on the globe."""
    plain = boxes()
    place = Georeference((48.0, 11.0, 500.0))
    lat, lon, alt, _ = place.to_geographic(np.stack([plain[name] for name in "xyz"], axis=1))
    rest = {name: values for name, values in plain.items() if name not in "xyz"}
    data = [table(tmp_path / "d.csv", plain), table(tmp_path / "g.csv", {**rest, "lat": lat, "lon": lon, "alt": alt})]
    found = []
    for number, one in enumerate(data):
        out = tmp_path / f"{number}.csv"
        done = run_here(capsys, "track", one, "--origin", "48.0,11.0,500", "--out", out)
        assert done.returncode == 0, done.stderr
        found.append(read_table(out))
    for name in ("id", "x", "y", "z", "lat", "lon", "alt", "heading"):
        np.testing.assert_allclose(found[0][name], found[1][name], atol=1e-6)
    center = np.stack([found[0][name] for name in "xyz"], axis=1)
    np.testing.assert_allclose(found[0]["lat"], place.to_geographic(center).lat, atol=1e-12)
    assert run_here(capsys, "track", data[0], "--origin", "98,11,0", "--out", out).returncode == 2


def test_processes_evaluate_as_one_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`evaluate --jobs 2` prints what one process prints, for the classes of a scene and the tracks of two trackers."""
    data = ("--dataset", "scene", "--option", "frames=10", "--option", "clouds=0")
    for profile in ("scene", "kitti"):
        assert run_here(capsys, "track", *data, "--profile", profile, "--out", tmp_path / profile).returncode == 0
    tracks = ("--tracks", tmp_path / "scene", "--tracks", tmp_path / "kitti")
    one, two = (run_here(capsys, "evaluate", *data, *tracks, "--json", "--jobs", jobs) for jobs in "12")
    assert result_of(one)["trackers"]
    assert one.stdout == two.stdout


def test_other_datasets_are_written_as_tables_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A generated scene tracked into one table evaluates as its result files do, to their rounding."""
    data = ("--dataset", "scene", "--option", "frames=30", "--option", "clouds=0")
    for out in (tmp_path / "t.feather", tmp_path / "files"):
        assert run_here(capsys, "track", *data, "--out", out).returncode == 0
    figures = [
        result_of(run_here(capsys, "evaluate", *data, "--tracks", out, "--json"))["classes"]
        for out in (tmp_path / "t.feather", tmp_path / "files")
    ]
    for name, one in figures[1].items():
        assert figures[0][name]["all"]["MOTA"] == pytest.approx(one["all"]["MOTA"])
        assert figures[0][name]["gospa"]["all"]["GOSPA"] == pytest.approx(one["gospa"]["all"]["GOSPA"], abs=1e-5)


def test_a_dataset_is_guessed_from_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder of tables is a dataset of as many recordings; a file of no known kind is refused with the known ones."""
    for name in ("one", "two"):
        table(tmp_path / "many" / f"{name}.csv", boxes())
    dataset = open_dataset("table", tmp_path / "many")
    assert [one.name for one in dataset.sequences(["all"])] == ["one", "two"]
    (tmp_path / "a.xyz").write_text("nothing")
    done = run_here(capsys, "track", tmp_path / "a.xyz")
    assert done.returncode == 2
    assert "expected a table (.csv, .parquet, .jsonl, .json, .feather)" in done.stderr


def test_text_has_the_digits_of_its_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """CSV and JSON Lines hold the same short numbers, Parquet and `--digits full` every bit."""
    data = table(tmp_path / "d.csv", boxes())
    found: dict[str, Any] = {}
    for name in ("a.csv", "a.jsonl", "a.parquet", "full.csv"):
        more = ("--digits", "full") if name == "full.csv" else ()
        assert run_here(capsys, "track", data, "--out", tmp_path / name, *more).returncode == 0
        found[name] = read_table(tmp_path / name)
    for name, doubles in found["a.parquet"].items():
        if doubles.dtype.kind == "f":
            unit = 1e-3 if name in {"vx", "vy", "acceleration"} else 1e-4
            np.testing.assert_array_equal(found["full.csv"][name], doubles)
            np.testing.assert_array_equal(found["a.csv"][name], found["a.jsonl"][name])
            np.testing.assert_allclose(found["a.csv"][name], doubles, rtol=0.0, atol=0.5001 * unit)
    fields = (tmp_path / "a.csv").read_text().replace("\n", ",").split(",")
    assert max(len(field.partition(".")[2]) for field in fields) == 4
    assert "--digits: expected unit or full" in run_here(capsys, "track", data, "--digits", "x").stderr

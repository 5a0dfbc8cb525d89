"""Files as people have them: text tables of other countries, dates, and the results of detectors."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from commands import run_here
from optipmb_tools.camera import kitti_from_sensor
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.table_files import Columns, line_of, read_table, write_table
from own_tables import FRAMES, boxes
from pyarrow import parquet

PLAIN = "t,x,class\n0.0,1.5,car\n0.1,-2.25,Fuß\n"


def same(one: Columns, other: Columns) -> None:
    assert list(one) == list(other)
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name])


@pytest.mark.parametrize(
    ("name", "text", "encoding", "options"),
    [
        ("semicolons.csv", PLAIN.replace(",", ";"), "utf-8", {}),
        ("decimals.csv", PLAIN.replace(",", ";").replace(".", ","), "utf-8", {}),
        ("quoted.csv", 't,x,class\n"0,0","1,5",car\n"0,1","-2,25",Fuß\n', "utf-8", {}),
        ("said.csv", PLAIN.replace(",", ";").replace(".", ","), "utf-8", {"decimal": ","}),
        ("comments.csv", "# made by hand\n\n" + PLAIN.replace("0.1", "# half\n0.1"), "utf-8", {}),
        ("numpy.txt", "# " + PLAIN.replace(",", " "), "utf-8", {}),
        ("percent.csv", "% units: metres, seconds\n// a run\n" + PLAIN, "utf-8", {}),
        ("pipes.csv", PLAIN.replace(",", "|"), "utf-8", {}),
        ("title.csv", "Detections of run 5, in the yard\n\nroom 2\n" + PLAIN, "utf-8", {}),
        ("excel.csv", "sep=;\n" + PLAIN.replace(",", ";"), "utf-8", {}),
        ("trailing.csv", PLAIN.replace("\n", ",\n"), "utf-8", {}),
        ("trailing_rows.csv", PLAIN.replace("\n", ",\n").replace("class,", "class"), "utf-8", {}),
        ("trailing_names.csv", PLAIN.replace("class", "class,"), "utf-8", {}),
        ("blanks.txt", PLAIN.replace(",", "   ").replace("\n", "  \n  "), "utf-8", {}),
        ("tabs.txt", PLAIN.replace(",", "\t"), "utf-8", {}),
        ("windows.csv", PLAIN.replace("\n", "\r\n"), "utf-8-sig", {}),
        ("utf16.csv", PLAIN, "utf-16", {}),
        ("utf16le.csv", PLAIN, "utf-16-le", {"encoding": "utf-16-le"}),
        ("latin.csv", PLAIN, "latin-1", {"encoding": "latin-1"}),
    ],
)
def test_text_tables_of_other_countries(
    name: str, text: str, encoding: str, options: dict[str, str], tmp_path: Path
) -> None:
    """A text table reads the same with other separators, decimals, comments, line ends and encodings."""
    (tmp_path / "plain.csv").write_text(PLAIN, encoding="utf-8")
    (tmp_path / name).write_bytes(text.encode(encoding))
    same(read_table(tmp_path / name, options), read_table(tmp_path / "plain.csv"))


def test_a_row_of_units_is_part_of_the_names(tmp_path: Path) -> None:
    """Units below the names of the columns are read as in the names; lines are counted with them."""
    (tmp_path / "a.csv").write_text("a, title\nt,x,yaw,class\n[s],[m],[deg],-\n0.0,1.5,90.0,car\n", encoding="utf-8")
    assert list(read_table(tmp_path / "a.csv")) == ["t [s]", "x [m]", "yaw [deg]", "class"]
    assert line_of(tmp_path / "a.csv", 0) == 4


def test_texts_of_lists_are_lists(tmp_path: Path) -> None:
    """Lists and structures are read as data frames and numpy write them into CSV; a list of one is its value."""
    text = """t;center;size;kind;note
0.0;[1.0, 2.0, nan];[4.5  1.9\t1.6];['car'];[a]
0.1;[3, 4, 5];[4.5 1.9 1.6];['car'];(b
"""
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    columns = read_table(tmp_path / "a.csv")
    assert list(columns) == ["t", *(f"{name}.{i}" for name in ("center", "size") for i in range(3)), "kind", "note"]
    np.testing.assert_array_equal(columns["center.2"], [np.nan, 5.0])
    assert columns["size.0"].tolist() == [4.5, 4.5]
    assert columns["kind"].tolist() == ["car", "car"]
    (tmp_path / "b.csv").write_text("t;center\n0.0;{'x': 1.0, 'y': 2.0}\n", encoding="utf-8")
    assert list(read_table(tmp_path / "b.csv")) == ["t", "center.x", "center.y"]


ISO = ("2024-05-01T10:00:00.100Z", "2024-05-01T10:00:00.200Z")


def test_dates_of_iso_8601_may_be_without_separators(tmp_path: Path) -> None:
    """20240501T100000.100Z is a date, also with a zone."""
    for name, texts in {
        "basic": ("20240501T100000.1Z", "20240501T100000.2Z"),
        "zone": ("20240501T113000.1+0130",),
    }.items():
        (tmp_path / f"{name}.csv").write_text("\n".join(("t", *texts)), encoding="utf-8")
        found = read_table(tmp_path / f"{name}.csv")["t"]
        np.testing.assert_array_equal(found, np.array([one[:-1] for one in ISO], dtype="datetime64[ns]")[: len(texts)])


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".jsonl", ".json", ".parquet", ".feather"])
@pytest.mark.parametrize(
    ("texts", "options"),
    [
        (ISO, {}),
        ([text.replace("T", " ").removesuffix("Z") for text in ISO], {}),
        ([text.replace("T10", "T12").replace("Z", "+02:00") for text in ISO], {}),
        ([text.replace("T", " ").replace("Z", " UTC") for text in ISO], {}),
        ([text.replace("2024-05-01T", "01/05/2024 ").removesuffix("Z") for text in ISO], {"date": "dmy"}),
        ([text.replace("2024-05-01T", "5/1/2024 ").removesuffix("Z") for text in ISO], {"date": "mdy"}),
        ([text.replace("2024-05-01T", "01.05.2024 ").removesuffix("Z") for text in ISO], {}),
        ([text.replace("2024-05-01T", "2024/05/01 ").removesuffix("Z") for text in ISO], {}),
    ],
)
def test_dates_are_stamps_in_every_format(
    suffix: str, texts: list[str], options: dict[str, str], tmp_path: Path
) -> None:
    """Dates as text are read to the nanosecond in every format, with a zone or without."""
    path = tmp_path / f"d{suffix}"
    if suffix == ".json":
        path.write_text(json.dumps([{"t": text} for text in texts]))
    else:
        write_table(path, {"t": np.array(texts)})
    stamps = read_table(path, options)["t"]
    assert stamps.astype(np.int64).tolist() == [1714557600100000000, 1714557600200000000]


def test_the_day_is_found_where_a_number_exceeds_twelve(tmp_path: Path) -> None:
    """13/01/2025 has the day first and 01/13/2025 the month; 12/01/2025 and 01/12/2025 are refused with the option."""
    found = []
    for text in ("13/01/2025 10:00:00", "01/13/2025 10:00:00"):
        (tmp_path / "d.csv").write_text(f"t,x\n03/01/2025 10:00:00,1\n{text},2\n")
        found.append(read_table(tmp_path / "d.csv")["t"].astype("datetime64[D]").astype(str).tolist())
    assert found == [["2025-01-03", "2025-01-13"], ["2025-03-01", "2025-01-13"]]
    (tmp_path / "d.csv").write_text("t,x\n12/01/2025 10:00:00,1\n01/12/2025 10:00:00,1\n")
    with pytest.raises(DatasetError, match="--option date=dmy"):
        read_table(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("name", "content", "options", "said"),
    [
        ("d.csv", "t,x\n2024-05-01 10:00:00.1,1\n2024-05-01 10:00,2\nsoon,3\n", {}, ":4: expected a date as YYYY"),
        ("d.jsonl", '{"t": "2024-05-01T10:00:00.1Z"}\n{"t": "2024-05-01T10:00:00.2"}\n', {}, ":2: expected a date as"),
        ("d.csv", b"t,class\n1,Fu\xdf\n", {}, ":2: expected text in UTF-8 (--option encoding=latin-1"),
        ("d.csv", "t,x\n1,2\n".encode("utf-16-le"), {}, "--option encoding=latin-1, cp1252, gbk or utf-16-le"),
        ("d.csv", "t,x\n", {"encoding": "klingon"}, "--option encoding: expected latin-1"),
        (
            "d.csv",
            "t;x;y\n1,5;2.5;1\n",
            {},
            "(--option decimal=. or decimal=, says which), received commas in column t",
        ),
        ("d.csv", "t,x\n", {"decimal": ";"}, "--option decimal: expected a comma or a point"),
        (
            "d.jsonl",
            '{"t": "1/5/2024 10:00"}\n',
            {"date": "ymd"},
            "--option date=dmy (day first) or date=mdy, received 'ymd' for column t",
        ),
        ("d.csv", "t,x\n1,2\n3\n", {}, "d.csv:3: expected 2 fields in each row"),
        (
            "d.txt",
            "0 1 Car 0 0 -1.5 1 2 3 4 1.5 1.6 4.2 1 1.6 20 1.57\n",
            {},
            "--dataset kitti reads a folder of it",
        ),
        ("d.txt", "1,1,794.2,247.5,71.2,174.8,-1,-1,-1,-1\n", {}, "image boxes as of MOTChallenge"),
        ("d.txt", "1,1,794.2,247.5,71.2,174.8,1,1,0.86\n", {}, "image boxes as of MOTChallenge"),
        ("d.parquet", "version https://git-lfs.github.com/spec/v1\noid sha256:0\n", {}, "git lfs pull"),
        ("d.csv", "<!DOCTYPE html>\n<html>\n", {}, "a page of HTML"),
        ("d.csv", "PK\3\4and more", {}, "a ZIP archive or a spreadsheet"),
        ("d.pkl", "anything", {}, "a result.pkl of OpenPCDet"),
        ("d.npy", "anything", {}, "a table (.csv, .tsv, .parquet, .jsonl, .ndjson, .feather, .arrow, .json, .txt)"),
        ("d.xlsx", "anything", {}, "a table (.csv, .tsv, .parquet, .jsonl, .ndjson, .feather, .arrow, .json, .txt)"),
        ("d.json", '{"meta": {}, "results": {"a": []}}', {}, "--dataset nuscenes --root ROOT --detections"),
        ("d.json", '[{"x": 1},\n {"x": }]', {}, ":2: expected JSON"),
        ("d.json", '{"x": 1}', {}, "an array of objects, or an object with a list bboxes_3d"),
        ("d.txt", "Car 0 0 0 1 2 3 4 1.5 1.6 4.2 1 1.6 20 1.57 0.9\n", {}, "name their folder"),
    ],
)
def test_what_cannot_be_read_is_refused_with_what_can(
    name: str, content: Any, options: dict[str, str], said: str, tmp_path: Path
) -> None:
    """A file that is no table, or can be read in two ways, is refused with the row and the option that reads it."""
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DatasetError) as refused:
        read_table(path, options)
    assert said in str(refused.value)
    assert "np." not in str(refused.value)


def test_a_header_alone_gives_columns_without_rows(tmp_path: Path) -> None:
    """A table without rows has its columns, with a line end and without."""
    for text in ("t,x,class\n", "t,x,class"):
        (tmp_path / "d.csv").write_text(text)
        assert {name: len(values) for name, values in read_table(tmp_path / "d.csv").items()} == dict.fromkeys(
            ("t", "x", "class"), 0
        )


def test_lines_are_counted_with_comments_and_blank_lines(tmp_path: Path) -> None:
    """The line of a row is the line in the file, also after rows left out."""
    (tmp_path / "d.csv").write_text("# made by hand\nt,x\n\n1,2\n# later\n3,4\n")
    assert [line_of(tmp_path / "d.csv", row) for row in (0, 1)] == [4, 6]
    (tmp_path / "d.txt").write_text("# t x\n1 2\n3 4\n")
    assert [line_of(tmp_path / "d.txt", row) for row in (0, 1)] == [2, 3]


def frames_of(path: Path, **options: str) -> list[tuple[Any, ...]]:
    (sequence,) = open_dataset("table", path, **options).sequences(["all"])
    return [
        (
            *(np.round(getattr(one, name), 4).tolist() for name in ("center", "size", "yaw", "score")),
            [one.labels[i] for i in one.label],
            None if one.velocity is None else one.velocity.tolist(),
        )
        for one in sequence.frames()
    ]


def lists() -> list[dict[str, Any]]:
    columns = boxes(vx=np.tile([8.0, -6.0, 1.0], FRAMES), vy=np.zeros(3 * FRAMES))
    rows = np.column_stack([columns[name] for name in ("x", "y", "z", "l", "w", "h", "yaw", "vx", "vy")])
    return [
        {
            "name": columns["class"][3 * i : 3 * i + 3].tolist(),
            "score": columns["score"][3 * i : 3 * i + 3].tolist(),
            "boxes_lidar": rows[3 * i : 3 * i + 3].tolist(),
        }
        for i in range(FRAMES)
    ]


def flat(tmp_path: Path, **changed: Any) -> list[tuple[Any, ...]]:
    velocity = {"vx": np.tile([8.0, -6.0, 1.0], FRAMES), "vy": np.zeros(3 * FRAMES)}
    write_table(tmp_path / "flat.parquet", boxes(**(velocity | changed)))
    return frames_of(tmp_path / "flat.parquet")


@pytest.mark.parametrize("suffix", [".jsonl", ".json"])
def test_a_row_may_hold_the_boxes_of_a_frame(suffix: str, tmp_path: Path) -> None:
    """Frames of OpenPCDet with lists of boxes, some empty, give the frames of a flat table."""
    frames = [{"t": i / 10, **one} for i, one in enumerate(lists())]
    frames.insert(7, {"t": 0.65, "name": [], "score": [], "boxes_lidar": []})
    lines = "\n".join(map(json.dumps, frames))
    (tmp_path / f"d{suffix}").write_text(lines if suffix == ".jsonl" else json.dumps(frames))
    found = frames_of(tmp_path / f"d{suffix}")
    assert found[7][0] == []
    assert found[:7] + found[8:] == flat(tmp_path)


@pytest.mark.parametrize("form", ["frames", "numbers", "names", "stamps", "ids", "lists"])
def test_frames_of_a_file_are_found_by_their_names(form: str, tmp_path: Path) -> None:
    """A file of JSON may have the list of frames among other values, or frames by their numbers, names or stamps."""
    columns = boxes(**{"class": None, "score": None})
    rows = [{name: values[i].item() for name, values in columns.items() if name != "t"} for i in range(3 * FRAMES)]
    frames = [rows[i : i + 3] for i in range(0, len(rows), 3)]
    content: Any = {
        "frames": {"version": 1, "frames": [{"t": i / 10, "objects": one} for i, one in enumerate(frames)]},
        "numbers": {f"{i}": one for i, one in enumerate(frames)},
        "names": {f"scan_{i:04}.bin": {"objects": one} for i, one in enumerate(frames)},
        "stamps": {f"{1_700_000_000_000_000_000 + 10**8 * i}": one for i, one in enumerate(frames)},
        "ids": {"frames": {f"{i}": {f"{k}": box for k, box in enumerate(one)} for i, one in enumerate(frames)}},
        "lists": {f"{i}": [[box[name] for name in (*"xyzlwh", "yaw")] for box in one] for i, one in enumerate(frames)},
    }[form]
    (tmp_path / "d.json").write_text(json.dumps(content), encoding="utf-8")
    write_table(tmp_path / "flat.parquet", columns)
    assert frames_of(tmp_path / "d.json") == frames_of(tmp_path / "flat.parquet")


def test_lists_of_different_lengths_are_told_as_not_used(tmp_path: Path) -> None:
    """A column of lists that have no common length is no number, and is named."""
    rows = [{name: values[i].item() for name, values in boxes().items()} | {"hits": [1] * (i % 3)} for i in range(9)]
    (tmp_path / "d.jsonl").write_text("\n".join(map(json.dumps, rows)))
    assert any("columns not used: hits" in note for note in open_dataset("table", tmp_path / "d.jsonl").notes)


def test_objects_of_a_file_are_its_rows(tmp_path: Path) -> None:
    """JSON arrays of records, and an object with a list of them, read as a flat table does."""
    columns = {name: values.tolist() for name, values in boxes(vx=np.ones(3 * FRAMES), vy=np.ones(3 * FRAMES)).items()}
    records = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    expected = flat(tmp_path, vx=np.ones(3 * FRAMES), vy=np.ones(3 * FRAMES))
    for content in (records, {"version": 1, "detections": records}, {"frames": records}):
        (tmp_path / "d.json").write_text(json.dumps(content))
        assert frames_of(tmp_path / "d.json") == expected


def test_a_folder_of_mmdetection3d_is_one_recording(tmp_path: Path) -> None:
    """`preds/*.json` are the frames of one recording by the numbers in their names; boxes stand on their bottoms."""
    (tmp_path / "preds").mkdir()
    for i, one in enumerate(lists()):
        bottoms = [[*box[:2], box[2] - 0.5 * box[5], *box[3:]] for box in one["boxes_lidar"]]
        frame = {"labels_3d": [0, 0, 1], "scores_3d": one["score"], "bboxes_3d": bottoms, "box_type_3d": "LiDAR"}
        if i == 5:
            frame |= {"labels_3d": [], "scores_3d": [], "bboxes_3d": []}
        (tmp_path / "preds" / f"{i + 95}.json").write_text(json.dumps(frame))
    found = frames_of(tmp_path / "preds", rate="10", **{"class.0": "Car", "class.1": "Pedestrian"})
    expected = flat(tmp_path)
    assert found[5][0] == []
    assert found[:5] + found[6:] == expected[:5] + expected[6:]
    columns = read_table(tmp_path / "preds")
    assert columns["frame"][[0, -1]].tolist() == [95, 94 + FRAMES]
    assert set(columns["labels_3d"].tolist()) == {"0", "1", ""}


def test_stamps_in_the_names_of_files_are_stamps(tmp_path: Path) -> None:
    """Names of files that end with a time give a column of stamps."""
    (tmp_path / "preds").mkdir()
    for stamp in (1532402927647951, 1532402928147847):
        frame = {"labels_3d": [0], "scores_3d": [0.5], "bboxes_3d": [[1, 2, 0, 4, 2, 1.5, 0]], "box_type_3d": "LiDAR"}
        (tmp_path / "preds" / f"n015-2018__LIDAR_TOP__{stamp}.json").write_text(json.dumps(frame))
    assert read_table(tmp_path / "preds")["timestamp"].tolist() == [1532402927647951, 1532402928147847]


def test_a_folder_of_kitti_object_results_is_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`.txt` files of KITTI's object benchmark are frames by their numbers, with the axes of a camera."""
    (tmp_path / "pred").mkdir()
    for i, one in enumerate(lists()):
        rows = np.array(one["boxes_lidar"])
        bottom, hwl, turn = kitti_from_sensor(rows[:, :3], rows[:, 3:6], rows[:, 6])
        values = np.column_stack((hwl, bottom, turn, one["score"]))
        lines = [
            f"{name} -1 -1 0.0 0 0 10 10 {' '.join(map(str, row))}\n"
            for name, row in zip(one["name"], values.tolist(), strict=True)
        ]
        (tmp_path / "pred" / f"{i:06d}.txt").write_text("" if i == 5 else "".join(lines) + "DontCare" + " -1" * 15)
    found = frames_of(tmp_path / "pred", rate="10")
    expected = [(*one[:5], None) for one in flat(tmp_path)]
    assert found[5][0] == []
    assert found[:5] + found[6:] == expected[:5] + expected[6:]
    done = run_here(capsys, "track", tmp_path / "pred", "--option", "rate=10", "--out", tmp_path / "t.csv")
    assert done.returncode == 0, done.stderr
    (tmp_path / "pred" / "000003.txt").write_text("Car 0 0 0 1 2\n")
    with pytest.raises(DatasetError, match=r"000003.txt:1: expected 8 fields"):
        read_table(tmp_path / "pred")


def test_a_folder_reads_its_tables_and_no_notes(tmp_path: Path) -> None:
    """A text or JSON file next to tables is no recording."""
    (tmp_path / "many").mkdir()
    write_table(tmp_path / "many" / "a.csv", boxes())
    (tmp_path / "many" / "README.txt").write_text("Boxes of a car park.\n")
    (tmp_path / "many" / "settings.json").write_text("{}")
    assert [one.name for one in open_dataset("table", tmp_path / "many").sequences(["all"])] == ["a"]


def test_a_column_that_is_text_in_one_frame_is_text(tmp_path: Path) -> None:
    """Classes of a folder with a table for each frame are read as from one table."""
    for i, labels in enumerate((["Car"], [7, 7, 8])):
        rows = [f"{k + 1},2,0,4,2,1.5,0.1,0.9,{label}\n" for k, label in enumerate(labels)]
        (tmp_path / f"{i:06d}.csv").write_text("x,y,z,length,width,height,yaw,score,label\n" + "".join(rows))
    (sequence,) = open_dataset("table", tmp_path, rate="10").sequences(["all"])
    assert [one.labels[n] for one in sequence.frames() for n in one.label] == ["Car", "7", "7", "8"]


@pytest.mark.parametrize("name", ["x.json", "x.xlsx", "x.csv.gz", "x.txt"])
@pytest.mark.parametrize("command", ["track", "replay"])
def test_results_are_refused_in_an_unknown_format_before_tracking(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--out` with the suffix of an unknown format ends with status 2 and the formats that are written."""
    write_table(tmp_path / "d.csv", boxes())
    done = run_here(capsys, command, tmp_path / "d.csv", "--out", tmp_path / name)
    assert done.returncode == 2
    assert "a folder, or a table (.csv, .tsv, .parquet" in done.stderr.splitlines()[-1]
    assert [file.name for file in tmp_path.iterdir()] == ["d.csv"]


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".json", ".parquet"])
@pytest.mark.parametrize("first", [1_700_000_000_000_000_001, 2**64 - 1])
def test_integers_keep_their_digits_where_one_is_missing(first: int, suffix: str, tmp_path: Path) -> None:
    """Integers of 64 bits, signed or not, are read to the last digit, also in a column with an empty cell."""
    path = tmp_path / f"d{suffix}"
    values = [first, None, first - 2]
    if suffix == ".csv":
        path.write_text("a,t\n" + "".join(f"1,{'' if one is None else one}\n" for one in values))
    elif suffix == ".parquet":
        parquet.write_table(pa.table({"t": pa.array(values, pa.uint64())}), path)
    else:
        records = [{"t": one} for one in values]
        lines = "\n".join(map(json.dumps, records))
        path.write_text(json.dumps(records) if suffix == ".json" else lines)
    assert read_table(path)["t"].tolist() == ["" if one is None else str(one) for one in values]


def test_a_missing_stamp_among_long_ones_is_named_with_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An empty cell in a column of nanoseconds ends with the line of the cell."""
    stamps = 1_700_000_000_000_000_000 + np.repeat(np.arange(FRAMES), 3) * 100_000_000
    texts = stamps.astype(np.str_)
    texts[50] = ""
    write_table(tmp_path / "d.csv", boxes(t=None, stamp_ns=texts))
    done = run_here(capsys, "track", tmp_path / "d.csv", "--out", tmp_path / "t.csv")
    assert done.returncode == 2
    assert "d.csv:52: expected a stamp in column stamp_ns" in done.stderr.splitlines()[-1]


def test_json_lines_may_be_long_and_of_several_types(tmp_path: Path) -> None:
    """A line of several megabytes is read, and one that pyarrow refuses is named."""
    frames = [{"t": t, "boxes": [[0.1234567 + i, 1.0, 0.8, 4.5, 1.9, 1.6, 0.0] for i in range(40_000)]} for t in (0, 1)]
    path = tmp_path / "d.jsonl"
    path.write_text("\n".join(map(json.dumps, frames)))
    assert len(read_table(path)["boxes.0"]) == 80_000
    path.write_text('{"x": 1.5}\r\n\r\n{"x": "two"}\r\n')
    assert read_table(path)["x"].tolist() == ["1.5", "two"]
    path.write_text('{"x": 1.5}\n{"x": }\n')
    with pytest.raises(DatasetError, match=r"d.jsonl:2: expected an object of JSON in every line"):
        read_table(path)


@pytest.mark.parametrize("how", ["\r\n", "\ufeff", "\t", "first"])
def test_frames_of_kitti_are_read_as_other_systems_write_them(how: str, tmp_path: Path) -> None:
    """Line ends of Windows, a byte order mark, tabs, and a first file with nothing but a line end change no box."""
    for folder in ("plain", "changed"):
        (tmp_path / folder).mkdir()
        for i in range(3):
            text = f"Car 0.00 0 0.0 1 2 3 4 1.5 1.9 4.5 {i} 1.6 20 0.1 0.9\n" * 2 if i else "\n"
            if folder == "changed" and i:
                text = {"\r\n": text.replace("\n", "\r\n"), "\ufeff": "\ufeff" + text}.get(how, text)
                text = text.replace(" ", "\t") if how == "\t" else text
            elif not i and how != "first":
                text = "Car 0.00 0 0.0 1 2 3 4 1.5 1.9 4.5 0 1.6 20 0.1 0.9\n"
            (tmp_path / folder / f"{i:06d}.txt").write_bytes(text.encode())
    same(read_table(tmp_path / "changed"), read_table(tmp_path / "plain"))

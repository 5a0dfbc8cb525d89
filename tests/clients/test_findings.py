"""Tables of unknown sources: correct columns are read, wrong ones are refused or named with the remedy."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from optipmb_tools.datasets import DatasetError
from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.table import TableDataset
from optipmb_tools.datasets.table.findings import Claim, Finding, Reading
from optipmb_tools.results.output import TrackCounts
from optipmb_tools.run.profiles import profile_for
from optipmb_tools.run.tracking import Tracking, track_whole
from optipmb_tools.table_files import write_table
from own_tables import boxes
from streets import CARS, PERIOD, Table, street


def looked(path: Path, columns: Table, **options: str) -> tuple[TableDataset, list[Finding]]:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table(path, columns)
    findings: list[Finding] = []
    return TableDataset(path, options, lenient=True, findings=findings), findings


def troubles(path: Path, columns: Table, **options: str) -> list[str]:
    return [f"{one.text} {one.option}" for one in looked(path, columns, **options)[1] if one.wrong or one.doubt]


@pytest.mark.parametrize("changed", [{}, {"ray": 0.03}, {"ray": 0.08}, {"copies": 5}, {"parked": 8}, {"parked": 0}])
def test_right_tables_have_no_doubtful_finding(tmp_path: Path, changed: dict[str, Any]) -> None:
    """Jitter along the ray is no motion, and boxes before suppression are no frames that were merged."""
    assert troubles(tmp_path / "d.csv", street(**changed)) == []


def test_of_two_columns_with_one_word_each_the_first_name_is_the_class(tmp_path: Path) -> None:
    """A column that says the same of all boxes does not take the place of another such one."""
    columns = street()
    columns["type"] = np.full(len(columns["t"]), "detected")
    columns["class"] = np.full(len(columns["t"]), "car")
    assert looked(tmp_path / "d.csv", columns)[0].sequences(["all"])[0].labels == ("car",)


@pytest.mark.parametrize("changed", [{}, {"ray": 0.02}])
@pytest.mark.parametrize(("name", "turn"), [("y", -0.5 * np.pi), ("-y", 0.5 * np.pi)])
def test_wrong_headings_are_refused_beside_jitter(
    tmp_path: Path, changed: dict[str, Any], name: str, turn: float
) -> None:
    """Headings that are measured from another axis are refused with its option, by which nothing is in doubt."""
    columns = street(**changed)
    columns["yaw"] = columns["yaw"] + turn
    (found,) = troubles(tmp_path / "d.csv", columns)
    assert f"--option heading={name}, or" in found
    assert troubles(tmp_path / "d.csv", columns, heading=name) == []


def test_wrong_headings_are_refused_without_sizes(tmp_path: Path) -> None:
    """Centres with the bearings of a compass, clockwise from north, are refused with the option of their axis."""
    columns = {name: one for name, one in street().items() if name not in {"l", "w", "h"}}
    columns["heading"] = np.degrees(0.5 * np.pi - columns.pop("yaw")) % 360.0
    assert any("heading=y-clockwise" in one for one in troubles(tmp_path / "d.csv", columns))
    assert troubles(tmp_path / "d.csv", columns, heading="y-clockwise") == []


def test_an_object_reported_twice_hides_no_wrong_heading(tmp_path: Path) -> None:
    """A car that is detected twice makes no moving sensor of headings from another axis, and is named."""
    columns = street(parked=4)
    twice = np.arange(len(columns["t"])) % CARS < 2
    columns = {name: np.concatenate([one, one[twice]]) for name, one in columns.items()}
    columns["x"][-int(twice.sum()) :] += 0.15
    columns["yaw"] = columns["yaw"] - 0.5 * np.pi
    found = troubles(tmp_path / "d.csv", columns)
    assert any("heading=y" in one for one in found)
    assert any("objects are reported twice" in one for one in found)


def yaw_of(path: Path) -> np.ndarray:
    (sequence,) = TableDataset(path).sequences(["all"])
    return np.concatenate([frame.yaw for frame in sequence.frames()])


def test_an_orientation_is_read_whole_or_refused(tmp_path: Path) -> None:
    """Quaternions, three angles and matrices give the heading under any name of their group; half of one is refused."""
    columns = street(4.0)
    yaw, zero = columns["yaw"], np.zeros(len(columns["t"]))
    cos, sin = np.cos(yaw), np.sin(yaw)
    groups: dict[str, list[np.ndarray]] = {
        "x y z w": [zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)],
        "z w": [np.sin(yaw / 2), np.cos(yaw / 2)],
        "x y z": [zero, zero, yaw],
        "0 1 2": [zero, zero, yaw],
        "matrix.0.0 matrix.0.1 matrix.0.2 matrix.1.0 matrix.1.1 matrix.1.2 matrix.2.0 matrix.2.1 matrix.2.2": [
            *(cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1)
        ],
        "vector.0 vector.1 vector.2": [zero, zero, yaw],
    }
    for names, values in groups.items():
        group = {f"rotation.{name}": one for name, one in zip(names.split(), values, strict=True)}
        write_table(tmp_path / "d.parquet", {**{name: one for name, one in columns.items() if name != "yaw"}, **group})
        turn = np.abs(np.exp(1j * yaw_of(tmp_path / "d.parquet")) - np.exp(1j * yaw))
        assert turn.max() < 1e-6, names
    tilted = {f"eulerAngles.{name}": yaw for name in "xyz"}
    write_table(tmp_path / "d.parquet", {**{name: one for name, one in columns.items() if name != "yaw"}, **tilted})
    with pytest.raises(DatasetError, match=r"expected a column yaw \(--option column.yaw=NAME\)"):
        yaw_of(tmp_path / "d.parquet")


@pytest.mark.parametrize(
    "name", ["{0}_lidar64.csv", "148_sj_{0}_16372.csv", "{0:06d}.csv", "{0}_{1}_1.csv"], ids=lambda one: one[:9]
)
@pytest.mark.parametrize("column", ["t", "yaw_rate"])
def test_a_folder_with_a_table_for_each_frame_is_one_recording(tmp_path: Path, name: str, column: str) -> None:
    """The stamps give the order of the frames, or the number that differs among the names, at any place in them."""
    columns = street(2.0)
    for number, stamp in enumerate(np.unique(columns["t"]).tolist()):
        rows = {key: one[columns["t"] == stamp] for key, one in columns.items()}
        path = tmp_path / "in" / name.format(number, 1637218746 + number)
        path.parent.mkdir(exist_ok=True)
        write_table(path, {column if key == "t" else key: one for key, one in rows.items()})
    (sequence,) = TableDataset(tmp_path / "in", {"rate": "10"} if column != "t" else {}).sequences(["all"])
    x = np.array([frame.center[-1, 0] for frame in sequence.frames()])
    assert len(sequence) == 20
    assert np.abs(np.diff(x, 2)).max() < 0.3
    assert np.diff(sequence.stamps) == pytest.approx(1e8, abs=300)


def label(tool: str, yaw: float) -> Any:
    """Return a frame of a car as a tool for labels writes it."""
    place, turn = {"x": 5.0, "y": 2.0, "z": 0.8}, {"x": 0.0, "y": 0.0, "z": yaw}
    if tool == "sustech":
        psr = {"position": place, "rotation": turn, "scale": {"x": 4.5, "y": 1.9, "z": 1.6}}
        return [{"obj_id": "1", "obj_type": "car", "psr": psr}]
    if tool == "labelcloud":
        sides = {"length": 4.5, "width": 1.9, "height": 1.6}
        return {"folder": "a", "objects": [{"name": "car", "centroid": place, "dimensions": sides, "rotations": turn}]}
    sides = {"h": 1.6, "w": 1.9, "l": 4.5}
    return [{"type": "car", "3d_dimensions": sides, "3d_location": place, "rotation": yaw}]


@pytest.mark.parametrize("tool", ["sustech", "labelcloud", "dair"])
def test_frames_of_tools_for_labels_are_read(tmp_path: Path, tool: str) -> None:
    """JSON files without stamps, a file for each frame, are one recording with the boxes of their tool."""
    for number in range(12):
        (tmp_path / f"{number}.json").write_text(json.dumps(label(tool, 0.4)))
    (sequence,) = TableDataset(tmp_path, {"rate": "10"}).sequences(["all"])
    frame = next(sequence.frames())
    assert len(sequence) == 12
    assert [*frame.center[0], *frame.size[0], frame.yaw[0]] == pytest.approx([5.0, 2.0, 0.8, 4.5, 1.9, 1.6, 0.4])
    assert frame.labels == ("car",)


def test_names_of_frames_in_two_orders_are_refused(tmp_path: Path) -> None:
    """Frame and camera in a name give no order of time, nor do names without a number."""
    columns = {name: one for name, one in street(0.1).items() if name != "t"}
    for folder, names in (("a", ["1_0", "1_1", "2_0", "2_1"]), ("b", ["left", "right"])):
        (tmp_path / folder).mkdir()
        for name in names:
            write_table(tmp_path / folder / f"{name}.csv", columns)
        with pytest.raises(DatasetError, match="names of frames that differ in one number"):
            TableDataset(tmp_path / folder)


def test_names_in_a_column_number_the_frames(tmp_path: Path) -> None:
    """The number in the name of each row's frame counts frames; names of two numbers are refused."""
    columns = street()
    number = np.unique(columns.pop("t"), return_inverse=True)[1]
    names = np.char.add("scan_", number.astype(str))
    for column, option in (("frame", {}), ("file", {"column.frame": "file"})):
        dataset, _ = looked(tmp_path / "d.csv", {column: names, **columns}, rate="5", **option)
        assert dataset.sequences(["all"])[0].stamps.tolist() == [200_000_000 * one for one in range(number.max() + 1)]
    names = np.char.add((number % 2).astype(str), np.char.add("_", number.astype(str)))
    with pytest.raises(DatasetError, match="names of frames that differ in one number"):
        looked(tmp_path / "d.csv", {"frame": names, **columns})


def test_a_rate_counts_no_times(tmp_path: Path) -> None:
    """`rate` is for numbers of frames: seconds with nanoseconds, or since 1970, stay times, with a finding."""
    columns = street()
    number = np.unique(columns.pop("t"), return_inverse=True)[1]
    parts = {"sec": 1_700_000_000 + number // 10, "nanosec": number % 10 * 100_000_000}
    for times in (parts, {"stamp": parts["sec"] * 1_000_000_000 + parts["nanosec"]}):
        found = troubles(tmp_path / "d.csv", {**times, **columns}, rate="10")
        assert found == [f"rate is not used: column {next(iter(times))} has times, not numbers of frames "]
        dataset, _ = looked(tmp_path / "d.csv", {**times, **columns}, rate="10")
        assert len(dataset.sequences(["all"])[0].stamps) == number.max() + 1


def test_recordings_of_one_frame_are_refused(tmp_path: Path) -> None:
    """A column that differs in each frame names no recordings; `none` leaves it out."""
    columns = {**street(2.0), "scene": np.char.mod("%d", np.round(street(2.0)["t"] * 10)).astype(np.str_)}
    write_table(tmp_path / "d.csv", columns)
    with pytest.raises(DatasetError, match="20 recordings of one frame"):
        TableDataset(tmp_path / "d.csv")
    assert len(TableDataset(tmp_path / "d.csv", {"column.recording": "none"}).sequences(["all"])[0]) == 20


def index(columns: Table) -> np.ndarray:
    return np.round(columns["t"] / PERIOD).astype(np.int64)


CLOCKS = {
    "2^32 us": lambda k: (4_292_967_296 + k * 100_000) % 2**32,
    "an hour": lambda k: (3595.0 + k * 0.1) % 3600.0,
    "a minute": lambda k: (55.0 + k * 0.1).round(6) % 60.0,
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_clock_that_begins_again_goes_on(tmp_path: Path, name: str) -> None:
    """Stamps go on where their counter wraps, as the order of the rows shows, and a line says so."""
    columns = street(9.0)
    columns["t"] = CLOCKS[name](index(columns))
    dataset, findings = looked(tmp_path / "d.csv", columns)
    assert np.diff(dataset.sequences(["all"])[0].stamps) == pytest.approx(1e8, abs=300)
    assert any("the clock begins again" in one.text for one in findings)


@pytest.mark.parametrize("digits", ["%Y%m%d%H%M%S%f", "%H%M%S.%f", "%H%M%S%f"])
def test_digits_of_a_calendar_are_stamps(tmp_path: Path, digits: str) -> None:
    """Numbers as 20260301115958123 and 115958.123 are read as dates and times of day across a minute."""
    columns = street(9.0)
    stamps = np.datetime64("2026-03-01T11:59:55.000") + index(columns) * np.timedelta64(100, "ms")
    texts = [one.strftime(digits)[:-3] for one in stamps.astype(object).tolist()]
    columns["t"] = np.array(texts, dtype=np.float64 if "." in digits else np.int64)
    dataset, findings = looked(tmp_path / "d.csv", columns)
    assert np.diff(dataset.sequences(["all"])[0].stamps) == pytest.approx(1e8, abs=300)
    assert any("hhmmss, as their digits say" in one.text for one in findings)


def test_times_of_a_day_are_stamps(tmp_path: Path) -> None:
    """Texts as 23:59:58.100 go on after midnight, and tables of tracks have them as they are."""
    columns = street(9.0)
    stamps = np.datetime64("2026-03-01T23:59:55.000") + index(columns) * np.timedelta64(100, "ms")
    columns["t"] = np.array([one.strftime("%H:%M:%S.%f")[:-3] for one in stamps.astype(object).tolist()])
    dataset, findings = looked(tmp_path / "d.csv", columns)
    assert np.diff(dataset.sequences(["all"])[0].stamps) == pytest.approx(1e8, abs=300)
    assert any("times of a day in column t" in one.text for one in findings)


def test_whole_numbers_that_may_be_seconds_are_not_milliseconds(tmp_path: Path) -> None:
    """Steps of 12 with boxes that would go too fast in milliseconds are refused, and so are frames years apart."""
    columns = {**street(9.0), "t": index(street(9.0)) * 12}
    (found,) = troubles(tmp_path / "a.csv", columns)
    assert "expected a unit of time" in found
    assert "--option time=s, or time=ms" in found
    assert troubles(tmp_path / "b.csv", columns, time="s") == troubles(tmp_path / "b.csv", columns, time="ms") == []
    near = {**columns, "x": columns["x"] / 50, "y": columns["y"] / 50}
    assert not [one for one in troubles(tmp_path / "c.csv", near) if "unit of time" in one]
    write_table(tmp_path / "d.csv", {**street(4.0), "t": index(street(4.0)) * 10**11})
    with pytest.raises(DatasetError, match=r"frames at a plausible rate .* which are 1e.08 s in milliseconds"):
        TableDataset(tmp_path / "d.csv", {})


@pytest.mark.parametrize("rows", [slice(400, 401), slice(480, None)])
def test_a_stamp_far_from_all_others_is_refused(tmp_path: Path, rows: slice) -> None:
    """One frame that is a year ahead, and stamps half of which have another unit, are refused with the row."""
    columns = street(12.0)
    columns["t"][rows] = columns["t"][rows] * 1000.0 if rows.stop is None else columns["t"][rows] + 3.2e7
    place = f"d.csv:{rows.start + 2}: expected stamps of one recording"
    assert sum(place in one for one in troubles(tmp_path / "d.csv", columns)) == 1


def test_a_name_of_a_frame_of_reference_is_no_number_of_a_frame(tmp_path: Path) -> None:
    """A column `frame_id` of texts, or with one number in all rows, changes nothing."""
    for name in ("velodyne", 7):
        columns = {**street(4.0), "frame_id": np.full(len(street(4.0)["t"]), name)}
        dataset, _ = looked(tmp_path / "d.csv", columns)
        assert len(dataset.sequences(["all"])[0]) == 40


@pytest.mark.parametrize("factor", [2.0, 0.01, 0.001, 0.3048])
def test_sizes_by_a_factor_are_named_with_the_option(tmp_path: Path, factor: float) -> None:
    """Halves of sizes, centimetres, millimetres and feet are named; with the option they are sizes of cars."""
    columns = street(4.0)
    for name in "lwh":
        columns[name] = columns[name] / factor
    (found,) = troubles(tmp_path / "d.csv", columns)
    assert f"{factor:g}" in found.partition("--option size_factor=")[2].replace(",", " ").split()
    dataset, findings = looked(tmp_path / "d.csv", columns, size_factor=str(factor))
    assert not any(one.doubt for one in findings)
    assert next(dataset.sequences(["all"])[0].frames()).size[0] == pytest.approx([4.5, 1.9, 1.6])


@pytest.mark.parametrize(("column", "mark"), [("yaw", 511), ("yaw", -999), ("yaw", 3600), ("l", 9999), ("w", -999)])
def test_marks_for_no_value_are_refused_or_left_out(tmp_path: Path, column: str, mark: int) -> None:
    """A number that is no angle and no size is refused with its line; an option leaves its row out or names it."""
    columns = street(4.0)
    columns[column][10] = mark
    (found, *_) = troubles(tmp_path / "d.csv", columns)
    assert "d.csv:12: expected" in found
    assert "missing=NUMBER" in found
    assert troubles(tmp_path / "d.csv", columns, invalid="skip") == []
    if column == "yaw":
        dataset, _ = looked(tmp_path / "d.csv", columns, missing=str(mark))
        yaw = np.concatenate([frame.yaw for frame in dataset.sequences(["all"])[0].frames()])
        assert np.isnan(yaw).sum() == 1


def test_marks_among_positions_are_doubted(tmp_path: Path) -> None:
    """A number that often stands for no value is named where no other position is near it."""
    columns = street(4.0)
    marked = columns["x"].copy()
    marked[[10, 50]] = -999
    (found,) = troubles(tmp_path / "d.csv", {**columns, "x": marked})
    assert found == "column x has -999 in 2 rows, as a mark for no value --option missing=-999"
    assert troubles(tmp_path / "d.csv", {**columns, "x": marked}, missing="-999", invalid="skip") == []
    many = np.linspace(-1020, -980, len(marked)).round()
    assert not [one for one in troubles(tmp_path / "e.csv", {**columns, "x": many}) if "mark" in one]


def test_headings_that_are_all_turned_round_are_doubted(tmp_path: Path) -> None:
    """Boxes that all drive backwards have headings from -x; the option turns them."""
    columns = street()
    turned = {**columns, "yaw": columns["yaw"] + np.pi}
    (found,) = troubles(tmp_path / "d.csv", turned)
    assert "many boxes drive backwards: 0% of" in found
    assert "--option heading=-x" in found
    assert troubles(tmp_path / "d.csv", turned, heading="-x") == []


def cornered(columns: Table) -> np.ndarray:
    """Return the corners (R, 8, 3) of boxes, from the left front at the bottom round to the left, then at the top."""
    half = 0.5 * np.column_stack([columns[name] for name in "lwh"])
    signs = np.array([[a, b, c] for c in (-1, 1) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
    local = signs * half[:, None]
    cos, sin = np.cos(columns["yaw"])[:, None], np.sin(columns["yaw"])[:, None]
    flat = (cos * local[:, :, 0] - sin * local[:, :, 1], sin * local[:, :, 0] + cos * local[:, :, 1], local[:, :, 2])
    return np.stack(flat, axis=2) + np.column_stack([columns[name] for name in "xyz"])[:, None]


@pytest.mark.parametrize("form", ["corners", "corner_3d", "corners.dict", "plan"])
def test_corners_are_boxes(tmp_path: Path, form: str) -> None:
    """Corners in any order give the box, whose heading gets the sense of its motion."""
    columns = street(parked=0)
    points = cornered(columns)[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    rest = {name: columns[name] for name in ("t", "score", "class")}
    name = {"corners": "corners.{}.{}", "corner_3d": "corner_3d_{}_{}", "corners.dict": "corners.{}.{}"}.get(form)
    axes = "xyz" if form == "corners.dict" else range(3)
    count, axes = (4, range(2)) if form == "plan" else (8, axes)
    corners = {
        (name or "corner{}_{}").format(i, axis): points[:, i, k] for i in range(count) for k, axis in enumerate(axes)
    }
    dataset, findings = looked(tmp_path / "d.csv", rest | corners)
    assert not [one for one in findings if one.wrong or one.doubt]
    assert any(f"have {count} corners" in one.text for one in findings)
    frames = list(dataset.sequences(["all"])[0].frames())
    wanted = list(looked(tmp_path / "e.csv", columns)[0].sequences(["all"])[0].frames())
    for found, one in zip(frames, wanted, strict=True):
        np.testing.assert_allclose(found.center[:, :2], one.center[:, :2], atol=1e-3)
        np.testing.assert_allclose(found.size[:, :2], one.size[:, :2], atol=1e-3)
        np.testing.assert_allclose(np.cos(found.yaw - one.yaw), 1.0, atol=1e-3)


def test_bounds_and_sines_are_boxes(tmp_path: Path) -> None:
    """Bounds along the axes give centres; sine and cosine, or q0 to q3, give headings."""
    columns = street(4.0)
    points = cornered(columns)
    bounds = {
        f"{axis}_{end}": getattr(points[:, :, i], end)(axis=1) for i, axis in enumerate("xyz") for end in ("min", "max")
    }
    rest = {name: columns[name] for name in ("t", "score", "class")}
    bare, said = looked(tmp_path / "a.csv", rest | bounds)
    centres = np.concatenate([frame.center for frame in bare.sequences(["all"])[0].frames()])
    np.testing.assert_allclose(centres, np.column_stack([columns[name] for name in "xyz"]), atol=1e-3)
    assert any("centres are the middles of bounds" in one.text for one in said)
    yaw = columns.pop("yaw")
    zero = np.zeros(len(yaw))
    for turned in (
        {"sin_yaw": np.sin(yaw), "cos_yaw": np.cos(yaw)},
        {"q0": np.cos(yaw / 2), "q1": zero, "q2": zero, "q3": np.sin(yaw / 2)},
    ):
        found = yaw_of_frames(looked(tmp_path / "b.csv", columns | turned)[0])
        np.testing.assert_allclose(np.cos(found - yaw), 1.0, atol=1e-3)


def yaw_of_frames(dataset: TableDataset) -> np.ndarray:
    return np.concatenate([frame.yaw for frame in dataset.sequences(["all"])[0].frames()])


def test_units_of_length_are_in_names_or_options(tmp_path: Path) -> None:
    """Names as x_cm and vx_kmh, and the option length_factor, give metres of positions, sizes and speeds."""
    columns = street(4.0) | {"vx": np.full(320, 1.0), "vy": np.full(320, 0.5)}
    lengths = [*"xyzlwh"]
    named = {name: one for name, one in columns.items() if name not in {*lengths, "vx", "vy"}}
    named |= {f"{name}_cm": 100.0 * columns[name] for name in lengths}
    named |= {"vx (km/h)": 3.6 * columns["vx"], "vy (km/h)": 3.6 * columns["vy"]}
    scaled = columns | {name: 1000.0 * columns[name] for name in (*lengths, "vx", "vy")}
    wanted = next(looked(tmp_path / "a.csv", columns)[0].sequences(["all"])[0].frames())
    for path, one, options in (("b.csv", named, {}), ("c.csv", scaled, {"length_factor": "0.001"})):
        found = next(looked(tmp_path / path, one, **options)[0].sequences(["all"])[0].frames())
        for name in ("center", "size", "velocity"):
            np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-3)
    assert any("length_factor for all lengths" in one for one in troubles(tmp_path / "d.csv", scaled))


@pytest.mark.parametrize("mark", ["NULL", "none", "na", "N.A.", "\\N", "#VALUE!", "1.#QNAN"])
def test_texts_for_no_value_are_empty_cells(tmp_path: Path, mark: str) -> None:
    """Where a text stands for no value, a heading is unknown, and the row of a size is refused or left out."""
    columns = street(4.0)
    for name in ("yaw", "l"):
        cells = columns[name].astype(np.str_)
        cells[10] = mark
        path, changed = tmp_path / f"{name}.csv", {**columns, name: cells}
        if name == "l":
            (found,) = troubles(path, changed)
            assert "l.csv:12: expected positive length, width and height" in found
        assert troubles(path, changed, invalid="skip") == []
        (sequence,) = looked(path, changed, invalid="skip")[0].sequences(["all"])
        yaw = np.concatenate([frame.yaw for frame in sequence.frames()])
        assert (np.isnan(yaw).sum(), len(yaw)) == ((1, 320) if name == "yaw" else (0, 319))


def test_boxes_may_lack_their_headings(tmp_path: Path) -> None:
    """Headings are unknown where the column or a cell is missing, and one line says so."""
    none = np.full(len(street(4.0)["t"]), np.nan)
    for yaw in (None, none, np.where(np.arange(len(none)) % 3 == 0, np.nan, street(4.0)["yaw"])):
        columns = {**street(4.0), "yaw": yaw}
        dataset, findings = looked(tmp_path / "d.csv", {name: one for name, one in columns.items() if one is not None})
        given = np.concatenate([frame.yaw for frame in dataset.sequences(["all"])[0].frames()])
        assert np.isnan(given).sum() == (len(given) if yaw is None else np.isnan(yaw).sum())
        assert sum("unknown" in one.text for one in findings) == 1
        assert any("yaw is in radians" in one.text for one in findings) == (yaw is not None and yaw is not none)


@pytest.mark.parametrize("name", ["17000000{:02d}.{:d}00000", "17000000{:02d}{:d}00000000"])
def test_names_of_files_that_are_stamps_give_the_rate(tmp_path: Path, name: str) -> None:
    """Seconds with a fraction, and nanoseconds, in the names of the tables of frames are stamps."""
    columns = street(2.0)
    rows = {key: one for key, one in columns.items() if key != "t"}
    for frame, stamp in enumerate(np.unique(columns["t"]).tolist()):
        file = tmp_path / f"{name.format(frame // 2, frame % 2 * 5)}.csv"
        write_table(file, {key: one[columns["t"] == stamp] for key, one in rows.items()})
    stamps = TableDataset(tmp_path).sequences(["all"])[0].stamps
    assert np.diff(stamps) == pytest.approx(0.5e9, rel=1e-3)


@pytest.mark.parametrize("form", ["car:{}", "{}:car", "car{}"])
def test_a_class_with_the_number_of_an_object_is_class_and_id(tmp_path: Path, form: str) -> None:
    """`car:3` is the object 3 of class `car`; classes that differ in a number alone stay as they are."""
    columns = street(4.0)
    number = np.arange(len(columns["t"])) % CARS
    columns["class"] = np.array([form.format(one) for one in number.tolist()])
    assert looked(tmp_path / "a.csv", columns)[0].sequences(["all"])[0].labels == ("car",)
    truth = TableDataset(tmp_path / "a.csv").sequences(["all"])[0].truth()
    assert truth is not None
    assert len(np.unique(truth.id)) == CARS
    columns["class"] = np.char.add("class_", (number % 2).astype(np.str_))
    assert set(looked(tmp_path / "b.csv", columns)[0].sequences(["all"])[0].labels) == {"class_0", "class_1"}


def test_a_rate_is_that_of_numbers_and_not_of_times(tmp_path: Path) -> None:
    """Whole numbers in a column of stamps count frames if a rate says so; of fractions, the rate is named as unused."""
    columns = street(4.0)
    (found,) = troubles(tmp_path / "d.csv", columns, rate="50")
    assert "rate is not used: column t has times" in found
    for stamps, rate in ((columns["t"], "50"), (np.round(columns["t"] / PERIOD), "10")):
        dataset, findings = looked(tmp_path / "d.csv", {**columns, "t": stamps}, rate=rate)
        assert np.diff(dataset.sequences(["all"])[0].stamps) == pytest.approx(PERIOD * 1e9)
    assert any("column t counts frames, 10 a second" in one.text for one in findings)


def test_boxes_of_an_image_are_refused(tmp_path: Path) -> None:
    """Width and height without a length, corners and lists of four numbers are an image's, with or without heading."""
    plain = boxes(z=None, l=None)
    rest = {name: one for name, one in plain.items() if name not in {"w", "h"}}
    image = {"image_width": plain["w"] * 30.0, "image_height": plain["h"] * 30.0}
    bare = {name: one for name, one in rest.items() if name not in {"x", "y", "yaw"}}
    ends = (plain["x"], plain["y"], plain["x"] + 30.0, plain["y"] + 30.0)
    corners = dict(zip(("x1", "y1", "x2", "y2"), ends, strict=True))
    listed = {f"bbox.{place}": one for place, one in enumerate(ends)}
    for columns in (plain, {**rest, **image}, {**bare, **corners}, {**bare, **listed}):
        write_table(tmp_path / "d.csv", columns)
        with pytest.raises(DatasetError, match=r"--camera FILE.*cameras\.md.*boxes in pixels\?"):
            TableDataset(tmp_path / "d.csv")


def test_a_heading_that_may_be_in_unread_columns_is_doubted(tmp_path: Path) -> None:
    """An angle about an axis is not taken for a yaw; without a heading, columns that may have it are named."""
    columns = street(4.0)
    yaw = columns.pop("yaw")
    axis = {f"rotation.axis.{place}": np.full(len(yaw), float(place == 2)) for place in range(3)}
    for others in ({**axis, "rotation.angle": yaw}, {"direction": yaw, "bearing": yaw}):
        (found,) = troubles(tmp_path / "d.parquet", {**columns, **others})
        assert all(name in found for name in others)
    assert troubles(tmp_path / "d.parquet", columns) == []


def test_objects_that_report_one_by_one_are_looks_at_each(tmp_path: Path) -> None:
    """Frames of one box whose objects come back in turn look around their box; `group` bounds a frame in time.

    The gate of the profile made for them holds the way from one report to the next.
    """
    rng = np.random.default_rng(1)
    t = np.sort(
        np.concatenate([rng.uniform(0.0, 2.0) + np.arange(40) * 2.0 + rng.normal(0.0, 0.1, 40) for _ in range(5)])
    )
    ship = np.arange(200) % 5
    columns = {
        "t": t.round(3),
        "x": 300.0 * np.cos(ship) + 4.0 * t,
        "y": 300.0 * np.sin(ship),
        "yaw": np.zeros(200),
        "l": np.full(200, 12.0),
        "w": np.full(200, 4.0),
    }
    dataset, findings = looked(tmp_path / "d.csv", columns)
    assert any("objects report one by one" in one.text for one in findings)
    frame = next(dataset.sequences(["all"])[0].frames())
    assert frame.field_of_view is not None
    assert frame.pose.translation[:2] == pytest.approx([columns["x"][0], columns["y"][0]])
    (sequence,) = dataset.sequences(["all"])
    tracks = track_whole(Tracking(profile_for("auto", [sequence])), sequence).tracks
    assert TrackCounts.of(tracks.values()).tracks == 5
    stamps = looked(tmp_path / "d.csv", columns, group="2.3")[0].sequences(["all"])[0].stamps
    assert 25 < len(stamps) < 45


def test_rows_that_repeat_another_one_count_once(tmp_path: Path) -> None:
    """A table in which each row stands twice has the boxes of the plain one; a copy of a recording has all of them."""
    columns = {name: np.repeat(one, 2) for name, one in street(4.0).items()}
    dataset, findings = looked(tmp_path / "a" / "d.csv", columns)
    assert sum(len(frame) for frame in dataset.sequences(["all"])[0].frames()) == len(columns["t"]) // 2
    assert any("rows that another one repeats are left out" in one.text for one in findings)
    for name in ("a.csv", "b.csv"):
        looked(tmp_path / "b" / name, street(4.0))
    for one in TableDataset(tmp_path / "b").sequences(["all"]):
        assert sum(len(frame) for frame in one.frames()) == len(columns["t"]) // 2


def test_boxes_of_two_detectors_are_refused_with_the_column_of_the_detector(tmp_path: Path) -> None:
    """Two boxes at each place are refused where frames may be merged; a column that tells them apart is named."""
    columns = {name: np.repeat(one, 2) for name, one in street(4.0).items()}
    columns["x"] = columns["x"] + np.resize([0.0, 0.05], len(columns["x"]))
    (found,) = troubles(tmp_path / "d.csv", columns)
    assert "two detectors see each object --option time=UNIT" in found
    cameras = {**columns, "camera": np.resize(["left", "right"], len(columns["x"]))}
    assert any("--option column.sensor=camera" in one for one in troubles(tmp_path / "d.csv", cameras))
    assert troubles(tmp_path / "d.csv", cameras, **{"column.sensor": "camera"}) == []
    even = {**columns, "t": columns["t"] * 0.3}  # frames that were merged are not 30 ms apart
    assert [one for one in looked(tmp_path / "d.csv", even)[1] if one.wrong] == []


def test_stronger_evidence_needs_numbers_and_a_difference() -> None:
    """Two of two beat nothing, and a percent of a thousand is noise."""
    assert not Evidence(2, 2).beats(Evidence(0, 2))
    assert not Evidence(990, 1000).beats(Evidence(950, 1000))
    assert Evidence(50, 50).beats(Evidence(20, 50))


def test_a_meaning_that_values_rule_out_gives_way(tmp_path: Path) -> None:
    """The first possible one holds without evidence, the user's choice always; where none or several are, they ask."""
    reading = Reading(tmp_path, {})
    out, other = Claim("a", possible=False), Claim("b", text="b holds")
    assert reading.decide("time", [out, other]) == "b"
    assert [(one.text, one.doubt) for one in reading.findings] == [("b holds", False)]
    assert reading.decide("time", [out, other], asked="a") == "a"
    for claims in ([out], [other, other]):
        with pytest.raises(DatasetError, match="expected a unit, received steps of 1"):
            reading.decide("time", claims, expected="a unit", received="steps of 1")
    with pytest.raises(DatasetError, match="expected a unit, received b holds"):
        reading.decide("time", [out, replace(other, wins="refused")], expected="a unit")


def test_check_ends_with_the_status_of_its_findings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A clean table is all right; one that track would refuse ends with 1 and is named once."""
    right, wrong = tmp_path / "a.csv", tmp_path / "b.csv"
    write_table(right, street())
    write_table(wrong, {name: one for name, one in street(4.0).items() if name != "l"})
    done = run_here(capsys, "check", right)
    assert done.returncode == 0
    assert "\nall right\n" in done.stdout
    done = run_here(capsys, "check", wrong)
    assert done.returncode == 1
    assert done.stdout.count("WRONG") == 1
    assert "all right" not in done.stdout
    assert json.loads(run_here(capsys, "check", wrong, "--json").stdout)["findings"][-1]["wrong"] is True


def test_check_refuses_data_without_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table whose rows are all left out is not all right, with the number of its recordings."""
    write_table(tmp_path / "d.csv", {**street(4.0), "l": np.zeros(320)})
    done = run_here(capsys, "check", tmp_path / "d.csv", "--option", "invalid=skip")
    assert done.returncode == 1
    assert "WRONG expected boxes, received none in 1 recordings" in done.stdout
    assert "all right" not in done.stdout


def test_check_says_once_how_rows_are_left_out(tmp_path: Path) -> None:
    """The option that leaves out a wrong row stands in its own column, once for each finding."""
    columns = street(4.0)
    columns["l"][10] = np.nan
    (found,) = (one for one in looked(tmp_path / "d.csv", columns)[1] if one.wrong)
    assert found.option.startswith("--option invalid=skip leaves such rows out")
    assert "--option" not in found.text

"""Tables of strangers: spellings, people, velocities, stamps and columns as files elsewhere have them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from optipmb_tools.datasets.table import TableDataset, TableSequence
from optipmb_tools.datasets.table.findings import Finding
from optipmb_tools.files import DatasetError
from optipmb_tools.table_files import write_table
from PIL import Image
from streets import street

Table = dict[str, Any]
FRAMES = 60


def read(path: Path, columns: Table, **options: str) -> tuple[TableSequence, list[Finding]]:
    write_table(path, columns)
    found: list[Finding] = []
    sequence = TableDataset(path, options, findings=found).sequences(["all"])[0]
    assert isinstance(sequence, TableSequence)
    return sequence, found


def walkers(apart: float, **more: object) -> Table:
    """People who walk side by side along x, pair after pair."""
    rng, people = np.random.default_rng(3), np.arange(6)
    t, who = np.repeat(np.arange(FRAMES) * 0.1, 6), np.tile(people, FRAMES)
    x = 1.3 * t + 4.0 * (who // 2) + rng.normal(0.0, 0.03, len(t))
    y = apart * (who % 2) + rng.normal(0.0, 0.03, len(t))
    return {"t": t, "x": x, "y": y, **{name: np.full(len(t), one) for name, one in more.items()}}


def test_spellings_of_a_class_are_one(tmp_path: Path) -> None:
    """Names that differ in case or path are one class; others of one kind are, where objects change between them."""
    columns = street()
    rows = np.arange(len(columns["t"]))
    for one, other in (("car", "Car"), ("car", "vehicle.car"), ("car", "automobile")):
        names = np.where(np.random.default_rng(1).random(len(rows)) < 0.6, one, other)
        sequence, found = read(tmp_path / "a.csv", columns | {"class": names})
        assert sequence.labels == (one,)
        assert any("one class, car" in finding.text for finding in found)
    vans = np.where(np.isclose(columns["y"], columns["y"][0], atol=2.0), "van", "car")
    assert set(read(tmp_path / "b.csv", columns | {"class": vans})[0].labels) == {"car", "van"}


def test_people_without_a_class_are_people(tmp_path: Path) -> None:
    """Sizes tell them, or speeds and distances; pairs that keep apart are no objects that two detectors see."""
    for more in ({}, {"l": 0.6, "w": 0.6, "h": 1.7}):
        sequence, found = read(tmp_path / "a.csv", walkers(0.5, **more))
        assert sequence.labels == ("pedestrian",)
        assert sequence.apart == ("pedestrian",)
        assert not any(one.doubt for one in found)
    sequence, found = read(tmp_path / "c.csv", walkers(0.05, l=0.6, w=0.6, h=1.7), time="s")
    assert sequence.apart == ()
    assert any("two detectors" in one.text for one in found)


def test_velocities_are_judged_by_object(tmp_path: Path) -> None:
    """Those of one object that contradict its motion are left out, with the convention that they look like."""
    columns = street(6.0)
    own = np.isclose(np.abs(np.abs(columns["yaw"]) - np.pi), 0.0, atol=0.5)
    course, speed = np.where(own, 0.0, columns["yaw"]), np.full(len(own), 8.0)
    columns |= {"vx": speed * np.cos(course), "vy": speed * np.sin(course)}
    sequence, found = read(tmp_path / "a.csv", columns)
    (text,) = (one.text for one in found if one.topic == "velocity")
    assert "contradict their motion and are left out: they are along the heading of the box" in text
    velocities = np.concatenate([frame.velocity for frame in sequence.frames() if frame.velocity is not None])
    assert 0.1 < np.isnan(velocities).any(axis=1).mean() < 0.35


def test_columns_that_may_be_meant_are_named(tmp_path: Path) -> None:
    """A class by any name is read or named, and all columns that are missing are named at once."""
    columns = street()
    renamed = {"agent_category2": columns["class"], **{n: one for n, one in columns.items() if n != "class"}}
    assert read(tmp_path / "a.csv", {"road_user_type": columns["class"], **renamed})[1]
    found = read(
        tmp_path / "b.csv",
        {"type_code": np.arange(len(columns["t"])) % 3, **renamed, "agent_category2": 1.0 * columns["x"]},
    )[1]
    assert any(one.doubt and "type_code" in one.text for one in found)
    for name in ("t", "x", "y"):
        columns[f"my {name} time" if name == "t" else f"my {name}"] = columns.pop(name)
    with pytest.raises(DatasetError, match=r"column.stamp=my t time --option column.x=my x --option column.y=my y"):
        read(tmp_path / "c.csv", columns)


@pytest.mark.parametrize(
    "write",
    [
        lambda t: f"{t:.1f} sec",
        lambda t: f"{1000 * t:.0f} ms",
        lambda t: repr(45000.25 + t / 86400.0),
        lambda t: repr(738000.25 + t / 86400.0),
    ],
)
def test_stamps_with_units_and_days_are_read(tmp_path: Path, write: Any) -> None:
    """Units behind the numbers, and the days of spreadsheets and of MATLAB."""
    columns = street()
    sequence = read(tmp_path / "a.csv", columns | {"t": np.array([write(t) for t in columns["t"].tolist()])})[0]
    assert np.allclose(np.diff(sequence.stamps), 1e8, atol=1e5)


def test_sizes_of_zero_are_unknown(tmp_path: Path) -> None:
    """A row whose length and width are 0 is kept without a size."""
    columns = street()
    columns["l"][::5], columns["w"][::5] = 0.0, 0.0
    sequence, _ = read(tmp_path / "a.csv", columns)
    size = np.concatenate([frame.size for frame in sequence.frames()])
    assert np.isnan(size[:, 0]).sum() == len(columns["l"][::5])


def test_rows_with_names_and_ragged_rows(tmp_path: Path) -> None:
    """R's names of rows are a column; a row with more fields than names is refused with its line."""
    columns = street()
    write_table(tmp_path / "a.csv", columns)
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "r.csv").write_text("\n".join([head, *(f"{k},{row}" for k, row in enumerate(rows))]) + "\n")
    assert len(TableDataset(tmp_path / "r.csv").sequences(["all"])[0]) == len(np.unique(columns["t"]))
    (tmp_path / "b.csv").write_text("\n".join([head, *rows[:5], f"{rows[5]},1", *rows[6:]]) + "\n")
    with pytest.raises(DatasetError, match=r"b.csv:7: expected 10 fields in each row"):
        TableDataset(tmp_path / "b.csv")


def test_headings_beside_latitudes_are_those_of_a_compass(tmp_path: Path) -> None:
    """North is 0 and east is 90 degrees, without an option."""
    columns = street()
    heading = np.degrees(0.5 * np.pi - columns.pop("yaw")) % 360.0
    lat, lon = 48.0 + columns.pop("y") / 111_200.0, 11.0 + columns.pop("x") / 74_600.0
    sequence, found = read(
        tmp_path / "a.csv", {**columns, "lat": lat, "lon": lon, "heading": heading}, origin="48,11,0"
    )
    assert any("clockwise from north" in one.text for one in found)
    yaw = np.concatenate([frame.yaw for frame in sequence.frames()])
    assert np.allclose(np.cos(yaw - street()["yaw"]), 1.0, atol=1e-3)


def test_boxes_that_nothing_follows_are_refused(tmp_path: Path) -> None:
    """Where no box has a next one within reach, each would begin a track."""
    columns = walkers(0.5)
    with pytest.raises(DatasetError, match="boxes that can be followed from frame to frame"):
        read(tmp_path / "a.csv", columns | {"x": 1e4 * columns["x"]})


def test_check_draws_the_first_seconds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The picture is written, and the last table has the columns."""
    write_table(tmp_path / "a.csv", street())
    done = run_here(capsys, "check", tmp_path / "a.csv", "--plot", tmp_path / "check.png")
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "check.png") as picture:
        assert picture.size == (900, 700)
    assert "yaw" in done.stdout.rpartition("read as")[2]


@pytest.mark.parametrize(
    "names",
    [
        {"t": "Zeit", "class": "Klasse", "l": "Länge", "w": "Breite", "h": "Höhe", "yaw": "Gierwinkel"},
        {"t": "时间戳", "class": "类别", "l": "长", "w": "宽", "h": "高", "yaw": "航向角"},
        {"x": "Position_1", "y": "Position_2", "z": "Position_3"},  # MATLAB counts from 1
        {"t": "TIMESTAMP", "x": "UTM_X", "y": "UTM_Y", "yaw": "UTM_ANGLE"},
        {"x": "pose.position.x", "y": "pose.position.y", "z": "pose.position.z"},
    ],
)
def test_columns_by_names_of_other_sources(tmp_path: Path, names: dict[str, str]) -> None:
    """German and Chinese names, lists that count from 1, map coordinates, and a pose where there is no other place."""
    columns = street()
    renamed = read(tmp_path / "a.csv", {names.get(name, name): one for name, one in columns.items()})[0]
    plain = read(tmp_path / "b.csv", columns)[0]
    for one, other in zip(renamed.frames(), plain.frames(), strict=True):
        assert one.labels == other.labels
        for name in ("center", "size", "yaw"):
            assert np.array_equal(getattr(one, name), getattr(other, name))


def test_a_place_is_that_of_the_box(tmp_path: Path) -> None:
    """Not a corner of its outline, which has the shorter name."""
    columns = street()
    outline = {"outline.polygon.0.x": columns["x"] + 2.0, "outline.polygon.0.y": columns["y"] + 1.0}
    own = {f"position.{axis}": columns.pop(axis) for axis in "xyz"}
    centre = next(iter(read(tmp_path / "a.csv", {**outline, **own, **columns})[0].frames())).center
    assert np.allclose(centre[0], [one[0] for one in own.values()])


@pytest.mark.parametrize("other", [{"object_category": 2}, {"type": "Feature"}])
def test_classes_are_words_that_differ(tmp_path: Path, other: Table) -> None:
    """Neither numbers nor a column with one word are the classes where another column has several words."""
    columns = street()
    names = np.where(columns["y"] > 0.0, "car", "truck")
    more = {name: np.full(len(names), one) for name, one in other.items()}
    rest = {name: one for name, one in columns.items() if name != "class"}
    sequence = read(tmp_path / "a.csv", {**more, "properties.class": names, **rest})[0]
    assert set(sequence.labels) == {"car", "truck"}


def test_rows_that_stand_for_no_object(tmp_path: Path) -> None:
    """Rows at 0, 0 that fill a frame up are left out; rows at -1, -1 are doubted, with the option for them."""
    columns = street()
    plain = read(tmp_path / "a.csv", columns)[0]
    empty = {name: one[:0] for name, one in columns.items()}
    empty |= {name: np.zeros(2 * len(plain)) for name in ("x", "y", "z", "l", "w", "h", "yaw", "score")}
    empty |= {"t": np.repeat(plain.times, 2), "class": np.full(2 * len(plain), "car")}
    filled = {name: np.concatenate([one, empty[name]]) for name, one in columns.items()}
    sequence, found = read(tmp_path / "b.csv", filled)
    assert [len(one) for one in sequence.frames()] == [len(one) for one in plain.frames()]
    assert any("240 rows at 0, 0" in one.text for one in found)
    columns["x"][::9], columns["y"][::9] = -1.0, -1.0
    assert any(one.doubt and "missing=-1" in one.option for one in read(tmp_path / "c.csv", columns)[1])


def test_a_class_without_sizes_has_none(tmp_path: Path) -> None:
    """Empty sizes of most boxes of a class are unknown; a single one is missing, and refused with its line."""
    columns = street()
    people = columns["y"] > 0.0
    columns["class"] = np.where(people, "pedestrian", "car")
    columns["l"][people], columns["w"][people] = np.nan, np.nan
    sequence, _ = read(tmp_path / "a.csv", columns)
    size = np.concatenate([frame.size for frame in sequence.frames()])
    assert np.isnan(size[:, 0]).sum() == people.sum()
    columns["l"][int(np.flatnonzero(~people)[3])] = np.nan
    with pytest.raises(DatasetError, match="positive length"):
        read(tmp_path / "b.csv", columns)


def test_feet_and_small_degrees_are_named(tmp_path: Path) -> None:
    """Sizes of cars in feet are doubted by any name of their class; coordinates in 1e-7 degrees are read."""
    columns = street()
    feet = {name: columns[name] / 0.3048 for name in "xyzlwh"} | {"class": np.full(len(columns["t"]), 2)}
    assert any(one.doubt and "as feet" in one.text for one in read(tmp_path / "a.csv", columns | feet)[1])
    places = {"lat": 48.0 + columns.pop("y") / 111_200.0, "lon": 11.0 + columns.pop("x") / 74_600.0}
    whole = {name: np.round(1e7 * one).astype(np.int64) for name, one in places.items()}
    one, other = (read(tmp_path / "b.csv", columns | given, origin="48,11,0")[0] for given in (places, whole))
    for a, b in zip(one.frames(), other.frames(), strict=True):
        assert np.allclose(a.center, b.center, atol=0.02)


def test_marks_among_headings_and_objects_side_by_side(tmp_path: Path) -> None:
    """AIS has 511 for no heading, and then its course; a row for all objects is refused, as one alone would be read."""
    columns = street()
    course = np.degrees(0.5 * np.pi - columns.pop("yaw")) % 360.0
    marked = columns | {"heading": np.full(len(course), 511.0), "cog": course}
    sequence = read(tmp_path / "a.csv", marked, heading="y-clockwise")[0]
    assert np.allclose(np.cos(next(iter(sequence.frames())).yaw - street()["yaw"][:8]), 1.0, atol=1e-3)
    some = np.where(np.arange(len(course)) % 3 == 0, 511.0, course)
    found = read(tmp_path / "b.csv", columns | {"heading": some}, heading="y-clockwise")[1]
    assert any("a heading of 511" in one.text for one in found)
    wide = {"t": columns["t"][::8], **{f"{axis}_{k}": columns[axis][k::8] for k in range(1, 4) for axis in "xy"}}
    with pytest.raises(DatasetError, match="a row for each box"):
        read(tmp_path / "c.csv", wide)

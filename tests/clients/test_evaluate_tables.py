"""Evaluation of anybody's tables: options, rates of the truth, ids, names of classes and boxes without sizes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import result_of, run_here
from optipmb_tools.commands import options
from optipmb_tools.run.bulk import Here
from optipmb_tools.table_files import read_table, write_table

FRAMES, CARS = 50, 2


def cars(stamps: Any = None, scale: float = 1.0, **changed: Any) -> dict[str, np.ndarray]:
    """Give two cars that drive side by side, one row each at every stamp; columns may be changed."""
    seconds = np.repeat(np.arange(FRAMES) / 10 if stamps is None else np.asarray(stamps), CARS)
    many = len(seconds) // CARS
    columns: dict[str, Any] = {
        "t": (seconds * scale).round(6) if scale == 1.0 else np.round(seconds * scale).astype(np.int64),
        "id": np.tile([1, 2], many),
        "x": seconds * np.tile([10.0, 5.0], many),
        "y": np.tile([0.0, 8.0], many),
        "z": np.full(len(seconds), 0.8),
        "l": np.full(len(seconds), 4.5),
        "w": np.full(len(seconds), 1.9),
        "h": np.full(len(seconds), 1.6),
        "yaw": np.full(len(seconds), 0.3),
        "class": np.full(len(seconds), "car"),
        **changed,
    }
    return {name: np.asarray(values) for name, values in columns.items() if values is not None}


def take(columns: Mapping[str, np.ndarray], rows: Any) -> dict[str, np.ndarray]:
    return {name: values[rows] for name, values in columns.items()}


class Bench:
    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys

    def table(self, name: str, columns: Mapping[str, np.ndarray]) -> Path:
        path = self.folder / name
        write_table(path, columns)
        return path

    def run(self, *arguments: object, options: Sequence[str] = ()) -> Any:
        return run_here(self._capsys, *arguments, *(word for one in options for word in ("--option", one)))

    def evaluate(
        self,
        truth: Mapping[str, np.ndarray],
        tracks: Mapping[str, np.ndarray],
        *arguments: object,
        detections: Mapping[str, np.ndarray] | None = None,
        options: Sequence[str] = (),
    ) -> Any:
        """Evaluate tracks; the default detections are the two cars."""
        found = detections or cars(id=None, score=np.full(FRAMES * CARS, 0.9))
        paths = [self.table(f"{name}.csv", one) for name, one in (("d", found), ("truth", truth), ("tracks", tracks))]
        asked = (paths[0], "--truth", paths[1], "--tracks", paths[2], *arguments)
        return self.run("evaluate", *asked, "--json", options=options)


@pytest.fixture
def bench(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Bench:
    return Bench(tmp_path, capsys)


def counts(done: Any, name: str = "car") -> tuple[float | None, int, int, int]:
    """Give MOTA in percent, truth boxes, false and missed ones of all tracks."""
    found = result_of(done)["classes"][name]["all"]
    return None if found["MOTA"] is None else round(100 * found["MOTA"], 3), found["GT"], found["FP"], found["FN"]


@pytest.mark.parametrize(("worth", "processes"), [(FRAMES - 1, 2), (FRAMES, 1)])
def test_many_frames_are_evaluated_by_a_process_for_each_class(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, worth: int, processes: int
) -> None:
    """Where frames are so few that processes cost more than they save, by this one."""
    asked: list[int] = []
    monkeypatch.setattr(options, "WORTH_PROCESSES", worth)
    monkeypatch.setattr(options, "processors", lambda: 8)
    monkeypatch.setattr(options, "executor_for", lambda jobs: asked.append(jobs) or Here())
    truth = cars(**{"class": np.tile(["car", "van"], FRAMES)})
    found = {name: one for name, one in truth.items() if name != "id"} | {"score": np.full(FRAMES * CARS, 0.9)}
    assert bench.evaluate(truth, truth, detections=found).returncode == 0
    assert asked == [processes]


RIGHT = (100.0, FRAMES * CARS, 0, 0)


def test_the_tracks_that_are_shown_are_the_confirmed_ones(bench: Bench) -> None:
    """The first row counts confirmed rows alone, `--all` adds the others; other people's tables have one kind."""
    found = cars(confirmed=np.tile([1, 0], FRAMES), score=np.full(FRAMES * CARS, 0.9))
    values = result_of(bench.evaluate(cars(), found))["classes"]["car"]
    assert (values["confirmed"]["TP"], values["all"]["TP"]) == (FRAMES, FRAMES * CARS)
    assert values["hota_centre"]["confirmed"]["HOTA"] < values["hota_centre"]["all"]["HOTA"]
    tables = [bench.folder / "d.csv", "--truth", bench.folder / "truth.csv", "--tracks"]
    for tracks, words, rows in (
        ("tracks.csv", (), ["confirmed", "≥"]),
        ("tracks.csv", ("--all",), ["confirmed", "≥", "all"]),
        ("truth.csv", (), ["all", "≥"]),
    ):
        lines = bench.run("evaluate", *tables, bench.folder / tracks, *words).stdout.splitlines()[3:]
        assert [line.split()[at] for at, line in zip((1, 0, 0), lines[: len(rows)], strict=False)] == rows


def test_data_and_truth_have_a_line_of_assumptions_each(bench: Bench) -> None:
    """Where they are read in different ways; a table without truth is answered with the option."""
    found = bench.table("d.csv", cars(id=None, score=np.full(FRAMES * CARS, 0.9)))
    truth = bench.table("truth.csv", cars(id=None, object=np.tile([1, 2], FRAMES), scale=1000.0, h=None))
    tracks = bench.table("tracks.csv", cars())
    options = ["column.id=object"]
    said = bench.run("evaluate", found, "--truth", truth, "--tracks", tracks, options=options).stderr
    assert f"{found}: stamps are in seconds" in said
    assert f"{truth}: stamps are in milliseconds" in said
    done = bench.run("evaluate", found, "--tracks", tracks)
    assert done.returncode == 2
    assert "--truth FILE" in done.stderr


def test_tracks_may_be_a_table_of_text(bench: Bench) -> None:
    """A `.txt` with names of columns is a table of tracks; a format of a benchmark in its place is named."""
    bench.evaluate(cars(), cars())
    tables = [bench.folder / "d.csv", "--truth", bench.folder / "truth.csv", "--tracks", bench.folder / "tracks.txt"]
    (bench.folder / "tracks.txt").write_bytes((bench.folder / "truth.csv").read_bytes())
    assert counts(bench.run("evaluate", *tables, "--json")) == RIGHT
    (bench.folder / "tracks.txt").write_text("1,1,5.0,6.0,4.5,1.9,1,-1,-1,-1\n")
    assert "image boxes as of MOTChallenge" in bench.run("evaluate", *tables).stderr


def test_trackers_are_compared_by_mota_and_identity_switches(bench: Bench) -> None:
    """A row for each tracker begins with MOTA, switches and IDF1 of the tracks it shows; bars are drawn of them."""
    late = np.where(cars()["t"] < 2.0, cars()["id"], cars()["id"] + 2)
    bench.evaluate(cars(), cars())
    tables = [bench.table("changes.csv", cars(id=late)), bench.folder / "truth.csv"]
    asked = ("--truth", bench.folder / "truth.csv", *(word for one in tables for word in ("--tracks", one)))
    drawn = bench.folder / "drawn.png"
    lines = bench.run("evaluate", bench.folder / "d.csv", *asked, "--plot", drawn).stdout.splitlines()
    assert drawn.read_bytes()[1:4] == b"PNG"
    head = next(place for place, line in enumerate(lines) if line.startswith("tracks"))
    assert lines[head].split()[1:5] == ["MOTA", "IDS", "IDF1", "HOTA"]
    rows = [line.split()[1:4] for line in lines[head + 1 : head + 3]]
    assert rows == [["98.00", "2", "60.00"], ["100.00", "0", "100.00"]]
    done = bench.run("evaluate", bench.folder / "d.csv", *asked[:4], "--plot", drawn)
    assert done.returncode == 2
    assert "expected a .png of several --tracks" in done.stderr


def test_the_unit_of_time_reaches_truth_and_own_tracks(bench: Bench) -> None:
    """Microseconds from 0 with `time=us` are tracked and evaluated alike."""
    data = bench.table("d.csv", cars(scale=1e6, id=None, score=np.full(FRAMES * CARS, 0.9)))
    truth = bench.table("truth.csv", cars(scale=1e6))
    out = bench.folder / "t.csv"
    assert bench.run("track", data, "--out", out, options=["time=us"]).returncode == 0
    done = bench.run("evaluate", data, "--truth", truth, "--tracks", out, "--json", options=["time=us"])
    assert counts(done) == RIGHT


NORTH = {"x": cars()["y"], "y": cars()["x"]}
"""The cars drive along y."""


@pytest.mark.parametrize(
    ("changed", "options"),
    [
        ({"yaw": np.full(100, 90.0)}, ["yaw=degrees", "time=s"]),
        ({"yaw": np.full(100, np.pi / 2), "l": cars()["w"], "w": cars()["l"]}, ["sizes=wlh", "class.car=Auto"]),
        ({"yaw": np.zeros(100)}, ["heading=y", "score=percent"]),
    ],
)
def test_own_tracks_keep_their_units(bench: Bench, changed: dict[str, np.ndarray], options: list[str]) -> None:
    """Options of headings and of size order apply to detections and truth, not to a table of OptiPMB."""
    scores = np.full(FRAMES * CARS, 90.0 if "score=percent" in options else 0.9)
    data = bench.table("d.csv", cars(id=None, score=scores, **NORTH, **changed))
    truth, out = bench.table("truth.csv", cars(**NORTH, **changed)), bench.folder / "t.csv"
    assert bench.run("track", data, "--out", out, options=options).returncode == 0
    done = bench.run("evaluate", data, "--truth", truth, "--tracks", out, "--json", "--iou", "0.8", options=options)
    assert counts(done, "Auto" if "class.car=Auto" in options else "car") == RIGHT


def test_all_options_reach_tracks_of_others(bench: Bench) -> None:
    """Degrees and sizes in another order are read in the tracks of another tracker, and said to be."""
    other = {"yaw": np.full(FRAMES * CARS, 3.0), "l": cars()["w"], "w": cars()["l"]}
    detections = cars(id=None, score=np.full(FRAMES * CARS, 0.9), **other)
    options = ["yaw=degrees", "sizes=wlh"]
    done = bench.evaluate(cars(**other), cars(**other), "--iou", "0.9", detections=detections, options=options)
    assert counts(done) == RIGHT
    assert "tracks.csv: no columns for the pose" in done.stderr


def test_an_option_applies_to_the_tables_that_have_what_it_names(bench: Bench) -> None:
    """A class or a column of one table alone is read there; one that is in none is refused, with what there is."""
    east = cars(east=cars()["x"], x=None)
    other = cars(**{"class": np.full(FRAMES * CARS, "thing")})
    assert counts(bench.evaluate(east, cars(), options=["column.x=east"])) == RIGHT
    assert counts(bench.evaluate(cars(), east, options=["column.x=east"])) == RIGHT
    assert counts(bench.evaluate(other, cars(), options=["class.thing=car"])) == RIGHT
    assert counts(bench.evaluate(cars(), other, options=["class.thing=car"])) == RIGHT
    for option, said in (("class.thing=car", "class of the table: car"), ("column.id=number", "a column: t, id, x")):
        done = bench.evaluate(cars(), cars(), options=[option])
        assert done.returncode == 2
        assert f"--option {option.partition('=')[0]}: expected a" in done.stderr
        assert said in done.stderr
    done = bench.run("track", bench.table("d.csv", cars(score=np.full(100, 0.9))), options=["class.thing=car"])
    assert (done.returncode, "class of the table: car" in done.stderr) == (2, True)


def test_a_column_of_ids_may_be_named_in_each_table(bench: Bench) -> None:
    """`column.id` reaches the truth and the tracks of `evaluate`, and the table of `check`."""
    other = cars(id=None, number=cars()["id"])
    done = bench.evaluate(other, cars())
    assert (done.returncode, "truth.csv: expected a column of ids" in done.stderr) == (2, True)
    assert counts(bench.evaluate(other, cars(), options=["column.id=number"])) == RIGHT
    assert counts(bench.evaluate(cars(), other, options=["column.id=number"])) == RIGHT
    done = bench.run("check", bench.table("truth.csv", other), "--json", options=["column.id=number"])
    assert {"id": "number"}.items() <= {one["role"]: one["column"] for one in result_of(done)["columns"]}.items()


def test_the_truth_of_a_folder_is_matched_by_the_names_of_files(bench: Bench) -> None:
    """Each recording has the truth of the file of its name; a recording without one is named."""
    for name, shift in (("one", 0.0), ("two", 500.0)):
        moved = cars(x=cars()["x"] + shift)
        bench.table(f"d/{name}.csv", {**moved, "score": np.full(FRAMES * CARS, 0.9)})
        bench.table(f"truth/{name}.csv", moved)
        bench.table(f"tracks/{name}.csv", moved)
    asked = ("evaluate", bench.folder / "d", "--truth", bench.folder / "truth", "--tracks", bench.folder / "tracks")
    assert counts(bench.run(*asked, "--json")) == (100.0, 2 * FRAMES * CARS, 0, 0)
    bench.table("truth/three.csv", cars())
    (bench.folder / "truth/two.csv").unlink()
    done = bench.run(*asked)
    assert done.returncode == 2
    assert "sequence two: expected annotations" in done.stderr


def test_recordings_without_rows_are_compared(bench: Bench) -> None:
    """A truth with a header alone has no objects, detections with a header alone have no frames; both are said."""
    for name in ("one", "two", "three"):
        bench.table(f"d/{name}.csv", take(cars(score=np.full(100, 0.9)), slice(0 if name == "three" else 100)))
        bench.table(f"truth/{name}.csv", take(cars(), slice(0 if name == "two" else 100)))
        bench.table(f"tracks/{name}.csv", take(cars(), slice(0 if name == "three" else 100)))
    asked = ("evaluate", bench.folder / "d", "--truth", bench.folder / "truth", "--tracks", bench.folder / "tracks")
    done = bench.run(*asked, "--json")
    assert counts(done) == (0.0, 100, 100, 0)
    assert "two.csv: truth has 0 of 50 frames of two: the others count as frames without objects" in done.stderr
    assert "three.csv: 100 rows are at no frame of three: left out" in done.stderr


def test_only_the_frames_of_a_sparse_truth_are_compared(bench: Bench) -> None:
    """Labels at 2 Hz compare a fifth of the frames, in every figure; a false track counts in these frames alone."""
    truth = cars(np.arange(0, FRAMES, 5) / 10)
    done = bench.evaluate(truth, cars())
    assert counts(done) == (100.0, 20, 0, 0)
    assert "truth has 10 of 50 frames of d: only these are compared" in done.stderr
    figures = result_of(done)["classes"]["car"]
    assert figures["hota_centre"]["all"]["HOTA"] == pytest.approx(1.0)
    assert figures["gospa"]["all"]["GOSPA"] == pytest.approx(0.0, abs=1e-6)
    false = cars(y=np.tile([0.0, 80.0], FRAMES))
    found = bench.evaluate(truth, false)
    assert counts(found) == (0.0, 20, 10, 10)
    assert result_of(found)["classes"]["car"]["gospa"]["all"]["missed"] == pytest.approx(np.sqrt(2.0))


def test_a_sparse_truth_is_refused_by_tune(bench: Bench) -> None:
    """Detections between the labels of a sparse truth are not clutter, so `tune` says what to do instead."""
    data = bench.table("d.csv", cars(id=None, score=np.full(FRAMES * CARS, 0.9)))
    truth = bench.table("truth.csv", cars(np.arange(0, FRAMES, 5) / 10))
    done = bench.run("tune", data, "--truth", truth, "--profile", "auto", "--out", bench.folder / "tuned")
    assert done.returncode == 2
    assert "expected a truth of every frame to tune by, received labels in 10 of 50" in done.stderr


def test_frames_without_objects_count_where_the_truth_is_dense(bench: Bench) -> None:
    """A truth of every frame but a few says that these are empty: tracks in them are false; one line says so."""
    kept = (cars()["t"] < 2.0) | (cars()["t"] > 2.45)
    done = bench.evaluate(take(cars(), kept), cars())
    assert counts(done)[1:] == (90, 10, 0)
    assert "truth has 45 of 50 frames of d: the others count as frames without objects" in done.stderr


def test_a_row_with_a_stamp_alone_labels_a_frame(bench: Bench) -> None:
    """In a sparse truth a row without a box is a labelled frame without objects."""
    labels = np.isin(np.arange(FRAMES * CARS) // CARS, np.arange(0, FRAMES, 5))
    blank = (cars()["t"] == 1.0) & labels
    truth = take(cars(), labels)
    for name in ("x", "y", "l", "w"):
        truth[name] = np.where(blank[labels], np.nan, truth[name])
    assert counts(bench.evaluate(truth, cars()))[1:] == (18, 2, 0)


def test_the_nearest_row_of_a_dense_truth_counts_once(bench: Bench) -> None:
    """Labels and tracks at 50 Hz are compared at the frames, 10 Hz, by the row that is nearest in time."""
    dense = cars(np.arange(0, 5 * FRAMES - 4) / 50 + 0.004)
    done = bench.evaluate(dense, dense)
    assert counts(done) == RIGHT
    assert "truth.csv: of several rows of an object at a frame the nearest counts" in done.stderr
    found = result_of(bench.evaluate(dense, cars()))["classes"]["car"]["all"]
    assert (found["MOTA"], found["GT"]) == (1.0, FRAMES * CARS)
    assert found["MOTP"] == pytest.approx(0.004 * 7.5)


@pytest.mark.parametrize("twice", ["truth", "tracks"])
def test_an_id_twice_at_a_stamp_is_refused(bench: Bench, twice: str) -> None:
    """The line of the second row is named."""
    doubled = take(cars(), np.r_[0:42, 40:100])
    done = bench.evaluate(*((doubled, cars()) if twice == "truth" else (cars(), doubled)))
    assert done.returncode == 2
    assert f"{twice}.csv:44: expected an id once per frame" in done.stderr


@pytest.mark.parametrize("none", [-1, np.nan, "", -1.0])
def test_rows_without_an_id_are_no_track(bench: Bench, none: Any) -> None:
    """Ids of -1 and empty cells are left out and counted, not followed as one track."""
    ids = cars()["id"].astype(object)
    ids[1::2] = none
    kind: Any = str if none == "" else type(none)
    done = bench.evaluate(cars(), cars(id=ids.astype(kind)))
    assert counts(done) == (50.0, 100, 0, 50)
    assert "tracks.csv: 50 rows with no id, or -1, are left out" in done.stderr


def test_no_tracks_are_a_recall_of_zero(bench: Bench) -> None:
    """A table of tracks with a header alone, and one that has no row of a recording, miss every object."""
    assert counts(bench.evaluate(cars(), take(cars(), slice(0)))) == (0.0, 100, 0, 100)
    twice = {name: np.tile(values, 2) for name, values in cars().items()}
    twice["log"] = np.repeat(["a", "b"], FRAMES * CARS)
    detections = {**twice, "score": np.full(2 * FRAMES * CARS, 0.9)}
    done = bench.evaluate(twice, take(twice, twice["log"] == "b"), detections=detections)
    assert counts(done) == (50.0, 200, 0, 100)
    assert "tracks.csv: no tracks of a" in done.stderr


@pytest.mark.parametrize("bare", ["truth", "tracks"])
def test_centres_without_sizes_have_the_figures_of_distances(bench: Bench, bare: str) -> None:
    """Tables without sizes and headings are compared by centres, and one line says so; overlaps are refused."""
    centres = cars(l=None, w=None, h=None, yaw=None)
    pair = (centres, cars()) if bare == "truth" else (cars(), centres)
    done = bench.evaluate(*pair, "--verbose")
    assert counts(done) == RIGHT
    assert f"{bare}.csv: no column for the size or the heading: only centres can be compared" in done.stderr
    done = bench.evaluate(*pair, "--iou", "0.5")
    assert done.returncode == 2
    assert "--iou: expected truth and tracks with sizes" in done.stderr


def test_classes_that_mean_the_same_are_one(bench: Bench) -> None:
    """`vehicle.car` of the truth, `car` of the detections and `Car` of the tracks are compared as `car`."""
    names = [cars(**{"class": np.full(FRAMES * CARS, name)}) for name in ("vehicle.car", "Car")]
    done = bench.evaluate(*names)
    assert counts(done) == RIGHT
    assert "classes of the truth: vehicle.car as car" in done.stderr
    assert "classes of the tracks: Car as car" in done.stderr
    assert counts(bench.evaluate(*names, "--class", "Car")) == RIGHT
    assert counts(bench.evaluate(*names, "--class", "vehicle.car"), "vehicle.car") == RIGHT


def test_classes_that_are_compared_with_nothing_are_named(bench: Bench) -> None:
    """A van close to a car of the same table is another class; without a common class, one line says so."""
    mixed = cars(**{"class": np.tile(["car", "van"], FRAMES)})
    done = bench.evaluate(mixed, cars())
    assert counts(done)[1:] == (50, 50, 0)
    assert "classes of the truth not compared: van" in done.stderr
    done = bench.evaluate(cars(**{"class": np.full(FRAMES * CARS, "tree")}), cars())
    assert counts(done)[0] is None
    assert "no class is in both: truth has tree, tracks have car" in done.stderr


@pytest.mark.parametrize("stamped", [False, True])
def test_tables_without_stamps_are_matched_by_the_numbers_of_frames(bench: Bench, *, stamped: bool) -> None:
    """Frame numbers of any origin and step, also of a sparse truth, match detections with or without stamps."""
    frames = np.repeat(371 + 5 * np.arange(FRAMES), CARS)
    numbered = cars(t=None, frame=frames)
    detections = cars(id=None, frame=frames, score=np.full(FRAMES * CARS, 0.9))
    if not stamped:
        detections.pop("t")
    assert counts(bench.evaluate(numbered, numbered, detections=detections)) == RIGHT
    sparse = take(numbered, np.isin(frames, 371 + 25 * np.arange(10)))
    assert counts(bench.evaluate(sparse, numbered, detections=detections)) == (100.0, 20, 0, 0)
    if not stamped:
        assert counts(bench.evaluate(numbered, numbered, detections=detections, options=["rate=50"])) == RIGHT
        data, truth = bench.table("d.csv", detections), bench.table("truth.csv", numbered)
        out = bench.folder / "own.csv"
        assert bench.run("track", data, "--out", out).returncode == 0
        assert set(read_table(out)["frame"].tolist()) <= set(frames.tolist())
        assert counts(bench.run("evaluate", data, "--truth", truth, "--tracks", out, "--json")) == RIGHT


def test_own_tracks_of_a_table_in_another_encoding_are_read(bench: Bench) -> None:
    """Options of encoding and decimals apply to the user's tables, not to a table of OptiPMB."""
    paths = []
    for name, columns in (("d", cars(id=None, score=np.full(FRAMES * CARS, 0.9))), ("truth", cars())):
        text = bench.table(f"{name}.csv", columns).read_text().replace(",", ";").replace(".", ",")
        paths.append(bench.folder / f"{name}16.csv")
        paths[-1].write_text(text, encoding="utf-16")
    out, options = bench.folder / "own.csv", ["encoding=utf-16", "decimal=,"]
    assert bench.run("track", paths[0], "--out", out, options=options).returncode == 0
    asked = ("evaluate", paths[0], "--truth", paths[1], "--tracks", out, "--json")
    assert counts(bench.run(*asked, options=options)) == RIGHT


def test_a_shift_of_all_scores_changes_no_figure(bench: Bench) -> None:
    """No track is deleted at its own threshold: 1e-6 more for every score changes the thresholds alone.

    Two tracks of a score have means that differ in the last place, by their lengths, unless they are rounded.
    """
    many = {name: np.concatenate([values] * 6) for name, values in cars().items()}
    many["id"] = many["id"] + CARS * np.repeat(np.arange(6), FRAMES * CARS)
    many["y"] = many["y"] + 20.0 * (many["id"] // 3)
    tracks = take(many, many["t"] < 0.3 * many["id"] + 0.1)
    reports = []
    for shift in (0.0, 1e-6, 2e-6):
        scores = (0.1 * (1 + (tracks["id"] - 1) // 2) + shift).round(6)
        done = bench.evaluate(take(many, many["id"] > 4), {**tracks, "score": scores})
        found = result_of(done)["classes"]["car"]
        assert found["best"].pop("score") == pytest.approx(0.3 + shift, abs=1e-9)
        reports.append(json.dumps(found))
    assert len(set(reports)) == 1


def test_a_table_of_several_sequences_that_are_named_by_digits_is_evaluated(bench: Bench) -> None:
    """Scenes are called 0000 and 0001: their tracks in one CSV file give the figures that result files give."""
    scenes = ("--dataset", "scene", "--sequences", "0000", "0001", "--option", "frames=20", "--option", "clouds=0")
    figures = []
    for name in ("t.csv", "files"):
        assert bench.run("track", *scenes, "--out", bench.folder / name, "--jobs", "1").returncode == 0
        found = result_of(bench.run("evaluate", *scenes, "--tracks", bench.folder / name, "--json", "--jobs", "1"))
        figures.append({label: one["all"]["MOTA"] for label, one in found["classes"].items()})
    assert figures[0] == figures[1]


def test_truth_that_is_a_frame_late_is_named(bench: Bench) -> None:
    """Tracks that fit the truth of the next frame much better get a note with both distances; others get none."""
    late = bench.evaluate(cars(t=cars()["t"] + 0.1), cars())
    assert "m from that of the frame after: does one of the two count frames from 1?" in late.stderr
    assert "count frames from 1" not in bench.evaluate(cars(), cars()).stderr


def test_a_truth_needs_no_detections(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The frames of the truth are compared; tracks far away, or of another clock, are told from wrong ones."""
    bench = Bench(tmp_path, capsys)
    truth = bench.table("truth.csv", cars())
    more = cars(np.arange(FRAMES + 10) / 10)
    result = bench.run("evaluate", "--truth", truth, "--tracks", bench.table("u.csv", more), "--json")
    assert result_of(result)["classes"]["car"]["all"]["MOTA"] == 1.0
    assert "rows are at no frame of the truth" in result.stderr
    far = bench.run("evaluate", "--truth", truth, "--tracks", bench.table("v.csv", cars() | {"y": cars()["y"] + 6e5}))
    assert "6e+05 m from the truth" in far.stderr
    late = bench.run("evaluate", "--truth", truth, "--tracks", bench.table("w.csv", cars() | {"t": cars()["t"] + 1e9}))
    assert "0 to 4.9 s" in late.stderr
    assert "another clock" in late.stderr

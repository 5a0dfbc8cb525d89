"""Tables of strangers: units and conventions are found for the whole recording, or refused with an option."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import result_of, run_here
from optipmb_tools.datasets import open_dataset
from optipmb_tools.table_files import read_table, write_table

FRAMES, PERIOD = 50, 0.1
Table = dict[str, np.ndarray]


def street(frames: int = FRAMES, direction: float = 0.0, yaw: float | None = None) -> Table:
    """Give two cars side by side at 10 m/s for some frames, in the world frame."""
    rng = np.random.default_rng(7)
    t = np.repeat(np.arange(frames) * PERIOD, 2)
    along, across = 10.0 * t, np.tile([0.0, 8.0], frames)
    cos, sin = np.cos(direction), np.sin(direction)
    count = 2 * frames
    return {
        "t": t.round(6),
        "x": along * cos - across * sin + rng.normal(0.0, 0.03, count),
        "y": along * sin + across * cos + rng.normal(0.0, 0.03, count),
        "z": np.full(count, 0.8),
        "l": np.full(count, 4.5),
        "w": np.full(count, 1.9),
        "h": np.full(count, 1.6),
        "yaw": np.full(count, direction if yaw is None else yaw) + rng.normal(0.0, 0.01, count),
        "score": np.full(count, 0.9),
        "class": np.full(count, "car"),
    }


def tracked(capsys: pytest.CaptureFixture[str], data: Path, *options: str, name: str = "t.csv") -> tuple[Table, str]:
    out = data.parent / "out" / name
    done = run_here(capsys, "track", data, "--out", out, "--verbose", *options)
    assert done.returncode == 0, done.stderr
    return read_table(out), done.stderr


def refused(capsys: pytest.CaptureFixture[str], data: Path, *options: str) -> str:
    """Track a table that is refused; give the one line that says why."""
    done = run_here(capsys, "track", data, "--out", data.parent / "no.csv", *options)
    assert done.returncode == 2, done.stderr
    assert not (data.parent / "no.csv").exists()
    return done.stderr.splitlines()[-1]


def write(path: Path, columns: Table, **changed: np.ndarray | None) -> Path:
    write_table(path, {name: one for name, one in {**columns, **changed}.items() if one is not None})
    return path


def two_tracks(tracks: Table) -> bool:
    """Tell whether two tracks follow the cars through all frames but the first."""
    _, rows = np.unique(tracks["id"], return_counts=True)
    return len(rows) == 2 and rows.min() >= FRAMES - 1


INDEX = np.round(np.repeat(np.arange(FRAMES), 2)).astype(np.int64)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"timestamp": INDEX * 100_000}, "stamps are in microseconds: frames at 10 Hz"),
        ({"timestamp": INDEX * 100_000_000}, "stamps are in nanoseconds: frames at 10 Hz"),
        ({"timestamp": 86_400_000 + INDEX * 100}, "stamps are in milliseconds: frames at 10 Hz"),
        ({"timestamp": 1_700_000_000_000_000 + INDEX * 100_000}, "stamps are in microseconds, by their date"),
        ({"timestamp": -2.0 + INDEX / 10.0}, "stamps are in seconds: frames at 10 Hz"),
        ({"timestamp": INDEX - 30}, None),
        ({"timestamp": INDEX / 10.0 + np.tile([0.0, 0.004], FRAMES)}, "stamps differ by up to 0.004 s within a frame"),
        ({"timestamp": INDEX * 10**8 + np.tile([0, 80_000_000], FRAMES), "frame": INDEX}, "the first one of its frame"),
        ({"sec": 1_600_000_000 + INDEX // 10, "nanosec": INDEX % 10 * 100_000_000}, "stamps are sec + nanosec"),
        ({"frame": 371 + 5 * INDEX}, "frames of column frame are taken to come at 10 Hz (numbers in steps of 5)"),
    ],
)
def test_the_unit_of_time_is_that_with_a_plausible_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], columns: Table, said: str | None
) -> None:
    """Stamps of any origin and unit give two tracks and a line that states the unit; what counts frames is refused."""
    data = write(tmp_path / "d.csv", street(), t=None, **columns)
    if said is None:
        assert "may count frames (--option" not in (line := refused(capsys, data))
        assert "a unit of time (--option time=s, ms, us or ns, or rate=HZ)" in line
        tracks, _ = tracked(capsys, data, "--option", "rate=10")
        assert two_tracks(tracks)
        return
    tracks, notes = tracked(capsys, data)
    assert said in notes
    assert two_tracks(tracks)
    for name, values in columns.items():
        if name in tracks and "differ" not in said:
            assert set(tracks[name].tolist()) <= set(values.tolist())


def test_frame_numbers_of_the_table_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tracks have the frame numbers of the detections, with and without stamps."""
    for name, columns in (("a", street()), ("b", {**street(), "t": None})):
        data = write(tmp_path / name / "d.csv", columns, frame=371 + 5 * INDEX)
        tracks, _ = tracked(capsys, data)
        assert sorted(set(tracks["frame"].tolist())) == list(range(371, 371 + 5 * FRAMES, 5))


def test_stamps_that_lost_their_digits_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Frames whose boxes share their places are no frames, unless the user states the unit of their stamps."""
    data = write(tmp_path / "d.csv", street(), t=np.full(2 * FRAMES, 1.6e18))
    line = refused(capsys, data)
    assert "stamps have lost digits" in line
    assert "--option time=UNIT" in line
    _, notes = tracked(capsys, data, "--option", "time=ns")
    assert "100% of the boxes at the place of another one" in notes
    seconds = write(tmp_path / "s.csv", street(), t=1_600_000_000.0 + INDEX // 10)
    assert "stamps have lost digits" in refused(capsys, seconds)


def test_a_unit_in_the_name_that_contradicts_the_rate_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`stamp_ns` with steps of 100,000 is no clock of nanoseconds."""
    data = write(tmp_path / "d.csv", street(), t=None, stamp_ns=INDEX * 100_000)
    assert "--option time=us, or time=ns" in refused(capsys, data)
    assert two_tracks(tracked(capsys, data, "--option", "time=us")[0])


@pytest.mark.parametrize("yaw", [np.tile([3.0, 2.0], FRAMES), np.random.default_rng(1).uniform(-3.6, 3.6, 2 * FRAMES)])
def test_small_degrees_are_told_by_the_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], yaw: np.ndarray
) -> None:
    """Headings of some degrees on a straight road are not radians: the cars would drive sideways."""
    tracks, notes = tracked(capsys, write(tmp_path / "d.csv", street(), yaw=yaw))
    assert "yaw is in degrees: 100% of" in notes
    assert two_tracks(tracks)
    assert np.abs(tracks["yaw"]).max() < 0.08


def test_the_unit_of_headings_is_always_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Radians too, and that nothing moves."""
    assert "yaw is in radians: 100% of" in tracked(capsys, write(tmp_path / "a.csv", street(direction=1.0)))[1]
    parked = write(tmp_path / "b.csv", street(), x=np.tile([0.0, 9.0], FRAMES))
    assert "yaw is in radians (up to 0." in tracked(capsys, parked)[1]


CONVENTIONS: dict[str, Callable[[float], float]] = {
    "y": lambda course: course - np.pi / 2,
    "-y": lambda course: course + np.pi / 2,
    "x-clockwise": lambda course: -course,
    "y-clockwise": lambda course: np.pi / 2 - course,
    "-y-clockwise": lambda course: -np.pi / 2 - course,
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_headings_of_another_convention_are_refused_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """Headings that the motion contradicts are refused with the option that reads them, which gives the right ones."""
    course = 0.5
    data = write(tmp_path / "d.csv", street(direction=course, yaw=CONVENTIONS[name](course)))
    line = refused(capsys, data)
    assert "expected headings along the motion of the boxes" in line
    option = line.partition("--option heading=")[2].partition(",")[0]
    tracks, _ = tracked(capsys, data, "--option", f"heading={option}")
    assert option == name
    assert two_tracks(tracks)
    assert np.abs(tracks["yaw"] - course).max() < 0.1
    kept = tracked(capsys, data, "--option", "heading=x", name="kept.csv")[1]
    assert "headings and motion disagree" in kept


def test_quaternions_of_both_orders_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The order x y z w or w x y z is found from upright boxes; boxes of one heading are refused."""
    course = np.pi / 3
    columns = street(direction=course)
    half = columns["yaw"] / 2
    zero = np.zeros(2 * FRAMES)
    for order, parts in (
        ("xyzw", (zero, zero, np.sin(half), np.cos(half))),
        ("wxyz", (np.cos(half), zero, zero, np.sin(half))),
    ):
        listed = {f"rotation_{place}": part for place, part in enumerate(parts)}
        tracks, notes = tracked(capsys, write(tmp_path / f"{order}.csv", columns, yaw=None, **listed))
        assert f"quaternions are in the order {' '.join(order)}" in notes
        assert np.abs(tracks["yaw"] - course).max() < 0.1
    listed = {f"rotation_{place}": zero + (place == 3) for place in range(4)}
    data = write(tmp_path / "same.csv", street(), yaw=None, **listed)
    assert "--option quaternion=wxyz, xyzw" in refused(capsys, data)
    tracks, _ = tracked(capsys, data, "--option", "quaternion=xyzw")
    assert np.abs(tracks["yaw"]).max() < 0.1


@pytest.mark.parametrize("name", ["car", "Vehicle", "vehicle.bus.rigid", "TRUCK"])
def test_the_order_of_sizes_is_told_by_vehicles(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """Sizes without names get the order in which vehicles are longer than wide, whichever name the class has."""
    columns = street()
    sizes = {"size_0": columns["w"], "size_1": columns["l"], "size_2": columns["h"]}
    data = write(tmp_path / "d.csv", columns, l=None, w=None, h=None, **sizes, **{"class": np.full(2 * FRAMES, name)})
    tracks, notes = tracked(capsys, data)
    assert f"sizes are width, length, height, as the {name} boxes have them" in notes
    assert tracks["l"].tolist() == [4.5] * len(tracks["l"])


def turning(columns: Table, *, axes: str) -> Table:
    """Give boxes in the frame of a sensor that drives a bend, with its poses; velocities along the axes of `axes`."""
    t = columns["t"]
    yaw = 0.3 * t
    x, y = 20.0 * np.sin(yaw), 20.0 * (1.0 - np.cos(yaw))
    dx, dy = columns["x"] - x, columns["y"] - y
    cos, sin = np.cos(yaw), np.sin(yaw)
    velocity = (np.full(len(t), 10.0), np.zeros(len(t)))
    if axes == "sensor":
        velocity = (10.0 * cos, -10.0 * sin)
    return {
        **columns,
        "x": cos * dx + sin * dy,
        "y": cos * dy - sin * dx,
        "yaw": columns["yaw"] - yaw,
        "vx": velocity[0],
        "vy": velocity[1],
        "pose_x": x,
        "pose_y": y,
        "pose_yaw": yaw,
    }


@pytest.mark.parametrize("axes", ["sensor", "world"])
def test_the_axes_of_velocities_are_told_by_the_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], axes: str
) -> None:
    """Velocities along the axes of the world and of the sensor give the same tracks, and a line says which they are."""
    tracks, notes = tracked(capsys, write(tmp_path / "d.csv", turning(street(), axes=axes)))
    assert f"velocities are along the axes of the {axes}" in notes
    assert two_tracks(tracks)
    assert np.abs(tracks["vy"]).max() < 0.4


def test_velocities_in_another_unit_are_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Kilometres an hour are not what boxes move by."""
    data = write(tmp_path / "d.csv", street(), vx=np.full(2 * FRAMES, 36.0), vy=np.zeros(2 * FRAMES))
    assert "velocities and motion disagree: 36 m/s on average, boxes move at 10 m/s" in tracked(capsys, data)[1]


def test_one_score_does_not_change_the_kind_of_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A score just above 1 is taken for 1; one far outside is refused with its line; scores to 1000 are refused."""
    score = np.random.default_rng(2).uniform(0.05, 0.95, 2 * FRAMES)
    score[7] = 1.0000001
    notes = tracked(capsys, write(tmp_path / "a.csv", street(), score=score))[1]
    assert "1 scores up to 1.0000001 are taken for 1" in notes
    assert "logits" not in notes
    score[7] = -1.0
    data = write(tmp_path / "b.csv", street(), score=score)
    assert "b.csv:9: expected a score from 0 to 1" in refused(capsys, data)
    assert "1 rows with a score that is none are left out" in tracked(capsys, data, "--option", "invalid=skip")[1]
    assert "expected scores that are probabilities" in refused(
        capsys, write(tmp_path / "c.csv", street(), score=1000.0 * np.abs(score))
    )


def test_lost_digits_of_positions_are_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Coordinates of a map projection in six digits or single precision get a note, and whole ones do not."""
    east, north = street()["x"] + 500_000.0, street()["y"] + 5_400_000.0
    for name, kept, said in (
        ("a", (east, north), None),
        ("b", (np.round(east), np.round(north, -1)), "the digits of whole metres only"),
        ("c", (east.astype(np.float32), north.astype(np.float32)), "the digits of single precision only"),
    ):
        notes = tracked(capsys, write(tmp_path / f"{name}.csv", street(), x=kept[0], y=kept[1]))[1]
        assert ("have the digits of" in notes) == (said is not None)
        assert said is None or said in notes


def test_a_moving_sensor_without_poses_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Parked cars that pass by together tell that the sensor moves; the same cars with its poses do not."""
    rng = np.random.default_rng(3)
    cars = np.column_stack([np.arange(8) * 9.0, np.tile([3.5, -3.5], 4)])
    frames = 40
    t = np.repeat(np.arange(frames) * PERIOD, len(cars))
    place = np.tile(cars, (frames, 1)) + rng.normal(0.0, 0.03, (frames * len(cars), 2))
    plain = {name: np.resize(one, len(t)) for name, one in street().items()}
    heading = np.tile(np.where(cars[:, 1] > 0, np.pi, 0.0), frames)
    parked = {**plain, "t": t.round(6), "x": place[:, 0] - 10.0 * t, "y": place[:, 1], "yaw": heading}
    notes = tracked(capsys, write(tmp_path / "a.csv", parked))[1]
    assert "the sensor seems to move" in notes
    assert "--option poses=FILE" in notes
    zero = np.zeros(len(t))
    poses = write(
        tmp_path / "poses.csv",
        {"t": np.arange(frames + 1) * PERIOD},
        x=np.arange(frames + 1.0),
        y=np.zeros(frames + 1),
        yaw=np.zeros(frames + 1),
    )
    data = write(tmp_path / "b.csv", parked, pose_x=10.0 * t, pose_y=zero, pose_yaw=zero)
    columns, notes = tracked(capsys, data)
    assert "seems to move" not in notes
    joined, _ = tracked(capsys, tmp_path / "a.csv", "--option", f"poses={poses}", name="joined.csv")
    for name in ("x", "y", "yaw", "id"):
        np.testing.assert_allclose(joined[name], columns[name], atol=1e-6)


def argoverse(folder: Path, *, last: float = 5.0) -> Path:
    """Write a log as Argoverse 2 has it: boxes in the frame of the vehicle, and its poses at other stamps."""
    columns = turning(street(), axes="sensor")
    origin = 315_966_070_000_000_000
    half = columns["yaw"] / 2
    zero = np.zeros(len(half))
    write_table(
        folder / "annotations.feather",
        {
            "timestamp_ns": origin + np.round(columns["t"] * 1e9).astype(np.int64),
            "category": np.full(len(half), "REGULAR_VEHICLE"),
            "length_m": columns["l"], "width_m": columns["w"], "height_m": columns["h"],
            "qw": np.cos(half), "qx": zero, "qy": zero, "qz": np.sin(half),
            "tx_m": columns["x"], "ty_m": columns["y"], "tz_m": columns["z"],
        },
    )  # fmt: skip
    t = np.arange(-0.03, last, 0.05)
    yaw = 0.3 * t
    zero = np.zeros(len(t))
    poses = {
        "timestamp_ns": origin + np.round(t * 1e9).astype(np.int64),
        "qw": np.cos(yaw / 2), "qx": zero, "qy": zero, "qz": np.sin(yaw / 2),
        "tx_m": 20.0 * np.sin(yaw), "ty_m": 20.0 * (1.0 - np.cos(yaw)), "tz_m": zero,
    }  # fmt: skip
    write_table(folder / "city_SE3_egovehicle.feather", poses)
    return folder / "annotations.feather"


def test_poses_of_another_table_are_interpolated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A log of Argoverse 2 is tracked in the world without a script; stamps beyond its poses are refused."""
    data = argoverse(tmp_path / "log")
    poses = f"poses={tmp_path / 'log' / 'city_SE3_egovehicle.feather'}"
    tracks, _ = tracked(capsys, data, "--option", poses)
    assert two_tracks(tracks)
    late = tracks["detection_row"] >= FRAMES
    assert np.abs(tracks["vx"][late] - 10.0).max() < 0.3
    assert np.abs(tracks["yaw"][late]).max() < 0.05
    data = argoverse(tmp_path / "short", last=3.0)
    poses = f"poses={tmp_path / 'short' / 'city_SE3_egovehicle.feather'}"
    assert "expected a stamp between the first and the last pose" in refused(capsys, data, "--option", poses)


def test_a_folder_is_judged_as_a_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Files that tell nothing alone have the units of their folder; one without rows is a recording without frames."""
    folder = tmp_path / "in"
    wide = np.tile([0.0, 179.0], FRAMES)
    write(folder / "a.csv", street(), yaw=np.rad2deg(street()["yaw"]))
    write(folder / "b.csv", street(), x=np.tile([0.0, 40.0], FRAMES), yaw=wide)
    (folder / "c.csv").write_text((folder / "a.csv").read_text().splitlines()[0] + "\n")
    dataset = open_dataset("table", folder)
    assert [(one.name, len(one)) for one in dataset.sequences(["all"])] == [("a", FRAMES), ("b", FRAMES), ("c", 0)]
    yaws = [frame.yaw for one in dataset.sequences(["all"]) for frame in one.frames()]
    assert max(np.abs(one).max() for one in yaws[:FRAMES]) < 0.05
    done = run_here(capsys, "track", folder, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "c.csv: no rows, a recording without frames" in done.stderr
    assert len(read_table(tmp_path / "out" / "a.csv")["id"]) >= 2 * FRAMES - 2
    assert (tmp_path / "out" / "c.csv").is_file()


def test_a_table_without_classes_is_of_class_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The class is called so in the tracks, and an option renames it; names are stripped, empty ones refused."""
    data = write(tmp_path / "a.csv", street(), **{"class": None})
    assert set(tracked(capsys, data)[0]["class"].tolist()) == {"object"}
    assert set(tracked(capsys, data, "--option", "class.object=Car")[0]["class"].tolist()) == {"Car"}
    names = np.where(np.arange(2 * FRAMES) == 11, "", " car ")
    data = write(tmp_path / "b.csv", street(), **{"class": names})
    assert "b.csv:13: expected class" in refused(capsys, data)
    assert set(tracked(capsys, data, "--option", "invalid=skip")[0]["class"].tolist()) == {"car"}
    assert set(
        tracked(capsys, data, "--option", "invalid=skip", "--option", "class.CAR=Auto")[0]["class"].tolist()
    ) == {"Auto"}


def test_numbers_of_classes_are_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A class is called `1` also where an empty cell turns the numbers of the column into fractions."""
    data = write(tmp_path / "d.csv", street(), **{"class": np.where(np.arange(2 * FRAMES) == 11, np.nan, 1.0)})
    assert "d.csv:13: expected class" in refused(capsys, data)
    assert set(tracked(capsys, data, "--option", "invalid=skip")[0]["class"].tolist()) == {1}
    options = ("--option", "invalid=skip", "--option", "class.1=car", "--option", "class.2=bus")
    notes = tracked(capsys, data, *options)[1]
    assert "car as car" in notes
    assert "no box is of class 2" in notes


def test_check_prints_the_findings_without_tracking(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb check` names units, columns, classes and wrong options; a wrong option ends with status 1."""
    right = result_of(run_here(capsys, "check", write(tmp_path / "a.csv", street()), "--json"))
    topics = {one["topic"]: one["text"] for one in right["findings"]}
    assert topics["time"] == "stamps are in seconds: frames at 10 Hz"
    assert right["columns"][0] == {"role": "stamp", "column": "t", "unit": "", "example": "0.0"}
    assert [one["role"] for one in right["columns"][1:3]] == ["x", "y"]
    assert right["recordings"] == [
        {"recording": "a", "frames": FRAMES, "Hz": 10.0, "seconds": 4.9, "longest_gap_s": 0.1, "boxes": 2 * FRAMES}
    ]
    assert right["classes"][0]["kind"] == "car"
    wrong = write(
        tmp_path / "b.csv", street(direction=0.7, yaw=0.7 - np.pi / 2), score=np.r_[-1.0, np.ones(2 * FRAMES - 1)]
    )
    done = run_here(capsys, "check", wrong, "--json")
    assert done.returncode == 1
    found = {one["topic"]: one for one in json.loads(done.stdout)["findings"] if one["wrong"]}
    assert found["yaw"]["option"] == "--option heading=y, or heading=x to keep it"
    assert found["score"]["text"] == "b.csv:2: expected a score from 0 to 1, received -1"
    done = run_here(capsys, "check", wrong)
    assert "WRONG" in done.stdout
    done = run_here(capsys, "check", "--dataset", "scene", "--option", "frames=20", "--option", "clouds=0")
    assert done.returncode == 0
    assert "moves are along the heading" in done.stdout

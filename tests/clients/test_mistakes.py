"""Twenty mistakes that new users make, and the sentence that each of them gets."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_schemas.installation import install_command
from optipmb_tools.cli import run
from optipmb_tools.table_files import write_table
from own_tables import FRAMES, boxes

ROWS = 3 * FRAMES


def camera_boxes() -> dict[str, np.ndarray]:
    plain = boxes()
    return boxes(y=-plain["z"], z=np.linspace(2.0, 70.0, ROWS), x=plain["y"])


def broken(column: str, row: int, value: float) -> dict[str, np.ndarray]:
    columns = boxes()
    columns[column] = columns[column].astype(np.float64)
    columns[column][row] = value
    return columns


def classes(*names: str) -> dict[str, np.ndarray]:
    return boxes(**{"class": np.array(names * FRAMES)})


MISTAKES: list[tuple[str, Any, list[str], int, str]] = [
    ("swapped axes", camera_boxes(), [], 2, "camera axes: x right, y down, z forward"),
    ("degrees", boxes(yaw=np.tile([0.0, 179.0, 5.0], FRAMES)), [], 0, "yaw is in degrees"),
    ("milliseconds", boxes(t=np.repeat(np.arange(FRAMES) * 100, 3)), [], 0, "stamps are in milliseconds"),
    ("frame numbers as time", boxes(t=np.repeat(np.arange(FRAMES), 3)), [], 2, "may count frames"),
    ("frames without a rate", boxes(t=None, frame=np.repeat(np.arange(FRAMES), 3)), [], 0, "--option rate=HZ"),
    (
        "sizes as h, w, l",
        boxes(l=boxes()["h"], h=boxes()["l"]),
        [],
        0,
        "not as their columns are named (--option sizes=hwl)",
    ),
    ("lower-case classes", classes("car", "car", "pedestrian"), ["--profile", "kitti"], 0, "tracks car as Car"),
    ("classes of nobody", classes("cone", "cone", "sign"), ["--profile", "kitti"], 2, "nothing would be tracked"),
    ("some classes unknown", classes("Car", "Car", "Cone"), ["--profile", "kitti"], 0, "does not track Cone: left out"),
    (
        "what is left out",
        classes("Car", "Sign", "Cone"),
        ["--profile", "kitti"],
        0,
        "are left out with profile kitti: 30 Cone, 30",
    ),
    (
        "low scores",
        boxes(score=np.full(ROWS, 0.01)),
        ["--profile", "kitti"],
        1,
        " Car below its score_filter, most of the class",
    ),
    ("a rate of another profile", boxes(), ["--profile", "nuscenes"], 0, "for 2 Hz"),
    ("not a number", broken("x", 7, np.nan), [], 2, "d.csv:9: expected finite x, y and z"),
    ("a size of zero", broken("w", 3, 0.0), [], 2, "d.csv:5: expected positive length, width and height"),
    ("logits as scores", boxes(score=np.tile([4.0, 3.0, -1.0], FRAMES)), [], 0, "scores look like logits (-1 to 4)"),
    ("percent as scores", boxes(score=np.tile([90.0, 80.0, 70.0], FRAMES)), [], 0, "scores look like percent"),
    ("rows backwards in time", {k: v[::-1] for k, v in boxes().items()}, [], 0, "results in"),
    ("a column missing", boxes(l=None), [], 2, "expected a column l (--option column.l=NAME)"),
    (
        "text for a number",
        boxes(x=np.array(["a", *["1.0"] * (ROWS - 1)])),
        [],
        2,
        "d.csv:2: expected a number in column x",
    ),
    (
        "scores with signs of percent",
        boxes(score=np.array(["80%"] * ROWS)),
        [],
        0,
        "scores look like percent (0 to 80): divided by 100",
    ),
    ("latitudes without an origin", boxes(x=None, lat=boxes()["x"], lon=boxes()["y"]), [], 2, "--option origin=LAT"),
    ("no header", "0.0,1,2,3,4,5,6,7,8\n", [], 2, "a first line with the names of the columns"),
    ("a column twice", "t,x,y,x\n0,1,2,3\n", [], 2, "expected every column once, received 'x' twice"),
    ("an empty file", "", [], 2, "expected a table, received an empty file"),
    ("a header alone", "t,x,y,z,l,w,h,yaw,score,class\n", [], 2, "expected rows, received none"),
    ("no such file", None, [], 2, "expected a table (.csv), received no such file"),
    ("a wrong profile", boxes(), ["--profile", "kiti"], 2, "(is kitti meant?)"),
    ("a wrong option", boxes(), ["--option", "jaw=degrees"], 2, "--option jaw: expected one of time, rate, group, yaw"),
    ("places in centimetres", boxes(x=100.0 * boxes()["x"]), [], 2, "expected boxes that can be followed from frame"),
    (
        "velocities of another sign",
        boxes(t=np.repeat(np.arange(FRAMES), 3) * 1.0, vx=np.tile([-9.0, 8.0, -7.0], FRAMES), vy=np.zeros(ROWS)),
        ["--option", "time=s"],
        0,
        "velocity: expected metres per second over ground",
    ),
    ("no tracks", boxes(score=np.full(ROWS, 0.01)), ["--profile", "kitti"], 1, "no tracks came of 90 detections"),
]


@pytest.mark.parametrize(
    ("content", "options", "status", "text"), [one[1:] for one in MISTAKES], ids=[m[0] for m in MISTAKES]
)
def test_every_mistake_gets_its_sentence(
    content: Any, options: list[str], status: int, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command ends with the status and says the sentence; an error is one line, the last one."""
    path = tmp_path / "d.csv"
    if isinstance(content, str):
        path.write_text(content)
    elif content is not None:
        write_table(path, content)
    assert run(["track", str(path), "--out", str(tmp_path / "t.csv"), "--verbose", *options]) == status
    printed = capsys.readouterr()
    assert text in printed.err + printed.out
    if status == 2:
        assert text in printed.err.splitlines()[-1]
        assert not (tmp_path / "t.csv").exists()


def test_a_place_where_nothing_can_be_written_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Below a file, and in a folder that takes none: before the data are read, and with the place itself."""
    (tmp_path / "file").write_text("")
    assert run(["track", "absent.csv", "--out", str(tmp_path / "file" / "t.csv")]) == 2
    assert f"{tmp_path / 'file'} is a file" in capsys.readouterr().err
    assert run(["track", "absent.csv", "--out", "/proc/new/t.csv"]) == 2
    assert "/proc cannot be written to" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("package", "command", "extra"),
    [
        ("pyarrow", ["track", "d.csv"], "table"),
        ("optuna", ["tune", "d.csv"], "tune"),
        ("scipy", ["evaluate", "d.csv", "--tracks", "t"], "evaluation"),
    ],
)
def test_a_missing_extra_gets_the_command_that_installs_it(
    package: str, command: list[str], extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the packages of an extra, one line says how to install it, and the status is 1."""
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *_: None if name == package else object())
    assert run(command) == 1
    assert install_command(extra) in capsys.readouterr().err

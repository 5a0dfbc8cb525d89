"""The recipes of docs/detectors.md run as they stand, on files as the detectors write them."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from commands import run_here
from nuscenes_tables import Scene, box, write_detections, write_root
from optipmb_tools.table_files import read_table
from own_tables import boxes
from real_data import REPOSITORY

PAGE = (REPOSITORY / "docs" / "detectors.md").read_text()
FRAMES = 12
COMMANDS = sorted(set(re.findall(r"optipmb track [^`\n]*examples/detectors/[^`\n#]*", PAGE)))


def nuscenes(folder: Path) -> None:
    scene = Scene("scene-0103", [(100.0, 200.0)] * 5, [])
    write_root(folder / "nuscenes", [scene])
    found = {scene.token(i): [box(scene.token(i), translation=[110.0, 200.0, 1.0])] for i in range(5)}
    write_detections(folder / "nuscenes", "made", [scene], found)
    (made,) = (folder / "nuscenes").rglob("made*.json")
    made.rename(folder / "results_nusc.json")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split()[2].rpartition("/")[2])
def test_every_recipe_gives_tracks(command: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two vehicles and a pedestrian are where they were, in the world; the camera has a car."""
    done = run_here(capsys, *shlex.split(command)[1:], *(() if "--out" in command else ("--out", "tracks.csv")))
    assert done.returncode == 0, done.stderr
    tracks = read_table(folder / "tracks.csv")
    classes = {one.lower() for one in tracks["class"].tolist()}
    if "--camera" in command:
        assert (len(set(tracks["id"].tolist())), classes) == (1, {"car"})
        return
    assert len(set(tracks["id"].tolist())) == 3
    assert classes - {"cyclist"} == {"car", "pedestrian"}
    assert np.median(tracks["y"]) == pytest.approx(104.0 if "poses=" in command else 4.0, abs=1.0)
    last = tracks["frame"] == FRAMES - 1
    expected = boxes()["x"].reshape(-1, 3)[FRAMES - 1]
    assert np.sort(tracks["x"][last]) == pytest.approx(np.sort(expected), abs=0.3)
    assert tracks["z"][last] == pytest.approx(0.8, abs=0.11)


def test_a_submission_to_nuscenes_is_tracked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command of the page writes results in the layout of the benchmark."""
    nuscenes(folder)
    (command, *_) = re.findall(r"^optipmb (track --dataset nuscenes .*)$", PAGE, re.MULTILINE)
    done = run_here(capsys, *shlex.split(command))
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "tracks" / "tracking_results.json").read_text())["results"]


def test_samples_are_small_and_each_has_its_recipe() -> None:
    """Each file below examples/detectors is named by a command, and no recipe has more than 20 kB."""
    for place in (REPOSITORY / "examples" / "detectors").iterdir():
        assert place.name in PAGE
        files = [place] if place.is_file() else [one for one in place.rglob("*") if one.is_file()]
        assert sum(one.stat().st_size for one in files) <= 20_000, place

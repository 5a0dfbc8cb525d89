"""The command tune, on generated scenes."""

import json
from pathlib import Path

import pytest
from optipmb_tools.cli import run

import optipmb

SCENE = ["--dataset", "scene", "--option", "frames=12", "--option", "clouds=0", "--sequences", "0000", "0001"]
CARS = [*SCENE, "--profile", "kitti-paper", "--classes", "Car"]
FEW = ["--trials", "3", "--folds", "2"]


def tune(out: Path, *options: str) -> None:
    assert run(["tune", *CARS, *FEW, "--out", str(out), *options]) == 0


def test_the_same_seed_gives_the_same_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two sessions of three trials, one of them in two parts and one in two processes, give the same bytes."""
    pytest.importorskip("optuna")
    tune(tmp_path / "a")
    shown = capsys.readouterr()
    assert "held out" in shown.out
    assert "trial 3 of 3" in shown.err
    tune(tmp_path / "b", "--trials", "2")
    tune(tmp_path / "b", "--jobs", "2")
    for name in ("tuned.toml", "report.json", "estimate.json", "estimated.toml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_profile_loads_and_says_where_it_comes_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The profile has all classes, other values than before only for the class tuned, and tracks."""
    pytest.importorskip("optuna")
    tune(tmp_path, "--json", "--metric", "mota", "--all")
    report = json.loads(capsys.readouterr().out)
    before, after = optipmb.load_profile("kitti-paper"), optipmb.load_profile(report["profile"])
    assert after.labels == before.labels
    assert after.classes["Cyclist"] == before.classes["Cyclist"]
    for part in ("kitti-paper", "scene", "0000 0001", "Car", "mota", "seed 0", before.provenance.split(maxsplit=1)[0]):
        assert part in after.provenance
    car = report["classes"]["Car"]
    assert {*car["sequences"], *car["held out"]} == {"0000", "0001"}
    assert len(car["held out"]) == 1
    assert car["figures"]["held out, after"]["GT"] + car["figures"]["after"]["GT"] > 0
    assert car["objective"]["after"] >= car["objective"]["before"] - 1e-9
    assert all(one["value"] != one["start"] for one in car["changes"])
    changed = {one["path"] for one in car["changes"]}
    table, other = (profile.model_dump()["classes"]["Car"] for profile in (before, after))
    flat = {key for key in table if table[key] != other[key] and not isinstance(table[key], dict)}
    assert flat <= changed | {"calibration", "heading_sign"}
    assert before.classes["Car"].heading_sign is None, "tuning gives the usual one to a class that has none"
    assert other["calibration"] is not None
    assert car["calibration"]["held out"]
    assert run(["track", *SCENE, "--profile", report["profile"], "--out", str(tmp_path / "tracks")]) == 0


def test_estimates_alone_need_no_search(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--estimate-only tracks nothing and writes a profile that loads."""
    assert run(["tune", *SCENE, "--estimate-only", "--out", str(tmp_path)]) == 0
    assert "measurement_noise.position" in capsys.readouterr().out
    assert optipmb.load_profile(tmp_path / "estimated.toml").name.endswith("-estimated")
    assert not (tmp_path / "trials.db").exists()


def test_a_profile_is_matched_by_common_class_names(tmp_path: Path) -> None:
    """Profile generic has car and bicycle; the new profile has the names of the truth, Car and Cyclist."""
    assert run(["tune", *SCENE, "--profile", "generic", "--estimate-only", "--out", str(tmp_path)]) == 0
    assert {"Car", "Cyclist"} <= set(optipmb.load_profile(tmp_path / "estimated.toml").labels)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([*SCENE, "--classes", "Tram"], "no class 'Tram'"),
        ([*CARS, "--metric", "beauty"], "one of combination"),
    ],
)
def test_wrong_wishes_are_told_in_one_line(
    arguments: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The status is 2, and the line names the error."""
    assert run(["tune", *arguments, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert text in error
    assert "\n" not in error

"""The command sweep, on generated scenes."""

import csv
import json
import re
from pathlib import Path

import pytest
from commands import result_of, run_here

import optipmb

SCENE = ["--dataset", "scene", "--option", "frames=16", "--option", "clouds=0", "--sequences", "0000", "0001"]


def test_a_value_gives_the_figures_of_a_profile_that_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each value applies to all classes, for the time of its row; all else stays as in the profile."""
    swept = result_of(run_here(capsys, "sweep", *SCENE, "--parameter", "birth_score=0.1,0.9", "--json"))["sweeps"][0]
    assert (swept["parameter"], swept["values"]) == ("birth_score", [0.1, 0.9])
    source = optipmb.profile_source("scene")
    for place, value in enumerate((0.1, 0.9)):
        profile = tmp_path / f"{value}.toml"
        profile.write_text(re.sub("(?m)^birth_score = .*", f"birth_score = {value}", source), encoding="utf-8")
        (*_, whole) = result_of(run_here(capsys, "ablate", *SCENE, "--profile", profile, "--json"))["rows"]
        expected = whole["classes"] | {"all classes": whole["overall"]}
        assert {name: rows[place] for name, rows in swept["figures"].items()} == expected
    assert swept["figures"]["Car"][0] != swept["figures"]["Car"][1]


def test_each_parameter_is_swept_on_its_own_and_in_the_classes_named(capsys: pytest.CaptureFixture[str]) -> None:
    """Three parameters give three tables of one class, headed by the profile's value; numbers, words and flags work."""
    asked = ["--parameter", "process_noise.heading=0.1,1", "--parameter", "motion=cv,ctra"]
    done = run_here(capsys, "sweep", *SCENE, "--classes", "Car", *asked, "--parameter", "birth_over_clutter=true")
    assert done.returncode == 0
    own = optipmb.load_profile("scene").classes["Car"]
    titles = [line.strip() for line in done.stdout.splitlines() if line.startswith("Car, ")]
    assert titles == [
        f"Car, process_noise.heading (profile: {own.process_noise.heading})",
        f"Car, motion (profile: {own.motion})",
        f"Car, birth_over_clutter (profile: {own.birth_over_clutter})",
    ]
    rows = [line.split() for line in done.stdout.splitlines() if len(line.split()) == 9]
    assert [row[0] for row in rows] == ["0.1", "1.0", "cv", "ctra", "True"]


def test_the_parameters_of_the_papers_figure_are_swept_by_default(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Survival, clutter rate and misses; the files have a row per value and class, a picture, and the same bytes."""
    for name in ("first", "again"):
        done = run_here(capsys, "sweep", *SCENE, "--classes", "Car", "Cyclist", "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "first" / "sweep.json").read_text(encoding="utf-8"))
    assert [one["parameter"] for one in result["sweeps"]] == ["survival", "clutter_rate", "extract_misses"]
    with (tmp_path / "first" / "sweep.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["parameter"], row["value"], row["class"]) for row in rows] == [
        (one["parameter"], str(value), label)
        for one in result["sweeps"]
        for label in ("Car", "Cyclist", "all classes")
        for value in one["values"]
    ]
    assert {"sAMOTA", "AMOTA", "HOTA", "HOTA, all"} <= set(rows[0])
    assert (tmp_path / "first" / "sweep.png").read_bytes().startswith(b"\x89PNG")
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("survivl=0.9", "such as survival"),
        ("gate.x=1", "has no table gate"),
        ("birth=3", "such as birth.position"),
        ("survival=0.9,2", "less than or equal to 1, received '2'"),
        ("survival=0.9,", "expected NAME=VALUE,VALUE"),
        ("survival", "expected NAME=VALUE,VALUE"),
    ],
)
def test_a_wrong_parameter_is_refused(asked: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One line names the parameter and its allowed values, before anything is tracked."""
    done = run_here(capsys, "sweep", *SCENE, "--parameter", asked)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr
    assert asked.partition("=")[0].partition(".")[0] in done.stderr

"""The commands tune and ablate, on generated scenes."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from optipmb_client.cli import run
from optipmb_client.tuning import ROWS
from optipmb_client.tuning.caution import Jury
from optipmb_client.tuning.evidence import prune, weigh
from optipmb_client.tuning.material import load, of_class
from optipmb_client.tuning.objective import Bench
from optipmb_client.tuning.scoring import rules_of, scorer_of
from optipmb_client.tuning.values import Value, only, value_of, with_values
from optipmb_client.tuning.watch import Quiet
from tuning_cases import Habits, recorded

import optipmb

PAGE = Path(__file__).parents[2] / "docs" / "tuning.md"
SCENE = ["--dataset", "scene", "--option", "frames=16", "--option", "clouds=0", "--sequences", "0000", "0001"]
CARS = [*SCENE, "--profile", "kitti-paper", "--classes", "Car"]
FEW = ["--trials", "3", "--fold-trials", "2", "--folds", "2"]


def tune(out: Path, *options: str) -> None:
    """Tune cars."""
    assert run(["tune", *CARS, *FEW, "--out", str(out), *options]) == 0


def test_the_same_seed_gives_the_same_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two sessions of three trials, one of them in two parts and one in two processes, give the same bytes."""
    pytest.importorskip("optuna")
    tune(tmp_path / "a")
    shown = capsys.readouterr()
    assert "cross-validated" in shown.out
    assert "trial 7 of 7" in shown.err
    tune(tmp_path / "b", "--trials", "2")
    tune(tmp_path / "b", "--jobs", "2")
    for name in ("tuned.toml", "report.json", "estimate.json", "estimated.toml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_profile_loads_and_says_where_it_comes_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The profile has all classes, other values than before only for the class tuned, and tracks."""
    pytest.importorskip("optuna")
    tune(tmp_path, "--json", "--metric", "mota", "--degrade", "0", "--all", "--fold-trials", "1")
    report = json.loads(capsys.readouterr().out)
    before, after = optipmb.load_profile("kitti-paper"), optipmb.load_profile(report["profile"])
    assert after.labels == before.labels
    assert after.classes["Cyclist"] == before.classes["Cyclist"]
    for part in ("kitti-paper", "scene", "0000 0001", "Car", "mota", "seed 0", before.provenance.split(maxsplit=1)[0]):
        assert part in after.provenance
    car = report["classes"]["Car"]
    assert len(car["folds"]) == 2
    assert car["objective"]["after"] >= car["objective"]["before"] - 1e-9
    assert all(one["value"] != one["start"] for one in car["evidence"])
    changed = {one["path"] for one in car["evidence"]}
    table, other = (profile.model_dump()["classes"]["Car"] for profile in (before, after))
    flat = {key for key in table if table[key] != other[key] and not isinstance(table[key], dict)}
    assert flat <= changed | {"calibration", "heading_sign"}
    assert before.classes["Car"].heading_sign is None, "tuning gives the usual one to a class that has none"
    assert other["calibration"] is not None
    assert car["calibration"]["held out"]
    assert car["ranking"][0]["score"] == "x_s"
    assert run(["track", *SCENE, "--profile", report["profile"], "--out", str(tmp_path / "tracks")]) == 0


def test_estimates_alone_need_no_search(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--estimate-only tracks nothing and writes a profile that loads."""
    assert run(["tune", *SCENE, "--estimate-only", "--out", str(tmp_path)]) == 0
    assert "measurement_noise.position" in capsys.readouterr().out
    assert optipmb.load_profile(tmp_path / "estimated.toml").name.endswith("-estimated")
    assert not (tmp_path / "trials.db").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([*SCENE, "--classes", "Tram"], "no class 'Tram'"),
        ([*CARS, "--metric", "beauty"], "one of combination"),
        ([*SCENE, "--profile", "nuscenes"], "nothing would be tracked"),
    ],
)
def test_wrong_wishes_are_told_in_one_line(
    arguments: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The status is 2, and the line says what is wrong."""
    assert run(["tune", *arguments, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert text in error
    assert "\n" not in error


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Three recordings of cars."""
    whole, rules = optipmb.load_profile("kitti-paper"), rules_of("scene")
    sequences = [recorded(Habits(), seed, frames=25, objects=10, name=f"{seed:04d}") for seed in range(3)]
    clips = [of_class(load(one, whole, rules), "Car", rules) for one in sequences]
    with Bench([clips], scorer_of("scene", "Car", sequences), "mota") as made:
        yield made


def test_a_change_that_does_not_pay_is_taken_back(bench: Bench) -> None:
    """Of two changed values, the one with a use is kept and the idle one is put back; the use is told."""
    start = with_values(only(optipmb.load_profile("kitti-paper"), "Car"), "Car", {"gate": 0.1})
    before: dict[str, Value] = {"gate": 0.1, "birth.acceleration": value_of(start, "Car", "birth.acceleration")}
    made = partial(with_values, start, "Car")
    jury = Jury(bench, range(3), start)
    chosen = prune(jury, made, before, {"gate": 4.0, "birth.acceleration": 1.1}, 1.0, Quiet())
    assert chosen == {"gate": 4.0}
    (found,) = weigh(jury, made, before, chosen, Quiet())
    assert (found.path, found.start, found.value, found.positive, found.groups) == ("gate", 0.1, 4.0, 3, 3)
    assert found.gain > 3.0 * found.error > 0.0


def test_the_start_needs_no_caution_and_others_do(bench: Bench) -> None:
    """The cautious score of the start is its score; that of others is less than theirs by their error."""
    start = only(optipmb.load_profile("kitti-paper"), "Car")
    jury = Jury(bench, range(3), start)
    assert jury.score(start, 5.0) == jury.gain(start).value
    other = with_values(start, "Car", {"score_filter": 0.6})
    found = jury.gain(other)
    assert found.error > 0.0
    assert jury.score(other, 2.0) == pytest.approx(found.value - 2.0 * found.error)


def test_the_page_uses_options_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    """Every command of docs/tuning.md has a help, and every option in it is named there."""
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("optipmb ")]
    assert len(lines) >= 6
    for line in lines:
        command, *words = line.split()[1:]
        assert run([command, "--help"]) == 0
        text = capsys.readouterr().out
        assert all(word in text for word in words if word.startswith("--")), line


def test_the_ablation_has_the_sixteen_rows_of_the_paper(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All choices of four modules, each once, from none to all; as a table and as JSON."""
    monkeypatch.setenv("COLUMNS", "200")  # a narrow terminal has the table in parts
    assert len(set(ROWS)) == 16
    assert (ROWS[0], len(ROWS[-1])) == (frozenset(), 4)
    assert run(["ablate", *SCENE, "--classes", "Car"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 18
    assert lines[-1].split()[:4] == ["x"] * 4
    assert run(["ablate", *SCENE, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [sum(row["modules"].values()) for row in rows] == [len(on) for on in ROWS]
    for row in rows:
        assert row["frames_per_second"] > 0.0
        assert set(row["classes"]) == {"Car", "Pedestrian", "Cyclist"}
        assert row["overall"]["FN"] == sum(one["FN"] for one in row["classes"].values())
    assert len({json.dumps(row["overall"]) for row in rows}) > 4

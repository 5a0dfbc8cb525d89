"""The command ablate, on generated scenes."""

import json

import pytest
from optipmb_client.cli import run
from optipmb_client.tuning import ROWS

SCENE = ["--dataset", "scene", "--option", "frames=16", "--option", "clouds=0", "--sequences", "0000", "0001"]


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

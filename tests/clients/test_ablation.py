"""The command ablate, on generated scenes."""

import csv
import json
from pathlib import Path

import pytest
from optipmb_tools.cli import run
from optipmb_tools.tuning.variants import ROWS

DOCS = Path(__file__).parents[2] / "docs"
SCENE = ["--dataset", "scene", "--option", "frames=16", "--option", "clouds=0", "--sequences", "0000", "0001"]


def test_the_ablation_has_the_sixteen_rows_of_the_paper(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All choices of four modules, each once, from none to all; as a table and as JSON."""
    monkeypatch.setenv("COLUMNS", "200")  # a narrow terminal has the table in parts
    assert len(set(ROWS)) == 16
    assert (ROWS[0], len(ROWS[-1])) == (frozenset(), 4)
    assert run(["ablate", *SCENE[:-1], "--classes", "Car"]) == 0
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


@pytest.mark.parametrize(
    ("section", "file", "name"), [("## nuScenes", "nuscenes.csv", "car"), ("## KITTI", "kitti.csv", "Car")]
)
def test_the_tables_of_the_page_are_those_of_the_files(section: str, file: str, name: str) -> None:
    """Rows of docs/ablation.md are those with ADP of its files; without ADP FP differs by 13, others by 0.08."""
    page = (DOCS / "ablation.md").read_text(encoding="utf-8")
    lines = [line for line in page[page.index(section) :].split("\n## ")[0].splitlines() if line.startswith("| ")]
    shown = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    head, *written = (row for row in shown if not set("".join(row)) <= {"-", ":"})
    with (DOCS / "ablation" / file).open(encoding="utf-8", newline="") as opened:
        rows = [row for row in csv.DictReader(opened) if row["class"] == name]
    kept = {adp: [tuple(row[one] for one in head) for row in rows if row["ADP"] == adp] for adp in ("x", "")}
    assert len(written) > 3
    assert {tuple(row) for row in written} <= set(kept["x"])
    for one, without in zip(kept["x"], kept[""], strict=True):
        assert one[:3] == without[:3]
        differ = {name: abs(float(a) - float(b)) for name, a, b in zip(head[3:], one[3:], without[3:], strict=True)}
        assert all(value <= (13.0 if name == "FP" else 0.081) for name, value in differ.items())

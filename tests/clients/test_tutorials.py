"""The commands and programs of the tutorials run as they stand on the pages."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SET_UP = re.compile(r"(pip install|python3 -m venv) .*")


def blocks(page: str, heading: str) -> str:
    """Return the commands and programs of a section of a page as one script, without installations."""
    (section,) = re.findall(
        rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE
    )
    script = []
    for language, text in re.findall(r"^```(sh|python)\n(.*?)^```", section, re.DOTALL | re.MULTILINE):
        commands = [line for line in text.splitlines() if not SET_UP.fullmatch(line)]
        script += ["python - <<'END_OF_PROGRAM'", *commands, "END_OF_PROGRAM"] if language == "python" else commands
    assert script
    return "\n".join(script)


def run(script: str, folder: Path) -> str:
    if not (folder / "examples").exists():
        (folder / "examples").symlink_to(ROOT / "examples")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "COLUMNS": "80"}
    command = ["bash", "-euo", "pipefail", "-c", script]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_getting_started(tmp_path: Path) -> None:
    """The sample is checked, tracked, drawn and evaluated, by the command and in Python."""
    page = "docs/getting-started.md"
    run(blocks(page, "2. Look at your detections"), tmp_path)
    assert "51 tracks" in run(blocks(page, "3. Track"), tmp_path)
    shown = run(blocks(page, "4. Look at the tracks"), tmp_path)
    assert (tmp_path / "crossing.png").stat().st_size > 10_000
    assert re.search(r"car +all .*\n +0\.\d+ +97\.89 .* 0 +0\n", shown)
    assert run(blocks(page, "5. The same in Python"), tmp_path).startswith("OnlineTracks: 29 tracks at 7.900 s")


def test_a_table_with_other_names(tmp_path: Path) -> None:
    """One car, although its columns, units and class have names of their own."""
    run(blocks("docs/tutorials.md", "Track your detector's CSV table"), tmp_path)
    rows = (tmp_path / "tracks.csv").read_text().splitlines()[1:]
    assert len(rows) == 5
    assert {row.split(",")[2] for row in rows} == {"1"}


def test_coming_from_another_tracker(tmp_path: Path) -> None:
    """The program on the page prints one confirmed track."""
    assert run(blocks("docs/migrate.md", "norfair, motpy, SORT"), tmp_path).splitlines()[-1].startswith("[1] [[3.2")


def test_tuning(tmp_path: Path) -> None:
    """A profile is estimated, loads, and tracks a scene that it has not seen."""
    pytest.importorskip("optuna")
    assert "car" in run(blocks("docs/tutorials.md", "Tune a profile"), tmp_path).lower()

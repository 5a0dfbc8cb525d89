"""The commands and programs of the pages run as they stand there, and print what they promise."""

import contextlib
import csv
import io
import re
import runpy
import shlex
import subprocess
from functools import cache
from itertools import takewhile
from pathlib import Path

import pytest
from commands import run_here
from optipmb_service.app.cli import main as service_command
from optipmb_tools.cli import run as client_command

ROOT = Path(__file__).parents[2]
SET_UP = ("pip install ", "python3 -m venv ")


def run(page: str, heading: str, capsys: pytest.CaptureFixture[str], times: int = 2) -> str:
    """Run the blocks of a section of a page twice, without installations; return the last output.

    What a page says that a program prints is compared with what it prints.
    """
    (section,) = re.findall(
        rf"^##? {re.escape(heading)}\n(.*?)(?=^##? |\Z)", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE
    )
    for _ in range(times):
        printed = []
        for language, text, promised in re.findall(
            r"^```(sh|python)\n(.*?)^```\n(?:\nIt prints:\n\n```\n(.*?)^```)?", section, re.DOTALL | re.MULTILINE
        ):
            if language == "python":
                Path("program.py").write_text(text)
                runpy.run_path("program.py")
                printed.append(capsys.readouterr().out)
                assert promised in {"", printed[-1]}
                continue
            lines = text.replace("\\\n", "").splitlines()
            others = [line for line in lines if not line.startswith(("optipmb ", *SET_UP))]
            subprocess.run(["bash", "-euc", "\n".join(others)], check=True, timeout=60)  # noqa: S607
            for line in lines:
                if line.startswith("optipmb "):
                    done = run_here(capsys, *shlex.split(line, comments=True)[1:])
                    assert done.returncode == 0, done.stdout + done.stderr
                    printed.append(done.stdout)
    assert printed
    return "".join(printed)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


def test_getting_started(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The sample is checked, tracked, drawn and evaluated, by the command and in Python."""
    page = "docs/getting-started.md"
    text = (ROOT / page).read_text()
    (promised,) = re.findall(r"^```text\n( +finding.*?)^```", text, re.DOTALL | re.MULTILINE)
    read = run(page, "2. Look at your detections", capsys)
    assert [line.rstrip() for line in read.splitlines()] == promised.splitlines()
    told = run(page, "3. Track", capsys)
    with (folder / "tracks.csv").open() as file:
        shown = {row["id"] for row in csv.DictReader(file) if row["confirmed"] == "1"}
    assert f"80 frames, {len(shown)} tracks, " in told
    assert f"80 frames, {len(shown)} tracks, " in text
    assert told.splitlines()[-1] in text
    figures = run(page, "4. Look at the tracks", capsys)
    assert (folder / "crossing.png").stat().st_size > 10_000
    (promised,) = re.findall(r"^```text\n(class .*?)^```", text, re.DOTALL | re.MULTILINE)
    assert all(line in figures for line in promised.splitlines())
    assert run(page, "5. The same in Python", capsys).startswith(
        re.findall(r"^```text\n(OnlineTracks.*?)^```", text, re.DOTALL | re.MULTILINE)[0]
    )


def test_a_table_with_other_names(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One car, although its columns, units and class have names of their own."""
    run("docs/tutorials.md", "Track your detector's CSV table", capsys)
    rows = (folder / "tracks.csv").read_text().splitlines()[1:]
    assert len(rows) == 5
    assert {row.split(",")[2] for row in rows} == {"1"}


@pytest.mark.timeout(400)  # the joining of tracks may have to be compiled
@pytest.mark.parametrize(
    ("page", "heading"),
    [
        ("faq.md", "Why is my object not shown?"),
        ("gaps.md", "The same object after a gap"),
        ("gaps.md", "While tracking"),
        ("gaps.md", "Appearance"),
        ("gaps.md", "Attributes"),
        ("own-data.md", "Your own data: CSV, Parquet, JSON Lines"),
        ("own-data.md", "Latitude and longitude"),
        ("own-data.md", "Evaluate, tune, plot, replay"),
    ],
)
def test_a_section_of_a_page(page: str, heading: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each of its commands ends with status 0, each of its programs prints what the page says."""
    if heading.startswith("Evaluate"):
        run("docs/own-data.md", "Your own data: CSV, Parquet, JSON Lines", capsys, times=1)
    run(f"docs/{page}", heading, capsys, times=1)


def commands(text: str) -> list[list[str]]:
    """Return the calls of our two programs in a page, in blocks and in the text, as words."""
    blocks = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)).replace("\\\n", " ")
    lines = [
        *re.findall(r"(?:^|\s)(optipmb(?:-service)? .*)$", blocks, re.MULTILINE),
        *re.findall(r"`(optipmb(?:-service)? [^`]+)`", text),
    ]
    found = (shlex.split(line.replace("\\|", "|"), comments=True) for line in lines if line.count("'") % 2 == 0)
    return [list(takewhile(lambda word: word not in {"&", "&&", "|", ">"}, words)) for words in found]


@cache
def helped(*command: str) -> str:
    """Return the help of a command."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        (service_command if command[0] == "optipmb-service" else client_command)([*command[1:], "--help"])
    return printed.getvalue()


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))])
def test_the_commands_of_every_page_exist(page: str) -> None:
    """Each command that a page prints has a help, and each of its options is named there."""
    for program, *words in commands((ROOT / page).read_text()):
        names = list(takewhile(lambda word: re.fullmatch(r"[a-z][a-z-]*", word), words))[
            : 2 if words[:1] == ["camera"] else 1
        ]
        shown = helped(program, *names)
        assert "sage:" in shown, (program, *words)
        wrong = [word for word in words if word.startswith("--") and word.partition("=")[0] not in shown]
        assert not wrong, (program, *words)


def test_variables_stand_for_options(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """OPTIPMB_CONNECT and OPTIPMB_ZENOH_CONFIG are --connect, with commas between several, and --config."""
    monkeypatch.setenv("OPTIPMB_CONNECT", "tcp/127.0.0.1:1,tcp/127.0.0.1:2")
    assert "nothing answers at tcp/127.0.0.1:1, tcp/127.0.0.1:2" in run_here(capsys, "status").stderr
    monkeypatch.setenv("OPTIPMB_ZENOH_CONFIG", "nowhere.json5")
    assert "nowhere.json5" in run_here(capsys, "status").stderr


def test_trackers_side_by_side(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The commands of the page compare two tables of tracks, and draw them."""
    text = (ROOT / "docs/compare.md").read_text()
    for line in re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)[0].splitlines():
        done = run_here(capsys, *shlex.split(line)[1:])
        assert done.returncode == 0, done.stderr
    assert {"car", "pedestrian", "cyclist"} <= set(re.findall(r"^(\w+): shares", done.stdout, re.MULTILINE))
    assert "online.csv" in done.stdout
    assert (folder / "compared.png").stat().st_size > 10_000


def test_tuning(capsys: pytest.CaptureFixture[str]) -> None:
    """A profile is estimated, loads, and tracks a scene that it has not seen."""
    pytest.importorskip("optuna")
    assert "car" in run("docs/tutorials.md", "Tune a profile", capsys).lower()

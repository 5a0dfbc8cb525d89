"""The command line: options with several values, one-line errors, exit statuses, signals."""

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import optipmb, run_here, start
from fake_service import Behaviour, FakeService
from hypothesis import given
from hypothesis import strategies as st
from optipmb_tools.cli import COMMANDS, EXAMPLES, run, spread
from routers import free_endpoint

SMALL = ["--dataset", "scene", "--option", "frames=8", "--option", "vehicles=4", "--option", "clouds=0"]
NAMES = st.text(st.characters(categories=("L", "N")), min_size=1, max_size=4)


@given(st.lists(NAMES, min_size=1), st.data())
def test_every_way_to_give_several_values_means_the_same(names: list[str], data: st.DataObject) -> None:
    """Values after one flag, joined by commas, after an equals sign or after repeated flags are the same list."""
    arguments: list[str] = []
    rest = list(names)
    while rest:
        taken = data.draw(st.integers(1, len(rest)))
        group, rest = rest[:taken], rest[taken:]
        match data.draw(st.sampled_from(["values", "commas", "equals", "repeated"])):
            case "values":
                arguments += ["--x", *group]
            case "commas":
                arguments += ["--x", ",".join(group)]
            case "equals":
                arguments += [f"--x={','.join(group)}"]
            case _:
                arguments += [part for name in group for part in ("--x", name)]
    assert spread(arguments, ["--x"]) == [part for name in names for part in ("--x", name)]


@given(st.lists(st.sampled_from(["track", "--out", "dir", "-v", "a,b", "--y=1,2", "--", "--json"])))
def test_other_arguments_are_left_as_they_are(arguments: list[str]) -> None:
    """Without one of the options, nothing changes."""
    assert spread(arguments, ["--x"]) == arguments


@pytest.mark.parametrize(
    ("given_", "expected"),
    [
        (["track", "--x", "a", "b", "--out", "o"], ["track", "--x", "a", "--x", "b", "--out", "o"]),
        (["--x", "--out", "o"], ["--x", "--out", "o"]),
        (["--x"], ["--x"]),
        (["--x", "a", "--", "b"], ["--x", "a", "--", "b"]),
        (["--x="], ["--x", ""]),
    ],
)
def test_the_values_of_an_option_end_where_the_next_one_begins(given_: list[str], expected: list[str]) -> None:
    """A dash ends the values; a flag without values stays for the parser to refuse."""
    assert spread(given_, ["--x"]) == expected


WRONG = [
    ["track"],
    ["nonsense"],
    ["--nonsense"],
    ["track", "--dataset", "nonsense"],
    ["track", "--dataset", "kitti"],
    ["track", "--dataset", "kitti", "--root", "/nowhere"],
    ["track", *SMALL, "--sequences"],
    ["track", *SMALL, "--sequences", "nonsense"],
    ["track", *SMALL, "--profile", "nonsense"],
    ["track", *SMALL, "--classes", "Tram"],
    ["track", *SMALL, "--option", "frames"],
    ["track", *SMALL, "--option", "nonsense=1"],
    ["track", *SMALL, "--out", "/dev/null/here"],
    ["replay", *SMALL, "--speed", "fast"],
    ["replay", *SMALL, "--speed", "-1"],
    ["replay", *SMALL, "--speed", "nan"],
    ["replay", *SMALL, "--streams", "0"],
    ["status", "--prefix", "a b"],
    ["evaluate", *SMALL, "--tracks", "/nowhere"],
    ["evaluate", *SMALL, "--tracks", "/nowhere", "--iou", "2"],
    ["evaluate", *SMALL, "--tracks", "/nowhere", "--iou", "0.5", "--distance", "2"],
    ["plot", *SMALL, "--tracks", "/nowhere", "--out", "a.png"],
    ["plot", *SMALL, "--tracks", "/nowhere", "--out", "a.png", "--sequences", "0000", "0001"],
    ["demo", "--frames", "1"],
]


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_what_is_wrong_is_said_in_one_line(
    arguments: list[str],
    endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A wrong option, name or path gives exit status 2 and one line on standard error that starts with the program."""
    monkeypatch.chdir(tmp_path)
    if arguments[0] in {"replay", "status"}:
        arguments = [*arguments, "--connect", endpoint]
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("optipmb: ")
    assert len(line) > 15
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("routed", [False, True])
@pytest.mark.parametrize("command", ["replay", "status"])
def test_no_service_is_status_1(
    command: str, endpoint: str, capsys: pytest.CaptureFixture[str], *, routed: bool
) -> None:
    """Without a router one line names the endpoint, with one but no service the service; the status is 1."""
    address = endpoint if routed else free_endpoint()
    options = [*SMALL, "--wait", "0.3"] if command == "replay" else ["--timeout", "0.3"]
    assert run([command, *options, "--connect", address]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert ("service" if routed else address) in line


def test_missing_frames_are_status_1(endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Frames without tracks give status 1 and a line with their number; the results are printed all the same."""
    behaviour = Behaviour(lambda message, tracks: [] if message.seq in {2, 3} else [tracks])
    with FakeService(endpoint, behaviour):
        assert run(["replay", *SMALL, "--connect", endpoint, "--out", str(tmp_path), "--json"]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["missing"] == 2
    assert printed.err.splitlines() == ["optipmb: 2 of 8 frames have no tracks"]


def test_json_is_the_only_output(endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With --json standard output is one JSON document, and standard error is empty when all went well."""
    with FakeService(endpoint):
        assert run(["replay", *SMALL, "--connect", endpoint, "--out", str(tmp_path), "--json"]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert printed.err == ""
    assert result["sequences"][0]["returned"] == 8
    assert Path(result["sequences"][0]["file"]).is_file()


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    """--version prints it; no arguments are a call for help; help of every command works."""
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("optipmb ")
    assert run([]) == 0
    text = capsys.readouterr().out
    for command in ("demo", "track", "replay", "evaluate", "sweep", "plot", "status", "warm-up"):
        assert command in text
        assert run([command, "--help"]) == 0
        assert "--json" in capsys.readouterr().out


def test_a_warm_installation_has_nothing_to_compile(capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb warm-up` compiles missing kernels; afterwards it finds all kernels in their cache."""
    assert run_here(capsys, "warm-up").returncode == 0
    done = optipmb("warm-up", "--json")
    result = json.loads(done.stdout)
    assert (done.returncode, result["command"], result["compiled"]) == (0, "warm-up", 0)


def test_help_does_not_load_the_tracker() -> None:
    """`optipmb --help` imports neither the tracker's compiler nor the plotting library."""
    code = (
        "import sys; from optipmb_tools.cli import run; run(['--help']); "
        "sys.exit(','.join({'numba', 'matplotlib', 'optipmb', 'scipy'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_tracking_a_table_loads_nothing_else(tmp_path: Path) -> None:
    """`optipmb track boxes.csv` imports neither other commands nor other formats, and at most 120 modules of ours."""
    table = tmp_path / "boxes.csv"
    table.write_text(
        "t,x,y,z,length,width,height,yaw,score,class\n0.0,1,2,0,4,2,1,0,0.9,car\n0.1,1,2,0,4,2,1,0,0.9,car\n"
    )
    code = (
        "import sys; from optipmb_tools.cli import run; "
        f"status = run(['track', {str(table)!r}, '--out', {str(tmp_path / 'out')!r}]); "
        "others = ('optuna', 'optipmb_tools.tuning', 'optipmb_tools.datasets.scene', "
        "'optipmb_tools.datasets.kitti', 'optipmb_tools.datasets.nuscenes', 'optipmb_tools.commands.replay'); "
        "ours = [one for one in sys.modules if one.partition('.')[0].startswith('optipmb')]; "
        "sys.exit(','.join(sorted(set(others) & set(sys.modules))) or (ours if len(ours) > 120 else status))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_replay_cleanly(endpoint: str, tmp_path: Path, number: int, status: int) -> None:
    """Ctrl-C and SIGTERM end a replay within seconds: its session is closed, no file or traceback is left."""
    with FakeService(endpoint) as service:
        process = start(
            *("replay", "--dataset", "scene", "--option", "clouds=0", "--speed", "1"),
            *("--connect", endpoint, "--out", tmp_path),
        )
        deadline = time.monotonic() + 60.0
        while not service.seen.detections:
            assert time.monotonic() < deadline, "no frame was sent"
            time.sleep(0.01)  # the fake has no event for its first frame
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
    assert process.returncode == status, err
    assert out == ""
    assert "Traceback" not in err
    assert len(service.seen.closed) == 1
    assert list(tmp_path.iterdir()) == []


INTERRUPTED_TWICE = """
import atexit, os, sys, threading, time
from optipmb_tools import cli

class End:
    def __del__(self, sleep=time.sleep):
        sleep(3)  # the interpreter ends meanwhile

end, number = End(), int(sys.argv.pop())

def interrupt():
    while all(one.name != "open" for one in threading.enumerate()):
        time.sleep(0.01)
    atexit.register(os.kill, os.getpid(), number)
    os.kill(os.getpid(), number)

threading.Thread(target=interrupt).start()
cli.main()
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_end_a_command_that_waits_for_a_router(number: int, status: int) -> None:
    """The wait may end while the interpreter does, and a second signal may come then: neither aborts the process."""
    words = ("status", "--connect", free_endpoint(), "--timeout", "1", str(int(number)))
    command = (sys.executable, "-c", INTERRUPTED_TWICE, *words)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (status, "optipmb: interrupted\n" if status == 130 else "")


@pytest.mark.parametrize("debug", [[], ["--debug"]])
def test_an_error_that_no_code_foresaw_is_one_line(
    debug: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line names the error and the file that was being read, and asks for a report; --debug adds the traceback."""
    path = tmp_path / "training"
    (path / "calib").mkdir(parents=True)

    def broken(*_: object, **__: object) -> None:
        raise KeyError("inside")

    monkeypatch.setattr("optipmb_tools.datasets.kitti.KittiDataset", broken)
    assert run(["check", str(tmp_path), *debug]) == 1
    err = capsys.readouterr().err
    *before, line = err.splitlines()
    assert line.startswith(
        f"optipmb: unexpected KeyError: 'inside' ({tmp_path} was being read): please report this line"
    )
    assert bool(before) == ("Traceback" in err) == bool(debug)


def test_ctrl_c_on_a_terminal_says_what_is_written(tmp_path: Path) -> None:
    """Status 130, one line with the recordings that are written, and no half-written file."""
    begin = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
    words = ["track", "--dataset", "scene", "--option", "frames=100", "--option", "clouds=0", "--jobs", "1"]
    words += ["--sequences", *(f"{k:04}" for k in range(20)), "--out", str(tmp_path)]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", begin, sys.executable, "-m", "optipmb_tools", *words],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    with os.fdopen(ours, "r+b", buffering=0) as terminal:
        while b"0000: 100 frames" not in shown:
            shown += terminal.read(4096)
        terminal.write(b"\x03")
        with contextlib.suppress(OSError):  # a terminal without programs
            while part := terminal.read(4096):
                shown += part
    assert process.wait(60) == 130
    last = shown.decode().splitlines()[-1]
    done = int(re.search(r"interrupted: (\d+) of 20 recordings are in", last)[1])  # type: ignore[index]  # it is there
    assert sorted(path.name for path in tmp_path.iterdir())[:done] == [f"{k:04}.txt" for k in range(done)]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_the_help_can_be_called(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each help ends with two of them, whose options the command has."""
    assert run(["help", command]) == 0
    shown = capsys.readouterr().out
    for words in EXAMPLES[command]:
        assert f"optipmb {command} {words}".strip() in " ".join(shown.split())
        options = re.findall(r"--[a-z-]+", words)
        assert all(re.search(rf"^│ (\*  )?.*{one}\b", shown, re.MULTILINE) for one in options), (words, shown)


@pytest.mark.parametrize(
    ("word", "text"), [("trak", "Did you mean track?"), ("xyz", "optipmb help lists the commands")]
)
def test_a_mistyped_command_is_corrected(word: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The error names the command that is most like it, or the help."""
    assert run([word]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands(shell: str) -> None:
    """The script of `--show-completion` asks the program, which knows commands and options."""
    asked = {"_OPTIPMB_COMPLETE": f"complete_{shell}", "COMP_WORDS": "optipmb tra", "COMP_CWORD": "1"}
    asked |= {"_TYPER_COMPLETE_ARGS": "optipmb tra", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    program = [sys.executable, "-c", "from optipmb_tools.__main__ import main; main()"]
    done = subprocess.run(program, env=os.environ | asked, capture_output=True, text=True, timeout=120, check=False)
    assert {"track", "tracks"} <= set(re.findall(r"\w+", done.stdout))


def test_assumptions_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Detections and truth alike say each assumption once; `--verbose` has a line for each, with its option."""
    table = tmp_path / "boxes.csv"
    rows = [f"0.{k},{k},2,0,4,2,1,0,0.9,car,1" for k in range(8)]
    table.write_text("\n".join(["time,x,y,z,length,width,height,yaw,score,class,id", *rows]))
    words = ["evaluate", str(table), "--truth", str(table), "--tracks", str(table), "--iou", "0.5"]
    (line, *_) = run_here(capsys, *words).stderr.splitlines()
    assert line.count("stamps are in seconds") == 1
    assert line.endswith("(--verbose says more)")
    assert "--option time=UNIT" in run_here(capsys, *words, "--verbose").stderr


def test_a_closed_pipe_is_no_error(endpoint: str, tmp_path: Path) -> None:
    """`optipmb ... | head -0` leaves no traceback."""
    with FakeService(endpoint):
        process = start("replay", *SMALL, "--connect", endpoint, "--out", tmp_path)
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
        process.stderr.close()
        process.wait(60)


def test_tracks_are_evaluated_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What track writes, evaluate and plot read: figures per class, in a table or as JSON, and a PNG."""
    data = ["--dataset", "scene", "--option", "frames=30", "--option", "clouds=0"]
    tracks = ["--tracks", str(tmp_path)]
    assert run(["track", *data, "--out", str(tmp_path), "--json"]) == 0
    capsys.readouterr()
    assert run(["evaluate", *data, *tracks]) == 0
    _, _, head, *rows = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ["class", "tracks", "MOTA"]
    assert [row.split()[0] for row in rows[:6] if not row.startswith(" ")] == ["Car", "Pedestrian", "Cyclist"]
    assert run(["evaluate", *data, *tracks, "--class", "Car", "Cyclist", "--iou", "0.25", "--json"]) == 0
    classes = json.loads(capsys.readouterr().out)["classes"]
    assert list(classes) == ["Car", "Cyclist"]
    assert 0.7 < classes["Car"]["best"]["MOTA"] <= 1.0
    assert classes["Car"]["all"]["GT"] == classes["Car"]["sequences"]["0000"]["GT"] > 100
    picture = tmp_path / "picture.png"
    assert run(["plot", *data, *tracks, "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_configuration_file_is_used(endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--config names a Zenoh configuration whose endpoints hold; one that is not there is named."""
    config = tmp_path / "client.json5"
    config.write_text(f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}}}')
    with FakeService(endpoint):
        assert run(["status", "--config", str(config), "--timeout", "10"]) == 0
    assert "fake" in capsys.readouterr().out
    assert run(["status", "--config", str(tmp_path / "absent")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "absent") in line


def test_track_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --json a line per sequence and the folder of the results are printed."""
    done = run_here(capsys, "track", *SMALL, "--sequences", "0000", "0001", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("0000: 8 frames, ")
    assert lines[1].startswith("0001: 8 frames, ")
    assert lines[2].startswith(f"results in {tmp_path} (")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0000.txt", "0001.txt", "shown"]

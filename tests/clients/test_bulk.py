"""Many recordings in several processes: despite killed and failed workers, results equal one process byte for byte."""

import errno
import json
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from bulk_numbers import double
from bulk_tasks import RECORDINGS, Dying, bytes_of, recordings, tracked_plainly
from commands import run_here, start
from optipmb_client.errors import ClientError, UsageError
from optipmb_schemas.installation import install_command
from optipmb_tools.cli import run as command
from optipmb_tools.datasets import DatasetArguments
from optipmb_tools.run.bulk import Executor, Failed, Here, Processes, executor_for, run, values
from optipmb_tools.run.profiles import profile_for
from optipmb_tools.run.tracking import Tracking, track
from optipmb_tools.table_files import write_table
from own_tables import FRAMES, boxes

ENDS_S = 120.0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recordings(tmp_path_factory.mktemp("recordings"))


def workers(of: int) -> set[int]:
    children, found = [], set()
    for task in Path(f"/proc/{of}/task").iterdir():
        with suppress(OSError):  # the thread has ended
            children += (task / "children").read_text().split()
    for child in children:
        with suppress(OSError):  # it has ended
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.add(int(child))
    return found


def ended(processes: set[int]) -> bool:
    until = time.monotonic() + ENDS_S
    while any(Path(f"/proc/{one}/cmdline").exists() and Path(f"/proc/{one}/cmdline").read_bytes() for one in processes):
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
    return True


def test_killed_workers_lose_nothing(data: Path, tmp_path: Path) -> None:
    """Of 20 recordings, two workers killed in the middle of one and one between two, come the bytes of one process."""
    plain = tracked_plainly(data, tmp_path / "plain")
    asked = DatasetArguments("table", data)
    opened = asked.open()
    sequences = opened.sequences(["all"])
    parameters, out = profile_for("kitti", sequences), tmp_path / "out"
    notes: list[str] = []
    with Processes(2) as executor:
        dying = Dying(executor, tmp_path, {"r004", "r012"})
        done = track(opened, sequences, out, Tracking(parameters), executor=dying, note=notes.append)
        results = [next(done) for _ in range(8)]
        victim = workers(os.getpid()).pop()
        os.kill(victim, signal.SIGKILL)
        results += done
    assert [one.name for one in results] == [one.name for one in sequences]
    assert len(results) == RECORDINGS
    assert bytes_of(out) == plain
    assert {"r004", "r012"} <= {note.split()[1].rstrip(":") for note in notes if "its process died" in note}


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_fails_stops_nothing_else(jobs: int) -> None:
    """A task that is refused, one that raises and one that is always killed are reported; the others give values."""
    tasks = [task for task in range(10, 20) if jobs > 1 or task != 15]
    notes: list[str] = []
    with executor_for(jobs) as executor:
        executor.start(double, 2)
        ended = run(executor, tasks, lambda task: f"task {task}", notes.append)
        results = {tasks[place]: result for place, result in ended}
    failed = {task: one for task, one in results.items() if isinstance(one, Failed)}
    assert {task: one for task, one in results.items() if not isinstance(one, Failed)} == {
        task: 2 * task for task in tasks if task not in {13, 14, 15}
    }
    assert failed[13] == Failed("thirteen", wrong_input=True)
    assert failed[14].reason.startswith("unexpected ZeroDivisionError: fourteen: please report")
    assert not failed[14].wrong_input
    assert failed[14].trace.endswith("ZeroDivisionError: fourteen\n")
    if jobs > 1:
        assert failed[15].reason == "its process died (killed, or out of memory), 3 times"
        assert sum(note.startswith("task 15: its process died") for note in notes) == 2


def test_a_system_that_starts_no_process_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no other process can be started, one error says what to do."""

    def refuse(*_: object) -> None:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(ProcessPoolExecutor, "submit", refuse)
    with Processes(2) as executor:
        executor.start(double, 2)
        with pytest.raises(ClientError, match="temporarily unavailable; --jobs 1 needs none"):
            values(executor, [1], str)


@pytest.mark.parametrize("executor", [Here(), Processes(2)], ids=["here", "processes"])
def test_values_come_in_order_or_not_at_all(executor: Executor) -> None:
    """Where all values are needed they come in the order of the tasks, and the first failure is raised as it was."""
    with executor:
        executor.start(double, 3)
        assert values(executor, range(12), str) == [3 * task for task in range(12)]
        executor.start(double, 4)
        assert values(executor, [1, 2], str) == [4, 8]
        with pytest.raises(UsageError, match=r"^thirteen$"):
            values(executor, [1, 13, 2], str)
        with pytest.raises(ClientError, match="fourteen"):
            values(executor, [14], str)


def broken(folder: Path) -> Path:
    """Write four recordings, one of which has a frame that the tracker refuses."""
    plain = boxes()
    four = {name: np.tile(values, 4) for name, values in plain.items()}
    four["log"] = np.repeat(["a", "b", "c", "d"], 3 * FRAMES)
    four["x"][3 * FRAMES + 7] = 1e9
    write_table(folder / "d.csv", four)
    return folder / "d.csv"


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_recording_that_fails_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str], jobs: str) -> None:
    """Of four recordings one is refused: a line and the JSON name it, the others are tracked, and the status is 1."""
    arguments = ("track", broken(tmp_path), "--profile", "kitti", "--out", tmp_path / "out", "--jobs", jobs, "--json")
    done = run_here(capsys, *arguments)
    assert done.returncode == 1, done.stderr
    assert "recording b failed: sequence b, frame 2: " in done.stderr
    assert done.stderr.splitlines()[-1] == "optipmb: 1 of 4 recordings failed, the others are tracked: b"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.csv", "c.csv", "d.csv"]
    assert list(json.loads(done.stdout)["failed"]) == ["b"]
    alone = run_here(capsys, *arguments, "--sequences", "b")
    assert (alone.returncode, alone.stderr.count("frame 2")) == (2, 1)


def test_workers_end_with_the_command(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed, or asked to end, in the middle of its work, the command leaves no process and no file behind."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    for way in (signal.SIGKILL, signal.SIGTERM):
        out = tmp_path / way.name
        process = start("track", data, "--profile", "kitti", "--out", out, "--jobs", "2", fresh=True)
        until = time.monotonic() + ENDS_S
        while len(found := workers(process.pid)) < 2 and process.poll() is None and time.monotonic() < until:
            time.sleep(0.02)
        process.send_signal(way)
        process.communicate(timeout=ENDS_S)
        assert ended(found)
        assert not list((tmp_path / "temporary").iterdir())


def test_no_ray_is_said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Ray, `--ray` names the command that installs it; with and without an address, first or last."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *_: None if name == "ray" else object())
    scene = ["--dataset", "scene", "--option", "frames=3", "--option", "clouds=0"]
    for words in (["--ray", *scene], [*scene, "--ray"], [*scene, "--ray", "10.0.0.1:6379"], [*scene, "--ray", "auto"]):
        assert command(["track", *words]) == 1
        assert install_command("ray") in capsys.readouterr().err

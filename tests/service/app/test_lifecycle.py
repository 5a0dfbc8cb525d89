"""The end of every process has a bound: where a step of it hangs, the process ends, and says where."""

import contextlib
import faulthandler
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from optipmb_schemas import Keys, SessionState
from optipmb_service.app.lifecycle import HANDOVER_S, LAST_S, EndBound, Steps, StopRequest, longest_end_s, say_ready
from optipmb_service.app.workers import WORKERS_S
from processes import descendants, wait_until_ended
from router import Node, Sensor
from routers import free_endpoint, open_router
from service_process import ServiceProcess
from structlog.testing import capture_logs

NAMESPACE = ("unshare", "--pid", "--fork", "--kill-child")
HANGING = Path(__file__).parents[2] / "support" / "hanging"
SENSOR = Sensor()
GRACE_S = 0.5
SHORT_S = 1.0
"""For a handover, where a process is to hang."""
BOUND_S = longest_end_s(GRACE_S) - HANDOVER_S + SHORT_S
FROZEN_S = 3.0
"""So long that it is noticed, and shorter than the bound."""
BUSY_S = 30.0
"""How much later a busy machine may notice that a process has ended."""


def environment(hang: str = "", **settings: object) -> dict[str, str]:
    """Return variables for a process that is to hang at a place, or nowhere."""
    path = os.pathsep.join(filter(None, (str(HANGING), os.environ.get("PYTHONPATH"))))
    hangs = {"PYTHONPATH": path, "HANG": hang, "HANDOVER_S": str(SHORT_S)} if hang else {}
    return hangs | {f"OPTIPMB_{name}": str(value) for name, value in ({"GRACE_S": GRACE_S} | settings).items()}


def processes(folder: Path, router: str, hang: str = "") -> dict[str, ServiceProcess]:
    """Start one of every kind; clients use this router."""
    topics = folder / "ros2.toml"
    topics.write_text('[ros2.streams."site/node/lidar"]\ndetections = "/boxes"\n')
    nowhere = free_endpoint().removeprefix("tcp/")
    commands = {
        "alone": (),
        "workers": ("--workers", "2"),
        "router": ("router",),
        "grpc": ("grpc", "--connect", router, "--grpc", free_endpoint().removeprefix("tcp/")),
        "log": ("log", "--connect", router, "--cluster", f"nats://{nowhere}"),
        "ros2": ("ros2", "--connect", router, "--settings", str(topics)),
    }
    listening = {"alone", "workers", "router"}
    return {
        name: ServiceProcess(*options, listen=name in listening, environment=environment(hang))
        for name, options in commands.items()
    }


def ends(folder: Path, hang: str = "") -> tuple[dict[str, tuple[int, float]], dict[str, str]]:
    """Return exit status and seconds of the end of each process after SIGTERM, and the logs."""
    with contextlib.ExitStack() as stack:
        router = free_endpoint()
        stack.enter_context(open_router(router))
        started = processes(folder, router, hang)
        for one in started.values():
            stack.enter_context(one)
        for one in started.values():
            one.wait_ready()
        below = {pid for one in started.values() for pid in descendants(one.process.pid)}
        with ThreadPoolExecutor(len(started)) as threads:
            ended = dict(zip(started, threads.map(ServiceProcess.end, started.values()), strict=True))
        assert wait_until_ended(below, 0.0) == set()
        return ended, {name: one.errors for name, one in started.items()}


def test_the_line_ready_is_one_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """Text and end, so that no log line comes between them where output is not buffered."""
    written: list[str] = []
    monkeypatch.setattr("sys.stdout", SimpleNamespace(write=written.append, flush=lambda: None))
    say_ready("instance", "edge-1", ["tcp/127.0.0.1:7447"])
    assert written == ["ready instance=edge-1 endpoints=tcp/127.0.0.1:7447\n"]


def test_a_session_that_hangs_in_its_close_keeps_no_process(tmp_path: Path) -> None:
    """Where Zenoh's session does not close, every process ends within its bound, with status 1 and the place logged."""
    ended, logs = ends(tmp_path, "close")
    assert {name: status for name, (status, _) in ended.items()} == dict.fromkeys(ended, 1)
    for name, (_, seconds) in ended.items():
        bound_s = BOUND_S + (WORKERS_S if name == "workers" else 0.0)
        assert bound_s - LAST_S <= seconds < bound_s + BUSY_S, name
        # The parent says it, and each of its workers.
        assert logs[name].count("end_hangs") == (3 if name == "workers" else 1)
        assert "sitecustomize.hang" in logs[name]
    assert "worker_killed" not in logs["workers"]


def test_what_hangs_nowhere_ends_with_status_0(tmp_path: Path) -> None:
    """Every process follows SIGTERM with status 0, before its bound."""
    ended, logs = ends(tmp_path)
    assert {name: status for name, (status, _) in ended.items()} == dict.fromkeys(ended, 0)
    assert not [name for name, text in logs.items() if "hangs" in text or "Traceback" in text]


def test_a_step_that_hangs_before_the_last_checkpoint_does_not_prevent_it(tmp_path: Path) -> None:
    """A member whose end hangs in its first step keeps the newest state all the same: the next one continues it."""
    settings = {"STORE": tmp_path, "CHECKPOINT_S": 3600}
    with ServiceProcess(environment=environment("leave", **settings)) as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(*(SENSOR.detections(seq) for seq in range(5)))
            session = node.tracks(SENSOR.stream, 5)[-1].session
        status, _ = service.end()
        assert status == 1
        service.wait_log("step_hangs")
    with ServiceProcess(environment=environment(**settings, RECOVERY_WAIT_S=0)) as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(SENSOR.detections(5))
            assert node.tracks(SENSOR.stream, 1)[0].session == session
            assert node.ask(Keys().query(SENSOR.stream, "state"), SessionState).frames == 6
        assert service.end(signal.SIGTERM)[0] == 0


def test_what_lets_no_python_run_is_ended_by_the_first_signal() -> None:
    """A loop that turns no more, and a close with the interpreter's lock held, are ended too, with tracebacks."""
    with (
        ServiceProcess("router", environment=environment("lock")) as router,
        ServiceProcess(environment=environment("loop")) as service,
        ThreadPoolExecutor() as threads,
    ):
        router.wait_ready()
        service.wait_log("the loop hangs")
        for status, seconds in threads.map(ServiceProcess.end, (router, service)):
            assert status == 1
            assert seconds < BOUND_S + BUSY_S
    assert "in hang_with_the_lock" in router.errors
    assert "sitecustomize.hang" in service.errors


def test_the_time_of_a_frozen_process_does_not_count() -> None:
    """A process that is stopped during its end has the rest of its time when it continues."""
    with ServiceProcess("router", environment=environment("close")) as router:
        router.wait_ready()
        began = time.monotonic()
        router.process.send_signal(signal.SIGTERM)
        router.wait_log("stop_asked")
        router.process.send_signal(signal.SIGSTOP)
        time.sleep(FROZEN_S)
        status, seconds = router.end(signal.SIGCONT)
    assert status == 1
    assert time.monotonic() - began > BOUND_S - LAST_S + FROZEN_S / 2
    assert seconds < BOUND_S + BUSY_S
    assert "end_hangs" in router.errors


async def test_where_no_thread_can_be_started_the_end_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a limit of processes the first signal counts, though the end has no bound; a step is not done, and said so."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(faulthandler, "dump_traceback_later", lambda *_, **__: None)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    asked, steps = StopRequest(EndBound(60.0)), Steps()
    with capture_logs() as logs:
        asked.ask("SIGTERM")
        steps.do("leaving", list)
        assert steps.unfinished(1.0)
    assert asked.is_set()
    assert [one["event"] for one in logs] == ["end_unbounded", "stop_asked", "step_hangs"]


async def test_hangups_that_are_ignored_stay_ignored() -> None:
    """As under `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        StopRequest(EndBound(60.0))
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGUSR1) != signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def caught(pid: int) -> bool:
    """Whether a process has a handler of its own for SIGTERM."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    mask = next(int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))
    return bool(mask >> (signal.SIGTERM - 1) & 1)


def test_little_is_loaded_before_signals_have_handlers() -> None:
    """Process 1 of a container gets no signal before: not even the version is read."""
    code = (
        "import sys; import optipmb_service.__main__ as one; print(one.__name__, 'importlib.metadata' in sys.modules)"
    )
    command = [sys.executable, "-S", "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}"]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    assert loaded == "optipmb_service.__main__ False\n"


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "process 1"])
@pytest.mark.parametrize("options", [(), ("--workers", "2"), ("mqtt",)], ids=lambda one: " ".join(one) or "run")
def test_a_signal_before_the_imports_ends_the_process(*, options: tuple[str, ...], alone: bool) -> None:
    """Handlers are there before numpy is, also as process 1, which gets no other signals: status 0, nothing printed."""
    if not alone and subprocess.run([*NAMESPACE, "true"], check=False, timeout=60, capture_output=True).returncode:
        pytest.skip("no namespace may be made here")
    command = [*(() if alone else NAMESPACE), sys.executable, "-m", "optipmb_service", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
            ends = time.monotonic() + 60.0
            while not (pids := [process.pid] if alone else [int(one) for one in children.read_text().split()]) or not (
                caught(pids[0]) and Path(f"/proc/{pids[0]}/cmdline").read_bytes().startswith(sys.executable.encode())
            ):
                assert time.monotonic() < ends
                assert process.poll() is None
            os.kill(pids[0], signal.SIGSTOP)
            loaded = Path(f"/proc/{pids[0]}/maps").read_text()
            os.kill(pids[0], signal.SIGTERM)
            os.kill(pids[0], signal.SIGCONT)
            out, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, out, errors) == (0, b"", b"")
    assert "numpy" not in loaded

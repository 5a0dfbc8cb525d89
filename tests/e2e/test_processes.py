"""The service as a child process: it comes up, it ends, and it never stays behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import start
from optipmb_client import Connection, ServiceUnavailable
from optipmb_tools.run.service_process import ServiceProcess
from processes import descendants, running, wait_until_ended

START_S = 240.0


def test_a_service_comes_up_and_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers at its endpoint while the context lasts, ends with status 0 after it, and its log is kept.

    Settings in the environment are meant for other services and do not reach it: the one here would end its start.
    """
    monkeypatch.setenv("OPTIPMB_MAX_SESSIONS", "none")
    log = tmp_path / "folder" / "service.log"
    with ServiceProcess(log=log) as service:
        service.wait_until_ready(START_S)
        with Connection(service.endpoint) as connection:
            assert len(connection.alive("optipmb/v1/service/*/alive")) == 1
        pids = {service.process.pid} | descendants(service.process.pid)
    assert service.process.returncode == 0
    assert wait_until_ended(pids, 0.0) == set()
    assert "ready" in log.read_text()


def test_a_service_that_cannot_start_is_told_with_its_words() -> None:
    """A wrong setting ends the service at its start: the error carries its output."""
    with (
        ServiceProcess(environment={"OPTIPMB_MAX_SESSIONS": "none"}) as service,
        pytest.raises(ServiceUnavailable, match="max_sessions"),
    ):
        service.wait_until_ready(START_S)
    assert not running(service.process.pid)


def test_a_service_that_the_system_does_not_start_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no process can be started, the error says so."""
    monkeypatch.setattr(sys, "executable", "/no/interpreter")
    with pytest.raises(ServiceUnavailable, match=r"cannot start a service on this machine.*/no/interpreter"):
        ServiceProcess().__enter__()


def test_a_frozen_service_is_killed() -> None:
    """A service that does not follow SIGTERM, here one that is frozen in its start, is killed after its grace."""
    with ServiceProcess(grace_s=0.5) as service:
        service.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, service.process.pid, os.WSTOPPED)
        begun = time.monotonic()
    assert time.monotonic() - begun >= 0.5
    assert service.process.returncode == -signal.SIGKILL


def test_the_service_ends_when_its_parent_is_killed() -> None:
    """SIGKILL of the parent, which can clean up nothing, takes the service along, also while that starts."""
    code = (
        "from optipmb_tools.run.service_process import ServiceProcess\n"
        "with ServiceProcess() as service:\n"
        "    print(service.process.pid, flush=True)\n"
        "    service.process.wait(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert running(child)
        parent.kill()
    assert wait_until_ended({child}, 60.0) == set()


@pytest.mark.parametrize(
    ("stage", "number", "status"),
    [("starting", signal.SIGINT, 130), ("replaying", signal.SIGTERM, 143), ("replaying", signal.SIGKILL, -9)],
)
def test_an_interrupted_demo_leaves_nothing_behind(tmp_path: Path, stage: str, number: int, status: int) -> None:
    """However the demo ends, at any stage, the service ends too, and there is no traceback."""
    environment = os.environ | {"PYTHONFAULTHANDLER": "1"}  # SIGABRT prints where each thread is
    process = start("demo", "--out", tmp_path, "--frames", 10, "--speed", 0.1, fresh=True, env=environment)
    assert process.stderr is not None
    try:
        for line in process.stderr:
            if line.startswith(stage):
                break
        else:
            pytest.fail(f"the demo ended before {stage}")
        children = descendants(process.pid)
        deadline = time.monotonic() + 60.0
        while not children and time.monotonic() < deadline:
            children = descendants(process.pid)  # told of the stage, the service is being started
        assert children
        os.kill(process.pid, number)
        try:
            out, err = process.communicate(timeout=120)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)
            out, err = process.communicate(timeout=120)
    finally:
        process.kill()
        process.wait(60)
    assert process.returncode == status, err
    assert out == ""
    assert "Traceback" not in err
    assert wait_until_ended(children, 10.0) == set()

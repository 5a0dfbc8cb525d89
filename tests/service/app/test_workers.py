"""What the parent of worker processes does with one that gives no sign of life."""

import asyncio
import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_service.app import workers
from optipmb_service.app.configuration import load
from optipmb_service.app.lifecycle import EndBound, StopRequest
from optipmb_service.app.workers import Supervisor, Worker, serve_workers
from optipmb_service.telemetry.health import ProcessHealth
from optipmb_service.telemetry.metrics import Metrics
from structlog.testing import capture_logs
from unbounded import NO_BOUND


@pytest.mark.parametrize(("status", "failed"), [(-9, 1), (0, 1), (3, 3)])
async def test_a_worker_that_ends_in_its_first_start_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, status: int, failed: int
) -> None:
    """The exit status is the worker's, and 1 for one that was killed, or ended without a reason."""

    async def run(*_: object) -> int:
        return status

    monkeypatch.setattr(Worker, "run", run)
    supervisor = Supervisor(
        load(None, {"workers": 2, "store": "none"}).settings, StopRequest(EndBound(60.0)), Path("unused")
    )
    assert not await supervisor.start()
    assert supervisor.failed == failed


async def test_a_worker_that_cannot_be_started_ends_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the system starts no other process, the command ends with status 1 and the reason, and does not wait."""
    monkeypatch.setattr(sys, "executable", "/no/interpreter")
    supervisor = Supervisor(
        load(None, {"workers": 2, "store": "none"}).settings, StopRequest(EndBound(60.0)), Path("unused")
    )
    with capture_logs() as logs:
        assert not await asyncio.wait_for(supervisor.start(), 60.0)
    assert supervisor.failed == 1
    assert "/no/interpreter" in next(line["error"] for line in logs if line["event"] == "worker_not_started")


@pytest.mark.parametrize(
    ("status", "orderly"), [(0, True), (75, True), (-15, True), (-2, True), (1, False), (-9, False), (-11, False)]
)
async def test_a_worker_that_is_killed_in_its_end_is_no_orderly_end(
    monkeypatch: pytest.MonkeyPatch, status: int, *, orderly: bool
) -> None:
    """One that crashes while it writes its last checkpoints counts; one that a SIGTERM to all met early does not."""
    asked = StopRequest(NO_BOUND)

    async def run(*_: object) -> int:
        asked.ask("test")
        return status

    monkeypatch.setattr(Worker, "run", run)
    supervisor = Supervisor(load(None, {"workers": 1, "store": "none"}).settings, asked, Path("unused"))
    assert not await supervisor.start()
    assert await supervisor.stop() is orderly


async def test_workers_hear_of_the_end_before_grpc_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """To close it keeps the loop for seconds, of which the workers have need."""
    happened: list[str] = []
    asked = StopRequest(NO_BOUND)

    ended = asyncio.Event()

    async def run(worker: Worker, *_: object) -> int:
        worker.hear({"event": "ready"})
        await ended.wait()
        return 0

    def close() -> None:
        happened.append("told")
        ended.set()

    monkeypatch.setattr(Worker, "run", run)
    monkeypatch.setattr(Worker, "end", lambda _: asyncio.get_running_loop().call_soon(close))  # as a pipe is closed

    @contextlib.contextmanager
    def grpc(*_: object) -> Iterator[None]:
        yield
        happened.append("closed")

    nothing = {name: lambda *_: None for name in ("watch", "serve_service", "announce", "client")}
    settings = load(None, {"workers": 1, "store": "none"}).settings
    monkeypatch.setattr(workers, "grpc_edge", grpc)
    monkeypatch.setattr(workers, "say_ready", lambda *_: asked.ask("test"))
    transport: Any = SimpleNamespace(**nothing)
    supervisor, health = Supervisor(settings, asked, Path("unused")), ProcessHealth("test", Metrics())
    assert await serve_workers(settings, supervisor, transport, asked, health)
    assert happened[:2] == ["told", "closed"]


@pytest.mark.parametrize(("silent_s", "killed"), [(10.0, False), (2000.0, True)])
async def test_a_worker_that_hangs_while_it_starts_is_killed(
    monkeypatch: pytest.MonkeyPatch, silent_s: float, *, killed: bool
) -> None:
    """A start may take much longer than `stuck_s`, but not for ever."""
    monkeypatch.setattr(workers, "BEAT_S", 0.0)
    settings = load(None, {"workers": 2, "store": "none"}).settings
    supervisor = Supervisor(settings, StopRequest(EndBound(60.0)), Path("unused"))
    ended: list[Worker] = []
    monkeypatch.setattr(Worker, "kill", lambda one: ended.append(one))  # noqa: PLW0108 - bound to the worker
    worker = supervisor.workers[0]
    worker.state, worker.heard = "starting", time.monotonic() - silent_s
    watching = asyncio.create_task(supervisor._watch())
    for _ in range(20):
        await asyncio.sleep(0)
    watching.cancel()
    assert ended == ([worker] if killed else [])

"""What the parent of worker processes does with one that gives no sign of life."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import optipmb_service.app.supervisor
import pytest
from optipmb_service.app.ending import EndBound
from optipmb_service.app.loops import StopRequest
from optipmb_service.app.supervisor import Supervisor, _supervised
from optipmb_service.settings.loading import load
from unbounded import NO_BOUND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@pytest.mark.parametrize(("status", "failed"), [(-9, 1), (0, 1), (3, 3)])
async def test_a_worker_that_ends_in_its_first_start_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, status: int, failed: int
) -> None:
    """The exit status is the worker's, and 1 for one that was killed, or ended without a reason."""

    class Ending:
        def __init__(self, *_: object) -> None:
            pass

        async def run(self, *_: object) -> int:
            return status

    monkeypatch.setattr(optipmb_service.app.supervisor, "WorkerProcess", Ending)
    supervisor = Supervisor(
        load(None, {"workers": 2, "store": "none"}).settings, StopRequest(EndBound(60.0)), Path("unused")
    )
    await supervisor._kept(0)
    assert supervisor.failed == failed


@pytest.mark.parametrize(
    ("status", "orderly"), [(0, True), (75, True), (-15, True), (-2, True), (1, False), (-9, False), (-11, False)]
)
async def test_a_worker_that_is_killed_in_its_end_is_no_orderly_end(
    monkeypatch: pytest.MonkeyPatch, status: int, *, orderly: bool
) -> None:
    """One that crashes while it writes its last checkpoints counts; one that a SIGTERM to all met early does not."""
    asked = StopRequest(NO_BOUND)

    class Ending:
        def __init__(self, *_: object) -> None:
            pass

        async def run(self, *_: object) -> int:
            asked.ask("test")
            return status

        def end(self) -> None:
            pass

        kill = end

    monkeypatch.setattr(optipmb_service.app.supervisor, "WorkerProcess", Ending)
    supervisor = Supervisor(load(None, {"workers": 1, "store": "none"}).settings, asked, Path("unused"))
    assert not await supervisor.start()
    assert await supervisor.stop() is orderly


async def test_workers_hear_of_the_end_before_grpc_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """To close it keeps the loop for seconds, of which the workers have need."""
    happened: list[str] = []
    asked = StopRequest(NO_BOUND)

    class Ending:
        def __init__(self, _: int, event: Callable[[dict[str, Any]], None]) -> None:
            self._event = event
            self._ended = asyncio.Event()

        async def run(self, *_: object) -> int:
            self._event({"event": "ready"})
            await self._ended.wait()
            return 0

        def end(self) -> None:
            asyncio.get_running_loop().call_soon(self._close)  # as a pipe is closed

        def _close(self) -> None:
            happened.append("told")
            self._ended.set()

        def kill(self) -> None:
            pass

    @contextlib.contextmanager
    def grpc(*_: object) -> Iterator[None]:
        yield
        happened.append("closed")

    nothing = {name: lambda *_: None for name in ("watch", "serve_service", "announce", "client", "close")}
    settings = load(None, {"workers": 1, "store": "none"}).settings
    monkeypatch.setattr(optipmb_service.app.supervisor, "WorkerProcess", Ending)
    monkeypatch.setattr(optipmb_service.app.supervisor, "grpc_edge", grpc)
    monkeypatch.setattr(optipmb_service.app.supervisor, "say_ready", lambda *_: asked.ask("test"))
    transport: Any = SimpleNamespace(**nothing)
    assert await _supervised(settings, settings, transport, asked, Path("unused")) == 0
    assert happened[:2] == ["told", "closed"]


@pytest.mark.parametrize(("silent_s", "killed"), [(10.0, False), (2000.0, True)])
async def test_a_worker_that_hangs_while_it_starts_is_killed(
    monkeypatch: pytest.MonkeyPatch, silent_s: float, *, killed: bool
) -> None:
    """A start may take much longer than `stuck_s`, but not for ever."""
    monkeypatch.setattr(optipmb_service.app.supervisor, "BEAT_S", 0.0)
    settings = load(None, {"workers": 2, "store": "none"}).settings
    supervisor = Supervisor(settings, StopRequest(EndBound(60.0)), Path("unused"))
    ended: list[bool] = []
    child: Any = SimpleNamespace(kill=lambda: ended.append(True))
    supervisor._children[0], supervisor.states[0] = child, "starting"
    supervisor._heard[0] = time.monotonic() - silent_s
    watching = asyncio.create_task(supervisor._watch())
    for _ in range(20):
        await asyncio.sleep(0)
    watching.cancel()
    assert bool(ended) is killed

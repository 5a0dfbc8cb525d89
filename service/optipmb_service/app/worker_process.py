"""A worker process, as its parent sees it: started, listened to, ended in every case.

The worker is a fresh interpreter. A fork would copy Zenoh's threads without their life and numba's locks as they were,
and a worker that is started again after a crash must not inherit what the parent has become by then.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from asyncio.subprocess import PIPE
from typing import TYPE_CHECKING, Any, Final

import structlog

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from optipmb_service.settings.model import Settings

log = structlog.get_logger("optipmb_service")

LINE_BYTES: Final = 1 << 20
"""Longest line between the two."""


class WorkerProcess:
    """A worker process, from its start to its end.

    Args:
        index: which worker.
        event: called with what the worker says, on the loop's thread.
    """

    def __init__(self, index: int, event: Callable[[dict[str, Any]], None]) -> None:
        self.index = index
        self._event = event
        self._process: asyncio.subprocess.Process | None = None

    async def run(self, settings: Settings, private: Path) -> int:
        """Start it, and return its exit status when it has ended; below 0: the signal that killed it."""
        process = self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "optipmb_service.app.worker", stdin=PIPE, stdout=PIPE, limit=LINE_BYTES
        )
        log.info("worker_started", worker=self.index, pid=process.pid)
        try:
            order = {"settings": settings.model_dump(mode="json"), "index": self.index, "private": str(private)}
            assert process.stdin is not None  # noqa: S101 - it was asked for: said for the type checker
            assert process.stdout is not None  # noqa: S101 - likewise
            process.stdin.write(json.dumps(order).encode() + b"\n")
            async for line in process.stdout:
                with contextlib.suppress(ValueError):  # what a library prints is no event
                    self._event(json.loads(line))
            return await process.wait()
        finally:
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()

    @property
    def pid(self) -> int | None:
        """Number of the process; None before it runs and after its end."""
        process = self._process
        return process.pid if process is not None and process.returncode is None else None

    def end(self) -> None:
        """Ask it to end."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def kill(self) -> None:
        """End it at once."""
        if self.pid is not None and self._process is not None:
            log.warning("worker_killed", worker=self.index)
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()

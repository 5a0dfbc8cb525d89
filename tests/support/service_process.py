"""The real command in a process of its own, forked or fresh: started, awaited by its ready line, always ended."""

import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from forked import start
from routers import free_endpoint

READY_S = 240.0
"""The first start after an installation compiles the kernels."""


class ServiceProcess:
    """`optipmb-service` with options, on a free endpoint unless they name one.

    Args:
        options: what follows the command's name.
        environment: variables on top of this process's, which loses its own settings.
        listen: whether a free endpoint is given to it.
        fresh: whether it is a new interpreter, for claims about a start, memory and loaded modules; else
            it is forked from a process that has imports and kernels behind it.
    """

    def __init__(
        self,
        *options: str,
        environment: Mapping[str, str] | None = None,
        listen: bool = True,
        fresh: bool = False,
    ) -> None:
        self.endpoint = free_endpoint()
        where = ("--listen", self.endpoint) if listen else ()
        clean = {name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")}
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._errors: list[str] = []
        command = ("optipmb_service", *options, *where)
        self.process = start(
            *command,
            fresh=fresh,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # Tests that want state say where it is kept; no user's own is touched.
            env=clean | {"OPTIPMB_STORE": "none"} | dict(environment or {}),
        )
        self._threads = [threading.Thread(target=read, daemon=True) for read in (self._read_out, self._read_errors)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(60)
        for thread in self._threads:
            thread.join(60)
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        if error is not None:
            error.add_note(f"the end of its log:\n{self.errors[-3000:]}")

    def wait_ready(self) -> str:
        line = self._lines.get(timeout=READY_S)
        assert line is not None, f"ended without a ready line: {self.errors}"
        return line

    def wait_log(self, event: str, deadline_s: float = 120.0) -> None:
        """Wait for a log event; fails at once when the process has ended without it."""
        ends = time.monotonic() + deadline_s
        reader = self._threads[1]
        while event not in self.errors:
            assert time.monotonic() < ends, f"no {event} in {self.errors}"
            if not reader.is_alive():  # it has read everything
                assert event in self.errors, f"ended without {event}: {self.errors}"
            reader.join(0.01)

    def end(self, *numbers: signal.Signals, deadline_s: float = 60.0) -> tuple[int, float]:
        """Send signals (SIGTERM unless named); return the exit status and the seconds until the end."""
        began = time.monotonic()
        for number in numbers or (signal.SIGTERM,):
            self.process.send_signal(number)
        return self.wait_end(deadline_s), time.monotonic() - began

    def wait_end(self, deadline_s: float = 120.0) -> int:
        """Return the exit status of a process that ends by itself; everything it has written is then there."""
        status = self.process.wait(deadline_s)
        for thread in self._threads:
            thread.join(deadline_s)
        return status

    @property
    def errors(self) -> str:
        return "".join(self._errors)

    @property
    def output(self) -> list[str]:
        lines = []
        while not self._lines.empty():
            if (line := self._lines.get()) is not None:
                lines.append(line)
        return lines

    def _read_out(self) -> None:
        for line in self.process.stdout or ():
            self._lines.put(line.rstrip("\n"))
        self._lines.put(None)

    def _read_errors(self) -> None:
        for line in self.process.stderr or ():
            self._errors.append(line)

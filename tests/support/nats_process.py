"""A real NATS server in a process of its own, started as users start one; it can be killed and started again."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Self

from routers import free_endpoint

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

START_S = 60.0


class NatsProcess:
    """`optipmb-service nats` on a free port.

    Args:
        folder: where its files are, which it finds again when it is started again.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.address = free_endpoint().removeprefix("tcp/")
        self.url = f"nats://{self.address}"
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    def start(self) -> None:
        """Start it, and wait until it takes connections."""
        log = (self._folder / "nats.log").open("ab")
        with log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "optipmb_service", "nats", "--listen", self.address, "--store", self._folder],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")},
            )
        host, _, port = self.address.partition(":")
        ends = time.monotonic() + START_S
        while True:
            try:
                socket.create_connection((host, int(port)), 1.0).close()
            except OSError:
                assert self.process.poll() is None, (self._folder / "nats.log").read_text()
                assert time.monotonic() < ends, "the server does not listen"
                time.sleep(0.01)  # another process: there is nothing to wait on
            else:
                return

    def kill(self) -> None:
        """SIGKILL."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

"""A real NATS server in a process of its own, started as users start one; it can be killed and started again."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from optipmb_service.app.cli import NATS_PAYLOAD_MB, nats_server
from routers import free_endpoint

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

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        command = [sys.executable, "-m", "optipmb_service", "nats", "--listen", self.address, "--store", self._folder]
        self.process = started(command, self.address, self._folder / "nats.log")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait(60)
            self.process = None


class NatsTrio:
    """Three servers of one cluster, as those who run them configure them.

    Args:
        folder: where their files are.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._addresses = [free_endpoint().removeprefix("tcp/") for _ in range(6)]
        self.urls = [f"nats://{address}" for address in self._addresses[:3]]
        self._processes: dict[int, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        for index in range(3):
            self.start(index)
        return self

    def __exit__(self, *_: object) -> None:
        for index in tuple(self._processes):
            self.kill(index)

    def start(self, index: int) -> None:
        routes = ", ".join(f'"nats://{address}"' for address in self._addresses[3:])
        file = self._folder / f"{index}.conf"
        file.write_text(f"""
            server_name: n{index}
            listen: "{self._addresses[index]}"
            max_payload: {NATS_PAYLOAD_MB}MB
            jetstream {{ store_dir: "{self._folder / str(index)}" }}
            cluster {{ name: test, listen: "{self._addresses[3 + index]}", routes: [{routes}] }}
        """)
        server = nats_server()
        assert server is not None
        command = [server, "--config", str(file)]
        self._processes[index] = started(command, self._addresses[index], self._folder / f"{index}.log")

    def kill(self, index: int) -> None:
        process = self._processes.pop(index)
        process.kill()
        process.wait(60)


def started(command: Sequence[str | Path], address: str, log: Path) -> subprocess.Popen[bytes]:
    with log.open("ab") as file:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            env={name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")},
        )
    host, _, port = address.partition(":")
    ends = time.monotonic() + START_S
    while True:
        try:
            socket.create_connection((host, int(port)), 1.0).close()
        except OSError:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < ends, "the server does not listen"
            time.sleep(0.01)  # another process: there is nothing to wait on
        else:
            return process

"""A router process and service processes that share a store: started, frozen, killed, and always ended."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

import zenoh
from routers import free_endpoint, open_client
from service_process import ServiceProcess

START_S = 60.0

PROFILE = "nuscenes"
"""What all services of a fleet track with."""

_ROUTER = """
import sys, threading
sys.path.insert(0, sys.argv[1])
from routers import open_router
session = open_router(*sys.argv[2:])
print("up", flush=True)
threading.Event().wait()
"""


class RouterProcess:
    """A Zenoh router in a process of its own; it can be killed and started again at the same endpoint.

    Args:
        others: endpoints of routers that it is linked to.
    """

    def __init__(self, *others: str) -> None:
        self._others = others
        self.endpoint = free_endpoint()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _ROUTER, os.path.dirname(__file__), self.endpoint, *self._others],  # noqa: PTH120 - a text is needed
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "up\n"

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(60)
            if self._process.stdout is not None:
                self._process.stdout.close()
            self._process = None


class Fleet:
    """Services that are clients of one router and share a store.

    Args:
        folder: where the store is.
        environment: settings of all services, on top of the defaults of tests.
    """

    def __init__(self, folder: Path, **environment: object) -> None:
        self.folder = folder
        self.router = RouterProcess()
        self._context = contextlib.ExitStack()
        self._environment = {
            "OPTIPMB_STORE": str(folder),
            "OPTIPMB_PROFILE": PROFILE,
            "OPTIPMB_LOG_LEVEL": "info",
            "OPTIPMB_LEASE_S": "2.0",
            "OPTIPMB_CHECKPOINT_S": "0.5",
        } | {f"OPTIPMB_{name.upper()}": str(value) for name, value in environment.items()}

    def __enter__(self) -> Self:
        self._context.enter_context(self.router)
        return self

    def __exit__(self, *_: object) -> None:
        self._context.close()

    @property
    def endpoint(self) -> str:
        return self.router.endpoint

    def service(
        self, instance: str, *, wait: bool = True, endpoint: str = "", fresh: bool = False, **environment: object
    ) -> ServiceProcess:
        """Start a service, at another router's endpoint if one is given; it is killed at the end, if it still runs."""
        extra = {f"OPTIPMB_{name.upper()}": str(value) for name, value in environment.items()}
        process = ServiceProcess(
            *("--connect", endpoint or self.endpoint, "--instance", instance),
            environment=self._environment | extra,
            listen=False,
            fresh=fresh,
        )
        self._context.enter_context(process)
        if wait:
            process.wait_ready()
        return process

    def client(self) -> zenoh.Session:
        return self._context.enter_context(open_client(self.endpoint))


def freeze(service: ServiceProcess) -> None:
    service.process.send_signal(signal.SIGSTOP)
    deadline = time.monotonic() + START_S
    while _state(service.process.pid) != "T":
        assert time.monotonic() < deadline, "the process does not stop"
        time.sleep(0.001)  # another process: there is nothing to wait on


def thaw(service: ServiceProcess) -> None:
    service.process.send_signal(signal.SIGCONT)


def _state(pid: int) -> str:
    with open(f"/proc/{pid}/stat", encoding="ascii") as file:  # noqa: PTH123 - the kernel's
        return file.read().rpartition(")")[2].split()[0]

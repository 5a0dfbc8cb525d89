"""A protected network as `docker/security/make.py` sets it up: a real router process, sessions with certificates."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh
from optipmb_schemas import Keys, ServiceStatus, decode
from routers import free_endpoint
from service_process import ServiceProcess

MAKE = Path(__file__).parents[2] / "docker" / "security" / "make.py"
DEADLINE_S = 60.0
AGAIN_S = 0.1
"""After this long a message that has not come is sent again."""
REFUSAL_MS = 1500
"""How long a link that must not be had is asked for."""


def make(out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(MAKE), "--out", str(out), "--router", "localhost", "--router", "127.0.0.1", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


class Network:
    """A router under access control, with certificates for its users.

    Args:
        folder: for certificates and configurations.
        options: of `make.py`: who there is, and limits.
    """

    def __init__(self, folder: Path, *options: str) -> None:
        port = free_endpoint().rpartition(":")[2]
        self.folder = folder
        self.endpoint = f"tls/localhost:{port}"
        self.options = ("--connect", self.endpoint, *options)
        self.make()
        config = str(folder / "router" / "zenoh.json5")
        listen = ("--listen", f"tls/127.0.0.1:{port}", "--zenoh-config", config)
        self.router = ServiceProcess("router", "--instance", "router", *listen, listen=False)

    def __enter__(self) -> Self:
        try:
            self.router.wait_ready()
        except BaseException:
            self.router.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.router.__exit__(kind, error, trace)

    def make(self, *more: str) -> str:
        done = make(self.folder, *self.options, *more)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def config(self, role: str) -> Path:
        return self.folder / role / "zenoh.json5"

    def service(self, name: str = "tracker") -> ServiceProcess:
        config = str(self.config(f"service/{name}"))
        return ServiceProcess(
            "--instance", name, "--connect", self.endpoint, "--zenoh-config", config, listen=False
        )  # fmt: skip


class Party:
    """A plain Zenoh session with a configuration; collects the messages of its subscriptions.

    Args:
        config: the file.
        patience_ms: how long it tries to link.
        changes: values over the file.

    Raises:
        zenoh.ZError: it cannot link to the router.
    """

    def __init__(self, config: Path, *, patience_ms: int = int(1000 * DEADLINE_S), **changes: Any) -> None:
        values = zenoh.Config.from_file(config)
        for name, value in (changes | {"connect/timeout_ms": patience_ms}).items():
            values.insert_json5(name.replace("__", "/"), json.dumps(value))
        self.session = zenoh.open(values)
        self.seen: list[tuple[str, bytes]] = []
        self._changed = threading.Condition()
        self._kept: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped

    def read(self, *patterns: str) -> Self:
        def take(sample: zenoh.Sample) -> None:
            with self._changed:
                self.seen.append((str(sample.key_expr), sample.payload.to_bytes()))
                self._changed.notify_all()

        self._kept += [
            self.session.declare_subscriber(pattern, take, allowed_origin=zenoh.Locality.REMOTE) for pattern in patterns
        ]
        self.settle()
        return self

    def settle(self) -> None:
        """Return when the router has taken all messages so far: it answers in order."""
        self.tokens(Keys().all_alive())

    def wait(self, enough: Callable[[list[tuple[str, bytes]]], bool], deadline_s: float = DEADLINE_S) -> bool:
        """Wait until `enough` has come; False at the deadline."""
        with self._changed:
            return self._changed.wait_for(lambda: enough(self.seen), deadline_s)

    def put(self, key: str, payload: bytes) -> None:
        """Publish; who may not is not told."""
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def deliver(self, key: str, payload: bytes, receiver: Self) -> bool:
        """Publish until another has received it: the router may take two messages close together for a flood."""
        ends = time.monotonic() + DEADLINE_S
        while time.monotonic() < ends:
            self.put(key, payload)
            if receiver.wait(lambda seen: (key, payload) in seen, AGAIN_S):
                return True
        return False

    def token(self, key: str) -> None:
        self._kept.append(self.session.liveliness().declare_token(key))

    def tokens(self, pattern: str) -> set[str]:
        replies = self.session.liveliness().get(pattern, timeout=DEADLINE_S)
        return {str(sample.key_expr) for reply in replies if (sample := reply.ok) is not None}

    def ask(self, key: str, timeout: float = 3.0) -> list[bytes]:
        replies = self.session.get(
            key, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE, allowed_destination=zenoh.Locality.REMOTE
        )
        return [sample.payload.to_bytes() for reply in replies if (sample := reply.ok) is not None]

    def wait_for_frames(self, count: int) -> int:
        """Ask the services again and again how many frames they have tracked, until it is `count` or the deadline."""
        ends = time.monotonic() + DEADLINE_S
        frames = -1
        while frames != count and time.monotonic() < ends:
            frames = sum(decode(status, ServiceStatus).frames for status in self.ask(Keys().all_status()))
            time.sleep(0.02)  # no message says it
        return frames

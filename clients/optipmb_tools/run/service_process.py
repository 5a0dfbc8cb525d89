"""A tracking service as a child process: started on a free port, awaited, and ended in every case.

The child gets a process group of its own, so that Ctrl-C reaches this program alone, which then ends the child in
order; and the kernel tells it when this program dies without having done so.
"""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from optipmb_client.errors import ConnectionFailed, ServiceUnavailable
from optipmb_client.sessions import find_services
from optipmb_client.zenoh import Connection

# Runs in the child before the service: asks the kernel for SIGTERM at the death of the parent, which survives the exec.
# Written out because the hook that Python offers for this runs between fork and exec, which is unsafe with threads.
_BOOTSTRAP = """
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
try:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
except (AttributeError, OSError):
    pass
if os.getppid() != int(sys.argv[1]):
    sys.exit("the parent is gone")
os.execv(sys.executable, [sys.executable, "-m", "optipmb_service", *sys.argv[2:]])
"""

_LOG_LINES = 5
_FIRST_PORT, _EPHEMERAL_PORT = 20_000, 32_768


class ServiceProcess:
    """A service with its own router on this machine, for as long as the context lasts.

    Enter it from the main thread: the kernel takes the end of the thread that started a child for the parent's death.

    Args:
        options: Further options of `optipmb-service`.
        environment: Environment variables on top of this program's, which lose their `OPTIPMB_` settings.
        log: File for the output of the service; default: a temporary one.
        grace_s: How long the service may take to end before it is killed.
    """

    def __init__(
        self,
        options: Sequence[str] = (),
        *,
        environment: Mapping[str, str] | None = None,
        log: Path | None = None,
        grace_s: float = 5.0,
    ) -> None:
        self.instance = f"local-{secrets.token_hex(4)}"
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._grace_s = grace_s
        self._log = log
        self._command = [sys.executable, "-c", _BOOTSTRAP, str(os.getpid())]
        self._command += ["--router", "--listen", self.endpoint, "--instance", self.instance, *options]
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")}
        self._environment = inherited | dict(environment or {})
        self._context = contextlib.ExitStack()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as started:
            folder = started.enter_context(tempfile.TemporaryDirectory(prefix="optipmb-", ignore_cleanup_errors=True))
            self._log = self._log or Path(folder) / "service.log"
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("wb") as log:
                try:
                    self._process = subprocess.Popen(  # noqa: S603  our own interpreter and our own module
                        self._command,
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,
                        cwd=folder,  # files of the service are removed with it
                        env={"XDG_STATE_HOME": folder} | self._environment,
                    )
                except OSError as error:
                    raise ServiceUnavailable(f"cannot start a service on this machine: {error}") from error
            started.callback(self.stop)
            self._context = started.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._context.close()

    @property
    def process(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise ServiceUnavailable("the service has not been started")
        return self._process

    def wait_until_ready(self, timeout: float = 90.0) -> None:
        """Wait until the service says that it is alive; the first start after an installation compiles for a while.

        Raises:
            ServiceUnavailable: It ended, or has not come up in time; with its last output.
        """
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            self._check_running()
            with contextlib.suppress(ConnectionFailed), Connection(self.endpoint, timeout=0.5) as connection:
                while time.monotonic() < deadline:
                    self._check_running()
                    if any(status.instance == self.instance for status in find_services(connection, patience_s=0.5)):
                        return
        raise ServiceUnavailable(f"the service did not come up within {timeout:g} s; {self._last_words()}")

    def stop(self) -> int:
        """End the service: SIGTERM, and SIGKILL to its whole group when it does not follow. Returns its exit status."""
        process = self.process
        try:
            if process.poll() is None:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(self._grace_s)
        finally:  # also when a second interrupt comes while waiting
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            status = process.wait()  # it has ended or is killed
        return status

    def _check_running(self) -> None:
        if (status := self.process.poll()) is not None:
            raise ServiceUnavailable(f"the service ended with status {status} at its start; {self._last_words()}")

    def _last_words(self) -> str:
        text = self._log.read_text(errors="replace") if self._log is not None else ""
        lines = text.splitlines()[-_LOG_LINES:]
        return "it printed: " + " | ".join(line.strip() for line in lines) if lines else "it printed nothing"


def free_port() -> int:
    """Return a free port below the ephemeral range, which the system would give away before the child binds it."""
    while True:
        port = _FIRST_PORT + secrets.randbelow(_EPHEMERAL_PORT - _FIRST_PORT)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port

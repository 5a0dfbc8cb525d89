"""Processes of service and client without the second of processor time that imports and kernels take of a start.

They are forked from one that has these loaded (`fork_server`); from `main` on they run what a start from a shell runs,
with its own words, environment, files and signals. Tests that are about a start itself begin with a new interpreter.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import fork_server

PR_SET_CHILD_SUBREAPER = 36

ALLOWED = False
"""Set by the tests; a benchmark compares checkouts, and measures processes as users start them."""

ONE_AT_A_TIME = threading.Lock()

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""numpy's linear algebra starts others when it is imported."""


@functools.cache
def server() -> socket.socket:
    """The one server of this process, started when first needed: where it takes requests."""
    asking, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    number = theirs.fileno()
    clean = {name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")}
    process = subprocess.Popen(
        [sys.executable, fork_server.__file__, str(number)], pass_fds=(number,), env=clean | ONE_THREAD,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    theirs.close()

    def end() -> None:
        asking.close()
        process.kill()  # it may still load; forked processes belong to others
        process.wait(60)

    atexit.register(end)
    threads = asking.recv(32)
    assert threads, "the process that is to be forked has ended at its start"
    assert threads == b"1", f"with {threads!r} threads a fork would copy locks that others hold"
    return asking


def start(*command: str, fresh: bool = False, **how: Any) -> subprocess.Popen[str]:
    """Start `python -m` with a module and words, by fork where that is allowed; `how` as for `subprocess.Popen`."""
    if fresh or not ALLOWED:
        return subprocess.Popen((sys.executable, "-m", *command), text=True, **how)
    return Forked(command, text=True, **how)


class Forked(subprocess.Popen[str]):
    """`python -m` with the module and the words given, as `subprocess.Popen` starts and ends it."""

    def _execute_child(self, args: Any, executable: Any, *given: Any) -> None:
        """Fork where `Popen` forks and calls exec; its interface has been the same since Python 3.9."""
        del executable
        _, _, _, folder, environment, _, _, _, *pipes = given[:14]
        stdin, _, _, stdout, _, stderr = pipes
        request = {
            "words": list(args),
            "environment": dict(os.environ if environment is None else environment),
            "folder": str(folder or Path.cwd()),
        }
        kernel = ctypes.CDLL(None, use_errno=True)
        with ONE_AT_A_TIME:
            asking = server()
            kernel.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
            try:
                files = [own if one == -1 else one for own, one in enumerate((stdin, stdout, stderr))]
                socket.send_fds(asking, [json.dumps(request).encode()], files)
                self.pid = int(asking.recv(32))
            except BaseException:  # the answer may still come: the next request must not get it
                asking.close()
                server.cache_clear()
                raise
            finally:
                kernel.prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)
        self._child_created = True
        self._close_pipe_fds(*pipes)

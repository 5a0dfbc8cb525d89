"""The end of all that a test process has started, when it has ended: also by SIGKILL, when it can end nothing itself.

`python guard.py MARK` runs as its companion and holds the other end of a pipe. Started processes and their
descendants carry the mark in their environment.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

VARIABLE = "STARTED_BY_TESTS"
ROUNDS = 20


def begin() -> None:
    """Mark what this process starts from now on, and start the process that ends it."""
    os.environ.pop(VARIABLE, None)  # the guard is not to end itself
    reading, _ = os.pipe()  # the other end closes with this process
    command = [sys.executable, __file__, f"{VARIABLE}={os.getpid()}"]
    os.posix_spawn(sys.executable, command, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, reading, 0)], setpgroup=0)
    os.close(reading)
    os.environ[VARIABLE] = str(os.getpid())


def marked(mark: str) -> set[int]:
    """Return the processes with a mark."""
    found = set()
    for environ in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):  # it has ended, or is another user's
            if mark.encode() in environ.read_bytes().split(b"\0"):
                found.add(int(environ.parent.name))
    return found


def end(mark: str) -> None:
    """Kill every process with a mark, again and again: they may start others meanwhile."""
    for _ in range(ROUNDS):
        for process in marked(mark):
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.05)


if __name__ == "__main__":
    sys.stdin.read()
    end(sys.argv[1])

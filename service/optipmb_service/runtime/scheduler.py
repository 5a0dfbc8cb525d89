"""The thread that runs the actors: one at a time, streams in turn."""

from __future__ import annotations

import queue
import threading
import time
from typing import Final, Protocol

import structlog

log = structlog.get_logger("optipmb_service")


class Runnable(Protocol):
    """What the scheduler runs."""

    def work(self) -> bool:
        """Do a bounded piece of work; True: there is more."""


class Scheduler:
    """A thread that works on whatever was submitted, first come first served.

    One is enough: most of a frame is under the interpreter's lock. It is a daemon: a step that does not end must not
    keep the process.
    """

    _END: Final = None

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Runnable | None] = queue.SimpleQueue()
        self._began_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="tracking", daemon=True)
        self._thread.start()

    def submit(self, runnable: Runnable) -> None:
        """Have the thread call `work`; what is being worked on must not be submitted."""
        self._queue.put(runnable)

    @property
    def busy_s(self) -> float:
        """For how long the thread has been at its present piece of work; 0 while it waits."""
        began_ns = self._began_ns
        return 0.0 if began_ns is None else (time.monotonic_ns() - began_ns) / 1e9

    def close(self, timeout: float) -> bool:
        """End the thread after what was submitted; False when it did not end in time (s)."""
        self._queue.put(self._END)
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (runnable := self._queue.get()) is not self._END:
            self._began_ns = time.monotonic_ns()
            try:
                if runnable.work():
                    self._queue.put(runnable)
            except Exception:
                log.exception("internal_error", thread="tracking")  # one stream must not end the thread of all
            self._began_ns = None

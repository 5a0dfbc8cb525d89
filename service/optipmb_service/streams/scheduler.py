"""Scheduler: the tracking thread of a process."""

from __future__ import annotations

import queue
import threading
import time
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from collections.abc import Callable

log = structlog.get_logger("optipmb_service")


class Scheduler:
    """A thread that does the work that was submitted, first come first served.

    One is enough: most of a frame is under the interpreter's lock. It is a daemon: a step that does not end must not
    keep the process.
    """

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Callable[[], bool] | None] = queue.SimpleQueue()
        self._began_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="tracking", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], bool]) -> None:
        """Have the thread call `work`, which does a bounded piece and returns whether there is more."""
        self._queue.put(work)

    @property
    def busy_s(self) -> float:
        """Seconds that the present piece of work has taken; 0 while the thread waits."""
        began_ns = self._began_ns
        return 0.0 if began_ns is None else (time.monotonic_ns() - began_ns) / 1e9

    def close(self, timeout: float) -> bool:
        """End the thread after the submitted work; False when it did not end in time (s)."""
        self._queue.put(None)
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (work := self._queue.get()) is not None:
            self._began_ns = time.monotonic_ns()
            try:
                if work():
                    self._queue.put(work)
            except Exception:
                log.exception("internal_error", thread="tracking")  # one stream must not end the thread of all
            self._began_ns = None

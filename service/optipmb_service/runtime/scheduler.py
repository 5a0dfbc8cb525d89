"""The threads that run the actors: one at a time per stream, streams in turn."""

from __future__ import annotations

import queue
import threading
from typing import Final, Protocol


class Runnable(Protocol):
    """What workers work on."""

    def work(self) -> bool:
        """Do a bounded piece of work; True: there is more."""


class Scheduler:
    """A few threads that work on whatever was submitted, first come first served.

    They are daemons: a step that does not end must not keep the process.
    """

    _END: Final = None

    def __init__(self, threads: int) -> None:
        self._queue: queue.SimpleQueue[Runnable | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._run, name=f"worker-{number}", daemon=True) for number in range(threads)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, worked: Runnable) -> None:
        """Have a thread call `work`; what is being worked on must not be submitted."""
        self._queue.put(worked)

    def close(self, timeout: float) -> bool:
        """End the threads after what was submitted; False when some did not end in time (s)."""
        for _ in self._threads:
            self._queue.put(self._END)
        for thread in self._threads:
            thread.join(timeout / len(self._threads))
        return not any(thread.is_alive() for thread in self._threads)

    def _run(self) -> None:
        while (worked := self._queue.get()) is not self._END:
            if worked.work():
                self._queue.put(worked)

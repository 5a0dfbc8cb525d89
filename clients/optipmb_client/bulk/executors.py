"""Where tasks run: this process, or several processes of this machine. Ray has a module of its own."""

import multiprocessing
import os
import pickle
import shutil
import signal
import tempfile
import threading
import uuid
from abc import ABC, abstractmethod
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Self

from optipmb_client.bulk.task import Done, Failed, Function, WorkerDiedError, attempt

ATTEMPTS: Final = 3  # how often a task is started whose process dies


class Executor(ABC):
    """Runs tasks. Use it as a context manager: at its end nothing of it is left, whatever was under way."""

    width: int  # tasks that are to be under way at once
    attempts: int  # how often the loop starts a task whose process dies
    here = False  # whether tasks run in this process, and share its objects

    @abstractmethod
    def start(self, function: Function, shared: Any) -> None:
        """Make ready to call `function(shared, task)`; a second call changes what is called."""

    @abstractmethod
    def submit(self, task: Any) -> Future[Any]:
        """Start a task."""

    @abstractmethod
    def take(self, future: Future[Any]) -> Done[Any] | Failed:
        """Return what a task gave; called once for each that has ended.

        Raises:
            WorkerDiedError: nothing came back.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:  # noqa: B027  not all hold something
        """End what is under way, and leave nothing of it."""


class Here(Executor):
    """One task after the other, in this process."""

    width = attempts = 1
    here = True

    def start(self, function: Function, shared: Any) -> None:
        """Keep what is called."""
        self._call = function, shared

    def submit(self, task: Any) -> Future[Any]:
        """Run the task."""
        future: Future[Any] = Future()
        future.set_result(attempt(*self._call, task))
        return future

    def take(self, future: Future[Any]) -> Done[Any] | Failed:
        """Return what it gave."""
        result: Done[Any] | Failed = future.result()
        return result


class Processes(Executor):
    """So many processes of this machine; each is a pool of its own, so that one that dies takes no other task with it.

    Results come back as files: a process that is killed while it sends a large one through a pipe would leave the
    reader waiting for the rest. The processes end with this one, however it ends: they hold one end of a pipe.
    """

    attempts = ATTEMPTS

    def __init__(self, width: int) -> None:
        self.width = width
        self._context = multiprocessing.get_context("spawn")  # a fork would copy the locks of libraries' threads
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Any], ProcessPoolExecutor] = {}

    def start(self, function: Function, shared: Any) -> None:
        """Write down what is called; processes are started with the first tasks."""
        self._close()
        self._folder = tempfile.TemporaryDirectory(prefix="optipmb-bulk-", ignore_cleanup_errors=True)
        call = Path(self._folder.name, "call")
        call.write_bytes(pickle.dumps((function, shared), pickle.HIGHEST_PROTOCOL))
        self._call = str(call)
        self._theirs, self._ours = self._context.Pipe(duplex=False)

    def submit(self, task: Any) -> Future[Any]:
        """Give the task to a process that waits, or to a new one."""
        pool = self._idle.pop() if self._idle else self._new()
        try:
            future = pool.submit(_run, self._call, task)
        except BrokenProcessPool:  # it was killed while it waited
            pool.shutdown()
            pool = self._new()
            future = pool.submit(_run, self._call, task)
        self._busy[future] = pool
        return future

    def take(self, future: Future[Any]) -> Done[Any] | Failed:
        """Read what the task gave."""
        pool = self._busy.pop(future)
        try:
            file = Path(future.result())
        except BrokenProcessPool as error:
            pool.shutdown()
            raise WorkerDiedError("its process died (killed, or out of memory)") from error
        self._idle.append(pool)
        result: Done[Any] | Failed = pickle.loads(file.read_bytes())  # noqa: S301  our own process wrote it
        file.unlink()
        return result

    def __exit__(self, *_: object) -> None:
        self._close()

    def _new(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, _begin, (self._theirs, str(Path(self._call).parent)))

    def _close(self) -> None:
        if self._folder is None:
            return
        self._ours.close()  # ends the processes, also those at work
        for pool in (*self._idle, *self._busy.values()):
            pool.shutdown(cancel_futures=True)
        self._theirs.close()
        self._idle, self._busy = [], {}
        self._folder.cleanup()
        self._folder = None


def _begin(end: Connection, folder: str) -> None:
    """Make a process ready: it ends when the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its processes
    threading.Thread(target=_end_with, args=(end, Path(folder)), daemon=True).start()
    tempfile.tempdir = folder  # what a killed process leaves goes with it


def _end_with(end: Connection, folder: Path) -> None:
    end.poll(None)
    shutil.rmtree(folder, ignore_errors=True)  # the parent does it, if it was not killed
    os._exit(0)  # the task at work is not waited for


@cache
def _called(file: str) -> tuple[Function, Any]:
    """Return what is called, which a process reads once: it serves one `start`."""
    called: tuple[Function, Any] = pickle.loads(Path(file).read_bytes())  # noqa: S301  the parent wrote it
    return called


def _run(call: str, task: Any) -> str:
    """Run a task in a process of the pool; return the file with what it gave."""
    file = Path(tempfile.gettempdir(), uuid.uuid4().hex)
    file.write_bytes(pickle.dumps(attempt(*_called(call), task), pickle.HIGHEST_PROTOCOL))
    return str(file)

"""The same function for many tasks: in this process, in several processes, or on a Ray cluster.

There is one loop (`run`) over one list of tasks, and three executors. A task is idempotent: it may run again after its
process was killed, and gives the same bytes. What a task raises becomes a value (`Failed`), so one bad recording stops
no other, and every exception reaches the caller's process.
"""

import concurrent.futures
import multiprocessing
import os
import pickle
import shutil
import signal
import tempfile
import threading
import traceback
import uuid
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self, TypeAlias, TypeVar

from optipmb_client.errors import ClientError, UsageError
from optipmb_schemas import MessageError

from optipmb_tools.extras import needed
from optipmb_tools.files import DatasetError, unexpected

T = TypeVar("T")
Function: TypeAlias = Callable[[Any, Any], Any]  # a function of a module: (arguments of all tasks, task) -> value
Note: TypeAlias = Callable[[str], None]

ATTEMPTS = 3  # starts of a task whose process dies
_INPUT = (UsageError, DatasetError, MessageError, OSError)


class WorkerDiedError(Exception):
    """The process or the machine that ran a task is gone, and nothing of the task came back."""


@dataclass(frozen=True)
class Failed:
    """Error of a task."""

    reason: str  # one line
    wrong_input: bool = False  # whether the data or an option were wrong, not the program or its surroundings
    trace: str = ""  # traceback of an unexpected error; empty for others

    def error(self) -> UsageError | ClientError:
        """Return the error to raise for it, with the trace as a note."""
        error = UsageError(self.reason) if self.wrong_input else ClientError(self.reason)
        if self.trace:
            error.add_note(self.trace)
        return error


def attempt(function: Function, shared: Any, task: Any) -> Any:
    """Run a task; return its value, or `Failed`."""
    try:
        return function(shared, task)
    except _INPUT as error:
        return Failed(str(error), wrong_input=True)
    except ClientError as error:
        return Failed(str(error))
    except Exception as error:  # noqa: BLE001  reported with its trace; other tasks go on
        return Failed(unexpected(error), trace=traceback.format_exc())


class Executor(ABC):
    """Runs tasks. Use it as a context manager: at its end nothing of it is left, running tasks included."""

    width: int  # tasks to run at once
    attempts: int = ATTEMPTS  # starts of a task whose process dies
    here = False  # whether tasks run in this process, and share its objects

    @abstractmethod
    def start(self, function: Function, shared: Any) -> None:
        """Prepare to call `function(shared, task)`; a second call replaces the first."""

    @abstractmethod
    def submit(self, task: Any) -> Future[Any]:
        """Start a task."""

    @abstractmethod
    def take(self, future: Future[Any]) -> Any:
        """Return the value of a task that has ended, or `Failed`; called once for each.

        Raises:
            WorkerDiedError: Nothing came back.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:  # noqa: B027  not all hold something
        """End running tasks, and leave nothing of them."""


class Here(Executor):
    """One task after the other, in this process."""

    width = 1
    here = True

    def start(self, function: Function, shared: Any) -> None:
        self._call = function, shared

    def submit(self, task: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(attempt(*self._call, task))
        return future

    def take(self, future: Future[Any]) -> Any:
        return future.result()


class Processes(Executor):
    """Processes of this machine, `width` of them; each is a pool of its own, so that its death takes no other task.

    Values come back as files: a process that is killed while it sends a large one through a pipe would leave the
    reader waiting for the rest. The processes end with this one, however it ends: they hold one end of a pipe.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._context = multiprocessing.get_context("spawn")  # a fork would copy the locks of libraries' threads
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Any], ProcessPoolExecutor] = {}

    def start(self, function: Function, shared: Any) -> None:
        """Write the call into a file; processes are started with the first tasks."""
        self.__exit__()
        self._folder = tempfile.TemporaryDirectory(prefix="optipmb-bulk-", ignore_cleanup_errors=True)
        call = Path(self._folder.name, "call")
        call.write_bytes(pickle.dumps((function, shared), pickle.HIGHEST_PROTOCOL))
        self._call = str(call)
        self._theirs, self._ours = self._context.Pipe(duplex=False)

    def submit(self, task: Any) -> Future[Any]:
        """Give the task to an idle process, or to a new one."""
        pool = self._idle.pop() if self._idle else self._new()
        try:
            try:
                future = pool.submit(_run, self._call, task)
            except BrokenProcessPool:  # it was killed while it was idle
                pool.shutdown()
                pool = self._new()
                future = pool.submit(_run, self._call, task)
        except OSError as error:
            raise ClientError(f"cannot start another process: {error}; --jobs 1 needs none") from error
        self._busy[future] = pool
        return future

    def take(self, future: Future[Any]) -> Any:
        """Read the value."""
        pool = self._busy.pop(future)
        try:
            file = Path(future.result())
        except BrokenProcessPool as error:
            pool.shutdown()
            raise WorkerDiedError("its process died (killed, or out of memory)") from error
        self._idle.append(pool)
        result = pickle.loads(file.read_bytes())  # noqa: S301  our own process wrote it
        file.unlink()
        return result

    def __exit__(self, *_: object) -> None:
        if self._folder is None:
            return
        self._ours.close()  # ends the processes, also those at work
        for pool in (*self._idle, *self._busy.values()):
            pool.shutdown(cancel_futures=True)
        self._theirs.close()
        self._idle, self._busy = [], {}
        self._folder.cleanup()
        self._folder = None

    def _new(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, _begin, (self._theirs, str(Path(self._call).parent)))


def _begin(end: Connection, folder: str) -> None:
    """Prepare a process: it ends when the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its processes
    threading.Thread(target=_end_with, args=(end, Path(folder)), daemon=True).start()
    tempfile.tempdir = folder  # temporary files of a killed process are removed with it


def _end_with(end: Connection, folder: Path) -> None:
    end.poll(None)
    shutil.rmtree(folder, ignore_errors=True)  # the parent does it, if it was not killed
    os._exit(0)  # the running task is not waited for


@cache
def _called(file: str) -> tuple[Function, Any]:
    """Return the call, which a process reads once: it serves one `start`."""
    called: tuple[Function, Any] = pickle.loads(Path(file).read_bytes())  # noqa: S301  the parent wrote it
    return called


def _run(call: str, task: Any) -> str:
    """Run a task in a process of the pool; return the file with its value."""
    file = Path(tempfile.gettempdir(), uuid.uuid4().hex)
    file.write_bytes(pickle.dumps(attempt(*_called(call), task), pickle.HIGHEST_PROTOCOL))
    return str(file)


def processors() -> int:
    """Return how many processors this process may use; where the system does not say, as on macOS, all there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def executor_for(jobs: int, ray: str | None = None) -> Executor:
    """Return the executor for `jobs` tasks at once.

    Args:
        jobs: Tasks at once; on a Ray cluster 0 means as many as it has processors.
        ray: Address of a Ray cluster, `local` for one that is started here; None: processes of this machine.

    Raises:
        ClientError: Ray is not installed.
    """
    if ray is not None:
        needed("--ray", "ray", "ray")
        from optipmb_tools.run.ray_cluster import RayCluster  # noqa: PLC0415  packages of an extra

        return RayCluster(ray, jobs)
    return Processes(jobs) if jobs > 1 else Here()


def run(
    executor: Executor, tasks: Sequence[Any], name: Callable[[Any], str], note: Note = lambda _: None
) -> Iterator[tuple[int, Any]]:
    """Run tasks on a started executor; yield place and value, or `Failed`, of each as it ends, in no order.

    No more run at once than the executor asks for, so little is done twice when it ends early. A task whose process
    died runs again, `executor.attempts` times in all.

    Args:
        executor: After its `start`.
        tasks: Each is sent to where it runs.
        name: Name of a task in messages.
        note: Called with a line when a process died.
    """
    waiting = deque((place, 1) for place in range(len(tasks)))
    running: dict[Future[Any], tuple[int, int]] = {}
    while waiting or running:
        while waiting and len(running) < executor.width:
            place, number = waiting.popleft()
            running[executor.submit(tasks[place])] = place, number
        # A task ends with its recording, or its process; nothing else could say that it takes too long.
        for future in concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED).done:
            place, number = running.pop(future)
            try:
                result = executor.take(future)
            except WorkerDiedError as died:
                if number < executor.attempts:
                    note(f"{name(tasks[place])}: {died}; starts again")
                    waiting.appendleft((place, number + 1))
                    continue
                result = Failed(f"{died}, {number} times" if number > 1 else str(died))
            yield place, result


def in_order(ended: Iterable[tuple[int, T]]) -> Iterator[T]:
    """Yield values in the order of their places, each when those before it are there too."""
    waiting: dict[int, T] = {}
    following = 0
    for place, one in ended:
        waiting[place] = one
        while following in waiting:
            yield waiting.pop(following)
            following += 1


def values(
    executor: Executor, tasks: Sequence[Any], name: Callable[[Any], str], note: Note = lambda _: None
) -> list[Any]:
    """Run tasks, and return their values in the order of the tasks.

    Raises:
        UsageError, ClientError: A task failed; the text names it.
    """
    results = list(in_order(run(executor, tasks, name, note)))
    for failed in results:
        if isinstance(failed, Failed):
            raise failed.error()
    return results

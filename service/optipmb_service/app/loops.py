"""What the control loops of a worker and of its parent share: waiting for the end, blocking work, leaving."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import math
import os
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

import structlog

from optipmb_service.observability.health import BEAT_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


SWITCH_S: Final = 0.0005
"""By default it is ten times as long, and a frame that meets two other threads waits 10 ms."""

HANDOVER_S: Final = 4.0
"""At the end, how long other members may take to have the streams; it takes a second."""

CLOSE_S: Final = 3.0
"""At the end, how long a process may take to close, beyond handover and grace."""

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")


class Deadline:
    """A time by which several stages end, each of which may take what those before it have left.

    Args:
        seconds: from now on.
    """

    def __init__(self, seconds: float) -> None:
        self._ends = time.monotonic() + seconds

    def left(self, most: float = math.inf) -> float:
        """Return the seconds that are left, at most so many."""
        return max(0.0, min(most, self._ends - time.monotonic()))


class StopRequest:
    """Whether somebody wants the end: SIGINT, SIGTERM, or whoever calls it; to be made inside the loop."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._loop.add_signal_handler(number, self.ask, number.name)

    def ask(self, reason: str) -> None:
        """Ask for the end."""
        log.info("stop_asked" if not self.is_set() else "stop_asked_again", signal=reason)
        self._event.set()

    def ask_threadsafe(self, reason: str) -> None:
        """Ask for the end, from any thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            self._loop.call_soon_threadsafe(self.ask, reason)

    def is_set(self) -> bool:
        """Whether the end was asked for."""
        return self._event.is_set()

    async def wait(self, seconds: float | None = None) -> None:
        """Wait until the end is asked for, at most so long."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._event.wait(), seconds)


class Heartbeat(Protocol):
    """What is told that the loop turns."""

    def beat(self) -> None:
        """Take it in."""


def say_ready(what: str, name: str, endpoints: Iterable[str]) -> None:
    """Print the line that starters wait for, the only one on stdout: what is ready, and the endpoints it uses."""
    print(f"ready {what}={name} endpoints={','.join(endpoints)}", flush=True)  # noqa: T201 - it is the interface


def leave(status: int) -> None:
    """End the process; at once where a thread is stuck in machine code, which would crash an orderly end."""
    sys.stdout.flush()
    sys.stderr.flush()
    if any(thread.daemon and thread.is_alive() for thread in threading.enumerate()):
        os._exit(status)
    sys.exit(status)


def settle() -> None:
    """Take what the start has made out of the garbage collector's sight, and let threads take turns more often.

    What libraries and kernels have made, 150,000 objects in a service, lives for ever. A full collection walks them
    all, and for as long no frame moves: 50 ms on an idle machine. Without them it takes microseconds.
    A thread that has been waited for gives the interpreter's lock away after `SWITCH_S`.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)


async def beat(health: Heartbeat) -> None:
    """Say that the loop turns, for ever."""
    while True:
        health.beat()
        await asyncio.sleep(BEAT_S)


async def unless(asked: StopRequest, work: Callable[[], _T]) -> _T | None:
    """Do blocking work on a thread; None when the end was asked for before it was done, the work is then abandoned."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[_T] = loop.create_future()

    def finish(value: _T | None, error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(value)  # type: ignore[arg-type]  # without an error there is a value

    def call() -> None:
        value: _T | None = None
        error: BaseException | None = None
        try:
            value = work()
        except BaseException as raised:  # noqa: BLE001 - handed to whoever awaits it
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has ended: the work was abandoned
            loop.call_soon_threadsafe(finish, value, error)

    # A daemon: neither compiling nor waiting for a router can be interrupted, and neither may keep the process.
    threading.Thread(target=call, name="start", daemon=True).start()
    stop = loop.create_task(asked.wait())
    waits: set[asyncio.Future[Any]] = {done, stop}
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    stop.cancel()
    if not done.done():
        done.cancel()
        return None
    return done.result()

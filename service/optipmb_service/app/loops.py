"""What the control loops of all processes share: waiting for the end, blocking work, signs of life."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

import structlog

from optipmb_service.observability.health import BEAT_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from optipmb_client.zenoh.session import KeyNumbers

    from optipmb_service.app.ending import EndBound

SWITCH_S: Final = 0.0005
"""By default it is ten times as long, and a frame that meets two other threads waits 10 ms."""

KEYS_S: Final = 1.0
"""How often it is seen how many keys a process has declared."""

GAINED: Final = 0.1
"""Share of them that a restart gives back at least."""

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")


class StopRequest:
    """Whether somebody wants the end: SIGINT, SIGTERM, or whoever calls it; to be made inside the loop.

    Args:
        bound: on the end, from when it is asked for.
    """

    def __init__(self, bound: EndBound) -> None:
        self.bound = bound
        self.restarts = False
        """Whether the process is to begin again after the end."""
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._loop.add_signal_handler(number, self.ask, number.name)
            # The loop hears of it over a descriptor, which stays; in place of a handler that does nothing, the bound
            # begins, also where the loop hangs. Nothing else may be done there: whatever it interrupts may hold locks.
            signal.signal(number, lambda *_: bound.begin())

    def restart(self, reason: str) -> None:
        """Ask for the end, after which the process is to begin again; unless somebody wants it to end."""
        if not self.is_set():
            self.ask(reason)
            self.restarts = True

    def ask(self, reason: str) -> None:
        """Ask for the end."""
        self.restarts = False
        if not self.bound.begin():  # before anything that may block, as a log that nobody reads
            log.warning("end_unbounded")
        log.info("stop_asked" if not self.is_set() else "stop_asked_again", signal=reason)
        self._event.set()

    def ask_threadsafe(self, reason: str) -> None:
        """Ask for the end, from any thread."""
        self.bound.begin()  # here: the loop may hang
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


async def watch_keys(asked: StopRequest, used: Callable[[], KeyNumbers], most: int) -> None:
    """Have the process begin again before its network session has no number for keys any more.

    It does not where that would give it few: what is open when it ends needs as many again.

    Args:
        asked: the end.
        used: returns how many numbers are used.
        most: how many may be used up.
    """
    while not asked.is_set():
        keys = used()
        if keys.declared >= most and keys.declared - keys.open >= GAINED * most:
            log.warning("keys_used_up", declared=keys.declared, open=keys.open)
            asked.restart("keys_used_up")
        await asked.wait(KEYS_S)


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

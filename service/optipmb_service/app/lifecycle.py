"""Start and end of every process of the service: signals, monitoring, bounds, exit status.

The end has a bound, for Zenoh's `session.close` may hang, as may any call into a library, and a supervisor may
have no time-out of its own. The bound counts from the begin of the end:

- A thread counts most of it, logs where every thread is, and ends the process with status 1.
- What hangs with the interpreter's lock held lets no other Python run. For that case a thread of `faulthandler`,
  which needs no lock, does the same at the end of the bound, with tracebacks in place of the log line.

The time for which the process is frozen (SIGSTOP, `docker pause`) does not count, as long as it does not outlast what
is left: else the thread of `faulthandler`, which wakes up first and cannot know of it, ends the process.

A step that may hang before the last checkpoints are written is done on a thread of its own (`Steps`), and left there.
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import functools
import gc
import os
import signal
import sys
import threading
import time
import traceback
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeVar

import structlog
from optipmb_client.errors import ClientError
from optipmb_schemas.installation import install_command

from optipmb_service import __version__
from optipmb_service.app import ENDING
from optipmb_service.cluster.store import StoreError
from optipmb_service.telemetry import logs
from optipmb_service.telemetry.certificates import Certificates
from optipmb_service.telemetry.health import BEAT_S, Component, ProcessHealth
from optipmb_service.telemetry.metrics import GATEWAY_METRICS, NETWORK_METRICS, TLS_METRICS, Metrics
from optipmb_service.zenoh.client import LISTENING, Client, certificates_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator
    from pathlib import Path
    from types import FrameType

    from optipmb_client.zenoh.session import ZenohSession

    from optipmb_service.settings import Settings

HANDOVER_S: Final = 4.0  # at the end, how long other members may take to have the streams; it takes a second
CLOSE_S: Final = 3.0  # at the end, how long a process may take to close, beyond handover and grace
SPARE_S: Final = 1.0  # beyond these, before a process that has not ended is ended
LAST_S: Final = 0.5  # part of the bound that is kept for logging what hung
STEP_S: Final = 1.0  # how long the other steps of an end wait for one that may hang
SLICE_S: Final = 0.25  # the time of an end is counted in slices of so long
LATE_S: Final = 2.0  # what wakes up so late was frozen, or starved, with all of its process
END_HUNG: Final = 1  # exit status of a process in which a step of the end hung
RESTART: Final = 75  # exit status of a process that has ended in order to begin again (sysexits.h: try again)
SWITCH_S: Final = 0.0005  # by default it is ten times as long, and a frame that meets two other threads waits 10 ms
HOUSEKEEPING_S: Final = 0.5
KEYS_S: Final = 1.0  # period of the check of declared keys
GAINED: Final = 0.1  # share of the declared keys that a restart gives back at least
STDERR: Final = 2
CALLS: Final = 6  # logged calls of a thread: the innermost one, and calls of these packages
PACKAGES: Final = ("optipmb_service", "optipmb_client")

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")


def longest_end_s(grace_s: float) -> float:
    """Return how long a process may take to end that has `grace_s` for frames already received."""
    return HANDOVER_S + grace_s + CLOSE_S + SPARE_S


class Deadline:
    """A time by which several stages end, each of which may take what those before it have left."""

    def __init__(self, seconds: float) -> None:
        self._ends = time.monotonic() + seconds

    def left(self) -> float:
        return max(0.0, self._ends - time.monotonic())


class EndBound:
    """Ends this process when its end takes longer than `seconds`."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._lock = threading.RLock()  # a signal may interrupt the holder, and begin too
        self._begun = False
        self._left_s = seconds - LAST_S

    def begin(self) -> bool:
        """Begin the end, from any thread or signal handler; again without effect.

        Returns:
            Whether it has a bound: False where no thread can be started.
        """
        with self._lock:
            if not self._begun:
                self._begun = True
                try:
                    self._arm()
                    threading.Thread(target=self._watch, name="end", daemon=True).start()
                except RuntimeError:
                    self._begun = False
            return self._begun

    def left(self) -> float:
        """Return the seconds that are left for the steps of the end."""
        return self._left_s

    def _arm(self) -> None:
        """Have the thread that needs no lock end the process, when so long has passed as is left."""
        faulthandler.dump_traceback_later(self._left_s + LAST_S, exit=True, file=STDERR)

    def _watch(self) -> None:
        before = time.monotonic()
        while self._left_s > 0.0:
            time.sleep(min(SLICE_S, self._left_s))
            now = time.monotonic()
            if now - before < LATE_S:
                self._left_s = max(0.0, self._left_s - (now - before))
            else:
                self._arm()
            before = now
        # Not on this thread: the log may block.
        logging = threading.Thread(target=_log_threads, args=(self._seconds,), name="end", daemon=True)
        with contextlib.suppress(RuntimeError):  # no thread can be started
            logging.start()
            logging.join(0.8 * LAST_S)
        os._exit(END_HUNG)


class Steps:
    """Steps of an end that may hang, and behind which others must be done."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []

    def do(self, name: str, step: Callable[[], object]) -> None:
        """Do a step; one that hangs, or raises, delays the next ones by `STEP_S` at most."""

        def work() -> None:
            try:
                step()
            except Exception:
                log.exception("internal_error", step=name)

        thread = threading.Thread(target=work, name=name, daemon=True)
        self._threads.append(thread)
        with contextlib.suppress(RuntimeError):  # no thread can be started: it remains unfinished
            thread.start()
            thread.join(STEP_S)

    def unfinished(self, seconds: float) -> bool:
        """Return whether a step has not ended after `seconds`, or could not begin, and log it."""
        deadline = Deadline(seconds)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(deadline.left())
        names = [thread.name for thread in self._threads if thread.is_alive() or thread.ident is None]
        if names:
            log.error("step_hangs", steps=names)
        return bool(names)


def leave_or_restart(status: int) -> NoReturn:
    """End the process, or begin it again in its place, with its id and command line."""
    if status == RESTART:
        sys.stdout.flush()
        logs.finish()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - the command line of this process itself
    leave(status)


def leave(status: int) -> NoReturn:
    """End the process; at once where a daemon thread is left.

    It may be stuck in machine code, which would crash an orderly end. The thread of a bound is among them: after an
    orderly end there is nothing left to wait for.
    """
    sys.stdout.flush()
    logs.finish()
    if any(thread.daemon and thread.is_alive() for thread in threading.enumerate()):
        os._exit(status)
    sys.exit(status)


def _log_threads(seconds: float) -> None:
    names = {thread.ident: thread.name for thread in threading.enumerate() if thread.name != "end"}
    frames = sys._current_frames()  # noqa: SLF001 - the documented way to see what threads do
    threads = {names[ident]: calls for ident, frame in frames.items() if ident in names and (calls := _calls(frame))}
    log.error("end_hangs", bound_s=seconds, threads=threads)
    logs.finish()


def _calls(frame: FrameType) -> str:
    """Return the calls of a thread; nothing where none is of these packages."""
    stack = [(one.f_globals.get("__name__", ""), one, line) for one, line in traceback.walk_stack(frame)]
    ours = [one for one in stack if one[0].partition(".")[0] in PACKAGES]
    calls = [*stack[:1], *(one for one in ours if one is not stack[0])][:CALLS] if ours else []
    return " < ".join(f"{module}.{one.f_code.co_name}:{line}" for module, one, line in calls)


class StopRequest:
    """Request to end this process, by a signal or a caller; begins the bound. To be made inside the loop."""

    def __init__(self, bound: EndBound) -> None:
        self.bound = bound
        self.restarts = False
        """Whether the process is to begin again after the end."""
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        for number in ENDING:
            if signal.getsignal(number) == signal.SIG_IGN:  # as under `nohup`
                continue
            self._loop.add_signal_handler(number, self.ask, number.name)
            # The loop hears of it over a descriptor, which stays; in place of a handler that does nothing, the bound
            # begins, also where the loop hangs. Nothing else may be done there: the interrupted code may hold locks.
            signal.signal(number, lambda *_: bound.begin())

    def restart(self, reason: str) -> None:
        """Ask for the end, after which the process is to begin again, unless the end was asked for already."""
        if not self.is_set():
            self.ask(reason)
            self.restarts = True

    def ask(self, reason: str) -> None:
        self.restarts = False
        if not self.bound.begin():  # before anything that may block, as a log without a reader
            log.warning("end_unbounded")
        about = {"hint": "settings hold from the start: start it again"} if reason == signal.SIGHUP.name else {}
        log.info("stop_asked" if not self.is_set() else "stop_asked_again", signal=reason, **about)
        self._event.set()

    def ask_threadsafe(self, reason: str) -> None:
        """Ask for the end, from any thread."""
        self.bound.begin()  # here: the loop may hang
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            self._loop.call_soon_threadsafe(self.ask, reason)

    def is_set(self) -> bool:
        """Return whether the end was asked for."""
        return self._event.is_set()

    async def wait(self, seconds: float | None = None) -> None:
        """Wait until the end is asked for, at most so long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._event.wait()


async def unless(asked: StopRequest, work: Callable[[], _T]) -> _T | None:
    """Do blocking work on a thread; None when the end was asked for before it was done, the work is then abandoned."""
    done: Future[_T] = Future()

    def call() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised where the result is awaited
            done.set_exception(error)

    # A daemon: neither compiling nor waiting for a router can be interrupted, and neither may keep the process.
    threading.Thread(target=call, name="start", daemon=True).start()
    result = asyncio.wrap_future(done)
    result.add_done_callback(lambda one: one.cancelled() or one.exception())  # an abandoned one may fail unseen
    stop = asyncio.create_task(asked.wait())
    waits: set[asyncio.Future[Any]] = {result, stop}
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    stop.cancel()
    return result.result() if result.done() else None


async def watch_keys(asked: StopRequest, session: Callable[[], ZenohSession | None], most: int) -> None:
    """Have the process begin again before its network session has no number for keys any more.

    It does not where that would free few: keys that are open at the end are declared again.
    """
    while not asked.is_set():
        keys = used.key_numbers if (used := session()) is not None else None
        if keys is not None and keys.declared >= most and keys.declared - keys.open >= GAINED * most:
            log.warning("keys_used_up", declared=keys.declared, open=keys.open)
            asked.restart("keys_used_up")
        await asked.wait(KEYS_S)


def say_ready(what: str, name: str, endpoints: Iterable[str]) -> None:
    """Print the line that starters wait for, the only one on stdout: name and endpoints.

    In one write: `print` makes two where Python does not buffer, and a log line could come between text and end.
    """
    sys.stdout.write(f"ready {what}={name} endpoints={','.join(endpoints)}\n")
    sys.stdout.flush()


def report_ready(
    settings: Settings, health: ProcessHealth, part: Component, what: str, name: str, **about: object
) -> None:
    """Say that this part of a process works: to health checks, to who has started it, and in the log."""
    health.report(part)
    settle()
    say_ready(what, name, settings.endpoints or settings.connect)
    log.info("ready", instance=settings.instance, **about, connect=settings.connect)


def settle() -> None:
    """Take what the start has made out of the garbage collector's sight, and let threads take turns more often.

    The objects of libraries and kernels, 150,000 in a service, live for ever. A full collection walks them all, and
    for as long no frame moves: 50 ms on an idle machine. Without them it takes microseconds.
    A thread that has been waited for gives the interpreter's lock away after `SWITCH_S`.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)


def _certificate_files(settings: Settings) -> dict[str, Path]:
    files = certificates_of(settings)
    for use, folder in (("grpc", settings.grpc_tls if settings.grpc else None), ("cluster", settings.cluster_tls)):
        if folder is not None:
            files |= {use: folder / "cert.pem", f"{use}_authority": folder / "ca.pem"}
    if settings.http_tls is not None and settings.http:
        files["http"] = settings.http_tls / "cert.pem"
    return files


def sessions_of(settings: Settings) -> Callable[[str], str]:
    """Return what names the session that a stream feeds."""
    if not (settings.fuse or settings.fused):
        return str
    from optipmb_service.streams.profiles import Fusion  # noqa: PLC0415 - the tracker, which a router does not load

    return Fusion.of(settings).session_of


@contextlib.contextmanager
def _monitoring(settings: Settings, health: ProcessHealth) -> Iterator[None]:
    """Answer over HTTP, where that is asked for.

    Raises:
        ClientError: the address cannot be listened on.
    """
    if not settings.http:
        yield
        return
    from optipmb_schemas.asyncapi import document  # noqa: PLC0415 - as above

    from optipmb_service.edges.http import Server, application  # noqa: PLC0415 - a third of a second that only this needs
    from optipmb_service.edges.readers import places_of  # noqa: PLC0415 - as above

    endpoint = (*settings.connect, *settings.endpoints)[0]
    interface = functools.partial(document, settings.prefix, endpoint, settings.http)
    answers = application(health, settings, places_of(settings), interface, sessions_of(settings))
    server = Server(answers, settings.http, settings.limits.max_json_bytes, settings.http_tls)
    log.info("http", address=server.address)
    try:
        yield
    finally:
        server.close()


@contextlib.contextmanager
def grpc_edge(settings: Settings, client: Client, metrics: Metrics) -> Iterator[str]:
    """Serve gRPC in this process where the settings say so, and add its metrics; give its address, empty without one.

    Raises:
        ClientError: it cannot be served.
    """
    if not settings.grpc:
        yield ""
        return
    try:
        from optipmb_service.edges.grpc.server import serving  # noqa: PLC0415 - an extra that only this needs
    except ModuleNotFoundError as error:
        raise ClientError(f"gRPC needs {error.name}, which is not installed: {install_command('grpc')}") from error
    with serving(settings, client, sessions_of(settings)) as server:
        metrics.add(GATEWAY_METRICS, lambda: server.metrics)
        yield server.address


async def run(
    settings: Settings,
    serve: Callable[[StopRequest, ProcessHealth], Awaitable[bool | None]],
    *,
    counts: bool = True,
    more_s: float = 0.0,
    **about: Any,
) -> int:
    """Work until a signal of `ENDING`.

    Args:
        settings: of the process.
        serve: does the work until the end is asked for; returns whether it ended in order, None when it never began.
        counts: whether the metrics have the counters of tracking.
        more_s: time that the end may take beyond the usual bound.
        about: more for the first line of the log.

    Returns:
        The exit status: 0, or 1 when the network, an address or the store cannot be used, or a step of the end hung;
        `RESTART` where the process is to begin again.
    """
    asked = StopRequest(EndBound(longest_end_s(settings.grace_s) + more_s))
    log.info("starting", instance=settings.instance, version=__version__, **about)
    health = ProcessHealth(settings.instance, Metrics(counts=counts))

    async def beat() -> None:
        while True:
            health.beat()
            await asyncio.sleep(BEAT_S)

    tasks = [asyncio.create_task(one) for one in (beat(), watch_keys(asked, health.session, settings.restart_keys))]
    try:
        health.tls = certificates = Certificates(_certificate_files(settings), fixed=LISTENING)
        health.metrics.add(TLS_METRICS, lambda: certificates)
        tasks.append(asyncio.create_task(certificates.watch()))
        with _monitoring(settings, health):
            ended = await serve(asked, health)
    except (ClientError, StoreError) as error:
        logs.say(f"optipmb-service: {error}")
        return 1
    finally:
        asked.bound.begin()  # also after an error
        for task in tasks:
            task.cancel()
    if ended is not None:
        log.info("stopped", drained=ended)
    if asked.restarts:
        return RESTART
    return END_HUNG if ended is False else 0


async def run_client(settings: Settings, serve: Callable[[StopRequest, ProcessHealth, Client], Awaitable[None]]) -> int:
    """Run a process as `run` does, with a connection to a router that is closed at the end."""

    async def connected(asked: StopRequest, health: ProcessHealth) -> bool | None:
        log.info("connecting", endpoints=settings.connect)
        client = await unless(asked, lambda: Client(settings))
        if client is None:
            return None
        health.metrics.add(NETWORK_METRICS, lambda: client)
        try:
            await serve(asked, health, client)
        finally:
            asked.bound.begin()
            await asyncio.to_thread(client.close)
        return True

    return await run(settings, connected)

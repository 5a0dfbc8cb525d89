"""A process that tracks: alone, or as one of the workers of a parent (`python -m optipmb_service.app.worker`).

asyncio runs on the main thread and does little: signals, the deadlines of frames that wait for their clouds, and once a
second the streams that fell silent and the summaries of problems. Messages never pass through it.

Parent and worker talk in lines of JSON. The parent writes settings to the worker's stdin; when stdin
ends, so does the worker: the parent wants it, or is dead. The worker writes events to its stdout: `ready`, and a beat
twice a second. Logs go to stderr, which both share.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import mmap
import signal
import sys
import threading
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

import optipmb
from optipmb_service.app import WRONG_USE, lifecycle
from optipmb_service.app.lifecycle import HOUSEKEEPING_S, grpc_edge, leave, say_ready, settle, unless
from optipmb_service.app.service import Service
from optipmb_service.settings import Settings
from optipmb_service.streams.profiles import Profiles
from optipmb_service.telemetry import logs

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.telemetry.health import ProcessHealth

log = structlog.get_logger("optipmb_service")

UNUSED: Final = "scipy.linalg"
COMPILER: Final = "libllvmlite"
MAPS: Final = Path("/proc/self/maps")


class Parent:
    """The parent, as the worker `index` sees it; `private` is a folder that the workers share."""

    def __init__(self, index: int, private: Path) -> None:
        self.index = index
        self.private = private

    def listen(self, asked: StopRequest) -> None:
        """End when the parent says so, or is gone."""

        def read() -> None:
            for _ in sys.stdin:
                pass
            asked.ask_threadsafe("parent")

        threading.Thread(target=read, name="parent", daemon=True).start()

    def say(self, event: str) -> None:
        try:
            print(json.dumps({"event": event}), flush=True)  # noqa: T201 - the parent reads it
        except BrokenPipeError:
            log.warning("parent_gone")  # stdin has ended too, or will


def run(settings: Settings, parent: Parent | None = None) -> int:
    """Track until SIGINT or SIGTERM, or until the parent says so; returns the exit status."""
    try:
        profiles = Profiles.read(settings.profile, settings.profiles, settings.sensors, settings.missing_s)
        profiles.check_zones(settings.zones)
    except optipmb.ParameterError as error:
        if parent is None or parent.index == 0:  # of all workers one says it
            logs.say(f"optipmb-service: {' '.join(str(error).split())}")
        return WRONG_USE

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool | None:
        return await _serve(settings, profiles, parent, asked, health)

    return asyncio.run(lifecycle.run(settings, serve, profiles=profiles.names))


async def _serve(
    settings: Settings, profiles: Profiles, parent: Parent | None, asked: StopRequest, health: ProcessHealth
) -> bool | None:
    """Run the service until the end is asked for; return whether it ended in order, None when it never began.

    Raises:
        TransportError: the network cannot be used.
        StoreError: the store cannot be used, and others use it.
    """
    loop = asyncio.get_running_loop()
    private = None if parent is None else parent.private
    if parent is not None:
        parent.listen(asked)

    def arm(wake: Callable[[], None], at_ns: int) -> None:
        # The loop's time and the deadlines are one clock, the monotonic one.
        loop.call_soon_threadsafe(loop.call_at, at_ns / 1e9, wake)

    await unless(asked, partial(warm_up, rejoin=bool(settings.rejoin)))
    if asked.is_set():
        return None
    if not settings.is_router:
        log.info("connecting", endpoints=settings.connect)
    service = await unless(asked, lambda: Service(settings, profiles, arm, private=private, metrics=health.metrics))
    if service is None:
        return None
    service.start(announce=parent is None)  # to the network the workers are one instance: the parent speaks for it
    health.report(service)
    settle()
    with grpc_edge(settings, service.client(), health.metrics):
        # In this order: messages may come as soon as the ready line is out, and sessions log after this event.
        log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
        if parent is None:
            say_ready("instance", settings.instance, (*settings.endpoints, *settings.connect))
        else:
            parent.say("ready")
        while not asked.is_set():
            await asked.wait(HOUSEKEEPING_S)
            service.housekeeping()
            if health.tls is not None and (why := health.tls.failure):
                service.report_certificate(why)
            if parent is not None and not service.stuck:  # else the parent is to replace this process
                parent.say("beat")
        health.ends()
    return await asyncio.to_thread(service.stop, asked.bound.left())


def warm_up(*, rejoin: bool = False) -> None:
    """Compile the kernels, or load them, with `rejoin` also the kernels that join tracks over gaps.

    With its array functions numba loads scipy's linear algebra where that is installed: 15 of 220 MB, and a twelfth of
    the processor time of the start, for functions that no kernel uses. It does without where there is none, so it is
    shown none.
    """
    if UNUSED not in sys.modules:
        sys.modules[UNUSED] = None  # type: ignore[assignment]  # what makes an import fail, as Python has it
        try:
            import_module("numba.np.arraymath")
        finally:
            del sys.modules[UNUSED]
    optipmb.warm_up(rejoin=rejoin)
    _release_compiler()


def _release_compiler() -> None:
    """Give back the pages of the compiler's code: 52 of 205 MB, read to load the kernels and not read again.

    They map a file and are never written to: a later use reads the file again. On other systems than Linux they stay.
    """
    if sys.platform != "linux":
        return
    advise = ctypes.CDLL(None).madvise
    advise.argtypes = (ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int)
    for line in MAPS.read_text(encoding="utf-8").splitlines():
        extent, access = line.split(maxsplit=2)[:2]
        # Code alone: read-only data may hold addresses that were filled in when the library was loaded.
        if COMPILER in line and access == "r-xp":
            begin, end = (int(bound, 16) for bound in extent.split("-"))
            advise(begin, end - begin, mmap.MADV_DONTNEED)


def main() -> int:
    """Run a worker; return the exit status."""
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    line = sys.stdin.readline()
    if not line:
        return 0  # the parent died at once
    order = json.loads(line)
    settings = Settings(**order["settings"])
    logs.configure(settings.log_format, settings.log_level, order["index"])
    return run(settings, Parent(order["index"], Path(order["private"])))


if __name__ == "__main__":
    leave(main())

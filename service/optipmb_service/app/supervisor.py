"""The parent of worker processes: starts them, starts again those that die, speaks for them, and tracks nothing itself.

With a router, the router lives in the parent, and the workers connect to it over a socket in a private folder: no port,
no password. Else the workers connect where the parent does. To the network the workers are one instance: the parent
holds its alive token and answers its queries; the owner tokens of streams carry the names of the workers.

A worker that gives no sign of life for `stuck_s`, or for `START_S` while it starts, is killed. One that dies is started
again at once; if it dies again soon, after a pause that doubles. Meanwhile the others have its streams.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
import time
from typing import TYPE_CHECKING, Any, Final, Literal

import structlog

from optipmb_service import __version__
from optipmb_service.app.aggregate import QUERIES, AggregateView
from optipmb_service.app.certificates import Certificates
from optipmb_service.app.edges import grpc_edge, monitoring
from optipmb_service.app.ending import END_HUNG, LATE_S, RESTART, SLICE_S, EndBound, longest_end_s
from optipmb_service.app.loops import StopRequest, beat, say_ready, unless, watch_keys
from optipmb_service.app.private_folder import private_folder
from optipmb_service.app.worker_process import WorkerProcess
from optipmb_service.observability import logs
from optipmb_service.observability.health import BEAT_S
from optipmb_service.runtime.ports import EdgeError, TransportError
from optipmb_service.zenoh.transport import Transport

if TYPE_CHECKING:
    from pathlib import Path

    from optipmb_service.settings.model import Settings

log = structlog.get_logger("optipmb_service")

FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0
STEADY_S: Final = 10.0
"""A worker that has lived for so long is taken for sound: if it dies, it is started again at once."""

START_S: Final = 900.0
"""How long a worker may take to start: where the kernels are compiled, one compiles them and the others wait."""

WORKERS_S: Final = 2.0
"""How much longer the end of a parent may take than that of its workers."""

OWN_END_S: Final = 0.5
"""How long a parent may take to end without workers: what is left of them before is killed."""

ORDERLY: Final = frozenset({0, RESTART, -signal.SIGINT, -signal.SIGTERM})
"""Statuses of a worker that has ended as it was asked to; by these signals before it could listen to them."""

State = Literal["starting", "ready", "down"]


class Supervisor:
    """The workers of one instance.

    Args:
        settings: what the workers run with, but for their names.
        asked: whether the end was asked for.
        private: folder that the workers share.
    """

    def __init__(self, settings: Settings, asked: StopRequest, private: Path) -> None:
        self.count = settings.workers
        self.states: list[State] = ["down"] * self.count
        self.restarts = [0] * self.count
        self._was_ready = [False] * self.count
        self._hung = False
        self.began = False
        """Whether all workers have been ready at once."""
        self.failed: int | None = None
        """Exit status of a worker that could not even start."""
        self._settings = settings
        self._asked = asked
        self._private = private
        self._children: list[WorkerProcess | None] = [None] * self.count
        self._tasks: list[asyncio.Task[None]] = []
        self._watching: asyncio.Task[None] | None = None
        self._heard = [0.0] * self.count
        self._changed = asyncio.Event()

    async def start(self) -> bool:
        """Start the workers and wait until all are ready; False when that will not be."""
        self._tasks = [asyncio.create_task(self._kept(index)) for index in range(self.count)]
        self._watching = asyncio.create_task(self._watch())
        stop = asyncio.create_task(self._asked.wait())
        while not self._over and any(state != "ready" for state in self.states):
            self._changed.clear()
            change = asyncio.create_task(self._changed.wait())
            await asyncio.wait({change, stop}, return_when=asyncio.FIRST_COMPLETED)
            change.cancel()
        stop.cancel()
        self.began = not self._over
        return self.began

    async def end(self) -> None:
        """Tell the workers to end."""
        for child in self._children:
            if child is not None:
                child.end()
        await asyncio.sleep(0.0)  # only the loop's next turn closes what they read from

    async def stop(self) -> bool:
        """End the workers; False when one hung in its end, or had to be killed."""
        if self._watching is not None:
            self._watching.cancel()
        if not self._asked.is_set():
            self._asked.ask("failed start")
        await self.end()
        if not self._tasks:
            return True
        while True:  # the bound does not count the time for which all of them are frozen
            _, late = await asyncio.wait(self._tasks, timeout=SLICE_S)
            if not late or self._asked.bound.left() <= OWN_END_S:
                break
        for child in self._children:
            if child is not None:
                child.kill()
        if late:
            await asyncio.wait(late)
        return not (late or self._hung)

    async def _watch(self) -> None:
        """Kill workers that give no sign of life; they are started again."""
        turned = time.monotonic()
        while not self._over:
            await asyncio.sleep(BEAT_S)
            now, before = time.monotonic(), turned
            turned = now
            if now - before > LATE_S:
                # This process was frozen itself, or starved: what the workers said meanwhile is still to be read.
                self._heard = [now] * self.count
                continue
            for index, child in enumerate(self._children):
                silent_s = now - self._heard[index]
                most_s = {"ready": self._settings.stuck_s, "starting": START_S}.get(self.states[index], math.inf)
                if child is not None and silent_s > most_s:
                    log.error("worker_stuck", worker=index, silent_s=round(silent_s, 3))
                    self._set(index, "down")
                    child.kill()

    @property
    def _over(self) -> bool:
        return self._asked.is_set() or self.failed is not None

    async def _kept(self, index: int) -> None:
        """Have a worker run until the end."""
        folder = self._settings.folder  # one for all, wherever the workers connect
        settings = self._settings.model_copy(
            update={"instance": f"{self._settings.instance}-w{index}", "store": str(folder) if folder else "none"}
        )
        pause_s = 0.0
        while not self._over:
            child = self._children[index] = WorkerProcess(index, lambda event: self._take_in(index, event))
            self._set(index, "starting")
            self._heard[index] = time.monotonic()
            self._was_ready[index] = False
            began = time.monotonic()
            status = await child.run(settings, self._private)
            lived_s = time.monotonic() - began
            if status == RESTART and not self._over:
                log.info("worker_restarts", worker=index)
                self._set(index, "down")
                continue
            never_ready = not self._was_ready[index]
            self._set(index, "down")
            if self._asked.is_set():
                self._hung |= status not in ORDERLY
                return
            if never_ready and not self.began:
                self.failed = max(status or 0, 1)  # one that was killed has a negative status
                self._changed.set()
                return
            pause_s = 0.0 if lived_s > STEADY_S else min(LONGEST_PAUSE_S, max(FIRST_PAUSE_S, 2 * pause_s))
            again_s = 0.0 if self.restarts[index] == 0 else pause_s
            self.restarts[index] += 1
            log.error("worker_ended", worker=index, status=status, again_s=again_s)
            if again_s:
                await self._asked.wait(again_s)

    def _take_in(self, index: int, event: dict[str, Any]) -> None:
        self._heard[index] = time.monotonic()
        if event == {"event": "ready"}:
            self._was_ready[index] = True
            self._set(index, "ready")

    def _set(self, index: int, state: State) -> None:
        self.states[index] = state
        self._changed.set()


async def supervise(settings: Settings) -> int:
    """Run the service as worker processes until SIGINT or SIGTERM.

    Returns:
        The exit status: 0, 1 when the network could not be used or an end hung, or that of a worker which could not
        start; `RESTART` where this process is to begin again.
    """
    asked = StopRequest(EndBound(longest_end_s(settings.grace_s) + WORKERS_S))
    log.info("starting", instance=settings.instance, version=__version__, workers=settings.workers)
    with private_folder() as folder:
        socket = f"unixsock-stream/{folder / 'router'}"
        own, workers = divided(settings, socket)
        if not settings.is_router:
            log.info("connecting", endpoints=settings.connect)
        try:
            transport = await unless(asked, lambda: Transport(own))
            if transport is None:
                return 0
            return await _supervised(settings, workers, transport, asked, folder)
        except (TransportError, EdgeError) as error:
            logs.say(f"optipmb-service: {error}")
            return 1


async def _supervised(
    settings: Settings, workers: Settings, transport: Transport, asked: StopRequest, private: Path
) -> int:
    """Run the workers until the end is asked for.

    Raises:
        HttpError: the address cannot be listened on.
    """
    supervisor = Supervisor(workers, asked, private)
    view = AggregateView(settings, supervisor, transport)
    view.tls = certificates = Certificates(settings)
    view.add(certificates.figures)
    looking = asyncio.create_task(certificates.watch())
    beating = asyncio.create_task(beat(view))
    client = transport.client()
    watching = asyncio.create_task(watch_keys(asked, lambda: client.key_numbers, settings.restart_keys))
    ended = True
    try:
        with monitoring(settings, view):
            if await supervisor.start():
                transport.watch()
                transport.serve_service(view.answer, QUERIES)
                transport.announce()
                with grpc_edge(settings, transport.client, view.add):
                    say_ready("instance", settings.instance, (*settings.endpoints, *settings.connect))
                    log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
                    await asked.wait()
                    await supervisor.end()  # before gRPC closes, which takes of the time that they have
            view.ends()
            ended = await supervisor.stop()
    finally:
        asked.bound.begin()  # also where nobody asked
        for task in (beating, watching, looking):
            task.cancel()
        with contextlib.suppress(Exception):
            await asyncio.to_thread(transport.close)
    log.info("stopped", drained=ended)
    if asked.restarts and not supervisor.failed:
        return RESTART
    return supervisor.failed or (0 if ended else END_HUNG)


def divided(settings: Settings, socket: str) -> tuple[Settings, Settings]:
    """Return the settings of the parent and those of its workers, which have no names yet.

    Args:
        settings: of the whole.
        socket: endpoint where the parent's router listens for the workers, where it is one.
    """
    router = settings.is_router
    own = settings.model_copy(update={"listen": (*settings.endpoints, socket) if router else settings.endpoints})
    workers = settings.model_copy(
        update={
            "router": False,
            "listen": (),
            "connect": (socket,) if router else settings.connect,
            "http": "",
            "grpc": "",
            # Its name follows from the endpoints, and those of the workers are the parent's own affair.
            "store": "none" if settings.folder is None else str(settings.folder),
            "zenoh_config": None if router else settings.zenoh_config,
            "standby_mb": max(1, settings.standby_mb // settings.workers),
        }
    )
    return own, workers

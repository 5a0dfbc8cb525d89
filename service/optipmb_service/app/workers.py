"""The parent of worker processes: starts and restarts them, answers for them, and tracks nothing itself.

With a router, the router lives in the parent, and the workers connect to it over a socket in a private folder: no port,
no password. Else the workers connect where the parent does. To the network the workers are one instance: the parent
holds its alive token and answers its queries; the owner tokens of streams carry the names of the workers.

A worker that gives no sign of life for `stuck_s`, or for `START_S` while it starts, is killed. One that dies is started
again at once; if it dies again soon, after a pause that doubles. Meanwhile the others have its streams.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import math
import os
import shutil
import sys
import tempfile
import time
from asyncio.subprocess import PIPE, Process
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import optipmb_schemas as schemas
import structlog

from optipmb_service import __version__
from optipmb_service.app import ENDING, lifecycle
from optipmb_service.app.lifecycle import LATE_S, RESTART, SLICE_S, grpc_edge, say_ready, unless
from optipmb_service.cluster.leases import ALIVE, instance_of
from optipmb_service.streams.profiles import Fusion
from optipmb_service.streams.queries import TEXT, UNDRAINED, drain_asked, guarded, move_asked
from optipmb_service.telemetry.health import BEAT_S, Component
from optipmb_service.telemetry.metrics import NETWORK_METRICS
from optipmb_service.zenoh.transport import Transport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from optipmb_client.zenoh.handles import Query

    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")

FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0
STEADY_S: Final = 10.0  # a worker that has lived for so long is started again at once if it dies
START_S: Final = 900.0  # longest start of a worker: one compiles the kernels, and the others wait
WORKERS_S: Final = 2.0  # time of a parent's end beyond the end of its workers
OWN_END_S: Final = 0.5  # time of a parent's end after its workers; those still running before are killed
ORDERLY: Final = frozenset({0, RESTART, *(-number for number in ENDING)})
"""Statuses of a worker that has ended as it was asked to; by these signals before it could listen to them."""

LINE_BYTES: Final = 1 << 20  # longest line between worker and parent
ANSWER_S: Final = 1.0  # how long a worker may take to answer for its part
MOVE_S: Final = 20.0  # how long a worker may take to have a stream brought to it
QUERIES: Final = ("status", "metrics", "move", "drain")  # answered for all workers; they answer the rest
PROBLEMS: Final = 100
SESSIONS: Final = 10_000

PREFIX: Final = "optipmb-"
HELD: Final = "held"

State = Literal["starting", "ready", "down"]


class Worker:
    """A worker process and its replacements.

    Each is a fresh interpreter. A fork would copy Zenoh's threads without their life and numba's locks as they were,
    and a worker that is started again after a crash must not inherit what the parent has become by then.

    Args:
        index: number of the worker.
        changed: called when `state` changes.
    """

    def __init__(self, index: int, changed: Callable[[], None] = lambda: None) -> None:
        self.index = index
        self.state: State = "down"
        self.was_ready = False
        """Whether the present process has been ready."""
        self.heard = 0.0
        """Monotonic time of its last sign of life."""
        self._changed = changed
        self._process: Process | None = None
        self._ending = False

    def set(self, state: State) -> None:
        self.state = state
        self._changed()

    async def run(self, settings: Settings, private: Path) -> int:
        """Start the process, and return its exit status when it has ended; below 0: the signal that killed it."""
        try:
            process = self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "optipmb_service.app.worker", stdin=PIPE, stdout=PIPE, limit=LINE_BYTES
            )
        except OSError as error:  # no right, no memory, too many processes, no interpreter any more
            log.error("worker_not_started", worker=self.index, error=str(error))  # noqa: TRY400 - the text says it all
            return 1
        log.info("worker_started", worker=self.index, pid=process.pid)
        try:
            order = {"settings": settings.model_dump(mode="json"), "index": self.index, "private": str(private)}
            assert process.stdin is not None  # noqa: S101 - it was asked for: said for the type checker
            assert process.stdout is not None  # noqa: S101 - likewise
            process.stdin.write(json.dumps(order).encode() + b"\n")
            if self._ending:  # asked while this process began
                process.stdin.close()
            async for line in process.stdout:
                with contextlib.suppress(ValueError):  # what a library prints is no event
                    self.hear(json.loads(line))
            return await process.wait()
        finally:
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()

    def hear(self, event: object) -> None:
        """Note a sign of life."""
        self.heard = time.monotonic()
        if event == {"event": "ready"}:
            self.was_ready = True
            self.set("ready")

    def end(self) -> None:
        """Ask the process to end, also one that is about to begin."""
        self._ending = True
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def kill(self) -> None:
        """End the process at once."""
        if self._process is not None and self._process.returncode is None:
            log.warning("worker_killed", worker=self.index)
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()


class Supervisor:
    """The workers of one instance, with these settings but for their names, and a folder that they share."""

    def __init__(self, settings: Settings, asked: StopRequest, private: Path) -> None:
        self.workers = [Worker(index, self._change) for index in range(settings.workers)]
        self.began = False
        """Whether all workers have been ready at once."""
        self.failed = 0
        """Exit status of a worker that could not even start."""
        self._hung = False
        self._settings = settings
        self._asked = asked
        self._private = private
        self._tasks: list[asyncio.Task[None]] = []
        self._watching: asyncio.Task[None] | None = None
        self._settled = asyncio.Event()

    async def start(self) -> bool:
        """Start the workers and wait until all are ready; False when that will not be."""
        self._tasks = [asyncio.create_task(self._keep(worker)) for worker in self.workers]
        self._watching = asyncio.create_task(self._watch())
        waits = {asyncio.create_task(self._asked.wait()), asyncio.create_task(self._settled.wait())}
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for one in waits:
            one.cancel()
        self.began = not self._over
        return self.began

    async def end(self) -> None:
        for worker in self.workers:
            worker.end()
        await asyncio.sleep(0.0)  # only the loop's next turn closes their stdin

    async def stop(self) -> bool:
        """End the workers; False when one hung in its end, or had to be killed."""
        if self._watching is not None:
            self._watching.cancel()
        if not self._asked.is_set():
            self._asked.ask("failed start")
        await self.end()
        while True:  # the bound does not count the time for which all of them are frozen
            _, late = await asyncio.wait(self._tasks, timeout=SLICE_S)
            if not late or self._asked.bound.left() <= OWN_END_S:
                break
        for worker in self.workers:
            worker.kill()
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
            for worker in self.workers:
                if now - before > LATE_S:
                    # This process was frozen itself, or starved: what the workers said meanwhile is still to be read.
                    worker.heard = now
                silent_s = now - worker.heard
                if silent_s > {"ready": self._settings.stuck_s, "starting": START_S}.get(worker.state, math.inf):
                    log.error("worker_stuck", worker=worker.index, silent_s=round(silent_s, 3))
                    worker.set("down")
                    worker.kill()

    @property
    def _over(self) -> bool:
        return self._asked.is_set() or bool(self.failed)

    def _change(self) -> None:
        if self.failed or all(worker.state == "ready" for worker in self.workers):
            self._settled.set()

    async def _keep(self, worker: Worker) -> None:
        """Run a worker until the end, again whenever it ends."""
        index, folder = worker.index, self._settings.folder  # shared by all workers
        settings = self._settings.model_copy(
            update={"instance": f"{self._settings.instance}-w{index}", "store": str(folder) if folder else "none"}
        )
        pause_s, first = 0.0, True
        while not self._over:
            worker.was_ready, worker.heard = False, time.monotonic()
            worker.set("starting")
            began = time.monotonic()
            status = await worker.run(settings, self._private)
            lived_s = time.monotonic() - began
            worker.set("down")
            if self._asked.is_set():
                self._hung |= status not in ORDERLY
                return
            if status == RESTART:
                log.info("worker_restarts", worker=index)
                continue
            if not worker.was_ready and not self.began:
                self.failed = max(status, 1)  # one that was killed has a negative status
                self._change()
                return
            pause_s = 0.0 if lived_s > STEADY_S else min(LONGEST_PAUSE_S, max(FIRST_PAUSE_S, 2 * pause_s))
            again_s, first = 0.0 if first else pause_s, False
            log.error("worker_ended", worker=index, status=status, again_s=again_s)
            if again_s:
                await self._asked.wait(again_s)


class AggregateView(Component):
    """All workers of one instance: status and metrics asked of each and put together, and the moves.

    A worker that does not answer in time is left out and makes the state `degraded`. Its metrics go to the parent's.
    """

    def __init__(self, settings: Settings, supervisor: Supervisor, network: Transport, metrics: Metrics) -> None:
        self._instance = settings.instance
        self._keys = schemas.Keys(settings.prefix)
        self._fusion = Fusion.of(settings)
        self._limits = settings.limits.limits()
        self._supervisor = supervisor
        self._names = [f"{settings.instance}-w{worker.index}" for worker in supervisor.workers]
        self._network = network
        self._started_ns = time.time_ns()
        self._began_ns = time.monotonic_ns()
        self._ending = False
        self._asking = ThreadPoolExecutor(len(self._names), "asking")
        self._draining = ThreadPoolExecutor(len(self._names), "draining")  # takes long, and keeps no status waiting
        self._metrics = metrics
        metrics.add({"linked": NETWORK_METRICS["linked"]}, network.client)
        metrics.workers = self._samples

    def ends(self) -> None:
        """Report the end from now on."""
        self._ending = True
        for threads in (self._asking, self._draining):
            threads.shutdown(wait=False, cancel_futures=True)

    @property
    def usable(self) -> bool:
        """Whether streams are tracked, be it not all of them."""
        return any(worker.state == "ready" for worker in self._supervisor.workers)

    @property
    def failure(self) -> str:
        """Why there is no network, or which workers are not ready; empty while all is well."""
        if why := self._network.client().failure:
            return why
        late = (worker for worker in self._supervisor.workers if worker.state != "ready")
        return ", ".join(f"worker {worker.index}: {worker.state}" for worker in late)

    @property
    def state(self) -> str:
        """State of the whole: unlinked without a router, degraded when a worker is down."""
        if self._ending:
            return "stopping"
        if not self._supervisor.began:
            return "starting"
        if self._network.client().failure:
            return "unlinked"
        return "ready" if all(worker.state == "ready" for worker in self._supervisor.workers) else "degraded"

    def status(self) -> schemas.ServiceStatus:
        """Return the status: the sessions of all workers by stream, each with its worker, and the sums."""
        parts = [
            None if answer is None else schemas.decode(answer, schemas.ServiceStatus)
            for answer in self._ask(self._keys.status)
        ]
        answered = [part for part in parts if part is not None]
        sums: dict[str, int] = {}
        for part in answered:
            for name, value in part.present():
                if type(value) is int and name != "started_ns":
                    sums[name] = sums.get(name, 0) + value
        sessions = [
            session.model_copy(update={"worker": index})
            for index, part in enumerate(parts)
            if part is not None
            for session in part.sessions
        ]
        state = self.state
        drains = state == "ready" and bool(answered) and all(part.state == "draining" for part in answered)
        well = len(answered) == len(self._names) and all(part.state == "ready" for part in answered)
        return schemas.ServiceStatus(
            instance=self._instance,
            version=__version__,
            started_ns=self._started_ns,
            uptime_s=(time.monotonic_ns() - self._began_ns) / 1e9,
            state="draining" if drains else "degraded" if state == "ready" and not well else state,
            sessions=tuple(sorted(sessions, key=lambda session: session.stream)[:SESSIONS]),
            members=_newest(answered),
            problems=tuple(problem for part in answered for problem in part.problems)[-PROBLEMS:],
            **sums,
        )

    def session(self) -> Client | None:
        """Return the session for readers; None at the end."""
        return None if self._ending else self._network.client()

    def detections_of(self, stream: str) -> str:
        """Return the pattern of the streams whose detections belong to the tracks of a stream."""
        return self._fusion.seen_by(stream)

    def answer(self, request: Query) -> None:
        """Answer a query about the instance, and finish it in any case."""
        guarded(request, lambda: self._answer(request), instance=self._instance)

    def _answer(self, request: Query) -> None:
        keys = self._keys
        status, metrics = keys.status(self._instance), keys.metrics(self._instance)
        orders = {keys.move(self._instance): self._move, keys.drain(self._instance): self._drain}
        if request.key in orders:
            orders[request.key](request)
            return
        if request.matches(status):
            request.answer(status, self.status())
        if request.matches(metrics):
            request.answer_text(metrics, self._metrics.text(), TEXT)

    def _move(self, request: Query) -> None:
        asked = move_asked(request, self._limits, len(self._names))
        key = self._keys.move(self._names[asked.worker])
        if self._network.ask(key, MOVE_S, request.payload or b"", request.encoding) is None:
            raise schemas.MessageError("invalid_value", "worker", "a worker to which the stream comes", "none in time")
        request.answer(request.key, asked)

    def _drain(self, request: Query) -> None:
        asked = drain_asked(request, self._limits)
        answers = [one for one in self._ask(self._keys.status) if one is not None] if asked.drain else []
        members = _newest(schemas.decode(answer, schemas.ServiceStatus) for answer in answers)
        if asked.drain and all(instance_of(one.member) in self._names or one.state != ALIVE for one in members):
            raise schemas.MessageError("invalid_value", "drain", "another member that takes the streams", "none")
        keys = [self._keys.drain(name) for name in self._names]
        payload, encoding = schemas.encode(asked), schemas.encoding_of(schemas.DrainRequest)
        drained = list(self._draining.map(lambda key: self._network.ask(key, MOVE_S, payload, encoding), keys))
        if None in drained:
            raise schemas.MessageError("invalid_value", "drain", "members that take the streams", UNDRAINED)
        request.answer(request.key, asked)

    def _samples(self) -> Iterator[tuple[int, bytes]]:
        for index, answer in enumerate(self._ask(self._keys.metrics)):
            if answer is not None:
                yield index, answer

    def _ask(self, key: Callable[[str], str]) -> list[bytes | None]:
        """Ask every worker at the key of its name, all at once."""
        if self._ending:
            return []
        return list(self._asking.map(lambda name: self._network.ask(key(name), ANSWER_S), self._names))


def _newest(parts: Iterable[schemas.ServiceStatus]) -> tuple[schemas.MemberSummary, ...]:
    """Return the members that workers know: each as it knows itself, else as the worker that heard of it last."""
    members: dict[str, tuple[bool, float, schemas.MemberSummary]] = {}
    for part in parts:
        for one in part.members:
            known = (instance_of(one.member) != part.instance, one.age_s, one)
            if one.member not in members or known[:2] < members[one.member][:2]:
                members[one.member] = known
    return tuple(members[name][2] for name in sorted(members))


async def supervise(settings: Settings) -> int:
    """Run the service as worker processes until SIGINT or SIGTERM.

    Returns:
        The exit status, as `lifecycle.run` does, or of a worker which could not start.
    """
    with private_folder() as folder:
        own, workers = divided(settings, f"unixsock-stream/{folder / 'router'}")
        failed = 0

        async def serve(asked: StopRequest, health: ProcessHealth) -> bool | None:
            nonlocal failed
            if not settings.is_router:
                log.info("connecting", endpoints=settings.connect)
            transport = await unless(asked, lambda: Transport(own))
            if transport is None:
                return None
            supervisor = Supervisor(workers, asked, folder)
            try:
                return await serve_workers(settings, supervisor, transport, asked, health)
            finally:
                failed = supervisor.failed
                asked.bound.begin()
                with contextlib.suppress(Exception):
                    await asyncio.to_thread(transport.close)

        status = await lifecycle.run(settings, serve, counts=False, more_s=WORKERS_S, workers=settings.workers)
        return failed or status


async def serve_workers(
    settings: Settings, supervisor: Supervisor, transport: Transport, asked: StopRequest, health: ProcessHealth
) -> bool:
    """Run the workers until the end is asked for; return whether they ended in order."""
    client = transport.client()
    view = AggregateView(settings, supervisor, transport, health.metrics)
    health.report(view)
    if await supervisor.start():
        transport.watch()
        transport.serve_service(view.answer, QUERIES)
        transport.announce()
        with grpc_edge(settings, client, health.metrics):
            say_ready("instance", settings.instance, (*settings.endpoints, *settings.connect))
            log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
            await asked.wait()
            await supervisor.end()  # before gRPC closes, which takes of the time that they have
    view.ends()
    health.ends()
    return await supervisor.stop()


def divided(settings: Settings, socket: str) -> tuple[Settings, Settings]:
    """Return the settings of the parent, whose router listens at `socket`, and of its workers, without names."""
    router = settings.is_router
    own = settings.model_copy(update={"listen": (*settings.endpoints, socket) if router else settings.endpoints})
    workers = settings.model_copy(
        update={
            "router": False,
            "listen": (),
            "connect": (socket,) if router else settings.connect,
            "http": "",
            "grpc": "",
            # Its default name follows from the endpoints, which differ between parent and workers.
            "store": "none" if settings.folder is None else str(settings.folder),
            "zenoh_config": None if router else settings.zenoh_config,
            "standby_mb": max(1, settings.standby_mb // settings.workers),
        }
    )
    return own, workers


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder that only this user may enter, and remove it at the end; what killed processes left goes too.

    A living process holds a lock on a file in its folder; the kernel lets go of it however the process ends. The file
    gets its name when it is locked already, so every file of this name is locked while its process lives.
    """
    for held in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{HELD}"):
        with contextlib.suppress(OSError):  # of another user, held by a process that lives, or removed meanwhile
            if held.parent.stat().st_uid == os.geteuid():
                with held.open() as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(held.parent)
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / "new").open("x") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            (folder / "new").rename(folder / HELD)
            yield folder

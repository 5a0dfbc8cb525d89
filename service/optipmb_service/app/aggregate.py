"""What the workers of one instance are together: status and metrics asked of each and put together, and the moves.

Implements `http.Source`, and answers the queries about the instance. A worker that does not answer in time is left out
and makes the state `degraded`.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, Protocol

import optipmb_schemas as schemas
import structlog
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.metrics_core import Metric

from optipmb_service import __version__
from optipmb_service.cluster.leases import ALIVE, instance_of
from optipmb_service.observability import collectors
from optipmb_service.observability.health import STUCK_S
from optipmb_service.observability.metrics import Collected, ReadOnDemand, families
from optipmb_service.runtime.profiles import Fusion
from optipmb_service.runtime.queries import UNDRAINED, drain_asked, guarded, move_asked, problem_with

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from optipmb_service.observability.health import TlsSource
    from optipmb_service.observability.metrics import Value
    from optipmb_service.runtime.ports import Request
    from optipmb_service.settings.model import Settings
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")

ANSWER_S: Final = 1.0
"""How long a worker may take to answer for its part."""

MOVE_S: Final = 20.0
"""How long a worker may take to have a stream brought to it."""

QUERIES: Final = ("status", "metrics", "move", "drain")
"""What is answered for all workers; they answer the rest."""

TEXT: Final = "text/plain;version=0.0.4"
PROBLEMS: Final = 100
SESSIONS: Final = 10_000


class Workers(Protocol):
    """What is asked of the supervisor."""

    @property
    def count(self) -> int:
        """How many workers there are."""

    @property
    def states(self) -> Sequence[str]:
        """How each is."""

    @property
    def began(self) -> bool:
        """Whether all have been ready at once."""


class Network(Protocol):
    """What is asked of the transport."""

    def ask(self, key: str, timeout: float, payload: bytes = b"", encoding: str = "") -> bytes | None:
        """Return the first answer at a key."""

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None], detections: str = "") -> Callable[[], None]:
        """Hand over what comes on a stream, and the detections of a pattern of others, until the result is called."""

    def client(self) -> Client:
        """Return what says whether there is a router."""


class AggregateView:
    """All workers of one instance.

    Args:
        settings: of the instance.
        workers: the supervisor.
        network: where the workers are asked.
    """

    def __init__(self, settings: Settings, workers: Workers, network: Network) -> None:
        self._instance = settings.instance
        self._keys = schemas.Keys(settings.prefix)
        self._fusion = Fusion(settings.fuse)
        self._limits = settings.limits.limits()
        self._workers = workers
        self._network = network
        self._started_ns = time.time_ns()
        self._began_ns = self._beat_ns = time.monotonic_ns()
        self._ending = False
        self.tls: TlsSource | None = None
        """The certificates of the parent."""
        self._asking = ThreadPoolExecutor(workers.count, "asking")
        self._draining = ThreadPoolExecutor(workers.count, "draining")  # takes long, and keeps no status waiting
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)

    def add(self, figures: Callable[[], Iterable[Value]]) -> None:
        """Have figures of the parent itself read with the metrics."""
        self._registry.register(ReadOnDemand(figures))

    # As http.Source

    def beat(self) -> None:
        """Say that the control loop turns."""
        self._beat_ns = time.monotonic_ns()

    def beat_age_s(self) -> float:
        """Return the seconds since the control loop last turned."""
        return (time.monotonic_ns() - self._beat_ns) / 1e9

    def alive(self) -> bool:
        """Tell whether the control loop turns."""
        return self.beat_age_s() < STUCK_S

    def ends(self) -> None:
        """Report the end from now on."""
        self._ending = True
        for threads in (self._asking, self._draining):
            threads.shutdown(wait=False, cancel_futures=True)

    def ready(self) -> bool:
        """Tell whether streams are tracked, be it not all of them."""
        cut_off = self.tls is not None and self.tls.cut_off
        return self.state() in {"ready", "degraded"} and "ready" in self._workers.states and not cut_off

    def failure(self) -> str:
        """Return why there is no network, or which workers are not ready; empty while all is well."""
        if self.tls is not None and self.tls.failure:
            return self.tls.failure
        if why := self._network.client().failure:
            return why
        states = enumerate(self._workers.states)
        return ", ".join(f"worker {index}: {state}" for index, state in states if state != "ready")

    def state(self) -> str:
        """Return the state of the whole: unlinked without a router, degraded when a worker is down."""
        if self._ending:
            return "stopping"
        if not self._workers.began:
            return "starting"
        if self._network.client().failure:
            return "unlinked"
        return "ready" if all(state == "ready" for state in self._workers.states) else "degraded"

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
        state = self.state()
        drains = state == "ready" and bool(answered) and all(part.state == "draining" for part in answered)
        well = len(answered) == self._workers.count and all(part.state == "ready" for part in answered)
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

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None] | None:
        """Hand over what comes on a stream to a viewer, whichever worker tracks it, until the result is called."""
        return None if self._ending else self._network.tap(stream, receive, self._fusion.seen_by(stream))

    def text(self) -> bytes:
        """Return the metrics of all processes in Prometheus' text format; those of a worker have its label."""
        registry = CollectorRegistry()
        registry.register(Collected(self._families))
        return generate_latest(registry)

    # Queries

    def answer(self, request: Request) -> None:
        """Answer a query about the instance, and finish it whatever happens."""
        guarded(request, lambda: self._answer(request))

    def _answer(self, request: Request) -> None:
        keys = self._keys
        status, metrics = keys.status(self._instance), keys.metrics(self._instance)
        orders = {keys.move(self._instance): self._move, keys.drain(self._instance): self._drain}
        if request.key in orders:
            try:
                orders[request.key](request)
            except schemas.MessageError as error:
                request.refuse(problem_with(error, instance=self._instance))
            return
        if request.matches(status):
            request.answer(status, self.status())
        if request.matches(metrics):
            request.answer_text(metrics, self.text(), TEXT)

    def _move(self, request: Request) -> None:
        """Carry out a move.

        Raises:
            MessageError: what was asked cannot be.
        """
        asked = move_asked(request, self._limits, self._workers.count)
        key = self._keys.move(f"{self._instance}-w{asked.worker}")
        if self._network.ask(key, MOVE_S, request.payload or b"", request.encoding) is None:
            raise schemas.MessageError("invalid_value", "worker", "a worker to which the stream comes", "none in time")
        request.answer(request.key, asked)

    def _drain(self, request: Request) -> None:
        """Have all workers leave their streams.

        Raises:
            MessageError: what was asked cannot be.
        """
        asked = drain_asked(request, self._limits)
        own = {f"{self._instance}-w{index}" for index in range(self._workers.count)}
        if asked.drain and all(instance_of(one.member) in own or one.state != ALIVE for one in self._members()):
            raise schemas.MessageError("invalid_value", "drain", "another member that takes the streams", "none")
        keys = [self._keys.drain(name) for name in sorted(own)]
        payload, encoding = schemas.encode(asked), schemas.encoding_of(schemas.DrainRequest)
        answers = list(self._draining.map(lambda key: self._network.ask(key, MOVE_S, payload, encoding), keys))
        if None in answers:
            raise schemas.MessageError("invalid_value", "drain", "members that take the streams", UNDRAINED)
        request.answer(request.key, asked)

    def _members(self) -> tuple[schemas.MemberSummary, ...]:
        """Return what the workers know of members, of each what was heard last."""
        answers = [one for one in self._ask(self._keys.status) if one is not None]
        return _newest(schemas.decode(answer, schemas.ServiceStatus) for answer in answers)

    # The parts

    def _ask(self, key: Callable[[str], str]) -> list[bytes | None]:
        """Ask every worker at the key of its name, all at once."""
        if self._ending:
            return []
        keys = [key(f"{self._instance}-w{index}") for index in range(self._workers.count)]
        return list(self._asking.map(lambda one: self._network.ask(one, ANSWER_S), keys))

    def _figures(self) -> Iterator[Value]:
        yield from collectors.of_process(self._instance, self.state())
        yield "linked", (), not self._network.client().failure

    def _families(self) -> Iterator[Metric]:
        merged: dict[str, Metric] = {}
        own = ReadOnDemand(self._figures).collect()
        parts = [("", [*own, *self._registry.collect()])]
        for index, samples in enumerate(self._ask(self._keys.samples)):
            if samples is None:
                continue
            try:
                parts.append((str(index), families(samples)))
            except ValueError as error:
                log.warning("metrics_unreadable", worker=index, error=str(error))
        for worker, metrics in parts:
            for metric in metrics:
                into = merged.setdefault(metric.name, Metric(metric.name, metric.documentation, metric.type))
                into.samples += [
                    sample._replace(labels={**sample.labels, "worker": worker}) if worker else sample
                    for sample in metric.samples
                ]
        yield from merged.values()


def _newest(parts: Iterable[schemas.ServiceStatus]) -> tuple[schemas.MemberSummary, ...]:
    """Return the members that workers know: each as it knows itself, else as who heard of it last does."""
    members: dict[str, tuple[bool, float, schemas.MemberSummary]] = {}
    for part in parts:
        for one in part.members:
            known = (instance_of(one.member) != part.instance, one.age_s, one)
            if one.member not in members or known[:2] < members[one.member][:2]:
                members[one.member] = known
    return tuple(members[name][2] for name in sorted(members))

"""Answers to queries: the state and density of sessions, resets, parameters, the status of the service.

What concerns a session is run by the worker of its stream, so that nothing else happens to it meanwhile: a question
about the state or the density goes before the frames that wait, a reset or a change of parameters takes its turn among
them. The query thread itself only sorts. An error is a reply too: a `Problem`, as an error reply.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
import optipmb_schemas as schemas
import structlog

import optipmb
from optipmb_service.cluster.store import StoreError
from optipmb_service.runtime.ports import TransportError
from optipmb_service.session.checkpoint import digest_of
from optipmb_service.session.convert import density_of
from optipmb_service.session.problems import problem_of
from optipmb_service.session.values import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.cluster.leases import MemberLease
    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.ports import Packet, Request
    from optipmb_service.runtime.registry import Registry
    from optipmb_service.runtime.stream_actor import StreamActor
    from optipmb_service.runtime.track_query import TrackQuery
    from optipmb_service.session.checkpoint import Checkpoint

log = structlog.get_logger("optipmb_service")

TEXT = "text/plain;version=0.0.4"
"""Zenoh encoding of the metrics."""

JSON = "application/json"
"""Zenoh encoding of the metrics as data."""

MOVE_S = 15.0
"""How long a stream may take to be moved; it takes a second."""

UNDRAINED = "not all taken in time; it goes on draining until that is undone"
"""Why a drain was not confirmed."""

MOVES = 16
"""Moves that wait for each other."""

NO_SESSION = "0" * 32
"""Session id in the state of a stream that has none."""

_T = TypeVar("_T", bound=schemas.Message)


class Queries:
    """Answers every request, and finishes it whatever happens.

    Args:
        registry: the streams.
        status: makes the status of the service.
        metrics: makes its metrics, in Prometheus' text format.
        samples: makes its metrics as data for the parent of this process.
        member: the partitions of this process.
        hand_over: gives what was received lately of sessions that are tracked elsewhere now.
        workers: how many processes the service has.
        tracks: answers queries for tracks.
    """

    def __init__(
        self,
        registry: Registry,
        status: Callable[[], schemas.ServiceStatus],
        metrics: Callable[[], bytes],
        samples: Callable[[], bytes],
        member: Member,
        hand_over: Callable[[Iterable[str], Callable[[Packet], None]], None],
        workers: int,
        tracks: TrackQuery,
    ) -> None:
        self._registry = registry
        self._tracks = tracks
        self._status = status
        self._metrics = metrics
        self._samples = samples
        self._member = member
        self._handed_over = hand_over
        self._workers = workers
        self._keys = registry.keys
        self._moves = ThreadPoolExecutor(1, "move")
        self._moving = threading.BoundedSemaphore(MOVES)
        self._digests = ThreadPoolExecutor(1, "digest")
        self._handovers = ThreadPoolExecutor(1, "recent")

    def about_service(self, request: Request) -> None:
        """Answer with the status of the service, its metrics, or both when the key has a `*`; or have streams moved."""
        instance = self._registry.instance
        if request.key == self._keys.recent():
            self._handovers.submit(_guarded, request, lambda: self._hand_over(request))
            return
        if request.key in {self._keys.move(instance), self._keys.drain(instance)}:
            if self._moving.acquire(blocking=False):
                moves = self._move if request.key == self._keys.move(instance) else self._drain
                self._moves.submit(self._move_in_turn, request, moves)
            else:
                many = schemas.MessageError("invalid_value", "worker", f"at most {MOVES} moves at a time", "more")
                _guarded(request, lambda: request.refuse(self._problem("", many)))
            return
        _guarded(request, lambda: self._report(request, self._keys.status(instance), self._keys.metrics(instance)))

    def _report(self, request: Request, status: str, metrics: str) -> None:
        if request.key == self._keys.samples(self._registry.instance):
            request.answer_text(request.key, self._samples(), JSON)
            return
        if request.matches(status):
            request.answer(status, self._status())
        if request.matches(metrics):
            request.answer_text(metrics, self._metrics(), TEXT)

    def _hand_over(self, request: Request) -> None:
        """Answer with what was received lately of sessions, whose names are lines, to who tracks them now."""
        key = self._keys.recent(self._registry.instance)

        def give(packet: Packet) -> None:
            request.answer_text(key, packet.payload or b"", packet.encoding, about=packet.key)

        self._handed_over((request.payload or b"").decode("ascii", "replace").splitlines(), give)

    def _move_in_turn(self, request: Request, moves: Callable[[Request], None]) -> None:
        try:
            _guarded(request, lambda: moves(request))
        finally:
            self._moving.release()

    def _move(self, request: Request) -> None:
        """Have a stream brought here, and say so."""
        try:
            asked = move_asked(request, self._registry.limits, self._workers)
        except schemas.MessageError as error:
            request.refuse(self._problem("", error))
            return
        try:
            received = (
                "" if self._member.bring(self._registry.fusion.session_of(asked.stream), MOVE_S) else "none in time"
            )
        except StoreError as error:
            received = str(error)
        if received:
            failed = schemas.MessageError("invalid_value", "worker", "a worker to which the stream comes", received)
            request.refuse(self._problem(asked.stream, failed))
        else:
            request.answer(request.key, asked)

    def _drain(self, request: Request) -> None:
        """Have all streams taken by others, and say so."""
        try:
            asked = drain_asked(request, self._registry.limits)
        except schemas.MessageError as error:
            request.refuse(self._problem("", error))
            return
        received = "none" if asked.drain and not self._member.others else ""
        if not received:
            self._member.drain(drains=asked.drain)
            if asked.drain and not self._member.drained(MOVE_S):
                received = UNDRAINED
        if received:
            failed = schemas.MessageError("invalid_value", "drain", "another member that takes the streams", received)
            request.refuse(self._problem("", failed))
        else:
            request.answer(request.key, asked)

    def about_streams(self, request: Request) -> None:
        """Answer what concerns sessions, here or on the worker of the stream."""
        name = request.key.rpartition("/")[2]
        if "*" in request.key:
            self._answer_many(request)
            return
        stream = request.key.removeprefix(f"{self._keys.prefix}/").removesuffix(f"/q/{name}")
        try:
            self._keys.tracks(stream)
        except schemas.MessageError as error:
            nowhere = self._problem("", error)
            _guarded(request, lambda: request.refuse(nowhere))
            return
        session = self._registry.fusion.session_of(stream)
        if self._registry.elsewhere(session):
            request.finish()  # another instance tracks the stream, and answers
            return
        if session != stream:
            shared = schemas.MessageError("invalid_value", "key", f"{session}, the session that it shares", stream)
            _guarded(request, lambda: request.refuse(self._problem(stream, shared)))
            return
        if name == "tracks":
            self._tracks.answer(request, stream)
            return
        commands: dict[str, tuple[Callable[[StreamActor, Request], None], bool]] = {
            "state": (lambda *_: None, True),
            "density": (self._density, True),
            "reset": (self._reset, False),
            "parameters": (self._parameters, False),
        }
        if name not in commands:
            unknown = schemas.MessageError(
                "invalid_value", "key", f"one of q/{', q/'.join((*commands, 'tracks'))}", f"q/{name}"
            )
            _guarded(request, lambda: request.refuse(self._problem(stream, unknown)))
            return
        command, urgent = commands[name]

        def answer(actor: StreamActor) -> None:
            if name == "state" and not actor.elsewhere:
                self._later(self._state(actor), lambda state: _guarded(request, lambda: self._say(request, state)))
                return
            # Where several instances run, the one that tracks the stream answers.
            _guarded(request, lambda: None if actor.elsewhere else command(actor, request))

        # A stream can be set up ahead of its first frame, by a valid request.
        seeks = name == "parameters" and self._sets(request)
        taken = self._registry.command(stream, lambda actor: actor.ask(answer, seek=seeks), urgent=urgent)
        if not taken:
            full = schemas.MessageError("too_large", "key", "fewer new streams at once", "another one")
            _guarded(request, lambda: request.refuse(self._problem(stream, full)))

    def _sets(self, request: Request) -> bool:
        """Whether a request for parameters is valid and changes any."""
        try:
            asked = schemas.decode(
                request.payload or b"",
                schemas.SessionParameters,
                encoding=request.encoding,
                limits=self._registry.limits,
            )
        except schemas.MessageError:
            return False
        known = asked.profile is None or self._registry.profiles.named(asked.profile) is not None
        return known and asked != schemas.SessionParameters()

    def _answer_many(self, request: Request) -> None:
        """Answer a question about the state of all streams that a key expression includes; many answer nothing else."""
        actors = [
            actor for actor in self._registry.actors() if request.matches(self._keys.query(actor.stream, "state"))
        ]
        if not actors:
            request.finish()
            return
        left = _Countdown(len(actors), request.finish)
        for actor in actors:
            if not self._registry.command(actor.stream, self._one_of_many(request, left), urgent=True):
                left.one()

    def _one_of_many(self, request: Request, left: _Countdown) -> Callable[[StreamActor], None]:
        def command(actor: StreamActor) -> None:
            def say(state: schemas.SessionState) -> None:
                try:
                    self._say(request, state)
                except TransportError as error:
                    log.warning("reply_failed", key=request.key, error=str(error))
                finally:
                    left.one()

            self._later(self._state(actor), say)

        return command

    def _say(self, request: Request, state: schemas.SessionState) -> None:
        request.answer(self._keys.query(state.stream, "state"), state)

    def _later(
        self, state: tuple[schemas.SessionState, Checkpoint | None], then: Callable[[schemas.SessionState], None]
    ) -> None:
        """Go on with a state that has its digest, on the thread that makes digests: it encodes a whole checkpoint."""

        def work() -> None:
            said, checkpoint = state
            then(said if checkpoint is None else said.model_copy(update={"digest": digest_of(checkpoint)}))

        self._digests.submit(work)

    # Run by the tracking thread

    def _state(self, actor: StreamActor) -> tuple[schemas.SessionState, Checkpoint | None]:
        state = actor.state()
        if state is None or actor.session is None:
            return self._nothing(actor.stream, "new"), None
        return state, actor.session.snapshot()

    def _density(self, actor: StreamActor, request: Request) -> None:
        session = actor.session
        parameters = session.parameters if session else self._registry.profiles.of(actor.stream)
        message = density_of(
            session.density if session else optipmb.Density.empty(parameters.labels),
            stream=actor.stream,
            session=session.session if session else NO_SESSION,
            parameters=parameters,
        )
        request.answer(self._keys.query(actor.stream, "density"), message)

    def _reset(self, actor: StreamActor, request: Request) -> None:
        asked = self._payload(actor, request, schemas.ResetRequest, schemas.ResetRequest())
        if asked is None:
            return
        session = actor.session
        state = self._nothing(actor.stream, "closed" if asked.close else "new")
        if session is not None and asked.close:
            actor.close_session("query")
            state = session.state(closed=True)
        elif session is not None:
            actor.deliver(session.reset())
            state, checkpoint = self._state(actor)
            if checkpoint is not None:
                state = state.model_copy(update={"digest": digest_of(checkpoint)})
        request.answer(self._keys.query(actor.stream, "reset"), state)

    def _parameters(self, actor: StreamActor, request: Request) -> None:
        empty = schemas.SessionParameters()
        asked = self._payload(actor, request, schemas.SessionParameters, empty)
        if asked is None:
            return
        parameters = None
        if asked.profile is not None:
            parameters = self._registry.profiles.named(asked.profile)
            if parameters is None:
                expected = f"one of {', '.join(self._registry.profiles.names)}"
                error = schemas.MessageError("invalid_value", "profile", expected, repr(asked.profile))
                request.refuse(self._problem(actor.stream, error))
                return
        if asked != empty and actor.session is None:
            full = schemas.MessageError(
                "too_large", "stream", "a stream that is tracked already", "no room for another"
            )
            request.refuse(self._problem(actor.stream, full, code="refused"))
            return
        session = actor.session
        if session is not None and asked != empty:
            try:
                horizons = None if asked.horizons is None else asked.horizons.tolist()
                actor.deliver(session.configure(parameters, asked.cloud_wait_s, horizons, restart=asked.restart))
            except RefusedError as error:
                refusal = schemas.MessageError("invalid_value", error.path, error.expected, error.received)
                request.refuse(self._problem(actor.stream, refusal, code="refused"))
                return
        request.answer(self._keys.query(actor.stream, "parameters"), self._in_force(actor))

    def _in_force(self, actor: StreamActor) -> schemas.SessionParameters:
        session = actor.session
        parameters: optipmb.Parameters = session.parameters if session else self._registry.profiles.of(actor.stream)
        return schemas.SessionParameters(
            profile=parameters.name,
            cloud_wait_s=session.cloud_wait_s if session else self._registry.cloud_wait_s,
            horizons=np.array(parameters.horizons, np.float64),
            values=parameters.model_dump(mode="json"),
        )

    def _nothing(self, stream: str, state: Literal["new", "closed"]) -> schemas.SessionState:
        """Return the state of a stream that has no session."""
        return schemas.SessionState(
            stream=stream, session=NO_SESSION, state=state, profile=self._registry.profiles.of(stream).name
        )

    def _payload(self, actor: StreamActor, request: Request, expected: type[_T], empty: _T) -> _T | None:
        """Return what was sent along, `empty` when nothing was, None after a refusal."""
        if not request.payload:
            return empty
        try:
            return schemas.decode(request.payload, expected, encoding=request.encoding, limits=self._registry.limits)
        except schemas.MessageError as error:
            request.refuse(self._problem(actor.stream, error))
            return None

    def _problem(self, stream: str, error: schemas.MessageError, *, code: str = "") -> schemas.Problem:
        return problem_of(
            code or error.code,
            stream=stream,
            instance=self._registry.instance,
            path=error.path,
            expected=error.expected,
            received=error.received,
            message=f"Query: {error.path or 'payload'}: expected {error.expected}, received {error.received}.",
        )


def move_asked(request: Request, limits: schemas.Limits, workers: int) -> schemas.MoveRequest:
    """Return what a request to move a stream says.

    Raises:
        MessageError: it is none, or there is no such worker.
    """
    asked = schemas.decode(request.payload or b"", schemas.MoveRequest, encoding=request.encoding, limits=limits)
    if asked.worker >= workers:
        raise schemas.MessageError("invalid_value", "worker", f"a worker from 0 to {workers - 1}", str(asked.worker))
    return asked


def drain_asked(request: Request, limits: schemas.Limits) -> schemas.DrainRequest:
    """Return what a request to leave all streams says.

    Raises:
        MessageError: it is none.
    """
    if not request.payload:
        return schemas.DrainRequest()
    return schemas.decode(request.payload, schemas.DrainRequest, encoding=request.encoding, limits=limits)


def members_of(leases: Sequence[MemberLease]) -> tuple[schemas.MemberSummary, ...]:
    """Return the lines of the members in the status."""
    return tuple(
        schemas.MemberSummary(
            member=one.member,
            state=one.state,
            age_s=one.age_ns / 1e9,
            partitions=tuple(one.fences),
            fences=tuple(one.fences.values()),
        )
        for one in leases
    )


class _Countdown:
    """Calls `last` when `one` has been called so many times, by any threads."""

    def __init__(self, count: int, last: Callable[[], None]) -> None:
        self._lock = threading.Lock()
        self._left = count
        self._last = last

    def one(self) -> None:
        with self._lock:
            self._left -= 1
            done = self._left == 0
        if done:
            self._last()


def _guarded(request: Request, answer: Callable[[], None]) -> None:
    """Answer, and finish the request whatever happens: an asker must not wait for its timeout."""
    began_ns = time.monotonic_ns()
    try:
        answer()
    except TransportError as error:
        log.warning("reply_failed", key=request.key, error=str(error))
    finally:
        request.finish()
        log.debug("query", key=request.key, took_ms=(time.monotonic_ns() - began_ns) / 1e6)

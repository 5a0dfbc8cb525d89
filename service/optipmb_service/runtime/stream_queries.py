"""Answers to queries about streams: the state and density of sessions, resets, parameters, tracks of the past.

What concerns a session is run by the actor of its stream, so that nothing else happens to it meanwhile: a question
about the state or the density goes before the frames that wait, a reset or a change of parameters takes its turn among
them. The query thread itself only sorts. An error is a reply too: a `Problem`, as an error reply.
"""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, Literal, TypeAlias, TypeVar

import numpy as np
import optipmb_schemas as schemas
import structlog

import optipmb
from optipmb_service.runtime.ports import TransportError
from optipmb_service.runtime.requests import guarded, problem_with
from optipmb_service.session.checkpoint import digest_of
from optipmb_service.session.convert import density_of
from optipmb_service.session.values import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from optipmb_service.runtime.ports import Request
    from optipmb_service.runtime.registry import Registry
    from optipmb_service.runtime.stream_actor import StreamActor
    from optipmb_service.runtime.track_query import TrackQuery
    from optipmb_service.session.checkpoint import Checkpoint

log = structlog.get_logger("optipmb_service")

MOST_WILDCARDS: Final = 4
"""Queries with wildcards that may be open at once: each has a checkpoint of every stream that it matches."""

NO_SESSION = "0" * 32
"""Session id in the state of a stream that has none."""

_T = TypeVar("_T", bound=schemas.Message)
_State: TypeAlias = "tuple[schemas.SessionState, Checkpoint | None]"
"""The state of a session, and what its digest is made of."""
_Command: TypeAlias = "Callable[[StreamActor, Request], _State | None]"
"""Answers a request, or returns the state that is to be answered."""


class StreamQueries:
    """Answers every request about streams, and finishes it whatever happens.

    Args:
        registry: the streams.
        tracks: answers queries for tracks.
    """

    def __init__(self, registry: Registry, tracks: TrackQuery) -> None:
        self._registry = registry
        self._tracks = tracks
        self._keys = registry.keys
        self._digests = ThreadPoolExecutor(1, "digest")
        self._room_for_wildcards = threading.Semaphore(MOST_WILDCARDS)

    def answer(self, request: Request) -> None:
        """Answer what concerns sessions, here or by the actor of the stream."""
        name = request.key.rpartition("/")[2]
        if "*" in request.key:
            self._answer_many(request)
            return
        stream = request.key.removeprefix(f"{self._keys.prefix}/").removesuffix(f"/q/{name}")
        try:
            self._keys.tracks(stream)
        except schemas.MessageError as error:
            nowhere = self._problem("", error)
            guarded(request, lambda: request.refuse(nowhere))
            return
        session = self._registry.fusion.session_of(stream)
        if self._registry.elsewhere(session):
            request.finish()  # another instance tracks the stream, and answers
            return
        if session != stream:
            shared = schemas.MessageError("invalid_value", "key", f"{session}, the session that it shares", stream)
            guarded(request, lambda: request.refuse(self._problem(stream, shared)))
            return
        if name == "tracks":
            self._tracks.answer(request, stream)
            return
        commands: dict[str, tuple[_Command, bool]] = {
            "state": (lambda actor, _: self._state(actor), True),
            "density": (self._density, True),
            "reset": (self._reset, False),
            "parameters": (self._parameters, False),
        }
        if name not in commands:
            unknown = schemas.MessageError(
                "invalid_value", "key", f"one of q/{', q/'.join((*commands, 'tracks'))}", f"q/{name}"
            )
            guarded(request, lambda: request.refuse(self._problem(stream, unknown)))
            return
        command, urgent = commands[name]

        def answer(actor: StreamActor) -> None:
            guarded(request, lambda: self._run(command, actor, request))

        # A stream can be set up ahead of its first frame, by a valid request.
        creates = name == "parameters" and self._sets(request)
        if not self._registry.command(stream, lambda actor: actor.ask(answer, create=creates), urgent=urgent):
            full = schemas.MessageError("too_large", "key", "fewer new streams at once", "another one")
            guarded(request, lambda: request.refuse(self._problem(stream, full)))

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
        if not self._room_for_wildcards.acquire(blocking=False):
            full = schemas.MessageError(
                "too_large", "key", f"at most {MOST_WILDCARDS} queries about many streams open at once", "another one"
            )
            guarded(request, lambda: request.refuse(self._problem("", full, code="refused")))
            return

        def finish() -> None:
            self._room_for_wildcards.release()
            request.finish()

        left = _Countdown(len(actors), finish)
        for actor in actors:
            if not self._registry.command(actor.stream, self._one_of_many(request, left), urgent=True):
                left.one()

    def _one_of_many(self, request: Request, left: _Countdown) -> Callable[[StreamActor], None]:
        def tell(state: _State) -> None:
            try:
                self._tell(request, state, self._keys.query(state[0].stream, "state"))
            except TransportError as error:
                log.warning("reply_failed", key=request.key, error=str(error))
            finally:
                left.one()

        def command(actor: StreamActor) -> None:
            try:
                state = self._state(actor)
            except Exception:
                left.one()
                raise
            self._digests.submit(tell, state)

        return command

    def _tell(self, request: Request, state: _State, key: str) -> None:
        """Answer with a state and its digest, on the thread that makes digests: it encodes a whole checkpoint."""
        said, checkpoint = state
        if checkpoint is not None:
            try:
                said = said.model_copy(update={"digest": digest_of(checkpoint)})
            except Exception:
                log.exception("internal_error", stream=said.stream)
                raise
        request.answer(key, said)

    # Run by the tracking thread

    def _run(self, command: _Command, actor: StreamActor, request: Request) -> Future[None] | None:
        """Carry out a command; a state is answered by another thread, which makes its digest first."""
        # Where several instances run, the one that tracks the stream answers.
        state = None if actor.elsewhere else command(actor, request)
        if state is None:
            return None
        return self._digests.submit(guarded, request, lambda: self._tell(request, state, request.key))

    def _state(self, actor: StreamActor) -> _State:
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

    def _reset(self, actor: StreamActor, request: Request) -> _State | None:
        asked = self._payload(actor, request, schemas.ResetRequest, schemas.ResetRequest())
        if asked is None:
            return None
        session = actor.session
        if session is not None and asked.close:
            actor.close_session("query")
            return session.state(closed=True), None
        if session is not None:
            actor.deliver(session.reset())
            return self._state(actor)
        return self._nothing(actor.stream, "closed" if asked.close else "new"), None

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
            session=session.session if session else None,
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
        return problem_with(error, instance=self._registry.instance, stream=stream, code=code)


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

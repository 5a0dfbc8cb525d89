"""Answers to queries about streams and about the service. An error is a reply too: a `Problem`, as an error reply.

What concerns a session is run by its stream, so that nothing else happens to it meanwhile: a question about the state
or the density goes before the frames that wait, a reset or a change of parameters takes its turn among them. The query
thread itself only sorts.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, TypeAlias, TypeVar

import numpy as np
import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError

import optipmb
from optipmb_service.cluster.store import StoreError
from optipmb_service.session.checkpoint import digest_of
from optipmb_service.session.convert import density_of
from optipmb_service.session.outputs import CommandRefusedError
from optipmb_service.session.problems import problem_of
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from concurrent.futures import Future

    from optipmb_client.zenoh.handles import Query

    from optipmb_service.cluster.leases import MemberLease
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.streams.kept_tracks import TrackQuery
    from optipmb_service.streams.stream import Stream
    from optipmb_service.streams.streams import Streams
    from optipmb_service.zenoh.topics import Packet

log = structlog.get_logger("optipmb_service")

TEXT = "text/plain;version=0.0.4"
"""Zenoh encoding of the metrics."""

MOVE_S = 15.0
"""Longest time for moving a stream; it takes a second."""

UNDRAINED = "not all taken in time; it goes on draining until that is undone"
"""Reason of a drain that is not confirmed."""

MOVES = 16
"""Moves that wait for each other."""

MOST_WILDCARDS: Final = 4
"""Queries with wildcards that may be open at once: each has a checkpoint of every stream that it matches."""

NO_SESSION = "0" * 32
"""Session id in the state of a stream that has none."""

_T = TypeVar("_T", bound=schemas.Message)
_State: TypeAlias = "tuple[schemas.SessionState, Checkpoint | None]"
"""The state of a session, and what its digest is made of."""
_Command: TypeAlias = "Callable[[Stream, Query], _State | None]"
"""Answers a request, or returns the state that is to be answered."""


def guarded(request: Query, answer: Callable[[], Future[None] | None], *, instance: str = "", stream: str = "") -> None:
    """Answer, and finish the request in any case: an asker must not wait for its timeout.

    Args:
        request: the query.
        answer: answers it, or returns what will do so, and finish it, on another thread. A `MessageError` or
            `CommandRefusedError` that it raises is the answer.
        instance: name of the service, for problems.
        stream: whose problem it is.
    """
    began_ns, later = time.monotonic_ns(), None
    try:
        try:
            later = answer()
        except schemas.MessageError as error:
            request.refuse(problem_with(error, instance=instance, stream=stream))
        except CommandRefusedError as error:
            refused = schemas.MessageError("invalid_value", error.path, error.expected, error.received)
            request.refuse(problem_with(refused, instance=instance, stream=stream, code="refused"))
    except TransportError as error:
        log.warning("reply_failed", key=request.key, error=str(error))
    finally:
        if later is None:
            request.finish()
        log.debug("query", key=request.key, took_ms=(time.monotonic_ns() - began_ns) / 1e6)


def problem_with(error: schemas.MessageError, *, instance: str, stream: str = "", code: str = "") -> schemas.Problem:
    """Return the answer to a query that is refused, by default with the code of its error."""
    texts = {"path": error.path, "expected": error.expected, "received": error.received}
    return problem_of(code or error.code, stream=stream, instance=instance, subject="Query", **texts)


class StreamQueries:
    """Answers and finishes every request about streams.

    Args:
        streams: the streams.
        tracks: answers queries for tracks.
    """

    def __init__(self, streams: Streams, tracks: TrackQuery) -> None:
        self._streams = streams
        self._parts = streams.parts
        self._instance = streams.parts.settings.instance
        self._tracks = tracks
        self._keys = streams.parts.keys
        self._profiles = streams.parts.sessions.profiles
        self._digests = ThreadPoolExecutor(1, "digest")
        self._room_for_wildcards = threading.Semaphore(MOST_WILDCARDS)
        self._commands: dict[str, tuple[_Command, bool]] = {
            "state": (lambda one, _: self._state(one), True),
            "density": (self._density, True),
            "zones": (self._zones, True),
            "reset": (self._reset, False),
            "parameters": (self._parameters, False),
        }
        """Commands by name, each with whether it goes before the frames that wait."""

    def answer(self, request: Query) -> None:
        """Answer what concerns sessions, here or by the stream."""
        name = request.key.rpartition("/")[2]
        stream = request.key.removeprefix(f"{self._keys.prefix}/").removesuffix(f"/q/{name}")
        if "*" in request.key:
            self._answer_many(request)
            return
        try:
            self._keys.tracks(stream)
        except schemas.MessageError as error:
            self._refuse(request, error)
            return
        session = self._parts.fusion.session_of(stream)
        try:
            if self._streams.elsewhere(session):
                request.finish()  # another instance tracks the stream, and answers
            elif name == "tracks" and session == stream:
                self._tracks.answer(request, stream)
            else:
                self._command(request, name, stream, session)
        except schemas.MessageError as error:
            self._refuse(request, error, stream)

    def _refuse(self, request: Query, error: Exception, stream: str = "") -> None:
        guarded(request, partial(_raise, error), instance=self._instance, stream=stream)

    def _command(self, request: Query, name: str, stream: str, session: str) -> None:
        """Have a stream answer.

        Raises:
            MessageError: there is no such query, or no room for the stream.
        """
        if session != stream:
            raise schemas.MessageError("invalid_value", "key", f"{session}, the session that it shares", stream)
        if name not in self._commands:
            expected = f"one of q/{', q/'.join((*self._commands, 'tracks'))}"
            raise schemas.MessageError("invalid_value", "key", expected, f"q/{name}")
        command, urgent = self._commands[name]

        def answer(one: Stream) -> None:
            guarded(request, lambda: self._run(command, one, request), instance=self._instance, stream=stream)

        # A stream can be set up ahead of its first frame, by a valid request.
        creates = name == "parameters" and self._sets(request)
        if not self._streams.command(stream, lambda one: one.ask(answer, create=creates), urgent=urgent):
            raise schemas.MessageError("too_large", "key", "fewer new streams at once", "another one")

    def _sets(self, request: Query) -> bool:
        """Whether a request for parameters is valid and changes any."""
        try:
            asked = self._payload(request, schemas.SessionParameters())
        except schemas.MessageError:
            return False
        known = asked.profile is None or asked.profile in self._profiles.known
        return known and asked != schemas.SessionParameters()

    def _answer_many(self, request: Query) -> None:
        """Answer a question about the state of all streams that a key expression includes; many answer nothing else."""
        streams = [one for one in self._streams.tracking() if request.matches(self._keys.query(one.name, "state"))]
        if not streams:
            request.finish()
            return
        if not self._room_for_wildcards.acquire(blocking=False):
            full = CommandRefusedError(
                "key", f"at most {MOST_WILDCARDS} queries about many streams open at once", "another one"
            )
            guarded(request, partial(_raise, full), instance=self._instance)
            return

        def finish() -> None:
            self._room_for_wildcards.release()
            request.finish()

        left = _Countdown(len(streams), finish)
        for stream in streams:
            if not self._streams.command(stream.name, self._one_of_many(request, left), urgent=True):
                left.one()

    def _one_of_many(self, request: Query, left: _Countdown) -> Callable[[Stream], None]:
        def tell(state: _State) -> None:
            try:
                self._tell(request, state, self._keys.query(state[0].stream, "state"))
            except TransportError as error:
                log.warning("reply_failed", key=request.key, error=str(error))
            finally:
                left.one()

        def command(stream: Stream) -> None:
            try:
                state = self._state(stream)
            except Exception:
                left.one()
                raise
            self._digests.submit(tell, state)

        return command

    def _tell(self, request: Query, state: _State, key: str) -> None:
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

    def _run(self, command: _Command, stream: Stream, request: Query) -> Future[None] | None:
        """Carry out a command; a state is answered by another thread, which makes its digest first."""
        # Where several instances run, the one that tracks the stream answers.
        state = None if self._streams.elsewhere(stream.name) else command(stream, request)
        if state is None:
            return None
        return self._digests.submit(guarded, request, lambda: self._tell(request, state, request.key))

    def _state(self, stream: Stream) -> _State:
        if (session := stream.session) is None:
            return self._nothing(stream.name, "new"), None
        return stream.counts.state(session), session.snapshot()

    def _density(self, stream: Stream, request: Query) -> None:
        session = stream.session
        parameters = session.parameters if session else self._profiles.of(stream.name)
        message = density_of(
            session.density if session else optipmb.Density.empty(parameters.labels),
            stream=stream.name,
            session=session.session if session else NO_SESSION,
            parameters=parameters,
        )
        request.answer(self._keys.query(stream.name, "density"), message)

    def _zones(self, stream: Stream, request: Query) -> None:
        counts = stream.session.zone_counts() if stream.session else None
        if counts is None:
            raise schemas.MessageError("invalid_value", "key", "a stream with zones and frames", repr(stream.name))
        request.answer(self._keys.query(stream.name, "zones"), counts)

    def _reset(self, stream: Stream, request: Query) -> _State:
        asked = self._payload(request, schemas.ResetRequest())
        session = stream.session
        if session is None:
            return self._nothing(stream.name, "closed" if asked.close else "new"), None
        if asked.close:
            stream.close_session("query")
            return session.state(closed=True), None
        stream.deliver(session.reset())
        return self._state(stream)

    def _parameters(self, stream: Stream, request: Query) -> None:
        empty = schemas.SessionParameters()
        asked = self._payload(request, empty)
        parameters = None if asked.profile is None else self._profiles.named(asked.profile, stream.name)
        if asked.profile is not None and parameters is None:
            expected = f"one of {', '.join(self._profiles.names)}"
            raise schemas.MessageError("invalid_value", "profile", expected, repr(asked.profile))
        if asked != empty:
            if stream.session is None:
                raise CommandRefusedError("stream", "a stream that is tracked already", "no room for another")
            horizons = None if asked.horizons is None else asked.horizons.tolist()
            stream.deliver(stream.session.configure(parameters, asked.cloud_wait_s, horizons, restart=asked.restart))
        request.answer(self._keys.query(stream.name, "parameters"), self._in_force(stream))

    def _in_force(self, stream: Stream) -> schemas.SessionParameters:
        session = stream.session
        parameters: optipmb.Parameters = session.parameters if session else self._profiles.of(stream.name)
        return schemas.SessionParameters(
            profile=parameters.name,
            cloud_wait_s=session.cloud_wait_s if session else stream.policy.cloud_wait_ns / SECOND,
            horizons=np.array(parameters.horizons, np.float64),
            values=parameters.model_dump(mode="json"),
            sensors=stream.policy.sensors.shown() or None,
            session=session.session if session else None,
        )

    def _nothing(self, stream: str, state: Literal["new", "closed"]) -> schemas.SessionState:
        profile = self._profiles.of(stream).name
        return schemas.SessionState(stream=stream, session=NO_SESSION, state=state, profile=profile)

    def _payload(self, request: Query, empty: _T) -> _T:
        """Return the payload of a request, `empty` without one.

        Raises:
            MessageError: it is not valid.
        """
        if not request.payload:
            return empty
        return schemas.decode(request.payload, type(empty), encoding=request.encoding, limits=self._parts.limits)


def _raise(error: Exception) -> None:
    raise error


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


class ServiceQueries:
    """Answers and finishes every request about the service.

    Args:
        streams: the streams.
        status: returns the status of the service.
        metrics: returns its metrics, in Prometheus' text format.
        hand_over: gives recent messages of sessions that are tracked elsewhere now.
        workers: number of processes of the service.
    """

    def __init__(
        self,
        streams: Streams,
        *,
        status: Callable[[], schemas.ServiceStatus],
        metrics: Callable[[], bytes],
        hand_over: Callable[[Iterable[str], Callable[[Packet], None]], None],
        workers: int,
    ) -> None:
        self._streams = streams
        self._parts = streams.parts
        self._instance = streams.parts.settings.instance
        self._keys = streams.parts.keys
        self._member = streams.parts.member
        self._status = status
        self._metrics = metrics
        self._handed_over = hand_over
        self._workers = workers
        self._moves = ThreadPoolExecutor(1, "move")
        self._moving = threading.BoundedSemaphore(MOVES)
        self._handovers = ThreadPoolExecutor(1, "recent")

    def answer(self, request: Query) -> None:
        """Answer with the status of the service, its metrics, or both when the key has a `*`; or have streams moved."""
        instance = self._instance
        orders = {self._keys.move(instance): self._move, self._keys.drain(instance): self._drain}
        if request.key == self._keys.recent():
            self._handovers.submit(guarded, request, lambda: self._hand_over(request))
        elif request.key not in orders:
            guarded(request, lambda: self._report(request))
        elif self._moving.acquire(blocking=False):
            self._moves.submit(self._order, request, orders[request.key])
        else:
            many = schemas.MessageError("invalid_value", "worker", f"at most {MOVES} moves at a time", "more")
            guarded(request, partial(_raise, many), instance=instance)

    def _report(self, request: Query) -> None:
        instance = self._instance
        status, metrics = self._keys.status(instance), self._keys.metrics(instance)
        if request.matches(status):
            request.answer(status, self._status())
        if request.matches(metrics):
            request.answer_text(metrics, self._metrics(), TEXT)

    def _hand_over(self, request: Query) -> None:
        """Answer with recent messages of sessions, whose names are lines, to the member that tracks them."""
        key = self._keys.recent(self._instance)

        def give(packet: Packet) -> None:
            about = f"{packet.key}\n{packet.traceparent}" if packet.traceparent else packet.key
            request.answer_text(key, packet.payload or b"", packet.encoding, about=about)

        self._handed_over((request.payload or b"").decode("ascii", "replace").splitlines(), give)

    def _order(self, request: Query, order: Callable[[Query], None]) -> None:
        try:
            guarded(request, lambda: order(request), instance=self._instance)
        finally:
            self._moving.release()

    def _move(self, request: Query) -> None:
        """Have a stream brought here, and say so."""
        asked = move_asked(request, self._parts.limits, self._workers)
        try:
            brought = self._member.bring(self._parts.fusion.session_of(asked.stream), MOVE_S)
            received = "" if brought else "none in time"
        except StoreError as error:
            received = str(error)
        if received:
            failed = schemas.MessageError("invalid_value", "worker", "a worker to which the stream comes", received)
            request.refuse(problem_with(failed, instance=self._instance, stream=asked.stream))
        else:
            request.answer(request.key, asked)

    def _drain(self, request: Query) -> None:
        """Have all streams taken by others, and say so."""
        asked = drain_asked(request, self._parts.limits)
        received = "none" if asked.drain and not self._member.others else ""
        if not received:
            self._member.drain(drains=asked.drain)
            if asked.drain and not self._member.drained(MOVE_S):
                received = UNDRAINED
        if received:
            raise schemas.MessageError("invalid_value", "drain", "another member that takes the streams", received)
        request.answer(request.key, asked)


def move_asked(request: Query, limits: schemas.Limits, workers: int) -> schemas.MoveRequest:
    """Return what a request to move a stream says.

    Raises:
        MessageError: it is none, or there is no such worker.
    """
    asked = schemas.decode(request.payload or b"", schemas.MoveRequest, encoding=request.encoding, limits=limits)
    if asked.worker >= workers:
        raise schemas.MessageError("invalid_value", "worker", f"a worker from 0 to {workers - 1}", str(asked.worker))
    return asked


def drain_asked(request: Query, limits: schemas.Limits) -> schemas.DrainRequest:
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

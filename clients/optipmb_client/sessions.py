"""Asking the service: parameters, reset, state and kept tracks of a stream's session, and the services themselves."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from optipmb_schemas import (
    PREFIX,
    DrainRequest,
    Keys,
    Links,
    Message,
    MessageError,
    MoveRequest,
    Problem,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    Tracks,
    TracksRequest,
    decode,
    encode,
    encoding_of,
)

from optipmb_client.errors import ServiceRefused, ServiceUnavailable, UsageError
from optipmb_client.incoming import Answer
from optipmb_client.links import Link
from optipmb_client.zenoh import Connection

__all__ = [
    "close_session",
    "drain_service",
    "find_services",
    "kept_tracks",
    "linked_objects",
    "links_of",
    "move_stream",
    "only_service",
    "session_state",
    "set_parameters",
]

QUERY_S = 2.0
MOVE_S = 25.0
TRACKS_S = 15.0
"""Longest wait for kept tracks: a service reads its log for up to 3 s, and several queries in turn."""
RETRY_S = 0.1

_Answer = TypeVar("_Answer", bound=Message)


def set_parameters(
    connection: Link,
    stream: str,
    parameters: SessionParameters,
    *,
    prefix: str = PREFIX,
    patience_s: float = 10.0,
    stop: threading.Event | None = None,
) -> SessionParameters:
    """Set the parameters of a stream's session, which starts it; return those in force.

    Raises:
        ServiceUnavailable: No service answered within `patience_s` seconds, or before `stop` was set.
        ServiceRefused: A service answered that it will not; the text says why.
    """
    deadline = time.monotonic() + patience_s
    while (
        in_force := _ask(connection, Keys(prefix).query(stream, "parameters"), SessionParameters, parameters)
    ) is None:
        if time.monotonic() >= deadline or (stop is not None and stop.is_set()):
            raise ServiceUnavailable(
                f"no tracking service answered for {patience_s:g} s; is optipmb-service running, with the same prefix?"
            )
        time.sleep(RETRY_S)
    return in_force


def close_session(connection: Link, stream: str, *, prefix: str = PREFIX) -> SessionState | None:
    """End the session of a stream and free its memory; None when no service answers, or it says no."""
    try:
        return _ask(connection, Keys(prefix).query(stream, "reset"), SessionState, ResetRequest(close=True))
    except ServiceRefused:
        return None


def session_state(connection: Link, stream: str, *, prefix: str = PREFIX) -> SessionState | None:
    """Return the state of a stream's session; None when no service answers, or it has none."""
    try:
        return _ask(connection, Keys(prefix).query(stream, "state"), SessionState)
    except ServiceRefused:
        return None


def linked_objects(connection: Link, area: str, *, prefix: str = PREFIX) -> dict[tuple[str, str, int], bytes]:
    """Return the common id of each linked object of an area, by stream, session and object or track.

    Raises:
        MessageError: The area is no name.
        ServiceUnavailable: No `optipmb-service link` answers for the area.
    """
    found = links_of(connection, area, prefix=prefix)
    return {(one.stream, one.session, one.object): one.global_id for one in found.objects}


def links_of(connection: Link, area: str, *, prefix: str = PREFIX) -> Links:
    """Return all linked objects of an area. Raises as `linked_objects` does."""
    found = _ask(connection, Keys(prefix).links_query(area), Links)
    if found is None:
        raise ServiceUnavailable(f"no optipmb-service link answers for the area {area} (prefix {prefix})")
    return found


def kept_tracks(
    connection: Connection, stream: str, from_ns: int = 0, to_ns: int | None = None, *, prefix: str = PREFIX
) -> Iterator[Tracks]:
    """Yield the tracks of a stream in a range of stamps, by stamp, each frame once, as far as they are kept.

    The service keeps the last 100 messages of a stream; with `--cluster` and `optipmb-service log` all of an hour, or
    of the time in the setting `log_tracks_s`. The range is asked for part by part, as the iterator goes on.

    Args:
        connection: Where to ask.
        stream: Name of the stream, `site/node/sensor`.
        from_ns: First stamp, of the sensor's clock.
        to_ns: Last stamp; None: up to the newest frame.
        prefix: First part of all keys, as configured in the service.

    Raises:
        MessageError: The name or a stamp is not valid.
        ServiceUnavailable: No service answers completely in time.
        ServiceRefused: The service answers that it cannot; the text says why.
    """
    key = Keys(prefix).query(stream, "tracks")
    next_ns: int | None = from_ns
    while next_ns is not None:
        request = TracksRequest(from_ns=next_ns, to_ns=to_ns)
        answers = connection.query(key, encode(request), encoding_of(request), timeout=TRACKS_S)
        if not answers:
            raise ServiceUnavailable(f"no tracking service answered for {stream} in {TRACKS_S:g} s (prefix {prefix})")
        tracks = [one for one in answers if one.ok and one.encoding != encoding_of(request)]
        refusals = [one for one in answers if not one.ok]
        if not refusals and len(tracks) == len(answers):
            raise ServiceUnavailable(f"the tracks of {stream} did not come completely in {TRACKS_S:g} s; ask again")
        yield from (decode(one.payload, Tracks, encoding=one.encoding) for one in tracks)
        next_ns = _rest(next_ns, refusals[0]) if refusals else None


def move_stream(connection: Connection, instance: str, stream: str, worker: int, *, prefix: str = PREFIX) -> None:
    """Give a stream to another worker process of an instance.

    Raises:
        MessageError: The stream's name is none.
        ServiceUnavailable: No such instance.
        ServiceRefused: It has no such worker, or the move was not done in time.
    """
    _order(connection, Keys(prefix).move(instance), MoveRequest(stream=stream, worker=worker), instance)


def drain_service(
    connection: Connection,
    member: str,
    *,
    drains: bool = True,
    prefix: str = PREFIX,
    patience_s: float = 0.0,
    on_wait: Callable[[ServiceStatus], None] = lambda _: None,
) -> None:
    """Have a service, or a worker of one, give all its streams to others; with `drains` false, take a share again.

    Args:
        connection: Where to ask.
        member: Name of the service or worker.
        drains: Whether to give the streams away.
        prefix: First part of all keys.
        patience_s: How long to ask again while it still holds streams.
        on_wait: Is called with its status each time before it is asked again.

    Raises:
        ServiceUnavailable: No such service.
        ServiceRefused: There is no other one, or it did not take all streams in time.
    """
    keys = Keys(prefix)
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return _order(connection, keys.drain(member), DrainRequest(drain=drains), member)
        except ServiceRefused:
            status = _ask(connection, keys.status(member), ServiceStatus)
            if status is None or status.state != "draining" or time.monotonic() >= deadline:
                raise
            on_wait(status)
            time.sleep(RETRY_S)


def _order(connection: Connection, key: str, request: Message, instance: str) -> None:
    if _ask(connection, key, type(request), request, timeout=MOVE_S) is None:
        raise ServiceUnavailable(f"no service {instance} answers")


def find_services(
    connection: Connection,
    *,
    prefix: str = PREFIX,
    patience_s: float = 1.0,
    on_silent: Callable[[str], None] = lambda _: None,
) -> list[ServiceStatus]:
    """Return the status of every service that is alive, by instance.

    Args:
        connection: Where to ask.
        prefix: First part of all keys.
        patience_s: Time to wait for a first service, and for the answers of all.
        on_silent: Is called with the instance of each service that is alive and has not answered, or with an error.
    """
    keys = Keys(prefix)
    deadline = time.monotonic() + patience_s
    while True:
        instances = [key.rsplit("/", 2)[1] for key in connection.alive(keys.all_alive())]
        found = [_status(connection, keys.status(instance)) for instance in instances]
        if (found and None not in found) or time.monotonic() >= deadline:
            break
        time.sleep(RETRY_S)
    for instance, status in zip(instances, found, strict=True):
        if status is None:
            on_silent(instance)
    return [status for status in found if status is not None]


def _status(connection: Connection, key: str) -> ServiceStatus | None:
    """Return the answer of a service; None where it has none, or one that is no status: others may have theirs."""
    with contextlib.suppress(ServiceRefused, MessageError):
        return _ask(connection, key, ServiceStatus)
    return None


def only_service(connection: Connection, option: str, *, prefix: str = PREFIX) -> str:
    """Return the name of the one service that is alive.

    Raises:
        ServiceUnavailable: There is none.
        UsageError: There are several; says which, and the option that names one.
    """
    names: list[str] = []
    names += [found.instance for found in find_services(connection, prefix=prefix, on_silent=names.append)]
    if not names:
        raise ServiceUnavailable(f"no tracking service is alive at {connection.where} (prefix {prefix})")
    if len(names) > 1:
        raise UsageError(f"{option}: one of {', '.join(sorted(names))}")
    return names[0]


def _ask(
    connection: Link, key: str, expected: type[_Answer], request: Message | None = None, *, timeout: float = QUERY_S
) -> _Answer | None:
    """Ask at a key and return the first good answer; None without an answer.

    Raises:
        ServiceRefused: All answers are errors; says what the first one was.
    """
    payload, encoding = (b"", "") if request is None else (encode(request), encoding_of(request))
    answers = connection.query(key, payload, encoding, timeout=timeout)
    for answer in answers:
        if answer.ok:
            return decode(answer.payload, expected, encoding=answer.encoding)
    if not answers:
        return None
    raise ServiceRefused(f"the service refused: {_reason(answers[0])}")


def _reason(refusal: Answer) -> str:
    try:
        return decode(refusal.payload, Problem, encoding=refusal.encoding).message
    except MessageError:
        return refusal.payload[:200].decode(errors="replace")


def _rest(asked_ns: int, refusal: Answer) -> int:
    """Return the stamp at which the rest of kept tracks begins.

    Raises:
        ServiceRefused: There is no rest, but another problem.
    """
    problem = decode(refusal.payload, Problem)
    if problem.code != "cut" or problem.stamp_ns is None or problem.stamp_ns <= asked_ns:
        raise ServiceRefused(f"the service refused: {problem.message}")
    return problem.stamp_ns

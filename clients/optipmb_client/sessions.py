"""Asking the service: parameters, reset and state of a stream's session, and the status of the services themselves."""

import time
from typing import TypeVar

from optipmb_schemas import (
    PREFIX,
    DrainRequest,
    Keys,
    MessageError,
    MoveRequest,
    Problem,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
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
    "move_stream",
    "only_service",
    "session_state",
    "set_parameters",
]

QUERY_S = 2.0
MOVE_S = 25.0
RETRY_S = 0.1

Message = TypeVar("Message", SessionParameters, SessionState, ServiceStatus, MoveRequest, DrainRequest)


def set_parameters(
    connection: Link,
    stream: str,
    parameters: SessionParameters,
    *,
    prefix: str = PREFIX,
    patience_s: float = 10.0,
) -> SessionParameters:
    """Set the parameters of a stream's session, which starts it; return those in force.

    Raises:
        ServiceUnavailable: No service answered within `patience_s` seconds.
        ServiceRefused: A service answered that it will not; the text says why.
    """
    key = Keys(prefix).query(stream, "parameters")
    deadline = time.monotonic() + patience_s
    while True:
        asked = connection.query(key, encode(parameters), encoding_of(SessionParameters), timeout=QUERY_S)
        if asked:
            return _read(asked, SessionParameters)
        if time.monotonic() >= deadline:
            raise ServiceUnavailable(
                f"no tracking service answered for {patience_s:g} s; is optipmb-service running, with the same prefix?"
            )
        time.sleep(RETRY_S)


def close_session(connection: Link, stream: str, *, prefix: str = PREFIX) -> SessionState | None:
    """End the session of a stream and free what it holds; None when no service answers, or it says no."""
    key = Keys(prefix).query(stream, "reset")
    asked = connection.query(key, encode(ResetRequest(close=True)), encoding_of(ResetRequest), timeout=QUERY_S)
    try:
        return _read(asked, SessionState) if asked else None
    except ServiceRefused:
        return None


def session_state(connection: Link, stream: str, *, prefix: str = PREFIX) -> SessionState | None:
    """Return the state of a stream's session; None when no service answers, or it has none."""
    asked = connection.query(Keys(prefix).query(stream, "state"), timeout=QUERY_S)
    try:
        return _read(asked, SessionState) if asked else None
    except ServiceRefused:
        return None


def move_stream(connection: Connection, instance: str, stream: str, worker: int, *, prefix: str = PREFIX) -> None:
    """Give a stream to another worker process of an instance.

    Raises:
        MessageError: The stream's name is none.
        ServiceUnavailable: No such instance.
        ServiceRefused: It has no such worker, or the move was not done in time.
    """
    request = MoveRequest(stream=stream, worker=worker)
    asked = connection.query(Keys(prefix).move(instance), encode(request), encoding_of(MoveRequest), timeout=MOVE_S)
    if not asked:
        raise ServiceUnavailable(f"no service {instance} answers")
    _read(asked, MoveRequest)


def drain_service(connection: Connection, member: str, *, drains: bool = True, prefix: str = PREFIX) -> None:
    """Have a service, or a worker of one, give all its streams to others; with `drains` false, take a share again.

    Raises:
        ServiceUnavailable: No such service.
        ServiceRefused: There is no other one, or it did not take all streams in time.
    """
    request = DrainRequest(drain=drains)
    asked = connection.query(Keys(prefix).drain(member), encode(request), encoding_of(DrainRequest), timeout=MOVE_S)
    if not asked:
        raise ServiceUnavailable(f"no service {member} answers")
    _read(asked, DrainRequest)


def find_services(connection: Connection, *, prefix: str = PREFIX, patience_s: float = 1.0) -> list[ServiceStatus]:
    """Return the status of every service that is alive, by instance; waits up to `patience_s` for a first one."""
    keys = Keys(prefix)
    deadline = time.monotonic() + patience_s
    while not (alive := connection.alive(keys.all_alive())):
        if time.monotonic() >= deadline:
            return []
        time.sleep(RETRY_S)
    instances = [key.rsplit("/", 2)[1] for key in alive]
    answers = [connection.query(keys.status(instance), timeout=QUERY_S) for instance in instances]
    return [_read(answer, ServiceStatus) for answer in answers if answer]


def only_service(connection: Connection, option: str, *, prefix: str = PREFIX) -> str:
    """Return the name of the one service that is alive.

    Raises:
        ServiceUnavailable: There is none.
        UsageError: There are several; says which, and the option that names one.
    """
    names = [found.instance for found in find_services(connection, prefix=prefix)]
    if not names:
        raise ServiceUnavailable(f"no tracking service is alive at {connection.where} (prefix {prefix})")
    if len(names) > 1:
        raise UsageError(f"{option}: one of {', '.join(names)}")
    return names[0]


def _read(answers: tuple[Answer, ...], expected: type[Message]) -> Message:
    """Return the first good answer.

    Raises:
        ServiceRefused: There is none; says what the first error was.
    """
    for answer in answers:
        if answer.ok:
            return decode(answer.payload, expected, encoding=answer.encoding)
    first = answers[0]
    try:
        reason = decode(first.payload, Problem, encoding=first.encoding).message
    except MessageError:
        reason = first.payload[:200].decode(errors="replace")
    raise ServiceRefused(f"the service refused: {reason}")

"""`GetState`, `Reset`, `SetParameters`, `ListStreams`: questions that the services answer by queries."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, TypeVar

import grpc
import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_service.grpc.status import EndCall, refused

if TYPE_CHECKING:
    from google.protobuf.message import Message as ProtoMessage

    from optipmb_service.grpc.calls import Call

QUERY_S: Final = 2.0
"""Longest wait for an answer; a caller's own deadline may be shorter."""

NOBODY: Final = "no tracking service answers"

T = TypeVar("T", bound=schemas.Message)


async def get_state(call: Call) -> None:
    """Ask for the state of a session."""
    asked = convert.parse(await call.first() or b"", pb.GetStateRequest)
    key = call.gateway.client.keys.query(asked.stream, "state")
    call.caller.may_read(asked.stream)
    state = await _asked(call, key, None, schemas.SessionState)
    await _answer(call, pb.GetStateResponse(state=convert.to_proto(state)))


async def reset(call: Call) -> None:
    """Start a session anew, or end it."""
    asked = convert.parse(await call.first() or b"", pb.ResetRequest)
    key = call.gateway.client.keys.query(asked.stream, "reset")
    call.caller.may_command(asked.stream)
    state = await _asked(call, key, schemas.ResetRequest(close=asked.close), schemas.SessionState)
    await _answer(call, pb.ResetResponse(state=convert.to_proto(state)))


async def set_parameters(call: Call) -> None:
    """Set parameters of a session, or ask for them."""
    asked = convert.parse(await call.first() or b"", pb.SetParametersRequest)
    key = call.gateway.client.keys.query(asked.stream, "parameters")
    call.caller.may_command(asked.stream)
    asked.parameters.ClearField("values")
    try:
        wanted = convert.from_proto(asked.parameters, schemas.SessionParameters)
    except schemas.MessageError as error:
        raise error.under("parameters") from None
    payload = None if wanted == schemas.SessionParameters() else wanted
    parameters = await _asked(call, key, payload, schemas.SessionParameters)
    await _answer(call, pb.SetParametersResponse(parameters=convert.to_proto(parameters)))


async def list_streams(call: Call) -> None:
    """Ask every service for its streams; workers, who answer too, are no services: their parent speaks for them."""
    asked = convert.parse(await call.first() or b"", pb.ListStreamsRequest)
    client, pattern = call.gateway.client, asked.pattern or call.caller.pattern
    client.keys.matching(pattern, "tracks")
    call.caller.may_read(pattern)
    answers, alive = await asyncio.gather(
        asyncio.to_thread(client.query, client.keys.all_status(), timeout=QUERY_S),
        asyncio.to_thread(client.alive, client.keys.all_alive(), timeout=QUERY_S),
    )
    services = {client.keys.instance_of(key) for key in alive}
    listed = []
    for answer in answers:
        if answer.ok:
            status = schemas.decode(answer.payload, schemas.ServiceStatus, encoding=answer.encoding)
            if status.instance in services:
                listed += [(status.instance, one) for one in status.sessions if _matches(one.stream, pattern)]
    listed.sort(key=lambda entry: (entry[1].stream, entry[0]))
    streams = [pb.ListedStream(instance=instance, session=convert.to_proto(one)) for instance, one in listed]
    await _answer(call, pb.ListStreamsResponse(streams=streams))


async def _asked(call: Call, key: str, message: schemas.Message | None, kind: type[T]) -> T:
    """Return the first good answer.

    Raises:
        EndCall: nobody answers, or a service refuses.
    """
    payload = b"" if message is None else schemas.encode(message)
    encoding = "" if message is None else schemas.encoding_of(message)
    answers = await asyncio.to_thread(call.gateway.client.query, key, payload, encoding, timeout=QUERY_S)
    for answer in answers:
        if answer.ok:
            return schemas.decode(answer.payload, kind, encoding=answer.encoding)
    if not answers:
        raise EndCall(grpc.StatusCode.UNAVAILABLE, NOBODY)
    problem = schemas.decode(answers[0].payload, schemas.Problem, encoding=answers[0].encoding)
    raise refusal(problem)


def refusal(problem: schemas.Problem) -> EndCall:
    """Return the end of a call that a service refused."""
    code: Any = problem.code if problem.code in schemas.CODES else "invalid_value"
    error = schemas.MessageError(code, problem.path, problem.expected, problem.received)
    if problem.code in schemas.CODES:
        return refused(error)
    return EndCall(grpc.StatusCode.FAILED_PRECONDITION, problem.message, error)


async def _answer(call: Call, response: ProtoMessage) -> None:
    await call.write(response.SerializeToString())


def _matches(stream: str, pattern: str) -> bool:
    return all(want in {"*", part} for part, want in zip(stream.split("/"), pattern.split("/"), strict=True))

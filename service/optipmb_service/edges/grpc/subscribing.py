"""`Subscribe` and the queries: tracks on their way to a reader, and answers of the services."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, TypeVar

import grpc
import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_service.edges.grpc.calls import EndCall
from optipmb_service.edges.grpc.network import Listener, tracks_response
from optipmb_service.edges.grpc.selection import EventSelection, Filter
from optipmb_service.edges.queues import Outbox, Pace
from optipmb_service.edges.readers import listed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from google.protobuf.message import Message as ProtoMessage
    from optipmb_schemas.protobuf.convert import EncodedTracks

    from optipmb_service.edges.grpc.calls import Call
    from optipmb_service.edges.grpc.network import Received

    T = TypeVar("T", bound=schemas.Message)

QUEUE: Final = 16
MAX_QUEUE: Final = 1024

QUERY_S: Final = 2.0
"""Longest wait for an answer; a caller's own deadline may be shorter."""

KEPT_S: Final = 15.0
"""Longest wait for kept tracks: a service reads its log for up to 3 s, and several queries in turn."""

NOBODY: Final = "no tracking service answers"


async def subscribe(call: Call) -> None:
    """Send the tracks of a pattern until the caller or the gateway ends it."""
    asked = await call.request(pb.SubscribeRequest)
    keys, network = call.gateway.client.keys, call.gateway.network
    tracks = keys.matching(asked.pattern, "now" if asked.predict else "tracks")
    problems = keys.matching(asked.pattern, "problems")
    call.caller.may_read(asked.pattern)
    selection, pace = Filter(asked.filter), Pace(asked.max_rate_hz, predict=asked.predict)
    if asked.queue > MAX_QUEUE:
        raise schemas.MessageError("too_large", "queue", f"at most {MAX_QUEUE}", str(asked.queue))
    outbox = Outbox[bytes](asked.queue or QUEUE)

    def passes(one: EncodedTracks) -> bool:
        return pace.passes(one.stream, one.predicted_to_ns or one.stamp_ns)

    def put(message: Received, response: bytes) -> None:
        outbox.put(message.stream, response, len(response))

    listener = Listener(put, selection, passes)
    async with contextlib.AsyncExitStack() as subscriptions:
        await subscriptions.enter_async_context(network.subscribed(tracks, listener))
        if asked.problems:
            await subscriptions.enter_async_context(network.subscribed(problems, listener))
        history = [] if asked.predict else await network.recent(tracks)
        await call.begin()
        for one in history if asked.history else ():
            if passes(one):
                await call.write(tracks_response(one, selection))
        listener.begin(history)
        await call.drain(outbox)
    call.check_ending()


async def subscribe_events(call: Call) -> None:
    """Send the events of a pattern, final ones by default, until the caller or the gateway ends it."""
    asked = await call.request(pb.SubscribeEventsRequest)
    key, network = call.gateway.client.keys.matching(asked.pattern, "events"), call.gateway.network
    call.caller.may_read(asked.pattern)
    chosen = EventSelection(asked)
    outbox: Outbox[bytes] = Outbox(MAX_QUEUE)

    def take(message: Received, _: bytes) -> None:
        for response in chosen.responses(message) if isinstance(message, schemas.Events) else ():
            outbox.put(message.stream, response, len(response))

    listener = Listener(take)
    async with network.subscribed(key, listener):
        history = await network.recent_events(key)
        await call.begin()
        for one in history if asked.history else ():
            for response in chosen.responses(one):
                await call.write(response)
        listener.begin(history)
        await call.drain(outbox)
    call.check_ending()


async def query_tracks(call: Call) -> None:
    """Send the tracks that the services keep, of the newest revision of each frame."""
    asked = await call.request(pb.QueryTracksRequest)
    key = call.gateway.client.keys.matching(asked.pattern, "tracks")
    call.caller.may_read(asked.pattern)
    selection = Filter(asked.filter)
    wanted = schemas.TracksRequest(
        from_ns=asked.from_ns if asked.HasField("from_ns") else 0,
        to_ns=asked.to_ns if asked.HasField("to_ns") else None,
    )
    if "*" not in asked.pattern:
        async for tracks in _kept(call, asked.pattern, wanted):
            await call.write(tracks_response(tracks, selection))
        return
    last = 2**63 if wanted.to_ns is None else wanted.to_ns
    for tracks in _newest(await call.gateway.network.recent(key)):
        if wanted.from_ns <= tracks.stamp_ns <= last:
            await call.write(tracks_response(tracks, selection))


async def get_state(call: Call) -> None:
    """Ask for the state of a session."""
    asked = await call.request(pb.GetStateRequest)
    key = call.gateway.client.keys.query(asked.stream, "state")
    call.caller.may_read(asked.stream)
    await _answer(call, pb.GetStateResponse(state=await _asked(call, key, None, schemas.SessionState)))


async def get_links(call: Call) -> None:
    """Ask which objects of streams that the caller may read are one."""
    asked = await call.request(pb.GetLinksRequest)
    links = await _asked(call, call.gateway.client.keys.links_query(asked.area), None, schemas.Links)
    readable = [one for one in links.objects if call.caller.can_read(one.stream)]
    links.ClearField("objects")
    links.objects.extend(readable)
    await _answer(call, pb.GetLinksResponse(links=links))


async def reset(call: Call) -> None:
    """Restart a session, or end it."""
    asked = await call.request(pb.ResetRequest)
    key = call.gateway.client.keys.query(asked.stream, "reset")
    call.caller.may_command(asked.stream)
    request = schemas.ResetRequest(close=asked.close)
    await _answer(call, pb.ResetResponse(state=await _asked(call, key, request, schemas.SessionState)))


async def set_parameters(call: Call) -> None:
    """Set parameters of a session, or ask for them."""
    asked = await call.request(pb.SetParametersRequest)
    key = call.gateway.client.keys.query(asked.stream, "parameters")
    call.caller.may_command(asked.stream)
    asked.parameters.ClearField("values")
    try:
        wanted = convert.from_proto(asked.parameters, schemas.SessionParameters)
    except schemas.MessageError as error:
        raise error.under("parameters") from None
    request = None if wanted == schemas.SessionParameters() else wanted
    parameters = await _asked(call, key, request, schemas.SessionParameters)
    await _answer(call, pb.SetParametersResponse(parameters=parameters))


async def list_streams(call: Call) -> None:
    """Ask every service for its streams."""
    asked = await call.request(pb.ListStreamsRequest)
    client, pattern = call.gateway.client, asked.pattern or call.caller.pattern
    client.keys.matching(pattern, "tracks")
    call.caller.may_read(pattern)
    found = await listed(client, client.keys, pattern)
    streams = [pb.ListedStream(instance=instance, session=convert.to_proto(one)) for instance, one in found]
    await _answer(call, pb.ListStreamsResponse(streams=streams))


async def _asked(call: Call, key: str, message: schemas.Message | None, kind: type[T]) -> Any:
    """Return the first good answer to a query, in protobuf.

    Raises:
        EndCall: no service answers, or one refuses.
    """
    payload = b"" if message is None else schemas.encode(message)
    encoding = "" if message is None else schemas.encoding_of(message)
    answers = await asyncio.to_thread(call.gateway.client.query, key, payload, encoding, timeout=QUERY_S)
    for answer in answers:
        if answer.ok:
            return convert.to_proto(schemas.decode(answer.payload, kind, encoding=answer.encoding))
    if not answers:
        raise EndCall(grpc.StatusCode.UNAVAILABLE, NOBODY)
    raise _refusal(schemas.decode(answers[0].payload, schemas.Problem, encoding=answers[0].encoding))


async def _answer(call: Call, response: ProtoMessage) -> None:
    await call.write(response.SerializeToString())


async def _kept(call: Call, stream: str, wanted: schemas.TracksRequest) -> AsyncIterator[EncodedTracks]:
    """Yield the tracks of one stream, asking the service that has them part by part.

    Raises:
        EndCall: no service answers, not completely, or with a refusal.
    """
    client, encoding = call.gateway.client, schemas.encoding_of(wanted)
    key = client.keys.query(stream, "tracks")
    next_ns: int | None = wanted.from_ns
    while next_ns is not None:
        part = wanted.model_copy(update={"from_ns": next_ns})
        answers = await asyncio.to_thread(client.query, key, schemas.encode(part), encoding, timeout=KEPT_S)
        found = [one for one in answers if one.ok and one.encoding != encoding]
        problems = [
            schemas.decode(one.payload, schemas.Problem, encoding=one.encoding) for one in answers if not one.ok
        ]
        if not problems and len(found) == len(answers):
            raise EndCall(grpc.StatusCode.UNAVAILABLE, "the tracks did not come completely" if found else NOBODY)
        for one in found:
            yield convert.transcode(one.payload, encoding=one.encoding)
        asked_ns, next_ns = next_ns, None
        for problem in problems[:1]:
            if problem.code != "cut" or problem.stamp_ns is None or problem.stamp_ns <= asked_ns:
                raise _refusal(problem)
            next_ns = problem.stamp_ns


def _newest(publications: Iterable[EncodedTracks]) -> list[EncodedTracks]:
    """Return the latest revision of the latest run of each frame, by stream and stamp."""
    newest: dict[tuple[str, bytes, int], EncodedTracks] = {}
    for tracks in sorted(publications, key=lambda one: (one.run, one.revision)):
        newest[tracks.stream, tracks.epoch, tracks.seq] = tracks
    return sorted(newest.values(), key=lambda tracks: (tracks.stream, tracks.stamp_ns, tracks.seq))


def _refusal(problem: schemas.Problem) -> EndCall:
    code: Any = problem.code if problem.code in schemas.CODES else "invalid_value"
    error = schemas.MessageError(code, problem.path, problem.expected, problem.received)
    if problem.code in schemas.CODES:
        return EndCall.invalid(error)
    return EndCall(grpc.StatusCode.FAILED_PRECONDITION, problem.message, error)

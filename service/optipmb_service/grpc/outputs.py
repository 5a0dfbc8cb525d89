"""`Subscribe` and `QueryTracks`: tracks on their way to a reader."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final

import grpc
import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import transcode

from optipmb_service.grpc.feeds import tracks_item
from optipmb_service.grpc.fresh import Fresh, order
from optipmb_service.grpc.outbox import Outbox
from optipmb_service.grpc.questions import NOBODY, refusal
from optipmb_service.grpc.selection import Pace, Selection
from optipmb_service.grpc.status import EndCall

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from optipmb_schemas.protobuf.convert import EncodedTracks

    from optipmb_service.grpc.calls import Call

QUEUE: Final = 16
MAX_QUEUE: Final = 1024

KEPT_S: Final = 15.0
"""Longest wait for kept tracks: a service reads its log for up to 3 s, and several queries in turn."""


class _Subscriber:
    """A listener with a queue of its own.

    Args:
        asked: what is subscribed to.

    Raises:
        MessageError: it is not valid.
    """

    def __init__(self, asked: pb.SubscribeRequest) -> None:
        self.selection = Selection(asked.filter)
        self._pace = Pace(asked.max_rate_hz)
        if asked.queue > MAX_QUEUE:
            raise schemas.MessageError("too_large", "queue", f"at most {MAX_QUEUE}", str(asked.queue))
        self.outbox = Outbox(asked.queue or QUEUE)
        self._fresh = Fresh(lambda item: self.outbox.put(item.stream, item.response))
        self.take, self.begin = self._fresh.put, self._fresh.begin

    def passes(self, tracks: EncodedTracks) -> bool:
        return self._pace.passes(tracks.stream, tracks.stamp_ns)


async def subscribe(call: Call) -> None:
    """Send the tracks of a pattern until the caller or the gateway ends it."""
    asked = convert.parse(await call.first() or b"", pb.SubscribeRequest)
    keys, feeds = call.gateway.client.keys, call.gateway.feeds
    tracks, problems = keys.matching(asked.pattern, "tracks"), keys.matching(asked.pattern, "problems")
    call.caller.may_read(asked.pattern)
    listener = _Subscriber(asked)
    async with contextlib.AsyncExitStack() as joined:
        await joined.enter_async_context(feeds.joined(tracks, listener))
        if asked.problems:
            await joined.enter_async_context(feeds.joined(problems, listener))
        await call.begin()
        history = await feeds.recent(tracks)
        for one in history if asked.history else ():
            if listener.passes(one):
                await call.write(tracks_item(one, listener.selection).response)
        listener.begin(history)
        try:
            await call.drain(listener.outbox)
        finally:
            call.left_out += listener.outbox.left_out
    call.check_ending()


async def query_tracks(call: Call) -> None:
    """Send the tracks that the services keep, of the newest revision of each frame."""
    asked = convert.parse(await call.first() or b"", pb.QueryTracksRequest)
    key = call.gateway.client.keys.matching(asked.pattern, "tracks")
    call.caller.may_read(asked.pattern)
    selection = Selection(asked.filter)
    wanted = schemas.TracksRequest(
        from_ns=asked.from_ns if asked.HasField("from_ns") else 0,
        to_ns=asked.to_ns if asked.HasField("to_ns") else None,
    )
    if "*" not in asked.pattern:
        async for tracks in kept(call, asked.pattern, wanted):
            await call.write(tracks_item(tracks, selection).response)
        return
    last = 2**63 if wanted.to_ns is None else wanted.to_ns
    for tracks in newest(await call.gateway.feeds.recent(key)):
        if wanted.from_ns <= tracks.stamp_ns <= last:
            await call.write(tracks_item(tracks, selection).response)


async def kept(call: Call, stream: str, wanted: schemas.TracksRequest) -> AsyncIterator[EncodedTracks]:
    """Yield the tracks of one stream, asking the service that has them part by part.

    Raises:
        EndCall: nobody answers, not completely, or with a refusal.
    """
    client, encoding = call.gateway.client, schemas.encoding_of(wanted)
    key = client.keys.query(stream, "tracks")
    next_ns: int | None = wanted.from_ns
    while next_ns is not None:
        part = wanted.model_copy(update={"from_ns": next_ns})
        answers = await asyncio.to_thread(client.ask, key, schemas.encode(part), encoding, timeout=KEPT_S)
        found = [one for one in answers if one.good and one.encoding != encoding]
        problems = [
            schemas.decode(one.payload, schemas.Problem, encoding=one.encoding) for one in answers if not one.good
        ]
        if not problems and len(found) == len(answers):
            raise EndCall(grpc.StatusCode.UNAVAILABLE, "the tracks did not come completely" if found else NOBODY)
        for one in found:
            yield transcode(one.payload, encoding=one.encoding)
        next_ns = _rest(next_ns, problems)


def _rest(asked_ns: int, problems: list[schemas.Problem]) -> int | None:
    """Return the stamp at which the rest begins, None where there is none.

    Raises:
        EndCall: there is another problem.
    """
    for problem in problems:
        if problem.code != "cut" or problem.stamp_ns is None or problem.stamp_ns <= asked_ns:
            raise refusal(problem)
        return problem.stamp_ns
    return None


def newest(publications: Iterable[EncodedTracks]) -> list[EncodedTracks]:
    """Return what holds of each frame, by stream and stamp: that of the latest run, and in it the latest revision."""
    holding: dict[tuple[str, bytes, int], EncodedTracks] = {}
    for tracks in publications:
        key = tracks.stream, tracks.epoch, tracks.seq
        known = holding.get(key)
        if known is None or order(tracks) >= order(known):
            holding[key] = tracks
    return sorted(holding.values(), key=lambda tracks: (tracks.stream, tracks.stamp_ns, tracks.seq))

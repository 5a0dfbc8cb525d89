"""Subscriptions that calls share: what is wanted by many is received, decoded and encoded once."""

from __future__ import annotations

import asyncio
import collections
import contextlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

import optipmb_schemas as schemas
import structlog
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import EncodedTracks, transcode

from optipmb_service.grpc.idle_pool import IdlePool
from optipmb_service.grpc.outbox import varint
from optipmb_service.grpc.selection import Selection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from optipmb_service.zenoh.client import Client, Message
    from optipmb_service.zenoh.subscription import Subscription

KEPT: Final = 256
"""Subscriptions that are kept when no call has them any more."""

HISTORY_S: Final = 2.0
"""Longest wait for the caches of the services."""

_TRACKS: Final = b"\x0a"
"""Tag of field 1, `tracks`, of all responses with tracks."""

EVERYTHING: Final = Selection(pb.TrackFilter())

log = structlog.get_logger("optipmb_service")


@dataclass(frozen=True, slots=True)
class Item:
    """Something that came, as a response of any streaming method.

    Attributes:
        tracks: of which it is, if it is of any.
        problem: its code and path, if it is one.
    """

    stream: str
    response: bytes
    tracks: EncodedTracks | None = None
    problem: tuple[str, str] | None = None


class Listener(Protocol):
    """A call that wants what comes."""

    @property
    def selection(self) -> Selection:
        """What it wants of tracks."""

    def passes(self, tracks: EncodedTracks) -> bool:
        """Tell whether it wants the tracks of this frame; called on a thread of the feed."""

    def take(self, item: Item) -> None:
        """Take something; called on the loop."""


@dataclass(eq=False)
class _Feed:
    listeners: tuple[Listener, ...] = ()
    subscription: Subscription | None = None


class Feeds:
    """The subscriptions of a gateway; all methods belong to its loop.

    Args:
        client: of the network.
        loop: of the gateway.
        invalid: called for what comes and is no valid message, on any thread.
    """

    def __init__(self, client: Client, loop: asyncio.AbstractEventLoop, invalid: Callable[[str], None]) -> None:
        self._client = client
        self._loop = loop
        self._invalid = invalid
        self._feeds: dict[str, _Feed] = {}
        self._handed: collections.deque[tuple[Listener, Item]] = collections.deque()
        self._waking = False
        self._kept = IdlePool(loop, KEPT)

    @contextlib.asynccontextmanager
    async def joined(self, key: str, listener: Listener) -> AsyncIterator[None]:
        """Have a listener take what is published under a key expression.

        Raises:
            TransportError: the network cannot be used.
        """
        self._kept.take(key)
        feed = self._feeds.setdefault(key, _Feed())
        feed.listeners = (*feed.listeners, listener)
        try:
            if feed.subscription is None:
                feed.subscription = self._client.subscribe(key, lambda message: self._receive(feed, message))
            yield
        finally:
            feed.listeners = tuple(one for one in feed.listeners if one is not listener)
            if not feed.listeners and feed.subscription is None:
                del self._feeds[key]
            elif not feed.listeners:
                self._kept.keep(key, partial(self._end, key, feed))

    def close(self) -> None:
        """End the subscriptions that no call has any more."""
        self._kept.close()

    def _end(self, key: str, feed: _Feed) -> None:
        if self._feeds.get(key) is feed:
            del self._feeds[key]
        if feed.subscription is not None:
            self._loop.run_in_executor(None, feed.subscription.close)

    async def recent(self, key: str) -> list[EncodedTracks]:
        """Return the tracks that the services keep under a key expression, each stream's as they were published.

        Raises:
            TransportError: the network cannot be used.
        """
        return await asyncio.to_thread(self._recent, key)

    def _recent(self, key: str) -> list[EncodedTracks]:
        messages = self._client.recent(key, HISTORY_S)
        return [tracks for one in messages if (tracks := self._tracks(one)) is not None]

    def _receive(self, feed: _Feed, message: Message) -> None:
        """Take a message on the thread of its subscription."""
        if not (listeners := feed.listeners):
            return
        handed: list[tuple[Listener, Item]] = []
        if message.key.endswith("/problems"):
            problem = self._problem(message)
            if problem is not None:
                item = problem_item(problem)
                handed = [(listener, item) for listener in listeners]
        else:
            tracks = self._tracks(message)
            if tracks is not None:
                wanting = [one for one in listeners if one.passes(tracks)]
                items = {one.selection.key: one.selection for one in wanting}
                made = {key: tracks_item(tracks, selection) for key, selection in items.items()}
                handed = [(one, made[one.selection.key]) for one in wanting]
        self._handed.extend(handed)
        if handed and not self._waking:  # what is added after this was seen is still handed over
            self._waking = True
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._hand_over)

    def _hand_over(self) -> None:
        """Hand over all that has come, on the loop, which is woken once for it."""
        self._waking = False
        while self._handed:
            listener, item = self._handed.popleft()
            listener.take(item)

    def _tracks(self, message: Message) -> EncodedTracks | None:
        try:
            return transcode(message.payload, encoding=message.encoding)
        except schemas.MessageError as error:
            self._invalid(str(error))
            return None

    def _problem(self, message: Message) -> schemas.Problem | None:
        try:
            return schemas.decode(message.payload, schemas.Problem, encoding=message.encoding)
        except schemas.MessageError as error:
            self._invalid(str(error))
            return None


def tracks_item(tracks: EncodedTracks, selection: Selection = EVERYTHING) -> Item:
    """Return tracks as a response."""
    payload = selection.of(tracks.message()).SerializeToString() if selection.key else tracks.payload
    return Item(tracks.stream, b"".join((_TRACKS, varint(len(payload)), payload)), tracks)


def problem_item(problem: schemas.Problem) -> Item:
    """Return a problem as a response."""
    response = pb.SubscribeResponse(problem=convert.to_proto(problem))
    return Item(problem.stream, response.SerializeToString(), problem=(problem.code, problem.path))

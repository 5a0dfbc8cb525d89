"""The network as calls use it: subscriptions that they share, and publishers that they use in turn.

Messages for many calls are received, decoded and encoded once. Unused subscriptions are kept for the next call,
because Zenoh never gives back the number of a key.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_service.edges.grpc.calls import varint
from optipmb_service.edges.grpc.selection import EVERYTHING
from optipmb_service.zenoh.client import IdlePool, SharedSubscriptions

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from optipmb_client.incoming import Answer, Arrival
    from optipmb_schemas.protobuf.convert import EncodedTracks

    from optipmb_service.edges.grpc.selection import Filter
    from optipmb_service.zenoh.client import Client, Outgoing

    Received: TypeAlias = EncodedTracks | schemas.Problem | schemas.Events
    T = TypeVar("T")
    M = TypeVar("M", bound=schemas.Message)

IDLE_SUBSCRIPTIONS: Final = 256
IDLE_PUBLISHERS: Final = 64
"""How many are kept without a call; a publisher is kept with its cache."""

MAX_EARLY: Final = 1024
"""Most messages that wait until it is known what the caches hold."""

_TRACKS: Final = b"\x0a"
"""Tag of field 1, `tracks`, of all responses with tracks."""

PublisherKey = tuple[str, int, int]
"""Stream, cached detections, cached clouds."""


def tracks_response(tracks: EncodedTracks, selection: Filter = EVERYTHING) -> bytes:
    """Return tracks as a response of any streaming method."""
    payload = selection.of(tracks.message()).SerializeToString() if selection.key else tracks.payload
    return b"".join((_TRACKS, varint(len(payload)), payload))


def problem_response(problem: schemas.Problem) -> bytes:
    """Return a problem as a response of any streaming method."""
    return pb.SubscribeResponse(problem=convert.to_proto(problem)).SerializeToString()


class Listener:
    """A call that receives messages which the caches did not hold when they were asked. To be used on the loop.

    At the next heartbeat of a publisher, recovery sends a subscriber that has heard nothing yet all that is cached.

    Args:
        take: called with each new message and its response; of events, of which each call makes its own, an empty one.
        selection: of its tracks.
        passes: whether it wants the tracks of a frame; called on a thread of the subscription.
    """

    def __init__(
        self,
        take: Callable[[Received, bytes], None],
        selection: Filter = EVERYTHING,
        passes: Callable[[EncodedTracks], bool] = lambda _: True,
    ) -> None:
        self.selection = selection
        self.passes = passes
        self._take = take
        self._known: set[tuple[object, ...]] = set()
        self._early: list[tuple[Received, bytes]] | None = []  # from before the answer of the caches

    def put(self, message: Received, response: bytes) -> None:
        """Pass on a message, now or when the caches have been asked, or leave it out."""
        if self._early is not None and len(self._early) < MAX_EARLY:
            self._early.append((message, response))
        elif isinstance(message, schemas.Problem) or _publication(message) not in self._known:
            self._take(message, response)

    def begin(self, held: Iterable[EncodedTracks | schemas.Events]) -> None:
        """Leave out the contents of the caches, and pass on what else came while they were asked."""
        self._known = {_publication(one) for one in held}
        early, self._early = self._early or [], None
        for message, response in early:
            self.put(message, response)


def _publication(one: EncodedTracks | schemas.Events) -> tuple[object, ...]:
    delivery = one.delivery if isinstance(one, schemas.Events) else one
    return one.stream, one.sensor or "", one.epoch, one.seq, delivery and delivery.run, one.revision


class Network:
    """Subscriptions and publishers of a gateway; to be used on its loop.

    Args:
        client: of the network.
        invalid: called for each message that is not valid, on any thread.
    """

    def __init__(self, client: Client, invalid: Callable[[str], None]) -> None:
        self._client = client
        self._loop = asyncio.get_running_loop()
        self._invalid = invalid
        self._shared: SharedSubscriptions[Listener, Arrival]
        self._shared = SharedSubscriptions(client.subscribe, self._receive, IDLE_SUBSCRIPTIONS)
        self._idle_publishers: IdlePool[Outgoing] = IdlePool(IDLE_PUBLISHERS)
        self._arrived: collections.deque[tuple[Listener, Received, bytes]] = collections.deque()
        self._waking = False

    def close(self) -> None:
        """Withdraw what no call has any more; may wait."""
        self._shared.close()
        self._idle_publishers.close()

    @contextlib.asynccontextmanager
    async def subscribed(self, key: str, listener: Listener) -> AsyncIterator[None]:
        """Have a listener receive the publications under a key expression.

        Raises:
            TransportError: the network cannot be used.
        """
        leave = self._shared.join(key, listener)
        try:
            yield
        finally:
            leave()

    @contextlib.asynccontextmanager
    async def publishing(self, key: PublisherKey, wanted: Callable[[], None]) -> AsyncIterator[Outgoing]:
        """Give the publishers of a stream to a call alone; `wanted` as for `Outgoing`.

        Raises:
            TransportError: the network cannot be used, or too many were opened.
        """
        outgoing = self._idle_publishers.take(key)
        if outgoing is None:
            outgoing = self._client.publish(*key, wanted)
        outgoing.wanted = wanted
        try:
            yield outgoing
        finally:
            outgoing.wanted = lambda: None
            # Cached clouds take much memory; another call may have left its own publishers.
            if key[2] or not self._idle_publishers.keep(key, outgoing):
                await asyncio.shield(asyncio.to_thread(outgoing.close))

    async def recent(self, key: str) -> list[EncodedTracks]:
        """Return the tracks that the services keep under a key expression, each stream's as they were published.

        Raises:
            TransportError: the network cannot be used.
        """
        return await asyncio.to_thread(self._cached, key, self._tracks)

    async def recent_events(self, key: str) -> list[schemas.Events]:
        """Return the recent events of a key; raises as `recent`."""
        return await asyncio.to_thread(self._cached, key, partial(self._decoded, schemas.Events))

    def _cached(self, key: str, read: Callable[[Answer], T | None]) -> list[T]:
        messages = self._client.cached(key)
        return [found for one in messages if (found := read(one)) is not None]

    def _receive(self, listeners: tuple[Listener, ...], message: Arrival) -> None:
        """Take a message on the thread of its subscription."""
        arrived: list[tuple[Listener, Received, bytes]] = []
        topic = message.key.rpartition("/")[2]
        if not listeners:
            return
        if topic == "problems" and (problem := self._decoded(schemas.Problem, message)) is not None:
            response = problem_response(problem)
            arrived = [(one, problem, response) for one in listeners]
        elif topic == "events" and (events := self._decoded(schemas.Events, message)) is not None:
            arrived = [(one, events, b"") for one in listeners]
        elif topic in {"tracks", "now"} and (tracks := self._tracks(message)) is not None:
            wanting = [one for one in listeners if one.passes(tracks)]
            selections = {one.selection.key: one.selection for one in wanting}
            responses = {key: tracks_response(tracks, selection) for key, selection in selections.items()}
            arrived = [(one, tracks, responses[one.selection.key]) for one in wanting]
        self._arrived.extend(arrived)
        if arrived and not self._waking:  # messages that are added after this are still handed over
            self._waking = True
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._hand_over)

    def _hand_over(self) -> None:
        """Hand over all that has come, on the loop, which is woken once for it."""
        self._waking = False
        while self._arrived:
            listener, message, response = self._arrived.popleft()
            listener.put(message, response)

    def _tracks(self, message: Answer | Arrival) -> EncodedTracks | None:
        try:
            return convert.transcode(message.payload, encoding=message.encoding)
        except schemas.MessageError as error:
            self._invalid(str(error))
            return None

    def _decoded(self, kind: type[M], message: Answer | Arrival) -> M | None:
        try:
            return schemas.decode(message.payload, kind, encoding=message.encoding)
        except schemas.MessageError as error:
            self._invalid(str(error))
            return None

"""`Track` and `Publish`: detections and clouds of one stream on their way to the network."""

from __future__ import annotations

import asyncio
import collections
import contextlib
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_service.grpc.feeds import EVERYTHING, Item, problem_item, tracks_item
from optipmb_service.grpc.flight import Flight
from optipmb_service.grpc.fresh import Fresh
from optipmb_service.grpc.outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from optipmb_schemas.protobuf.convert import EncodedTracks

    from optipmb_service.grpc.calls import Call
    from optipmb_service.grpc.selection import Selection
    from optipmb_service.zenoh.client import Outgoing

CACHE: Final = 400
"""Detections that are kept for recovery unless the publisher says otherwise: 10 s of a sensor at 20 Hz."""

MAX_CACHE: Final = 4096
MAX_CACHE_CLOUDS: Final = 64

INLINE_BYTES: Final = 64 * 2**10
"""What is larger is handed to the network on a thread: it is cut into fragments and may wait for the link."""

WINDOW: Final = 64
"""Frames of a `Track` call without tracks; beyond it the gateway reads no further, and the caller feels it."""

RESPONSES: Final = 256
"""Responses that may wait for a caller: more than the window, so that none are left out but for others' frames."""

ACKNOWLEDGE_S: Final = 1.0
"""Longest time until a message is acknowledged: one acknowledgement covers all messages since the last."""

WANTED_S: Final = 1.0
"""How long the first cloud waits for it to be known whether anybody takes clouds."""

Input = schemas.Detections | schemas.Points | schemas.Problem | pb.PublishOptions


class Incoming:
    """Reads the messages of one stream, checks them as the service does, and hands them to the network.

    Args:
        call: with the requests.
        kind: of the requests, which have `detections` and `points`.
    """

    def __init__(self, call: Call, kind: type[pb.TrackRequest | pb.PublishRequest]) -> None:
        self._call = call
        self._kind = kind
        self._options = pb.PublishOptions()
        self._outgoing: Outgoing | None = None
        self._matched = asyncio.Event()
        self._waited = False
        self.stream = ""

    async def first(self) -> Input | None:
        """Return the first message, which says the stream; None when the caller sends none.

        Raises:
            EndCall: there is none in time, or it is none of this method, or the caller may not publish this stream.
        """
        payload = await self._call.first()
        return None if payload is None else self._read(payload)

    async def next(self) -> Input | None:
        """Return the next message, a problem in the place of one that is not valid, None when all have come.

        Raises:
            EndCall: it is none of this method, or of another stream.
        """
        payload = await self._call.read()
        return None if payload is None else self._read(payload)

    @contextlib.asynccontextmanager
    async def opened(self, changed: Callable[[], None] | None = None) -> AsyncIterator[Outgoing]:
        """Keep the publishers open meanwhile; `changed` is called when it changes whether anybody takes clouds.

        Raises:
            TransportError: the network cannot be used.
        """
        loop = asyncio.get_running_loop()

        def matched() -> None:
            self._matched.set()
            if changed is not None:
                changed()

        def matching() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(matched)

        options = self._options
        key = self.stream, options.cache or CACHE, options.cache_clouds
        async with self._call.gateway.publishers.opened(key, matching) as outgoing:
            self._outgoing = outgoing
            yield outgoing

    async def send(self, message: schemas.Detections | schemas.Points) -> None:
        """Hand a message to the network; a cloud only if somebody takes it.

        Raises:
            TransportError: the network cannot be used.
        """
        outgoing = self._outgoing
        assert outgoing is not None  # noqa: S101 - opened before: said for the type checker
        if isinstance(message, schemas.Points) and not await self._points_wanted(outgoing):
            return
        put = outgoing.detections if isinstance(message, schemas.Detections) else outgoing.points
        payload = schemas.encode(message) if isinstance(message, schemas.Points) else schemas.encoded(message)
        if len(payload) <= INLINE_BYTES:
            put(payload)
        else:
            await asyncio.to_thread(put, payload)

    async def _points_wanted(self, outgoing: Outgoing) -> bool:
        if not self._waited and not outgoing.points_wanted:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._matched.wait(), WANTED_S)
        self._waited = True
        return outgoing.points_wanted

    def _read(self, payload: bytes) -> Input:
        request = convert.parse(payload, self._kind)
        name = request.WhichOneof("request")
        if name is None:
            raise schemas.MessageError("missing_field", "request", "detections or points", "nothing")
        message = getattr(request, name)
        if not self.stream:
            self._begin(name, message)
        elif message.stream != self.stream:
            raise schemas.MessageError("invalid_value", f"{name}.stream", self.stream, ascii(message.stream)[:80])
        if name == "options":
            return self._options
        try:
            if name == "detections":
                return convert.from_proto(message, schemas.Detections, self._call.gateway.limits)
            return convert.from_proto(message, schemas.Points, self._call.gateway.limits)
        except schemas.MessageError as error:
            return self._problem(message, error)

    def _begin(self, name: str, message: Any) -> None:
        try:
            self._call.gateway.client.keys.detections(message.stream)
            if name == "options":
                _bounded("cache", message.cache, MAX_CACHE)
                _bounded("cache_clouds", message.cache_clouds, MAX_CACHE_CLOUDS)
                self._options = message
        except schemas.MessageError as error:
            raise error.under(name) from None
        self._call.caller.may_publish(message.stream)
        self.stream = message.stream

    def _problem(self, message: Any, error: schemas.MessageError) -> schemas.Problem:
        gateway = self._call.gateway
        problem = schemas.Problem.of(error, stream=self.stream, instance=gateway.instance)
        known = {name: getattr(message, name) for name in ("seq", "stamp_ns") if message.HasField(name)}
        problem = problem.model_copy(update={name: value for name, value in known.items() if value >= 0})
        gateway.refused(problem)
        return problem


class _Answers:
    """What comes back of a stream, for the call that publishes it."""

    selection: Selection = EVERYTHING

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._told: collections.deque[tuple[str, str]] = collections.deque(maxlen=RESPONSES)

    def tell(self, problem: schemas.Problem) -> None:
        """Tell the caller of a message that was refused here; the problem also comes back from the network."""
        self._told.append((problem.code, problem.path))
        self._outbox.put(problem.stream, problem_item(problem).response)

    def passes(self, _tracks: EncodedTracks) -> bool:
        """Tell whether they are wanted: all are."""
        return True

    def take(self, item: Item) -> None:
        """Take tracks, or a problem that the caller does not know."""
        if item.problem not in self._told:
            self._outbox.put(item.stream, item.response)


class _TracksAnswers(_Answers):
    """The tracks of the frames on their way, and problems; what was published before the call is answered by it alone.

    Args:
        outbox: for the caller.
        flight: of the call.
    """

    def __init__(self, outbox: Outbox, flight: Flight) -> None:
        super().__init__(outbox)
        self._flight = flight
        self._fresh = Fresh(self._answer)
        self.begin = self._fresh.begin

    def take(self, item: Item) -> None:
        """Take tracks or a problem, if they are new."""
        self._fresh.put(item)

    def _answer(self, item: Item) -> None:
        if item.tracks is not None:
            self._flight.came(item.tracks.epoch, item.tracks.seq)
        super().take(item)


async def track(call: Call) -> None:
    """Detections and clouds in, tracks and problems back."""
    incoming, outbox, flight = Incoming(call, pb.TrackRequest), Outbox(RESPONSES), Flight()
    message = await incoming.first()
    if message is None:
        return
    answers = _TracksAnswers(outbox, flight)
    keys, feeds = call.gateway.client.keys, call.gateway.feeds
    async with (
        feeds.joined(keys.tracks(incoming.stream), answers),
        feeds.joined(keys.problems(incoming.stream), answers),
        incoming.opened(),
        call.writing(outbox),
    ):
        held = await feeds.recent(keys.tracks(incoming.stream))
        known = _already_tracked(held, message, outbox)
        answers.begin(held)
        while message is not None:
            if isinstance(message, schemas.Problem):
                answers.tell(message)
            elif isinstance(message, schemas.Detections | schemas.Points):
                if isinstance(message, schemas.Detections) and (message.epoch, message.seq) not in known:
                    flight.sent(message.epoch, message.seq)
                await incoming.send(message)
                await flight.below(WINDOW)
            message = await incoming.next()
        await flight.below(1)
    call.check_ending()


def _already_tracked(held: Iterable[EncodedTracks], first: Input, outbox: Outbox) -> set[tuple[bytes, int]]:
    """Answer what a caller that comes back sends again: it may have been tracked, and is not tracked twice."""
    known: set[tuple[bytes, int]] = set()
    if not isinstance(first, schemas.Detections | schemas.Points):
        return known
    for tracks in held:
        if tracks.epoch == first.epoch and tracks.stamp_ns >= first.stamp_ns:
            known.add((tracks.epoch, tracks.seq))
            outbox.put(tracks.stream, tracks_item(tracks).response)
    return known


async def publish(call: Call) -> None:
    """Detections and clouds in, acknowledgements and problems back."""
    incoming, outbox = Incoming(call, pb.PublishRequest), Outbox(RESPONSES)
    message = await incoming.first()
    if message is None:
        return
    progress, answers = _Progress(outbox), _Answers(outbox)
    async with (
        call.gateway.feeds.joined(call.gateway.client.keys.problems(incoming.stream), answers),
        incoming.opened(progress.acknowledge) as outgoing,
        call.writing(outbox),
    ):
        progress.begin(outgoing)
        try:
            while message is not None:
                if isinstance(message, schemas.Problem):
                    answers.tell(message)
                elif isinstance(message, schemas.Detections | schemas.Points):
                    await incoming.send(message)
                    progress.sent(message)
                message = await incoming.next()
            progress.acknowledge()
        finally:
            progress.end()
    call.check_ending()


class _Progress:
    """Says how far a publisher's messages have gone out; the newest acknowledgement stands for those before it.

    Args:
        outbox: for the caller.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._newest = pb.Acknowledgement()
        self._outgoing: Outgoing | None = None
        self._due: asyncio.TimerHandle | None = None

    def begin(self, outgoing: Outgoing) -> None:
        """Acknowledge that the stream is open."""
        self._outgoing = outgoing
        self.acknowledge()

    def sent(self, message: schemas.Detections | schemas.Points) -> None:
        """Take in that a message has gone out; it is acknowledged soon."""
        if isinstance(message, schemas.Detections):
            self._newest.detections = message.seq
        else:
            self._newest.points = message.seq
        if self._due is None:
            self._due = asyncio.get_running_loop().call_later(ACKNOWLEDGE_S, self.acknowledge)

    def acknowledge(self) -> None:
        """Acknowledge all that has gone out, now."""
        self.end()
        if self._outgoing is not None:
            self._newest.points_wanted = self._outgoing.points_wanted
            self._outbox.replace(pb.PublishResponse(acknowledgement=self._newest).SerializeToString())

    def end(self) -> None:
        """Acknowledge nothing later."""
        if self._due is not None:
            self._due.cancel()
            self._due = None


def _bounded(name: str, value: int, most: int) -> None:
    if value > most:
        raise schemas.MessageError("too_large", name, f"at most {most}", str(value))

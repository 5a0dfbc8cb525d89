"""`Track` and `Publish`: detections and clouds of one stream on their way to the network."""

from __future__ import annotations

import asyncio
import collections
import contextlib
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import EncodedTracks

from optipmb_service.edges.grpc.network import Listener, problem_response, tracks_response
from optipmb_service.edges.grpc.selection import check_bound
from optipmb_service.edges.inputs import CACHE, WINDOW, InFlight, put
from optipmb_service.edges.queues import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from optipmb_service.edges.grpc.calls import Call
    from optipmb_service.edges.grpc.network import Received
    from optipmb_service.zenoh.client import Outgoing

MAX_CACHE: Final = 4096
MAX_CACHE_CLOUDS: Final = 64

RESPONSES: Final = 256
"""Responses that may wait for a caller: more than the window, so that none are left out but for others' frames."""

ACKNOWLEDGE_S: Final = 1.0
"""Longest time until a message is acknowledged: one acknowledgement covers all messages since the last."""

WANTED_S: Final = 1.0
"""How long the first cloud waits for it to be known whether anybody takes clouds."""

Input = schemas.Detections | schemas.Points | schemas.Problem | pb.PublishOptions


async def track(call: Call) -> None:
    """Detections and clouds in, tracks and problems back."""
    inputs, outbox = _Inputs(call, pb.TrackRequest), Outbox[bytes](RESPONSES)
    message = await inputs.next()
    if message is None:
        return
    answers = _Answers(call, outbox)
    keys, network = call.gateway.client.keys, call.gateway.network
    tracks = keys.tracks(call.gateway.session_of(inputs.stream))

    def is_own(one: EncodedTracks) -> bool:
        return (one.sensor or one.stream) == inputs.stream

    answers.listener.passes = is_own
    async with (
        network.subscribed(tracks, answers.listener),
        network.subscribed(keys.problems(inputs.stream), answers.listener),
        inputs.opened() as outgoing,
        call.writing(outbox),
    ):
        cached = [one for one in await network.recent(tracks) if is_own(one)]
        known = _already_tracked(cached, message, outbox)
        answers.listener.begin(cached)
        while message is not None:
            if isinstance(message, schemas.Problem):
                answers.report(message)
            elif isinstance(message, schemas.Detections | schemas.Points):
                if isinstance(message, schemas.Detections) and (message.epoch, message.seq) not in known:
                    answers.in_flight.add(message.epoch, message.seq)
                await inputs.send(outgoing, message)
                await answers.in_flight.below(WINDOW)
            message = await inputs.next()
        await answers.in_flight.below(1)
    call.check_ending()


def _already_tracked(cached: Iterable[EncodedTracks], first: Input, outbox: Outbox[bytes]) -> set[tuple[bytes, int]]:
    """Answer what a caller that comes back sends again: it may have been tracked, and is not tracked twice."""
    known: set[tuple[bytes, int]] = set()
    if not isinstance(first, schemas.Detections | schemas.Points):
        return known
    for tracks in cached:
        if tracks.epoch == first.epoch and tracks.stamp_ns >= first.stamp_ns:
            known.add((tracks.epoch, tracks.seq))
            response = tracks_response(tracks)
            outbox.put(tracks.stream, response, len(response))
    return known


async def publish(call: Call) -> None:
    """Detections and clouds in, acknowledgements and problems back."""
    inputs, outbox = _Inputs(call, pb.PublishRequest), Outbox[bytes](RESPONSES)
    message = await inputs.next()
    if message is None:
        return
    acknowledgements, answers = _Acknowledgements(outbox), _Answers(call, outbox)
    answers.listener.begin(())
    problems = call.gateway.client.keys.problems(inputs.stream)
    async with (
        call.gateway.network.subscribed(problems, answers.listener),
        inputs.opened(acknowledgements.send) as outgoing,
        call.writing(outbox),
    ):
        acknowledgements.begin(outgoing)
        try:
            while message is not None:
                if isinstance(message, schemas.Problem):
                    answers.report(message)
                elif isinstance(message, schemas.Detections | schemas.Points):
                    await inputs.send(outgoing, message)
                    acknowledgements.add(message)
                message = await inputs.next()
            acknowledgements.send()
        finally:
            acknowledgements.cancel()
    call.check_ending()


class _Inputs:
    """Messages of one stream: read, checked as the service does, and handed to the network.

    Args:
        call: with the requests.
        kind: of the requests, which have `detections` and `points`.
    """

    def __init__(self, call: Call, kind: type[pb.TrackRequest | pb.PublishRequest]) -> None:
        self._call = call
        self._kind = kind
        self._options = pb.PublishOptions()
        self._matched = asyncio.Event()
        self._waited = False
        self._traceparent = ""
        self.stream = ""
        """Name of the stream; the first message says it."""

    async def next(self) -> Input | None:
        """Return the next message, a problem in the place of one that is not valid, None when all have come.

        Raises:
            EndCall: the first one does not come in time, or the caller may not publish its stream.
            MessageError: it is none of this method, or of another stream.
        """
        payload = await (self._call.read() if self.stream else self._call.first())
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

        key = self.stream, self._options.cache or CACHE, self._options.cache_clouds
        async with self._call.gateway.network.publishing(key, matching) as outgoing:
            yield outgoing

    async def send(self, outgoing: Outgoing, message: schemas.Detections | schemas.Points) -> None:
        """Hand a message to the publishers; a cloud only if somebody takes it.

        Raises:
            TransportError: the network cannot be used.
        """
        if isinstance(message, schemas.Points):
            if not self._waited and not outgoing.points_wanted:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(WANTED_S):
                        await self._matched.wait()
            self._waited = True
            if not outgoing.points_wanted:
                return
        publish = outgoing.detections if isinstance(message, schemas.Detections) else outgoing.points
        await put(publish, schemas.encoded(message), self._traceparent)

    def _read(self, payload: bytes) -> Input:
        request = convert.parse(payload, self._kind)
        name = request.WhichOneof("request")
        self._traceparent = request.traceparent or self._call.traceparent
        if name is None:
            raise schemas.MessageError("missing_field", "request", "detections or points", "nothing")
        message = getattr(request, name)
        if not self.stream:
            self._begin(name, message)
        elif message.stream != self.stream:
            raise schemas.MessageError("invalid_value", f"{name}.stream", self.stream, ascii(message.stream)[:80])
        if name == "options":
            return self._options
        kind: Any = schemas.Detections if name == "detections" else schemas.Points
        try:
            checked: Input = convert.from_proto(message, kind, self._call.gateway.limits)
        except schemas.MessageError as error:
            return self._problem(message, error)
        return checked

    def _begin(self, name: str, message: Any) -> None:
        try:
            self._call.gateway.client.keys.detections(message.stream)
            if name == "options":
                check_bound("cache", message.cache, MAX_CACHE)
                check_bound("cache_clouds", message.cache_clouds, MAX_CACHE_CLOUDS)
                self._options = message
        except schemas.MessageError as error:
            raise error.under(name) from None
        self._call.caller.may_publish(message.stream)
        self.stream = message.stream

    def _problem(self, message: Any, error: schemas.MessageError) -> schemas.Problem:
        gateway = self._call.gateway
        problem = schemas.Problem.of(error, stream=self.stream, instance=gateway.instance)
        known = {name: getattr(message, name) for name in ("seq", "stamp_ns") if message.HasField(name)}
        return problem.model_copy(update={name: value for name, value in known.items() if value >= 0})


class _Answers:
    """Tracks and problems of a stream for the call that publishes it, each once.

    The call itself answers for messages published before it.

    Attributes:
        in_flight: frames of the call without tracks.
        listener: takes tracks and problems.
    """

    def __init__(self, call: Call, outbox: Outbox[bytes]) -> None:
        self._gateway = call.gateway
        self._outbox = outbox
        self._reported: collections.deque[tuple[str, str]] = collections.deque(maxlen=RESPONSES)
        self.in_flight = InFlight()
        self.listener = Listener(self._answer)

    def report(self, problem: schemas.Problem) -> None:
        """Report a message that was refused here, to the caller and the network, from which it comes back."""
        self._reported.append((problem.code, problem.path))
        self._gateway.refused(problem)
        response = problem_response(problem)
        self._outbox.put(problem.stream, response, len(response))

    def _answer(self, message: Received, response: bytes) -> None:
        if isinstance(message, EncodedTracks):
            self.in_flight.remove(message.epoch, message.seq)
        elif isinstance(message, schemas.Problem) and (message.code, message.path) in self._reported:
            return
        self._outbox.put(message.stream, response, len(response))


class _Acknowledgements:
    """Acknowledgements of a publisher's messages; the newest stands for those before it."""

    def __init__(self, outbox: Outbox[bytes]) -> None:
        self._outbox = outbox
        self._newest = pb.Acknowledgement()
        self._outgoing: Outgoing | None = None
        self._due: asyncio.TimerHandle | None = None

    def begin(self, outgoing: Outgoing) -> None:
        """Acknowledge that the stream is open."""
        self._outgoing = outgoing
        self.send()

    def add(self, message: schemas.Detections | schemas.Points) -> None:
        """Acknowledge soon that a message has gone out."""
        name = "detections" if isinstance(message, schemas.Detections) else "points"
        setattr(self._newest, name, message.seq)
        if self._due is None:
            self._due = asyncio.get_running_loop().call_later(ACKNOWLEDGE_S, self.send)

    def send(self) -> None:
        """Acknowledge all that has gone out, now."""
        self.cancel()
        if self._outgoing is not None:
            self._newest.points_wanted = self._outgoing.points_wanted
            response = pb.PublishResponse(acknowledgement=self._newest).SerializeToString()
            self._outbox.replace(response, len(response))

    def cancel(self) -> None:
        """Acknowledge nothing later."""
        if self._due is not None:
            self._due.cancel()
            self._due = None

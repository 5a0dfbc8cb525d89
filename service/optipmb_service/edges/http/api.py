"""JSON over HTTP for readers: the newest tracks by GET, all of them as server-sent events and over a WebSocket.

Readers share subscriptions and are counted here, apart from other requests. One that is too slow gets the newest frame
of each stream. Events are kept for a while, for slow readers and for those who come again.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import math
import time
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Protocol

import msgspec
import optipmb_schemas as schemas
from msgspec import Meta, Struct
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_schemas.json_form import FIELDS, Selection, features_json
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from optipmb_service.edges import access
from optipmb_service.edges.access import ANYBODY, Caller, NotAllowedError, name_by, token_names
from optipmb_service.edges.readers import Feeds, Reader, Wish, listed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence

    from optipmb_client.zenoh.session import ZenohSession
    from optipmb_schemas.json_form import Place
    from starlette.requests import HTTPConnection, Request
    from starlette.types import Receive, Scope, Send

    from optipmb_service.edges.readers import Logs, Publication
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

POLL_S: Final = 0.1  # a reader hears so soon that the service ends
KEEP_ALIVE_S: Final = 5.0  # period of signs of life of a silent stream, for proxies in between
EVENT_STREAM: Final = "text/event-stream"
PROTOCOL: Final = "optipmb.v1"  # subprotocol of the WebSocket
BEARER: Final = "bearer."  # a second subprotocol with the token of a browser, which can set no header
NAMES: Final = 256
RECENT: Final = 32  # newest messages of events, of more than a second, among which one has counts
TRY_AGAIN, MALFORMED, TOO_BIG = 1013, 1008, 1009  # why a WebSocket was closed
NOT_VALID: Final = "the token is not valid any more"
MESSAGE_CHARACTERS: Final = 4096  # largest message of a reader
STREAMING: Final = {"cache-control": "no-store, no-transform", "x-accel-buffering": "no"}  # for proxies
HEADERS: Final = {"cache-control": "no-store", "x-content-type-options": "nosniff", "referrer-policy": "no-referrer"}


ANSWERS: Final = {
    HTTPStatus.UNAUTHORIZED: {"www-authenticate": "Bearer"},
    HTTPStatus.SERVICE_UNAVAILABLE: {"retry-after": "1"},
}
"""Headers of answers by their status."""


class NoTokenError(Exception):
    """The token is missing or not valid."""


class NoRoomError(Exception):
    """There are as many connections of a kind as there may be."""


class RequestError(Exception):
    """A request that cannot be read, with the status and the code of its answer."""

    def __init__(self, status: HTTPStatus, code: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status
        self.code = code


STATUS: Final[dict[type[Exception], tuple[HTTPStatus, str]]] = {
    schemas.MessageError: (HTTPStatus.BAD_REQUEST, "invalid_value"),  # or its own code
    NoTokenError: (HTTPStatus.UNAUTHORIZED, "no_token"),
    NotAllowedError: (HTTPStatus.FORBIDDEN, "not_allowed"),
    NoRoomError: (HTTPStatus.SERVICE_UNAVAILABLE, "busy"),
    TransportError: (HTTPStatus.SERVICE_UNAVAILABLE, "unlinked"),
    RequestError: (HTTPStatus.BAD_REQUEST, "malformed"),  # or its own
}
"""Status and code of the answers to errors."""


def refusal(
    status: int, code: str, message: str, path: str = "", headers: Mapping[str, str] | None = None, **about: object
) -> JSONResponse:
    """Return the answer to a request that is refused; it has the same form for all."""
    body = {"error": {"code": code, "path": path, "message": message} | about}
    return JSONResponse(body, status, HEADERS | dict(headers or {}))


async def refuse(connection: HTTPConnection, error: Exception) -> Response | None:
    """Answer what cannot be answered otherwise."""
    status, code = next(one for kind, one in STATUS.items() if isinstance(error, kind))
    headers = ANSWERS.get(status, {})
    if isinstance(error, RequestError):  # the rest of its body is not read
        status, headers = error.status, {"connection": "close"}
    response = refusal(status, getattr(error, "code", code), str(error), getattr(error, "path", ""), headers)
    if not isinstance(connection, WebSocket):
        return response
    await connection.send_denial_response(response)
    return None


class Source(Protocol):
    """Queue of a reader."""

    def receive(self, one: Publication) -> None:
        """Take a message, on any thread."""

    def read(self, logs: list[Logs]) -> str:
        """Read events from these logs, and return the id after which it begins."""

    async def take(self, seconds: float | None = None) -> tuple[bytes, str]:
        """Return the next text, and its id if it is an event. Raises TimeoutError."""


@dataclass(eq=False)
class Occupant:
    """A connection in a room.

    Attributes:
        name: of its caller.
        yields: whether it may be closed for another one when it is idle.
        used_s: monotonic time at which it was last used.
        left: whether its place was given to another one.
    """

    name: str
    yields: bool
    used_s: float
    left: bool = False


class Room:
    """Connections of a kind that are open now: a bounded number. An idle one gives its place to another.

    Attributes:
        refused: connections that found no place, by the name of their callers.

    Args:
        most: their largest number.
        who: they are, for the refusal.
        share: of the places that one name may have; anybody has no name.
        idle_s: time without use after which one gives its place.
    """

    def __init__(self, most: int, who: str, share: float = 1.0, idle_s: float = math.inf) -> None:
        self.refused: collections.Counter[str] = collections.Counter()
        self._places: set[Occupant] = set()
        self._most = most
        self._of_a_name = max(1, int(most * share))
        self._who = who
        self._idle_s = idle_s

    @property
    def count(self) -> int:
        """Connections that are open now."""
        return len(self._places)

    @contextlib.contextmanager
    def entered(self, name: str = ANYBODY, *, yields: bool = False) -> Iterator[Occupant]:
        """Count a connection meanwhile; `yields`: it may be closed for another one when it is idle.

        Raises:
            NoRoomError: there are too many.
        """
        place = Occupant(name, yields, time.monotonic())
        own = {one for one in self._places if one.name == name != ANYBODY}
        if len(own) >= self._of_a_name:
            self._make_room(own, place, f"{len(own)} {self._who} of {name} are here already")
        elif self.count >= self._most:
            self._make_room(self._places, place, f"{self._most} {self._who} are here already")
        self._places.add(place)  # before anything is awaited: those who come together are counted one by one
        try:
            yield place
        finally:
            self._places.discard(place)

    def _make_room(self, places: set[Occupant], place: Occupant, reason: str) -> None:
        idle = [one for one in places if one.yields and place.used_s - one.used_s >= self._idle_s]
        if not idle:
            self.refused[place.name] += 1
            raise NoRoomError(reason)
        longest = min(idle, key=lambda one: one.used_s)
        longest.left = True
        self._places.discard(longest)


class Readers:
    """Those who read now, by any path, with rights by their tokens.

    Attributes:
        room: for them.

    Args:
        health: of the process.
        settings: of the process.
        places: of sites.
    """

    def __init__(self, health: ProcessHealth, settings: Settings, places: Mapping[str, Place]) -> None:
        self.keys = schemas.Keys(settings.prefix)
        self._health = health
        self._places = places
        self._names = token_names("http_tokens", settings.http_tokens) if settings.http_tokens else None
        self._reads = settings.readable_by
        self.stale_s = settings.stale_s
        self.room = Room(settings.http_clients, "readers")
        self._feeds: Feeds | None = None

    def session(self) -> ZenohSession:
        """Return the session of the process.

        Raises:
            TransportError: there is none yet.
        """
        if (session := self._health.session()) is None:
            raise TransportError(f"the service is {self._health.state()}")
        return session

    def feeds(self) -> Feeds:
        """Return the subscriptions.

        Raises:
            TransportError: there is no session yet.
        """
        session = self.session()
        if self._feeds is None or self._feeds.session is not session:
            self._feeds = Feeds(session, self.keys, self._places)
        return self._feeds

    async def caller(self, connection: HTTPConnection) -> Caller:
        """Return who asks.

        Raises:
            NoTokenError: the token is missing or not valid.
        """
        if self._names is None:
            return Caller(ANYBODY)
        metadata = dict(connection.headers)
        for one in connection.scope.get("subprotocols", ()):
            if one.startswith(BEARER):
                metadata["authorization"] = f"Bearer {one[len(BEARER) :]}"
        if not (name := await name_by(self._names, metadata)):
            raise NoTokenError("the token is missing or not valid")
        return Caller(name, self._reads(name))

    async def is_revoked(self, connection: HTTPConnection, caller: Caller) -> bool:
        """Return whether the token of an open connection has been taken out of the file, or has other rights now."""
        try:
            return isinstance(self._names, access.TokenFile) and await self.caller(connection) != caller
        except NoTokenError:
            return True

    async def revoked(self, connection: HTTPConnection, caller: Caller) -> None:
        """Wait until the token of an open connection has been taken out of the file, or has other rights."""
        while not await self.is_revoked(connection, caller):  # noqa: ASYNC110 - a file tells nobody that it changes
            await asyncio.sleep(access.LOOK_S)

    @contextlib.asynccontextmanager
    async def joined(self, keys: Sequence[str], source: Source) -> AsyncIterator[str]:
        """Hand over the publications of keys meanwhile; gives the id after which the reader of events begins.

        Raises:
            TransportError: the network cannot be used, or too many keys were asked for.
        """
        loop, feeds = asyncio.get_running_loop(), self.feeds()
        joining = loop.run_in_executor(None, feeds.join, keys, source.receive)
        try:
            leave = await asyncio.shield(joining)
        except asyncio.CancelledError:
            joining.add_done_callback(_undo)  # the reader has gone; the thread subscribes all the same
            raise
        try:
            yield source.read(feeds.logs(keys))
        finally:
            loop.run_in_executor(None, leave)  # not awaited: the reader's task may be cancelled

    async def stream(
        self,
        request: Request,
        keys: Sequence[str],
        source: Callable[[], Source],
        headers: Mapping[str, str],
        pause_s: float = 0.0,
    ) -> Response:
        """Return an answer with the texts of a reader as server-sent events.

        Raises:
            NoRoomError: there are too many readers.
            TransportError: the network cannot be used, or too many keys were asked for.
        """
        headers, caller = {**headers, **STREAMING}, await self.caller(request)
        if request.method == "HEAD":
            return Response(headers=headers, media_type=EVENT_STREAM)
        async with contextlib.AsyncExitStack() as ended:
            ended.enter_context(self.room.entered())
            reader = source()
            begins = await ended.enter_async_context(self.joined(keys, reader))
            revoked = asyncio.create_task(self.revoked(request, caller))
            ended.callback(revoked.cancel)
            return _EventResponse(self._lines(reader, begins, pause_s, revoked), ended.pop_all(), headers)

    async def _lines(
        self, reader: Source, begins: str, pause_s: float, revoked: asyncio.Task[None]
    ) -> AsyncIterator[bytes]:
        heard = time.monotonic()
        # The headers go with the first piece: the reader knows that it is connected.
        yield b": hello\n%b\n" % (f"id: {begins}\n".encode() if begins else b"")
        while self._health.state() != "stopping" and not revoked.done():
            try:
                text, event_id = await reader.take(POLL_S)
            except TimeoutError:
                if time.monotonic() - heard > KEEP_ALIVE_S:
                    heard = time.monotonic()
                    yield b": silent\n\n"
                continue
            heard = time.monotonic()
            yield b"%bdata: %b\n\n" % (f"id: {event_id}\n".encode() if event_id else b"", text)
            await asyncio.sleep(pause_s)


class _EventResponse(StreamingResponse):
    """Server-sent events for one reader; closes `ended` when they end, however they do."""

    def __init__(
        self, lines: AsyncIterator[bytes], ended: contextlib.AsyncExitStack, headers: Mapping[str, str]
    ) -> None:
        super().__init__(lines, media_type=EVENT_STREAM, headers=headers)
        self._ended = ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with self._ended:
            await super().__call__(scope, receive, send)


def _undo(joining: asyncio.Future[Callable[[], None]]) -> None:
    """Withdraw the subscriptions of a reader that has gone."""
    if not joining.cancelled() and joining.exception() is None:
        with contextlib.suppress(RuntimeError):  # the server ends, and so do its threads
            joining.get_loop().run_in_executor(None, joining.result())


Names = Annotated[frozenset[str], Meta(max_length=NAMES)]


class _Asked(Struct, frozen=True):
    """Parameters of all paths and of `subscribe`."""

    stream: str
    topics: frozenset[Literal["tracks", "events", "zones", "problems"]] = frozenset({"tracks"})
    classes: Names = frozenset()
    confirmed: bool = True
    min_existence: Annotated[float, Meta(ge=0, le=1)] = 0.0
    max_rate_hz: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    fields: Names = frozenset()
    events: Literal["final", "now"] = "final"
    predict: bool = False
    after: str = ""


PARAMETERS: Final = _Asked.__struct_fields__
FORMAT: Final = "format"  # of `GET /api/v1/tracks`
SELECTION: Final = frozenset({"stream", "classes", "confirmed", "min_existence", "fields", "predict"})


class _Incoming(Struct, forbid_unknown_fields=True):
    """A message of a WebSocket's client."""

    subscribe: dict[str, Any]


def parameters_of(connection: HTTPConnection, known: Iterable[str]) -> dict[str, str]:
    """Return the parameters of a request.

    Raises:
        MessageError: one is not known, or given twice; with its name as path.
    """
    pairs, names = connection.query_params.multi_items(), sorted(known)
    found = dict(pairs)
    for name in found:
        if name not in names:
            raise schemas.MessageError("invalid_value", name, f"one of {', '.join(names)}", "another parameter")
        if (count := sum(each == name for each, _ in pairs)) > 1:
            raise schemas.MessageError("invalid_value", name, "one value, with commas for several", f"{count} of them")
    return found


def wish_of(parameters: Mapping[str, Any]) -> Wish:
    """Return what a reader asks for.

    Raises:
        MessageError: a parameter is wrong; with its name as path.
    """
    lists = {"topics", "classes", "fields"}
    values = {
        name: value.split(",") if name in lists and isinstance(value, str) else value
        for name, value in parameters.items()
    }
    for name in values.keys() - set(PARAMETERS):
        raise schemas.MessageError("invalid_value", name, f"one of {', '.join(PARAMETERS)}", "another parameter")
    if "stream" not in values:
        raise schemas.MessageError("missing_field", "stream", "a pattern, as garage/*/*", "nothing")
    for name in lists & values.keys():
        if isinstance(values[name], list) and not all(values[name]):
            raise schemas.MessageError("invalid_value", name, "names; leave it out for the default", "an empty name")
    try:
        asked = msgspec.convert(values, _Asked, strict=False)
    except msgspec.ValidationError as error:
        expected, _, path = str(error).rpartition(" - at `$.")
        path = path.rstrip("`")
        name = path.partition("[")[0]
        received = ascii(values[name])[:80]
        path = name if isinstance(parameters[name], str) else path  # as it was written: with commas, or as a list
        raise schemas.MessageError("invalid_value", path, expected.removeprefix("Expected "), received) from None
    if wrong := asked.fields - FIELDS:
        raise schemas.MessageError("invalid_value", "fields", f"of {', '.join(sorted(FIELDS))}", ascii(min(wrong))[:80])
    selection = Selection(asked.classes, asked.confirmed, asked.min_existence, asked.fields)
    rate, final = asked.max_rate_hz, asked.events == "final"
    return Wish((asked.stream,), asked.topics, selection, rate, final, asked.predict, asked.after)


class Api:
    """Routes below `/api/v1`."""

    def __init__(self, readers: Readers) -> None:
        self._readers = readers

    def routes(self) -> list[Route | WebSocketRoute]:
        answers = {"streams": self.streams, "tracks": self.tracks, "zones": self.zones, "stream": self.stream}
        gets = [Route(f"/api/v1/{name}", answer) for name, answer in answers.items()]
        return [*gets, WebSocketRoute("/api/v1/ws", self.socket)]

    async def streams(self, request: Request) -> Response:
        """Answer with the sessions of a pattern, or of all streams that the caller may read."""
        caller = await self._readers.caller(request)
        pattern = parameters_of(request, ["stream"]).get("stream", caller.pattern)
        Wish((pattern,), frozenset({"tracks"})).keys(self._readers.keys)
        caller.may_read(pattern)
        found = await listed(self._readers.feeds().session, self._readers.keys, pattern)
        texts = [b'{"instance":"%b",%b' % (name.encode(), schemas.encode_json(one)[1:]) for name, one in found]
        return _array(texts)

    async def tracks(self, request: Request) -> Response:
        """Answer with the newest frame of each stream, as JSON or as the points of a map."""
        _, wish = await self._asked(request, SELECTION | {FORMAT})
        if (form := request.query_params.get(FORMAT, "json")) not in {"json", "geojson"}:
            raise schemas.MessageError("invalid_value", FORMAT, "json or geojson", ascii(form)[:80])
        if wish.predict:
            raise schemas.MessageError("invalid_value", "predict", "0 here: `stream` and `ws` predict", "1")
        (key,) = wish.keys(self._readers.keys)
        newest, selection = await self._newest(key), wish.selection
        if form == "json":
            return _array([one.tracks(selection, self._readers.stale_s) for one in newest])
        if nowhere := [one.message.stream for one in newest if one.place is None]:
            raise schemas.MessageError("invalid_value", "sites", f"the place of the site of {nowhere[0]}", "none")
        if selection.fields:
            selection = msgspec.structs.replace(selection, fields=selection.fields | {"lat", "lon", "alt", "object"})
        text = features_json(one.tracks(selection, self._readers.stale_s) for one in newest)
        return Response(text, media_type="application/geo+json", headers=HEADERS)

    async def zones(self, request: Request) -> Response:
        """Answer with the newest counts of the zones of each stream."""
        _, wish = await self._asked(request, ["stream"])
        key = self._readers.keys.matching(wish.streams[0], "events")
        newest = await self._newest(key, RECENT, lambda one: one.zones is not None)
        return _array([one.zones or b"" for one in newest])

    async def stream(self, request: Request) -> Response:
        """Answer with server-sent events."""
        _, wish = await self._asked(request)
        wish = replace(wish, after=request.headers.get("last-event-id", wish.after))
        keys = wish.keys(self._readers.keys)
        return await self._readers.stream(request, keys, lambda: Reader(wish, self._readers.stale_s), HEADERS)

    async def socket(self, websocket: WebSocket) -> None:
        """Serve a WebSocket."""
        caller, wish = await self._asked(websocket)
        with self._readers.room.entered():
            reader = Reader(wish, self._readers.stale_s)
            async with contextlib.AsyncExitStack() as joined:
                await joined.enter_async_context(self._readers.joined(wish.keys(self._readers.keys), reader))
                await websocket.accept(PROTOCOL if PROTOCOL in websocket.scope["subprotocols"] else None)
                listening = self._listen(websocket, caller, reader, joined)
                works = _send(websocket, reader), listening, self._revoke(websocket, caller)
                tasks = [asyncio.create_task(work) for work in works]
                try:
                    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for task in tasks:
                        task.cancel()
                    await asyncio.wait(tasks)
                for task in done:
                    task.result()

    async def _revoke(self, websocket: WebSocket, caller: Caller) -> None:
        """Close a WebSocket when its token is not valid any more."""
        await self._readers.revoked(websocket, caller)
        await websocket.close(MALFORMED, NOT_VALID)

    async def _listen(
        self, websocket: WebSocket, caller: Caller, reader: Reader, joined: contextlib.AsyncExitStack
    ) -> None:
        """Change what a reader wants as often as it says so, until it goes."""
        while (message := await websocket.receive())["type"] != "websocket.disconnect":
            text = message.get("text") or ""
            if len(text) > MESSAGE_CHARACTERS:
                await websocket.close(TOO_BIG)
                return
            try:
                wish = wish_of(msgspec.json.decode(text, type=_Incoming).subscribe)
                keys = wish.keys(self._readers.keys)
                caller.may_read(wish.streams[0])
            except (msgspec.DecodeError, schemas.MessageError, NotAllowedError) as error:
                await websocket.close(MALFORMED, str(error)[:100])
                return
            reader.want(wish)
            async with joined.pop_all():  # the earlier subscriptions stay until the new ones are there
                try:
                    await joined.enter_async_context(self._readers.joined(keys, reader))
                except TransportError as error:
                    await websocket.close(TRY_AGAIN, str(error)[:100])
                    return

    async def _asked(self, connection: HTTPConnection, known: Iterable[str] = PARAMETERS) -> tuple[Caller, Wish]:
        """Return the caller and a wish that it may read."""
        caller = await self._readers.caller(connection)
        parameters = parameters_of(connection, known)
        wish = wish_of({name: value for name, value in parameters.items() if name != FORMAT})
        wish.keys(self._readers.keys)
        caller.may_read(wish.streams[0])
        return caller, wish

    async def _newest(
        self, key: str, most: int = 1, fits: Callable[[Publication], bool] = lambda _: True
    ) -> list[Publication]:
        """Return the newest message of each stream, by stream, from its newest run."""
        newest: dict[str, Publication] = {}
        found = await asyncio.to_thread(self._readers.feeds().newest, key, most)
        for one in sorted((one for one in found if one.message is not None and fits(one)), key=_order):
            newest[one.message.stream] = one
        return [newest[stream] for stream in sorted(newest)]


def _order(one: Publication) -> tuple[int, int]:
    delivery = one.message.delivery
    return (0, 0) if delivery is None else (delivery.run, delivery.published_ns)


def _array(texts: Iterable[bytes]) -> Response:
    return Response(b"[%b]" % b",".join(texts), media_type="application/json", headers=HEADERS)


async def _send(websocket: WebSocket, reader: Reader) -> None:
    """Send the texts of a reader, each when the one before has gone."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # it has gone
        while True:
            await websocket.send_text((await reader.take())[0].decode())

"""HTTP for orchestrators, Prometheus and people: uvicorn on a thread with a loop of its own; neither side waits.

Only requests by a name of this service are answered. A browser that was led to a page of a stranger can be made to ask
a service of its own network: the stranger lets his name point to its address (DNS rebinding). Such a request carries
the stranger's name. Addresses, names without a dot (`localhost`, a container, a host of the same network) and the names
of the settings are answered, others are not. Probes and Prometheus ask by names with a domain
(`tracker.site.svc.cluster.local`): their paths, which show no tracks, are answered under any name.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import h11
import uvicorn
from optipmb_client.errors import ClientError
from optipmb_schemas import openapi
from optipmb_schemas.asyncapi import document
from optipmb_schemas.errors import show
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol
from wsproto.events import CloseConnection

from optipmb_service.edges.http.api import MALFORMED, STATUS, Api, Readers, parameters_of, refusal, refuse
from optipmb_service.edges.http.detections import Senders
from optipmb_service.edges.http.page import page
from optipmb_service.edges.http.tls import ServerCertificate
from optipmb_service.telemetry.metrics import CONTENT_TYPE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from optipmb_schemas.json_form import Place
    from starlette.requests import Request
    from starlette.types import ASGIApp, Receive, Scope, Send

    from optipmb_service.edges.http.api import Room
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

GRACE_S: Final = 1  # how long an answer under way may take at the end
CONNECTIONS: Final = 256  # open connections; a further one closes an idle one
REQUESTS: Final = 64  # requests answered at once, without probes, readers and senders
HEAD_S: Final = 5.0  # longest time from the begin of a connection until its first request is complete
KEEP_ALIVE_S: Final = 5
HEAD_BYTES: Final = 16 * 1024
SEND_S: Final = 30.0  # a connection whose peer takes nothing for so long is aborted
SEND_BYTES: Final = 2**16  # what the system holds for a connection, so that it is soon known
SLICE: Final = 4096  # bytes of a WebSocket, and of the head of a request, that are read in one turn of the loop
CHUNKED_SLICE: Final = 1024  # the same of a body in chunks
PIECES: Final = 256  # pieces of a message that may be smaller than `PIECE_BYTES`
PIECE_BYTES: Final = 512
PINGS: Final = 1000  # pings of a peer between two of its messages
LINGER_S: Final = 1.0  # how long a refused peer may take to read why
PING_S: Final = 20.0  # period of pings, and longest wait for their answers

BAD: Final = 400
UNAVAILABLE: Final = 503
FORBIDDEN: Final = 403
NOT_FOUND: Final = 404
MISDIRECTED: Final = 421
ANY: Final = "*"

PROBES: Final = frozenset({"/healthz", "/readyz"})  # paths that are answered however many other requests are
MONITORING: Final = PROBES | {"/metrics"}  # paths for programs, answered under any host name


def application(
    health: ProcessHealth,
    settings: Settings,
    places: Mapping[str, Place] | None = None,
    interface: Callable[[], str] = document,
    sessions: Callable[[str], str] = str,
) -> ASGIApp:
    """Return the application: health, readiness, metrics, the JSON interface, and the page.

    Args:
        health: of the process.
        settings: of the process.
        places: of the world frames of sites that have one.
        interface: returns the AsyncAPI document.
        sessions: returns the session that a stream feeds; by default its own.

    Raises:
        ClientError: the tokens cannot be used.
    """

    # Coroutines: probes wait for no thread.
    async def alive(_: Request) -> Response:
        well = health.alive()
        return _answer({"alive": well, "beat_age_s": round(health.beat_age_s(), 3)}, well=well)

    async def ready(_: Request) -> Response:
        well = health.ready()
        body: dict[str, object] = {"ready": well, "state": health.state()}
        if failure := health.failure():
            body["failure"] = failure
        if settings.unprotected:
            body["unprotected"] = settings.unprotected
        if senders.room.refused:
            body["senders_refused"] = {name or "anybody": count for name, count in senders.room.refused.items()}
        return _answer(body, well=well)

    # No coroutine: Starlette runs it on a thread, so that making the metrics of many streams delays no other answer.
    def metrics(_: Request) -> Response:
        return Response(health.metrics.text(), media_type=CONTENT_TYPE, headers={"cache-control": "no-store"})

    routes: list[BaseRoute] = [Route("/healthz", alive), Route("/readyz", ready), Route("/metrics", metrics)]
    places = places or {}
    readers = Readers(health, settings, places)
    senders = Senders(health, readers, settings, places, sessions)
    routes += [
        Route("/api/v1/asyncapi.json", _document(interface)),
        Route("/openapi.json", _document(partial(openapi.document, settings.http or openapi.ADDRESS))),
        *Api(readers).routes(),
        *senders.routes(),
        *page(health, readers, settings, places),
    ]
    paths = {route.path: sorted(route.methods or ()) for route in routes if isinstance(route, Route)}

    async def not_there(request: Request, error: HTTPException) -> Response:
        code = "not_found" if error.status_code == NOT_FOUND else "method_not_allowed"
        message = f"{request.method} {show(request.url.path)[1:-1]}: {error.detail}; see `paths` for what there is"
        return refusal(error.status_code, code, message, headers=error.headers, paths=paths)

    refusals: dict[Any, Any] = dict.fromkeys(STATUS, refuse) | {HTTPException: not_there}
    answers: ASGIApp = Starlette(routes=routes, exception_handlers=refusals)
    if settings.http_origins:
        allowed = ["authorization", "content-type", "idempotency-key"]
        origins = settings.http_origins
        answers = CORSMiddleware(answers, allow_origins=origins, allow_methods=["GET", "POST"], allow_headers=allowed)
    return _Guarded(answers, settings, (readers.room, senders.room))


def _document(make: Callable[[], str]) -> Callable[[Request], Response]:
    """Return what answers with a document in JSON."""

    def answer(request: Request) -> Response:
        parameters_of(request, ())
        return Response(make(), media_type="application/json", headers={"cache-control": "no-store"})

    return answer


def _answer(body: dict[str, object], *, well: bool) -> Response:
    return JSONResponse(body, status_code=200 if well else UNAVAILABLE, headers={"cache-control": "no-store"})


class _Guarded:
    """An application that answers known host names, and a bounded number of requests beside probes, readers, senders.

    A WebSocket is opened, and a POST answered, for programs, for pages of this service, and for pages of
    `http_origins`: a browser asks for both for the page of a stranger.
    """

    def __init__(self, application: ASGIApp, settings: Settings, rooms: Sequence[Room]) -> None:
        self._application = application
        self._rooms = rooms
        self._names = {name.lower().rstrip(".") for name in settings.http_hosts}
        self._origins = settings.http_origins
        self._requests = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        answer: Any = self._application
        is_socket, path = scope["type"] == "websocket", scope.get("path", "")
        if path in PROBES and not is_socket:
            await answer(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if self._requests - sum(room.count for room in self._rooms) >= REQUESTS:
            answer = refusal(UNAVAILABLE, "busy", f"{REQUESTS} requests are being answered; ask again")
        elif {"content-length", "transfer-encoding"} <= set(headers):  # a proxy in front may go by the other one
            closes = {"connection": "close"}
            reason = "content-length or transfer-encoding is expected, not both"
            answer = refusal(BAD, "malformed", reason, headers=closes)
        elif (path not in MONITORING or is_socket) and not self._knows(headers.get("host", "")):
            answer = refusal(MISDIRECTED, "unknown_host", "unknown host; see the setting http_hosts")
        elif (is_socket or scope["method"] == "POST") and not self._welcomes(headers):
            answer = refusal(FORBIDDEN, "other_origin", "page of another origin; see the setting http_origins")
        self._requests += 1
        try:
            await answer(scope, receive, send)
        finally:
            self._requests -= 1

    def _welcomes(self, headers: Headers) -> bool:
        origin = headers.get("origin")
        own = origin is None or origin.partition("://")[2] == headers.get("host")
        return own or origin in self._origins or ANY in self._origins

    def _knows(self, host: str) -> bool:
        name = host.lower()
        name = name[1:].partition("]")[0] if name.startswith("[") else name.partition(":")[0]
        name = name.rstrip(".")
        if ANY in self._names or name in self._names or "." not in name:
            return bool(name) or ANY in self._names
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


class Server:
    """A running HTTP server; it listens when the constructor returns.

    Args:
        application: the application that it serves.
        address: `host:port` or `[v6]:port`; port 0 takes any free one.
        message_bytes: largest message of a WebSocket's client.
        certificate: folder with `key.pem` and `cert.pem`; default: no TLS.

    Raises:
        ClientError: the address cannot be listened on, or the certificate not used.
    """

    def __init__(self, application: ASGIApp, address: str, message_bytes: int, certificate: Path | None = None) -> None:
        context = None if certificate is None else ServerCertificate(certificate).context
        host, _, port = address.rpartition(":")
        host = host.strip("[]")
        try:
            family = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, int(port)), family=family, backlog=CONNECTIONS)
        except OSError as error:
            raise ClientError(f"cannot listen on {address} for HTTP: {error.strerror or error}") from error
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)  # connections inherit it
        bound = self._socket.getsockname()
        self.address = f"[{bound[0]}]:{bound[1]}" if family == socket.AF_INET6 else f"{bound[0]}:{bound[1]}"
        config = uvicorn.Config(
            application,
            loop=f"{__name__}:_Loop",
            http=_Connection,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=GRACE_S,
            h11_max_incomplete_event_size=HEAD_BYTES,
            ws=_Socket,
            ws_max_size=message_bytes,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
        )
        config.load()
        config.ssl = context
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="http", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the server; answers under way have a second. May be called twice."""
        self._server.should_exit = True
        self._thread.join(2 * GRACE_S)
        if not self._thread.is_alive():  # else it closes the socket itself, and would fail without one
            self._socket.close()


class _Loop(asyncio.SelectorEventLoop):
    """A loop whose servers end a connection that does not complete its handshake soon."""

    async def create_server(self, *arguments: Any, **options: Any) -> asyncio.Server:
        """Listen as the base class does."""
        if options.get("ssl") is not None:
            options["ssl_handshake_timeout"] = HEAD_S
        return await super().create_server(*arguments, **options)


class _Bounded(asyncio.Protocol):
    """A connection that is aborted when its peer takes nothing for `SEND_S`, or when others need its place.

    Where all places are taken, the connection that has been idle for the longest time is closed; where all are busy,
    the one that has been busy for the longest time. So probes are always answered.
    """

    loop: asyncio.AbstractEventLoop
    transport: asyncio.Transport
    connections: set[Any]
    _limit: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as the base classes have it
        super().connection_made(transport)
        self.since = time.monotonic()
        if len(self.connections) > CONNECTIONS:
            others = [one for one in self.connections if one is not self]
            victim = min(others, key=lambda one: (one.is_busy, one.since))
            self.connections.discard(victim)  # it is lost with the loop's next turn: others may come before
            victim.transport.abort()

    @property
    def is_busy(self) -> bool:
        """Whether it is in use."""
        return True

    def pause_writing(self) -> None:
        super().pause_writing()
        self._limit = self.loop.call_later(SEND_S, self.transport.abort)

    def resume_writing(self) -> None:
        self._end_limit()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._end_limit()
        super().connection_lost(exc)

    def _end_limit(self) -> None:
        if self._limit is not None:
            self._limit.cancel()


class _Socket(_Bounded, WSProtocol):
    """A WebSocket of which a turn of the loop reads a bounded part, so that none delays the others."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._unread = bytearray()
        self._reading: asyncio.Handle | None = None
        self._pieces = self._pings = 0
        self._refused = False

    def data_received(self, data: bytes) -> None:
        if not self._refused:
            self._unread += data
            if self._reading is None and not self.read_paused:
                self._read()

    async def receive(self) -> Any:
        """Return the next message, and go on with those behind it."""
        message = await super().receive()
        if self._unread and self._reading is None and not self.read_paused:
            self.transport.pause_reading()
            self._reading = self.loop.call_soon(self._read)
        return message

    def handle_message(self, event: Any) -> None:
        self._pieces += event.frame_finished
        super().handle_message(event)
        if self._pieces > PIECES and 0 < self.buffer.length < self._pieces * PIECE_BYTES:
            self._refuse(f"a message in pieces of {PIECE_BYTES} bytes or more is expected")
        if event.message_finished:
            self._pieces = self._pings = 0

    def handle_ping(self, event: Any) -> None:
        self._pings += 1
        super().handle_ping(event)
        if self._pings > PINGS:
            self._refuse(f"at most {PINGS} pings between two messages are expected")

    def connection_lost(self, exc: Exception | None) -> None:
        self._unread.clear()
        super().connection_lost(exc)

    def _read(self) -> None:
        """Read a part; the next one is read in another turn, when the application has taken the message before."""
        self._reading = None
        part = bytes(self._unread[:SLICE])
        del self._unread[:SLICE]
        if part and not self.transport.is_closing():
            super().data_received(part)
        if self._refused:
            self._unread.clear()
        if self.read_paused:
            return
        if self._unread:
            self.transport.pause_reading()
            self._reading = self.loop.call_soon(self._read)
        else:
            self.transport.resume_reading()

    def _refuse(self, reason: str) -> None:
        """Close with the reason; what its peer still sends is not looked at, so that it can read this."""
        if not self.close_sent:
            self.close_sent = self._refused = True
            self.queue.put_nowait({"type": "websocket.disconnect", "code": MALFORMED, "reason": reason})
            self.transport.write(self.conn.send(CloseConnection(code=MALFORMED, reason=reason)))
            self.close_timer = self.loop.call_later(LINGER_S, self.transport.abort)


class _Connection(_Bounded, H11Protocol):
    """A connection that ends when its first request does not come.

    Of a head, and of a body in chunks, which may be tiny, a turn of the loop reads a bounded part.
    """

    _reading: asyncio.Handle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as the base class has it
        super().connection_made(transport)
        self._unread = bytearray()
        self._head = self.loop.call_later(HEAD_S, self._end_without_request)

    def connection_lost(self, exc: Exception | None) -> None:
        self._head.cancel()
        self._unread.clear()
        if self._reading is not None:
            self._reading.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._unread += data
        if self._reading is None:
            self._read()

    def _read(self) -> None:
        self._reading = None
        most = SLICE
        if self.conn.their_state is h11.SEND_BODY:
            is_chunked = any(name == b"transfer-encoding" for name, _ in self.headers)
            most = CHUNKED_SLICE if is_chunked else len(self._unread)
        part = bytes(self._unread[:most])
        del self._unread[:most]
        super().data_received(part)
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            self._unread.clear()
        elif self._unread:
            self.transport.pause_reading()
            self._reading = self.loop.call_soon(self._read)
        elif not self.flow.read_paused:
            self.transport.resume_reading()

    def on_response_complete(self) -> None:
        self.since = time.monotonic()
        super().on_response_complete()

    @property
    def is_busy(self) -> bool:
        """Whether a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def _end_without_request(self) -> None:
        if self.headers is None:
            self.transport.abort()  # type: ignore[unreachable]  # uvicorn types the headers as always there

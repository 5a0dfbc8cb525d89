"""HTTP for orchestrators, Prometheus and people: uvicorn on a thread with a loop of its own; neither side waits.

Only requests by a name of this service are answered. A browser that was led to a page of a stranger can be made to ask
a service of its own network: the stranger lets his name point to its address (DNS rebinding). Such a request carries
the stranger's name. Addresses, names without a dot (`localhost`, a container, a host of the same network) and the names
of the settings are answered, others are not. Probes and Prometheus ask by names with a domain
(`tracker.site.svc.cluster.local`): their paths, which show no tracks, are answered under any name.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import uvicorn
from optipmb_client.errors import ClientError
from optipmb_schemas.asyncapi import document
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from optipmb_service.http.page import page
from optipmb_service.telemetry.metrics import CONTENT_TYPE

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Collection, Mapping

    from starlette.requests import Request
    from starlette.types import ASGIApp, Receive, Scope, Send

    from optipmb import Georeference
    from optipmb_service.telemetry.health import ProcessHealth

GRACE_S: Final = 1  # how long an answer under way may take at the end
CONNECTIONS: Final = 256  # open connections; a further one closes an idle one
REQUESTS: Final = 64  # requests answered at once, without probes; more than the viewers of the page
HEAD_S: Final = 5.0  # longest time from the begin of a connection until its first request is complete
KEEP_ALIVE_S: Final = 5
HEAD_BYTES: Final = 16 * 1024

UNAVAILABLE: Final = 503
MISDIRECTED: Final = 421
ANY: Final = "*"

PROBES: Final = frozenset({"/healthz", "/readyz"})  # paths that are answered however many other requests are
MONITORING: Final = PROBES | {"/metrics"}  # paths for programs, answered under any host name


def application(
    health: ProcessHealth,
    names: Collection[str] = (),
    sites: Mapping[str, Georeference] | None = None,
    interface: Callable[[], str] = document,
) -> ASGIApp:
    """Return the application: health, readiness, metrics, and the page.

    Args:
        health: of the process.
        names: names of this service in addition to addresses and names without a dot; `*`: any.
        sites: place of the world frame of each site that has one.
        interface: returns the AsyncAPI document.
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
        return _answer(body, well=well)

    # No coroutine: Starlette runs it on a thread, so that making the metrics of many streams delays no other answer.
    def metrics(_: Request) -> Response:
        return Response(health.metrics.text(), media_type=CONTENT_TYPE, headers={"cache-control": "no-store"})

    def asyncapi(_: Request) -> Response:
        return Response(interface(), media_type="application/json", headers={"cache-control": "no-store"})

    routes = [Route("/healthz", alive), Route("/readyz", ready), Route("/metrics", metrics)]
    routes += [Route("/api/v1/asyncapi.json", asyncapi), *page(health, sites)]
    return _Guarded(Starlette(routes=routes), names)


def _answer(body: dict[str, object], *, well: bool) -> Response:
    return JSONResponse(body, status_code=200 if well else UNAVAILABLE, headers={"cache-control": "no-store"})


class _Guarded:
    """An application that answers known host names, and a bounded number of requests at once, without probes."""

    def __init__(self, application: ASGIApp, names: Collection[str]) -> None:
        self._application = application
        self._names = {name.lower().rstrip(".") for name in names}
        self._requests = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        answer: Any = self._application
        path = scope["path"] if scope["type"] == "http" else ""
        if path in PROBES:
            await answer(scope, receive, send)
            return
        if self._requests >= REQUESTS:
            answer = PlainTextResponse(f"{REQUESTS} requests are being answered; ask again", status_code=UNAVAILABLE)
        elif path and path not in MONITORING and not self._knows(Headers(scope=scope).get("host", "")):
            answer = PlainTextResponse("unknown host; see the setting http_hosts", status_code=MISDIRECTED)
        self._requests += 1
        try:
            await answer(scope, receive, send)
        finally:
            self._requests -= 1

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

    Raises:
        ClientError: the address cannot be listened on.
    """

    def __init__(self, application: ASGIApp, address: str) -> None:
        host, _, port = address.rpartition(":")
        host = host.strip("[]")
        try:
            family = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, int(port)), family=family, backlog=CONNECTIONS)
        except OSError as error:
            raise ClientError(f"cannot listen on {address} for HTTP: {error.strerror or error}") from error
        bound = self._socket.getsockname()
        self.address = f"[{bound[0]}]:{bound[1]}" if family == socket.AF_INET6 else f"{bound[0]}:{bound[1]}"
        self._server = uvicorn.Server(
            uvicorn.Config(
                application,
                loop="asyncio",
                http=_Connection,
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                timeout_keep_alive=KEEP_ALIVE_S,
                timeout_graceful_shutdown=GRACE_S,
                h11_max_incomplete_event_size=HEAD_BYTES,
            )
        )
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="http", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the server; answers under way have a second. May be called twice."""
        self._server.should_exit = True
        self._thread.join(2 * GRACE_S)
        self._socket.close()


class _Connection(H11Protocol):
    """A connection that ends when its first request does not come, or when others need its place.

    Where all places are taken, the connection that has been idle for the longest time is closed; where all are busy,
    the one that has been busy for the longest time. So probes are always answered.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as the base class has it
        super().connection_made(transport)
        self._since = time.monotonic()
        self._head = self.loop.call_later(HEAD_S, self._end_without_request)
        if len(self.connections) > CONNECTIONS:
            others = [one for one in self.connections if one is not self and isinstance(one, _Connection)]
            victim = min(others, key=lambda one: (one.is_busy, one._since))  # noqa: SLF001 - of the same class
            self.connections.discard(victim)  # it is lost with the loop's next turn: others may come before
            victim.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._head.cancel()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self._since = time.monotonic()
        super().on_response_complete()

    @property
    def is_busy(self) -> bool:
        """Whether a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def _end_without_request(self) -> None:
        if self.headers is None:
            self.transport.abort()  # type: ignore[unreachable]  # uvicorn types the headers as always there

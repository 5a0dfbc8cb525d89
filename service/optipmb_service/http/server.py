"""The application on a port: uvicorn on a thread with a loop of its own, so that neither side waits for the other."""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import uvicorn
from starlette.responses import PlainTextResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

from optipmb_service.http.app import PROBES, UNAVAILABLE
from optipmb_service.runtime.ports import HttpError

if TYPE_CHECKING:
    import asyncio

    from starlette.types import ASGIApp, Receive, Scope, Send

GRACE_S: Final = 1
"""How long an answer under way may take at the end."""

CONNECTIONS: Final = 256
"""Open connections; a further one closes an idle one."""

REQUESTS: Final = 64
"""Requests answered at once, beside those of probes; more than the viewers of the page."""

HEAD_S: Final = 5.0
"""Longest time from the begin of a connection until its first request is complete."""

KEEP_ALIVE_S: Final = 5
HEAD_BYTES: Final = 16 * 1024


class Server:
    """A running HTTP server; it listens when the constructor returns.

    Args:
        application: what it serves.
        address: `host:port` or `[v6]:port`; port 0 takes any free one.

    Raises:
        HttpError: the address cannot be listened on.
    """

    def __init__(self, application: ASGIApp, address: str) -> None:
        host, _, port = address.rpartition(":")
        host = host.strip("[]")
        try:
            family = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, int(port)), family=family, backlog=CONNECTIONS)
        except OSError as error:
            raise HttpError(f"cannot listen on {address} for HTTP: {error.strerror or error}") from error
        bound = self._socket.getsockname()
        self.address = f"[{bound[0]}]:{bound[1]}" if family == socket.AF_INET6 else f"{bound[0]}:{bound[1]}"
        self._server = uvicorn.Server(
            uvicorn.Config(
                _Bounded(application),
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
    the one that has been busy for the longest time. So nobody keeps a probe out.
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
        if self.headers is None:  # its type says that it never is
            self.transport.abort()  # type: ignore[unreachable]


class _Bounded:
    """An application that answers so many requests at once, and those of probes beside them."""

    def __init__(self, application: ASGIApp) -> None:
        self._application = application
        self._requests = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        answer: Any = self._application
        if scope["type"] == "http" and scope["path"] in PROBES:
            await answer(scope, receive, send)
            return
        if self._requests >= REQUESTS:
            answer = PlainTextResponse(f"{REQUESTS} requests are being answered; ask again", status_code=UNAVAILABLE)
        self._requests += 1
        try:
            await answer(scope, receive, send)
        finally:
            self._requests -= 1

"""The application on a port: uvicorn on a thread with a loop of its own, so that neither side waits for the other."""

from __future__ import annotations

import socket
import threading
from typing import TYPE_CHECKING, Final

import uvicorn

from optipmb_service.runtime.ports import HttpError

if TYPE_CHECKING:
    from starlette.types import ASGIApp

GRACE_S: Final = 1
"""How long an answer under way may take at the end."""

CONNECTIONS: Final = 64
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
                application,
                loop="asyncio",
                http="h11",
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                limit_concurrency=CONNECTIONS,
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

"""The gateway beside the service, on a thread with a loop of its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import TYPE_CHECKING

import structlog

from optipmb_service.grpc.server import GRACE_S, Server

if TYPE_CHECKING:
    from collections.abc import Iterator

    from optipmb_service.grpc.metrics import CallMetrics
    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")


@contextlib.contextmanager
def serving(settings: Settings, client: Client) -> Iterator[CallMetrics]:
    """Serve meanwhile, on a thread with a loop of its own: neither side waits for the other.

    Raises:
        EdgeError: the address, the certificates or the access cannot be used.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="grpc", daemon=True)
    thread.start()

    async def begin() -> Server:
        server = Server(settings, client)
        await server.start()
        return server

    server: Server | None = None
    try:
        server = asyncio.run_coroutine_threadsafe(begin(), loop).result()
        log.info("grpc", address=server.address)
        yield server.metrics
    finally:
        if server is not None:
            with contextlib.suppress(TimeoutError):
                asyncio.run_coroutine_threadsafe(server.stop(), loop).result(2 * GRACE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(GRACE_S)

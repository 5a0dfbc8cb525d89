"""The gateway as a process of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.app import process
from optipmb_service.app.loops import say_ready, settle
from optipmb_service.grpc.server import Server

if TYPE_CHECKING:
    from optipmb_service.app.loops import StopRequest
    from optipmb_service.observability.health import ProcessHealth
    from optipmb_service.settings.model import Settings
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")


class _Gateway:
    """What a gateway reports: whether it can be used."""

    stuck: Final = False

    def __init__(self, client: Client) -> None:
        self._client = client

    @property
    def state(self) -> str:
        """Ready while it has a router."""
        return "unlinked" if self.failure else "ready"

    @property
    def failure(self) -> str:
        """Why it cannot be used; empty while it can."""
        return self._client.failure

    def status(self) -> None:
        """Return nothing: a gateway has no streams."""


async def run(settings: Settings) -> int:
    """Serve until SIGINT or SIGTERM; returns the exit status, as `process.run` does."""

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        server = Server(settings, client)
        health.metrics.add(server.metrics.figures)
        await server.start()
        health.report(_Gateway(client))
        settle()
        say_ready("grpc", server.address, settings.connect)
        log.info("ready", instance=settings.instance, grpc=server.address, connect=settings.connect)
        await asked.wait()
        health.ends()
        await server.stop()

    return await process.run_client(settings, serve)

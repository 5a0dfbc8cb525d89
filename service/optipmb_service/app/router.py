"""A Zenoh router alone, for networks whose services and nodes are all clients.

It is the same router as the one inside the service, with the same tuning; access control, TLS and limits come from
the Zenoh configuration file. Health and readiness are those of the service.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

import structlog

from optipmb_service.app import process
from optipmb_service.app.loops import say_ready
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from optipmb_service.app.loops import StopRequest
    from optipmb_service.observability.health import ProcessHealth
    from optipmb_service.settings.model import Settings

log = structlog.get_logger("optipmb_service")


@dataclass(frozen=True)
class _Routing:
    """What a router reports: that it routes."""

    state: str = "ready"
    stuck: bool = False
    failure: str = ""

    def status(self) -> None:
        """Return nothing: a router has no streams."""


async def run(settings: Settings) -> int:
    """Route until SIGINT or SIGTERM; returns the exit status, as `process.run` does."""

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool:
        router = Client(settings)
        health.report(_Routing())
        say_ready("router", settings.instance, settings.endpoints)
        log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
        await asked.wait()
        health.ends()
        await asyncio.to_thread(router.close)
        return True

    return await process.run(settings, serve)

"""Processes that are edges alone: a Zenoh router, and a gRPC gateway.

The router is the same as the one inside the service, with the same tuning; access control, TLS and limits come from
the Zenoh configuration file. Health and readiness are reported as by the service.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import structlog

from optipmb_service.app import lifecycle
from optipmb_service.app.lifecycle import say_ready, settle
from optipmb_service.telemetry.health import Reporter
from optipmb_service.telemetry.metrics import GATEWAY_METRICS
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

log = structlog.get_logger("optipmb_service")


async def run_router(settings: Settings) -> int:
    """Route until SIGINT or SIGTERM; returns the exit status, as `lifecycle.run` does."""

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool:
        router = Client(settings)
        health.report(Reporter(router))
        say_ready("router", settings.instance, settings.endpoints)
        log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
        await asked.wait()
        health.ends()
        await asyncio.to_thread(router.close)
        return True

    return await lifecycle.run(settings, serve)


async def run_gateway(settings: Settings) -> int:
    """Serve gRPC until SIGINT or SIGTERM; returns the exit status, as `lifecycle.run` does."""
    from optipmb_service.grpc.server import Server  # noqa: PLC0415 - an extra that only this needs

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        server = Server(settings, client)
        health.metrics.add(GATEWAY_METRICS, lambda: server.metrics)
        await server.start()
        health.report(Reporter(client))
        settle()
        say_ready("grpc", server.address, settings.connect)
        log.info("ready", instance=settings.instance, grpc=server.address, connect=settings.connect)
        await asked.wait()
        health.ends()
        await server.stop()

    return await lifecycle.run_client(settings, serve)

"""What every process of the service has around its own work: signals, monitoring, log lines and exit status."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import structlog

from optipmb_service import __version__
from optipmb_service.app.certificates import Certificates
from optipmb_service.app.edges import monitoring
from optipmb_service.app.ending import END_HUNG, RESTART, EndBound, longest_end_s
from optipmb_service.app.loops import StopRequest, beat, unless, watch_keys
from optipmb_service.cluster.store import StoreError
from optipmb_service.observability import collectors, logs
from optipmb_service.observability.health import ProcessHealth
from optipmb_service.runtime.ports import EdgeError, TransportError
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from optipmb_service.settings.model import Settings

log = structlog.get_logger("optipmb_service")


async def run(
    settings: Settings, serve: Callable[[StopRequest, ProcessHealth], Awaitable[bool | None]], **about: Any
) -> int:
    """Work until SIGINT or SIGTERM.

    Args:
        settings: what is in force.
        serve: does the work until the end is asked for; returns whether it ended in order, None when it never began.
        about: more for the first line of the log.

    Returns:
        The exit status: 0, or 1 when the network, an address or the store cannot be used, or a step of the end hung;
        `RESTART` where the process is to begin again.
    """
    asked = StopRequest(EndBound(longest_end_s(settings.grace_s)))
    log.info("starting", instance=settings.instance, version=__version__, **about)
    health = ProcessHealth(settings.instance)
    beating = asyncio.create_task(beat(health))
    watching: asyncio.Task[None] | None = None
    try:
        health.tls = certificates = Certificates(settings)
        health.metrics.add(certificates.figures)
        watching = asyncio.create_task(certificates.watch())
        with monitoring(settings, health):
            ended = await serve(asked, health)
    except (TransportError, EdgeError, StoreError) as error:
        logs.say(f"optipmb-service: {error}")
        return 1
    finally:
        asked.bound.begin()  # also where nobody asked
        beating.cancel()
        if watching is not None:
            watching.cancel()
    if ended is not None:
        log.info("stopped", drained=ended)
    if asked.restarts:
        return RESTART
    return END_HUNG if ended is False else 0


async def run_client(settings: Settings, serve: Callable[[StopRequest, ProcessHealth, Client], Awaitable[None]]) -> int:
    """Do the same with a connection to a router, which is closed at the end."""

    async def connected(asked: StopRequest, health: ProcessHealth) -> bool | None:
        log.info("connecting", endpoints=settings.connect)
        client = await unless(asked, lambda: Client(settings))
        if client is None:
            return None
        health.metrics.add(lambda: collectors.of_network(client.key_numbers.declared, linked=client.linked()))
        watching = asyncio.create_task(watch_keys(asked, lambda: client.key_numbers, settings.restart_keys))
        try:
            await serve(asked, health, client)
        finally:
            watching.cancel()
            asked.bound.begin()
            await asyncio.to_thread(client.close)
        return True

    return await run(settings, connected)

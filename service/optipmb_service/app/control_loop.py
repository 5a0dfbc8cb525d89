"""The control loop of a process that tracks: its start, its timers, its end.

asyncio runs on the main thread and does little: signals, the deadlines of frames that wait for their clouds, and once a
second the streams that fell silent and the summaries of problems. Messages never pass through it.

Start: compile the kernels, start the `Service`, print the ready line. End: SIGINT or SIGTERM, or the parent says so.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

import structlog

from optipmb_service.app import process
from optipmb_service.app.edges import grpc_edge
from optipmb_service.app.kernels import warm_up
from optipmb_service.app.loops import say_ready, settle, unless, watch_keys
from optipmb_service.app.service import Service

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from optipmb_service.app.loops import StopRequest
    from optipmb_service.observability.health import ProcessHealth
    from optipmb_service.runtime.profiles import Profiles
    from optipmb_service.settings.model import Settings

log = structlog.get_logger("optipmb_service")

HOUSEKEEPING_S: Final = 0.5


class Parent(Protocol):
    """What a process that tracks is to the one that started it."""

    @property
    def private(self) -> Path | None:
        """Folder that it shares with the others of the same parent; None: it has no parent."""

    @property
    def announces(self) -> bool:
        """Whether it is an instance of its own to the network."""

    def begin(self, asked: StopRequest) -> None:
        """Listen for orders; the end may be one."""

    def warm_up(self) -> None:
        """Have the kernels ready."""

    def ready(self, service: Service) -> None:
        """Say that streams are served."""

    def beat(self) -> None:
        """Give a sign of life; called by the control loop about twice a second once streams are served."""


class NoParent:
    """A process of its own: prints the ready line.

    Args:
        settings: what is in force.
    """

    announces: Final = True

    def __init__(self, settings: Settings) -> None:
        self.private = None
        self._settings = settings

    def begin(self, asked: StopRequest) -> None:
        """Do nothing: signals are enough."""

    def warm_up(self) -> None:
        """Compile the kernels, or load them."""
        warm_up()

    def ready(self, service: Service) -> None:
        """Print the line that starters wait for."""
        del service
        say_ready("instance", self._settings.instance, (*self._settings.endpoints, *self._settings.connect))

    def beat(self) -> None:
        """Do nothing: nobody waits for a sign."""


async def run(settings: Settings, profiles: Profiles, parent: Parent | None = None) -> int:
    """Run the service until SIGINT or SIGTERM.

    Args:
        settings: what is in force.
        profiles: the parameters that can be had.
        parent: the parent of a worker process; default: this process has none.

    Returns:
        The exit status: 0, or 1 when the network or the store could not be used.
    """
    parent = parent or NoParent(settings)
    return await process.run(settings, partial(_serve, settings, profiles, parent), profiles=profiles.names)


async def _serve(
    settings: Settings, profiles: Profiles, parent: Parent, asked: StopRequest, health: ProcessHealth
) -> bool | None:
    """Run the service until the end is asked for; return whether it ended in order, None when it never began.

    Raises:
        TransportError: the network cannot be used.
        StoreError: the store cannot be used, and others use it.
    """
    loop = asyncio.get_running_loop()
    parent.begin(asked)

    def arm(wake: Callable[[], None], at_ns: int) -> None:
        # The loop's time and the deadlines are one clock, the monotonic one.
        loop.call_soon_threadsafe(loop.call_at, at_ns / 1e9, wake)

    await unless(asked, parent.warm_up)
    if asked.is_set():
        return None
    if not settings.is_router:
        log.info("connecting", endpoints=settings.connect)
    service = await unless(
        asked, lambda: Service(settings, profiles, arm, private=parent.private, metrics=health.metrics)
    )
    if service is None:
        return None
    service.start(announce=parent.announces)
    health.report(service)
    settle()
    watching = loop.create_task(watch_keys(asked, lambda: service.key_numbers, settings.restart_keys))
    with grpc_edge(settings, service.client, health.metrics.add):
        # In this order: who sees the ready line may send at once, and finds this event before those of a session.
        log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
        parent.ready(service)
        while not asked.is_set():
            await asked.wait(HOUSEKEEPING_S)
            service.housekeeping()
            if health.tls is not None and (why := health.tls.failure):
                service.report_certificate(why)
            parent.beat()
        health.ends()
    watching.cancel()
    return await asyncio.to_thread(service.stop, asked.bound.left())

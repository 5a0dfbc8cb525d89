"""Processes that do not track: the router, the gRPC gateway, the linker, and the bridges to MQTT, ROS 2, the log.

Each works until SIGINT or SIGTERM and returns the exit status, as `lifecycle.run` does.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from importlib import import_module
from typing import TYPE_CHECKING

import structlog

from optipmb_service.app.lifecycle import HOUSEKEEPING_S, grpc_edge, report_ready, run, run_client, sessions_of, unless
from optipmb_service.telemetry.health import BEAT_S, Component
from optipmb_service.telemetry.metrics import LINK_METRICS, LOG_METRICS, PROBLEM_METRICS
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

log = structlog.get_logger("optipmb_service")


async def run_router(settings: Settings) -> int:
    async def serve(asked: StopRequest, health: ProcessHealth) -> bool:
        router = Client(settings)
        report_ready(settings, health, Component(router), "router", settings.instance, listen=settings.endpoints)
        await asked.wait()
        health.ends()
        await asyncio.to_thread(router.close)
        return True

    return await run(settings, serve)


async def run_gateway(settings: Settings) -> int:
    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        with grpc_edge(settings, client, health.metrics) as address:
            report_ready(settings, health, Component(client), "grpc", address, grpc=address)
            await asked.wait()
            health.ends()

    return await run_client(settings, serve)


async def run_bridge(settings: Settings, name: str) -> int:
    """Run the `Bridge` of a module of `edges`, as `edges.mqtt` has one."""
    module = import_module(f"optipmb_service.edges.{name}")  # with an extra that only this needs

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        bridge = module.Bridge(settings, client, sessions_of(settings))
        bridge.add_metrics(health.metrics)
        running = asyncio.create_task(bridge.run())
        report_ready(settings, health, bridge, name, *bridge.about.values(), **bridge.about)
        stop = asyncio.create_task(asked.wait())
        await asyncio.wait((stop, running), return_when=asyncio.FIRST_COMPLETED)
        health.ends()
        stop.cancel()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running

    return await run_client(settings, serve)


async def run_ros2(settings: Settings) -> int:
    from optipmb_service.edges.ros2.node import Ros2Node  # noqa: PLC0415 - an extra that only this needs
    from optipmb_service.edges.ros2.work import Work  # noqa: PLC0415 - as above

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool | None:
        log.info("connecting", endpoints=settings.connect)
        node = await unless(asked, lambda: Ros2Node(settings))
        if node is None:
            return None
        work = Work(settings, node)
        try:
            work.open()
            streams = ",".join(settings.ros2.streams)
            report_ready(settings, health, work, "ros2", streams, streams=streams)
            while not asked.is_set():
                await asyncio.to_thread(work.work, BEAT_S)
            health.ends()
        finally:
            asked.bound.begin()
            await asyncio.to_thread(node.close)
        return True

    return await run(settings, serve)


async def run_link(settings: Settings) -> int:
    from optipmb_service.app.link_bridge import LinkBridge  # noqa: PLC0415 - the tracker, which a router does not load

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        bridge = await asyncio.to_thread(LinkBridge, settings, client)
        health.metrics.add(LINK_METRICS | PROBLEM_METRICS, lambda: bridge)
        report_ready(settings, health, bridge, "link", ",".join(settings.links))
        while not asked.is_set():
            await asked.wait(HOUSEKEEPING_S)
            await asyncio.to_thread(bridge.work)
        health.ends()
        await asyncio.to_thread(bridge.close)

    return await run_client(settings, serve)


async def run_log(settings: Settings) -> int:
    from optipmb_service.app.log_bridge import LogBridge  # noqa: PLC0415 - as above

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        bridge = LogBridge(settings, client)
        health.metrics.add(LOG_METRICS | PROBLEM_METRICS, lambda: bridge)
        report_ready(settings, health, bridge, "log", settings.instance)
        while not asked.is_set():
            await asked.wait(HOUSEKEEPING_S)
            bridge.reporter.flush(time.monotonic_ns())
        health.ends()
        await asyncio.to_thread(bridge.close)

    return await run_client(settings, serve)

"""Processes beside the members: the router, the gRPC gateway, and the bridges to MQTT, ROS 2 and the message log.

Each works until SIGINT or SIGTERM and returns the exit status, as `lifecycle.run` does.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.app.lifecycle import grpc_edge, run, run_client, say_ready, settle, unless
from optipmb_service.telemetry.health import BEAT_S, Reporter
from optipmb_service.telemetry.metrics import LOG_METRICS, MQTT_METRICS, PROBLEM_METRICS
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

log = structlog.get_logger("optipmb_service")

HOUSEKEEPING_S: Final = 0.5


async def run_router(settings: Settings) -> int:
    async def serve(asked: StopRequest, health: ProcessHealth) -> bool:
        router = Client(settings)
        health.report(Reporter(router))
        say_ready("router", settings.instance, settings.endpoints)
        log.info("ready", instance=settings.instance, listen=settings.endpoints, connect=settings.connect)
        await asked.wait()
        health.ends()
        await asyncio.to_thread(router.close)
        return True

    return await run(settings, serve)


async def run_gateway(settings: Settings) -> int:
    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        with grpc_edge(settings, client, health.metrics) as address:
            health.report(Reporter(client))
            settle()
            say_ready("grpc", address, settings.connect)
            log.info("ready", instance=settings.instance, grpc=address, connect=settings.connect)
            await asked.wait()
            health.ends()

    return await run_client(settings, serve)


async def run_mqtt(settings: Settings) -> int:
    from optipmb_service.edges.mqtt import Bridge  # noqa: PLC0415 - an extra that only this needs

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        bridge = Bridge(settings, client)
        health.metrics.add(MQTT_METRICS, lambda: bridge)
        health.report(bridge)
        running = asyncio.create_task(bridge.run())
        settle()
        say_ready("mqtt", settings.mqtt.broker, settings.connect)
        log.info("ready", instance=settings.instance, broker=settings.mqtt.broker, connect=settings.connect)
        stop = asyncio.create_task(asked.wait())
        await asyncio.wait((stop, running), return_when=asyncio.FIRST_COMPLETED)
        health.ends()
        stop.cancel()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running

    return await run_client(settings, serve)


async def run_ros2(settings: Settings) -> int:
    from optipmb_service.edges.ros2.node import Ros2Node  # noqa: PLC0415 - as above
    from optipmb_service.edges.ros2.work import Work  # noqa: PLC0415 - as above

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool | None:
        log.info("connecting", endpoints=settings.connect)
        node = await unless(asked, lambda: Ros2Node(settings))
        if node is None:
            return None
        work = Work(settings, node)
        try:
            work.open()
            health.report(work)
            streams = ",".join(settings.ros2.streams)
            say_ready("ros2", streams, settings.connect)
            log.info("ready", instance=settings.instance, streams=streams, connect=settings.connect)
            while not asked.is_set():
                await asyncio.to_thread(work.work, BEAT_S)
            health.ends()
        finally:
            asked.bound.begin()
            await asyncio.to_thread(node.close)
        return True

    return await run(settings, serve)


async def run_log(settings: Settings) -> int:
    from optipmb_service.app.log_bridge import LogBridge  # noqa: PLC0415 - as above

    async def serve(asked: StopRequest, health: ProcessHealth, client: Client) -> None:
        bridge = LogBridge(settings, client)
        health.metrics.add(LOG_METRICS | PROBLEM_METRICS, lambda: bridge)
        health.report(bridge)
        settle()
        say_ready("log", settings.instance, settings.connect)
        log.info("ready", instance=settings.instance, connect=settings.connect)
        while not asked.is_set():
            await asked.wait(HOUSEKEEPING_S)
            bridge.reporter.flush(time.monotonic_ns())
        health.ends()
        await asyncio.to_thread(bridge.close)

    return await run_client(settings, serve)

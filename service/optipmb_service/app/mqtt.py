"""The bridge to an MQTT broker as a process of its own: publishes tracks, events, counts and problems as JSON.

Topics are the keys of the network. It keeps nothing and reads nothing from the broker. While the broker is away, events
and the newest counts wait; tracks and problems do not, because they would be out of date.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import aiomqtt
import structlog
from aiomqtt.exceptions import MqttConnectError
from optipmb_client.errors import ClientError
from optipmb_schemas.certificates import context_of
from optipmb_schemas.json_form import Selection
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from optipmb_service.app import lifecycle
from optipmb_service.app.lifecycle import places_of, say_ready, settle
from optipmb_service.edge.readers import Feeds, Reader, Text, Wish
from optipmb_service.telemetry.health import Reporter
from optipmb_service.telemetry.metrics import MQTT_METRICS

if TYPE_CHECKING:
    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.edge.readers import Publication
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")

PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
EVENTS: Final = 10_000
"""Events that wait while the broker is away; then the oldest are lost, and `n` shows the gap."""

TOGETHER: Final = 8
"""Messages on their way to the broker at once."""

RETRY_S: Final = 2.0
ANSWER_S: Final = 10.0
"""Longest wait for the broker."""

LAST_S: Final = 1.0
"""The same at the end."""

QOS: Final = {"tracks": 0, "problems": 0, "events": 1, "zones": 1}
RETAINED: Final = "zones"
KEPT: Final = frozenset({"events"})  # topics of the network that wait for the broker
OLD: Final = frozenset({1, 132})  # how brokers of 3.1.1, and of 5, refuse the version of the protocol


class Bridge(Reporter):
    """From the network to the broker. To be made and run on one loop.

    Args:
        settings: of the process.
        client: on the network; it is closed by the caller, after this.

    Raises:
        ClientError: a certificate or the credentials cannot be used.
    """

    def __init__(self, settings: Settings, client: Client) -> None:
        super().__init__(client)
        self.connected = False
        self.published: collections.Counter[str] = collections.Counter()
        self._keys = client.keys
        self._why = "not connected yet"
        self._mqtt = settings.mqtt
        self._alive = f"{settings.prefix}/mqtt/{settings.instance}/alive"
        self._identifier = f"optipmb-{settings.instance}"
        self._version = aiomqtt.ProtocolVersion.V5
        try:
            user = settings.mqtt.credentials.read_text("utf-8").strip() if settings.mqtt.credentials else ""
            self._tls = context_of(settings.mqtt.tls) if settings.mqtt.broker.startswith("mqtts") else None
        except (OSError, ValueError) as error:
            raise ClientError(f"settings mqtt.credentials, mqtt.tls: {error}") from error
        self._user, _, self._password = user.partition(":")
        self._wish = Wish(
            settings.mqtt.streams, frozenset(settings.mqtt.topics), Selection(confirmed=True), settings.mqtt.tracks_hz
        )
        self._reader = Reader(self._wish, EVENTS)
        self._feeds = Feeds(client, places_of(settings))
        self._unsent: list[Text] = []

    @property
    def lost(self) -> int:
        """Events that were lost while the broker was away."""
        return self._reader.lost_events

    @property
    def skipped(self) -> int:
        """Messages that newer ones replaced before the broker took them."""
        return self._reader.outbox.left_out - self._reader.lost_events

    @property
    def failure(self) -> str:
        """Why nothing can be received or published; empty while it can."""
        return self.unlinked or ("" if self.connected else f"mqtt: {self._why}")

    async def run(self) -> None:
        """Publish until it is cancelled; connect again and again."""
        await asyncio.to_thread(self._feeds.join, self._wish.keys(self._keys), self._receive)
        task = asyncio.current_task()
        while True:
            try:
                async with self._broker() as broker:
                    await self._serve(broker)
            except aiomqtt.MqttError as error:
                if task is not None and task.cancelling():  # it was raised by what the end does
                    return
                if str(error) != self._why:
                    log.warning("mqtt_disconnected", broker=self._mqtt.broker, reason=str(error))
                self._why = str(error)
                if isinstance(error, MqttConnectError) and getattr(error.rc, "value", error.rc) in OLD:
                    self._version = aiomqtt.ProtocolVersion.V311
            finally:
                self.connected = False
            await asyncio.sleep(RETRY_S)

    async def _serve(self, broker: aiomqtt.Client) -> None:
        await broker.publish(self._alive, b"1", qos=1, retain=True)
        self.connected, self._why = True, ""
        log.info("mqtt_connected", broker=self._mqtt.broker, protocol=self._version.name)
        # Nothing is subscribed to: the iterator ends with the connection, which a publish that waits does not.
        tasks = {asyncio.create_task(self._publish(broker)), asyncio.create_task(_until_lost(broker))}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except asyncio.CancelledError:  # a connection that is closed in order has no last will
            await broker.publish(self._alive, b"0", qos=1, retain=True, timeout=LAST_S)
            raise
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)

    def _broker(self) -> aiomqtt.Client:
        broker = urlsplit(self._mqtt.broker)
        return aiomqtt.Client(
            broker.hostname or "",
            broker.port or PORTS[broker.scheme],
            username=self._user or None,
            password=self._password or None,
            identifier=self._identifier,
            protocol=self._version,
            will=aiomqtt.Will(self._alive, b"0", qos=1, retain=True),
            tls_context=self._tls,
            timeout=ANSWER_S,
        )

    def _receive(self, one: Publication) -> None:
        """Take a message, on any thread."""
        if self.connected or one.topic in KEPT:
            self._reader.receive(one)

    async def _publish(self, broker: aiomqtt.Client) -> None:
        """Publish waiting messages, a few at once; repeat unconfirmed ones."""
        outbox, properties = self._reader.outbox, None
        if self._version is aiomqtt.ProtocolVersion.V5:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.ContentType = "application/json"

        async def publish(one: Text) -> None:
            topic, retain = f"{self._keys.prefix}/{one.stream}/{one.topic}", one.topic == RETAINED
            await broker.publish(topic, one.make(), QOS[one.topic], retain, properties)
            self.published[one.topic] += 1

        while True:
            if not self._unsent and (taken := await outbox.take()) is not None:
                self._unsent.append(taken[0])
            while len(self._unsent) < TOGETHER and (text := outbox.take_now()) is not None:
                self._unsent.append(text[0])
            await asyncio.gather(*map(publish, self._unsent))  # they go out in this order
            self._unsent.clear()


async def _until_lost(broker: aiomqtt.Client) -> None:
    async for _ in broker.messages:
        pass


async def run(settings: Settings) -> int:
    """Publish until SIGINT or SIGTERM; returns the exit status, as `lifecycle.run` does."""

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

    return await lifecycle.run_client(settings, serve)

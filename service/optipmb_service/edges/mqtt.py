"""The bridge to an MQTT broker: publishes tracks, events, counts, problems and CPM as JSON.

Topics are the keys of the network. The bridge stores nothing, and reads only the retained counts from the broker. While
the broker is away, events and the newest counts wait. Tracks and problems are dropped, because they would be outdated.

A message that the broker cannot take is reported and dropped, so that it does not block others: a message above the
broker's Maximum Packet Size (MQTT 5), a refused one, and one that ends the connection twice while it is sent alone. To
find the last kind, each message that is larger than all before on its topic and connection is sent with QoS 1.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import time
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ClientError, ConnectionFailed
from optipmb_client.merging import remember
from optipmb_schemas.certificates import context_of
from optipmb_schemas.json_form import Selection
from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from optipmb_service.edges.cpm import SEGMENTS, Station, station_of
from optipmb_service.edges.inputs import Inputs
from optipmb_service.edges.mqtt_inputs import RECEIVED, MqttInputs
from optipmb_service.edges.readers import Bounds, Feeds, Reader, Text, Wish, places_of
from optipmb_service.telemetry.health import Component
from optipmb_service.telemetry.metrics import INPUT_METRICS, MQTT_METRICS

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable

    from optipmb_service.edges.readers import Publication
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.zenoh.client import Client

T = TypeVar("T")

log = structlog.get_logger("optipmb_service")

PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
EVENTS: Final = 10_000
"""Events of a stream that wait while the broker is away; then the oldest are lost, and `n` shows the gap."""

EVENT_BYTES: Final = 32 * 2**20
"""The same of all streams, in bytes."""

TOGETHER: Final = 8
"""Messages on their way to the broker at once."""

RETRY_S: Final = 2.0
ANSWER_S: Final = 10.0
"""Longest wait for the broker."""

LAST_S: Final = 1.0
"""The same at the end."""

QOS: Final = {"tracks": 0, "problems": 0, "events": 1, "zones": 1, "cpm": 0}
OBJECTS: Final = 128
"""Objects of a CPM in JSON."""
SEE_S: Final = 0.5
"""Time between two looks at the field of view of a sensor: CPM have it once a second."""
RETAINED: Final = "zones"
KEPT: Final = frozenset({"events"})  # topics of the network that wait for the broker
OLD: Final = frozenset({1, 132})  # how brokers of 3.1.1, and of 5, refuse the version of the protocol
TAKEN_OVER: Final = 142
STRIKES: Final = 2  # connections that a message may end while it is alone under way

TOO_LARGE: Final = "Packet too large"
ENDED: Final = "ended the connection"
FORGET_S: Final = 600.0
"""Time after which a size that ended connections is tried again."""

HEAD_BYTES: Final = 64
"""Most bytes of a published packet beside topic and payload."""


class LinkError(Exception):
    """There is no connection to the broker, or it has ended.

    Attributes:
        code: reason code of the broker; 0: it gave none.
    """

    def __init__(self, reason: str, code: int = 0) -> None:
        super().__init__(reason)
        self.code = code


class Link:
    """One connection to the broker. Create and use it on one loop; callbacks run on a thread of paho.

    Args:
        client: not connected yet.
        take: takes a message, and a function that confirms it.
    """

    def __init__(self, client: paho.Client, take: Callable[[Any, Callable[[], object]], None]) -> None:
        self._client = client
        self._loop = loop = asyncio.get_running_loop()
        self._under_way: dict[int, asyncio.Future[str]] = {}
        self.opened: asyncio.Future[int] = loop.create_future()
        """Maximum Packet Size of the broker; 0: none."""
        self.ended: asyncio.Future[LinkError] = loop.create_future()
        client.on_connect = lambda _c, _d, _f, reason, properties: self._call(self._connected, reason, properties)
        client.on_disconnect = lambda _c, _d, _f, reason, _p: self._call(self._disconnected, reason)
        self.retained: asyncio.Queue[str] = asyncio.Queue()
        """Subscribed topics with a retained message."""
        self._take = take
        self.denied: dict[str, str] = {}
        """Why the broker refuses subscriptions, by topic."""
        self._asked: dict[int, str] = {}
        client.on_subscribe = lambda _c, _d, number, reasons, _p: self._call(self._subscribed, number, reasons)
        client.on_message = lambda _c, _d, one: self._call(self._heard, one)
        client.on_publish = lambda _c, _d, number, reason, _p: self._call(self._published, number, reason)

    async def open(self, host: str, port: int) -> int:
        """Connect; return the size of the largest packet that the broker takes, 0 without one.

        Raises:
            LinkError: there is no connection.
        """
        properties = None
        if self._client.protocol == MQTTProtocolVersion.MQTTv5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # of paho
            properties.ReceiveMaximum = RECEIVED
        try:
            await asyncio.to_thread(self._client.connect, host, port, properties=properties)
        except OSError as error:
            raise LinkError(str(error)) from None
        self._client.loop_start()
        return await self._answer(self.opened, ANSWER_S)

    async def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, seconds: float = ANSWER_S) -> str:
        """Publish; return why the broker refuses it, empty if it takes it. Without QoS that is not known.

        Raises:
            LinkError: the connection has ended, or the broker does not confirm.
        """
        properties = None
        if self._client.protocol == MQTTProtocolVersion.MQTTv5:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # of paho
            properties.ContentType = "application/json"
        sent = self._client.publish(topic, payload, qos, retain, properties)
        confirmed: asyncio.Future[str] = self._loop.create_future()
        if sent.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:  # it has ended; why is known in a moment
            return await self._answer(confirmed, LAST_S)
        self._under_way[sent.mid] = confirmed
        try:
            return await self._answer(confirmed, seconds)
        finally:
            del self._under_way[sent.mid]

    def subscribe(self, pattern: str, qos: int = 1) -> None:
        """Ask the broker for the topics of a pattern."""
        _, number = self._client.subscribe(pattern, qos)
        if number is not None:
            self._asked[number] = pattern

    async def close(self) -> None:
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)
        # A client closes its sockets when nothing refers to it any more.
        self._client.on_connect = self._client.on_disconnect = self._client.on_message = self._client.on_publish = None
        self._client.on_subscribe = None

    async def _answer(self, answer: asyncio.Future[T], seconds: float) -> T:
        await asyncio.wait((answer, self.ended), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if answer.done():
            return answer.result()
        raise self.ended.result() if self.ended.done() else LinkError("the broker does not answer")

    def _call(self, function: Any, *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, *arguments)

    def _connected(self, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._end(LinkError(f"the broker refuses the connection: {reason}", reason.value))
        elif not self.opened.done():
            self.opened.set_result(getattr(properties, "MaximumPacketSize", 0))

    def _disconnected(self, reason: Any) -> None:
        self._end(LinkError(f"disconnected: {reason}", reason.value))

    def _end(self, error: LinkError) -> None:
        if not self.ended.done():
            self.ended.set_result(error)

    def _subscribed(self, number: int, reasons: list[Any]) -> None:
        topic = self._asked.pop(number, "")
        if why := next((str(reason) for reason in reasons if reason.is_failure), ""):
            self.denied[topic] = why
            log.warning("mqtt_refused", topic=topic, reason=why)

    def _heard(self, message: Any) -> None:
        if message.retain and message.topic.endswith(f"/{RETAINED}"):
            self.retained.put_nowait(message.topic)
        self._take(message, partial(self._client.ack, message.mid, message.qos))

    def _published(self, number: int, reason: Any) -> None:
        if (confirmed := self._under_way.get(number)) is not None and not confirmed.done():
            confirmed.set_result(str(reason) if reason.is_failure else "")


@dataclass
class Unsent:
    """A message without confirmation, and the number of connections that it ended."""

    text: Text
    payload: bytes
    strikes: int = 0


TAKEN_OVER_S: Final = 30.0
"""Pause after another client of this name has taken the connection."""

MANY: Final = 5
MANY_S: Final = 60.0
"""So many connections within so long are those of two clients of one name, where the broker gives no reason."""


class Bridge(Component):
    """From the network to the broker. Create and run it on one loop.

    Attributes:
        about: for the log, where it works.

    Args:
        settings: of the process.
        client: on the network; it is closed by the caller, after this.
        sessions: returns the session that a stream feeds.

    Raises:
        ClientError: a certificate or the credentials cannot be used.
    """

    def __init__(self, settings: Settings, client: Client, sessions: Callable[[str], str] = str) -> None:
        super().__init__(client)
        self.inputs = Inputs(settings, client, "mqtt", sessions)
        self.about = {"broker": settings.mqtt.broker}
        self._sources = MqttInputs(settings, self.inputs)
        self._denied: dict[str, str] = {}
        self.connected = False
        self.published: collections.Counter[str] = collections.Counter()
        self.refused: collections.Counter[str] = collections.Counter()
        self.left_out: collections.Counter[str] = collections.Counter()
        """Objects without a place in the CPM, by reason."""
        self._settings = settings
        self._stations: collections.OrderedDict[str, Station | None] = collections.OrderedDict()
        self._seen: dict[str, float] = {}  # when the field of view of a sensor was taken, monotonic
        self._keys = client.keys
        self._why = "not connected yet"
        self._mqtt = settings.mqtt
        self._instance = settings.instance
        self._identifier = f"optipmb-{settings.instance}"
        self._alive = f"{settings.prefix}/mqtt/{settings.instance}/alive"
        self._version = MQTTProtocolVersion.MQTTv5
        self._tls: ssl.SSLContext | None = None
        try:
            user = settings.mqtt.credentials.read_text("utf-8").strip() if settings.mqtt.credentials else ""
            if settings.mqtt.broker.startswith("mqtts"):
                self._tls = context_of(settings.mqtt.tls)
        except (OSError, ValueError) as error:
            raise ClientError(f"settings mqtt.credentials, mqtt.tls: {error}") from error
        self._user, _, self._password = user.partition(":")
        self._wish = Wish(
            settings.mqtt.streams, frozenset(settings.mqtt.topics), Selection(confirmed=True), settings.mqtt.tracks_hz
        )
        self._reader = Reader(self._wish, settings.stale_s)
        self._client = client
        self._feeds = Feeds(client, client.keys, places_of(settings), Bounds(EVENTS, inf, EVENT_BYTES))
        self._opened: collections.deque[float] = collections.deque(maxlen=MANY)
        """Monotonic times of the last connections."""
        self._lost = 0
        self._unsent: list[Unsent] = []
        self._most = 0  # bytes of a packet that the broker takes; 0: it does not say
        self._largest: collections.OrderedDict[str, int] = collections.OrderedDict()
        """Bytes of the largest message that was confirmed on this connection, by topic."""
        self._refusing: collections.OrderedDict[str, str] = collections.OrderedDict()
        """Why the newest message was refused, by topic."""
        self._impossible: collections.OrderedDict[str, tuple[int, float]] = collections.OrderedDict()
        """Size that ended connections, and when, by topic."""

    def add_metrics(self, metrics: Metrics) -> None:
        """Add the figures of the bridge and of its inputs to the metrics of the process."""
        metrics.add(MQTT_METRICS, lambda: self)
        metrics.add(INPUT_METRICS, lambda: self.inputs)

    @property
    def lost(self) -> int:
        """Events that were lost while the broker was away, or that it did not take."""
        return self._reader.lost_events + self._lost

    @property
    def skipped(self) -> int:
        """Messages that newer ones replaced before the broker took them."""
        return self._reader.outbox.left_out

    @property
    def failure(self) -> str:
        """Why nothing can be received or published, or not everything; empty while it can."""
        if self.unlinked or not self.connected:
            return self.unlinked or f"mqtt: {self._why}"
        refusing = self._refusing | self._denied
        for topic, reason in tuple(refusing.items())[:1]:
            return f"mqtt: {len(refusing)} topics are refused, as {topic}: {reason}"
        return ""

    async def run(self) -> None:
        """Publish until it is cancelled; connect again and again."""
        keys = self._wish.keys(self._keys)
        if "cpm" in self._wish.topics and self._settings.outputs:
            keys += [self._keys.matching(one, "now") for one in self._wish.streams]
        await asyncio.to_thread(self._feeds.join, keys, self._receive)
        for stream in {one.stream for station in self._settings.cpm.values() for one in station.sensors if one.stream}:
            if "cpm" in self._wish.topics:
                await asyncio.to_thread(self._feeds.join, [self._keys.detections(stream)], partial(self._see, stream))
        self._reader.read(self._feeds.logs(keys))
        pause_s = RETRY_S
        with contextlib.closing(self._sources):
            while True:
                link = self._link()
                try:
                    await self._serve(link)
                except LinkError as error:
                    why, pause_s = str(error), RETRY_S
                    if error.code == TAKEN_OVER:  # they would take it from each other again and again
                        why = f"duplicate_name: another client is {self._identifier}, too; {error}"
                        pause_s = TAKEN_OVER_S
                    elif len(self._opened) == MANY and self._opened[-1] - self._opened[0] <= MANY_S:
                        likely = f"another client of the name {self._identifier} is likely"
                        why = f"{error}; {MANY} connections within a minute: {likely}"
                    if why != self._why:
                        log.warning("mqtt_disconnected", broker=self._mqtt.broker, reason=why)
                    self._why = why
                    if error.code in OLD:
                        self._version = MQTTProtocolVersion.MQTTv311
                finally:
                    self.connected = False
                    await link.close()
                await asyncio.sleep(pause_s)

    async def _serve(self, link: Link) -> None:
        broker = urlsplit(self._mqtt.broker)
        self._most = await link.open(broker.hostname or "", broker.port or PORTS[broker.scheme])
        self._largest.clear()
        self._opened.append(time.monotonic())
        self._denied = link.denied
        for topic, qos in self._sources.topics:  # first: who sends once this bridge is alive is heard
            link.subscribe(topic, qos)
        self._note(self._alive, await link.publish(self._alive, b"1", 1, retain=True))
        self.connected, self._why = True, ""
        log.info("mqtt_connected", broker=self._mqtt.broker, protocol=self._version.name, most_bytes=self._most)
        publishing = asyncio.create_task(self._publish(link))
        clearing = asyncio.create_task(self._clear(link))
        try:
            await asyncio.wait((publishing, link.ended), return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:  # a connection that is closed in order has no last will
            with contextlib.suppress(LinkError):
                await link.publish(self._alive, b"0", 1, retain=True, seconds=LAST_S)
            if self._unsent:
                log.warning("mqtt_unsent", messages=len(self._unsent))
            raise
        finally:
            publishing.cancel()
            clearing.cancel()
            await asyncio.wait((publishing, clearing))
        if publishing.cancelled():
            raise link.ended.result()
        publishing.result()

    async def _clear(self, link: Link) -> None:
        """Clear retained counts of streams whose zones are gone: services know the stream, and have no counts of it."""
        for pattern in self._wish.streams if RETAINED in self._wish.topics else ():
            link.subscribe(f"{self._keys.prefix}/{pattern.replace('*', '+')}/{RETAINED}")
        while True:
            topic = await link.retained.get()
            stream = topic.removeprefix(f"{self._keys.prefix}/").removesuffix(f"/{RETAINED}")
            with contextlib.suppress(LinkError, ConnectionFailed, schemas.MessageError):  # another time
                answers = await asyncio.to_thread(self._client.query, self._keys.query(stream, "zones"))
                if answers and not any(one.ok for one in answers):
                    await link.publish(topic, b"", 1, retain=True)

    def _link(self) -> Link:
        client = paho.Client(
            CallbackAPIVersion.VERSION2,
            self._identifier,
            protocol=self._version,
            reconnect_on_failure=False,
            manual_ack=True,
        )
        client.connect_timeout = ANSWER_S
        if self._user:
            client.username_pw_set(self._user, self._password or None)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        client.will_set(self._alive, b"0", 1, retain=True)
        return Link(client, self._sources.take)

    def _receive(self, one: Publication) -> None:
        """Take a message, on any thread."""
        if self.connected or one.topic in KEPT:
            if one.topic != "now":
                self._reader.receive(one)
            if one.topic in {"tracks", "now"} and "cpm" in self._wish.topics and one.message is not None:
                self._perceive(one.message, predicted=one.topic == "now")

    def _perceive(self, tracks: schemas.Tracks, *, predicted: bool) -> None:
        """Queue the CPM that are due after a frame."""
        stream = tracks.stream
        if stream not in self._stations:
            remember(self._stations, stream, station_of(self._settings, stream, OBJECTS))
        station = self._stations[stream]
        if station is not None and station.predicted == predicted:
            for message in station.messages(tracks, self.left_out):
                payload = station.json(message, time.time_ns())
                text = Text("cpm", stream, partial(bytes, payload))
                self._reader.outbox.put(f"cpm {stream}", text, len(payload), SEGMENTS)

    def _see(self, stream: str, one: Publication) -> None:
        """Take the field of view of a sensor, once a second."""
        now = time.monotonic()
        if now - self._seen.get(stream, -inf) >= SEE_S and one.message is not None:
            self._seen[stream] = now
            for station in tuple(self._stations.values()):
                if station is not None:
                    station.see(one.message)

    async def _publish(self, link: Link) -> None:
        """Publish waiting messages, a few at once; messages that an ended connection left, one by one."""
        while True:
            while self._unsent:
                await self._send(link, self._unsent[0], alone=True)
                del self._unsent[0]
            self._unsent.append(_unsent(await self._reader.take_text()))
            while len(self._unsent) < TOGETHER and (taken := self._reader.take_now()) is not None:
                self._unsent.append(_unsent(taken))
            # They go out in this order.
            sent = await asyncio.gather(*(self._send(link, one) for one in self._unsent), return_exceptions=True)
            self._unsent = [one for one, result in zip(self._unsent, sent, strict=True) if result is not None]
            for error in sent:
                if error is not None:
                    raise error

    async def _send(self, link: Link, one: Unsent, *, alone: bool = False) -> None:
        """Publish a message, or leave it out, if the broker cannot take it."""
        kind, size = one.text.topic, len(one.payload)
        topic = f"{self._keys.prefix}/{one.text.stream}/{kind}"
        packet = size + len(topic) + HEAD_BYTES
        ended_at, at = self._impossible.get(topic, (inf, 0.0))
        if self._most and packet > self._most:
            self._leave_out(one, topic, TOO_LARGE, f"packets of at most {self._most} bytes, as the broker says")
        elif size >= ended_at and time.monotonic() - at < FORGET_S:
            self._leave_out(one, topic, ENDED, f"less than {ended_at} bytes, with which it ended connections")
        elif one.strikes >= STRIKES:
            remember(self._impossible, topic, (size, time.monotonic()))
            self._leave_out(one, topic, ENDED, f"a message that does not end the connection {STRIKES} times")
        else:
            is_known = size <= self._largest.get(topic, -1)
            try:
                reason = await link.publish(topic, one.payload, QOS[kind] if is_known else 1, retain=kind == RETAINED)
            except (LinkError, asyncio.CancelledError):
                one.strikes += alone and link.ended.done()
                raise
            self._note(topic, reason)
            if not reason:
                self.published[kind] += 1
                remember(self._largest, topic, max(size, self._largest.get(topic, 0)))

    def _note(self, topic: str, reason: str) -> None:
        """Note why the broker refuses a message of a topic; empty if it takes it."""
        if not reason:
            self._refusing.pop(topic, None)
            return
        self.refused[reason] += 1
        self._lost += topic.endswith("/events")
        if self._refusing.get(topic) != reason:
            log.warning("mqtt_refused", topic=topic, reason=reason)
        remember(self._refusing, topic, reason)

    def _leave_out(self, one: Unsent, topic: str, reason: str, expected: str) -> None:
        if self._refusing.get(topic) != reason:
            error = schemas.MessageError("too_large", topic, expected, f"{len(one.payload)} bytes")
            self._client.publish_problem(schemas.Problem.of(error, stream=one.text.stream, instance=self._instance))
        self._note(topic, reason)


def _unsent(taken: tuple[Text, int]) -> Unsent:
    return Unsent(taken[0], taken[0].make())

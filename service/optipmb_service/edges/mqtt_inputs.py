"""Detections over MQTT: payloads of the topics of the settings become frames.

The settings map topics to streams; no payload names another one. A message is confirmed when its frame has gone to the
network, so the broker keeps messages while that is away.
"""

from __future__ import annotations

import asyncio
import re
import weakref
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
from optipmb_schemas.errors import show

from optipmb_service.edges.inputs import LATER, RefusedError
from optipmb_service.edges.json_frames import FrameReader
from optipmb_service.edges.mapping import other_value

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.edges.inputs import Inputs
    from optipmb_service.settings import Settings

RECEIVED: Final = 64
"""Unconfirmed messages that the broker may have under way to the bridge (MQTT 5)."""

WAITING: Final = 1024
"""Messages without confirmation (QoS 0) that may wait for the network; further ones are left out."""

PAUSE_S: Final = 0.2
"""Time until a frame that could not be sent is tried again."""

log = structlog.get_logger("optipmb_service")


class MqttInputs:
    """Takes the messages of input topics. Create and use it on one loop.

    Args:
        settings: with the inputs.
        inputs: takes the frames.
    """

    def __init__(self, settings: Settings, inputs: Inputs) -> None:
        self.topics = {one.topic: one.qos for one in settings.mqtt.inputs.values()}.items()
        self._frames = FrameReader(settings)
        self._most_bytes = settings.limits.max_json_bytes
        self._inputs = inputs
        self._own = f"{settings.prefix}/"
        self._rows = [
            (re.compile(re.escape(one.pattern).replace(r"\+", "([^/]*)")), stream)
            for stream, one in settings.mqtt.inputs.items()
        ]
        self._tasks: set[asyncio.Task[None]] = set()
        self._turns: weakref.WeakValueDictionary[str, asyncio.Lock] = weakref.WeakValueDictionary()

    def take(self, message: Any, confirm: Callable[[], object]) -> None:
        """Take a message of paho's; `confirm` is called when it is done with."""
        matches = ((stream, topic.fullmatch(message.topic)) for topic, stream in self._rows if not message.retain)
        found = [stream.format("", *match.groups()) for stream, match in matches if match]
        fits = len(message.payload) <= self._most_bytes  # a larger one is refused
        stream = next((one for one in found if not fits or self._is_of(message.payload, one)), None)
        if stream is None:  # an old message, counts that the bridge publishes, or the payload of another sensor
            self._inputs.refused["mqtt", "other_sensor"] += bool(found)
            if not (found or message.retain or message.topic.startswith(self._own)):
                self._report_topic(message.topic, "a topic of `mqtt.inputs`", "another one")
            confirm()
            return
        if not message.qos and len(self._tasks) >= WAITING:
            self._inputs.refused["mqtt", "busy"] += 1
            return
        task = asyncio.create_task(self._taken(message, confirm, stream))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def close(self) -> None:
        """End the sending of messages that wait."""
        for task in self._tasks:
            task.cancel()

    def _is_of(self, payload: bytes, stream: str) -> bool:
        return other_value(payload, self._frames.rules(stream).only) is None

    async def _taken(self, message: Any, confirm: Callable[[], object], stream: str) -> None:
        try:
            await self._send(message, stream)
        except Exception:
            log.exception("internal_error", topic=message.topic)  # one message must not end the others
        confirm()

    def _report_topic(self, topic: str, expected: str, received: str) -> None:
        self._inputs.report("", schemas.MessageError("invalid_value", show(topic)[1:-1], expected, received))

    async def _send(self, message: Any, stream: str) -> None:
        """Send the frame of a message, as soon as that is possible."""
        try:
            self._inputs.client.keys.detections(stream)
        except schemas.MessageError as error:
            self._report_topic(message.topic, f"levels that are names in {error.expected}", show(stream))
            return
        try:
            frame = self._frames.read(message.payload, stream)
        except schemas.MessageError as error:
            self._inputs.report(stream, error)
            return
        correlation = getattr(message.properties, "CorrelationData", b"").hex()
        repeats = correlation and f"correlation data {correlation}"
        async with self._turns.setdefault(stream, asyncio.Lock()):  # none passes a frame that is tried again
            while True:
                try:
                    await self._inputs.send(frame, self._frames.rules(stream), repeats)
                except RefusedError as error:
                    if error.code not in LATER:
                        self._inputs.report(stream, error)
                        return
                else:
                    return
                await asyncio.sleep(PAUSE_S)


def tried(settings: Settings, name: str, payload: bytes) -> str:
    """Return the detections that a payload of an input becomes, as JSON; `{1}` in its name stands for itself.

    Raises:
        ValueError: there is no such input, or the payload is not valid.
    """
    if name not in settings.mqtt.inputs:
        raise ValueError(
            f"option --input: one of {', '.join(settings.mqtt.inputs) or 'mqtt.inputs'}, received {name!r}"
        )
    frame = FrameReader(settings).read(payload, re.sub(r"\{(\d)\}", r"\1", name))
    return schemas.encode_json(frame.message).decode()

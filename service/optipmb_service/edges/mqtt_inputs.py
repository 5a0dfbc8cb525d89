"""Detections over MQTT: payloads of the topics of the settings become frames.

The settings map topics to streams; no payload names another one. A message is confirmed when its frame has gone to the
network, so the broker keeps messages while that is away.
"""

from __future__ import annotations

import asyncio
import re
import weakref
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import optipmb_schemas as schemas
import structlog
from optipmb_schemas.errors import show

from optipmb_service.edges.inputs import LATER, RefusedError
from optipmb_service.edges.json_frames import FrameReader
from optipmb_service.edges.mapping import is_of, mapping_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from optipmb_service.edges.inputs import Inputs
    from optipmb_service.edges.mapping import PayloadMapping
    from optipmb_service.settings import Settings

RECEIVED: Final = 64
"""Unconfirmed messages that the broker may have under way to the bridge (MQTT 5)."""

WAITING: Final = 1024
"""Messages without confirmation (QoS 0) that may wait for the network; further ones are left out."""

PAUSE_S: Final = 0.2
"""Time until a frame that could not be sent is tried again."""

log = structlog.get_logger("optipmb_service")


class _Row(NamedTuple):
    """An input of the settings."""

    topic: re.Pattern[str]
    only: Mapping[str, bool | int | str]
    stream: str
    mapping: PayloadMapping | None


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
            _Row(re.compile(re.escape(one.pattern).replace(r"\+", "([^/]*)")), one.only, stream, mapping_of(one))
            for stream, one in settings.mqtt.inputs.items()
        ]
        self._tasks: set[asyncio.Task[None]] = set()
        self._turns: weakref.WeakValueDictionary[str, asyncio.Lock] = weakref.WeakValueDictionary()

    def take(self, message: Any, confirm: Callable[[], object]) -> None:
        """Take a message of paho's; `confirm` is called when it is done with."""
        found = (
            []
            if message.retain
            else [(match, row) for row in self._rows if (match := row.topic.fullmatch(message.topic))]
        )
        fits = len(message.payload) <= self._most_bytes  # a larger one is refused
        target = next(((match, row) for match, row in found if not fits or is_of(message.payload, row.only)), None)
        if target is None:  # an old message, counts that the bridge publishes, or the payload of another sensor
            self._inputs.refused["mqtt", "other_sensor"] += bool(found)
            if not (found or message.retain or message.topic.startswith(self._own)):
                self._report_topic(message.topic, "a topic of `mqtt.inputs`", "another one")
            confirm()
            return
        match, row = target
        if not message.qos and len(self._tasks) >= WAITING:
            self._inputs.refused["mqtt", "busy"] += 1
            return
        task = asyncio.create_task(self._taken(message, confirm, row.stream.format("", *match.groups()), row.mapping))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def close(self) -> None:
        """End the sending of messages that wait."""
        for task in self._tasks:
            task.cancel()

    async def _taken(
        self, message: Any, confirm: Callable[[], object], stream: str, mapping: PayloadMapping | None
    ) -> None:
        try:
            await self._send(message, stream, mapping)
        except Exception:
            log.exception("internal_error", topic=message.topic)  # one message must not end the others
        confirm()

    def _report_topic(self, topic: str, expected: str, received: str) -> None:
        self._inputs.report("", schemas.MessageError("invalid_value", show(topic)[1:-1], expected, received))

    async def _send(self, message: Any, stream: str, mapping: PayloadMapping | None) -> None:
        """Send the frame of a message, as soon as that is possible."""
        try:
            self._inputs.client.keys.detections(stream)
        except schemas.MessageError as error:
            self._report_topic(message.topic, f"levels that are names in {error.expected}", show(stream))
            return
        try:
            frame = self._frames.read(message.payload, stream, mapping)
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
    one = settings.mqtt.inputs.get(name)
    if one is None:
        raise ValueError(
            f"option --input: one of {', '.join(settings.mqtt.inputs) or 'mqtt.inputs'}, received {name!r}"
        )
    if not is_of(payload, one.only):
        raise ValueError(f"a payload with {one.only}, as `only` of the input says")
    stream = re.sub(r"\{(\d)\}", r"\1", name)
    frame = FrameReader(settings).read(payload, stream, mapping_of(one))
    return schemas.encode_json(frame.message).decode()

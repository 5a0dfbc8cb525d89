"""The bridge into the message log: puts published detections and tracks into NATS.

It keeps nothing, so any number of it may run: the servers drop what another one has put there. It is no part
of a member, because it receives the messages of all members, and a killed member must not take messages with it that
its successor needs.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

from optipmb_service.app.storage import nats_access
from optipmb_service.cluster.message_log import LogMessage, LogWriter, MessageLog, Retention
from optipmb_service.session.problems import problem_of
from optipmb_service.streams.kept_tracks import order_of
from optipmb_service.telemetry.health import Component
from optipmb_service.telemetry.problem_reporter import ProblemReporter
from optipmb_service.units import MEGABYTE

if TYPE_CHECKING:
    from optipmb_client.incoming import Arrival

    from optipmb_service.cluster.message_log import Topic
    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.client import Client

CLOSE_S: Final = 1.0
DRAIN_POLL_S: Final = 0.01


class LogBridge(Component):
    """From a network into the log; the client is closed by the caller, after this."""

    def __init__(self, settings: Settings, client: Client) -> None:
        super().__init__(client)
        self._client = client
        self._instance = settings.instance
        self._limits = settings.limits.limits()
        self._grace_s = settings.grace_s
        self.invalid = 0
        self.reporter = ProblemReporter(client.publish_problem)
        keep: dict[Topic, Retention] = {"detections": Retention(settings.log_s, settings.log_mb * MEGABYTE)}
        if settings.log_tracks_s:
            keep["tracks"] = Retention(settings.log_tracks_s, settings.log_tracks_mb * MEGABYTE)
        self._log = MessageLog(settings.cluster, settings.prefix, nats_access(settings))
        self.writer = LogWriter(self._log, keep, self._lost)
        self._subscriptions = [client.subscribe(client.keys.all(topic), self._take) for topic in keep]

    @property
    def failure(self) -> str:
        """Why nothing can be received or written; empty while it can."""
        why = self.writer.failure
        return self.unlinked or (f"log: {why}" if why else "")

    def close(self) -> None:
        """Write the waiting messages, within the grace, and end."""
        ends = time.monotonic() + self._grace_s
        for subscription in self._subscriptions:
            subscription.close(CLOSE_S)
        while not self.writer.idle() and time.monotonic() < ends:
            time.sleep(DRAIN_POLL_S)
        self.writer.close()
        self._log.connection.close(CLOSE_S)

    def _take(self, message: Arrival) -> None:
        """Put a message into the log; an invalid one is counted here and reported by the service that tracks."""
        kind = schemas.Detections if message.key.endswith("/detections") else schemas.Tracks
        try:
            stream = self._client.keys.stream_of(message.key)
            content = schemas.decode(message.payload, kind, encoding=message.encoding, limits=self._limits)
        except schemas.MessageError:
            content = None
        if content is None or content.stream != stream:
            self.invalid += 1
            return
        topic: Topic = "detections"
        sensor, order = "", (0, 0)
        if isinstance(content, schemas.Tracks):
            topic, sensor, order = "tracks", content.sensor or "", order_of(content)
        frame = content.epoch, content.seq, content.stamp_ns, sensor
        self.writer.put(LogMessage(topic, stream, *frame, order, message.payload, message.encoding))

    def _lost(self, stream: str, why: str) -> None:
        problem = problem_of(
            "message_log",
            stream=stream,
            instance=self._instance,
            expected="a message log that takes the message",
            received=why,
            message=f"Not in the message log: {why}.",
        )
        self.reporter.report(problem, time.monotonic_ns())

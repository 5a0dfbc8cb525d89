"""A message's way through the session of its stream: decoded, counted, tracked, and what came of it delivered.

Where several streams share a session, what is wrong with a message is said on the stream that it came on.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

from optipmb_service.runtime.decoding import message_of
from optipmb_service.runtime.step_limit import StepLimit
from optipmb_service.runtime.track_publisher import Arrival

if TYPE_CHECKING:
    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.runtime.mailbox import Mailbox
    from optipmb_service.runtime.ports import Packet
    from optipmb_service.runtime.stream_counters import StreamCounters
    from optipmb_service.runtime.stream_outputs import StreamOutputs
    from optipmb_service.runtime.stream_sensors import StreamSensors
    from optipmb_service.session.session import Session


CLOUD_REFUSED: Final = {"invalid_value", "refused"}
"""Problems by which a session says that it does not take a cloud: not valid, or of one sensor too many."""


class StreamTracking:
    """Takes messages to a session and its outputs on.

    Args:
        context: what all actors share.
        counters: of the messages.
        sensors: the streams that feed the session.
        outputs: where its results go.
    """

    def __init__(
        self, context: ActorContext, counters: StreamCounters, sensors: StreamSensors, outputs: StreamOutputs
    ) -> None:
        self._prefix = f"{context.keys.prefix}/"
        self._limits = context.limits
        self._queue_frames = context.queue_frames
        self._counters = counters
        self._sensors = sensors
        self._outputs = outputs
        self.limit = StepLimit(context.step_limit_ns, outputs)
        """What a message may take."""
        self.changed = False
        """Whether the session has a state that was not given to the checkpoint writer; reset by whoever gives it."""

    def accept(self, session: Session, packet: Packet, *, frame: bool) -> None:
        """Give a packet to a session and deliver what comes of it; refused when its stream is degraded."""
        stream, resting = self._stream_of(packet.origin), self.limit.until_ns
        if resting and time.monotonic_ns() < resting.get(stream, 0):
            self._counters.receive(frame=frame)
            self._counters.refuse(session, frame=frame)
            self.limit.refuse(stream)
            return
        began_ns, processor_ns = time.perf_counter_ns(), time.thread_time_ns()
        try:
            self._track(session, packet, began_ns, frame=frame)
        finally:
            # It took no more processor time than time, and to read the processor time is a system call.
            if time.perf_counter_ns() - began_ns > self.limit.limit_ns:
                self.limit.charge(stream, time.thread_time_ns() - processor_ns)

    def read(
        self, packet: Packet, session: Session | None, *, frame: bool
    ) -> schemas.Detections | schemas.Points | None:
        """Return the message of a packet; None after a refusal, which is counted with the session, if any."""
        kind = schemas.Detections if frame else schemas.Points
        stream = self._stream_of(packet.origin)
        try:
            return message_of(packet, kind, stream, self._limits)
        except schemas.MessageError as error:
            self._counters.refuse(session, frame=frame)
            self._outputs.report(
                error.code, error.path, error.expected, error.received, what=kind.__name__, stream=stream
            )
            return None

    def recovered(self, session: Session) -> None:
        """End a session's waiting for frames that caches may hold."""
        self.changed = True
        self._outputs.deliver(session.recovered(time.monotonic_ns()), session)

    def report_shed(self, mailbox: Mailbox) -> None:
        """Report the frames that a mailbox has dropped since the last time, on the streams that they came on."""
        expected = f"at most {self._queue_frames} frames waiting"
        for origin, shed in mailbox.shed_since().items():
            received, stream = f"{shed} more; the oldest were dropped", self._stream_of(origin)
            self._outputs.report("shed", "", expected, received, count=shed, stream=stream)

    def _stream_of(self, origin: str) -> str:
        """Return the stream of what came on a key."""
        return origin.removeprefix(self._prefix)

    def _track(self, session: Session, packet: Packet, began_ns: int, *, frame: bool) -> None:
        self.changed = True
        self._counters.receive(frame=frame)
        message = self.read(packet, session, frame=frame)
        if message is None:
            return
        now_ns = time.monotonic_ns()
        self._sensors.arrived(packet, message.stream, frame=frame)
        ticket = Arrival(packet.wall_ns, packet.now_ns, time.perf_counter_ns() - began_ns)
        if isinstance(message, schemas.Points):
            outputs = session.on_points(message, now_ns, ticket=ticket)
            if any(getattr(one, "code", "") in CLOUD_REFUSED for one in outputs):
                self._counters.refuse(session, frame=False)
        else:
            outputs = session.on_detections(message, now_ns, arrived_ns=packet.now_ns, ticket=ticket)
        self._outputs.deliver(outputs, session)

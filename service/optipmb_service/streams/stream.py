"""Stream: one session's turns on the tracking thread.

A stream gives its session what waits in the backlog. All is on the tracking thread, so nothing is locked. Where several
sensors share a session, the stream has the session's name.

A stream is made for any message on a key whose partition this member holds, its session only for a valid message:
garbage costs a stream that is gone when its backlog is empty. Clocks: `now_ns` is monotonic, and alone decides.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.session.checkpoint import forgotten
from optipmb_service.streams.counters import StreamCounters
from optipmb_service.streams.opening import Opening
from optipmb_service.streams.outbox import StreamOutbox, Ticket
from optipmb_service.streams.sensor_meters import SensorMeters
from optipmb_service.streams.sources import Sources
from optipmb_service.telemetry.stream_meter import StreamMeter
from optipmb_service.zenoh.topics import Packet

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.session.outputs import Output
    from optipmb_service.session.session import Session
    from optipmb_service.streams.backlog import Backlog
    from optipmb_service.streams.streams import Streams

log = structlog.get_logger("optipmb_service")

BATCH: Final = 8
"""Items that are taken before other streams have their turn."""

TURN_NS: Final = 5_000_000
"""Time after which they have it in any case."""

CLOUD_REFUSED: Final = {"invalid_value", "refused"}
"""Problems by which a session refuses a cloud: not valid, or of one sensor too many."""


class Stream:
    """Session of a sensor, or of several.

    Args:
        streams: of the process.
        backlog: its waiting messages.
    """

    def __init__(self, streams: Streams, backlog: Backlog) -> None:
        parts = streams.parts
        self.name = backlog.session
        self.backlog = backlog
        self.session: Session | None = None
        self.fused = parts.fusion.is_session(self.name)
        self.meter = StreamMeter(time.monotonic_ns())
        self.sensors = SensorMeters(self.name, self.meter, parts)
        self.policy = parts.sessions.policy(self.name)
        self.outbox = StreamOutbox(self.name, parts, self.policy, self.meter)
        self.opening = Opening(streams, self.policy, backlog)
        self.sources = Sources(parts, streams.directory, backlog)
        self._streams = streams
        self._parts = parts
        self._member = parts.member
        self._prefix = f"{parts.keys.prefix}/"
        self._changed = False
        self._armed_ns: int | None = None
        backlog.attach(partial(parts.scheduler.submit, self.work), self.on_answered)
        self.counts = StreamCounters(backlog)

    # A turn

    def work(self) -> bool:
        """Take some of what waits; True: come again."""
        backlog, ends_ns = self.backlog, time.monotonic_ns() + TURN_NS
        for _ in range(BATCH):
            item = backlog.take(urgent=self._paused)
            if item is None:
                break
            if isinstance(item, Packet):
                self._guard(self._receive, item)
            else:
                self._guard(item)
            if backlog.empty or time.monotonic_ns() >= ends_ns:
                break
        paused = self._paused  # asked after `take`: a call of `wake` before that may mean that the pause has ended
        if not paused:
            self._guard(self.outbox.publish)
            self._guard(self._settle)
        turn = backlog.end_turn(close=not self.occupied, urgent=paused)
        if turn is None:
            self._streams.discard(self)
        return bool(turn)

    def tell(self, command: Callable[[Stream], None]) -> None:
        """Run a command before all that waits."""
        self.backlog.command(partial(command, self), urgent=True)

    def ask(self, command: Callable[[Stream], None], *, create: bool) -> None:
        """Call `command` as soon as no session is about to begin or end; with `create`, one begins if there is none."""
        if create and self.session is None and not self.opening.under_way and self._member.holds(self.name):
            self.opening.begin(self._on_opened)
        if self.opening.under_way:
            self.opening.wait(partial(self.ask, command, create=create))
        else:
            self._guard(command, self)

    @property
    def occupied(self) -> bool:
        """Whether there is a session, or one begins, or the state of one is not kept yet; for any thread.

        Such a stream has sent a valid message.
        """
        return self.session is not None or self.opening.under_way

    @property
    def changed(self) -> bool:
        """Whether the session has a state that was not given to the checkpoint writer; for any thread."""
        return self._changed and self.session is not None

    @property
    def held_bytes(self) -> int:
        """Bytes of messages that the session keeps; for any thread."""
        session = self.session
        return 0 if session is None else session.held_bytes

    @property
    def _paused(self) -> bool:
        """Whether messages wait: the write lease has lapsed, or another instance has the stream."""
        return self.session is not None and not self.outbox.may_write

    def _guard(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception as error:
            log.exception("internal_error", stream=self.name)
            expected, received = "a message handled without an error", f"{type(error).__name__}: {error}"
            self._parts.report("internal", self.name, expected, received)

    def _settle(self) -> None:
        """Process frames whose wait is over, send predicted tracks that are due, and ask for the next turn."""
        for origin, shed in self.backlog.shed_since().items():
            expected = f"at most {self._parts.settings.queue_frames} frames waiting"
            received = f"{shed} more; the oldest were dropped"
            self._parts.report("shed", self._stream_of(origin), expected, received, count=shed)
        session = self.session
        if session is None:
            return
        now_ns, deadline_ns = time.monotonic_ns(), session.deadline_ns
        if deadline_ns is not None and deadline_ns <= now_ns and not self.backlog.clouds_waiting:
            self.deliver(session.on_tick(now_ns))
            deadline_ns = session.deadline_ns
        if (predicted_ns := self.outbox.predict(session)) is not None:
            deadline_ns = predicted_ns if deadline_ns is None else min(deadline_ns, predicted_ns)
        if deadline_ns == 0:
            self.backlog.wake()  # more is ready: after the other streams
        elif deadline_ns is not None and deadline_ns != self._armed_ns:
            self._armed_ns = deadline_ns
            self._parts.arm(self.backlog.wake, deadline_ns)

    # Messages

    def _receive(self, packet: Packet) -> None:
        """Give a packet to the session, or begin one; who takes too much time is refused for a while."""
        session, stream = self.session, self._stream_of(packet.origin)
        if session is None:
            self._begin(packet)
            return
        self.counts.receive(frame=packet.frame)
        if self.sensors.refuses(stream):
            self.counts.refuse(session, frame=packet.frame)
            return
        self._changed = True
        began_ns, processor_ns = time.perf_counter_ns(), time.thread_time_ns()
        try:
            if (message := self._read(packet, session)) is not None:
                self._track(session, packet, message, time.perf_counter_ns() - began_ns)
        finally:
            # It took no more processor time than time, and to read the processor time is a system call.
            if time.perf_counter_ns() - began_ns > self.sensors.limit_ns:
                self.sensors.charge(stream, time.thread_time_ns() - processor_ns)

    def _begin(self, packet: Packet) -> None:
        """Begin a session with a valid packet, if there is room."""
        if not self._member.holds(self.name):
            self.backlog.open(packet)
            self.backlog.leave()
        elif self._read(packet) is not None:
            why = self._streams.admission.room(self.name)
            if why or not self.opening.begin(self._on_opened, packet):
                self.counts.refuse(None, frame=packet.frame)
            if why:
                self._parts.report("refused", self.name, why, "another one; there is room for no more sessions")

    def _read(self, packet: Packet, session: Session | None = None) -> schemas.Detections | schemas.Points | None:
        """Return the message of a packet; None after a refusal, which is counted with the session, if any."""
        stream = self._stream_of(packet.origin)
        try:
            return packet.message(stream, self._parts.limits)
        except schemas.MessageError as error:
            self.counts.refuse(session, frame=packet.frame)
            subject = (schemas.Detections if packet.frame else schemas.Points).__name__
            self._parts.report(error.code, stream, error.expected, error.received, path=error.path, subject=subject)
            return None

    def _track(
        self, session: Session, packet: Packet, message: schemas.Detections | schemas.Points, decode_ns: int
    ) -> None:
        now_ns = time.monotonic_ns()
        self.sensors.arrived(packet, message.stream)
        trace = self._parts.traces.received(packet, message) if self._parts.traces else None
        ticket = Ticket(packet.wall_ns, packet.now_ns, decode_ns, trace)
        if isinstance(message, schemas.Points):
            outputs = session.on_points(message, now_ns, ticket=ticket)
            if any(getattr(one, "code", "") in CLOUD_REFUSED for one in outputs):
                self.counts.refuse(session, frame=False)
        else:
            outputs = session.on_detections(message, now_ns, arrived_ns=packet.now_ns, ticket=ticket)
        self.deliver(outputs)

    def _stream_of(self, origin: str) -> str:
        return origin.removeprefix(self._prefix)

    def deliver(self, outputs: Sequence[Output]) -> None:
        """Publish, log and report outputs of the session."""
        self.outbox.deliver(outputs, self.session)

    def on_answered(self, *caches: str) -> None:
        """Note caches of which all has been taken; go on behind gaps when all sources have answered."""
        session = self.session
        if session is not None and self.sources.complete(session, *caches):
            self._changed = True
            self.deliver(session.recovered(time.monotonic_ns()))

    # Coming

    def take_up(self) -> None:
        """Go on with a session that has come here. One that is kept, and was not closed, goes on at once.

        Else the first valid packet begins one.
        """
        if not self._member.holds(self.name):
            return
        if self.opening.under_way:
            self.backlog.open()
        elif (
            self.session is not None
            or self._streams.admission.room(self.name)
            or not self.opening.begin(self._on_opened, restore_only=True)
        ):
            self.backlog.go_live()

    def _on_opened(self, session: Session, fence: int | None, restored: bool) -> None:  # noqa: FBT001 - a callback
        self.outbox.open(fence)
        self.counts.open(session)
        self._changed, self.session = False, session
        if restored:
            self._guard(self.outbox.resume, session)

    # Leaving

    def on_lost(self) -> None:
        """Leave the stream: another instance has it, and the newest state."""
        if not self._member.holds(self.name):
            self.backlog.leave()
        if self.outbox.fence == self._member.fence(self.name):
            return  # lost and taken again before this was called
        self._parts.checkpoints.forget(self.name)
        if self.session is not None:
            expected = "an instance that is neither frozen nor cut off"
            self._parts.report("superseded", self.name, expected, "another one goes on")
        self._drop_session("superseded")

    def on_renewed(self) -> None:
        """Go on under another fence: the store has lost the lease, and all checkpoints with it."""
        self.outbox.fence = self._member.fence(self.name)
        self._changed = True

    def on_recalled(self) -> None:
        """Another instance is to have the stream: leave it as soon as its state is kept.

        Without a router it is left as by a process that is killed: the newest tracks may not have left this process, so
        the other one is to track their frames again.
        """
        if self._member.unlinked:
            self._parts.checkpoints.forget(self.name)
            self._drop_session("unlinked")
            self._member.look()
        else:
            self.close_session("moved")

    def close_session(self, reason: str) -> None:
        """End the session and free its memory; the next valid message of the stream begins another, or goes on.

        A session that is idle or moved is kept as it is; one that is closed by a query forgets its density and its
        counters. Pending messages are processed, in a session that is moved by the next member.
        """
        session = self.session
        if session is None:
            return
        if reason == "moved":
            self.counts.hand_over(session.held)
            self.opening.hand_over(session)
        else:
            self.deliver(session.flush())
        self.outbox.publish()  # what waited for the write lease is in the state that is kept
        state = session.snapshot()
        if reason == "query":
            session.reset()
            state = forgotten(session.snapshot())
        self.opening.close()
        self._drop_session(reason)
        self._parts.checkpoints.put(state, self.outbox.fence, lambda: self.tell(lambda one: one.opening.kept()))

    def keep(self) -> None:
        """Give the state to the checkpoint writer, if it changed."""
        if (session := self.session) is not None and self._changed:
            self._changed = False
            self._guard(lambda: self._parts.checkpoints.put(session.snapshot(), self.outbox.fence))

    def flush(self) -> None:
        """Process pending frames without waiting any longer."""
        if self.session is not None:
            self.deliver(self.session.flush())

    def _drop_session(self, reason: str) -> None:
        if (session := self.session) is None:
            return
        self.session, self._armed_ns = None, None
        self.outbox.close()
        self.counts.close()
        self._streams.admission.release(self.name, session.incarnation)
        log.info(
            "session_closed", stream=self.name, session=session.session, reason=reason, frames=session.counters.frames
        )

    # State, for any thread

    def summary(self, now_ns: int) -> schemas.SessionSummary | None:
        """Return the line of the service's status."""
        session = self.session
        if session is None:
            return None
        summary = self.sensors.summary(self.counts.state(session), now_ns)
        more = {"configured": self._parts.sessions.differing_profile(session), "learned": session.learned}
        return summary.model_copy(update=more)

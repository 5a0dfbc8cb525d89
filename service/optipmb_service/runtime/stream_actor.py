"""A session's way through the service: decode, track, publish, all on one worker at a time, so nothing is locked here.

Most sessions are those of one stream. Where several streams share one (`fusion`), the actor has its name, and what is
wrong with a message is said on the stream that it came on.

An actor is made for whatever arrives on a stream's key, its session only for a valid message of a stream that this
instance owns: garbage costs an actor that is gone when its mailbox is empty. While another instance owns the stream, or
it is not known yet who does, packets wait for a takeover (`takeover_buffer`). Clocks: `now_ns` monotonic for all
decisions, the wall clock only for what delivery reports.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.cluster.port import Role
from optipmb_service.observability.stream_meter import StreamMeter
from optipmb_service.runtime.decoding import message_of
from optipmb_service.runtime.mailbox import Mailbox
from optipmb_service.runtime.ports import Packet
from optipmb_service.runtime.stream_counters import StreamCounters
from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
from optipmb_service.runtime.track_publisher import Arrival, TrackPublisher
from optipmb_service.session.checkpoint import Checkpoint, CheckpointError, forgotten
from optipmb_service.session.problems import problem_of
from optipmb_service.session.session import Session
from optipmb_service.session.values import MAX_SENSORS, Begun, Output, Quarantined, Tracked

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.session.values import Lineage, MessageCounters

log = structlog.get_logger("optipmb_service")

REST: Final = 9
"""How many times as long as a message took beyond its limit a stream rests: it has a tenth of the time at most."""

BATCH: Final = 8
"""Items that the thread takes before the other streams have their turn."""

TURN_NS: Final = 5_000_000
"""Time after which they have it in any case."""


class StreamActor:
    """One stream, or several that share a session.

    Args:
        stream: `site/node/sensor`; the name of the session, where several streams share it.
        context: what all actors share.
    """

    def __init__(self, stream: str, context: ActorContext) -> None:
        self.stream = stream
        self.mailbox = Mailbox(context.queue_frames, context.queue_clouds, context.mailbox_bytes, context.mailboxes)
        self.meter = StreamMeter(time.monotonic_ns())
        self.session: Session | None = None
        self.fused = context.fused(stream)
        self.sensors: dict[str, StreamMeter] = {} if self.fused else {stream: self.meter}
        """Of each stream."""
        self.stale: set[str] = set()
        """Streams that fell silent."""
        self._accounts = StreamCounters(self.mailbox)
        self._context = context
        self._takeover = TakeoverBuffer(context.standby_ns, context.budget)
        self._out = TrackPublisher(
            stream, context.instance, context.sink, self.meter, context.metrics, context.coordinator
        )
        self._asking: list[Callable[[StreamActor], None]] = []
        self._changed = False
        self._armed_ns: int | None = None
        self._degraded_ns: dict[str, int] = {}
        self._opening: Lineage | None = None
        self._grant = 0

    def wake(self) -> None:
        """Send a worker though nothing came: frames have waited long enough."""
        if self.mailbox.ring():
            self._context.submit(self)

    def tell(self, command: Callable[[StreamActor], None]) -> None:
        """Have the worker run a command before all that waits."""
        if self.mailbox.offer_command(lambda: command(self), urgent=True):
            self._context.submit(self)

    # The worker's turn

    def work(self) -> bool:
        """Take some of what waits; True: come again."""
        ends_ns = time.monotonic_ns() + TURN_NS
        for _ in range(BATCH):
            taken = self.mailbox.take(urgent=self._paused)
            if taken is None:
                break
            self._guard(self._handle, *taken)
            if time.monotonic_ns() >= ends_ns:
                break
        paused = self._paused
        if not paused:
            self._out.flush()
            self._guard(self._settle)
        close = not self._needed
        if close:
            self._context.coordinator.release(self.stream)
        turn = self.mailbox.leave(close=close, urgent=paused)
        if turn is None:
            self._context.discard(self)
        return bool(turn)

    @property
    def _paused(self) -> bool:
        """Whether frames have to wait: the write lease lapsed, and the tokens of others are looked at."""
        return self.session is not None and not self._context.coordinator.may_write(self.stream)

    @property
    def _needed(self) -> bool:
        """Whether the actor holds anything that the next message of its stream, or the coordinator, will ask for."""
        coming = self._context.coordinator.role(self.stream) in {Role.CLAIMING, Role.OWNER}
        return self.session is not None or coming or bool(self._takeover) or bool(self._asking)

    @property
    def elsewhere(self) -> bool:
        """Whether another instance tracks the stream, and answers for it."""
        return self.session is None and self._context.coordinator.elsewhere(self.stream)

    @property
    def proven(self) -> bool:
        """Whether the stream has sent a valid message, as far as is known; may be called by any thread."""
        return self.session is not None or self._context.coordinator.role(self.stream) is not Role.NONE

    @property
    def buffers_for_takeover(self) -> bool:
        """Whether packets wait here for a takeover; may be called by any thread."""
        return self.session is None and self._opening is None and bool(self._takeover)

    @property
    def held_bytes(self) -> int:
        """Bytes of messages that the session keeps; may be called by any thread."""
        session = self.session
        return 0 if session is None else session.held_bytes

    def _guard(self, work: Callable[..., None], *arguments: Any, **named: Any) -> None:
        """Do a piece of work; whatever it raises, the stream and its worker go on."""
        try:
            work(*arguments, **named)
        except Exception as error:
            log.exception("internal_error", stream=self.stream)
            self._report("internal", "", "a message handled without an error", f"{type(error).__name__}: {error}")

    def _handle(self, kind: str, item: Packet | Callable[[], None]) -> None:
        if isinstance(item, Packet):
            self._receive(item, frame=kind == "frame")
        else:
            item()

    def _settle(self) -> None:
        """Let go what has waited long enough, and have the worker come back for what has not."""
        if self._accounts.shed():
            expected = f"at most {self._context.queue_frames} frames waiting"
            for origin, shed in self.mailbox.shed_since().items():
                received, stream = f"{shed} more; the oldest were dropped", self._stream_of(origin)
                self._report("shed", "", expected, received, count=shed, stream=stream)
        session = self.session
        if session is None or (deadline_ns := session.deadline_ns) is None:
            return
        now_ns = time.monotonic_ns()
        if deadline_ns <= now_ns and not self.mailbox.clouds_waiting:
            self._deliver(session.on_tick(now_ns))
            deadline_ns = session.deadline_ns
        if deadline_ns is not None and deadline_ns != self._armed_ns:
            self._armed_ns = deadline_ns
            self._context.arm(self, deadline_ns)

    # Messages

    def _receive(self, packet: Packet, *, frame: bool) -> None:
        session = self.session
        if session is None:
            self._buffer(packet, frame=frame)
            return
        stream = self._stream_of(packet.origin)
        if time.monotonic_ns() < self._degraded_ns.get(stream, 0):
            self._accounts.receive(frame=frame)
            self._accounts.refuse(session, frame=frame)
            expected = f"at most {self._context.step_limit_ns / 1e9:g} s of processor time for a message"
            self._report("overload", "", expected, "a stream that took more just before", stream=stream)
            return
        began_ns = time.thread_time_ns()
        try:
            self._track(session, packet, frame=frame)
        finally:
            self._charge(stream, time.thread_time_ns() - began_ns)

    def _charge(self, stream: str, took_ns: int) -> None:
        """Degrade a stream when a message of it took too long: the others of the process waited for it."""
        if took_ns <= self._context.step_limit_ns:
            return
        now_ns = time.monotonic_ns()
        self._degraded_ns = {name: until for name, until in self._degraded_ns.items() if until > now_ns}
        self._degraded_ns[stream] = now_ns + REST * took_ns
        log.warning("stream_degraded", stream=stream, took_s=took_ns / 1e9, refused_s=REST * took_ns / 1e9)
        expected = f"at most {self._context.step_limit_ns / 1e9:g} s of processor time for a message"
        self._report("overload", "", expected, f"{took_ns / 1e9:.3f} s", stream=stream)

    def _stream_of(self, origin: str) -> str:
        """Return the stream of what came on a key."""
        return origin.removeprefix(f"{self._context.keys.prefix}/")

    def _track(self, session: Session, packet: Packet, *, frame: bool) -> None:
        began_ns = time.perf_counter_ns()
        self._changed = True
        self._accounts.receive(frame=frame)
        message = self._read(packet, frame=frame)
        if message is None:
            return
        now_ns = time.monotonic_ns()
        self._arrived(packet, message.stream, frame=frame)
        ticket = Arrival(packet.wall_ns, packet.now_ns, time.perf_counter_ns() - began_ns)
        if isinstance(message, schemas.Points):
            outputs = session.on_points(message, now_ns, ticket=ticket)
            if any(getattr(one, "code", "") == "invalid_value" for one in outputs):
                self._accounts.refuse(session, frame=False)
        else:
            outputs = session.on_detections(message, now_ns, arrived_ns=packet.now_ns, ticket=ticket)
        self._deliver(outputs)

    def _arrived(self, packet: Packet, stream: str, *, frame: bool) -> None:
        """Note a valid message of a stream."""
        self.meter.arrived(packet.now_ns, frame=frame)
        if self.fused and (stream in self.sensors or len(self.sensors) < MAX_SENSORS):
            self.sensors.setdefault(stream, StreamMeter(packet.now_ns)).arrived(packet.now_ns, frame=frame)
        if stream in self.stale and frame:
            self.stale.discard(stream)
            log.info("stream_back", stream=stream)

    def _read(self, packet: Packet, *, frame: bool) -> schemas.Detections | schemas.Points | None:
        """Return the message of a packet; None after a refusal."""
        kind = schemas.Detections if frame else schemas.Points
        stream = self._stream_of(packet.origin)
        try:
            return message_of(packet, kind, stream, self._context.limits)
        except schemas.MessageError as error:
            self._accounts.refuse(self.session, frame=frame)
            self._report(error.code, error.path, error.expected, error.received, what=kind.__name__, stream=stream)
            return None

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Tracked):
                self._out.send(output)
            elif isinstance(output, Begun):
                epoch = self.session.state().epoch if self.session else None
                log.info(
                    "session_begun",
                    stream=self.stream,
                    session=output.session,
                    epoch=epoch.hex() if epoch else "",
                    reason=output.reason,
                    profile=self.session.parameters.name if self.session else "",
                    jump_s=output.jump_ns / 1e9,
                )
            elif isinstance(output, Quarantined):
                file = self._context.dump(self.stream, output.dump)
                log.error("session_quarantined", stream=self.stream, error=output.error, file=file)
            else:
                self._context.reporter.report(output, time.monotonic_ns())

    def _report(
        self, code: str, path: str, expected: str, received: str, *, what: str = "", count: int = 1, stream: str = ""
    ) -> None:
        message = f"{what or 'Stream'}: {path or 'message'}: expected {expected}, received {received}."
        problem = problem_of(
            code,
            stream=stream or self.stream,
            instance=self._context.instance,
            path=path,
            expected=expected,
            received=received,
            message=message,
            count=count,
        )
        self._context.reporter.report(problem, time.monotonic_ns())

    # Who tracks the stream; to be called by the worker alone

    def _buffer(self, packet: Packet, *, frame: bool) -> None:
        """Keep a packet for the moment when this instance owns the stream, and ask for it if nobody does."""
        coordinator = self._context.coordinator
        if coordinator.role(self.stream) is Role.NONE:
            if coordinator.elsewhere(self.stream):
                # Another instance tracks it, which decodes and complains; here it is kept for a takeover, if there is
                # room for one.
                if not self._context.room(self.stream):
                    coordinator.request(self.stream)
                    self._takeover.add(packet, frame=frame)
                return
            if self._read(packet, frame=frame) is None or not self._admitted(frame=frame):
                return
            self._context.coordinator.request(self.stream)
        self._takeover.add(packet, frame=frame)

    def ask(self, command: Callable[[StreamActor], None], *, seek: bool) -> None:
        """Call `command` as soon as it is known whether this instance owns the stream, perhaps now.

        With `seek` it asks for a stream that nobody owns.
        """
        coordinator = self._context.coordinator
        if seek and self.session is None and coordinator.role(self.stream) is Role.NONE:
            coordinator.request(self.stream)
        self._asking.append(command)
        if self.session is not None or coordinator.role(self.stream) in {Role.NONE, Role.STANDBY}:
            self._answer()

    def on_granted(self) -> None:
        """This instance owns the stream: go on where its last owner was, with all that came since."""
        if self._context.coordinator.role(self.stream) is not Role.OWNER:
            return  # given up meanwhile, or lost again, which will be told too
        self._grant += 1
        if self.session is not None:
            self._resume()
        elif self._opening is None:
            self._opening = self._context.admit(self.stream)
            if self._opening is not None:
                self._load()
                return
            self._admitted(frame=True)
            self._context.coordinator.release(self.stream)
            self._resume()

    def _resume(self) -> None:
        """Go on with what came while nobody tracked the stream here."""
        for packet, frame in self._takeover.take():
            if self.session is not None:
                self._guard(self._receive, packet, frame=frame)
            else:
                self._accounts.refuse(self.session, frame=frame)
        self._answer()

    def on_lost(self) -> None:
        """Another instance owns the stream: what is here is no longer the newest state."""
        self._context.persistence.forget(self.stream)
        if self.session is not None:
            self._report("superseded", "", "an instance that is neither frozen nor cut off", "another one goes on")
        self._drop_session("superseded")
        self._answer()

    def on_recalled(self) -> None:
        """Another instance is to have the stream: leave it as soon as its state is kept."""
        if self.session is None:
            self.release_ownership()
        else:
            self.close_session("moved")

    def release_ownership(self) -> None:
        """The session has ended and its state is kept: whoever gets the next message of the stream may go on."""
        if self.session is None:
            self._context.coordinator.release(self.stream)
            if self._takeover or self._asking:
                self._context.coordinator.request(self.stream)

    def hand_over(self, then: Callable[[], None] = lambda: None) -> None:
        """End the session because another worker has the stream now; `then` is called when its state is kept.

        While it is not known yet who owns the stream, its first packets wait here and nowhere else: they are tracked
        first.
        """
        self.ask(lambda actor: actor.close_session("moved", then), seek=False)

    def trim(self) -> None:
        """Drop what has waited too long for a takeover."""
        self._takeover.trim(time.monotonic_ns())

    def _answer(self) -> None:
        asking, self._asking = self._asking, []
        for command in asking:
            self._guard(command, self)

    # Sessions; to be called by the worker alone

    def _admitted(self, *, frame: bool) -> bool:
        why = self._context.room(self.stream)
        if not why:
            return True
        self._accounts.refuse(self.session, frame=frame)
        self._report("refused", "", why, "another one; there is room for no more sessions")
        return False

    def _load(self) -> None:
        """Have the session restored on the thread of the store; packets wait meanwhile."""
        context, grant = self._context, self._grant

        def restore(checkpoint: Checkpoint) -> Session:
            now_ns = time.monotonic_ns()
            if checkpoint.fused is not self.fused:
                raise CheckpointError(f"of {'several streams' if checkpoint.fused else 'one stream'}, by `fuse` then")
            return Session.restore(
                checkpoint, now_ns, context.policy, instance=context.instance, tracker=context.tracker
            )

        context.persistence.recall(
            self.stream, restore, lambda restored: self.tell(lambda actor: actor.on_loaded(restored, grant))
        )

    def on_loaded(self, restored: Session | None, grant: int) -> None:
        """Begin a session, or go on with the one that was kept; unless the stream was lost meanwhile."""
        lineage, self._opening = self._opening, None
        if lineage is None:
            return
        if self._context.coordinator.role(self.stream) is not Role.OWNER:
            self._context.release(self.stream, lineage)
            self._answer()
            return
        if grant != self._grant:
            # Lost and granted again: another instance may have gone on in between.
            self._opening = lineage
            self._load()
            return
        self._begin(restored, lineage)
        self._resume()

    def _begin(self, restored: Session | None, lineage: Lineage) -> None:
        context = self._context
        self._out.open()
        if restored is None:
            session = Session(
                self.stream,
                context.parameters_of(self.stream),
                context.policy,
                fused=self.fused,
                instance=context.instance,
                life=lineage,
                tracker=context.tracker,
            )
            log.info("session_opened", stream=self.stream, profile=session.parameters.name)
        else:
            session = restored
            context.metrics.restored()
            log.info("session_restored", stream=self.stream, session=session.session, frames=session.counters.frames)
            # Its run has a new number: written soon, so that a crash just now does not give the next run the same one.
            context.persistence.put(session.snapshot(), lambda: None)
        self.session, self._changed = session, False
        self._accounts.open(session)

    def close_session(self, reason: str, then: Callable[[], None] = lambda: None) -> None:
        """End the session and free what it holds; the next valid message of the stream begins another, or goes on.

        A session that is idle or moved is kept as it is; one that is closed by a query forgets its density and its
        counters. `then` is called when its state is kept and the stream left.
        """
        session = self.session
        if session is None:
            then()
            return
        self._deliver(session.flush())
        state = session.snapshot()
        if reason == "query":
            session.reset()
            state = forgotten(session.snapshot())
        self._drop_session(reason)

        def leave(actor: StreamActor) -> None:
            actor.release_ownership()
            then()

        self._context.persistence.put(state, lambda: self.tell(leave))

    def keep(self) -> None:
        """Give the state to the checkpoint writer, if it changed."""
        if self.session is not None and self._changed:
            self._changed = False
            self._context.persistence.put(self.session.snapshot())

    def _drop_session(self, reason: str) -> None:
        session = self.session
        if session is None:
            return
        self.session, self._armed_ns = None, None
        self._out.close()
        self._accounts.close(session)
        self._context.release(self.stream, session.life)
        log.info(
            "session_closed", stream=self.stream, session=session.session, reason=reason, frames=session.counters.frames
        )

    def deliver(self, outputs: Sequence[Output]) -> None:
        """Publish what a command to the session brought."""
        self._deliver(outputs)

    def state(self) -> schemas.SessionState | None:
        """Return the state of the session without its digest, None without a session."""
        return None if self.session is None else self._accounts.state(self.session)

    def totals(self) -> MessageCounters:
        """Return what became of messages since the actor is there; may be called by any thread."""
        return self._accounts.totals(self.session)

    def summary(self, now_ns: int) -> schemas.SessionSummary | None:
        """Return the line of the service's status; may be called by any thread."""
        session = self.session
        if session is None:
            return None
        degraded = any(now_ns < until for until in tuple(self._degraded_ns.values()))
        stale, sensors = frozenset(self.stale), sorted(self.sensors)
        state = self._accounts.state(session)
        summary = self.meter.summary(state, now_ns, stale=bool(sensors) and stale >= set(sensors), degraded=degraded)
        if not self.fused:
            return summary
        return summary.model_copy(update={"sensors": tuple(sensors), "silent": tuple(sorted(stale))})

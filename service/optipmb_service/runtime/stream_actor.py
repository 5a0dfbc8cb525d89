"""A session's way through the service: decode, track, publish, all on one worker at a time, so nothing is locked here.

Most sessions are those of one stream. Where several streams share one (`fusion`), the actor has its name, and what is
wrong with a message is said on the stream that it came on.

An actor is made for whatever arrives on the key of a stream whose partition this instance holds, its session only for a
valid message: garbage costs an actor that is gone when its mailbox is empty. Clocks: `now_ns` monotonic for all
decisions, the wall clock only for what delivery reports.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.observability.stream_meter import StreamMeter
from optipmb_service.runtime.decoding import message_of
from optipmb_service.runtime.directory import BACK_NS
from optipmb_service.runtime.mailbox import Mailbox
from optipmb_service.runtime.ports import Packet, TransportError
from optipmb_service.runtime.stream_counters import StreamCounters
from optipmb_service.runtime.track_publisher import Arrival, TrackPublisher
from optipmb_service.session.checkpoint import Checkpoint, CheckpointError, forgotten
from optipmb_service.session.problems import problem_of
from optipmb_service.session.session import Session
from optipmb_service.session.values import MAX_SENSORS, Begun, Output, Quarantined, Tracked, total

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
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
        self._waiting = context.buffer()
        self._missed: deque[TakeoverBuffer] = deque()
        self._out = TrackPublisher(stream, context.instance, context.sink, self.meter, context.metrics, context.member)
        self._asking: list[tuple[Callable[[StreamActor], None], bool]] = []
        self._changed = False
        self._armed_ns: int | None = None
        self._degraded_ns: dict[str, int] = {}
        self._opening: Lineage | None = None
        self._seeking = False
        self._answered: set[str] = set()
        self._asked: set[str] = set()
        self._closing = False
        self._fence: int | None = None

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
        turn = self.mailbox.leave(close=not self.occupied, urgent=paused)
        if turn is None:
            self._context.discard(self)
        return bool(turn)

    @property
    def _paused(self) -> bool:
        """Whether frames have to wait: the write lease has lapsed, or another instance has the stream."""
        return self.session is not None and not self._context.member.may_write(self.stream, self._fence)

    @property
    def occupied(self) -> bool:
        """Whether there is a session, or one begins, or the state of one is not kept yet; may be called by any thread.

        Such a stream has sent a valid message.
        """
        return self.session is not None or self._opening is not None or self._closing

    @property
    def changed(self) -> bool:
        """Whether the session has a state that was not given to the checkpoint writer; may be called by any thread."""
        return self._changed and self.session is not None

    @property
    def elsewhere(self) -> bool:
        """Whether another instance tracks the stream, and answers for it."""
        return self.session is None and not self._context.member.holds(self.stream)

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
        if self.session is None or self._missed:
            self._buffer(packet, frame=frame)
        else:
            self._accept(self.session, packet, frame=frame)

    def _accept(self, session: Session, packet: Packet, *, frame: bool) -> None:
        stream = self._stream_of(packet.origin)
        if time.monotonic_ns() < self._degraded_ns.get(stream, 0):
            self._accounts.receive(frame=frame)
            self._accounts.refuse(session, frame=frame)
            expected = f"at most {self._context.step_limit_ns / 1e9:g} s of processor time for a message"
            self._report("overload", "", expected, "a stream that took more just before", stream=stream)
            return
        began_ns, held = time.thread_time_ns(), session.held
        try:
            self._track(session, packet, frame=frame)
        finally:
            # After a restore a message may let go many that were held for it.
            self._charge(stream, (time.thread_time_ns() - began_ns) // max(1, held + frame - session.held))

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
        if self.fused and stream not in self.sensors and len(self.sensors) >= MAX_SENSORS:
            oldest = min(self.sensors, key=lambda name: self.sensors[name].active_ns)
            if oldest in self.stale:
                self.stale.discard(oldest)
                self.sensors = {name: one for name, one in self.sensors.items() if name != oldest}
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

    def take_up(self, packets: Sequence[tuple[Packet, bool]], answered: Collection[str] = ()) -> None:
        """Go on with a stream that has come here, and with what it sent before, each packet with whether it is a frame.

        A session that is kept, and was not closed, goes on at once; else the first valid packet begins one. `answered`:
        streams of which all that the publisher's cache holds is among them.
        """
        if not self.occupied and self._context.member.holds(self.stream) and not self._context.room(self.stream):
            self._seeking = self._open()
        self._receive_all(packets)
        if answered:
            self.on_caches_answered(*answered)

    def on_caches_answered(self, *streams: str) -> None:
        """Go on behind gaps: all that the caches of these streams held has come. Of several sensors all must have."""
        self._answered.update(streams)
        self._asked.update(streams)
        self.ask(StreamActor._recovered, seek=False)

    def _recovered(self) -> None:
        session = self.session
        if session is not None and session.awaits_caches and not (self.fused and self._awaits(session)):
            self._changed = True
            self._deliver(session.recovered(time.monotonic_ns()))

    def _awaits(self, session: Session) -> bool:
        """Whether the caches of sensors may hold what has not come; those that have not answered are asked."""
        caches = self._context.caches()
        awaited = caches.awaited(self.stream, session.sensors)
        for stream, is_there in awaited.items():
            if is_there and stream not in self._asked:
                self._asked.add(stream)
                with contextlib.suppress(TransportError):  # the end
                    caches.ask_cache(stream, partial(self._take_cached, stream))
        # Tokens of sensors that a young session does not know may be on their way.
        young_ns = session.young_since_ns
        is_young = young_ns is not None and time.monotonic_ns() - young_ns < BACK_NS
        return is_young or not awaited.keys() <= self._answered

    def _take_cached(self, stream: str, packets: list[tuple[Packet, bool]], complete: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Have the worker take what a cache held; one that has not answered is asked again. Called on any thread."""

        def take(actor: StreamActor, cached: TakeoverBuffer) -> None:
            actor._catch_up(cached)
            if complete:
                actor.on_caches_answered(stream)
            else:
                actor._asked.discard(stream)

        self._hand_over(packets, take)

    def _receive_all(self, packets: Sequence[tuple[Packet, bool]]) -> None:
        for packet, frame in packets:
            self._guard(self._receive, packet, frame=frame)

    def _buffer(self, packet: Packet, *, frame: bool) -> None:
        """Keep a packet until a session takes it, and begin one if the packet is valid and the stream is to be here."""
        if not (self._opening or self._closing or self._missed):
            if not self._context.member.holds(self.stream):
                self._context.keep(self.stream, packet, frame)
                return
            if self._read(packet, frame=frame) is None or not self._admitted(frame=frame):
                return
            if not self._open():
                self._accounts.refuse(None, frame=frame)
                return
        self._waiting.add(packet, frame=frame)

    def ask(self, command: Callable[[StreamActor], None], *, seek: bool) -> None:
        """Call `command`, as soon as no session is about to begin or end, or has to be told what it missed.

        With `seek`, one begins if there is none.
        """
        if seek and self.session is None and not self._closing and self._context.member.holds(self.stream):
            _ = self._opening or self._open()
        if self._opening or self._closing or self._missed:
            self._asking.append((command, seek))
        else:
            self._guard(command, self)

    def _resume(self) -> None:
        """Go on with what came while a session was about to begin or end."""
        self._receive_all(self._waiting.take())
        asking, self._asking = self._asking, []
        for command, seek in asking:
            self.ask(command, seek=seek)

    def on_lost(self) -> None:
        """Another instance has the stream: what is here is no longer the newest state."""
        if self._fence == self._context.member.fence(self.stream):
            return  # lost and taken again before this was told
        self._context.persistence.forget(self.stream)
        if self.session is not None:
            self._report("superseded", "", "an instance that is neither frozen nor cut off", "another one goes on")
        self._drop_session("superseded")

    def on_recalled(self) -> None:
        """Another instance is to have the stream: leave it as soon as its state is kept."""
        self.close_session("moved")

    # Sessions; to be called by the worker alone

    def _admitted(self, *, frame: bool) -> bool:
        why = self._context.room(self.stream)
        if not why:
            return True
        self._accounts.refuse(self.session, frame=frame)
        self._report("refused", "", why, "another one; there is room for no more sessions")
        return False

    def _open(self) -> bool:
        """Begin to open a session; False when there is no room."""
        self._opening = self._context.admit(self.stream)
        if self._opening is not None:
            self._load()
        return self._opening is not None

    def _load(self) -> None:
        """Have the session restored on the thread of the store; packets wait meanwhile."""
        context, fence = self._context, self._context.member.fence(self.stream)
        taken: list[Checkpoint] = []

        def restore(checkpoint: Checkpoint) -> Session:
            now_ns = time.monotonic_ns()
            taken[:] = [checkpoint]
            if checkpoint.fused is not self.fused:
                raise CheckpointError(f"of {'several streams' if checkpoint.fused else 'one stream'}, by `fuse` then")
            return Session.restore(
                checkpoint, now_ns, context.policy, fence=fence or 1, instance=context.instance, tracker=context.tracker
            )

        def load(restored: Session | None) -> None:
            context.missed.fetch(
                self.stream,
                taken[-1] if restored and taken else None,
                lambda packets: self._hand_over(
                    packets, lambda actor, missed: actor.on_loaded(restored, fence, missed)
                ),
                lambda packets: self._hand_over(packets, StreamActor._catch_up),
            )

        context.persistence.recall(self.stream, restore, load)

    def _hand_over(
        self, packets: Sequence[tuple[Packet, bool]], command: Callable[[StreamActor, TakeoverBuffer], None]
    ) -> None:
        """Have the worker run a command with packets, within the bytes that may wait; called on any thread."""
        missed = self._context.buffer()
        for packet, frame in packets:
            missed.add(packet, frame=frame)
        if len(missed) < len(packets):
            log.warning("log_cut", stream=self.stream, frames=len(packets), kept=len(missed))
        must_send = self.mailbox.offer_command(lambda: command(self, missed), urgent=True)
        if must_send:
            self._context.submit(self)
        elif must_send is None:  # the actor has ended
            missed.take()

    def on_loaded(self, restored: Session | None, fence: int | None, missed: TakeoverBuffer) -> None:
        """Begin a session, or go on with the one that was kept and what it missed; unless the stream was lost."""
        member, lineage = self._context.member, self._opening
        if lineage is None:
            missed.take()
            return
        if fence != member.fence(self.stream) and member.holds(self.stream):
            missed.take()
            self._load()  # lost and taken again: another instance may have gone on in between
            return
        is_closed = restored is None or not restored.counters.frames
        if member.holds(self.stream) and not (is_closed and self._seeking):
            self._begin(restored, lineage, fence)
        else:
            self._context.release(self.stream, lineage)
            member.look()
        self._opening, self._seeking = None, False
        self._catch_up(missed)

    def _catch_up(self, missed: TakeoverBuffer) -> None:
        """Have the session take what it missed before all that waits; without a session it waits, too."""
        if self.session is None:
            self._receive_all(missed.take())
        elif missed:
            self._missed.append(missed)
        self._take_missed()

    def _take_missed(self) -> None:
        """Give the session some of what it missed, and come back for the rest when other streams had their turn.

        What comes meanwhile waits for all of it. So does the rest where the session must not publish.
        """
        ends_ns = time.monotonic_ns() + TURN_NS
        for _ in range(BATCH):
            if self.session is None or not self._missed or time.monotonic_ns() >= ends_ns:
                break
            packet, frame = self._missed[0].pop()
            if not self._missed[0]:
                self._missed.popleft()
            self._guard(self._accept, self.session, packet, frame=frame)
        if self._missed:
            self.mailbox.offer_command(self._take_missed, urgent=False)
        else:
            self._resume()

    def _begin(self, restored: Session | None, lineage: Lineage, fence: int | None) -> None:
        context, self._fence = self._context, fence
        self._out.open(fence)
        if restored is None:
            session = Session(
                self.stream,
                context.parameters_of(self.stream),
                context.policy,
                fused=self.fused,
                instance=context.instance,
                life=replace(lineage, run=total(lineage.run, fence or 0)),
                tracker=context.tracker,
            )
            log.info("session_opened", stream=self.stream, profile=session.parameters.name)
        else:
            session = restored
            context.metrics.restored()
            log.info("session_restored", stream=self.stream, session=session.session, frames=session.counters.frames)
        self.session, self._changed = session, False
        self._accounts.open(session)

    def close_session(self, reason: str) -> None:
        """End the session and free what it holds; the next valid message of the stream begins another, or goes on.

        A session that is idle or moved is kept as it is; one that is closed by a query forgets its density and its
        counters. What waits is processed, in a session that is moved by whoever goes on with it.
        """
        session = self.session
        if session is None:
            return
        if reason == "moved":
            self._pass_on(session)
        else:
            self._deliver(session.flush())
        self._out.flush()  # what waited for the write lease is in the state that is kept
        state = session.snapshot()
        if reason == "query":
            session.reset()
            state = forgotten(session.snapshot())
        self._closing = True
        self._drop_session(reason)
        self._context.persistence.put(state, self._fence, lambda: self.tell(StreamActor.on_kept))

    def _pass_on(self, session: Session) -> None:
        """Keep what waits in a session for the instance that goes on with it: clouds of held frames come there."""
        keys, now_ns, wall_ns = self._context.keys, time.monotonic_ns(), time.time_ns()
        for message, ticket in session.unprocessed():
            frame = isinstance(message, schemas.Detections)
            payload, key = schemas.encode(message), (keys.detections if frame else keys.points)(message.stream)
            came = (ticket.wall_ns, ticket.now_ns) if isinstance(ticket, Arrival) else (wall_ns, now_ns)
            packet = Packet(key, payload, len(payload), schemas.encoding_of(message), *came)
            self._context.keep(self.stream, packet, frame)
        self._accounts.pass_on(session.held)

    def on_kept(self) -> None:
        """Leave the stream: the state of the session that has ended is kept."""
        self._closing = False
        self._resume()
        self._context.member.look()

    def keep(self) -> None:
        """Give the state to the checkpoint writer, if it changed."""
        if self.changed and self.session is not None:
            self._changed = False
            self._context.persistence.put(self.session.snapshot(), self._fence)

    def _drop_session(self, reason: str) -> None:
        session = self.session
        if session is None:
            return
        self.session, self._armed_ns = None, None
        self._answered.clear()
        self._asked.clear()
        while self._missed:  # who goes on with the stream reads it in the log
            self._missed.popleft().take()
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

"""Stream: one session's turns on the tracking thread.

A stream opens its session, gives it what waits in the backlog, delivers its outputs, and ends it. All is on the
tracking thread, so nothing is locked. Where several sensors share a session, the stream has the session's name.

A stream is made for any message on a key whose partition this member holds, its session only for a valid message:
garbage costs a stream that is gone when its backlog is empty. Clocks: `now_ns` is monotonic and decides; the wall clock
is only reported.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.trace_context import attachment_of

from optipmb_service.session.checkpoint import CheckpointError, forgotten
from optipmb_service.session.counts import MAX_COUNT, total
from optipmb_service.session.problems import problem_of
from optipmb_service.session.values import MAX_SENSORS, SECOND, Begun, Incarnation, Quarantined, Tracked
from optipmb_service.settings import FARTHEST
from optipmb_service.streams.counters import StreamCounters
from optipmb_service.streams.persistence import save_dump
from optipmb_service.streams.recovery import LogCheck
from optipmb_service.telemetry.stream_meter import StreamMeter
from optipmb_service.zenoh.inputs import Packet

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from opentelemetry.context import Context

    from optipmb_service.session.arrivals import Arrivals
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.counts import MessageCounters
    from optipmb_service.session.fixed_rate import FixedRate
    from optipmb_service.session.session import Session
    from optipmb_service.session.values import Output, Reached
    from optipmb_service.streams.backlog import Backlog
    from optipmb_service.streams.streams import Streams
    from optipmb_service.streams.traces import FrameTrace, Traces
    from optipmb_service.zenoh.transport import StreamPublisher

log = structlog.get_logger("optipmb_service")

BATCH: Final = 8
"""Items that are taken before other streams have their turn."""

TURN_NS: Final = 5_000_000
"""Time after which they have it in any case."""

REST: Final = 9
"""Rest of a sensor after a message beyond the limit, as a multiple of its time: it gets a tenth of the time at most."""

MILLISECOND: Final = 1e6

CLOUD_REFUSED: Final = {"invalid_value", "refused"}
"""Problems by which a session refuses a cloud: not valid, or of one sensor too many."""


class Ticket(NamedTuple):
    """Times of a frame's arrival and decoding, and its trace where traces are recorded; comes back with its tracks."""

    wall_ns: int
    now_ns: int
    decode_ns: int
    trace: FrameTrace | None = None


class Stream:
    """Session of a sensor, or of several.

    Args:
        name: of the session, `site/node/sensor`.
        streams: all streams of the process.
        backlog: its waiting messages.
    """

    def __init__(self, name: str, streams: Streams, backlog: Backlog) -> None:
        self.name = name
        self.backlog = backlog
        self.session: Session | None = None
        self.fused = streams.fusion.is_session(name)
        self.meter = StreamMeter(time.monotonic_ns())
        self.sensors = SensorMeters(name, self.meter, fused=self.fused)
        self.log_check = LogCheck(streams.silent_ns)
        self._is_far = False
        self._streams = streams
        self.policy = streams.sessions.policy(name)
        self.durable: Reached | None = None if streams.checkpoints.durable else (MAX_COUNT, 0, "")
        """How far the newest checkpoint is that a process would go on from; None: there is none."""
        self._member = streams.member
        self._prefix = f"{streams.keys.prefix}/"
        self._step_limit_ns = streams.step_limit_ns
        self._publisher: StreamPublisher | None = None
        self._fixed_rate: FixedRate | None = None
        self._traces: Traces | None = streams.traces
        self._unpublished: list[tuple[bytes, bytes | None, Tracked, int, Context | None]] = []
        """Encoded tracks and events that wait for the write lease, each with the time that its frame waited, ns."""
        self._ids = b""
        """Ids of the newest tracks, as the bytes of int64."""
        self._resting: dict[str, int] = {}
        """Monotonic time until when messages of a sensor are refused that took too long."""
        self._changed = False
        self._incarnation: Incarnation | None = None
        """Incarnation of the earlier session while one is being opened, else None."""
        self._restore_only = False
        self._unread = Incarnation()
        """The highest numbers of sessions whose checkpoints are of another format, or have expired."""
        self._closing = False
        self._asking: list[Callable[[], None]] = []
        self._armed_ns: int | None = None
        self._fence: int | None = None
        backlog.attach(partial(streams.scheduler.submit, self.work))
        self._counts = StreamCounters(backlog)

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
            if backlog.answered and (answered := backlog.take_answered()):
                self._guard(self.on_caches_answered, *answered)
            if self._unpublished:
                self._guard(self._publish)
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
        if create and self.session is None and not self._busy and self._member.holds(self.name):
            self._open()
        if self._busy:
            self._asking.append(partial(self.ask, command, create=create))
        else:
            self._guard(command, self)

    @property
    def occupied(self) -> bool:
        """Whether there is a session, or one begins, or the state of one is not kept yet; for any thread.

        Such a stream has sent a valid message.
        """
        return self.session is not None or self._busy

    @property
    def changed(self) -> bool:
        """Whether the session has a state that was not given to the checkpoint writer; for any thread."""
        return self._changed and self.session is not None

    @property
    def elsewhere(self) -> bool:
        """Whether another instance tracks the stream, and answers for it."""
        return self.session is None and not self._member.holds(self.name)

    @property
    def held_bytes(self) -> int:
        """Bytes of messages that the session keeps; for any thread."""
        session = self.session
        return 0 if session is None else session.held_bytes

    @property
    def _busy(self) -> bool:
        return self._incarnation is not None or self._closing

    @property
    def _paused(self) -> bool:
        """Whether messages wait: the write lease has lapsed, or another instance has the stream."""
        return self.session is not None and not self._member.may_write(self.name, self._fence)

    def _guard(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception as error:
            log.exception("internal_error", stream=self.name)
            self.report("internal", "", "a message handled without an error", f"{type(error).__name__}: {error}")

    def _settle(self) -> None:
        """Process frames whose wait is over, send predicted tracks that are due, and ask for the next turn."""
        for origin, shed in self.backlog.shed_since().items():
            expected, received = f"at most {self._streams.queue_frames} frames waiting", "more; the oldest were dropped"
            self.report("shed", "", expected, f"{shed} {received}", count=shed, stream=self._stream_of(origin))
        session = self.session
        if session is None:
            return
        now_ns, deadline_ns = time.monotonic_ns(), session.deadline_ns
        if deadline_ns is not None and deadline_ns <= now_ns and not self.backlog.clouds_waiting:
            self.deliver(session.on_tick(now_ns))
            deadline_ns = session.deadline_ns
        if self._fixed_rate is not None:
            self._send_predicted(session, self._fixed_rate)
            due = [one for one in (deadline_ns, self._fixed_rate.due_ns) if one is not None]
            deadline_ns = min(due, default=None)
        if deadline_ns == 0:
            self.backlog.wake()  # more is ready: after the other streams
        elif deadline_ns is not None and deadline_ns != self._armed_ns:
            self._armed_ns = deadline_ns
            self._streams.arm(self.backlog.wake, deadline_ns)

    # Messages

    def _receive(self, packet: Packet) -> None:
        """Give a packet to the session, or begin one; who takes too much time is refused for a while."""
        session, stream = self.session, self._stream_of(packet.origin)
        if session is None:
            self._begin(packet)
            return
        self._counts.receive(frame=packet.frame)
        if self._resting and time.monotonic_ns() < self._resting.get(stream, 0):
            self._counts.refuse(session, frame=packet.frame)
            self._report_overload(stream, "a stream that took more just before")
            return
        self._changed = True
        began_ns, processor_ns = time.perf_counter_ns(), time.thread_time_ns()
        try:
            if (message := self._read(packet, session)) is not None:
                self._track(session, packet, message, time.perf_counter_ns() - began_ns)
        finally:
            # It took no more processor time than time, and to read the processor time is a system call.
            if time.perf_counter_ns() - began_ns > self._step_limit_ns:
                self._charge(stream, time.thread_time_ns() - processor_ns)

    def _begin(self, packet: Packet) -> None:
        """Begin a session with a valid packet, if there is room."""
        if not self._member.holds(self.name):
            self.backlog.open(packet)
            self.backlog.leave()
        elif self._read(packet) is not None:
            why = self._streams.admission.room(self.name)
            if why or not self._open(packet):
                self._counts.refuse(None, frame=packet.frame)
            if why:
                self.report("refused", "", why, "another one; there is room for no more sessions")

    def _read(self, packet: Packet, session: Session | None = None) -> schemas.Detections | schemas.Points | None:
        """Return the message of a packet; None after a refusal, which is counted with the session, if any."""
        stream = self._stream_of(packet.origin)
        try:
            return message_of(packet, stream, self._streams.limits)
        except schemas.MessageError as error:
            self._counts.refuse(session, frame=packet.frame)
            what = (schemas.Detections if packet.frame else schemas.Points).__name__
            self.report(error.code, error.path, error.expected, error.received, what=what, stream=stream)
            return None

    def _track(
        self, session: Session, packet: Packet, message: schemas.Detections | schemas.Points, decode_ns: int
    ) -> None:
        now_ns = time.monotonic_ns()
        self.sensors.arrived(packet, message.stream)
        trace = self._traces.received(packet, message) if self._traces else None
        ticket = Ticket(packet.wall_ns, packet.now_ns, decode_ns, trace)
        if isinstance(message, schemas.Points):
            outputs = session.on_points(message, now_ns, ticket=ticket)
            if any(getattr(one, "code", "") in CLOUD_REFUSED for one in outputs):
                self._counts.refuse(session, frame=False)
        else:
            outputs = session.on_detections(message, now_ns, arrived_ns=packet.now_ns, ticket=ticket)
        self.deliver(outputs)

    def _stream_of(self, origin: str) -> str:
        return origin.removeprefix(self._prefix)

    def _charge(self, stream: str, took_ns: int) -> None:
        """Let a sensor rest whose message took too much processor time: the others of the process waited."""
        if took_ns <= self._step_limit_ns:
            return
        now_ns = time.monotonic_ns()
        self._resting = {name: until for name, until in self._resting.items() if until > now_ns}
        self._resting[stream] = now_ns + REST * took_ns
        log.warning("stream_degraded", stream=stream, took_s=took_ns / 1e9, refused_s=REST * took_ns / 1e9)
        self._report_overload(stream, f"{took_ns / 1e9:.3f} s")

    # Outputs

    def deliver(self, outputs: Sequence[Output]) -> None:
        """Publish, log and report outputs of the session."""
        session = self.session
        for output in outputs:
            if isinstance(output, Tracked):
                self._check_place(output)
                self._send(output)
            elif isinstance(output, Begun):
                if session and output.reason in {"first", "parameters"}:
                    self._check_zones(session)
                epoch = session.state().epoch if session else None
                log.info(
                    "session_begun",
                    stream=self.name,
                    session=output.session,
                    epoch=epoch.hex() if epoch else "",
                    reason=output.reason,
                    profile=session.parameters.name if session else "",
                    jump_s=output.jump_ns / 1e9,
                )
            elif isinstance(output, Quarantined):
                file = save_dump(self._streams.folder, self.name, output.dump)
                log.error("session_quarantined", stream=self.name, error=output.error, file=file)
            else:
                self._streams.reporter.report(output, time.monotonic_ns())
        if self._fixed_rate is not None and (wrong := self._fixed_rate.take(outputs, time.monotonic_ns())):
            self.report("clock", "stamp_ns", 'system time, or `clock = "arrival"` in `outputs`', wrong)

    def _open_publisher(self) -> None:
        self._fixed_rate = self._streams.sessions.fixed_rate(self.name)
        kinds = {"events": bool(self.policy.zones), "now": self._fixed_rate is not None}
        try:
            self._publisher = self._streams.open_publisher(self.name, **kinds)
        except TransportError as error:
            log.warning("publisher_failed", stream=self.name, error=str(error))

    def _republish_events(self) -> None:
        """Publish the events of the window in this run, which voids later events of the run before."""
        now = Ticket(time.time_ns(), time.monotonic_ns(), 0)
        for tracked in self.session.again() if self.session and self.policy.zones else ():
            tracked.ticket = now
            self._send(tracked, again=True)

    def _send(self, tracked: Tracked, *, again: bool = False) -> None:
        """Publish tracks and events of a frame, `again` events alone, now or when the write lease holds again."""
        ticket: Ticket = tracked.ticket
        passed_ns = time.monotonic_ns() - ticket.now_ns
        waited_ns = max(0, passed_ns - ticket.decode_ns - tracked.step_ns)
        delivery = self._delivery(tracked, waited_ns)
        events = tracked.encoded_events(delivery, self.durable)
        if not again:
            self._count_tracks(tracked.estimates.id.tobytes())
        span = self._traces.tracked(ticket.trace, tracked) if self._traces and ticket.trace else None
        self._unpublished.append((b"" if again else tracked.encoded(delivery), events, tracked, waited_ns, span))
        self._publish()

    def _delivery(self, tracked: Tracked, waited_ns: int) -> dict[str, Any]:
        return {
            "instance": self._streams.instance,
            "received_ns": tracked.ticket.wall_ns,
            "published_ns": time.time_ns(),
            "queue_ms": waited_ns / MILLISECOND,
            "decode_ms": tracked.ticket.decode_ns / MILLISECOND,
            "step_ms": tracked.step_ns / MILLISECOND,
            "run": tracked.run,
        }

    def _send_predicted(self, session: Session, fixed_rate: FixedRate) -> None:
        """Send the tracks predicted to now, if they are due."""
        due_ns, now_ns = fixed_rate.due_ns, time.monotonic_ns()
        tracked = fixed_rate.due(now_ns, time.time_ns(), session.parameters)
        if tracked is None or due_ns is None or self._publisher is None:
            return
        try:
            self._publisher.publish_now(tracked.encoded(self._delivery(tracked, now_ns - due_ns)))
        except TransportError as error:
            log.warning("publish_failed", stream=self.name, error=str(error))

    def _publish(self) -> None:
        """Publish what waits, if the write lease holds."""
        if not self._unpublished or not self._member.may_write(self.name, self._fence):
            return
        waiting, self._unpublished = self._unpublished, []
        for payload, events, tracked, waited_ns, span in waiting:
            attachment = attachment_of(self._traces.traceparent(span)) if self._traces and span else None
            try:
                if self._publisher is not None:
                    if payload:
                        self._publisher.publish(payload, attachment)
                    if events is not None:
                        self._publisher.publish_events(events)
            except TransportError as error:
                log.warning("publish_failed", stream=self.name, error=str(error))
                continue
            if self._traces and span:
                self._traces.published(span)
            if payload:
                latency_ns = time.monotonic_ns() - tracked.ticket.now_ns
                self.meter.published(latency_ns)
                self._streams.metrics.published(
                    latency_s=latency_ns / SECOND,
                    queue_s=waited_ns / SECOND,
                    decode_s=tracked.ticket.decode_ns / SECOND,
                    step_s=tracked.step_ns / SECOND,
                )

    def _count_tracks(self, ids: bytes) -> None:
        """Count new and ended tracks."""
        if ids != self._ids:
            after, before = (set(memoryview(one).cast("q")) for one in (ids, self._ids))
            self._streams.metrics.tracks(started=len(after - before), ended=len(before - after))
            self._ids = ids

    def report(
        self, code: str, path: str, expected: str, received: str, *, what: str = "", count: int = 1, stream: str = ""
    ) -> None:
        """Report a problem that is not of the session.

        Args:
            code: one of the codes of `Problem`.
            path: field of the message.
            expected: what would have been accepted.
            received: the value received.
            what: its subject; a stream.
            count: number of messages that it concerns.
            stream: the stream it is reported on; by default the session's.
        """
        texts = {"path": path, "expected": expected, "received": received}
        about = {"stream": stream or self.name, "subject": what or "Stream"}
        problem = problem_of(code, instance=self._streams.instance, count=count, **about, **texts)
        self._streams.reporter.report(problem, time.monotonic_ns())

    def _check_zones(self, session: Session) -> None:
        """Report the classes of zones that the profile lacks."""
        for zone in self.policy.zones:
            for label in zone.classes:
                if label not in session.parameters.labels:
                    expected = f"one of {', '.join(session.parameters.labels)} (profile {session.parameters.name})"
                    self.report("unknown_class", f"zones.{zone.name}.classes", expected, repr(label))

    def _check_place(self, tracked: Tracked) -> None:
        """Report, once, tracks that are far from the place of the site: as of coordinates of a grid, such as UTM."""
        if self._is_far or not self.policy.has_place:
            return
        far = abs(tracked.estimates.center[:, :2]).max(axis=1, initial=0.0) > FARTHEST
        if far.any():
            self._is_far = True
            expected = f"within {FARTHEST / 1e3:g} km of the origin of its site in `sites`"
            x, y = tracked.estimates.center[far][0, :2]
            self.report("far", "center", expected, f"{x:.0f}, {y:.0f} m")

    def _report_overload(self, stream: str, received: str) -> None:
        expected = f"at most {self._step_limit_ns / 1e9:g} s of processor time for a message"
        self.report("overload", "", expected, received, stream=stream)

    # Recovery

    def on_caches_answered(self, *streams: str) -> None:
        """Go on behind gaps: all that the caches of these streams held has come. Of several sensors all must have."""
        if self.session is not None:
            self.session.arrivals.answer(*streams)
        self.ask(Stream._end_recovery, create=False)

    def _end_recovery(self) -> None:
        session = self.session
        if session is None or not session.arrivals.waiting:
            return
        now_ns, arrivals = time.monotonic_ns(), session.arrivals
        if self.fused:
            streams, fusion = self._streams, self._streams.fusion
            caches = streams.directory.awaited(
                fusion.feeds(self.name), lambda one: fusion.session_of(one) == self.name, session.sensors, now_ns
            )
            for stream in arrivals.to_ask(caches):
                with contextlib.suppress(TransportError):  # the end
                    streams.ask_cache(stream, partial(self._take_cached, arrivals, stream))
            if not arrivals.complete(caches, now_ns):
                return
        self._changed = True
        self.deliver(session.recovered(now_ns))

    def _take_cached(self, arrivals: Arrivals, stream: str, packets: list[Packet], complete: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Take what a cache held; one that has not answered is asked again. Called on any thread."""
        self.backlog.recover(packets)
        then = partial(self.on_caches_answered if complete else arrivals.ask_again, stream)
        self.backlog.command(then, urgent=False)

    def look_in_log(self) -> None:
        """Recover what the log has of the session's sensors after their newest frames."""
        if self.session is None or self._streams.log is None:
            self.log_check.end(found=False)
            return

        def take(packets: list[Packet]) -> None:
            self.backlog.recover(packets)
            self.log_check.end(found=bool(packets))

        self._streams.log.look(self.session.snapshot(), take)

    # Opening

    def take_up(self) -> None:
        """Go on with a session that has come here. One that is kept, and was not closed, goes on at once.

        Else the first valid packet begins one.
        """
        if not self._member.holds(self.name):
            return
        if self._busy:
            self.backlog.open()
        elif self.session is not None or self._streams.admission.room(self.name) or not self._open(restore_only=True):
            self.backlog.go_live()

    def _open(self, first: Packet | None = None, *, restore_only: bool = False) -> bool:
        """Begin to open a session, while packets wait; False when there is no room.

        Args:
            first: a packet that was taken already.
            restore_only: whether a session begins only if one was kept, and not closed.
        """
        self._incarnation = self._streams.admit(self.name)
        if self._incarnation is None:
            return False
        self._restore_only = restore_only
        self.backlog.open(first)
        self._load()
        return True

    def _load(self) -> None:
        """Have the session restored, then missed frames read from the log, then `_on_loaded` called."""
        fence = self._member.fence(self.name)
        self._streams.checkpoints.recall(
            self.name, partial(self._restore, fence), partial(self._fetch, fence), self._note_unread
        )

    def _restore(self, fence: int | None, checkpoint: Checkpoint) -> tuple[Session, Checkpoint]:
        """Return the session of a checkpoint; on the thread of the store."""
        now_ns = time.monotonic_ns()
        if self._unread != Incarnation():
            raise CheckpointError("older than one of another format, whose ids would be given out again")
        if checkpoint.fused is not self.fused:
            raise CheckpointError(f"of {'several streams' if checkpoint.fused else 'one stream'}, by `fuse` then")
        return self._streams.sessions.restored(checkpoint, self.policy, now_ns, fence or 1), checkpoint

    def _note_unread(self, incarnation: Incarnation) -> None:
        self._unread = self._unread.after(incarnation)

    def _fetch(self, fence: int | None, found: tuple[Session, Checkpoint] | None) -> None:
        """Read the frames after a checkpoint from the log, if there is one; on the thread of the store."""
        restored, checkpoint = found or (None, None)

        def loaded(packets: list[Packet]) -> None:
            self.backlog.recover(packets)
            self.backlog.command(partial(self._on_loaded, restored, fence), urgent=True)

        if self._streams.log is None:
            loaded([])
        else:
            self._streams.log.fetch(self.name, checkpoint, loaded, self.backlog.recover)

    def _on_loaded(self, restored: Session | None, fence: int | None) -> None:
        """Begin a session, or go on with the one that was kept, unless the stream was lost."""
        incarnation, holds = self._incarnation, self._member.holds(self.name)
        if incarnation is None:
            return
        if holds and fence != self._member.fence(self.name):
            # Lost and taken again: another instance may have gone on since it was loaded.
            self.backlog.forget_missed()
            self._load()
            return
        closed = restored is None or not restored.counters.frames
        if holds and not (closed and self._restore_only):
            self._fence = fence
            self._open_publisher()
            session = self._restored(restored) if restored else self._new(incarnation, fence)
            self._counts.open(session)
            self._changed, self.session = False, session
            if restored:
                self.durable = self.durable or session.final
                self._check_zones(session)
                self._guard(self._republish_events)
        else:
            self._streams.admission.release(self.name, incarnation)
            self._member.look()
        self._incarnation, self._restore_only = None, False
        self._proceed()

    def _restored(self, session: Session) -> Session:
        self._streams.metrics.restored()
        frames = session.counters.frames
        log.info("session_restored", stream=self.name, session=session.session, frames=frames)
        if configured := self._streams.sessions.differing_profile(session):
            in_force = session.parameters.name
            log.warning("profile_differs", stream=self.name, profile=in_force, configured=configured)
        return session

    def _new(self, incarnation: Incarnation, fence: int | None) -> Session:
        numbers = incarnation.after(self._unread)
        numbers = replace(numbers, run=total(numbers.run, fence or 0))
        session = self._streams.sessions.new(self.name, self.policy, numbers)
        log.info("session_opened", stream=self.name, profile=session.parameters.name)
        return session

    def _proceed(self) -> None:
        """Go on with messages that came while a session was about to begin or end."""
        if self.backlog.state == "opening":
            if self._member.holds(self.name):
                self.backlog.go_live()
            else:
                self.backlog.leave()
        asking, self._asking = self._asking, []
        for one in asking:
            one()

    # Leaving

    def on_lost(self) -> None:
        """Leave the stream: another instance has it, and the newest state."""
        if not self._member.holds(self.name):
            self.backlog.leave()
        if self._fence == self._member.fence(self.name):
            return  # lost and taken again before this was called
        self._streams.checkpoints.forget(self.name)
        if self.session is not None:
            self.report("superseded", "", "an instance that is neither frozen nor cut off", "another one goes on")
        self._drop_session("superseded")

    def on_renewed(self) -> None:
        """Go on under another fence: the store has lost the lease, and all checkpoints with it."""
        self._fence = self._member.fence(self.name)
        self._changed = True

    def on_recalled(self) -> None:
        """Another instance is to have the stream: leave it as soon as its state is kept.

        Without a router it is left as by a process that is killed: the newest tracks may not have left this process, so
        the other one is to track their frames again.
        """
        if self._member.unlinked:
            self._streams.checkpoints.forget(self.name)
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
            self._hand_over(session)
        else:
            self.deliver(session.flush())
        self._publish()  # what waited for the write lease is in the state that is kept
        state = session.snapshot()
        if reason == "query":
            session.reset()
            state = forgotten(session.snapshot())
        self._closing = True
        if self.backlog.state == "live":
            self.backlog.open()
        self._drop_session(reason)
        self._streams.checkpoints.put(state, self._fence, lambda: self.tell(Stream.on_kept))

    def on_kept(self) -> None:
        """Leave the stream: the state of the session that has ended is kept."""
        self._closing = False
        self._proceed()
        self._member.look()

    def _hand_over(self, session: Session) -> None:
        """Hold the pending messages of a session for the instance that goes on with it."""
        keys, now_ns, wall_ns = self._streams.keys, time.monotonic_ns(), time.time_ns()
        self._counts.hand_over(session.held)
        for message, ticket in session.unprocessed():
            key = (keys.detections if isinstance(message, schemas.Detections) else keys.points)(message.stream)
            payload = schemas.encode(message)
            came, parent = (wall_ns, now_ns), ""
            if isinstance(ticket, Ticket):
                came = ticket.wall_ns, ticket.now_ns
                if self._traces and ticket.trace:
                    parent = self._traces.traceparent(ticket.trace.context)
            self.backlog.push(Packet(key, payload, len(payload), schemas.encoding_of(message), *came, parent))

    def keep(self) -> None:
        """Give the state to the checkpoint writer, if it changed."""
        if self.changed:
            self._guard(self._keep)

    def _keep(self) -> None:
        if self.session is not None:
            self._changed = False
            self._streams.checkpoints.put(self.session.snapshot(), self._fence)

    def flush(self) -> None:
        """Process pending frames without waiting any longer."""
        if self.session is not None:
            self.deliver(self.session.flush())

    def _drop_session(self, reason: str) -> None:
        if (session := self.session) is None:
            return
        self.session, self._armed_ns, self._fixed_rate = None, None, None
        self._unpublished.clear()  # another owner publishes it
        self._count_tracks(b"")
        if self._publisher is not None:
            self._publisher.release()
            self._publisher = None
        self._counts.close()
        self._streams.admission.release(self.name, session.incarnation)
        log.info(
            "session_closed", stream=self.name, session=session.session, reason=reason, frames=session.counters.frames
        )

    # State, for any thread

    def state(self) -> schemas.SessionState | None:
        """Return the state of the session without its digest, None without a session."""
        session = self.session
        return None if session is None else self._counts.state(session)

    def totals(self) -> MessageCounters:
        return self._counts.totals()

    def summary(self, now_ns: int) -> schemas.SessionSummary | None:
        """Return the line of the service's status."""
        session = self.session
        if session is None:
            return None
        degraded = any(now_ns < until for until in tuple(self._resting.values()))
        summary = self.sensors.summary(self._counts.state(session), now_ns, degraded=degraded)
        more = {"configured": self._streams.sessions.differing_profile(session), "learned": session.learned}
        return summary.model_copy(update=more)


def message_of(packet: Packet, stream: str, limits: schemas.Limits) -> schemas.Detections | schemas.Points:
    """Return the message of a packet.

    Raises:
        MessageError: it is none, or not one of this stream.
    """
    if packet.payload is None:
        raise schemas.MessageError("too_large", "", f"at most {limits.max_bytes} bytes", f"{packet.size} bytes")
    kind: type[schemas.Detections | schemas.Points] = schemas.Detections if packet.frame else schemas.Points
    message = schemas.decode(packet.payload, kind, encoding=packet.encoding, limits=limits)
    if message.stream != stream:
        raise schemas.MessageError("invalid_value", "stream", repr(stream), repr(message.stream))
    return message


class SensorMeters:
    """Sensors of one session: when each sent last, and which fell silent.

    Written by the tracking thread; the control loop looks for silent ones.

    Args:
        session: its name.
        meter: the figures of the session.
        fused: whether several sensors feed it, which are known when they send.
    """

    def __init__(self, session: str, meter: StreamMeter, *, fused: bool) -> None:
        self._fused = fused
        self._meter = meter
        self._meters: dict[str, StreamMeter] = {} if fused else {session: meter}
        self._stale: set[str] = set()

    def arrived(self, packet: Packet, stream: str) -> None:
        """Note a valid message of a sensor."""
        frame = packet.frame
        self._meter.arrived(packet.now_ns, frame=frame)
        if self._fused:
            if stream not in self._meters and len(self._meters) >= MAX_SENSORS:
                self._forget_stale()
            if stream in self._meters or len(self._meters) < MAX_SENSORS:
                self._meters.setdefault(stream, StreamMeter(packet.now_ns)).arrived(packet.now_ns, frame=frame)
        if stream in self._stale and frame:
            self._stale.discard(stream)
            log.info("stream_back", stream=stream)

    def look_for_silent(self, now_ns: int, stale_s: float) -> None:
        """Log the sensors that have sent no frame for longer than `stale_s`, each once."""
        for stream, meter in tuple(self._meters.items()):
            age_s = meter.age_s(now_ns)
            if age_s is not None and age_s > stale_s and stream not in self._stale:
                self._stale.add(stream)
                log.warning("stream_stale", stream=stream, age_s=round(age_s, 3))

    def silent_ns(self, now_ns: int) -> int:
        """Return the time since the last message of the sensor that is silent for longest; for any thread."""
        return now_ns - min((meter.active_ns for meter in tuple(self._meters.values())), default=self._meter.active_ns)

    def summary(self, state: schemas.SessionState, now_ns: int, *, degraded: bool) -> schemas.SessionSummary:
        """Return the line of the service's status; for any thread."""
        stale, sensors = frozenset(self._stale), sorted(self._meters)
        is_stale = bool(sensors) and stale >= set(sensors)
        summary = self._meter.summary(state, now_ns, stale=is_stale, degraded=degraded)
        if not self._fused:
            return summary
        return summary.model_copy(update={"sensors": tuple(sensors), "silent": tuple(sorted(stale))})

    def _forget_stale(self) -> None:
        oldest = min(self._meters, key=lambda name: self._meters[name].active_ns)
        if oldest in self._stale:
            self._stale.discard(oldest)
            self._meters = {name: one for name, one in self._meters.items() if name != oldest}

"""A session's turns on the tracking thread: it is taken up, left and kept there, and given what waits for it.

All is on that one thread, so nothing is locked. Where several streams share a session, the actor has its name.

An actor is made for whatever arrives on the key of a stream whose partition this instance holds, its session only for a
valid message: garbage costs an actor that is gone when its mailbox is empty. Clocks: `now_ns` monotonic for all
decisions, the wall clock only for what delivery reports.

The parts: `stream_tracking` takes a message through the session, under `step_limit`; `stream_outputs` has what comes
of it; `stream_sensors` knows who feeds the session. `session_opening` restores a session or makes one, `missed_queue`
has what it missed, `awaited_caches` which caches it waits for.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import structlog

from optipmb_service.runtime.awaited_caches import AwaitedCaches
from optipmb_service.runtime.mailbox import Mailbox
from optipmb_service.runtime.missed_frames import LogCheck
from optipmb_service.runtime.missed_queue import MissedQueue
from optipmb_service.runtime.ports import Packet
from optipmb_service.runtime.session_opening import SessionOpening
from optipmb_service.runtime.stream_counters import StreamCounters
from optipmb_service.runtime.stream_outputs import StreamOutputs
from optipmb_service.runtime.stream_sensors import StreamSensors
from optipmb_service.runtime.stream_tracking import StreamTracking
from optipmb_service.session.checkpoint import forgotten
from optipmb_service.telemetry.stream_meter import StreamMeter

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
    from optipmb_service.session.session import Session
    from optipmb_service.session.values import MessageCounters, Output

log = structlog.get_logger("optipmb_service")

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
        self.sensors = StreamSensors(stream, self.meter, fused=self.fused)
        """The streams that feed it."""
        self._context = context
        self._accounts = StreamCounters(self.mailbox)
        self._out = StreamOutputs(stream, context, self.meter)
        self._tracking = StreamTracking(context, self._accounts, self.sensors, self._out)
        self._opening = SessionOpening(stream, context, fused=self.fused)
        self._missed = MissedQueue(stream, context.buffer)
        self._caches = AwaitedCaches(stream, context.caches)
        self.log_check = LogCheck(context.silent_ns)
        """When the log is read for frames that do not arrive."""
        self._waiting = context.buffer()
        self._asking: list[tuple[Callable[[StreamActor], None], bool]] = []
        self._armed_ns: int | None = None
        self._closing = False
        self._fence: int | None = None

    def wake(self) -> None:
        """Schedule the actor though nothing came: frames have waited long enough."""
        if self.mailbox.ring():
            self._context.submit(self)

    def tell(self, command: Callable[[StreamActor], None]) -> None:
        """Run a command before all that waits."""
        if self.mailbox.offer_command(lambda: command(self), urgent=True):
            self._context.submit(self)

    # A turn

    def work(self) -> bool:
        """Take some of what waits; True: come again."""
        ends_ns = time.monotonic_ns() + TURN_NS
        for _ in range(BATCH):
            taken = self.mailbox.take(urgent=self._paused)
            if taken is None:
                break
            kind, item = taken
            if isinstance(item, Packet):
                self._guard(self._receive, item, frame=kind == "frame")
            else:
                self._guard(item)
            if self.mailbox.empty or time.monotonic_ns() >= ends_ns:
                break
        paused = self._paused  # asked after `take`: a call of `ring` before that may mean that the pause has ended
        if not paused:
            if self._out.tracks.waiting:
                self._guard(self._out.tracks.flush)
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
        return self.session is not None or self._opening.incarnation is not None or self._closing

    @property
    def changed(self) -> bool:
        """Whether the session has a state that was not given to the checkpoint writer; may be called by any thread."""
        return self._tracking.changed and self.session is not None

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
        """Do a piece of work; whatever it raises, the stream and the thread go on."""
        try:
            work(*arguments, **named)
        except Exception as error:
            log.exception("internal_error", stream=self.stream)
            self._out.report("internal", "", "a message handled without an error", f"{type(error).__name__}: {error}")

    def _settle(self) -> None:
        """Let go what has waited long enough, and ask for a turn for what has not."""
        if self._accounts.shed():
            self._tracking.report_shed(self.mailbox)
        session = self.session
        if session is None or (deadline_ns := session.deadline_ns) is None:
            return
        now_ns = time.monotonic_ns()
        if deadline_ns <= now_ns and not self.mailbox.clouds_waiting:
            self._out.deliver(session.on_tick(now_ns), session)
            deadline_ns = session.deadline_ns
        if deadline_ns == 0:
            self.mailbox.ring()  # more is ready: after the other streams
        elif deadline_ns is not None and deadline_ns != self._armed_ns:
            self._armed_ns = deadline_ns
            self._context.arm(self, deadline_ns)

    def _receive(self, packet: Packet, *, frame: bool) -> None:
        if self.session is None or self._missed.buffers:
            self._buffer(packet, frame=frame)
        else:
            self._tracking.accept(self.session, packet, frame=frame)

    # Who tracks the stream; to be called by the tracking thread alone

    def take_up(self, packets: Sequence[tuple[Packet, bool]], answered: Collection[str] = ()) -> None:
        """Go on with a stream that has come here, and with what it sent before, each packet with whether it is a frame.

        A session that is kept, and was not closed, goes on at once; else the first valid packet begins one. `answered`:
        streams of which all that the publisher's cache holds is among them.
        """
        if not self.occupied and self._context.member.holds(self.stream) and not self._context.room(self.stream):
            self._open(restore_only=True)
        self._receive_all(packets)
        if answered:
            self.on_caches_answered(*answered)

    def on_caches_answered(self, *streams: str) -> None:
        """Go on behind gaps: all that the caches of these streams held has come. Of several sensors all must have."""
        self._caches.answered(*streams)
        self.ask(StreamActor._recovered, create=False)

    def _recovered(self) -> None:
        session = self.session
        if session is None or not session.awaits_caches:
            return
        if not (self.fused and self._caches.awaited(session, self._take_cached)):
            self._tracking.recovered(session)

    def _take_cached(self, stream: str, packets: list[tuple[Packet, bool]], complete: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Take what a cache held; one that has not answered is asked again. Called on any thread."""

        def take(cached: TakeoverBuffer) -> None:
            self._catch_up(cached)
            if complete:
                self.on_caches_answered(stream)
            else:
                self._caches.ask_again(stream)

        self._hand_over(packets, take)

    def _receive_all(self, packets: Sequence[tuple[Packet, bool]]) -> None:
        for packet, frame in packets:
            self._guard(self._receive, packet, frame=frame)

    def _buffer(self, packet: Packet, *, frame: bool) -> None:
        """Keep a packet until a session takes it, and begin one if the packet is valid and the stream is to be here."""
        if not (self._opening.incarnation or self._closing or self._missed.buffers):
            if not self._context.member.holds(self.stream):
                self._context.keep(self.stream, packet, frame=frame)
                return
            if self._tracking.read(packet, None, frame=frame) is None:
                return
            if why := self._context.room(self.stream):
                self._accounts.refuse(None, frame=frame)
                self._out.report("refused", "", why, "another one; there is room for no more sessions")
                return
            if not self._open():
                self._accounts.refuse(None, frame=frame)
                return
        if dropped := self._accounts.drop(self._waiting.add(packet, frame=frame, own=True)):
            self._out.report("shed", "", "room for what waits", f"{dropped} more; dropped", count=dropped)

    def ask(self, command: Callable[[StreamActor], None], *, create: bool) -> None:
        """Call `command`, as soon as no session is about to begin or end, or has to take what it missed.

        With `create`, one begins if there is none.
        """
        if create and self.session is None and not self._closing and self._context.member.holds(self.stream):
            _ = self._opening.incarnation or self._open()
        if self._opening.incarnation or self._closing or self._missed.buffers:
            self._asking.append((command, create))
        else:
            self._guard(command, self)

    def _resume(self) -> None:
        """Go on with what came while a session was about to begin or end."""
        self._receive_all(self._waiting.take())
        asking, self._asking = self._asking, []
        for command, create in asking:
            self.ask(command, create=create)

    def on_lost(self) -> None:
        """Another instance has the stream: what is here is no longer the newest state."""
        if self._fence == self._context.member.fence(self.stream):
            return  # lost and taken again before this was called
        self._context.persistence.forget(self.stream)
        if self.session is not None:
            self._out.report("superseded", "", "an instance that is neither frozen nor cut off", "another one goes on")
        self._drop_session("superseded")

    def on_renewed(self) -> None:
        """Go on under another fence: the store has lost the lease, and all checkpoints with it."""
        self._fence = self._context.member.fence(self.stream)
        self._out.tracks.renew(self._fence)
        self._tracking.changed = True

    def on_recalled(self) -> None:
        """Another instance is to have the stream: leave it as soon as its state is kept.

        Without a router it is left as by a process that is killed: the newest tracks may not have left this process, so
        the other one is to track their frames again.
        """
        if self._context.member.unlinked:
            self._context.persistence.forget(self.stream)
            self._drop_session("unlinked")
            self._context.member.look()
        else:
            self.close_session("moved")

    # Sessions; to be called by the tracking thread alone

    def _open(self, *, restore_only: bool = False) -> bool:
        """Begin to open a session, while packets wait; False when there is no room."""
        if has_room := self._opening.start(restore_only=restore_only):
            self._load()
        return has_room

    def _load(self) -> None:
        self._opening.load(
            lambda restored, fence, packets: self._hand_over(packets, partial(self._on_loaded, restored, fence)),
            lambda packets: self._hand_over(packets, self._catch_up),
        )

    def _hand_over(self, packets: Sequence[tuple[Packet, bool]], command: Callable[[TakeoverBuffer], None]) -> None:
        """Post a command with packets to the mailbox, within the bytes that may wait; called on any thread."""
        missed = self._missed.bounded(packets)
        must_schedule = self.mailbox.offer_command(lambda: command(missed), urgent=True)
        if must_schedule:
            self._context.submit(self)
        elif must_schedule is None:  # the actor has ended
            missed.take()

    def _on_loaded(self, restored: Session | None, fence: int | None, missed: TakeoverBuffer) -> None:
        """Begin a session, or go on with the one that was kept and what it missed; unless the stream was lost."""
        incarnation = self._opening.incarnation
        if incarnation is None:
            missed.take()
            return
        if self._opening.is_outdated(fence):
            missed.take()
            self._load()
            return
        if self._opening.is_wanted(restored):
            self._fence = fence
            self._out.tracks.open(fence)
            session = self._opening.begin(restored, incarnation, fence)
            self._accounts.open(session)
            self._tracking.changed, self.session = False, session
        else:
            self._opening.release()
        self._opening.end()
        self._catch_up(missed)

    def _catch_up(self, missed: TakeoverBuffer) -> None:
        """Have the session take what it missed before all that waits; without a session it waits, too."""
        if self.session is None:
            self._receive_all(missed.take())
        elif missed:
            self._missed.buffers.append(missed)
        self._take_missed()

    def _take_missed(self) -> None:
        """Give the session some of what it missed, and come back for the rest when other streams had their turn.

        What comes meanwhile waits for all of it. So does the rest where the session must not publish.
        """
        self._missed.take(partial(self._guard, self._tracking.accept, self.session), most=BATCH, turn_ns=TURN_NS)
        if self._missed.buffers:
            self.mailbox.offer_command(self._take_missed, urgent=False)
        else:
            self._resume()

    def look_in_log(self) -> None:
        """Have the session take what the log has of its streams after their newest frames."""
        session = self.session
        if session is None or self._missed.buffers:
            self.log_check.end(found=False)
            return

        def take(packets: list[tuple[Packet, bool]]) -> None:
            if packets:
                self._hand_over(packets, self._catch_up)
            self.log_check.end(found=bool(packets))

        self._context.missed.look(session.snapshot(), take)

    def close_session(self, reason: str) -> None:
        """End the session and free what it holds; the next valid message of the stream begins another, or goes on.

        A session that is idle or moved is kept as it is; one that is closed by a query forgets its density and its
        counters. What waits is processed, in a session that is moved by whoever goes on with it.
        """
        session = self.session
        if session is None:
            return
        if reason == "moved":
            self._opening.pass_on(session)
            self._accounts.pass_on(session.held)
        else:
            self.deliver(session.flush())
        self._out.tracks.flush()  # what waited for the write lease is in the state that is kept
        state = session.snapshot()
        if reason == "query":
            session.reset()
            state = forgotten(session.snapshot())
        self._closing = True
        self._drop_session(reason)
        self._context.persistence.put(state, self._fence, lambda: self.tell(StreamActor.on_kept))

    def on_kept(self) -> None:
        """Leave the stream: the state of the session that has ended is kept."""
        self._closing = False
        self._resume()
        self._context.member.look()

    def keep(self) -> None:
        """Give the state to the checkpoint writer, if it changed."""
        if self.changed:
            self._guard(self._keep)

    def _keep(self) -> None:
        if self.session is not None:
            self._tracking.changed = False
            self._context.persistence.put(self.session.snapshot(), self._fence)

    def _drop_session(self, reason: str) -> None:
        if (session := self.session) is None:
            return
        self.session, self._armed_ns = None, None
        self._caches.forget()
        self._missed.drop()
        self._out.tracks.close()
        self._accounts.close()
        self._context.release(self.stream, session.incarnation)
        log.info(
            "session_closed", stream=self.stream, session=session.session, reason=reason, frames=session.counters.frames
        )

    def deliver(self, outputs: Sequence[Output]) -> None:
        """Publish what the session brought."""
        self._out.deliver(outputs, self.session)

    def state(self) -> schemas.SessionState | None:
        """Return the state of the session without its digest, None without a session."""
        return None if self.session is None else self._accounts.state(self.session)

    def totals(self) -> MessageCounters:
        """Return what became of messages since the actor is there; may be called by any thread."""
        return self._accounts.totals()

    def summary(self, now_ns: int) -> schemas.SessionSummary | None:
        """Return the line of the service's status; may be called by any thread."""
        session = self.session
        if session is None:
            return None
        degraded = self._tracking.limit.is_exceeded(now_ns)
        summary = self.sensors.summary(self._accounts.state(session), now_ns, degraded=degraded)
        configured = self._opening.configured(session)
        return summary if configured is None else summary.model_copy(update={"configured": configured})

"""All streams of the service: finds the actor of a message, makes and frees actors, and sees to those that fell silent.

Called by the readers, the workers, the query thread and the control loop; one lock guards the tables, and nothing slow
is done under it.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

import optipmb
from optipmb_service.cluster.leases import Change, partition_of
from optipmb_service.runtime import dumps
from optipmb_service.runtime.admission import Admission
from optipmb_service.runtime.byte_budget import MEGABYTE, ByteBudget
from optipmb_service.runtime.context import Actor, ActorContext, part_of, policy_of
from optipmb_service.runtime.fusion import FUSED, Fusion
from optipmb_service.runtime.mailbox import Mailbox
from optipmb_service.runtime.rivals import Rivals
from optipmb_service.runtime.stream_actor import StreamActor
from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
from optipmb_service.runtime.untracked import UntrackedMessages
from optipmb_service.session.problems import problem_of
from optipmb_service.session.values import SECOND, MessageCounters

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.cluster.member import Member
    from optipmb_service.observability.metrics import Metrics
    from optipmb_service.observability.problem_reporter import ProblemReporter
    from optipmb_service.runtime.missed_frames import MissedFrames
    from optipmb_service.runtime.persistence import Persistence
    from optipmb_service.runtime.ports import Caches, MessageSink, Packet
    from optipmb_service.runtime.profiles import Profiles
    from optipmb_service.runtime.scheduler import Scheduler
    from optipmb_service.session.values import Lineage
    from optipmb_service.settings import Settings

log = structlog.get_logger("optipmb_service")

MAX_UNPROVEN: Final = 256
"""Actors at once of streams that have not sent a valid message yet."""

MAX_UNPROVEN_STRAINED: Final = 16
"""The same while the lease is renewed late: each of them delays that."""

RIVAL_LEASES: Final = 3
"""Leases for which the token of an instance may stay whose stream has been taken over."""

SWEEP_REST: Final = 200
"""How many times as long as a look at all sessions took of the processor it rests before the next one."""

MOST_REST_NS: Final = 5 * SECOND

MAX_KEYS: Final = 8192
"""Keys whose stream is remembered."""


class Registry:
    """The streams of one service.

    Args:
        settings: what is in force.
        profiles: the parameters that can be had.
        outlet: where results go.
        problem reporter: where problems go.
        scheduler: the workers.
        member: says which streams this instance tracks.
        checkpoint writer: where checkpoints go and come from.
        missed: what is known of the frames that a session has missed.
        arm: has `StreamActor.wake` called at a monotonic time (ns).
        metrics: counts what comes and goes.
        tracker: makes the trackers of sessions.
    """

    def __init__(  # noqa: PLR0913 - the parts that it brings together
        self,
        settings: Settings,
        profiles: Profiles,
        *,
        sink: MessageSink,
        reporter: ProblemReporter,
        scheduler: Scheduler,
        member: Member,
        persistence: Persistence,
        missed: MissedFrames,
        arm: Callable[[Actor, int], None],
        metrics: Metrics,
        tracker: Callable[[optipmb.Parameters], Any] = optipmb.Tracker,
    ) -> None:
        self._member = member
        self.profiles = profiles
        self.instance = settings.instance
        self.keys = schemas.Keys(settings.prefix)
        self.fusion = Fusion(settings.fuse)
        self.limits = settings.limits.limits()
        self.cloud_wait_s = settings.cloud_wait_s
        self._settings = settings
        self._reporter = reporter
        self._scheduler = scheduler
        self._lock = threading.Lock()
        self._actors: dict[str, StreamActor] = {}
        self._unproven: set[StreamActor] = set()
        self._streams: dict[str, tuple[str, str]] = {}
        self._past = MessageCounters()
        self._metrics = metrics
        self._sweep_ns = 0
        self._admission = Admission(settings, self._used, self._evict_for_another)
        self._rivals = Rivals(round(RIVAL_LEASES * settings.lease_s * SECOND))
        standby = ByteBudget(settings.standby_mb * MEGABYTE)

        def buffer() -> TakeoverBuffer:
            return TakeoverBuffer(round(settings.standby_s * SECOND), standby)

        self.untracked = UntrackedMessages(member.holds, buffer, self._lose)
        self.caches: Caches
        """What publishers keep; set before anything is received."""
        self._mailboxes = ByteBudget(settings.memory_mb * MEGABYTE // 2)
        self._context = ActorContext(
            instance=settings.instance,
            keys=self.keys,
            fused=self.fusion.is_session,
            limits=self.limits,
            policy=policy_of(settings),
            queue_frames=settings.queue_frames,
            queue_clouds=settings.queue_clouds,
            mailbox_bytes=part_of(settings),
            mailboxes=self._mailboxes,
            step_limit_ns=round(settings.step_limit_s * SECOND),
            sink=sink,
            reporter=reporter,
            parameters_of=profiles.of,
            member=member,
            persistence=persistence,
            missed=missed,
            dump=lambda stream, dump: dumps.save(settings.folder, stream, dump),
            buffer=buffer,
            keep=self._keep,
            caches=lambda: self.caches,
            room=self._admission.room,
            admit=self._admit,
            release=self._admission.release,
            discard=self._discard,
            submit=scheduler.submit,
            arm=arm,
            metrics=metrics,
            tracker=tracker,
        )

    # Messages, from the readers

    def frame(self, packet: Packet) -> None:
        """Hand detections to their stream; never waits."""
        self._receive(packet, frame=True)

    def cloud(self, packet: Packet) -> None:
        """Hand a point cloud to its stream; never waits."""
        self._receive(packet, frame=False)

    def _receive(self, packet: Packet, *, frame: bool) -> None:
        try:
            stream, session = self.parsed(packet.key)
        except schemas.MessageError as error:
            # Whoever receives it receives the detections of all: it is one of all members.
            self._count_refused()
            self._report("invalid_value", "", error.expected, error.received)
            return
        own = self._member.holds(session)
        if not own and self.untracked.keep(session, packet, frame=frame):
            self._metrics.foreign("detections" if frame else "points", packet.size)
        else:
            self._metrics.received("detections" if frame else "points", packet.size)
            if not self._over_quota(stream, packet, frame=frame):
                self._keep(session, packet, frame)

    def caches_answered(self, key: str) -> None:
        """Tell a session that all has come which the cache of its publisher held."""
        try:
            stream, session = self.parsed(key)
        except schemas.MessageError:
            return
        if self.untracked.cache_answered(session, stream):
            return
        with self._lock:
            actor = self._actors.get(session)
        if actor is not None and actor.mailbox.offer_command(lambda: actor.on_caches_answered(stream), urgent=False):
            self._scheduler.submit(actor)

    def _hand(self, stream: str, packet: Packet, *, frame: bool) -> None:
        offered = Mailbox.offer_frame if frame else Mailbox.offer_cloud
        if not self._offer(stream, lambda actor: offered(actor.mailbox, packet)):
            self.untracked.put_off(stream, packet, frame=frame)

    def _keep(self, stream: str, packet: Packet, frame: bool) -> None:  # noqa: FBT001 - as a field of the context
        """Keep a packet that was received to be tracked here until its stream is, here or by who asks for it."""
        if not self.untracked.keep(stream, packet, frame=frame, own=True):
            self._hand(stream, packet, frame=frame)

    def command(self, stream: str, command: Callable[[StreamActor], None], *, urgent: bool) -> bool:
        """Have a worker run a command for a stream; False when the service takes no more streams."""
        if self._offer(stream, lambda actor: actor.mailbox.offer_command(lambda: command(actor), urgent=urgent)):
            return True
        self._refuse(stream)
        return False

    # What is there

    def actors(self) -> list[StreamActor]:
        """Return the actors that have a session, by stream name."""
        with self._lock:
            actors = sorted(self._actors.items())
        return [actor for _, actor in actors if actor.session is not None]

    def _tracking(self) -> list[StreamActor]:
        """Return the actors that have a session, in any order."""
        with self._lock:
            actors = list(self._actors.values())
        return [actor for actor in actors if actor.session is not None]

    def actor(self, stream: str) -> StreamActor | None:
        """Return the actor of a stream that has a session."""
        with self._lock:
            actor = self._actors.get(stream)
        return actor if actor is not None and actor.session is not None else None

    def totals(self) -> MessageCounters:
        """Return what became of all messages since the start."""
        with self._lock:
            totals, actors = self._past, list(self._actors.values())
        for actor in actors:
            totals += actor.totals()
        return totals

    # Streams that come here, or have left

    def passed_by(self, key: str, size: int) -> None:
        """Count detections that were discovered and are of no use here, unless they come by a subscription as well."""
        if not self._member.holds(self.parsed(key)[1]):
            self._metrics.foreign("detections", size)

    def waits(self, session: str) -> bool:
        """Whether messages of a session wait for a worker."""
        with self._lock:
            actor = self._actors.get(session)
        return actor is not None and (actor.occupied or not actor.mailbox.idle)

    def take_up(self, session: str, packets: list[tuple[Packet, bool]]) -> None:
        """Go on with a session that has come here: with what others received of it, then with what was kept here."""
        self.untracked.hand_over(session, packets, self._take_up)

    def _take_up(self, session: str, packets: list[tuple[Packet, bool]], answered: set[str]) -> None:
        def take_up(actor: StreamActor) -> bool | None:
            return actor.mailbox.offer_command(lambda: actor.take_up(packets, answered), urgent=True)

        self._offer(session, take_up, limited=False)

    def tracked(self, session: str) -> bool:
        """Whether a session is there, here or elsewhere: something valid has come of it."""
        return self.actor(session) is not None or self._rivals.tracks(session)

    def told_owners(self) -> Callable[[str, str, bool], None]:
        """Forget who tracks what; return what takes in, from now on, that an instance does so, or no longer."""
        self._rivals = Rivals(round(RIVAL_LEASES * self._settings.lease_s * SECOND))
        return self._rivals.told

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream, and answers for it."""
        return not self._member.holds(stream) and self.actor(stream) is None

    def occupied(self) -> set[int]:
        """Return the partitions with a stream whose state is not kept yet."""
        with self._lock:
            actors = list(self._actors.values())
        return {partition_of(actor.stream) for actor in actors if actor.occupied}

    @property
    def busy(self) -> bool:
        """Whether something waits to be worked on."""
        with self._lock:
            actors = list(self._actors.values())
        return any(not actor.mailbox.idle for actor in actors)

    # What the control loop has done now and then

    def sweep(self, now_ns: int) -> None:
        """Log streams that fell silent, close sessions that have been idle for long, or are another instance's.

        Where thousands are silent, that is done less often.
        """
        self._let_in()
        if now_ns < self._sweep_ns:
            return
        began_ns = time.thread_time_ns()
        self._sweep_all(now_ns)
        self._sweep_ns = now_ns + min(MOST_REST_NS, SWEEP_REST * (time.thread_time_ns() - began_ns))

    def _sweep_all(self, now_ns: int) -> None:
        actors = self._tracking()
        for actor in actors:
            if self._member.fence(actor.stream) is None:
                # It began at the very moment in which its partition was left.
                self.command(actor.stream, StreamActor.on_lost, urgent=True)
            session = actor.session  # the worker may end it at any moment
            if actor.fused and session is not None and session.awaits_caches and actor.mailbox.idle:
                self.command(actor.stream, StreamActor.on_caches_answered, urgent=False)  # or a publisher may be gone
            actor.sensors.look_for_silent(now_ns, self._settings.stale_s)
            if now_ns - actor.meter.active_ns > self._settings.idle_s * SECOND and actor.mailbox.idle:
                self.command(actor.stream, self._close_idle, urgent=False)
        for stream, owners in self._rivals.contested(now_ns):
            tracked = f"it is tracked by {' and '.join(owners)}"
            self._report("contested", stream, "one `store`, or `cluster`, for all instances", tracked)
        self._evict(actors)
        self.untracked.trim(now_ns, round(self._settings.idle_s * SECOND))

    def _evict(self, actors: list[StreamActor]) -> None:
        """Close sessions, the least recently used first, while all together keep more than the process may."""
        held = [(actor.meter.active_ns, actor.held_bytes, actor) for actor in actors]
        excess = sum(size for _, size, _ in held) - self._settings.memory_mb * MEGABYTE // 2
        if excess <= 0:
            return
        for _, size, actor in sorted(held, key=lambda one: one[0]):
            if excess <= 0:
                return
            excess -= size
            self._report("refused", actor.stream, f"messages of at most {self._settings.memory_mb} MB", "more, in all")
            self.command(actor.stream, lambda one: one.close_session("memory"), urgent=False)

    def changed(self, partition: int, change: Change) -> None:
        """Tell the workers of streams what has become of their partition; those that came here are to be taken up."""
        if change is Change.HELD:
            return
        told = StreamActor.on_recalled if change is Change.RECALLED else StreamActor.on_lost
        with self._lock:
            actors = [actor for actor in self._actors.values() if partition_of(actor.stream) == partition]
        for actor in actors:
            if actor.session is not None:  # before it ends: what comes from then on is kept for who asks
                self.untracked.leave(actor.stream, asked_for=change is Change.RECALLED)
            actor.tell(told)

    def resume(self) -> None:
        """Send workers to all streams: they paused, and need not any longer."""
        for actor in self.actors():
            actor.wake()

    def keep(self) -> None:
        """Have every session that changed give its state to the checkpoint writer."""
        for actor in self._tracking():
            if actor.changed:  # thousands may be silent
                actor.tell(StreamActor.keep)

    def keep_now(self) -> None:
        """Do the same in the calling thread, when the workers have ended."""
        for actor in self.actors():
            actor.keep()

    def finish(self) -> None:
        """Process what is held for clouds, in every session; the workers do it."""
        for actor in self.actors():
            self.command(actor.stream, _flush, urgent=False)

    def _close_idle(self, actor: StreamActor) -> None:
        # Asked again: a message may have come between the sweep and the worker's turn.
        if time.monotonic_ns() - actor.meter.active_ns > self._settings.idle_s * SECOND:
            actor.close_session("idle")

    # Actors

    def _over_quota(self, stream: str, packet: Packet, *, frame: bool) -> bool:
        """Refuse a message for which its node, or site, has no more quota."""
        exceeded = self._admission.exceeded(stream, packet.size, packet.now_ns)
        if not exceeded:
            return False
        with self._lock:
            self._past += MessageCounters(received=frame, refused=frame, clouds_refused=not frame)
        self._report("quota", stream, exceeded, "more")
        return True

    def _used(self) -> list[tuple[str, int]]:
        """Return the streams with a session, and when each was last used."""
        return [(actor.stream, actor.meter.active_ns) for actor in self.actors()]

    def _evict_for_another(self, stream: str) -> None:
        self._report("refused", stream, f"at most {self._settings.max_sessions} streams at once", "another site's")
        self.command(stream, lambda actor: actor.close_session("evicted"), urgent=True)

    def _offer(self, stream: str, offer: Callable[[StreamActor], bool | None], *, limited: bool = True) -> bool:
        while True:
            actor = self._actor(stream, limited=limited)
            if actor is None:
                return False
            sent = offer(actor)
            if sent is not None:
                break
            # The actor has closed since it was found: once more, with a new one.
            self._discard(actor)
        if sent:
            self._scheduler.submit(actor)
        return True

    def _actor(self, stream: str, *, limited: bool) -> StreamActor | None:
        with self._lock:
            actor = self._actors.get(stream)
            if actor is None and not (self._crowded() and limited):
                actor = self._actors[stream] = StreamActor(stream, self._context)
                self._unproven.add(actor)
            return actor

    def _crowded(self) -> bool:
        """Whether too many streams have not sent a valid message yet, as far as is known; called with the lock."""
        most = MAX_UNPROVEN_STRAINED if self._member.strained else MAX_UNPROVEN
        if len(self._unproven) >= most:
            known = self._actors.get
            self._unproven = {one for one in self._unproven if not one.occupied and known(one.stream) is one}
        return len(self._unproven) >= most

    def _let_in(self) -> None:
        """Hand over what was put off, as far as there is room."""
        while self.untracked.newcomers:
            with self._lock:
                if self._crowded():
                    return
            self.untracked.hand_over_newcomer(self._take_up)

    def _discard(self, actor: Actor) -> None:
        with self._lock:
            if self._actors.get(actor.stream) is actor:
                del self._actors[actor.stream]
                self._past += actor.totals()

    def _admit(self, stream: str) -> Lineage | None:
        lineage = self._admission.admit(stream)
        if lineage is not None:
            self._let_in()
        return lineage

    def _refuse(self, stream: str) -> None:
        self._count_refused()
        self._report_shed(stream)

    def _lose(self, stream: str, lost: list[bool]) -> None:
        """Count messages that were dropped before their stream was tracked, each True: a frame."""
        frames = sum(lost)
        with self._lock:
            self._past += MessageCounters(received=frames, refused=frames, clouds_refused=len(lost) - frames)
        self._report_shed(stream)

    def _report_shed(self, stream: str) -> None:
        self._report("shed", stream, f"fewer than {MAX_UNPROVEN} new streams at once", "more than can wait")

    def _count_refused(self) -> None:
        with self._lock:
            self._past += MessageCounters(received=1, refused=1)

    def parsed(self, key: str) -> tuple[str, str]:
        """Return the stream of a key and its session, remembered.

        Raises:
            MessageError: it is none.
        """
        parsed = self._streams.get(key)
        if parsed is None:
            stream = self.keys.stream_of(key)
            if self.fusion.is_session(stream):
                raise schemas.MessageError("invalid_value", "key", f"a sensor not named {FUSED}, as its tracks", key)
            parsed = stream, self.fusion.session_of(stream)
            if len(self._streams) >= MAX_KEYS:
                self._streams.clear()
            self._streams[key] = parsed
        return parsed

    def _report(self, code: str, stream: str, expected: str, received: str) -> None:
        message = f"Key: expected {expected}, received {received}."
        problem = problem_of(
            code,
            stream=stream,
            instance=self.instance,
            path="key",
            expected=expected,
            received=received,
            message=message,
        )
        self._reporter.report(problem, time.monotonic_ns())


def _flush(actor: StreamActor) -> None:
    if actor.session is not None:
        actor.deliver(actor.session.flush())

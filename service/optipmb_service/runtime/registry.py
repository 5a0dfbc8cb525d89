"""All streams of the service: hands messages to the actors of their streams, and tells these what the others decide.

Called by threads of the network, the tracking thread, the query thread and the control loop. `actor_table` has the
actors, `untracked` what came of streams that others track, `admission` says who has room, and `sweep` looks at all of
them now and then.
"""

from __future__ import annotations

import time
from functools import lru_cache, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Literal

import optipmb_schemas as schemas

import optipmb
from optipmb_service.cluster.leases import Change, partition_of
from optipmb_service.runtime import dumps
from optipmb_service.runtime.actor_table import MAX_UNPROVEN_ACTORS, ActorTable
from optipmb_service.runtime.admission import Admission
from optipmb_service.runtime.byte_budget import MEGABYTE, ByteBudget
from optipmb_service.runtime.context import Actor, ActorContext, part_of, policy_of
from optipmb_service.runtime.fusion import FUSED, Fusion
from optipmb_service.runtime.mailbox import Mailbox
from optipmb_service.runtime.rivals import Rivals
from optipmb_service.runtime.stream_actor import StreamActor
from optipmb_service.runtime.sweep import Sweep
from optipmb_service.runtime.takeover_buffer import ANY_AGE_NS, TakeoverBuffer
from optipmb_service.runtime.untracked import UntrackedMessages
from optipmb_service.session.problems import problem_of
from optipmb_service.session.values import SECOND, MessageCounters

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.missed_frames import MissedFrames
    from optipmb_service.runtime.persistence import Persistence
    from optipmb_service.runtime.ports import Caches, MessageSink, Packet
    from optipmb_service.runtime.profiles import Profiles
    from optipmb_service.runtime.scheduler import Scheduler
    from optipmb_service.session.values import Incarnation
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.telemetry.problem_reporter import ProblemReporter

RIVAL_LEASES: Final = 3
"""Leases for which the token of an instance may stay whose stream has been taken over."""

KEPT_AT_ONCE: Final = 8
"""States that are given to the checkpoint writer before waiting frames have their turn; they take less than a frame."""

MAX_KEYS: Final = 8192
"""Keys whose stream is remembered."""


class Registry:
    """The streams of one service.

    Args:
        settings: what is in force.
        profiles: the parameters that can be had.
        sink: where results go.
        reporter: where problems go.
        scheduler: runs the actors.
        member: says which streams this instance tracks.
        persistence: where checkpoints go and come from.
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
        self._actors = ActorTable(lambda stream: StreamActor(stream, self._context), scheduler, member)
        self.parsed = lru_cache(MAX_KEYS)(self._parsed)
        """Returns the stream of a key and its session, or raises MessageError where it is none."""
        self._metrics = metrics
        self._admission = Admission(settings, self._used, self._evict_for_another)
        self._rivals = Rivals(settings.instance, round(RIVAL_LEASES * settings.lease_s * SECOND))
        standby = ByteBudget(settings.standby_mb * MEGABYTE)

        def buffer(keep_ns: int = ANY_AGE_NS) -> TakeoverBuffer:
            return TakeoverBuffer(keep_ns, standby)

        standby_ns = round(settings.standby_s * SECOND)
        self.untracked = UntrackedMessages(member.holds, partial(buffer, standby_ns), self._lose)
        self._sweep = Sweep(settings, self._actors, member, self.untracked, self.command, self._report)
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
            silent_ns=round(settings.lease_s * SECOND),
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
            discard=self._actors.discard,
            submit=scheduler.submit,
            arm=arm,
            metrics=metrics,
            tracker=tracker,
        )

    # Messages, from the network

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
            self._count_refused(frame=frame)
            self._report("invalid_value", "", error.expected, error.received)
            return
        topic: Literal["detections", "points"] = "detections" if frame else "points"
        passes = self.untracked.passes(session)
        if not passes and not self._member.holds(session) and self.untracked.keep(session, packet, frame=frame):
            self._metrics.foreign(topic, packet.size)
            return
        self._metrics.received(topic, packet.size)
        if exceeded := self._admission.exceeded(stream, packet.size, packet.now_ns):
            self._count_refused(frame=frame)
            self._report("quota", stream, exceeded, "more")
        elif passes:
            self._hand(session, packet, frame=frame)
        else:
            self._keep(session, packet, frame=frame)

    def caches_answered(self, key: str) -> None:
        """Tell a session that all has come which the cache of its publisher held."""
        try:
            stream, session = self.parsed(key)
        except schemas.MessageError:
            return
        if self.untracked.cache_answered(session, stream):
            return
        actor = self._actors.of(session)
        if actor is not None and actor.mailbox.offer_command(lambda: actor.on_caches_answered(stream), urgent=False):
            self._scheduler.submit(actor)

    def _hand(self, session: str, packet: Packet, *, frame: bool) -> None:
        offered = Mailbox.offer_frame if frame else Mailbox.offer_cloud
        if not self._actors.offer(session, lambda actor: offered(actor.mailbox, packet)):
            self.untracked.put_off(session, packet, frame=frame)

    def _keep(self, session: str, packet: Packet, *, frame: bool) -> None:
        """Keep a packet that was received to be tracked here until its session is, here or by who asks for it."""
        if not self.untracked.keep(session, packet, frame=frame, own=True):
            self._hand(session, packet, frame=frame)

    def command(self, stream: str, command: Callable[[StreamActor], None], *, urgent: bool) -> bool:
        """Have the actor of a stream run a command; False when the service takes no more streams."""
        if self._actors.offer(stream, lambda actor: actor.mailbox.offer_command(lambda: command(actor), urgent=urgent)):
            return True
        self._report_shed(stream)
        return False

    # What is there

    def actors(self) -> list[StreamActor]:
        """Return the actors that have a session, by stream name."""
        return self._actors.in_order()

    def actor(self, stream: str) -> StreamActor | None:
        """Return the actor of a stream that has a session."""
        actor = self._actors.of(stream)
        return actor if actor is not None and actor.session is not None else None

    def totals(self) -> MessageCounters:
        """Return what became of all messages since the start."""
        return self._actors.totals()

    # Streams that come here, or have left

    def passed_by(self, key: str, size: int) -> None:
        """Count detections that were discovered and are of no use here, unless they come by a subscription as well."""
        if not self._member.holds(self.parsed(key)[1]):
            self._metrics.foreign("detections", size)

    def waits(self, session: str) -> bool:
        """Whether messages of a session wait for the tracking thread."""
        actor = self._actors.of(session)
        return actor is not None and (actor.occupied or not actor.mailbox.idle)

    def take_up(self, session: str, packets: list[tuple[Packet, bool]]) -> None:
        """Go on with a session that has come here: with what others received of it, then with what was kept here."""
        self.untracked.hand_over(session, packets, self._take_up)

    def _take_up(self, session: str, packets: list[tuple[Packet, bool]], answered: set[str]) -> None:
        def take_up(actor: StreamActor) -> bool | None:
            return actor.mailbox.offer_command(lambda: actor.take_up(packets, answered), urgent=True)

        self._actors.offer(session, take_up, limited=False)

    def tracked(self, session: str) -> bool:
        """Whether a session is there, here or elsewhere: something valid has come of it."""
        return self.actor(session) is not None or self._rivals.tracks(session)

    def on_owner(self) -> Callable[[str, str, bool], None]:
        """Forget who tracks what; return what takes in, from now on, that an instance does so, or no longer."""
        patience_ns = round(RIVAL_LEASES * self._settings.lease_s * SECOND)
        self._rivals = Rivals(self.instance, patience_ns, self._rivals.doubted)
        return self._rivals.on_owner

    @property
    def doubts_owners(self) -> bool:
        """Whether who tracks what is to be asked for again."""
        return bool(self._rivals.doubted)

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream, and answers for it."""
        return not self._member.holds(stream) and self.actor(stream) is None

    def occupied(self) -> set[int]:
        """Return the partitions with a stream whose state is not kept yet."""
        return {partition_of(actor.stream) for actor in self._actors.every() if actor.occupied}

    @property
    def busy(self) -> bool:
        """Whether something waits to be worked on."""
        return any(not actor.mailbox.idle for actor in self._actors.every())

    # What the control loop has done now and then

    def sweep(self, now_ns: int) -> None:
        """Log streams that fell silent, close sessions that have been idle for long, or are another instance's.

        Where thousands are silent, that is done less often.
        """
        self._let_in()
        self._sweep.run(now_ns, self._rivals)

    def changed(self, partition: int, change: Change) -> None:
        """Have actors run what a change of their partition asks for; those that came here are to be taken up."""
        if change is Change.HELD:
            return
        commands = {Change.RECALLED: StreamActor.on_recalled, Change.RENEWED: StreamActor.on_renewed}
        command = commands.get(change, StreamActor.on_lost)
        for actor in [actor for actor in self._actors.every() if partition_of(actor.stream) == partition]:
            if actor.session is not None and change is not Change.RENEWED:
                # Before it ends: what comes from then on is kept for who asks.
                self.untracked.leave(actor.stream, asked_for=change is Change.RECALLED)
            actor.tell(command)

    def resume(self) -> None:
        """Schedule all actors: they paused, and need not any longer."""
        for actor in self.actors():
            actor.wake()

    def keep(self) -> None:
        """Have every session that changed give its state to the checkpoint writer."""
        changed = [actor for actor in self._actors.tracking() if actor.changed]  # thousands may be silent
        if changed:
            self._scheduler.submit(_Keeping(changed))

    def keep_now(self) -> None:
        """Do the same in the calling thread, when the tracking thread has ended."""
        for actor in self.actors():
            actor.keep()

    def finish(self) -> None:
        """Process what is held for clouds, in every session, on the tracking thread."""
        for actor in self.actors():
            self.command(actor.stream, _flush, urgent=False)

    # Room

    def _used(self) -> list[tuple[str, int, bool]]:
        """Return the streams with a session, when each was last used, and whether it is silent."""
        now_ns = time.monotonic_ns()
        return [(actor.stream, actor.meter.active_ns, actor.meter.is_silent(now_ns)) for actor in self.actors()]

    def _evict_for_another(self, stream: str) -> None:
        self._report("refused", stream, f"at most {self._settings.max_sessions} streams at once", "another site's")
        self.command(stream, lambda actor: actor.close_session("evicted"), urgent=True)

    def _let_in(self) -> None:
        """Hand over what was put off, as far as there is room."""
        while self.untracked.newcomers and self._actors.has_room():
            self.untracked.hand_over_newcomer(self._take_up)

    def _admit(self, stream: str) -> Incarnation | None:
        incarnation = self._admission.admit(stream)
        if incarnation is not None:
            self._let_in()
        return incarnation

    def _lose(self, stream: str, lost: list[bool]) -> None:
        """Count messages that were dropped before their stream was tracked, each True: a frame."""
        frames = sum(lost)
        self._actors.count(MessageCounters(received=frames, shed=frames, clouds_shed=len(lost) - frames))
        expected = "room for what waits for its session, for two minutes at most"
        self._report("shed", stream, expected, f"{len(lost)} more; the oldest were dropped")

    def _report_shed(self, stream: str) -> None:
        self._report("shed", stream, f"fewer than {MAX_UNPROVEN_ACTORS} new streams at once", "more than can wait")

    def _count_refused(self, *, frame: bool) -> None:
        self._actors.count(MessageCounters(received=frame, refused=frame, clouds_refused=not frame))

    def _parsed(self, key: str) -> tuple[str, str]:
        stream = self.keys.stream_of(key)
        if self.fusion.is_session(stream):
            raise schemas.MessageError("invalid_value", "key", f"a sensor not named {FUSED}, as its tracks", key)
        return stream, self.fusion.session_of(stream)

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


class _Keeping:
    """Has actors give the states of their sessions to the checkpoint writer, on the tracking thread, few at a time.

    Args:
        actors: those with sessions that changed.
    """

    def __init__(self, actors: list[StreamActor]) -> None:
        self._left = iter(actors)

    def work(self) -> bool:
        """Go on; True: there are more, after the frames that wait."""
        some = list(islice(self._left, KEPT_AT_ONCE))
        for actor in some:
            actor.keep()
        return len(some) == KEPT_AT_ONCE


def _flush(actor: StreamActor) -> None:
    if actor.session is not None:
        actor.deliver(actor.session.flush())

"""What is looked at now and then in all streams: silence, idleness, memory, and who else tracks them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, Protocol

from optipmb_service.runtime.byte_budget import MEGABYTE
from optipmb_service.runtime.stream_actor import StreamActor
from optipmb_service.session.values import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.actor_table import ActorTable
    from optipmb_service.runtime.rivals import Rivals
    from optipmb_service.runtime.untracked import UntrackedMessages
    from optipmb_service.settings import Settings

    Report = Callable[[str, str, str, str], None]

SWEEP_REST: Final = 200
"""How many times as long as a look at all sessions took of the processor it rests before the next one."""

MOST_REST_NS: Final = 5 * SECOND


LOG_READS: Final = 32
"""Sessions that read the log at once: thousands that are silent are no load on its servers."""

LITTLE: Final = 0.1
"""Part of an equal share of the memory: a session that keeps less is not closed for it.

It would free next to nothing. All such sessions keep less than a tenth of the memory, so to close others suffices.
"""


class Command(Protocol):
    """Has the actor of a stream run a command, after what waits there or, `urgent`, before."""

    def __call__(self, stream: str, command: Callable[[StreamActor], None], *, urgent: bool) -> bool:
        """Return False when there is no room for the stream."""


class Sweep:
    """Looks at all streams, less often where thousands are silent.

    Args:
        settings: what is in force.
        actors: those of the streams.
        member: says which streams this instance tracks.
        untracked: what is kept of streams that are not tracked here.
        command: reaches the actors of streams.
        report: reports a problem: code, stream, what was expected and what was received.
    """

    def __init__(
        self,
        settings: Settings,
        actors: ActorTable,
        member: Member,
        untracked: UntrackedMessages,
        command: Command,
        report: Report,
    ) -> None:
        self._stale_s = settings.stale_s
        self._idle_ns = settings.idle_s * SECOND
        self._memory_mb = settings.memory_mb
        self._has_log = bool(settings.cluster)
        self._actors = actors
        self._member = member
        self._untracked = untracked
        self._command = command
        self._report = report
        self._next_ns = 0

    def run(self, now_ns: int, rivals: Rivals) -> None:
        """Look at all streams, if it is time to (monotonic); `rivals` says which others track as well."""
        if now_ns < self._next_ns:
            return
        began_ns = time.thread_time_ns()
        self._run(now_ns, rivals)
        self._next_ns = now_ns + min(MOST_REST_NS, SWEEP_REST * (time.thread_time_ns() - began_ns))

    def _run(self, now_ns: int, rivals: Rivals) -> None:
        actors = self._actors.tracking()
        for actor in actors:
            if self._member.fence(actor.stream) is None:
                # It began at the very moment in which its partition was left.
                self._command(actor.stream, StreamActor.on_lost, urgent=True)
            session = actor.session  # the tracking thread may end it at any time
            if actor.fused and session is not None and session.awaits_caches and actor.mailbox.idle:
                self._command(actor.stream, StreamActor.on_caches_answered, urgent=False)  # or a publisher may be gone
            actor.sensors.look_for_silent(now_ns, self._stale_s)
            if now_ns - actor.meter.active_ns > self._idle_ns and actor.mailbox.idle:
                self._command(actor.stream, self._close_idle, urgent=False)
        if self._has_log:
            self._read_log(actors, now_ns)
        for stream, owners in rivals.contested(now_ns, [actor.stream for actor in actors]):
            tracked = f"it is tracked by {' and '.join(owners)}"
            self._report("contested", stream, "one `store`, or `cluster`, for all instances", tracked)
        self._evict(actors)
        self._untracked.trim(now_ns, round(self._idle_ns))

    def _read_log(self, actors: list[StreamActor], now_ns: int) -> None:
        """Have the log read for silent sessions, those first that wait longest; a few at a time."""
        silent = ((actor.log_check.due_ns(actor.sensors.silent_ns(now_ns), now_ns), actor) for actor in actors)
        due = [(since_ns, actor) for since_ns, actor in silent if since_ns is not None]
        free = LOG_READS - sum(actor.log_check.under_way for actor in actors)
        for _, actor in sorted(due, key=lambda one: one[0])[: max(0, free)]:
            actor.log_check.begin(now_ns)
            if not self._command(actor.stream, StreamActor.look_in_log, urgent=False):
                actor.log_check.end(found=False)

    def _evict(self, actors: list[StreamActor]) -> None:
        """Close sessions, the least recently used first, while all together keep more than the process may."""
        held = [(actor.meter.active_ns, actor.held_bytes, actor) for actor in actors]
        most = self._memory_mb * MEGABYTE // 2
        excess = sum(size for _, size, _ in held) - most
        if excess <= 0:
            return
        little = LITTLE * most / len(held)
        for _, size, actor in sorted(held, key=lambda one: one[0]):
            if excess <= 0:
                return
            if size < little:
                continue
            excess -= size
            self._report("refused", actor.stream, f"messages of at most {self._memory_mb} MB", "more, in all")
            self._command(actor.stream, lambda one: one.close_session("memory"), urgent=False)

    def _close_idle(self, actor: StreamActor) -> None:
        # Asked again: a message may have come between the sweep and the actor's turn.
        if time.monotonic_ns() - actor.meter.active_ns > self._idle_ns:
            actor.close_session("idle")

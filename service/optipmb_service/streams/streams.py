"""Streams: all streams of a process. Messages, commands and changes of partitions reach them here.

Called by threads of the network, the tracking thread, the query threads, the intake and the control loop. One lock
guards the table of backlogs; nothing slow is done under it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from functools import lru_cache, partial
from itertools import islice
from typing import TYPE_CHECKING, Final, Literal

import optipmb_schemas as schemas

from optipmb_service.cluster.leases import Change, partition_of
from optipmb_service.session.counts import MessageCounters
from optipmb_service.streams.admission import Admission
from optipmb_service.streams.backlog import Backlog, BacklogBounds, ByteBudget
from optipmb_service.streams.directory import StreamDirectory
from optipmb_service.streams.profiles import FUSED
from optipmb_service.streams.rivals import Rivals
from optipmb_service.streams.session_factory import PARTS
from optipmb_service.streams.sources import read_logs
from optipmb_service.streams.stream import Stream
from optipmb_service.units import MEGABYTE, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.identity import Incarnation
    from optipmb_service.streams.parts import Parts
    from optipmb_service.zenoh.topics import Packet

MAX_UNPROVEN: Final = 256
"""Streams at once that have not sent a valid message yet."""

MAX_UNPROVEN_STRAINED: Final = 16
"""The same while the lease is renewed late: each of them delays that."""

MAX_NEWCOMERS: Final = 16_384
"""Sessions whose first messages wait for room."""

MAX_BACKLOGS: Final = 65_536
"""Backlogs from which on empty ones are forgotten at once."""

MAX_KEYS: Final = 8192
"""Keys whose stream is remembered."""

RIVAL_LEASES: Final = 3
"""Leases for which the token of an instance may stay whose stream has been taken over."""

KEPT_AT_ONCE: Final = 8
"""States that are given to the checkpoint writer before waiting frames have their turn; they take less than a frame."""

SWEEP_REST: Final = 200
"""Rest after a look at all sessions, in times of the processor time that it took."""

MOST_REST_NS: Final = 5 * SECOND

LITTLE: Final = 0.1
"""Part of an equal share of the memory: a session that keeps less is not closed for it.

It would free next to nothing. All such sessions keep less than a tenth of the memory, so to close others suffices.
"""


class Streams:
    """The streams of one process."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self._settings = settings = parts.settings
        self._member = parts.member
        self.admission = Admission(settings, self._used, self._evict_for_another)
        """Room for sessions."""
        self.directory = StreamDirectory(
            settings.instance,
            round(settings.idle_s * SECOND),
            lambda stream: self.tracked(parts.fusion.session_of(stream)),
        )
        """Streams that are known."""
        self.queued = ByteBudget(settings.memory_mb * MEGABYTE // 2)
        """Bytes that wait in the queues of all streams."""
        self.parsed = lru_cache(MAX_KEYS)(self._parsed)
        """Returns the stream of a key and its session, or raises MessageError."""
        self._rivals = Rivals(settings.instance, round(RIVAL_LEASES * settings.lease_s * SECOND))
        self._bounds = BacklogBounds(
            self._lose,
            settings.queue_frames,
            settings.queue_clouds,
            settings.stream_mb * MEGABYTE // PARTS,
            self.queued,
            ByteBudget(settings.standby_mb * MEGABYTE),
            round(settings.standby_s * SECOND),
        )
        self._lock = threading.Lock()
        self._backlogs: dict[str, Backlog] = {}
        self._streams: dict[str, Stream] = {}
        self._unproven: set[Stream] = set()
        self._newcomers: dict[str, None] = {}
        """Sessions that wait for room, in order."""
        self._coming: set[str] = set()
        """Sessions that the intake is about to open."""
        self._past = MessageCounters()
        """Counts of streams that have ended, and of messages that came to none."""
        self._sweeps_ns = 0

    # Messages, from the network

    def receive(self, packet: Packet) -> None:
        """Add a packet to the backlog of its session; never waits."""
        try:
            stream, session = self.parsed(packet.key)
        except schemas.MessageError as error:
            # Only members that receive the detections of all streams receive it.
            named = ""
            with contextlib.suppress(schemas.MessageError):  # the key of a stream, with the name of a session
                named = self.parts.keys.stream_of(packet.key)
            self._refuse("invalid_value", packet, named, error.expected, error.received)
            return
        topic: Literal["detections", "points"] = "detections" if packet.frame else "points"
        if not self._member.holds(session):
            self.parts.metrics.foreign(topic, packet.size)
            self._push(session, packet, own=False)
            return
        self.parts.metrics.received(topic, packet.size)
        if exceeded := self.admission.exceeded(stream, packet.size, packet.now_ns):
            self._refuse("quota", packet, stream, exceeded, "more")
        else:
            self._push(session, packet, own=True)

    def passed_by(self, key: str, size: int) -> None:
        """Count detections that were discovered and are of no use here, unless they come by a subscription as well."""
        if not self._member.holds(self.parsed(key)[1]):
            self.parts.metrics.foreign("detections", size)

    def cache_answered(self, key: str) -> None:
        """Note that all has come which the cache of a publisher held."""
        try:
            stream, session = self.parsed(key)
        except schemas.MessageError:
            return
        if (backlog := self._backlogs.get(session)) is not None:
            backlog.cache_answered(stream)

    def _push(self, session: str, packet: Packet, *, own: bool) -> None:
        while True:
            backlog = self._backlogs.get(session) or self._add(session, packet.now_ns)
            if backlog is None:
                self._lose(session, [packet])
                return
            if backlog.push(packet, own=own):
                return
            self._forget_closed(session)

    def _add(self, session: str, now_ns: int) -> Backlog | None:
        """Return the backlog of a session, a new one with a stream if it is to be tracked here and there is room."""
        with self._lock:
            backlog = self._backlogs.get(session)
            if backlog is None:
                crowded = self._member.holds(session) and self._crowded()
                if crowded and len(self._newcomers) >= MAX_NEWCOMERS:
                    return None
                backlog = self._backlog(session, now_ns)
                if crowded:
                    self._newcomers[session] = None
                elif self._member.holds(session):
                    self._attach(backlog)
                    backlog.go_live()
            return backlog

    def _forget_closed(self, session: str) -> None:
        if (stream := self._streams.get(session)) is not None and stream.backlog.closed:
            self.discard(stream)

    # Commands

    def command(self, session: str, command: Callable[[Stream], None], *, urgent: bool) -> bool:
        """Have a stream run a command; False when the process takes no more streams."""
        if self._command(session, command, urgent=urgent):
            return True
        expected = f"fewer than {MAX_UNPROVEN} new streams at once"
        self._report("shed", session, expected, "more than can wait")
        return False

    def _command(self, session: str, command: Callable[[Stream], None], *, urgent: bool, limited: bool = True) -> bool:
        while (stream := self._streams.get(session) or self._stream(session, limited=limited)) is not None:
            if stream.backlog.command(partial(command, stream), urgent=urgent):
                return True
            self._forget_closed(session)
        return False

    def _stream(self, session: str, *, limited: bool) -> Stream | None:
        """Return the stream of a session, a new one if there is room."""
        with self._lock:
            stream = self._streams.get(session)
            if stream is None and not (limited and self._crowded()):
                backlog = self._backlogs.get(session)
                if backlog is not None:
                    return self._attach(backlog)
                backlog = self._backlog(session, time.monotonic_ns())
                stream = self._attach(backlog)
                if self._member.holds(session):
                    backlog.go_live()
            return stream

    def discard(self, stream: Stream) -> None:
        """Forget a stream that has ended, but not the counts of its messages."""
        with self._lock:
            if self._streams.get(stream.name) is stream:
                self._past += stream.counts.totals()
                del self._streams[stream.name]
                self._unproven.discard(stream)
                if stream.backlog.detach():
                    del self._backlogs[stream.name]

    # Present streams

    def tracking(self) -> list[Stream]:
        """Return the streams that have a session, by name."""
        with self._lock:
            streams = sorted(self._streams.items())
        return [stream for _, stream in streams if stream.session is not None]

    def of(self, session: str) -> Stream | None:
        """Return the stream of a session, if it has one."""
        stream = self._streams.get(session)
        return None if stream is None or stream.session is None else stream

    def totals(self) -> MessageCounters:
        """Return the counts of all messages since the start."""
        with self._lock:
            totals, streams = self._past, list(self._streams.values())
        for stream in streams:
            totals += stream.counts.totals()
        return totals

    def tracked(self, session: str) -> bool:
        """Whether a session is there, here or elsewhere: something valid has come of it."""
        return self.of(session) is not None or self._rivals.tracks(session)

    def elsewhere(self, session: str) -> bool:
        """Whether another instance tracks a session, and answers for it."""
        return not self._member.holds(session) and self.of(session) is None

    def occupied(self) -> set[int]:
        """Return the partitions with a stream whose state is not kept yet."""
        return {partition_of(stream.name) for stream in self._all() if stream.occupied}

    @property
    def busy(self) -> bool:
        """Whether something waits to be processed."""
        return any(not stream.backlog.idle for stream in self._all())

    def waits(self, session: str) -> bool:
        """Whether messages of a session wait for the tracking thread."""
        stream = self._streams.get(session)
        return stream is not None and (stream.occupied or not stream.backlog.idle)

    # Sessions that come here, or leave

    def expect(self, session: str) -> None:
        """Keep messages of a session that is new to all members until its own has asked for them."""
        if session not in self._backlogs and not self._member.holds(session):
            with self._lock:
                if session not in self._backlogs:
                    self._backlog(session, time.monotonic_ns()).unasked = True

    def hold(self, session: str) -> None:
        """Hold messages of a session until it is opened."""
        now_ns = time.monotonic_ns()
        with self._lock:
            self._newcomers.pop(session, None)
            self._coming.add(session)
            backlog = self._backlogs.get(session) or self._backlog(session, now_ns)
            backlog.seen_ns = now_ns
        backlog.leave()

    def take_up(self, session: str, packets: list[Packet]) -> None:
        """Open a session that has come here: first with messages that others received, then with the held ones."""
        lost: list[Packet] = []
        with self._lock:
            self._newcomers.pop(session, None)
            self._coming.discard(session)
            backlog = self._backlogs.get(session)
            if backlog is None and packets:
                backlog = self._backlog(session, time.monotonic_ns())
            if backlog is None:
                return
            if holds := self._member.holds(session):
                lost = backlog.bring(packets)
        if lost:
            self._lose(session, lost)
        if holds:
            self._command(session, Stream.take_up, urgent=True, limited=False)
        else:
            for packet in packets:
                self._push(session, packet, own=False)

    def held(self, partitions: Container[int]) -> set[str]:
        """Return the sessions of partitions of which messages are held for another member, or until it is opened."""
        with self._lock:
            return {
                name
                for name, one in self._backlogs.items()
                if one.state == "foreign" and partition_of(name) in partitions
            }

    def keeps(self, session: str) -> bool:
        """Whether messages of a session are held for another member, or until it is opened."""
        backlog = self._backlogs.get(session)
        return backlog is not None and backlog.state == "foreign"

    def recent(self, sessions: Iterable[str]) -> list[Packet]:
        """Return the held messages of sessions, the oldest first, for their next member."""
        held = [backlog.recent() for one in sessions if (backlog := self._backlogs.get(one)) is not None]
        return sorted((packet for packets in held for packet in packets), key=lambda one: one.now_ns)

    def forget_caches(self, received: set[str]) -> None:
        """Forget which caches have answered, but for streams that are received still: they hold more by now."""
        with self._lock:
            for backlog in self._backlogs.values():
                backlog.answered &= received

    def changed(self, partition: int, change: Change) -> None:
        """Have streams follow a change of their partition; sessions that came here are opened later."""
        commands = {Change.RECALLED: Stream.on_recalled, Change.RENEWED: Stream.on_renewed, Change.LOST: Stream.on_lost}
        if (command := commands.get(change)) is None:
            return
        for stream in [one for one in self._all() if partition_of(one.name) == partition]:
            if change is not Change.RENEWED and not self._member.holds(stream.name):
                # Before its session ends: later messages are held for the next member.
                stream.backlog.leave(asked_for=change is Change.RECALLED and stream.session is not None)
            stream.tell(command)

    def on_owner(self) -> Callable[[str, str, bool], None]:
        """Forget who tracks what; return what notes, from now on, that an instance does so, or no longer."""
        self._rivals = self._rivals.again()
        return self._rivals.on_owner

    @property
    def doubts_owners(self) -> bool:
        """Whether the owners are to be asked for again."""
        return bool(self._rivals.doubted)

    # Checkpoints and the end

    def keep(self) -> None:
        """Have every session that changed give its state to the checkpoint writer."""
        changed = [stream for stream in self._all() if stream.changed]  # thousands may be silent
        if changed:
            self.parts.scheduler.submit(partial(self._keep_some, iter(changed)))

    @staticmethod
    def _keep_some(changed: Iterator[Stream]) -> bool:
        """Give some states, on the tracking thread; True: there are more, after the frames that wait."""
        some = list(islice(changed, KEPT_AT_ONCE))
        for stream in some:
            stream.keep()
        return len(some) == KEPT_AT_ONCE

    def kept(self, checkpoint: Checkpoint) -> None:
        """Note that a checkpoint is durable."""
        if (stream := self._streams.get(checkpoint.stream)) is not None:
            stream.outbox.durable = checkpoint.base.reached

    def keep_now(self) -> None:
        """Give all changed states to the checkpoint writer, after the tracking thread has ended."""
        for stream in self.tracking():
            stream.keep()

    def resume(self) -> None:
        """Schedule all streams after a pause."""
        for stream in self.tracking():
            stream.backlog.wake()

    def finish(self) -> None:
        """Process what waits for clouds, in every session, on the tracking thread."""
        for stream in self.tracking():
            self.command(stream.name, Stream.flush, urgent=False)

    # Now and then, by the control loop

    def sweep(self, now_ns: int) -> None:
        """Look at all streams: silence, idleness, memory, other owners. Less often where thousands are silent."""
        self._let_in()
        if now_ns < self._sweeps_ns:
            return
        began_ns = time.thread_time_ns()
        self._sweep(now_ns)
        self._sweeps_ns = now_ns + min(MOST_REST_NS, SWEEP_REST * (time.thread_time_ns() - began_ns))

    def _sweep(self, now_ns: int) -> None:
        idle_ns = round(self._settings.idle_s * SECOND)
        streams = [stream for stream in self._all() if stream.session is not None]
        for stream in streams:
            if self._member.fence(stream.name) is None:
                # It began at the very moment in which its partition was left.
                stream.tell(Stream.on_lost)
            if stream.fused and stream.session and stream.session.arrivals.waiting and stream.backlog.idle:
                self.command(stream.name, Stream.on_answered, urgent=False)  # or a publisher may be gone
            stream.sensors.look_for_silent(now_ns, self._settings.stale_s)
            if now_ns - stream.meter.active_ns > idle_ns and stream.backlog.idle:
                self.command(stream.name, lambda one: self._close_idle(one, idle_ns), urgent=False)
        if self._settings.cluster:
            read_logs(streams, now_ns)
        for name, owners in self._rivals.contested(now_ns, [stream.name for stream in streams]):
            tracked = f"it is tracked by {' and '.join(owners)}"
            self._report("contested", name, "one `store`, or `cluster`, for all instances", tracked)
        self._evict(streams)
        self._trim(now_ns, idle_ns)

    def _evict(self, streams: list[Stream]) -> None:
        """Close sessions, the least recently used first, while all together keep more than the process may."""
        held = [(stream.meter.active_ns, stream.held_bytes, stream) for stream in streams]
        most = self._settings.memory_mb * MEGABYTE // 2
        excess = sum(size for _, size, _ in held) - most
        if excess <= 0:
            return
        little = LITTLE * most / len(held)
        for _, size, stream in sorted(held, key=lambda one: one[0]):
            if excess <= 0:
                return
            if size < little:
                continue
            excess -= size
            self._report("refused", stream.name, f"messages of at most {self._settings.memory_mb} MB", "more, in all")
            self.command(stream.name, lambda one: one.close_session("memory"), urgent=False)

    def _trim(self, now_ns: int, idle_ns: int) -> None:
        """Drop messages held for too long, and backlogs of which nothing was heard for `idle_ns`."""
        with self._lock:
            backlogs = list(self._backlogs.items())
        for session, backlog in backlogs:
            if backlog.trim(now_ns) and (len(backlogs) > MAX_BACKLOGS or now_ns - backlog.seen_ns > idle_ns):
                self._forget_empty(session)

    def _forget_empty(self, session: str) -> None:
        with self._lock:
            backlog = self._backlogs.get(session)
            if backlog is not None and session not in self._streams and backlog.close_empty():
                del self._backlogs[session]
                self._newcomers.pop(session, None)

    @staticmethod
    def _close_idle(stream: Stream, idle_ns: int) -> None:
        # Asked again: a message may have come between the sweep and the stream's turn.
        if time.monotonic_ns() - stream.meter.active_ns > idle_ns:
            stream.close_session("idle")

    # Room

    def admit(self, session: str) -> Incarnation | None:
        """Count a session that begins; return the stream's last incarnation, None when there is no room."""
        incarnation = self.admission.admit(session)
        if incarnation is not None:
            self._let_in()
        return incarnation

    def _let_in(self) -> None:
        """Open sessions that have waited for room, as far as there is some."""
        while self._newcomers:
            with self._lock:
                session = None if self._crowded() else next(iter(self._newcomers), None)
                if session is None:
                    return
                del self._newcomers[session]
            self._command(session, self._take_up_newcomer, urgent=True, limited=False)

    def _take_up_newcomer(self, stream: Stream) -> None:
        if stream.name not in self._coming:  # the intake takes those up with what others received
            stream.take_up()

    def _used(self) -> list[tuple[str, int, bool]]:
        """Return the streams with a session, when each was last used, and whether it is silent."""
        now_ns = time.monotonic_ns()
        return [(one.name, one.meter.active_ns, one.meter.is_silent(now_ns)) for one in self.tracking()]

    def _evict_for_another(self, session: str) -> None:
        self._report("refused", session, f"at most {self._settings.max_sessions} streams at once", "another site's")
        self.command(session, lambda one: one.close_session("evicted"), urgent=True)

    def _lose(self, session: str, lost: list[Packet]) -> None:
        """Count messages that were dropped before their session took them."""
        frames = sum(packet.frame for packet in lost)
        with self._lock:
            self._past += MessageCounters(received=frames, shed=frames, clouds_shed=len(lost) - frames)
        expected = "room for what waits for its session, for two minutes at most"
        self._report("shed", session, expected, f"{len(lost)} more; the oldest were dropped", len(lost))

    def _refuse(self, code: str, packet: Packet, stream: str, expected: str, received: str) -> None:
        with self._lock:
            frame = packet.frame
            self._past += MessageCounters(received=frame, refused=frame, clouds_refused=not frame)
        self._report(code, stream, expected, received)

    def _report(self, code: str, stream: str, expected: str, received: str, count: int = 1, path: str = "key") -> None:
        self.parts.report(code, stream, expected, received, path=path, count=count)

    # The table

    def _all(self) -> list[Stream]:
        with self._lock:
            return list(self._streams.values())

    def _parsed(self, key: str) -> tuple[str, str]:
        stream, fusion = self.parts.keys.stream_of(key), self.parts.fusion
        if fusion.is_session(stream):
            part = "sensor" if stream.endswith(f"/{FUSED}") else "node"
            raise schemas.MessageError("invalid_value", "key", f"a {part} not named {FUSED}, as its tracks", key)
        return stream, fusion.session_of(stream)

    def _backlog(self, session: str, now_ns: int) -> Backlog:
        backlog = self._backlogs[session] = Backlog(session, self._bounds, now_ns)
        return backlog

    def _attach(self, backlog: Backlog) -> Stream:
        stream = self._streams[backlog.session] = Stream(self, backlog)
        self._unproven.add(stream)
        return stream

    def _crowded(self) -> bool:
        """Whether too many streams have not sent a valid message yet, as far as is known; called with the lock."""
        most = MAX_UNPROVEN_STRAINED if self._member.strained else MAX_UNPROVEN
        if len(self._unproven) >= most:
            known = self._streams.get
            self._unproven = {one for one in self._unproven if not one.occupied and known(one.name) is one}
        return len(self._unproven) >= most

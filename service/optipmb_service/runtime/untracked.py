"""What was received of sessions that are not tracked here, or not yet: kept for whoever takes them up.

A session may be another member's, may be on its way to or from one, or may be new and wait for room. Once it is to be
tracked here, what was kept goes first, so all that comes is kept until that has been handed over. Called by the
network, the tracking thread, the intake and the control loop; one lock guards it all.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from optipmb_service.cluster.leases import partition_of

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable

    from optipmb_service.runtime.ports import Packet
    from optipmb_service.runtime.takeover_buffer import TakeoverBuffer

    TakeUp = Callable[[str, list[tuple[Packet, bool]], set[str]], object]

MAX_NEWCOMERS: Final = 16_384
"""Sessions whose first messages wait for room."""

MAX_BUFFERS: Final = 65_536
"""Beyond so many, those that are empty are forgotten at once."""


class UntrackedMessages:
    """The messages of sessions that are not tracked here.

    Args:
        holds: whether a session is to be tracked here.
        buffer: makes what keeps the messages of one session.
        lost: called with a session whose messages were dropped, those received to be tracked here; each True: a frame.
    """

    def __init__(
        self,
        holds: Callable[[str], bool],
        buffer: Callable[[], TakeoverBuffer],
        lost: Callable[[str, list[bool]], None],
    ) -> None:
        self._holds = holds
        self._buffer = buffer
        self._lost = lost
        self._lock = threading.Lock()
        self._buffers: dict[str, TakeoverBuffer] = {}
        self._newcomers: dict[str, None] = {}

    def __contains__(self, session: object) -> bool:
        return session in self._buffers

    def passes(self, session: str) -> bool:
        """Whether a packet of a session is to be tracked here at once: nothing of it is kept that would go first."""
        return session not in self._buffers and self._holds(session)

    # Keeping

    def keep(self, session: str, packet: Packet, *, frame: bool, own: bool = False) -> bool:
        """Keep a packet of a session that is not tracked here; False where it is to be tracked here at once.

        Those that were received to be tracked here (`own`) are kept until somebody asks for them, and are reported when
        they are dropped.
        """
        if self.passes(session):
            return False
        with self._lock:
            if self.passes(session):
                return False
            buffer = self._buffer_of(session, packet.now_ns)
            buffer.unasked |= own
            lost = buffer.add(packet, frame=frame, own=own)
        self._lose(session, lost)
        return True

    def put_off(self, session: str, packet: Packet, *, frame: bool) -> None:
        """Keep a packet of a new session until there is room for it."""
        lost = [frame]
        with self._lock:
            if session not in self._buffers and len(self._newcomers) < MAX_NEWCOMERS:
                self._buffer_of(session, packet.now_ns).unasked = True
                self._newcomers[session] = None
            if session in self._buffers:
                buffer = self._buffer_of(session, packet.now_ns)
                lost = buffer.add(packet, frame=frame, own=True)
                if not buffer and session in self._newcomers:
                    self._forget(session)
        self._lose(session, lost)

    def expect(self, session: str) -> None:
        """Keep what comes of a session that is new to all members until its own has asked for it."""
        with self._lock:
            if session not in self._buffers and not self._holds(session):
                self._buffer_of(session).unasked = True

    def hold(self, session: str) -> None:
        """Keep what comes of a session until it is taken up."""
        with self._lock:
            self._newcomers.pop(session, None)
            self._buffer_of(session)

    def leave(self, session: str, *, asked_for: bool) -> None:
        """Keep what comes of a session from now on that is about to end here, where another member is to have it.

        Args:
            session: its name.
            asked_for: whether that member will ask for it.
        """
        with self._lock:
            if not self._holds(session):
                self._buffer_of(session).unasked |= asked_for

    # Who asks for it

    def of_partitions(self, partitions: Container[int]) -> set[str]:
        """Return the sessions of partitions of which something is kept."""
        with self._lock:
            return {session for session in self._buffers if partition_of(session) in partitions}

    def recent(self, sessions: Iterable[str]) -> list[Packet]:
        """Return what is kept of sessions, the oldest first, for the member that goes on with them."""
        with self._lock:
            buffers = [self._buffers[session] for session in sessions if session in self._buffers]
            kept = [packet for buffer in buffers for packet, _ in buffer.asked()]
        return sorted((packet for packet in kept if packet.payload is not None), key=lambda one: one.now_ns)

    def hand_over(self, session: str, packets: list[tuple[Packet, bool]], take_up: TakeUp) -> None:
        """Hand over what others received of a session, then what was kept here and which caches have answered.

        Without a buffer that has been done before; of a session that has gone again the packets are kept.
        """
        with self._lock:
            self._hand_over(session, packets, take_up)

    @property
    def newcomers(self) -> int:
        """How many sessions wait for room."""
        return len(self._newcomers)

    def hand_over_newcomer(self, take_up: TakeUp) -> None:
        """Hand over the session that has waited longest for room."""
        with self._lock:
            # At once: a session that the intake holds meanwhile it takes up itself, with what others received.
            session = next(iter(self._newcomers), None)
            if session is not None:
                self._hand_over(session, [], take_up)

    # Caches of publishers

    def cache_answered(self, session: str, stream: str) -> bool:
        """Note that all has come which the cache of a stream held; False where nothing is kept of its session."""
        with self._lock:
            buffer = self._buffers.get(session)
            if buffer is not None:
                buffer.answered.add(stream)
        return buffer is not None

    def forget_caches(self, received: set[str]) -> None:
        """Forget which caches have answered, but for streams that are received still: they hold more by now."""
        with self._lock:
            for buffer in self._buffers.values():
                buffer.answered &= received

    def trim(self, now_ns: int, idle_ns: int) -> None:
        """Drop what has been kept for too long, and sessions of which nothing was heard for `idle_ns`."""
        lost: dict[str, list[bool]] = {}
        with self._lock:
            for session, buffer in tuple(self._buffers.items()):
                if dropped := buffer.trim(now_ns):
                    lost[session] = dropped
                if not buffer and (len(self._buffers) > MAX_BUFFERS or now_ns - buffer.seen_ns > idle_ns):
                    self._forget(session)
        for session, dropped in lost.items():
            self._lose(session, dropped)

    # With the lock

    def _hand_over(self, session: str, packets: list[tuple[Packet, bool]], take_up: TakeUp) -> None:
        self._newcomers.pop(session, None)
        if session not in self._buffers and not packets:
            return
        buffer = self._buffer_of(session)
        if not self._holds(session):
            for packet, frame in packets:
                buffer.add(packet, frame=frame)
            return
        known = {(packet.key, packet.payload) for packet, _ in packets}
        packets = packets + [one for one in buffer.take() if (one[0].key, one[0].payload) not in known]
        take_up(session, packets, buffer.answered.copy())
        self._forget(session)  # from now on newer ones are handed over

    def _buffer_of(self, session: str, now_ns: int | None = None) -> TakeoverBuffer:
        buffer = self._buffers.get(session)
        if buffer is None:
            buffer = self._buffers[session] = self._buffer()
        buffer.seen_ns = time.monotonic_ns() if now_ns is None else now_ns
        return buffer

    def _forget(self, session: str) -> None:
        del self._buffers[session]
        self._newcomers.pop(session, None)

    def _lose(self, session: str, lost: list[bool]) -> None:
        if lost:
            self._lost(session, lost)

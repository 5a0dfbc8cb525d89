"""Backlog of a session: its messages that have arrived, or were recovered, and are not processed yet.

A backlog is made for any message on the keys of a session. It is in one of three states:

| state | meaning | an arriving message is | bounded by | next state by |
| --- | --- | --- | --- | --- |
| foreign | tracked elsewhere, on its way here, or no room | held in order | age, bytes of all | `open`, `go_live` |
| opening | a checkpoint is being read or written | held in order | bytes of all | `go_live`, `leave` |
| live | messages are processed as they come | queued, clouds before frames | numbers, bytes | `open`, `leave` |

Foreign messages are given to the member that asks for them (`recent`). While missed packets wait in a live backlog,
arriving ones are held, too.

A stream takes packets that the session has missed first (`recover`), then the held ones, then queued ones. A change of
the state moves all waiting messages; none is copied between waiting places. A dropped message that was to be tracked
here is counted: `shed` of the queues, `BacklogBounds.lost` of held ones.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import structlog

from optipmb_service.units import SECOND
from optipmb_service.zenoh.topics import Packet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    Command = Callable[[], None]

log = structlog.get_logger("optipmb_service")

UNLIMITED: Final = 2**62

UNASKED_NS: Final = 120 * SECOND
"""Age at which messages are dropped that the session's next member has not asked for yet."""


class ByteBudget:
    """A number of bytes that all backlogs share, for any thread.

    Args:
        most: how many there are.
    """

    def __init__(self, most: int = UNLIMITED) -> None:
        self._most = most
        self._lock = threading.Lock()
        self.used = 0

    def add(self, size: int) -> bool:
        """Take bytes, or give back with a negative size; False when more are taken than there are."""
        with self._lock:
            self.used += size
            return self.used <= self._most

    def take(self, size: int) -> bool:
        """Take bytes if there are so many."""
        with self._lock:
            if self.used + size > self._most:
                return False
            self.used += size
            return True


@dataclass(frozen=True)
class BacklogBounds:
    """Limits that all backlogs of a process share.

    Attributes:
        lost: called with a session and dropped packets that were to be tracked here.
        frames: most queued frames of a sender.
        clouds: most queued clouds of a sender.
        bytes: most queued bytes of a sender.
        queued: bytes of all queues.
        held: bytes of all messages that are held or were missed.
        keep_ns: age at which a message is dropped that is held for another member.
    """

    lost: Callable[[str, list[Packet]], None]
    frames: int
    clouds: int
    bytes: int
    queued: ByteBudget
    held: ByteBudget
    keep_ns: int


@dataclass(slots=True)
class Shed:
    """Messages that left the queues unprocessed."""

    frames: int = 0
    clouds: int = 0


@dataclass(slots=True)
class _Queued:
    frames: int = 0
    clouds: int = 0
    bytes: int = 0


class Backlog:
    """Waiting messages and commands of one session, for any thread.

    Args:
        session: its name.
        bounds: limits.
        now_ns: monotonic time.
    """

    def __init__(self, session: str, bounds: BacklogBounds, now_ns: int) -> None:
        self.session = session
        self.state: Literal["foreign", "opening", "live"] = "foreign"
        self.unasked = False
        """Whether the member that is to track the session has yet to ask for the held messages."""
        self.answered: set[str] = set()
        """Streams whose publishers' caches have been received completely, with messages that are held still."""
        self.closed = False
        """Whether its stream has ended, or it is forgotten: what arrives needs another one."""
        self.seen_ns = now_ns
        """Monotonic time of the newest message."""
        self.shed = Shed()
        self._bounds = bounds
        self._lock = threading.Lock()
        self._held: deque[tuple[Packet, bool]] = deque()
        """Packets in order of arrival, each with whether it was received to be tracked here."""
        self._schedule: Callable[[], None] | None = None
        self._answered: Callable[..., None] = _nowhere
        self._scheduled = self._rung = False

    def attach(self, schedule: Callable[[], None], answered: Callable[..., None]) -> None:
        """Let a stream take from the backlog.

        Args:
            schedule: has its turn come.
            answered: is a command of it, with the streams of which all has been taken that their caches held.
        """
        with self._lock:
            self._schedule, self._answered = schedule, answered
            self.closed, self._scheduled, self._rung = False, False, False
            self.shed = Shed()
            self._shed_of: dict[str, int] = {}
            self._missed: deque[Packet] = deque()
            self._clouds: deque[Packet] = deque()
            self._frames: deque[Packet | Command] = deque()
            self._urgent: deque[Command] = deque()
            self._senders: dict[str, _Queued] = {}

    def detach(self) -> bool:
        """End with a stream that has nothing left to do; False: messages are held for another member."""
        with self._lock:
            if self._held:
                self.state = "foreign"
            self._schedule, self._answered = None, _nowhere
            self.closed = self.state != "foreign"
            return self.closed

    def close_empty(self) -> bool:
        """Close a foreign backlog that has neither messages nor a stream; False when it has."""
        with self._lock:
            self.closed = self.state == "foreign" and self._schedule is None and not self._held
            return self.closed

    # Arrivals, on any thread

    def push(self, packet: Packet, *, own: bool = True) -> bool:
        """Add a packet; False when the backlog is closed.

        Args:
            packet: what arrived.
            own: whether it was received to be tracked here: it is kept until it was asked for, and counted when lost.
        """
        lost: list[Packet] = []
        with self._lock:
            if self.closed:
                return False
            if self.state == "live" and not self._missed:
                self._queue(packet)
                wakes = self._wakes()
            else:
                self.unasked |= own and self.state == "foreign"
                self._hold(packet, lost, own=own)
                wakes = False
        if wakes and self._schedule is not None:
            self._schedule()
        self._lose(lost)
        return True

    def recover(self, packets: Sequence[Packet]) -> None:
        """Put packets that the session has missed before all that waits, the newest of them as far as there is room."""
        kept, budget = deque[Packet](), self._bounds.held
        for packet in packets:
            kept.append(packet)
            fits = budget.add(packet.held)
            while not fits and kept:
                fits = budget.add(-_oldest(kept).held)
        with self._lock:
            if refused := self.closed or self.state == "foreign":
                budget.add(-sum(one.held for one in kept))
            else:
                self._missed.extend(kept)
            wakes = not refused and self._wakes()
        if wakes and self._schedule is not None:
            self._schedule()
        if len(kept) < len(packets):
            log.warning("message_log_cut", stream=self.session, frames=len(packets), kept=len(kept))

    def command(self, command: Command, *, urgent: bool) -> bool:
        """Add a command before everything, or after the frames that wait; False when the backlog has no stream."""
        with self._lock:
            if self.closed or self._schedule is None:
                return False
            (self._urgent if urgent else self._frames).append(command)
            wakes = self._wakes()
        if wakes:
            self._schedule()
        return True

    def wake(self) -> None:
        """Ask for a turn though nothing came."""
        with self._lock:
            self._rung = True
            wakes = not self.closed and self._schedule is not None and self._wakes()
        if wakes and self._schedule is not None:
            self._schedule()

    def cache_answered(self, stream: str) -> None:
        """Note that a publisher's cache was received completely: `answered` follows its messages."""
        with self._lock:
            waits = self.state != "live" or bool(self._missed or self._held)
            if waits:
                self.answered.add(stream)
        if not waits:
            self.command(partial(self._answered, stream), urgent=False)

    # States

    def open(self, first: Packet | None = None) -> None:
        """Hold all that waits, and what arrives, while a checkpoint is read or written; `first` goes before it."""
        lost: list[Packet] = []
        with self._lock:
            self.state = "opening"
            missed, queued = self._missed, self._unqueued()
            self._missed = deque()
            self._held.extendleft((one, False) for one in reversed(missed))
            if first is not None:
                self._bounds.held.add(first.held)
                self._held.appendleft((first, True))
            for packet in queued:
                self._hold(packet, lost, own=True)
        self._lose(lost)

    def go_live(self) -> None:
        """Process messages from now on."""
        with self._lock:
            self.state = "live"
            self.unasked = False

    def leave(self, *, asked_for: bool = False) -> None:
        """Hold all that waits, and what arrives, for another member.

        Args:
            asked_for: whether that member will ask for it.
        """
        lost: list[Packet] = []
        with self._lock:
            if self.state != "foreign":
                self.state = "foreign"
                self._forget_missed()
                for packet in self._unqueued():
                    self._hold(packet, lost, own=True)
                asked_for = asked_for or any(own for _, own in self._held)
            self.unasked |= asked_for
        self._lose(lost)

    def bring(self, packets: Iterable[Packet]) -> list[Packet]:
        """Put messages that other members received before the held ones; none is held twice.

        Returns:
            Messages that were dropped because there is no room, for the caller to count.
        """
        lost: list[Packet] = []
        with self._lock:
            held = [(packet, True) for packet in packets]
            known = {(packet.key, packet.payload) for packet, _ in held}
            given = sum(packet.held for packet, _ in held)
            for packet, own in self._held:
                if (packet.key, packet.payload) in known:
                    given -= packet.held
                else:
                    held.append((packet, own))
            self._held = deque(held)
            self._make_room(lost, fits=self._bounds.held.add(given))
        return lost

    def forget_missed(self) -> None:
        """Drop packets that were missed: they are in the log still."""
        with self._lock:
            self._forget_missed()

    # What other members ask for

    def recent(self) -> list[Packet]:
        """Return the messages held for the session's next member; they no longer count as lost when dropped."""
        with self._lock:
            self.unasked = False
            self._held = deque((packet, False) for packet, _ in self._held)
            return [packet for packet, _ in self._held if packet.payload is not None]

    def trim(self, now_ns: int) -> bool:
        """Drop messages held for another member for too long; return whether none is left."""
        lost: list[Packet] = []
        with self._lock:
            if self.state != "foreign":
                return False
            keep_ns = max(self._bounds.keep_ns, UNASKED_NS) if self.unasked else self._bounds.keep_ns
            while self._held and now_ns - self._held[0][0].now_ns > keep_ns:
                self._drop_held(0, lost)
            if lost:  # no member asked in time; messages from others are kept as long as usual
                self.unasked = any(own for _, own in self._held)
            empty = not self._held and self._schedule is None
        self._lose(lost)
        return empty

    # Taking, on the tracking thread

    def take(self, *, urgent: bool = False) -> Packet | Command | None:
        """Take the next item, None when there is none; with `urgent` only commands that go before everything."""
        with self._lock:
            self._rung = False
            if self._urgent:
                return self._urgent.popleft()
            if urgent or self.state == "opening":
                return None
            if self.state == "live":
                if self._missed or self._held:
                    packet = self._missed.popleft() if self._missed else self._held.popleft()[0]
                    self._bounds.held.add(-packet.held)
                    return packet
                if self.answered:
                    answered, self.answered = self.answered, set()
                    return partial(self._answered, *answered)
                if self._clouds:
                    return self._unqueue(self._clouds.popleft())
            item = self._frames.popleft() if self._frames else None
            return self._unqueue(item) if isinstance(item, Packet) else item

    @property
    def empty(self) -> bool:
        """Whether nothing can be taken, or soon."""
        return not (self._frames or self._clouds or self._urgent or self._held or self._missed or self.answered)

    @property
    def clouds_waiting(self) -> bool:
        return bool(self._clouds)

    @property
    def idle(self) -> bool:
        """Whether its stream is neither scheduled nor at work."""
        return not self._scheduled

    def end_turn(self, *, close: bool, urgent: bool = False) -> bool | None:
        """End the stream's turn: True: it needs another, None: the backlog is closed, as asked, for nothing waits.

        With `urgent`, only commands that go before everything count: the stream waits until it is scheduled.
        """
        with self._lock:
            if self._urgent or self._rung or (not urgent and self._ready()):
                return True
            self._scheduled = False
            self.closed = close and not self._ready() and not self._frames
            return None if self.closed else False

    def counts(self) -> tuple[int, int, int]:
        """Return the frames that wait, and the frames and clouds shed, of one moment."""
        with self._lock:
            waiting = sum(one.frames for one in self._senders.values())
            if self._held:
                waiting += sum(packet.frame for packet, _ in self._held)
            return waiting, self.shed.frames, self.shed.clouds

    def shed_since(self) -> dict[str, int]:
        """Return the queued frames shed since this was asked last, by `Packet.origin`."""
        if not self._shed_of:
            return {}
        with self._lock:
            shed, self._shed_of = self._shed_of, {}
        return shed

    # With the lock

    def _ready(self) -> bool:
        if self.state == "live":
            return bool(self._frames or self._clouds or self._held or self._missed or self.answered)
        return self.state == "foreign" and bool(self._frames)

    def _wakes(self) -> bool:
        first, self._scheduled = not self._scheduled, True
        return first

    def _hold(self, packet: Packet, lost: list[Packet], *, own: bool) -> None:
        self._held.append((packet, own))
        self.seen_ns = packet.now_ns
        self._make_room(lost, fits=self._bounds.held.add(packet.held))

    def _make_room(self, lost: list[Packet], *, fits: bool) -> None:
        """Drop held packets until all fit: the oldest clouds of the session go first, then its oldest frames."""
        while not fits and self._held:
            cloud = next((index for index, (one, _) in enumerate(self._held) if not one.frame), 0)
            fits = self._drop_held(cloud, lost)

    def _drop_held(self, index: int, lost: list[Packet]) -> bool:
        packet, own = self._held[index]
        del self._held[index]
        if own:
            lost.append(packet)
        return self._bounds.held.add(-packet.held)

    def _lose(self, lost: list[Packet]) -> None:
        if lost:
            self._bounds.lost(self.session, lost)

    def _forget_missed(self) -> None:
        self._bounds.held.add(-sum(one.held for one in self._missed))
        self._missed.clear()

    def _queue(self, packet: Packet) -> None:
        """Queue a packet; the oldest of its sender make room for it."""
        origin, held, bounds = packet.origin, packet.held, self._bounds
        sender = self._senders.get(origin) or _Queued()
        if packet.frame and sender.frames >= bounds.frames:
            self._shed_frame(origin)
        elif not packet.frame and sender.clouds >= bounds.clouds:
            self._shed_cloud(origin)
        while sender.bytes + held > bounds.bytes or not bounds.queued.take(held):
            if not (self._shed_cloud(origin) or self._shed_frame(origin)):
                self._count_shed(packet)
                return
        self._senders[origin] = sender
        sender.bytes += held
        if packet.frame:
            self._frames.append(packet)
            sender.frames += 1
        else:
            self._clouds.append(packet)
            sender.clouds += 1

    def _unqueue(self, packet: Packet) -> Packet:
        """Count a packet that leaves the queues; senders without any are forgotten, for their names are arbitrary."""
        origin, held = packet.origin, packet.held
        sender = self._senders[origin]
        self._bounds.queued.add(-held)
        sender.bytes -= held
        if packet.frame:
            sender.frames -= 1
        else:
            sender.clouds -= 1
        if not (sender.frames or sender.clouds):
            del self._senders[origin]
        return packet

    def _unqueued(self) -> list[Packet]:
        """Empty the queues but for commands; return the packets in the order in which they would be taken."""
        frames = [one for one in self._frames if isinstance(one, Packet)]
        packets = [self._unqueue(one) for one in (*self._clouds, *frames)]
        self._clouds.clear()
        self._frames = deque(one for one in self._frames if not isinstance(one, Packet))
        return packets

    def _shed_cloud(self, origin: str) -> bool:
        for index, packet in enumerate(self._clouds):
            if packet.origin == origin:
                del self._clouds[index]
                self._count_shed(self._unqueue(packet))
                return True
        return False

    def _shed_frame(self, origin: str) -> bool:
        for index, item in enumerate(self._frames):
            if isinstance(item, Packet) and item.origin == origin:
                del self._frames[index]
                self._count_shed(self._unqueue(item))
                return True
        return False

    def _count_shed(self, packet: Packet) -> None:
        if packet.frame:
            self.shed.frames += 1
            self._shed_of[packet.origin] = self._shed_of.get(packet.origin, 0) + 1
        else:
            self.shed.clouds += 1


def _nowhere(*_: str) -> None:
    """Take the answers of caches while there is no stream."""


def _oldest(packets: deque[Packet]) -> Packet:
    """Take the oldest cloud of these, or the oldest frame."""
    index = next((index for index, one in enumerate(packets) if not one.frame), 0)
    packet = packets[index]
    del packets[index]
    return packet

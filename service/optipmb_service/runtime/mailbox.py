"""The bounded mailbox of a session.

Readers put in, the tracking thread takes out. What is not urgent keeps its order. Point clouds go before frames, so
that no frame goes on without a cloud that has long arrived; when too many of a stream wait, or too many bytes, its
oldest is shed and counted. Where several streams feed the session, none takes the room of another.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from optipmb_service.runtime.byte_budget import ByteBudget
from optipmb_service.runtime.ports import Packet

if TYPE_CHECKING:
    from collections.abc import Callable

    Command = Callable[[], None]


UNLIMITED: Final = 2**62


@dataclass(slots=True)
class _Waiting:
    """What waits of a stream."""

    frames: int = 0
    clouds: int = 0
    bytes: int = 0


class Mailbox:
    """What waits for a session.

    Args:
        frames: most frames of a stream waiting.
        clouds: most point clouds of a stream waiting.
        most_bytes: most bytes of messages of a stream waiting.
        budget: bytes that wait in the mailboxes of all sessions.
    """

    def __init__(self, frames: int, clouds: int, most_bytes: int = UNLIMITED, budget: ByteBudget | None = None) -> None:
        self._most_bytes = most_bytes
        self._budget = budget or ByteBudget(UNLIMITED)
        self._of: dict[str, _Waiting] = {}
        self._lock = threading.Lock()
        self._urgent: deque[Command] = deque()
        self._clouds: deque[Packet] = deque()
        self._frames: deque[Packet | Command] = deque()
        self._most_frames = frames
        self._most_clouds = clouds
        self._shed_of: dict[str, int] = {}
        self._scheduled = False
        self._rung = False
        self._closed = False
        self.shed_frames = 0
        self.shed_clouds = 0

    @property
    def idle(self) -> bool:
        """Whether its actor is neither scheduled nor at work."""
        return not self._scheduled

    def shed_since(self) -> dict[str, int]:
        """Return the frames shed since this was asked last, by `Packet.origin`."""
        with self._lock:
            shed, self._shed_of = self._shed_of, {}
        return shed

    def counts(self) -> tuple[int, int, int]:
        """Return the frames shed so far, those that wait, and the clouds shed so far, of one moment."""
        with self._lock:
            return self.shed_frames, self._waiting_frames(), self.shed_clouds

    def offer_frame(self, packet: Packet) -> bool | None:
        """Put a frame last; True: the actor must be scheduled, None: closed."""
        with self._lock:
            if self._closed:
                return None
            origin = packet.origin
            waiting = self._of.get(origin) or _Waiting()
            if waiting.frames >= self._most_frames:
                self._shed_frame(origin)
            if self._fits(packet, origin, waiting):
                self._frames.append(packet)
                waiting.frames += 1
            else:
                self._count_shed(origin)
            return self._schedule()

    def offer_cloud(self, packet: Packet) -> bool | None:
        """Put a cloud last of the clouds; True: the actor must be scheduled, None: closed."""
        with self._lock:
            if self._closed:
                return None
            origin = packet.origin
            waiting = self._of.get(origin) or _Waiting()
            if waiting.clouds >= self._most_clouds:
                self._shed_cloud(origin)
            if self._fits(packet, origin, waiting):
                self._clouds.append(packet)
                waiting.clouds += 1
            else:
                self.shed_clouds += 1
            return self._schedule()

    def offer_command(self, command: Command, *, urgent: bool) -> bool | None:
        """Put a command before everything, or after the frames that wait.

        True: the actor must be scheduled, None: closed.
        """
        with self._lock:
            if self._closed:
                return None
            (self._urgent if urgent else self._frames).append(command)
            return self._schedule()

    def ring(self) -> bool | None:
        """Ask for a turn though nothing came; True: the actor must be scheduled, None: closed."""
        with self._lock:
            if self._closed:
                return None
            self._rung = True
            return self._schedule()

    def take(self, *, urgent: bool = False) -> tuple[str, Packet | Command] | None:
        """Take what is next, with its kind: "command", "cloud" or "frame"; None when nothing waits.

        With `urgent`, only commands that go before everything.
        """
        with self._lock:
            self._rung = False
            if self._urgent:
                return "command", self._urgent.popleft()
            if urgent:
                return None
            if self._clouds:
                return "cloud", self._taken(self._clouds.popleft(), clouds=1)
            if not self._frames:
                return None
            item = self._frames.popleft()
            if not isinstance(item, Packet):
                return "command", item
            return "frame", self._taken(item, frames=1)

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not (self._frames or self._clouds or self._urgent)

    @property
    def clouds_waiting(self) -> int:
        """Clouds that wait."""
        return len(self._clouds)

    def leave(self, *, close: bool, urgent: bool = False) -> bool | None:
        """End the actor's turn: True: it needs another, None: the mailbox was empty and is closed now, as asked.

        With `urgent`, what waits but is not urgent does not count: the actor waits until it is scheduled.
        """
        with self._lock:
            if self._urgent or self._rung or (not urgent and (self._clouds or self._frames)):
                return True
            close = close and not (self._clouds or self._frames)
            self._scheduled = False
            self._closed = close
            return None if close else False

    def _schedule(self) -> bool:
        first, self._scheduled = not self._scheduled, True
        return first

    def _waiting_frames(self) -> int:
        return sum(one.frames for one in self._of.values())

    def _fits(self, packet: Packet, origin: str, waiting: _Waiting) -> bool:
        """Make room for a message, by what its stream sent before; False when there is none even so."""
        held = packet.held
        while waiting.bytes + held > self._most_bytes or not self._budget.take(held):
            if not (self._shed_cloud(origin) or self._shed_frame(origin)):
                return False
        waiting.bytes += held
        self._of[origin] = waiting
        return True

    def _taken(self, packet: Packet, *, frames: int = 0, clouds: int = 0) -> Packet:
        """Count a message that leaves; what counts nothing is forgotten, for names of streams are anybody's choice."""
        origin, held = packet.origin, packet.held
        waiting = self._of[origin]
        self._budget.add(-held)
        waiting.frames -= frames
        waiting.clouds -= clouds
        waiting.bytes -= held
        if not (waiting.frames or waiting.clouds):
            del self._of[origin]
        return packet

    def _shed_cloud(self, origin: str) -> bool:
        """Drop the oldest cloud of a stream; False when there is none."""
        for index, packet in enumerate(self._clouds):
            if packet.origin == origin:
                del self._clouds[index]
                self._taken(packet, clouds=1)
                self.shed_clouds += 1
                return True
        return False

    def _shed_frame(self, origin: str) -> bool:
        """Drop the oldest frame of a stream; commands between the frames stay. False when there is none."""
        for index, item in enumerate(self._frames):
            if isinstance(item, Packet) and item.origin == origin:
                del self._frames[index]
                self._taken(item, frames=1)
                self._count_shed(origin)
                return True
        return False

    def _count_shed(self, origin: str) -> None:
        self.shed_frames += 1
        self._shed_of[origin] = self._shed_of.get(origin, 0) + 1

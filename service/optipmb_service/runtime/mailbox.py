"""A stream's bounded mailbox.

Readers put in, one worker thread takes out. What is not urgent keeps its order. Point clouds go before frames, so that
no frame goes on without a cloud that has long arrived; when too many wait, or too many bytes, the oldest is shed and
counted.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from optipmb_service.runtime.byte_budget import ByteBudget
from optipmb_service.runtime.ports import Packet

if TYPE_CHECKING:
    from collections.abc import Callable

    Command = Callable[[], None]


UNLIMITED: Final = 2**62


class Mailbox:
    """What waits for a stream's worker.

    Args:
        frames: most frames waiting.
        clouds: most point clouds waiting.
        most_bytes: most bytes of messages waiting.
        budget: bytes that wait in the mailboxes of all streams.
    """

    def __init__(self, frames: int, clouds: int, most_bytes: int = UNLIMITED, budget: ByteBudget | None = None) -> None:
        self._most_bytes = most_bytes
        self._budget = budget or ByteBudget(UNLIMITED)
        self._bytes = 0
        self._lock = threading.Lock()
        self._urgent: deque[Command] = deque()
        self._clouds: deque[Packet] = deque()
        self._frames: deque[Packet | Command] = deque()
        self._most_frames = frames
        self._most_clouds = clouds
        self._waiting = 0
        self._scheduled = False
        self._rung = False
        self._closed = False
        self.shed_frames = 0
        self.shed_clouds = 0

    @property
    def idle(self) -> bool:
        """Whether no worker is needed or at work."""
        return not self._scheduled

    @property
    def waiting(self) -> int:
        """Frames that wait."""
        return self._waiting

    def counts(self) -> tuple[int, int, int]:
        """Return the frames shed so far, those that wait, and the clouds shed so far, of one moment."""
        with self._lock:
            return self.shed_frames, self._waiting, self.shed_clouds

    def offer_frame(self, packet: Packet) -> bool | None:
        """Put a frame last; True: a worker must be sent, None: closed."""
        with self._lock:
            if self._closed:
                return None
            if self._waiting >= self._most_frames:
                self._shed_frame()
            if self._fits(packet):
                self._frames.append(packet)
                self._waiting += 1
            else:
                self.shed_frames += 1
            return self._schedule()

    def offer_cloud(self, packet: Packet) -> bool | None:
        """Put a cloud last of the clouds; True: a worker must be sent, None: closed."""
        with self._lock:
            if self._closed:
                return None
            if len(self._clouds) >= self._most_clouds:
                self._shed_cloud()
            if self._fits(packet):
                self._clouds.append(packet)
            else:
                self.shed_clouds += 1
            return self._schedule()

    def offer_command(self, command: Command, *, urgent: bool) -> bool | None:
        """Put a command before everything, or after the frames that wait; True: a worker must be sent, None: closed."""
        with self._lock:
            if self._closed:
                return None
            (self._urgent if urgent else self._frames).append(command)
            return self._schedule()

    def ring(self) -> bool | None:
        """Call for a worker though nothing came; True: it must be sent, None: closed."""
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
                return "cloud", self._taken(self._clouds.popleft())
            if not self._frames:
                return None
            item = self._frames.popleft()
            if not isinstance(item, Packet):
                return "command", item
            self._waiting -= 1
            return "frame", self._taken(item)

    @property
    def clouds_waiting(self) -> int:
        """Clouds that wait."""
        return len(self._clouds)

    def leave(self, *, close: bool, urgent: bool = False) -> bool | None:
        """End a worker's turn: True: it must come again, None: the mailbox was empty and is closed now, as asked.

        With `urgent`, what waits but is not urgent does not count: the worker is to come when it is sent for.
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

    def _fits(self, packet: Packet) -> bool:
        """Make room for a message, by what is older; False when there is none even so, and it is not to be kept."""
        while self._bytes + packet.held > self._most_bytes or not self._budget.take(packet.held):
            if not (self._shed_cloud() or self._shed_frame()):
                return False
        self._bytes += packet.held
        return True

    def _taken(self, packet: Packet) -> Packet:
        self._bytes -= packet.held
        self._budget.add(-packet.held)
        return packet

    def _shed_cloud(self) -> bool:
        """Drop the oldest cloud; False when there is none."""
        if not self._clouds:
            return False
        self._taken(self._clouds.popleft())
        self.shed_clouds += 1
        return True

    def _shed_frame(self) -> bool:
        """Drop the oldest frame; commands between the frames stay. False when there is none."""
        for index, item in enumerate(self._frames):
            if isinstance(item, Packet):
                del self._frames[index]
                self._taken(item)
                self._waiting -= 1
                self.shed_frames += 1
                return True
        return False

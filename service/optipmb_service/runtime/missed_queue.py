"""What a session takes before all that waits: packets that it has missed, from the log or the caches of publishers.

They are taken some at a time, so that other streams have their turn. What comes meanwhile waits for all of them.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.runtime.ports import Packet
    from optipmb_service.runtime.takeover_buffer import TakeoverBuffer

log = structlog.get_logger("optipmb_service")


class MissedQueue:
    """The packets that one session has missed and not taken yet; for the tracking thread alone.

    Args:
        stream: the name of the session.
        buffer: makes buffers for packets.
    """

    def __init__(self, stream: str, buffer: Callable[[], TakeoverBuffer]) -> None:
        self._stream = stream
        self._buffer = buffer
        self.buffers: deque[TakeoverBuffer] = deque()
        """What is to be taken, none of them empty; looked at for every message."""

    def bounded(self, packets: Sequence[tuple[Packet, bool]]) -> TakeoverBuffer:
        """Return packets, each with whether it is a frame, as far as they may wait; may be called by any thread."""
        missed = self._buffer()
        for packet, frame in packets:
            missed.add(packet, frame=frame)
        if len(missed) < len(packets):
            log.warning("log_cut", stream=self._stream, frames=len(packets), kept=len(missed))
        return missed

    def take(self, accept: Callable[..., None], *, most: int, turn_ns: int) -> None:
        """Give the session some of what it missed.

        Args:
            accept: called as `accept(packet, frame=...)`.
            most: packets that are taken at most.
            turn_ns: for how long.
        """
        ends_ns = time.monotonic_ns() + turn_ns
        for _ in range(most):
            if not self.buffers or time.monotonic_ns() >= ends_ns:
                break
            packet, frame = self.buffers[0].pop()
            if not self.buffers[0]:
                self.buffers.popleft()
            accept(packet, frame=frame)

    def drop(self) -> None:
        """Drop what was not taken: who goes on with the stream reads it in the log."""
        while self.buffers:
            self.buffers.popleft().take()

"""Which streams a worker process tracks: a share of all streams that every worker computes for itself.

Rendezvous hashing: of all workers the one whose hash with the stream's name is the highest tracks the stream. It needs
no table and no talk between workers, it is the same in every process and after every restart, and with one worker more,
only the streams that it takes over change hands. Streams that an operator has moved stand in a table that the parent
keeps and every worker is told of.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


def worker_of(stream: str, count: int) -> int:
    """Return which of `count` workers tracks a stream that nobody has moved."""
    if count == 1:
        return 0
    return max(range(count), key=lambda index: blake2b(f"{stream} {index}".encode(), digest_size=8).digest())


class Assignment:
    """The streams of one worker.

    Args:
        index: which worker, from 0.
        count: how many there are.
        moved: streams that an operator has moved, and to which worker.
    """

    def __init__(self, index: int = 0, count: int = 1, moved: Mapping[str, int] | None = None) -> None:
        self.index = index
        self.count = count
        self._moved = dict(moved or {})
        self._known: dict[str, bool] = {}

    def has(self, stream: str) -> bool:
        """Whether this worker tracks a stream; may be called by any thread."""
        if self.count == 1:
            return True
        known = self._known  # of one moment: an answer from before a move goes into the table that the move threw away
        answer = known.get(stream)
        if answer is None:
            answer = self._moved.get(stream, worker_of(stream, self.count)) == self.index
            if len(known) >= MAX_KNOWN:
                known.clear()
            known[stream] = answer
        return answer

    def move(self, stream: str, index: int) -> None:
        """Give a stream to a worker, whichever had it."""
        self._moved[stream] = index
        self._known = {}


MAX_KNOWN = 65_536
"""Streams whose worker is remembered."""

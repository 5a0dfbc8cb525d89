"""What waits for the reader of a call: bounded; the newest wins, and how many were left out is said."""

from __future__ import annotations

import asyncio
import collections
from typing import Final

BYTES: Final = 32 * 2**20
"""Bytes that wait at most for one reader."""

_SKIPPED: Final = b"\x18"
"""Tag of field 3, `skipped`, of all responses of streams: protobuf merges messages that stand one after the other."""


class Outbox:
    """Encoded responses on their way to one reader; all of it happens on the loop.

    Streams take turns, so that one of them cannot hide the others.

    Args:
        per_stream: responses of one stream that may wait.
    """

    def __init__(self, per_stream: int) -> None:
        self._per_stream = per_stream
        self._waiting: dict[str, collections.deque[bytes]] = {}
        self._bytes = 0
        self._skipped = 0
        self._came = asyncio.Event()
        self._closed = False
        self.left_out = 0
        """Responses left out since the beginning."""

    def put(self, stream: str, response: bytes) -> None:
        """Add a response."""
        queue = self._waiting.setdefault(stream, collections.deque())
        queue.append(response)
        self._bytes += len(response)
        while len(queue) > self._per_stream or (self._bytes > BYTES and len(queue) > 1):
            self._bytes -= len(queue.popleft())
            self._skipped += 1
            self.left_out += 1
        self._came.set()

    def replace(self, response: bytes) -> None:
        """Add a response that stands for those of its kind before it, which need not be sent."""
        queue = self._waiting.setdefault("", collections.deque())
        self._bytes += len(response) - sum(map(len, queue))
        queue.clear()
        queue.append(response)
        self._came.set()

    def close(self) -> None:
        """Say that nothing follows."""
        self._closed = True
        self._came.set()

    async def take(self) -> bytes | None:
        """Return the next response, waiting for it; None when there is none and nothing follows."""
        while not self._waiting:
            if self._closed:
                return None
            self._came.clear()
            await self._came.wait()
        stream, queue = next(iter(self._waiting.items()))
        response = queue.popleft()
        self._bytes -= len(response)
        del self._waiting[stream]
        if queue:
            self._waiting[stream] = queue  # behind the others
        if self._skipped:
            response += _SKIPPED + varint(self._skipped)
            self._skipped = 0
        return response


def varint(number: int) -> bytes:
    """Return a number as protobuf writes it."""
    parts = bytearray()
    while number > 0x7F:  # noqa: PLR2004 - seven bits in each byte
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    parts.append(number)
    return bytes(parts)

"""Bounded queues of readers, in which streams take turns, and bounds on their rates."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import threading
from typing import Final, Generic, TypeVar

import optipmb_schemas as schemas
from optipmb_client.merging import remember

BYTES: Final = 32 * 2**20
"""Most bytes in the queue of a reader, beyond one message of each stream."""

TOLERANCE: Final = 0.999
"""Shortest accepted part of a period: stamps of real sensors jitter."""

PREDICTED_TOLERANCE: Final = 0.95
"""The same for predicted states: the time of an output jitters by milliseconds."""

REMEMBERED: Final = 64

T = TypeVar("T")


class Outbox(Generic[T]):
    """Bounded queue of one reader; the oldest items are dropped. Create and read it on the reader's loop.

    Streams take turns, so a fast one does not displace the others.

    Args:
        per_stream: items of one stream that may wait.
    """

    def __init__(self, per_stream: int = 1) -> None:
        self._per_stream = per_stream
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._waiting: dict[str, collections.deque[tuple[T, int]]] = {}
        self._bytes = 0
        self._skipped = 0
        self._changed = asyncio.Event()
        self._closed = False
        self.left_out = 0
        """Items left out since the beginning."""

    def put(self, stream: str, item: T, size: int, most: int = 0) -> int:
        """Add an item on any thread, and return how many of its stream were left out for it; `most` may wait."""
        with self._lock:
            was_empty = not self._waiting
            queue = self._waiting.setdefault(stream, collections.deque())
            queue.append((item, size))
            self._bytes += size
            left_out = 0
            while len(queue) > (most or self._per_stream) or (self._bytes > BYTES and len(queue) > 1):
                self._bytes -= queue.popleft()[1]
                left_out += 1
            self._skipped += left_out
            self.left_out += left_out
        if was_empty:
            self._wake()
        return left_out

    def replace(self, item: T, size: int) -> None:
        """Add an item that replaces the waiting one of its kind."""
        with self._lock:
            self._bytes += size - sum(before for _, before in self._waiting.get("", ()))
            self._waiting[""] = collections.deque([(item, size)])
        self._wake()

    def close(self) -> None:
        """Mark the queue as complete."""
        self._closed = True
        self._wake()

    async def take(self, seconds: float | None = None) -> tuple[T, int] | None:
        """Return the next item, and how many were left out before it; None when there is none and nothing follows.

        Raises:
            TimeoutError: none has come in so long.
        """
        while (taken := self.take_now()) is None:
            if not await self.wait(seconds):
                return None
        return taken

    async def wait(self, seconds: float | None = None) -> bool:
        """Wait for an item; False when nothing follows.

        Raises:
            TimeoutError: none has come in so long.
        """
        while True:
            with self._lock:
                if self._waiting or self._closed:
                    return bool(self._waiting)
                self._changed.clear()
            async with asyncio.timeout(seconds):  # `wait_for` of Python 3.11 loses a cancellation as an item comes
                await self._changed.wait()

    def take_now(self) -> tuple[T, int] | None:
        """Return the next item, and how many were left out before it; None when none waits."""
        with self._lock:
            if not self._waiting:
                return None
            stream, queue = next(iter(self._waiting.items()))
            item, size = queue.popleft()
            self._bytes -= size
            del self._waiting[stream]
            if queue:
                self._waiting[stream] = queue  # behind the others
            skipped, self._skipped = self._skipped, 0
            return item, skipped

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._changed.set)


class Pace:
    """Leaves out frames that come sooner than a period after the one before, in sensor time, in each stream.

    Corrections of accepted frames pass, too.

    Args:
        max_rate_hz: highest rate; 0: all frames.
        predict: whether the stamps are times of predicted states, which nothing corrects.

    Raises:
        MessageError: it is no rate.
    """

    def __init__(self, max_rate_hz: float, *, predict: bool = False) -> None:
        if not 0 <= max_rate_hz < float("inf"):
            raise schemas.MessageError("invalid_value", "max_rate_hz", "a rate in Hz, or 0", f"{max_rate_hz:g}")
        tolerance = PREDICTED_TOLERANCE if predict else TOLERANCE
        self._period_ns = tolerance * 1e9 / max_rate_hz if max_rate_hz else 0.0
        self._predict = predict
        self._passed: collections.OrderedDict[str, collections.deque[int]] = collections.OrderedDict()

    def passes(self, stream: str, stamp_ns: int) -> bool:
        """Tell whether the tracks of a frame are sent."""
        if not self._period_ns:
            return True
        passed = remember(self._passed, stream, self._passed.get(stream) or collections.deque(maxlen=REMEMBERED))
        if stamp_ns in passed:
            return not self._predict
        if passed and abs(stamp_ns - passed[-1]) < self._period_ns:
            return False
        passed.append(stamp_ns)
        return True

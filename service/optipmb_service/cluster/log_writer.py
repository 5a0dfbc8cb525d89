"""Puts messages into the log, in order, and holds them while the servers are away, within bounds."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

import structlog
from nats.errors import Error as NatsError

from optipmb_service.cluster.message_log import NotKeptError
from optipmb_service.cluster.nats_connection import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from optipmb_service.cluster.message_log import LogMessage, MessageLog, Retention, Topic

log = structlog.get_logger("optipmb_service")

AT_ONCE: Final = 256
"""Messages on their way to the servers at once."""

HELD_BYTES: Final = 2**28
"""Bytes that are held at most; the oldest messages go first."""

OVERHEAD: Final = 512
"""What a message takes beside its payload, nearly."""

RETRY_S: Final = 0.5
"""Between two tries."""

TRIES: Final = 5
"""How often a message is tried alone that is not written by servers that work."""


class LogWriter:
    """The writer of one process.

    Args:
        log: where messages go; closed by the caller, after this.
        keep: what is kept of which topics.
        lost: called, on any thread, with the stream of a message that is not in the log, and why.
        held_bytes: bytes that are held at most.
    """

    def __init__(
        self,
        log: MessageLog,
        keep: Mapping[Topic, Retention],
        lost: Callable[[str, str], None],
        held_bytes: int = HELD_BYTES,
    ) -> None:
        self._log = log
        self._connection = log.connection
        self._keep = keep
        self._lost = lost
        self._most = held_bytes
        self._lock = threading.Lock()
        self._waiting: deque[LogMessage] = deque()
        self._came = asyncio.Event()
        self.held_bytes = 0
        """Bytes that wait, nearly."""
        self._at_once = AT_ONCE
        self._tries = 0
        self._tried: LogMessage | None = None
        self._failure = "the log was not reached yet"
        self.written = 0
        """Messages that are in the log by this writer."""
        self.repeated = 0
        """Messages that were in the log already."""
        self.dropped = 0
        """Messages that are not in the log."""
        self._running = self._connection.start(self._run())

    @property
    def failure(self) -> str:
        """Why nothing can be written at present; empty while it can."""
        return self._connection.failure or self._failure

    def put(self, message: LogMessage) -> None:
        """Have a message written; never waits."""
        with self._lock:
            wakes = not self._waiting
            self._waiting.append(message)
            self.held_bytes += _size(message)
            dropped = []
            while self._waiting and self.held_bytes > self._most:
                dropped.append(self._take())
        for one in dropped:
            self._lose(one, f"at most {self._most} bytes waiting for the log")
        if wakes:
            self._connection.soon(self._came.set)

    def idle(self) -> bool:
        """Whether all that was put has been written, or lost."""
        with self._lock:
            return not self.held_bytes

    def close(self) -> None:
        """End; what waits is lost."""
        self._running.cancel()

    def _take(self) -> LogMessage:
        """Take the oldest that waits; called with the lock."""
        message = self._waiting.popleft()
        self.held_bytes -= _size(message)
        return message

    def _lose(self, message: LogMessage, why: str) -> None:
        self.dropped += 1
        self._lost(message.stream, why)

    # On the loop of the log

    async def _run(self) -> None:
        while not await self._ready():  # noqa: ASYNC110 - the servers are asked again, nobody else says anything
            await asyncio.sleep(RETRY_S)
        self._works()
        while True:
            await self._came.wait()
            self._came.clear()
            while batch := self._next():
                failed = await self._write(batch)
                if self._tries == TRIES:
                    self._tries = 0
                    self._lose(failed.pop(), self._failure)
                    self._go_on()
                with self._lock:
                    self._waiting.extendleft(reversed(failed))
                    self.held_bytes -= sum(map(_size, batch)) - sum(map(_size, failed))
                if failed:
                    await asyncio.sleep(RETRY_S)

    async def _ready(self) -> bool:
        try:
            for topic, keep in self._keep.items():
                await self._log.ready(topic, keep)
        except (NatsError, RefusedError, TimeoutError, OSError) as error:
            self._failed(error)
            return False
        return True

    def _next(self) -> list[LogMessage]:
        """Take what is to be written at once; its bytes still count."""
        with self._lock:
            return [self._waiting.popleft() for _ in range(min(self._at_once, len(self._waiting)))]

    async def _write(self, batch: list[LogMessage]) -> list[LogMessage]:
        """Write messages; return those that have to be tried again.

        One message can keep all beside it from being written, by having the connection closed. So after a failure they
        are tried alone, and the tries of the first one count while the servers say that its log is there.
        """
        if not await self._ready():
            return batch
        results = await asyncio.gather(*map(self._log.put, batch), return_exceptions=True)
        failed: list[LogMessage] = []
        for message, result in zip(batch, results, strict=True):
            if isinstance(result, NotKeptError):
                self._lose(message, str(result))
            elif isinstance(result, NatsError | RefusedError | TimeoutError | OSError):
                self._failed(result)
                failed.append(message)
            elif isinstance(result, BaseException):
                self._lose(message, f"{type(result).__name__}: {result}")
            else:
                self.written += result
                self.repeated += not result
        if failed:
            self._log.look_again()
            alone = batch[0] if len(batch) == 1 else None
            self._tries = 0 if alone is None else 1 if alone is not self._tried else self._tries + 1
            self._tried = alone
            self._at_once = 1
        else:
            self._tries = 0
            self._at_once = min(AT_ONCE, 2 * self._at_once)
            self._go_on()
        return failed

    def _go_on(self) -> None:
        """Take the servers for sound, unless what failed before may be among the messages that wait."""
        if self._at_once == AT_ONCE or not self._waiting:
            self._works()

    def _works(self) -> None:
        if self._failure:
            self._failure = ""
            log.info("log_back")

    def _failed(self, error: BaseException) -> None:
        if not self._failure:
            log.error("log_failed", error=str(error))
        self._failure = self._connection.described(error)


def _size(message: LogMessage) -> int:
    return OVERHEAD + len(message.payload)

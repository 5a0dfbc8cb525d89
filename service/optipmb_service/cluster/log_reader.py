"""Reads the log for those who track: what a session has missed, and tracks of a time that has passed.

Everything runs on the loop of the connection, a few streams at a time, each for a bounded time and up to a bounded
number of bytes. What cannot be read is as if it were not there: the caches of publishers may still have it.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import structlog
from nats.errors import Error as NatsError

from optipmb_service.cluster.nats_connection import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.cluster.log_position import Missed, Position
    from optipmb_service.cluster.message_log import LogMessage, MessageLog

log = structlog.get_logger("optipmb_service")

AT_ONCE: Final = 16
"""Streams that are read at once."""

READ_S: Final = 3.0
"""Longest time for one stream, from its turn on."""

WAIT_S: Final = 30.0
"""Longest time in all, with what it waits for its turn."""

OUTAGE_S: Final = 30.0
"""How far a stream is read at most that has a position, by the log's own times, unless one without has it longer.

To track more than that would keep the newest frames waiting for as long as they are of use.
"""

MOST_BYTES: Final = 2**25
"""Bytes of a stream that are given at once at most; the oldest frames go."""

MOST_FRAMES: Final = 1024
"""Frames of a stream that are given at once at most: as many as a session holds while some are missing."""

AGAIN_S: Final = (0.3, 0.7)
"""When the log is read again for what was not there yet, after the first time and after that."""


class LogReader:
    """The reader of one process.

    Args:
        message_log: what is read; its connection is closed with the reader.
        back_s: how far a stream is read that has no position: so long before its newest message.
    """

    def __init__(self, message_log: MessageLog, back_s: float) -> None:
        self._log = message_log
        self._back_s = back_s
        self._turns = asyncio.Semaphore(AT_ONCE)

    def missed(
        self, wanted: Missed, take: Callable[[list[LogMessage]], None], again_s: Sequence[float] = AGAIN_S
    ) -> None:
        """Read what a session has missed, without waiting for it.

        Args:
            wanted: of which streams, from where on.
            take: called, on a thread that must not be kept, with what there is, in the order of the log of each stream;
                then a few times with what has come since. The first time it is called in any case.
            again_s: pauses after which the log is read again.
        """
        self._log.connection.start(self._missed(wanted, take, again_s))

    def tracks(
        self, stream: str, from_ns: int, take: Callable[[list[LogMessage]], bool], end: Callable[[str], None]
    ) -> None:
        """Read the tracks of a stream from a stamp on, without waiting for it.

        Args:
            stream: whose.
            from_ns: the stamp; some earlier ones may come, too.
            take: called, on a thread that must not be kept, with some of them, in the order of the log, until it says
                that it has enough (False).
            end: called once afterwards, with the reason when not all could be read.
        """
        self._log.connection.start(self._tracks(stream, from_ns, take, end))

    def close(self, timeout: float) -> None:
        """End."""
        self._log.connection.close(timeout)

    # On the loop

    async def _missed(self, wanted: Missed, take: Callable[[list[LogMessage]], None], again_s: Sequence[float]) -> None:
        parts: dict[str, _Part] = {}
        for number, pause_s in enumerate((0.0, *again_s)):
            await asyncio.sleep(pause_s)
            messages = await self._look(wanted, parts)
            if messages or number == 0:
                take(messages)

    async def _look(self, wanted: Missed, parts: dict[str, _Part]) -> list[LogMessage]:
        """Return what is new in the log; nothing where it cannot be read in time."""
        messages: list[LogMessage] = []
        try:
            async with asyncio.timeout(WAIT_S), self._turns, asyncio.timeout(READ_S):
                streams = set(wanted.streams)
                if wanted.node:
                    streams.update(filter(wanted.belongs, await self._log.streams("detections", wanted.node)))
                for stream in sorted(streams):
                    await self._read(parts.setdefault(stream, _Part(stream, wanted.positions.get(stream))), messages)
        except (NatsError, RefusedError, TimeoutError, OSError) as error:
            log.warning("log_unread", streams=sorted(wanted.streams), error=self._log.connection.described(error))
        except Exception:
            log.exception("internal_error", streams=sorted(wanted.streams))  # the session waits for whatever there is
        return messages

    async def _read(self, part: _Part, messages: list[LogMessage]) -> None:
        """Append what is new of a stream."""
        position = part.position
        before = (lambda _: False) if position is None else position.before
        if part.next is None:
            back_s = max(OUTAGE_S, self._back_s) if position and position.tracked else self._back_s
            part.next = await self._log.since("detections", part.stream, before, back_s)
        kept: deque[LogMessage] = deque()
        size = cut = 0
        try:
            while part.next is not None and (found := await self._log.read("detections", part.stream, part.next)):
                part.next = found[-1][0] + 1
                for _, message in found:
                    if before(message):
                        continue
                    kept.append(message)
                    size += len(message.payload)
                    while len(kept) > MOST_FRAMES or size > MOST_BYTES:
                        size -= len(kept.popleft().payload)
                        cut += 1
        finally:  # what was read before a failure is not read again
            messages.extend(kept)
        if cut:
            log.warning("log_cut", stream=part.stream, frames=len(kept) + cut, kept=len(kept))

    async def _tracks(
        self, stream: str, from_ns: int, take: Callable[[list[LogMessage]], bool], end: Callable[[str], None]
    ) -> None:
        failure = ""
        try:
            async with asyncio.timeout(WAIT_S), self._turns, asyncio.timeout(READ_S):
                number = await self._log.since("tracks", stream, lambda one: one.stamp_ns < from_ns)
                while number is not None and (found := await self._log.read("tracks", stream, number)):
                    number = found[-1][0] + 1
                    if not take([message for _, message in found]):
                        break
        except (NatsError, RefusedError, TimeoutError, OSError) as error:
            failure = self._log.connection.described(error)
        except Exception as error:
            log.exception("internal_error", stream=stream)
            failure = f"{type(error).__name__}: {error}"
        end(failure)


@dataclass(slots=True)
class _Part:
    """How far a stream has been read."""

    stream: str
    position: Position | None
    next: int | None = None

"""The log of messages in NATS JetStream: detections for the next member of a session, tracks for later queries.

Each topic has a JetStream stream, with a subject for each stream of the service; its size and the age of its messages
are bounded, the oldest go. The server drops a message whose id it has, so any number of writers may write the same.
Point clouds are never put here.

A reader searches its first message backwards from the newest one, by the server's own times, so that clocks of
machines and sensors are never compared with each other. A message that cannot be read counts as missing: the caches of
publishers may still have it. A writer holds messages while the servers are away.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import structlog
from nats.errors import Error as NatsError

from optipmb_service.cluster.nats_connection import ERRORS, NO_STREAM, NatsConnection, NatsRefusedError, text_of, token

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from nats.aio.msg import Msg

    from optipmb_service.cluster.store import LogQuery, Position


log = structlog.get_logger("optipmb_service")

Topic = Literal["detections", "tracks"]

REPEATED_S: Final = 120  # window in which the server drops a copy; later ones are kept and do no harm
BACK_S: Final = 8.0  # first look back of a reader; four times as far each time, until a message is old enough
FURTHER: Final = 4.0
NEAR_S: Final = 2.0  # how near to the first message that is wanted a reader begins
BATCH: Final = 128
BATCH_BYTES: Final = 2**21
MISSING_S: Final = 0.1  # a missing log is not looked for again for so long: every new session would ask
TOO_LARGE: Final = 10054
WRITTEN_NOW: Final = 10158  # another bridge writes the same message, and several servers have not agreed on it yet
AGAIN_S: Final = 0.05
TRIES: Final = 40  # it is asked about so often before that is a failure
ID: Final = "Nats-Msg-Id"
FRAME: Final = "Optipmb-Frame"
ENCODING: Final = "Optipmb-Encoding"
HEADERS: Final = len(b"NATS/1.0\r\n\r\n")


READ_AT_ONCE: Final = 16  # streams that are read at once
READ_S: Final = 3.0  # longest time for one stream, from its turn on
WAIT_S: Final = 30.0  # longest time in all, with the wait for its turn
OUTAGE_S: Final = 30.0
"""How far a stream is read at most that has a position, by the log's own times, unless one without has it longer.

To track more than that would keep the newest frames waiting for as long as they are of use.
"""

MOST_BYTES: Final = 2**25  # bytes of a stream that are given at once at most; the oldest frames go
MOST_FRAMES: Final = 1024  # frames given at once at most, as many as a session holds while some are missing
LOOK_AGAIN_S: Final = (0.3, 0.7)  # pauses before the log is read again for newer messages
AT_ONCE: Final = 256  # messages on their way to the servers at once
HELD_BYTES: Final = 2**28  # bytes that are held at most; the oldest messages go first
OVERHEAD: Final = 512  # bytes of a message without its payload, nearly
RETRY_S: Final = 0.5  # between two tries
ALONE_TRIES: Final = 5  # how often a message is tried alone that is not written by servers that work


class NotKeptError(Exception):
    """The log does not take a message, however often it is tried; the text says why."""


class LogMessage(NamedTuple):
    """A message of the log.

    Attributes:
        topic: of which log.
        stream: `site/node/sensor`.
        epoch: of its frame.
        seq: of its frame.
        stamp_ns: of its frame.
        sensor: whose frame it is, where several sensors share tracks; else empty.
        order: what tells the tracks of one frame apart: the higher ones hold. (0, 0) for detections.
        payload: its bytes, as they were published.
        encoding: the Zenoh encoding.
    """

    topic: Topic
    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    sensor: str
    order: tuple[int, int]
    payload: bytes
    encoding: str

    @property
    def id(self) -> str:
        """What two copies of the message have in common, and no other has."""
        return f"{self.stream}:{self._frame}"

    @property
    def headers(self) -> dict[str, str]:
        return {ID: self.id, FRAME: self._frame, ENCODING: self.encoding}

    @property
    def _frame(self) -> str:
        return f"{self.epoch.hex()}:{self.seq}:{self.stamp_ns}:{self.sensor}:{self.order[0]}:{self.order[1]}"


@dataclass(frozen=True)
class Retention:
    """How much a log keeps.

    Attributes:
        age_s: the oldest message; 0: of any age.
        size: bytes of all messages.
    """

    age_s: float
    size: int


class MessageLog:
    """The logs of one key prefix, for one who writes and any number that read.

    Args:
        servers: addresses of NATS servers.
        prefix: first chunks of every key of the service.
        options: of NATS' client, as `nats_connection.access` returns them.

    Attributes:
        connection: to the servers; closed by the owner of the log. All methods run on its loop.
    """

    def __init__(self, servers: Sequence[str], prefix: str, options: Mapping[str, Any] | None = None) -> None:
        self._names = {topic: f"OPTIPMB-{topic.upper()}_{token(prefix)}" for topic in ("detections", "tracks")}
        self.connection = NatsConnection(servers, self.look_again, options)
        self._there: set[str] = set()
        self._missing_until: dict[Topic, float] = {}

    def look_again(self) -> None:
        """Forget which logs are there: the servers may have come back without their files."""
        self._there.clear()
        self._missing_until.clear()

    async def ready(self, topic: Topic, keep: Retention) -> None:
        """Create a log that keeps so much, or change one.

        Raises:
            NatsError: the servers cannot be reached, or do not answer.
            NatsRefusedError: they do not want to.
        """
        name = self._names[topic]
        if name in self._there:
            return
        bounds = {
            "max_age": round(keep.age_s * 1e9),
            "max_bytes": keep.size,
            "duplicate_window": round(min(REPEATED_S, keep.age_s or REPEATED_S) * 1e9),
        }
        await self.connection.create(name, bounds)
        config = (await self.connection.ask(f"STREAM.INFO.{name}", {}))["config"]
        if any(config.get(one) != value for one, value in bounds.items()):
            await self.connection.ask(f"STREAM.UPDATE.{name}", {**config, **bounds})
        self._there.add(name)

    async def put(self, message: LogMessage) -> bool:
        """Put a message into its log; False: it is there already.

        Raises:
            NotKeptError: the log will never take it.
            NatsError: the servers cannot be reached, or do not answer.
            NatsRefusedError: they do not take it now.
        """
        subject, headers = self._subject(message.topic, message.stream), message.headers
        # The server closes the connection over a message that is too large with its headers; the client counts without.
        size = HEADERS + len(message.payload)
        size += sum(len(f"{name}: {value}\r\n".encode()) for name, value in headers.items())
        if size > (most := self.connection.client().max_payload):
            raise NotKeptError(f"{size} bytes with its headers, and the servers take {most} at once")
        for _ in range(TRIES):
            answer = await self.connection.request(subject, message.payload, headers)
            if answer.get("error", {}).get("err_code") != WRITTEN_NOW:
                break
            await asyncio.sleep(AGAIN_S)
        if "error" in answer:
            refused = NatsRefusedError(answer["error"])
            raise NotKeptError(str(refused)) if refused.code == TOO_LARGE else refused
        return not answer.get("duplicate", False)

    async def since(
        self, topic: Topic, stream: str, old: Callable[[LogMessage], bool], back_s: float = math.inf
    ) -> int | None:
        """Return the number of a message shortly before the first that is wanted; None: none is.

        Args:
            topic: which log.
            stream: whose messages.
            old: whether a message precedes the wanted ones; true for the first messages of a stream.
            back_s: how much older than the newest message they are at most.
        """
        newest = await self._one(topic, {"last_by_subj": self._subject(topic, stream)})
        if newest is None or old(newest.message):
            return None
        oldest = await self._first_at(topic, stream, newest.at_s - back_s)
        if oldest is None:
            return None
        if not old(oldest.message):
            return oldest.number
        early, late_s, step_s = oldest, newest.at_s, BACK_S
        # Most readers want little: the first steps are backwards from the newest message, and then the rest is halved.
        while late_s - early.at_s > NEAR_S:
            middle_s = max(newest.at_s - step_s, (early.at_s + late_s) / 2)
            step_s *= FURTHER
            found = await self._first_at(topic, stream, middle_s)
            if found is not None and old(found.message):
                early = found
                step_s = math.inf
            late_s = late_s if found is early else middle_s
        return early.number

    async def read(self, topic: Topic, stream: str, number: int) -> list[tuple[int, LogMessage]]:
        """Return some messages of a stream from a number of the log on, with their numbers; none: there are no more."""
        request = {"seq": number, "next_by_subj": self._subject(topic, stream)}
        request |= {"batch": BATCH, "max_bytes": BATCH_BYTES}
        return [(one.number, one.message) for one in await self._found(topic, request)]

    async def streams(self, topic: Topic, common: str) -> list[str]:
        """Return the streams of a node (`site/node`) or a site that have messages in a log."""
        name = self._names[topic]
        any_of = 2 - common.count("/")
        head = self._subject(topic, common + any_of * "/any").rsplit(".", any_of)[0]
        request = {"subjects_filter": head + any_of * ".*"}
        try:
            state = (await self.connection.ask(f"STREAM.INFO.{name}", request))["state"]
        except NatsRefusedError as refused:
            if refused.code == NO_STREAM:
                return []
            raise
        return sorted("/".join(map(text_of, one.split(".")[1:])) for one in state.get("subjects") or ())

    async def _first_at(self, topic: Topic, stream: str, at_s: float) -> _Found | None:
        """Return the first message of a stream that the server got at a time (s since 1970, the server's) or later."""
        request: dict[str, object] = {"next_by_subj": self._subject(topic, stream)}
        if at_s > 0:
            request["start_time"] = datetime.fromtimestamp(at_s, UTC).isoformat().replace("+00:00", "Z")
        else:
            request["seq"] = 1
        return await self._one(topic, request)

    async def _one(self, topic: Topic, request: Mapping[str, object]) -> _Found | None:
        return next(iter(await self._found(topic, request)), None)

    async def _found(self, topic: Topic, request: Mapping[str, object]) -> list[_Found]:
        if time.monotonic() < self._missing_until.get(topic, 0.0):
            return []
        try:
            messages = await self.connection.read(self._names[topic], request)
        except NatsRefusedError:  # the log does not exist yet
            self._missing_until[topic] = time.monotonic() + MISSING_S
            return []
        return [_found(topic, one) for one in messages]

    def _subject(self, topic: Topic, stream: str) -> str:
        return ".".join((self._names[topic], *map(token, stream.split("/"))))


class _Found(NamedTuple):
    """A message with its number in the log, and when the server got it (s since 1970)."""

    number: int
    at_s: float
    message: LogMessage


def _found(topic: Topic, message: Msg) -> _Found:
    """Return what a message of the log says.

    Raises:
        NatsError: somebody else has put it there.
    """
    headers = message.headers or {}
    try:
        stream = "/".join(map(text_of, headers["Nats-Subject"].split(".")[1:]))
        epoch, seq, stamp_ns, sensor, run, revision = headers[FRAME].split(":")
        content = LogMessage(
            topic,
            stream,
            bytes.fromhex(epoch),
            int(seq),
            int(stamp_ns),
            sensor,
            (int(run), int(revision)),
            message.data,
            headers.get(ENCODING, ""),
        )
        at_s = datetime.fromisoformat(headers["Nats-Time-Stamp"]).timestamp()
        return _Found(int(headers["Nats-Sequence"]), at_s, content)
    except (LookupError, ValueError) as error:
        raise NatsError(f"in the message log there is something else than messages: {error}") from error


class LogReader:
    """The reader of one process.

    Everything runs on the loop of the connection, a few streams at a time, each for a bounded time and up to a bounded
    number of bytes.

    Args:
        message_log: log to read; its connection is closed with the reader.
        back_s: how far a stream is read that has no position: so long before its newest message.
    """

    def __init__(self, message_log: MessageLog, back_s: float) -> None:
        self._log = message_log
        self._back_s = back_s
        self._turns = asyncio.Semaphore(READ_AT_ONCE)

    def missed(
        self, wanted: LogQuery, take: Callable[[list[LogMessage]], None], again_s: Sequence[float] = LOOK_AGAIN_S
    ) -> None:
        """Read what a session has missed, without waiting for it.

        Args:
            wanted: of which streams, from where on.
            take: called, on a thread that must not be kept, with what there is, in the order of the log of each stream;
                then a few times with newer ones. The first time it is called in any case.
            again_s: pauses after which the log is read again.
        """
        self._log.connection.start(self._missed(wanted, take, again_s))

    def tracks(
        self, stream: str, from_ns: int, take: Callable[[list[LogMessage]], bool], end: Callable[[str], None]
    ) -> None:
        """Read the tracks of a stream from a stamp on, without waiting for it.

        Args:
            stream: its name.
            from_ns: the stamp; some earlier ones may come, too.
            take: called, on a thread that must not be kept, with some of them, in the order of the log, until it says
                that it has enough (False).
            end: called once afterwards, with the reason when not all could be read.
        """
        self._log.connection.start(self._tracks(stream, from_ns, take, end))

    def close(self, timeout: float) -> None:
        self._log.connection.close(timeout)

    async def _missed(
        self, wanted: LogQuery, take: Callable[[list[LogMessage]], None], again_s: Sequence[float]
    ) -> None:
        following: dict[str, int | None] = {}
        for number, pause_s in enumerate((0.0, *again_s)):
            await asyncio.sleep(pause_s)
            messages: list[LogMessage] = []

            async def read(messages: list[LogMessage] = messages) -> None:
                streams = set(wanted.streams)
                if wanted.common:
                    streams.update(filter(wanted.belongs, await self._log.streams("detections", wanted.common)))
                for stream in sorted(streams):
                    await self._read(stream, wanted.positions.get(stream), following, messages)

            if failure := await self._bounded(read):
                log.warning("message_log_unread", streams=sorted(wanted.streams), error=failure)
            if messages or number == 0:
                take(messages)

    async def _bounded(self, read: Callable[[], Awaitable[None]]) -> str:
        """Read in turn, for a bounded time; return the failure, empty without one."""
        try:
            async with asyncio.timeout(WAIT_S), self._turns, asyncio.timeout(READ_S):
                await read()
        except ERRORS as error:
            return self._log.connection.described(error)
        except Exception as error:
            log.exception("internal_error", thread="nats")  # the session waits for an answer
            return f"{type(error).__name__}: {error}"
        return ""

    async def _read(
        self, stream: str, position: Position | None, following: dict[str, int | None], messages: list[LogMessage]
    ) -> None:
        """Append the messages of a stream from the number on that follows the last read; note the next one."""

        def before(message: LogMessage) -> bool:
            return position is not None and position.covers(message.epoch, message.seq)

        number = following.get(stream)
        if number is None:
            back_s = max(OUTAGE_S, self._back_s) if position and position.tracked else self._back_s
            number = await self._log.since("detections", stream, before, back_s)
        kept: deque[LogMessage] = deque()
        size = cut = 0
        try:
            while number is not None and (found := await self._log.read("detections", stream, number)):
                number = found[-1][0] + 1
                for _, message in found:
                    if before(message):
                        continue
                    kept.append(message)
                    size += len(message.payload)
                    while len(kept) > MOST_FRAMES or size > MOST_BYTES:
                        size -= len(kept.popleft().payload)
                        cut += 1
        finally:  # after a failure reading continues here
            following[stream] = number
            messages.extend(kept)
        if cut:
            log.warning("message_log_cut", stream=stream, frames=len(kept) + cut, kept=len(kept))

    async def _tracks(
        self, stream: str, from_ns: int, take: Callable[[list[LogMessage]], bool], end: Callable[[str], None]
    ) -> None:
        async def read() -> None:
            number = await self._log.since("tracks", stream, lambda one: one.stamp_ns < from_ns)
            while number is not None and (found := await self._log.read("tracks", stream, number)):
                number = found[-1][0] + 1
                if not take([message for _, message in found]):
                    break

        end(await self._bounded(read))


class LogWriter:
    """The writer of one process.

    Args:
        log: where messages go; closed by the caller, after this.
        keep: retention by topic.
        lost: called, on any thread, with the stream of a message that is not in the log, and its topic and why.
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
        self._failure = "the message log was not reached yet"
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
        """Queue a message; never waits."""
        with self._lock:
            wakes = not self._waiting
            self._waiting.append(message)
            self.held_bytes += _size(message)
            dropped = []
            while self._waiting and self.held_bytes > self._most:
                dropped.append(self._take())
        for one in dropped:
            self._lose(one, f"at most {self._most} bytes waiting for the message log")
        if wakes:
            self._connection.soon(self._came.set)

    def idle(self) -> bool:
        """Return whether all messages have been written, or lost."""
        with self._lock:
            return not self.held_bytes

    def close(self) -> None:
        """End; what waits is lost."""
        self._running.cancel()

    def _take(self) -> LogMessage:
        """Remove the oldest message from the queue; called with the lock."""
        message = self._waiting.popleft()
        self.held_bytes -= _size(message)
        return message

    def _lose(self, message: LogMessage, why: str) -> None:
        self.dropped += 1
        self._lost(message.stream, f"{message.topic}: {why}")

    # On the loop of the log

    async def _run(self) -> None:
        while not await self._ready():  # noqa: ASYNC110 - there is no event to wait for
            await asyncio.sleep(RETRY_S)
        self._works()
        while True:
            await self._came.wait()
            self._came.clear()
            while batch := self._next():
                failed = await self._write(batch)
                if self._tries == ALONE_TRIES:
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
        except ERRORS as error:
            self._failed(error)
            return False
        return True

    def _next(self) -> list[LogMessage]:
        """Remove the messages to write at once from the queue; their bytes still count."""
        with self._lock:
            return [self._waiting.popleft() for _ in range(min(self._at_once, len(self._waiting)))]

    async def _write(self, batch: list[LogMessage]) -> list[LogMessage]:
        """Write messages; return the ones to try again.

        One message can keep all others from being written, by having the connection closed. So after a failure they
        are tried alone, and the tries of the first one count while the servers say that its log is there.
        """
        if not await self._ready():
            return batch
        results = await asyncio.gather(*map(self._log.put, batch), return_exceptions=True)
        failed: list[LogMessage] = []
        for message, result in zip(batch, results, strict=True):
            if isinstance(result, NotKeptError):
                self._lose(message, str(result))
            elif isinstance(result, ERRORS):
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
        """End the failure, unless the message that failed may still be in the queue."""
        if self._at_once == AT_ONCE or not self._waiting:
            self._works()

    def _works(self) -> None:
        if self._failure:
            self._failure = ""
            log.info("message_log_back")

    def _failed(self, error: BaseException) -> None:
        if not self._failure:
            log.error("message_log_failed", error=str(error))
        self._failure = self._connection.described(error)


def _size(message: LogMessage) -> int:
    return OVERHEAD + len(message.payload)

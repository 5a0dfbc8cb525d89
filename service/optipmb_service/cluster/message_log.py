"""The log of messages in NATS JetStream: detections for who goes on with a session, tracks for who asks later.

Each topic has a JetStream stream, with a subject for each stream of the service; its size and the age of what it holds
are bounded, the oldest messages go. A message has an id, and the server drops what it has under the same id, so it does
not matter how many write the same. Point clouds are never put here.

A reader looks for the beginning of what it wants from the newest message on, backwards by the server's own times, so
that neither the clocks of machines nor those of sensors are compared with each other.
"""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from nats.errors import Error as NatsError

from optipmb_service.cluster.nats_connection import NatsConnection, NobodyAnswersError, RefusedError, text_of, token

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from nats.aio.msg import Msg

    from optipmb_service.cluster.nats_access import NatsAccess

Topic = Literal["detections", "tracks"]

REPEATED_S: Final = 120
"""Time within which the server drops a message that it has; later a copy is kept, which does no harm."""

BACK_S: Final = 8.0
"""How far a reader looks back at first; four times as far each time, until what it finds is old enough."""

FURTHER: Final = 4.0
NEAR_S: Final = 2.0
"""How near to the first message that is wanted a reader begins."""

BATCH: Final = 128
BATCH_BYTES: Final = 2**21
MISSING_S: Final = 0.1
"""How long a log that is not there is not looked for again: without one, every new session would ask for it."""

NO_LOG: Final = 10059
TOO_LARGE: Final = 10054
WRITTEN_NOW: Final = 10158
"""Another bridge writes the same message, and several servers have not agreed on it yet."""

AGAIN_S: Final = 0.05
TRIES: Final = 40
"""It is asked about so often before that is a failure."""

ID: Final = "Nats-Msg-Id"
FRAME: Final = "Optipmb-Frame"
ENCODING: Final = "Optipmb-Encoding"
HEADERS: Final = len(b"NATS/1.0\r\n\r\n")


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
        sensor: whose frame it is, where tracks are those of several sensors; else nothing.
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
        """What it carries in the log."""
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
        access: what the servers want to see.

    Attributes:
        connection: to the servers; closed by the owner of the log. All methods run on its loop.
    """

    def __init__(self, servers: Sequence[str], prefix: str, access: NatsAccess | None = None) -> None:
        self._names = {topic: f"OPTIPMB-{topic.upper()}_{token(prefix)}" for topic in ("detections", "tracks")}
        self.connection = NatsConnection(servers, self.look_again, access)
        self._there: set[str] = set()
        self._missing_until: dict[Topic, float] = {}

    def look_again(self) -> None:
        """Have `ready` ask the servers again: they may have come back without their files."""
        self._there.clear()
        self._missing_until.clear()

    async def ready(self, topic: Topic, keep: Retention) -> None:
        """Have a log there that keeps so much.

        Raises:
            NatsError: the servers cannot be reached, or do not answer.
            RefusedError: they do not want to.
        """
        name = self._names[topic]
        if name in self._there:
            return
        bounds = {
            "max_age": round(keep.age_s * 1e9),
            "max_bytes": keep.size,
            "duplicate_window": round(min(REPEATED_S, keep.age_s or REPEATED_S) * 1e9),
        }
        await self.connection.create(
            {
                "name": name,
                "subjects": [f"{name}.>"],
                "storage": "file",
                "retention": "limits",
                "discard": "old",
                "allow_direct": True,
                **bounds,
            }
        )
        config = (await self.connection.ask(f"STREAM.INFO.{name}", {}))["config"]
        if any(config.get(one) != value for one, value in bounds.items()):
            await self.connection.ask(f"STREAM.UPDATE.{name}", {**config, **bounds})
        self._there.add(name)

    async def put(self, message: LogMessage) -> bool:
        """Put a message into its log; False: it is there already.

        Raises:
            NotKeptError: the log will never take it.
            NatsError: the servers cannot be reached, or do not answer.
            RefusedError: they do not take it now.
        """
        subject, headers = self._subject(message.topic, message.stream), message.headers
        # The server closes the connection over a message that is too large with its headers; the client counts without.
        size = (
            len(message.payload)
            + HEADERS
            + sum(len(f"{name}: {value}\r\n".encode()) for name, value in headers.items())
        )
        if size > (most := self.connection.client().max_payload):
            raise NotKeptError(f"{size} bytes with its headers, and the servers take {most} at once")
        for _ in range(TRIES):
            answer = await self.connection.request(subject, message.payload, headers)
            if answer.get("error", {}).get("err_code") != WRITTEN_NOW:
                break
            await asyncio.sleep(AGAIN_S)
        if "error" in answer:
            refused = RefusedError(answer["error"])
            raise NotKeptError(str(refused)) if refused.code == TOO_LARGE else refused
        return not answer.get("duplicate", False)

    async def since(
        self, topic: Topic, stream: str, old: Callable[[LogMessage], bool], back_s: float = math.inf
    ) -> int | None:
        """Return the number of a message shortly before the first that is wanted; None: none is.

        Args:
            topic: which log.
            stream: whose messages.
            old: whether a message is before those that are wanted; of a stream's messages it is the first ones.
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

    async def streams(self, topic: Topic, node: str) -> list[str]:
        """Return the streams of a node (`site/node`) that have messages in a log."""
        name = self._names[topic]
        request = {"subjects_filter": self._subject(topic, f"{node}/any").rpartition(".")[0] + ".*"}
        try:
            state = (await self.connection.ask(f"STREAM.INFO.{name}", request))["state"]
        except RefusedError as refused:
            if refused.code == NO_LOG:
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
        except NobodyAnswersError:  # nobody has put anything into such a log
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
        raise NatsError(f"in the log there is something else than messages: {error}") from error

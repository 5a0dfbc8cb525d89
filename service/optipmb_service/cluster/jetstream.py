"""Leases and checkpoints in NATS JetStream; implements `store.LeaseStore`.

One JetStream stream for each key prefix holds every record and every checkpoint, each kind under subjects of its own.
The sequence number that the server gives a message is its revision, and the server compares: a write states the
sequence of the message that it replaces (`Nats-Expected-Last-Subject-Sequence`), a checkpoint states the sequence of
its partition's record (with `…-Subject`, which needs NATS 2.12). The server removes old checkpoints by itself.
"""

from __future__ import annotations

import asyncio
import base64
import re
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeVar

from optipmb_service.cluster.nats_connection import NatsConnection, NatsRefusedError, text_of, token
from optipmb_service.cluster.store import KEPT, Record

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from optipmb_service.cluster.store import Fenced, Write

_T = TypeVar("_T")

BATCH: Final = 1024  # records read at once
SAVED_AT_ONCE: Final = 8
SAVED_IN_A_CALL: Final = 32
PARTS: Final = 16  # messages of one checkpoint
MEMBER_TTL_S: Final = 3600  # age at which the server forgets the record of a member that has ended
NOT_THE_NEWEST: Final = 10071
UNDECIDED: Final = 10164  # several servers have not agreed yet on a write that was asked for before
NOTHING_THERE: Final = 10037
AGAIN_S: Final = 0.05
MOST_NUMBERS: Final = 4096  # streams whose written numbers are remembered

EXPECTED: Final = "Nats-Expected-Last-Subject-Sequence"
IN_PARTS: Final = "Optipmb-Parts"
"""Sequences of the messages with the first parts of a checkpoint; its own message has the last one."""


class JetStream:
    """The leases and checkpoints of one key prefix.

    Args:
        servers: addresses of NATS servers, as `nats://host:4222`; of one cluster, where there are several.
        prefix: first chunks of every key of the service.
        keep_s: age at which the newest checkpoint of a stream is removed; 0: never.
        options: of NATS' client, as `nats_connection.access` returns them.
    """

    remote: Final = True

    def __init__(
        self, servers: Sequence[str], prefix: str, keep_s: float = 0.0, options: Mapping[str, Any] | None = None
    ) -> None:
        self._connection = NatsConnection(servers, self._lost, options)
        self._name = f"OPTIPMB_{token(prefix)}"
        self._keep_s = round(keep_s)
        self._there = False
        self._numbers: dict[str, bytes] = {}
        """Numbers that were written last, by stream."""
        self._part_bytes = 2**19
        """Bytes of a message; by the server's own limit, once that is known."""

    @property
    def max_bytes(self) -> int:
        """Bytes that a checkpoint may have."""
        return PARTS * self._part_bytes

    def follow(self, after: int) -> list[Record]:
        """Return the newest record of each key that changed after a revision, by revision; a thousand at most."""
        return self._call(self._follow(after))

    def get(self, key: str) -> Record | None:
        """Return the newest record of a key; None without one."""
        found = self._call(self._last(self._record(key)))
        return None if found is None else Record(key, found[1].decode(), found[0])

    def put(self, write: Write) -> int | None:
        """Write a record; return its revision, None when the one to be replaced is not the newest."""
        headers = {EXPECTED: str(write.over)}
        if write.key.startswith("member/"):
            headers["Nats-TTL"] = f"{MEMBER_TTL_S}s"
        return self._call(self._publish(self._record(write.key), write.value.encode(), headers))

    def gone(self, member: str) -> bool:
        """Return False: the end of a process on another machine cannot be observed."""
        del member
        return False

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams; return the streams refused for their fence."""
        refused: frozenset[str] = frozenset()
        left = iter(checkpoints.items())
        while some := dict(islice(left, SAVED_IN_A_CALL)):  # a server that is stuck is waited for once
            messages = sum(1 + len(one.data) // self._part_bytes for one in some.values())
            refused |= self._call(self._save(some), messages)
        return refused

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""
        found = self._call(self._load(stream), PARTS)
        return None if found is None else found[1]

    def numbers(self, stream: str) -> bytes | None:
        """Return the numbers saved with the newest checkpoint of a stream, also after that has gone; else None."""
        found = self._call(self._last(self._subject("numbers", stream)))
        return None if found is None else found[1]

    def expire(self, age_s: float) -> int:
        """Return 0: the server itself forgets a checkpoint that is old."""
        del age_s
        return 0

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""
        self._call(self._set_aside(stream, reason))

    def close(self, timeout: float) -> None:
        self._connection.close(timeout)

    def _call(self, work: Coroutine[Any, Any, _T], count: int = 1) -> _T:
        return self._connection.call(work, 1 + count / SAVED_AT_ONCE)

    # Everything below runs on the loop

    def _lost(self) -> None:
        self._there = False  # the server may come back without its files
        self._numbers.clear()

    async def _ready(self) -> None:
        """Create the JetStream stream, unless it is there."""
        client = self._connection.client()
        if not self._there:
            self._part_bytes = client.max_payload * 3 // 4 - 4096  # it is read as base64
            await self._connection.create(self._name, {"max_msgs_per_subject": KEPT, "allow_msg_ttl": True})
            self._there = True

    async def _follow(self, after: int) -> list[Record]:
        await self._ready()
        request = {"batch": BATCH, "seq": after + 1, "next_by_subj": f"{self._name}.record.>"}
        records: dict[str, Record] = {}
        for message in await self._connection.read(self._name, request):
            headers = message.headers or {}
            key = "/".join(map(text_of, headers["Nats-Subject"].split(".")[2:]))
            records[key] = Record(key, message.data.decode(), int(headers["Nats-Sequence"]))
        return sorted(records.values(), key=lambda record: record.revision)

    async def _last(self, subject: str) -> tuple[int, bytes] | None:
        """Return sequence and bytes of the newest message on a subject; None without one."""
        message = await self._message({"last_by_subj": subject})
        return None if message is None else (int(message["seq"]), base64.b64decode(message.get("data", "")))

    async def _message(self, which: dict[str, Any]) -> dict[str, Any] | None:
        """Return a message from the server that decides on writes; None without one."""
        await self._ready()
        try:
            answer = await self._connection.ask(f"STREAM.MSG.GET.{self._name}", which)
        except NatsRefusedError as refused:
            if refused.code == NOTHING_THERE:
                return None
            raise
        message: dict[str, Any] = answer["message"]
        return message

    async def _load(self, stream: str) -> tuple[int, bytes] | None:
        """Return sequence and bytes of the newest checkpoint; without the parts that are not there any more."""
        message = await self._message({"last_by_subj": self._subject("checkpoint", stream)})
        if message is None:
            return None
        headers = base64.b64decode(message.get("hdrs", "")).decode()
        sequences = re.findall(rf"^{IN_PARTS}: *(.*?)\r?$", headers, re.MULTILINE)
        parts = [await self._message({"seq": int(one)}) for text in sequences for one in text.split(",")]
        whole = b"".join(base64.b64decode(one.get("data", "")) for one in (*parts, message) if one is not None)
        return int(message["seq"]), whole

    async def _publish(self, subject: str, data: bytes, headers: dict[str, str]) -> int | None:
        """Return the sequence of a message that was kept; None when another one than expected is the newest."""
        await self._ready()
        while True:
            answer = await self._connection.request(subject, data, headers)
            error = answer.get("error", {})
            code = error.get("err_code")
            if code is None:
                return int(answer["seq"])
            if code == NOT_THE_NEWEST:
                return None
            if code != UNDECIDED:
                raise NatsRefusedError(error)
            await asyncio.sleep(AGAIN_S)  # the caller sets the bound

    async def _save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        turn = asyncio.Semaphore(SAVED_AT_ONCE)

        async def save(stream: str, one: Fenced) -> str | None:
            headers = {EXPECTED: str(one.fence), f"{EXPECTED}-Subject": self._record(one.lease)}
            if self._keep_s:
                headers["Nats-TTL"] = f"{self._keep_s}s"
            async with turn:
                kept = await self._save_one(stream, one.data, headers)
                if kept is not None and one.numbers and self._numbers.get(stream) != one.numbers:
                    headers.pop("Nats-TTL", None)
                    await self._publish(self._subject("numbers", stream), one.numbers, headers)
                    if len(self._numbers) >= MOST_NUMBERS:
                        self._numbers.clear()
                    self._numbers[stream] = one.numbers
            return stream if kept is None else None

        refused = await asyncio.gather(*(save(*one) for one in checkpoints.items()))
        return frozenset(stream for stream in refused if stream is not None)

    async def _save_one(self, stream: str, data: bytes, headers: dict[str, str]) -> int | None:
        """Write a checkpoint, the first parts of a large one before it; return as `_publish` does."""
        sequences: list[str] = []
        while len(data) > self._part_bytes:
            part, data = data[: self._part_bytes], data[self._part_bytes :]
            sequence = await self._publish(self._subject(f"part.{len(sequences)}", stream), part, headers)
            if sequence is None:
                return None
            sequences.append(str(sequence))
        whole = headers | {IN_PARTS: ",".join(sequences)} if sequences else headers
        return await self._publish(self._subject("checkpoint", stream), data, whole)

    async def _set_aside(self, stream: str, reason: str) -> None:
        await self._ready()
        found = await self._last(self._subject("checkpoint", stream))
        if found is not None:
            why = {"Optipmb-Reason": " ".join(reason.split())}
            await self._publish(self._subject("aside", stream), found[1], why)
            await self._connection.ask(f"STREAM.MSG.DELETE.{self._name}", {"seq": found[0], "no_erase": True})

    def _record(self, key: str) -> str:
        kind, _, name = key.partition("/")
        return self._subject(f"record.{kind}", name)

    def _subject(self, kind: str, name: str) -> str:
        return f"{self._name}.{kind}.{token(name)}"

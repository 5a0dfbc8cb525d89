"""Leases and checkpoints in NATS JetStream; implements `store.LeaseStore`.

One JetStream stream for each key prefix holds every record and every checkpoint, each kind under subjects of its own.
The sequence number that the server gives a message is its revision, and the server compares: a write states the
sequence of the message that it replaces (`Nats-Expected-Last-Subject-Sequence`), a checkpoint that of its partition's
record (with `…-Subject`, which needs NATS 2.12). A checkpoint that nobody has replaced for so long is forgotten by the
server.

The client of NATS is asyncio's; it has a loop on a thread of its own, and every call waits for it a bounded time.
"""

from __future__ import annotations

import asyncio
import base64
import json
import re
import threading
from concurrent.futures import CancelledError
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeVar

import structlog
from nats.aio.client import Client
from nats.errors import Error as NatsError

from optipmb_service.cluster.store import KEPT, Record, StoreError

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from optipmb_service.cluster.store import Fenced, Write

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")

CALL_S: Final = 1.0
"""How long the servers may take to answer; they take milliseconds."""

CONNECT_S: Final = 1
RETRY_S: Final = 1
"""Both in whole seconds, as NATS' client has them typed."""

MANY: Final = 3
"""Servers from which on everything is kept by three of them."""

BATCH: Final = 1024
"""Records read at once."""

SAVED_AT_ONCE: Final = 8
SAVED_IN_A_CALL: Final = 32
MEMBER_TTL_S: Final = 3600
"""Age at which the server forgets the record of a member that has ended."""

LEAST: Final = (2, 12)
"""First version of the server that refuses a checkpoint for its fence."""

EXISTS: Final = 10058
NOT_THE_NEWEST: Final = 10071
UNDECIDED: Final = 10164
"""Several servers have not agreed yet on a write that was asked for before."""

NOTHING_THERE: Final = 10037
AGAIN_S: Final = 0.05
ENDS: Final = frozenset({"204", "404"})
"""Status that ends a batch: that was all, or there is nothing."""

EXPECTED: Final = "Nats-Expected-Last-Subject-Sequence"


class _Refused(Exception):  # noqa: N818 - the server's answer, which some callers expect
    def __init__(self, error: Mapping[str, Any]) -> None:
        super().__init__(str(error.get("description", error)))
        self.code = error.get("err_code")


class JetStream:
    """The leases and checkpoints of one key prefix.

    Args:
        servers: addresses of NATS servers, as `nats://host:4222`; of one cluster, where there are several.
        prefix: first chunks of every key of the service.
        keep_s: age at which a checkpoint that nobody has replaced is forgotten; 0: never.
    """

    remote: Final = True

    def __init__(self, servers: Sequence[str], prefix: str, keep_s: float = 0.0) -> None:
        self._servers = list(servers)
        self._name = f"OPTIPMB_{_token(prefix)}"
        self._keep_s = round(keep_s)
        self._client = Client()
        self._why = f"no connection to {', '.join(map(_shown, servers))}"
        self._there = False
        self._closed = False
        self.max_bytes = 2**19
        """Bytes that a checkpoint may have; the server's own limit, once that is known."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nats", daemon=True)
        self._thread.start()
        self._connecting = asyncio.run_coroutine_threadsafe(self._connect(), self._loop)

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
        """Return False: whether a process on another machine has ended nobody knows."""
        del member
        return False

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams; return those that were refused for their fence."""
        refused: frozenset[str] = frozenset()
        left = iter(checkpoints.items())
        while some := dict(islice(left, SAVED_IN_A_CALL)):  # a server that is stuck is waited for once
            refused |= self._call(self._save(some), len(some))
        return refused

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""
        found = self._call(self._last(self._subject("checkpoint", stream)))
        return None if found is None else found[1]

    def expire(self, age_s: float) -> int:
        """Do nothing: the server itself forgets a checkpoint that is old."""
        del age_s
        return 0

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""
        self._call(self._set_aside(stream, reason))

    def close(self, timeout: float) -> None:
        """Close the connection."""
        if self._closed:
            return
        self._closed = True

        async def end() -> None:
            self._connecting.cancel()
            await self._client.close()
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        try:
            asyncio.run_coroutine_threadsafe(end(), self._loop).result(timeout)
        except TimeoutError:
            log.warning("leases_failed", error="the connection does not close")
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout)
        if not self._thread.is_alive():
            self._loop.close()

    # Everything below runs on the loop

    def _call(self, work: Coroutine[Any, Any, _T], count: int = 1) -> _T:
        """Have the loop do something, and wait for it.

        Raises:
            StoreError: it could not be done in time.
        """
        bound_s = CALL_S * (1 + count / SAVED_AT_ONCE)

        async def bounded() -> _T:
            async with asyncio.timeout(bound_s):
                return await work

        if self._closed:
            work.close()
            raise StoreError("the connection is closed")
        try:
            return asyncio.run_coroutine_threadsafe(bounded(), self._loop).result(bound_s + CALL_S)
        except (NatsError, _Refused, TimeoutError, CancelledError, OSError) as error:
            text = str(error).removeprefix("nats: ") or "no answer in time"
            raise StoreError(f"{', '.join(map(_shown, self._servers))}: {text}") from error

    async def _connect(self) -> None:
        await self._client.connect(
            self._servers,
            name="optipmb-service",
            connect_timeout=CONNECT_S,
            reconnect_time_wait=RETRY_S,
            max_reconnect_attempts=-1,
            ping_interval=5,
            max_outstanding_pings=2,
            error_cb=self._note,
            disconnected_cb=self._disconnected,
        )

    async def _note(self, error: Exception) -> None:
        self._why = str(error).removeprefix("nats: ") or type(error).__name__

    async def _disconnected(self) -> None:
        self._there = False  # the server may come back without its files

    async def _ready(self) -> Client:
        """Return the client, connected, with the JetStream stream there."""
        client = self._client
        if not client.is_connected:
            # Nothing is put into the client's buffer: it would be sent when nobody waits for it any more.
            raise NatsError(self._why)
        if not self._there:
            version = client.connected_server_version
            if (version.major, version.minor) < LEAST:
                raise NatsError(f"NATS {'.'.join(map(str, LEAST))} or newer is needed, this is {version}")
            self.max_bytes = client.max_payload * 3 // 4 - 4096  # it is read as base64
            await self._create(client)
            self._there = True
        return client

    async def _create(self, client: Client) -> None:
        config = {
            "name": self._name,
            "subjects": [f"{self._name}.>"],
            "storage": "file",
            "retention": "limits",
            "discard": "old",
            "max_msgs_per_subject": KEPT,
            "allow_direct": True,
            "allow_msg_ttl": True,
            "num_replicas": MANY if len(self._servers) >= MANY else 1,
        }
        try:
            await self._ask(client, f"STREAM.CREATE.{self._name}", config)
        except _Refused as refused:
            if refused.code != EXISTS:  # somebody who runs the servers may have changed it
                raise

    async def _ask(self, client: Client, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
        reply = await client.request(f"$JS.API.{what}", json.dumps(request).encode(), timeout=CALL_S)
        answer: dict[str, Any] = json.loads(reply.data)
        if "error" in answer:
            raise _Refused(answer["error"])
        return answer

    async def _follow(self, after: int) -> list[Record]:
        client = await self._ready()
        inbox = client.new_inbox()
        subscription = await client.subscribe(inbox)
        records: dict[str, Record] = {}
        try:
            request = {"batch": BATCH, "seq": after + 1, "next_by_subj": f"{self._name}.record.>"}
            await client.publish(f"$JS.API.DIRECT.GET.{self._name}", json.dumps(request).encode(), reply=inbox)
            while True:
                message = await subscription.next_msg(CALL_S)
                headers = message.headers or {}
                if (status := headers.get("Status")) is not None:
                    if status not in ENDS:
                        raise NatsError(f"status {status}")
                    break
                key = "/".join(map(_text, headers["Nats-Subject"].split(".")[2:]))
                records[key] = Record(key, message.data.decode(), int(headers["Nats-Sequence"]))
        finally:
            await subscription.unsubscribe()
        return sorted(records.values(), key=lambda record: record.revision)

    async def _last(self, subject: str) -> tuple[int, bytes] | None:
        """Return sequence and bytes of the newest message on a subject, from the server that decides on writes."""
        client = await self._ready()
        try:
            answer = await self._ask(client, f"STREAM.MSG.GET.{self._name}", {"last_by_subj": subject})
        except _Refused as refused:
            if refused.code == NOTHING_THERE:
                return None
            raise
        message = answer["message"]
        return int(message["seq"]), base64.b64decode(message.get("data", ""))

    async def _publish(self, subject: str, data: bytes, headers: dict[str, str]) -> int | None:
        """Return the sequence of a message that was kept; None when another one than expected is the newest."""
        client = await self._ready()
        while True:
            answer = json.loads((await client.request(subject, data, timeout=CALL_S, headers=headers)).data)
            error = answer.get("error", {})
            code = error.get("err_code")
            if code is None:
                return int(answer["seq"])
            if code == NOT_THE_NEWEST:
                return None
            if code != UNDECIDED:
                raise _Refused(error)
            await asyncio.sleep(AGAIN_S)  # whoever called sets the bound

    async def _save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        turn = asyncio.Semaphore(SAVED_AT_ONCE)

        async def save(stream: str, one: Fenced) -> str | None:
            headers = {EXPECTED: str(one.fence), f"{EXPECTED}-Subject": self._record(one.lease)}
            if self._keep_s:
                headers["Nats-TTL"] = f"{self._keep_s}s"
            async with turn:
                kept = await self._publish(self._subject("checkpoint", stream), one.data, headers)
            return stream if kept is None else None

        refused = await asyncio.gather(*(save(*one) for one in checkpoints.items()))
        return frozenset(stream for stream in refused if stream is not None)

    async def _set_aside(self, stream: str, reason: str) -> None:
        client = await self._ready()
        found = await self._last(self._subject("checkpoint", stream))
        if found is not None:
            why = {"Optipmb-Reason": " ".join(reason.split())}
            await self._publish(self._subject("aside", stream), found[1], why)
            await self._ask(client, f"STREAM.MSG.DELETE.{self._name}", {"seq": found[0], "no_erase": True})

    def _record(self, key: str) -> str:
        kind, _, name = key.partition("/")
        return self._subject(f"record.{kind}", name)

    def _subject(self, kind: str, name: str) -> str:
        return f"{self._name}.{kind}.{_token(name)}"


def _token(text: str) -> str:
    """Return a text in the letters that names of streams and subjects may have; `_text` undoes it."""
    return re.sub(r"[^A-Za-z0-9-]", lambda found: f"_{ord(found[0]):02x}", text)


def _text(token: str) -> str:
    return re.sub(r"_([0-9a-f]{2})", lambda found: chr(int(found[1], 16)), token)


def _shown(server: str) -> str:
    """Return an address without the password that it may hold."""
    return re.sub(r"//[^/@]*@", "//", server)

"""One connection to the NATS servers, for any thread.

The client of NATS is asyncio's; it has a loop on a thread of its own, and whoever calls waits for it a bounded time.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import threading
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any, Final, TypeVar

import structlog
from nats.errors import Error as NatsError
from nats.errors import NoRespondersError

from optipmb_service.cluster.nats_access import SecuredClient
from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence
    from concurrent.futures import Future

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from optipmb_service.cluster.nats_access import NatsAccess

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")

CALL_S: Final = 1.0
"""How long the servers may take to answer; they take milliseconds."""

CONNECT_S: Final = 1
RETRY_S: Final = 1
"""Both in whole seconds, as NATS' client has them typed."""

MANY: Final = 3
"""Servers from which on everything is kept by three of them."""

LEAST: Final = (2, 12)
"""First version of the server that refuses a checkpoint for its fence."""

EXISTS: Final = 10058
ENDS: Final = frozenset({"204", "404"})
"""Status that ends a batch: that was all, or there is nothing."""
NOBODY: Final = "503"


class RefusedError(Exception):
    """The server's answer to a request that it did not carry out.

    Attributes:
        code: NATS' number of the error.
    """

    def __init__(self, error: Mapping[str, Any]) -> None:
        super().__init__(str(error.get("description", error)))
        self.code = error.get("err_code")


class NobodyAnswersError(NatsError):
    """There is no JetStream stream of a name, or none that answers now."""


class NatsConnection:
    """A connection that is opened again whenever it is lost.

    Args:
        servers: addresses, as `nats://host:4222`; of one cluster, where there are several.
        lost: called on the loop when it is lost.
        access: what the servers want to see.

    Raises:
        StoreError: what they want to see cannot be read.
    """

    def __init__(
        self, servers: Sequence[str], lost: Callable[[], None] = lambda: None, access: NatsAccess | None = None
    ) -> None:
        self._options = access.options() if access else {}
        self._servers = list(servers)
        self._lost = lost
        self._client = SecuredClient()
        self._why = f"no connection to {', '.join(map(_shown, servers))}"
        self._closed = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nats", daemon=True)
        self._thread.start()
        self._connecting = self.start(self._connect())

    @property
    def replicas(self) -> int:
        """How many servers are to keep a JetStream stream."""
        return MANY if len(self._servers) >= MANY else 1

    @property
    def failure(self) -> str:
        """Why the servers cannot be reached; empty while they can."""
        return "" if self._client.is_connected else self._why

    def soon(self, callback: Callable[[], object]) -> None:
        """Have something called on the loop, without waiting for it."""
        with contextlib.suppress(RuntimeError):  # it has closed
            self._loop.call_soon_threadsafe(callback)

    def start(self, work: Coroutine[Any, Any, _T]) -> Future[_T]:
        """Have the loop do something, without waiting for it."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call(self, work: Coroutine[Any, Any, _T], calls: float = 1.0) -> _T:
        """Have the loop do something that takes as long as so many calls, and wait for it.

        Raises:
            StoreError: it could not be done in time.
        """
        bound_s = calls * CALL_S

        async def bounded() -> _T:
            async with asyncio.timeout(bound_s):
                return await work

        if self._closed:
            work.close()
            raise StoreError("the connection is closed")
        try:
            return self.start(bounded()).result(bound_s + CALL_S)
        except (NatsError, RefusedError, TimeoutError, CancelledError, OSError) as error:
            raise StoreError(self.described(error)) from error

    def described(self, error: BaseException) -> str:
        """Return an error as one line, with the servers that it is about."""
        text = str(error).removeprefix("nats: ") or "no answer in time"
        return f"{', '.join(map(_shown, self._servers))}: {text}"

    def close(self, timeout: float) -> None:
        """Close the connection; may be called twice."""
        if self._closed:
            return
        self._closed = True

        async def end() -> None:
            self._connecting.cancel()
            await self._client.close()
            # Connecting may have begun something before it was cancelled.
            while tasks := asyncio.all_tasks() - {asyncio.current_task()}:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)

        try:
            self.start(end()).result(timeout)
        except TimeoutError:
            log.warning("leases_failed", error="the connection does not close")
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout)
        if not self._thread.is_alive():
            self._loop.close()

    # Everything below runs on the loop

    def client(self) -> Client:
        """Return NATS' client.

        Raises:
            NatsError: it is not connected, or to a server that is too old.
        """
        client = self._client
        if not client.is_connected:
            # Nothing is put into the client's buffer: it would be sent when nobody waits for it any more.
            raise NatsError(self._why)
        version = client.connected_server_version
        if (version.major, version.minor) < LEAST:
            raise NatsError(f"NATS {'.'.join(map(str, LEAST))} or newer is needed, this is {version}")
        return client

    async def create(self, config: Mapping[str, Any]) -> None:
        """Create a JetStream stream, unless there is one of that name."""
        try:
            await self.ask(f"STREAM.CREATE.{config['name']}", {**config, "num_replicas": self.replicas})
        except RefusedError as refused:
            if refused.code != EXISTS:  # somebody who runs the servers may have changed it
                raise

    async def ask(self, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request to JetStream, and return the answer.

        Raises:
            RefusedError: it says no.
        """
        answer = await self.request(f"$JS.API.{what}", json.dumps(request).encode())
        if "error" in answer:
            raise RefusedError(answer["error"])
        return answer

    async def request(self, subject: str, data: bytes, headers: dict[str, str] | None = None) -> dict[str, Any]:
        """Send a message, and return what JetStream says to it."""
        reply = await self.client().request(subject, data, timeout=CALL_S, headers=headers)
        answer: dict[str, Any] = json.loads(reply.data)
        return answer

    async def read(self, name: str, request: Mapping[str, Any]) -> list[Msg]:
        """Return the messages of a JetStream stream that a request names, from the server that is nearest."""
        client = self.client()
        if "batch" not in request:
            try:
                return _answered(
                    await client.request(f"$JS.API.DIRECT.GET.{name}", json.dumps(request).encode(), timeout=CALL_S)
                )
            except NoRespondersError as error:
                raise NobodyAnswersError(f"nobody answers for {name}") from error
        inbox = client.new_inbox()
        subscription = await client.subscribe(inbox)
        messages: list[Msg] = []
        try:
            await client.publish(f"$JS.API.DIRECT.GET.{name}", json.dumps(request).encode(), reply=inbox)
            while True:
                message = await subscription.next_msg(CALL_S)
                if (message.headers or {}).get("Status") == NOBODY:
                    raise NobodyAnswersError(f"nobody answers for {name}")
                if not (found := _answered(message)):
                    return messages
                messages += found
        finally:
            await subscription.unsubscribe()

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
            **self._options,
        )

    async def _note(self, error: Exception) -> None:
        self._why = str(error).removeprefix("nats: ") or type(error).__name__

    async def _disconnected(self) -> None:
        self._lost()


def _answered(message: Msg) -> list[Msg]:
    """Return the message of an answer; none where its status says that there are no more.

    Raises:
        NatsError: the status says something else.
    """
    status = (message.headers or {}).get("Status")
    if status is None:
        return [message]
    if status not in ENDS:
        raise NatsError(f"status {status}")
    return []


def token(text: str) -> str:
    """Return a text in the letters that names of streams and subjects may have; `text_of` undoes it."""
    return re.sub(r"[^A-Za-z0-9-]", lambda found: f"_{ord(found[0]):02x}", text)


def text_of(written: str) -> str:
    """Return the text that `token` has written so."""
    return re.sub(r"_([0-9a-f]{2})", lambda found: chr(int(found[1], 16)), written)


def _shown(server: str) -> str:
    """Return an address without the password that it may hold."""
    return re.sub(r"//[^/@]*@", "//", server)

"""One connection to the NATS servers, for any thread, and what opens it: certificates, and a user's credentials.

The client of NATS is asyncio's; it has a loop on a thread of its own, and callers wait for it a bounded time.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import contextlib
import json
import re
import threading
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any, Final, TypeVar

import structlog
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from nats.aio.client import Client
from nats.errors import Error as NatsError
from optipmb_schemas.certificates import context_of

from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from nats.aio.client import Srv
    from nats.aio.msg import Msg

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")

CALL_S: Final = 1.0  # how long the servers may take to answer; they take milliseconds
CONNECT_S: Final = 1
RETRY_S: Final = 1  # both in whole seconds, as NATS' client has them typed
MANY: Final = 3  # servers from which on everything is kept by three of them
LEAST: Final = (2, 12, 7)  # first version of the server that finds the checkpoint before one that was removed
EXISTS: Final = 10058
ENDS: Final = frozenset({"204", "404"})  # status that ends a batch: that was all, or there is nothing
NOBODY: Final = "503"
NO_STREAM: Final = 10059  # there is no JetStream stream of a name, or none that answers now

_JWT: Final = re.compile(r"-+BEGIN NATS USER JWT-+\s+(\S+)\s+-+END")
_SEED: Final = re.compile(r"-+BEGIN USER NKEY SEED-+\s+(\S+)\s+-+END")
_SEED_BYTES: Final = 36  # of a user's seed: a prefix of two, the seed, a checksum


class NatsRefusedError(Exception):
    """The server's answer to a request that it did not carry out.

    Attributes:
        code: NATS' number of the error.
    """

    def __init__(self, error: Mapping[str, Any]) -> None:
        super().__init__(str(error.get("description", error)))
        self.code = error.get("err_code")


ERRORS: Final = (NatsError, NatsRefusedError, TimeoutError, OSError)  # failures of a request to the servers


class SecuredClient(Client):
    """NATS' client, but one that says nothing to a server without TLS where the address wants it.

    A server tells in the clear whether it wants TLS, and an attacker in between could leave that out: the client
    would go on without, and send the password.

    It also closes a connection that a server ended before it had greeted the client, before it tries the next one.
    """

    async def _connect_to_server(self, s: Srv) -> None:
        if self._transport is not None:
            self._transport.close()  # type: ignore[no-untyped-call]  # NATS' client annotates no `close`
        await super()._connect_to_server(s)

    def _connect_command(self) -> bytes:
        server = self._current_server
        if server is not None and server.uri.scheme == "tls" and not self._server_info.get("tls_required"):
            raise NatsError("tls:// and the server offers no TLS")
        return super()._connect_command()


class NatsConnection:
    """A connection that is opened again whenever it is lost.

    Args:
        servers: addresses, as `nats://host:4222`; of one cluster, where there are several.
        lost: called on the loop when it is lost.
        options: of NATS' client, as `access` returns them.
    """

    def __init__(
        self, servers: Sequence[str], lost: Callable[[], None] = lambda: None, options: Mapping[str, Any] | None = None
    ) -> None:
        self._options = dict(options or {})
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
    def failure(self) -> str:
        """Why the servers cannot be reached; empty while they can."""
        return "" if self._client.is_connected else self._why

    def soon(self, callback: Callable[[], object]) -> None:
        """Call something on the loop, without waiting for it."""
        with contextlib.suppress(RuntimeError):  # it has closed
            self._loop.call_soon_threadsafe(callback)

    def start(self, work: Coroutine[Any, Any, _T]) -> Future[_T]:
        """Run a coroutine on the loop, without waiting for it."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call(self, work: Coroutine[Any, Any, _T], calls: float = 1.0) -> _T:
        """Run a coroutine on the loop that takes as long as so many calls, and wait for it.

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
        except (*ERRORS, CancelledError) as error:
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
            # Nothing is put into the client's buffer: it would be sent after its caller has given up.
            raise NatsError(self._why)
        version = client.connected_server_version
        if (version.major, version.minor, version.patch) < LEAST:
            raise NatsError(f"NATS {'.'.join(map(str, LEAST))} or newer is needed, this is {version}")
        return client

    async def create(self, name: str, bounds: Mapping[str, Any]) -> None:
        """Create a JetStream stream of the subjects below its name, unless there is one."""
        config = {
            "name": name,
            "subjects": [f"{name}.>"],
            "storage": "file",
            "retention": "limits",
            "discard": "old",
            "allow_direct": True,
            "num_replicas": MANY if len(self._servers) >= MANY else 1,
        }
        try:
            await self.ask(f"STREAM.CREATE.{name}", {**config, **bounds})
        except NatsRefusedError as refused:
            if refused.code != EXISTS:  # somebody who runs the servers may have changed it
                raise

    async def ask(self, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request to JetStream, and return the answer.

        Raises:
            NatsRefusedError: it says no.
        """
        answer = await self.request(f"$JS.API.{what}", json.dumps(request).encode())
        if "error" in answer:
            raise NatsRefusedError(answer["error"])
        return answer

    async def request(self, subject: str, data: bytes, headers: dict[str, str] | None = None) -> dict[str, Any]:
        """Send a message, and return what JetStream says to it."""
        reply = await self.client().request(subject, data, timeout=CALL_S, headers=headers)
        answer: dict[str, Any] = json.loads(reply.data)
        return answer

    async def read(self, name: str, request: Mapping[str, Any]) -> list[Msg]:
        """Return the messages of a JetStream stream that a request names, from the server that is nearest.

        Raises:
            NatsRefusedError: there is no such stream, or none that answers now.
        """
        client = self.client()
        inbox = client.new_inbox()
        subscription = await client.subscribe(inbox)
        messages: list[Msg] = []
        try:
            await client.publish(f"$JS.API.DIRECT.GET.{name}", json.dumps(request).encode(), reply=inbox)
            while not messages or "batch" in request:
                message = await subscription.next_msg(CALL_S)
                status = (message.headers or {}).get("Status")
                if status in ENDS:
                    break
                if status == NOBODY:
                    raise NatsRefusedError({"err_code": NO_STREAM, "description": f"nobody answers for {name}"})
                if status is not None:
                    raise NatsError(f"status {status}")
                messages.append(message)
        finally:
            await subscription.unsubscribe()
        return messages

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


def access(tls: Path | None = None, credentials: Path | None = None) -> dict[str, Any]:
    """Return the options of NATS' client that open a connection to servers that do not let everybody in.

    Args:
        tls: folder with the authority of the servers and, where they ask for one, the certificate of this service.
            None: the authorities of the system.
        credentials: file with a user's JWT and seed, as NATS' tools write it; or with one line, `user:password` or a
            token. None: what the addresses say.

    Raises:
        StoreError: a file cannot be read, or holds something else.
    """
    options: dict[str, Any] = {}
    if tls is not None:
        try:
            options["tls"] = context_of(tls)
        except OSError as error:  # also one of its contents
            raise StoreError(f"cluster_tls: {tls}: {error}") from error
    if credentials is not None:
        try:
            options |= _user(credentials)
        except (OSError, ValueError) as error:
            raise StoreError(f"cluster_credentials: {credentials}: {error}") from error
    return options


def _user(file: Path) -> dict[str, Any]:
    text = file.read_text(encoding="utf-8")
    if _JWT.search(text):
        _read(file)  # fails now rather than at every try to connect
        return {
            "user_jwt_cb": lambda: bytearray(_read(file)[0].encode()),
            "signature_cb": lambda nonce: base64.b64encode(_read(file)[1].sign(nonce.encode())),
        }
    lines = text.split()
    if len(lines) != 1:
        raise ValueError("expected a NATS user's JWT and seed, or one line: user:password, or a token")
    user, colon, password = lines[0].partition(":")
    return {"user": user, "password": password} if colon else {"token": lines[0]}


def _read(file: Path) -> tuple[str, Ed25519PrivateKey]:
    """Return the JWT of a user and the key that signs for it; read each time, so that a new file holds at once."""
    text = file.read_text(encoding="utf-8")
    jwt, seed = _JWT.search(text), _SEED.search(text)
    if jwt is None or seed is None:
        raise ValueError("expected a NATS user's JWT and seed")
    try:
        raw = base64.b32decode(seed[1] + "=" * (-len(seed[1]) % 8))
    except binascii.Error as error:
        raise ValueError("the seed is not written in base 32") from error
    if len(raw) != _SEED_BYTES:
        raise ValueError("the seed has another length")
    return jwt[1], Ed25519PrivateKey.from_private_bytes(raw[2:34])


def token(text: str) -> str:
    """Return a text in the letters that names of streams and subjects may have; `text_of` undoes it."""
    return re.sub(r"[^A-Za-z0-9-]", lambda found: f"_{ord(found[0]):02x}", text)


def text_of(written: str) -> str:
    """Return the text that `token` has written so."""
    return re.sub(r"_([0-9a-f]{2})", lambda found: chr(int(found[1], 16)), written)


def _shown(server: str) -> str:
    """Return an address without the password that it may hold."""
    return re.sub(r"//[^/@]*@", "//", server)

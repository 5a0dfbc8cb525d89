"""A Zenoh session: what is opened on it, what is asked over it, and how all of it is closed."""

import contextlib
import json
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh
from optipmb_schemas import Detections, Keys, Points, Topic, encoding_of
from optipmb_schemas.certificates import end_of, ended

from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Answer, Inbox
from optipmb_client.zenoh.configuration import DEFAULT_ENDPOINT, configuration
from optipmb_client.zenoh.sender import Sender, cached_sender, plain_sender
from optipmb_client.zenoh.subscription import Subscription, Subscriptions, subscribe

__all__ = ["Connection"]

NO_BOUND = 2**31 - 1  # of the replies to a query, in effect: they are all kept anyhow, and its timeout ends them

MOST_KEYS = 0xFFFF
"""Keys that a Zenoh session can declare in its life: it numbers them by 16 bits and gives no number back. Beyond, it
would use numbers again that are in use, and what is sent with these would be lost without an error."""

POLL_S = 0.02

PLAIN = 1
"""Keys that a publisher declares."""
CACHED = 2
"""Keys that a publisher with a cache declares, and a subscriber that asks caches for what was lost."""

_Opened = TypeVar("_Opened", Sender, Subscription)


class Connection:
    """A Zenoh session. Publishers and subscribers may share one; whoever opens it closes it.

    It can declare 65,535 keys in its life, and closing gives none back: a `Publisher` declares three, with a cache of
    clouds four, and a `Subscriber` two, with `on_problem` four. What a program opens beyond is refused with
    `ConnectionFailed`; another connection can open it.

    Args:
        connect: Endpoint or endpoints of routers (or of a service with its own router), such as ``tcp/10.0.0.1:7447``;
            the session is then a client of them. Default: ``tcp/127.0.0.1:7447``, unless `config` is given.
        config: A Zenoh configuration file (JSON5), for TLS, user names and everything else; its endpoints hold unless
            `connect` is given too.
        timeout: Seconds to wait for a router; `math.inf`: for ever.

    Raises:
        ConnectionFailed: Within `timeout`, when no router is reachable or an endpoint or the file is unusable.
    """

    def __init__(
        self,
        connect: str | Sequence[str] | None = None,
        *,
        config: str | Path | None = None,
        timeout: float = 5.0,
    ) -> None:
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect or ())
        if not endpoints and config is None:
            endpoints = (DEFAULT_ENDPOINT,)
        self.where = ", ".join(endpoints) or str(config)  # for people
        settings = configuration(endpoints, config, timeout)
        try:
            self._session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise self._unanswered(endpoints, timeout, settings) from error
        # A router that starts at this moment may be known and not linked yet: what is sent then is lost.
        ends = time.monotonic() + timeout
        while json.loads(settings.get_json("mode")) == "client" and not self._session.info.routers_zid():
            if time.monotonic() > ends:
                self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped
                raise self._unanswered(endpoints, timeout, settings)
            time.sleep(POLL_S)
        self._opened: weakref.WeakSet[Sender | Subscription] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._keys = 0
        # For programs that forget to close: messages that still stand in a batch would be lost at their end, and a
        # draining thread that wakes after the interpreter has ended would abort the process.
        self._finalizer = weakref.finalize(self, _close_all, self._opened, self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close everything opened on this connection, then the session. May be called twice."""
        self._finalizer()

    @property
    def closed(self) -> bool:
        """Whether `close` has been called."""
        return self._session.is_closed()

    def _unanswered(self, endpoints: tuple[str, ...], timeout: float, settings: zenoh.Config) -> ConnectionFailed:
        names = ("connect_certificate", "root_ca_certificate")
        found = [json.loads(settings.get_json(f"transport/link/tls/{name}")) for name in names]
        ends = [ended(Path(file), end_of(Path(file))) for file in found if file]
        advice = "; ".join(filter(None, ends)) or "is optipmb-service running there?"
        if any(found) and not any(ends):
            advice = "is optipmb-service running there, and does its TLS certificate hold?"
        return ConnectionFailed(
            f"nothing answers at {self.where} (waited {timeout:g} s); {advice}",
            endpoints=endpoints,
            timeout=timeout,
        )

    def cached_sender(self, key: str, encoding: str, *, cache: int) -> Sender:
        """Open a publisher for small messages that must not get lost: it keeps the newest `cache` for recovery."""
        self._count(CACHED)
        with _usable():
            return self._keep(cached_sender(self._session, key, encoding, cache))

    def plain_sender(self, key: str, encoding: str, *, cache: int = 0) -> Sender:
        """Open a publisher for large messages: lower priority than the small ones; with `cache` it keeps the newest."""
        self._count(CACHED if cache else PLAIN)
        with _usable():
            return self._keep(plain_sender(self._session, key, encoding, cache))

    def subscribe(self, pattern: str, inbox: Inbox) -> Subscription:
        """Move all that is published under `pattern` into `inbox`; losses are recovered from the publishers' caches.

        What those caches hold from before the subscription comes first. (Recovery would bring it anyhow, at the first
        heartbeat of a publisher: for it a late subscriber is one that has lost everything so far.)
        """
        (subscription,) = self._subscribe([pattern], inbox)
        return subscription

    def senders(self, stream: str, *, prefix: str, cache: int, cache_clouds: int) -> tuple[Sender, Sender]:
        """Open what sends the detections and the clouds of a stream, each keeping the newest for recovery."""
        session, keys = self._session, Keys(prefix)
        self._count(CACHED + (CACHED if cache_clouds else PLAIN))
        with _usable():
            return (
                self._keep(cached_sender(session, keys.detections(stream), encoding_of(Detections), cache)),
                self._keep(plain_sender(session, keys.points(stream), encoding_of(Points), cache_clouds)),
            )

    def subscribe_tracks(self, pattern: str, inbox: Inbox, *, prefix: str, problems: bool) -> Subscriptions:
        """Move the tracks of a pattern into an inbox, its problems too where that is asked for."""
        topics: tuple[Topic, ...] = ("tracks", "problems") if problems else ("tracks",)
        return Subscriptions(self._subscribe([Keys(prefix).matching(pattern, topic) for topic in topics], inbox))

    def query(self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float = 2.0) -> tuple[Answer, ...]:
        """Ask everybody who answers at `key`; an empty result means that nobody did within `timeout` seconds."""
        answers = []
        with _usable():
            replies = self._session.get(
                key,
                zenoh.handlers.FifoChannel(NO_BOUND),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # the default keeps one reply per key: of two services one
                timeout=timeout,
                payload=payload or None,
                encoding=encoding or None,
            )
            for reply in replies:
                if (sample := reply.ok) is not None:
                    text = str(sample.encoding)
                    answers.append(Answer(str(sample.key_expr), sample.payload.to_bytes(), text, ok=True))
                elif (error := reply.err) is not None and (said := error.payload.to_bytes()) != b"Timeout":
                    answers.append(Answer(key, said, str(error.encoding), ok=False))
        return tuple(answers)

    def alive(self, pattern: str, *, timeout: float = 2.0) -> tuple[str, ...]:
        """Keys of the liveliness tokens under `pattern`, sorted."""
        with _usable():
            replies = self._session.liveliness().get(pattern, zenoh.handlers.FifoChannel(NO_BOUND), timeout=timeout)
            return tuple(sorted({str(sample.key_expr) for reply in replies if (sample := reply.ok) is not None}))

    def _subscribe(self, patterns: Sequence[str], inbox: Inbox) -> list[Subscription]:
        """Open a subscription to each pattern, or none of them."""
        self._count(CACHED * len(patterns))
        with _usable():
            return [self._keep(subscribe(self._session, pattern, inbox)) for pattern in patterns]

    def _count(self, keys: int) -> None:
        """Count keys that are going to be declared.

        Raises:
            ConnectionFailed: they are more than are left.
        """
        with self._lock:
            if self._keys + keys > MOST_KEYS:
                raise ConnectionFailed(
                    f"this connection has declared {self._keys} keys and cannot declare more: open another one"
                )
            self._keys += keys

    def _keep(self, opened: _Opened) -> _Opened:
        self._opened.add(opened)
        return opened


@contextlib.contextmanager
def _usable() -> Iterator[None]:
    """Turn Zenoh's error for whatever cannot be done on a session into ours."""
    try:
        yield
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]  # what follows is a place in Zenoh's own source
        raise ConnectionFailed(f"the connection cannot be used: {reason}") from error


def _close_all(opened: weakref.WeakSet[Sender | Subscription], session: Any) -> None:
    for one in tuple(opened):
        one.close()
    with contextlib.suppress(zenoh.ZError):
        session.close()

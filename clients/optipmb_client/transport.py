"""Zenoh, and nothing else: the one module of the client that imports it.

Conventions: payloads are bytes, keys are text, times are `time.monotonic_ns()`. Four rules avoid Zenoh's known traps:

- No callback of ours ever runs on a thread of the network. Each subscription has a daemon thread that always drains its
  channel into an `Inbox`, which drops its oldest entry when its reader is too slow. So a slow program delays nobody,
  closing never waits for a full channel, and a program that forgets to close still ends.
- Publishers of the same connection answer on the very thread that subscribes or asks, before the call returns, and with
  the lock of a cache held. So what they answer must find room: a subscription is drained from before it is declared,
  and the channel of a query has no bound.
- Closing goes from the outside in: subscriptions, publishers, session. After that nothing is delivered any more.
- Implicit shared memory is off: it loses messages without a word when a receiver stalls.
"""

import collections
import contextlib
import json
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, TypeAlias, TypeVar, cast

import zenoh
import zenoh.ext
from optipmb_schemas import Detections, Keys, Message, Points, Topic, decode, encode, encoding_of
from optipmb_schemas.late_join import ANSWER_S, CacheQueries, LateJoin

from optipmb_client.errors import ConnectionFailed

__all__ = ["DEFAULT_ENDPOINT", "Answer", "Arrival", "Connection", "Inbox", "Sender", "Subscription"]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
NO_BOUND = 2**31 - 1  # of the replies to a query, in effect: they are all kept anyhow, and its timeout ends them
CLOSE_S = 5.0  # how long closing waits for what has come to be moved
_Message = TypeVar("_Message", bound=Message)
_Result = TypeVar("_Result")

HEARTBEAT_S = 1.0  # how long the loss of a newest message may stay unnoticed, when no other one follows
WAIT_BEFORE_DROP_US = 50_000  # with the defaults (1 ms) large messages are lost whenever the machine is busy
WAIT_BEFORE_DROP_FRAGMENTS_US = 500_000
CLOUD_BATCHES = 16  # of 64 kB on the way to the network: with the default of 2 sending a cloud takes four times as long


# The parts of Zenoh's objects used here, typed: its own stubs leave some of them untyped, and one wrongly typed.
class _ZenohPublisher(Protocol):
    def put(self, payload: bytes) -> object: ...


class _ZenohMatchingStatus(Protocol):
    @property
    def matching(self) -> bool: ...


class _ZenohMatching(Protocol):
    @property
    def matching_status(self) -> _ZenohMatchingStatus: ...


class _ZenohSubscriber(Protocol):
    def undeclare(self) -> object: ...


_Handler: TypeAlias = "tuple[zenoh.handlers.Callback[zenoh.Sample], None]"  # the class cannot be subscripted


class _ZenohSession(Protocol):
    def close(self) -> object: ...


@dataclass(frozen=True)
class Arrival:
    """A message as it came in: key, payload, Zenoh encoding, and the monotonic time of its arrival in nanoseconds."""

    key: str
    payload: bytes
    encoding: str
    monotonic_ns: int

    def read(self, kind: type[_Message]) -> _Message:
        """Return the message, checked.

        Raises:
            MessageError: it is not valid.
        """
        return decode(self.payload, kind, encoding=self.encoding)


@dataclass(frozen=True)
class Answer:
    """A reply to a query; `ok` is False for an error reply, whose payload then says why."""

    key: str
    payload: bytes
    encoding: str
    ok: bool


class Inbox:
    """A bounded queue from the draining thread to one reader; when it is full the oldest entry goes, and is counted."""

    def __init__(self, capacity: int) -> None:
        self._entries: collections.deque[Arrival] = collections.deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0

    @property
    def pending(self) -> int:
        """Entries waiting to be read."""
        return len(self._entries)

    def put(self, arrival: Arrival) -> None:
        """Append an entry; never waits. After `close` it does nothing."""
        with self._changed:
            if self._closed:
                return
            if len(self._entries) >= self._capacity:
                self._entries.popleft()
                self.dropped += 1
            self._entries.append(arrival)
            self._changed.notify()

    def get(self, timeout: float | None = None) -> Arrival | None:
        """Take the oldest entry, waiting up to `timeout` seconds (None: for ever); None when there is none."""
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._closed, timeout)
            if not self._entries:
                return None
            return self._entries.popleft()

    @property
    def closed(self) -> bool:
        """Whether nothing will come any more (what is there can still be read)."""
        return self._closed

    def close(self) -> None:
        """Wake the reader for good."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Sender:
    """A publisher of encoded messages on one key."""

    def __init__(self, publisher: _ZenohPublisher, matching: _ZenohMatching | None) -> None:
        self._publisher: _ZenohPublisher | None = publisher
        self._matching = matching

    @property
    def wanted(self) -> bool:
        """Whether somebody is known to listen. Always True with a cache: that also serves those who come later."""
        matching = self._matching  # `close` may take it away meanwhile
        return matching is None or matching.matching_status.matching

    def pack(self, message: Message) -> bytes:
        """Return a message as it is sent."""
        return encode(message)

    def put(self, payload: bytes) -> None:
        """Send one message; does not wait for anybody to receive it.

        Raises:
            ConnectionFailed: After `close`.
        """
        publisher = self._publisher
        if publisher is None:
            raise ConnectionFailed("this publisher has been closed")
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            raise ConnectionFailed("this publisher has been closed") from error

    def close(self) -> None:
        """Withdraw the publisher.

        It is let go of; a message that another thread is sending may still go out. What Zenoh calls `undeclare` waits
        for the heartbeats to end with the lock of the interpreter held; while the thread that sends them waits for that
        lock, the whole process would be blocked for ten seconds.
        """
        self._publisher = self._matching = None


class Subscription:
    """Samples that a thread moves into an inbox.

    Args:
        declare: Declares the subscriber with the handler that it is given.
        inbox: Where samples go.
        session: For the caches of publishers that were there before the subscription.
    """

    def __init__(self, declare: Callable[[_Handler], _ZenohSubscriber], inbox: Inbox, session: zenoh.Session) -> None:
        self._inbox = inbox
        self._session = session
        self._queries: CacheQueries[zenoh.Sample] = CacheQueries(self._ask)
        self._late_join: LateJoin[zenoh.Sample] = LateJoin(self._receive, self._queries.ask)
        self._draining: threading.Thread | None = None
        self._drained = threading.Event()
        # Zenoh calls back on a Python thread that it starts for the handler, before it declares anything. It is a pair:
        # with a callback alone the subscription would go on until the session is closed.
        handler = zenoh.handlers.Callback(self._take, self._end), None
        self._subscriber = _on_a_daemon_thread(lambda: declare(handler))

    def _take(self, sample: zenoh.Sample) -> None:
        self._draining = threading.current_thread()
        if sample.kind == zenoh.SampleKind.PUT:
            self._late_join.take(sample)

    def _end(self) -> None:
        self._draining = threading.current_thread()
        self._drained.set()

    def _receive(self, sample: zenoh.Sample) -> None:
        arrived = time.monotonic_ns()
        payload = sample.payload.to_bytes()
        self._inbox.put(Arrival(str(sample.key_expr), payload, str(sample.encoding), arrived))

    def _ask(self, selector: str, reply: Callable[[zenoh.Sample], None], end: Callable[[bool], None]) -> None:
        errors = []

        def take(answer: zenoh.Reply) -> None:
            if (sample := answer.ok) is not None:
                reply(sample)
            else:
                errors.append(answer.err)

        try:
            self._session.get(
                selector,
                zenoh.handlers.Callback(take, lambda: end(not errors)),
                accept_replies=zenoh.ReplyKeyExpr.ANY,  # a cache answers with the keys that it caches
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_S,
            )
        except zenoh.ZError:  # the session is closed
            end(False)

    @property
    def alive(self) -> bool:
        """Whether something may still come into the inbox."""
        return not self._drained.is_set()

    def close(self) -> None:
        """End the subscription; what is in the inbox stays readable."""
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()
        if self._draining is not threading.current_thread():  # which ends what a program forgot to close
            self._drained.wait(CLOSE_S)
            if (draining := self._draining) is not None:
                draining.join(CLOSE_S)
        self._queries.close()
        self._late_join.close()


def _on_a_daemon_thread(work: Callable[[], _Result]) -> _Result:
    """Do something on a daemon thread: threads that it starts are daemons, too, and keep no program from ending."""
    done: Future[_Result] = Future()

    def do() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001  raised where the result is waited for
            done.set_exception(error)

    threading.Thread(target=do, name="declare", daemon=True).start()
    return done.result()


class Subscriptions:
    """Several of them, which end together."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions

    def close(self) -> None:
        """End all; what is in the inbox stays readable."""
        for subscription in self._subscriptions:
            subscription.close()


_Opened = TypeVar("_Opened", Sender, Subscription)


class Connection:
    """A Zenoh session. Publishers and subscribers may share one; whoever opens it closes it.

    Args:
        connect: Endpoint or endpoints of routers (or of a service with its own router), such as ``tcp/10.0.0.1:7447``;
            the session is then a client of them. Default: ``tcp/127.0.0.1:7447``, unless `config` is given.
        config: A Zenoh configuration file (JSON5), for TLS, user names and everything else; its endpoints hold unless
            `connect` is given too.
        timeout: Seconds to wait for a router.

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
        settings = _settings(endpoints, config, timeout)
        try:
            self._session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise ConnectionFailed(
                f"nothing answers at {self.where} (waited {timeout:g} s); is optipmb-service running there?",
                endpoints=endpoints,
                timeout=timeout,
            ) from error
        self._opened: weakref.WeakSet[Sender | Subscription] = weakref.WeakSet()
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

    def cached_sender(self, key: str, encoding: str, *, cache: int) -> Sender:
        """Open a publisher for small messages that must not get lost: it keeps the newest `cache` for recovery."""
        with _usable():
            publisher = zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_HIGH,
                express=True,
                cache=zenoh.ext.CacheConfig(cache),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        return self._keep(Sender(publisher, None))

    def plain_sender(self, key: str, encoding: str, *, cache: int = 0) -> Sender:
        """Open a publisher for large messages: lower priority than the small ones; with `cache` it keeps the newest."""
        with _usable():
            if cache:
                cached = zenoh.ext.declare_advanced_publisher(
                    self._session,
                    key,
                    encoding=encoding,
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.DATA_LOW,
                    cache=zenoh.ext.CacheConfig(cache),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                    publisher_detection=True,
                )
                return self._keep(Sender(cached, None))
            publisher = self._session.declare_publisher(
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )
        return self._keep(Sender(publisher, cast("_ZenohMatching", publisher)))  # the stub calls the status a bool

    def subscribe(self, pattern: str, inbox: Inbox) -> Subscription:
        """Move all that is published under `pattern` into `inbox`; losses are recovered from the publishers' caches.

        What those caches hold from before the subscription comes first. (Recovery would bring it anyhow, at the first
        heartbeat of a publisher: for it a late subscriber is one that has lost everything so far.)
        """

        def declare(handler: _Handler) -> _ZenohSubscriber:
            return zenoh.ext.declare_advanced_subscriber(
                self._session,
                pattern,
                handler,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )

        with _usable():
            return self._keep(Subscription(declare, inbox, self._session))

    def senders(self, stream: str, *, prefix: str, cache: int, cache_clouds: int) -> tuple[Sender, Sender]:
        """Open what sends the detections and the clouds of a stream, each keeping the newest for recovery."""
        keys = Keys(prefix)
        return (
            self.cached_sender(keys.detections(stream), encoding_of(Detections), cache=cache),
            self.plain_sender(keys.points(stream), encoding_of(Points), cache=cache_clouds),
        )

    def subscribe_tracks(self, pattern: str, inbox: Inbox, *, prefix: str, problems: bool) -> Subscriptions:
        """Move the tracks of a pattern into an inbox, its problems too where that is asked for."""
        topics: tuple[Topic, ...] = ("tracks", "problems") if problems else ("tracks",)
        return Subscriptions([self.subscribe(Keys(prefix).matching(pattern, topic), inbox) for topic in topics])

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

    def _keep(self, opened: _Opened) -> _Opened:
        self._opened.add(opened)
        return opened


def _settings(endpoints: tuple[str, ...], config: str | Path | None, timeout: float) -> zenoh.Config:
    try:
        settings = zenoh.Config() if config is None else zenoh.Config.from_file(config)
        if config is None:
            values: dict[str, object] = {
                "mode": "client",
                "transport/link/tx/queue/size/data_low": CLOUD_BATCHES,
                "scouting/multicast/enabled": False,
                "transport/shared_memory/enabled": False,
                "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
                "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": (
                    WAIT_BEFORE_DROP_FRAGMENTS_US
                ),
            }
            for key, value in values.items():
                settings.insert_json5(key, json.dumps(value))
        if endpoints:
            settings.insert_json5("connect/endpoints", json.dumps(endpoints))
        settings.insert_json5("connect/timeout_ms", json.dumps(int(timeout * 1e3)))
        retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
        settings.insert_json5("connect/retry", json.dumps(retry))
    except (zenoh.ZError, OSError) as error:
        if config is not None and not Path(config).is_file():
            raise ConnectionFailed(f"there is no Zenoh configuration file at {config}") from error
        where = " ".join([*endpoints, *([str(config)] if config else [])])
        raise ConnectionFailed(
            f"not a usable Zenoh endpoint or configuration: {where} (an endpoint looks like {DEFAULT_ENDPOINT})",
            endpoints=endpoints,
        ) from error
    return settings


@contextlib.contextmanager
def _usable() -> Iterator[None]:
    """Turn Zenoh's error for whatever cannot be done on a session into ours."""
    try:
        yield
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]  # what follows is a place in Zenoh's own source
        raise ConnectionFailed(f"the connection cannot be used: {reason}") from error


def _close_all(opened: weakref.WeakSet[Sender | Subscription], session: _ZenohSession) -> None:
    for one in tuple(opened):
        one.close()
    with contextlib.suppress(zenoh.ZError):
        session.close()

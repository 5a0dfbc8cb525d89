"""The link to Zenoh: a session with its declarations and queries."""

import contextlib
import logging
import queue
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias, TypeVar

import zenoh
import zenoh.ext
from optipmb_schemas import Detections, Keys, Points, Problem, encoding_of

from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Answer, Arrival
from optipmb_client.trace_context import attached
from optipmb_client.zenoh.handles import (
    CLOSE_S,
    Declaration,
    Dispatcher,
    ItemQueue,
    Query,
    Sender,
    directly,
    reason,
    usable,
)
from optipmb_client.zenoh.late_join import ANSWER_S, CacheQueries, LateJoin

__all__ = ["EVERYTHING", "NEWEST", "KeyNumbers", "Opened", "Sample", "ZenohSession", "opened"]

MOST_KEYS = 0xFFFF
"""Keys that a Zenoh session can declare in its life: it numbers them by 16 bits and gives no number back. Beyond, it
would use numbers again that are in use, and messages with these would be lost without an error."""

PLAIN = 1
"""Key numbers of a publisher, a subscriber, a queryable or a declared key. Tokens and queries need none."""
CACHED = 2
"""Key numbers of a publisher with a cache, and of a subscriber with recovery: they also declare `@adv` keys."""

CHANNEL = 4096
"""Tokens and links between Zenoh and a reading thread."""

SUBSCRIBED = 1024
"""Samples between Zenoh and a reading thread; more than any publisher's history."""

LATE_S = 1.0
"""Time after its timeout within which a query still may end."""

HEARTBEAT_S = 1.0
"""How long the loss of a newest message may stay unnoticed when no other one follows.

Heartbeats go on in silence: one that is sent once alone could be lost with the message, as when a router is started
again. For that they are not often: thousands of silent publishers cost little.
"""

EVERYTHING = zenoh.ext.HistoryConfig(detect_late_publishers=True)
"""History of a subscription: all that caches hold, also caches of later publishers."""

NEWEST = zenoh.ext.HistoryConfig(detect_late_publishers=False, max_samples=1)
"""Without the newest message, the first heartbeat of each publisher would bring all that its cache holds.

Late publishers are not detected: after a link was lost, the newest message would come so before its predecessors, and
Zenoh would take these for lost. Heartbeats tell of missed messages.
"""

_RECOVERY = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)

Opened: TypeAlias = zenoh.Session
Sample: TypeAlias = zenoh.Sample
_Item = TypeVar("_Item")
_log_failure = partial(logging.getLogger("optipmb_client").exception, "the receiver of %s failed")


@dataclass(frozen=True)
class KeyNumbers:
    """Keys that a session has declared in its life, and those still declared."""

    declared: int = 0
    open: int = 0


def opened(config: zenoh.Config) -> Opened:
    """Open a session of Zenoh's, on a thread: Ctrl-C, which `zenoh.open` does not see, ends the wait for an answer.

    Raises:
        ConnectionFailed: The configuration or an endpoint cannot be used, or there is no answer.
    """
    answer: Future[Opened] = Future()

    def attempt() -> None:
        found: Opened | BaseException
        try:
            found = zenoh.open(config)
        except BaseException as error:  # noqa: BLE001  the waiting thread raises it
            found = error
        if answer.set_running_or_notify_cancel() and isinstance(found, BaseException):
            answer.set_exception(found)
        elif isinstance(found, BaseException):
            return
        elif answer.cancelled():
            close_session(found)
        else:
            answer.set_result(found)

    threading.Thread(target=attempt, name="open", daemon=True).start()
    try:
        return answer.result()
    except zenoh.ZError as error:
        raise ConnectionFailed(reason(error)) from error
    except KeyboardInterrupt:
        answer.cancel()
        raise


def close_session(session: Opened) -> None:
    """Close a session of Zenoh's, also one that is closed."""
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped


class ZenohSession:
    """A Zenoh session with its declarations; may be used by any threads, but not by callbacks of the network.

    It can declare `MOST_KEYS` keys in its life, and closing gives none back. All methods raise `ConnectionFailed` when
    it is closed; methods that declare keys also when none is left.

    Args:
        session: Zenoh's.
        failed: Called with the name of a subscription or queryable in place of an exception of its receiver.
    """

    def __init__(self, session: Opened, failed: Callable[[str], object] = _log_failure) -> None:
        self._session = session
        self._failed = failed
        self._lock = threading.Lock()
        self._keys = self._open_keys = 0
        self._readings: set[Dispatcher] = set()
        self._declared: set[Declaration] = set()
        """References: Zenoh withdraws declarations without any. Senders are withdrawn so."""
        self._senders: weakref.WeakSet[Sender] = weakref.WeakSet()
        self._linking: set[str] = set()
        """Routers to which a link is being set up."""
        self._held: list[Callable[[], object]] = []
        """Withdrawals that wait for the end of that."""
        self._link_listeners = self._follow_links()

    @property
    def closed(self) -> bool:
        """Whether `close` has been called."""
        return self._session.is_closed()

    def linked(self) -> bool:
        """Return whether it has a router."""
        return bool(self._session.info.routers_zid())

    @property
    def id(self) -> str:
        """Zenoh's id of the session."""
        return str(self._session.info.zid())

    @property
    def key_numbers(self) -> KeyNumbers:
        """Key numbers that were used, and those in use."""
        with self._lock:
            return KeyNumbers(self._keys, self._open_keys)

    def stop(self, timeout: float = CLOSE_S) -> None:
        """Read nothing any more; items received before are handed over, within `timeout` seconds for each reading."""
        readings = tuple(self._readings)
        for one in readings:
            one.withdraw()
        for one in readings:
            one.close(timeout)

    def close(self, timeout: float = CLOSE_S) -> None:
        """Close everything from the outside in: readings, publishers and tokens, the session."""
        self.stop(timeout)
        for one in (*self._senders, *self._declared):
            one.close()
        close_session(self._session)

    # Sending

    def senders(self, keys: Keys, stream: str, *, cache: int, cache_clouds: int) -> tuple[Sender, Sender]:
        """Open what sends the detections and the clouds of a stream, each keeping the newest for recovery."""
        self.require(CACHED + (CACHED if cache_clouds else PLAIN))
        detections = self.cached_sender(keys.detections(stream), encoding_of(Detections), cache=cache)
        return detections, self.plain_sender(keys.points(stream), encoding_of(Points), cache=cache_clouds)

    def cached_sender(self, key: str, encoding: str, *, cache: int, detected: bool = True) -> Sender:
        """Open a publisher for small messages that must not get lost: it keeps the newest `cache` for recovery.

        With `detected` a token says that the publisher is there, from before its first message.
        """
        return self.sender(key, encoding, cache, zenoh.Priority.DATA_HIGH, express=True, detected=detected)

    def plain_sender(self, key: str, encoding: str, *, cache: int = 0) -> Sender:
        """Open a publisher for large messages: lower priority than the small ones; with `cache` it keeps the newest."""
        return self.sender(key, encoding, cache or None, zenoh.Priority.DATA_LOW)

    def sender(
        self,
        key: str,
        encoding: str = "",
        cache: int | None = None,
        priority: zenoh.Priority = zenoh.Priority.DATA,
        *,
        express: bool = False,
        detected: bool = True,
    ) -> Sender:
        """Open a publisher that does not wait; with `cache` it keeps its newest messages for recovery."""
        options: dict[str, Any] = {
            "encoding": encoding or None,
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": priority,
            "express": express,
        }
        if cache is not None:
            heartbeat = zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
            options |= {"cache": zenoh.ext.CacheConfig(cache), "sample_miss_detection": heartbeat}
            options |= {"publisher_detection": detected}
        keys = PLAIN if cache is None else CACHED
        with self._counted(keys):
            publisher: Any = (
                self._session.declare_publisher(key, **options)
                if cache is None
                else zenoh.ext.declare_advanced_publisher(self._session, key, **options)
            )
        sender = Sender(publisher, lambda _: self._free(keys), self._withdraw, cached=cache is not None)
        self._senders.add(sender)
        return sender

    def put(self, key: str, payload: bytes, encoding: str) -> None:
        """Send one message at low priority, without a publisher."""
        with usable():
            self._session.put(
                key,
                payload,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )

    # Receiving

    def subscribe(self, key: str, receive: Callable[[Arrival], object], *, history: bool | None = None) -> Dispatcher:
        """Hand over all that is published under `key`, on a thread of its own.

        Losses are recovered from the publishers' caches. What those caches hold from before comes first: with
        `history` at once, with None when a publisher is heard of. With False it does not come, and this returns when
        the caches have named their newest samples: later samples come.
        """
        after_loss: set[str] = set()

        def hand_over(sample: Sample) -> None:
            at = str(sample.key_expr)
            lost = at in after_loss
            after_loss.discard(at)
            payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
            parent = attached(sample.attachment.to_bytes()) if sample.attachment is not None else ""
            try:
                receive(Arrival(at, payload, encoding, time.monotonic_ns(), after_loss=lost, traceparent=parent))
            except Exception:  # noqa: BLE001 - one message must not end the subscription; `failed` reports it
                self._failed(key)

        queries: CacheQueries[Sample] = CacheQueries(self.ask)
        late_join: LateJoin[Sample] = LateJoin(hand_over, queries.ask, lost=after_loss.add, waits=history is False)

        def ended() -> None:
            queries.close()
            late_join.close()

        samples: ItemQueue[Sample] = ItemQueue(SUBSCRIBED)
        declared = self.listen(key, samples.put, recovers=True, history=EVERYTHING if history else None)
        if history is False:  # samples after the newest ones of the caches are new
            newest: list[Sample] = []
            begun = threading.Event()

            def begin(_: bool) -> None:  # noqa: FBT001 - as `CacheQueries` has it called
                late_join.begin(newest)
                begun.set()

            queries.ask(f"{key}/@adv/pub/**?_max=1", newest.append, begin)
            begun.wait(ANSWER_S)
        return self._read(key, declared, samples, late_join.take, ended)

    def read_newest(self, key: str, receive: Callable[[Sample], None], *, most: int = 1) -> Dispatcher:
        """Hand over samples on a thread of its own; the newest `most` may wait."""
        with self._counted(PLAIN):
            subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(most))

        def take(sample: Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                receive(sample)

        return self._read(key, self._keep(subscriber.undeclare, PLAIN), subscriber.handler, take)

    def listen(
        self, key: str, receive: Callable[[Sample], object], *, recovers: bool = False, history: Any = None
    ) -> Declaration:
        """Hand over samples on the thread of the network that brings them, which must not be kept waiting.

        Args:
            key: The key expression.
            receive: Called for each sample.
            recovers: Whether losses are recovered from the publishers' caches. To declare that takes Zenoh several
                times as long, and longer the more is declared already.
            history: Messages of caches at the beginning: `EVERYTHING`, `NEWEST` or None.
        """

        def take(sample: Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                receive(sample)

        advanced = recovers or history is not None
        keys = CACHED if advanced else PLAIN
        with self._counted(keys):
            subscriber: Any = (
                zenoh.ext.declare_advanced_subscriber(
                    self._session, key, directly(take), history=history, recovery=_RECOVERY if recovers else None
                )
                if advanced
                else self._session.declare_subscriber(key, directly(take))
            )
        return self._keep(subscriber.undeclare, keys)

    def declare_key(self, key: str) -> Declaration:
        """Declare a key whose messages are received by a subscription to a pattern.

        Zenoh hands over the messages of a declared key without comparing it with all subscriptions for each of them.
        """
        with self._counted(PLAIN):
            number = self._session.declare_keyexpr(key)
        return self._keep(lambda: self._session.undeclare(number), PLAIN)

    # Tokens and links

    def token(self, key: str) -> Declaration:
        """Declare a liveliness token."""
        with usable():
            token = self._session.liveliness().declare_token(key)
        return self._keep(token.undeclare, 0)

    def watch(self, pattern: str, changed: Callable[[str, bool], object]) -> Dispatcher:
        """Tell which tokens of a pattern are there, and which come (True) and go, on a thread of its own."""
        tokens: ItemQueue[Sample] = ItemQueue(CHANNEL)
        with usable():
            subscriber = self._session.liveliness().declare_subscriber(pattern, directly(tokens.put), history=True)

        def take(sample: Sample) -> None:
            changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        return self._read(pattern, self._keep(subscriber.undeclare, 0), tokens, take)

    def watch_links(self, changed: Callable[[str, str, bool], object]) -> Dispatcher:
        """Tell the id and kind of the nodes and routers that are linked, and that come (True) and go."""
        events: ItemQueue[Any] = ItemQueue(CHANNEL)
        with usable():
            listener = self._session.info.declare_transport_events_listener(directly(events.put), history=True)

        def take(event: Any) -> None:
            peer = event.transport
            changed(str(peer.zid), str(peer.whatami), event.kind == zenoh.SampleKind.PUT)

        return self._read("links", self._keep(listener.undeclare, 0), events, take)

    def alive(self, pattern: str, *, timeout: float = 2.0) -> tuple[str, ...]:
        """Keys of the liveliness tokens under `pattern`, sorted."""
        with usable():
            replies = self._replies(timeout, partial(self._session.liveliness().get, pattern, timeout=timeout))
            return tuple(sorted({str(sample.key_expr) for reply in replies if (sample := reply.ok) is not None}))

    # Queries

    def serve(self, key: str, answer: Callable[[Query], None], *, most: int, refusal: Problem) -> Dispatcher:
        """Hand over the queries of a key expression on a thread of its own, in their order.

        Args:
            key: The key expression.
            answer: Called for each query; it is to be finished, on any thread.
            most: Queries that may be open. The thread that brings them brings messages, too, and must not wait.
            refusal: Answer to those beyond.
        """
        room = threading.Semaphore(most)
        queries: ItemQueue[Query] = ItemQueue(most)

        def take(query: zenoh.Query) -> None:
            if room.acquire(blocking=False):
                queries.put(Query(query, room.release))
                return
            refused = Query(query)
            with contextlib.suppress(ConnectionFailed):  # the asker is gone
                refused.refuse(refusal)
            refused.finish()

        with self._counted(PLAIN):
            queryable = self._session.declare_queryable(key, directly(take))
        return self._read("queries", self._keep(queryable.undeclare, PLAIN), queries, answer)

    def query(
        self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float = 2.0, background: bool = False
    ) -> tuple[Answer, ...]:
        """Send a query to all that answer at `key`; an empty result means no answer within `timeout` seconds.

        With `background` only other sessions are asked, at the lowest priority: the question overtakes no message.
        """
        options = _options(timeout, background=background) | {"payload": payload or None, "encoding": encoding or None}
        answers = []
        with usable():
            for reply in self._replies(timeout, partial(self._session.get, key, **options)):
                if (sample := reply.ok) is not None:
                    about = "" if sample.attachment is None else sample.attachment.to_string()
                    text = str(sample.encoding)
                    answers.append(Answer(str(sample.key_expr), sample.payload.to_bytes(), text, ok=True, about=about))
                elif (error := reply.err) is not None and (said := error.payload.to_bytes()) != b"Timeout":
                    answers.append(Answer(key, said, str(error.encoding), ok=False))
        return tuple(answers)

    def cached(self, key: str, *, timeout: float = 2.0) -> list[Answer]:
        """Return the messages in publishers' caches under a key expression, in the order of each publisher."""
        return [one for one in self.query(f"{key}/@adv/**", timeout=timeout) if one.ok]

    def ask(
        self,
        selector: str,
        reply: Callable[[Sample], object],
        end: Callable[[bool], object] = lambda _: None,
        *,
        timeout: float = ANSWER_S,
        background: bool = False,
    ) -> None:
        """Ask without waiting: `reply` is called with each answer, and `end` when no more comes, on another thread.

        `end` gets whether all have answered in time; in a closed session, False. With `background` only other
        sessions are asked, at the lowest priority, and not at all where the link is congested.
        """
        errors = []

        def take(answer: zenoh.Reply) -> None:
            if (sample := answer.ok) is not None:
                reply(sample)
            else:
                errors.append(answer.err)

        options = _options(timeout, background=background)
        if background:
            options["congestion_control"] = zenoh.CongestionControl.DROP
        try:
            self._session.get(selector, zenoh.handlers.Callback(take, lambda: end(not errors)), **options)
        except zenoh.ZError:
            end(False)

    @staticmethod
    def _replies(timeout: float, ask: Callable[[Any], object]) -> Iterator[zenoh.Reply]:
        """Yield the replies to a query that `ask` sends; none that comes later than the query may take.

        Queryables of the same session answer on the thread that asks, before it can read: a channel with a bound, as
        Zenoh's own, would wait for room for ever, with the lock of a cache held. The bound is the time.
        """
        replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        ends = time.monotonic() + timeout + LATE_S
        ask(zenoh.handlers.Callback(replies.put, partial(replies.put, None), indirect=False))
        with contextlib.suppress(queue.Empty):
            while (reply := replies.get(timeout=max(0.0, ends - time.monotonic()))) is not None:
                yield reply

    # Declarations

    def _read(
        self,
        name: str,
        declared: Declaration,
        items: Iterable[_Item],
        receive: Callable[[_Item], None],
        ended: Callable[[], None] = lambda: None,
    ) -> Dispatcher:
        def forget(reading: Dispatcher) -> None:
            self._readings.discard(reading)
            ended()

        reading = Dispatcher(name, declared, items, receive, self._failed, forget)
        self._readings.add(reading)
        return reading

    def _keep(self, undeclare: Callable[[], object], keys: int) -> Declaration:
        def forget(declared: Declaration) -> None:
            self._declared.discard(declared)
            self._free(keys)

        declared = Declaration(partial(self._withdraw, undeclare), forget)
        self._declared.add(declared)
        return declared

    def _follow_links(self) -> tuple[object, object]:
        """Have withdrawals wait while Zenoh sets up a link to a router; return references to the listeners.

        Zenoh collects the declarations and sends them to the new router without a lock in between. A withdrawal would
        overtake its declaration, which the router would then keep until the link ends. The same thread reports the
        transport before this, and its link after it.
        """

        def follow_transport(event: Any) -> None:
            if event.transport.whatami == zenoh.WhatAmI.ROUTER:
                follow(str(event.transport.zid), begins=event.kind == zenoh.SampleKind.PUT)

        def follow(router: str, *, begins: bool) -> None:
            with self._lock:
                if begins:
                    self._linking.add(router)
                    return
                self._linking.discard(router)
                if self._linking or not self._held:
                    return
                held, self._held = self._held, []
            threading.Thread(target=_call, args=(held,), name="withdrawals", daemon=True).start()

        info = self._session.info
        with usable():
            return (
                info.declare_transport_events_listener(directly(follow_transport)),
                info.declare_link_events_listener(directly(lambda event: follow(str(event.link.zid), begins=False))),
            )

    def _withdraw(self, undeclare: Callable[[], object]) -> None:
        with self._lock:
            if self._linking:
                self._held.append(undeclare)
                return
        undeclare()

    def require(self, keys: int) -> None:
        """Raise `ConnectionFailed` if fewer key numbers are left."""
        if self._keys + keys > MOST_KEYS:
            raise ConnectionFailed(
                f"this connection has declared {self._keys} keys and cannot declare more: open another one"
            )

    @contextlib.contextmanager
    def _counted(self, keys: int) -> Iterator[None]:
        """Count key numbers that are going to be declared."""
        with self._lock:
            self.require(keys)
            self._keys += keys
            self._open_keys += keys
        try:
            with usable():
                yield
        except ConnectionFailed:
            self._free(keys)
            raise

    def _free(self, keys: int) -> None:
        with self._lock:
            self._open_keys -= keys


def _call(withdrawals: list[Callable[[], object]]) -> None:
    while withdrawals:  # releasing the reference withdraws a publisher, so none is kept
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            withdrawals.pop(0)()


def _options(timeout: float, *, background: bool) -> dict[str, Any]:
    """Return how everybody is asked: each answer is kept, also of two services with the same key, and caches answer."""
    options: dict[str, Any] = {
        "target": zenoh.QueryTarget.ALL,
        "consolidation": zenoh.ConsolidationMode.NONE,
        "accept_replies": zenoh.ReplyKeyExpr.ANY,
        "timeout": timeout,
    }
    if background:
        options |= {"allowed_destination": zenoh.Locality.REMOTE, "priority": zenoh.Priority.BACKGROUND}
    return options

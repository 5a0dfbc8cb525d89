"""What a member receives: subscriptions that come and go, of single streams or of all, by topic.

A subscription is known by its topic and its key. However many there are, the samples of a topic are handed over one
after the other, in their order, on the thread of the network that brings them: a queue and a thread in between would
cost each message two more changes of the thread. When the subscription of a stream replaces the subscription of
all streams, or the other way round, nothing is missing in between, and only the newest message comes twice: a new
subscription asks Zenoh for it. The messages that caches hold from before are asked for once for each publisher
(`late_join`), and again after the stream was not subscribed to.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import optipmb_schemas as schemas
import structlog
from optipmb_client.zenoh.late_join import CacheQueries, LateJoin
from optipmb_client.zenoh.session import NEWEST

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from optipmb_client.zenoh.handles import Declaration
    from optipmb_client.zenoh.session import Sample, ZenohSession

log = structlog.get_logger("optipmb_service")

MOST_RETURNED: Final = 16_384
"""Publishers that are to be asked at once."""

FIRST_PAUSE_NS: Final = 500_000_000
LAST_PAUSE_NS: Final = 16_000_000_000
"""Pauses before a publisher that came back is asked, each twice as long as the last one until it has sent something."""

MOST: Final = 256
"""Messages of a topic that may wait while another thread hands over those before them."""

ALL: Final = ""
"""Instead of a stream: all of them."""

Kind = Literal["detections", "points", "discovery"]


class Input(NamedTuple):
    """A subscription to a stream, or to all of them; `cached`: lost messages are recovered from a cache."""

    kind: Kind
    stream: str = ALL
    cached: bool = True


PACKET_BYTES: Final = 512
"""Bytes of a message without its payload, nearly."""


@dataclass(slots=True)
class Packet:
    """A message as it arrived, not decoded.

    Attributes:
        key: where it was published.
        payload: its bytes; None when they are more than the limit and were not taken over.
        size: number of bytes.
        encoding: the Zenoh encoding, as a text.
        wall_ns: arrival by the wall clock, ns since 1970; only reported, never decided by.
        now_ns: arrival by the monotonic clock, ns.
        traceparent: W3C trace context that came along, unchecked; empty where no traces are recorded.
        origin: what tells the stream: the key without its topic.
        frame: whether it holds detections.
        held: bytes that it takes while it waits.
    """

    key: str
    payload: bytes | None
    size: int
    encoding: str
    wall_ns: int
    now_ns: int
    traceparent: str = ""
    origin: str = field(init=False)
    frame: bool = field(init=False)
    held: int = field(init=False)

    def __post_init__(self) -> None:
        self.origin, _, topic = self.key.rpartition("/")
        self.frame = topic == "detections"
        self.held = PACKET_BYTES + (0 if self.payload is None else self.size)

    def message(self, stream: str, limits: schemas.Limits) -> schemas.Detections | schemas.Points:
        """Return the message, decoded.

        Raises:
            MessageError: it is none, or not one of this stream.
        """
        if self.payload is None:
            raise schemas.MessageError("too_large", "", f"at most {limits.max_bytes} bytes", f"{self.size} bytes")
        kind: type[schemas.Detections | schemas.Points] = schemas.Detections if self.frame else schemas.Points
        message = schemas.decode(self.payload, kind, encoding=self.encoding, limits=limits)
        if message.stream != stream:
            raise schemas.MessageError("invalid_value", "stream", repr(stream), repr(message.stream))
        return message


class Topic:
    """The subscriptions of one topic.

    Args:
        name: of the topic, for the log.
        receive: called for each sample, one after the other; the thread of the network is not to be kept waiting.
        answered: called with the key of a publisher when all has been handed over that its cache held.
    """

    def __init__(
        self,
        name: str,
        session: ZenohSession,
        receive: Callable[[Sample], None],
        answered: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._name = name
        self._session = session
        self._receive = receive
        self._waiting: deque[tuple[Callable[..., object], tuple[object, ...]]] = deque()
        self._turn = threading.Lock()
        self._closed = False
        self._drained = threading.Event()
        self._subscribers: dict[str, tuple[str, Declaration]] = {}
        self._queries: CacheQueries[Sample] = CacheQueries(session.ask)
        self._late_join: LateJoin[Sample] = LateJoin(self._hand_over, self._queries.ask, answered)

    def subscribe(
        self, name: str, key: str, passing: Callable[[Sample], None] | None = None, *, cached: bool = True
    ) -> None:
        """Receive publications under a key expression, and those in caches.

        Args:
            name: of the subscription; `ALL` for all streams.
            key: the key expression.
            passing: called for each sample instead of the topic's function; nothing is recovered then.
            cached: whether lost messages are recovered from caches.

        Raises:
            TransportError: the session is closed, or has declared all keys that it can.
        """
        recovers = passing is None and cached
        take = partial(self._in_turn, self._late_join.take if passing is None else passing)
        subscriber = self._session.listen(key, take, recovers=recovers, history=NEWEST if recovers else None)
        self._subscribers[name] = key, subscriber

    def leave(self, names: Iterable[str]) -> None:
        """Withdraw subscriptions; messages received before are handed over.

        Caches are asked again when their keys come again. While all streams are received, none has gone.
        """
        left = [self._subscribers.pop(name) for name in names]
        for _, subscriber in left:
            subscriber.close()
        if left and ALL not in self._subscribers:
            kept = frozenset(key for key, _ in self._subscribers.values())
            # After the messages that wait, whose publishers would be known again.
            self._in_turn(self._late_join.keep, kept)

    def due(self, zid: str, eid: int) -> int:
        """Return the number after the highest that was handed over of a publisher; 0 of one that is not known."""
        return self._late_join.due(zid, eid)

    def pass_through(self, then: Callable[[], object]) -> None:
        """Call `then`, on some thread, when all that has come until now is handed over."""
        self._in_turn(then)

    def close(self, timeout: float) -> None:
        """End it; messages received before are handed over within `timeout` seconds, and nothing afterwards."""
        # One that does not return is left behind with its thread; a second close goes on with the others.
        with contextlib.suppress(KeyError):
            while True:
                _, (_, subscriber) = self._subscribers.popitem()
                subscriber.close()
        self._in_turn(self._end)
        self._drained.wait(timeout)
        self._end()
        self._queries.close()
        self._late_join.close()

    def _in_turn(self, work: Callable[..., object], *arguments: object) -> None:
        """Have work done after all that came before it: here, or on the thread that is doing so already.

        Of several links there are several threads of the network.
        """
        self._waiting.append((work, arguments))
        # The thread that holds the lock looks at the queue again after it has released it, so nothing stays behind.
        # This thread waits for it only where too much is in the queue.
        while self._waiting and self._turn.acquire(blocking=len(self._waiting) > MOST):
            try:
                while self._waiting and not self._closed:
                    work, arguments = self._waiting.popleft()
                    try:
                        work(*arguments)
                    except Exception:
                        log.exception("internal_error", topic=self._name)  # one message must not end the subscription
                if self._closed:
                    self._waiting.clear()
            finally:
                self._turn.release()

    def _end(self) -> None:
        self._closed = True
        self._drained.set()

    def _hand_over(self, sample: Sample) -> None:
        try:
            self._receive(sample)
        except Exception:
            log.exception("internal_error", topic=self._name)  # nor what waits for its turn in `LateJoin`


class ReturnedPublishers:
    """Publishers whose tokens came back, and who are asked for the newest number in their caches.

    After a lost link the numbers go on. The numbers of a program that was started again with the Zenoh id of its last
    run begin at 0, and Zenoh drops its messages, up to the highest number before, without a word.

    Args:
        due: returns the number that is expected next of a publisher, by Zenoh id and number of the entity; 0: it is not
            known.
    """

    def __init__(self, session: ZenohSession, due: Callable[[str, int], int]) -> None:
        self._session = session
        self._due = due
        self._waiting: dict[str, tuple[int, int]] = {}
        """Tokens, each with the monotonic time of its next query and the pause after that."""

    def came(self, token: str) -> None:
        """Note that a token has come; called by any thread."""
        if self._expected(token) and len(self._waiting) < MOST_RETURNED:
            self._waiting[token] = time.monotonic_ns() + FIRST_PAUSE_NS, FIRST_PAUSE_NS

    def look(self, report: Callable[[str, int, int], None]) -> None:
        """Ask the publishers that are due, without waiting for the answers.

        Args:
            report: called, on a thread of the network, with the token of a publisher whose numbers went back, the
                number that was expected next, and its newest one.
        """
        now_ns = time.monotonic_ns()
        for token, (at_ns, pause_ns) in tuple(self._waiting.items()):
            if now_ns < at_ns:
                continue
            if pause_ns > LAST_PAUSE_NS:  # it has sent nothing
                self._waiting.pop(token, None)
            else:
                self._waiting[token] = now_ns + 2 * pause_ns, 2 * pause_ns
                self._ask(token, report)

    def _ask(self, token: str, report: Callable[[str, int, int], None]) -> None:
        due = self._expected(token)

        def take(sample: Sample) -> None:
            if (info := sample.source_info) is None:
                return
            newest = info.source_sn
            if self._waiting.pop(token, None) is not None and newest + 1 < due:
                report(token, due, newest)

        self._session.ask(f"{token.rpartition('/')[0]}/**?_max=1", take, background=True)

    def _expected(self, token: str) -> int:
        zid, _, rest = token.rpartition("/@adv/pub/")[2].partition("/")
        eid = rest.partition("/")[0]
        return self._due(zid, int(eid)) if eid.isdecimal() else 0

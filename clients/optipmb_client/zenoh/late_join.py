"""Samples of publishers with a cache in their order, with all that the cache still holds of those before.

A publisher sends to the subscriptions that it knows of. While the declaration of a new one is on its way, messages go
to the cache alone, and Zenoh's own query of the caches may have been answered before. Once a later message has come,
Zenoh takes recovered messages for old ones, and drops them. So the number of a message decides here: unless it follows
the number before it, or is 0 at the beginning, the cache is asked for the messages in between, and further messages of
this publisher wait meanwhile. Most gaps have been filled by Zenoh's advanced subscriber before. One is left where a
new subscription takes over: the cache's answer to it may overtake messages on their way, which Zenoh then drops.

It takes Zenoh's samples and imports no Zenoh.
"""

import heapq
import itertools
import queue
import threading
import time
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

__all__ = ["ANSWER_S", "CacheQueries", "LateJoin"]

ANSWER_S: Final = 5.0
"""How long to wait for the answer of a cache; a publisher that has just sent a message answers within milliseconds."""

REPEATS_S: Final = (0.5, 1.0, 2.0)
"""How long nothing is heard of a query before it is sent again: if it was lost on its way, or its answer was, all that
comes of the publisher would wait for `ANSWER_S`."""

MAX_WAITING: Final = 1024
"""Most messages of one publisher that wait for the answer of its cache."""

MAX_WAITING_BYTES: Final = 1 << 25
"""Most bytes of one subscription that wait; with more, nothing of the publisher concerned waits any longer."""

MAX_SOURCES: Final = 16_384
"""Most publishers that are known; the cache of one that is forgotten is asked once more."""

_S = TypeVar("_S", bound=Any)  # as Zenoh's samples
_Source = tuple[str, int]


@dataclass(slots=True)
class _Publisher(Generic[_S]):
    """Reading state of a publisher with a cache.

    Attributes:
        key: where it publishes.
        due: the number after the highest that was handed over.
        begin: the first number that is handed over.
        waiting: the samples that wait for the answer of its cache; None: none does.
    """

    key: str
    due: int = 0
    begin: int = 0
    waiting: list[_S] | None = None


@dataclass(frozen=True)
class _Gap(Generic[_S]):
    """Numbers that are missing, first to last, and the samples that wait behind them."""

    first: int
    last: int
    behind: list[_S]


class _Query(Generic[_S]):
    """A query that is sent again while nothing is heard of it, and ends with the first of these that ends.

    Args:
        selector: of the query.
        reply: called with each answer; where it was sent twice, perhaps with the same one twice.
        end: called when no more will come, with whether all that were asked have answered.
    """

    def __init__(self, selector: str, reply: Callable[[_S], None], end: Callable[[bool], None]) -> None:
        self._selector = selector
        self._reply = reply
        self._when_ended = end
        self._lock = threading.Lock()
        self._sent = 0
        self._heard = self._ended = False

    def send(self, query: Callable[[str, Callable[[_S], None], Callable[[bool], None]], object]) -> float | None:
        """Send it unless something was heard; return after how long (s) it is to be sent again, None: no more."""
        if self._heard or self._ended:
            return None
        self._sent += 1
        query(self._selector, self._take, self._end)
        return REPEATS_S[self._sent - 1] if self._sent <= len(REPEATS_S) else None

    def _take(self, sample: _S) -> None:
        self._heard = True
        if not self._ended:
            self._reply(sample)

    def _end(self, complete: bool) -> None:  # noqa: FBT001 - as `CacheQueries` has it called
        with self._lock:
            if self._ended:
                return
            self._ended = True
        self._when_ended(complete)


class CacheQueries(Generic[_S]):
    """Sends the queries of a subscription on a thread of its own, which begins with the first.

    A cache of the same session answers on the thread that asks, and calls back with its lock held. A query that is sent
    by such a callback waits for that lock, for ever where another thread waits to add a message to the cache.

    Args:
        query: sends one, with what `LateJoin` gives its `ask`. It must not raise.
    """

    def __init__(self, query: Callable[[str, Callable[[_S], None], Callable[[bool], None]], object]) -> None:
        self._query = query
        self._waiting: queue.SimpleQueue[_Query[_S] | None] = queue.SimpleQueue()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False

    def ask(self, selector: str, reply: Callable[[_S], None], end: Callable[[bool], None]) -> None:
        """Have a query sent soon, and again while nothing is heard of it; never waits."""
        self._waiting.put(_Query(selector, reply, end))
        with self._starting:
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._send, name="cache-queries", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Send nothing any more: a session cannot be closed while a query is being sent."""
        with self._starting:
            self._closed = True
        self._waiting.put(None)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(ANSWER_S)

    def _send(self) -> None:
        again: list[tuple[float, int, _Query[_S]]] = []
        numbers = itertools.count()
        while True:
            try:
                wait_s = max(0.0, again[0][0] - time.monotonic()) if again else None
                query = self._waiting.get(timeout=wait_s)
            except queue.Empty:
                _, _, query = heapq.heappop(again)
            if query is None or self._closed:
                return
            if (after_s := query.send(self._query)) is not None:
                heapq.heappush(again, (time.monotonic() + after_s, next(numbers), query))


class LateJoin(Generic[_S]):
    """Hands over the samples of one subscription, of each publisher in order, from the oldest in its cache on.

    Args:
        receive: takes a sample; never called by two threads at once, nor after `close`. It must not raise.
        ask: queries a selector; calls its second argument with each reply, perhaps with one twice, and its third when
            no more will come, with whether all that were asked have answered, on any thread but the one that asks
            (`CacheQueries`).
        answered: called with the key of a publisher when all has been handed over that its cache held. It must not
            raise.
        lost: called with a key just before a sample is handed over behind others that no cache holds any more. It must
            not raise.
        waits: whether nothing is handed over before `begin` is called.
    """

    def __init__(
        self,
        receive: Callable[[_S], object],
        ask: Callable[[str, Callable[[_S], None], Callable[[bool], None]], object],
        answered: Callable[[str], object] = lambda _: None,
        lost: Callable[[str], object] = lambda _: None,
        *,
        waits: bool = False,
    ) -> None:
        self._lost = lost
        self._early: list[_S] | None = [] if waits else None
        self._receive = receive
        self._ask = ask
        self._on_answered = answered
        self._publishers: dict[_Source, _Publisher[_S]] = {}
        self._waiting_bytes = 0
        self._lock = threading.RLock()
        self._closed = False

    def begin(self, newest: Iterable[_S]) -> None:
        """Hand over waiting and new messages, except messages published before this call.

        Args:
            newest: the newest sample of each publisher that was there.
        """
        with self._lock:
            early, self._early = self._early or (), None
            for sample in newest:
                if (info := sample.source_info) is not None and not self._closed:
                    publisher = self._added((str(info.source_id.zid), info.source_id.eid), str(sample.key_expr))
                    publisher.due = publisher.begin = info.source_sn + 1
            for sample in early:
                self._take(sample)

    def take(self, sample: _S) -> None:
        """Take a sample that the subscriber has received; to be called by one thread at a time."""
        with self._lock:
            if self._early is not None:
                self._early.append(sample)
                if len(self._early) >= MAX_WAITING:
                    self.begin(())
                return
        self._take(sample)

    def _take(self, sample: _S) -> None:
        info = sample.source_info
        if info is None:  # of a publisher without a cache
            with self._lock:
                if not self._closed:
                    self._receive(sample)
            return
        entity, number = info.source_id, info.source_sn
        source = str(entity.zid), entity.eid
        with self._lock:
            if self._closed:
                return
            publisher = self._publishers.get(source) or self._added(source, str(sample.key_expr))
            if number < publisher.begin:
                return
            waiting = publisher.waiting
            if waiting is None and number <= publisher.due:  # mostly: in order, and nothing waits
                self._receive(sample)
                if number == publisher.due:  # else it is a repetition
                    publisher.due = number + 1
                return
            if waiting is None:
                gap = self._follow(publisher, [sample])
            else:
                gap = None
                waiting.append(sample)
                self._waiting_bytes += len(sample.payload)
            if len(waiting or ()) >= MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
                self._release(publisher)
        self._ask_for(source, str(sample.key_expr), gap)

    def keep(self, keys: Container[str]) -> None:
        """Forget the publishers of all other keys: when they are heard again, their caches are asked once more."""
        with self._lock:
            known = self._publishers.items()
            for source in [one for one, of in known if of.key not in keys and of.waiting is None]:
                del self._publishers[source]

    def due(self, zid: str, eid: int) -> int:
        """Return the number after the highest that was handed over of a publisher; 0 of one that is not known."""
        publisher = self._publishers.get((zid, eid))
        return 0 if publisher is None else publisher.due

    def close(self) -> None:
        """Hand over what still waits, and nothing afterwards."""
        with self._lock:
            for publisher in self._publishers.values():
                for sample in publisher.waiting or ():
                    self._receive(sample)
            self._publishers.clear()
            self._closed = True

    def _added(self, source: _Source, key: str) -> "_Publisher[_S]":
        """Return a new publisher, in the place of the oldest where there are too many."""
        if len(self._publishers) >= MAX_SOURCES:
            oldest = next((one for one, publisher in self._publishers.items() if publisher.waiting is None), None)
            if oldest is not None:
                del self._publishers[oldest]
        publisher = self._publishers[source] = _Publisher(key)
        return publisher

    def _follow(self, publisher: "_Publisher[_S]", samples: list[_S]) -> "_Gap[_S] | None":
        """Hand over samples of a publisher up to a gap, behind which they wait; return the gap."""
        for index, sample in enumerate(samples):
            number = self._number(sample)
            if number > publisher.due:
                behind = publisher.waiting = samples[index:]
                self._waiting_bytes += sum(len(one.payload) for one in behind)
                return _Gap(publisher.due, number - 1, behind)
            self._hand_over(publisher, sample)
        return None

    def _hand_over(self, publisher: "_Publisher[_S] | None", sample: _S) -> None:
        number = self._number(sample)
        if publisher is not None and number > publisher.due:
            self._lost(str(sample.key_expr))
        self._receive(sample)
        if publisher is not None:  # else it is forgotten
            publisher.due = max(publisher.due, number + 1)

    @staticmethod
    def _number(sample: _S) -> int:
        info = sample.source_info
        return 0 if info is None else info.source_sn

    def _ask_for(self, source: _Source, key: str, gap: "_Gap[_S] | None") -> None:
        """Ask the cache for missing samples; its answer ends the wait for them."""
        if gap is None:
            return
        early: list[_S] = []
        zid, eid = source
        selector = f"{key}/@adv/pub/{zid}/{eid}/**?_sn={gap.first}..{gap.last}"
        self._ask(selector, early.append, lambda complete: self._answered(source, key, gap, early, complete=complete))

    def _answered(self, source: _Source, key: str, gap: "_Gap[_S]", early: list[_S], *, complete: bool) -> None:
        further = None
        with self._lock:
            if self._closed:
                return
            publisher = self._publishers.get(source)
            numbered = {self._number(one): one for one in early if one.source_info is not None}
            for _, sample in sorted(numbered.items()):
                self._hand_over(publisher, sample)
            waits = None if publisher is None else publisher.waiting
            if publisher is not None and waits is gap.behind:
                waiting = self._taken(publisher)
                self._hand_over(publisher, waiting[0])
                further = self._follow(publisher, waiting[1:])
            # Else a later gap is still asked for, or the cache may hold more.
            if complete and further is None and (waits is gap.behind or waits is None):
                self._on_answered(key)
        self._ask_for(source, key, further)

    def _taken(self, publisher: "_Publisher[_S]") -> list[_S]:
        """Take what waits of a publisher; nothing waits any longer."""
        waiting = publisher.waiting or []  # nothing where it was released before
        publisher.waiting = None
        self._waiting_bytes -= sum(len(sample.payload) for sample in waiting)
        return waiting

    def _release(self, publisher: "_Publisher[_S]") -> None:
        """Hand over what waits, gaps and all: there is too much of it."""
        for sample in self._taken(publisher):
            self._hand_over(publisher, sample)

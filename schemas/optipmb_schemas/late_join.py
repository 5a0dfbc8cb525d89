"""What a subscription gets of a publisher with a cache: all that the cache still holds, each message in its turn.

A publisher sends to the subscriptions that it knows of. While the declaration of a new one is on its way, messages go
to the cache alone, and Zenoh's own query of the caches may have been answered before. Once a later message has come,
Zenoh takes those that are recovered for old ones, and drops them. So the number of a message decides here: unless it
follows that of the one before, or is 0 where there was none, the cache is asked for those in between, and what comes of
this publisher meanwhile waits. Most gaps have been filled by Zenoh's advanced subscriber before. One is left where a
new subscription takes over: the cache's answer to it may overtake messages on their way, which Zenoh then drops.

It takes Zenoh's samples and imports no Zenoh.
"""

import queue
import threading
from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

__all__ = ["ANSWER_S", "CacheQueries", "LateJoin"]

ANSWER_S: Final = 5.0
"""How long to wait for the answer of a cache; a publisher that has just sent a message answers within milliseconds."""

MAX_WAITING: Final = 1024
"""Most messages of one publisher that wait for the answer of its cache."""

MAX_WAITING_BYTES: Final = 1 << 25
"""Most bytes of one subscription that wait; with more, nothing of the publisher concerned waits any longer."""

MAX_SOURCES: Final = 16_384
"""Most publishers that are known; the cache of one that is forgotten is asked once more."""


class _Id(Protocol):
    @property
    def zid(self) -> object: ...
    @property
    def eid(self) -> int: ...


class _Info(Protocol):
    @property
    def source_id(self) -> _Id: ...
    @property
    def source_sn(self) -> int: ...


class _Bytes(Protocol):
    def __len__(self) -> int: ...


class _Sample(Protocol):
    @property
    def key_expr(self) -> object: ...
    @property
    def payload(self) -> _Bytes: ...
    @property
    def source_info(self) -> _Info | None: ...


_S = TypeVar("_S", bound=_Sample)
_Source = tuple[str, int]


@dataclass(frozen=True)
class _Gap(Generic[_S]):
    """Numbers that are missing, first to last, and the samples that wait behind them."""

    first: int
    last: int
    behind: list[_S]


class CacheQueries(Generic[_S]):
    """Sends the queries of a subscription on a thread of its own, which begins with the first.

    A cache of the same session answers on the thread that asks, and calls back with its lock held. A query that is sent
    by such a callback waits for that lock, for ever where another thread waits to add a message to the cache.

    Args:
        query: sends one, with what `LateJoin` gives its `ask`. It must not raise.
    """

    def __init__(self, query: Callable[[str, Callable[[_S], None], Callable[[bool], None]], object]) -> None:
        self._query = query
        self._waiting: queue.SimpleQueue[tuple[str, Callable[[_S], None], Callable[[bool], None]] | None]
        self._waiting = queue.SimpleQueue()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False

    def ask(self, selector: str, reply: Callable[[_S], None], end: Callable[[bool], None]) -> None:
        """Have a query sent soon; never waits."""
        self._waiting.put((selector, reply, end))
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
        while (query := self._waiting.get()) is not None and not self._closed:
            self._query(*query)


class LateJoin(Generic[_S]):
    """Hands over the samples of one subscription, those of a publisher in order, from the oldest in its cache on.

    Args:
        receive: takes a sample; never called by two threads at once, nor after `close`. It must not raise.
        ask: queries a selector; calls its second argument with each reply, and its third when no more will come, with
            whether all that were asked have answered, on any thread but the one that asks (`CacheQueries`).
        answered: called with the key of a publisher when all has been handed over that its cache held. It must not
            raise.
    """

    def __init__(
        self,
        receive: Callable[[_S], object],
        ask: Callable[[str, Callable[[_S], None], Callable[[bool], None]], object],
        answered: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._receive = receive
        self._ask = ask
        self._on_answered = answered
        self._sources: dict[_Source, list[_S] | None] = {}  # what waits for the answer of a cache; None: nothing does
        self._due: dict[_Source, int] = {}  # the number after the highest that was handed over
        self._keys: dict[_Source, str] = {}
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._closed = False

    def take(self, sample: _S) -> None:
        """Take a sample that the subscriber has received; to be called by one thread at a time."""
        info = sample.source_info
        if info is None:  # of a publisher without a cache
            with self._lock:
                if not self._closed:
                    self._receive(sample)
            return
        source = str(info.source_id.zid), info.source_id.eid
        with self._lock:
            if self._closed:
                return
            if source not in self._sources:
                self._make_room()
                self._sources[source] = None
                self._keys[source] = str(sample.key_expr)
                self._due[source] = 0
            waiting, number = self._sources[source], info.source_sn
            if waiting is None and number <= self._due[source]:  # mostly: in order, and nothing waits
                self._hand_over(source, sample, number)
                return
            if waiting is None:
                gap = self._follow(source, [sample])
            else:
                gap = None
                waiting.append(sample)
                self._waiting_bytes += len(sample.payload)
            if len(waiting or ()) >= MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
                self._release(source)
        self._ask_for(source, str(sample.key_expr), gap)

    def keep(self, keys: Container[str]) -> None:
        """Forget the publishers of all other keys: when they are heard again, their caches are asked once more."""
        with self._lock:
            for source in [one for one, key in self._keys.items() if key not in keys and self._sources[one] is None]:
                self._forget(source)

    def close(self) -> None:
        """Hand over what still waits, and nothing afterwards."""
        with self._lock:
            for waiting in self._sources.values():
                for sample in waiting or ():
                    self._receive(sample)
            self._sources.clear()
            self._keys.clear()
            self._due.clear()
            self._closed = True

    def _make_room(self) -> None:
        """Make room for a new publisher."""
        if len(self._sources) >= MAX_SOURCES:
            oldest = next((source for source, waiting in self._sources.items() if waiting is None), None)
            if oldest is not None:
                self._forget(oldest)

    def _forget(self, source: _Source) -> None:
        del self._sources[source], self._keys[source], self._due[source]

    def _follow(self, source: _Source, samples: list[_S]) -> "_Gap[_S] | None":
        """Hand over samples of a publisher up to a gap, behind which they wait; return the gap."""
        for index, sample in enumerate(samples):
            due, number = self._due[source], self._number(sample)
            if number > due:
                behind = self._sources[source] = samples[index:]
                self._waiting_bytes += sum(len(one.payload) for one in behind)
                return _Gap(due, number - 1, behind)
            self._hand_over(source, sample, number)
        return None

    def _hand_over(self, source: _Source, sample: _S, number: int) -> None:
        self._receive(sample)
        due = self._due.get(source)
        if due is not None and number >= due:  # else the publisher is forgotten, or it is a repetition
            self._due[source] = number + 1

    @staticmethod
    def _number(sample: _S) -> int:
        info = sample.source_info
        return 0 if info is None else info.source_sn

    def _ask_for(self, source: _Source, key: str, gap: "_Gap[_S] | None") -> None:
        """Ask the cache for what is missing; what it no longer has is not waited for any longer."""
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
            for sample in sorted((one for one in early if one.source_info is not None), key=self._number):
                self._hand_over(source, sample, self._number(sample))
            waits = self._sources.get(source)
            if waits is gap.behind:
                waiting = self._taken(source)
                self._hand_over(source, waiting[0], self._number(waiting[0]))
                further = self._follow(source, waiting[1:])
            # Else a later gap is still asked for, or the cache may hold what has not come.
            if complete and further is None and (waits is gap.behind or waits is None):
                self._on_answered(key)
        self._ask_for(source, key, further)

    def _taken(self, source: _Source) -> list[_S]:
        """Take what waits of a publisher; nothing waits any longer."""
        waiting = self._sources.get(source)
        if waiting is None:  # released before, and perhaps forgotten since
            return []
        self._sources[source] = None
        self._waiting_bytes -= sum(len(sample.payload) for sample in waiting)
        return waiting

    def _release(self, source: _Source) -> None:
        """Hand over what waits, gaps and all: there is too much of it."""
        for sample in self._taken(source):
            self._hand_over(source, sample, self._number(sample))

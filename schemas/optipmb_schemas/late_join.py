"""What a subscription gets of a publisher that was there before it: everything that the publisher's cache still holds.

A publisher sends to the subscriptions that it knows of. While the declaration of a new one is on its way, messages go
to the cache alone, and Zenoh's own query of the caches may have been answered before. Once a later message has come,
Zenoh takes those that are recovered for old ones, and drops them. So the number of the first message that comes of a
publisher decides here: unless it is 0, the cache is asked for the messages before it, and what comes of this publisher
meanwhile waits. That happens once for each publisher; later gaps are recovered by Zenoh's advanced subscriber.

It takes Zenoh's samples and imports no Zenoh.
"""

import threading
from collections.abc import Callable, Container
from typing import Final, Generic, Protocol, TypeVar

__all__ = ["ANSWER_S", "LateJoin"]

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


class LateJoin(Generic[_S]):
    """Hands over the samples of one subscription, those of a publisher in order, from the oldest in its cache on.

    Args:
        receive: takes a sample; never called by two threads at once, nor after `close`. It must not raise.
        ask: queries a selector; calls its second argument with each reply, and its third when no more will come, on any
            thread but the one that asks.
        answered: told the key of a publisher when all has been handed over that its cache held. It must not raise.
    """

    def __init__(
        self,
        receive: Callable[[_S], object],
        ask: Callable[[str, Callable[[_S], None], Callable[[], None]], object],
        answered: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._receive = receive
        self._ask = ask
        self._told = answered
        self._sources: dict[_Source, list[_S] | None] = {}  # what waits for the answer of a cache; None: nothing does
        self._keys: dict[_Source, str] = {}
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._closed = False

    def take(self, sample: _S) -> None:
        """Take a sample that the subscriber has received; to be called by one thread."""
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
            if first := source not in self._sources:
                self._make_room()
                self._sources[source] = [] if info.source_sn else None
                self._keys[source] = str(sample.key_expr)
            waiting = self._sources[source]
            if waiting is None:
                self._receive(sample)
                return
            waiting.append(sample)
            self._waiting_bytes += len(sample.payload)
            if len(waiting) >= MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
                self._release(source)
        if first:
            self._ask_before(sample.key_expr, source, info.source_sn)

    def keep(self, keys: Container[str]) -> None:
        """Forget the publishers of all other keys: when they are heard again, their caches are asked once more."""
        with self._lock:
            for source in [one for one, key in self._keys.items() if key not in keys and self._sources[one] is None]:
                del self._sources[source], self._keys[source]

    def close(self) -> None:
        """Hand over what still waits, and nothing afterwards."""
        with self._lock:
            for waiting in self._sources.values():
                for sample in waiting or ():
                    self._receive(sample)
            self._sources.clear()
            self._keys.clear()
            self._closed = True

    def _make_room(self) -> None:
        """Make room for a new publisher."""
        if len(self._sources) >= MAX_SOURCES:
            oldest = next((source for source, waiting in self._sources.items() if waiting is None), None)
            if oldest is not None:
                del self._sources[oldest], self._keys[oldest]

    def _ask_before(self, key: object, source: _Source, number: int) -> None:
        early: list[tuple[int, _S]] = []

        def reply(cached: _S) -> None:
            if (info := cached.source_info) is not None:
                early.append((info.source_sn, cached))

        zid, eid = source
        selector = f"{key}/@adv/pub/{zid}/{eid}/**?_sn=..{number - 1}"
        self._ask(selector, reply, lambda: self._answered(source, early, str(key)))

    def _answered(self, source: _Source, early: list[tuple[int, _S]], key: str) -> None:
        with self._lock:
            if self._closed:
                return
            for _, sample in sorted(early, key=lambda one: one[0]):
                self._receive(sample)
            self._release(source)
            self._told(key)

    def _release(self, source: _Source) -> None:
        waiting = self._sources.get(source)
        if waiting is None:  # released before, and perhaps forgotten since
            return
        self._sources[source] = None
        for sample in waiting:
            self._waiting_bytes -= len(sample.payload)
            self._receive(sample)

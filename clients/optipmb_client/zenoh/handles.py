"""Publishers, subscriptions and queryables of a Zenoh session, and the threads that read them."""

import contextlib
import ctypes
import queue
import re
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

import zenoh
from optipmb_schemas import Message, Problem, encode, encoding_of

from optipmb_client.errors import ConnectionFailed

__all__ = ["Declaration", "Dispatcher", "ItemQueue", "Query", "Sender", "directly", "reason", "usable"]

CLOSE_S = 5.0
"""Longest wait of `close` until received items are handed over."""

FULL_S = 0.005
"""Pause of the network's thread before it looks again for room in a channel."""

_Item = TypeVar("_Item")

_thread = threading.local()  # lives as long as the state of the thread does


class Declaration:
    """Something declared on a session.

    Args:
        undeclare: Withdraws it.
        forget: Called with this object once it is withdrawn.
    """

    def __init__(self, undeclare: Callable[[], object], forget: "Callable[[Declaration], None]") -> None:
        self._undeclare: Callable[[], object] | None = undeclare
        self._forget = forget

    def close(self) -> None:
        """Withdraw it. May be called again, and after the session was closed."""
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            with contextlib.suppress(zenoh.ZError):
                undeclare()
            self._forget(self)


class Sender(Declaration):
    """A publisher of encoded messages on one key.

    It is withdrawn by letting go of it; a message that another thread is sending may still go out. What Zenoh calls
    `undeclare` waits for the heartbeats to end with the lock of the interpreter held. While the thread that sends them
    waits for that lock, the whole process would be blocked for ten seconds.

    Args:
        publisher: Zenoh's.
        forget: As for `Declaration`.
        withdraw: Called with a function that lets go of the publisher.
        cached: Whether the publisher keeps messages for recovery.
    """

    def __init__(
        self,
        publisher: Any,
        forget: Callable[[Declaration], None],
        withdraw: Callable[[Callable[[], object]], object],
        *,
        cached: bool,
    ) -> None:
        super().__init__(self._let_go, forget)
        self._withdraw = withdraw
        self._publisher = publisher  # Any: Zenoh leaves parts of these untyped, and one wrongly typed
        self._cached = cached

    @property
    def wanted(self) -> bool:
        """Whether somebody is known to listen. Always True with a cache: that also serves those who come later."""
        publisher = self._publisher  # `close` may take it away meanwhile
        return self._cached or (publisher is not None and bool(publisher.matching_status.matching))

    def on_wanted(self, changed: Callable[[], object]) -> None:
        """Have `changed` called on a thread of the network when `wanted` has changed."""
        if not self._cached:
            with usable():
                self._publisher.declare_matching_listener(lambda _status: changed())

    def pack(self, message: Message) -> bytes:
        """Return a message as it is sent."""
        return encode(message)

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Send one message; does not wait for anybody to receive it.

        Raises:
            ConnectionFailed: After `close`.
        """
        publisher = self._publisher
        if publisher is None:
            raise ConnectionFailed("this publisher has been closed")
        try:
            publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            raise ConnectionFailed("this publisher has been closed") from error

    def _let_go(self) -> None:
        publisher, self._publisher = self._publisher, None
        self._withdraw(lambda: publisher)  # the reference ends with the function


class Dispatcher:
    """A subscription or queryable whose items a daemon thread hands over, one after the other.

    Args:
        name: Name of the reading, for messages.
        declared: The subscription or queryable.
        items: A channel of Zenoh's, or one of ours.
        receive: Called for each item.
        failed: Called with the name in place of an exception of `receive`.
        ended: Called when the reading is closed.
    """

    def __init__(
        self,
        name: str,
        declared: Declaration,
        items: Iterable[_Item],
        receive: Callable[[_Item], None],
        failed: Callable[[str], object],
        ended: "Callable[[Dispatcher], None]",
    ) -> None:
        def drain() -> None:
            with contextlib.suppress(zenoh.ZError):  # how Zenoh's channels end
                for item in items:
                    try:
                        receive(item)
                    except Exception:  # noqa: BLE001  one message must not end the reading; `failed` reports it
                        failed(name)

        self._declared = declared
        self._items = items
        self._ended = ended
        self._thread = threading.Thread(target=drain, name=f"reader-{name}", daemon=True)
        self._thread.start()

    def withdraw(self) -> None:
        """Withdraw it; items received before are still handed over."""
        self._declared.close()
        if isinstance(self._items, ItemQueue):
            self._items.close()

    def close(self, timeout: float = CLOSE_S) -> None:
        """End it; items received before are handed over within `timeout` seconds. May be called again."""
        self.withdraw()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout)
        self._ended(self)


class ItemQueue(Generic[_Item]):
    """Items from the threads of the network, in their order, for one thread that iterates over them.

    Zenoh's own channels wake their reader ten times a second, to look for signals.

    Args:
        most: Items that may wait once they are read; the thread of the network waits beyond that. Before, there is no
            bound: publishers of the same session send their caches on the thread that subscribes, before it reads.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._waiting: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()  # half the cost of `queue.Queue`
        self._bounded = False
        self._closed = False

    def __iter__(self) -> Iterator[_Item]:
        """Yield items until the end."""
        self._bounded = True
        while (item := self._waiting.get()) is not None:
            yield item
        with contextlib.suppress(queue.Empty):
            while (item := self._waiting.get_nowait()) is not None:  # items that waited for room
                yield item

    def close(self) -> None:
        """End the reading after the items that wait."""
        self._closed = True
        self._waiting.put(None)

    def put(self, item: _Item) -> None:
        """Append an item; waits for room while the channel is read."""
        while self._bounded and self._waiting.qsize() >= self._most and not self._closed:
            time.sleep(FULL_S)
        self._waiting.put(item)


class Query:
    """A received query; until it is finished, its asker waits up to the timeout.

    Args:
        query: Zenoh's query.
        ended: Called once, when it is finished or has no references left.
    """

    def __init__(self, query: Any, ended: Callable[[], None] = lambda: None) -> None:
        self._query = query
        self._ended = weakref.finalize(self, ended)
        self.key = str(query.key_expr)
        self.payload: bytes | None = None if query.payload is None else query.payload.to_bytes()
        self.encoding = "" if query.encoding is None else str(query.encoding)

    def matches(self, key: str) -> bool:
        """Return whether the key expression that was asked includes a key."""
        return bool(self._query.key_expr.intersects(zenoh.KeyExpr(key)))

    def answer(self, key: str, message: Message) -> None:
        """Reply with a message.

        Raises:
            ConnectionFailed: The asker or the session is gone.
        """
        self.answer_text(key, encode(message), encoding_of(message))

    def answer_text(self, key: str, text: bytes, encoding: str, *, about: str = "") -> None:
        """Reply with bytes as they are, and with the key that they are about.

        Raises:
            ConnectionFailed: The asker or the session is gone.
        """
        with usable():
            self._query.reply(key, text, encoding=encoding, attachment=about or None)

    def refuse(self, problem: Problem) -> None:
        """Reply with an error.

        Raises:
            ConnectionFailed: The asker or the session is gone.
        """
        with usable():
            self._query.reply_err(encode(problem), encoding=encoding_of(problem))

    def finish(self) -> None:
        """Tell the asker that nothing follows."""
        self._query.drop()
        self._ended()


def directly(take: Callable[[Any], None]) -> Any:
    """Return a handler with which Zenoh calls `take` on the thread of the network.

    It is a pair with something that could be read: with a callback alone Zenoh lets a subscription run in the
    background, and does not withdraw its declarations for recovery.
    """

    def receive(item: Any) -> None:
        if not getattr(_thread, "attached", False):
            _stay_attached()
        take(item)

    return zenoh.handlers.Callback(receive, indirect=False), None


def _stay_attached() -> None:
    """Have the calling thread, one of Zenoh's, keep its thread state of the interpreter until it ends.

    The interpreter makes one whenever a foreign thread calls into it, and drops it on the way back unless an earlier
    call has not returned. Per message that is memory mapped and unmapped, and every processor of the process is
    interrupted to forget it: half the system time, and a tenth of all time, that receiving 4 kB takes. This is such a
    call; the lock is given back with the callback, as ever. A thread that ends leaves its state behind; Zenoh's threads
    live as long as the process, unless a callback blocks in Zenoh.
    """
    ctypes.pythonapi.PyGILState_Ensure()
    _thread.attached = True


def reason(error: zenoh.ZError) -> str:
    """Return Zenoh's words without the places in its sources."""
    text = re.sub(r" at /\S+?:\d+\.?", "", str(error))
    return " ".join(text.split()).rstrip(".")[:300]


@contextlib.contextmanager
def usable() -> Iterator[None]:
    """Raise `ConnectionFailed` in place of Zenoh's error."""
    try:
        yield
    except zenoh.ZError as error:
        raise ConnectionFailed(f"the connection cannot be used: {reason(error)}") from error

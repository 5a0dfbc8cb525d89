"""What is declared on a session, typed: publishers, tokens, queries, and the threads that read what comes in."""

from __future__ import annotations

import contextlib
import ctypes
import queue
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

import optipmb_schemas as schemas
import structlog
import zenoh
import zenoh.ext

from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh.connection import line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

FULL_S: Final = 0.005
"""How long the thread of the network waits before it looks again for room in a channel."""

LATE_S: Final = 1.0
"""How much later than its timeout a query may end."""

HEARTBEAT_S: Final = 1.0
"""How long the loss of a newest message of a cached publisher may stay unnoticed when no other one follows.

Heartbeats go on in silence: one that is sent once alone could be lost with the message, as when a router is started
again. For that they are not often: thousands of silent publishers cost little.
"""

log = structlog.get_logger("optipmb_service")

_T = TypeVar("_T")

_thread = threading.local()
"""Lives as long as the state of the thread does."""


# What is used of Zenoh's objects, typed: its own stubs leave parts untyped.
class Undeclared(Protocol):
    """What is declared on a session."""

    def undeclare(self) -> object:
        """Withdraw it."""


class Putting(Protocol):
    """A publisher of Zenoh's own."""

    def put(self, payload: bytes) -> object:
        """Send it."""


class Channel(Generic[_T]):
    """What comes in on the threads of the network, in its order, for a thread that iterates over it.

    Zenoh's own channels wake who waits for them ten times a second, to look for signals.

    Args:
        most: items that may wait once they are read; the thread of the network waits beyond that. Before, all may: what
            is there already comes on the thread that declares, which is the one that begins to read.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # To put into this queue and to wake its reader takes half of what `queue.Queue` takes. It has no bound.
        self._waiting: queue.SimpleQueue[_T | None] = queue.SimpleQueue()
        self._bounded = False
        self._closed = False

    @property
    def handler(self) -> tuple[Any, None]:
        """What Zenoh is to be given."""
        return directly(self.put)

    def __iter__(self) -> Iterator[_T]:
        """Yield what comes until the end."""
        self._bounded = True
        while (item := self._waiting.get()) is not None:
            yield item
        with contextlib.suppress(queue.Empty):
            while (item := self._waiting.get_nowait()) is not None:  # what waited for room
                yield item

    def close(self) -> None:
        """End the reading after what has come."""
        self._closed = True
        self._waiting.put(None)

    def put(self, item: _T) -> None:
        """Put something last; waits for room where it is read."""
        while self._bounded and self._waiting.qsize() >= self._most and not self._closed:
            time.sleep(FULL_S)
        self._waiting.put(item)


class Replies:
    """The replies to a query, for the thread that asks to iterate over.

    What is in the same session answers on that thread before it can read: a channel with a bound, as Zenoh's own, would
    wait for room for ever, with the lock of a cache held. The bound is the time.

    Args:
        timeout: of the query (s).
    """

    def __init__(self, timeout: float) -> None:
        self._ends = time.monotonic() + timeout + LATE_S
        self._waiting: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()

    @property
    def handler(self) -> zenoh.handlers.Callback[zenoh.Reply]:
        """What Zenoh is to be given."""
        return zenoh.handlers.Callback(self._waiting.put, partial(self._waiting.put, None), indirect=False)

    def __iter__(self) -> Iterator[zenoh.Reply]:
        """Yield the replies until the last; nothing that comes later than the query may take."""
        with contextlib.suppress(queue.Empty):
            while (reply := self._waiting.get(timeout=max(0.0, self._ends - time.monotonic()))) is not None:
                yield reply


def directly(take: Callable[[Any], None]) -> tuple[Any, None]:
    """Have what comes handed over on the thread of the network.

    A pair with something that could be read: with a callback alone Zenoh lets a subscription run in the background, and
    what it has declared for recovery beside it is not withdrawn with it.
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
    interrupted to forget it. This is such a call; the lock is given back with the callback, as ever. A thread that ends
    leaves its state behind; Zenoh's threads live as long as the process, unless a callback blocks in Zenoh.
    """
    ctypes.pythonapi.PyGILState_Ensure()
    _thread.attached = True


class Readers:
    """What is read: each thing that was declared has a thread of its own, and no message ends the reading."""

    def __init__(self) -> None:
        self._reading: list[tuple[str, Undeclared, Iterable[Any], threading.Thread]] = []

    def add(self, name: str, declared: Undeclared, handler: Iterable[_T], receive: Callable[[_T], None]) -> None:
        """Hand over what comes in, one after the other, until the end."""

        def drain() -> None:
            with contextlib.suppress(zenoh.ZError):  # how a channel says that it is closed and empty
                for item in handler:
                    try:
                        receive(item)
                    except Exception:
                        log.exception("internal_error", reader=name)  # one message must not end the reading

        thread = threading.Thread(target=drain, name=f"reader-{name}", daemon=True)
        thread.start()
        self._reading.append((name, declared, handler, thread))

    def stop(self, timeout: float) -> None:
        """Withdraw everything; what was received before is handed over within `timeout` seconds each."""
        reading, self._reading = self._reading, []
        for one in reading:
            self._withdraw(*one[1:3])
        for *_, thread in reading:
            thread.join(timeout)

    def end(self, name: str) -> None:
        """Withdraw what has a name, if there is any; what was received before is handed over soon."""
        left = [one for one in self._reading if one[0] == name]
        self._reading = [one for one in self._reading if one[0] != name]
        for one in left:
            self._withdraw(*one[1:3])

    @staticmethod
    def _withdraw(declared: Undeclared, handler: Iterable[Any]) -> None:
        undeclare(declared)
        if isinstance(handler, Channel):
            handler.close()


def cached_publisher(
    session: zenoh.Session,
    key: str,
    kind: type[schemas.Message],
    cache: int,
    *,
    priority: zenoh.Priority = zenoh.Priority.DATA_HIGH,
    express: bool = True,
    detected: bool = True,
) -> Putting:
    """Declare a publisher that keeps its newest messages for subscribers that lost some or come late.

    It needs `key_numbers.CACHED` numbers, which are to be taken before.

    Args:
        session: to publish on.
        key: of what is published.
        kind: of its messages.
        cache: how many it keeps.
        priority: of its messages.
        express: whether each is sent at once.
        detected: whether a token says that it is there, from before its first message.

    Raises:
        TransportError: the session is closed.
    """
    try:
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=schemas.encoding_of(kind),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            express=express,
            cache=zenoh.ext.CacheConfig(cache),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=detected,
        )
    except zenoh.ZError as error:
        raise TransportError(line(error)) from error


def publish_problem(session: zenoh.Session, keys: schemas.Keys, problem: schemas.Problem) -> None:
    """Send a problem on its stream's key; one without a stream has no key and is not sent."""
    if not problem.stream:
        return
    with contextlib.suppress(zenoh.ZError):  # at the end: the session is closed
        session.put(
            keys.problems(problem.stream),
            schemas.encode(problem),
            encoding=schemas.encoding_of(problem),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )


class Publisher:
    """A publisher of Zenoh's own, and what else is declared while it is there.

    It is withdrawn by letting go of it: what Zenoh calls `undeclare` waits for the heartbeats to end with the lock of
    the interpreter held. While the thread that sends them waits for that lock, the whole process would be blocked
    until Zenoh gives up, after ten seconds.
    """

    def __init__(
        self,
        publisher: Putting,
        others: Sequence[Undeclared] = (),
        forget: Callable[[Publisher], None] = lambda _: None,
    ) -> None:
        self._publisher: Putting | None = publisher
        self._others = others
        self._forget = forget

    def publish(self, payload: bytes) -> None:
        """Send an encoded message.

        Raises:
            TransportError: the publisher is withdrawn.
        """
        publisher = self._publisher
        if publisher is None:
            raise TransportError("the publisher is withdrawn")
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def release(self) -> None:
        """Withdraw all of it."""
        for other in self._others:
            undeclare(other)
        self._publisher = None
        self._forget(self)


def undeclare(declared: Undeclared) -> None:
    """Withdraw what was declared; when the session is closed there is nothing to withdraw."""
    with contextlib.suppress(zenoh.ZError):
        declared.undeclare()

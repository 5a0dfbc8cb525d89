"""A client of the network, for an edge that speaks for others: publishes inputs, reads outputs, asks.

What it declares is what `optipmb_client` declares for a program of its own, so that nothing on the network can tell the
two apart. Everything here may be called by any thread; `ask` and `recent` wait for answers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self, cast

import optipmb_schemas as schemas
import zenoh
import zenoh.ext

from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh import key_numbers
from optipmb_service.zenoh.connection import close, line, opened
from optipmb_service.zenoh.handles import Publisher, Replies, cached_publisher, publish_problem
from optipmb_service.zenoh.subscription import Subscription

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.handles import Putting
    from optipmb_service.zenoh.key_numbers import KeyCount


NEW_STREAMS: Final = 4000
"""Publishers and subscriptions that edges have declared at once."""

NEW_STREAM_S: Final = 0.5
"""Time after which there is a further one, in the long run."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it came: key, payload, Zenoh encoding; `good` is False for an error reply."""

    key: str
    payload: bytes
    encoding: str
    good: bool = True


class Outgoing:
    """The publishers of one stream's detections and clouds.

    Args:
        session: to publish on.
        keys: of the network.
        stream: its name.
        cache: detections that are kept for recovery.
        cache_clouds: clouds that are kept; without any they are sent only while somebody subscribes.
        wanted: called on any thread, and only to pass it on, when it has changed whether anybody takes clouds.

    Raises:
        TransportError: the session is closed, or has declared all keys that it can.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: schemas.Keys,
        stream: str,
        cache: int,
        cache_clouds: int,
        wanted: Callable[[], None],
    ) -> None:
        self._matching: Any = None
        self.wanted = wanted
        taken = key_numbers.take(session, key_numbers.CACHED)
        cached = cached_publisher(session, keys.detections(stream), schemas.Detections, cache)
        self._detections = Publisher(cached, (taken,))
        if cache_clouds:
            taken = key_numbers.take(session, key_numbers.CACHED)
            low = zenoh.Priority.DATA_LOW
            cached = cached_publisher(
                session, keys.points(stream), schemas.Points, cache_clouds, priority=low, express=False
            )
            self._points = Publisher(cached, (taken,))
            return
        taken = key_numbers.take(session, key_numbers.PLAIN)
        try:
            plain = session.declare_publisher(
                keys.points(stream),
                encoding=schemas.encoding_of(schemas.Points),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )
            self._points, self._matching = Publisher(cast("Putting", plain), (taken,)), cast("Any", plain)
            plain.declare_matching_listener(lambda _status: self.wanted())
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    @property
    def points_wanted(self) -> bool:
        """Whether anybody is known to take clouds; always with a cache, which serves those who come later."""
        matching = self._matching  # `close` may take it away meanwhile
        return matching is None or bool(matching.matching_status.matching)

    def detections(self, payload: bytes) -> None:
        """Send encoded detections.

        Raises:
            TransportError: the publisher is withdrawn.
        """
        self._detections.publish(payload)

    def points(self, payload: bytes) -> None:
        """Send an encoded cloud.

        Raises:
            TransportError: the publisher is withdrawn.
        """
        self._points.publish(payload)

    def close(self) -> None:
        """Withdraw both."""
        self._detections.release()
        self._points.release()
        self._matching = None


class Client:
    """A session as edges use it.

    Args:
        session: where everything is declared.
        prefix: first chunks of all keys.
        router: whether the session is a router itself.
    """

    def __init__(self, session: zenoh.Session, prefix: str, *, router: bool = False) -> None:
        self.keys = schemas.Keys(prefix)
        self._session = session
        self._router = router
        self._turns = key_numbers.Turns(NEW_STREAMS, NEW_STREAM_S)

    @classmethod
    def opened(cls, settings: Settings) -> Self:
        """Open a session of one's own; waits for a router.

        Raises:
            TransportError: an endpoint or the configuration cannot be used.
        """
        return cls(opened(settings), settings.prefix)

    def close(self) -> None:
        """Close the session."""
        close(self._session)

    def linked(self) -> bool:
        """Whether the session has a router, or is one."""
        return self._router or bool(self._session.info.routers_zid())

    @property
    def failure(self) -> str:
        """Why nothing can be received or sent; empty while it can."""
        return "" if self.linked() else "network: no router"

    @property
    def key_numbers(self) -> KeyCount:
        """What is used of the numbers that the session has for keys."""
        return key_numbers.used(self._session)

    def publish(self, stream: str, cache: int, cache_clouds: int, wanted: Callable[[], None]) -> Outgoing:
        """Open the publishers of a stream; arguments and errors are those of `Outgoing`.

        Raises:
            TransportError: also where too many were opened.
        """
        self._turns.take()
        return Outgoing(self._session, self.keys, stream, cache, cache_clouds, wanted)

    def publish_problem(self, problem: schemas.Problem) -> None:
        """Send a problem of a stream."""
        publish_problem(self._session, self.keys, problem)

    def subscribe(self, key: str, receive: Callable[[Message], None]) -> Subscription:
        """Hand over what is published under a key expression, and what caches hold, on a thread of its own.

        Raises:
            TransportError: the session is closed, or too many were opened.
        """
        self._turns.take()
        return Subscription(self._session, key, lambda sample: receive(_message(sample)))

    def recent(self, key: str, timeout: float) -> list[Message]:
        """Return what the caches of advanced publishers hold under a key expression, those of a publisher in order.

        Raises:
            TransportError: the session is closed.
        """
        return [one for one in self.ask(f"{key}/@adv/**", timeout=timeout) if one.good]

    def ask(self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float) -> list[Message]:
        """Ask everybody who answers at a key; nothing when nobody did in time (s).

        Raises:
            TransportError: the session is closed.
        """
        answers, replies = [], Replies(timeout)
        try:
            self._session.get(
                key,
                replies.handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # the default keeps one reply per key: of two services one
                accept_replies=zenoh.ReplyKeyExpr.ANY,  # a cache answers with the keys that it caches
                timeout=timeout,
                payload=payload or None,
                encoding=encoding or None,
            )
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        for reply in replies:
            if (sample := reply.ok) is not None:
                answers.append(_message(sample))
            elif (error_reply := reply.err) is not None and (said := error_reply.payload.to_bytes()) != b"Timeout":
                answers.append(Message(key, said, str(error_reply.encoding), good=False))
        return answers

    def alive(self, pattern: str, timeout: float) -> list[str]:
        """Return the keys of the liveliness tokens under a pattern, sorted.

        Raises:
            TransportError: the session is closed.
        """
        replies = Replies(timeout)
        try:
            self._session.liveliness().get(pattern, replies.handler, timeout=timeout)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        return sorted({str(sample.key_expr) for reply in replies if (sample := reply.ok) is not None})


def _message(sample: zenoh.Sample) -> Message:
    return Message(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))

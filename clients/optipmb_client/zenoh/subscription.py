"""Subscriptions: samples, and what the caches of their publishers hold, on the way to an inbox."""

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeAlias, TypeVar

import zenoh
import zenoh.ext
from optipmb_schemas.late_join import ANSWER_S, CacheQueries, LateJoin

from optipmb_client.incoming import Arrival, Inbox

__all__ = ["Subscription", "Subscriptions", "subscribe"]

CLOSE_S = 5.0  # how long closing waits for what has come to be moved
_Result = TypeVar("_Result")
_Handler: TypeAlias = "tuple[zenoh.handlers.Callback[zenoh.Sample], None]"  # the class cannot be subscripted


class Subscription:
    """Samples that a thread moves into an inbox.

    Args:
        declare: Declares the subscriber with the handler that it is given.
        inbox: Where samples go.
        session: For the caches of publishers that were there before the subscription.
    """

    def __init__(self, declare: Callable[[_Handler], Any], inbox: Inbox, session: zenoh.Session) -> None:
        self._inbox = inbox
        self._session = session
        self._queries: CacheQueries[zenoh.Sample] = CacheQueries(self._ask)
        self._after_loss: set[str] = set()
        self._late_join: LateJoin[zenoh.Sample] = LateJoin(self._receive, self._queries.ask, lost=self._after_loss.add)
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
        payload, key = sample.payload.to_bytes(), str(sample.key_expr)
        after_loss = key in self._after_loss
        self._after_loss.discard(key)
        self._inbox.put(Arrival(key, payload, str(sample.encoding), arrived, after_loss=after_loss))

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


class Subscriptions:
    """Several of them, which end together."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions

    def close(self) -> None:
        """End all; what is in the inbox stays readable."""
        for subscription in self._subscriptions:
            subscription.close()


def subscribe(session: zenoh.Session, pattern: str, inbox: Inbox) -> Subscription:
    """Move all that is published under `pattern` into `inbox`; losses are recovered from the publishers' caches.

    What those caches hold from before the subscription comes first. (Recovery would bring it anyhow, at the first
    heartbeat of a publisher: for it a late subscriber is one that has lost everything so far.)
    """

    def declare(handler: _Handler) -> Any:
        return zenoh.ext.declare_advanced_subscriber(
            session,
            pattern,
            handler,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )

    return Subscription(declare, inbox, session)


def _on_a_daemon_thread(work: Callable[[], _Result]) -> _Result:
    """Do something on a daemon thread: threads that it starts are daemons, too, and keep no program from ending."""
    done: Future[_Result] = Future()

    def do() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised again where the result is waited for
            done.set_exception(error)

    threading.Thread(target=do, name="declare", daemon=True).start()
    return done.result()

"""A subscription whose samples a thread of its own hands over: nothing that a publisher still caches is missing."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import structlog
import zenoh
import zenoh.ext
from optipmb_schemas.late_join import ANSWER_S, CacheQueries, LateJoin

from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh import key_numbers
from optipmb_service.zenoh.connection import line
from optipmb_service.zenoh.handles import Channel, Readers

if TYPE_CHECKING:
    from collections.abc import Callable

log = structlog.get_logger("optipmb_service")

CHANNEL: Final = 1024
"""Messages between Zenoh and a draining thread; more than any publisher's history."""

CLOSE_S: Final = 5.0


class Subscription:
    """A key expression whose samples are handed over; what was lost is recovered from the publishers' caches.

    Args:
        session: to subscribe on.
        key: the key expression.
        receive: called for each sample, one after the other.

    Raises:
        TransportError: the session is closed, or has declared all keys that it can.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        receive: Callable[[zenoh.Sample], None],
    ) -> None:
        self._key = key
        self._receive = receive
        self._queries: CacheQueries[zenoh.Sample] = CacheQueries(partial(ask_cache, session))
        self._late_join: LateJoin[zenoh.Sample] = LateJoin(self._hand_over, self._queries.ask)
        waiting: Channel[zenoh.Sample] = Channel(CHANNEL)
        self._taken = key_numbers.take(session, key_numbers.CACHED)
        try:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session,
                key,
                waiting.handler,
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        self._readers = Readers()
        self._readers.add(key, subscriber, waiting, self._take)

    def close(self, timeout: float = CLOSE_S) -> None:
        """End it; what came before is handed over within `timeout` seconds, and nothing afterwards."""
        self._readers.stop(timeout)
        self._taken.undeclare()
        self._queries.close()
        self._late_join.close()

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._late_join.take(sample)

    def _hand_over(self, sample: zenoh.Sample) -> None:
        try:
            self._receive(sample)
        except Exception:
            log.exception("internal_error", reader=self._key)  # one message must not end the reading


def ask_cache(
    session: zenoh.Session, selector: str, reply: Callable[[zenoh.Sample], None], end: Callable[[bool], None]
) -> None:
    """Ask publishers' caches for what they hold: `reply` is called with each message, and `end` when no more comes.

    `end` is called with whether all have answered, within `ANSWER_S`. In a closed session nobody does.
    """
    errors = []

    def take(answer: zenoh.Reply) -> None:
        if (sample := answer.ok) is not None:
            reply(sample)
        else:
            errors.append(answer.err)

    try:
        session.get(
            selector,
            zenoh.handlers.Callback(take, lambda: end(not errors)),
            target=zenoh.QueryTarget.ALL,
            accept_replies=zenoh.ReplyKeyExpr.ANY,  # a cache answers with the keys that it caches
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ANSWER_S,
        )
    except zenoh.ZError:
        end(False)

"""Queries that come in: each is open until it is finished, and only so many are open at once."""

from __future__ import annotations

import contextlib
import threading
import weakref
from typing import TYPE_CHECKING, Any, Final, cast

import optipmb_schemas as schemas
import zenoh

from optipmb_service.runtime.ports import TransportError
from optipmb_service.runtime.queries import problem_with
from optipmb_service.zenoh.connection import line
from optipmb_service.zenoh.handles import Channel, directly

if TYPE_CHECKING:
    from collections.abc import Callable

MOST_OPEN: Final = 256
"""Queries of one key expression that may be open; those beyond are refused. The thread that brings them brings
detections, too, and must not wait for answers."""


class OpenQueries(Channel["Question"]):
    """The queries of one key expression, in their order, for a thread that iterates over them.

    Args:
        instance: name of the service, for refusals.
    """

    def __init__(self, instance: str) -> None:
        super().__init__(MOST_OPEN)
        self._room = threading.Semaphore(MOST_OPEN)
        full = schemas.MessageError("too_large", "key", f"at most {MOST_OPEN} queries open at once", "another one")
        self._refusal = problem_with(full, instance=instance, code="refused")

    @property
    def handler(self) -> tuple[Any, None]:
        """What Zenoh is to be given."""
        return directly(self._take)

    def _take(self, query: zenoh.Query) -> None:
        """Take a query on the thread of the network that brings it."""
        if self._room.acquire(blocking=False):
            self.put(Question(query, self._room.release))
            return
        question = Question(query)
        with contextlib.suppress(TransportError):  # who asked is gone
            question.refuse(self._refusal)
        question.finish()


class Question:
    """A query; not finished, it keeps its asker waiting until the timeout.

    Args:
        query: as it came.
        ended: called once, when it is finished, or forgotten by all.
    """

    def __init__(self, query: zenoh.Query, ended: Callable[[], None] = lambda: None) -> None:
        self._query = query
        self._ended = weakref.finalize(self, ended)
        self.key = str(query.key_expr)
        payload = query.payload
        self.payload = None if payload is None else payload.to_bytes()
        self.encoding = "" if query.encoding is None else str(query.encoding)

    def matches(self, key: str) -> bool:
        """Tell whether the key expression that was asked includes a key."""
        return bool(self._query.key_expr.intersects(zenoh.KeyExpr(key)))

    def answer(self, key: str, message: schemas.Message) -> None:
        """Reply.

        Raises:
            TransportError: the asker or the session is gone.
        """
        try:
            self._query.reply(key, schemas.encode(message), encoding=schemas.encoding_of(message))
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def answer_text(self, key: str, text: bytes, encoding: str, *, about: str = "") -> None:
        """Reply with bytes as they are, and with the key that they are about.

        Raises:
            TransportError: the asker or the session is gone.
        """
        try:
            self._query.reply(key, text, encoding=encoding, attachment=about or None)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def refuse(self, problem: schemas.Problem) -> None:
        """Reply with an error.

        Raises:
            TransportError: the asker or the session is gone.
        """
        try:
            self._query.reply_err(schemas.encode(problem), encoding=schemas.encoding_of(problem))
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def finish(self) -> None:
        """Tell the asker that nothing follows."""
        cast("Any", self._query).drop()
        self._ended()

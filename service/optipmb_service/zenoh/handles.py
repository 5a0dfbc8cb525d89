"""What the transport hands out: the publisher of a stream's tracks, a liveliness token, a query to be answered."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Protocol, cast

import optipmb_schemas as schemas
import zenoh

from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh.connection import line

if TYPE_CHECKING:
    from collections.abc import Callable


# What is used of Zenoh's objects, typed: its own stubs leave parts untyped.
class Undeclared(Protocol):
    """What is declared on a session."""

    def undeclare(self) -> object: ...  # noqa: D102 - withdraw it


class _Dropped(Protocol):
    def drop(self) -> object: ...


class _Publisher(Undeclared, Protocol):
    def put(self, payload: bytes) -> object: ...


class Publisher:
    """The publisher of a stream's tracks."""

    def __init__(self, publisher: _Publisher, forget: Callable[[Publisher], None]) -> None:
        self._publisher = publisher
        self._forget = forget

    def publish(self, payload: bytes) -> None:
        """Send encoded tracks.

        Raises:
            TransportError: the publisher is withdrawn.
        """
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def release(self) -> None:
        """Withdraw the publisher."""
        undeclare(self._publisher)
        self._forget(self)


class Token:
    """A liveliness token; it vanishes with its process and its link too."""

    def __init__(self, declared: Undeclared) -> None:
        self._declared = declared

    def withdraw(self) -> None:
        """Take it back."""
        undeclare(self._declared)


class Question:
    """A query; not finished, it keeps its asker waiting until the timeout."""

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
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

    def answer_text(self, key: str, text: bytes, encoding: str) -> None:
        """Reply with text that is no message.

        Raises:
            TransportError: the asker or the session is gone.
        """
        try:
            self._query.reply(key, text, encoding=encoding)
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
        cast("_Dropped", self._query).drop()


def undeclare(declared: Undeclared) -> None:
    """Withdraw what was declared; when the session is closed there is nothing to withdraw."""
    with contextlib.suppress(zenoh.ZError):
        declared.undeclare()

"""Which publishers' caches a session waits for: frames before those that it holds may still come from them."""

from __future__ import annotations

import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING, Final

from optipmb_service.runtime.directory import BACK_NS
from optipmb_service.runtime.ports import TransportError
from optipmb_service.session.values import MAX_SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.runtime.ports import Caches, Packet
    from optipmb_service.session.session import Session

MOST: Final = 4 * MAX_SENSORS
"""Streams whose caches have answered; when there are more, those are forgotten whose publishers have gone."""


class AwaitedCaches:
    """The caches of one session's streams; for the tracking thread alone.

    Args:
        stream: the name of the session.
        caches: returns what is known of the publishers' caches.
    """

    def __init__(self, stream: str, caches: Callable[[], Caches]) -> None:
        self._stream = stream
        self._caches = caches
        self._answered: set[str] = set()
        self._asked: set[str] = set()
        self._most = MOST

    def answered(self, *streams: str) -> None:
        """Note that all has come which the caches of these streams held."""
        self._answered.update(streams)
        self._asked.update(streams)
        if len(self._answered) > self._most:
            there = self._caches().awaited(self._stream, self._answered).keys()
            self._answered &= there
            self._asked &= there
            self._most = max(MOST, 2 * len(self._answered))  # publishers that are there are not gone over each time

    def ask_again(self, stream: str) -> None:
        """Note that the cache of a stream has not answered in full."""
        self._asked.discard(stream)

    def forget(self) -> None:
        """Begin again: the session has ended."""
        self._answered.clear()
        self._asked.clear()
        self._most = MOST

    def awaited(self, session: Session, take: Callable[[str, list[tuple[Packet, bool]], bool], None]) -> bool:
        """Whether the caches of sensors may hold what has not come; those that have not answered are asked.

        Args:
            session: it says what it waits for.
            take: takes what the cache of a stream held, each packet with whether it is a frame, and whether that is
                all; called on any thread.
        """
        caches = self._caches()
        awaited = caches.awaited(self._stream, session.sensors)
        for stream, is_there in awaited.items():
            if is_there and stream not in self._asked:
                self._asked.add(stream)
                with contextlib.suppress(TransportError):  # the end
                    caches.ask_cache(stream, partial(take, stream))
        # Tokens of sensors that a young session does not know may be on their way.
        young_ns = session.young_since_ns
        is_young = young_ns is not None and time.monotonic_ns() - young_ns < BACK_NS
        return is_young or not awaited.keys() <= self._answered

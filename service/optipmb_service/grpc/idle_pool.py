"""Subscriptions and publishers without a call, kept for the next one: Zenoh never gives back the number of a key."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Hashable

KEPT_S: Final = 60.0
"""Time after which one that nobody has taken is closed."""


class IdlePool:
    """Idle objects by key, each closed after `KEPT_S`; all methods belong to the loop.

    Args:
        loop: of the gateway.
        most: idle objects at most; beyond it the oldest is closed.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, most: int) -> None:
        self._loop = loop
        self._most = most
        self._kept: collections.OrderedDict[Hashable, tuple[asyncio.TimerHandle, Callable[[], None]]] = (
            collections.OrderedDict()
        )

    def keep(self, key: Hashable, end: Callable[[], None]) -> None:
        """Add an object under a free key; `end` closes it unless it is taken in time."""
        self._kept[key] = self._loop.call_later(KEPT_S, self._end, key), end
        while len(self._kept) > self._most:
            self._end(next(iter(self._kept)))

    def take(self, key: Hashable) -> bool:
        """Remove the object of a key without closing it; False when there is none."""
        if (found := self._kept.pop(key, None)) is None:
            return False
        found[0].cancel()
        return True

    def close(self) -> None:
        """Close all objects."""
        for key in list(self._kept):
            self._end(key)

    def _end(self, key: Hashable) -> None:
        timer, end = self._kept.pop(key)
        timer.cancel()
        end()

"""What calls leave behind for those that come soon after them: each key that Zenoh is given takes a number for ever."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Hashable

KEPT_S: Final = 60.0
"""How long it is kept."""


class Kept:
    """What nobody uses now, by its key; all methods belong to the loop.

    Args:
        loop: of the gateway.
        most: so much is kept; of more, the oldest ends.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, most: int) -> None:
        self._loop = loop
        self._most = most
        self._kept: collections.OrderedDict[Hashable, tuple[asyncio.TimerHandle, Callable[[], None]]] = (
            collections.OrderedDict()
        )

    def keep(self, key: Hashable, end: Callable[[], None]) -> None:
        """Keep something under a key that nothing is kept under; `end` is called unless it is taken in time."""
        self._kept[key] = self._loop.call_later(KEPT_S, self._end, key), end
        while len(self._kept) > self._most:
            self._end(next(iter(self._kept)))

    def take(self, key: Hashable) -> bool:
        """Take what is kept under a key; False when there is nothing."""
        if (found := self._kept.pop(key, None)) is None:
            return False
        found[0].cancel()
        return True

    def close(self) -> None:
        """End everything."""
        for key in list(self._kept):
            self._end(key)

    def _end(self, key: Hashable) -> None:
        timer, end = self._kept.pop(key)
        timer.cancel()
        end()

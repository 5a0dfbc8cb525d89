"""Publishers of streams, reused by calls that follow each other."""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial
from typing import TYPE_CHECKING, Final

from optipmb_service.grpc.idle_pool import IdlePool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from optipmb_service.zenoh.client import Client, Outgoing

KEPT: Final = 64
"""Streams whose publishers are kept, with what they cache, when no call has them any more."""

Key = tuple[str, int, int]
"""Stream, cached detections, cached clouds."""


class Publishers:
    """The publishers of a gateway; all methods belong to its loop.

    Args:
        client: of the network.
        loop: of the gateway.
    """

    def __init__(self, client: Client, loop: asyncio.AbstractEventLoop) -> None:
        self._client = client
        self._loop = loop
        self._kept = IdlePool(loop, KEPT)
        self._left: dict[Key, Outgoing] = {}

    @contextlib.asynccontextmanager
    async def opened(self, key: Key, wanted: Callable[[], None]) -> AsyncIterator[Outgoing]:
        """Give the publishers of a stream for a call alone; `wanted` as for `Outgoing`.

        Raises:
            TransportError: the network cannot be used, or too many were opened.
        """
        if self._kept.take(key):
            outgoing = self._left.pop(key)
            outgoing.wanted = wanted
        else:
            outgoing = self._client.publish(*key, wanted)
        try:
            yield outgoing
        finally:
            outgoing.wanted = _nobody
            if key in self._left or key[2]:  # another call has left its own; clouds take much memory
                await asyncio.shield(asyncio.to_thread(outgoing.close))
            else:
                self._left[key] = outgoing
                self._kept.keep(key, partial(self._end, key))

    def close(self) -> None:
        """End the publishers that no call has any more."""
        self._kept.close()

    def _end(self, key: Key) -> None:
        self._loop.run_in_executor(None, self._left.pop(key).close)


def _nobody() -> None:
    """Tell nobody."""

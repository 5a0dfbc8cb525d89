"""The frames of a call that are without tracks: their number is what the caller's speed is bounded by."""

from __future__ import annotations

import asyncio
import collections
import time
from typing import Final

STALL_S: Final = 1.0
"""Frames that are without tracks when nothing has come for so long have been refused, or nobody tracks."""


class Flight:
    """Frames on their way; all of it happens on the loop."""

    def __init__(self) -> None:
        self._frames: collections.OrderedDict[tuple[bytes, int], None] = collections.OrderedDict()
        self._progress = time.monotonic()
        self._changed = asyncio.Event()

    def sent(self, epoch: bytes, seq: int) -> None:
        """Count a frame that goes out."""
        if not self._frames:
            self._progress = time.monotonic()
        self._frames[epoch, seq] = None

    def came(self, epoch: bytes, seq: int) -> None:
        """Take in that a frame has tracks; those sent before it that have none will have none, or have them late."""
        if (epoch, seq) in self._frames:
            while next(iter(self._frames)) != (epoch, seq):
                self._frames.popitem(last=False)
            del self._frames[epoch, seq]
            self._progress = time.monotonic()
            self._changed.set()

    async def below(self, most: int) -> None:
        """Wait until less than so many frames are without tracks; when that stalls, forget them."""
        while len(self._frames) >= most:
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), self._progress + STALL_S - time.monotonic())
            except TimeoutError:
                self._frames.clear()

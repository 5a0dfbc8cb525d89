"""Bytes that all streams of a process share."""

from __future__ import annotations

import threading
from typing import Final

MEGABYTE: Final = 2**20


class ByteBudget:
    """A number of bytes to be taken and given back, by any thread.

    Args:
        most: how many there are.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self.used = 0

    def add(self, size: int) -> bool:
        """Take bytes, or give back with a negative size; False when more are taken than there are."""
        with self._lock:
            self.used += size
            return self.used <= self._most

    def take(self, size: int) -> bool:
        """Take bytes if there are so many."""
        with self._lock:
            if self.used + size > self._most:
                return False
            self.used += size
            return True

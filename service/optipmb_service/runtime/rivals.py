"""Streams that another instance tracks too, for the two share no store: it is reported, nothing is decided by it."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator


class Rivals:
    """What other instances say that they track.

    Args:
        instance: the name of this one.
        patience_ns: how long two may say so while one takes over from the other, monotonic time.
    """

    def __init__(self, instance: str, patience_ns: int) -> None:
        self._instance = instance
        self._patience_ns = patience_ns
        self._lock = threading.Lock()
        self._others: dict[str, set[str]] = {}
        self._since_ns: dict[str, int] = {}

    def told(self, stream: str, instance: str, present: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Take in that an instance tracks a stream, or does so no longer."""
        if instance == self._instance:
            return
        with self._lock:
            others = self._others.setdefault(stream, set())
            (others.add if present else others.discard)(instance)
            if not others:
                del self._others[stream]

    def tracks(self, stream: str) -> bool:
        """Whether another instance says that it tracks a stream."""
        return stream in self._others

    def contested(self, tracked: Collection[str], now_ns: int) -> Iterator[tuple[str, str]]:
        """Yield the streams tracked here that another instance has tracked too for longer than is right, and its name.

        Args:
            tracked: the streams tracked here.
            now_ns: monotonic time.
        """
        with self._lock:
            both = {stream: min(self._others[stream]) for stream in tracked if stream in self._others}
        self._since_ns = {stream: self._since_ns.get(stream, now_ns) for stream in both}
        for stream, since_ns in self._since_ns.items():
            if now_ns - since_ns > self._patience_ns:
                yield stream, both[stream]

"""Streams that several instances track, for they share no store: it is reported, nothing is decided by it.

One member of all looks, the discoverer: what the network takes for a token grows with how many others look at it.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


class Rivals:
    """What instances say that they track.

    Args:
        patience_ns: how long two may say so while one takes over from the other, monotonic time.
    """

    def __init__(self, patience_ns: int) -> None:
        self._patience_ns = patience_ns
        self._lock = threading.Lock()
        self._owners: dict[str, set[str]] = {}
        self._shared: set[str] = set()
        """Streams with several owners."""
        self._since_ns: dict[str, int] = {}

    def on_owner(self, stream: str, instance: str, present: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Take in that an instance tracks a stream, or does so no longer."""
        with self._lock:
            owners = self._owners.setdefault(stream, set())
            (owners.add if present else owners.discard)(instance)
            (self._shared.add if len(owners) > 1 else self._shared.discard)(stream)
            if not owners:
                del self._owners[stream]

    def tracks(self, stream: str) -> bool:
        """Whether an instance says that it tracks a stream."""
        return stream in self._owners

    def contested(self, now_ns: int) -> Iterator[tuple[str, list[str]]]:
        """Yield the streams that several instances have tracked for longer than is right, and their names.

        Args:
            now_ns: monotonic time.
        """
        with self._lock:
            shared = {stream: sorted(self._owners[stream]) for stream in self._shared}
        self._since_ns = {stream: self._since_ns.get(stream, now_ns) for stream in shared}
        for stream, since_ns in self._since_ns.items():
            if now_ns - since_ns > self._patience_ns:
                yield stream, shared[stream]

"""Rivals: streams that several instances track."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


class Rivals:
    """Streams that several instances track, for they share no store: it is reported, nothing is decided by it.

    Tokens that come and go while a link is cut and heals may be told wrongly. So the own ones are not asked for, and
    the others are asked for once more before a stream is reported. One member of all looks, the discoverer: what the
    network takes for a token grows with how many others look at it.

    Args:
        instance: name of this one.
        patience_ns: how long two may say so while one takes over from the other, monotonic time.
        doubted: streams that seemed to have several owners when these were asked for before.
    """

    def __init__(self, instance: str, patience_ns: int, doubted: Iterable[str] = ()) -> None:
        self._instance = instance
        self._patience_ns = patience_ns
        self._asked_again = frozenset(doubted)
        self._lock = threading.Lock()
        self._owners: dict[str, set[str]] = {}
        self._shared: set[str] = set()
        """Streams with several owners elsewhere."""
        self._since_ns: dict[str, int] = {}
        self.doubted: set[str] = set()
        """Streams that seem to have had several owners for too long; the owners are to be asked for again."""

    def again(self) -> Rivals:
        """Return the rivals of a new look at all owners, to whom those doubted now are no surprise."""
        return Rivals(self._instance, self._patience_ns, self.doubted)

    def on_owner(self, stream: str, instance: str, present: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Note that an instance tracks a stream, or does so no longer."""
        if instance == self._instance:
            return
        with self._lock:
            owners = self._owners.setdefault(stream, set())
            (owners.add if present else owners.discard)(instance)
            (self._shared.add if len(owners) > 1 else self._shared.discard)(stream)
            if not owners:
                del self._owners[stream]

    def tracks(self, stream: str) -> bool:
        """Whether another instance says that it tracks a stream."""
        return stream in self._owners

    def contested(self, now_ns: int, here: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
        """Yield the streams that several instances have tracked for longer than is right, and their names.

        Args:
            now_ns: monotonic time.
            here: the streams that this instance tracks.
        """
        with self._lock:
            shared = {stream: sorted(self._owners[stream]) for stream in self._shared}
            for stream in here:
                if stream in self._owners:
                    shared[stream] = sorted({self._instance, *self._owners[stream]})
        self._since_ns = {stream: self._since_ns.get(stream, now_ns) for stream in shared}
        for stream, since_ns in self._since_ns.items():
            if now_ns - since_ns > self._patience_ns and stream not in self.doubted:
                self.doubted.add(stream)
                if stream in self._asked_again:
                    yield stream, shared[stream]

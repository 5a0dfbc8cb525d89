"""Directory of all streams, whichever member tracks them: decisions only, no network and no threads of its own.

A publisher of detections with a cache has a liveliness token, from before its first message to its end. A
publisher without one is noticed by its messages: one member, the *discoverer*, subscribes to the detections of all
streams, and announces such streams by tokens, so all members know of them.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from optipmb_service.session.arrivals import BACK_NS
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

MAX_STREAMS: Final = 65_536
"""Streams that are known at once; publishers beyond it are not heard."""

FORGET_NS: Final = 10 * SECOND
"""Time for which a stream stays known after its last token: a publisher, or the discoverer, may come back."""

TOKEN_NS: Final = SECOND
"""Longest delay of the token of a publisher with a cache after its first message."""

MAX_UNPROVEN_ANNOUNCED: Final = 256
"""Streams without a session that this instance announces at once: each costs members a token and subscriptions."""

UNPROVEN_NS: Final = 30 * SECOND
"""Time for which a stream without a session is announced; then others have their turn before it is again."""

QUEUED_NS: Final = 120 * SECOND
"""Time after its last message for which a stream waits for its turn: as long as first frames are kept."""


def node_of(stream: str) -> str:
    """Return the node of a stream, `site/node`."""
    return stream.rpartition("/")[0]


@dataclass(slots=True)
class _StreamEntry:
    tokens: set[str] = field(default_factory=set)
    """Of publishers with a cache."""
    announcements: set[str] = field(default_factory=set)
    """Tokens by which other instances announce the stream."""
    announced: bool = False
    """Whether this instance does."""
    seen_ns: int = 0
    """When this instance noticed a message last; of streams that it announces."""
    left_ns: int | None = None
    """Monotonic time at which the last token went; None while there is one."""


class StreamDirectory:
    """Known streams, for any thread.

    Args:
        instance: the name of this one.
        idle_ns: silence after which an announced stream is announced no longer.
        has_session: whether a stream is tracked, here or elsewhere.
    """

    def __init__(self, instance: str, idle_ns: int, has_session: Callable[[str], bool]) -> None:
        self.began_ns = 0
        """Monotonic time since which tokens are received; set by the receiver."""
        self._instance = instance
        self._idle_ns = idle_ns
        self._has_session = has_session
        self._unproven: dict[str, int] = {}
        self._queued: dict[str, int] = {}
        self._lock = threading.Lock()
        self._streams: dict[str, _StreamEntry] = {}
        self._nodes: dict[str, dict[str, None]] = {}
        """The streams of each node, in the order in which they came."""
        self._awaited: dict[str, int] = {}

    def published(self, stream: str, token: str, now_ns: int, *, present: bool) -> bool:
        """Note the token of a publisher; True: the known streams change."""
        with self._lock:
            known = self._found(stream) if present else self._streams.get(stream)
            if known is None or (token in known.tokens) is present:
                return False
            (known.tokens.add if present else known.tokens.discard)(token)
            self._awaited.pop(stream, None)
            return self._settled(known, now_ns)

    def discovered(self, stream: str, token: str, now_ns: int, *, present: bool) -> bool:
        """Note that a token announces a stream, or no longer does; True: the known streams change."""
        with self._lock:
            known = self._found(stream) if present else self._streams.get(stream)
            if known is None or (token in known.announcements) is present:
                return False
            (known.announcements.add if present else known.announcements.discard)(token)
            if known.announcements - {token}:
                return False  # it moves to another token of its discoverer, or is announced by two
            return self._settled(known, now_ns)

    def noticed(self, stream: str, now_ns: int, *, recoverable: bool) -> bool:
        """Note a message that the discoverer received; True: its publisher has no token.

        While too many streams wait for a session, a new one is announced when it is its turn.

        Args:
            stream: of the message.
            now_ns: monotonic time.
            recoverable: whether the publisher numbers its messages for recovery; then its token may be on the way.
        """
        known = self._streams.get(stream)
        if known is not None and known.tokens:
            return False  # the usual case, without the lock
        with self._lock:
            known = self._streams.get(stream)
            if known is None or not known.announced:
                if recoverable and now_ns - self._awaited.setdefault(stream, now_ns) < TOKEN_NS:
                    if len(self._awaited) > MAX_STREAMS:
                        self._awaited.clear()
                    return False
                if (known is None or not known.tokens) and not self._admitted(stream, now_ns):
                    return True
                known = self._found(stream)
                if known is None:
                    return False
                known.announced, known.left_ns = True, None
            known.seen_ns = now_ns
            return not known.tokens

    def adopt(self, now_ns: int) -> None:
        """Announce what other discoverers announce, or did until just now: this instance is the discoverer now."""
        with self._lock:
            for known in self._streams.values():
                if not known.tokens and not known.announced:
                    known.announced, known.seen_ns, known.left_ns = True, now_ns, None

    def expire(self, now_ns: int, *, discovering: bool) -> None:
        """Forget streams whose publishers are gone, and announce those no longer that need it no longer."""
        with self._lock:
            if not discovering:
                self._queued.clear()
            for stream, known in tuple(self._streams.items()):
                if known.announced and (known.tokens or not discovering or now_ns - known.seen_ns > self._idle_ns):
                    known.announced = False
                    self._settled(known, now_ns)
                if known.left_ns is not None and now_ns - known.left_ns > FORGET_NS:
                    self._forget(stream)
            self._awaited = {one: since for one, since in self._awaited.items() if now_ns - since < self._idle_ns}
        self.admit(now_ns)

    def streams(self) -> dict[str, bool]:
        """Return the streams that are known, each with whether its publisher has a cache to ask."""
        with self._lock:
            return {stream: bool(known.tokens) for stream, known in self._streams.items()}

    def awaited(
        self, common: str, belongs: Callable[[str], bool], sensors: Iterable[str], now_ns: int
    ) -> dict[str, bool]:
        """Return the streams whose caches may hold something: True where a publisher is there, False: it may come back.

        Args:
            common: their node, `site/node`, or their site.
            belongs: whether a stream of it is in question.
            sensors: the streams of earlier publishers.
            now_ns: monotonic time.
        """
        with self._lock:
            nodes = [common] if "/" in common else [one for one in self._nodes if one.startswith(f"{common}/")]
            there = (one for node in nodes for one in self._nodes.get(node, ()) if self._streams[one].tokens)
            found = {stream: True for stream in there if belongs(stream)}
            for stream in sensors:
                known = self._streams.get(stream, _StreamEntry(left_ns=self.began_ns))
                if known.left_ns is not None and now_ns - known.left_ns < BACK_NS:
                    found[stream] = False
        return found

    def announced(self) -> set[str]:
        with self._lock:
            return {stream for stream, known in self._streams.items() if known.announced}

    def announces(self, stream: str) -> bool:
        known = self._streams.get(stream)
        return known is not None and known.announced

    def _admitted(self, stream: str, now_ns: int) -> bool:
        """Whether a stream may be announced: it has a session, or not too many wait for one."""
        if self._has_session(stream):
            return True
        if len(self._unproven) >= MAX_UNPROVEN_ANNOUNCED:
            if stream in self._queued or len(self._queued) < MAX_STREAMS:
                self._queued[stream] = now_ns
            return False
        self._queued.pop(stream, None)
        self._unproven[stream] = now_ns
        return True

    def admit(self, now_ns: int) -> None:
        """Announce the next streams in place of streams that got a session or waited too long for one."""
        with self._lock:
            for stream, since_ns in tuple(self._unproven.items()):
                known = self._streams.get(stream)
                if known is None or not known.announced or self._has_session(stream):
                    del self._unproven[stream]
                elif now_ns - since_ns > UNPROVEN_NS:
                    del self._unproven[stream]
                    known.announced = False
                    self._settled(known, now_ns)
                    if len(self._queued) < MAX_STREAMS:
                        self._queued.setdefault(stream, known.seen_ns)
            while self._queued and len(self._unproven) < MAX_UNPROVEN_ANNOUNCED:
                stream = next(iter(self._queued))
                seen_ns = self._queued.pop(stream)
                if now_ns - seen_ns <= QUEUED_NS and (known := self._found(stream)) is not None and not known.tokens:
                    self._unproven[stream] = now_ns
                    known.announced, known.left_ns, known.seen_ns = True, None, seen_ns

    def _found(self, stream: str) -> _StreamEntry | None:
        known = self._streams.get(stream)
        if known is None and len(self._streams) < MAX_STREAMS:
            known = self._streams[stream] = _StreamEntry()
            self._nodes.setdefault(node_of(stream), {})[stream] = None
        return known

    def _forget(self, stream: str) -> None:
        del self._streams[stream]
        streams = self._nodes[node_of(stream)]
        del streams[stream]
        if not streams:
            del self._nodes[node_of(stream)]

    @staticmethod
    def _settled(known: _StreamEntry, now_ns: int) -> bool:
        """Note whether anybody still speaks for a stream."""
        if known.tokens or known.announcements or known.announced:
            known.left_ns = None
        elif known.left_ns is None:
            known.left_ns = now_ns
        return True

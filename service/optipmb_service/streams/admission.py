"""Admission of sessions and messages: limits of the process, quotas of nodes and sites.

Decisions only, for any thread. Rates are token buckets that hold a second's worth, so that a burst of so much passes.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from optipmb_service.session.identity import Incarnation
from optipmb_service.units import MEGABYTE, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.settings import Settings

MAX_OWNERS: Final = 16_384
"""Nodes and sites whose rates are remembered."""

MAX_ENDED: Final = 65_536
"""Streams without a session whose incarnation is remembered."""

EVICT_EVERY_NS: Final = SECOND
"""A session is asked to close no more often than this."""

REFUSED_NS: Final = SECOND // 10
"""Time for which a stream without room is refused without another look."""

MAX_REFUSED: Final = 256
"""Streams for which that is remembered."""


@dataclass(frozen=True, slots=True)
class Quota:
    """Limits of one node or site; 0: no limit.

    Attributes:
        sessions: streams tracked at once.
        messages: a second.
        bytes: a second.
    """

    sessions: int = 0
    messages: int = 0
    bytes: int = 0


@dataclass(slots=True)
class _Bucket:
    messages: float
    bytes: float
    at_ns: int

    def take(self, quota: Quota, size: int, now_ns: int) -> bool:
        """Fill it up to the present and take a message; False when it is empty."""
        passed_s = max(0, now_ns - self.at_ns) / SECOND
        messages = min(quota.messages, self.messages + passed_s * quota.messages)
        filled = min(quota.bytes, self.bytes + passed_s * quota.bytes)
        taken = (messages >= 1 or not quota.messages) and (filled > 0 or not quota.bytes)
        self.messages, self.bytes, self.at_ns = messages - taken, filled - taken * size, now_ns
        return taken


class Admission:
    """Room for messages and sessions: quotas of nodes and sites, and the sessions of the process.

    Args:
        settings: the limits.
        tracked: returns the streams with a session, when each was last used, and whether it is silent.
        evict: closes the session of a stream to make room.
    """

    def __init__(
        self, settings: Settings, tracked: Callable[[], Sequence[tuple[str, int, bool]]], evict: Callable[[str], None]
    ) -> None:
        self._most = settings.max_sessions
        self._tracked = tracked
        self._evict = evict
        node = Quota(settings.node_sessions, settings.node_rate, settings.node_mb_s * MEGABYTE)
        site = Quota(settings.site_sessions, settings.site_rate, settings.site_mb_s * MEGABYTE)
        self._quotas = {"node": node, "site": site}
        self._rated = [(at, quota) for at, quota in enumerate((node, site)) if quota.messages or quota.bytes]
        self._lock = threading.Lock()
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()
        self._owned: Counter[tuple[str, str]] = Counter()
        """Sessions of each node and site."""
        self._sessions = 0
        self._ended: OrderedDict[str, Incarnation] = OrderedDict()
        self._refused: dict[str, tuple[int, str]] = {}
        self._evicted: tuple[str, int] = "", 0

    def exceeded(self, stream: str, size: int, now_ns: int) -> str:
        """Take a message of a stream from its quotas; return the one that is used up, empty when none is."""
        if not self._rated:
            return ""
        owners = _owners(stream)
        with self._lock:
            for at, quota in self._rated:
                kind, owner = owners[at]
                bucket = self._buckets.get(owner) or self._added(owner, quota, now_ns)
                self._buckets.move_to_end(owner)
                if not bucket.take(quota, size, now_ns):
                    return f"{kind} {owner}: at most {_text(quota)} a second"
        return ""

    def room(self, stream: str) -> str:
        """Return why a further stream has no room; empty when it has. A refusal is remembered for a moment."""
        now_ns = time.monotonic_ns()
        until_ns, why = self._refused.get(stream, (0, ""))
        if now_ns >= until_ns:
            why = self._look_for_room(stream, now_ns)
            if len(self._refused) >= MAX_REFUSED:
                self._refused.clear()
            if why:
                self._refused[stream] = now_ns + REFUSED_NS, why
        return why

    def admit(self, stream: str) -> Incarnation | None:
        """Count a session that begins; return the stream's last incarnation, None when there is no room."""
        with self._lock:
            if self._sessions >= self._most:
                return None
            self._sessions += 1
            self._owned.update(_owners(stream))
            return self._ended.pop(stream, Incarnation())

    def release(self, stream: str, incarnation: Incarnation) -> None:
        """Count a session that has ended, or was not begun, and remember its incarnation."""
        with self._lock:
            self._sessions -= 1
            self._refused.clear()  # who was refused may have room now
            self._ended[stream] = incarnation
            if len(self._ended) > MAX_ENDED:
                self._ended.popitem(last=False)
            self._owned -= Counter(_owners(stream))  # keeps no zeros

    def _look_for_room(self, stream: str, now_ns: int) -> str:
        if full := self._full(stream):
            return full
        if self._sessions < self._most:
            return ""
        victim = victim_of(stream, self._tracked())
        if victim is None:
            return f"at most {self._most} streams at once"
        evicted, until_ns = self._evicted
        if victim != evicted or until_ns < now_ns:
            self._evicted = victim, now_ns + EVICT_EVERY_NS
            self._evict(victim)
        return "room for another session: one is being closed"

    def _full(self, stream: str) -> str:
        """Return the quota of sessions that a further stream would exceed; empty when none."""
        with self._lock:
            for kind, owner in _owners(stream):
                most = self._quotas[kind].sessions
                if most and self._owned[kind, owner] >= most:
                    return f"{kind} {owner}: at most {most} streams at once"
        return ""

    def _added(self, owner: str, quota: Quota, now_ns: int) -> _Bucket:
        bucket = self._buckets[owner] = _Bucket(quota.messages, quota.bytes, now_ns)
        if len(self._buckets) > MAX_OWNERS:
            self._buckets.popitem(last=False)
        return bucket


def victim_of(stream: str, tracked: Iterable[tuple[str, int, bool]]) -> str | None:
    """Return the stream whose session makes room for another one; None when none has to.

    The least recently used silent stream: it goes on from the store. Else, of the site that has the most,
    its least recently used, if that site has at least two more than the one that asks. So no site keeps the others
    out, nor do streams of one frame.

    Args:
        stream: the one that asks.
        tracked: streams with a session, when each was last used, and whether it is silent.
    """
    used = sorted(tracked, key=lambda one: one[1])
    for other, _, silent in used:
        if silent:
            return other
    sites = Counter(other.partition("/")[0] for other, _, _ in used)
    if not sites:
        return None
    largest, most = max(sites.items(), key=lambda one: (one[1], one[0]))
    if most < sites[stream.partition("/")[0]] + 2:
        return None
    return next(other for other, _, _ in used if other.partition("/")[0] == largest)


@lru_cache(MAX_OWNERS)  # asked about with each message
def _owners(stream: str) -> tuple[tuple[str, str], tuple[str, str]]:
    site, _, rest = stream.partition("/")
    return ("node", f"{site}/{rest.partition('/')[0]}"), ("site", site)


def _text(quota: Quota) -> str:
    parts = [f"{quota.messages} messages"] if quota.messages else []
    return " and ".join([*parts, f"{quota.bytes} bytes"] if quota.bytes else parts)

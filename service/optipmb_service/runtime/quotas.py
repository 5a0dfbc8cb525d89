"""What one node, and one site, may have of a process: sessions, messages and bytes a second.

Decisions only; the clock is handed in, monotonic nanoseconds. Rates are token buckets that hold a second's worth, so
that a burst of so much passes.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_OWNERS: Final = 16_384
"""Nodes and sites whose rates are remembered."""

SECOND: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Quota:
    """What one may have; 0: no limit.

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


class Quotas:
    """The quotas of all nodes and sites; may be used by any thread.

    Args:
        node: of each node, `site/node`.
        site: of each site.
    """

    def __init__(self, node: Quota, site: Quota) -> None:
        self._quotas = {"node": node, "site": site}
        self._lock = threading.Lock()
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()
        self._sessions: Counter[tuple[str, str]] = Counter()

    def exceeded(self, stream: str, size: int, now_ns: int) -> str:
        """Take a message of a stream from its quotas; say which has no more, empty while all have."""
        with self._lock:
            for kind, owner in _owners(stream):
                quota = self._quotas[kind]
                if (quota.messages or quota.bytes) and not self._take(owner, quota, size, now_ns):
                    return f"{kind} {owner}: at most {_said(quota)} a second"
        return ""

    def count(self, stream: str, sessions: int) -> None:
        """Take in that a stream has a session (1), or none any more (-1)."""
        with self._lock:
            for owner in _owners(stream):
                self._sessions[owner] += sessions
                if not self._sessions[owner]:
                    del self._sessions[owner]

    def full(self, stream: str) -> str:
        """Say which quota of sessions a further stream would exceed; empty when none."""
        with self._lock:
            for kind, owner in _owners(stream):
                most = self._quotas[kind].sessions
                if most and self._sessions[kind, owner] >= most:
                    return f"{kind} {owner}: at most {most} streams at once"
        return ""

    def _take(self, owner: str, quota: Quota, size: int, now_ns: int) -> bool:
        bucket = self._buckets.get(owner)
        if bucket is None:
            bucket = self._buckets[owner] = _Bucket(quota.messages, quota.bytes, now_ns)
            if len(self._buckets) > MAX_OWNERS:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(owner)
        passed_s = max(0, now_ns - bucket.at_ns) / SECOND
        bucket.messages = min(quota.messages, bucket.messages + passed_s * quota.messages)
        bucket.bytes = min(quota.bytes, bucket.bytes + passed_s * quota.bytes)
        bucket.at_ns = now_ns
        if (quota.messages and bucket.messages < 1) or (quota.bytes and bucket.bytes <= 0):
            return False
        bucket.messages -= 1
        bucket.bytes -= size
        return True


def victim_of(stream: str, tracked: Iterable[tuple[str, int]], now_ns: int, idle_ns: int) -> str | None:
    """Return the stream whose session makes room for another one; None when nobody has to.

    The least recently used that has been silent for a while; else, of the site that has the most, its least recently
    used, if that site has at least two more than the one that asks. So no site keeps the others out.

    Args:
        stream: the one that asks.
        tracked: streams with a session, and when each was last used.
        now_ns: the present.
        idle_ns: silence after which a session is nobody's loss: its state is in the store.
    """
    used = sorted(tracked, key=lambda one: one[1])
    if used and now_ns - used[0][1] > idle_ns:
        return used[0][0]
    sites = Counter(other.partition("/")[0] for other, _ in used)
    if not sites:
        return None
    largest, most = max(sites.items(), key=lambda one: (one[1], one[0]))
    if most < sites[stream.partition("/")[0]] + 2:
        return None
    return next(other for other, _ in used if other.partition("/")[0] == largest)


def _owners(stream: str) -> tuple[tuple[str, str], tuple[str, str]]:
    site, _, rest = stream.partition("/")
    return ("node", f"{site}/{rest.partition('/')[0]}"), ("site", site)


def _said(quota: Quota) -> str:
    parts = [f"{quota.messages} messages"] if quota.messages else []
    return " and ".join([*parts, f"{quota.bytes} bytes"] if quota.bytes else parts)

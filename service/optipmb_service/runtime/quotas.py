"""What one node, and one site, may have of a process: sessions, messages and bytes a second.

Decisions only; the clock is handed in, monotonic nanoseconds. Rates are token buckets that hold a second's worth, so
that a burst of so much passes.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from dataclasses import dataclass
from functools import lru_cache
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

    def take(self, quota: Quota, size: int, now_ns: int) -> bool:
        """Fill it up to the present and take a message; False when it is empty."""
        passed_s = max(0, now_ns - self.at_ns) / SECOND
        messages = min(quota.messages, self.messages + passed_s * quota.messages)
        filled = min(quota.bytes, self.bytes + passed_s * quota.bytes)
        taken = (messages >= 1 or not quota.messages) and (filled > 0 or not quota.bytes)
        self.messages, self.bytes, self.at_ns = messages - taken, filled - taken * size, now_ns
        return taken


class Quotas:
    """The quotas of all nodes and sites; may be used by any thread.

    Args:
        node: of each node, `site/node`.
        site: of each site.
    """

    def __init__(self, node: Quota, site: Quota) -> None:
        self._quotas = {"node": node, "site": site}
        self._rated = [(at, quota) for at, quota in enumerate((node, site)) if quota.messages or quota.bytes]
        self._lock = threading.Lock()
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()
        self._sessions: Counter[tuple[str, str]] = Counter()

    def exceeded(self, stream: str, size: int, now_ns: int) -> str:
        """Take a message of a stream from its quotas; say which has no more, empty while all have."""
        owners = _owners(stream)
        with self._lock:
            for at, quota in self._rated:
                kind, owner = owners[at]
                bucket = self._buckets.get(owner) or self._added(owner, quota, now_ns)
                self._buckets.move_to_end(owner)
                if not bucket.take(quota, size, now_ns):
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

    def _added(self, owner: str, quota: Quota, now_ns: int) -> _Bucket:
        bucket = self._buckets[owner] = _Bucket(quota.messages, quota.bytes, now_ns)
        if len(self._buckets) > MAX_OWNERS:
            self._buckets.popitem(last=False)
        return bucket


def victim_of(stream: str, tracked: Iterable[tuple[str, int, bool]]) -> str | None:
    """Return the stream whose session makes room for another one; None when nobody has to.

    The least recently used of those that are silent: they go on from the store. Else, of the site that has the most,
    its least recently used, if that site has at least two more than the one that asks. So no site keeps the others
    out, and streams of one frame keep out nobody.

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


def _said(quota: Quota) -> str:
    parts = [f"{quota.messages} messages"] if quota.messages else []
    return " and ".join([*parts, f"{quota.bytes} bytes"] if quota.bytes else parts)

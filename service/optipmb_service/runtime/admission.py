"""Which streams may have a session, and what is remembered of one between two sessions.

Limits are those of the process and the quotas of nodes and sites. May be called by any thread.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

from optipmb_service.runtime.byte_budget import MEGABYTE
from optipmb_service.runtime.quotas import Quota, Quotas, victim_of
from optipmb_service.session.values import SECOND, Incarnation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.settings import Settings

MAX_LIVES: Final = 65_536
"""Streams without a session whose past is remembered."""

EVICT_EVERY_NS: Final = SECOND
"""A session is asked to close no more often than this."""

REFUSED_NS: Final = SECOND // 10
"""How long a stream without room is refused without another look."""

MAX_REFUSED: Final = 256
"""Streams for which that is remembered."""


class Admission:
    """Who has a session, and who may have one.

    Args:
        settings: the limits.
        tracked: returns the streams with a session, when each was last used, and whether it is silent.
        evict: closes the session of a stream for that of another.
    """

    def __init__(
        self, settings: Settings, tracked: Callable[[], Sequence[tuple[str, int, bool]]], evict: Callable[[str], None]
    ) -> None:
        self._most = settings.max_sessions
        self._tracked = tracked
        self._evict = evict
        self._quotas = Quotas(
            Quota(settings.node_sessions, settings.node_rate, settings.node_mb_s * MEGABYTE),
            Quota(settings.site_sessions, settings.site_rate, settings.site_mb_s * MEGABYTE),
        )
        self.exceeded = self._quotas.exceeded
        self._lock = threading.Lock()
        self._sessions = 0
        self._kept: OrderedDict[str, Incarnation] = OrderedDict()
        self._refused: dict[str, tuple[int, str]] = {}
        self._evicted: tuple[str, int] = "", 0

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
        """Count a session that begins; return what the stream had before, None when there is no room."""
        with self._lock:
            if self._sessions >= self._most:
                return None
            self._sessions += 1
            incarnation = self._kept.pop(stream, Incarnation())
        self._quotas.count(stream, 1)
        return incarnation

    def release(self, stream: str, incarnation: Incarnation) -> None:
        """Count a session that has ended, or was not begun, and remember what a later one has to know."""
        with self._lock:
            self._sessions -= 1
            self._refused.clear()  # who was refused may have room now
            self._kept[stream] = incarnation
            if len(self._kept) > MAX_LIVES:
                self._kept.popitem(last=False)
        self._quotas.count(stream, -1)

    def _look_for_room(self, stream: str, now_ns: int) -> str:
        if full := self._quotas.full(stream):
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

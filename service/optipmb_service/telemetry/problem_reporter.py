"""Reports problems to people and programs, at a bounded rate.

The first problem of a kind is published and logged at once; what follows becomes one summary a second that counts them
all. Kinds that come and go without end (garbage on ever new keys) share a total rate. Nothing here sends anything.
"""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

log = structlog.get_logger("optipmb_service")

MAX_KINDS: Final = 4096  # kinds of problems remembered for their rate
NEWEST: Final = 20  # problems kept for the status
PUBLISH_EVERY_NS: Final = SECOND
LOG_EVERY_NS: Final = 10 * SECOND
PUBLISHED_PER_SECOND: Final = 200
LOGGED_PER_SECOND: Final = 20


@dataclass(slots=True)
class _Kind:
    """One kind: times of its last reports, and the counts since."""

    published_ns: int
    logged_ns: int
    gathered: int = 0
    unlogged: int = 0
    last: schemas.Problem | None = None


class _Budget:
    """At most so many a second, over all kinds."""

    def __init__(self, per_second: int) -> None:
        self._per_second = per_second
        self._second = -1
        self._used = 0

    def take(self, now_ns: int) -> bool:
        second = now_ns // SECOND
        if second != self._second:
            self._second, self._used = second, 0
        self._used += 1
        return self._used <= self._per_second


class ProblemReporter:
    """Takes problems from any thread.

    Args:
        publish: sends a problem on its stream's key.
    """

    def __init__(self, publish: Callable[[schemas.Problem], None]) -> None:
        self._publish = publish
        self._lock = threading.Lock()
        self._kinds: OrderedDict[tuple[str, str, str], _Kind] = OrderedDict()
        self._newest: deque[schemas.Problem] = deque(maxlen=NEWEST)
        self._published = _Budget(PUBLISHED_PER_SECOND)
        self._logged = _Budget(LOGGED_PER_SECOND)
        self._counts: Counter[str] = Counter()

    def report(self, problem: schemas.Problem, now_ns: int) -> None:
        """Report a problem now or, when its kind was reported just before, in the next summary."""
        # Elements of an array are one kind. Classes are few and each is reported once, so each is a kind of its own.
        detail = problem.received if problem.code == "unknown_class" else re.sub(r"\[\d+\]", "[]", problem.path)
        key = (problem.stream, problem.code, detail)
        with self._lock:
            self._counts[problem.code] += problem.count
            kind = self._kinds.get(key)
            if kind is None:
                kind = _Kind(published_ns=now_ns - PUBLISH_EVERY_NS, logged_ns=now_ns - LOG_EVERY_NS)
                self._kinds[key] = kind
                if len(self._kinds) > MAX_KINDS:
                    self._kinds.popitem(last=False)
            kind.gathered += problem.count
            kind.unlogged += problem.count
            kind.last = problem
            due = self._due(kind, now_ns)
        self._send(*due)

    def flush(self, now_ns: int) -> bool:
        """Send the summaries that are due; to be called about once a second while it returns that some are left."""
        due = []
        with self._lock:
            for key, kind in list(self._kinds.items()):
                if kind.gathered or kind.unlogged:
                    due.append(self._due(kind, now_ns))
                elif now_ns - kind.logged_ns >= LOG_EVERY_NS:
                    del self._kinds[key]
            is_left = any(kind.gathered or kind.unlogged for kind in self._kinds.values())
        for one in due:
            self._send(*one)
        return is_left

    def newest(self) -> tuple[schemas.Problem, ...]:
        """Return the newest problems, the oldest first."""
        with self._lock:
            return tuple(self._newest)

    def counts(self) -> dict[str, int]:
        """Return how many problems there were since the start, by code."""
        with self._lock:
            return dict(self._counts)

    def _due(self, kind: _Kind, now_ns: int) -> tuple[schemas.Problem | None, int, int]:
        """Take what may be reported of a kind now, called with the lock: how many to publish and how many to log."""
        publish = bool(kind.gathered) and now_ns - kind.published_ns >= PUBLISH_EVERY_NS
        write = bool(kind.unlogged) and now_ns - kind.logged_ns >= LOG_EVERY_NS
        publish = publish and self._published.take(now_ns)
        write = write and self._logged.take(now_ns)
        if kind.last is None or not (publish or write):
            return None, 0, 0
        problem = kind.last.model_copy(update={"reported_ns": time.time_ns()})
        published, logged = kind.gathered if publish else 0, kind.unlogged if write else 0
        if publish:
            kind.gathered, kind.published_ns = 0, now_ns
            self._newest.append(problem.model_copy(update={"count": published}))
        if write:
            kind.unlogged, kind.logged_ns = 0, now_ns
        return problem, published, logged

    def _send(self, problem: schemas.Problem | None, published: int, logged: int) -> None:
        """Publish and log outside the lock: both may take a while."""
        if problem is not None and published:
            self._publish(problem.model_copy(update={"count": published}))
        if problem is not None and logged:
            shown = problem.model_dump(include={"stream", "code", "path", "expected", "received"})
            log.warning("problem", **shown, count=logged)

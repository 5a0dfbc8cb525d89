"""What is reported to people and programs, at a bounded rate whatever arrives.

`problem_of` makes a problem whose texts fit the message. The `Desk` decides what is published and what is logged: the
first of a kind at once, what follows as one summary a second that counts them all. Kinds that come and go without end
(garbage on ever new keys) share a total rate. Nothing here reads a clock or sends anything.
"""

from __future__ import annotations

import re
import threading
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

if TYPE_CHECKING:
    from collections.abc import Callable

CODES: Final = {
    "malformed": ("The bytes are no message.", "Check the publisher's encoder; compare with the JSON Schemas."),
    "wrong_type": ("Another message type than belongs on the key.", "Check the key and the encoding of the publisher."),
    "unsupported_version": ("A major version that this service does not know.", "Update the service or the publisher."),
    "too_large": ("A size, count or nesting above the limit.", "Send less, or raise `limits`."),
    "missing_field": ("A required field is absent.", "Send the field that `path` names."),
    "invalid_value": ("A field has a wrong value; the whole frame is refused.", "Look at `path`: NaN, sizes, scores?"),
    "unknown_class": (
        "Objects of a class that the profile lacks are left out; told once per session.",
        "Choose another profile, or send the names of its classes.",
    ),
    "late": (
        "The frame came later than the window in which tracks are corrected.",
        "Publish in order, or raise `rewind_s`.",
    ),
    "duplicate_epoch": ("A publisher that another one has replaced still sends.", "Stop one of the two publishers."),
    "shed": ("The queue was full and the oldest frames were dropped.", "Lower the rate, or give more processors."),
    "refused": ("No room for another session, or a change that needs a restart.", "Raise `max_sessions`; see `path`."),
    "astray": (
        "The sensor cannot have got there since its last frame; the frame is refused.",
        "Check the localisation; if it is right, raise `max_speed`.",
    ),
    "internal": (
        "A fault of the service; the session is quarantined, its last frames are saved.",
        "Report it with the saved file; `optipmb track --dump` replays it.",
    ),
    "quarantined": (
        "Tracking this stream failed, see `internal`; its frames are refused.",
        "Reset the session, or restart the publisher.",
    ),
}
"""Every code of a problem: what it means, and what to do."""

MAX_TEXT: Final = 500
"""Characters of a text in a problem."""

MAX_KINDS: Final = 4096
"""Kinds of problems remembered for their rate."""

NEWEST: Final = 20
"""Problems kept for the status."""

SECOND: Final = 1_000_000_000
PUBLISH_EVERY_NS: Final = SECOND
LOG_EVERY_NS: Final = 10 * SECOND
PUBLISHED_PER_SECOND: Final = 200
LOGGED_PER_SECOND: Final = 20


def problem_of(  # noqa: PLR0913 - all keywords, each a field of the message
    code: str,
    *,
    stream: str,
    instance: str,
    message: str,
    path: str = "",
    expected: str = "",
    received: str = "",
    seq: int | None = None,
    stamp_ns: int | None = None,
    count: int = 1,
) -> schemas.Problem:
    """Return a problem, its texts printable and cut to what the message allows."""
    return schemas.Problem(
        stream=stream,
        instance=instance,
        code=code,
        path=_fit(path),
        expected=_fit(expected),
        received=_fit(received),
        message=_fit(message),
        seq=seq,
        stamp_ns=stamp_ns,
        count=count,
    )


def _fit(text: str) -> str:
    text = "".join(character if character.isprintable() else "?" for character in text[: MAX_TEXT + 1])
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 3] + "..."


@dataclass(slots=True)
class _Kind:
    """What is known of one kind: when it was last told, and what has gathered since."""

    published_ns: int
    logged_ns: int
    gathered: int = 0
    unlogged: int = 0
    last: schemas.Problem | None = None


@dataclass(frozen=True, slots=True)
class _Told:
    """A problem, and how many it stands for where it is published and where it is logged; 0: it is not."""

    problem: schemas.Problem
    published: int
    logged: int


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


class Desk:
    """Takes problems from any thread.

    Args:
        publish: sends a problem on its stream's key.
        log: writes a line about a problem; the second argument is how many it stands for.
    """

    def __init__(self, publish: Callable[[schemas.Problem], None], log: Callable[[schemas.Problem, int], None]) -> None:
        self._publish = publish
        self._log = log
        self._lock = threading.Lock()
        self._kinds: OrderedDict[tuple[str, str, str], _Kind] = OrderedDict()
        self._newest: deque[schemas.Problem] = deque(maxlen=NEWEST)
        self._published = _Budget(PUBLISHED_PER_SECOND)
        self._logged = _Budget(LOGGED_PER_SECOND)
        self._counts: Counter[str] = Counter()

    def report(self, problem: schemas.Problem, now_ns: int) -> None:
        """Tell of a problem now or, when its kind was told of just before, in the next summary."""
        # Elements of an array are one kind. Classes are few and each is told of once, so each is a kind of its own.
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
            told = self._tell(kind, now_ns)
        self._send(told)

    def flush(self, now_ns: int) -> None:
        """Send the summaries that are due; to be called about once a second."""
        due: list[_Told | None] = []
        with self._lock:
            for key, kind in list(self._kinds.items()):
                if kind.gathered or kind.unlogged:
                    due.append(self._tell(kind, now_ns))
                elif now_ns - kind.logged_ns >= LOG_EVERY_NS:
                    del self._kinds[key]
        for told in due:
            self._send(told)

    def newest(self) -> tuple[schemas.Problem, ...]:
        """Return the newest problems, the oldest first."""
        with self._lock:
            return tuple(self._newest)

    def counts(self) -> dict[str, int]:
        """Return how many problems there were since the start, by code."""
        with self._lock:
            return dict(self._counts)

    def _tell(self, kind: _Kind, now_ns: int) -> _Told | None:
        """Take what may be told of a kind now; called with the lock."""
        problem = kind.last
        publish = bool(kind.gathered) and now_ns - kind.published_ns >= PUBLISH_EVERY_NS
        log = bool(kind.unlogged) and now_ns - kind.logged_ns >= LOG_EVERY_NS
        publish = publish and self._published.take(now_ns)
        log = log and self._logged.take(now_ns)
        if problem is None or not (publish or log):
            return None
        told = _Told(problem, published=kind.gathered if publish else 0, logged=kind.unlogged if log else 0)
        if publish:
            kind.gathered, kind.published_ns = 0, now_ns
            self._newest.append(told.problem.model_copy(update={"count": told.published}))
        if log:
            kind.unlogged, kind.logged_ns = 0, now_ns
        return told

    def _send(self, told: _Told | None) -> None:
        """Publish and log outside the lock: both may take a while."""
        if told is None:
            return
        if told.published:
            self._publish(told.problem.model_copy(update={"count": told.published}))
        if told.logged:
            self._log(told.problem, told.logged)

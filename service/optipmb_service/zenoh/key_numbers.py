"""How many numbers for keys a Zenoh session has used up, of the 65,535 that it has in its life.

Zenoh numbers the keys that a session declares by 16 bits, and gives none of them back. After the last one it begins
again with the first, whatever that stands for: what the publishers with these numbers send from then on is lost, and
nobody is told. So whoever declares takes the numbers here first. Long before the last one the process restarts
(`restart_keys`), and beyond it nothing is declared. Tokens, queries and what only listens to tokens need no number.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from optipmb_service.runtime.ports import TransportError

if TYPE_CHECKING:
    import zenoh

MOST: Final = 0xFFFF

PLAIN: Final = 1
"""What a publisher, a subscriber, a queryable or a declared key takes."""
CACHED: Final = 2
"""What a publisher with a cache takes, and a subscriber that recovers what it lost: they also declare `@adv` keys."""

_lock = threading.Lock()
_used: dict[str, KeyCount] = {}
"""By the id of the session."""


@dataclass
class KeyCount:
    """How many keys a session has declared in its life, and how many of these are declared still."""

    declared: int = 0
    open: int = 0


class Taken:
    """Numbers that are in use until `undeclare`, which goes with that of what they were taken for."""

    def __init__(self, used: KeyCount, count: int) -> None:
        self._used = used
        self._count = count

    def undeclare(self) -> None:
        """Count them as used up and no longer in use; calling it again has no effect."""
        with _lock:
            self._used.open -= self._count
            self._count = 0


def take(session: zenoh.Session, count: int) -> Taken:
    """Take numbers for what is going to be declared.

    Raises:
        TransportError: the session has none left.
    """
    with _lock:
        used = _used.setdefault(str(session.zid()), KeyCount())
        if used.declared + count > MOST:
            raise TransportError(f"the network session has declared {MOST} keys, and cannot declare more")
        used.declared += count
        used.open += count
    return Taken(used, count)


def used(session: zenoh.Session) -> KeyCount:
    """Return how many keys the session has declared, as of now."""
    with _lock:
        return replace(_used.get(str(session.zid()), KeyCount()))


def forget(session: zenoh.Session) -> None:
    """Forget a session that is closed."""
    with _lock:
        _used.pop(str(session.zid()), None)


class Turns:
    """Bound on how often strangers have keys declared: a burst, then one in each period. May be used by any threads.

    Args:
        burst: declared at once.
        period_s: time until there is a further one.
    """

    def __init__(self, burst: int, period_s: float) -> None:
        self._burst = burst
        self._period_s = period_s
        self._lock = threading.Lock()
        self._left, self._at = float(burst), time.monotonic()

    def take(self) -> None:
        """Take a turn.

        Raises:
            TransportError: there is none now.
        """
        with self._lock:
            now = time.monotonic()
            self._left = min(float(self._burst), self._left + (now - self._at) / self._period_s)
            self._at = now
            if self._left < 1:
                wait_s = (1 - self._left) * self._period_s
                raise TransportError(f"too many new streams were asked for; the next one can be in {wait_s:.0f} s")
            self._left -= 1


class DeclaredKey:
    """A key of a stream that is received by a subscription to a pattern.

    Zenoh hands over the messages of a declared key without comparing it with all subscriptions for each of them.

    Args:
        session: that receives them.
        key: of the stream.

    Raises:
        TransportError: the session has no numbers left.
        zenoh.ZError: it is closed.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._taken = take(session, PLAIN)
        self._session = session
        self._key = session.declare_keyexpr(key)

    def undeclare(self) -> None:
        """Let Zenoh forget the key.

        Raises:
            zenoh.ZError: the session is closed.
        """
        self._taken.undeclare()
        self._session.undeclare(self._key)

"""The thread that coordinates this instance with others: declares tokens, looks at theirs, renews the write lease.

It wakes when a stream is sought or a token comes or goes, and a few times within every write lease. Nothing else it
does may take long: a coordinator that comes late lets the write lease lapse, and then nothing is published until it has
looked again.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

import structlog

from optipmb_service.cluster.ownership import OwnershipTable
from optipmb_service.cluster.port import Role, RoleChange, WriteLease

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

log = structlog.get_logger("optipmb_service")

SECOND: Final = 1_000_000_000
SETTLE_NS: Final = SECOND // 4
PERSIST_NS: Final = SECOND
VERIFY_NS: Final = SECOND // 5
"""After a lapse, time in which a dead link is noticed; only then a look at the tokens means something."""

WRITE_LEASES_PER_LEASE: Final = 2
TICKS_PER_WRITE_LEASE: Final = 5
CONTEST_TICK_S: Final = 0.05
FEW: Final = 8
"""Streams that are looked up one by one; for more, all tokens are looked up at once."""


class Token(Protocol):
    """A declared token."""

    def withdraw(self) -> None:
        """Take it back."""


class Tokens(Protocol):
    """What the coordinator needs of the network."""

    def linked(self) -> bool:
        """Whether this instance is part of the network now."""

    def declare_claim(self, stream: str) -> Token | None:
        """Say that this instance wants a stream; None at the end."""

    def declare_owner(self, stream: str) -> Token | None:
        """Say that it tracks a stream; None at the end."""

    def watch_owners(self, told: Callable[[str, str, bool], None]) -> None:
        """Tell which instance claims which stream, or does so no longer (False), from now on."""

    def claimants(self, streams: Iterable[str] | None) -> Mapping[str, set[str]] | None:
        """Return who wants or has some streams, or any; None when it cannot be found out."""


class Coordinator:
    """The streams of one instance among others on the same router; implements `port.Ownership`.

    Args:
        instance: its name.
        tokens: the network.
        lease_s: how long a frozen process is taken for alive.
    """

    def __init__(self, instance: str, tokens: Tokens, lease_s: float) -> None:
        lease_ns = round(lease_s * SECOND)
        self._table = OwnershipTable(instance, lease_ns, SETTLE_NS, PERSIST_NS)
        self._write_lease = WriteLease(lease_ns // WRITE_LEASES_PER_LEASE)
        self._tick_s = lease_s / WRITE_LEASES_PER_LEASE / TICKS_PER_WRITE_LEASE
        self._write_lease_ns = lease_ns // WRITE_LEASES_PER_LEASE
        self._tokens = tokens
        self._changed: Callable[[str, RoleChange], None] = lambda *_: None
        self._resumed: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._held: dict[str, list[Token]] = {}
        self._left: list[str] = []
        self._lapsed_ns: int | None = None
        self._turned_ns = time.monotonic_ns()
        self._unlinked = False
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coordinator", daemon=True)

    @property
    def failure(self) -> str:
        """Nothing that is shared can fail: a router that is gone is waited for."""
        return ""

    def start(self, changed: Callable[[str, RoleChange], None], resumed: Callable[[], None]) -> None:
        """Begin; before it, streams are only requested.

        Args:
            changed: called with every change of ownership, on the coordinator's thread; must not take long.
            resumed: called when a lapsed write lease holds again.
        """
        self._changed, self._resumed = changed, resumed
        self._tokens.watch_owners(
            lambda stream, instance, present: self.token_changed(stream, instance, present=present)
        )
        self._turned_ns = time.monotonic_ns()
        self._write_lease.renew(self._turned_ns)
        self._thread.start()

    def role(self, stream: str) -> Role:
        """Return what this instance is to a stream."""
        return self._table.role(stream)

    def may_write(self, stream: str) -> bool:
        """Whether this instance may publish and store for a stream now."""
        return self._table.role(stream) is Role.OWNER and self._write_lease.valid(time.monotonic_ns())

    def owns(self, stream: str) -> bool:
        """Whether this instance owns a stream, also while its write lease has lapsed."""
        return self._table.role(stream) is Role.OWNER

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream."""
        return self._table.elsewhere(stream)

    def request(self, stream: str) -> None:
        """Ask for a stream."""
        with self._lock:
            self._table.request(stream, time.monotonic_ns())
        self._wake.set()

    def release(self, stream: str) -> None:
        """Give up a stream."""
        with self._lock:
            self._table.release(stream)
            self._left.append(stream)
        self._wake.set()

    def token_changed(self, stream: str, instance: str, *, present: bool) -> None:
        """Take in that a token came or went."""
        with self._lock:
            own = self._table.token_changed(stream, instance, present=present)
        if own:
            self._unlinked = True  # the link was lost, however short
            self._write_lease.lapse()
        self._wake.set()

    def close(self, timeout: float) -> None:
        """End the thread and withdraw all tokens."""
        self._ended.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)
        for stream in tuple(self._held):
            self._withdraw(stream)

    # The coordinator's thread

    def _run(self) -> None:
        contested = False
        while not self._ended.is_set():
            self._wake.wait(CONTEST_TICK_S if contested or self._lapsed_ns is not None else self._tick_s)
            self._wake.clear()
            try:
                contested = self._turn()
            except Exception:
                log.exception(
                    "internal_error", thread="coordinator"
                )  # the write lease lapses, nothing is written by mistake

    def _turn(self) -> bool:
        """Do what is due; True: something is contested, look again soon."""
        now_ns = time.monotonic_ns()
        linked = self._tokens.linked()
        self._withdraw_left()
        self._keep_write_lease(now_ns, linked=linked)
        with self._lock:
            claims = self._table.claims(now_ns, linked=linked)
        for stream in claims:
            self._hold(stream, self._tokens.declare_claim(stream))
        with self._lock:
            contested = self._table.contested
        if linked and contested and self._lapsed_ns is None:
            self._decide(contested)
        with self._lock:
            return bool(self._table.contested)

    def _withdraw_left(self) -> None:
        with self._lock:
            left, self._left = self._left, []
            gone = [stream for stream in left if self._table.role(stream) in {Role.NONE, Role.STANDBY}]
        for stream in gone:
            self._withdraw(stream)

    def _keep_write_lease(self, now_ns: int, *, linked: bool) -> None:
        """Renew the write lease; one that lapsed only after a look at the tokens, over a link that has proved alive."""
        slept = now_ns - self._turned_ns >= self._write_lease_ns
        self._turned_ns = now_ns
        if self._lapsed_ns is None:
            if not self._write_lease.valid(now_ns):
                self._lapsed_ns = now_ns
                if self._table.owned():
                    log.warning("write_lease_lapsed", linked=linked)
            elif linked:
                self._write_lease.renew(now_ns)
            return
        if slept or not linked or self._unlinked:
            self._lapsed_ns, self._unlinked = now_ns, False
        elif now_ns - self._lapsed_ns >= VERIFY_NS and self._decide(None, lapsed=True):
            self._lapsed_ns = None
            if owned := self._table.owned():
                log.info("write_lease_renewed", streams=len(owned))
            self._resumed()

    def _hold(self, stream: str, token: Token | None) -> None:
        if token is not None:
            self._held.setdefault(stream, []).append(token)

    def _withdraw(self, stream: str) -> None:
        for token in reversed(self._held.pop(stream, [])):
            token.withdraw()

    def _decide(self, contested: list[str] | None, *, lapsed: bool = False) -> bool:
        """Look at the tokens and act on what is found; False when that was not possible."""
        began_ns = time.monotonic_ns()
        found = self._tokens.claimants(contested if contested is not None and len(contested) <= FEW else None)
        if found is None:
            return False
        with self._lock:
            streams = self._table.owned() if contested is None else contested
            view = {stream: found.get(stream, set()) for stream in streams}
            now_ns = time.monotonic_ns()
            if now_ns - began_ns >= self._write_lease_ns:
                return False  # frozen in between: what was seen is old
            changes = self._table.decide(now_ns, view, lapsed=lapsed)
        if lapsed:
            self._write_lease.renew(began_ns)
        for stream, change in changes.items():
            if change is RoleChange.GRANTED:
                self._hold(stream, self._tokens.declare_owner(stream))
            else:
                self._withdraw(stream)
            self._changed(stream, change)
        return True

"""A member: the thread that renews its record, follows those of others, and takes and leaves partitions.

Implements `port.Ownership` by `leases`. To the streams of a partition that it leaves it says so, and gives the
partition up when the state of each is kept.
"""

from __future__ import annotations

import secrets
import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

import structlog

from optipmb_service.cluster.leases import (
    ALIVE,
    ENDED,
    PARTITIONS,
    Fenced,
    LeaseTable,
    Write,
    member_key,
    partition_of,
)
from optipmb_service.cluster.port import Role, RoleChange, WriteLease
from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from optipmb_service.cluster.coordinator import Token
    from optipmb_service.cluster.leases import LeaseStore

log = structlog.get_logger("optipmb_service")

SECOND: Final = 1_000_000_000
LOOKS_PER_LEASE: Final = 20
RENEWALS_PER_LEASE: Final = 10
WRITE_LEASES_PER_LEASE: Final = 2
RETRY_S: Final = 0.1


class Announcing(Protocol):
    """What the member needs of the network."""

    def declare_owner(self, stream: str) -> Token | None:
        """Say that this instance tracks a stream; None at the end."""


class Member:
    """The streams of one instance among others that share a store, for any thread.

    Args:
        instance: its name.
        store: what all members share; closed with the member.
        network: where owners are announced; nothing is decided by that.
        lease_s: how long a member that is frozen or cut off keeps its partitions.
        clock: monotonic time, ns.
    """

    def __init__(
        self,
        instance: str,
        store: LeaseStore,
        network: Announcing,
        lease_s: float,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._instance = instance
        self._store = store
        self._network = network
        self._clock = clock
        self._lease_ns = round(lease_s * SECOND)
        self._write_lease = WriteLease(self._lease_ns // WRITE_LEASES_PER_LEASE)
        self._look_s = lease_s / LOOKS_PER_LEASE
        self._table = self._joining()
        self._revision = 0
        self._renewed_ns = 0
        self._error = "not a member yet"
        self._failing = False
        self._shown: tuple[list[str], int] = ([], 0)
        self._lock = threading.Lock()
        self._roles: dict[str, Role] = {}
        self._recalled: set[str] = set()
        self._unsettled = False
        self._tokens: dict[str, Token] = {}
        self._changed: Callable[[str, RoleChange], None] = lambda *_: None
        self._resumed: Callable[[], None] = lambda: None
        self._wake = threading.Event()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="member", daemon=True)

    def start(self, changed: Callable[[str, RoleChange], None], resumed: Callable[[], None]) -> None:
        """Join the others."""
        self._changed, self._resumed = changed, resumed
        self._thread.start()

    @property
    def failure(self) -> str:
        """Why nothing may be published at present; empty while it may."""
        return "" if self._write_lease.valid(self._clock()) else f"cluster: {self._error}"

    def role(self, stream: str) -> Role:
        """Return what this instance is to a stream."""
        return self._roles.get(stream, Role.NONE)

    def may_write(self, stream: str) -> bool:
        """Whether this instance may publish and store for a stream now."""
        return partition_of(stream) in self._table.held and self._write_lease.valid(self._clock())

    def owns(self, stream: str) -> bool:
        """Whether this instance owns a stream, also while its write lease has lapsed."""
        return partition_of(stream) in self._table.held

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream, as far as is known."""
        return self._table.elsewhere(partition_of(stream))

    def fence(self, stream: str) -> int | None:
        """Return the fence under which checkpoints of a stream are saved; None without a lease."""
        return self._table.held.get(partition_of(stream))

    def request(self, stream: str) -> None:
        """Ask for a stream."""
        with self._lock:
            taken = self._table.taken(partition_of(stream))
            self._roles.setdefault(stream, Role.STANDBY if taken else Role.CLAIMING)
            self._unsettled = True
        self._wake.set()

    def release(self, stream: str) -> None:
        """Give up a stream; of a partition that is left, its state is kept now."""
        with self._lock:
            self._roles.pop(stream, None)
            self._recalled.discard(stream)
            token = self._tokens.pop(stream, None)
        if token is not None:
            token.withdraw()
        self._wake.set()

    def close(self, timeout: float) -> None:
        """Leave all partitions, say that this member has ended, and leave the store."""
        self._ending.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)
        for token in self._tokens.values():
            token.withdraw()
        self._store.close(timeout)

    # The member's thread

    def _run(self) -> None:
        while not self._ending.is_set():
            self._wake.wait(self._look_s)
            self._wake.clear()
            try:
                self._settle()  # what needs no look at the store does not wait for it
                self._turn()
                self._settle()
            except StoreError as error:
                self._failed(str(error))
            except Exception:
                log.exception("internal_error", thread="member")  # the write lease lapses
        try:
            self._end()
        except StoreError as error:
            log.warning("cluster_failed", error=str(error))

    def _turn(self) -> None:
        """Renew, look, write what is due."""
        if not self._keep():
            return
        records = self._store.follow(self._table.position)
        self._table.take_in(records, self._clock())
        writes = self._table.due(self._clock(), self._occupied)
        for write in writes:
            if not self._keep():
                return
            self._table.written(write, self._store.put(write))
        with self._lock:
            self._unsettled |= bool(records or writes)

    def _keep(self) -> bool:
        """Renew this member's record if it is time to; False: it has been ended by another, and begins anew."""
        sent_ns = self._clock()
        if self._revision and sent_ns - self._renewed_ns < self._lease_ns // RENEWALS_PER_LEASE:
            return True
        key = member_key(self._table.member)
        revision = self._store.put(Write(key, ALIVE, self._revision))
        if revision is None:
            found = self._store.get(key)
            if found is None or found.value != ALIVE:
                self._lose()
                return False
            # A renewal of its own, whose answer did not arrive.
            sent_ns = self._clock()
            revision = self._store.put(Write(key, ALIVE, found.revision))
            if revision is None:
                return False
        was = self._write_lease.valid(self._clock())
        self._revision, self._renewed_ns, self._error = revision, sent_ns, "its lease has lapsed"
        self._write_lease.renew(sent_ns)
        if self._failing:
            self._failing = False
            log.info("cluster_back")
        if not was:
            self._resumed()
        return True

    def _lose(self) -> None:
        """Begin anew: another member has ended this one, and holds what it held, or will."""
        self._write_lease.lapse()
        if self._table.held:
            log.error("lease_lost", member=self._table.member, partitions=len(self._table.held))
        self._error = "another member has taken over its partitions"
        self._table = self._joining()
        self._revision = 0
        with self._lock:
            self._unsettled = True

    def _joining(self) -> LeaseTable:
        return LeaseTable(f"{self._instance}/{secrets.token_hex(4)}", self._lease_ns)

    def _failed(self, error: str) -> None:
        if not self._failing:
            log.error("cluster_failed", error=error)
        self._failing, self._error = True, error

    def _occupied(self) -> set[int]:
        """Return the partitions with a stream whose state is not kept yet."""
        with self._lock:
            owned = {stream for stream, role in self._roles.items() if role is Role.OWNER}
            return {partition_of(stream) for stream in owned | self._recalled}

    def _settle(self) -> None:
        """Tell every stream what has changed for it."""
        with self._lock:
            if not self._unsettled:
                return
            self._unsettled = False
            changes = {
                stream: change
                for stream, role in self._roles.items()
                if (change := self._change(stream, role)) is not None
            }
            for stream, change in changes.items():
                self._roles[stream] = Role.OWNER if change is RoleChange.GRANTED else Role.STANDBY
                (self._recalled.add if change is RoleChange.RECALLED else self._recalled.discard)(stream)
        for stream, change in changes.items():
            self._announce(stream, owner=change is RoleChange.GRANTED)
            self._changed(stream, change)
        shown = self._table.members(), len(self._table.held)
        if shown != self._shown and self._revision:
            self._shown = shown
            log.info("partitions_held", held=shown[1], of=PARTITIONS, members=shown[0])

    def _change(self, stream: str, role: Role) -> RoleChange | None:
        partition = partition_of(stream)
        held, leaving = partition in self._table.held, partition in self._table.leaving
        if role is Role.OWNER or stream in self._recalled:
            if not held:
                return RoleChange.LOST
            return RoleChange.RECALLED if leaving and role is Role.OWNER else None
        if held and not leaving:
            return RoleChange.GRANTED
        if role is Role.CLAIMING and (leaving or self._table.taken(partition)):
            return RoleChange.DENIED
        return None

    def _announce(self, stream: str, *, owner: bool) -> None:
        token = self._network.declare_owner(stream) if owner else None
        with self._lock:
            old = self._tokens.pop(stream, None)
            if token is not None and self._roles.get(stream) is Role.OWNER:  # it may have been released meanwhile
                self._tokens[stream] = token
                token = None
        for one in (old, token):
            if one is not None:
                one.withdraw()

    def _end(self) -> None:
        """Say that this member has ended: its partitions are free then. What is to be kept has been saved."""
        self._write_lease.lapse()
        if self._revision:
            self._store.put(Write(member_key(self._table.member), ENDED, self._revision))


class FencedStore:
    """The checkpoints of a member's streams, saved under the fences of its leases; implements `store.Store`.

    Args:
        store: what all members share.
        fence: the fence of a stream's lease; None without one.
    """

    def __init__(self, store: LeaseStore, fence: Callable[[str], int | None]) -> None:
        self._store = store
        self._fence = fence
        self._closed = threading.Event()

    @property
    def max_bytes(self) -> int:
        """Bytes that a checkpoint may have."""
        return self._store.max_bytes

    def claim(self, streams: Collection[str]) -> None:
        """Do nothing: the lease of the partition is the claim."""

    def save(self, checkpoints: Mapping[str, bytes]) -> frozenset[str]:
        """Write the newest checkpoint of each stream; returns those whose lease is lost."""
        fenced = {
            stream: Fenced(partition_of(stream), fence, data)
            for stream, data in checkpoints.items()
            if (fence := self._fence(stream)) is not None
        }
        return frozenset(checkpoints.keys() - fenced.keys()) | self._store.save(fenced)

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one.

        While the stream is this member's, a store that cannot be reached is waited for: to begin anew would use track
        ids a second time.
        """
        while True:
            try:
                return self._store.load(stream)
            except StoreError:
                if self._fence(stream) is None or self._closed.wait(RETRY_S):
                    raise

    def expire(self, age_s: float) -> int:
        """Do nothing: the store itself forgets a checkpoint that is old."""
        del age_s
        return 0

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside."""
        self._store.set_aside(stream, reason)

    def close(self) -> None:
        """Wait for nothing any more; the member leaves the store itself."""
        self._closed.set()

"""What all members share, in memory, and members that are moved by hand: no thread, and a clock that tests set."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

from optipmb_service.cluster.leases import PARTITIONS, Change, partition_key, partition_of
from optipmb_service.cluster.member import Member
from optipmb_service.cluster.store import KEPT, Fenced, LeaseStore, Record, StoreError, Write

SECOND = 1_000_000_000
LEASE_S = 2.0


@dataclass
class Shared:
    """Records and checkpoints in one order of events."""

    records: dict[str, Record] = field(default_factory=dict)
    checkpoints: dict[str, list[bytes]] = field(default_factory=dict)
    numbers: dict[str, bytes] = field(default_factory=dict)
    revision: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)
    """Of those who write at the same time, one is accepted."""


class MemoryLeases:
    """A member's way to what all share; implements `LeaseStore`.

    Args:
        shared: what all members share.
    """

    max_bytes = 2**20
    remote = True

    def __init__(self, shared: Shared) -> None:
        self.shared = shared
        self.reachable = True
        self.answers = True
        """Whether answers arrive; without them what was asked is done nevertheless."""

    def follow(self, after: int) -> list[Record]:
        self._reach()
        changed = [record for record in self.shared.records.values() if record.revision > after]
        return sorted(changed, key=lambda record: record.revision)

    def get(self, key: str) -> Record | None:
        self._reach()
        return self.shared.records.get(key)

    def put(self, write: Write) -> int | None:
        self._reach(after=False)
        revision = None
        with self.shared.lock:
            now = self.shared.records.get(write.key)
            if (now.revision if now else 0) == write.over:
                revision = self.shared.revision = self.shared.revision + 1
                self.shared.records[write.key] = Record(write.key, write.value, revision)
        self._reach()
        return revision

    def gone(self, member: str) -> bool:
        del member
        return False

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        self._reach()
        refused = set()
        for stream, one in checkpoints.items():
            now = self.shared.records.get(one.lease)
            if now is None or now.revision != one.fence:
                refused.add(stream)
            else:
                self.shared.checkpoints[stream] = [*self.shared.checkpoints.get(stream, []), one.data][-KEPT:]
                self.shared.numbers[stream] = one.numbers
                self.shared.revision += 1
        return frozenset(refused)

    def load(self, stream: str) -> bytes | None:
        self._reach()
        kept = self.shared.checkpoints.get(stream)
        return kept[-1] if kept else None

    def numbers(self, stream: str) -> bytes | None:
        return self.shared.numbers.get(stream)

    def expire(self, age_s: float) -> int:
        del age_s
        return 0

    def set_aside(self, stream: str, reason: str) -> None:
        del reason
        self._reach()
        if kept := self.shared.checkpoints.get(stream):
            kept.pop()

    def close(self, timeout: float) -> None:
        """Nothing is open."""

    def _reach(self, *, after: bool = True) -> None:
        if not self.reachable or (after and not self.answers):
            raise StoreError("cut off")


class Alone(Member):
    """Leases of all partitions, for the checkpoints of a store without other users.

    Args:
        store: where they are.
    """

    def __init__(self, store: LeaseStore) -> None:
        self.lapsed = False
        self._store = store
        self._fences = [self._take(partition_key(number)) for number in range(PARTITIONS)]

    def _take(self, key: str) -> int | None:
        now = self._store.get(key)
        return self._store.put(Write(key, "alone", now.revision if now else 0))

    def leave(self) -> None:
        for number, fence in enumerate(self._fences):
            self._store.put(Write(partition_key(number), "", fence or 0))

    def fence(self, stream: str) -> int | None:
        return self._fences[partition_of(stream)]

    def may_write(self, stream: str, fence: int | None) -> bool:
        return fence == self.fence(stream) and not self.lapsed

    def save(self, checkpoints: Mapping[str, bytes]) -> frozenset[str]:
        return self._store.save(
            {
                stream: Fenced(partition_key(partition_of(stream)), self.fence(stream) or 0, data)
                for stream, data in checkpoints.items()
            }
        )


class Clock:
    """The clock of one member.

    Args:
        ahead_s: how far it is from the others' clocks.
    """

    def __init__(self, ahead_s: float = 0.0) -> None:
        self.ns = round(ahead_s * SECOND)

    def __call__(self) -> int:
        return self.ns


class HandMember:
    """A member that does one turn when it is asked to.

    Args:
        name: of the instance.
        store: its way to what all share.
        ahead_s: how far its clock is from the others'.
    """

    def __init__(self, name: str, store: LeaseStore, ahead_s: float = 0.0) -> None:
        self.name = name
        self.frozen = 0
        """Turns that it is still to miss."""
        self.clock = Clock(ahead_s)
        self.store = store
        self.member = Member(name, store, LEASE_S, self.clock)
        self.changes: list[tuple[int, Change]] = []
        self.occupied: set[int] = set()
        """Partitions with a stream whose state is not kept."""
        self.resumed = 0
        self.member._changed = lambda partition, change: self.changes.append((partition, change))
        self.member._resumed = self._resume
        self.member._occupied = lambda: self.occupied

    def turn(self, passed_s: float = 0.0) -> bool:
        """Let time pass and do one turn; False when the store could not be reached."""
        self.clock.ns += round(passed_s * SECOND)
        try:
            self.member._turn()
            self.member._settle()
        except StoreError as error:
            self.member._failed(str(error))
            return False
        return True

    @property
    def held(self) -> set[int]:
        valid = self.clock.ns < self.member._may_write_until_ns
        return set(self.member._table.held) if valid else set()

    def end(self) -> None:
        self.member._end()

    def _resume(self) -> None:
        self.resumed += 1

"""Leases of partitions: decisions only, no clock, no network, no threads.

Streams are hashed to partitions. A member, one run of one process, holds partitions and tracks their streams. All that
is agreed on is a record under a key in a store whose order of events is the only one there is: every write of a record
states the revision that it replaces, is refused when that is not the newest, and gets a revision higher than all before
it. No clock is ever compared with another one.

- `member/<id>`: a member renews its record several times within a lease. Who has watched a record for a whole lease,
  by its own clock, without a new revision, writes `ended` over that revision. The member's next renewal is refused
  then, or it has come first and the other's write is refused.
- `partition/<number>`: the member that holds the partition, or nobody. The revision of the record is the *fence* of
  the lease; the store refuses a checkpoint whose fence is not the newest revision of its partition. A partition
  whose member has ended, or that nobody holds, is taken by writing over its record.
- A member publishes for half a lease after it has sent a renewal that was accepted, so it has stopped before anybody
  can end it.

Every member computes from the living ones how many partitions each is to have, within one of an equal share, leaves
what it has beyond that, and takes what is free up to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence

PARTITIONS: Final = 64
ALIVE: Final = "alive"
ENDED: Final = "ended"
NOBODY: Final = ""

LEAVE_LEASES: Final = 4
"""Leases within which the sessions of a partition that is left must have been kept; then it is left without them."""

WATCHED: Final = 2
"""A pause between two looks at the records that is longer than a lease divided by this does not count as watching."""

MAX_ENDED: Final = 1024
"""Members that have ended and are remembered."""


def partition_of(stream: str) -> int:
    """Return the partition of a stream."""
    return int.from_bytes(blake2b(stream.encode(), digest_size=8).digest()) % PARTITIONS


def member_key(member: str) -> str:
    """Return the key of a member's record."""
    return f"member/{member}"


def partition_key(partition: int) -> str:
    """Return the key of a partition's record."""
    return f"partition/{partition}"


class Record(NamedTuple):
    """A record as the store has it: its key, what it says, and its revision."""

    key: str
    value: str
    revision: int


class Write(NamedTuple):
    """A record to be written over a revision; 0: the key is to have none."""

    key: str
    value: str
    over: int


class Fenced(NamedTuple):
    """A checkpoint with the lease under which it is saved."""

    partition: int
    fence: int
    data: bytes


class LeaseStore(Protocol):
    """Where records and checkpoints are. Any thread may call; every call is bounded in time and raises `StoreError`."""

    @property
    def max_bytes(self) -> int:
        """Bytes that a checkpoint may have."""

    def follow(self, after: int) -> Sequence[Record]:
        """Return the newest record of each key that changed after a revision, by revision; perhaps not yet the last."""

    def get(self, key: str) -> Record | None:
        """Return the newest record of a key, certainly the newest; None without one."""

    def put(self, write: Write) -> int | None:
        """Write a record; return its revision, None when the one to be replaced is not the newest."""

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams; return those that were refused for their fence."""

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""

    def close(self, timeout: float) -> None:
        """Leave the store, within `timeout` seconds."""


@dataclass(slots=True)
class _Watched:
    revision: int
    alive: bool
    seen_ns: int
    """When its newest revision was seen first."""


@dataclass
class LeaseTable:
    """What one member knows of all members and partitions. All times are its own, monotonic, ns.

    Attributes:
        member: its id, that no other run of a process ever has.
        lease_ns: how long a member is watched before it is ended.
        position: the highest revision seen.
        held: partitions that it holds, each with its fence; may be read by any thread.
        leaving: of these, those that it is about to leave, since when.
    """

    member: str
    lease_ns: int
    position: int = 0
    held: dict[int, int] = field(default_factory=dict)
    leaving: dict[int, int] = field(default_factory=dict)
    _members: dict[str, _Watched] = field(default_factory=dict)
    _partitions: dict[int, tuple[int, str]] = field(default_factory=dict)
    _looked_ns: int | None = None

    def take_in(self, records: Iterable[Record], now_ns: int) -> None:
        """Take in what has changed, or that nothing has."""
        if self._looked_ns is None or now_ns - self._looked_ns > self.lease_ns // WATCHED:
            # Nobody could renew, or it was not seen: the lease of each is counted from now.
            for one in self._members.values():
                one.seen_ns = now_ns
        self._looked_ns = now_ns
        for record in records:
            self.position = max(self.position, record.revision)
            kind, _, name = record.key.partition("/")
            if kind == "member":
                self._take_in_member(name, record, now_ns)
            elif record.revision > self._partitions.get(int(name), (0, NOBODY))[0]:
                self._set(int(name), record.revision, record.value)
        for _, holder in self._partitions.values():
            if holder not in {NOBODY, self.member}:
                self._members.setdefault(holder, _Watched(0, alive=True, seen_ns=now_ns))
        ended = [name for name, one in self._members.items() if not one.alive]
        for name in ended[: max(0, len(ended) - MAX_ENDED)]:
            del self._members[name]

    def _take_in_member(self, name: str, record: Record, now_ns: int) -> None:
        known = self._members.get(name)
        if name != self.member and (known is None or record.revision > known.revision):
            self._members[name] = _Watched(record.revision, record.value == ALIVE, now_ns)

    def _set(self, partition: int, revision: int, holder: str) -> None:
        self._partitions[partition] = revision, holder
        if holder == self.member:
            self.held[partition] = revision
        else:
            self.held.pop(partition, None)
            self.leaving.pop(partition, None)

    def members(self) -> list[str]:
        """Return the living members with this one, by id."""
        return sorted([self.member, *(name for name, one in self._members.items() if one.alive)])

    def elsewhere(self, partition: int) -> bool:
        """Whether another member holds a partition, or is about to; may be called by any thread."""
        return partition in self._partitions and (partition not in self.held or partition in self.leaving)

    def taken(self, partition: int) -> bool:
        """Whether another living member holds a partition; may be called by any thread."""
        _, holder = self._partitions.get(partition, (0, NOBODY))
        known = self._members.get(holder)
        return known is not None and known.alive

    def due(self, now_ns: int, occupied: Callable[[], Container[int]]) -> list[Write]:
        """Return what is to be written now; `written` is to be told of each.

        Args:
            now_ns: monotonic time.
            occupied: returns the partitions with a stream whose state is not kept yet; asked when one is to be left.
        """
        writes = [
            Write(member_key(name), ENDED, one.revision)
            for name, one in self._members.items()
            if one.alive and now_ns - one.seen_ns >= self.lease_ns
        ]
        staying = [partition for partition in self.held if partition not in self.leaving]
        missing = self._share() - len(staying)
        if missing < 0:
            self.leaving |= dict.fromkeys(sorted(staying)[missing:], now_ns)
        first = int.from_bytes(blake2b(self.member.encode(), digest_size=8).digest())
        for offset in range(PARTITIONS):  # each begins elsewhere, so that members seldom want the same one
            partition = (first + offset) % PARTITIONS
            if missing <= 0:
                break
            if partition not in self.held and not self.taken(partition):
                revision, _ = self._partitions.get(partition, (0, NOBODY))
                writes.append(Write(partition_key(partition), self.member, revision))
                missing -= 1
        if self.leaving:
            kept = occupied()
            overdue_ns = now_ns - LEAVE_LEASES * self.lease_ns
            writes += [
                Write(partition_key(partition), NOBODY, self.held[partition])
                for partition, since_ns in self.leaving.items()
                if partition not in kept or since_ns <= overdue_ns
            ]
        return writes

    def written(self, write: Write, revision: int | None) -> None:
        """Take in what became of a write; None: refused, what is there instead comes with `take_in`."""
        if revision is None:
            return
        kind, _, name = write.key.partition("/")
        if kind == "member":
            self._members[name] = _Watched(revision, alive=False, seen_ns=0)
        else:
            self._set(int(name), revision, write.value)

    def _share(self) -> int:
        """Return how many partitions this member is to hold."""
        members = self.members()
        each, rest = divmod(PARTITIONS, len(members))
        return each + (members.index(self.member) < rest)

"""Leases of partitions: decisions only, no clock, no network, no threads.

Streams are hashed to partitions. A member, a process from its start to its end, holds partitions and tracks their
streams. All that is agreed on is a record under a key in a store whose order of events is the only one there is: every
write of a record states the revision that it replaces, is refused when that is not the newest, and gets a revision
higher than all before it. No clock is ever compared with another one.

- `member/<id>`: a member renews its record several times within a lease. Who has watched a record for a whole lease,
  by its own clock, without a new revision, writes `ended` over that revision; at once where the store knows that the
  member's process is gone. The member's next renewal is refused then, or it has come first and the other's write is
  refused.
- `partition/<number>`: the member that holds the partition, or none. The revision of the record is the *fence* of
  the lease; the store refuses a checkpoint whose fence is not the newest revision of its partition. A partition
  whose member has ended, or without a holder, is taken by writing over its record.
- A member publishes for half a lease after it has sent a renewal that was accepted, so it has stopped before anybody
  can end it.

Every member computes from the living ones how many partitions each is to have, within one of an equal share, leaves
the surplus, and takes free ones up to its share. `wish/<number>` names the instance that an operator wants to
have a partition: while such a member lives, no other takes it, and who holds it leaves it. A member that drains, or
has no router, says so in its record: its share is nothing, the others have it. Partitions are left a few at a time, so
that the streams of one wait for nothing but their own restoring.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum, unique
from functools import lru_cache
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

from optipmb_service.cluster.store import ENDED, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable

    from optipmb_service.cluster.store import Record

PARTITIONS: Final = 64
ALIVE: Final = "alive"
DRAINING: Final = "draining"  # what the record of a member says that gives its partitions up
UNLINKED: Final = "unlinked"  # the same of a member that has no router, so it neither receives nor publishes
NOBODY: Final = ""

LEAVE_LEASES: Final = 4  # longest wait for the checkpoints of a partition that is left
WATCHED: Final = 2  # a longer pause between looks than a lease divided by this is not watching
LEFT_AT_ONCE: Final = 8  # partitions that a member leaves at the same time
MAX_ENDED: Final = 1024  # members that have ended and are remembered


@lru_cache(65_536)  # as many streams as are known at once; asked about all of them whenever one comes or goes
def partition_of(stream: str) -> int:
    return int.from_bytes(blake2b(stream.encode(), digest_size=8).digest()) % PARTITIONS


def member_key(member: str) -> str:
    """Return the key of a member's record."""
    return f"member/{member}"


def partition_key(partition: int) -> str:
    """Return the key of a partition's record."""
    return f"partition/{partition}"


def wish_key(partition: int) -> str:
    return f"wish/{partition}"


def instance_of(member: str) -> str:
    """Return the name of the instance to which a member belongs."""
    return member.rpartition("/")[0]


@unique
class Change(StrEnum):
    """What becomes of a partition."""

    HELD = "held"
    RECALLED = "recalled"
    """Another member is to have it as soon as the states of its streams are kept."""
    RENEWED = "renewed"
    """It is held under another fence: the store had lost its record, and no other member has taken it."""
    LOST = "lost"
    """Another member may continue its streams already: the states here are not the newest, and are not to be kept."""


@dataclass(slots=True)
class _Watched:
    revision: int
    state: str
    seen_ns: int
    """When its newest revision was seen first."""

    @property
    def alive(self) -> bool:
        return self.state != ENDED


@dataclass(frozen=True, slots=True)
class MemberLease:
    """A living member, as another one knows it.

    Attributes:
        member: its id.
        state: `alive`, `draining` or `unlinked`.
        age_ns: since its newest renewal was seen.
        fences: the partitions that it holds, each with its fence.
    """

    member: str
    state: str
    age_ns: int
    fences: dict[int, int]


@dataclass
class LeaseTable:
    """What one member knows of all members and partitions. All times are its own, monotonic, ns.

    Attributes:
        member: its id, that no other process ever has.
        lease_ns: how long a member is watched before it is ended.
        position: the highest revision seen.
        held: partitions that it holds, each with its fence; may be read by any thread.
        leaving: partitions of `held` that it is about to leave, since when.
        lost: partitions that it held and others have taken, until that is reported.
        state: value of its record; unless `alive`, others are to have its partitions.
        moving: whether it has fewer partitions than it is to have, or more.
        changed_ns: when something but a renewal was seen last.
    """

    member: str
    lease_ns: int
    position: int = 0
    held: dict[int, int] = field(default_factory=dict)
    leaving: dict[int, int] = field(default_factory=dict)
    lost: set[int] = field(default_factory=set)
    state: str = ALIVE
    moving: bool = False
    changed_ns: int = 0
    _members: dict[str, _Watched] = field(default_factory=dict)
    _partitions: dict[int, tuple[int, str]] = field(default_factory=dict)
    _wishes: dict[int, str] = field(default_factory=dict)
    _looked_ns: int | None = None

    def apply(self, records: Iterable[Record], now_ns: int) -> None:
        """Apply new records."""
        if self._looked_ns is None or now_ns - self._looked_ns > self.lease_ns // WATCHED:
            # Renewals may have been missed: the lease of each member is counted from now.
            for one in self._members.values():
                one.seen_ns = now_ns
        self._looked_ns = now_ns
        changed = False
        for record in records:
            self.position = max(self.position, record.revision)
            kind, _, name = record.key.partition("/")
            if kind == "member":
                changed |= self._apply_member(name, record, now_ns)
                continue
            changed = True
            if kind == "wish":
                self._wishes[int(name)] = record.value
            elif record.revision > self._partitions.get(int(name), (0, NOBODY))[0]:
                self._set(int(name), record.revision, record.value)
        if changed:
            self.changed_ns = now_ns
            self._complete_members(now_ns)

    def _complete_members(self, now_ns: int) -> None:
        """Watch every holder of a partition; forget the first of many members that have ended."""
        for _, holder in self._partitions.values():
            if holder not in {NOBODY, self.member}:
                self._members.setdefault(holder, _Watched(0, ALIVE, now_ns))
        ended = [name for name, one in self._members.items() if not one.alive]
        for name in ended[: max(0, len(ended) - MAX_ENDED)]:
            del self._members[name]

    def _apply_member(self, name: str, record: Record, now_ns: int) -> bool:
        """Apply the record of a member; return whether it is more than a renewal."""
        known = self._members.get(name)
        if name == self.member or (known is not None and record.revision <= known.revision):
            return False
        self._members[name] = _Watched(record.revision, record.value, now_ns)
        return known is None or known.state != record.value

    def _set(self, partition: int, revision: int, holder: str) -> None:
        self._partitions[partition] = revision, holder
        if holder == self.member:
            self.held[partition] = revision
        else:
            if partition in self.held.keys() - self.leaving.keys() and holder != NOBODY:
                self.lost.add(partition)
            self.held.pop(partition, None)
            self.leaving.pop(partition, None)

    def members(self) -> list[str]:
        """Return the living members with this one, by id."""
        return sorted([self.member, *(name for name, one in self._all() if one.alive)])

    def _all(self) -> tuple[tuple[str, _Watched], ...]:
        """Return the other members, in one go: any thread may ask, while the member's own takes in more."""
        return tuple(self._members.items())

    def takers(self) -> list[str]:
        """Return the living members that take partitions, by id."""
        others = [name for name, one in self._all() if one.state == ALIVE]
        return sorted([self.member, *others] if self.state == ALIVE else others)

    def leases(self, renewed_ns: int, now_ns: int) -> list[MemberLease]:
        """Return the living members, by id; this one has renewed its record at `renewed_ns`."""
        held: dict[str, dict[int, int]] = {}
        for partition, (fence, holder) in sorted(tuple(self._partitions.items())):  # noqa: C414 - in one go, for the member's thread writes it
            held.setdefault(holder, {})[partition] = fence
        known = [(name, one.state, one.seen_ns) for name, one in self._all() if one.alive]
        return [
            MemberLease(name, state, max(0, now_ns - seen_ns), held.get(name, {}))
            for name, state, seen_ns in sorted([(self.member, self.state, renewed_ns), *known])
        ]

    def holds(self, partition: int) -> bool:
        """Return whether sessions of a partition may begin here; may be called by any thread."""
        return partition in self.held and partition not in self.leaving

    def taken(self, partition: int, instance: str | None = None) -> bool:
        """Return whether another living member holds a partition, of any instance or of one."""
        _, holder = self._partitions.get(partition, (0, NOBODY))
        known = self._members.get(holder)
        return known is not None and known.alive and instance in {None, instance_of(holder)}

    def due(self, now_ns: int, occupied: Callable[[], Container[int]], gone: Callable[[str], bool]) -> list[Write]:
        """Return the writes that are due; `written` is to be called with each.

        Args:
            now_ns: monotonic time.
            occupied: returns the partitions with a stream whose state is not kept yet; asked when one is to be left.
            gone: whether the process of a member has ended for certain.
        """
        writes = [
            Write(member_key(name), ENDED, one.revision)
            for name, one in self._members.items()
            if one.alive and (now_ns - one.seen_ns >= self.lease_ns or gone(name))
        ]
        mine, others = self._wished()
        # Wishes go before an equal share.
        room = self._share() - len(mine)
        wished = self.held.keys() & others
        surplus = []
        for partition in sorted(self.held.keys() - self.leaving.keys() - mine - wished):
            room -= 1
            surplus += [partition] if room < 0 else []
        for partition in [*sorted(wished - self.leaving.keys()), *surplus]:
            if len(self.leaving) < LEFT_AT_ONCE:
                self.leaving[partition] = now_ns
        self.moving = room > 0 or bool(self.leaving or wished or surplus) or not mine <= self.held.keys()
        first = int.from_bytes(blake2b(self.member.encode(), digest_size=8).digest())
        for offset in range(PARTITIONS):  # each begins elsewhere, so that members seldom want the same one
            partition = (first + offset) % PARTITIONS
            if partition in self.held or partition in others or self.taken(partition):
                continue
            if partition not in mine:
                if room <= 0:
                    continue
                room -= 1
            revision, _ = self._partitions.get(partition, (0, NOBODY))
            writes.append(Write(partition_key(partition), self.member, revision))
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
        """Apply the result of a write; None: refused, the record that is there comes with `apply`."""
        if revision is None:
            return
        kind, _, name = write.key.partition("/")
        if kind == "member":
            self._members[name] = _Watched(revision, ENDED, 0)
        else:
            self._set(int(name), revision, write.value)

    def gone(self, key: str) -> None:
        """Note that the store has lost a record: the next write of it replaces none."""
        kind, _, name = key.partition("/")
        if kind == "partition":
            self._partitions[int(name)] = 0, self._partitions.get(int(name), (0, NOBODY))[1]
        elif name in self._members:
            self._members[name].revision = 0

    def _share(self) -> int:
        """Return how many of all partitions are an equal share of this member; where none takes any, all have one."""
        members = self.takers() or self.members()
        if self.member not in members:
            return 0
        each, rest = divmod(PARTITIONS, len(members))
        return each + (members.index(self.member) < rest)

    def _wished(self) -> tuple[set[int], set[int]]:
        """Return the partitions that wishes give to this member, and to other living members."""
        own, living = instance_of(self.member), {instance_of(name) for name in self.takers()}
        mine = {
            partition
            for partition, to in self._wishes.items()
            if to == own in living and not self.taken(partition, own)
        }
        others = {partition for partition, to in self._wishes.items() if to in living}
        return mine, others - mine

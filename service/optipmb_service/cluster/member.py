"""A member: the thread that renews its record, follows the records of others, and takes and leaves partitions.

It tells what becomes of each partition. One that it leaves it gives up when the state of each of its streams is kept.
"""

from __future__ import annotations

import secrets
import threading
import time
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.cluster.leases import (
    ALIVE,
    DRAINING,
    PARTITIONS,
    UNLINKED,
    Change,
    LeaseTable,
    MemberLease,
    instance_of,
    member_key,
    partition_key,
    partition_of,
    wish_key,
)
from optipmb_service.cluster.store import ENDED, StoreError, Write
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from optipmb_service.cluster.store import LeaseStore

log = structlog.get_logger("optipmb_service")

LOOKS_PER_LEASE: Final = 8  # each with a renewal: a request to a store elsewhere takes a millisecond of processor
LONGEST_LOOK_S: Final = 0.1  # of a store on the same machine: how late a killed member may be noticed
SHORT_LOOK_S: Final = 0.02  # while partitions change hands: each is without a holder for as long
RENEWALS_PER_LEASE: Final = 2 * LOOKS_PER_LEASE  # at most: so each look that is not a short one renews
STRAINED: Final = 4  # part of a lease without a renewal from which on it is late
SLOW_LEASES: Final = 2  # leases without a renewal in time: then the store is slow, and waiting does not help
UNLINKED_PER_LEASE: Final = 4  # part of a lease without a router, before the partitions are given up
WRITE_LEASES_PER_LEASE: Final = 2
RETRY_S: Final = 0.1  # at the end, between two tries to say so
FIRST_TURNS: Final = 3  # turns in which a new member ends dead ones, and takes all free partitions


class Member:
    """The partitions of one instance among others that share a store, for any thread.

    Args:
        instance: its name.
        store: what all members share; closed with the member.
        lease_s: how long a member that is frozen or cut off keeps its partitions.
        clock: monotonic time, ns.
    """

    def __init__(
        self, instance: str, store: LeaseStore, lease_s: float, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._instance = instance
        self._store = store
        self._clock = clock
        self._lease_ns = round(lease_s * SECOND)
        self._may_write_until_ns = 0
        """End of the write lease; read by any thread."""
        look_s = lease_s / LOOKS_PER_LEASE
        self._look_s = look_s if store.remote else min(look_s, LONGEST_LOOK_S)
        self._table = self._joining()
        self._revision = 0
        self._renewed_ns = 0
        self._in_time_ns = clock()
        self._slow = False
        self._error = "not a member yet"
        self._failing = False
        self._unwritable = False
        self._drains = False
        self._linked: Callable[[], bool] = lambda: True
        self._unlinked_ns: int | None = None
        """Since when no look has found a router."""
        self._said = ALIVE
        self._shown: tuple[list[str], int] = ([], 0)
        self._reported: dict[int, int] = {}
        self._recalled: set[int] = set()
        self._gone: set[int] = set()
        """Partitions that are held, and whose records the store has lost."""
        self._renewed: set[int] = set()
        """Partitions whose records were written again, until that is reported."""
        self._came = threading.Condition()
        self._changed: Callable[[int, Change], None] = lambda *_: None
        self._resumed: Callable[[], None] = lambda: None
        self._occupied: Callable[[], Container[int]] = frozenset
        self._wake = threading.Event()
        self._ends_ns = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="member", daemon=True)

    def start(
        self,
        changed: Callable[[int, Change], None],
        resumed: Callable[[], None],
        occupied: Callable[[], Container[int]],
        linked: Callable[[], bool] = lambda: True,
    ) -> None:
        """Join the others.

        Args:
            changed: called with every change of a partition; must not take long.
            resumed: called when a lapsed write lease holds again.
            occupied: returns the partitions with a stream whose state is not kept yet.
            linked: whether this process has a router; must not take long.
        """
        self._changed, self._resumed, self._occupied, self._linked = changed, resumed, occupied, linked
        if not self._store.remote:
            # Who is alone has all partitions before the first message comes.
            for _ in range(FIRST_TURNS):
                self._step()
        self._thread.start()

    @property
    def failure(self) -> str:
        """Why nothing may be published at present; empty while it may."""
        return "" if self._clock() < self._may_write_until_ns else f"leases: {self._error}"

    @property
    def strained(self) -> bool:
        """Whether its renewals are late; optional work is to be deferred.

        Where every renewal takes so long, that is so only while nothing may be published.
        """
        now_ns = self._clock()
        late = now_ns - self._renewed_ns > self._lease_ns // STRAINED
        return late and not (self._slow and now_ns < self._may_write_until_ns)

    @property
    def partitions(self) -> set[int]:
        """The partitions that this member holds, also while it is about to leave them."""
        return set(self._table.held.copy())

    def holds(self, stream: str) -> bool:
        """Return whether a session of a stream may begin here."""
        return self._table.holds(partition_of(stream))

    def fence(self, stream: str) -> int | None:
        """Return the fence of the lease under which a stream is tracked here; None without one."""
        return self._table.held.get(partition_of(stream))

    def may_write(self, stream: str, fence: int | None) -> bool:
        """Return whether the results of a fence may be published and saved now."""
        held = self._table.held.get(partition_of(stream))
        return fence is not None and fence == held and self._clock() < self._may_write_until_ns

    def look(self) -> None:
        """Wake the thread: a state is kept."""
        self._wake.set()

    def bring(self, stream: str, timeout: float) -> bool:
        """Get the partition of a stream, to stay; return False when it has not come in time (s).

        Raises:
            StoreError: the wish could not be written.
        """
        partition = partition_of(stream)
        key = wish_key(partition)
        while (found := self._store.get(key)) is None or found.value != self._instance:
            self._store.put(Write(key, self._instance, found.revision if found else 0))
        self._wake.set()
        with self._came:
            return self._came.wait_for(lambda: self._table.holds(partition), timeout)

    @property
    def draining(self) -> bool:
        """Whether it gives its partitions up and takes none."""
        return self._drains

    @property
    def unlinked(self) -> bool:
        """Whether it gives its partitions up because it has no router."""
        return self._table.state == UNLINKED

    @property
    def others(self) -> bool:
        """Whether another living member would take what this one leaves."""
        return any(name != self._table.member for name in self._table.takers())

    def drain(self, *, drains: bool = True) -> None:
        """Give up all partitions, each with the states of its streams, and take none; or take a share again."""
        self._drains = drains
        self._wake.set()

    def drained(self, timeout: float) -> bool:
        """Wait until nothing is held, or no member can take it, at most so long (s); return whether nothing is held."""
        with self._came:
            self._came.wait_for(lambda: not (self._table.held and self.others), timeout)
            return not self._table.held

    def leases(self) -> list[MemberLease]:
        """Return the living members as this one knows them."""
        return self._table.leases(self._renewed_ns, self._clock()) if self._revision else []

    def close(self, timeout: float) -> None:
        """Leave all partitions, say that this member has ended, and leave the store; a slow one is waited for."""
        self._ends_ns = self._clock() + round(timeout * SECOND)
        self._ending.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)
        self._store.close(max(0.0, (self._ends_ns - self._clock()) / SECOND))

    # The member's thread

    def _run(self) -> None:
        while not self._ending.is_set():
            hurries = self._table.moving and self._clock() - self._table.changed_ns < self._lease_ns
            self._wake.wait(min(self._look_s, SHORT_LOOK_S) if hurries else self._look_s)
            self._wake.clear()
            self._step()
        while True:
            try:
                self._end()
            except StoreError as error:
                if self._clock() < self._ends_ns:
                    self._wake.wait(RETRY_S)
                    self._wake.clear()
                    continue
                log.warning("leases_failed", error=str(error))
            return

    def _step(self) -> None:
        for part in (self._turn, self._settle):
            try:
                part()
            except StoreError as error:
                self._failed(str(error))
            except Exception:
                log.exception("internal_error", thread="member")  # the write lease lapses

    def _turn(self) -> None:
        """Renew, look, write."""
        self._table.state = self._state()
        if not self._keep():
            return
        self._write_again()
        records, now_ns = self._store.follow(self._table.position), self._clock()
        self._table.apply(records, now_ns)
        # At the same time: after a pause of the machine in between all the others would look frozen.
        for write in self._table.due(now_ns, self._occupied, self._store.gone):
            if not self._keep():
                return
            revision = self._store.put(write)
            self._table.written(write, revision)
            if revision is None and write.over and self._store.get(write.key) is None:
                self._table.gone(write.key)
            if write.value == ENDED:
                self._wake.set()  # its partitions can be taken at once

    def _state(self) -> str:
        """Return what the record of this member is to say."""
        now_ns = self._clock()
        if self._linked():
            self._unlinked_ns = None
        elif self._unlinked_ns is None:
            self._unlinked_ns = now_ns  # not since the last look: who was frozen looks for a router first
        if self._drains:
            return DRAINING
        since_ns = now_ns if self._unlinked_ns is None else self._unlinked_ns
        return UNLINKED if now_ns - since_ns > self._lease_ns // UNLINKED_PER_LEASE else ALIVE

    def _keep(self) -> bool:
        """Renew this member's record if it is time to; False: nothing else can be done now."""
        sent_ns = self._clock()
        value = self._table.state
        due = sent_ns - self._renewed_ns >= self._lease_ns // RENEWALS_PER_LEASE or value != self._said
        if self._revision and not due:
            return not self._unwritable
        key = member_key(self._table.member)
        revision = self._put_alive(key, value)
        if revision is None:
            found = self._store.get(key)
            if found is not None and found.value == ENDED:
                self._lose()
                return False
            # A renewal of its own, whose answer did not arrive; or the store has lost its records.
            sent_ns = self._clock()
            revision = self._store.put(Write(key, value, 0 if found is None else found.revision))
            if revision is None:
                return False
            if found is None:
                log.error("leases_gone", member=self._table.member, partitions=len(self._table.held))
                self._gone = set(self._table.held)
        was = self._clock() < self._may_write_until_ns
        if not self._unwritable:
            self._said = value
        self._revision, self._renewed_ns, self._error = revision, sent_ns, "its lease has lapsed"
        self._may_write_until_ns = sent_ns + self._lease_ns // WRITE_LEASES_PER_LEASE
        self._time_renewal(sent_ns)
        if self._failing:
            self._failing = False
            log.info("leases_back")
        if not was:
            self._resumed()
        return not self._unwritable

    def _write_again(self) -> None:
        """Write records of partitions that the store has lost; one that another member has taken meanwhile is lost."""
        while self._gone:
            partition = next(iter(self._gone))
            write = Write(partition_key(partition), self._table.member, 0)
            revision = self._store.put(write)
            if revision is not None:
                self._table.written(write, revision)
                self._renewed.add(partition)
            elif (found := self._store.get(write.key)) is not None:
                self._table.apply([found], self._clock())
            self._gone.discard(partition)

    def _time_renewal(self, sent_ns: int) -> None:
        """Note whether a renewal that has just been answered was in time."""
        now_ns = self._clock()
        if now_ns - sent_ns <= self._lease_ns // STRAINED:
            self._in_time_ns = now_ns
            if self._slow:
                self._slow = False
                log.info("leases_in_time")
        elif not self._slow and now_ns - self._in_time_ns > SLOW_LEASES * self._lease_ns:
            self._slow = True
            log.warning("leases_slow", took_s=round((now_ns - sent_ns) / SECOND, 3))

    def _put_alive(self, key: str, value: str) -> int | None:
        """Renew this member's record; return its revision, None when another one is the newest."""
        try:
            revision = self._store.put(Write(key, value, self._revision))
        except StoreError:
            # A full or read-only disk: no member can write, so none is ended, and each goes on while its record stands.
            # A member that can write again has not looked meanwhile, and counts every lease from then.
            found = None if self._store.remote else self._store.get(key)
            if found is None or found.revision != self._revision:
                raise
            self._unwritable = True
            return self._revision
        self._unwritable = False
        return revision

    def _lose(self) -> None:
        """Begin again as a new member: another one has ended this one, and takes its partitions."""
        self._may_write_until_ns = 0
        self._report_lost(self._table.lost | self._reported.keys())  # the records of some may have come before
        self._error = "another member has taken over its partitions"
        state, self._table = self._table.state, self._joining()
        self._table.state = state
        self._gone = set()
        self._revision = 0

    def _report_lost(self, partitions: set[int]) -> None:
        if partitions:
            log.error("lease_lost", member=self._table.member, partitions=len(partitions))

    def _joining(self) -> LeaseTable:
        return LeaseTable(f"{self._instance}/{secrets.token_hex(4)}", self._lease_ns)

    def _failed(self, error: str) -> None:
        if not self._failing:
            log.error("leases_failed", error=error)
        self._failing, self._error = True, error

    def _settle(self) -> None:
        """Report changes of partitions."""
        self._report_lost(self._table.lost)
        self._table.lost = set()
        held, leaving = dict(self._table.held), set(self._table.leaving)
        reported, self._reported = self._reported, held
        if held != reported:
            lost = {partition for partition, fence in reported.items() if held.get(partition) != fence}
            renewed, self._renewed = self._renewed & lost & held.keys(), set()
            for partition in lost:
                self._recalled.discard(partition)
                self._changed(partition, Change.RENEWED if partition in renewed else Change.LOST)
            for partition in held:
                if partition not in reported or partition in lost - renewed:
                    self._changed(partition, Change.HELD)
        for partition in leaving - self._recalled:
            self._recalled.add(partition)
            self._changed(partition, Change.RECALLED)
        with self._came:
            self._came.notify_all()
        shown = self._table.members(), len(held)
        if shown != self._shown and self._revision:
            self._shown = shown
            log.info("partitions_held", held=shown[1], of=PARTITIONS, members=[instance_of(name) for name in shown[0]])

    def _end(self) -> None:
        """Write that this member has ended: its partitions are free then. All checkpoints have been saved."""
        self._may_write_until_ns = 0
        key = member_key(self._table.member)
        if self._revision and self._store.put(Write(key, ENDED, self._revision)) is None:
            found = self._store.get(key)
            if found is not None and found.value != ENDED:  # a renewal of its own, whose answer did not arrive
                self._store.put(Write(key, ENDED, found.revision))

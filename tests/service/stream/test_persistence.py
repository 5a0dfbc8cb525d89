"""The checkpoint writer: its input, its memory while the store fails, and its effect on frames."""

import threading
from collections.abc import Mapping
from dataclasses import replace

from lease_log import Alone
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import Fenced, StoreError
from optipmb_service.session.checkpoint import Checkpoint, CheckpointError, encode_checkpoint
from optipmb_service.session.identity import Incarnation
from optipmb_service.session.session import Session
from optipmb_service.streams.persistence import CheckpointWriter
from router import Sensor, until

import optipmb

FIRST, SECOND = Sensor("site/first/lidar"), Sensor("site/second/lidar")


def snapshot(sensor: Sensor) -> Checkpoint:
    return Session(sensor.stream, optipmb.load_profile("nuscenes")).snapshot()


class Full(SqliteStore):
    """A store that has no room when told so; a test sees each try, and says when it fails."""

    def __init__(self) -> None:
        super().__init__(None)
        self.full = False
        self.tries = threading.Semaphore(0)
        self.may_fail = threading.Semaphore(0)

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        if not self.full:
            return super().save(checkpoints)
        self.tries.release()
        assert self.may_fail.acquire(timeout=60.0)
        raise StoreError("database or disk is full")


def test_the_newest_state_is_found_while_it_cannot_be_written() -> None:
    """A session that is opened again while the store is full goes on from memory, also in the middle of a try."""
    store, found = Full(), list[int]()
    leases = Alone(store)
    writer = CheckpointWriter(store, 0.3, leases)
    fence, state = leases.fence(FIRST.stream), snapshot(FIRST)
    old, tried = threading.Event(), threading.Event()

    def recall() -> int:
        writer.recall(FIRST.stream, lambda one: one.run, lambda run: found.append(run or 0))
        until(lambda: found, "its state is read")
        return found.pop()

    writer.start(lambda: None)
    writer.put(replace(state, run=1), fence, old.set)
    assert old.wait(60.0)
    assert recall() == 1
    store.full = True
    writer.put(replace(state, run=2), fence, tried.set)
    for is_full in (True, False):  # after the try that somebody waits for, and after the next one
        assert store.tries.acquire(timeout=60.0)
        assert recall() == 2
        store.full = is_full
        store.may_fail.release()
        assert tried.wait(60.0)
    until(lambda: not writer.failure, "it is written")
    assert recall() == 2
    writer.close(5)
    store.close()


def test_no_error_of_the_writer_loses_a_state() -> None:
    """What the writer took is written in the next round, and until then the store is said to fail."""

    class Broken(SqliteStore):
        broken = True

        def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
            if self.broken:
                raise RuntimeError("a bug")
            return super().save(checkpoints)

    store = Broken(None)
    leases = Alone(store)
    writer = CheckpointWriter(store, 0.05, leases)
    writer.start(lambda: None)
    writer.put(snapshot(FIRST), leases.fence(FIRST.stream))
    until(lambda: writer.failure, "it fails")
    assert writer.failure == "a bug"
    store.broken = False
    until(lambda: store.streams() == (FIRST.stream,), "the state is written")
    until(lambda: not writer.failure, "it is well")
    writer.close(5)
    store.close()


def test_what_waits_for_its_lease_grows_older() -> None:
    """While a lease has lapsed the store has not all; with nothing to write it has, round after round."""
    store, rounds = SqliteStore(None), [0]
    leases = Alone(store)
    writer = CheckpointWriter(store, 0.05, leases)

    def gather() -> None:
        rounds[0] += 1

    leases.lapsed = True
    writer.put(snapshot(FIRST), leases.fence(FIRST.stream))
    before_ns = writer.complete_ns
    writer.start(gather)
    until(lambda: rounds[0] > 3, "rounds")
    assert (store.streams(), writer.complete_ns) == ((), before_ns)
    leases.lapsed = False
    until(lambda: writer.complete_ns > before_ns, "it is written")
    assert store.streams() == (FIRST.stream,)
    written_ns = writer.complete_ns
    until(lambda: writer.complete_ns > written_ns, "a round without anything to write")
    assert (writer.written, writer.failure) == (1, "")
    writer.close(5)
    store.close()


def test_the_end_says_whether_all_is_written() -> None:
    """At its end the writer skips refused checkpoints and lost leases, and writes all others."""

    def end(store: SqliteStore, *, lapsed: bool = False) -> bool:
        leases = Alone(store)
        leases.lapsed = lapsed
        writer = CheckpointWriter(store, 60.0, leases)
        writer.start(lambda: None)
        writer.put(snapshot(FIRST), leases.fence(FIRST.stream))
        whole = writer.close(60.0)
        store.close()
        return whole

    full = Full()
    full.full = True
    full.may_fail.release()
    assert end(SqliteStore(None)) is True
    assert end(full) is False
    assert end(SqliteStore(None), lapsed=True) is False


def test_the_numbers_of_a_state_that_does_not_fit_are_kept() -> None:
    """Its ids never come again: the successor reads the next ones, and no older state; the failure is told."""
    store, told, unread, found = SqliteStore(None), list[str](), list[Incarnation](), list[Checkpoint | None]()
    leases = Alone(store)
    state = snapshot(FIRST)
    for most, next_id in ((10**9, 5), (len(encode_checkpoint(state)) - 1, 9)):
        store.max_bytes = most  # type: ignore[misc]  # as if it were another server
        writer = CheckpointWriter(store, 60.0, leases, lambda _, why: told.append(why))
        writer.start(lambda: None)
        head = replace(state.head, density=replace(state.head.density, next_id=next_id))
        writer.put(replace(state, base=head, head=head), leases.fence(FIRST.stream))
        assert writer.close(60.0) is (next_id == 5)
    assert len(told) == 1
    reader = CheckpointWriter(store, 60.0, leases)

    def restore(one: Checkpoint) -> Checkpoint:
        if unread:
            raise CheckpointError("older")
        return one

    reader.start(lambda: None)
    reader.recall(FIRST.stream, restore, found.append, unread.append)
    until(lambda: found, "it is read")
    assert (found, {one.next_id for one in unread}) == ([None], {9})
    reader.close(60.0)
    store.close()


def test_the_end_says_when_a_state_cannot_be_written() -> None:
    """A stream whose newest state is too large for the store is not kept, also where that was found long before."""

    class Small(SqliteStore):
        max_bytes = 1

    store, tried = Small(None), threading.Event()
    leases = Alone(store)
    writer = CheckpointWriter(store, 60.0, leases)
    writer.start(lambda: None)
    writer.put(snapshot(FIRST), leases.fence(FIRST.stream), tried.set)
    assert tried.wait(60.0)
    assert writer.close(60.0) is False
    store.close()

"""The checkpoint writer: its input, its memory while the store fails, and its effect on frames."""

import threading
from collections.abc import Mapping
from dataclasses import replace

from lease_log import Alone
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import Fenced, StoreError
from optipmb_service.stream.checkpoint import Checkpoint
from optipmb_service.stream.persistence import CheckpointWriter
from optipmb_service.stream.session import Session
from optipmb_service.stream.streams import KEPT_AT_ONCE
from registries import Around, packet_of, streams_of
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


def test_who_is_waited_for_keeps_no_other_waiting() -> None:
    """Sessions close one after the other, each while the one before is written: all others are written, too."""
    store, ended = SqliteStore(None), threading.Event()
    leases = Alone(store)
    writer = CheckpointWriter(store, 0.3, leases)
    closing, other = snapshot(FIRST), snapshot(SECOND)

    def close_another() -> None:
        if not ended.is_set():
            writer.put(closing, leases.fence(closing.stream), close_another)

    writer.start(lambda: writer.put(other, leases.fence(other.stream)))
    close_another()
    until(lambda: other.stream in store.streams(), "the other one is written")
    ended.set()
    writer.close(5)
    assert store.streams() == (FIRST.stream, SECOND.stream)
    store.close()


def test_what_somebody_waits_for_is_not_all() -> None:
    """A state written at once leaves the age of what the store has as it was: others may wait for their round."""
    store, kept = SqliteStore(None), threading.Event()
    leases = Alone(store)
    writer = CheckpointWriter(store, 60.0, leases)
    before_ns = writer.complete_ns
    writer.start(lambda: None)
    writer.put(snapshot(SECOND), leases.fence(SECOND.stream))
    writer.put(snapshot(FIRST), leases.fence(FIRST.stream), kept.set)
    assert kept.wait(60.0)
    assert (store.streams(), writer.complete_ns) == ((FIRST.stream,), before_ns)
    writer.close(5)
    assert store.streams() == (FIRST.stream, SECOND.stream)
    assert writer.complete_ns > before_ns
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


def test_states_are_given_for_a_few_streams_at_a_time() -> None:
    """Checkpoints of changed sessions, in pieces between which a new frame has its turn."""
    around = Around()
    streams = streams_of(around)
    sensors = [replace(FIRST, stream=f"site/node{number:02d}/lidar") for number in range(2 * KEPT_AT_ONCE + 3)]
    for seq in range(2):
        for sensor in sensors:
            streams.receive(packet_of(sensor.detections(seq)))
    around.run()
    streams.keep()
    streams.receive(packet_of(sensors[0].detections(2)))
    kept = []
    while around.turn():
        kept.append((len(around.kept), streams.totals().frames))
    frames = 2 * len(sensors)
    few, more = KEPT_AT_ONCE, 2 * KEPT_AT_ONCE
    assert kept == [(few, frames), (few, frames + 1), (more, frames + 1), (len(sensors), frames + 1)]
    around.kept.clear()
    streams.keep()
    around.run()
    assert around.kept.keys() == {sensors[0].stream}
    streams.keep()
    assert not around.turn()

"""Leases of partitions, over SQLite, a real NATS server, and the store in memory that the simulation below uses."""

import random
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lease_log import LEASE_S, SECOND, Alone, HandMember, MemoryLeases, Shared
from nats_process import NatsProcess, NatsTrio
from optipmb_service.cluster import jetstream, nats_connection
from optipmb_service.cluster import member as members_module
from optipmb_service.cluster.jetstream import JetStream
from optipmb_service.cluster.leases import LEFT_AT_ONCE, PARTITIONS, Change, partition_key, partition_of
from optipmb_service.cluster.member import Member
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import ENDED, Fenced, LeaseStore, Record, StoreError, Write
from optipmb_service.streams.persistence import CheckpointWriter
from router import until
from structlog.testing import capture_logs

Make = Callable[[], LeaseStore]

STREAM = "a.b/c_d/e-f"
TICK_S = LEASE_S / 20
HOUR_S = 3600.0


@pytest.fixture(scope="module", autouse=True)
def _patient() -> Iterator[None]:
    """A server on a machine that is busy with other things may take its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nats_connection, "CALL_S", 20.0)
        yield


@pytest.fixture(scope="module")
def nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsProcess]:
    with NatsProcess(tmp_path_factory.mktemp("nats")) as server:
        yield server


@pytest.fixture(params=["memory", "sqlite", "nats"])
def make(request: pytest.FixtureRequest) -> Iterator[Make]:
    """Makes ways to one store, each as of another process; every test has a store of its own."""
    made: list[LeaseStore] = []
    if request.param == "memory":
        shared = Shared()
        yield lambda: MemoryLeases(shared)
        return
    if request.param == "sqlite":
        folder: Path = request.getfixturevalue("tmp_path")

        def open_store() -> LeaseStore:
            made.append(SqliteStore(folder / "sessions.db"))
            return made[-1]

        yield open_store
        for one in made:
            one.close(5.0)
        return
    server: NatsProcess = request.getfixturevalue("nats")

    def join() -> LeaseStore:
        made.append(JetStream([server.url], f"test/{request.node.name}"))
        connected(made[-1])
        return made[-1]

    yield join
    for one in made:
        one.close(5.0)


def connected(store: LeaseStore) -> None:
    def reached() -> bool:
        try:
            store.follow(0)
        except StoreError:
            return False
        return True

    until(reached, "the store is reached")


def even(*members: HandMember) -> None:
    """Let members have turns until each partition is held, by equal shares."""
    for _ in range(20):
        for one in members:
            assert one.turn(TICK_S)
    assert sum(len(one.held) for one in members) == PARTITIONS
    assert set().union(*(one.held for one in members)) == set(range(PARTITIONS))
    assert max(len(one.held) for one in members) - min(len(one.held) for one in members) <= 1


def test_of_writes_at_once_one_wins(make: Make) -> None:
    """Fault 17: thirty times, thirty write over one record at the same time: one is accepted and read."""
    stores = [make() for _ in range(30)]
    for number in range(30):
        write = Write(partition_key(number), "", 0)
        together = threading.Barrier(len(stores))
        revisions: dict[int, int | None] = {}

        def put(index: int, write: Write = write, together: threading.Barrier = together) -> None:
            together.wait(60)
            revisions[index] = stores[index].put(write._replace(value=str(index)))  # noqa: B023 - joined below

        threads = [threading.Thread(target=put, args=(index,)) for index in range(len(stores))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        ((winner, revision),) = [one for one in revisions.items() if one[1] is not None]
        assert len(revisions) == len(stores)
        assert stores[0].get(write.key) == (write.key, str(winner), revision)


def test_what_changed_is_followed(make: Make) -> None:
    """A follower gets the newest record of each key that changed since, in the order of the revisions."""
    one, other = make(), make()
    first = one.put(Write("partition/1", "a/1", 0))
    second = other.put(Write("member/a.b_c/1", "alive", 0))
    assert first is not None
    assert second is not None
    third = one.put(Write("partition/1", "", first))
    assert third is not None
    assert first < second < third
    records = [Record("member/a.b_c/1", "alive", second), Record("partition/1", "", third)]
    assert other.follow(0) == records
    assert other.follow(second) == records[1:]
    assert other.follow(third) == []
    assert other.get("partition/2") is None


def test_a_checkpoint_is_refused_for_its_fence(make: Make) -> None:
    """A former holder of a partition saves nothing; the newest checkpoint and the one before come back to the byte."""
    one, other = make(), make()
    data = [random.Random(number).randbytes(200_000) for number in range(3)]
    key = partition_key(partition_of(STREAM))
    stale = one.put(Write(key, "a", 0))
    assert stale is not None
    assert one.load(STREAM) is None
    assert one.save({STREAM: Fenced(key, stale, data[0])}) == frozenset()
    fence = other.put(Write(key, "b", stale))
    assert fence is not None
    kept = {STREAM: Fenced(key, stale, b"stale"), "another": Fenced(key, fence, b"fresh")}
    assert one.save(kept) == {STREAM}
    assert (other.load(STREAM), other.load("another")) == (data[0], b"fresh")
    for number in (1, 2):
        assert other.save({STREAM: Fenced(key, fence, data[number])}) == frozenset()
    assert one.load(STREAM) == data[2]
    other.set_aside(STREAM, "torn\nin the middle")
    assert one.load(STREAM) == data[1]


def test_numbers_are_those_of_the_newest_checkpoint(make: Make) -> None:
    """They are saved under its fence, and stay when all checkpoints are set aside."""
    one, other = make(), make()
    key = partition_key(partition_of(STREAM))
    fence = one.put(Write(key, "a", 0))
    assert fence is not None
    assert one.numbers(STREAM) is None
    for number in (b"1", b"2", b"2"):
        assert one.save({STREAM: Fenced(key, fence, b"data", number)}) == frozenset()
    assert other.save({STREAM: Fenced(key, fence + 100, b"data", b"3")}) == {STREAM}
    while other.load(STREAM) is not None:
        other.set_aside(STREAM, "torn")
    assert other.numbers(STREAM) == b"2"


def test_a_store_that_is_closed_or_cannot_be_reached_says_so(nats: NatsProcess) -> None:
    """Every call ends in time with the one error, which names the server and no password."""
    nowhere = JetStream(["nats://user:secret@127.0.0.1:9"], "test")
    with pytest.raises(StoreError, match=r"^nats://127\.0\.0\.1:9: "):
        nowhere.load(STREAM)
    closed = JetStream([nats.url], "test")
    connected(closed)
    for store in (nowhere, closed):
        store.close(5.0)
        with pytest.raises(StoreError, match="closed"):
            store.follow(0)


def test_a_checkpoint_is_waited_for() -> None:
    """While a stream is this member's, a store that is cut off is asked again; at the end it is not."""
    store = MemoryLeases(Shared())
    leases = Alone(store)
    leases.save({STREAM: b"kept"})
    store.reachable = False
    failed = threading.Event()
    writer = CheckpointWriter(store, 0.05, leases)
    failing = writer._failed
    writer._failed = lambda error: (failing(error), failed.set())  # type: ignore[method-assign,assignment]  # told of it
    with ThreadPoolExecutor(1) as thread:
        for ends in (False, True):
            failed.clear()
            loading = thread.submit(writer._recalled, STREAM, lambda _: "restored", lambda _: None)
            assert failed.wait(60.0)
            assert not loading.done()
            if ends:
                writer._ended.set()
            else:
                store.shared.checkpoints[STREAM].clear()
                store.reachable = True
            assert loading.result(60.0) is None
            store.reachable = False


def test_members_share_evenly_as_they_come_and_go(make: Make) -> None:
    """With each member that joins, or ends in order, every one holds its share within one, and all are held."""
    members: list[HandMember] = []
    for name in "abc":
        members.append(HandMember(name, make()))
        even(*members)
    while len(members) > 1:
        members.pop(0).end()
        even(*members)


def test_who_is_silent_for_a_lease_loses_all(make: Make) -> None:
    """Fault 17: with clocks an hour apart a silent member's partitions are taken after its lease, and not before.

    It stops by itself before that, and when it wakes up it holds nothing, says so, and gets a share again.
    """
    sleeper, other = HandMember("z", make()), HandMember("a", make(), HOUR_S)
    even(sleeper, other)
    partitions = sleeper.held
    stream = next(name for name in map(str, range(1000)) if partition_of(name) in partitions)
    fence = sleeper.member.fence(stream)
    assert sleeper.member.may_write(stream, fence)
    passed_s = 0.0
    while other.held.isdisjoint(partitions):
        assert other.turn(TICK_S)
        sleeper.clock.ns += round(TICK_S * SECOND)
        passed_s += TICK_S
        assert not sleeper.held & other.held
        assert passed_s < 3 * LEASE_S
    assert passed_s > LEASE_S * 0.9
    assert other.held == set(range(PARTITIONS))
    assert not sleeper.member.may_write(stream, fence)
    sleeper.changes.clear()
    assert sleeper.turn()
    assert sorted(sleeper.changes) == [(partition, Change.LOST) for partition in sorted(partitions)]
    even(sleeper, other)
    assert not sleeper.member.may_write(stream, fence)


@pytest.mark.parametrize("passed_s", [0.0, LEASE_S])
def test_a_member_logs_once_that_others_have_its_partitions(passed_s: float) -> None:
    """It does so whether it notices by its own record, or before that by the records of its partitions."""
    shared = Shared()
    sleeper, other = HandMember("z", MemoryLeases(shared)), HandMember("a", MemoryLeases(shared))
    even(sleeper, other)
    count = len(sleeper.held)
    assert sleeper.turn(TICK_S)
    while len(other.held) < PARTITIONS:
        assert other.turn(TICK_S)
    with capture_logs() as logs:
        assert sleeper.turn(passed_s)
        even(sleeper, other)
    assert [line["partitions"] for line in logs if line["event"] == "lease_lost"] == [count]


def test_a_partition_is_left_when_the_state_of_its_streams_is_kept(make: Make) -> None:
    """What another member is to have is recalled; it may still be saved, and only then the other begins."""
    one, other = HandMember("one", make()), HandMember("other", make())
    even(one)
    one.occupied = set(range(0, PARTITIONS, 2))
    one.changes.clear()
    for _ in range(10):
        assert one.turn(TICK_S)
        assert other.turn(TICK_S)
    recalled = {partition for partition, change in one.changes if change is Change.RECALLED}
    assert len(recalled) == LEFT_AT_ONCE
    assert recalled <= one.occupied & one.held
    streams = {partition_of(stream): stream for stream in map(str, range(1000))}
    for stream in map(streams.__getitem__, recalled):
        assert not one.member.holds(stream)
        assert one.member.may_write(stream, one.member.fence(stream))
        assert other.member.fence(stream) is None
    one.occupied = set()
    even(one, other)
    assert recalled < other.held
    assert {partition for partition, change in other.changes if change is Change.HELD} == other.held


def test_what_is_wished_for_comes_and_stays(make: Make) -> None:
    """A partition that an operator wants elsewhere goes there, and the shares stay even, as members come and go."""
    members = [HandMember(name, make()) for name in "ab"]
    even(*members)
    wished = sorted(members[0].held)[:3]
    streams = {partition_of(stream): stream for stream in map(str, range(1000))}
    for partition in wished:
        assert not members[1].member.bring(streams[partition], 0.0)
    even(*members)
    assert members[1].held >= set(wished)
    members.append(HandMember("c", make()))
    even(*members)
    assert members[1].held >= set(wished)
    members.pop(1).end()
    even(*members)
    members.append(HandMember("b", make()))
    even(*members)
    assert members[-1].held >= set(wished)


def test_who_has_been_wished_for_everything_has_it(make: Make) -> None:
    """Wishes go before an equal share."""
    one, other = HandMember("one", make()), HandMember("other", make())
    even(one, other)
    streams = {partition_of(stream): stream for stream in map(str, range(1000))}
    for stream in streams.values():
        one.member.bring(stream, 0.0)
    for _ in range(20):
        for member in (one, other):
            assert member.turn(TICK_S)
    assert (len(one.held), len(other.held)) == (PARTITIONS, 0)


def test_who_drains_holds_nothing(make: Make) -> None:
    """A member that drains gives all to the others and takes nothing, wishes included, until that is undone.

    Its record says so; a few partitions at a time have no holder.
    """
    members = [HandMember(name, make()) for name in "abc"]
    even(*members)
    drained, *others = members
    drained.member.drain()
    stream = next(name for name in map(str, range(1000)) if partition_of(name) in others[0].held)
    drained.member.bring(stream, 0.0)
    left = len(drained.held)
    while drained.held:
        assert drained.turn(TICK_S)
        assert left - LEFT_AT_ONCE <= len(drained.held) < left
        left = len(drained.held)
        for one in others:
            assert one.turn(TICK_S)
    for _ in range(5):
        for one in members:
            assert one.turn(TICK_S)
    assert drained.member.drained(0.0)
    assert [len(one.held) for one in members] == [0, PARTITIONS // 2, PARTITIONS // 2]
    told = {one.member.rpartition("/")[0]: (one.state, set(one.fences)) for one in others[0].member.leases()}
    assert told == {"a": ("draining", set()), "b": ("alive", others[0].held), "c": ("alive", others[1].held)}
    drained.member.drain(drains=False)
    even(*members)
    assert drained.member.holds(stream)


def test_a_drain_that_is_undone_leaves_nothing_between(make: Make) -> None:
    """Partitions that could not be left meanwhile, as their streams' states were not kept, have a holder again."""
    one, other = (HandMember(name, make()) for name in "ab")
    even(one, other)
    for _ in range(5):
        assert one.turn(TICK_S)
    one.occupied = set(range(PARTITIONS))
    one.member.drain()
    assert one.turn(TICK_S)
    assert one.member._table.leaving
    one.member.drain(drains=False)
    one.occupied = set()
    even(one, other)
    assert not one.member._table.leaving


def test_the_last_member_drains_in_vain(make: Make) -> None:
    """No member can take its partitions: the drain is neither awaited nor confirmed, and it goes on tracking.

    That also holds for members that all drain: each keeps its share.
    """
    one, other = HandMember("a", make()), HandMember("b", make())
    even(one, other)
    for member in (one, other):
        assert member.member.others
        member.member.drain()
    # At first the one sees the other stay, and begins to leave.
    assert one.turn(TICK_S)
    for _ in range(5):
        assert other.turn(TICK_S)
        assert one.turn(TICK_S)
    assert not one.member.others
    assert not one.member.drained(60.0)
    assert [len(member.held) for member in (one, other)] == [PARTITIONS // 2] * 2
    alone = HandMember("c", MemoryLeases(Shared()))
    even(alone)
    alone.member.drain()
    for _ in range(5):
        assert alone.turn(TICK_S)
        assert len(alone.held) == PARTITIONS


def test_an_orderly_end_waits_for_a_slow_store() -> None:
    """A store that does not answer for a moment is asked again, so that the others need not wait for the lease."""
    store = MemoryLeases(Shared())
    member = Member("a", store, 60.0)
    member.start(lambda *_: None, lambda: None, frozenset)
    until(lambda: not member.failure, "it has joined")
    store.reachable = False
    threading.Timer(0.5, setattr, (store, "reachable", True)).start()
    member.close(60.0)
    assert [one.value for one in store.shared.records.values() if one.key.startswith("member/")] == [ENDED]


def test_a_full_disk_costs_no_lease(tmp_path: Path) -> None:
    """While nothing can be written both members of a machine go on; when it can, none is ended for the time between."""
    stores = [SqliteStore(tmp_path / "sessions.db") for _ in range(2)]
    members = [HandMember(name, store) for name, store in zip("ab", stores, strict=True)]
    even(*members)
    held = [dict(one.member._table.held) for one in members]
    for store in stores:
        assert isinstance(store, SqliteStore)
        assert store._leases.connection is not None
        store._leases.connection.execute("PRAGMA query_only = 1")
    for _ in range(100):
        for one in members:
            one.turn(TICK_S)
            assert len(one.held) == PARTITIONS // 2
            assert not one.member.failure
    for store in stores:
        assert isinstance(store, SqliteStore)
        assert store._leases.connection is not None
        store._leases.connection.execute("PRAGMA query_only = 0")
    even(*members)
    assert [one.member._table.held for one in members] == held
    for store in stores:
        store.close()


def test_a_server_that_is_killed(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The store is gone for an hour: leases lapse in time; when it is back all goes on with the same owners."""
    with NatsProcess(tmp_path_factory.mktemp("nats")) as server:
        stores = [JetStream([server.url], "test") for _ in range(2)]
        for store in stores:
            connected(store)
        members = [HandMember(name, store) for name, store in zip("ab", stores, strict=True)]
        even(*members)
        held = [one.held for one in members]
        fences = [dict(one.member._table.held) for one in members]
        server.kill()
        for one in members:
            assert not one.turn(LEASE_S / 4)
            assert one.held
            assert not one.turn(LEASE_S / 4)
            assert not one.held
            assert one.member.failure
            one.clock.ns += round(HOUR_S * SECOND)
        server.start()
        for store in stores:
            connected(store)
        for one in members:
            resumed = one.resumed
            assert one.turn()
            assert one.resumed == resumed + 1
            assert not one.member.failure
        even(*members)
        assert [one.held for one in members] == held
        assert [one.member._table.held for one in members] == fences
        for store in stores:
            store.close(5.0)


def disturbed(one: HandMember, chance: random.Random) -> HandMember:
    """Let a member have a turn in which something may befall it; returns it, or its next run."""
    store = one.store
    assert isinstance(store, MemoryLeases)
    fault = chance.randrange(60)
    one.frozen = chance.randrange(60) if fault == 0 else max(0, one.frozen - 1)
    store.reachable ^= fault == 1
    store.answers ^= fault == 2
    if one.frozen:
        one.clock.ns += round(TICK_S * SECOND)
    elif fault == 3 and store.reachable and store.answers:
        one.end()
        return HandMember(one.name, MemoryLeases(store.shared), chance.uniform(-HOUR_S, HOUR_S))
    else:
        one.turn(TICK_S)
    return one


def patiently(call: Callable[[], Any]) -> Any:
    """What a call returns as soon as the servers answer it."""
    answers: list[Any] = []

    def answered() -> bool:
        try:
            answers.append(call())
        except StoreError:
            return False
        return True

    until(answered, "the servers have a leader")
    return answers[-1]


@pytest.mark.alone
def test_of_three_servers_one_may_be_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of three servers in turn is killed and comes back: the same members go on, under the same fences.

    Without two of them nothing is saved; when one is back, all goes on.
    """
    monkeypatch.setattr(nats_connection, "CALL_S", 2.0)  # calls lost with a leader are repeated
    with NatsTrio(tmp_path) as servers:
        stores = [JetStream(servers.urls, "test") for _ in range(2)]
        members = [HandMember(name, store) for name, store in zip("ab", stores, strict=True)]
        for _ in range(20):
            for one in members:
                until(lambda one=one: one.turn(TICK_S), "a turn")  # type: ignore[misc]
        held = [dict(one.member._table.held) for one in members]
        assert [len(one) for one in held] == [PARTITIONS // 2] * 2
        partition, fence = next(iter(held[0].items()))

        def check(data: bytes) -> None:
            checkpoint = {STREAM: Fenced(partition_key(partition), fence, data)}
            assert patiently(lambda: stores[0].save(checkpoint)) == frozenset()
            assert patiently(lambda: stores[1].load(STREAM)) == data
            for one in members:
                until(lambda one=one: one.turn(TICK_S * 3), "a renewal")  # type: ignore[misc]
            assert [one.member._table.held for one in members] == held

        for index in range(3):
            servers.kill(index)
            check(b"two servers %d" % index)
            servers.start(index)
            check(b"three servers %d" % index)
        servers.kill(0)
        servers.kill(1)
        with pytest.raises(StoreError):
            stores[0].save({STREAM: Fenced(partition_key(partition), fence, b"lost")})
        servers.start(0)
        check(b"two servers again")
        for store in stores:
            store.close(5.0)


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 5), seed=st.integers(0, 10**6))
def test_no_partition_ever_has_two_owners(count: int, seed: int) -> None:
    """Fault 17: members are frozen, cut off, left without answers and ended, in any order, their clocks apart.

    At no time do two of them publish for one partition, and no fence is ever used by two; when all is well again every
    partition has one owner, by equal shares.
    """
    chance = random.Random(seed)
    shared = Shared()
    members = [
        HandMember(f"m{number}", MemoryLeases(shared), chance.uniform(-HOUR_S, HOUR_S)) for number in range(count)
    ]
    fences: dict[tuple[int, int], str] = {}
    for _ in range(150):
        for index in chance.sample(range(count), count):
            members[index] = disturbed(members[index], chance)
            owners = Counter(partition for one in members for partition in one.held)
            assert not owners or max(owners.values()) == 1
            for one in members:
                for lease in one.member._table.held.items():
                    assert fences.setdefault(lease, one.member._table.member) == one.member._table.member
    for one in members:
        assert isinstance(one.store, MemoryLeases)
        one.store.reachable = one.store.answers = True
    for _ in range(80):
        for one in members:
            one.turn(TICK_S)
    even(*members)


def test_a_slow_store_holds_new_streams_up_for_two_leases_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """A member whose every renewal takes long takes in new streams after two leases, and says so once."""
    now_ns, lease_ns, told = [0], round(LEASE_S * SECOND), list[str]()

    class Slow(MemoryLeases):
        took_ns = lease_ns * 3 // 10

        def put(self, write: Write) -> int | None:
            now_ns[0] += self.took_ns
            return super().put(write)

    class Log:
        def __getattr__(self, _: str) -> Callable[..., None]:
            return lambda event, **_: told.append(event)

    monkeypatch.setattr(members_module, "log", Log())
    store = Slow(Shared())
    member = Member("a", store, LEASE_S, lambda: now_ns[0])

    def strained(leases: int) -> set[bool]:
        seen, ends_ns = set[bool](), now_ns[0] + leases * lease_ns
        while now_ns[0] < ends_ns:
            member._keep()
            assert not member.failure
            seen.add(member.strained)
        return seen

    assert strained(1) == {True}
    assert True in strained(1)
    assert strained(3) == {False}
    now_ns[0] += lease_ns // 2
    assert member.strained  # nothing may be published
    assert told == ["leases_slow"]
    store.took_ns = lease_ns // 10
    assert strained(1) == {False}
    assert told == ["leases_slow", "leases_in_time"]


def test_a_checkpoint_above_the_largest_message_is_cut(nats: NatsProcess) -> None:
    """It comes back whole; a part of a frozen writer is refused; without all parts the one before is found."""
    store = JetStream([nats.url], "test/parts")
    connected(store)
    key, part = partition_key(partition_of("a/b/c")), store.max_bytes // jetstream.PARTS
    fence = store.put(Write(key, "one", 0)) or 0
    small, large = b"small", bytes(range(256)) * (part // 100)
    for data in (small, large):
        assert store.save({"a/b/c": Fenced(key, fence, data, b"n")}) == frozenset()
        assert store.load("a/b/c") == data
    later = store.put(Write(key, "two", fence)) or 0
    assert store.save({"a/b/c": Fenced(key, fence, large + b"x", b"n")}) == {"a/b/c"}
    assert store.load("a/b/c") == large
    for number in range(2):  # of two others whose writers ended before the last part
        store._call(store._publish(store._subject("part.0", "a/b/c"), b"%d" % number, {}))
    assert store.load("a/b/c") not in {large, None}
    store.set_aside("a/b/c", "torn")
    assert store.load("a/b/c") == small
    assert store.save({"a/b/c": Fenced(key, later, large, b"n")}) == frozenset()
    assert store.load("a/b/c") == large
    store.close(5.0)

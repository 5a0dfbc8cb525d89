"""Exactly one instance keeps a stream, whatever comes together; who was away looks first."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.cluster.ownership import OwnershipTable
from optipmb_service.cluster.port import Role, RoleChange, WriteLease
from optipmb_service.runtime.byte_budget import ByteBudget
from optipmb_service.runtime.ports import Packet
from optipmb_service.runtime.takeover_buffer import TakeoverBuffer

SECOND = 1_000_000_000
TICK = SECOND // 20
STREAM = "a/b/c"


@dataclass
class Network:
    """Tokens of several instances; claims are seen at once, owner tokens are told of with a delay."""

    names: list[str]
    tables: dict[str, OwnershipTable] = field(default_factory=dict)
    claims: set[str] = field(default_factory=set)
    owners: set[str] = field(default_factory=set)
    told: list[tuple[int, str, str, bool]] = field(default_factory=list)
    dead: set[str] = field(default_factory=set)
    frozen: set[str] = field(default_factory=set)
    now_ns: int = 0

    def __post_init__(self) -> None:
        self.tables = {name: OwnershipTable(name, 2 * SECOND, SECOND // 4, SECOND) for name in self.names}

    def withdraw(self, name: str) -> None:
        """All tokens of an instance vanish."""
        self.claims.discard(name)
        if name in self.owners:
            self.owners.discard(name)
            self._tell(name, present=False)

    def turn(self, order: list[str], *, lapsed: frozenset[str] = frozenset()) -> None:
        """Each instance's coordinator has its turn, in some order; claims are declared before anybody decides."""
        self.now_ns += TICK
        for at, name, other, present in [one for one in self.told if one[0] <= self.now_ns]:
            self.told.remove((at, name, other, present))
            self.tables[name].token_changed(STREAM, other, present=present)
        living = [name for name in order if name not in self.dead | self.frozen]
        for name in living:
            self.claims |= {name for _ in self.tables[name].claims(self.now_ns, linked=True)}
        for name in living:
            tables = self.tables[name]
            view = {STREAM: set(self.claims)} if tables.contested or name in lapsed else {}
            for change in tables.decide(self.now_ns, view, lapsed=name in lapsed).values():
                if change is RoleChange.GRANTED:
                    self.owners.add(name)
                    self._tell(name, present=True)
                else:
                    self.withdraw(name)

    def _tell(self, who: str, *, present: bool) -> None:
        late = 2 * TICK
        self.told += [(self.now_ns + late, name, who, present) for name in self.names if name != who]

    @property
    def owning(self) -> list[str]:
        """Who believes to own the stream, of those that live."""
        return [
            name
            for name, tables in self.tables.items()
            if name not in self.dead | self.frozen and tables.role(STREAM) is Role.OWNER
        ]


@settings(max_examples=200, deadline=None)
@given(count=st.integers(1, 5), seed=st.integers(0, 10**6))
def test_exactly_one_of_those_that_claim_at_once_keeps(count: int, seed: int) -> None:
    """Fault 17: instances ask within a tenth of a second, turns in any order: at no time two owners, at last one."""
    chance = random.Random(seed)
    network = Network([f"i{number}" for number in range(count)])
    starts = {name: chance.randrange(3) for name in network.names}
    for turn in range(60):
        for name in network.names:
            if starts[name] == turn:
                network.tables[name].request(STREAM, network.now_ns)
        network.turn(chance.sample(network.names, count))
        assert len(network.owning) <= 1
    assert len(network.owning) == 1


@settings(max_examples=200, deadline=None)
@given(count=st.integers(2, 5), seed=st.integers(0, 10**6))
def test_one_takes_over_when_the_owner_dies(count: int, seed: int) -> None:
    """Fault 17: its tokens vanish, and one of those that stand by owns the stream within a second."""
    chance = random.Random(seed)
    network = Network([f"i{number}" for number in range(count)])
    for name in network.names:
        network.tables[name].request(STREAM, 0)
    for _ in range(60):
        network.turn(chance.sample(network.names, count))
    for _ in range(count - 1):
        (owner,) = network.owning
        network.dead.add(owner)
        network.withdraw(owner)
        for _ in range(60):
            network.turn(chance.sample(network.names, count))
            assert len(network.owning) <= 1
        assert len(network.owning) == 1


@pytest.mark.parametrize("names", [["a", "b"], ["b", "a"]])
def test_a_frozen_owner_stands_down(names: list[str]) -> None:
    """Fault 17: whatever its name is, an owner whose write lease lapsed gives the stream up to another's claim."""
    sleeper, other = names
    network = Network(names)
    network.tables[sleeper].request(STREAM, 0)
    for _ in range(20):
        network.turn(names)
    network.tables[other].request(STREAM, network.now_ns)
    network.turn(names)
    assert network.owning == [sleeper]
    network.frozen.add(sleeper)
    network.withdraw(sleeper)  # the router has not heard of it for a lease
    for _ in range(60):
        network.turn(names)
    assert network.owning == [other]
    network.frozen.clear()
    network.claims.add(sleeper)  # its tokens come back with its link
    network.turn(names, lapsed=frozenset({sleeper}))
    assert network.owning == [other]


def test_who_lost_its_own_link_waits_before_it_takes_over() -> None:
    """A router that was gone took all tokens along: the owner gets a lease to come back before anybody claims."""
    tables = OwnershipTable("b", 2 * SECOND, SECOND // 4, SECOND)
    tables.token_changed(STREAM, "a", present=True)
    tables.request(STREAM, 0)
    assert tables.claims(SECOND, linked=True) == []
    tables.token_changed(STREAM, "a", present=False)
    assert tables.claims(2 * SECOND, linked=False) == []
    assert tables.claims(3 * SECOND, linked=True) == []
    assert tables.claims(4 * SECOND, linked=True) == []
    assert tables.claims(5 * SECOND, linked=True) == [STREAM]


def test_a_write_lease_ends_by_itself() -> None:
    """A write lease holds for its length after a renewal, and not at all before the first one or after a lapse."""
    write_lease = WriteLease(SECOND)
    assert not write_lease.valid(1)
    write_lease.renew(5 * SECOND)
    assert write_lease.valid(6 * SECOND - 1)
    assert not write_lease.valid(6 * SECOND)
    write_lease.lapse()
    assert not write_lease.valid(5 * SECOND)


def packet(size: int, at_s: float) -> Packet:
    """A packet that arrived at a time."""
    return Packet("k", bytes(size), size, "", 0, round(at_s * SECOND))


@given(st.lists(st.tuples(st.integers(1, 50), st.booleans(), st.floats(0, 2)), max_size=60))
def test_what_waits_for_a_takeover_is_bounded(arrivals: list[tuple[int, bool, float]]) -> None:
    """By bytes over all streams and by age; what is left comes in order, clouds go before frames."""
    budget = ByteBudget(200)
    waiting = [TakeoverBuffer(5 * SECOND, budget), TakeoverBuffer(5 * SECOND, budget)]
    now_s = 0.0
    for number, (size, frame, pause_s) in enumerate(arrivals):
        now_s += pause_s
        waiting[number % 2].add(packet(size, now_s), frame=frame)
        assert 0 <= budget.used <= 200
    for one in waiting:
        one.trim(round(now_s * SECOND))
        taken = one.take()
        times = [entry.now_ns for entry, _ in taken]
        assert times == sorted(times)
        assert all(now_s * SECOND - at <= 5 * SECOND + 1 for at in times)
        assert not one
    assert budget.used == 0


def test_clouds_go_first() -> None:
    """When there is no room a stream gives up its clouds, then its oldest frames."""
    one = TakeoverBuffer(5 * SECOND, ByteBudget(100))
    for number in range(5):
        one.add(packet(10, number / 10), frame=True)
        one.add(packet(30, number / 10), frame=False)
    assert sum(frame for _, frame in one.take()) == 5

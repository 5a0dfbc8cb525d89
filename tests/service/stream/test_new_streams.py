"""What streams cost that begin at once, and what becomes of their first frames: counted, without a network."""

import random
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_schemas import Keys
from optipmb_service.cluster.leases import PARTITIONS, Change, partition_of
from optipmb_service.streams import directory, streams
from optipmb_service.streams.backlog import UNASKED_NS
from optipmb_service.streams.intake import DISCOVERY, NEW_STREAMS, Intake
from optipmb_service.streams.profiles import Fusion
from optipmb_service.units import SECOND
from optipmb_service.zenoh.topics import ALL, Packet
from registries import Around, packet_of, streams_of
from router import Sensor, until

KEYS = Keys()
STREAMS = [f"site/n{number:04}/lidar" for number in range(3 * NEW_STREAMS)]
WAIT_S = 60.0


class Network:
    """Writes down what a member asks of the network; when it watches for tokens, another one announces streams."""

    def __init__(self, announced: Sequence[str] = (), published: Sequence[str] = ()) -> None:
        self.asked: list[list[str]] = []
        self.subscribed: list[tuple[str, str, bool]] = []
        self.unasked: list[int] = []
        """At each question: streams of which something is subscribed to, and nothing has been asked."""
        self._announced, self._published = announced, published

    def receive(self, *_: Callable[..., object]) -> None:
        """Nothing comes here."""

    def watch_streams(self, published: Callable[..., None], discovered: Callable[..., None]) -> None:
        for stream in self._announced:
            discovered(KEYS.discovered([stream], "other", "run"), True)
        for stream in self._published:
            published(f"{KEYS.detections(stream)}/@adv/pub/1/2/_", "token", True)

    def subscribe(self, kind: str, stream: str, *, cached: bool) -> None:
        self.subscribed.append((kind, stream, cached))

    def unsubscribe(self, inputs: Iterable[object]) -> None:
        assert not list(inputs)

    def watch_owners(self, told: Callable[..., None] | None) -> None:
        """There are no announcements."""

    def discover(self, streams: set[str]) -> None:
        assert not streams

    def ask_recent(self, sessions: Sequence[str]) -> list[object]:
        asked = {session for group in self.asked for session in group}
        self.unasked.append(len({stream for _, stream, _ in self.subscribed} - asked))
        self.asked.append(list(sessions))
        return []


class Following(Network):
    def __init__(self) -> None:
        super().__init__()
        self.now: set[tuple[str, str, bool]] = set()

    def subscribe(self, kind: str, stream: str, *, cached: bool) -> None:
        assert (kind, stream, cached) not in self.now
        self.now.add((kind, stream, cached))

    def unsubscribe(self, inputs: Iterable[object]) -> None:
        left: Any = set(inputs)
        assert left <= self.now
        self.now -= left

    def discover(self, streams: set[str]) -> None:
        """Announcing is not looked at."""


class Discovering(Following):
    """Gives out the function that is called with each detections message of any stream."""

    noticed: Callable[[str, bool], bool]
    announced: set[str]

    def receive(self, *callbacks: Callable[..., Any]) -> None:
        self.noticed, self.announced = callbacks[1], set()

    def discover(self, streams: set[str]) -> None:
        self.announced = streams


class Holding:
    strained = False

    def __init__(self, held: set[int]) -> None:
        self._held = held

    @property
    def partitions(self) -> set[int]:
        return set(self._held)

    def holds(self, stream: str) -> bool:
        return partition_of(stream) in self._held


def member_of(network: Network, held: set[int]) -> tuple[Intake, Any]:
    streams = SimpleNamespace(
        on_owner=lambda: None,
        doubts_owners=False,
        receive=None,
        passed_by=None,
        cache_answered=None,
        of=lambda _: None,
        held=lambda _: set(),
        tracked=lambda _: False,
        parsed=lambda key: (KEYS.stream_of(key),) * 2,
        expect=lambda _: None,
        hold=lambda _: None,
        forget_caches=lambda _: None,
        take_up=lambda *_: None,
        changed=lambda *_: None,
    )
    streams.directory = directory.StreamDirectory("m", 3600 * SECOND, streams.tracked)
    streams.parts = SimpleNamespace(keys=KEYS, fusion=Fusion())
    untyped: Any = streams, Holding(held), network
    return Intake(*untyped, standby=False, linger_s=10.0), streams


class Turning:
    """A member that is asked for its partitions once in each step."""

    def __init__(self, held: Callable[[], set[int]], member: Any) -> None:
        self._held, self._member = held, member

    @property
    def partitions(self) -> set[int]:
        return self._held()

    @property
    def strained(self) -> bool:
        return bool(self._member.strained)


def run(network: Network, intake: Intake, done: Callable[[], bool]) -> None:
    intake.start()
    try:
        ends = time.monotonic() + WAIT_S
        while not done():
            assert time.monotonic() < ends, network.subscribed[-1:]
            time.sleep(0.01)
    finally:
        intake.close(WAIT_S)


def test_new_streams_are_asked_for_a_few_at_a_time() -> None:
    """A member with many new streams asks for the first frames of the first before it has subscribed to all."""
    network = Network(announced=STREAMS)
    intake, _ = member_of(network, set(range(1, PARTITIONS)))
    own = {stream for stream in STREAMS if partition_of(stream)}
    run(network, intake, lambda: sum(map(len, network.asked)) >= len(own))
    assert Counter(session for group in network.asked for session in group) == Counter(own)
    assert max(network.unasked) <= NEW_STREAMS
    assert Counter(network.subscribed) == Counter(
        (kind, stream, False) for stream in own for kind in ("detections", "points")
    )


@pytest.mark.parametrize("cached", [True, False], ids=["cached", "plain"])
def test_new_streams_wait_while_the_lease_is_renewed_late(*, cached: bool) -> None:
    """A member that renews its lease late subscribes to no new stream before it is in time again."""
    network = Network(**{"published" if cached else "announced": STREAMS})
    intake, _ = member_of(network, set(range(1, PARTITIONS)))
    own = {stream for stream in STREAMS if partition_of(stream)}
    steps: list[int] = []
    late: Any = intake._member

    def held() -> set[int]:
        steps.append(len(network.subscribed))
        late.strained = len(steps) < 3
        return set(range(1, PARTITIONS))

    intake._member = Turning(held, late)  # type: ignore[assignment]  # the only attribute used
    run(network, intake, lambda: {stream for _, stream, _ in network.subscribed} == own)
    assert steps[:3] == [0, 0, 0]


def test_only_publishers_with_a_cache_are_subscribed_to_with_recovery() -> None:
    """Recovery, which is expensive to declare, is asked for where there is a cache, and nowhere else."""
    plain, cached = STREAMS[:5], STREAMS[5:10]
    network = Network(announced=plain, published=cached)
    intake, _ = member_of(network, set(range(1, PARTITIONS)))
    own = {stream for stream in plain + cached if partition_of(stream)}
    run(network, intake, lambda: len(network.subscribed) >= 2 * len(own))
    assert {stream for _, stream, recovered in network.subscribed if recovered} == own.intersection(cached)
    assert {stream for _, stream, recovered in network.subscribed if not recovered} == own.intersection(plain)


@pytest.mark.parametrize("seed", range(4))
def test_subscriptions_are_those_of_who_begins_now(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """For all earlier streams and partitions, step by step, with and without caches of publishers.

    Of streams whose detections are received no longer it is forgotten that their caches had answered.
    """
    monkeypatch.setattr(directory, "FORGET_NS", 0)
    chance = random.Random(seed)
    held = set(range(PARTITIONS if seed == 0 else 30))
    network = Following()
    intake, member = member_of(network, held)
    answered = set[str]()
    member.forget_caches = answered.intersection_update
    seen = set()
    for _ in range(300):
        for stream in chance.sample(STREAMS[:60], chance.randrange(5)):
            present = chance.random() < 0.6
            if chance.random() < 0.5:
                intake._published(f"{KEYS.detections(stream)}/@adv/pub/1/2/_", "token", present)
            else:
                intake._discovered(KEYS.discovered([stream], "other", "run"), present)
        if chance.random() < 0.1:
            partition = chance.randrange(PARTITIONS)
            held ^= {partition}
            intake.changed(partition, Change.HELD if partition in held else Change.LOST)
        if chance.random() < 0.1:
            intake._left.clear()
        intake._expires_ns = 0
        intake._step()
        begins = Following()
        fresh, _ = member_of(begins, held)
        fresh._directory, fresh._left = intake._directory, dict(intake._left)
        fresh._expires_ns = intake._expires_ns
        fresh._step()
        assert network.now == begins.now
        seen.add(frozenset(network.now))
        received = {stream for kind, stream, _ in network.now if kind == "detections"}
        assert answered <= received or ALL in received
        answered |= received - {ALL}
    assert len(seen) > 30


@pytest.mark.parametrize("fails", ["subscribe", "discover", "ask_recent", "take_up"])
def test_a_step_that_fails_is_done_again(monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    """Sessions held for an arriving stream are resumed, even after an error in between."""
    network, held = Network(announced=STREAMS[:5], published=STREAMS[5:10]), set[int]()
    intake, member = member_of(network, held)
    kept, taken, failed = set[str](), set[str](), list[str]()
    member.hold = kept.add
    member.take_up = lambda session, _: (kept.discard(session), taken.add(session))
    where: Any = member if fails == "take_up" else network
    works = getattr(where, fails)

    def failing(*arguments: Any, **named: Any) -> object:
        if kept and not failed:
            failed.append(fails)
            raise RuntimeError("a mistake")
        return works(*arguments, **named)

    monkeypatch.setattr(where, fails, failing)
    intake.start()
    try:
        held.update(range(1, PARTITIONS))
        for partition in tuple(held):
            intake.changed(partition, Change.HELD)
        own = {stream for stream in STREAMS[:10] if partition_of(stream)}
        until(lambda: failed == [fails] and taken == own and not kept, "all are taken up", WAIT_S)
    finally:
        intake.close(WAIT_S)


class Others(Around):
    """Everything around the streams of a member that may hold none, and whose lease may be renewed late."""

    def __init__(self) -> None:
        super().__init__()
        self.holding = True
        self.problems: list[str] = []

    def holds(self, _: str) -> bool:
        return self.holding

    def report(self, problem: Any, _: int) -> None:
        self.problems.append(problem.code)


class Kept:
    """The streams of a member that has room for no new ones."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
        self.others = Others()
        self._patch = monkeypatch
        self.crowded(True)
        self.streams = streams_of(self.others, reporter=self.others, **settings)

    def crowded(self, crowded: bool) -> None:  # noqa: FBT001 - the state itself
        self._patch.setattr(streams, "MAX_UNPROVEN", 0 if crowded else 256)

    def tracked(self) -> list[int]:
        self.others.run()
        return [one.session.counters.frames for one in self.streams.tracking() if one.session is not None]


SENSOR = Sensor(STREAMS[0])


def detections(number: int) -> Packet:
    return packet_of(SENSOR.detections(number))


def test_what_others_received_reaches_a_stream_that_was_let_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream admitted while others are asked for their received messages gets these as well."""
    kept = Kept(monkeypatch)
    kept.streams.receive(detections(0))
    assert kept.tracked() == []
    kept.crowded(False)
    kept.streams.sweep(0)
    kept.streams.take_up(STREAMS[0], [detections(1), detections(2)])
    assert kept.tracked() == [3]


def test_a_stream_that_the_intake_holds_is_not_let_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream that the intake holds while room is made stays held until the intake has asked the others."""
    kept = Kept(monkeypatch)
    kept.streams.receive(detections(1))
    kept.crowded(False)
    kept.streams.sweep(0)
    kept.streams.hold(STREAMS[0])
    assert kept.tracked() == []
    kept.streams.take_up(STREAMS[0], [detections(0)])
    assert kept.tracked() == [2]
    assert kept.streams.totals().inserted == 0
    assert not kept.streams.keeps(STREAMS[0])


def test_what_is_put_off_counts_as_received(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message of a stream that waits for room counts as received once, and none as another member's."""
    kept = Kept(monkeypatch)
    counted: Counter[str] = Counter()
    monkeypatch.setattr(kept.streams.parts.metrics, "received", lambda topic, _: counted.update([f"received {topic}"]))
    monkeypatch.setattr(kept.streams.parts.metrics, "foreign", lambda topic, _: counted.update([f"foreign {topic}"]))
    for number in range(5):
        kept.streams.receive(detections(number))
    kept.crowded(False)
    kept.streams.sweep(0)
    assert kept.tracked() == [5]
    assert counted == {"received detections": 5}


def test_what_is_put_off_and_dropped_is_shed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages beyond the backlogs' bounds of size and time count as shed, with a problem."""
    kept = Kept(monkeypatch, standby_mb=1)
    large = packet_of(SENSOR.detections(0, objects=1000))
    room = 2**20 // large.held
    for _ in range(room + 10):
        kept.streams.receive(replace(large))
    assert kept.streams.totals().shed == 10
    kept.streams.receive(packet_of(SENSOR.points(0)))
    kept.streams.sweep(time.monotonic_ns() + UNASKED_NS + SECOND)
    totals = kept.streams.totals()
    assert (totals.received, totals.shed, totals.clouds_shed) == (room + 10, room + 10, 1)
    assert set(kept.others.problems) == {"shed"}


def test_what_is_put_off_is_within_the_quota(monkeypatch: pytest.MonkeyPatch) -> None:
    """The quotas of a node and a site hold for a stream that waits for room as for any other."""
    kept = Kept(monkeypatch, node_rate=1)
    for number in range(2):
        kept.streams.receive(detections(number))
    assert (kept.streams.totals().refused, kept.others.problems) == (1, ["quota"])
    kept.crowded(False)
    kept.streams.sweep(0)
    assert kept.tracked() == [1]


def test_messages_without_a_token_are_kept_for_who_tracks_their_stream() -> None:
    """The first message of an unknown stream is kept for its member; once the stream is known, its member asks."""
    network = Discovering()
    intake, streams = member_of(network, {DISCOVERY})
    kept: list[str] = []
    streams.expect = kept.append
    foreign = next(stream for stream in STREAMS if partition_of(stream) != DISCOVERY)

    def known() -> bool:
        """Another message comes: whether the stream of the first one has been announced."""
        assert network.noticed(KEYS.detections(foreign), False)
        return foreign in network.announced

    run(network, intake, known)
    before = len(kept)
    assert set(kept) == {foreign}
    assert network.noticed(KEYS.detections(foreign), False)
    assert len(kept) == before


@pytest.mark.parametrize("asked", [True, False])
def test_what_a_session_passes_on_is_kept_until_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, *, asked: bool
) -> None:
    """Frames of a leaving session are kept also where `standby_s` is 0, and count as shed without a request."""
    kept = Kept(monkeypatch, standby_s=0)
    kept.crowded(False)
    held = [packet_of(SENSOR.detections(number, has_points=True)) for number in range(2)]
    for packet in held:
        kept.streams.receive(packet)
    assert kept.tracked() == [0]
    kept.others.holding = False
    kept.streams.changed(partition_of(STREAMS[0]), Change.RECALLED)
    kept.others.run()
    kept.streams.receive(detections(2))
    assert kept.streams.held(range(PARTITIONS)) == {STREAMS[0]}
    if asked:
        recent = kept.streams.recent([STREAMS[0]])
        assert [one.payload for one in recent[:2]] == [one.payload for one in held]
    kept.streams.sweep(time.monotonic_ns() + UNASKED_NS + SECOND)
    assert not kept.streams.recent([STREAMS[0]])
    assert kept.streams.totals().shed == (0 if asked else 2)

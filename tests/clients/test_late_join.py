"""Which samples of a publisher a subscription hands over, and in which order."""

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import optipmb_client.zenoh.late_join
import pytest
from optipmb_client.zenoh.late_join import CacheQueries, LateJoin


@dataclass(frozen=True)
class Entity:
    zid: str = "abc"
    eid: int = 7


@dataclass(frozen=True)
class Info:
    source_id: Entity
    source_sn: int


@dataclass(frozen=True)
class Sample:
    source_info: Info | None
    key_expr: str = "a/b"
    payload: bytes = bytes(10)


@dataclass
class Joined:
    """A subscription with its caches: delivered samples and pending queries."""

    received: list[object] = field(default_factory=list)
    asked: list[tuple[str, Callable[[Sample], None], Callable[[bool], None]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.join: LateJoin[Sample] = LateJoin(
            lambda sample: self.received.append(sample.source_info and sample.source_info.source_sn),
            lambda *query: self.asked.append(query),
            self.received.append,
        )

    def take(self, *numbers: int, source: Entity = Entity()) -> None:
        for number in numbers:
            self.join.take(sample(number, source))

    def answer(self, *numbers: int, complete: bool = True) -> None:
        """The cache's answer to the oldest query; one that is not complete comes too late."""
        _, reply, end = self.asked.pop(0)
        for number in numbers:
            reply(sample(number))
        end(complete)


def sample(number: int, source: Entity = Entity()) -> Sample:
    return Sample(Info(source, number))


def test_a_publisher_that_begins_is_handed_over_at_once() -> None:
    """From number 0 on nothing is asked and nothing waits; the same for publishers without a cache."""
    one = Joined()
    one.join.take(Sample(None))
    one.take(0, 1, 2)
    assert (one.received, one.asked) == ([None, 0, 1, 2], [])


def test_what_came_before_the_first_sample_comes_first() -> None:
    """A first sample with another number waits, and what follows, for those before it; later ones do not."""
    one = Joined()
    one.take(3, 4)
    assert (one.received, [selector for selector, _, _ in one.asked]) == ([], ["a/b/@adv/pub/abc/7/**?_sn=0..2"])
    one.answer(2, 1)
    one.take(5)
    assert (one.received, one.asked) == ([1, 2, 3, 4, "a/b", 5], [])


def test_a_gap_is_asked_for_once() -> None:
    """What follows a gap waits for the answer of the cache, which may have nothing; further gaps wait for their own."""
    one = Joined()
    one.take(0, 1, 4, 6, 7)
    assert (one.received, [selector for selector, _, _ in one.asked]) == ([0, 1], ["a/b/@adv/pub/abc/7/**?_sn=2..3"])
    one.answer(3, 2)
    assert (one.received, [selector for selector, _, _ in one.asked]) == (
        [0, 1, 2, 3, 4],
        ["a/b/@adv/pub/abc/7/**?_sn=5..5"],
    )
    one.answer()
    one.take(5, 8)
    assert (one.received, one.asked) == ([0, 1, 2, 3, 4, 6, 7, "a/b", 5, 8], [])


def test_what_was_published_before_is_left_out() -> None:
    """Samples wait until the newest ones of the caches are known; a publisher that is not among them is new."""
    one, other = Joined(), Entity(eid=8)
    one.join = LateJoin(
        lambda sample: one.received.append(sample.source_info and sample.source_info.source_sn),
        lambda *query: one.asked.append(query),
        waits=True,
    )
    one.take(3, 4, 5, 6)
    one.take(0, 1, source=other)
    assert (one.received, one.asked) == ([], [])
    one.join.begin([sample(4)])
    one.take(2, 9)
    assert (one.received, [selector for selector, _, _ in one.asked]) == (
        [5, 6, 0, 1],
        ["a/b/@adv/pub/abc/7/**?_sn=7..8"],
    )
    one.answer(8, 7)
    assert one.received[4:] == [7, 8, 9]


def test_what_no_cache_holds_is_said_to_be_lost() -> None:
    """Before the sample behind it, with its key; not what the cache still has, nor repetitions."""
    one, found = Joined(), list[object]()
    one.join = LateJoin(
        lambda sample: found.append(sample.source_info and sample.source_info.source_sn),
        lambda *query: one.asked.append(query),
        lost=found.append,
    )
    one.take(0, 1, 1, 5)
    one.answer(3, 4)
    one.take(8, 9)
    one.answer()
    assert found == [0, 1, 1, "a/b", 3, 4, 5, "a/b", 8, 9]


def test_a_cache_that_does_not_answer_is_not_said_to_have_answered() -> None:
    """Samples held for a query are delivered when it fails, and so are its answers."""
    one = Joined()
    one.take(0, 3)
    one.answer(2, complete=False)
    one.take(4)
    assert one.received == [0, 2, 3, 4]


def test_one_publisher_does_not_wait_for_another() -> None:
    """While one publisher's cache is queried, samples of others are delivered."""
    one = Joined()
    one.take(3)
    one.take(0, 1, source=Entity("def"))
    assert one.received == [0, 1]
    one.answer()
    assert one.received == [0, 1, 3, "a/b"]


def test_closing_hands_over_what_waits_and_nothing_afterwards() -> None:
    """Received samples survive the end of the subscription; later answers and samples do not."""
    one = Joined()
    one.take(3, 4)
    one.join.close()
    one.answer(1, 2)
    one.take(5)
    assert one.received == [3, 4]


def test_what_waits_and_who_is_known_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too many samples do not wait any longer for the cache; the publisher known longest is asked again."""
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_WAITING", 3)
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_SOURCES", 2)
    one = Joined()
    one.take(3, 4, 5, 6)
    assert one.received == [3, 4, 5, 6]
    one.answer(2)
    assert one.received == [3, 4, 5, 6, 2, "a/b"]
    for name in ("second", "third"):
        one.take(0, source=Entity(name))
    assert one.asked == []
    one.take(7)
    assert [selector for selector, _, _ in one.asked] == ["a/b/@adv/pub/abc/7/**?_sn=0..6"]


def test_an_answer_brings_no_forgotten_publisher_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """A publisher that did not wait any longer and is forgotten stays so: its cache is asked when it is heard again."""
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_WAITING", 2)
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_SOURCES", 1)
    one = Joined()
    one.take(3, 4)
    one.join.keep(())
    one.answer(2)
    one.take(0, source=Entity("other"))
    one.take(7)
    assert one.received == [3, 4, 2, "a/b", 0]
    assert [selector for selector, _, _ in one.asked] == ["a/b/@adv/pub/abc/7/**?_sn=0..6"]


def test_bytes_that_wait_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """With more bytes than may wait the publisher concerned waits no longer; what then waits is counted from there."""
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_WAITING_BYTES", 30)
    one, other = Joined(), Entity("def")
    one.take(3, 4)
    one.take(8, source=other)
    assert one.received == []
    one.take(5)
    assert one.received == [3, 4, 5]
    one.take(9, 10, source=other)
    assert one.received == [3, 4, 5]
    one.take(11, source=other)
    assert one.received == [3, 4, 5, 8, 9, 10, 11]


def test_an_answer_lets_go_what_waits_behind_its_own_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """When too much waited for one answer, what waits for a later one goes on waiting for it."""
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "MAX_WAITING", 3)
    one = Joined()
    one.take(0, 2, 3, 4, 7)
    one.answer(1)
    assert one.received == [0, 2, 3, 4, 1]
    one.answer(5, 6)
    assert one.received == [0, 2, 3, 4, 1, 5, 6, 7, "a/b"]


class LostQueries:
    """Queries of which the first ones are lost: they end only when their time is up."""

    def __init__(self, lost: int) -> None:
        self.lost = lost
        self.sent: list[tuple[Callable[[Sample], None], Callable[[bool], None]]] = []
        self.queries: CacheQueries[Sample] = CacheQueries(self._send)
        self.replied: list[Sample] = []
        self.ended: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def ask(self) -> bool:
        self.queries.ask("a/b", self.replied.append, self.ended.put)
        return self.ended.get(timeout=60)

    def end_first(self) -> None:
        """End the first one unanswered when it has been sent as often as it is."""
        while len(self.sent) <= len(optipmb_client.zenoh.late_join.REPEATS_S):
            time.sleep(0.001)
        self.sent[0][1](False)

    def _send(self, selector: str, reply: Callable[[Sample], None], end: Callable[[bool], None]) -> None:
        assert selector == "a/b"
        self.sent.append((reply, end))
        if len(self.sent) > self.lost:
            reply(sample(1))
            end(True)


@pytest.fixture
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optipmb_client.zenoh.late_join, "REPEATS_S", (0.001, 0.001, 0.001))


@pytest.mark.usefixtures("_soon")
@pytest.mark.parametrize("lost", range(4))
def test_a_query_that_is_lost_is_sent_again(lost: int) -> None:
    """Up to three times; what an earlier one brings after the end of a later one goes nowhere."""
    one = LostQueries(lost)
    assert one.ask()
    for reply, end in one.sent[:lost]:
        reply(sample(1))
        end(False)
    one.queries.close()
    assert (one.replied, len(one.sent), one.ended.empty()) == ([sample(1)], lost + 1, True)


@pytest.mark.usefixtures("_soon")
def test_a_query_that_nobody_answers_ends_with_the_first_that_does() -> None:
    """When the time of the one that was sent first is up, however often it was sent again; nothing is sent any more."""
    one = LostQueries(9)
    threading.Thread(target=one.end_first, daemon=True).start()
    assert not one.ask()
    one.queries.close()
    assert one.replied == []


@pytest.mark.usefixtures("_soon")
def test_a_query_that_something_is_heard_of_is_sent_once() -> None:
    """A cache may take seconds for all that it holds; asked again, it would take longer."""
    one: CacheQueries[Sample]
    sent: list[str] = []
    others, ended = queue.SimpleQueue[bool](), queue.SimpleQueue[bool]()

    def send(selector: str, reply: Callable[[Sample], None], end: Callable[[bool], None]) -> None:
        sent.append(selector)
        reply(sample(1))
        if selector == "other":
            end(True)

    one = CacheQueries(send)
    one.ask("slow", lambda _: None, ended.put)
    for _ in range(20):  # each is due later than the query before it would have been sent again
        one.ask("other", lambda _: None, others.put)
        assert others.get(timeout=60)
        time.sleep(0.001)
    one.close()
    assert (sent.count("slow"), ended.empty()) == (1, True)


def test_what_a_cache_answers_twice_is_handed_over_once() -> None:
    """A query that was sent twice may be answered twice."""
    one = Joined()
    one.take(3)
    one.answer(1, 2, 1, 2)
    assert one.received == [1, 2, 3, "a/b"]

"""Subscriptions of a topic that come and go, and queries of publishers' caches meanwhile."""

import threading
from collections import Counter
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, cast

import optipmb_service.zenoh.topics
import pytest
import zenoh
from optipmb_client.zenoh.session import ZenohSession
from optipmb_schemas import Keys
from optipmb_service.zenoh.topics import ALL, Topic
from router import Collected
from routers import free_endpoint, open_router

KEYS: Final = Keys()
STREAM: Final = "site/node/lidar"
KEY: Final = KEYS.detections(STREAM)
CLOSE_S: Final = 10.0


class Network:
    """A topic, and a publisher with a cache on the same session, where each message is with its subscribers at once."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.link = ZenohSession(session)
        self.publisher = self.link.cached_sender(KEY, "", cache=100)
        self.received = Collected()
        self.answered: list[str] = []
        self.topic = Topic("detections", self.link, self.receive, self.answered.append)

    def receive(self, sample: zenoh.Sample) -> None:
        self.received.add(str(sample.key_expr), sample.payload.to_bytes(), "")

    def publish(self, *payloads: bytes) -> None:
        for payload in payloads:
            self.publisher.put(payload)

    def counts(self, *payloads: bytes) -> Counter[bytes]:
        """How often each message was handed over, when all of these were."""
        self.received.wait(lambda items: {*payloads} <= {one for _, one, _ in items}, repr(payloads))
        return Counter(one for _, one, _ in self.received.items)


@pytest.fixture
def network() -> Iterator[Network]:
    with open_router(free_endpoint()) as session:
        one = Network(session)
        one.publish(b"0", b"1")
        yield one
        one.topic.close(CLOSE_S)


def test_no_cache_is_asked_again_where_all_streams_take_over_from_one(network: Network) -> None:
    """When a stream is received by the subscription to all from now on, nothing but its newest message comes twice."""
    network.topic.subscribe(STREAM, KEY)
    network.publish(b"2")
    network.counts(b"0", b"1", b"2")
    network.topic.subscribe(ALL, KEYS.all("detections"))
    network.topic.leave([STREAM])
    network.publish(b"3")
    counts = network.counts(b"3")
    assert (counts[b"0"], counts[b"1"], network.answered) == (1, 1, [KEY])


@pytest.mark.parametrize(("name", "key"), [(STREAM, KEY), (ALL, KEYS.all("detections"))], ids=["one", "all"])
def test_a_stream_that_comes_again_lacks_nothing(network: Network, name: str, key: str) -> None:
    """Messages sent while neither the stream nor all are subscribed to come from the cache, after either."""
    network.topic.subscribe(name, key)
    network.publish(b"2")
    network.counts(b"0", b"1", b"2")
    network.topic.leave([name])
    network.publish(b"3", b"4")
    network.topic.subscribe(STREAM, KEY)
    network.publish(b"5")
    network.counts(b"3", b"4", b"5")


def test_messages_on_their_way_when_their_stream_is_left_do_not_hide_what_follows(
    network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message that is being handed over while its stream is left does not hinder a later query of its cache."""
    network.topic.subscribe(STREAM, KEY)
    network.publish(b"2")
    network.counts(b"0", b"1", b"2")
    arrived, go_on, receive = threading.Event(), threading.Event(), network.received.add

    def slowly(*arguments: Any) -> None:
        arrived.set()
        go_on.wait(CLOSE_S)
        receive(*arguments)

    monkeypatch.setattr(network.received, "add", slowly)
    publishing = threading.Thread(target=network.publish, args=(b"3",), daemon=True)
    publishing.start()
    arrived.wait(CLOSE_S)
    passed = threading.Event()
    network.topic.leave([STREAM])
    network.topic.pass_through(passed.set)
    assert not passed.is_set()
    go_on.set()
    passed.wait(CLOSE_S)
    assert b"3" in {payload for _, payload, _ in network.received.items}
    publishing.join(CLOSE_S)
    network.publish(b"5", b"6")
    network.topic.subscribe(STREAM, KEY)
    network.publish(b"7")
    network.counts(b"5", b"6", b"7")


def test_an_error_while_a_cache_is_asked_ends_nothing(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    """When a cache cannot be asked, what waited for it is handed over, and messages of others are as before."""

    def fail(*_: object, **_named: object) -> None:
        raise zenoh.ZError("closed")

    closed: Any = SimpleNamespace(_session=SimpleNamespace(get=fail))
    ask = ZenohSession.ask
    monkeypatch.setattr(network.link, "ask", lambda *query: ask(closed, *query))
    topic = Topic("detections", network.link, network.receive)
    topic.subscribe(ALL, KEYS.all("detections"))
    network.publish(b"2")
    network.session.put(KEYS.detections("site/node/camera"), b"other")
    network.counts(b"2", b"other")
    topic.close(CLOSE_S)


def test_messages_of_several_threads_are_handed_over_one_at_a_time(network: Network) -> None:
    """Links bring messages on threads of their own; of a topic no two are handed over at the same time."""
    at_work, together, received = threading.Lock(), [], Collected()

    def receive(sample: zenoh.Sample) -> None:
        together.append(not at_work.acquire(blocking=False))
        threading.Event().wait(0.001)  # others have the processor meanwhile
        at_work.release()
        received.add(str(sample.key_expr), sample.payload.to_bytes(), "")

    topic = Topic("points", network.link, receive)
    topic.subscribe(ALL, KEYS.all("points"), cached=False)
    sent = [[bytes((sender, number)) for number in range(20)] for sender in range(4)]
    senders = [
        threading.Thread(
            target=lambda own=own: [network.session.put(KEYS.points(STREAM), one) for one in own], daemon=True
        )
        for own in sent
    ]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join(CLOSE_S)
    received.wait(lambda items: len(items) == sum(map(len, sent)), "all messages")
    topic.close(CLOSE_S)
    network.session.put(KEYS.points(STREAM), b"afterwards")
    assert not any(together)
    assert b"afterwards" not in {payload for _, payload, _ in received.items}
    for own in sent:  # each in its order
        assert [payload for _, payload, _ in received.items if payload[0] == own[0][0]] == own


def test_a_thread_waits_while_too_many_messages_wait(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    """While more messages wait than may, the thread that brings the next one waits; then all come in their order."""
    monkeypatch.setattr(optipmb_service.zenoh.topics, "MOST", 2)
    arrived, may_go_on, received = threading.Event(), threading.Event(), Collected()

    def receive(sample: zenoh.Sample) -> None:
        arrived.set()
        may_go_on.wait(CLOSE_S)
        received.add(str(sample.key_expr), sample.payload.to_bytes(), "")

    def send(*payloads: bytes) -> threading.Thread:
        put = partial(network.session.put, KEYS.points(STREAM))
        sender = threading.Thread(target=lambda: [put(payload) for payload in payloads], daemon=True)
        sender.start()
        return sender

    sent = [bytes((number,)) for number in range(20)]
    topic = Topic("points", network.link, receive)
    topic.subscribe(ALL, KEYS.all("points"), cached=False)
    senders = [send(sent[0])]
    try:
        arrived.wait(CLOSE_S)
        senders.append(send(*sent[1:]))
        senders[1].join(0.5)
        assert senders[1].is_alive()
        may_go_on.set()
        received.wait(lambda items: len(items) == len(sent), "all messages")
        assert [payload for _, payload, _ in received.items] == sent
    finally:
        may_go_on.set()
        for sender in senders:
            sender.join(CLOSE_S)  # a session is not closed while another thread is in it
        topic.close(CLOSE_S)


def test_a_topic_is_closed_again_while_a_subscription_does_not_return() -> None:
    """The end closes a topic again whose first close is stuck: each subscription is withdrawn once."""
    withdrawn: list[str] = []
    topic = Topic("detections", cast("ZenohSession", SimpleNamespace(ask=None)), lambda _: None)

    def subscriber(name: str) -> Any:
        def close() -> None:
            withdrawn.append(name)
            topic.close(CLOSE_S)  # as from another thread meanwhile

        return SimpleNamespace(close=close)

    topic._subscribers = {name: ("key", subscriber(name)) for name in ("a", "b", "c")}
    topic.close(CLOSE_S)
    assert sorted(withdrawn) == ["a", "b", "c"]

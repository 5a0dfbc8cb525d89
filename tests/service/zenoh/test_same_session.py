"""What the caches, tokens and publishers of a session's own bring: Zenoh calls back on the thread that asks for it.

Each of these is tried on a thread of its own, for a test that fails would wait for ever.
"""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Final

import optipmb_client.zenoh.session
import pytest
from optipmb_client.zenoh.handles import ItemQueue
from optipmb_client.zenoh.session import ZenohSession
from optipmb_schemas import Keys
from optipmb_service.app.configuration import load
from optipmb_service.zenoh.topics import Topic
from optipmb_service.zenoh.transport import Transport
from router import until
from routers import free_endpoint, open_client, open_router

KEYS: Final = Keys()
HANGS_S: Final = 60.0


@pytest.fixture
def session() -> Iterator[ZenohSession]:
    with open_router(free_endpoint()) as session:
        yield ZenohSession(session)


def ends(work: Callable[[], object]) -> None:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(HANGS_S)
    assert not thread.is_alive()


def test_a_question_has_as_many_answers_as_there_are(session: ZenohSession) -> None:
    """The caches of one's own hold more than any channel of Zenoh; messages are sent meanwhile."""
    publishers = [session.cached_sender(KEYS.tracks(f"site/node/{one}"), "", cache=50) for one in range(8)]
    for publisher in publishers:
        for _ in range(50):
            publisher.put(b"x")
    found: list[object] = []
    ends(lambda: found.extend(session.cached(KEYS.all("tracks"), timeout=10.0)))
    assert len(found) == 400
    ends(lambda: publishers[0].put(b"y"))


def test_as_many_tokens_may_be_there_as_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """More may be watched than a channel holds: owners, and the links of a router."""
    monkeypatch.setattr(optipmb_client.zenoh.session, "CHANNEL", 1)
    endpoint = free_endpoint()
    transport = Transport(load(None, {"listen": [endpoint], "instance": "one", "store": "none"}).settings)
    owners: set[str] = set()
    publishers = [transport.open_publisher(f"site/node/{one}") for one in range(20)]
    ends(lambda: transport.watch_owners(lambda stream, _instance, _present: owners.add(stream)))
    until(lambda: len(owners) == len(publishers), "all owners")
    with open_client(endpoint), open_client(endpoint), open_client(endpoint):
        ends(transport.watch)
    ends(transport.close)


def test_a_channel_waits_for_room_only_where_it_is_read() -> None:
    """Before, who fills it is who will read it."""
    channel: ItemQueue[int] = ItemQueue(2)
    ends(lambda: [channel.put(one) for one in range(10)])
    reading = iter(channel)
    assert [next(reading) for _ in range(10)] == list(range(10))
    for one in range(2):
        channel.put(one)
    third = threading.Thread(target=channel.put, args=(2,), daemon=True)
    third.start()
    time.sleep(0.1)
    assert third.is_alive()
    assert [next(reading) for _ in range(3)] == [0, 1, 2]
    third.join(HANGS_S)
    assert not third.is_alive()


def test_subscribing_to_what_is_sent_in_the_same_session_waits_for_no_cache(session: ZenohSession) -> None:
    """A cache answers a new subscription with its lock held; asking it once more from there must not wait for it."""
    received = []
    topic = Topic("detections", session, received.append)

    def subscribe(number: int) -> None:
        key, over = KEYS.detections(f"site/node/{number}"), threading.Event()
        publisher = session.cached_sender(key, "", cache=200)
        for _ in range(100):
            publisher.put(bytes(2000))

        def send() -> None:
            while not over.is_set():
                publisher.put(bytes(2000))

        sending = threading.Thread(target=send, daemon=True)
        sending.start()
        topic.subscribe(str(number), key)
        over.set()
        sending.join(60)
        topic.leave([str(number)])

    ends(lambda: [subscribe(number) for number in range(20)])
    topic.close(HANGS_S)
    assert received

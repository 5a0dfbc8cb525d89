"""The numbers that a Zenoh session has for keys: counted as Zenoh takes them, and never given twice."""

import itertools
from collections.abc import Callable, Iterator

import pytest
import zenoh
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.zenoh.session import CACHED, MOST_KEYS, PLAIN, ZenohSession
from optipmb_service.zenoh.topics import Topic


@pytest.fixture
def session() -> Iterator[ZenohSession]:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    session = ZenohSession(zenoh.open(config))
    yield session
    session.close()
    assert session.key_numbers.open == 0


def _published(session: ZenohSession, key: str) -> Callable[[], object]:
    return session.cached_sender(key, "", cache=1, detected=False).close


def _received(session: ZenohSession, key: str) -> Callable[[], object]:
    topic = Topic("detections", session, lambda _: None)
    topic.subscribe(key, key)
    return lambda: topic.leave([key])


def _received_plainly(session: ZenohSession, key: str) -> Callable[[], object]:
    topic = Topic("points", session, lambda _: None)
    topic.subscribe(key, key, cached=False)
    return lambda: topic.leave([key])


def _known(session: ZenohSession, key: str) -> Callable[[], object]:
    return session.declare_key(key).close


def test_no_number_is_given_twice(session: ZenohSession) -> None:
    """When a session has used up its numbers, nothing is declared, and open subscriptions still deliver.

    Zenoh alone goes on with numbers that are in use, and what these publishers send is lost without an error.
    """
    received: list[bytes] = []
    session.listen("early", lambda sample: received.append(sample.payload.to_bytes()))
    early = session.cached_sender("early", "", cache=1, detected=False)

    def come_and_go() -> None:
        kinds = itertools.chain((_published, _received, _received_plainly, _known) * 500, itertools.repeat(_known))
        for number, declare in zip(range(MOST_KEYS), kinds, strict=False):
            declare(session, f"passing/{number}/lidar")()

    with pytest.raises(TransportError, match=r"6553[45] keys"):
        come_and_go()
    used = session.key_numbers
    assert MOST_KEYS - CACHED < used.declared <= MOST_KEYS
    assert used.open == PLAIN + CACHED
    early.put(b"late")
    assert received == [b"late"]


def test_numbers_are_in_use_until_what_has_them_is_withdrawn(session: ZenohSession) -> None:
    """Withdrawn again, nothing is given back twice; used-up numbers stay so."""
    subscription = session.subscribe("some/**", lambda _: None)
    key = session.declare_key("some/key")
    assert (session.key_numbers.declared, session.key_numbers.open) == (CACHED + PLAIN, CACHED + PLAIN)
    key.close()
    key.close()
    assert session.key_numbers.open == CACHED
    subscription.close()
    assert (session.key_numbers.declared, session.key_numbers.open) == (CACHED + PLAIN, 0)

"""The numbers that a Zenoh session has for keys: counted as Zenoh takes them, and never given twice."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import zenoh
from optipmb_schemas import Detections
from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh import key_numbers
from optipmb_service.zenoh.connection import close
from optipmb_service.zenoh.handles import Publisher, cached_publisher, directly
from optipmb_service.zenoh.inputs import Topic
from optipmb_service.zenoh.key_numbers import CACHED, MOST, PLAIN, DeclaredKey
from optipmb_service.zenoh.subscription import Subscription

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session alone."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    session = zenoh.open(config)
    yield session
    close(session)
    assert key_numbers.used(session).declared == 0


def _published(session: zenoh.Session, key: str) -> Callable[[], object]:
    taken = key_numbers.take(session, CACHED)
    return Publisher(cached_publisher(session, key, Detections, 1, detected=False), (taken,)).release


def _received(session: zenoh.Session, key: str) -> Callable[[], object]:
    topic = Topic("detections", session, lambda _: None)
    topic.subscribe(key, key)
    return lambda: topic.leave([key])


def _received_plainly(session: zenoh.Session, key: str) -> Callable[[], object]:
    topic = Topic("points", session, lambda _: None)
    topic.subscribe(key, key, cached=False)
    return lambda: topic.leave([key])


def _known(session: zenoh.Session, key: str) -> Callable[[], object]:
    return DeclaredKey(session, key).undeclare


@pytest.mark.parametrize("declare", [_published, _received, _received_plainly, _known])
def test_no_number_is_given_twice(
    session: zenoh.Session, declare: Callable[[zenoh.Session, str], Callable[[], object]]
) -> None:
    """Whatever comes and goes: when a session has used up its numbers, nothing is declared, and what is open delivers.

    Zenoh alone goes on with numbers that are in use, and what these publishers send is lost without an error.
    """
    received: list[bytes] = []
    key_numbers.take(session, PLAIN)
    subscriber = session.declare_subscriber(
        "early", directly(lambda sample: received.append(sample.payload.to_bytes()))
    )
    key_numbers.take(session, CACHED)
    early = cached_publisher(session, "early", Detections, 1, detected=False)

    def come_and_go() -> None:
        for number in range(MOST):
            declare(session, f"passing/{number}/lidar")()

    with pytest.raises(TransportError, match="65535 keys"):
        come_and_go()
    used = key_numbers.used(session)
    assert MOST - CACHED < used.declared <= MOST
    assert used.open == PLAIN + CACHED
    early.put(b"late")
    assert received == [b"late"]
    del subscriber


def test_numbers_are_in_use_until_what_has_them_is_withdrawn(session: zenoh.Session) -> None:
    """Withdrawn again, nothing is given back twice; those that are used up stay so."""
    subscription = Subscription(session, "some/**", lambda _: None)
    key = key_numbers.take(session, PLAIN)
    assert (key_numbers.used(session).declared, key_numbers.used(session).open) == (CACHED + PLAIN, CACHED + PLAIN)
    key.undeclare()
    key.undeclare()
    assert key_numbers.used(session).open == CACHED
    subscription.close()
    assert (key_numbers.used(session).declared, key_numbers.used(session).open) == (CACHED + PLAIN, 0)

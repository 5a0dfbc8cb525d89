"""Withdrawal of declarations, while the threads of the network call into Python."""

from collections.abc import Iterator
from typing import Any

import pytest
import zenoh
import zenoh.ext
from optipmb_client.zenoh.session import Session

ROUNDS = 60
"""Where Zenoh's own way is taken, one in ten stops the process, for ten seconds each time."""


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session alone, whose heartbeats come a thousand times a second and are taken in Python."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        Session(session).listen("noise/*/@adv/pub/**", lambda _: None)
        noise = [_publisher(session, f"noise/{number}") for number in range(20)]
        yield session
        noise.clear()


def _publisher(session: zenoh.Session, key: str) -> Any:
    publisher = zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(1),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.001, sporadic_heartbeat=None),
        publisher_detection=True,
    )
    publisher.put(b"what heartbeats tell of")
    return publisher


@pytest.mark.timeout(40)  # six stops take longer
def test_withdrawing_never_stops_the_process(session: zenoh.Session) -> None:
    """A publisher is withdrawn, and with its token, in any state of the network's threads."""
    link = Session(session)
    for number in range(ROUNDS):
        sender = link.cached_sender(f"stream/{number}", "", cache=1)
        sender.put(b"what heartbeats tell of")
        sender.close()
    left = session.liveliness().get("stream/*/@adv/**", timeout=1.0)
    assert [reply for reply in left if reply.ok is not None] == []

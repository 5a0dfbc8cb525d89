"""Withdrawing what was declared, while the threads of the network call into Python."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest
import zenoh
import zenoh.ext
from optipmb_client.zenoh.sender import Sender
from optipmb_schemas import Detections
from optipmb_service.zenoh.handles import Publisher, cached_publisher, directly

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROUNDS = 60
"""Where Zenoh's own way is taken, one in ten stops the process."""

FROZEN_S = 5.0
"""Zenoh gives up after ten seconds."""


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session alone, whose heartbeats come a thousand times a second and are taken in Python."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        taken = session.declare_subscriber("noise/*/@adv/pub/**", directly(lambda _: None))
        noise = [_publisher(session, f"noise/{number}", 0.001) for number in range(20)]
        yield session
        noise.clear()
        del taken


def _publisher(session: zenoh.Session, key: str, heartbeat_s: float) -> Any:
    publisher = zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(1),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=heartbeat_s, sporadic_heartbeat=None),
        publisher_detection=True,
    )
    publisher.put(b"what heartbeats tell of")
    return publisher


def _of_the_service(session: zenoh.Session, key: str) -> Callable[[], None]:
    return Publisher(cached_publisher(session, key, Detections, 1)).release


def _of_the_client(session: zenoh.Session, key: str) -> Callable[[], None]:
    return Sender(_publisher(session, key, 1.0), None).close


@pytest.mark.parametrize("opened", [_of_the_service, _of_the_client])
def test_withdrawing_never_stops_the_process(
    session: zenoh.Session, opened: Callable[[zenoh.Session, str], Callable[[], None]]
) -> None:
    """A publisher is withdrawn at once, and with its token, whatever the threads of the network wait for."""
    for number in range(ROUNDS):
        withdraw = opened(session, f"stream/{number}")
        began = time.monotonic()
        withdraw()
        assert time.monotonic() - began < FROZEN_S
    left = session.liveliness().get("stream/*/@adv/**", timeout=1.0)
    assert [reply for reply in left if reply.ok is not None] == []

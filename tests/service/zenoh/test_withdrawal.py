"""Withdrawal of declarations, while the threads of the network call into Python."""

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh
import zenoh.ext
from fleet import RouterProcess
from optipmb_client import Connection
from optipmb_client.zenoh.configuration import configured
from optipmb_client.zenoh.session import ZenohSession, opened
from router import until

ROUNDS = 60
"""Where Zenoh's own way is taken, one in ten stops the process, for ten seconds each time."""


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session alone, whose heartbeats come a thousand times a second and are taken in Python."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        ZenohSession(session).listen("noise/*/@adv/pub/**", lambda _: None)
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
    link = ZenohSession(session)
    for number in range(ROUNDS):
        sender = link.cached_sender(f"stream/{number}", "", cache=1)
        sender.put(b"what heartbeats tell of")
        sender.close()
    left = session.liveliness().get("stream/*/@adv/**", timeout=1.0)
    assert [reply for reply in left if reply.ok is not None] == []


def test_nothing_withdrawn_while_a_link_is_set_up_stays_at_the_router() -> None:
    """A token that is closed while Zenoh declares all of them to a new router is not there afterwards; the others are.

    Without the wait most of the collected and unsent tokens would stay.
    """
    began, ended = threading.Event(), threading.Event()

    def listen(info: Any) -> tuple[object, object]:
        def on(event: Any, phase: threading.Event) -> None:
            if event.kind == zenoh.SampleKind.PUT:
                phase.set()

        return (
            info.declare_transport_events_listener(zenoh.handlers.Callback(lambda one: on(one, began), indirect=False)),
            info.declare_link_events_listener(zenoh.handlers.Callback(lambda one: on(one, ended), indirect=False)),
        )

    with RouterProcess() as router:
        values = {"mode": "client", "connect/endpoints": [router.endpoint], "connect/timeout_ms": -1}
        zenohs = opened(configured(values))
        session = ZenohSession(zenohs)
        tokens = {f"token/{number}": session.token(f"token/{number}") for number in range(2000)}

        def close_some() -> None:
            assert began.wait(60.0)
            while len(tokens) > 1000:
                tokens.popitem()[1].close()
                if ended.wait(1e-5):  # it may have been before the first
                    break

        router.kill()
        listeners = listen(zenohs.info)
        thread = threading.Thread(target=close_some)
        thread.start()
        router.start()
        thread.join(60.0)
        with Connection(router.endpoint) as observer:
            until(lambda: set(observer.alive("token/*")) == tokens.keys(), "only the open tokens are there", 60.0)
        del listeners
        session.close()

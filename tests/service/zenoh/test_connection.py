"""The Zenoh session of a service: what its configuration makes of publishers and subscribers."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from optipmb_client.zenoh.handles import Sender
from optipmb_client.zenoh.session import ZenohSession
from optipmb_schemas import Keys, Tracks, encoding_of
from optipmb_service.app.configuration import load
from optipmb_service.zenoh.client import Client
from router import until
from routers import free_endpoint, open_client, open_router

KEYS = Keys()
ECHO = "echo"
"""A key where the router itself answers."""


@pytest.fixture
def endpoint() -> Iterator[str]:
    endpoint = free_endpoint()
    with open_router(endpoint, adminspace=True) as router:
        router.declare_queryable(ECHO, lambda query: query.reply(ECHO, b""))
        yield endpoint


@contextlib.contextmanager
def connected(endpoint: str, file: Path | None = None) -> Iterator[Client]:
    given = {"connect": [endpoint], "instance": "member", "store": "none"}
    client = Client(load(None, given | ({} if file is None else {"zenoh_config": str(file)})).settings)
    yield client
    client.close()


def opened_publisher(member: Client, stream: str) -> Sender:
    return member.cached_sender(KEYS.tracks(stream), encoding_of(Tracks), cache=8, detected=False)


def interests(member: Client, asker: zenoh.Session) -> set[str]:
    """The keys in whose subscribers publishers are interested, as the router tells; of heartbeats it tells nothing.

    It has dealt with all that the member declared when it answers that one. A router of Zenoh 1.10 that is asked while
    it deals with a declaration can block for ever.
    """
    assert [answer.ok for answer in member.query(ECHO)] == [True]
    found = [reply.ok for reply in asker.get("@/*/router/publisher/**")]
    return {str(one.key_expr).partition("/publisher/")[2] for one in found if one is not None}


def test_a_router_knows_one_interest_however_many_streams_there_are(endpoint: str, tmp_path: Path) -> None:
    """It compares each subscription with every interest, so these must not grow with the streams' number.

    The interest ends with the last publisher. What a file of Zenoh aggregates more stays aggregated.
    """
    file = tmp_path / "zenoh.json5"
    file.write_text(json.dumps({"aggregation": {"publishers": ["others/**"]}}))
    with connected(endpoint, file) as member, open_client(endpoint) as asker:
        publishers = [opened_publisher(member, f"site/node/lidar{number}") for number in range(5)]
        others = [member.sender(f"others/{number}") for number in range(2)]
        assert interests(member, asker) == {KEYS.all("tracks"), "others/**"}
        for one in others:
            one.close()
        for publisher in publishers[1:]:
            publisher.close()
        assert interests(member, asker) == {KEYS.all("tracks")}
        publishers[0].close()
        assert interests(member, asker) == set()


def test_tracks_come_whichever_publisher_was_declared_first(endpoint: str) -> None:
    """All publishers share the interest: it ends with the last one, and begins again with the next.

    Who subscribes late gets what the cache holds, too.
    """
    with connected(endpoint) as member, open_client(endpoint) as viewer:
        publishers = [opened_publisher(member, f"site/node/lidar{number}") for number in range(3)]

        def heard(number: int, payload: bytes) -> None:
            """A new subscriber of a stream gets a message, sent before it came, and one that is sent after."""
            got: list[bytes] = []
            publishers[number].put(payload)
            key = KEYS.tracks(f"site/node/lidar{number}")
            subscription = ZenohSession(viewer).subscribe(key, lambda arrival: got.append(arrival.payload))
            until(lambda: payload in got, "a message of the cache")
            publishers[number].put(payload + b" and on")
            until(lambda: payload + b" and on" in got, "a message")
            subscription.close()

        heard(0, b"of the first")
        publishers[0].close()
        heard(1, b"of the second")
        publishers[1].close()
        publishers[2].close()
        publishers[1] = opened_publisher(member, "site/node/lidar1")
        heard(1, b"of the first again")

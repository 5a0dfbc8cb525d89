"""Keys that one connection can declare in its life: more are refused, and nothing is lost."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from optipmb_client import Publisher, Subscriber
from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Inbox
from optipmb_client.zenoh import Connection
from optipmb_client.zenoh.handles import Dispatcher, Sender
from optipmb_client.zenoh.session import MOST_KEYS

ALONE: Final = '{mode: "peer", scouting: {delay: 0, multicast: {enabled: false}}, listen: {endpoints: []}}'


def _cached(connection: Connection, key: str) -> Sender:
    return connection.cached_sender(key, "", cache=1)


def _plain(connection: Connection, key: str) -> Sender:
    return connection.plain_sender(key, "")


def _plain_cached(connection: Connection, key: str) -> Sender:
    return connection.plain_sender(key, "", cache=1)


def _subscribed(connection: Connection, key: str) -> Dispatcher:
    return connection.subscribe(key, Inbox(1))


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[Connection]:
    file = tmp_path / "alone.json5"
    file.write_text(ALONE, encoding="utf-8")
    with Connection(config=file) as connection:
        yield connection


def test_what_was_opened_early_is_heard_to_the_last(connection: Connection) -> None:
    """When a connection has declared all keys that it can, the next publisher is refused, and early ones go on.

    Zenoh alone uses numbers again that are in use, and what their publishers send is lost without an error.
    """
    inbox = Inbox(8)
    subscription = connection.subscribe("early", inbox)
    early = connection.cached_sender("early", "", cache=1)

    def come_and_go() -> None:
        kinds = itertools.chain((_cached, _plain, _plain_cached, _subscribed) * 500, itertools.repeat(_plain))
        for number, opened in zip(range(MOST_KEYS), kinds, strict=False):
            opened(connection, f"passing/{number}").close()

    with pytest.raises(ConnectionFailed, match="open another one"):
        come_and_go()
    with pytest.raises(ConnectionFailed, match=r"declared 6553[45] keys"):
        connection.subscribe("late", inbox)
    early.put(b"late")
    arrival = inbox.get(timeout=5.0)
    assert arrival is not None
    assert arrival.payload == b"late"
    subscription.close()


def test_what_needs_more_keys_than_are_left_opens_none(connection: Connection) -> None:
    """A publisher and a subscriber that declare several keys are refused before the first of them is taken."""
    for number in range(MOST_KEYS - 2):
        _plain(connection, f"passing/{number}").close()
    with pytest.raises(ConnectionFailed, match="declared 65533 keys"):
        Subscriber("*/*/*", connection=connection, on_problem=lambda _: None)
    with pytest.raises(ConnectionFailed, match="declared 65533 keys"):
        Publisher("site/node/lidar", connection=connection)
    Subscriber("*/*/*", connection=connection).close()

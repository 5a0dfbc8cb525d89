"""Connections, publishers and subscribers against a real router in the same process."""

import math
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from optipmb_client import ConnectionFailed, Publisher, Subscriber
from optipmb_client.incoming import Inbox
from optipmb_client.links import linked
from optipmb_client.zenoh import DEFAULT_ENDPOINT, Connection
from optipmb_client.zenoh import connection as connecting
from router import until
from routers import free_endpoint, open_client, open_router


@pytest.mark.parametrize(
    "opened",
    [
        lambda address: Connection(address, timeout=0.5),
        lambda address: Publisher("a/b/c", address, timeout=0.5),
        lambda address: Subscriber("a/b/c", address, connect_timeout=0.5),
    ],
    ids=["connection", "publisher", "subscriber"],
)
def test_unreachable_router_is_one_error_within_the_timeout(opened: Callable[[str], object]) -> None:
    """Without a listener, ConnectionFailed names the endpoint after the timeout."""
    address = free_endpoint()
    with pytest.raises(ConnectionFailed, match=address) as caught:
        opened(address)
    assert caught.value.endpoints == (address,)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("endpoint", ["nonsense", ""])
def test_an_endpoint_that_is_none_is_the_same_error(endpoint: str) -> None:
    """A malformed endpoint is refused at once, with an example of a good one."""
    with pytest.raises(ConnectionFailed, match=re.escape(DEFAULT_ENDPOINT)):
        Connection([endpoint], timeout=5.0)


def test_a_missing_configuration_file_is_the_same_error(tmp_path: object) -> None:
    """A configuration file that is not there is named."""
    with pytest.raises(ConnectionFailed, match=r"no Zenoh configuration file at .*absent"):
        Connection(config=f"{tmp_path}/absent.json5")


def test_a_configuration_with_an_id_is_refused(tmp_path: Path) -> None:
    """A program that starts again with the Zenoh id of its last run would not be heard: the error names file and id."""
    file = tmp_path / "zenoh.json5"
    file.write_text('{id: "ab12", mode: "client"}')
    with pytest.raises(ConnectionFailed, match=r'zenoh\.json5: id: expected none, received "ab12".*remove it'):
        Connection(free_endpoint(), config=file)


@pytest.mark.parametrize("timeout", [math.nan, -1.0])
@pytest.mark.parametrize("scheme", ["tcp/", "grpc://"])
def test_a_timeout_that_is_none_is_one_error(timeout: float, scheme: str) -> None:
    """An invalid timeout raises ConnectionFailed with the expected values, over Zenoh and over gRPC."""
    with pytest.raises(ConnectionFailed, match=f"timeout: expected seconds, 0 or more, received {timeout}"):
        linked(f"{scheme}127.0.0.1:1", timeout=timeout)


def test_a_connection_may_wait_for_ever(endpoint: str) -> None:
    """With an infinite timeout a connection opens; it has a router when it is open."""
    with Connection(endpoint, timeout=math.inf) as connection:
        assert connection._session.linked()


def test_an_interrupt_ends_the_wait_for_a_router() -> None:
    """Ctrl-C raises KeyboardInterrupt in a connection that waits for ever."""
    main = threading.get_ident()

    def interrupt() -> None:
        until(lambda: any(one.name == "open" for one in threading.enumerate()), "waiting")
        signal.pthread_kill(main, signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        Connection(free_endpoint(), timeout=math.inf)


def test_a_router_that_comes_later_within_the_timeout_is_waited_for() -> None:
    """Opening a connection before its router is no error when the router comes in time."""
    address = free_endpoint()
    opened: list[zenoh.Session] = []
    timer = threading.Timer(0.4, lambda: opened.append(open_router(address)))
    timer.start()
    try:
        with Connection(address, timeout=60.0) as connection:
            assert not connection.closed
            assert connection._session.linked()
    finally:
        timer.join(60)
        opened[0].close()


def test_what_is_sent_just_before_closing_arrives(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing a connection flushes: the last small and the last large message are both received."""
    # A large message that finds no room within half a second is dropped, whether or not the connection closes.
    drop = "transport/link/tx/queue/congestion_control/drop"
    longer = {f"{drop}/wait_before_drop": 30_000_000, f"{drop}/max_wait_before_drop_fragments": 30_000_000}
    monkeypatch.setattr(connecting, "BUSY", {**connecting.BUSY, **longer})
    inbox = Inbox(10)
    with Connection(endpoint) as receiver:
        receiver.subscribe("a/*", inbox)
        with Connection(endpoint) as sender:
            large = sender.plain_sender("a/large", "zenoh/bytes")
            deadline = time.monotonic() + 60.0
            while not large.wanted and time.monotonic() < deadline:
                time.sleep(0.01)  # the subscription is on its way to this session; there is no event for it
            large.put(bytes(1_900_000))
            sender.cached_sender("a/small", "zenoh/bytes", cache=10).put(b"x")
        arrivals = [inbox.get(60.0), inbox.get(60.0)]
    assert {arrival.key: len(arrival.payload) for arrival in arrivals if arrival} == {
        "a/large": 1_900_000,
        "a/small": 1,
    }


def test_what_a_publisher_sent_before_its_first_sample_came_is_not_lost(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A subscription to live messages only still receives the publisher's earlier messages first."""
    monkeypatch.setattr(zenoh.ext, "declare_advanced_subscriber", plain_subscriber)
    inbox = Inbox(10_000)
    with Connection(endpoint) as sender, Connection(endpoint) as receiver:
        small = sender.cached_sender("a/small", "zenoh/bytes", cache=1000)
        for number in range(5):
            small.put(b"%d" % number)
        receiver.subscribe("a/*", inbox)
        sent, deadline = 5, time.monotonic() + 60.0
        while inbox.pending < sent and time.monotonic() < deadline:
            small.put(b"%d" % sent)
            sent += 1
            time.sleep(0.05)  # the subscription is on its way to the publisher; there is no event for it
        received = [inbox.get(60.0) for _ in range(sent)]
    assert [arrival.payload for arrival in received if arrival] == [b"%d" % number for number in range(sent)]


def plain_subscriber(session: zenoh.Session, key: str, handler: Any, **_: object) -> Any:
    return session.declare_subscriber(key, handler)


def test_an_unread_inbox_neither_blocks_the_publisher_nor_the_closing(endpoint: str) -> None:
    """A reader that never reads costs its own oldest messages only: puts and closing end, drops are counted."""
    inbox = Inbox(10)
    with Connection(endpoint) as sender:
        receiver = Connection(endpoint)
        receiver.subscribe("a/*", inbox)
        small = sender.cached_sender("a/small", "zenoh/bytes", cache=1)
        deadline, number = time.monotonic() + 60.0, 0
        while inbox.dropped < 1000 and time.monotonic() < deadline:
            small.put(b"%d" % number)
            number += 1
        receiver.close()
    assert inbox.pending == 10
    assert inbox.dropped >= 1000


def test_nothing_arrives_after_closing(endpoint: str) -> None:
    """Closing a connection leaves its inboxes unchanged, also while queries are pending."""
    for _ in range(5):
        inbox = Inbox(100_000)
        with Connection(endpoint) as sender:
            receiver = Connection(endpoint)
            receiver.subscribe("a/*", inbox)
            small = sender.cached_sender("a/small", "zenoh/bytes", cache=1)
            for number in range(3000):
                small.put(b"%d" % number)
            receiver.close()
            assert receiver.closed
            received = inbox.pending
        assert inbox.pending == received


def test_a_closed_connection_is_one_clear_error(endpoint: str) -> None:
    """Every call on a closed connection raises ConnectionFailed in one line; closing again does nothing."""
    connection = Connection(endpoint)
    sender = connection.cached_sender("a/b", "zenoh/bytes", cache=1)
    connection.close()
    connection.close()
    attempts: list[Callable[[], object]] = [
        lambda: connection.cached_sender("a/b", "zenoh/bytes", cache=1),
        lambda: connection.plain_sender("a/b", "zenoh/bytes"),
        lambda: connection.subscribe("a/b", Inbox(1)),
        lambda: connection.query("a/b"),
        lambda: connection.alive("a/b"),
        lambda: sender.put(b""),
    ]
    for attempt in attempts:
        with pytest.raises(ConnectionFailed) as caught:
            attempt()
        assert "\n" not in str(caught.value)
        assert ".rs" not in str(caught.value)


def test_a_query_nobody_serves_has_no_answers(endpoint: str) -> None:
    """No service: no answers, at once, no error."""
    with Connection(endpoint) as connection:
        assert connection.query("nobody/here", timeout=5.0) == ()
        assert connection.alive("nobody/*") == ()


def test_replies_and_error_replies_are_told_apart(endpoint: str) -> None:
    """A reply and an error reply both come back, with their encodings."""
    with Connection(endpoint) as connection, open_client(endpoint) as server:
        ready = server.declare_queryable("q/x", zenoh.handlers.FifoChannel(10))

        def serve() -> None:
            for query in ready:
                with query:
                    if query.payload is None:
                        query.reply(query.key_expr, b"fine", encoding="application/msgpack;optipmb.SessionState.v1")
                    else:
                        query.reply_err(b"no", encoding="application/msgpack;optipmb.Problem.v1")

        threading.Thread(target=serve, daemon=True).start()
        deadline = time.monotonic() + 60.0
        while not (good := connection.query("q/x")) and time.monotonic() < deadline:
            pass
        (bad,) = connection.query("q/x", b"payload", "application/msgpack;optipmb.ResetRequest.v1")
    assert [(answer.ok, answer.payload) for answer in good] == [(True, b"fine")]
    assert (bad.ok, bad.payload, bad.encoding) == (False, b"no", "application/msgpack;optipmb.Problem.v1")


def test_replies_of_two_services_are_both_kept(endpoint: str) -> None:
    """Two that answer at the same key give two answers."""
    with Connection(endpoint) as connection, open_client(endpoint) as one, open_client(endpoint) as two:
        for name, server in ((b"one", one), (b"two", two)):
            questions = server.declare_queryable("q/x", zenoh.handlers.FifoChannel(10))
            threading.Thread(target=answer_with, args=(questions, name), daemon=True).start()
        deadline = time.monotonic() + 60.0
        while len(answers := connection.query("q/x")) < 2 and time.monotonic() < deadline:
            pass
    assert {answer.payload for answer in answers} == {b"one", b"two"}


def answer_with(questions: Iterable[zenoh.Query], text: bytes) -> None:
    for query in questions:
        with query:
            query.reply(query.key_expr, text)


FORGETFUL = """
import sys
from optipmb_client.incoming import Inbox
from optipmb_client.zenoh import Connection
connection = Connection(sys.argv[1])
connection.subscribe("a/*", Inbox(10))
connection.cached_sender("a/b", "zenoh/bytes", cache=10).put(b"last words")
"""


def test_a_program_that_forgets_to_close_ends_and_loses_nothing(endpoint: str) -> None:
    """A process with an open connection, subscription and publisher exits by itself; its last message is delivered."""
    inbox = Inbox(10)
    with Connection(endpoint) as receiver:
        receiver.subscribe("a/*", inbox)
        subprocess.run([sys.executable, "-c", FORGETFUL, endpoint], timeout=60, check=True)
        arrival = inbox.get(60.0)
    assert arrival is not None
    assert arrival.payload == b"last words"

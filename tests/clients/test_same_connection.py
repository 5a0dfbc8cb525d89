"""What publishers of a connection's own have cached: Zenoh brings it on the thread that asks for it, before it returns.

Each is tried in a process of its own, for one that hangs could not be ended from within.
"""

import subprocess
import sys

import pytest

HANGS_S = 60.0

SETTING = """
import sys
from optipmb_client.incoming import Inbox
from optipmb_client.zenoh import Connection
connection, inbox = Connection(sys.argv[1]), Inbox(10_000)
"""

SUBSCRIBE = """
sender = connection.cached_sender("a/b", "zenoh/bytes", cache=6000)
for number in range(5000):
    sender.put(b"%d" % number)
connection.subscribe("a/*", inbox)
sender.put(b"5000")
assert sorted(int(inbox.get(30.0).payload) for _ in range(5001)) == list(range(5001))
"""
"""Far more than any channel of Zenoh or of ours has room for. Where a heartbeat of the publisher falls into the
answer, Zenoh leaves out its beginning, and more than `late_join.MAX_WAITING` messages do not wait for that."""

QUERY = """
sender = connection.cached_sender("a/b", "zenoh/bytes", cache=5000)
for number in range(5000):
    sender.put(b"%d" % number)
answers = connection.query("a/b/@adv/**?_anyke", timeout=30.0)
assert sorted(int(answer.payload) for answer in answers) == list(range(5000))
sender.put(b"the lock of the cache is free")
"""

ALIVE = """
senders = [connection.cached_sender(f"a/{number}", "zenoh/bytes", cache=1) for number in range(400)]
assert len(connection.alive("a/*/@adv/**", timeout=30.0)) == 400
"""

CLOSE = """
connection.close()
assert connection.closed
"""


def ends(script: str, endpoint: str) -> None:
    """Run something that could wait for ever, and close the connection after it."""
    subprocess.run([sys.executable, "-c", SETTING + script + CLOSE, endpoint], timeout=HANGS_S, check=True)


def test_a_subscription_gets_all_that_the_same_connection_has_cached(endpoint: str) -> None:
    """However much the connection's publishers have cached, a subscription begins, and gets it."""
    ends(SUBSCRIBE, endpoint)


@pytest.mark.parametrize("script", [QUERY, ALIVE], ids=["query", "alive"])
def test_a_question_has_as_many_answers_as_the_same_connection_gives(script: str, endpoint: str) -> None:
    """However many messages or tokens of its own a connection asks for, it gets all of them."""
    ends(script, endpoint)


def test_a_program_that_forgets_to_close_ends_after_such_a_subscription(endpoint: str) -> None:
    """The receiving thread does not keep a program from ending."""
    subprocess.run([sys.executable, "-c", SETTING + SUBSCRIBE, endpoint], timeout=HANGS_S, check=True)

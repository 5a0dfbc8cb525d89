"""Repeated queries for the densities of streams, during a subscription to their tracks."""

import threading
import time
from typing import Final, Self

from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.zenoh import Connection
from optipmb_schemas import PREFIX, Keys

PERIOD_S: Final = 0.5
TIMEOUT_S: Final = 1.0


class DensityQueries:
    """Queries, on a thread of its own, the density of every stream that has had tracks since the last query.

    Answers go into an inbox, among the messages that were subscribed to; errors are left out. A stream is asked twice a
    second at most, and not at all while it is silent. So a service that is slow to answer delays neither tracks nor
    their reader.

    Args:
        connection: Where to ask; closed by the caller, after this.
        inbox: Where answers go, by the key of the query.
        prefix: Of the keys.
    """

    def __init__(self, connection: Connection, inbox: Inbox, prefix: str = PREFIX) -> None:
        self._connection = connection
        self._inbox = inbox
        self._keys = Keys(prefix)
        self._due: set[str] = set()
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="densities", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(2 * TIMEOUT_S)

    def note(self, stream: str) -> None:
        """Say that a stream has new tracks; never waits."""
        with self._lock:
            self._due.add(stream)

    def _run(self) -> None:
        while not self._over.wait(PERIOD_S):
            with self._lock:
                due, self._due = self._due, set()
            for stream in sorted(due):
                if self._over.is_set():
                    return
                self._ask(self._keys.query(stream, "density"))

    def _ask(self, key: str) -> None:
        try:
            answers = self._connection.query(key, timeout=TIMEOUT_S)
        except ConnectionFailed:
            return  # the connection is being closed, or links again
        for answer in answers:
            if answer.ok:
                self._inbox.put(Arrival(answer.key, answer.payload, answer.encoding, time.monotonic_ns()))

"""Where checkpoints are kept: a small protocol, a SQLite file by default, a dictionary for tests.

A store holds bytes and knows nothing of what they mean. It keeps the newest two checkpoints of every stream: when the
newest turns out to be torn, it is set aside (kept for whoever wants to know why, never deleted by the way) and the one
before it is the newest again.

Several processes share one store: those that track, and one that stands by. A process that was frozen and wakes up
must not write over what its successor has saved since, so a stream belongs to the process that claimed it last, and
what another one saves for it is not written.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping
    from pathlib import Path

KEPT: Final = 2
"""Checkpoints kept per stream."""

ASIDE: Final = 64
"""Torn checkpoints kept in all; beyond it the oldest go."""

BUSY_S: Final = 5.0
"""How long a transaction waits for those of other processes; each takes milliseconds."""


class StoreError(Exception):
    """The store cannot do what was asked: full, read-only, locked, not there. Tracking goes on without it."""


class Store(Protocol):
    """What a session's state is written to. Any thread may call; every method may raise `StoreError`."""

    @property
    def max_bytes(self) -> int:
        """Bytes that a checkpoint may have."""

    def claim(self, streams: Collection[str]) -> None:
        """Make streams this process's own, and no longer another's."""

    def save(self, checkpoints: Mapping[str, bytes]) -> frozenset[str]:
        """Write the newest checkpoint of each stream, all of them or none.

        Returns:
            The streams that another process has claimed since; theirs were not written.
        """

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""

    def expire(self, age_s: float) -> int:
        """Forget the streams of which nothing was saved for so long; returns how many."""

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""

    def close(self) -> None:
        """Free what the store holds; may be called twice."""


_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS checkpoints (
    stream TEXT NOT NULL, number INTEGER NOT NULL, data BLOB NOT NULL, PRIMARY KEY (stream, number)
);
CREATE TABLE IF NOT EXISTS aside (
    number INTEGER PRIMARY KEY, stream TEXT NOT NULL, reason TEXT NOT NULL, data BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS owners (stream TEXT PRIMARY KEY, owner TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS written (stream TEXT PRIMARY KEY, at REAL NOT NULL);
"""

_NEWEST: Final = "SELECT data FROM checkpoints WHERE stream = ? ORDER BY number DESC LIMIT 1"


class SqliteStore:
    """A file with all checkpoints.

    The journal is a write-ahead log, so that readers never wait for the writer. `synchronous = NORMAL` suffices: what a
    killed process has committed is in the log and stays, the file is whole after a power cut too, which may only cost
    the last transactions; the publishers' caches give those frames again. Syncing every transaction would cost several
    milliseconds of disk time each second for nothing else.

    Args:
        path: the file; made when it is not there.
        owner: who this process is, for `claim`.
        clock: seconds since 1970.

    Raises:
        StoreError: it cannot be opened, or is no such file.
    """

    max_bytes: Final = 1_000_000_000  # SQLite's own limit

    def __init__(self, path: Path, owner: str = "", clock: Callable[[], float] = time.time) -> None:
        self._path = path
        self._clock = clock
        self._owner = owner
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        try:
            self._connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = NORMAL")
            self._connection.execute(f"PRAGMA journal_size_limit = {64 * 2**20}")
            self._connection.executescript(_SCHEMA)
        except sqlite3.Error as error:
            self.close()
            raise StoreError(f"{path}: {error}") from error

    def claim(self, streams: Collection[str]) -> None:
        """Make streams this process's own, and no longer another's."""
        with self._transaction() as connection:
            rows = [(stream, self._owner) for stream in streams]
            connection.executemany("INSERT OR REPLACE INTO owners VALUES (?, ?)", rows)

    def save(self, checkpoints: Mapping[str, bytes]) -> frozenset[str]:
        """Write the newest checkpoint of each stream in one transaction; returns those that belong to another."""
        lost: set[str] = set()
        with self._transaction() as connection:
            for stream, data in checkpoints.items():
                owner = connection.execute("SELECT owner FROM owners WHERE stream = ?", (stream,)).fetchone()
                if owner is not None and owner[0] != self._owner:
                    lost.add(stream)
                    continue
                (last,) = connection.execute(
                    "SELECT coalesce(max(number), 0) FROM checkpoints WHERE stream = ?", (stream,)
                ).fetchone()
                connection.execute("INSERT INTO checkpoints VALUES (?, ?, ?)", (stream, last + 1, data))
                connection.execute("INSERT OR REPLACE INTO written VALUES (?, ?)", (stream, self._clock()))
                connection.execute(
                    "DELETE FROM checkpoints WHERE stream = ? AND number <= ?", (stream, last + 1 - KEPT)
                )
        return frozenset(lost)

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""
        with self._use() as connection:
            row = connection.execute(_NEWEST, (stream,)).fetchone()
        return None if row is None else bytes(row[0])

    def streams(self) -> tuple[str, ...]:
        """Return the streams that have a checkpoint, by name."""
        with self._use() as connection:
            rows = connection.execute("SELECT DISTINCT stream FROM checkpoints ORDER BY stream").fetchall()
        return tuple(row[0] for row in rows)

    def expire(self, age_s: float) -> int:
        """Forget the streams of which nothing was saved for so long; one of an earlier version counts from now."""
        now_s = self._clock()
        old = "(SELECT stream FROM written WHERE at < ?)"
        with self._transaction() as connection:
            connection.execute("INSERT OR IGNORE INTO written SELECT DISTINCT stream, ? FROM checkpoints", (now_s,))
            for table in ("checkpoints", "owners"):
                connection.execute(f"DELETE FROM {table} WHERE stream IN {old}", (now_s - age_s,))  # noqa: S608 - constants
            return connection.execute("DELETE FROM written WHERE at < ?", (now_s - age_s,)).rowcount

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""
        with self._transaction() as connection:
            newest = "stream = ? AND number = (SELECT max(number) FROM checkpoints WHERE stream = ?)"
            connection.execute(
                f"INSERT INTO aside (stream, reason, data) SELECT stream, ?, data FROM checkpoints WHERE {newest}",  # noqa: S608 - a constant
                (reason, stream, stream),
            )
            connection.execute(f"DELETE FROM checkpoints WHERE {newest}", (stream, stream))  # noqa: S608 - a constant
            connection.execute("DELETE FROM aside WHERE number <= (SELECT max(number) FROM aside) - ?", (ASIDE,))

    def aside(self) -> list[tuple[str, str, bytes]]:
        """Return stream, reason and bytes of what was set aside, the oldest first."""
        with self._use() as connection:
            rows = connection.execute("SELECT stream, reason, data FROM aside ORDER BY number").fetchall()
        return [(stream, reason, bytes(data)) for stream, reason, data in rows]

    def delete(self, stream: str) -> None:
        """Forget the checkpoints of a stream; those set aside stay."""
        with self._transaction() as connection:
            connection.execute("DELETE FROM checkpoints WHERE stream = ?", (stream,))
            connection.execute("DELETE FROM owners WHERE stream = ? AND owner = ?", (stream, self._owner))

    def close(self) -> None:
        """Close the file; may be called twice."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    @contextmanager
    def _use(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._connection is None:
                raise StoreError(f"{self._path}: closed")
            try:
                yield self._connection
            except sqlite3.Error as error:
                raise StoreError(f"{self._path}: {error}") from error

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """Do all of it or nothing; the write lock is taken first, so that no reader has to become a writer halfway."""
        with self._use() as connection:
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                # A full disk may have rolled it back already.
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise


class MemoryStore:
    """The same in memory, for tests.

    Args:
        owner: who claims and saves; stores that share `shared` are those of several processes.
        shared: the contents.
    """

    max_bytes: Final = 1_000_000_000

    def __init__(self, owner: str = "", shared: MemoryStore | None = None) -> None:
        self._owner = owner
        self._kept: dict[str, list[bytes]] = shared._kept if shared else {}  # noqa: SLF001 - its own class
        self._owners: dict[str, str] = shared._owners if shared else {}  # noqa: SLF001 - its own class
        self._aside: list[tuple[str, str, bytes]] = shared._aside if shared else []  # noqa: SLF001 - its own class

    def claim(self, streams: Collection[str]) -> None:
        """Make streams this process's own."""
        self._owners.update(dict.fromkeys(streams, self._owner))

    def save(self, checkpoints: Mapping[str, bytes]) -> frozenset[str]:
        """Keep the newest checkpoint of each stream; returns those that belong to another."""
        lost = {stream for stream in checkpoints if self._owners.get(stream, self._owner) != self._owner}
        for stream, data in checkpoints.items():
            if stream not in lost:
                self._kept[stream] = [*self._kept.get(stream, []), data][-KEPT:]
        return frozenset(lost)

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream."""
        kept = self._kept.get(stream)
        return kept[-1] if kept else None

    def streams(self) -> tuple[str, ...]:
        """Return the streams that have a checkpoint."""
        return tuple(sorted(stream for stream, kept in self._kept.copy().items() if kept))

    def expire(self, age_s: float) -> int:
        """Keep all: it does not outlive its process."""
        del age_s
        return 0

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside."""
        if kept := self._kept.get(stream):
            self._aside.append((stream, reason, kept.pop()))
            del self._aside[:-ASIDE]

    def aside(self) -> list[tuple[str, str, bytes]]:
        """Return stream, reason and bytes of what was set aside."""
        return list(self._aside)

    def delete(self, stream: str) -> None:
        """Forget the checkpoints of a stream."""
        self._kept.pop(stream, None)
        if self._owners.get(stream) == self._owner:
            del self._owners[stream]

    def close(self) -> None:
        """Nothing is held."""


_T = TypeVar("_T")


def load_newest(
    store: Store, stream: str, read: Callable[[bytes], _T], torn: type[Exception], on_torn: Callable[[str], None]
) -> _T | None:
    """Return the newest checkpoint of a stream that can be read; what cannot is set aside.

    Args:
        store: where to look.
        stream: whose.
        read: makes the checkpoint of the bytes.
        torn: what `read` raises.
        on_torn: told why, each time.

    Raises:
        StoreError: the store cannot be read.
    """
    while (data := store.load(stream)) is not None:
        try:
            return read(data)
        except torn as error:
            on_torn(str(error))
            store.set_aside(stream, str(error))
    return None

"""Leases and checkpoints in two SQLite files, for the processes of one machine; implements `store.LeaseStore`.

A renewal must not wait for a disk: a member that cannot renew for a lease loses its partitions. So the records have a
file of their own, which is never synced, and a connection that nothing else uses. What a power cut may do to that file
costs nothing: no member survives it. A damaged one is replaced when nobody uses it.

The other file has the checkpoints. Its journal is a write-ahead log, so that readers never wait for the writer, and
`synchronous = NORMAL` suffices: what a killed process has committed is in the log and stays, the file is whole after a
power cut too, which may only cost the last transactions; the publishers' caches give those frames again. Syncing every
transaction would cost several milliseconds of disk time each second for nothing else. Much is written in transactions
of a bounded size, so that other processes have their turn.

`sqlite_file` opens such a file. Beside the two is the folder of the locks of members (`member_locks`).
"""

from __future__ import annotations

import fcntl
import os
import time
from itertools import islice
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.cluster.member_locks import MEMBERS, MemberLocks, in_use
from optipmb_service.cluster.sqlite_file import Database, is_damaged
from optipmb_service.cluster.store import ENDED, KEPT, Fenced, Record, StoreError, Write

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

log = structlog.get_logger("optipmb_service")

ASIDE: Final = 64
"""Torn checkpoints kept in all; beyond it the oldest go."""

LEASES: Final = "leases.db"
"""File of the records."""

ENDED_KEPT: Final = 64
"""Records of ended members that are kept; who has followed none of the later ones was ended itself."""

SLICE: Final = 64
"""Streams of one transaction."""

SLICE_BYTES: Final = 4 * 2**20
"""Bytes of checkpoints of one transaction; one checkpoint may have more."""

PAGE_BYTES: Final = 32768
"""Pages of the file of the checkpoints, each of which has tens of thousands of bytes."""

_RECORDS: Final = """
CREATE TABLE IF NOT EXISTS records (key TEXT PRIMARY KEY, value TEXT NOT NULL, revision INTEGER NOT NULL) WITHOUT ROWID;
"""
_CHECKPOINTS: Final = """
CREATE TABLE IF NOT EXISTS checkpoints (
    stream TEXT NOT NULL, number INTEGER NOT NULL, data BLOB NOT NULL, PRIMARY KEY (stream, number)
);
CREATE TABLE IF NOT EXISTS aside (
    number INTEGER PRIMARY KEY, stream TEXT NOT NULL, reason TEXT NOT NULL, data BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS written (stream TEXT PRIMARY KEY, at REAL NOT NULL);
DROP TABLE IF EXISTS records;
"""

_OLD_MEMBERS: Final = """
DELETE FROM records WHERE key LIKE 'member/%' AND value = 'ended' AND revision <= (
    SELECT revision FROM records WHERE key LIKE 'member/%' AND value = 'ended' ORDER BY revision DESC LIMIT 1 OFFSET ?
)
"""
_NEWEST: Final = "SELECT data FROM checkpoints WHERE stream = ? ORDER BY number DESC LIMIT 1"
_SILENT: Final = "SELECT stream FROM written WHERE at < ? LIMIT ?"


class SqliteStore:
    """The leases and checkpoints of the processes of one machine.

    Args:
        path: the file of the checkpoints; the other one and the folder are beside it, and all are made when they are
            not there. None: in memory, for one process alone.
        clock: seconds since 1970.

    Raises:
        StoreError: it cannot be opened or written, or is no such file.
    """

    max_bytes: Final = 1_000_000_000  # SQLite's own limit
    remote: Final = False

    def __init__(self, path: Path | None, clock: Callable[[], float] = time.time) -> None:
        self._locks = MemberLocks(None if path is None else path.with_name(MEMBERS))
        self._clock = clock
        self._checkpoints = Database(path, _CHECKPOINTS, "NORMAL", PAGE_BYTES)
        try:
            self._leases = (
                Database(None, _RECORDS, "OFF") if path is None else _leases_beside(path, self._locks.restore)
            )
        except StoreError:
            self._checkpoints.close()
            raise

    def follow(self, after: int) -> list[Record]:
        """Return the newest record of each key that changed after a revision, by revision."""
        with self._leases.use() as connection:
            rows = connection.execute("SELECT * FROM records WHERE revision > ? ORDER BY revision", (after,)).fetchall()
        return [Record(*row) for row in rows]

    def get(self, key: str) -> Record | None:
        """Return the newest record of a key; None without one."""
        with self._leases.use() as connection:
            row = connection.execute("SELECT * FROM records WHERE key = ?", (key,)).fetchone()
        return None if row is None else Record(*row)

    def put(self, write: Write) -> int | None:
        """Write a record; return its revision, None when the one to be replaced is not the newest.

        With its first record a member takes its lock, and with its last one it, or whoever ends it, removes that.
        """
        kind, _, name = write.key.partition("/")
        begins = kind == "member" and write.over == 0 and write.value != ENDED
        if begins:
            self._locks.take(name)
        with self._leases.transaction() as connection:
            row = connection.execute("SELECT revision FROM records WHERE key = ?", (write.key,)).fetchone()
            if (row[0] if row else 0) != write.over:
                return None
            (last,) = connection.execute("SELECT coalesce(max(revision), 0) FROM records").fetchone()
            connection.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?)", (write.key, write.value, last + 1))
            if begins:
                connection.execute(_OLD_MEMBERS, (ENDED_KEPT,))
        if kind == "member" and write.value == ENDED:
            self._locks.leave(name)
        return int(last) + 1

    def gone(self, member: str) -> bool:
        """Whether nobody holds the lock of a member. A file that is missing says nothing about its process."""
        return self._locks.is_free(member)

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams, some in a transaction; return those that were refused.

        The fence is read when nobody else can write a checkpoint, and a successor reads one only so (`load`): either it
        reads what is written here, or its fence is found here.
        """
        refused: set[str] = set()
        left = iter(checkpoints.items())
        while some := _some(left):
            with self._checkpoints.transaction() as connection:
                fences = self._fences({one.lease for _, one in some})
                for stream, one in some:
                    if fences.get(one.lease) == one.fence:
                        self._write(connection, stream, one.data)
                    else:
                        refused.add(stream)
        return frozenset(refused)

    def _fences(self, keys: set[str]) -> dict[str, int]:
        with self._leases.use() as connection:
            marks = ",".join("?" * len(keys))
            query = f"SELECT key, revision FROM records WHERE key IN ({marks})"  # noqa: S608 - question marks
            return dict(connection.execute(query, tuple(keys)).fetchall())

    def _write(self, connection: sqlite3.Connection, stream: str, data: bytes) -> None:
        (last,) = connection.execute(
            "SELECT coalesce(max(number), 0) FROM checkpoints WHERE stream = ?", (stream,)
        ).fetchone()
        connection.execute("INSERT INTO checkpoints VALUES (?, ?, ?)", (stream, last + 1, data))
        connection.execute("INSERT OR REPLACE INTO written VALUES (?, ?)", (stream, self._clock()))
        connection.execute("DELETE FROM checkpoints WHERE stream = ? AND number <= ?", (stream, last + 1 - KEPT))

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one; what a predecessor still writes is waited for."""
        with self._checkpoints.transaction() as connection:
            row = connection.execute(_NEWEST, (stream,)).fetchone()
        return None if row is None else bytes(row[0])

    def streams(self) -> tuple[str, ...]:
        """Return the streams that have a checkpoint, by name."""
        with self._checkpoints.use() as connection:
            rows = connection.execute("SELECT DISTINCT stream FROM checkpoints ORDER BY stream").fetchall()
        return tuple(row[0] for row in rows)

    def expire(self, age_s: float) -> int:
        """Forget some streams of which nothing was saved for so long; one of an earlier version counts from now."""
        now_s = self._clock()
        with self._checkpoints.transaction() as connection:
            connection.execute("INSERT OR IGNORE INTO written SELECT DISTINCT stream, ? FROM checkpoints", (now_s,))
            old = connection.execute(_SILENT, (now_s - age_s, SLICE)).fetchall()
            connection.executemany("DELETE FROM checkpoints WHERE stream = ?", old)
            connection.executemany("DELETE FROM written WHERE stream = ?", old)
        return len(old)

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""
        with self._checkpoints.transaction() as connection:
            newest = "stream = ? AND number = (SELECT max(number) FROM checkpoints WHERE stream = ?)"
            connection.execute(
                f"INSERT INTO aside (stream, reason, data) SELECT stream, ?, data FROM checkpoints WHERE {newest}",  # noqa: S608 - a constant
                (reason, stream, stream),
            )
            connection.execute(f"DELETE FROM checkpoints WHERE {newest}", (stream, stream))  # noqa: S608 - a constant
            connection.execute("DELETE FROM aside WHERE number <= (SELECT max(number) FROM aside) - ?", (ASIDE,))

    def aside(self) -> list[tuple[str, str, bytes]]:
        """Return stream, reason and bytes of what was set aside, the oldest first."""
        with self._checkpoints.use() as connection:
            rows = connection.execute("SELECT stream, reason, data FROM aside ORDER BY number").fetchall()
        return [(stream, reason, bytes(data)) for stream, reason, data in rows]

    def close(self, timeout: float = 1.0) -> None:
        """Close the files; may be called twice."""
        self._checkpoints.close(timeout / 2)
        self._leases.close(timeout / 2)
        self._locks.close()


def _some(left: Iterator[tuple[str, Fenced]]) -> list[tuple[str, Fenced]]:
    """Take as many checkpoints as one transaction may have."""
    some: list[tuple[str, Fenced]] = []
    size = 0
    for one in islice(left, SLICE):
        some.append(one)
        size += len(one[1].data)
        if size >= SLICE_BYTES:
            break
    return some


def _leases_beside(path: Path, restored: Callable[[], None]) -> Database:
    """Open the file of the records; one that is damaged is made anew when no member uses it.

    Raises:
        StoreError: it cannot be opened or written.
    """
    file, members = path.with_name(LEASES), path.with_name(MEMBERS)
    try:
        members.mkdir(exist_ok=True)
        folder = os.open(members, os.O_RDONLY)
    except OSError as error:
        raise StoreError(f"{members}: {error}") from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)  # of two that begin, one looks and replaces
        if is_damaged(file) and not in_use(path):
            log.warning("leases_damaged", file=str(file))
            for one in (file, *(file.with_name(f"{LEASES}{end}") for end in ("-wal", "-shm"))):
                one.unlink(missing_ok=True)
        return Database(file, _RECORDS, "OFF", restored=restored)
    except OSError as error:
        raise StoreError(f"{file}: {error}") from error
    finally:
        os.close(folder)

"""Leases and checkpoints in two SQLite files, for the processes of one machine; implements `store.LeaseStore`.

A renewal must not wait for a disk: a member that cannot renew for a lease loses its partitions. So the records have a
file of their own, which is never synced, and a connection that nothing else uses. What a power cut may do to that file
costs nothing: no member survives it. A damaged one is replaced when it is not in use.

The other file has the checkpoints. Its journal is a write-ahead log, so that readers never wait for the writer, and
`synchronous = NORMAL` suffices: what a killed process has committed is in the log and stays, the file is whole after a
power cut too, which may only cost the last transactions; the publishers' caches give those frames again. Syncing every
transaction would cost several milliseconds of disk time each second for nothing else. Much is written in transactions
of a bounded size, so that other processes have their turn.

A folder has a file for each member, which it holds a lock on as long as it lives. The kernel gives
up the lock of a member whose process has ended, however it ended: then it publishes nothing more for certain.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
import threading
import time
from hashlib import blake2b
from itertools import islice
from typing import IO, TYPE_CHECKING, Final

import structlog

from optipmb_service.cluster.store import ENDED, KEPT, Fenced, Record, StoreError, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

log = structlog.get_logger("optipmb_service")

MEMBERS: Final = "members"  # folder of the files whose locks say that members live
BUSY_S: Final = 5.0  # longest wait for transactions of other processes; each takes milliseconds
BUSY_PAUSE_S: Final = 0.01

LOG_BYTES: Final = 4 * 2**20  # size of the write-ahead log from which its pages go into the file
ASIDE: Final = 64  # torn checkpoints kept in all; beyond it the oldest go
LEASES: Final = "leases.db"  # file of the records
NUMBERS: Final = 2**17  # streams whose numbers are kept without a checkpoint; beyond it the longest silent go
ENDED_KEPT: Final = 64  # records of ended members; who has followed none of the later ones was ended itself
SLICE: Final = 64  # streams of one transaction
SLICE_BYTES: Final = 4 * 2**20  # bytes of checkpoints of one transaction; one checkpoint may have more
PAGE_BYTES: Final = 32768  # pages of the file of the checkpoints, each of which has tens of thousands of bytes
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
CREATE TABLE IF NOT EXISTS numbers (stream TEXT PRIMARY KEY, at REAL NOT NULL, data BLOB NOT NULL);
"""

_OLD_MEMBERS: Final = """
DELETE FROM records WHERE key LIKE 'member/%' AND value = 'ended' AND revision <= (
    SELECT revision FROM records WHERE key LIKE 'member/%' AND value = 'ended' ORDER BY revision DESC LIMIT 1 OFFSET ?
)
"""
_NEWEST: Final = "SELECT data FROM checkpoints WHERE stream = ? ORDER BY number DESC LIMIT 1"
_SILENT: Final = """
SELECT stream FROM numbers WHERE at < ? AND EXISTS (SELECT 1 FROM checkpoints WHERE stream = numbers.stream) LIMIT ?
"""
_OLD_NUMBERS: Final = """
DELETE FROM numbers WHERE at < (SELECT at FROM numbers ORDER BY at DESC LIMIT 1 OFFSET ?)
    AND NOT EXISTS (SELECT 1 FROM checkpoints WHERE stream = numbers.stream)
"""


class MemberLocks:
    """Locks of members in a folder, one held by this process; None: there are no other processes."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._member = ""
        self._file: IO[bytes] | None = None

    def is_free(self, member: str) -> bool:
        """Return whether the lock of a member is free. A missing file says nothing about its process."""
        if member == self._member or self._folder is None:
            return False
        try:
            return not _locked(_lock_of(self._folder, member))
        except OSError:
            return False

    def take(self, member: str) -> None:
        """Take the lock of a member that begins; the one before it in this process has ended.

        Raises:
            StoreError: the file cannot be made, or is locked.
        """
        if self._folder is None or member == self._member:
            return
        try:
            file = _lock_of(self._folder, member).open("xb")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(f"{self._folder}: {error}") from error
        self.close()
        self._member, self._file = member, file

    def restore(self) -> None:
        """Take the lock of this process again: its file was deleted.

        Raises:
            StoreError: the file cannot be made.
        """
        if self._folder is not None and self._member:
            try:
                self._folder.mkdir(exist_ok=True)
                member, self._member = self._member, ""
                if not _lock_of(self._folder, member).exists():
                    self.take(member)
                self._member = member
            except OSError as error:
                raise StoreError(f"{self._folder}: {error}") from error

    def leave(self, member: str) -> None:
        """Remove the lock of a member that has ended."""
        if self._folder is not None:
            with contextlib.suppress(OSError):
                _lock_of(self._folder, member).unlink(missing_ok=True)

    def close(self) -> None:
        """Give up the lock of this process; may be called twice."""
        if self._file is not None:
            self._file.close()


def in_use(path: Path) -> bool:
    """Return whether a living member has its leases in the folder of a file of checkpoints."""
    for lock in path.with_name(MEMBERS).glob("*"):
        with contextlib.suppress(OSError):  # it has gone meanwhile
            if _locked(lock):
                return True
    return False


def _lock_of(folder: Path, member: str) -> Path:
    return folder / blake2b(member.encode(), digest_size=8).hexdigest()


def _locked(path: Path) -> bool:
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


class Database:
    """One file that processes share and a connection to it; any thread may use it, one at a time.

    SQLite itself goes on writing into a file that was deleted, and so loses it. So before each use it is
    checked that the file is still the one that was opened; else it is made again, with all that the deleted one holds.

    Args:
        path: the file; made when it is not there. None: in memory.
        schema: of its tables.
        synchronous: SQLite's setting.
        page_bytes: size of the pages of a new file; each is read and written by a call of the system.
        restored: called when the file was deleted and is there again.

    Raises:
        StoreError: it cannot be opened or written, or is no such file.
    """

    def __init__(
        self,
        path: Path | None,
        schema: str,
        synchronous: str,
        page_bytes: int = 4096,
        restored: Callable[[], None] = lambda: None,
    ) -> None:
        self._path = path
        self._schema, self._synchronous, self._page_bytes = schema, synchronous, page_bytes
        self._restored = restored
        self._lock = threading.Lock()
        self.connection: sqlite3.Connection | None = None
        try:
            self._open()
        except (sqlite3.Error, OSError) as error:
            self.close()
            raise StoreError(f"{path}: {error}") from error

    def _open(self) -> None:
        connection = self.connection = sqlite3.connect(
            self._path or ":memory:", timeout=BUSY_S, isolation_level=None, check_same_thread=False
        )
        connection.execute(f"PRAGMA page_size = {self._page_bytes}")
        self._begin_log(connection)
        connection.execute(f"PRAGMA synchronous = {self._synchronous}")
        connection.execute(f"PRAGMA journal_size_limit = {64 * 2**20}")
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()  # an older file keeps its own
        connection.execute(f"PRAGMA wal_autocheckpoint = {LOG_BYTES // page_bytes}")
        connection.executescript(self._schema)
        connection.execute("PRAGMA user_version = 3")  # fails here already where nothing can be written
        self._opened = self._found()

    def _found(self) -> tuple[int, int] | None:
        """Return what tells the file at the path from others; None without one."""
        if self._path is None:
            return 0, 0
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return None
        return found.st_dev, found.st_ino

    def _follow(self, connection: sqlite3.Connection) -> sqlite3.Connection:
        """Return the connection to the file at the path; where the one in use was deleted, it is made again.

        No other process writes into the deleted one meanwhile: each looks for the file when it has the write lock.
        """
        path = self._path
        if path is None or self._found() == self._opened:
            return connection
        path.parent.mkdir(parents=True, exist_ok=True)
        with _exclusive(path.parent):  # of several processes one makes it
            if self._found() is None:
                copy = path.with_name(f"{path.name}.new")
                for one in (copy, *(path.with_name(f"{path.name}{end}") for end in ("-wal", "-shm"))):
                    one.unlink(missing_ok=True)
                connection.execute("BEGIN IMMEDIATE")
                try:
                    copy.write_bytes(connection.serialize())  # `backup` does not work with the write lock held
                    copy.rename(path)
                finally:
                    connection.execute("ROLLBACK")
            connection.close()
            self._open()
        log.warning("store_deleted", file=str(path))
        self._restored()
        return self._connected()

    def _connected(self) -> sqlite3.Connection:
        if self.connection is None:
            raise StoreError(f"{self._path}: closed")
        return self.connection

    @staticmethod
    def _begin_log(connection: sqlite3.Connection) -> None:
        """Make the journal a write-ahead log; SQLite itself does not wait there for a process that does the same."""
        until_s = time.monotonic() + BUSY_S
        while True:
            try:
                connection.execute("PRAGMA journal_mode = WAL")
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > until_s:
                    raise
                time.sleep(BUSY_PAUSE_S)
            else:
                return

    def close(self, timeout: float = 1.0) -> None:
        """Close the file, unless it is in use for so long (s); may be called twice."""
        if not self._lock.acquire(timeout=timeout):
            return  # it hangs, and the process ends
        try:
            if self.connection is not None:
                self.connection.close()
                self.connection = None
        finally:
            self._lock.release()

    @contextlib.contextmanager
    def use(self) -> Iterator[sqlite3.Connection]:
        """Use the connection exclusively.

        Raises:
            StoreError: it cannot be used.
        """
        with self._lock:
            connection = self._connected()
            try:
                yield self._follow(connection)
            except (sqlite3.Error, OSError) as error:
                raise StoreError(f"{self._path}: {error}") from error

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Open a transaction; the write lock is taken first, so that no reader has to become a writer halfway."""
        with self.use() as opened:
            connection = opened
            connection.execute("BEGIN IMMEDIATE")
            if self._found() != self._opened:  # it was deleted while another process had the lock
                connection.execute("ROLLBACK")
                connection = self._follow(connection)
                connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                # A full disk may have rolled it back already.
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise


def _is_damaged(file: Path) -> bool:
    """Return whether a file is no database, or not whole."""
    if not file.exists():
        return False
    with contextlib.closing(sqlite3.connect(file, timeout=BUSY_S)) as connection:
        try:
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone() != ("ok",))
        except sqlite3.OperationalError:  # busy, or not readable: it is not known
            return False
        except sqlite3.DatabaseError:
            return True


class SqliteStore:
    """The leases and checkpoints of the processes of one machine.

    Args:
        path: the file of the checkpoints, in whose folder all else is made. None: in memory, for one process alone.
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

        A member takes its lock with its first record; its last record, its own or another member's, removes it.
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
        """Return whether the lock of a member is free. A missing file says nothing about its process."""
        return self._locks.is_free(member)

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams, some in a transaction; return the refused ones.

        The fence is read with the write lock, and so is a checkpoint by a successor (`load`): either it reads the
        checkpoints of this call, or its fence is found here.
        """
        refused: set[str] = set()
        left = iter(checkpoints.items())
        while some := _some(left):
            with self._checkpoints.transaction() as connection:
                fences = self._fences({one.lease for _, one in some})
                for stream, one in some:
                    if fences.get(one.lease) == one.fence:
                        self._write(connection, stream, one)
                    else:
                        refused.add(stream)
        return frozenset(refused)

    def _fences(self, keys: set[str]) -> dict[str, int]:
        with self._leases.use() as connection:
            marks = ",".join("?" * len(keys))
            query = f"SELECT key, revision FROM records WHERE key IN ({marks})"  # noqa: S608 - question marks
            return dict(connection.execute(query, tuple(keys)).fetchall())

    def _write(self, connection: sqlite3.Connection, stream: str, one: Fenced) -> None:
        (last,) = connection.execute(
            "SELECT coalesce(max(number), 0) FROM checkpoints WHERE stream = ?", (stream,)
        ).fetchone()
        connection.execute("INSERT INTO checkpoints VALUES (?, ?, ?)", (stream, last + 1, one.data))
        connection.execute("INSERT OR REPLACE INTO numbers VALUES (?, ?, ?)", (stream, self._clock(), one.numbers))
        connection.execute("DELETE FROM checkpoints WHERE stream = ? AND number <= ?", (stream, last + 1 - KEPT))

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one; what a predecessor still writes is waited for."""
        with self._checkpoints.transaction() as connection:
            row = connection.execute(_NEWEST, (stream,)).fetchone()
        return None if row is None else bytes(row[0])

    def numbers(self, stream: str) -> bytes | None:
        """Return the numbers saved with the newest checkpoint of a stream; else None."""
        with self._checkpoints.use() as connection:
            row = connection.execute("SELECT data FROM numbers WHERE stream = ?", (stream,)).fetchone()
        return bytes(row[0]) if row and row[0] else None

    def streams(self) -> tuple[str, ...]:
        """Return the streams that have a checkpoint, by name."""
        with self._checkpoints.use() as connection:
            rows = connection.execute("SELECT DISTINCT stream FROM checkpoints ORDER BY stream").fetchall()
        return tuple(row[0] for row in rows)

    def expire(self, age_s: float) -> int:
        """Forget the checkpoints of some streams of which nothing was saved for so long; return how many."""
        with self._checkpoints.transaction() as connection:
            old = connection.execute(_SILENT, (self._clock() - age_s, SLICE)).fetchall()
            connection.executemany("DELETE FROM checkpoints WHERE stream = ?", old)
            connection.execute(_OLD_NUMBERS, (NUMBERS,))
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
        """Return stream, reason and bytes of the checkpoints set aside, the oldest first."""
        with self._checkpoints.use() as connection:
            rows = connection.execute("SELECT stream, reason, data FROM aside ORDER BY number").fetchall()
        return [(stream, reason, bytes(data)) for stream, reason, data in rows]

    def close(self, timeout: float = 1.0) -> None:
        """Close the files; may be called twice."""
        self._checkpoints.close(timeout / 2)
        self._leases.close(timeout / 2)
        self._locks.close()


def _some(left: Iterator[tuple[str, Fenced]]) -> list[tuple[str, Fenced]]:
    """Return as many checkpoints as one transaction may have."""
    some: list[tuple[str, Fenced]] = []
    size = 0
    for one in islice(left, SLICE):
        some.append(one)
        size += len(one[1].data)
        if size >= SLICE_BYTES:
            break
    return some


def _leases_beside(path: Path, restored: Callable[[], None]) -> Database:
    """Open the file of the records; a damaged one is replaced when no member uses it.

    Raises:
        StoreError: it cannot be opened or written.
    """
    file, members = path.with_name(LEASES), path.with_name(MEMBERS)
    try:
        members.mkdir(exist_ok=True)
        with _exclusive(members):  # of two that begin, one looks and replaces
            if _is_damaged(file) and not in_use(path):
                log.warning("leases_damaged", file=str(file))
                for one in (file, *(file.with_name(f"{LEASES}{end}") for end in ("-wal", "-shm"))):
                    one.unlink(missing_ok=True)
            return Database(file, _RECORDS, "OFF", restored=restored)
    except OSError as error:
        raise StoreError(f"{file}: {error}") from error


@contextlib.contextmanager
def _exclusive(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes that do the same."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)

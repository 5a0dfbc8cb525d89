"""Where leases and checkpoints are kept: the port `LeaseStore`, and its adapter for the processes of one machine.

A store holds records and bytes and knows nothing of what they mean. Of every stream it keeps the newest two
checkpoints: when the newest turns out to be torn, it is set aside (kept for whoever wants to know why, never deleted by
the way) and the one before it is the newest again. A checkpoint is saved under the fence of a lease: a process that was
frozen and wakes up cannot write over what its successor has saved since.
"""

from __future__ import annotations

import contextlib
import fcntl
import sqlite3
import threading
import time
from hashlib import blake2b
from typing import IO, TYPE_CHECKING, Final, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

KEPT: Final = 2
"""Checkpoints kept per stream."""

ASIDE: Final = 64
"""Torn checkpoints kept in all; beyond it the oldest go."""

MEMBERS: Final = "members"
"""Folder of the files whose locks say that members live."""

ENDED: Final = "ended"
"""What the record of a member says at last."""

ENDED_KEPT: Final = 64
"""Records of ended members that are kept; who has followed none of the later ones was ended itself."""

BUSY_S: Final = 5.0
"""How long a transaction waits for those of other processes; each takes milliseconds."""

BUSY_PAUSE_S: Final = 0.01


class StoreError(Exception):
    """The store cannot do what was asked: full, read-only, locked, not there. Tracking goes on without it."""


class Record(NamedTuple):
    """A record as the store has it: its key, what it says, and its revision."""

    key: str
    value: str
    revision: int


class Write(NamedTuple):
    """A record to be written over a revision; 0: the key is to have none."""

    key: str
    value: str
    over: int


class Fenced(NamedTuple):
    """A checkpoint, the record of its lease, and the revision of that record: the fence."""

    lease: str
    fence: int
    data: bytes


class LeaseStore(Protocol):
    """Where records and checkpoints are. Any thread may call; every call is bounded in time and raises `StoreError`."""

    @property
    def max_bytes(self) -> int:
        """Bytes that a checkpoint may have."""

    @property
    def remote(self) -> bool:
        """Whether it can be out of reach for one process while others use it."""

    def follow(self, after: int) -> Sequence[Record]:
        """Return the newest record of each key that changed after a revision, by revision; perhaps not yet the last."""

    def get(self, key: str) -> Record | None:
        """Return the newest record of a key, certainly the newest; None without one."""

    def put(self, write: Write) -> int | None:
        """Write a record; return its revision, None when the one to be replaced is not the newest."""

    def gone(self, member: str) -> bool:
        """Whether the process of a member that has written its record has ended for certain."""

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams; return those that were refused for their fence."""

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""

    def expire(self, age_s: float) -> int:
        """Forget the streams of which nothing was saved for so long; return how many."""

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""

    def close(self, timeout: float) -> None:
        """Leave the store, within `timeout` seconds; may be called twice."""


_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS checkpoints (
    stream TEXT NOT NULL, number INTEGER NOT NULL, data BLOB NOT NULL, PRIMARY KEY (stream, number)
);
CREATE TABLE IF NOT EXISTS aside (
    number INTEGER PRIMARY KEY, stream TEXT NOT NULL, reason TEXT NOT NULL, data BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS records (key TEXT PRIMARY KEY, value TEXT NOT NULL, revision INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS written (stream TEXT PRIMARY KEY, at REAL NOT NULL);
"""

_OLD_MEMBERS: Final = """
DELETE FROM records WHERE key LIKE 'member/%' AND value = 'ended' AND revision <= (
    SELECT revision FROM records WHERE key LIKE 'member/%' AND value = 'ended' ORDER BY revision DESC LIMIT 1 OFFSET ?
)
"""
_NEWEST: Final = "SELECT data FROM checkpoints WHERE stream = ? ORDER BY number DESC LIMIT 1"


class SqliteStore:
    """A file with all leases and checkpoints, and beside it a folder with a file that each member holds a lock on.

    The journal is a write-ahead log, so that readers never wait for the writer. `synchronous = NORMAL` suffices: what a
    killed process has committed is in the log and stays, the file is whole after a power cut too, which may only cost
    the last transactions; the publishers' caches give those frames again. Syncing every transaction would cost several
    milliseconds of disk time each second for nothing else.

    The kernel gives up the lock of a member whose process has ended, however it ended: then it can be said for certain
    that it publishes nothing more.

    Args:
        path: the file; made when it is not there. None: in memory, for one process alone.
        clock: seconds since 1970.

    Raises:
        StoreError: it cannot be opened or written, or is no such file.
    """

    max_bytes: Final = 1_000_000_000  # SQLite's own limit
    remote: Final = False

    def __init__(self, path: Path | None, clock: Callable[[], float] = time.time) -> None:
        self._path = path
        self._members = None if path is None else path.with_name(MEMBERS)
        self._member = ""
        self._lock_file: IO[bytes] | None = None
        self._clock = clock
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        try:
            if self._members is not None:
                self._members.mkdir(exist_ok=True)
            self._connection = sqlite3.connect(
                path or ":memory:", timeout=BUSY_S, isolation_level=None, check_same_thread=False
            )
            self._begin_log(self._connection)
            self._connection.execute("PRAGMA synchronous = NORMAL")
            self._connection.execute(f"PRAGMA journal_size_limit = {64 * 2**20}")
            self._connection.executescript(_SCHEMA)
            self._connection.execute("PRAGMA user_version = 2")  # fails here already where nothing can be written
        except (sqlite3.Error, OSError) as error:
            self.close()
            raise StoreError(f"{path}: {error}") from error

    @staticmethod
    def _begin_log(connection: sqlite3.Connection) -> None:
        """Have the journal be a write-ahead log; SQLite itself does not wait there for a process that does the same."""
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

    def follow(self, after: int) -> list[Record]:
        """Return the newest record of each key that changed after a revision, by revision."""
        with self._use() as connection:
            rows = connection.execute("SELECT * FROM records WHERE revision > ? ORDER BY revision", (after,)).fetchall()
        return [Record(*row) for row in rows]

    def get(self, key: str) -> Record | None:
        """Return the newest record of a key; None without one."""
        with self._use() as connection:
            row = connection.execute("SELECT * FROM records WHERE key = ?", (key,)).fetchone()
        return None if row is None else Record(*row)

    def put(self, write: Write) -> int | None:
        """Write a record; return its revision, None when the one to be replaced is not the newest.

        With its first record a member takes its lock, and with its last one it, or whoever ends it, removes that.
        """
        kind, _, name = write.key.partition("/")
        begins = kind == "member" and write.over == 0 and write.value != ENDED
        if begins:
            self._take_lock(name)
        with self._transaction() as connection:
            row = connection.execute("SELECT revision FROM records WHERE key = ?", (write.key,)).fetchone()
            if (row[0] if row else 0) != write.over:
                return None
            (last,) = connection.execute("SELECT coalesce(max(revision), 0) FROM records").fetchone()
            connection.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?)", (write.key, write.value, last + 1))
            if begins:
                connection.execute(_OLD_MEMBERS, (ENDED_KEPT,))
        if kind == "member" and write.value == ENDED:
            self._leave_lock(name)
        return int(last) + 1

    def gone(self, member: str) -> bool:
        """Whether nobody holds the lock of a member."""
        if member == self._member or self._members is None:
            return False
        try:
            return not _locked(self._lock_of(member))
        except FileNotFoundError:
            return True
        except OSError:  # it cannot be found out
            return False

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams in one transaction; return those that were refused."""
        refused: set[str] = set()
        with self._transaction() as connection:
            for stream, one in checkpoints.items():
                lease = connection.execute("SELECT revision FROM records WHERE key = ?", (one.lease,)).fetchone()
                if lease is None or lease[0] != one.fence:
                    refused.add(stream)
                    continue
                (last,) = connection.execute(
                    "SELECT coalesce(max(number), 0) FROM checkpoints WHERE stream = ?", (stream,)
                ).fetchone()
                connection.execute("INSERT INTO checkpoints VALUES (?, ?, ?)", (stream, last + 1, one.data))
                connection.execute("INSERT OR REPLACE INTO written VALUES (?, ?)", (stream, self._clock()))
                connection.execute(
                    "DELETE FROM checkpoints WHERE stream = ? AND number <= ?", (stream, last + 1 - KEPT)
                )
        return frozenset(refused)

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
            connection.execute(f"DELETE FROM checkpoints WHERE stream IN {old}", (now_s - age_s,))  # noqa: S608 - a constant
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

    def close(self, timeout: float = 0.0) -> None:
        """Close the file; may be called twice."""
        del timeout
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
        if self._lock_file is not None:
            self._lock_file.close()

    def _lock_of(self, member: str) -> Path:
        assert self._members is not None  # noqa: S101 - said for the type checker
        return self._members / blake2b(member.encode(), digest_size=8).hexdigest()

    def _take_lock(self, member: str) -> None:
        """Take the lock of a member that begins; the one before it in this process has ended."""
        if self._members is None or member == self._member:
            return
        try:
            file = self._lock_of(member).open("xb")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(f"{self._members}: {error}") from error
        if self._lock_file is not None:
            self._lock_file.close()
        self._member, self._lock_file = member, file

    def _leave_lock(self, member: str) -> None:
        if self._members is not None:
            with contextlib.suppress(OSError):
                self._lock_of(member).unlink(missing_ok=True)

    @contextlib.contextmanager
    def _use(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._connection is None:
                raise StoreError(f"{self._path}: closed")
            try:
                yield self._connection
            except sqlite3.Error as error:
                raise StoreError(f"{self._path}: {error}") from error

    @contextlib.contextmanager
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


def in_use(path: Path) -> bool:
    """Whether a member lives that keeps its leases in a file."""
    for lock in path.with_name(MEMBERS).glob("*"):
        with contextlib.suppress(OSError):  # it has gone meanwhile
            if _locked(lock):
                return True
    return False


def _locked(path: Path) -> bool:
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


_T = TypeVar("_T")


def load_newest(
    store: LeaseStore, stream: str, read: Callable[[bytes], _T], torn: type[Exception], on_torn: Callable[[str], None]
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

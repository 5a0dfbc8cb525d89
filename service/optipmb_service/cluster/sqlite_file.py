"""A file of SQLite that processes of one machine share: one connection of this process, and transactions on it.

SQLite itself goes on writing into a file that was deleted, where nobody finds it again. So before each use it is seen
whether the file is still the one that was opened; else it is made again, with all that the deleted one holds.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
import threading
import time
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

log = structlog.get_logger("optipmb_service")

BUSY_S: Final = 5.0
"""How long a transaction waits for those of other processes; each takes milliseconds."""

BUSY_PAUSE_S: Final = 0.01

LOG_BYTES: Final = 4 * 2**20
"""Size of the write-ahead log from which its pages go into the file, and it begins anew."""


class Database:
    """One file and a connection to it; any thread may use it, one at a time.

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
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)  # of several processes one makes it
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
        finally:
            os.close(folder)
        log.warning("store_deleted", file=str(path))
        self._restored()
        return self._connected()

    def _connected(self) -> sqlite3.Connection:
        if self.connection is None:
            raise StoreError(f"{self._path}: closed")
        return self.connection

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
        """Have the connection for one's own.

        Raises:
            StoreError: whatever is wrong with it.
        """
        with self._lock:
            connection = self._connected()
            try:
                yield self._follow(connection)
            except (sqlite3.Error, OSError) as error:
                raise StoreError(f"{self._path}: {error}") from error

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Do all of it or nothing; the write lock is taken first, so that no reader has to become a writer halfway."""
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


def is_damaged(file: Path) -> bool:
    """Whether a file is no database, or not whole."""
    if not file.exists():
        return False
    with contextlib.closing(sqlite3.connect(file, timeout=BUSY_S)) as connection:
        try:
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone() != ("ok",))
        except sqlite3.OperationalError:  # busy, or not readable: it is not known
            return False
        except sqlite3.DatabaseError:
            return True

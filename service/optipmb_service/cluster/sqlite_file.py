"""A file of SQLite that processes of one machine share: one connection of this process, and transactions on it."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from typing import TYPE_CHECKING, Final

from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

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

    Raises:
        StoreError: it cannot be opened or written, or is no such file.
    """

    def __init__(self, path: Path | None, schema: str, synchronous: str, page_bytes: int = 4096) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.connection: sqlite3.Connection | None = None
        try:
            self.connection = sqlite3.connect(
                path or ":memory:", timeout=BUSY_S, isolation_level=None, check_same_thread=False
            )
            self.connection.execute(f"PRAGMA page_size = {page_bytes}")
            self._begin_log(self.connection)
            self.connection.execute(f"PRAGMA synchronous = {synchronous}")
            self.connection.execute(f"PRAGMA journal_size_limit = {64 * 2**20}")
            (page_bytes,) = self.connection.execute("PRAGMA page_size").fetchone()  # an older file keeps its own
            self.connection.execute(f"PRAGMA wal_autocheckpoint = {LOG_BYTES // page_bytes}")
            self.connection.executescript(schema)
            self.connection.execute("PRAGMA user_version = 3")  # fails here already where nothing can be written
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
            if self.connection is None:
                raise StoreError(f"{self._path}: closed")
            try:
                yield self.connection
            except sqlite3.Error as error:
                raise StoreError(f"{self._path}: {error}") from error

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Do all of it or nothing; the write lock is taken first, so that no reader has to become a writer halfway."""
        with self.use() as connection:
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

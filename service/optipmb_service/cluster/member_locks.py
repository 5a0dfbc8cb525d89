"""The locks of the members of one machine: a folder with a file for each, which it holds a lock on as long as it lives.

The kernel gives up the lock of a member whose process has ended, however it ended: then it can be said for certain that
it publishes nothing more.
"""

from __future__ import annotations

import contextlib
import fcntl
from hashlib import blake2b
from typing import IO, TYPE_CHECKING, Final

from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from pathlib import Path

MEMBERS: Final = "members"
"""Folder of the files whose locks say that members live."""


class MemberLocks:
    """The lock of the member of this process, and those of others.

    Args:
        folder: where they are; None: there are no others.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._member = ""
        self._file: IO[bytes] | None = None

    def is_free(self, member: str) -> bool:
        """Whether nobody holds the lock of a member. A file that is missing says nothing about its process."""
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
    """Whether a member lives that keeps its leases beside a file of checkpoints."""
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

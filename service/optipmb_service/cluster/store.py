"""Store of leases and checkpoints: the port `LeaseStore`; its adapters are `sqlite` and `jetstream`. Parts of the log.

A store holds records and bytes without interpreting them. Of every stream it keeps the newest two
checkpoints: when the newest turns out to be torn, it is set aside (kept for diagnosis, never deleted by
the way) and the one before it is the newest again. A checkpoint is saved under the fence of a lease: a process that was
frozen and wakes up cannot write over what its successor has saved since.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

KEPT: Final = 2  # checkpoints kept per stream
ENDED: Final = "ended"  # what the record of a member says at last


class StoreError(Exception):
    """Failure of the store: full, read-only, locked, not there. Tracking goes on without it."""


class Record(NamedTuple):
    """A record of the store."""

    key: str
    value: str
    revision: int


class Write(NamedTuple):
    """A record to be written over a revision; 0: the key is to have none."""

    key: str
    value: str
    over: int


class Fenced(NamedTuple):
    """A checkpoint, the record of its lease, and the revision of that record: the fence.

    `numbers` are bytes that are kept when the checkpoint is not any more.
    """

    lease: str
    fence: int
    data: bytes
    numbers: bytes = b""


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
        """Return whether the process of a member that has written its record has ended for certain."""

    def save(self, checkpoints: Mapping[str, Fenced]) -> frozenset[str]:
        """Write the newest checkpoints of streams; return the streams refused for their fence."""

    def load(self, stream: str) -> bytes | None:
        """Return the newest checkpoint of a stream, None without one."""

    def numbers(self, stream: str) -> bytes | None:
        """Return the numbers saved with the newest checkpoint of a stream, also after that has gone; else None."""

    def expire(self, age_s: float) -> int:
        """Forget checkpoints of streams of which nothing was saved for so long, some at a time; return how many."""

    def set_aside(self, stream: str, reason: str) -> None:
        """Move the newest checkpoint of a stream to those set aside; the one before it is the newest then."""

    def close(self, timeout: float) -> None:
        """Leave the store, within `timeout` seconds; may be called twice."""


@dataclass(frozen=True)
class Position:
    """Frame of a stream, after which others are looked for.

    Attributes:
        epochs: publisher epochs before its own.
        epoch: its own.
        seq: its number.
        tracked: whether it was tracked: those after it are wanted, within the bound on a stream with a position.
    """

    epochs: frozenset[bytes]
    epoch: bytes
    seq: int
    tracked: bool

    def covers(self, epoch: bytes, seq: int) -> bool:
        """Return whether a frame is not later than this one."""
        return epoch in self.epochs or (epoch == self.epoch and seq <= self.seq)


@dataclass(frozen=True)
class LogQuery:
    """Part of the log that a session needs.

    Attributes:
        streams: whose detections.
        common: a node, `site/node`, or a site, whose streams in the log are wanted too where `belongs` says so; empty:
            none.
        belongs: whether such a stream feeds the session.
        positions: where streams are; of one without a position the last seconds are wanted.
    """

    streams: Sequence[str]
    common: str
    belongs: Callable[[str], bool]
    positions: Mapping[str, Position]


_T = TypeVar("_T")
_Torn = TypeVar("_Torn", bound=Exception)


def load_newest(
    store: LeaseStore, stream: str, read: Callable[[bytes], _T], torn: type[_Torn], on_torn: Callable[[_Torn], None]
) -> _T | None:
    """Return the newest checkpoint of a stream that `read` can read; one for which it raises `torn` is set aside.

    Raises:
        StoreError: the store cannot be read.
    """
    while (data := store.load(stream)) is not None:
        try:
            return read(data)
        except torn as error:
            on_torn(error)
            store.set_aside(stream, str(error))
    return None

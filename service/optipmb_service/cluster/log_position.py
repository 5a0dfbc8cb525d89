"""What of the log of detections is wanted for a session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


class _Message(Protocol):
    @property
    def epoch(self) -> bytes: ...
    @property
    def seq(self) -> int: ...


@dataclass(frozen=True)
class Position:
    """A frame of a stream, for who looks for those after it.

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

    def before(self, message: _Message) -> bool:
        """Whether a message is not later than this."""
        return message.epoch in self.epochs or (message.epoch == self.epoch and message.seq <= self.seq)


@dataclass(frozen=True)
class Missed:
    """What of the log is wanted for a session.

    Attributes:
        streams: whose detections.
        node: `site/node`, of whose other streams in the log those that `belongs` are wanted too; empty: none.
        belongs: whether a stream of the node feeds the session.
        positions: where streams are; of one without a position the last seconds are wanted.
    """

    streams: Sequence[str]
    node: str
    belongs: Callable[[str], bool]
    positions: Mapping[str, Position]

"""Parts of the log of detections that a session needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


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
class Missed:
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

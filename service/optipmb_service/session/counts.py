"""Counts of messages: of a session, of a stream, of all.

A counter of sessions is a field of `FrameCounts` or `Deliveries`, and of `SessionState` under the same name; its metric
is a row of `STREAM_METRICS`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import Field

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_COUNT: Final = 2**61
"""Where counters end, so that neither one more nor the sum of two leaves the 64 bits of a message."""

JOINING: Final = frozenset({"rejoined", "lost_dropped", "embedding_ignored"})
"""Counts of sessions that join tracks, or are sent what that needs."""

Count = Annotated[int, Field(strict=True, ge=0, le=MAX_COUNT)]


def total(*counts: int) -> int:
    """Return the sum of counts; beyond the highest it stays there.

    A publisher chooses its sequence numbers, and all numbers between two of them count as missing.
    """
    return min(sum(counts), MAX_COUNT)


def present(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by name without counts of joining that are 0, as in sessions that do not join tracks."""
    return {name: value for name, value in table.items() if name not in JOINING or value}


@dataclass
class Deliveries:
    """Counts of frames that were not tracked, and of corrections: they depend on how messages were delivered.

    Attributes:
        duplicates: frames that came again.
        late: frames that came too late.
        refused: messages that were not valid, or not wanted.
        inserted: late frames and clouds that were put in their place.
        corrected: tracks that were published again because of these.
    """

    duplicates: Count = 0
    late: Count = 0
    refused: Count = 0
    inserted: Count = 0
    corrected: Count = 0


@dataclass(slots=True)
class FrameCounts:
    """Counts of the frames that were processed, part of a state: never assigned to.

    Attributes:
        frames: tracked.
        gaps: missing between those tracked.
        new_epochs: how often the publisher restarted or its stamps jumped.
        clouds_used: tracked with their cloud.
        clouds_missed: that waited for a cloud in vain.
        astray: refused because the sensor cannot have been there, or its vectors have another length.
        effort: refused because they need too much computing.
        unconfirmed: refused because their stamps jumped and no others agreed.
        repaired: covariances that had lost rank in rounding and were repaired.
        rejoined: tracks that were joined with an earlier one of the same object.
        lost_dropped: lost objects that were dropped because there were too many.
        embedding_ignored: whose embeddings were not of the model that the session compares.
    """

    frames: Count = 0
    gaps: Count = 0
    new_epochs: Count = 0
    clouds_used: Count = 0
    clouds_missed: Count = 0
    astray: Count = 0
    effort: Count = 0
    unconfirmed: Count = 0
    repaired: Count = 0
    rejoined: Count = 0
    lost_dropped: Count = 0
    embedding_ignored: Count = 0


@dataclass
class Counters(FrameCounts, Deliveries):
    """Counts of the messages of a session so far; those refused include the frames that the tracker refused."""

    @classmethod
    def of(cls, frames: FrameCounts, deliveries: Deliveries) -> Counters:
        """Return the counts of both."""
        counts = {name: getattr(one, name) for one in (frames, deliveries) for name in one.__match_args__}
        counts["refused"] += frames.astray + frames.effort + frames.unconfirmed
        return cls(**counts)


@dataclass
class MessageCounters(Counters):
    """Counts of the messages of a stream, or of all, with messages that reached no session.

    Every frame received ends in one of frames, duplicates, late, refused and shed, or waits: received is their sum.
    """

    received: int = 0
    shed: int = 0
    clouds_refused: int = 0
    clouds_shed: int = 0

    def __add__(self, other: MessageCounters) -> MessageCounters:
        return MessageCounters(
            **{one.name: total(getattr(self, one.name), getattr(other, one.name)) for one in fields(MessageCounters)}
        )

    def since(self, earlier: Counters, now: Counters) -> MessageCounters:
        """Return the sum with the growth of a session's counters between two times."""
        come = {one.name: getattr(now, one.name) - getattr(earlier, one.name) for one in fields(Counters)}
        return self + MessageCounters(**come)

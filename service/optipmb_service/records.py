"""What goes into a session and what comes out of it, as plain values; times in nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import optipmb_schemas as schemas

if TYPE_CHECKING:
    import optipmb

SECOND: Final = 1_000_000_000


class Steps(Protocol):
    """What a session needs of a tracker; `optipmb.Tracker` has it."""

    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        """Return the density after the frame, and its tracks."""


@dataclass(frozen=True, slots=True)
class Policy:
    """The settings that a session follows.

    Attributes:
        gap_limit_ns: a larger step of the stamps starts the session anew.
        cloud_wait_ns: longest wait of a frame for its cloud.
        cloud_memory_ns: how lately a cloud must have come for a frame that does not say whether it has one.
        clouds: number of clouds kept.
        recovery_wait_ns: longest time after a restore that frames behind a gap are held for those missing.
    """

    gap_limit_ns: int = 5 * SECOND
    cloud_wait_ns: int = SECOND // 10
    cloud_memory_ns: int = 2 * SECOND
    clouds: int = 16
    recovery_wait_ns: int = 2 * SECOND


@dataclass(frozen=True, slots=True)
class Life:
    """What outlives a session, so that neither its id nor its track ids come again.

    Attributes:
        starts: how many lives the stream has had.
        next_id: the next track id.
    """

    starts: int = 0
    next_id: int = 1


@dataclass(frozen=True, slots=True)
class Tracked:
    """Tracks to be published, without their delivery part.

    Attributes:
        tracks: the message.
        ticket: what the caller gave with the detections.
        step_ns: time that conversion and tracking took.
    """

    tracks: schemas.Tracks
    ticket: Any
    step_ns: int


@dataclass(frozen=True, slots=True)
class Begun:
    """A new life of the density began: at the first frame, at a jump, by a reset.

    Attributes:
        session: its id.
        reason: "first", "jump", "publisher", "reset" or "parameters".
        jump_ns: how far the stamps jumped.
    """

    session: str
    reason: str
    jump_ns: int = 0


Output = Tracked | schemas.Problem | Begun


@dataclass(slots=True)
class Counters:
    """What happened to the messages of a session so far.

    Every frame received ends in one of frames, duplicates, late, refused and shed, or waits: received is their sum.
    """

    received: int = 0
    frames: int = 0
    duplicates: int = 0
    late: int = 0
    refused: int = 0
    shed: int = 0
    gaps: int = 0
    new_epochs: int = 0
    clouds_used: int = 0
    clouds_missed: int = 0
    clouds_refused: int = 0
    clouds_shed: int = 0

    def __add__(self, other: Counters) -> Counters:
        """Return the sums."""
        return Counters(**{name: getattr(self, name) + getattr(other, name) for name in self.__slots__})

    def __sub__(self, other: Counters) -> Counters:
        """Return what has come since the other."""
        return Counters(**{name: getattr(self, name) - getattr(other, name) for name in self.__slots__})


class RefusedError(ValueError):
    """A command was refused.

    Attributes:
        path: the field of the request.
        expected: what would have been accepted.
        received: what was asked for.
    """

    def __init__(self, path: str, expected: str, received: str) -> None:
        super().__init__(f"{path}: expected {expected}, received {received}")
        self.path = path
        self.expected = expected
        self.received = received

"""The port behind which it is decided who tracks a stream: what the runtime needs of whoever decides.

Two adapters: `coordinator` decides by liveliness tokens, for instances on one router that share a folder; `member` by
leases of partitions in a store that several machines share.
"""

from __future__ import annotations

from enum import StrEnum, unique
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable


@unique
class Role(StrEnum):
    """What an instance is to a stream."""

    NONE = "none"
    """It has not asked for it."""
    CLAIMING = "claiming"
    """It wants it, and it is not known yet who has it."""
    OWNER = "owner"
    """It tracks the stream."""
    STANDBY = "standby"
    """Another one tracks it."""


@unique
class RoleChange(StrEnum):
    """What becomes of a claim or an ownership."""

    GRANTED = "granted"
    DENIED = "denied"
    LOST = "lost"
    """Another instance may go on already: the state here is not the newest, and is not to be kept."""
    RECALLED = "recalled"
    """Another instance is to have the stream as soon as the state here is kept; `Ownership.release` says that it is."""


class WriteLease:
    """The time during which an owner may write without looking; read by any thread, written by one.

    Args:
        length_ns: how long a renewal holds, monotonic time.
    """

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._until_ns = 0

    def valid(self, now_ns: int) -> bool:
        """Whether the write lease holds."""
        return now_ns < self._until_ns

    def renew(self, now_ns: int) -> None:
        """Let it hold from now."""
        self._until_ns = now_ns + self._length_ns

    def lapse(self) -> None:
        """End it: writing has to wait until somebody has looked who else holds tokens."""
        self._until_ns = 0


class Ownership(Protocol):
    """Which streams this instance tracks; any thread may call."""

    @property
    def failure(self) -> str:
        """Why nothing may be published, for a store that all instances share; empty while it may."""

    def start(self, changed: Callable[[str, RoleChange], None], resumed: Callable[[], None]) -> None:
        """Begin; before it, streams are only requested.

        Args:
            changed: called with every change of ownership, on a thread of the adapter; must not take long.
            resumed: called when a lapsed write lease holds again.
        """

    def role(self, stream: str) -> Role:
        """Return what this instance is to a stream."""

    def may_write(self, stream: str) -> bool:
        """Whether this instance may publish and store for a stream now."""

    def owns(self, stream: str) -> bool:
        """Whether this instance owns a stream, also while its write lease has lapsed."""

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream, or is about to, as far as is known; it answers for the stream."""

    def request(self, stream: str) -> None:
        """Ask for a stream."""

    def release(self, stream: str) -> None:
        """Give up a stream."""

    def close(self, timeout: float) -> None:
        """Give up everything, within `timeout` seconds; what is to be kept has been saved."""

"""Frames that are held: for their point clouds and, after a restore, for frames before them that may still come."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.timing import Mark

MAX_HELD: Final = 64
"""Frames held for their clouds at once; beyond it the oldest goes on without."""

MAX_RECOVERING: Final = 1024
"""Frames held for missed ones at once; beyond it they go on with a gap."""


@dataclass(frozen=True, slots=True)
class Held:
    """A frame that arrived.

    Attributes:
        message: as it came.
        mark: what identifies it.
        order: where it belongs among the others.
        frame: what the tracker takes.
        ignored: objects left out of it.
        deadline_ns: until when it waits for its cloud (monotonic); None: it does not.
        ticket: what the caller gave with it.
    """

    message: schemas.Detections
    mark: Mark
    order: tuple[int, int, int]
    frame: optipmb.Frame
    ignored: int
    deadline_ns: int | None
    ticket: Any


@dataclass(frozen=True, slots=True)
class Ready:
    """A frame whose turn it is, with its cloud; `missed` says that it waited for one in vain."""

    held: Held
    points: schemas.Points | None
    missed: bool


class Waiting:
    """The frames held, in the order in which they will be processed."""

    def __init__(self) -> None:
        self._held: list[Held] = []
        self.recovery_ns: int | None = None
        """Until when frames behind a gap are held for those missing (monotonic); None: they are not."""

    def __len__(self) -> int:
        return len(self._held)

    def add(self, held: Held) -> None:
        """Put a frame where it belongs."""
        insort(self._held, held, key=lambda one: one.order)

    def clear(self) -> int:
        """Drop all; returns how many there were."""
        count = len(self._held)
        self._held.clear()
        return count

    def deadline_ns(self, complete: Callable[[Mark], bool]) -> int | None:
        """Return when `take` is due (monotonic); None while nothing waits.

        Args:
            complete: whether no frame is missing before one.
        """
        if not self._held:
            return None
        head = self._held[0]
        return self.recovery_ns if self._behind_gap(head, complete) else head.deadline_ns

    def take(
        self,
        now_ns: int | None,
        complete: Callable[[Mark], bool],
        cloud: Callable[[Held], schemas.Points | None],
        crowded: Callable[[Held], bool],
    ) -> Ready | None:
        """Return the next frame if it is ready, None otherwise.

        Args:
            now_ns: monotonic time; None: nothing waits any longer.
            complete: whether no frame is missing before one.
            cloud: finds the cloud of a frame.
            crowded: whether longer waiting for the cloud of a frame would cost those behind it theirs. Else one lost
                cloud would: each frame would find its own pushed off by the time that the one before was let go.
        """
        if now_ns is not None and self.recovery_ns is not None and now_ns >= self.recovery_ns:
            self.recovery_ns = None
        if not self._held:
            return None
        head = self._held[0]
        if now_ns is not None and len(self._held) <= MAX_RECOVERING and self._behind_gap(head, complete):
            return None
        points = cloud(head)
        missed = points is None and head.deadline_ns is not None
        many = len(self._held) > MAX_HELD and self.recovery_ns is None
        if missed and now_ns is not None and now_ns < (head.deadline_ns or 0) and not (many or crowded(head)):
            return None
        del self._held[0]
        return Ready(head, points, missed)

    def _behind_gap(self, head: Held, complete: Callable[[Mark], bool]) -> bool:
        return self.recovery_ns is not None and not complete(head.mark)

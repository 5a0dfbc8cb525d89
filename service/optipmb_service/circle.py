"""What the lanes of a service share, and what they need of those around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.keeper import Keeping
    from optipmb_service.metrics import Metrics
    from optipmb_service.ownership import Standing
    from optipmb_service.ports import Outlet
    from optipmb_service.problems import Desk
    from optipmb_service.records import Life, Policy
    from optipmb_service.session import Session
    from optipmb_service.standby import Budget


class Member(Protocol):
    """A lane, as those around it know it."""

    @property
    def stream(self) -> str:
        """Its stream, `site/node/sensor`."""

    def wake(self) -> None:
        """Send a worker though nothing came."""

    def work(self) -> bool:
        """Take some of what waits; True: come again."""


class Seating(Protocol):
    """What a lane needs of the steward."""

    def standing(self, stream: str) -> Standing:
        """Return what this instance is to a stream."""

    def may_write(self, stream: str) -> bool:
        """Whether this instance may publish and store for a stream now."""

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream."""

    def seek(self, stream: str) -> None:
        """Ask for a stream."""

    def leave(self, stream: str) -> None:
        """Give up a stream."""


@dataclass(frozen=True)
class Circle:
    """What all lanes share.

    Attributes:
        instance: name of the service.
        limits: bounds on messages.
        policy: waiting and restarting of sessions.
        queue_frames: most frames waiting per stream.
        queue_clouds: most clouds waiting per stream.
        outlet: where results go.
        desk: where problems go.
        parameters_of: profile of a stream.
        steward: says which streams this instance owns.
        keeper: where checkpoints go and come from.
        standby_ns: how long packets wait for a takeover.
        budget: bytes that may wait for takeovers, over all streams.
        dump: saves what is needed to see an error of a session again; returns the file.
        room: whether a further session has room.
        admit: asked before a session begins; returns what the stream had before, None when there is no room.
        release: told when a session has ended.
        discard: told when a lane without a session has nothing left to do.
        submit: sends a worker to a lane.
        arm: has `wake` of a lane called at a monotonic time (ns).
        metrics: counts what is published.
        tracker: makes trackers.
    """

    instance: str
    limits: schemas.Limits
    policy: Policy
    queue_frames: int
    queue_clouds: int
    outlet: Outlet
    desk: Desk
    parameters_of: Callable[[str], optipmb.Parameters]
    steward: Seating
    keeper: Keeping
    standby_ns: int
    budget: Budget
    dump: Callable[[str, bytes], str]
    room: Callable[[], bool]
    admit: Callable[[str], Life | None]
    release: Callable[[Session], None]
    discard: Callable[[Member], None]
    submit: Callable[[Member], None]
    arm: Callable[[Member, int], None]
    metrics: Metrics
    tracker: Callable[[optipmb.Parameters], Any]

"""What the actors of a service share, and what they need of those around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from optipmb_service.runtime.byte_budget import MEGABYTE
from optipmb_service.session.values import SECOND, Policy

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.byte_budget import ByteBudget
    from optipmb_service.runtime.missed_frames import MissedFrames
    from optipmb_service.runtime.persistence import Persistence
    from optipmb_service.runtime.ports import Caches, MessageSink, Packet
    from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
    from optipmb_service.session.values import Incarnation
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.telemetry.problem_reporter import ProblemReporter

PARTS: Final = 4
"""What a stream's memory is divided into: mailbox, clouds, frames held, window."""


class Actor(Protocol):
    """An actor, as those around it know it."""

    @property
    def stream(self) -> str:
        """Its stream, `site/node/sensor`."""

    def wake(self) -> None:
        """Schedule the actor though nothing came."""

    def work(self) -> bool:
        """Take some of what waits; True: come again."""


class Keep(Protocol):
    """Takes a packet of a session that another instance is to track."""

    def __call__(self, session: str, packet: Packet, *, frame: bool) -> None:
        """Take it, with whether it is a frame."""


@dataclass(frozen=True)
class ActorContext:
    """What all actors share.

    Attributes:
        instance: name of the service.
        keys: the keys of streams.
        fused: whether a session is that of several streams.
        limits: bounds on messages.
        policy: waiting and restarting of sessions.
        queue_frames: most frames waiting per stream.
        queue_clouds: most clouds waiting per stream.
        mailbox_bytes: most bytes waiting per stream.
        mailboxes: bytes that may wait, over all streams.
        step_limit_ns: processor time that one message may take.
        silent_ns: silence of a stream after which the log is read, where there is one.
        sink: where results go.
        reporter: where problems go.
        parameters_of: profile of a stream.
        member: says which streams are tracked here.
        persistence: where checkpoints go and come from.
        missed: what is known of the frames that a session has missed.
        buffer: makes buffers for packets that wait for their session.
        keep: takes a packet of a session that another instance is to track.
        dump: saves what is needed to see an error of a session again; returns the file.
        caches: returns what is known of the publishers' caches.
        room: why a further stream has no room; empty when it has.
        admit: asked before a session begins; returns what the stream had before, None when there is no room.
        release: called when a session has ended, or was not begun, with what a later one has to know.
        discard: called when an actor without a session has nothing left to do.
        submit: schedules an actor.
        arm: has `wake` of an actor called at a monotonic time (ns).
        metrics: counts what is published.
        tracker: makes trackers.
    """

    instance: str
    keys: schemas.Keys
    fused: Callable[[str], bool]
    limits: schemas.Limits
    policy: Policy
    queue_frames: int
    queue_clouds: int
    mailbox_bytes: int
    mailboxes: ByteBudget
    step_limit_ns: int
    silent_ns: int
    sink: MessageSink
    reporter: ProblemReporter
    parameters_of: Callable[[str], optipmb.Parameters]
    member: Member
    persistence: Persistence
    missed: MissedFrames
    buffer: Callable[[], TakeoverBuffer]
    keep: Keep
    dump: Callable[[str, bytes], str]
    caches: Callable[[], Caches]
    room: Callable[[str], str]
    admit: Callable[[str], Incarnation | None]
    release: Callable[[str, Incarnation], None]
    discard: Callable[[Actor], None]
    submit: Callable[[Actor], None]
    arm: Callable[[Actor, int], None]
    metrics: Metrics
    tracker: Callable[[optipmb.Parameters], Any]


def part_of(settings: Settings) -> int:
    """Return the bytes that each part of a stream's memory may take."""
    return settings.stream_mb * MEGABYTE // PARTS


def policy_of(settings: Settings) -> Policy:
    """Return what sessions follow."""
    return Policy(
        gap_limit_ns=round(settings.gap_limit_s * SECOND),
        cloud_wait_ns=round(settings.cloud_wait_s * SECOND),
        cloud_memory_ns=round(settings.cloud_memory_s * SECOND),
        clouds=settings.queue_clouds,
        cloud_bytes=part_of(settings),
        held_bytes=part_of(settings),
        rewind_bytes=part_of(settings),
        rewind_ns=round(settings.rewind_s * SECOND),
        late_clouds=settings.late_clouds,
        recovery_wait_ns=round(settings.recovery_wait_s * SECOND),
        max_speed=settings.max_speed,
        at_once=1,  # other streams have their turn between two frames
    )

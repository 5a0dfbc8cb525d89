"""How the session of a stream is opened here, and what of one that goes on elsewhere is passed on.

One that was kept is restored, and what it has missed is read from the log; without one, a new session begins. Opening
takes a while, in which the stream may be lost, and be taken again.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import optipmb_schemas as schemas
import structlog

from optipmb_service.runtime.ports import Packet
from optipmb_service.runtime.track_publisher import Arrival
from optipmb_service.session.checkpoint import CheckpointError
from optipmb_service.session.session import Session
from optipmb_service.session.values import Incarnation, total

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.session.checkpoint import Checkpoint

    Packets = list[tuple[Packet, bool]]

log = structlog.get_logger("optipmb_service")


class SessionOpening:
    """Restores or makes the session of one stream; for the tracking thread alone.

    Args:
        stream: the name of the session.
        context: what all actors share.
        fused: whether several streams feed the session.
    """

    def __init__(self, stream: str, context: ActorContext, *, fused: bool) -> None:
        self._stream = stream
        self._context = context
        self._fused = fused
        self._restore_only = False
        self.incarnation: Incarnation | None = None
        """What an earlier session of the stream left behind, while one is being opened; else None."""
        self._unread = Incarnation()
        """The highest ids of sessions whose checkpoints are of another version."""

    def start(self, *, restore_only: bool) -> bool:
        """Begin to open a session, which is to be loaded then; False when there is no room.

        Args:
            restore_only: whether one is wanted only if it was kept, and not closed.
        """
        self.incarnation = self._context.admit(self._stream)
        self._restore_only = restore_only and self.incarnation is not None
        return self.incarnation is not None

    def load(
        self, loaded: Callable[[Session | None, int | None, Packets], None], missed: Callable[[Packets], None]
    ) -> None:
        """Have the session restored on the thread of the store.

        Args:
            loaded: called once with the session, None if none was kept, the fence under which it was looked for, and
                packets that it has missed; on any thread.
            missed: called with more of these packets.
        """
        context, fence = self._context, self._context.member.fence(self._stream)
        taken: list[Checkpoint] = []

        def restore(checkpoint: Checkpoint) -> Session:
            now_ns = time.monotonic_ns()
            if self._unread != Incarnation():
                raise CheckpointError("older than one of another version, whose ids would be given out again")
            taken[:] = [checkpoint]
            if checkpoint.fused is not self._fused:
                raise CheckpointError(f"of {'several streams' if checkpoint.fused else 'one stream'}, by `fuse` then")
            return Session.restore(
                checkpoint, now_ns, context.policy, fence=fence or 1, instance=context.instance, tracker=context.tracker
            )

        def refused(error: CheckpointError) -> None:
            if (unread := error.incarnation) is not None:
                starts, next_id = max(self._unread.starts, unread.starts), max(self._unread.next_id, unread.next_id)
                self._unread = Incarnation(starts, next_id)

        def load(restored: Session | None) -> None:
            checkpoint = taken[-1] if restored and taken else None
            context.missed.fetch(self._stream, checkpoint, lambda packets: loaded(restored, fence, packets), missed)

        context.persistence.recall(self._stream, restore, load, refused)

    def is_outdated(self, fence: int | None) -> bool:
        """Whether the stream was lost and taken again: another instance may have gone on since it was loaded."""
        member = self._context.member
        return fence != member.fence(self._stream) and member.holds(self._stream)

    def is_wanted(self, restored: Session | None) -> bool:
        """Whether a session is to begin, now that it is known which one was kept."""
        is_closed = restored is None or not restored.counters.frames
        return self._context.member.holds(self._stream) and not (is_closed and self._restore_only)

    def release(self) -> None:
        """Give the room back: no session begins."""
        if self.incarnation is not None:
            self._context.release(self._stream, self.incarnation)
        self._context.member.look()

    def end(self) -> None:
        """End the opening: a session has begun, or none does."""
        self.incarnation, self._restore_only = None, False

    def begin(self, restored: Session | None, incarnation: Incarnation, fence: int | None) -> Session:
        """Return the session to go on with: the one that was restored, else a new one.

        Args:
            restored: the one that was kept, if any.
            incarnation: ids that an earlier session of the stream used.
            fence: of the partition.
        """
        context = self._context
        if restored is not None:
            context.metrics.restored()
            frames = restored.counters.frames
            log.info("session_restored", stream=self._stream, session=restored.session, frames=frames)
            if configured := self.configured(restored):
                in_force = restored.parameters.name
                log.warning("profile_differs", stream=self._stream, profile=in_force, configured=configured)
            return restored
        session = Session(
            self._stream,
            context.parameters_of(self._stream),
            context.policy,
            fused=self._fused,
            instance=context.instance,
            incarnation=Incarnation(
                max(incarnation.starts, self._unread.starts),
                max(incarnation.next_id, self._unread.next_id),
                total(incarnation.run, fence or 0),
            ),
            tracker=context.tracker,
        )
        log.info("session_opened", stream=self._stream, profile=session.parameters.name)
        return session

    def configured(self, session: Session) -> str | None:
        """Return the profile that the settings name where the session tracks with another one, or with other values."""
        wanted = self._context.parameters_of(self._stream)
        in_force = session.parameters
        same = in_force is wanted or in_force.model_copy(update={"horizons": wanted.horizons}) == wanted
        return None if same else wanted.name

    def pass_on(self, session: Session) -> None:
        """Keep what waits in a session for the instance that goes on with it: clouds of held frames come there."""
        keys, now_ns, wall_ns = self._context.keys, time.monotonic_ns(), time.time_ns()
        for message, ticket in session.unprocessed():
            frame = isinstance(message, schemas.Detections)
            payload, key = schemas.encode(message), (keys.detections if frame else keys.points)(message.stream)
            came = (ticket.wall_ns, ticket.now_ns) if isinstance(ticket, Arrival) else (wall_ns, now_ns)
            packet = Packet(key, payload, len(payload), schemas.encoding_of(message), *came)
            self._context.keep(self._stream, packet, frame=frame)

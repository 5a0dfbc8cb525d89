"""Opening of a stream's sessions: restored from a checkpoint and the message log, or new."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import optipmb_schemas as schemas
import structlog

from optipmb_service.session.checkpoint import CheckpointError
from optipmb_service.session.counts import total
from optipmb_service.session.identity import Incarnation
from optipmb_service.streams.outbox import Ticket
from optipmb_service.zenoh.topics import Packet

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.session import Session
    from optipmb_service.streams.backlog import Backlog
    from optipmb_service.streams.streams import Streams

    Opened = Callable[[Session, int | None, bool], None]

log = structlog.get_logger("optipmb_service")


class Opening:
    """The times at which a stream has no session yet, or none any more, because its checkpoint is read or written.

    Messages wait in the backlog meanwhile.

    Args:
        streams: of the process.
        policy: of the session.
        backlog: of the stream.
    """

    def __init__(self, streams: Streams, policy: Policy, backlog: Backlog) -> None:
        self._stream = backlog.session
        self._streams = streams
        self._parts = streams.parts
        self._policy = policy
        self._backlog = backlog
        self._incarnation: Incarnation | None = None
        """Incarnation of the earlier session while one is being opened, else None."""
        self._closing = False
        self._restore_only = False
        self._unread = Incarnation()
        """The highest numbers of sessions whose checkpoints are of another format, or have expired."""
        self._then: list[Callable[[], None]] = []

    @property
    def under_way(self) -> bool:
        """Whether a checkpoint is being read or written; for any thread."""
        return self._incarnation is not None or self._closing

    def wait(self, then: Callable[[], None]) -> None:
        """Call `then` as soon as it is no longer under way."""
        self._then.append(then)

    def begin(self, opened: Opened, first: Packet | None = None, *, restore_only: bool = False) -> bool:
        """Begin to open a session; False when there is no room.

        Args:
            opened: called on the tracking thread with the session, its fence, and whether it was restored.
            first: a packet that was taken already.
            restore_only: whether a session begins only if one was kept, and not closed.
        """
        self._incarnation = self._streams.admit(self._stream)
        if self._incarnation is None:
            return False
        self._restore_only = restore_only
        self._backlog.open(first)
        self._load(opened)
        return True

    def hand_over(self, session: Session) -> None:
        """Hold the pending messages of a session for the instance that goes on with it."""
        keys, traces, now_ns, wall_ns = self._parts.keys, self._parts.traces, time.monotonic_ns(), time.time_ns()
        for message, ticket in session.unprocessed():
            key = (keys.detections if isinstance(message, schemas.Detections) else keys.points)(message.stream)
            payload = schemas.encode(message)
            came, parent = (wall_ns, now_ns), ""
            if isinstance(ticket, Ticket):
                came = ticket.wall_ns, ticket.now_ns
                if traces and ticket.trace:
                    parent = traces.traceparent(ticket.trace.context)
            self._backlog.push(Packet(key, payload, len(payload), schemas.encoding_of(message), *came, parent))

    def close(self) -> None:
        """Have messages wait until the state of a session that ends is kept (`kept`)."""
        self._closing = True
        if self._backlog.state == "live":
            self._backlog.open()

    def kept(self) -> None:
        """Go on after the end of a session: its state is kept."""
        self._closing = False
        self._proceed()
        self._parts.member.look()

    def _load(self, opened: Opened) -> None:
        """Have the session restored, then missed frames read from the log, then `_loaded` called."""
        fence = self._parts.member.fence(self._stream)
        self._parts.checkpoints.recall(
            self._stream, partial(self._restore, fence), partial(self._fetch, opened, fence), self._note_unread
        )

    def _restore(self, fence: int | None, checkpoint: Checkpoint) -> tuple[Session, Checkpoint]:
        """Return the session of a checkpoint; on the thread of the store."""
        now_ns = time.monotonic_ns()
        if self._unread != Incarnation():
            raise CheckpointError("older than one of another format, whose ids would be given out again")
        if checkpoint.fused is not self._parts.fusion.is_session(self._stream):
            raise CheckpointError(f"of {'several streams' if checkpoint.fused else 'one stream'}, by `fuse` then")
        return self._parts.sessions.restored(checkpoint, self._policy, now_ns, fence or 1), checkpoint

    def _note_unread(self, incarnation: Incarnation) -> None:
        self._unread = self._unread.after(incarnation)

    def _fetch(self, opened: Opened, fence: int | None, found: tuple[Session, Checkpoint] | None) -> None:
        """Read the frames after a checkpoint from the log, if there is one; on the thread of the store."""
        restored, checkpoint = found or (None, None)

        def loaded(packets: list[Packet]) -> None:
            self._backlog.recover(packets)
            self._backlog.command(partial(self._loaded, opened, fence, restored), urgent=True)

        if self._parts.log is None:
            loaded([])
        else:
            self._parts.log.fetch(self._stream, checkpoint, loaded, self._backlog.recover)

    def _loaded(self, opened: Opened, fence: int | None, restored: Session | None) -> None:
        """Begin a session, or go on with the one that was kept, unless the stream was lost."""
        incarnation, holds = self._incarnation, self._parts.member.holds(self._stream)
        if incarnation is None:
            return
        if holds and fence != self._parts.member.fence(self._stream):
            # Lost and taken again: another instance may have gone on since it was loaded.
            self._backlog.forget_missed()
            self._load(opened)
            return
        closed = restored is None or not restored.counters.frames
        if holds and not (closed and self._restore_only):
            session = self._restored(restored) if restored else self._new(incarnation, fence)
            opened(session, fence, restored is not None)
        else:
            self._streams.admission.release(self._stream, incarnation)
            self._parts.member.look()
        self._incarnation, self._restore_only = None, False
        self._proceed()

    def _restored(self, session: Session) -> Session:
        self._parts.metrics.restored()
        frames = session.counters.frames
        log.info("session_restored", stream=self._stream, session=session.session, frames=frames)
        if configured := self._parts.sessions.differing_profile(session):
            in_force = session.parameters.name
            log.warning("profile_differs", stream=self._stream, profile=in_force, configured=configured)
        return session

    def _new(self, incarnation: Incarnation, fence: int | None) -> Session:
        numbers = incarnation.after(self._unread)
        numbers = replace(numbers, run=total(numbers.run, fence or 0))
        session = self._parts.sessions.new(self._stream, self._policy, numbers)
        log.info("session_opened", stream=self._stream, profile=session.parameters.name)
        return session

    def _proceed(self) -> None:
        """Go on with messages and commands that came meanwhile."""
        if self._backlog.state == "opening":
            if self._parts.member.holds(self._stream):
                self._backlog.go_live()
            else:
                self._backlog.leave()
        waiting, self._then = self._then, []
        for then in waiting:
            then()

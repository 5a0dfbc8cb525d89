"""What became of a stream's messages: what its sessions count while they last, and what never came to one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from optipmb_service.session.values import Counters, MessageCounters

if TYPE_CHECKING:
    from collections.abc import Sequence

    import optipmb_schemas as schemas

    from optipmb_service.runtime.mailbox import Mailbox
    from optipmb_service.session.session import Session


class _Accounts(NamedTuple):
    """What the totals are the sum of; replaced in one assignment, so whoever reads never sees them fall or doubled."""

    session: Session | None
    """The one that counts now."""
    base: Counters
    """What it had counted when it was opened."""
    opened: MessageCounters
    """The traffic at that time."""
    traffic: MessageCounters
    """What was counted beside it, and by the sessions before it."""


class StreamCounters:
    """The counts of one stream, so kept that every message received ends in one of them.

    Written by the tracking thread, read by whoever asks.

    Args:
        mailbox: of the stream; it counts what it sheds.
    """

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox
        self._accounts = _Accounts(None, Counters(), MessageCounters(), MessageCounters())
        self._shed_counted = 0
        self._clouds_shed_counted = 0

    def receive(self, *, frame: bool) -> None:
        """Count a message that goes to the session."""
        self._accounts.traffic.received += frame

    def refuse(self, session: Session | None, *, frame: bool) -> None:
        """Count a message that was none, or had no room."""
        traffic = self._accounts.traffic
        if not frame:
            traffic.clouds_refused += 1
        elif session is not None:
            session.refuse()
        else:
            traffic.received += 1
            traffic.refused += 1

    def drop(self, dropped: Sequence[bool]) -> int:
        """Count messages that were dropped while they waited, each with whether it was a frame; returns the frames."""
        frames, traffic = sum(dropped), self._accounts.traffic
        traffic.shed += frames
        traffic.received += frames
        traffic.clouds_shed += len(dropped) - frames
        return frames

    def pass_on(self, frames: int) -> None:
        """Do not count frames that waited here and will be tracked, and counted, by another instance."""
        self._accounts.traffic.received -= frames

    def shed(self) -> int:
        """Count what the mailbox shed since the last time; returns how many frames."""
        if (self._mailbox.shed_frames, self._mailbox.shed_clouds) == (self._shed_counted, self._clouds_shed_counted):
            return 0
        shed, _, clouds = self._mailbox.counts()
        fresh, self._shed_counted = shed - self._shed_counted, shed
        traffic = self._accounts.traffic
        traffic.clouds_shed += clouds - self._clouds_shed_counted
        self._clouds_shed_counted = clouds
        traffic.shed += fresh
        traffic.received += fresh
        return fresh

    def open(self, session: Session) -> None:
        """Begin to count with a session, which may have counted elsewhere before."""
        traffic = self._accounts.traffic
        self._accounts = _Accounts(session, session.counters, replace(traffic), traffic)

    def close(self) -> None:
        """Take over what the session that ends has counted here."""
        self._accounts = self._accounts._replace(session=None, traffic=self.totals())

    def totals(self) -> MessageCounters:
        """Return what became of messages since the actor is there; may be called by any thread."""
        session, base, _, traffic = self._accounts
        return traffic if session is None else traffic.since(base, session.counters)

    def state(self, session: Session) -> schemas.SessionState:
        """Return the state of a session with what was received and shed since it was opened."""
        shed, waiting, _ = self._mailbox.counts()
        uncounted = shed - self._shed_counted
        _, base, opened, traffic = self._accounts
        before = base.frames + base.duplicates + base.late + base.refused
        state = session.state(shed=traffic.shed - opened.shed + uncounted, queue=waiting)
        received = before + traffic.received - opened.received + uncounted + waiting
        clouds_refused = traffic.clouds_refused - opened.clouds_refused
        return state.model_copy(update={"received": received, "clouds_refused": clouds_refused})

"""Counts of the messages of one stream, through its sessions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from optipmb_service.session.counts import Counters, MessageCounters

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.session.session import Session
    from optipmb_service.streams.backlog import Backlog, Shed


class _Accounts(NamedTuple):
    """Terms of the totals, replaced in one assignment: readers never see a decrease or a message twice."""

    session: Session | None
    """Session that counts now."""
    base: Counters
    """Its counts when it was opened."""
    opened: MessageCounters
    """The traffic at that time."""
    traffic: MessageCounters
    """Counts of messages outside it, and of earlier sessions."""


class StreamCounters:
    """Counts of one stream: every message received ends in one of them.

    Written by the tracking thread, for any reader.

    Args:
        backlog: counts shed messages.
    """

    def __init__(self, backlog: Backlog) -> None:
        self._backlog = backlog
        self._shed: Shed = backlog.shed
        self._accounts = _Accounts(None, Counters(), MessageCounters(), MessageCounters())

    def receive(self, *, frame: bool) -> None:
        """Count a message that goes to the session."""
        self._accounts.traffic.received += frame

    def refuse(self, session: Session | None, *, frame: bool) -> None:
        """Count a message that was not valid, or had no room."""
        traffic = self._accounts.traffic
        if not frame:
            traffic.clouds_refused += 1
        elif session is not None:
            session.refuse()
        else:
            traffic.received += 1
            traffic.refused += 1

    def hand_over(self, frames: int) -> None:
        """Do not count pending frames that another instance will process and count."""
        self._accounts.traffic.received -= frames

    def open(self, session: Session) -> None:
        """Count with a session, which may have counted elsewhere before."""
        traffic = self._accounts.traffic
        self._accounts = _Accounts(session, session.counters, replace(traffic, shed=self._shed.frames), traffic)

    def close(self) -> None:
        """Add what the session that ends has counted here."""
        self._accounts = self._accounts._replace(session=None, traffic=self._counted())

    def totals(self) -> MessageCounters:
        """Return the counts since the stream was made; for any thread."""
        counted, frames = self._counted(), self._shed.frames
        return counted + MessageCounters(received=frames, shed=frames, clouds_shed=self._shed.clouds)

    def state(self, session: Session) -> schemas.SessionState:
        """Return the state of a session with the messages received and shed since it was opened."""
        waiting, shed, _ = self._backlog.counts()
        _, base, opened, traffic = self._accounts
        before = base.frames + base.duplicates + base.late + base.refused
        shed -= opened.shed
        received = before + traffic.received - opened.received + shed + waiting
        clouds_refused = traffic.clouds_refused - opened.clouds_refused
        state = session.state(shed=shed, queue=waiting)
        return state.model_copy(update={"received": received, "clouds_refused": clouds_refused})

    def _counted(self) -> MessageCounters:
        session, base, _, traffic = self._accounts
        return traffic if session is None else traffic.since(base, session.counters)

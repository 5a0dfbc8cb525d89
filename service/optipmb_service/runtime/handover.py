"""What members give each other of sessions whose partition has passed from one to the other: what came lately.

Who has the partition asks all others once for each session. Until all that is owed was asked for, the end of a process
waits, for a moment at most.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

from optipmb_service.cluster.leases import partition_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.ports import Packet
    from optipmb_service.runtime.registry import Registry

DRAIN_S: Final = 0.5
"""How long who is asked for what came lately waits for what is still on its way through this process."""

DRAIN_POLL_S: Final = 0.005


class Others(Protocol):
    """What is needed of the network."""

    def ask_recent(self, sessions: Sequence[str]) -> list[tuple[Packet, bool]]:
        """Return what other instances have received lately of sessions, each packet with whether it is a frame."""

    def pass_through(self, then: Callable[[], None]) -> None:
        """Call `then` when all that has come until now is handed over."""


class Handover:
    """Gives what was received of sessions that are tracked elsewhere now, and asks for that of those that came here.

    Args:
        registry: where messages go.
        member: says which partitions are held.
        others: the network.
    """

    def __init__(self, registry: Registry, member: Member, others: Others) -> None:
        self._registry = registry
        self._member = member
        self._others = others
        self._owed: set[str] = set()
        self._given = threading.Condition()

    def lost(self, partition: int) -> None:
        """Owe the sessions of a partition that was left."""
        with self._given:
            self._owed.update(self._registry.untracked.of_partitions({partition}))

    def kept(self, partition: int) -> None:
        """Owe nothing of a partition that is not left, or not yet."""
        with self._given:
            self._owed.difference_update(self._registry.untracked.of_partitions({partition}))

    def give(
        self, sessions: Collection[str], received: Callable[[int], bool], give: Callable[[Packet], None]
    ) -> set[int]:
        """Give what was received lately of sessions, the oldest first.

        Args:
            sessions: whose messages are asked for.
            received: whether messages of a partition are received here.
            give: takes each packet.

        Returns:
            The partitions of these sessions of which nothing is owed any longer.
        """
        asked = [session for session in sessions if self._may_have(session, received)]
        if asked:
            self._drain(asked)
            for packet in self._registry.untracked.recent(asked):
                give(packet)
            with self._given:
                self._owed.difference_update(asked)
                self._given.notify_all()
        # Who asks has subscribed already.
        still = {partition_of(session) for session in self._owed.copy()}
        return {partition_of(session) for session in sessions} - still

    def take(self, sessions: Sequence[str]) -> None:
        """Go on with sessions that came here, each with what others have received of it lately."""
        packets: dict[str, list[tuple[Packet, bool]]] = {session: [] for session in sessions}
        try:
            for packet, frame in self._others.ask_recent(sessions):
                _, session = self._registry.parsed(packet.key)
                if session in packets:
                    packets[session].append((packet, frame))
        finally:
            for session, found in packets.items():
                self._registry.take_up(session, found)

    def wait(self, timeout: float) -> bool:
        """Wait until all that is owed was asked for, at most so long (s); False when that was it."""
        with self._given:
            return self._given.wait_for(lambda: not self._owed, timeout)

    def _may_have(self, session: str, received: Callable[[int], bool]) -> bool:
        """Whether something of a session that is tracked elsewhere may have come, or be on its way through here."""
        if self._member.holds(session):
            return False
        return received(partition_of(session)) or session in self._registry.untracked

    def _drain(self, sessions: list[str]) -> None:
        """Wait for what is on its way through this process, for a moment at most."""
        ends = time.monotonic() + DRAIN_S
        passed = threading.Event()
        self._others.pass_through(passed.set)
        passed.wait(DRAIN_S)
        while any(self._registry.waits(session) for session in sessions) and time.monotonic() < ends:
            time.sleep(DRAIN_POLL_S)

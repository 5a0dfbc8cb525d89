"""What a stream sent while it was not tracked here: raw packets of the last seconds, for the moment of a takeover.

Who takes over restores the checkpoint, which is as old as the interval between checkpoints and the time in which the
death of the owner was noticed, and then hands these packets to the session. Most of them the session has seen; it drops
them. They wait undecoded, so they cost little but memory, which is bounded by time and, over all streams of the
instance, by bytes.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from optipmb_service.session.values import SECOND

if TYPE_CHECKING:
    from optipmb_service.runtime.byte_budget import ByteBudget
    from optipmb_service.runtime.ports import Packet

UNASKED_NS: Final = 120 * SECOND
"""Age at which packets are dropped that nobody has asked for yet, where the stream is new or has left a member."""

ANY_AGE_NS: Final = 2**62
"""No age is too high: the packets wait for a session that is about to take them."""


class TakeoverBuffer:
    """The waiting packets of one stream; not for several threads at once.

    Args:
        keep_ns: age at which a packet is dropped.
        budget: bytes that all streams share.
    """

    def __init__(self, keep_ns: int, budget: ByteBudget) -> None:
        self._keep_ns = keep_ns
        self._budget = budget
        self._packets: deque[tuple[Packet, bool, bool]] = deque()
        self.answered: set[str] = set()
        """Streams of which all has come that the publisher's cache holds."""
        self.unasked = False
        """Whether its member has yet to ask for what is kept, which takes long where many streams are new at once."""
        self.seen_ns = 0
        """When the stream was last heard of, monotonic; set by whoever keeps the buffer."""

    def __len__(self) -> int:
        return len(self._packets)

    def add(self, packet: Packet, *, frame: bool, own: bool = False) -> list[bool]:
        """Keep a packet; when there is no room, the oldest clouds of the stream go first, then its oldest frames.

        Args:
            packet: the packet.
            frame: whether it is a frame.
            own: whether it was received to be tracked here, so that it counts as lost when it is dropped.

        Returns:
            For each of these that was dropped, whether it was a frame.
        """
        lost = self.trim(packet.now_ns)
        self._packets.append((packet, frame, own))
        fits = self._budget.add(packet.held)
        while not fits and self._packets:
            cloud = next((index for index, (_, is_frame, _) in enumerate(self._packets) if not is_frame), 0)
            fits = self._drop(cloud, lost)
        return lost

    def trim(self, now_ns: int) -> list[bool]:
        """Drop what is old; returns the same as `add`."""
        lost: list[bool] = []
        keep_ns = max(self._keep_ns, UNASKED_NS) if self.unasked else self._keep_ns
        while self._packets and now_ns - self._packets[0][0].now_ns > keep_ns:
            self._drop(0, lost)
        if lost:  # nobody has asked for so long; what comes from others is kept as long as usual
            self.unasked = any(own for _, _, own in self._packets)
        return lost

    def pop(self) -> tuple[Packet, bool]:
        """Take the oldest packet, with whether it is a frame; there must be one."""
        packet, frame, _ = self._packets.popleft()
        self._budget.add(-packet.held)
        return packet, frame

    def take(self) -> list[tuple[Packet, bool]]:
        """Take all packets, the oldest first, each with whether it is a frame."""
        taken = self.kept()
        self._budget.add(-sum(packet.held for packet, _ in taken))
        self._packets.clear()
        return taken

    def kept(self) -> list[tuple[Packet, bool]]:
        """Return all packets, the oldest first, each with whether it is a frame."""
        return [(packet, frame) for packet, frame, _ in self._packets]

    def asked(self) -> list[tuple[Packet, bool]]:
        """Return the same for who goes on with the stream: from now on nothing is lost that is dropped."""
        self.unasked = False
        self._packets = deque((packet, frame, False) for packet, frame, _ in self._packets)
        return self.kept()

    def _drop(self, index: int, lost: list[bool]) -> bool:
        packet, frame, own = self._packets[index]
        del self._packets[index]
        if own:
            lost.append(frame)
        return self._budget.add(-packet.held)

"""Which frames of a publisher came: by epoch, the sequence numbers of a window; so duplicates and gaps are known."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from optipmb.records import record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.session.timeline import FrameId

WINDOW: Final = 1024
"""How many sequence numbers back a frame of an epoch is remembered; older unseen ones count as late."""

EPOCHS: Final = 32
"""How many publisher epochs are remembered."""


@record
class SeenNumbers:
    """Which frames of an epoch came.

    Attributes:
        epoch: whose.
        highest: highest sequence number.
        mask: bit i says whether `highest - i` came, for i below `WINDOW`.
    """

    epoch: bytes
    highest: int
    mask: int

    def has(self, seq: int) -> bool:
        """Whether a sequence number came, as far as that is remembered."""
        return 0 <= self.highest - seq < WINDOW and bool(self.mask >> (self.highest - seq) & 1)

    def add(self, seq: int) -> SeenNumbers:
        """Return it with one more sequence number."""
        ahead = seq - self.highest
        if ahead <= 0:
            return SeenNumbers(self.epoch, self.highest, self.mask | 1 << -ahead)
        # A sequence number may leap by 2^60: never shift further than the window is wide.
        shifted = self.mask << ahead if ahead < WINDOW else 0
        return SeenNumbers(self.epoch, seq, (shifted | 1) & ((1 << WINDOW) - 1))


def number_of(epochs: Sequence[SeenNumbers], epoch: bytes | None) -> int:
    """Return the place of an epoch among those of a publisher, -1 when it is none of them."""
    for number in range(len(epochs) - 1, -1, -1):
        if epochs[number].epoch == epoch:
            return number
    return -1


def remembered(epochs: tuple[SeenNumbers, ...], frame_id: FrameId) -> tuple[SeenNumbers, ...]:
    """Return the epochs of a publisher with one more frame that came."""
    number = number_of(epochs, frame_id.epoch)
    if number < 0:
        return (*epochs, SeenNumbers(frame_id.epoch, frame_id.seq, 1))[-EPOCHS:]
    return (*epochs[:number], epochs[number].add(frame_id.seq), *epochs[number + 1 :])


def reinstated(epochs: tuple[SeenNumbers, ...], epoch: bytes) -> tuple[SeenNumbers, ...]:
    """Return the epochs of a publisher with one of them in force that others have succeeded."""
    number = number_of(epochs, epoch)
    return (*epochs[:number], *epochs[number + 1 :], epochs[number])


def complete_until(epochs: Sequence[SeenNumbers], frame_id: FrameId, processed: tuple[bytes, int] | None) -> bool:
    """Whether no frame is missing between the last one processed of its epoch and this one."""
    number = number_of(epochs, frame_id.epoch)
    first = processed[1] + 1 if processed is not None and processed[0] == frame_id.epoch else 0
    if frame_id.seq - first > WINDOW or (number < 0 and frame_id.seq > first):
        return False
    return all(epochs[number].has(seq) for seq in range(first, frame_id.seq))

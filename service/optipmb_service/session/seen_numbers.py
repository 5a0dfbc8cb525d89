"""Which frames of a publisher came: by epoch, the sequence numbers of a window; so duplicates and gaps are known."""

from __future__ import annotations

import zlib
from array import array
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


class Checksums:
    """Checksums of the newest frames of a publisher, by which a repeated frame is told from another with its number."""

    def __init__(self) -> None:
        self._epoch = b""
        self._values = array("I")

    def add(self, epoch: bytes, seq: int, detections: bytes) -> None:
        """Remember a frame that came, by the bytes of its detections."""
        if epoch != self._epoch:
            self._epoch, self._values = epoch, array("I", bytes(array("I").itemsize * WINDOW))
        self._values[seq % WINDOW] = zlib.crc32(detections)

    def same(self, epoch: bytes, seq: int, detections: bytes) -> bool | None:
        """Return whether the frame that came with a number had these bytes; None: it is not known any more."""
        known = self._values[seq % WINDOW] if epoch == self._epoch else 0
        return known == zlib.crc32(detections) if known else None


class Claim:
    """Frames in a row of a publisher that another one has succeeded, while that one sends nothing."""

    def __init__(self) -> None:
        self._epoch = b""
        self._seq = -1
        self._count = 0
        self._since_ns = 0

    def clear(self) -> None:
        """Begin anew: the successor has sent a frame."""
        self._epoch = b""

    def add(self, frame_id: FrameId, *, frames: int, span_ns: int) -> bool:
        """Count a frame; return whether they are so many, over so long a time by their stamps."""
        if frame_id.epoch != self._epoch or frame_id.seq <= self._seq:
            self._epoch, self._count, self._since_ns = frame_id.epoch, 0, frame_id.stamp_ns
        self._seq = frame_id.seq
        self._count += 1
        return self._count >= frames and frame_id.stamp_ns - self._since_ns >= span_ns


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

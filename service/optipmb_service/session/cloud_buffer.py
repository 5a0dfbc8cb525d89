"""The point clouds of a stream that wait for their frames, or for which frames wait; found by their stamp.

A publisher sends its clouds under the epoch of its detections. Clouds of an epoch in which the stream has no detections
come from a program of their own and belong to whatever frame has their stamp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator

    import optipmb_schemas as schemas


class CloudBuffer:
    """A bounded shelf: one cloud per epoch and stamp, the newest arrival holds; when it is full the oldest goes.

    Args:
        most: number of clouds kept.
        most_bytes: bytes of points kept.
    """

    def __init__(self, most: int, most_bytes: int = 2**62) -> None:
        self._most = most
        self._most_bytes = most_bytes
        self.bytes = 0
        """Bytes of points kept now."""
        self._kept: dict[tuple[bytes, int], schemas.Points] = {}
        self.newest_ns: int | None = None
        """Stamp of the cloud that arrived last."""

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[schemas.Points]:
        return iter(self._kept.values())

    def bytes_beside(self, used: Container[int]) -> int:
        """Return the bytes of points kept of all clouds but some, given by `id`; may be called by any thread."""
        return sum(cloud.xyz.nbytes for cloud in tuple(self._kept.values()) if id(cloud) not in used)

    def add(self, cloud: schemas.Points) -> None:
        """Keep a cloud."""
        key = cloud.epoch, cloud.stamp_ns
        if key in self._kept:
            self._drop(key)
        self._kept[key] = cloud
        self.bytes += cloud.xyz.nbytes
        self.newest_ns = cloud.stamp_ns
        while len(self._kept) > self._most or (self.bytes > self._most_bytes and len(self._kept) > 1):
            self._drop(next(iter(self._kept)))

    def get(self, epoch: bytes, stamp_ns: int, publishers: Callable[[bytes], bool]) -> schemas.Points | None:
        """Return the cloud of a frame, None when it is not there; what another publisher of detections sent is not.

        Args:
            epoch: of the frame.
            stamp_ns: of the frame.
            publishers: whether detections came in an epoch.
        """
        own = self._kept.get((epoch, stamp_ns))
        if own is not None:
            return own
        others = (cloud for (whose, stamp), cloud in self._kept.items() if stamp == stamp_ns and not publishers(whose))
        return next(others, None)

    def full_behind(self, stamp_ns: int) -> bool:
        """Whether the shelf is full of clouds for frames later than a stamp: the next would push one of them off."""
        full = len(self._kept) >= self._most or self.bytes >= self._most_bytes
        return full and all(stamp > stamp_ns for _, stamp in self._kept)

    def forget_before(self, stamp_ns: int, reach_ns: int) -> None:
        """Drop the clouds before a stamp; those further back than `reach_ns` belong to frames after a jump."""
        gone = [key for key in self._kept if 0 < stamp_ns - key[1] <= reach_ns]
        for key in gone:
            self._drop(key)

    def _drop(self, key: tuple[bytes, int]) -> None:
        self.bytes -= self._kept.pop(key).xyz.nbytes

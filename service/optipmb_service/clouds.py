"""The point clouds of a stream that wait for their frames, or for which frames wait; found by their stamp."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas


class Clouds:
    """A bounded shelf: one cloud per stamp, the newest arrival holds; when it is full the oldest arrival goes.

    Args:
        most: number of clouds kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._by_stamp: dict[int, schemas.Points] = {}
        self.newest_ns: int | None = None
        """Stamp of the cloud that arrived last."""

    def __len__(self) -> int:
        return len(self._by_stamp)

    def add(self, cloud: schemas.Points) -> None:
        """Keep a cloud."""
        self._by_stamp.pop(cloud.stamp_ns, None)
        self._by_stamp[cloud.stamp_ns] = cloud
        self.newest_ns = cloud.stamp_ns
        while len(self._by_stamp) > self._most:
            del self._by_stamp[next(iter(self._by_stamp))]

    def get(self, stamp_ns: int) -> schemas.Points | None:
        """Return the cloud of a stamp, None when it is not there."""
        return self._by_stamp.get(stamp_ns)

    def forget_until(self, stamp_ns: int, reach_ns: int) -> None:
        """Drop the clouds up to the stamp of a processed frame; those further back belong to frames after a jump."""
        self._keep(lambda cloud: not 0 <= stamp_ns - cloud.stamp_ns <= reach_ns)

    def forget_publisher(self, epoch: bytes) -> None:
        """Drop what a stopped publisher left over: it must not be taken for its successor's."""
        self._keep(lambda cloud: cloud.epoch != epoch)

    def _keep(self, kept: Callable[[schemas.Points], bool]) -> None:
        self._by_stamp = {stamp: cloud for stamp, cloud in self._by_stamp.items() if kept(cloud)}

"""What a viewer of a stream gets: the newest tracks and detections as one line of JSON.

World frame, metres, radians, seconds; numbers are rounded to what can be seen.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas

if TYPE_CHECKING:
    from collections.abc import Sequence

_SENSORS: Final = 8
"""Detections of so many sensors are kept for a viewer of tracks that several share."""

_BYTES: Final = 2**22
"""And so many bytes of them, or one message."""

_MOST: Final = 1000
"""Tracks, and detections, in one frame at most."""

Sample = tuple[bytes, str]
"""Payload and encoding."""


class Newest:
    """Keeps the newest message of each topic for one reader on an event loop; what nobody took is replaced.

    Args:
        loop: of the reader.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._tracks: Sample | None = None
        self._detections: deque[Sample] = deque(maxlen=_SENSORS)
        self._event = asyncio.Event()
        self._heard = time.monotonic()

    def put(self, topic: str, payload: bytes, encoding: str) -> None:
        """Take a message, on any thread."""
        with self._lock:
            if topic == "detections":
                self._detections.appendleft((payload, encoding))
                while len(self._detections) > 1 and sum(len(one) for one, _ in self._detections) > _BYTES:
                    self._detections.pop()
                return  # it is shown with its tracks
            waits = self._tracks is not None
            self._tracks = (payload, encoding)
        if not waits and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._event.set)

    async def came(self, seconds: float) -> bool:
        """Wait for tracks, at most so long; tell whether there are any."""
        try:
            await asyncio.wait_for(self._event.wait(), seconds)
        except TimeoutError:
            return False
        return True

    def take(self) -> tuple[Sample | None, *tuple[Sample, ...]]:
        """Return the newest tracks, once, and the newest detections, the latest first."""
        self.heard()
        with self._lock:
            self._event.clear()
            tracks, self._tracks = self._tracks, None
            return tracks, *self._detections

    def heard(self) -> None:
        """Begin to count silence anew."""
        self._heard = time.monotonic()

    @property
    def silent_s(self) -> float:
        """Seconds since something was taken."""
        return time.monotonic() - self._heard


def live_frame(tracks: Sample | None, *detections: Sample) -> str | None:
    """Return what the page draws, as JSON; None for what is no valid message.

    Of detections, the latest first, those of each stream are drawn that come before another of the same stream.
    """
    if tracks is None:
        return None
    try:
        message = schemas.decode(tracks[0], schemas.Tracks, encoding=tracks[1])
    except schemas.MessageError:
        return None
    rows = np.column_stack(
        [
            message.center[:, :2],
            message.size[:, :2],
            message.yaw,
            message.velocity,
            message.existence,
            message.score,
            message.age,
            message.time_since_detection,
            np.ones(len(message.id)) if message.heading_confidence is None else message.heading_confidence,
        ]
    )
    confirmed = np.ones(len(rows), np.bool_) if message.confirmed is None else message.confirmed > 0
    numbers = np.round(rows[confirmed][:_MOST], 3).tolist()
    heads = zip(message.id[confirmed].tolist(), message.label[confirmed].tolist(), numbers, strict=False)
    sensor, found = _seen(detections)
    frame: dict[str, Any] = {
        "time": message.stamp_ns / 1e9,
        "session": message.session,
        "profile": message.profile,
        "labels": message.labels,
        "tracks": [[identity, label, *values] for identity, label, values in heads],
        "unconfirmed": int((~confirmed).sum()),
        "sensor": sensor,
        "detections": found,
    }
    return json.dumps(frame, separators=(",", ":"))


def _seen(samples: Sequence[Sample]) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the newest sensor, where it is known, and x, y of all detections, in the world frame."""
    sensor: list[float] | None = None
    found: list[list[float]] = []
    streams: set[str] = set()
    for number, sample in enumerate(samples):
        try:
            message = schemas.decode(sample[0], schemas.Detections, encoding=sample[1])
        except schemas.MessageError:
            continue
        if message.stream in streams:
            break
        streams.add(message.stream)
        place, centers = _placed(message)
        sensor = sensor if number else place
        found += centers
    return sensor, found


def _placed(message: schemas.Detections) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the sensor, where it is known, and x, y of the detections, in the world frame."""
    center, sensor = message.center[:_MOST], None
    if message.pose is not None:
        w, x, y, z = message.pose.quaternion
        rows = np.array(  # the first two rows of the rotation: what is seen from above
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            ]
        )
        place = message.pose.translation[:2]
        sensor = np.round([*place, np.arctan2(rows[1, 0], rows[0, 0])], 3).tolist()
        if message.frame == "sensor":
            center = center @ rows.T + place
    return sensor, np.round(center[:, :2], 2).tolist()

"""Tracks of a time that has passed: from the log, or from what is kept for subscribers that come late.

Messages are given as they were published. Of a frame that was published several times the tracks that hold are given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import optipmb_schemas as schemas

from optipmb_service.runtime.ports import TransportError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.cluster.message_log import LogReader

MOST: Final = 256
"""Frames of an answer, unless more have one stamp."""

MOST_BYTES: Final = 2**22
"""Bytes of an answer, but for its first stamp."""

LATE_NS: Final = 5_000_000_000
"""How much later in the log the tracks of a frame may be corrected; by stamps. Frames are inserted for a second."""


class Published(Protocol):
    """Tracks as they were published, and what they are of."""

    @property
    def epoch(self) -> bytes:
        """Epoch of the frame."""

    @property
    def seq(self) -> int:
        """Number of the frame."""

    @property
    def sensor(self) -> str:
        """Whose frame it is, in a session of several sensors; else empty."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame."""

    @property
    def order(self) -> tuple[int, int]:
        """Higher in the tracks of a frame that hold."""

    @property
    def payload(self) -> bytes:
        """Their bytes."""

    @property
    def encoding(self) -> str:
        """Their Zenoh encoding."""


class KeptTracks(Protocol):
    """Where tracks are kept."""

    def find(self, stream: str, wanted: TracksRange, then: Callable[[str], None]) -> None:
        """Put what is kept into a range, and call `then` with the reason when it cannot be read.

        It is called on a thread that it must not keep.
        """


class TracksRange:
    """The tracks with stamps from one to another, as many as an answer takes.

    Args:
        from_ns: first stamp.
        to_ns: last stamp; None: up to the newest.
        most: frames that it takes.
        most_bytes: bytes that it takes.
    """

    def __init__(self, from_ns: int, to_ns: int | None, most: int = MOST, most_bytes: int = MOST_BYTES) -> None:
        self.from_ns = from_ns
        self.known = False
        """Whether anything is kept of the stream, in the range or not."""
        self.cut_ns: int | None = None
        """The stamp from which on there is more; None: this is all."""
        self._to_ns = to_ns
        self._most = most
        self._most_bytes = most_bytes
        self._frames: dict[tuple[bytes, int, str], Published] = {}

    def add(self, messages: Iterable[Published]) -> bool:
        """Take messages in the order of their publication; False: no later one belongs here."""
        latest_ns = 0
        for one in messages:
            self.known = True
            latest_ns = max(latest_ns, one.stamp_ns)
            if one.stamp_ns < self.from_ns or (self._to_ns is not None and one.stamp_ns > self._to_ns):
                continue
            frame = one.epoch, one.seq, one.sensor
            known = self._frames.get(frame)
            if known is None or one.order >= known.order:
                self._frames[frame] = one
        self._cut()
        return self._to_ns is None or latest_ns <= self._to_ns + LATE_NS

    def messages(self) -> list[Published]:
        """Return the messages by their stamps."""
        return sorted(self._frames.values(), key=lambda one: (one.stamp_ns, one.sensor, one.seq))

    def _cut(self) -> None:
        """Leave out what an answer does not take: from a stamp on everything."""
        size = 0
        ordered = self.messages()
        for count, one in enumerate(ordered):
            size += len(one.payload)
            if (count >= self._most or size > self._most_bytes) and one.stamp_ns > ordered[0].stamp_ns:
                self.cut_ns = one.stamp_ns
                self._to_ns = one.stamp_ns - 1
                self._frames = {frame: kept for frame, kept in self._frames.items() if kept.stamp_ns < one.stamp_ns}
                return


class RecentTracks:
    """What is kept for subscribers that come late: the newest tracks of those who track the stream now.

    Args:
        recent: returns what the caches hold for a stream, each message with its encoding.
        limits: of messages.
    """

    def __init__(self, recent: Callable[[str], Sequence[tuple[bytes, str]]], limits: schemas.Limits) -> None:
        self._recent = recent
        self._limits = limits

    def find(self, stream: str, wanted: TracksRange, then: Callable[[str], None]) -> None:
        """Ask the caches."""
        try:
            found = [self._read(*one) for one in self._recent(stream)]
        except TransportError as error:
            then(str(error))
            return
        wanted.add(one for one in found if one is not None)
        then("")

    def _read(self, payload: bytes, encoding: str) -> _Recent | None:
        try:
            tracks = schemas.decode(payload, schemas.Tracks, encoding=encoding, limits=self._limits)
        except schemas.MessageError:  # of somebody else
            return None
        frame = tracks.epoch, tracks.seq, tracks.sensor or "", tracks.stamp_ns
        return _Recent(*frame, order_of(tracks), payload, encoding)


class LoggedTracks:
    """What is in the log.

    Args:
        reader: reads the log.
    """

    def __init__(self, reader: LogReader) -> None:
        self._reader = reader

    def find(self, stream: str, wanted: TracksRange, then: Callable[[str], None]) -> None:
        """Read the log."""
        self._reader.tracks(stream, max(0, wanted.from_ns - LATE_NS), wanted.add, then)


class _Recent(NamedTuple):
    epoch: bytes
    seq: int
    sensor: str
    stamp_ns: int
    order: tuple[int, int]
    payload: bytes
    encoding: str


def order_of(tracks: schemas.Tracks) -> tuple[int, int]:
    """Return what is higher in the tracks of a frame that hold."""
    return tracks.delivery.run if tracks.delivery else 0, tracks.revision

"""Messages of the streams of an area: which of them count, and until when they have come.

The newest messages of each stream wait for the next common time. A message counts once, also where messages come in
another order. A stream whose clock is far from most others is left out.
"""

from __future__ import annotations

import collections
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from optipmb_service.links.kinds import kinds_of
from optipmb_service.links.views import GRID_NS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from optipmb_schemas import Tracks

    from optipmb.model.rows import Array, Index
    from optipmb_service.links.places import WorldFrame

    Singles = NDArray[np.float32]

WAIT_NS: Final = 10**9
"""How far the furthest stream may be ahead of a common time before that is decided without the others."""
FRESH_NS: Final = 10**9
"""Age at which a track that is not detected, or a message, does not count any more."""
LONG_NS: Final = 2 * 10**9
"""Longest age that is kept of a track, which is fresh, and of an object, which has begun, for less."""
CLOCK_NS: Final = 2 * 10**9
"""Largest difference of a stream's clock from most other clocks."""
STUCK_NS: Final = 5 * 10**9
"""A stream whose stamps have been behind for so long has set its clock back."""
MOST_STREAMS: Final = 64
MOST_TRACKS: Final = 2000
"""Tracks of a message; of more the first count."""
MOST_LOOKS: Final = 64
"""Messages of a stream that wait for a common time."""
EXISTS: Final = 0.5
"""Least existence of a track where none says that it is confirmed."""


class Look(NamedTuple):
    """What counts of a message, in the plane of the area; small numbers, for it is part of the state."""

    stamp_ns: int
    session: int
    object: Index  # (N,)
    id: Index | None  # where it is not `object`
    place: Array
    velocity: Singles
    covariance: Singles  # (N, 3)
    variance: Singles  # (N,) of the velocity
    size: Singles
    kind: NDArray[np.int8]
    age_ns: NDArray[np.int32]  # up to `LONG_NS`
    since_ns: NDArray[np.int32]
    vectors: Singles | None


@dataclass
class InputStream:
    """A stream of an area and its newest messages."""

    name: str
    number: int
    frame: WorldFrame
    session: str = ""
    session_number: int = -1
    begun_ns: int = 0
    """Stamp of the first message of the session."""
    newest_ns: int = -1
    accepted_ns: int = 0
    """Arrival of the newest accepted message."""
    offset_ns: int = 0
    """Arrival less stamp of the newest message."""
    looks: collections.deque[Look] = field(default_factory=collections.deque)
    used_ns: int = -1
    """Stamp of the newest message that counted."""

    def until(self, stamp_ns: int) -> list[Look]:
        """Return the newest fresh message until a time, after earlier ones with vectors; drop those before it."""
        found = []
        while len(self.looks) > 1 and self.looks[1].stamp_ns <= stamp_ns:
            look = self.looks.popleft()
            if look.vectors is not None and look.stamp_ns > self.used_ns:
                found.append(look)
        if self.looks and self.looks[0].stamp_ns <= stamp_ns:
            found.append(self.looks[0])
        return [one for one in found if one.stamp_ns > stamp_ns - FRESH_NS]

    def add(self, look: Look) -> bool:
        """Add a message in the order of stamps; return whether the oldest was dropped for it."""
        at = len(self.looks)
        while at and self.looks[at - 1].stamp_ns > look.stamp_ns:
            at -= 1
        self.looks.insert(at, look)
        if is_full := len(self.looks) > MOST_LOOKS:
            self.looks.popleft()
        return is_full


class LinkInputs:
    """The streams of an area, with problems of them.

    Attributes:
        streams: by name.
        counters: messages and others that were left out, by reason.
        problems: present ones, by stream and code.
        is_set_back: whether common times begin again.

    Args:
        frame: returns the world frame of a stream.
    """

    def __init__(self, frame: Callable[[str], WorldFrame]) -> None:
        self.frame = frame
        self.streams: dict[str, InputStream] = {}
        self.counters: collections.Counter[str] = collections.Counter()
        self.problems: dict[tuple[str, str], str] = {}
        self.is_set_back = False

    def say(self, stream: str, code: str, text: str) -> None:
        """Note that something is wrong with a stream; empty: not any more."""
        if text:
            self.counters[code] += 1
            if len(self.problems) < 2 * MOST_STREAMS or (stream, code) in self.problems:
                self.problems[stream, code] = text
        else:
            self.problems.pop((stream, code), None)

    def accept(self, message: Tracks, arrived_ns: int, next_ns: int) -> InputStream | None:
        """Return the stream of a message that counts, None for another message.

        Args:
            message: the tracks of a frame.
            arrived_ns: when they came.
            next_ns: the next common time.
        """
        stream, offset = self.streams.get(message.stream), arrived_ns - message.stamp_ns
        if stream is None:
            if len(self.streams) >= MOST_STREAMS:
                self.say(message.stream, "too_many_streams", f"at most {MOST_STREAMS} streams in an area")
                return None
            stream = InputStream(message.stream, len(self.streams), self.frame(message.stream), offset_ns=offset)
            self.streams[message.stream] = stream
        since = max(arrived_ns - stream.accepted_ns, 0)
        if stream.newest_ns >= 0 and offset < stream.offset_ns - CLOCK_NS and since < STUCK_NS:
            apart = stream.offset_ns - offset  # one stamp is not believed against those before
            self.say(stream.name, "wrong_clock", f"a stamp is {apart * 1e-9:+.1f} s from those before")
            return None
        stream.offset_ns = offset if stream.newest_ns < 0 else min(offset, stream.offset_ns + since // 10)
        reference = self._reference(arrived_ns, stream)
        if self._is_off(stream, reference):
            return None
        if next_ns - GRID_NS > arrived_ns - reference + 2 * CLOCK_NS:
            self._set_back()
            stream.offset_ns, next_ns = offset, -1
        if not self._is_next(stream, message, arrived_ns, next_ns):
            return None
        stream.newest_ns = max(stream.newest_ns, message.stamp_ns)
        stream.accepted_ns = arrived_ns
        return stream

    def until_ns(self) -> tuple[int, int]:
        """Return the stamps of the first waiting message, and until which all streams have come that are not late."""
        newest = [one.newest_ns for one in self.streams.values() if one.newest_ns >= 0]
        latest = max(newest)
        first = min(one.looks[0].stamp_ns for one in self.streams.values() if one.looks)
        return first, min(one for one in newest if one >= latest - WAIT_NS)

    def add(self, stream: InputStream, message: Tracks, vectors: Singles | None) -> None:
        """Keep what counts of an accepted message until its common time."""
        sure = message.existence >= EXISTS if message.confirmed is None else message.confirmed > 0
        joined = message.object if message.object is not None else message.id
        own = np.where(joined >= 0, joined, message.id)
        rows = np.flatnonzero(sure)
        if len(rows) > MOST_TRACKS:
            self.say(stream.name, "too_many_tracks", f"{len(rows)} tracks, of which the first {MOST_TRACKS} count")
            rows = rows[:MOST_TRACKS]
        rows = rows[np.sort(np.unique(own[rows], return_index=True)[1])]
        frame, covariance = stream.frame, message.covariance[rows]
        speed = np.hypot(*message.velocity[rows].T)
        cos, sin = np.cos(frame.yaw), np.sin(frame.yaw)
        xx, yy = (np.clip(covariance[:, k, k], 1e-4, 1e4) for k in (0, 1))
        xy = np.clip(covariance[:, 0, 1], -0.99 * np.sqrt(xx * yy), 0.99 * np.sqrt(xx * yy))
        turned = np.column_stack(
            (
                cos**2 * xx - 2.0 * cos * sin * xy + sin**2 * yy,
                cos * sin * (xx - yy) + (cos**2 - sin**2) * xy,
                sin**2 * xx + 2.0 * cos * sin * xy + cos**2 * yy,
            )
        )
        unsure = 0.5 * (covariance[:, 2, 2] + np.square(speed) * np.clip(covariance[:, 3, 3], 0.0, 10.0))
        look = Look(
            message.stamp_ns,
            stream.session_number,
            own[rows],
            None if np.array_equal(own[rows], message.id[rows]) else message.id[rows],
            frame.turned(message.center[rows, :2]) + np.array((frame.x, frame.y)),
            frame.turned(message.velocity[rows]).astype(np.float32),
            turned.astype(np.float32),
            np.clip(unsure, 1e-3, 1e4).astype(np.float32),
            np.log(message.size[rows]).astype(np.float32),
            kinds_of(message.labels)[message.label[rows]].astype(np.int8),
            np.minimum(1e9 * message.age[rows], LONG_NS).astype(np.int32),
            np.minimum(1e9 * message.time_since_detection[rows], LONG_NS).astype(np.int32),
            None if vectors is None else vectors[rows],
        )
        if stream.add(look):
            self.counters["shed"] += 1

    def packed(self, pack: Callable[[Any], Any]) -> list[Any]:
        """Return the streams as a state holds them."""
        return [
            (
                (one.name, one.number, one.session, one.session_number, one.begun_ns),
                (one.newest_ns, one.accepted_ns, one.offset_ns, one.used_ns),
                [(look.stamp_ns, look.session, [pack(column) for column in look[2:]]) for look in one.looks],
            )
            for one in self.streams.values()
        ]

    def restore(self, streams: list[Any], unpack: Callable[[Any], Any]) -> None:
        """Take the streams of a state."""
        for (name, *header), times, looks in streams:
            stream = InputStream(name, header[0], self.frame(name), *header[1:])
            stream.newest_ns, stream.accepted_ns, stream.offset_ns, stream.used_ns = times
            stream.looks.extend(Look(one[0], one[1], *map(unpack, one[2])) for one in looks)
            self.streams[name] = stream

    def _set_back(self) -> None:
        """Begin all streams again, for the common time is ahead of all clocks that agree.

        A stream with a wrong clock was there before the others, or most clocks were set back.
        """
        for one in self.streams.values():
            one.looks.clear()
            one.newest_ns = one.used_ns = -1
        self.is_set_back = True
        self.say("", "set_back", "the clocks of most streams are behind those before: all links begin again")

    def _reference(self, arrived_ns: int, stream: InputStream) -> int:
        """Return the offset of most clocks; of two equal groups, that which is nearer to the clock of the receiver."""
        others = [
            one.offset_ns
            for one in self.streams.values()
            if one is stream or (one.newest_ns >= 0 and arrived_ns - one.accepted_ns < 10 * STUCK_NS)
        ]
        offsets = np.array(others)
        agree = (np.abs(offsets[:, None] - offsets) <= CLOCK_NS).sum(axis=1)
        return int(offsets[np.lexsort((np.abs(offsets), -agree))[0]])

    def _is_off(self, stream: InputStream, reference: int) -> bool:
        """Return whether the clock of a stream is far from most other clocks."""
        apart = reference - stream.offset_ns
        is_off = abs(apart) > CLOCK_NS
        text = f"its stamps are {apart * 1e-9:+.1f} s from other streams" if is_off else ""
        self.say(stream.name, "wrong_clock", text)
        return is_off

    def _is_next(self, stream: InputStream, message: Tracks, arrived_ns: int, next_ns: int) -> bool:
        """Return whether a message may still count."""
        stamp = message.stamp_ns
        late = stamp <= max(stream.used_ns, next_ns - GRID_NS)
        late |= message.session != stream.session and stamp <= stream.newest_ns
        if late and stream.newest_ns >= 0 and arrived_ns - stream.accepted_ns > STUCK_NS:
            stream.looks.clear()
            stream.newest_ns = stream.used_ns = -1
            stream.offset_ns = arrived_ns - stamp
            late = stamp <= next_ns - GRID_NS
        if late or any(one.stamp_ns == stamp for one in stream.looks):
            self.counters["late" if late else "repeated"] += 1
            stream.newest_ns = max(stream.newest_ns, stamp)  # the next common time waits for this stream
            return False
        return True

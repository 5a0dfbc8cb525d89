"""From messages that come at least once to tracks that are there exactly once.

The service publishes the tracks of a frame again when a late frame corrects them (a higher `revision`), and after a
restart when it goes over frames that it had published before (a higher `delivery.run`). Of each frame the latest run,
and in it the latest revision, holds. A message with the same tracks again is a repetition, even if its numbers
are higher.
"""

import collections
import enum
import hashlib
from typing import NamedTuple, TypeVar

from optipmb_schemas import Events, Tracks

MOST_HELD = 4096
"""Messages held of a stream; beyond it the oldest are dropped, as when a service cannot write checkpoints."""
MOST_SESSIONS = 1024
"""Sessions of a stream whose order is remembered."""
MOST_STREAMS = 65_536
"""Streams of which a reader remembers something: as many as a cluster knows."""

K = TypeVar("K")
V = TypeVar("V")


def remember(entries: "collections.OrderedDict[K, V]", key: K, value: V) -> V:
    """Set the value of a key as the newest of `MOST_STREAMS` entries, and return it."""
    entries[key] = value
    entries.move_to_end(key)
    if len(entries) > MOST_STREAMS:
        entries.popitem(last=False)
    return value


class Novelty(enum.Enum):
    """What a message brings."""

    NEW = "the first tracks of its frame"
    CORRECTION = "other tracks of a frame that replace those before"
    REPEATED = "nothing: the same tracks, or older ones"


class _Newest(NamedTuple):
    """Digest of the tracks of a frame that hold, and the newest (run, revision) of each session."""

    digest: bytes
    newest: dict[str, tuple[int, int]]


class Merging:
    """Remembers what holds of each of the newest `capacity` frames, by numbers and a digest: some 500 bytes each."""

    def __init__(self, capacity: int) -> None:
        self._frames: collections.OrderedDict[tuple[str, str | None, bytes, int], _Newest] = collections.OrderedDict()
        self._capacity = capacity

    def take(self, tracks: Tracks) -> Novelty:
        """Tell what a message brings, and remember it."""
        key = tracks.stream, tracks.sensor, tracks.epoch, tracks.seq
        order = (tracks.delivery.run if tracks.delivery else 0, tracks.revision)
        known = self._frames.get(key)
        # A service without checkpoints starts a new session, and counts from 0: its tracks hold too.
        if known is not None and order <= known.newest.get(tracks.session, (-1, 0)):
            return Novelty.REPEATED
        digest = _digest(tracks)
        self._frames[key] = _Newest(digest, {**(known.newest if known else {}), tracks.session: order})
        if known is not None:
            return Novelty.REPEATED if digest == known.digest else Novelty.CORRECTION
        if len(self._frames) > self._capacity:
            self._frames.popitem(last=False)
        return Novelty.NEW


def _digest(tracks: Tracks) -> bytes:
    """Return a digest of everything that is the same when the same tracks are sent again."""
    digest = hashlib.blake2b(digest_size=16)
    for name, value in tracks.present():
        if name in tracks.arrays:
            digest.update(value.tobytes())
        elif name not in {"delivery", "revision"}:
            digest.update(repr(value).encode())
    return digest.digest()


class FinalEvents:
    """Holds events of a stream until they are final, and gives out each message once, in the order of the frames.

    A run that goes on for another publishes again all events that are not final. So a later run voids the messages held
    of earlier ones, except of the last final frame.
    """

    def __init__(self) -> None:
        self.held: dict[tuple[str | None, bytes, int], Events] = {}
        """Messages that may still change, the newest of each frame."""
        self._sessions: dict[str, int] = {}
        self._count = 0
        self._run = 0
        self._final = 0, 0

    def take(self, message: Events) -> list[Events]:
        """Add a message; return the messages that are final now."""
        delivery, run, is_new = message.delivery, _run(message), message.session not in self._sessions
        if run < self._run and not is_new:
            return []
        if is_new:  # without checkpoints its runs count from 0 again
            self._count += 1
            self._sessions[message.session] = self._count
            if len(self._sessions) > MOST_SESSIONS:
                del self._sessions[next(iter(self._sessions))]
        if delivery and delivery.final_session in self._sessions:
            self._final = max(self._final, (self._sessions[delivery.final_session], delivery.final_ns or 0))
        if run > self._run:
            valid = (one for one in self.held.items() if _run(one[1]) >= run or self._place(one[1]) <= self._final)
            self.held = dict(valid)
        self._run = run
        frame = message.sensor, message.epoch, message.seq
        if self._place(message) >= self._final:
            known = self.held.get(frame, message)
            self.held[frame] = max(known, message, key=lambda one: (_run(one), one.revision))
        final = [frame for frame, one in self.held.items() if self._place(one) < self._final]
        released = [self.held.pop(frame) for frame in final]
        while len(self.held) > MOST_HELD:
            del self.held[next(iter(self.held))]
        return sorted(
            (one for one in released if one.events or one.zones),
            key=lambda one: (self._place(one), one.sensor or "", one.seq),
        )

    def _place(self, message: Events) -> tuple[int, int]:
        return self._sessions.get(message.session, 0), message.stamp_ns


class FinalEventsOfStreams:
    """Holds events of many streams until they are final, as `FinalEvents`; of those silent the longest none."""

    def __init__(self) -> None:
        self._streams: collections.OrderedDict[str, FinalEvents] = collections.OrderedDict()

    def take(self, message: Events) -> list[Events]:
        """Add a message; return the messages of its stream that are final now."""
        of_stream = self._streams.get(message.stream) or FinalEvents()
        return remember(self._streams, message.stream, of_stream).take(message)


def _run(message: Events) -> int:
    return message.delivery.run if message.delivery else 0

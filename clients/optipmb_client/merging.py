"""From messages that come at least once to tracks that are there exactly once.

The service publishes the tracks of a frame again when a late frame corrects them (a higher `revision`), and after a
restart when it goes over frames that it had published before (a higher `delivery.run`). Of each frame the latest run,
and in it the latest revision, holds. A message with the same tracks again is a repetition, even if its numbers
are higher.
"""

import collections
import enum
import hashlib
from typing import NamedTuple

from optipmb_schemas import Tracks


class Novelty(enum.Enum):
    """What a message brings."""

    NEW = "the first tracks of its frame"
    CORRECTION = "other tracks of a frame that replace those before"
    REPEATED = "nothing: the same tracks, or older ones"


class _Frame(NamedTuple):
    """Digest of the tracks of a frame that hold, and the newest (run, revision) of each session."""

    digest: bytes
    newest: dict[str, tuple[int, int]]


class Merging:
    """Remembers what holds of each of the newest `capacity` frames, by numbers and a digest: some 500 bytes each."""

    def __init__(self, capacity: int) -> None:
        self._frames: collections.OrderedDict[tuple[str, str | None, bytes, int], _Frame] = collections.OrderedDict()
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
        self._frames[key] = _Frame(digest, {**(known.newest if known else {}), tracks.session: order})
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

"""What is new to a call: its subscriptions also bring again what was published before they began."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from optipmb_schemas.protobuf.convert import EncodedTracks

    from optipmb_service.grpc.feeds import Item

MAX_EARLY: Final = 1024
"""Most items that wait until it is known what the caches hold."""

Publication = tuple[str, str, bytes, int, int, int]
"""One publication of the tracks of a frame: stream, sensor, epoch, number, run, revision."""


class Fresh:
    """Passes on what the caches did not hold when they were asked.

    At the next heartbeat of a publisher, recovery sends a subscriber that has heard nothing yet all that is cached.

    Args:
        take: called with what is new.
    """

    def __init__(self, take: Callable[[Item], None]) -> None:
        self._take = take
        self._known: set[Publication] = set()
        self._early: list[Item] | None = []  # what came before it was known what the caches hold

    def put(self, item: Item) -> None:
        """Pass on an item, now or when the caches have been asked, or leave it out."""
        if self._early is not None and len(self._early) < MAX_EARLY:
            self._early.append(item)
        elif item.tracks is None or _publication(item.tracks) not in self._known:
            self._take(item)

    def begin(self, held: Iterable[EncodedTracks]) -> None:
        """Take in what the caches hold, and pass on what else came while they were asked."""
        self._known = {_publication(tracks) for tracks in held}
        early, self._early = self._early or [], None
        for item in early:
            self.put(item)


def order(tracks: EncodedTracks) -> tuple[int, int]:
    """Return what later publications of a frame have more of: the run, and in it the revision."""
    return tracks.run, tracks.revision


def _publication(tracks: EncodedTracks) -> Publication:
    return (tracks.stream, tracks.sensor, tracks.epoch, tracks.seq, *order(tracks))

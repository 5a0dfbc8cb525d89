"""The streams that a discoverer announces, by tokens of many streams each.

What a router takes to declare a token grows with how many tokens there are, for each that watches them: with a token
for each stream it was most of what a new stream cost, and with 10,000 streams beyond what one router can do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet

    import optipmb_schemas as schemas
    from optipmb_client.zenoh.handles import Declared
    from optipmb_client.zenoh.session import Session

MOST: Final = 32
"""Streams of one token. A stream that comes or goes costs those who watch as many names as its token has."""


class Announcements:
    """The tokens of one instance.

    All have as many streams as one may have, but for one token.

    Args:
        session: to declare on.
        keys: of the network.
        instance: who announces.
        run: tells this process from others of its name.
    """

    def __init__(self, session: Session, keys: schemas.Keys, instance: str, run: str) -> None:
        self._session, self._keys, self._instance, self._run = session, keys, instance, run
        self._groups: dict[str, tuple[str, ...]] = {}
        """The group of each stream that is announced."""
        self._tokens: dict[tuple[str, ...], Declared] = {}

    def announce(self, streams: AbstractSet[str]) -> None:
        """Announce these streams, and no others; those that stay are announced all the time."""
        new = sorted(streams - self._groups.keys())
        gone = self._groups.keys() - streams
        if not new and not gone:
            return
        left = {self._groups[stream] for stream in gone} | {group for group in self._tokens if len(group) < MOST}
        pool = [stream for group in sorted(left) for stream in group if stream not in gone] + new
        groups = [tuple(pool[first : first + MOST]) for first in range(0, len(pool), MOST)]
        for group in groups:
            if group not in self._tokens:
                self._tokens[group] = self._session.token(self._keys.discovered(group, self._instance, self._run))
            self._groups.update(dict.fromkeys(group, group))
        for group in left.difference(groups):
            self._tokens.pop(group).close()
        for stream in gone:
            del self._groups[stream]

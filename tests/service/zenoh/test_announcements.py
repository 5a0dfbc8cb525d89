"""Streams that a discoverer announces: the tokens after any changes."""

import random
from typing import Any

import pytest
from optipmb_schemas import Keys
from optipmb_service.streams.directory import StreamDirectory
from optipmb_service.zenoh.transport import ANNOUNCED, Announcements

KEYS = Keys()


class Tokens:
    def __init__(self) -> None:
        self.now: set[str] = set()
        self.heard = StreamDirectory("other", 1, lambda _: True)

    def token(self, key: str) -> "Token":
        assert key not in self.now
        self.now.add(key)
        self._tell(key, present=True)
        return Token(self, key)

    def withdraw(self, key: str) -> None:
        self.now.remove(key)
        self._tell(key, present=False)

    @property
    def announced(self) -> list[str]:
        return sorted(stream for key in self.now for stream in KEYS.discovered_streams(key))

    def _tell(self, key: str, *, present: bool) -> None:
        for stream in KEYS.discovered_streams(key):
            self.heard.discovered(stream, key, 0, present=present)


class Token:
    def __init__(self, session: Tokens, key: str) -> None:
        self._session, self._key = session, key

    def close(self) -> None:
        self._session.withdraw(self._key)


def test_each_stream_is_in_one_token_and_all_tokens_but_one_are_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """After any changes, listeners to the tokens know these streams, and none of them was away in between."""
    chance = random.Random(1)
    tokens = Tokens()
    session: Any = tokens
    announcements = Announcements(session, KEYS, "m0", "run")
    streams: set[str] = set()
    away: list[str] = []
    most = 0
    settled = StreamDirectory._settled

    def noted(known: Any, now_ns: int) -> bool:
        changed = settled(known, now_ns)
        away.extend(stream for stream in streams if tokens.heard._streams.get(stream) is known and known.left_ns == 0)
        return changed

    monkeypatch.setattr(tokens.heard, "_settled", noted)  # called at every change
    for _ in range(200):
        gone = set(chance.sample(sorted(streams), chance.randrange(len(streams) + 1) // 4))
        new = {f"s/n{chance.randrange(300)}/lidar" for _ in range(chance.randrange(20))}
        streams -= gone - new
        announcements.announce(streams | new)
        streams |= new
        assert tokens.announced == sorted(streams)
        assert sum(len(KEYS.discovered_streams(key)) < ANNOUNCED for key in tokens.now) <= 1
        assert {one for one, known in tokens.heard._streams.items() if known.left_ns is None} == streams
        assert not away
        most = max(most, len(tokens.now))
    assert most > 3
    announcements.announce(set())
    assert not tokens.now

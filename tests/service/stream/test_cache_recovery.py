"""Caches that a session waits for, and the bound on remembered answers."""

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

from fusing import FUSED
from optipmb_service.stream.directory import BACK_NS, StreamDirectory
from optipmb_service.stream.recovery import MOST, CacheRecovery
from optipmb_service.stream.session import Session
from optipmb_service.zenoh.inputs import Packet

import optipmb


class Publishers:
    """Publishers of one node that come and go, each with a cache; implements `Caches`."""

    def __init__(self) -> None:
        self._directory = StreamDirectory("a", 600 * 10**9, lambda _: True)
        self.now_ns = 10 * BACK_NS
        self.asked: list[str] = []

    def set(self, stream: str, *, present: bool) -> None:
        assert self._directory.published(stream, "token", self.now_ns, present=present)

    def awaited(self, session: str, sensors: Iterable[str]) -> dict[str, bool]:
        """Return whose caches may hold something."""
        del session
        return self._directory.awaited("site/node", lambda _: True, sensors, self.now_ns)

    def ask_cache(self, stream: str, then: Callable[[list[Packet], bool], None]) -> None:
        del then
        self.asked.append(stream)


def test_publishers_that_come_and_go_leave_nothing_behind() -> None:
    """However many caches have answered: those are remembered whose publishers are there, and are not asked again."""
    publishers, session = Publishers(), Session(FUSED, optipmb.load_profile("nuscenes"), fused=True)
    streams: Any = SimpleNamespace(caches=publishers)
    one = CacheRecovery(FUSED, streams)
    staying = [f"site/node/{number}" for number in range(MOST + 10)]
    for stream in staying:
        publishers.set(stream, present=True)
        one.answered(stream)
    for number in range(10 * MOST):
        stream = f"site/node/passing-{number}"
        publishers.set(stream, present=True)
        one.answered(stream)
        publishers.set(stream, present=False)
        publishers.now_ns += BACK_NS
    assert set(staying) <= one._answered
    assert len(one._answered) <= 2 * len(staying) + 1
    assert len(one._asked) <= 2 * len(staying) + 1
    assert not one.awaited(session, lambda *_, **__: None)
    publishers.set("site/node/new", present=True)
    assert one.awaited(session, lambda *_, **__: None) is True
    assert publishers.asked == ["site/node/new"]

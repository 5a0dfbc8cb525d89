"""A worker that a stream is moved away from, at the moments when that is hard: it keeps nothing and loses nothing."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from optipmb_schemas import Keys
from optipmb_service.cluster.assignment import Assignment
from optipmb_service.runtime.takeover_buffer import TakeoverBuffer
from optipmb_service.zenoh import Transport
from router import Node, Sensor, until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    import pytest
    from optipmb_service.runtime.ports import Packet

KEYS = Keys()
SENSOR = Sensor()
FRAMES = 4
HERE, THERE = 0, 1


def test_a_stream_that_is_moved_while_its_owner_is_sought(
    start: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first frames wait here and nowhere else: they are tracked, and only then is the stream left."""
    look, may_look = Transport.claimants, threading.Event()
    add, waiting = TakeoverBuffer.add, []

    def keep(standby: TakeoverBuffer, packet: Packet, *, frame: bool) -> None:
        add(standby, packet, frame=frame)
        waiting.append(packet)

    def claimants(transport: Transport, streams: Iterable[str] | None) -> Mapping[str, set[str]] | None:
        return look(transport, streams) if may_look.is_set() else None

    monkeypatch.setattr(Transport, "claimants", claimants)
    monkeypatch.setattr(TakeoverBuffer, "add", keep)
    share = Assignment(HERE, 2, {SENSOR.stream: HERE})
    service, endpoint = start(share=share, store=str(tmp_path))
    left = threading.Event()
    with Node(endpoint) as node:
        node.send(*(SENSOR.detections(seq) for seq in range(FRAMES)))
        until(lambda: len(waiting) == FRAMES, "all frames wait for the owner to be known")
        share.move(SENSOR.stream, THERE)
        assert service.give_up(SENSOR.stream, left.set)
        assert not left.is_set()
        may_look.set()
        assert [tracks.seq for tracks in node.tracks(SENSOR.stream, FRAMES)] == list(range(FRAMES))
        assert left.wait(60.0)
        until(lambda: node.alive(KEYS.all_owners()) == [], "the stream has no owner")
        assert service.status().sessions == ()


def test_what_came_too_late_for_a_move_does_not_keep_the_stream(start: Callable[..., Any], tmp_path: Path) -> None:
    """A session of another worker's stream, begun by a message that was on its way, is ended by the housekeeping."""
    share = Assignment(HERE, 2, {SENSOR.stream: HERE})
    service, endpoint = start(share=share, store=str(tmp_path))
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)
        share.move(SENSOR.stream, THERE)

        def gone() -> bool:
            service.housekeeping()
            return node.alive(KEYS.all_owners()) == []

        until(gone, "the stream is left")
        assert service.status().sessions == ()


def test_a_move_is_not_forgotten_for_an_answer_that_was_on_its_way() -> None:
    """An answer that was computed before a move, and is noted after it, counts no more."""
    share = Assignment(HERE, 2, {SENSOR.stream: HERE})

    class Overtaken(dict[str, int]):
        """Where streams have been moved; the next move comes right after an answer."""

        def get(self, stream: str, otherwise: Any = None) -> Any:
            answer = super().get(stream, otherwise)
            share.move(stream, THERE)
            return answer

    share._moved = Overtaken(share._moved)
    assert share.has(SENSOR.stream)
    assert not share.has(SENSOR.stream)

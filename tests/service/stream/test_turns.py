"""A stream's queue: other streams have their turn while it is processed, and dropped messages count."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from optipmb_schemas import Keys, SessionState
from optipmb_service.cluster.sqlite import SqliteStore
from router import Node, Sensor, until
from sessions import Gated

KEYS = Keys()
CAREFUL = Sensor("site/careful/lidar")
CARELESS = Sensor("site/careless/lidar")


def test_frames_that_are_ready_together_keep_no_other_waiting(start: Callable[..., Any]) -> None:
    """Sixty frames have waited for clouds that never came: another stream is tracked between them."""
    held, wait_s = 60, 2.0
    gated = Gated(2)

    service, endpoint = start(tracker=gated.tracker, cloud_wait_s=wait_s, queue_frames=2 * held)

    def queues(careful: int, careless: int) -> None:
        expected = {CAREFUL.stream: careful, CARELESS.stream: careless}
        until(lambda: {one.stream: one.queue for one in service.status().sessions} == expected, str(expected))

    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        node.send(*(CARELESS.detections(seq, has_points=True) for seq in range(held)))
        queues(0, held)
        due = time.monotonic() + wait_s
        node.send(CAREFUL.detections(1))
        assert gated.entered.wait(60)
        node.send(CAREFUL.detections(2))
        queues(1, held)
        until(lambda: time.monotonic() > due, "all are due")
        gated.gate.set()
        assert [one.seq for one in node.tracks(CARELESS.stream, held)] == list(range(held))
        node.tracks(CAREFUL.stream, 3)
    third = [index for index, one in enumerate(gated.steps) if one is gated.steps[0]][2]
    assert third < held // 2


def test_what_is_dropped_before_a_session_begins_is_counted(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """While the store is slow more comes than may wait: the oldest go, counted and reported, and the newest stay."""
    sent, objects = 40, 1000
    gate, load = threading.Event(), SqliteStore.load

    def slow(store: SqliteStore, stream: str) -> bytes | None:
        assert stream != CARELESS.stream or gate.wait(60)
        return load(store, stream)

    monkeypatch.setattr(SqliteStore, "load", slow)
    service, endpoint = start(store=str(tmp_path), standby_mb=1)
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        node.tracks(CAREFUL.stream, 1)
        node.send(*(CARELESS.detections(seq, objects=objects) for seq in range(sent)))
        problem = node.problem(CARELESS.stream, "shed")
        node.send(CAREFUL.detections(1))
        node.tracks(CAREFUL.stream, 2)  # on the same link, so earlier messages have arrived
        gate.set()
        node.tracks(CARELESS.stream, 1)
        until(lambda: node.ask(KEYS.query(CARELESS.stream, "state"), SessionState).queue == 0, "all are tracked")
        state, status = node.ask(KEYS.query(CARELESS.stream, "state"), SessionState), service.status()
        tracked = [one.seq for one in node.tracks(CARELESS.stream, state.frames)]
    assert "room" in problem.expected
    assert tracked == list(range(sent - state.frames, sent))
    assert 0 < state.frames < sent
    assert (status.received, status.shed) == (sent + 2, sent - state.frames)

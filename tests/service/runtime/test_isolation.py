"""What one stream does, others do not feel: each test is a careless node beside a careful one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from optipmb_schemas import Keys, ServiceStatus, SessionState
from optipmb_service.cluster.store import MemoryStore, SqliteStore
from optipmb_service.runtime import persistence
from optipmb_service.runtime.persistence import STORE_FILE, CheckpointWriter
from optipmb_service.session.session import Session
from router import Node, Sensor, until

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import pytest

KEYS = Keys()
CAREFUL = Sensor("site/careful/lidar")
CARELESS = Sensor("site/careless/lidar")
LAST = 2**63 - 1
"""The highest sequence number of a message."""


def test_no_sequence_number_overflows_a_counter(start: Callable[..., Any], tmp_path: Path) -> None:
    """Gaps of 2^63 frames, three times: status, metrics, state and checkpoints of all streams go on."""
    service, endpoint = start(store=str(tmp_path), checkpoint_s=0.05)
    epochs = [bytes([number]) * 16 for number in range(3)]
    with Node(endpoint) as node:
        node.send(CAREFUL.detections(0))
        for number, epoch in enumerate(epochs):
            for place, seq in enumerate((0, LAST)):
                node.send(CARELESS.detections(2 * number + place).model_copy(update={"epoch": epoch, "seq": seq}))
        node.tracks(CARELESS.stream, 6)
        state = node.ask(KEYS.query(CARELESS.stream, "state"), SessionState)
        status = node.ask(KEYS.status("test"), ServiceStatus)
        assert b"optipmb_gaps_total" in node.query(KEYS.metrics("test"))[0][2]
        until(lambda: set(SqliteStore(tmp_path / STORE_FILE).streams()) == {CAREFUL.stream, CARELESS.stream}, "kept")
    assert state.gaps == LAST
    assert {one.stream: one.gaps for one in status.sessions} == {CAREFUL.stream: 0, CARELESS.stream: LAST}
    assert (status.state, service.state) == ("ready", "ready")


def test_a_checkpoint_that_cannot_be_made_is_its_streams_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """One stream's state does not encode: the others are written, the failure has a name, and ends when it does."""
    broken, encode = {CARELESS.stream}, persistence.encode_checkpoint

    def fragile(checkpoint: Any) -> bytes:
        if checkpoint.stream in broken:
            raise OverflowError("too large")
        return encode(checkpoint)

    monkeypatch.setattr(persistence, "encode_checkpoint", fragile)
    store, reported = MemoryStore(), []
    writer = CheckpointWriter(store, 0.05, lambda _: True, lambda stream, why: reported.append((stream, why)))
    parameters = optipmb.load_profile("nuscenes")
    snapshots = [Session(sensor.stream, parameters).snapshot() for sensor in (CARELESS, CAREFUL)]
    gathered = [0]

    def gather() -> None:
        gathered[0] += 1
        for snapshot in snapshots:
            writer.put(replace(snapshot))

    writer.start(gather)
    until(lambda: gathered[0] > 3, "rounds")
    assert store.streams() == (CAREFUL.stream,)
    assert writer.failure == f"checkpoint of {CARELESS.stream}: OverflowError: too large"
    assert set(reported) == {(CARELESS.stream, "OverflowError: too large")}
    broken.clear()
    until(lambda: writer.failure == "", "the failure ends")
    assert store.streams() == (CAREFUL.stream, CARELESS.stream)
    writer.close(5)

"""A process restarts before its network session runs out of numbers for keys, and its sessions continue."""

import contextlib
import hashlib
import signal
import sqlite3
from pathlib import Path

import pytest
from optipmb_schemas import Keys, ResetRequest
from optipmb_service.session.checkpoint import DIGEST, HEAD, MAGIC, VERSION
from router import Node, Sensor, plain
from service_process import ServiceProcess
from takeovers import expected

KEYS = Keys()
NUMBERS = 100
"""Keys of about 25 streams of one process."""
TOGETHER, MOST = 20, 15
"""Streams that are open at once, and how often others follow them."""
FRAMES = 8
END_S = 60.0


def come_and_go(endpoint: str, site: int) -> None:
    """Streams are tracked, and freed; their publisher leaves."""
    sensors = [Sensor(stream=f"{site}/passing/{number}") for number in range(TOGETHER)]
    with Node(endpoint) as node:
        node.send(*(sensor.detections(0) for sensor in sensors))
        for sensor in sensors:
            node.tracks(sensor.stream, 1)
            node.query(KEYS.query(sensor.stream, "reset"), ResetRequest(close=True))


@pytest.mark.parametrize(
    ("options", "event"), [((), "keys_used_up"), (("--workers", "2"), "worker_restarts")], ids=["alone", "workers"]
)
def test_streams_that_come_and_go_without_end_have_a_process_restart(
    tmp_path: Path, options: tuple[str, ...], event: str
) -> None:
    """The one that tracks begins again, once: with its id and its endpoint, and with the bytes of one that did not.

    Of several workers it is one that has used up its numbers.
    """
    environment = {"OPTIPMB_STORE": str(tmp_path), "OPTIPMB_RESTART_KEYS": str(NUMBERS)}
    sensor = Sensor(stream="yard/steady/lidar")
    with ServiceProcess("--instance", "one", *options, environment=environment, fresh=True) as service:
        ready = service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(*(sensor.detections(seq) for seq in range(FRAMES)))
            node.tracks(sensor.stream, FRAMES)
            for site in range(MOST):
                if event in service.errors:
                    break
                come_and_go(service.endpoint, site)
            service.wait_log(event)
            if not options:
                assert service.wait_ready() == ready
            node.send(*(sensor.detections(seq) for seq in range(FRAMES, 2 * FRAMES)))
            tracks = [plain(one) for one in node.tracks(sensor.stream, 2 * FRAMES)]
            assert tracks == expected(2 * FRAMES, sensor, "generic")[0]
        assert service.end(signal.SIGTERM, deadline_s=END_S)[0] == 0
        assert options or service.errors.count(" keys_used_up ") == 1
        assert service.output == []


@pytest.mark.parametrize("kept", [0, 1])
def test_a_release_that_cannot_read_a_checkpoint_gives_no_id_again(tmp_path: Path, kept: int) -> None:
    """After a checkpoint of another version the session is a new one, and its track ids go on.

    So they do where older checkpoints could be read.
    """
    sensor = Sensor(stream="yard/back/lidar")
    ids: list[set[int]] = []
    sessions: list[set[str]] = []
    for run in range(3):
        with ServiceProcess("--instance", "one", environment={"OPTIPMB_STORE": str(tmp_path)}) as service:
            service.wait_ready()
            with Node(service.endpoint) as node:
                node.send(*(sensor.detections(seq) for seq in range(run * FRAMES, (run + 1) * FRAMES)))
                tracks = node.tracks(sensor.stream, FRAMES)
            assert service.end(signal.SIGTERM, deadline_s=END_S)[0] == 0
            assert ("checkpoint_torn" in service.errors) == (run == 2)
        ids.append({int(one) for message in tracks for one in message.id})
        sessions.append({message.session for message in tracks})
        if run == 1:
            for file in tmp_path.glob("*.db"):
                _make_newer(file, kept)
    assert ids[0]
    assert min(ids[2]) > max(ids[0] | ids[1])
    assert sessions[0] == sessions[1] != sessions[2]


def _make_newer(file: Path, kept: int) -> None:
    """Give the checkpoints of a store, but for the oldest, the version of the next release, as it would write them."""
    with contextlib.closing(sqlite3.connect(file)) as store, store:
        if not store.execute("SELECT 1 FROM sqlite_master WHERE name = 'checkpoints'").fetchall():
            return
        rows = store.execute("SELECT stream, number, data FROM checkpoints ORDER BY number").fetchall()
        assert len(rows) > kept
        for stream, number, data in rows[kept:]:
            start = data[: len(MAGIC)] + (VERSION + 1).to_bytes(2, "big") + data[len(MAGIC) + 2 : HEAD - DIGEST]
            digest = hashlib.sha256(start + data[HEAD:]).digest()[:DIGEST]
            changed = (start + digest + data[HEAD:], stream, number)
            store.execute("UPDATE checkpoints SET data = ? WHERE stream = ? AND number = ?", changed)

"""Log lines: not too many of one event, and none lost without a word."""

import contextlib
import fcntl
import http.client
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st
from optipmb_service.telemetry.logs import BURST, LINES_PER_SECOND, QUEUE_BYTES, Limiter, LineWriter, configure
from router import Node, Sensor, until
from routers import free_endpoint

END_S = 60.0


@pytest.fixture
def full_pipe() -> Iterator[tuple[int, int, int]]:
    """A pipe that is full: its ends, and how many bytes it holds."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    size = fcntl.fcntl(writer, fcntl.F_GETPIPE_SZ)
    assert os.write(writer, b"x" * size) == size
    os.set_blocking(writer, True)
    yield reader, writer, size
    for end in (reader, writer):
        os.close(end)


def test_a_stderr_that_nobody_reads_stops_nothing(full_pipe: tuple[int, int, int]) -> None:
    """With a full pipe as stderr the service starts, tracks, is healthy, and ends with status 0."""
    endpoint, address = free_endpoint(), free_endpoint().removeprefix("tcp/")
    command = [sys.executable, "-m", "optipmb_service", "--listen", endpoint, "--http", address]
    environment = os.environ | {"OPTIPMB_STORE": "none"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=full_pipe[1], env=environment, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready")
            with Node(endpoint) as node:
                sensor = Sensor()
                node.send(*(sensor.detections(seq) for seq in range(5)))
                node.send_raw(node.keys.detections(sensor.stream), b"garbage")  # is logged
                assert len(node.tracks(sensor.stream, 5)) == 5
            host, _, port = address.rpartition(":")
            with contextlib.closing(http.client.HTTPConnection(host, int(port), timeout=END_S)) as connection:
                connection.request("GET", "/healthz")
                assert connection.getresponse().status == 200
            process.send_signal(signal.SIGTERM)
            assert process.wait(END_S) == 0
        finally:
            process.kill()


def test_lines_beyond_the_queue_are_counted(
    full_pipe: tuple[int, int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unread lines beyond the queue are dropped; the others come in order, then a line with how many are missing."""
    reader, writer, size = full_pipe
    told = tmp_path / "stderr"
    with told.open("w") as stderr, os.fdopen(os.dup(writer), "w") as file:
        monkeypatch.setattr(sys, "stderr", stderr)
        configure("json", "info")
        lines = LineWriter(file)
        count = 2 * QUEUE_BYTES // 1000
        for number in range(count):
            lines.write(f"{number:999d}\n")
        assert 0 < lines.dropped < count
        left = (count - lines.dropped) * 1000 + size
        while left:
            left -= len(os.read(reader, min(left, 2**20)))
        lines.finish(END_S)
        until(lambda: told.read_text().endswith("}\n"), "a line says how many are missing")
        structlog.reset_defaults()
    assert re.search(r'"count": (\d+)', told.read_text())[1] == str(lines.dropped)  # type: ignore[index]  # it is there


@given(st.lists(st.tuples(st.sampled_from(["problem", "peer_lost"]), st.floats(0, 0.5)), max_size=300))
def test_lines_are_limited_and_counted(lines: list[tuple[str, float]]) -> None:
    """Of each event at most a burst and then so many a second pass; every line dropped is in a later `suppressed`."""
    now = 0.0
    limiter = Limiter(lambda: now)
    passed: dict[str, int] = {}
    told: dict[str, int] = {}
    for event, pause in lines:
        now += pause
        try:
            line = limiter(None, "info", {"event": event})
        except structlog.DropEvent:
            continue
        passed[event] = passed.get(event, 0) + 1
        told[event] = told.get(event, 0) + line.get("suppressed", 0)
        assert passed[event] <= BURST + now * LINES_PER_SECOND + 1e-6
    now += BURST / LINES_PER_SECOND
    for event in {event for event, _ in lines}:
        line = limiter(None, "info", {"event": event})
        sent = sum(name == event for name, _ in lines)
        assert passed.get(event, 0) + told.get(event, 0) + line.get("suppressed", 0) == sent


def test_one_event_does_not_hide_another() -> None:
    """When one event is cut, the others are written as ever."""
    limiter = Limiter(lambda: 0.0)
    for _ in range(BURST):
        limiter(None, "info", {"event": "stream_stale"})
    with pytest.raises(structlog.DropEvent):
        limiter(None, "info", {"event": "stream_stale"})
    assert limiter(None, "info", {"event": "stop_asked"}) == {"event": "stop_asked"}

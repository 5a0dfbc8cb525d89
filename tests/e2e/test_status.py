"""`optipmb status` on a service at work."""

from pathlib import Path

import pytest
from commands import kill, result_of, run_here, start
from optipmb_client import Subscriber
from service_process import ServiceProcess


def test_streams_at_work_are_shown(service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """While a replay runs, its stream is listed with rate and latency, in the table and as JSON."""
    with Subscriber("replay/*/0003", service.endpoint) as tracks:
        replay = start(
            *("replay", "--dataset", "scene", "--option", "frames=200", "--option", "clouds=0", "--sequences", "0003"),
            *("--speed", "2", "--connect", service.endpoint, "--out", tmp_path),
        )
        try:
            received = tracks.receive(240.0)
            assert received is not None
            stream = received.tracks.stream
            for _ in range(30):
                assert tracks.receive(60.0) is not None
            result = result_of(run_here(capsys, "status", "--connect", service.endpoint, "--json"))
            table = run_here(capsys, "status", "--connect", service.endpoint)
        finally:
            kill(replay)
    (status,) = result["services"]
    assert status["instance"] == "garage"
    (session,) = [session for session in status["sessions"] if session["stream"] == stream]
    assert session["profile"] == received.tracks.profile
    assert 0.0 < session["rate_hz"] < 40.0
    assert 0.0 < session["latency_p50_ms"] <= session["latency_p99_ms"]
    assert session["frames"] >= 30
    assert session["shed"] == session["gaps"] == 0
    assert any(line.startswith(stream) for line in table.stdout.splitlines())

"""A load on a real service: both count the same."""

import json

import pytest
from commands import result_of, run_here
from load import main
from service_process import ServiceProcess

STREAMS, RATE, SECONDS = 3, 20, 2


def test_a_load_counts_exactly(service: ServiceProcess, capsys: pytest.CaptureFixture[str]) -> None:
    """Every frame sent comes back, with its cloud; the service has tracked as many, and keeps no session afterwards."""
    options = ("--streams", STREAMS, "--rate", RATE, "--seconds", SECONDS, "--objects", 5, "--points", 1000)
    assert main(["--connect", service.endpoint, *map(str, options), "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    frames = STREAMS * RATE * SECONDS
    assert (run["sent"], run["received"], run["lost"], run["repeated"], run["cloudless"]) == (frames, frames, 0, 0, 0)
    assert 0 < run["p50_ms"] <= run["p99_ms"] <= run["max_ms"]
    assert sum(run["stages_p50_ms"].values()) < 2 * run["p50_ms"]
    (status,) = result_of(run_here(capsys, "status", "--connect", service.endpoint, "--json"))["services"]
    assert status["frames"] == frames
    assert status.get("sessions", []) == []


def test_a_latency_that_is_not_held_is_reported(service: ServiceProcess, capsys: pytest.CaptureFixture[str]) -> None:
    """A limit that nothing can hold ends with status 1."""
    options = ("--streams", 1, "--rate", 20, "--seconds", 1, "--latency-ms", 0.1)
    assert main(["--connect", service.endpoint, *map(str, options)]) == 1
    assert "not held" in capsys.readouterr().out

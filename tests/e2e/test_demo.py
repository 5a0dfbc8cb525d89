"""The demonstration as a new user runs it."""

import csv
import json
import os
import signal
import struct
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from commands import run_here


def test_demo_runs_without_a_display(tmp_path: Path) -> None:
    """It ends by itself with all frames tracked, good figures and no id switch, a track file and a picture."""
    environment = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    out = tmp_path / "not" / "there" / "yet"
    done = subprocess.run(
        [sys.executable, "-m", "optipmb_tools", "demo", "--out", str(out), "--frames", "60", "--json"],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["frames"], result["returned"], result["missing"], result["clouds_missed"]) == (60, 60, 0, 0)
    assert 0.0 < result["latency"]["p50_ms"] <= result["latency"]["p99_ms"]
    assert result["precision"] > 0.9
    assert result["IDS"] == 0
    assert result["objects"] > 10
    with (out / "tracks.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["confirmed"] == "1"]
    assert {int(row["frame"]) for row in rows} > set(range(5, 55))
    assert len({row["id"] for row in rows}) == result["tracks"]
    head = (out / "tracks.png").read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", head[16:24])
    assert min(width, height) > 300


def test_demo_tells_what_it_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Stages go to standard error, the summary to standard output: a few short lines each."""
    done = run_here(capsys, "demo", "--out", tmp_path, "--frames", 20)
    assert done.returncode == 0, done.stderr
    heads = [line[:10].strip() for line in done.stdout.splitlines()]
    assert heads == ["frames", "latency", "tracks", "files", "", ""]
    assert [line.split()[0] for line in done.stderr.splitlines()] == [
        "generating",
        "starting",
        "replaying",
        "comparing",
    ]
    assert all(len(line) < 120 for line in done.stderr.splitlines())


def test_the_live_demo_shows_tracks_until_ctrl_c() -> None:
    """It prints the address of a page whose stream has tracks, opens no browser without a display, and ends with 0."""
    environment = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    command = [sys.executable, "-m", "optipmb_tools", "demo", "--live", "--frames", "20"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as demo:
        try:
            assert demo.stdout is not None
            page, _, stream = demo.stdout.readline().removeprefix("live page: ").strip().partition("#")
            with urllib.request.urlopen(f"{page}live?stream={stream}", timeout=60) as answer:  # noqa: S310 - of the demo
                assert any(b'"tracks":[[' in answer.readline() for _ in range(20))
        finally:
            demo.send_signal(signal.SIGINT)
            _, shown = demo.communicate(timeout=60)
    assert (demo.returncode, "Traceback" in shown) == (0, False), shown

"""Recordings of a sensor on a vehicle whose frames have no poses."""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import run_here


def test_a_recording_is_tracked_from_its_first_frame_on_with_what_later_frames_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cars that are parked along the way tell nothing of the sensor; those across it, seen four seconds later, do.

    Without hindsight the frames before are tracked as the service does.
    """
    rng = np.random.default_rng(3)
    cars = np.column_stack((np.arange(0.0, 160.0, 4.0), rng.choice([-7.0, -4.0, 4.0, 7.0], 40)))
    yaw = np.where(cars[:, 0] < 65.0, 0.0, 0.5 * np.pi)
    rows = ["t,class,x,y,z,l,w,h,yaw,score"]
    for k in range(100):
        local = cars - [float(k), 0.0] + rng.normal(0.0, 0.1, cars.shape)
        rows += [
            f"{0.1 * k:.1f},car,{x:.2f},{y:.2f},0,4.5,1.9,1.6,{heading:.3f},0.9"
            for (x, y), heading in zip(local.tolist(), yaw.tolist(), strict=True)
            if abs(x) < 25.0
        ]
    table = tmp_path / "boxes.csv"
    table.write_text("\n".join(rows) + "\n")
    result = run_here(capsys, "track", table, "--out", tmp_path / "tracks.csv")
    assert result.returncode == 0, result.stderr
    told = re.search(r"estimated in (\d+) of 100 frames", result.stderr)
    assert told, result.stderr
    assert int(told[1]) >= 98
    assert "100 frames" in result.stdout
    result = run_here(capsys, "track", table, "--hindsight", "0", "--out", tmp_path / "tracks.csv")
    told = re.search(r"estimated in (\d+) of 100 frames", result.stderr)
    assert told, result.stderr
    assert int(told[1]) < 60

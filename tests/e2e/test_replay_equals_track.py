"""The promise of the replay: the service gives the same result files as the tracker in process, byte for byte."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import result_of, run_here
from optipmb_schemas import PATHS, Detections, Keys, encode, encoding_of
from optipmb_service.session.outputs import TrackedFrame
from optipmb_service.session.session import Session
from optipmb_tools.datasets import open_dataset
from optipmb_tools.recordings.recording_file import RecordingWriter
from optipmb_tools.run.tracking import Tracking, track_whole
from router import Sensor
from service_process import ServiceProcess

from optipmb import load_profile

SAMPLE = Path(__file__).parents[2] / "examples" / "crossing.csv"
SCENE = ("--dataset", "scene", "--option", "frames=25")
SPREADS = np.array([[[0.5, 0.2, 0.0], [0.2, 0.3, 0.0], [0.0, 0.0, 1.0]], np.full((3, 3), np.nan)] * 4)
"""Covariances of eight positions, every other unknown."""
WITHOUT_CLOUDS = (*SCENE, "--option", "clouds=0")


class Both:
    """Tracks data offline and replays them through a service, the commands in this process, and compares the files."""

    def __init__(self, service: ServiceProcess, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.out = out
        self._endpoint = service.endpoint
        self._capsys = capsys

    def track(self, *data: object) -> Any:
        return result_of(
            run_here(self._capsys, "track", *data, "--out", self.out / "track", "--hindsight", 0, "--json")
        )

    def replay(self, *data: object) -> Any:
        """Replay a tracked data set; the files are the same, and not empty."""
        out = self.out / "replay"
        replayed = result_of(
            run_here(self._capsys, "replay", *data, "--connect", self._endpoint, "--out", out, "--json")
        )
        files = sorted((self.out / "track").glob("*.txt"))
        assert sorted(f"{entry['name']}.txt" for entry in replayed["sequences"]) == [file.name for file in files]
        for file in files:
            assert file.read_bytes() == (out / file.name).read_bytes(), f"{file.stem} differs"
            assert len(file.read_bytes().splitlines()) > 100
            (out / file.name).unlink()
        return replayed


@pytest.fixture
def both(service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Both:
    return Both(service, tmp_path, capsys)


def test_three_streams_at_once(both: Both) -> None:
    """Three scenes sent at the same time at full speed: each file equals its scene alone."""
    data = (*WITHOUT_CLOUDS, "--sequences", "0000", "0001", "0002")
    both.track(*data)
    assert len({(both.out / "track" / f"000{number}.txt").read_bytes() for number in range(3)}) == 3
    both.replay(*data, "--streams", 3)


def test_at_a_multiple_of_the_recorded_rate(both: Both) -> None:
    """Sent by the clock, twice as fast as recorded, the file is still the same."""
    data = (*WITHOUT_CLOUDS, "--sequences", "0003")
    both.track(*data)
    both.replay(*data, "--speed", 2)


def test_chosen_classes_and_another_profile(both: Both) -> None:
    """Classes and profile given on the command line mean the same on both ways."""
    data = (*WITHOUT_CLOUDS, "--option", "cyclists=20", "--classes", "Car", "Cyclist", "--profile", "kitti")
    assert both.track(*data)["profile"] == "kitti"
    both.replay(*data)
    text = (both.out / "track" / "0000.txt").read_text()
    assert {line.split()[2] for line in text.splitlines()} == {"Car", "Cyclist"}


def test_a_table_without_a_profile(service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table is replayed with the profile generic where none is named: the bytes of `track`."""
    table, tracked, replayed = SAMPLE, tmp_path / "tracked.csv", tmp_path / "replayed.csv"
    full = ("--digits", "full")
    run_here(capsys, "track", table, "--profile", "generic", "--hindsight", 0, "--out", tracked, *full)
    done = run_here(capsys, "replay", table, "--connect", service.endpoint, "--out", replayed, *full)
    assert "profile generic, which is auto at 10 Hz" in done.stderr
    assert tracked.read_bytes() == replayed.read_bytes()
    rows = list(csv.DictReader(tracked.read_text().splitlines()))
    assert {row["confirmed"] for row in rows} == {"0", "1"}


@pytest.mark.parametrize("horizons", [(), (0.5, 1.0, 3.0)])
@pytest.mark.parametrize("posed", [False, True])
def test_a_recording_of_a_publisher_of_the_world_frame(
    tmp_path: Path, horizons: tuple[float, ...], *, posed: bool
) -> None:
    """Boxes in the world frame, recorded and tracked offline, give the bytes of a session: no heading is turned.

    So do the predicted paths where the profile asks for them, and detections with covariances.
    """
    sensor, path, chance = Sensor("site/world/lidar"), tmp_path / "world.mcap", np.random.default_rng(7)
    parameters = load_profile("nuscenes").model_copy(update={"horizons": horizons})
    session, expected = Session(sensor.stream, parameters), []
    with RecordingWriter(path) as writer:
        for seq in range(30):
            angle = 0.1 * seq + np.arange(8.0)
            message = sensor.detections(
                seq,
                objects=8,
                center=np.c_[20 * np.arange(8) + 5 * np.cos(angle), 5 * np.sin(angle), np.ones(8)]
                + chance.normal(0, 0.05, (8, 3)),
                yaw=np.remainder(angle + np.pi / 2 + chance.normal(0, 0.02, 8), 2 * np.pi),  # beyond pi too
                position_covariance=SPREADS if seq % 2 else None,
                has_points=False,
            )
            if posed:
                pose = {"translation": [5.0, seq, 1.0], "quaternion": [0.6, 0.0, 0.0, 0.8]}
                message = Detections(**(dict(message.present()) | {"pose": pose}))
            assert message.frame == "world"
            key = Keys().detections(sensor.stream)
            writer.add(key, encode(message), encoding_of(message), seq)
            expected += [one.tracks for one in session.on_detections(message, 0) if isinstance(one, TrackedFrame)]
    (sequence,) = open_dataset("mcap", path).sequences(["all"])
    found = list(track_whole(Tracking(parameters), sequence).tracks.values())
    assert len(found) == len(expected) == 30
    assert len(found[-1].id) >= 8
    for offline, online in zip(found, expected, strict=True):
        columns = offline.arrays.keys() - {*PATHS, "class_probability"}
        given = {name for name in columns if getattr(online, name) is not None}
        assert given == columns - {"measured", "horizons", "object", "object_probability"}
        for column in given:
            assert getattr(offline, column).tobytes() == getattr(online, column).tobytes(), column
        for name in PATHS:
            one, other = getattr(offline, name), getattr(online, name)
            assert (one is None) == (other is None) == (not horizons)
            assert not horizons or (one.dtype == other.dtype and one.tobytes() == other.tobytes()), name

"""The promise of the replay: the service gives the same result files as the tracker in process, byte for byte."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import optipmb, result_of
from optipmb_client.child import ServiceProcess
from optipmb_client.datasets import open_dataset
from optipmb_client.mcap_files.writing import RecordingWriter
from optipmb_client.offline import track_sequence
from optipmb_schemas import Detections, Keys, encode, encoding_of
from optipmb_service.session.session import Session
from optipmb_service.session.values import Tracked
from real_data import kitti_root
from router import Sensor

from optipmb import load_profile

SCENE = ("--dataset", "scene", "--option", "frames=60")


def both(service: ServiceProcess, out: Path, data: tuple[object, ...], *options: object) -> tuple[Any, Any]:
    """Track offline and replay the same data; return both results after comparing the files."""
    offline = result_of(optipmb("track", *data, "--out", out / "track", "--json"))
    replayed = result_of(
        optipmb("replay", *data, *options, "--connect", service.endpoint, "--out", out / "replay", "--json")
    )
    names = [entry["name"] for entry in offline["sequences"]]
    assert [entry["name"] for entry in replayed["sequences"]] == names
    for name in names:
        one, other = (out / folder / f"{name}.txt" for folder in ("track", "replay"))
        assert one.read_bytes() == other.read_bytes(), f"sequence {name} differs"
        assert len(one.read_bytes().splitlines()) > 100
    return offline, replayed


def test_scene_at_full_speed(service: ServiceProcess, tmp_path: Path) -> None:
    """A scene with clouds, as fast as tracks come back: the same file, no frame and no cloud missing."""
    _, replayed = both(service, tmp_path, SCENE)
    (sequence,) = replayed["sequences"]
    assert (sequence["sent"], sequence["returned"], sequence["missing"]) == (60, 60, 0)
    assert (sequence["clouds"], sequence["clouds_missed"], sequence["problems"]) == (60, 0, 0)
    assert 0.0 < sequence["latency"]["p50_ms"] <= sequence["latency"]["p99_ms"]


def test_three_streams_at_once(service: ServiceProcess, tmp_path: Path) -> None:
    """Three scenes sent at the same time: each file is that of its own scene alone."""
    both(service, tmp_path, (*SCENE, "--sequences", "0000", "0001", "0002"), "--streams", 3)
    files = {(tmp_path / "replay" / f"000{number}.txt").read_bytes() for number in range(3)}
    assert len(files) == 3


def test_at_a_multiple_of_the_recorded_rate(service: ServiceProcess, tmp_path: Path) -> None:
    """Sent by the clock, twice as fast as recorded, the file is still the same."""
    both(service, tmp_path, SCENE, "--speed", 2)


def test_chosen_classes_and_another_profile(service: ServiceProcess, tmp_path: Path) -> None:
    """Classes and profile given on the command line mean the same on both ways."""
    data = ("--dataset", "scene", "--option", "frames=100", "--option", "cyclists=20", "--option", "seed=3")
    offline, _ = both(service, tmp_path, (*data, "--classes", "Car", "Cyclist", "--profile", "kitti"))
    text = (tmp_path / "track" / "0000.txt").read_text()
    assert {line.split()[2] for line in text.splitlines()} == {"Car", "Cyclist"}
    assert offline["profile"] == "kitti"


@pytest.mark.parametrize("streams", [1, 3])
def test_kitti(service: ServiceProcess, tmp_path: Path, streams: int) -> None:
    """Recorded detections, with the few clouds that there are, give the same files on both ways."""
    data = ("--dataset", "kitti", "--root", kitti_root(), "--detections", "pointrcnn")
    both(service, tmp_path, (*data, "--sequences", "0000", "0002", "0005"), "--streams", streams)


@pytest.mark.parametrize("posed", [False, True])
def test_a_recording_of_a_publisher_of_the_world_frame(tmp_path: Path, *, posed: bool) -> None:
    """Boxes in the world frame, recorded and tracked offline, give the bytes of a session: no heading is turned."""
    sensor, path, chance = Sensor("site/world/lidar"), tmp_path / "world.mcap", np.random.default_rng(7)
    parameters = load_profile("nuscenes")
    session, expected = Session(sensor.stream, parameters), []
    with RecordingWriter(path) as writer:
        for seq in range(30):
            angle = 0.1 * seq + np.arange(8.0)
            message = sensor.detections(
                seq,
                objects=8,
                center=np.c_[20 * np.arange(8) + 5 * np.cos(angle), 5 * np.sin(angle), np.ones(8)]
                + chance.normal(0, 0.05, (8, 3)),
                yaw=angle + np.pi / 2 + chance.normal(0, 0.02, 8),  # beyond pi too
                has_points=False,
            )
            if posed:
                pose = {"translation": [5.0, seq, 1.0], "quaternion": [0.6, 0.0, 0.0, 0.8]}
                message = Detections(**(dict(message.present()) | {"pose": pose}))
            assert message.frame == "world"
            key = Keys().detections(sensor.stream)
            writer.add(key, encode(message), encoding_of(message), seq)
            expected += [one.tracks for one in session.on_detections(message, 0) if isinstance(one, Tracked)]
    (sequence,) = open_dataset("mcap", path).sequences(["all"])
    found = [tracks.tracks for _, tracks, _, _ in track_sequence(parameters, sequence)]
    assert len(found) == len(expected) == 30
    assert len(found[-1].id) >= 8
    for offline, online in zip(found, expected, strict=True):
        for field in fields(offline):
            one, other = getattr(offline, field.name), getattr(online, field.name)
            assert np.asarray(one).tobytes() == np.asarray(other, np.asarray(one).dtype).tobytes(), field.name

"""The promise of the replay: the service gives the same result files as the tracker in process, byte for byte."""

from pathlib import Path
from typing import Any

import pytest
from commands import optipmb, result_of
from optipmb_client.child import ServiceProcess
from real_data import kitti_root

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

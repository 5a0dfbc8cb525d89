"""The sensors of a recording track into one density offline: the bytes of a service with the setting `fuse`."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from commands import result_of, run_here
from fusing import FRONT, FUSED, REAR, SIDE, drive
from optipmb_schemas import Detections, Keys, Tracks, encode, encoding_of
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets.fused import FusedSequence
from optipmb_tools.recordings.recording_file import RecordingWriter
from optipmb_tools.run.profiles import read_sensors
from optipmb_tools.run.tracking import Tracking, track_whole
from sessions import Merged

import optipmb
from optipmb.model.parameters import ALIKE

KITTI = optipmb.load_profile("kitti")
COLUMNS = ("id", "center", "size", "yaw", "velocity", "existence", "score", "covariance", "age", "detection")


UNEQUAL = """
profile = "kitti"  # of the service
[sensors."site/*/rear"]
profile = "nuscenes"
starts_tracks = false
[sensors."*/*/s*"]
trust_size = false
trust_heading = false
"""


def served(frames: list[Detections], sensors: optipmb.Sensors = ALIKE) -> list[Tracks]:
    """The tracks of a service, the last of each frame, in the order of the frames."""
    one, merged = Session(FUSED, KITTI, Policy(recovery_wait_ns=0, sensors=sensors), fused=True), Merged()
    for frame in sorted(frames, key=lambda one: one.stamp_ns):
        merged.take(one.on_detections(frame, 0))
    found = [message for _, message in merged.newest.values()]
    return sorted(found, key=lambda message: (message.stamp_ns, message.sensor or ""))


def recorded(path: Path, frames: list[Detections]) -> Path:
    with RecordingWriter(path) as writer:
        for number, frame in enumerate(frames):
            writer.add(Keys().detections(frame.stream), encode(frame), encoding_of(frame), number)
    return path


def tabled(path: Path, frames: list[Detections]) -> Path:
    """Write frames as rows with a column of the sensor, one sensor below the other."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["log", "sensor", "stamp_ns", "x", "y", "z", "l", "w", "h", "yaw", "score", "class", "vx", "vy"])
        for frame in sorted(frames, key=lambda one: one.stream):
            for i in range(len(frame.label)):
                box = (frame.center[i], frame.size[i], [frame.yaw[i], frame.score[i]])
                numbers = [repr(float(value)) for part in box for value in part]
                assert frame.velocity is not None
                moving = [repr(float(value)) for value in frame.velocity[i]]
                rows.writerow(["a", frame.stream.split("/")[2], frame.stamp_ns, *numbers, "car", *moving])
    return path


def same(sequence: FusedSequence, wanted: list[Tracks], sensors: optipmb.Sensors = ALIKE) -> None:
    """Check that the tracks of a sequence equal a service's, byte for byte."""
    found = track_whole(Tracking(KITTI, sensors=sensors), sequence).tracks.values()
    assert len(found) == len(wanted)
    for ours, theirs in zip(found, wanted, strict=True):
        for name in COLUMNS:
            assert np.asarray(getattr(ours, name)).tobytes() == getattr(theirs, name).tobytes(), name


def test_a_recording_gives_the_bytes_of_the_service(tmp_path: Path) -> None:
    """Fields of view and frames of two sensors, received in any order."""
    frames = drive(40)
    by_sensor = sorted(frames, key=lambda one: one.stream)
    dataset = open_dataset("mcap", recorded(tmp_path / "a.mcap", by_sensor), fuse="1")
    (sequence,) = dataset.sequences(["all"])
    assert isinstance(sequence, FusedSequence)
    assert (sequence.name, len(sequence)) == ("site.node.fused", len(frames))
    same(sequence, served(frames))
    assert dataset.sequences(["site/node/fused"]) == [sequence]


def test_a_table_gives_the_bytes_of_the_service(tmp_path: Path) -> None:
    """By the column of the sensor; two of them have the same stamps."""
    frames = [one.detections(seq, has_points=False) for one in (FRONT, REAR, SIDE) for seq in range(12)]
    dataset = open_dataset("table", tabled(tmp_path / "a.csv", frames), fuse="1")
    (sequence,) = dataset.sequences(["all"])
    assert isinstance(sequence, FusedSequence)
    assert (sequence.name, len(sequence)) == ("a", len(frames))
    same(sequence, served(frames))


@pytest.mark.parametrize("form", ["mcap", "table"])
def test_sensors_that_differ_give_the_bytes_of_the_service(tmp_path: Path, form: str) -> None:
    """By the table `sensors` of the settings; in a table of detections the column has the last part of a name."""
    settings = tmp_path / "service.toml"
    settings.write_text(UNEQUAL, encoding="utf-8")
    sensors = read_sensors(settings)
    frames = [one.detections(seq, has_points=False) for one in (FRONT, REAR, SIDE) for seq in range(12)]
    path = recorded(tmp_path / "a.mcap", frames) if form == "mcap" else tabled(tmp_path / "a.csv", frames)
    (sequence,) = open_dataset(form, path, fuse="1").sequences(["all"])
    assert isinstance(sequence, FusedSequence)
    wanted = served(frames, sensors)
    same(sequence, wanted, sensors)
    assert [one.covariance.tobytes() for one in wanted] != [one.covariance.tobytes() for one in served(frames)]


def test_the_command_reads_how_sensors_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No id begins in frames of a sensor that starts no tracks."""
    frames = [one.detections(seq, has_points=False) for one in (FRONT, REAR) for seq in range(12)]
    source, out, settings = tabled(tmp_path / "a.csv", frames), tmp_path / "tracks.csv", tmp_path / "service.toml"
    settings.write_text('[sensors."site/node/front"]\nstarts_tracks = false\n', encoding="utf-8")
    run_here(capsys, "track", source, "--fuse", "--sensors", settings, "--out", out, "--profile", "kitti")
    begun: dict[str, str] = {}
    with out.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            begun.setdefault(row["id"], row["sensor"])
    assert set(begun.values()) == {"rear"}


@pytest.mark.parametrize(
    ("text", "fuse", "error"),
    [
        ("", False, "expected --fuse"),
        ("[sensors", True, r"service.toml: Expected"),
        ('[sensors."a/b/c"]\nprofile = "none"', True, r"sensors.a/b/c.profile: expected one of"),
    ],
)
def test_a_wrong_table_of_sensors_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, error: str, *, fuse: bool
) -> None:
    """One line names the file and the field."""
    settings = tmp_path / "service.toml"
    settings.write_text(text, encoding="utf-8")
    source = tabled(tmp_path / "a.csv", [FRONT.detections(0)])
    options = ["--sensors", settings, *(["--fuse"] if fuse else [])]
    done = run_here(capsys, "track", source, *options, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert re.search(error, " ".join(done.stderr.split()))


def test_tracks_of_a_table_say_the_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each row has the recording, the sensor, the time and the row of the detection in the table."""
    frames = [one.detections(seq, has_points=False) for one in (FRONT, SIDE) for seq in range(12)]
    source, out = tabled(tmp_path / "a.csv", frames), tmp_path / "tracks.csv"
    report = result_of(run_here(capsys, "track", source, "--fuse", "--out", out, "--jobs", 1, "--json"))
    assert [one["name"] for one in report["sequences"]] == ["a"]
    with source.open(encoding="utf-8") as file, out.open(encoding="utf-8") as result:
        given, rows = list(csv.DictReader(file)), list(csv.DictReader(result))
    assert {row["sensor"] for row in rows} == {"front", "side"}
    found = [row for row in rows if row["detection_row"]]
    assert found
    for row in found:
        detection = given[int(float(row["detection_row"]))]
        assert (detection["sensor"], detection["stamp_ns"]) == (row["sensor"], row["stamp_ns"])
    assert len({row["id"] for row in rows}) == FRONT.objects


@pytest.mark.parametrize("name", ["kitti", "nuscenes", "rosbag"])
def test_data_without_sensors_are_not_fused(tmp_path: Path, name: str) -> None:
    """What cannot be is said at once."""
    with pytest.raises(DatasetError, match="--fuse: expected a table with a column `sensor`"):
        open_dataset(name, tmp_path, fuse="1")


def test_a_table_without_the_column_is_not_fused(tmp_path: Path) -> None:
    """The line names the missing part."""
    path = tabled(tmp_path / "a.csv", [FRONT.detections(0)])
    path.write_text(path.read_text(encoding="utf-8").replace("sensor", "other"), encoding="utf-8")
    with pytest.raises(DatasetError, match="--fuse: expected frames that name their sensor"):
        open_dataset("table", path, fuse="1")

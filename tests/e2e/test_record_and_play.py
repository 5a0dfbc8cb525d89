"""Recordings made by the command from a real service, played into another one."""

import contextlib
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import kill, result_of, run_here, start
from mcap.reader import make_reader
from optipmb_client import Connection, Subscriber
from optipmb_schemas import Tracks, decode, encode
from optipmb_tools.cli import run
from optipmb_tools.datasets import Dataset, DatasetError, open_dataset
from optipmb_tools.recordings.recording_file import RecordingFile
from optipmb_tools.run.replay import Replaying, ReplayPace, replay
from real_data import REPOSITORY
from service_process import ServiceProcess

FRAMES = 15
VALUES = {"frames": FRAMES, "vehicles": 8, "pedestrians": 2}
SCENE = ("--dataset", "scene", *(f"--option={name}={value}" for name, value in VALUES.items()))
FOUR = ("0000", "0001", "0002", "0003")
DEADLINE_S = 120.0

PATIENT = {"OPTIPMB_CLOUD_WAIT_S": "5"}
"""On a busy machine a cloud comes later than the tenth of a second for which a frame waits; its tracks would differ."""


@contextlib.contextmanager
def patient() -> Iterator[ServiceProcess]:
    with ServiceProcess(environment=PATIENT) as process:
        process.wait_ready()
        yield process


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A service with its own router, whose frames wait for their clouds."""
    with patient() as process:
        yield process


@pytest.fixture
def fresh() -> Iterator[ServiceProcess]:
    """A service that knows nothing."""
    with patient() as process:
        yield process


@contextlib.contextmanager
def recording(service: ServiceProcess, path: Path) -> Iterator["subprocess.Popen[str]"]:
    """Record all that goes through a service into `path`; ready when its subscriptions are."""
    process = start("record", "--out", path, "--connect", service.endpoint)
    try:
        with Connection(service.endpoint) as connection:
            probe = connection.plain_sender("optipmb/v1/a/probe/x/points", "")  # subscribed to last
            wait_for(lambda: probe.wanted and path.exists() and len(path.read_bytes()) > 0, service)
        yield process
    finally:
        if process.poll() is None:
            kill(process)


def wait_for(condition: object, service: ServiceProcess) -> None:
    assert callable(condition)
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert service.process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)  # a file and a matching status cannot be waited on


def count(path: Path, topic: str) -> int:
    """Messages of a topic in a recording that may still grow; 0 when it grew while it was read to its end."""
    try:
        return sum(one.topic == topic for one in RecordingFile(path))
    except DatasetError:
        return 0


def newest_tracks(path: Path) -> dict[tuple[str, int], bytes]:
    """Tracks of a recording without what tells of their delivery, by stream and number."""
    found: dict[tuple[str, int], Tracks] = {}
    for one in RecordingFile(path):
        if one.topic == "tracks":
            tracks = decode(one.payload, Tracks, encoding=one.encoding)
            known = found.get((tracks.stream, tracks.seq))
            if known is None or known.revision <= tracks.revision:
                found[tracks.stream, tracks.seq] = tracks
    return {key: encode(tracks.model_copy(update={"delivery": None})) for key, tracks in found.items()}


def recorded_replay(service: ServiceProcess, folder: Path, dataset: "Dataset", *names: str) -> Path:
    """Replay sequences through a service while they are recorded, all at once; give the recording.

    After its first frame each waits until the recording has the parameters of all: they are gone with the sessions.
    """
    path = folder / "incident.mcap"
    asked = threading.Event()

    def hold() -> None:
        if not asked.is_set():
            wait_for(lambda: count(path, "parameters") == len(names), service)
            asked.set()

    with recording(service, path) as process:
        with Connection(service.endpoint) as connection:
            pace = ReplayPace(patience_s=2 * DEADLINE_S)
            replayed = replay(
                connection,
                dataset,
                dataset.sequences(names),
                folder / "replay",
                Replaying(dataset.profile, pace, streams=len(names)),
                hold,
            )
        assert not any(one.missing or one.clouds_missed for one in replayed)
        # The recording hears of the newest tracks after the replay.
        wait_for(lambda: count(path, "tracks") >= sum(one.frames for one in replayed), service)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0, err
        assert "parameters" in out
    return path


def play_into_another(path: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Play a recording into a service that knows nothing, and record that; all tracks must be the same bytes."""
    with patient() as fresh, recording(fresh, folder / "again.mcap") as process:
        result = result_of(
            run_here(capsys, "play", path, "--as-recorded", "--connect", fresh.endpoint, "--json"),
        )
        returned = sum(stream["returned"] for stream in result["streams"])
        wait_for(lambda: count(folder / "again.mcap", "tracks") >= returned, fresh)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
    names = {stream["name"] for stream in result["streams"]}
    first = {key: content for key, content in newest_tracks(path).items() if key[0] in names}
    again = newest_tracks(folder / "again.mcap")
    assert len(first) > 3 * FRAMES
    assert again == first
    for stream in result["streams"]:
        assert stream["equal"] == stream["recorded"] == stream["frames"] == stream["returned"]
        assert stream["first_difference"] is None
        assert stream["clouds_lost"] == 0
        assert stream["other_values"] is False


def test_four_streams_played_into_a_fresh_service(
    service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ids, sessions, numbers, stamps and every byte of the tracks equal the recording; offline, too."""
    path = recorded_replay(service, tmp_path, open_dataset("scene", **VALUES), *FOUR)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    topics = {channel.topic.rsplit("/", 1)[1] for channel in summary.channels.values()}
    assert topics == {"detections", "points", "tracks", "scene", "pose", "figures", "parameters"}
    play_into_another(path, tmp_path, capsys)
    offline = result_of(
        run_here(capsys, "track", "--dataset", "mcap", "--root", path, "--out", tmp_path / "offline", "--json")
    )
    for entry in offline["sequences"]:
        name = entry["name"].rsplit(".", 1)[1]
        replayed = (tmp_path / "replay" / f"{name}.txt").read_bytes()
        assert Path(entry["file"]).read_bytes() == replayed
        assert len(replayed) > 1000


@pytest.fixture(scope="module")
def incident(service: ServiceProcess, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_replay(service, tmp_path_factory.mktemp("incident"), open_dataset("scene", **VALUES), "0000")


def test_a_recording_is_played_again_and_again(
    service: ServiceProcess, incident: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Under names of its own it meets no session, so the same service plays it twice, with the same result files."""
    for folder in ("one", "two"):
        done = run_here(
            capsys, "play", incident, "--connect", service.endpoint, "--out", tmp_path / folder, "--speed", 4
        )
        assert done.returncode == 0, done.stderr
        assert f"{FRAMES} of {FRAMES} equal to the recorded tracks" in done.stdout
    (one,), (two,) = ((tmp_path / folder).glob("*.txt") for folder in ("one", "two"))
    assert one.read_bytes() == two.read_bytes() == (incident.parent / "replay" / "0000.txt").read_bytes()


def test_parameters_of_another_session_are_not_recorded(fresh: ServiceProcess, incident: Path, tmp_path: Path) -> None:
    """Of a session that has ended when the service is asked, nothing is recorded that its tracks were not made with."""
    first = next(one for one in RecordingFile(incident) if one.topic == "tracks")
    path = tmp_path / "ended.mcap"
    with recording(fresh, path) as process:
        with Connection(fresh.endpoint) as connection:
            sender = connection.plain_sender(f"optipmb/v1/{first.stream}/tracks", first.encoding)
            wait_for(lambda: sender.wanted, fresh)
            sender.put(first.payload)
            wait_for(lambda: count(path, "tracks"), fresh)
        process.send_signal(signal.SIGTERM)  # it ends with the answer
        process.communicate(timeout=DEADLINE_S)
    assert {one.topic for one in RecordingFile(path)} == {"tracks"}


def test_tracks_that_differ_are_reported(
    service: ServiceProcess, incident: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With other parameters the tracks are others: status 1 and the number of the first frame that differs."""
    done = run_here(capsys, "play", incident, "--connect", service.endpoint, "--profile", "kitti")
    assert done.returncode == 1
    assert "differ from the recorded ones, the first is number" in done.stderr
    assert "profile kitti here has other values than what was in force" in done.stderr


def test_a_stream_that_was_tracked_before_is_reported(incident: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Played twice under the recorded name, ids go on from the first time: status 1, and why, in one line."""
    with patient() as fresh:
        again = ("play", incident, "--as-recorded", "--connect", fresh.endpoint)
        done = run_here(capsys, *again)
        assert (done.returncode, done.stderr) == (0, "")
        done = run_here(capsys, *again, "--patience", 1)  # of frames that it has, nothing comes
    assert done.returncode == 1
    why, what = done.stderr.splitlines()
    assert re.search(r"this service has tracked replay/\S+ before, so ids begin at \d+: play it without", why)
    assert "frames differ from the recorded ones" in what


def test_a_killed_recording_still_plays(
    service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """SIGKILL in the middle of a stream: messages until a second before are there, and play the same."""
    path = tmp_path / "cut.mcap"
    with recording(service, path) as process, Subscriber("replay/*/0000", service.endpoint) as tracks:
        replaying = start("replay", *SCENE, "--option", "frames=60", "--speed", 1, "--connect", service.endpoint)
        try:
            for _ in range(30):
                assert tracks.receive(DEADLINE_S) is not None
        finally:
            kill(process)
            kill(replaying)
    cut = RecordingFile(path)
    assert sum(one.topic == "tracks" for one in cut) >= 30 - 25  # at 10 Hz, a flush a second on a busy machine
    assert cut.cut
    done = run_here(capsys, "play", path, "--connect", service.endpoint)
    assert "was cut off" in done.stderr
    assert "equal to the recorded tracks" in done.stdout
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("play", "no.mcap"), "no.mcap"),
        (("play", __file__), "a recording"),
        (("play", "no.mcap", "--speed", "0"), "--speed"),
        (("record", "--out", __file__), "a new file"),
    ],
)
def test_what_cannot_be_is_one_line_with_status_2(
    arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wrong files and options are reported before anything is connected."""
    assert run(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_a_car_keeps_its_id_where_the_world_moves(
    fresh: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example of the documentation prints one track in both worlds; its recording plays to the same bytes."""
    page = (REPOSITORY / "docs" / "operation.md").read_text(encoding="utf-8")
    found = re.search(r"# When the world moves.*?```python\n(.*?)```", page, re.DOTALL)
    assert found is not None
    where = f', connect="{fresh.endpoint}"'
    code = found[1].replace("timeout=10)", f"timeout=60{where})").replace('frame="world")', f'frame="world"{where})')
    assert code.count(where) == 2
    path = tmp_path / "moved.mcap"
    with recording(fresh, path) as recorder:
        run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=200)
        wait_for(lambda: count(path, "tracks") >= 20, fresh)
        recorder.send_signal(signal.SIGINT)
        recorder.communicate(timeout=DEADLINE_S)
    lines = [line.split() for line in run.stdout.splitlines()]
    assert {(line[1], line[3]) for line in lines} == {("0", "1"), ("1", "1")}
    assert [float(one) for one in lines[-1][5:]] == pytest.approx([100.0, 59.5], abs=0.3)
    played = result_of(run_here(capsys, "play", path, "--connect", fresh.endpoint, "--json"))
    assert [(one["frames"], one["recorded"], one["equal"]) for one in played["streams"]] == [(20, 20, 20)]

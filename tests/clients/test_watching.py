"""Messages shown in Rerun, and the command that shows them."""

import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from commands import start
from optipmb_client.incoming import Answer, Inbox
from optipmb_schemas import Density, Detections, Keys, Points, Pose, Tracks, encode, encoding_of
from optipmb_tools.cli import run
from optipmb_tools.recordings.recording_file import RecordingWriter
from optipmb_tools.views.colours import COLOURS, colour_of, rgb_of
from optipmb_tools.views.viewer import LEGEND, DensityQueries, View
from routers import free_endpoint
from tracks_message import tracks_message

STREAM = "garage/robot-1/lidar"
POSE = Pose(translation=[100.0, 50.0, 2.0], quaternion=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # looks along y
DEADLINE_S = 60.0


class Log:
    """A Rerun recording that keeps the newest entry of each path."""

    def __init__(self) -> None:
        self.entities: dict[str, tuple[Any, ...]] = {}
        self.times: list[tuple[str, dict[str, Any]]] = []
        self.blueprints: list[Any] = []

    def log(self, path: str, *shown: Any, **_options: bool) -> None:
        self.entities[path] = shown

    def set_time(self, timeline: str, **when: Any) -> None:
        self.times.append((timeline, when))

    def send_blueprint(self, blueprint: Any) -> None:
        self.blueprints.append(blueprint)

    def column(self, path: str, name: str) -> Any:
        array = getattr(self.entities[path][0], name).as_arrow_array()
        assert isinstance(array, pa.Array)
        return array.to_pylist()


def tracks(seq: int, ids: list[int], covariance: np.ndarray | None = None) -> Tracks:
    return tracks_message(
        STREAM,
        seq,
        ids,
        stamp_ns=seq * 1_000_000_000,
        center=[[10.0 * seq, float(row), 1.0] for row in range(len(ids))] or np.zeros((0, 3)),
        size=[4.0, 2.0, 1.5],
        yaw=0.5,
        velocity=[2.0, 1.0],
        existence=0.75,
        confirmed=np.ones(len(ids), np.int64),
        score=np.linspace(0.9, 0.1, len(ids)),
        covariance=np.eye(6) if covariance is None else covariance,
    )


def detections() -> Detections:
    """One detection, five metres ahead of a sensor that looks along y."""
    return Detections(
        stream=STREAM,
        epoch=bytes(16),
        seq=0,
        stamp_ns=0,
        frame="sensor",
        pose=POSE,
        labels=["Car"],
        label=[0],
        center=[[5.0, 1.0, 0.0]],
        size=[[4.0, 2.0, 1.5]],
        yaw=[0.0],
        score=[0.9],
    )


def density() -> Density:
    """Two components, one that expects next to nothing and one that expects a quarter of an object."""
    covariance = np.tile(100 * np.eye(6), (2, 1, 1))
    covariance[:, 0, 0], covariance[:, 1, 1] = 4.0, 9.0
    return Density(
        stream=STREAM,
        session="0" * 32,
        stamp_ns=0,
        labels=["Car"],
        label=[0, 0],
        weight=[0.0001, 0.25],
        mean=[[1.0, 2.0, 9.0, 9.0, 9.0, 9.0], [3.0, 4.0, 9.0, 9.0, 9.0, 9.0]],
        covariance=covariance,
        z=[0.5, -0.5],
    )


def cloud() -> Points:
    xyz = np.array([[1, 0, 0], [0, 1, 0]], np.float32)
    return Points(stream=STREAM, epoch=bytes(16), seq=0, stamp_ns=0, frame="sensor", pose=POSE, xyz=xyz)


def test_tracks_are_boxes_of_their_colour_with_id_and_existence() -> None:
    """Place, size, turn, velocity and colour equal the message; only the surer tracks have a label."""
    log = Log()
    View(log).show(tracks(1, [3, 10, 11]))  # type: ignore[arg-type]  # stands for a recording
    path = f"{STREAM}/tracks"
    assert log.column(path, "centers") == [[10.0, 0.0, 1.0], [10.0, 1.0, 1.0], [10.0, 2.0, 1.0]]
    assert log.column(path, "half_sizes")[0] == [2.0, 1.0, 0.75]
    x, y, z, w = log.column(path, "quaternions")[0]
    assert (x, y) == (0.0, 0.0)
    assert 2 * np.arctan2(z, w) == pytest.approx(0.5)
    assert log.column(path, "labels") == ["3 0.75", "10 0.75", ""]
    red, green, blue = rgb_of(3)
    colours = log.column(path, "colors")
    assert colours[0] == colours[1] == (red << 24 | green << 16 | blue << 8 | 255)
    assert colours[2] != colours[0]
    assert log.column(f"{path}/velocity", "vectors")[0] == [2.0, 1.0, 0.0]


def test_tracks_of_an_object_are_one_in_views() -> None:
    """Where tracks are joined over gaps, a track has the label and colour of its object as soon as it is decided."""
    log = Log()
    joined = {"object": np.array([3, 4, -1]), "object_probability": np.ones(3, np.float32)}
    View(log).show(tracks(1, [3, 10, 11]).model_copy(update=joined))  # type: ignore[arg-type]  # as above
    assert log.column(f"{STREAM}/tracks", "labels")[:2] == ["3 0.75", "4 0.75"]
    red, green, blue = rgb_of(4)
    assert log.column(f"{STREAM}/tracks", "colors")[1] == red << 24 | green << 16 | blue << 8 | 255


def test_ellipses_are_two_standard_deviations_long_and_turned() -> None:
    """The covariance of the position is drawn along its own axes, for any other states."""
    turn, long, short = 0.6, 3.0, 0.5
    c, s = np.cos(turn), np.sin(turn)
    covariance = np.eye(6) * 100.0
    rotation = np.array([[c, -s], [s, c]])
    covariance[:2, :2] = rotation @ np.diag([long**2, short**2]) @ rotation.T
    log = Log()
    View(log).show(tracks(0, [1], covariance))  # type: ignore[arg-type]  # as above
    path = f"{STREAM}/tracks/covariance"
    (half,), (quaternion,) = log.column(path, "half_sizes"), log.column(path, "quaternions")
    assert half[:2] == pytest.approx([2 * short, 2 * long], rel=1e-5)
    angle = 2 * np.arctan2(quaternion[2], quaternion[3])  # of the short axis, which comes first
    assert np.cos(2 * (angle - turn - np.pi / 2)) == pytest.approx(1.0, abs=1e-5)


def test_trails_are_the_last_five_seconds() -> None:
    """A way grows with its track and ends with it; older places go."""
    log = Log()
    view = View(log)  # type: ignore[arg-type]  # as above
    for seq in range(9):
        view.show(tracks(seq, [1, 2] if seq < 2 else [1]))
    (strip,) = log.column(f"{STREAM}/tracks/trails", "strips")
    assert [place[0] for place in strip] == [30.0, 40.0, 50.0, 60.0, 70.0, 80.0]


def test_detections_and_clouds_are_shown_in_the_world() -> None:
    """Objects in the sensor's frame are moved to the sensor's pose; the sensor is shown too."""
    log = Log()
    view = View(log)  # type: ignore[arg-type]  # as above
    view.show(detections())
    view.show(cloud())
    assert log.column(f"{STREAM}/detections", "centers")[0] == pytest.approx([99.0, 55.0, 2.0], abs=1e-4)
    places = log.column(f"{STREAM}/cloud", "positions")
    assert places[0] == pytest.approx([100.0, 51.0, 2.0], abs=1e-4)
    assert places[1] == pytest.approx([99.0, 50.0, 2.0], abs=1e-4)
    assert log.column(f"{STREAM}/sensor", "translation")[0] == [100.0, 50.0, 2.0]


def test_components_are_faint_ellipses_on_a_path_of_their_own() -> None:
    """Place and covariance equal the message; weight is the size of the point, and how dark both are."""
    log = Log()
    view = View(log)  # type: ignore[arg-type]  # as above
    view.show(density())
    path = f"{STREAM}/poisson"
    assert set(log.entities) == {"/", "legend", path, f"{path}/weight"}
    assert log.column(path, "centers") == [[1.0, 2.0, 0.5], [3.0, 4.0, -0.5]]
    assert sorted(log.column(path, "half_sizes")[0])[1:] == pytest.approx([4.0, 6.0])
    assert log.column(f"{path}/weight", "positions") == [[1.0, 2.0, 0.5], [3.0, 4.0, -0.5]]
    assert log.column(f"{path}/weight", "radii") == pytest.approx([0.01, 0.5])
    faint, dark = log.column(path, "colors")
    assert faint > dark
    view.show(density().model_copy(update={"stamp_ns": None}))
    assert len(log.times) == 1


class Answering:
    def __init__(self) -> None:
        self.asked: list[tuple[str, str]] = []

    def query(self, key: str, **_options: float) -> tuple[Answer, ...]:
        self.asked.append((key, threading.current_thread().name))
        encoding = encoding_of(Density)
        return (Answer(key, b"no", encoding, ok=False), Answer(key, encode(density()), encoding, ok=True))


def test_only_streams_with_new_tracks_are_asked() -> None:
    """One question for a stream, however many tracks came, and none again while it is silent; never on our thread."""
    connection, inbox = Answering(), Inbox(9)
    with DensityQueries(connection, inbox) as asker:  # type: ignore[arg-type]  # stands for a connection
        for stream in ("a/b/c", "a/b/c", "a/b/d"):
            asker.note(stream)
        arrivals = [inbox.get(DEADLINE_S) for _ in range(2)]
        asker.note("a/b/e")
        arrivals.append(inbox.get(DEADLINE_S))
    keys = [Keys().query(stream, "density") for stream in ("a/b/c", "a/b/d", "a/b/e")]
    assert [arrival.key for arrival in arrivals if arrival] == keys
    assert [arrival.payload for arrival in arrivals if arrival] == [encode(density())] * 3
    assert connection.asked == [(key, "densities") for key in keys]


def test_the_layout_is_sent_once_and_axes_have_metres() -> None:
    """One layout, for the first stream; numbered axes near the sensor; a legend of the drawn items."""
    log = Log()
    view = View(log)  # type: ignore[arg-type]  # as above
    view.show(detections())
    for seq in range(3):
        view.show(tracks(seq, [1]))
    assert len(log.blueprints) == 1
    labels = log.column("axes", "labels")
    assert "x = 100 m" in labels
    assert any(label.startswith("y = ") for label in labels)
    for word in ("track", "detection", "sensor", "ellipse", "arrow", "existence", "metres"):
        assert word in LEGEND


def test_stamps_since_1970_are_times_and_small_ones_seconds() -> None:
    """A sensor's own clock starts near zero."""
    log = Log()
    view = View(log)  # type: ignore[arg-type]  # as above
    view.show(tracks(3, []))
    view.show(tracks(0, []).model_copy(update={"stamp_ns": 1_700_000_000_000_000_000}))
    assert [name for name, _ in log.times] == ["seconds", "stamp"]


def test_colours_can_be_told_apart() -> None:
    """Seven colours, all different; the eighth track repeats the first."""
    assert len(set(COLOURS)) == 7
    assert colour_of(0) == colour_of(7) == "#0072B2"
    assert rgb_of(0) == (0, 0x72, 0xB2)


@pytest.fixture
def incident(tmp_path: Path) -> Path:
    path = tmp_path / "incident.mcap"
    keys = Keys()
    with RecordingWriter(path) as writer:
        for number, (key, message) in enumerate(
            [
                (keys.detections(STREAM), detections()),
                (keys.points(STREAM), cloud()),
                *((keys.tracks(STREAM), tracks(seq, [1, 2])) for seq in range(5)),
            ]
        ):
            writer.add(key, encode(message), encoding_of(message), number)
        writer.add(keys.tracks(STREAM), b"\xc1", "", 99)
    return path


def test_a_recording_becomes_a_file_for_rerun(incident: Path, tmp_path: Path) -> None:
    """The file opens with Rerun's own tool and holds every entity."""
    assert run(["watch", str(incident), "--save", str(tmp_path / "out" / "a.rrd")]) == 0
    shown = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "out" / "a.rrd")],
        capture_output=True,
        text=True,
        check=True,
        timeout=DEADLINE_S,
    )
    for entity in ("tracks", "tracks/velocity", "tracks/covariance", "tracks/trails", "detections", "cloud", "sensor"):
        assert f"/{STREAM}/{entity}" in shown.stdout
    assert "/legend" in shown.stdout


def test_the_viewer_is_served_to_a_browser(incident: Path) -> None:
    """With --web the address that is printed answers with a page; it ends in time."""
    port = free_endpoint().rpartition(":")[2]
    grpc = free_endpoint().rpartition(":")[2]
    process = start("watch", incident, "--web", "--web-port", port, "--data-port", grpc, "--seconds", 20, fresh=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert f"http://localhost:{port}/" in line
        assert grpc in line
        ends = time.monotonic() + DEADLINE_S
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as page:
                    assert b"<html" in page.read(2000).lower()
                break
            except OSError:
                assert time.monotonic() < ends
                time.sleep(0.05)  # another program's port: there is nothing to wait on
    finally:
        process.kill()
        process.communicate(timeout=60)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("no.mcap", "--save", "a.rrd"), "no.mcap"),
        (("--web", "--save", "a.rrd"), "--save"),
        (("some.mcap", "--poisson", "--save", "a.rrd"), "--poisson"),
        (("--streams", "a/b", "--save", "a.rrd"), "a/b"),
    ],
)
def test_wrong_options_are_one_line(
    options: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 2, and no file is left behind."""
    assert run(["watch", *(str(tmp_path / one) if one.endswith("rrd") else one for one in options)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not list(tmp_path.iterdir())

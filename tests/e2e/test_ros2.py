"""The bridge to ROS 2 with a node by zenoh-ros2-sdk on the other side, over a real router and a real service."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest
import zenoh
import zenoh.ext
from optipmb_schemas import Keys, SessionParameters, decode
from optipmb_schemas.ros2.arrays import CLOUD
from optipmb_schemas.ros2.tracks import HORIZONS, TOPICS, TRACKED
from optipmb_schemas.ros2.types import own_types
from optipmb_service.app import cli
from optipmb_service.edges.ros2 import graph
from optipmb_tools.datasets import DataSequence, open_dataset
from optipmb_tools.run.profiles import read_profile
from optipmb_tools.run.tracking import Tracking, track_whole
from ros2_client import Ros2Client, hash_by_sdk
from router import until
from routers import open_client
from service_process import ServiceProcess
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

DOMAINS = itertools.count(7)
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TRACKS = "/detector/boxes/tracks"
START_NS = 10**18

PATIENCE_S = 20.0
"""How long clouds and transforms are waited for that do come, on a busy machine."""


@pytest.fixture(scope="module")
def scene() -> DataSequence:
    (sequence,) = open_dataset("scene", frames=16, vehicles=6, pedestrians=3).sequences(["0000"])
    return sequence


@dataclass(frozen=True)
class Robot:
    """A stream and a domain of ROS that no other test uses, at the router of one service for all tests."""

    endpoint: str
    domain: int

    @property
    def stream(self) -> str:
        return f"garage/robot-{self.domain}/lidar"


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A service that is a router, and waits long enough for clouds on a busy machine."""
    with ServiceProcess("--profile", "scene", environment={"OPTIPMB_CLOUD_WAIT_S": str(PATIENCE_S)}) as process:
        process.wait_ready()
        yield process


@pytest.fixture
def robot(service: ServiceProcess) -> Robot:
    return Robot(service.endpoint, next(DOMAINS))


def bridge(robot: Robot, folder: Path, *, points: str = "", tf_wait_s: float = PATIENCE_S) -> ServiceProcess:
    """Start the bridge, for a topic of points where one is named; use it as a context manager."""
    file = folder / "ros2.toml"
    stream = f'[ros2.streams."{robot.stream}"]\ndetections = "/detector/boxes"\n'
    clouds = f'points = "{points}"\n' if points else ""
    file.write_text(f"[ros2]\ndomain = {robot.domain}\ntf_wait_s = {tf_wait_s}\n{stream}{clouds}")
    process = ServiceProcess("ros2", "--settings", str(file), "--connect", robot.endpoint, listen=False)
    assert process.wait_ready().startswith(f"ready ros2={robot.stream} ")
    return process


def frames_of(sequence: DataSequence) -> list[list[bags.Sent]]:
    """Give the messages of a scene by frame: transforms first, then the cloud, then the detections."""
    frames: list[list[bags.Sent]] = [[]]
    for one in bags.messages(sequence, start_ns=START_NS):
        frames[-1].append(one)
        if one.topic == "/detector/boxes":
            frames.append([])
    return frames[:-1]


def publish_static(session: zenoh.Session, domain: int, message: dict[str, Any]) -> Any:
    """Publish a static transform as rmw_zenoh does, with a cache for late subscribers; keep the result."""
    key = graph.TopicKey(domain, "/tf_static", TF, hash_by_sdk(TF)).key
    publisher = zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(1),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
        publisher_detection=True,
    )
    types = own_types()
    one = message["transforms"][0]

    def made(kind: str, fields: dict[str, float]) -> Any:
        return types.new(f"geometry_msgs/msg/{kind}", **fields)

    moved = types.new(
        "geometry_msgs/msg/Transform",
        translation=made("Vector3", one["transform"]["translation"]),
        rotation=made("Quaternion", one["transform"]["rotation"]),
    )
    stamp = types.new("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = types.new("std_msgs/msg/Header", stamp=stamp, frame_id=one["header"]["frame_id"])
    fixed = types.new(
        "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=one["child_frame_id"], transform=moved
    )
    publisher.put(types.write(types.new(TF, transforms=[fixed])))
    return publisher


def play(client: Ros2Client, frames: list[list[bags.Sent]]) -> None:
    """Publish frames, each when the tracks of the one before have come back."""
    for frame in frames:
        before = len(client.received[TRACKS])
        for one in frame:
            if one.topic != "/tf_static":
                client.publish(one.topic, one.kind, one.message)
        client.wait(TRACKS, lambda got, before=before: len(got) > before)  # type: ignore[misc]


def ids(message: Any) -> list[int]:
    return [int.from_bytes(bytes(one.object_id.uuid)[8:], "big") for one in message.objects]


def horizons_of(session: zenoh.Session, stream: str) -> list[float]:
    """Ask which horizons the session of a stream has; none without an answer."""
    answers = [one.ok for one in session.get(Keys().query(stream, "parameters"), timeout=PATIENCE_S)]
    parameters = [decode(one.payload.to_bytes(), SessionParameters) for one in answers if one is not None]
    return parameters[0].horizons.tolist() if parameters and parameters[0].horizons is not None else []


def paths_of(message: Any) -> list[Any]:
    return [path for one in message.objects for path in one.kinematics.predicted_paths]


def told(client: Ros2Client, text: str) -> str:
    def texts(messages: list[Any]) -> list[str]:
        return [
            f"{status.message} {pair.value}"
            for message in messages
            for status in message.status
            for pair in status.values
            if text in f"{status.message} {pair.value}"
        ]

    return texts(client.wait("/diagnostics", lambda got: bool(texts(got))))[0]


def ready_client(robot: Robot) -> Ros2Client:
    """Start a node that listens to what the bridge publishes; returns when the bridge is heard."""
    client = Ros2Client(robot.endpoint, robot.domain)
    for topic, kind in (*((TRACKS + end, kind) for end, kind in TOPICS.items()), ("/diagnostics", DIAGNOSTICS)):
        client.subscribe(topic, kind)
    client.wait("/diagnostics", bool)
    return client


def test_topics_become_tracks_of_another_node(robot: Robot, scene: DataSequence, tmp_path: Path) -> None:
    """Detections, clouds and tf of a node that is not ours come back as the tracks of the same data, also to Humble."""
    frames = frames_of(scene)
    static = next(one.message for one in frames[0] if one.topic == "/tf_static")
    with open_client(robot.endpoint) as session, bridge(robot, tmp_path, points="/points") as process:
        publisher = publish_static(session, robot.domain, static)
        with ready_client(robot) as client:
            client.subscribe(TRACKS, TRACKED, name="of Humble", type_hash=graph.NO_HASH)
            play(client, frames[:4])
            until(lambda: horizons_of(session, robot.stream) == list(HORIZONS), "the bridge has asked for paths")
            play(client, frames[4:])
            tracked = client.received[TRACKS]
            detections = client.wait(f"{TRACKS}/detections", lambda got: len(got) == len(frames))
            shown = client.wait(f"{TRACKS}/markers", lambda got: len(got) == len(frames))
            predicted = client.wait(f"{TRACKS}/predicted", lambda got: len(got) == len(frames))
            last = tracked[-1].header.stamp
            of_humble = client.wait("of Humble", lambda got: bool(got) and got[-1].header.stamp == last)[-1]
            published = {"/diagnostics": DIAGNOSTICS} | {TRACKS + end: kind for end, kind in TOPICS.items()}
            for topic, kind in published.items():
                assert ("publisher", "/optipmb", kind, hash_by_sdk(kind)) in client.endpoints(topic)
            for topic, kind in (("/detector/boxes", bags.VISION), ("/points", CLOUD), ("/tf", TF), ("/tf_static", TF)):
                assert ("subscription", "/optipmb", kind, hash_by_sdk(kind)) in client.endpoints(topic)
        del publisher  # withdraws it; to undeclare it may stop the process for ten seconds
    assert {len(path.path) for path in paths_of(predicted[-1])} == {7}
    assert ids(of_humble) == ids(tracked[-1])
    assert process.process.poll() is not None
    expected = track_whole(Tracking(read_profile("scene")), scene).tracks.values()
    assert sum(len(tracks.id) for tracks in expected) > 30
    for index, (message, tracks) in enumerate(zip(tracked, expected, strict=True)):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == START_NS + index * 10**8
        assert message.header.frame_id == "map"
        assert ids(message) == tracks.id.tolist() == [int(one.id) for one in detections[index].detections]
        places = [one.kinematics.pose_with_covariance.pose.position for one in message.objects]
        np.testing.assert_allclose([[p.x, p.y, p.z] for p in places], tracks.center.reshape(-1, 3), atol=1e-9)
        existence = [one.existence_probability for one in message.objects]
        np.testing.assert_allclose(existence, tracks.existence, rtol=1e-6)
        assert len(shown[index].markers) > len(tracks.id)


def test_either_side_may_restart(robot: Robot, scene: DataSequence, tmp_path: Path) -> None:
    """After a restart of the node, and a kill of the bridge, tracks go on with their ids."""
    frames = frames_of(scene)
    static = next(one.message for one in frames[0] if one.topic == "/tf_static")
    with open_client(robot.endpoint) as session:
        publisher = publish_static(session, robot.domain, static)
        with bridge(robot, tmp_path, points="/points") as process:
            with ready_client(robot) as client:
                play(client, frames[:6])
                before = ids(client.received[TRACKS][-1])
            with ready_client(robot) as client:
                play(client, frames[6:10])
                between = ids(client.received[TRACKS][-1])
            process.process.kill()
        with bridge(robot, tmp_path, points="/points"), ready_client(robot) as client:
            play(client, frames[10:])
            after = ids(client.received[TRACKS][-1])
            counted = told(client, "tracking")
        del publisher  # withdraws it; to undeclare it may stop the process for ten seconds
    assert len(before) > 1
    assert set(before) & set(between) & set(after)
    assert counted


def test_what_is_wrong_on_the_other_side_is_reported(robot: Robot, scene: DataSequence, tmp_path: Path) -> None:
    """A clock that starts late, frames that tf lacks, and wrong quality of service or definitions are reported."""
    frames = frames_of(scene)
    boxes = json.loads(json.dumps(next(one for one in frames[0] if one.topic == "/detector/boxes").message))
    with bridge(robot, tmp_path, points="/points", tf_wait_s=1.0) as process, ready_client(robot) as client:
        boxes["header"]["stamp"] = {"sec": 0, "nanosec": 0}
        client.publish("/detector/boxes", bags.VISION, boxes)
        assert "simulated clock that has not started" in told(client, "header.stamp")

        boxes["header"] = bags.header(START_NS, "radar")
        client.publish("/detector/boxes", bags.VISION, boxes)
        assert "expected a transform to it in tf (waited 1." in told(client, "frame 'radar'")

        lasting = QosProfile(durability=QosDurability.TRANSIENT_LOCAL)
        client.subscribe(TRACKS, TRACKED, qos=lasting, node_name="late_joiner")
        assert "node /late_joiner subscribes to" in told(client, "asked for TRANSIENT_LOCAL, offered VOLATILE")

        fixed = {"transforms": []}
        client.publish("/tf_static", TF, fixed, node_name="forgetful")
        assert "/tf_static: node /forgetful publishes" in told(client, "/tf_static")

        other = f"RIHS01_{'0' * 64}"
        client.publish("/points", CLOUD, bags.cloud(START_NS, "velodyne", np.zeros((1, 3))), type_hash=other)
        assert f"another definition of {CLOUD}" in told(client, other)
        process.wait_log("ros2_mismatch")
        assert client.received[TRACKS] == []

        # The clock has started, the transforms and clouds come: the same bridge tracks.
        static = next(one.message for one in frames[0] if one.topic == "/tf_static")
        with open_client(robot.endpoint) as session:
            publisher = publish_static(session, robot.domain, static)
            play(client, frames[:2])
            del publisher  # as above
        assert ids(client.received[TRACKS][-1])


def test_a_clock_that_is_set_back_starts_anew(robot: Robot, scene: DataSequence, tmp_path: Path) -> None:
    """When a simulation starts again, transforms of before are forgotten, and tracks come again."""
    frames = [[one for one in frame if one.topic != "/points"] for frame in frames_of(scene)[:4]]
    with bridge(robot, tmp_path), ready_client(robot) as client:
        play(client, frames)
        back = json.loads(json.dumps([[list(one) for one in frame] for frame in frames]))
        for frame in back:
            for one in frame:
                _shift(one[3], -100)
        for topic, kind, _, message in (one for frame in back for one in frame):
            if topic != "/tf_static":
                client.publish(topic, kind, message)
        # The service believes a clock when three frames agree: the first two have no tracks.
        client.wait(TRACKS, lambda got: got[-1].header.stamp.sec == START_NS // 10**9 - 100)
        assert "the clock went back by 100." in told(client, "clock went back")


def test_a_root_that_comes_late_starts_anew(robot: Robot, scene: DataSequence, tmp_path: Path) -> None:
    """Detections that came before the root of tf was there are tracked in another frame, those after it in the root."""
    frames = [[one for one in frame if one.topic != "/points"] for frame in frames_of(scene)]
    for index, frame in enumerate(frames):
        transforms = next(one.message["transforms"] for one in frame if one.topic == "/tf")
        root = json.loads(json.dumps(transforms[0])) | {"child_frame_id": "base"}
        turned = bags.pose((5, 0, 0), bags.turned(0))
        root["transform"] = {"translation": turned["position"], "rotation": turned["orientation"]}
        transforms[0]["header"]["frame_id"] = "base"
        if index >= 4:
            transforms.append(root)
    with bridge(robot, tmp_path), ready_client(robot) as client:
        play(client, frames)
        tracked = client.received[TRACKS]
        assert "the root of tf is now 'map'" in told(client, "it was 'base'")
    assert [one.header.frame_id for one in tracked] == ["base"] * 4 + ["map"] * (len(frames) - 4)
    before, after = ({id_ for one in part for id_ in ids(one)} for part in (tracked[:4], tracked[4:]))
    assert before
    assert after
    assert not before & after


def _shift(message: Any, seconds: int) -> None:
    if isinstance(message, dict):
        for name, value in message.items():
            if name == "stamp":
                value["sec"] += seconds
            else:
                _shift(value, seconds)
    elif isinstance(message, list):
        for one in message:
            _shift(one, seconds)


def test_the_command_says_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without streams, and with a topic that is none, the command ends with status 2 and one clear line."""
    file = tmp_path / "ros2.toml"
    for text, expected in (
        ('[ros2.streams."a/b/c"]\ndetections = "boxes"', "a topic looks like /lidar/points, received 'boxes'"),
        ('[ros2.streams."a/b"]\ndetections = "/boxes"', "setting ros2.streams (from the file): a stream is named"),
    ):
        file.write_text(text)
        with pytest.raises(SystemExit, match="2"):
            cli.main(("ros2", "--settings", str(file)))
        (line,) = capsys.readouterr().err.splitlines()
        assert expected in line
    file.write_text("")
    with ServiceProcess("ros2", "--settings", str(file), listen=False) as process:
        assert process.wait_end() == 2
        (line,) = process.errors.splitlines()
        assert "setting ros2.streams: expected a table of streams" in line

"""Bags of ROS 2: written by other libraries, tracked, and read by other libraries."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest
from commands import result_of, run_here
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from optipmb_tools.cli import run
from optipmb_tools.datasets import DataSequence, dataset_at, open_dataset
from optipmb_tools.files import DatasetError
from optipmb_tools.results import FullTable, full_path, read_full
from optipmb_tools.run.profiles import read_profile
from optipmb_tools.run.tracking import Tracking, track

DETECTIONS = "/detector/boxes/tracks/detections"
CLASSES = {"class.car": "Car", "class.bicycle": "Cyclist", "class.pedestrian": "Pedestrian"}


@pytest.fixture(scope="module")
def scene() -> DataSequence:
    (sequence,) = open_dataset("scene", frames=20, vehicles=6, pedestrians=3, cyclists=2, velocity=True).sequences(
        ["0000"]
    )
    return sequence


@pytest.fixture(scope="module")
def bag(scene: DataSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_mcap(tmp_path_factory.mktemp("bag") / "scene.mcap", [*bags.messages(scene)])


def tracks_of(name: str, root: Path | None, out: Path, profile: str = "scene", **options: Any) -> FullTable:
    dataset = open_dataset(name, root, **options)
    (result,) = track(dataset, dataset.sequences(["all"])[:1], out, Tracking(read_profile(profile), full=True))
    return read_full(full_path(result.file))


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Give log times and messages of each topic, as another library reads them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


@pytest.mark.parametrize(
    ("kind", "storage", "odometry"),
    [
        (bags.VISION, bags.write_mcap, ""),
        (bags.VISION, bags.write_sqlite, "/odometry"),
        (bags.AUTOWARE, bags.write_mcap, "/odometry"),
        (bags.OLD_AUTOWARE, bags.write_sqlite, ""),
    ],
    ids=["vision-mcap-tf", "vision-sqlite-odometry", "autoware-mcap-odometry", "autoware_auto-sqlite-tf"],
)
def test_tracks_of_a_bag_are_those_of_the_data(
    kind: str, storage: Callable[..., Path], odometry: str, tmp_path: Path
) -> None:
    """The same data, as a bag that another library wrote, give the same tracks; 32-bit scores differ by rounding."""
    options = {"frames": 20, "vehicles": 6, "pedestrians": 3, "cyclists": 0, "velocity": kind != bags.VISION}
    (sequence,) = open_dataset("scene", **options).sequences(["0000"])  # type: ignore[arg-type]
    path = storage(tmp_path / "made.mcap", [*bags.messages(sequence, kind=kind, odometry=bool(odometry))])
    assert dataset_at(path) == "rosbag"
    classes = {} if kind == bags.VISION else CLASSES
    of_bag = tracks_of("rosbag", path, tmp_path / "bag", **classes)
    of_data = tracks_of("scene", None, tmp_path / "data", **options)
    assert len(of_data) > 40
    tolerance = 1e-12 if kind == bags.VISION else 1e-6
    for column in ("frame", "id", "detection"):
        assert np.array_equal(getattr(of_bag, column), getattr(of_data, column)), column
    for column in ("center", "size", "yaw", "velocity", "yaw_rate", "acceleration", "existence", "score", "covariance"):
        np.testing.assert_allclose(
            getattr(of_bag, column), getattr(of_data, column), atol=tolerance, rtol=tolerance, err_msg=column
        )


def test_covariances_in_a_bag_count_where_asked_for(tmp_path: Path) -> None:
    """With the option a doubtful detection leaves its track doubtful; without it the covariance changes nothing."""
    (sequence,) = open_dataset("scene", frames=12, vehicles=4, pedestrians=0, cyclists=0).sequences(["0000"])
    plain = [*bags.messages(sequence)]
    path = bags.write_mcap(tmp_path / "plain.mcap", plain)
    for one in plain:
        for box in one.message["detections"] if one.topic == "/detector/boxes" else ():
            box["results"][0]["pose"]["covariance"] = np.diag([9.0, 9.0, 1.0, 0.0, 0.0, 0.0]).ravel().tolist()
    doubtful = bags.write_mcap(tmp_path / "doubtful.mcap", plain)
    expected = tracks_of("rosbag", path, tmp_path / "a")
    unasked, zeros, found = (
        tracks_of("rosbag", bag, tmp_path / name, **options)
        for name, bag, options in (
            ("b", doubtful, {}), ("c", path, {"covariance": 1}), ("d", doubtful, {"covariance": 1}),
        )
    )  # fmt: skip
    for same in (unasked, zeros):
        assert same.center.tobytes() == expected.center.tobytes()
        assert same.covariance.tobytes() == expected.covariance.tobytes()
    assert np.median(found.covariance[:, 0, 0]) > 3.0 * np.median(expected.covariance[:, 0, 0])


def test_a_bag_of_tracks_says_what_is_known_of_them(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another library reads ids, probabilities, poses, twists and covariances in ROS's order from the written bag."""
    table = tracks_of("rosbag", bag, tmp_path / "table")
    done = run_here(capsys, "track", bag, "--profile", "scene", "--hindsight", 0, "--out", tmp_path / "tracks.mcap")
    assert done.returncode == 0, done.stderr
    found = decoded(tmp_path / "tracks.mcap")
    assert set(found) == {f"/detector/boxes/tracks{end}" for end in ("", "/detections", "/markers", "/predicted")}
    messages = found["/detector/boxes/tracks"]
    objects = [one for _, message in messages for one in message.objects]
    assert (len(messages), len(objects)) == (20, len(table))
    assert [int.from_bytes(bytes(one.object_id.uuid)[8:], "big") for one in objects] == table.id.tolist()
    assert len({bytes(one.object_id.uuid)[:8] for one in objects}) == 1
    for row, one in enumerate(objects):
        pose, twist = one.kinematics.pose_with_covariance, one.kinematics.twist_with_covariance
        place, turn = pose.pose.position, pose.pose.orientation
        np.testing.assert_allclose([place.x, place.y, place.z], table.center[row])
        yaw = 2 * np.arctan2(turn.z, turn.w)
        assert np.cos(yaw - table.yaw[row]) == pytest.approx(1)
        given = table.covariance[row]
        ours = np.array(pose.covariance).reshape(6, 6)
        np.testing.assert_allclose(ours[np.ix_([0, 1, 5], [0, 1, 5])], given[np.ix_([0, 1, 3], [0, 1, 3])])
        assert not ours[2:5].any()
        assert not ours[:, 2:5].any()
        spread = np.array(twist.covariance).reshape(6, 6)
        np.testing.assert_allclose(spread[np.ix_([0, 5], [0, 5])], given[np.ix_([2, 4], [2, 4])])
        speed = twist.twist.linear
        world = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ [speed.x, speed.y]
        np.testing.assert_allclose(world, table.velocity[row], atol=1e-9)
        assert twist.twist.angular.z == pytest.approx(table.yaw_rate[row])
        assert one.kinematics.acceleration_with_covariance.accel.linear.x == pytest.approx(table.acceleration[row])
        assert one.existence_probability == pytest.approx(table.existence[row], rel=1e-6)
        number = one.classification[0].label
        assert (
            bags.CLASS_NAMES[number]
            == {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}[table.labels[table.label[row]]]
        )
        size = one.shape.dimensions
        np.testing.assert_allclose([size.x, size.y, size.z], table.size[row])
    detections = [one for _, message in found["/detector/boxes/tracks/detections"] for one in message.detections]
    assert [int(one.id) for one in detections] == table.id.tolist()
    assert [one.results[0].hypothesis.score for one in detections] == table.score.tolist()
    predicted = [one for _, message in found["/detector/boxes/tracks/predicted"] for one in message.objects]
    assert [bytes(one.object_id.uuid) for one in predicted] == [bytes(one.object_id.uuid) for one in objects]
    for row, one in enumerate(predicted):
        (path,) = one.kinematics.predicted_paths
        assert (len(path.path), path.time_step.sec, path.time_step.nanosec) == (7, 0, 500_000_000)
        np.testing.assert_allclose([path.path[0].position.x, path.path[0].position.y], table.center[row, :2])
        ahead = [[pose.position.x, pose.position.y] for pose in path.path]
        step = np.hypot(*np.diff(ahead, axis=0).T)
        speed = np.hypot(*table.velocity[row])
        assert step[0] == pytest.approx(0.5 * speed, abs=0.1 + 0.2 * speed)
    for _, message in found["/detector/boxes/tracks/markers"]:
        assert message.markers[0].action == 3
        assert {one.header.frame_id for one in message.markers} == {"map"}


def test_the_input_is_kept_beside_the_tracks_if_asked(bag: Path, tmp_path: Path) -> None:
    """With --keep-input the new bag holds every message of the old one as it was; made again, it is the same."""
    outs = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for out in outs:
        assert run(["track", str(bag), "--profile", "scene", "--out", str(out), "--keep-input"]) == 0

    def raw(path: Path) -> list[tuple[str, int, bytes]]:
        with path.open("rb") as file:
            return [(channel.topic, one.log_time, one.data) for _, channel, one in make_reader(file).iter_messages()]

    everything, before = raw(outs[0]), raw(bag)
    assert sorted(one for one in everything if "/tracks" not in one[0]) == sorted(before)
    assert [one[1] for one in everything] == sorted(one[1] for one in everything)
    assert [(name, stamp) for name, stamp, _ in everything if name.endswith("/tracks")] == [
        (f"{name}/tracks", stamp) for name, stamp, _ in before if name == "/detector/boxes"
    ]
    pair = ["/detector/boxes", "/detector/boxes/tracks"]  # received at the same time, and in this order
    assert [name for name, *_ in everything if name in pair] == pair * 20
    assert raw(outs[1]) == everything
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == []


def test_the_command_tells_a_bag_from_other_files(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`optipmb track PATH` goes by what the path is; a wrong one is one clear line and status 2."""
    result = result_of(run_here(capsys, "track", bag, "--profile", "scene", "--out", tmp_path, "--json"))
    assert (result["dataset"], result["sequences"][0]["name"], result["sequences"][0]["clouds"]) == (
        "rosbag",
        "detector.boxes",
        20,
    )
    (tmp_path / "empty").mkdir()
    for arguments, text in (
        (["nothing.mcap"], "nothing.mcap: expected a table"),
        ([tmp_path / "empty"], "a bag of ROS 2 (with metadata.yaml"),
        ([bag, "--root", bag], "one of them names the data"),
        ([bag, "--option", "speed=1"], "option speed: expected one of fixed_frame, odometry, points"),
        ([bag, "--sequences", "other"], "topics of detections: /detector/boxes"),
        (["--dataset", "scene", "--out", "x.mcap"], "only tracks of a bag"),
    ):
        status, told = run(["track", *map(str, arguments)]), capsys.readouterr().err
        assert (status, told.count("\n")) == (2, 1), told
        assert text in told


def test_an_unfinished_file_is_reported(bag: Path, tmp_path: Path) -> None:
    """A file whose recorder was killed is refused with what to do about it."""
    path = tmp_path / "torn.mcap"
    path.write_bytes(bag.read_bytes()[:-100])
    with pytest.raises(DatasetError, match="mcap recover"):
        open_dataset("rosbag", path)


def changed(scene: DataSequence, path: Path, change: Callable[[bags.Sent], bags.Sent | None]) -> Path:
    sent = [new for one in bags.messages(scene) if (new := change(one)) is not None]
    return bags.write_mcap(path, sent)


def test_messages_without_a_pose_are_left_out_and_reported(
    scene: DataSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where tf begins later than the detections, the first frames are left out with a note."""
    late = 10**18 + 3 * 10**8 - 1

    def change(one: bags.Sent) -> bags.Sent | None:
        return None if one.topic == "/tf" and one.received_ns <= late else one

    path = changed(scene, tmp_path / "late.mcap", change)
    (sequence,) = open_dataset("rosbag", path).sequences(["all"])
    assert len(sequence) == 17
    assert run(["track", str(path), "--profile", "scene", "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().err
    assert "3 of 20 messages on /detector/boxes left out for want of a pose: map from camera" in told


def test_without_tf_the_frame_of_the_detections_is_the_world(scene: DataSequence, tmp_path: Path) -> None:
    """A sensor that stands still needs no tf: tracks are in the frame of its detections."""
    path = changed(scene, tmp_path / "still.mcap", lambda one: None if "/tf" in one.topic or "/p" in one.topic else one)
    (sequence,) = open_dataset("rosbag", path).sequences(["all"])
    assert (len(sequence), sequence.has_clouds) == (20, False)
    assert {tuple(pose.translation) for pose in sequence.poses} == {(0.0, 0.0, 0.0)}


def of_detections(one: bags.Sent, change: Callable[[dict[str, Any]], None]) -> bags.Sent:
    """Change a copy of the second message of detections."""
    if one.topic == "/detector/boxes" and one.received_ns == 10**18 + 10**8 + bags.LATENCY_NS:
        message = json.loads(json.dumps(one.message))
        change(message)
        return one._replace(message=message)
    return one


def set_at(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(message: dict[str, Any]) -> None:
        at: Any = message
        *parts, last = path.split(".")
        for part in parts:
            at = at[int(part)] if part.isdigit() else at[part]
        at[last] = value

    return change


@pytest.mark.parametrize(
    ("place", "value", "text"),
    [
        (
            "detections.0.bbox.size.y",
            -1.0,
            r"detections\[0\].bbox.size.y: expected a positive length, or 0 where unknown",
        ),
        ("detections.0.results", [], r"detections\[0\].results: expected at least one hypothesis"),
        ("detections.0.bbox.center.orientation.w", 3.0, r"orientation: expected a unit quaternion"),
        ("detections.0.results.0.hypothesis.score", 1.5, r"score: expected a score in \[0, 1\].*received 1.5"),
        ("detections.0.bbox.center.position.x", float("nan"), r"position.x: expected a finite number"),
        ("header.frame_id", "lidar", r"frame 'lidar': expected one of the frames in tf \(camera, map, velodyne\)"),
    ],
)
def test_a_wrong_value_is_named(scene: DataSequence, place: str, value: object, text: str, tmp_path: Path) -> None:
    """A wrong value is reported with topic, time and field; a message without a pose is left out with a note."""
    path = changed(scene, tmp_path / "wrong.mcap", lambda one: of_detections(one, set_at(place, value)))
    try:
        (sequence,) = open_dataset("rosbag", path).sequences(["all"])
        frames = len(list(sequence.frames()))
        told = " ".join(sequence.notes)  # type: ignore[attr-defined]
    except DatasetError as error:
        frames, told = 0, str(error)
        assert "/detector/boxes, received at 1000000000180000000 ns" in told
    assert frames in {0, 19}
    assert re.search(text, told), told


def test_an_odd_object_is_left_out_where_asked_for(scene: DataSequence, tmp_path: Path) -> None:
    """With invalid=skip the other objects of the bag are tracked, and the odd ones are counted."""
    path = changed(
        scene, tmp_path / "odd.mcap", lambda one: of_detections(one, set_at("detections.0.bbox.size.y", -1.0))
    )
    (sequence,) = open_dataset("rosbag", path, invalid="skip").sequences(["all"])
    counts = [len(frame) for frame in sequence.frames()]
    expected = [len(frame) for frame in scene.frames()]
    missing = [one - other for one, other in zip(expected, counts, strict=True)]
    assert max(missing) == 1
    assert sequence.notes[-1].startswith(f"{sum(missing)} objects on /detector/boxes are left out, the first: ")
    with pytest.raises(DatasetError, match="invalid=skip leaves such objects out"):
        list(open_dataset("rosbag", path).sequences(["all"])[0].frames())


def test_what_fits_twice_is_to_be_chosen(scene: DataSequence, tmp_path: Path) -> None:
    """Two topics with the clouds of the same stamps are refused until one is chosen."""
    sent = [*bags.messages(scene)]
    sent += [one._replace(topic="/other/points") for one in sent if one.topic == "/points"]
    path = bags.write_mcap(tmp_path / "two.mcap", sent)
    with pytest.raises(DatasetError, match=r"--option points=TOPIC.*/other/points, /points"):
        open_dataset("rosbag", path).sequences(["all"])
    (sequence,) = open_dataset("rosbag", path, points="/points").sequences(["all"])
    assert sequence.has_clouds


def test_a_bag_without_detections_is_reported(scene: DataSequence, tmp_path: Path) -> None:
    """The error lists the topics that there are."""
    path = changed(scene, tmp_path / "none.mcap", lambda one: None if one.topic == "/detector/boxes" else one)
    with pytest.raises(DatasetError, match=r"Detection3DArray.*received /points \(sensor_msgs/msg/PointCloud2\)"):
        open_dataset("rosbag", path)


def test_classes_of_any_name_are_tracked(
    scene: DataSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a profile one is made for the bag; with one, classes are renamed to its classes."""
    numbers = {"Car": "0", "Pedestrian": "1", "Cyclist": "2"}

    def change(one: bags.Sent) -> bags.Sent:
        if one.topic != "/detector/boxes":
            return one
        text = json.dumps(one.message)
        for name, number in numbers.items():
            text = text.replace(f'"{name}"', f'"{number}"')
        return one._replace(message=json.loads(text))

    path = changed(scene, tmp_path / "numbers.mcap", change)
    found = result_of(run_here(capsys, "track", path, "--out", tmp_path / "auto.mcap", "--json"))
    assert (found["profile"], found["sequences"][0]["frames"]) == ("auto", 20)
    detected = [one for _, message in decoded(tmp_path / "auto.mcap")[DETECTIONS] for one in message.detections]
    assert {one.results[0].hypothesis.class_id for one in detected} == {"0", "1", "2"}
    options: Any = {f"class.{number}": name for name, number in numbers.items()}
    assert len(tracks_of("rosbag", path, tmp_path / "renamed", **options)) > 40

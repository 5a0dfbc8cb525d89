"""Recordings: content of the file, content after a cut, and messages played."""

import concurrent.futures
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from foxglove_client import FoxgloveClient
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from optipmb_client.zenoh import Connection
from optipmb_schemas import (
    Detections,
    FieldOfView,
    Keys,
    Message,
    Points,
    Pose,
    Problem,
    SessionParameters,
    Tracks,
    decode,
    encode,
    encode_json,
    encoding_of,
)
from optipmb_tools.datasets import DatasetError, dataset_at, open_dataset
from optipmb_tools.recordings.plan import plan, steps
from optipmb_tools.recordings.recording_file import Recorded, RecordingFile, RecordingWriter
from optipmb_tools.views.foxglove import FoxgloveServer
from tracks_message import tracks_message

KEYS = Keys()
STREAM = "garage/robot-1/lidar"
EPOCH = bytes(range(16))
SESSION = "0" * 32


def detections(seq: int, *, stamp: int | None = None, has_points: bool | None = None) -> Detections:
    return Detections(
        stream=STREAM,
        epoch=EPOCH,
        seq=seq,
        stamp_ns=100 * seq if stamp is None else stamp,
        frame="world",
        labels=["Car"],
        label=[0, 0],
        center=[[seq, 0.0, 1.0], [seq, 9.0, 1.0]],
        size=[[4.0, 2.0, 1.5]] * 2,
        yaw=[0.0, 3.0],
        score=[0.9, 0.8],
        has_points=has_points,
    )


def points(seq: int, stamp: int) -> Points:
    return Points(stream=STREAM, epoch=EPOCH, seq=seq, stamp_ns=stamp, frame="world", xyz=np.ones((3, 3), np.float32))


def tracks(seq: int, ids: list[int], *, cloud_used: bool = False, revision: int = 0) -> Tracks:
    """Tracks of these ids at frame `seq`, going along x at 2 m/s."""
    return tracks_message(
        STREAM,
        seq,
        ids,
        epoch=EPOCH,
        stamp_ns=1_500_000_000 + seq,
        session=SESSION,
        revision=revision,
        cloud_used=cloud_used,
        center=np.arange(3.0 * len(ids)).reshape(-1, 3),
        size=2.0,
        yaw=0.5,
        velocity=[2.0, 0.0],
        existence=0.5,
        age=0.5,
        detection=-1,
    )


def put(writer: RecordingWriter, message: Message, received_ns: int, *, json: bool = False) -> bytes:
    topics = {Detections: "detections", Points: "points", Tracks: "tracks", Problem: "problems"}
    topic = topics[type(message)]
    payload = encode_json(message) if json else encode(message)
    key = f"optipmb/v1/{STREAM}/{topic}"
    writer.add(key, payload, encoding_of(message, form="json" if json else "msgpack"), received_ns)
    return payload


LIMITED = """
import resource, sys
from optipmb_tools.cli import run

resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
sys.exit(run(sys.argv[1:]))
"""


def test_a_disk_that_is_full_is_one_line_with_the_file(endpoint: str, tmp_path: Path) -> None:
    """A recording that cannot be written ends by itself, with one line that names the file."""
    file = tmp_path / "full.mcap"
    command = [sys.executable, "-c", LIMITED, "record", "--out", str(file), "--connect", endpoint]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
        Connection(endpoint) as connection,
    ):
        sender = connection.cached_sender("optipmb/v1/a/b/c/detections", "application/octet-stream", cache=10)
        while process.poll() is None:
            sender.put(os.urandom(50_000))
            time.sleep(0.05)
        assert process.stderr is not None
        errors = process.stderr.read()
        assert process.returncode != 0
    assert errors == f"optipmb: {file}: File too large\n"


def test_messages_come_back_byte_for_byte(tmp_path: Path) -> None:
    """Payload, stream, topic, encoding and times of every message are kept, msgpack and JSON, valid and not."""
    with RecordingWriter(tmp_path / "a.mcap", {"made_by": "test"}) as writer:
        payloads = [
            put(writer, points(0, 700), 10),
            put(writer, detections(7), 11),
            put(writer, detections(8), 12, json=True),
            put(writer, tracks(7, [1, 2]), 13),
        ]
        writer.add(KEYS.detections(STREAM), b"\xc1 no message", "zenoh/bytes", 14)
        asked = SessionParameters(profile="kitti")
        writer.add(KEYS.query(STREAM, "parameters"), encode(asked), encoding_of(asked), 15)
    recording = RecordingFile(tmp_path / "a.mcap")
    found = list(recording)
    assert not recording.cut
    assert recording.about == {"made_by": "test"}
    assert [one.payload for one in found] == [*payloads, b"\xc1 no message", encode(asked)]
    assert {one.stream for one in found} == {STREAM}
    assert [one.topic for one in found] == ["points", "detections", "detections", "tracks", "detections", "parameters"]
    assert [one.received_ns for one in found] == [10, 11, 12, 13, 14, 15]
    assert [one.stamp_ns for one in found] == [700, 700, 800, 1_500_000_007, 14, 15]
    assert found[1].encoding == "application/msgpack;optipmb.Detections.v1"
    assert found[2].encoding == "application/json;optipmb.Detections.v1"


def test_foxglove_finds_boxes_plots_and_logs_beside_our_messages(tmp_path: Path) -> None:
    """Detections are boxes and a pose, tracks also figures, problems are logs; our reader ignores them."""
    problem = Problem(stream=STREAM, instance="one", code="pose", message="it jumped", stamp_ns=5)
    pose = Pose(translation=np.array([0.0, 0.0, 1.0]), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))
    seen = detections(0).model_copy(update={"frame": "sensor", "pose": pose})
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        put(writer, seen, 10)
        put(writer, tracks(0, [3, 4]), 11)
        put(writer, problem, 12)
    found = {}
    factory = DecoderFactory()
    with (tmp_path / "a.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            decoder = factory.decoder_for(channel.message_encoding, schema) or json.loads
            if channel.message_encoding in {"protobuf", "json"}:
                found["/".join(channel.topic.split("/")[-2:])] = decoder(message.data)
    (boxes,) = found["detections/scene"].entities
    assert [cube.pose.position.z for cube in boxes.cubes] == [2.0, 2.0]
    assert (found["detections/pose"].child_frame_id, found["detections/pose"].translation.z) == (STREAM, 1.0)
    assert found["tracks/figures"]["tracks"] == 2
    assert (found["problems/log"].message, found["problems/log"].name) == ("it jumped", "pose")
    assert [one.topic for one in RecordingFile(tmp_path / "a.mcap")] == ["detections", "tracks", "problems"]


@pytest.mark.parametrize("frame", ["world", "sensor"])
def test_points_without_boxes_are_shown_and_read_again(frame: str, tmp_path: Path) -> None:
    """Foxglove has half a metre of each, at the height of the sensor; a reader sees unknown values."""
    pose = Pose(translation=np.array([1.0, 0.0, 2.0]), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))
    center = np.array([[3.0, 4.0, np.nan], [5.0, 6.0, 0.5]])
    unknown = {"size": None, "yaw": None, "center": center, "frame": frame, "pose": pose}
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for seq in range(3):
            put(writer, detections(seq).model_copy(update=unknown), 10 + seq)
    factory, cubes = DecoderFactory(), []
    with (tmp_path / "a.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic.endswith("detections/scene"):
                decoder = factory.decoder_for(channel.message_encoding, schema)
                assert decoder is not None
                cubes += decoder(message.data).entities[0].cubes
    x, z = (1.0, 2.0) if frame == "sensor" else (0.0, 0.0)
    places = [(one.pose.position.x, one.pose.position.z, one.size.x, one.size.z) for one in cubes[:2]]
    assert places == [(3.0 + x, z, 0.5, 0.5), (5.0 + x, 0.5 + z, 0.5, 0.5)]
    (sequence,) = open_dataset(dataset_at(tmp_path), tmp_path).sequences(["all"])
    first = next(iter(sequence.frames()))
    np.testing.assert_array_equal(first.center, center)
    assert np.isnan(first.size).all()
    assert np.isnan(first.yaw).all()


def test_foxglove_is_served_live(tmp_path: Path) -> None:
    """A client of Foxglove's protocol gets the scene, the cloud, plots and logs, by the schemas that it is sent."""
    problem = Problem(stream=STREAM, instance="one", code="pose", message="it jumped", stamp_ns=5)
    ends = {"tracks/scene", "tracks/figures", "detections/scene", "points/cloud", "problems/log"}
    with FoxgloveServer("127.0.0.1", 0) as server, concurrent.futures.ThreadPoolExecutor(1) as pool:
        client = FoxgloveClient(server.address)
        result = pool.submit(client.collect, {f"/{STREAM}/{end}" for end in ends})
        while not result.done():  # a channel is there with its first message, and one may subscribe only then
            for message in (tracks(0, [3]), detections(0), points(0, 700), problem):
                server.show(message)
            concurrent.futures.wait([result], timeout=0.05)
        found = {topic.removeprefix(f"/{STREAM}/"): one for topic, one in result.result(60).items()}
        client.close()
    assert found["tracks/scene"][0] == 1_500_000_000
    assert [entity.id for entity in found["tracks/scene"][1].entities] == ["3"]
    assert found["tracks/figures"][1]["tracks"] == 1
    cloud = found["points/cloud"][1]
    assert np.frombuffer(cloud.data, "<f4").tolist() == [1.0] * 9
    assert (cloud.point_stride, [field.name for field in cloud.fields]) == (12, ["x", "y", "z"])
    assert found["problems/log"][1].message == "it jumped"


def test_foxglove_finds_boxes_arrows_and_ids(tmp_path: Path) -> None:
    """Read by the MCAP library with the schema in the file: an entity per track, and gone tracks are deleted."""
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        put(writer, tracks(0, [3, 4, 11]), 10)
        put(writer, tracks(1, [4]), 20)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        scenes = list(reader.iter_decoded_messages(topics=[f"{KEYS.tracks(STREAM)}/scene"]))
    assert [schema.name for schema, *_ in scenes] == ["foxglove.SceneUpdate"] * 2
    assert [(message.log_time, message.publish_time) for _, _, message, _ in scenes] == [
        (10, 1_500_000_000),
        (20, 1_500_000_001),
    ]
    first, second = (decoded for *_, decoded in scenes)
    assert [entity.id for entity in first.entities] == ["3", "4", "11"]
    assert [deletion.id for deletion in second.deletions] == ["3", "11"]
    assert not first.deletions
    (entity,) = second.entities
    assert entity.frame_id == "world"
    assert (entity.timestamp.seconds, entity.timestamp.nanos) == (1, 500_000_001)
    (cube,), (arrow,), (text,) = entity.cubes, entity.arrows, entity.texts
    assert (cube.pose.position.x, cube.pose.position.y, cube.pose.position.z) == (0.0, 1.0, 2.0)
    assert (cube.size.x, cube.size.y, cube.size.z) == (2.0, 2.0, 2.0)
    assert cube.pose.orientation.z == pytest.approx(np.sin(0.25))
    assert arrow.shaft_length == 2.0
    assert text.text == "4"
    colours = {(c.color.r, c.color.g, c.color.b) for one in first.entities for c in one.cubes}
    assert len(colours) == 2  # ids 4 and 11 are seven apart


def recorded_bytes(tmp_path: Path) -> tuple[bytes, list[bytes], list[int]]:
    """A recording that was flushed after each message, its payloads, and its size at each flush."""
    sizes = []
    path = tmp_path / "whole.mcap"
    with RecordingWriter(path) as writer:
        payloads = []
        for number in range(6):
            payloads.append(put(writer, detections(number), 10 + number))
            sizes.append(writer.flush())
    return path.read_bytes(), payloads, sizes


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes, list[bytes], list[int]]:
    """A folder and what `recorded_bytes` gives."""
    folder = tmp_path_factory.mktemp("cut")
    return folder, *recorded_bytes(folder)


@given(share=st.floats(0.0, 1.0))
@settings(deadline=None)
def test_a_cut_recording_gives_what_was_flushed(
    share: float, whole: tuple[Path, bytes, list[bytes], list[int]]
) -> None:
    """Cut anywhere, a file gives the messages flushed before the cut, in order, and says that it is cut."""
    folder, content, payloads, sizes = whole
    at = 8 + round(share * (sizes[-1] - 8))
    path = folder / "cut.mcap"
    path.write_bytes(content[:at])
    recording = RecordingFile(path)
    found = [one.payload for one in recording]
    assert recording.cut
    least = sum(size <= at for size in sizes)
    assert found == payloads[: len(found)]
    assert len(found) >= least


def test_what_is_no_recording_is_refused_with_its_name(tmp_path: Path) -> None:
    """Missing, empty, of another kind, damaged in the middle: one error with the path."""
    content, _, sizes = recorded_bytes(tmp_path)
    damaged = bytearray(content)
    damaged[sizes[2] + 60] ^= 0xFF
    wrong = {"missing.mcap": None, "empty.mcap": b"", "text.mcap": b"no recording", "damaged.mcap": bytes(damaged)}
    for name, text in wrong.items():
        path = tmp_path / name
        if text is not None:
            path.write_bytes(text)
        with pytest.raises(DatasetError, match=name):
            list(RecordingFile(path))


def test_a_bit_that_turned_is_found(tmp_path: Path) -> None:
    """Noise does not compress, so only the checksum tells that a value in the middle of a cloud is another one."""
    path = tmp_path / "a.mcap"
    noise = np.random.default_rng(1).normal(size=(20_000, 3)).astype(np.float32)
    with RecordingWriter(path) as writer:
        put(writer, points(0, 0).model_copy(update={"xyz": noise}), 1)
        middle = writer.flush() // 2
    content = bytearray(path.read_bytes())
    content[middle] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="damaged"):
        list(RecordingFile(path))


def test_a_recording_is_never_written_over(tmp_path: Path) -> None:
    """A second recording of the same name is refused, the first one stays."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        put(writer, detections(0), 1)
    before = path.read_bytes()
    with pytest.raises(FileExistsError):
        RecordingWriter(path)
    assert path.read_bytes() == before


def recorded(message: Message, received_ns: int) -> Recorded:
    topic = type(message).__name__.lower()
    return Recorded(
        STREAM, topic, encode(message), encoding_of(message), received_ns, getattr(message, "stamp_ns", received_ns)
    )


def played(messages: list[Recorded]) -> Iterator[tuple[int, bool, bool | None]]:
    """Played frames: number, whether a cloud precedes it, and whether the frame announces one."""
    for step in steps(messages, plan(messages)):
        frame = decode(step.detections.payload, Detections)
        yield frame.seq, step.cloud is not None, frame.has_points


def test_a_frame_is_played_with_the_cloud_that_took_part() -> None:
    """A cloud that came after its frame goes before it; one that came too late for the tracks is left out."""
    messages = [
        recorded(detections(0, has_points=True), 1),
        recorded(detections(1, has_points=True), 2),
        recorded(points(0, 0), 3),
        recorded(tracks(0, [1], cloud_used=True), 4),
        recorded(tracks(1, [1], cloud_used=False), 5),
        recorded(points(1, 100), 6),
        recorded(detections(2, has_points=True), 7),
    ]
    assert list(played(messages)) == [(0, True, True), (1, False, False), (2, False, False)]


def test_repeated_frames_are_played_once_and_bytes_are_kept() -> None:
    """Messages repeated from a cache are left out; without clouds the payloads equal the recording."""
    messages = [recorded(detections(number, has_points=False), at) for at, number in enumerate([0, 1, 1, 0, 2])]
    found = [step.detections for step in steps(messages, plan(messages))]
    assert [one.payload for one in found] == [messages[0].payload, messages[1].payload, messages[4].payload]


def test_the_newest_correction_counts() -> None:
    """Of several revisions of the tracks of a frame the highest is what a playback is compared with."""
    messages = [recorded(detections(0), 1), *(recorded(tracks(0, [n], revision=n), 2 + n) for n in (0, 2, 1))]
    (one,) = plan(messages).values()
    assert [int(n) for t in one.tracks.values() for n in t.id] == [2]


def test_a_lost_cloud_is_counted() -> None:
    """Tracks that were made with a cloud that is not in the recording cannot be made again."""
    messages = [recorded(detections(0), 1), recorded(tracks(0, [1], cloud_used=True), 2)]
    (one,) = plan(messages).values()
    assert one.clouds_lost == 1


def test_a_recording_that_begins_late_is_known() -> None:
    """Tracks that are older than the first frame, and frames without tracks between others, are found."""
    first = detections(0, stamp=1_500_000_000)
    whole = [recorded(first, 1), recorded(tracks(0, [1]).model_copy(update={"age": np.zeros(1)}), 2)]
    (one,) = plan(whole).values()
    assert (one.begins_late, one.never_tracked) == (False, 0)
    late = [recorded(first, 1), recorded(tracks(0, [1]), 2)]  # half a second old
    late += [recorded(detections(n, stamp=1_500_000_000 + n), 2 + n) for n in (1, 2, 3)]
    (one,) = plan([*late, recorded(tracks(2, [1]), 9)]).values()
    assert (one.begins_late, one.never_tracked) == (True, 1)


@pytest.mark.parametrize(("tracked", "missed"), [((), 0), ((3,), 0), ((3, 4), 0), ((2, 5), 2), ((1, 3, 6), 3)])
def test_frames_between_tracked_ones_count_as_never_tracked(tracked: tuple[int, ...], missed: int) -> None:
    """Frames before the first and after the last one with tracks do not."""
    messages = [recorded(detections(n), 1 + n) for n in range(8)]
    (one,) = plan([*messages, *(recorded(tracks(n, [1]), 10 + n) for n in tracked)]).values()
    assert one.never_tracked == missed


def test_a_recording_is_a_dataset(tmp_path: Path) -> None:
    """Frames, poses, labels and clouds equal the messages; the profile is the recorded one."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        put(writer, detections(0, has_points=True), 1)
        put(writer, points(0, 0), 2)
        put(writer, detections(1), 3)
        put(writer, tracks(0, [1], cloud_used=True), 4)
    dataset = open_dataset("mcap", path)
    assert dataset.profile == "kitti"
    for name in ("all", "garage.robot-1.lidar", STREAM):
        (sequence,) = dataset.sequences([name])
        assert sequence.name == "garage.robot-1.lidar"
    frames = list(sequence.frames())
    assert [frame.stamp_ns for frame in frames] == [0, 100]
    assert [frame.cloud is not None for frame in frames] == [True, False]
    assert frames[0].labels == ("Car",)
    assert np.array_equal(frames[1].center, detections(1).center)
    assert len(sequence.poses) == len(sequence) == 2
    assert not sequence.notes


def test_embeddings_of_a_recording_are_said_to_be_unused(tmp_path: Path) -> None:
    """Detections that have vectors of appearance are joined by motion alone, and a note says so."""
    vectors = {"embedding": np.ones((2, 2)), "embedding_model": "reid-7"}
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        put(writer, Detections(**{**dict(detections(0)), **vectors}), 1)
    (sequence,) = open_dataset("mcap", tmp_path / "a.mcap").sequences(["all"])
    assert sequence.notes == ("garage.robot-1.lidar: embeddings are not used: objects are followed by motion alone",)


def test_boxes_of_the_world_are_carried_to_a_sensor_with_a_field_of_view(tmp_path: Path) -> None:
    """All columns are in the frame of a sensor that is turned to the left by a right angle."""
    pose = Pose(translation=[10.0, 0.0, 0.0], quaternion=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    seen = FieldOfView(azimuth=[-1.0, 1.0], elevation=[-1.0, 1.0], range=[0.0, 50.0])
    common: dict[str, Any] = {"stream": STREAM, "epoch": EPOCH, "labels": ["Car"], "pose": pose, "field_of_view": seen}
    common |= {"label": [0], "size": [[4.0, 2.0, 1.5]], "score": [0.9]}
    world: dict[str, Any] = {"center": [[10.0, 5.0, 1.0]], "yaw": [np.pi / 2], "velocity": [[0.0, 3.0]]}
    sensor: dict[str, Any] = {"center": [[5.0, 0.0, 1.0]], "yaw": [0.0], "velocity": [[3.0, 0.0]]}
    variances = {"world": [1.0, 2.0, 3.0], "sensor": [2.0, 1.0, 3.0]}
    with RecordingWriter(tmp_path / "two.mcap") as writer:
        for seq, (frame, columns) in enumerate({"world": world, "sensor": sensor}.items()):
            covariance = np.diag(variances[frame])[None]
            at: dict[str, Any] = {"seq": seq, "stamp_ns": seq, "frame": frame, "position_covariance": covariance}
            put(writer, Detections(**common, **columns, **at), seq)
    one, other = open_dataset("mcap", tmp_path / "two.mcap").sequences(["all"])[0].frames()
    for name in ("center", "yaw", "velocity", "position_covariance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12, err_msg=name)
    assert one.pose == other.pose


def test_a_dataset_needs_frames_in_order(tmp_path: Path) -> None:
    """Late frames need a service that is there when they come late: said with the way that takes them."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        put(writer, detections(1), 1)
        put(writer, detections(0), 2)
    with pytest.raises(DatasetError, match="optipmb play"):
        open_dataset("mcap", path).sequences(["all"])


def test_a_folder_of_recordings_is_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Streams of one name in several files are distinguished by file name, also in worker processes."""
    for number, name in enumerate(("monday", "monday.late")):
        with RecordingWriter(tmp_path / f"{name}.mcap") as writer:
            for frame in range(1 + number):
                put(writer, detections(frame), frame)
            put(writer, tracks(0, [1]), 9)
    names = ["monday.garage.robot-1.lidar", "monday.late.garage.robot-1.lidar"]
    dataset = open_dataset(dataset_at(tmp_path), tmp_path)
    assert [(one.name, len(one)) for one in dataset.sequences(["all"])] == [(names[0], 1), (names[1], 2)]
    for at, name in enumerate(names):
        (sequence,) = dataset.sequences([name])
        assert (sequence.name, len(sequence)) == (name, 1 + at)
    for jobs in ("1", "2"):
        assert run_here(capsys, "track", tmp_path, "--jobs", jobs, "--out", tmp_path / jobs).returncode == 0
    for name in names:
        assert (tmp_path / "1" / f"{name}.txt").read_bytes() == (tmp_path / "2" / f"{name}.txt").read_bytes()
    with pytest.raises(DatasetError, match=r"streams of the recording: monday\.garage"):
        dataset.sequences(["tuesday"])

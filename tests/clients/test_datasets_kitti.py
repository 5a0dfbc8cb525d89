"""The reader of the KITTI tracking benchmark, on small written roots and on the real data."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from boxes import points_in_box
from commands import run_here
from hypothesis import given
from hypothesis import strategies as st
from optipmb_tools.camera import sensor_from_kitti
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets.kitti import (
    EARTH_RADIUS_M,
    SPLITS,
    KittiDataset,
    KittiSequence,
    read_calibration,
    read_detections,
    read_oxts,
)
from optipmb_tools.geometry import rotation_of, stack_poses
from real_data import kitti_root
from scipy.spatial.transform import Rotation

ROW = "0,2,10,20,30,40,{score},1.5,1.6,4.0,1.0,1.7,20.0,-1.5,-1.6"
POSE = "1 0 0 0 0 1 0 0 0 0 1 {z}"
CALIBRATION = """P2: 700 0 600 45 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""


def write_root(base: Path, *, name: str = "0000", scores: tuple[str, ...] = ("2.0",), frames: int = 3) -> None:
    rows = "".join(ROW.format(score=score) + "\n" for score in scores)
    for place, text in {
        f"training/calib/{name}.txt": CALIBRATION,
        f"training/poses/{name}.txt": "".join(POSE.format(z=2 * i) + "\n" for i in range(frames)),
        f"detections/rcnn/Car/{name}.txt": rows,
    }.items():
        (base / place).parent.mkdir(parents=True, exist_ok=True)
        (base / place).write_text(text)


def read_all(root: Path) -> None:
    sequence = only_sequence(root)
    list(sequence.frames())
    _ = sequence.camera


def only_sequence(root: Path) -> KittiSequence:
    return KittiDataset(root).sequences(["all"])[0]


@pytest.mark.parametrize("below", ["", "training"])
def test_the_root_may_be_the_training_folder_itself(tmp_path: Path, below: str) -> None:
    """Both roots give the same frames; detections are found inside the root and next to it."""
    write_root(tmp_path)
    sequence = KittiDataset(tmp_path / below).sequences(["0000"])[0]
    frames = list(sequence.frames())
    assert [(frame.index, frame.stamp_ns, len(frame)) for frame in frames] == [
        (0, 0, 1),
        (1, 100_000_000, 0),
        (2, 200_000_000, 0),
    ]
    assert sequence.labels == frames[0].labels == ("Car",)
    np.testing.assert_allclose(frames[0].center, [[20.0, -1.0, -1.7 + 0.75]])
    np.testing.assert_allclose(frames[0].size, [[4.0, 1.6, 1.5]])
    np.testing.assert_allclose(frames[2].pose.translation, [4.0, 0.0, 0.0])
    assert sequence.truth() is None
    assert not sequence.has_clouds


def test_the_detector_may_be_a_name_or_a_folder(tmp_path: Path) -> None:
    """With two detectors one must be named before frames are read; its folder does as well; an unknown is an error."""
    write_root(tmp_path / "data")
    (tmp_path / "data/detections/rcnn").rename(tmp_path / "elsewhere")
    assert len(KittiDataset(tmp_path / "data", tmp_path / "elsewhere").sequences(["all"])) == 1
    write_root(tmp_path / "data")
    (tmp_path / "elsewhere").rename(tmp_path / "data/detections/other")
    assert len(KittiDataset(tmp_path / "data", "other").sequences(["all"])) == 1
    (sequence,) = KittiDataset(tmp_path / "data").sequences(["all"])
    assert sequence.labels == ("Car", "Cyclist", "Pedestrian")
    assert len(sequence.poses) == 3
    with pytest.raises(DatasetError, match="several: other, rcnn"):
        next(sequence.frames())
    with pytest.raises(DatasetError, match="detections/third"):
        KittiDataset(tmp_path / "data", "third")


def test_scores_beyond_0_and_1_are_logits(tmp_path: Path) -> None:
    """One score outside (0, 1] makes all scores of the detector logits."""
    write_root(tmp_path, scores=("0.5", "-3.0", "800", "-800"))
    score = next(only_sequence(tmp_path).frames()).score
    np.testing.assert_allclose(score[:2], 1.0 / (1.0 + np.exp([-0.5, 3.0])))
    assert score[2] == 1.0
    assert 0.0 < score[3] < 1e-9


def test_scores_within_0_and_1_are_probabilities(tmp_path: Path) -> None:
    """They are taken as they are."""
    write_root(tmp_path, scores=("0.5", "1.0"))
    np.testing.assert_array_equal(next(only_sequence(tmp_path).frames()).score, [0.5, 1.0])


def test_a_missing_sequence_is_named_once_with_those_that_are_there(tmp_path: Path) -> None:
    """The split val of a root without it gives one line with the missing names."""
    write_root(tmp_path)
    with pytest.raises(DatasetError) as caught:
        KittiDataset(tmp_path).sequences(["val"])
    assert "none for 0001 0006" in caught.value.received
    assert caught.value.received.endswith("there are 0000")
    assert len(str(caught.value).splitlines()) == 1


def test_names_are_taken_once_and_in_order(tmp_path: Path) -> None:
    """A sequence named twice, or in a split too, comes once."""
    for name in SPLITS["train"]:
        write_root(tmp_path, name=name)
    dataset = KittiDataset(tmp_path)
    assert [s.name for s in dataset.sequences(["0004", "train", "0004"])] == [
        "0004",
        *(name for name in SPLITS["train"] if name != "0004"),
    ]


@pytest.mark.parametrize(
    ("file", "text", "line", "received"),
    [
        ("training/poses/0000.txt", "1 0 0 0 0 1 0 0 0 0 1\n", 1, "11 fields"),
        ("training/poses/0000.txt", POSE.format(z=0) + "\n" + "1 0 0 0 0 2 0 0 0 0 1 0\n", 2, "another matrix"),
        ("detections/rcnn/Car/0000.txt", ROW.format(score="2")[:-5] + "\n", 1, "14 fields"),
        ("detections/rcnn/Car/0000.txt", ROW.format(score="2") + "\n9" + ROW.format(score="2")[1:] + "\n", 2, "9"),
        ("detections/rcnn/Car/0000.txt", ROW.format(score="2").replace("0,2,", "0,1,") + "\n", 1, "type 1"),
        ("detections/rcnn/Car/0000.txt", ROW.format(score="2").replace(",1.6,", ",0,") + "\n", 1, "[1.5, 0.0, 4.0]"),
        ("detections/rcnn/Car/0000.txt", ROW.format(score="nan") + "\n", 1, "'nan'"),
        ("training/calib/0000.txt", CALIBRATION.replace("P2: 700", "P2:"), 1, "11 fields"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_its_line(
    tmp_path: Path, file: str, text: str, line: int, received: str
) -> None:
    """For every kind of file, the error names it, the line and the wrong text."""
    write_root(tmp_path)
    (tmp_path / file).write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_all(tmp_path)
    assert caught.value.path == str(tmp_path / file)
    assert (caught.value.line, caught.value.received) == (line, received)


def test_a_root_that_is_none_and_poses_that_are_missing_are_reported(tmp_path: Path) -> None:
    """An unknown folder, a folder without calibration, and a sequence with neither poses nor oxts."""
    with pytest.raises(DatasetError, match="no such folder"):
        KittiDataset(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="KITTI tracking root"):
        KittiDataset(tmp_path)
    write_root(tmp_path)
    (tmp_path / "training/poses/0000.txt").unlink()
    with pytest.raises(
        DatasetError,
        match=r"poses/0000.txt: expected a pose file, or .*oxts/0000.txt, or --option poses=none .*, received neither",
    ):
        len(only_sequence(tmp_path))


def test_without_poses_the_sensor_can_be_taken_to_stand_still(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`poses=none` tracks up to the last frame of the detections, in the frame of the sensor, and a line says so."""
    write_root(tmp_path)
    (tmp_path / "training/poses/0000.txt").unlink()
    rows = [f"{k}" + ROW.format(score="0.9")[1:] for k in (0, 1, 2, 4)]
    (tmp_path / "detections/rcnn/Car/0000.txt").write_text("\n".join(rows))
    options = ["track", tmp_path, "--out", tmp_path / "out"]
    refused = run_here(capsys, *options)
    assert (refused.returncode, "--option poses=none" in refused.stderr) == (2, True)
    done = run_here(capsys, *options, "--option", "poses=none")
    assert done.returncode == 0, done.stderr
    assert "the sensor is taken to stand still, and tracks are in its frame" in done.stderr
    assert "0000: 5 frames" in done.stdout
    assert (tmp_path / "out/0000.txt").read_text().splitlines()[-1].split()[13:16] == [
        "1.000000",
        "1.700000",
        "20.000000",
    ]
    with pytest.raises(DatasetError, match="option poses: expected none"):
        open_dataset("kitti", tmp_path, poses="gps")


def test_the_testing_half_is_read_on_its_own_and_when_asked(tmp_path: Path) -> None:
    """`testing/` is read without `training/`; with both, `split=testing` reads only its own detections."""
    write_root(tmp_path, frames=3)
    (tmp_path / "training").rename(tmp_path / "testing")
    assert len(only_sequence(tmp_path)) == 3
    write_root(tmp_path, frames=2)
    assert len(only_sequence(tmp_path)) == 2
    (asked,) = open_dataset("kitti", tmp_path, split="testing").sequences(["all"])
    assert len(asked.poses) == 3
    with pytest.raises(DatasetError, match="the name of a detector, or just one"):
        next(asked.frames())
    write_root(tmp_path / "testing", scores=("0.5", "0.25"), frames=3)
    (asked,) = open_dataset("kitti", tmp_path, split="testing").sequences(["all"])
    assert next(asked.frames()).score.tolist() == [0.5, 0.25]
    assert asked.truth() is None
    with pytest.raises(DatasetError, match="with other/calib"):
        open_dataset("kitti", tmp_path, split="other")


def test_class_folders_are_matched_without_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Detections in `CAR/` are of the benchmark's `Car`; two folders of one class are refused."""
    write_root(tmp_path)
    (tmp_path / "detections/rcnn/Car").rename(tmp_path / "detections/rcnn/CAR")
    done = run_here(capsys, "track", tmp_path, "--out", tmp_path / "out", "--classes", "vehicle")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/0000.txt").read_text().split()[2] == "Car"
    write_root(tmp_path)
    with pytest.raises(DatasetError, match="several that differ in case"):
        only_sequence(tmp_path)


def test_unknown_datasets_and_options_are_reported() -> None:
    """The error lists the known names."""
    with pytest.raises(DatasetError, match="kitti or nuscenes or scene"):
        open_dataset("waymo")
    with pytest.raises(DatasetError, match="option colour: expected one of clouds"):
        open_dataset("kitti", "/", colour=1)
    with pytest.raises(DatasetError, match="--root"):
        open_dataset("kitti")


def test_both_spellings_of_calibration_files_are_read(tmp_path: Path) -> None:
    """R_rect, Tr_velo_cam and Tr_imu_velo without colons mean the same as the names with them."""
    (tmp_path / "a.txt").write_text(CALIBRATION)
    other = CALIBRATION.replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
    (tmp_path / "b.txt").write_text(other.replace("Tr_imu_to_velo:", "Tr_imu_velo").replace("P2:", "P2"))
    first, second = read_calibration(tmp_path / "a.txt"), read_calibration(tmp_path / "b.txt")
    np.testing.assert_array_equal(first.projection, second.projection)
    np.testing.assert_array_equal(first.rectified_from_velodyne, second.rectified_from_velodyne)
    assert first.velodyne_from_imu is not None
    np.testing.assert_array_equal(first.velodyne_from_imu, second.velodyne_from_imu)
    (tmp_path / "c.txt").write_text("P2: 700 0 600 45 0 700 180 0 0 0 1 0\n")
    with pytest.raises(DatasetError, match="a line R0_rect"):
        read_calibration(tmp_path / "c.txt")


def oxts_packet(latitude: float, longitude: float, altitude: float, yaw: float, *tilt: float) -> str:
    fields = [latitude, longitude, altitude, *(tilt or (0.0, 0.0)), yaw, *[0.0] * 24]
    return " ".join(f"{value:.12f}" for value in fields)


def test_oxts_packets_give_the_way_driven(tmp_path: Path) -> None:
    """Ten metres east, then a quarter turn to the left in place, in the axes of the first camera frame.

    The IMU sits 0.3 m left of and 1.08 m behind the camera of the written calibration, so while it turns in place the
    camera swings around it.
    """
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    latitude = 49.0
    east = np.degrees(10.0 / (EARTH_RADIUS_M * np.cos(np.radians(latitude))))
    packets = [
        oxts_packet(latitude, 8.0, 100.0, 0.0),
        oxts_packet(latitude, 8.0 + east, 100.0, 0.0),
        oxts_packet(latitude, 8.0 + east, 100.0, 0.5 * np.pi),
    ]
    (tmp_path / "oxts.txt").write_text("\n".join(packets) + "\n")
    calibration = read_calibration(tmp_path / "calib.txt")
    poses = read_oxts(tmp_path / "oxts.txt", calibration)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(poses[1][:3, 3], [0.0, 0.0, 10.0], atol=1e-6)
    assert calibration.velodyne_from_imu is not None
    camera_from_imu = calibration.rectified_from_velodyne @ calibration.velodyne_from_imu
    imu = np.linalg.inv(camera_from_imu)[:3, 3]  # the camera's place in the frame of the IMU: x forward, y left
    swung = np.array([-imu[1], imu[0]]) - imu[:2]
    np.testing.assert_allclose(poses[2][:3, 3], [-swung[1], 0.0, 10.0 + swung[0]], atol=1e-6)
    np.testing.assert_allclose(poses[2][:3, 2], [-1.0, 0.0, 0.0], atol=1e-9)  # it looks to the left now


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_roll_and_pitch_of_oxts_turn_about_the_axes_of_the_vehicle(angles: tuple[float, float, float]) -> None:
    """A pose is turned by yaw about z, then by pitch about the new y, then by roll about the new x."""
    yaw, pitch, roll = angles
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "calib.txt").write_text(CALIBRATION)
        packets = [oxts_packet(49.0, 8.0, 100.0, 0.0), oxts_packet(49.0, 8.0, 100.0, yaw, roll, pitch)]
        (folder / "oxts.txt").write_text("\n".join(packets) + "\n")
        calibration = read_calibration(folder / "calib.txt")
        turned = read_oxts(folder / "oxts.txt", calibration)[1][:3, :3]
    assert calibration.velodyne_from_imu is not None
    camera_from_imu = (calibration.rectified_from_velodyne @ calibration.velodyne_from_imu)[:3, :3]
    expected = camera_from_imu @ Rotation.from_euler("ZYX", angles).as_matrix() @ np.linalg.inv(camera_from_imu)
    np.testing.assert_allclose(turned, expected, atol=1e-9)


def test_a_sequence_with_oxts_needs_no_pose_file(tmp_path: Path) -> None:
    """The frames are counted by its packets."""
    write_root(tmp_path)
    (tmp_path / "training/poses/0000.txt").unlink()
    (tmp_path / "training/oxts").mkdir()
    (tmp_path / "training/oxts/0000.txt").write_text(f"{oxts_packet(49, 8, 100, 0)}\n" * 5)
    sequence = only_sequence(tmp_path)
    assert len(list(sequence.frames())) == len(sequence) == 5


def test_clouds_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    """A broken scan fails only a reader of clouds; option clouds=0 leaves all clouds out."""
    write_root(tmp_path)
    folder = tmp_path / "training/velodyne/0000"
    folder.mkdir(parents=True)
    (folder / "000001.bin").write_bytes(b"\0" * 8)
    frames = list(only_sequence(tmp_path).frames())
    assert [frame.cloud is not None for frame in frames] == [False, True, False]
    cloud = frames[1].cloud
    assert cloud is not None
    with pytest.raises(DatasetError, match=r"000001.bin: expected 16 bytes per point, received 8 bytes"):
        _ = cloud.xyz
    # The written calibration has the velodyne 27 cm behind and 8 cm above the camera, looking the same way.
    np.testing.assert_allclose(
        cloud.pose.translation, frames[1].pose.translation + np.array([-0.27, 0.0, 0.08]), atol=1e-12
    )
    np.testing.assert_allclose(rotation_of(cloud.pose.quaternion), np.eye(3), atol=1e-12)
    without = open_dataset("kitti", tmp_path, clouds=0).sequences(["all"])[0]
    assert not without.has_clouds


@pytest.fixture(scope="module")
def real() -> KittiDataset:
    return KittiDataset(kitti_root(), "pointrcnn")


COUNTS = {
    "0000": (154, 1838),
    "0002": (233, 2146),
    "0003": (144, 1069),
    "0004": (314, 3122),
    "0005": (297, 2099),
    "0007": (800, 5754),
    "0009": (803, 5951),
    "0011": (373, 4879),
    "0017": (145, 1215),
    "0020": (837, 9064),
}


def test_real_sequences_have_the_known_numbers_of_frames_and_detections(real: KittiDataset) -> None:
    """Frames and PointRCNN detections of the three classes, as counted in the files."""
    found = {}
    for sequence in real.sequences(list(COUNTS)):
        frames = list(sequence.frames())
        found[sequence.name] = (len(frames), sum(len(frame) for frame in frames))
        assert all(((frame.score > 0) & (frame.score <= 1)).all() for frame in frames)
    assert found == COUNTS


def test_projected_real_detections_are_where_the_detector_saw_them(real: KittiDataset) -> None:
    """The image boxes of the 3D boxes overlap the detector's own image boxes by more than 0.7 in 99 of 100 cases."""
    (sequence,) = real.sequences(["0011"])
    path = kitti_root() / "detections/pointrcnn/Car/0011.txt"
    file = read_detections(path, len(sequence), 2)
    boxes, seen = sequence.camera.boxes(*sensor_from_kitti(file["bottom"], file["hwl"], file["ry"]))
    low, high = np.maximum(boxes[:, :2], file["box2d"][:, :2]), np.minimum(boxes[:, 2:], file["box2d"][:, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=1)
    areas = [np.prod(b[:, 2:] - b[:, :2], axis=1) for b in (boxes, file["box2d"])]
    overlap = common / (areas[0] + areas[1] - common)
    assert seen.mean() > 0.99
    assert (overlap > 0.7).mean() > 0.99


@pytest.mark.parametrize("name", ["0009", "0011"])
def test_real_parked_cars_stay_where_they_are(real: KittiDataset, name: str) -> None:
    """Of the cars that the sensor drives past, most keep their place in the world to half a metre, the others drive.

    Nothing lies between: with a wrong pose convention parked cars would seem to wander by metres.
    """
    (sequence,) = real.sequences([name])
    truth = sequence.truth()
    assert truth is not None
    _, sensor = stack_poses(sequence.poses)
    spread = []
    for identity in np.unique(truth.id[truth.names == "Car"]):
        rows = (truth.id == identity) & (truth.frame >= 0)
        driven = np.linalg.norm(np.ptp(sensor[truth.frame[rows]], axis=0))
        near = rows & (np.linalg.norm(truth.center - sensor[truth.frame], axis=1) < 40.0)
        if driven > 10.0 and near.sum() > 10:
            place = truth.center[near, :2]
            spread.append(np.quantile(np.linalg.norm(place - np.median(place, axis=0), axis=1), 0.95))
    assert len(spread) >= 40
    parked = np.array(spread) < 0.5
    assert parked.mean() >= 0.8
    assert (np.array(spread)[~parked] > 5.0).all()


def test_real_scans_have_their_points_in_the_real_boxes(real: KittiDataset) -> None:
    """Carried to the world by the cloud's pose, the scan puts points into nearly every near and visible truth box."""
    filled = []
    for sequence in real.sequences(["0000", "0002", "0004", "0005", "0009", "0011"]):
        truth = sequence.truth()
        assert truth is not None
        for frame in sequence.frames():
            if frame.cloud is None:
                continue
            rotation = rotation_of(frame.cloud.pose.quaternion)
            points = frame.cloud.xyz.astype(np.float64) @ rotation.T + frame.cloud.pose.translation
            local = truth.to_sensor(sequence.poses)
            for row in np.flatnonzero((truth.frame == frame.index) & ~truth.ignored & (truth.occlusion == 0)):
                if 5.0 < local.center[row, 0] < 30.0:
                    inside = points_in_box(points, truth.center[row], truth.size[row], float(truth.yaw[row]))
                    filled.append(int(inside.sum()))
    assert len(filled) > 20
    assert np.mean(np.array(filled) > 20) > 0.9


def test_real_truth_has_types_and_regions(real: KittiDataset) -> None:
    """Vans differ from cars, DontCare is a region, and truncated or occluded objects are ignored."""
    (sequence,) = real.sequences(["0000"])
    truth = sequence.truth()
    assert truth is not None
    assert truth.labels == ("Car", "Cyclist", "Pedestrian", "Van")
    assert len(truth) + len(truth.regions.frame) == 1089
    assert truth.ignored.sum() == ((truth.occlusion > 2) | (truth.truncation > 0)).sum() > 0
    assert (truth.id >= 0).all()


def test_headings_across_the_motion_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`track` says so where the boxes of a detector do not move along their headings, and only there."""
    for name, rotation in (("along", -1.57), ("across", 0.0)):
        root = tmp_path / name
        write_root(root, frames=40)
        row = "{frame},2,10,20,30,40,0.9,1.5,1.6,4.0,1.0,1.7,{z},{rotation},-1.6"
        boxes = (row.format(frame=i, z=20.0 - i, rotation=rotation) for i in range(40))  # 1 m/frame ahead in the world
        (root / "detections/rcnn/Car/0000.txt").write_text("\n".join(boxes) + "\n")
        done = run_here(capsys, "track", "--dataset", "kitti", "--root", root, "--out", tmp_path / "out")
        assert done.returncode == 0, done.stderr
        assert ("headings and motion disagree" in done.stderr) == (name == "across"), done.stderr


def test_a_sequence_without_calibration_is_named(tmp_path: Path) -> None:
    """Detections of a sequence that has no calib file are left out with a note."""
    for name in ("0000", "0001"):
        write_root(tmp_path, name=name)
    (tmp_path / "training/calib/0001.txt").unlink()
    dataset = KittiDataset(tmp_path)
    assert [one.name for one in dataset.sequences(["all"])] == ["0000"]
    assert "1 of 2 sequences with detections are left out, without a calib/SSSS.txt: 0001" in dataset.notes[0]


def test_files_without_any_detection_end_with_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Sequences without detections are named; where there are no others, the status is 1."""
    for name in ("0000", "0001"):
        write_root(tmp_path, name=name, scores=())
    done = run_here(capsys, "track", "--dataset", "kitti", "--root", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "no detections in 2 of 2 recordings, 6 frames: 0000 0001" in done.stderr


@pytest.mark.parametrize(
    "change", [str, lambda text: "\ufeff" + text.replace("\n", "\r\n"), lambda text: text.replace(",", "\t")]
)
def test_detections_are_read_as_other_systems_write_them(change: Callable[[str], str], tmp_path: Path) -> None:
    """A byte order mark, line ends of Windows, and blanks or tabs between the fields change no box."""
    write_root(tmp_path, scores=("2.0", "1.0"))
    path = tmp_path / "detections/rcnn/Car/0000.txt"
    path.write_bytes(change(path.read_text()).encode())
    (frame, *_) = only_sequence(tmp_path).frames()
    assert len(frame) == 2


@pytest.mark.parametrize(
    ("name", "profile"),
    [
        ("pointrcnn", "kitti"),
        ("SECOND_iou", "kitti-second-iou"),
        ("VirConv-S", "kitti-virconv"),
        ("second_try", "auto"),
        ("my_CasA", "kitti"),
        ("casablanca", "auto"),
    ],
)
def test_the_profile_is_that_of_the_detector_that_is_named(tmp_path: Path, name: str, profile: str) -> None:
    """The name of its folder counts; of unknown detectors it is auto, and a note says so."""
    write_root(tmp_path)
    (tmp_path / "detections/rcnn").rename(tmp_path / "detections" / name)
    dataset = KittiDataset(tmp_path)
    assert dataset.profile == profile
    assert any("profile is auto" in note for note in dataset.notes) == (profile == "auto")

"""Reading nuScenes: tables, detections, scans and truth, from a small made-up root and from a recorded scene."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from nuscenes_tables import (
    STEP_US,
    TILTED,
    VERSION,
    Scene,
    Thing,
    box,
    crowd,
    rotation,
    write_detections,
    write_root,
    write_scan,
)
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets import nuscenes as tables_module
from optipmb_tools.datasets.nuscenes import (
    SPLITS,
    NuScenesDataset,
    NuScenesSequence,
    box_velocity,
    read_sweep,
    read_table,
    scenes_of_split,
)
from optipmb_tools.geometry import rotation_of
from real_data import nuscenes_root

SCENE = "scene-0103"
PATIENT = settings(deadline=None)  # other work on the machine may make any example slow


def one_scene(frames: int = 3, things: list[Thing] | None = None, name: str = SCENE) -> Scene:
    return Scene(name, [(100.0, 200.0)] * frames, things or [])


def opened(root: Path, scene: Scene, boxes: dict[str, list[dict[str, Any]]] | None = None) -> NuScenesSequence:
    write_root(root, [scene])
    write_detections(root, "made", [scene], boxes)
    (sequence,) = NuScenesDataset(root).sequences(["all"])
    return sequence


def test_frames_are_samples_in_order_of_time(tmp_path: Path) -> None:
    """Frames come in order of time, for any order of the table, at the stamp of the sample in nanoseconds."""
    scene = one_scene(4)
    sequence = opened(tmp_path, scene)
    frames = list(sequence.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.stamp_ns for frame in frames] == [(scene.start_us + i * STEP_US) * 1000 for i in range(4)]
    assert sequence.samples == tuple(scene.token(i) for i in range(4))
    assert len(sequence) == 4


def test_detections_are_in_the_world_frame(tmp_path: Path) -> None:
    """Boxes keep their global place and velocity under the identity pose; size becomes length, width, height."""
    token = one_scene().token(1)
    found = [box(token), box(token, rotation=[0.0, 0.0, 0.0, 1.0], detection_name="truck", detection_score=1.0)]
    frame = list(opened(tmp_path, one_scene(), {token: found}).frames())[1]
    assert np.array_equal(rotation_of(frame.pose.quaternion), np.eye(3))
    assert not frame.pose.translation.any()
    assert [frame.labels[label] for label in frame.label] == ["car", "truck"]
    assert frame.center.tolist() == [[10.0, 20.0, 1.0]] * 2
    assert frame.size.tolist() == [[4.0, 2.0, 1.5]] * 2
    assert frame.yaw == pytest.approx([0.5, math.pi])
    assert frame.score.tolist() == [0.5, 1.0]
    assert frame.velocity is not None
    assert frame.velocity.tolist() == [[1.0, 2.0]] * 2


@pytest.mark.parametrize("unknown", [None, [None, None], [math.nan, math.nan], [1.0, None], [1.0, math.nan]])
def test_velocity_may_be_unknown(tmp_path: Path, unknown: Any) -> None:
    """Null, lists of null and NaN all mean unknown: for one box a row of NaN, for all of a frame no velocity."""
    scene = one_scene(2)
    some = [box(scene.token(0), velocity=unknown), box(scene.token(0))]
    boxes = {scene.token(0): some, scene.token(1): [box(scene.token(1), velocity=unknown)]}
    first, second = opened(tmp_path, scene, boxes).frames()
    assert first.velocity is not None
    assert np.isnan(first.velocity[0]).all()
    assert first.velocity[1].tolist() == [1.0, 2.0]
    assert second.velocity is None


def test_class_names_of_others_are_matched_and_what_is_dropped_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`Car` and `vehicle.car` are cars; a line names each class that is left out with its count."""
    scene = one_scene(2)
    names = [
        "Car",
        "vehicle.car",
        "CAR",
        "pedestrian",
        "barrier",
        "barrier",
        "traffic_cone",
        "construction_vehicle",
        "sign",
    ]
    boxes = {scene.token(i): [box(scene.token(i), detection_name=name) for name in names] for i in range(2)}
    frame = next(opened(tmp_path, scene, boxes).frames())
    assert [frame.labels[label] for label in frame.label] == ["car", "car", "car", "pedestrian"]
    done = run_here(capsys, "track", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for name in ("Car", "vehicle.car", "CAR"):
        assert f"2 boxes of class {name}: read as car" in done.stderr
    for name, count in {"barrier": 4, "traffic_cone": 2, "construction_vehicle": 2, "sign": 2}.items():
        assert f"{count} boxes of class {name}: left out" in done.stderr


def test_boxes_beyond_500_in_a_sample_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`track` says how many boxes of how many samples the file has no room for, and what a submission holds."""
    scene = one_scene(3)
    write_root(tmp_path, [scene])
    places = [[10.0 * (i % 30), 10.0 * (i // 30), 1.0] for i in range(620)]
    boxes = {scene.token(i): [box(scene.token(i), translation=p, detection_score=0.9) for p in places] for i in (0, 1)}
    write_detections(tmp_path, "made", [scene], boxes)
    done = run_here(capsys, "track", tmp_path, "--out", tmp_path / "out", "--submission", "--json")
    counts = [len(one) for one in json.loads((tmp_path / "out/tracking_results.json").read_text())["results"].values()]
    assert max(counts) == 500
    beyond, samples = json.loads(done.stdout)["sequences"][0]["cut"]
    assert beyond > samples > 1
    assert f"{beyond} boxes in {samples} samples are not written: a sample of nuScenes has 500 at most" in done.stderr
    assert "all tracks are written, whatever their score" in done.stderr
    table = run_here(capsys, "track", tmp_path, "--out", tmp_path / "tracks.csv")
    assert "are not written" not in table.stderr


def test_height_of_the_bottom_is_raised_when_the_caller_or_the_file_says_so(tmp_path: Path) -> None:
    """Heights are centres by default; `z_bottom`, or the file's own word, adds half a height; options win."""
    scene = one_scene(1)
    write_root(tmp_path, [scene])
    path = write_detections(tmp_path, "plain", [scene], {scene.token(0): [box(scene.token(0))]})
    content = json.loads(path.read_text())
    content["meta"]["z_origin"] = "bottom"
    path.with_stem("low").write_text(json.dumps(content))

    def height(detections: str, **options: bool) -> float:
        (sequence,) = open_dataset("nuscenes", tmp_path, detections, **options).sequences([SCENE])
        return float(next(iter(sequence.frames())).center[0, 2])

    assert height("plain") == 1.0
    assert height("plain", z_bottom=True) == 1.75
    assert height("low") == 1.75
    assert height("low", z_bottom=False) == 1.0


def test_clouds_are_those_of_keyframes_that_are_present(tmp_path: Path) -> None:
    """A frame has a cloud when its scan is there; the pose carries its points to their places in the world."""
    scene = one_scene(3)
    sequence = opened(tmp_path, scene)
    assert not sequence.has_clouds
    points = np.array([[1, 2, 3, 50, 7], [4, 5, 6, 60, 8]], dtype=np.float32)
    write_scan(tmp_path, f"samples/LIDAR_TOP/LIDAR_TOP-{SCENE}-1.pcd.bin", points)
    write_scan(tmp_path, f"sweeps/LIDAR_TOP/LIDAR_TOP-{SCENE}-2-sweep.pcd.bin", points)
    (sequence,) = NuScenesDataset(tmp_path).sequences([SCENE])
    clouds = [frame.cloud for frame in sequence.frames()]
    assert sequence.has_clouds
    assert [cloud is not None for cloud in clouds] == [False, True, False]
    assert clouds[1] is not None
    assert clouds[1].xyz.dtype == np.float32
    assert clouds[1].xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    ego = rotation_of(np.array(rotation(0.3)))
    in_car = rotation_of(np.array(TILTED)) @ [1, 2, 3] + [0.9, 0.0, 1.8]
    world = rotation_of(clouds[1].pose.quaternion) @ [1, 2, 3] + clouds[1].pose.translation
    assert world == pytest.approx(ego @ in_car + [100.0, 200.0, 0.0])
    assert sequence.poses[1].translation == pytest.approx(clouds[1].pose.translation)
    assert sequence.ego_poses[1].translation == pytest.approx([100.0, 200.0, 0.0])
    (without,) = open_dataset("nuscenes", tmp_path, clouds=False).sequences([SCENE])
    assert not without.has_clouds


def test_truth_has_the_annotations_of_the_seven_classes(tmp_path: Path) -> None:
    """Categories become classes, objects keep one id, visibility becomes a level, boxes are in the world frame."""
    things = [
        Thing("a", "vehicle.car", 0, (110.0, 200.0, 1.0), yaw=1.0, lidar=7, visibility="4"),
        Thing("b", "human.pedestrian.child", 0, (120.0, 200.0, 1.0), visibility="1"),
        Thing("c", "vehicle.construction", 0, (110.0, 210.0, 1.0)),
        Thing("a", "vehicle.car", 1, (111.0, 200.5, 1.0), yaw=1.0, visibility="2"),
        Thing("d", "vehicle.bus.bendy", 1, (110.0, 190.0, 1.0), visibility=""),
    ]
    truth = opened(tmp_path, one_scene(2, things)).truth()
    assert truth is not None
    assert truth.names.tolist() == ["car", "pedestrian", "car", "bus"]
    assert truth.frame.tolist() == [0, 0, 1, 1]
    assert truth.id[0] == truth.id[2]
    assert len(set(truth.id.tolist())) == 3
    assert truth.center[0].tolist() == [110.0, 200.0, 1.0]
    assert truth.size[0].tolist() == [4.0, 2.0, 1.5]
    assert truth.yaw[0] == pytest.approx(1.0)
    assert truth.velocity[0] == pytest.approx([2.0, 1.0])
    assert np.isnan(truth.velocity[1]).all()
    assert truth.points.tolist() == [7, 10, 10, 10]
    assert truth.occlusion.tolist() == [0, 2, 1, 3]
    assert not truth.ignored.any()


@pytest.mark.parametrize(
    ("thing", "ignored"),
    [
        (Thing("a", "vehicle.car", 0, (149.0, 200.0, 1.0)), False),
        (Thing("a", "vehicle.car", 0, (150.0, 200.0, 1.0)), True),
        (Thing("a", "human.pedestrian.adult", 0, (100.0, 239.0, 1.0)), False),
        (Thing("a", "human.pedestrian.adult", 0, (100.0, 240.0, 1.0)), True),
        (Thing("a", "vehicle.car", 0, (110.0, 200.0, 1.0), lidar=0), True),
        (Thing("a", "vehicle.car", 0, (110.0, 200.0, 1.0), lidar=0, radar=1), False),
    ],
)
def test_truth_that_does_not_count_is_ignored(tmp_path: Path, thing: Thing, *, ignored: bool) -> None:
    """Objects out of the range of their class, and those without any LiDAR or radar point, are ignored."""
    truth = opened(tmp_path, one_scene(1, [thing])).truth()
    assert truth is not None
    assert truth.ignored.tolist() == [ignored]


def test_scenes_keep_their_own_annotations(tmp_path: Path) -> None:
    """With several scenes in the tables each gets its own rows, and ids are not shared."""
    scenes = [crowd("scene-0916", 1), crowd("scene-0061", 2), one_scene(name="scene-0553")]
    write_root(tmp_path, scenes)
    sequences = {sequence.name: sequence for sequence in NuScenesDataset(tmp_path).sequences(["all"])}
    assert list(sequences) == ["scene-0061", "scene-0553", "scene-0916"]
    for scene in scenes:
        kept = sequences[scene.name].annotations()
        places = sorted((thing.frame, *thing.center) for thing in scene.things)
        assert sorted(zip(kept.frame.tolist(), *kept.center.T.tolist(), strict=True)) == places
    assert sequences["scene-0553"].truth() is None
    first, second = (set(sequences[name].annotations().instance.tolist()) for name in ("scene-0061", "scene-0916"))
    assert not first & second


@PATIENT
@given(
    st.lists(
        st.lists(st.integers(0, 6_000_000), min_size=1, max_size=5, unique=True).map(sorted), min_size=1, max_size=4
    ),
    st.randoms(use_true_random=False),
)
def test_velocity_is_the_centred_difference(lives: list[list[int]], chance: Any) -> None:
    """Velocities equal the benchmark's rule for each annotation: next minus previous, within 1.5 s on each side."""
    rows = [(i, stamp, (stamp * 1e-6) ** 2, -stamp * 3e-6) for i, life in enumerate(lives) for stamp in life]
    chance.shuffle(rows)
    instance, stamp = (np.array([row[k] for row in rows], dtype=np.int64) for k in (0, 1))
    velocity = box_velocity(instance, stamp, np.array([row[2:] for row in rows]))
    for (i, when, *_), got in zip(rows, velocity, strict=True):
        life = lives[i]
        at = life.index(when)
        before, after = life[max(at - 1, 0)], life[min(at + 1, len(life) - 1)]
        longest = 3.0 if before < when < after else 1.5
        if before == after or (after - before) * 1e-6 > longest:
            assert np.isnan(got).all()
        else:
            seconds = (after - before) * 1e-6
            rise = ((after * 1e-6) ** 2 - (before * 1e-6) ** 2) / seconds
            assert got == pytest.approx([rise, -3.0])


@PATIENT
@given(
    st.lists(st.fixed_dictionaries({"token": st.text(max_size=8), "n": st.integers() | st.lists(st.floats(-9, 9))})),
    st.integers(1, 40),
    st.sampled_from([None, 0, 1]),
)
def test_tables_are_read_in_pieces(
    tmp_path_factory: pytest.TempPathFactory, records: list[dict[str, Any]], chunk: int, indent: int | None
) -> None:
    """Reading record by record equals reading the whole file, for pieces of any length."""
    folder = tmp_path_factory.getbasetemp()
    (folder / "sample.json").write_text(json.dumps(records, indent=indent))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables_module, "_CHUNK", chunk)
        assert list(read_table(folder, "sample", "n", "token")) == [(one["n"], one["token"]) for one in records]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "no list"),
        ("", "no list"),
        ('[{"token": 1}', "behind"),
        ('[{"token": 1},{"tok', "behind"),
        ('[{"token": 1}, nonsense]', "behind"),
        ('[{"name": 1}]', "record 0 without token"),
        ("[3]", "something else as record 0"),
    ],
)
def test_broken_tables_are_named(tmp_path: Path, text: str, said: str) -> None:
    """A table that is cut, empty, no list or without a field gives one line with its path."""
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(DatasetError, match=said) as caught:
        list(read_table(tmp_path, "scene", "token"))
    assert caught.value.path == str(tmp_path / "scene.json")
    assert "\n" not in str(caught.value)


def test_splits_are_the_official_ones() -> None:
    """The splits have the official sizes; train, val and test share no scene, and the mini ones are parts of these."""
    splits = {name: scenes_of_split(name) for name in SPLITS}
    assert {name: len(scenes) for name, scenes in splits.items()} == {
        "train": 700,
        "val": 150,
        "test": 150,
        "mini_train": 8,
        "mini_val": 2,
    }
    assert len({*splits["train"], *splits["val"], *splits["test"]}) == 1000
    assert set(splits["mini_train"]) < {*splits["train"], *splits["val"]}
    assert splits["mini_val"] == ("scene-0103", "scene-0916")
    assert set(splits["mini_val"]) < set(splits["val"])


def test_sequences_are_chosen_by_scene_split_or_own_split(tmp_path: Path) -> None:
    """Names of scenes, official splits and splits.json are accepted; absent scenes of splits are skipped."""
    names = ["scene-0103", "scene-0757", "scene-0916", "scene-0061"]
    write_root(tmp_path, [one_scene(name=name) for name in names])
    (tmp_path / VERSION / "splits.json").write_text(json.dumps({"mine": ["scene-0061", "scene-0103"]}))
    dataset = NuScenesDataset(tmp_path)

    def chosen(*asked: str) -> list[str]:
        return [sequence.name for sequence in dataset.sequences(asked)]

    assert chosen("scene-0757", "scene-0757") == ["scene-0757"]
    assert chosen("mini_val") == ["scene-0103", "scene-0916"]
    assert chosen("mine", "train") == ["scene-0061", "scene-0103", "scene-0757"]
    assert chosen("all") == sorted(names)
    with pytest.raises(DatasetError, match="'yours'"):
        chosen("yours")
    with pytest.raises(DatasetError, match="scenes of test"):
        chosen("test")


def test_all_means_scenes_with_detections(tmp_path: Path) -> None:
    """Scenes that the detection file does not have are not in `all`; a missing sample is an error."""
    scenes = [one_scene(name="scene-0103"), one_scene(name="scene-0916")]
    write_root(tmp_path, scenes)
    path = write_detections(tmp_path, "made", scenes[:1])
    dataset = NuScenesDataset(tmp_path)
    assert [sequence.name for sequence in dataset.sequences(["all"])] == ["scene-0103"]
    (other,) = dataset.sequences(["scene-0916"])
    with pytest.raises(DatasetError, match=scenes[1].token(0)) as caught:
        list(other.frames())
    assert caught.value.path == str(path)


def test_samples_that_the_tables_lack_are_named(tmp_path: Path) -> None:
    """Samples of other scenes are counted in a note; a file without any sample of the tables is refused."""
    scenes = [one_scene(name="scene-0103"), one_scene(name="scene-0916")]
    write_root(tmp_path, scenes[:1])
    path = write_detections(tmp_path, "made", scenes)
    assert NuScenesDataset(tmp_path).notes[-1].endswith("3 of 6 samples are not in v1.0-mini: left out")
    write_detections(tmp_path, "made", scenes[1:])
    with pytest.raises(DatasetError, match="none of them: the 3 samples of the file are of another release") as caught:
        NuScenesDataset(tmp_path).sequences(["all"])
    assert caught.value.path == str(path)


def test_the_root_may_be_the_folder_of_the_tables(tmp_path: Path) -> None:
    """The root is the folder around the tables or that folder itself; of several releases one must be named."""
    scene = one_scene()
    write_root(tmp_path, [scene])
    write_detections(tmp_path, "made", [scene])
    assert [len(sequence) for sequence in NuScenesDataset(tmp_path / VERSION, "made").sequences([SCENE])] == [3]
    write_root(tmp_path, [scene], "v1.0-trainval")
    with pytest.raises(DatasetError, match=r"v1\.0-trainval and v1\.0-mini: name one of them"):
        NuScenesDataset(tmp_path)
    assert NuScenesDataset(tmp_path / "v1.0-trainval").sequences([SCENE])


def test_detections_are_named_or_alone(tmp_path: Path) -> None:
    """A detector is a name, a path or the only one; several are an error where detections are needed, not before."""
    scene = one_scene()
    write_root(tmp_path, [scene])
    path = write_detections(tmp_path, "one", [scene], {scene.token(0): [box(scene.token(0))]})

    def count(detections: str | Path | None) -> int:
        (sequence,) = NuScenesDataset(tmp_path, detections).sequences(["all"])
        return sum(len(frame) for frame in sequence.frames())

    assert count(None) == count("one") == count(path) == 1
    write_detections(tmp_path, "two", [scene])
    assert count("two") == 0
    with pytest.raises(DatasetError, match="several: one, two"):
        count(None)
    with pytest.raises(DatasetError, match=r"detections/three\.json"):
        count("three")
    (sequence,) = NuScenesDataset(tmp_path).sequences(["all"])
    assert len(sequence.stamps) == len(sequence)
    assert len(sequence) == 3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"translation": [1.0, 2.0]}, "3 numbers in translation"),
        ({"translation": [1.0, 2.0, "x"]}, "numbers in every box"),
        ({"translation": [1.0, 2.0, math.inf]}, r"finite numbers.*\[0\]"),
        ({"size": [1.0, 0.0, 1.0]}, r"a size above 0.*\[0\]"),
        ({"rotation": [0.0, 0.0, 0.0, 0.0]}, r"a rotation.*\[0\]"),
        ({"detection_score": 1.5}, "scores from 0 to 1"),
        ({"detection_score": -0.1}, "scores from 0 to 1"),
        ({"detection_score": None}, "numbers in every box"),
    ],
)
def test_wrong_boxes_are_named(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    """A box that cannot be one gives one line with the path and the sample."""
    token = one_scene().token(0)
    with pytest.raises(DatasetError, match=said) as caught:
        list(opened(tmp_path, one_scene(), {token: [box(token, **changes)]}).frames())
    assert token in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"meta": {}}', '{"results": []}', '{"results": {"a": {}}}', '{"results": {']
)
def test_files_in_another_layout_are_named(tmp_path: Path, text: str) -> None:
    """A detection file that is not in the submission layout gives one line with its path."""
    write_root(tmp_path, [one_scene()])
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(DatasetError) as caught:
        NuScenesDataset(tmp_path, path).sequences(["all"])
    assert caught.value.path == str(path)


def test_a_hopeless_score_stays_above_zero(tmp_path: Path) -> None:
    """A score of exactly 0, which some detectors give, is kept as a tiny one."""
    token = one_scene().token(0)
    frame = next(opened(tmp_path, one_scene(), {token: [box(token, detection_score=0)]}).frames())
    assert 0.0 < frame.score[0] < 1e-9


def test_wrong_roots_and_options_are_named(tmp_path: Path) -> None:
    """No root, an empty one, a missing one and an unknown option each give one clear line."""
    for root, said in ((None, "--root"), (tmp_path, "a folder without them"), (tmp_path / "no", "no such folder")):
        with pytest.raises(DatasetError, match=said):
            open_dataset("nuscenes", root)
    with pytest.raises(DatasetError, match="option seed"):
        open_dataset("nuscenes", tmp_path, seed=1)


def test_a_recorded_scene() -> None:
    """The recorded scene: 40 keyframes at 2 Hz, the documented numbers of boxes, with truth."""
    root = nuscenes_root()
    (sequence,) = NuScenesDataset(root, "centerpoint").sequences(["mini_val"])
    frames = list(sequence.frames())
    assert (sequence.name, len(frames)) == ("scene-0103", 40)
    assert np.diff([frame.stamp_ns for frame in frames]) == pytest.approx(0.5e9, rel=0.25)
    assert sum(len(frame) for frame in frames) == 5772
    assert all(frame.velocity is None for frame in frames)
    truth = sequence.truth()
    assert truth is not None
    assert (len(sequence.annotations()), len(truth)) == (2090, 1996)
    assert len(np.unique(sequence.annotations().instance)) == 123
    cars = truth.take((truth.names == "car") & ~truth.ignored)
    near = []
    for frame in frames:
        found = frame.center[frame.label == frame.labels.index("car"), :2]
        places = cars.center[cars.frame == frame.index, :2]
        near += [np.linalg.norm(found - center, axis=1).min() < 2.0 for center in places]
    assert np.mean(near) > 0.9


def test_recorded_heights_of_bottoms() -> None:
    """The heights in the PointPillars file are bottoms: raised by half a height they meet CenterPoint's."""
    root = nuscenes_root()

    def cars(name: str, **options: bool) -> list[np.ndarray]:
        (sequence,) = NuScenesDataset(root, name, **options).sequences(["all"])
        return [frame.center[frame.label == frame.labels.index("car")] for frame in sequence.frames()]

    apart = []
    for found, others in zip(cars("pointpillars", z_bottom=True), cars("centerpoint"), strict=True):
        for center in found:
            distance = np.linalg.norm(others[:, :2] - center[:2], axis=1)
            if distance.min() < 0.5:
                apart.append(center[2] - others[distance.argmin(), 2])
    assert len(apart) > 200
    assert abs(np.median(apart)) < 0.1


def test_a_recorded_sweep() -> None:
    """A recorded scan has its documented number of points, around the sensor and mostly below it."""
    (path,) = (nuscenes_root() / "sweeps" / "LIDAR_TOP").glob("*.pcd.bin")
    points = read_sweep(path)
    assert points.shape == (34752, 3)
    assert points.dtype == np.float32
    assert np.isfinite(points).all()
    assert -3.0 < np.median(points[:, 2]) < 0.0


def test_a_cut_sweep_is_named(tmp_path: Path) -> None:
    """A scan whose length is no whole number of points gives one line with its path."""
    path = tmp_path / "cut.pcd.bin"
    path.write_bytes(b"123")
    with pytest.raises(DatasetError, match="20 bytes per point"):
        read_sweep(path)


@pytest.mark.parametrize(
    ("name", "meta", "profile"),
    [
        ("CenterPoint_val", {}, "nuscenes"),
        ("results", {"detector": "Center-Point, 10 sweeps"}, "nuscenes"),
        ("cbgs", {}, "nuscenes-megvii"),
        ("results", {"model": ["MEGVII"]}, "nuscenes-megvii"),
        ("results", {}, "auto"),
    ],
)
def test_the_profile_is_that_of_the_detector_that_is_named(
    tmp_path: Path, name: str, meta: dict[str, Any], profile: str
) -> None:
    """The name of the file and `meta` count; of unknown detectors it is auto, and a note says so."""
    write_root(tmp_path, [one_scene()])
    path = write_detections(tmp_path, name, [one_scene()])
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"meta": content["meta"] | meta}))
    dataset = NuScenesDataset(tmp_path)
    assert dataset.profile == profile
    assert any("profile is auto" in note for note in dataset.notes) == (profile == "auto")

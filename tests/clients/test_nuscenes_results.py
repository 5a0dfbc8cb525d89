"""Writing and reading nuScenes tracking results."""

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_service import FakeService
from nuscenes_cases import Rows, disturbed_tracks, message, truth_tracks, write
from nuscenes_tables import box, crowd, write_detections, write_root
from optipmb_client import Connection
from optipmb_tools.datasets import DatasetError
from optipmb_tools.datasets.nuscenes import NuScenesDataset, NuScenesSequence
from optipmb_tools.results.nuscenes import NUSCENES_MAX_BOXES, read_nuscenes_results, result_table
from optipmb_tools.results.output import Results
from optipmb_tools.run.replay import Replaying, ReplayPace, replay

SCENES = [crowd("scene-0103", 1, 6), crowd("scene-0916", 2, 5, 1_538_984_233_000_000)]
FILE = "tracking_results.json"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_root(tmp_path_factory.mktemp("nuscenes"), SCENES)
    token = SCENES[0].token(2)
    write_detections(folder, "made", SCENES, {token: [box(token)]})
    return folder


def rows(count: int, **changes: Any) -> Rows:
    number = np.arange(count, dtype=np.int64)
    one = np.ones(count)
    made = Rows(
        id=number + 5,
        label=np.full(count, 2, dtype=np.int64),
        center=np.outer(one, [1.0, 2.0, 3.0]),
        size=np.outer(one, [4.0, 2.0, 1.5]),
        yaw=0.5 * one,
        velocity=np.outer(one, [1.0, -1.0]),
        score=np.linspace(0.1, 0.9, count),
    )
    return replace(made, **changes)


def test_what_is_written_is_read_again(root: Path, tmp_path: Path) -> None:
    """Ids, classes, boxes and scores of every scene come back to six decimals."""
    dataset = NuScenesDataset(root)
    sequences = dataset.sequences(["all"])
    tracks = {sequence.name: disturbed_tracks(sequence, 3) for sequence in sequences}
    for sequence in sequences:
        path = write(dataset, sequence, tracks[sequence.name], tmp_path)
    results = read_nuscenes_results(tmp_path)
    assert results.path == path == tmp_path / FILE
    for sequence in sequences:
        table = result_table(results, sequence.name, sequence.samples)
        for index, wanted in enumerate(tracks[sequence.name]):
            got = table.take(table.frame == index)
            assert got.id.tolist() == wanted.id.tolist()
            assert got.label.tolist() == wanted.label.tolist()
            for name in ("center", "size", "yaw", "score"):
                assert getattr(got, name) == pytest.approx(getattr(wanted, name), abs=2e-6)


def test_every_sample_is_there(root: Path, tmp_path: Path) -> None:
    """Samples without tracks, and frames never added, have an empty list; the meta comes from the detections."""
    dataset = NuScenesDataset(root)
    (sequence,) = dataset.sequences(["scene-0103"])
    dataset.write(tmp_path, sequence, {2: rows(3), 3: rows(0)})
    dataset.join(tmp_path, [sequence])
    content = json.loads((tmp_path / FILE).read_text())
    assert {token: len(boxes) for token, boxes in content["results"].items()} == {
        token: 3 if i == 2 else 0 for i, token in enumerate(sequence.samples)
    }
    used = {"use_camera": True, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False}
    assert content["meta"] == used


def test_a_box_is_in_the_official_layout(root: Path, tmp_path: Path) -> None:
    """A box has the official fields: size as width, length, height, a quaternion, and the scene in its id."""
    dataset = NuScenesDataset(root)
    (sequence,) = dataset.sequences(["scene-0916"])
    unknown = np.full((1, 2), np.nan)
    path = write(dataset, sequence, [rows(1), rows(1, velocity=unknown)], tmp_path)
    results = json.loads(path.read_text())["results"]
    assert results[sequence.samples[0]] == [
        {
            "sample_token": sequence.samples[0],
            "translation": [1.0, 2.0, 3.0],
            "size": [2.0, 4.0, 1.5],
            "rotation": [0.968912, 0.0, 0.0, 0.247404],
            "velocity": [1.0, -1.0],
            "tracking_id": "scene-0916-5",
            "tracking_name": "car",
            "tracking_score": 0.1,
        }
    ]
    assert results[sequence.samples[1]][0]["velocity"] == [0.0, 0.0]


def test_a_sample_holds_the_best_500(root: Path, tmp_path: Path) -> None:
    """Of more tracks than the benchmark takes, those with the highest scores are written, in their order."""
    dataset = NuScenesDataset(root)
    (sequence,) = dataset.sequences(["scene-0103"])
    many = rows(700, score=np.random.default_rng(1).uniform(0.1, 1.0, 700))
    results = read_nuscenes_results(write(dataset, sequence, [many], tmp_path))
    table = result_table(results, sequence.name, sequence.samples)
    assert len(table) == NUSCENES_MAX_BOXES == 500
    assert set(table.id.tolist()) == set(many.id[np.argsort(-many.score)[:500]].tolist())
    assert (np.diff(table.id) > 0).all()


def test_bytes_do_not_depend_on_the_order_of_closing(root: Path, tmp_path: Path) -> None:
    """Scenes that end in another order, or at the same time in threads, give the same file of all scenes."""
    written = []
    for number in range(3):
        dataset = NuScenesDataset(root)
        sequences = dataset.sequences(["all"])
        tracks = [dict(enumerate(map(message, truth_tracks(sequence)))) for sequence in sequences]
        results = Results(dataset, tmp_path / str(number))

        def end(sequence: NuScenesSequence, found: dict[int, Any], results: Results = results) -> None:
            results.take(sequence, results.write(sequence, found))

        work = [threading.Thread(target=end, args=one) for one in zip(sequences, tracks, strict=True)]
        for thread in work[:: -1 if number == 1 else 1]:
            thread.start()
            if number != 2:
                thread.join(60)
        for thread in work:
            thread.join(60)
        results.close(sequences)
        written.append((tmp_path / str(number) / FILE).read_bytes())
    assert written[0] == written[1] == written[2]
    tokens = list(json.loads(written[0])["results"])
    assert tokens == [scene.token(frame) for scene in SCENES for frame in range(len(scene.ego))]


def test_the_file_of_all_scenes_comes_with_the_last(root: Path, tmp_path: Path) -> None:
    """Before all scenes are done there are only their own files; a scene that fails leaves neither."""
    dataset = NuScenesDataset(root)
    first, second = dataset.sequences(["all"])
    results = Results(dataset, tmp_path)
    results.take(first, results.write(first, {0: message(rows(2))}))
    with pytest.raises(IndexError):  # there is no such frame
        results.write(second, dict.fromkeys(range(len(second) + 1), message(rows(1))))
    results.close([first, second])
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["scene-0103.json"] * 2
    results.take(second, results.write(second, {0: message(rows(1))}))
    results.close([first, second])
    for folder in (tmp_path, tmp_path / "shown"):
        files = sorted(path.name for place in (folder, folder / "scenes") for path in place.glob("*.json"))
        assert files == ["scene-0103.json", "scene-0916.json", FILE]
    part = read_nuscenes_results(tmp_path / "scenes" / "scene-0103.json")
    assert list(part.rows) == list(first.samples)


def test_other_classes_are_refused(root: Path, tmp_path: Path) -> None:
    """Tracks of a class that the benchmark does not have give one clear line, and no file."""
    dataset = NuScenesDataset(root)
    (sequence,) = dataset.sequences(["scene-0103"])
    wrong = rows(1, labels=("Car", "Van", "Tram"))
    with pytest.raises(DatasetError, match="'Tram'"):
        write(dataset, sequence, [wrong], tmp_path)
    assert not list(tmp_path.rglob("*.json"))


def test_replaying_scenes_at_once_writes_the_same_file(endpoint: str, root: Path, tmp_path: Path) -> None:
    """Scenes replayed at the same time through a service give the file that one after the other gives."""
    dataset = NuScenesDataset(root)
    pace = ReplayPace(patience_s=3.0, service_s=5.0)
    with FakeService(endpoint), Connection(endpoint) as link:
        for streams in (1, 2):
            out = tmp_path / str(streams)
            how = Replaying("nuscenes", pace, streams=streams)
            done = replay(link, dataset, dataset.sequences(["all"]), out, how)
            assert [result.missing for result in done] == [0, 0]
    written = [(tmp_path / streams / FILE).read_bytes() for streams in ("1", "2")]
    assert written[0] == written[1]
    assert sum(map(len, read_nuscenes_results(tmp_path / "1").rows.values())) == 1


def track_box(**changes: Any) -> dict[str, Any]:
    base = {name: value for name, value in box("t").items() if not name.startswith("detection")}
    return base | {"tracking_id": "a", "tracking_name": "car", "tracking_score": 0.5} | changes


def test_foreign_ids_are_numbered(tmp_path: Path) -> None:
    """Ids of other trackers, text or number, become numbers in order of appearance."""
    path = tmp_path / "other.json"
    boxes = {"s0": [track_box(tracking_id="x9"), track_box(tracking_id=4)], "s1": [track_box(tracking_id="4")]}
    path.write_text(json.dumps({"meta": {}, "results": boxes}))
    table = result_table(read_nuscenes_results(path), "scene-0103", ["s0", "s1"])
    assert table.id.tolist() == [0, 1, 1]
    assert table.frame.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        ({"s0": []}, "no sample s1"),
        ({"s0": [], "s1": [track_box(), track_box()]}, "tracking_id once"),
        ({"s0": [track_box(tracking_id=str(i)) for i in range(501)], "s1": []}, "at most 500"),
        ({"s0": [{"translation": [0, 0, 0], "tracking_name": "car"}], "s1": []}, "size in every box"),
        ({"s0": [{"tracking_name": "car"}], "s1": []}, "a list of boxes"),
        ({"s0": [track_box(tracking_score=float("nan"))], "s1": []}, "finite numbers"),
    ],
)
def test_wrong_results_are_named(tmp_path: Path, boxes: dict[str, Any], said: str) -> None:
    """Results that the benchmark would refuse give one line with the path."""
    path = tmp_path / FILE
    path.write_text(json.dumps({"meta": {}, "results": boxes}))
    with pytest.raises(DatasetError, match=said) as caught:
        result_table(read_nuscenes_results(tmp_path), "scene-0103", ["s0", "s1"])
    assert caught.value.path == str(path)

"""Result files in the format of the KITTI tracking benchmark."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_here
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from optipmb_tools.camera import synthetic_camera
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.geometry import Floats, Ints, Pose, planar_pose, wrap_angle
from optipmb_tools.results import full_table
from optipmb_tools.results.kitti import SUBMISSION_SCORES, read_kitti_results, write_kitti_results
from optipmb_tools.run.profiles import profile_for
from optipmb_tools.run.tracking import Tracking, track_whole
from real_data import kitti_root

LABELS = ("Car", "Pedestrian", "Cyclist")

COLUMNS = ("id", "label", "center", "size", "yaw", "score")


@dataclass(frozen=True)
class Rows:
    id: Ints
    label: Ints
    center: Floats
    size: Floats
    yaw: Floats
    score: Floats
    labels: tuple[str, ...] = LABELS

    @property
    def velocity(self) -> Floats:
        return np.full((len(self.id), 2), np.nan)

    @property
    def existence(self) -> Floats:
        return np.ones(len(self.id))


def some_rows(rng: np.random.Generator, count: int) -> Rows:
    """Give tracks anywhere around the origin, also behind the sensor."""
    return Rows(
        id=rng.permutation(1000)[:count],
        label=rng.integers(0, 3, count),
        center=rng.uniform(-40.0, 40.0, (count, 3)) * [1.0, 1.0, 0.05],
        size=rng.uniform(0.5, 5.0, (count, 3)),
        yaw=rng.uniform(-np.pi, np.pi, count),
        score=rng.uniform(0.0, 1.0, count),
    )


def write(path: Path, frames: list[tuple[int, Pose, Rows]]) -> Path:
    poses = {index: pose for index, pose, _ in frames}
    tracks = {index: rows for index, _, rows in frames}
    return write_kitti_results(
        path, synthetic_camera(), [poses.get(index) for index in range(max(poses, default=-1) + 1)], tracks
    )


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(st.integers(0, 2**32), st.integers(0, 12))
def test_every_track_comes_back(tmp_path: Path, seed: int, count: int) -> None:
    """World to file to world gives the same ids, classes, boxes and scores to the digits of the file."""
    rng = np.random.default_rng(seed)
    poses = [planar_pose(*rng.uniform(-50, 50, 2), 1.7, float(rng.uniform(-3, 3))) for _ in range(3)]
    frames = [(i, pose, some_rows(rng, count)) for i, pose in enumerate(poses)]
    table = read_kitti_results(write(tmp_path / "0000.txt", frames), LABELS).to_world(poses)
    wanted = {name: np.concatenate([getattr(rows, name) for _, _, rows in frames]) for name in COLUMNS}
    assert table.labels == LABELS
    np.testing.assert_array_equal(table.frame, np.repeat(np.arange(3), count))
    for name in ("id", "label"):
        np.testing.assert_array_equal(getattr(table, name), wanted[name])
    for name in ("center", "size", "score"):
        np.testing.assert_allclose(getattr(table, name), wanted[name], atol=2e-6)
    assert abs(wrap_angle(table.yaw - wanted["yaw"])).max(initial=0.0) < 2e-6


def test_a_line_has_the_eighteen_fields_of_the_benchmark(tmp_path: Path) -> None:
    """A car 20 m ahead and below the camera, driving away: each field where the benchmark wants it."""
    rows = Rows(
        np.array([7]),
        np.array([0]),
        np.array([[20.0, 0.0, -1.0]]),
        np.array([[4.0, 1.6, 1.5]]),
        np.zeros(1),
        np.array([0.9]),
    )
    path = write(tmp_path / "0000.txt", [(3, planar_pose(0.0, 0.0, 0.0, 0.0), rows)])
    assert path.read_text() == (
        "3 7 Car -1 -1 -1.570796 589.000000 195.681818 653.000000 257.500000 "
        "1.500000 1.600000 4.000000 0.000000 1.750000 20.000000 -1.570796 0.900000\n"
    )


def test_tracks_that_no_image_shows_are_written_too(tmp_path: Path) -> None:
    """A track behind the camera has the image box 0 0 0 0 and its own 3D box."""
    rows = Rows(
        np.array([1]), np.array([1]), np.array([[-9.0, 2.0, 0.0]]), np.ones((1, 3)), np.zeros(1), np.array([0.1])
    )
    table = read_kitti_results(write(tmp_path / "0000.txt", [(0, planar_pose(0, 0, 0, 0), rows)]))
    np.testing.assert_array_equal(table.box2d, np.zeros((1, 4)))
    np.testing.assert_allclose(table.center, [[-9.0, 2.0, 0.0]])


def test_a_sequence_without_tracks_is_an_empty_file(tmp_path: Path) -> None:
    """The file is there, and reading it gives a table without rows."""
    path = write(tmp_path / "out" / "0000.txt", [])
    assert path.read_bytes() == b""
    assert len(read_kitti_results(path)) == len(full_table((), {})) == 0


def test_the_same_tracks_give_the_same_bytes(tmp_path: Path) -> None:
    """Written twice the file is the same, and what rounds to zero is written without a sign."""
    rows = some_rows(np.random.default_rng(3), 5)
    pose = planar_pose(0, 0, 0, 0)
    texts = []
    for i, tiny in enumerate((1e-9, 1e-9, -1e-9)):
        middle = replace(rows, center=rows.center * [1.0, 0.0, 1.0] + [0.0, tiny, 0.0], yaw=np.full(5, -0.5 * np.pi))
        texts.append(write(tmp_path / str(i), [(0, pose, middle)]).read_text())
    assert texts[0] == texts[1]
    assert "-0.000000" not in "".join(texts)


def write_cars(root: Path, folder: str = "Car") -> None:
    """Write a KITTI root with a car ahead, one that leaves the image, a doubtful one, and one that is soon missed."""
    # x, z, speed per frame, score, number of detections
    cars = [
        (0.0, 20.0, 0.0, 0.95, 20),
        (-4.0, 8.0, -0.3, 0.95, 20),
        (5.0, 25.0, 0.0, 0.6, 20),
        (-5.0, 30.0, 0.0, 0.95, 4),
    ]
    rows = [(k, x + k * speed, z, score) for x, z, speed, score, count in cars for k in range(count)]
    lines = [f"{k},2,0,0,9,9,{score},1.5,1.6,4,{x},1.7,{z},3.14,0" for k, x, z, score in rows]
    calibration = "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
    for place, text in {
        "training/calib/0000.txt": calibration + "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
        "training/poses/0000.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n" * 20,
        f"detections/made/{folder}/0000.txt": "\n".join(lines),
    }.items():
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_text(text)


def submitted(path: Path) -> dict[int, list[list[float]]]:
    """Return the image box and the score of each row of a file, by id."""
    rows: dict[int, list[list[float]]] = {}
    for fields in map(str.split, path.read_text().splitlines()):
        assert len(fields) == 18
        rows.setdefault(int(fields[1]), []).append([float(field) for field in (*fields[6:10], fields[17])])
    return rows


@pytest.mark.parametrize("options", [[], ["0.9"], ["0.3"]])
def test_a_submission_has_confirmed_tracks_of_high_mean_score_in_the_image(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    """Tracks that were confirmed and whose rank, by all rows, reaches the threshold, with the rows in the image."""
    write_cars(tmp_path)
    data = (tmp_path, "--hindsight", 0)
    run_here(capsys, "track", *data, "--out", tmp_path / "all")
    done = run_here(capsys, "track", *data, "--out", tmp_path / "cut", "--submission", *options)
    assert done.returncode == 0, done.stderr
    least = float(options[0]) if options else SUBMISSION_SCORES["Car"]
    assert f"confirmed tracks from these mean scores on, in the image: Car {least:g}" in done.stderr
    (sequence,) = open_dataset("kitti", tmp_path).sequences(["all"])
    found = track_whole(Tracking(profile_for("auto", [sequence])), sequence).tracks.values()
    confirmed = {int(one) for tracks in found for one in tracks.id[tracks.confirmed == 1]}
    every, cut = submitted(tmp_path / "all/0000.txt"), submitted(tmp_path / "cut/0000.txt")
    assert 3 < len(confirmed) <= len(every)
    shown = {one: [row for row in rows if any(row[:4])] for one, rows in every.items()}
    assert any(len(shown[one]) < len(every[one]) for one in confirmed)
    wanted = {one for one in confirmed if np.mean([row[4] for row in every[one]]) >= least}
    assert (len(wanted) < len(confirmed)) == (options != ["0.3"])
    assert cut == {one: shown[one] for one in every if one in wanted}
    again = run_here(capsys, "track", *data, "--out", tmp_path / "again", "--submission", *options)
    assert again.returncode == 0
    assert (tmp_path / "again/0000.txt").read_bytes() == (tmp_path / "cut/0000.txt").read_bytes()


def test_a_submission_is_refused_where_it_would_be_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table, all columns, a score that is none, another layout and classes that the benchmark lacks are refused."""
    write_cars(tmp_path / "cars")
    write_cars(tmp_path / "trucks", "Truck")
    out = ["--out", tmp_path / "out"]
    for arguments, says in (
        ([tmp_path / "cars", "--submission", "--out", tmp_path / "out.csv"], "expected a folder as --out"),
        ([tmp_path / "cars", "--submission", "--full", *out], "no --full"),
        ([tmp_path / "cars", "--submission=1.5", *out], "--submission: expected a mean score from 0 to 1"),
        (["--dataset", "scene", "--submission", *out], "submission"),
        ([tmp_path / "trucks", "--submission", "--profile", "auto", *out], "received tracks of 'Truck'"),
    ):
        done = run_here(capsys, "track", *arguments)
        assert (done.returncode, says in done.stderr.splitlines()[-1]) == (2, True), done.stderr
        assert not (tmp_path / "out/0000.txt").exists()


LINE = "0 1 Car -1 -1 0 0 0 1 1 1.5 1.6 4 0 1.7 20 0 0.9"


@pytest.mark.parametrize(
    ("text", "line", "received"),
    [
        ("0 1 Car -1 -1 0 0 0 1 1 1.5 1.6 4 0 1.7 20", 1, "16 fields"),
        (f"{LINE}\n{LINE}", 2, "id 1 again in frame 0"),
        (f"{LINE}\n{LINE.replace('0 1 Car', '-1 1 Car')}", 2, "-1"),
        (LINE.replace("1.7", "high"), 1, "'high'"),
    ],
)
def test_a_wrong_result_file_is_told_with_its_line(tmp_path: Path, text: str, line: int, received: str) -> None:
    """Fields, frames, ids and numbers are checked."""
    path = tmp_path / "0000.txt"
    path.write_text(text + "\n")
    with pytest.raises(DatasetError) as caught:
        read_kitti_results(path)
    assert (caught.value.line, caught.value.received) == (line, received)


def test_a_file_without_scores_is_read_too(tmp_path: Path) -> None:
    """Seventeen fields mean score 1, and rows are put in the order of frames."""
    path = tmp_path / "0000.txt"
    path.write_text(LINE.replace("0 1 Car", "5 1 Car") + "\n" + LINE.rsplit(" ", 1)[0].replace("Car", "Van") + "\n")
    table = read_kitti_results(path, ("Car",))
    assert table.frame.tolist() == [0, 5]
    assert table.score.tolist() == [1.0, 0.9]
    assert [table.labels[i] for i in table.label] == ["Van", "Car"]
    assert table.of_class("Van").frame.tolist() == [0]


def test_real_truth_written_as_results_is_the_label_file_again(tmp_path: Path) -> None:
    """Truth of a real sequence through world and writer has the 3D boxes, ry and, nearly, alpha of its label file."""
    dataset = open_dataset("kitti", kitti_root())
    (sequence,) = dataset.sequences(["0011"])
    truth = sequence.truth()
    assert truth is not None
    frames = [truth.take(truth.frame == index) for index in range(len(sequence))]
    tracks = {
        index: Rows(now.id, now.label, now.center, now.size, now.yaw, np.ones(len(now)), truth.labels)
        for index, now in enumerate(frames)
    }
    path = dataset.write(tmp_path, sequence, tracks)
    assert path == tmp_path / "0011.txt"
    lines = (kitti_root() / "training/label_02/0011.txt").read_text().splitlines()
    wanted = {tuple(f[:3]): f for f in (line.split() for line in lines) if f[2] != "DontCare"}
    found = {tuple(f[:3]): f for f in (line.split() for line in path.read_text().splitlines())}
    assert found.keys() == wanted.keys()
    ours = np.array([found[key][10:17] for key in wanted], dtype=np.float64)
    theirs = np.array([fields[10:17] for fields in wanted.values()], dtype=np.float64)
    np.testing.assert_allclose(ours[:, :6], theirs[:, :6], atol=2e-6)
    assert abs(wrap_angle(ours[:, 6] - theirs[:, 6])).max() < 2e-6
    alpha = np.array([[found[key][5], wanted[key][5]] for key in wanted], dtype=np.float64)
    assert np.median(abs(wrap_angle(alpha[:, 0] - alpha[:, 1]))) < 0.01

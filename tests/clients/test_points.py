"""Detections without heading, size or height: the page docs/points.md, tables, a recording, KITTI without headings."""

import io
import re
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_here
from optipmb_tools.datasets import open_dataset
from optipmb_tools.datasets.table import TableDataset
from optipmb_tools.evaluation import default_rules
from optipmb_tools.evaluation.cases import prepare
from optipmb_tools.evaluation.clear import clear, combine
from optipmb_tools.files import DatasetError
from optipmb_tools.run.tracking import Tracking, track_whole
from optipmb_tools.table_files import read_table, write_table
from optipmb_tools.tuning.clips import Clip, load, track_clip
from optipmb_tools.tuning.scoring import rules_of
from own_tables import FRAMES, boxes
from real_data import REPOSITORY, kitti_root

import optipmb

PAGE = REPOSITORY / "docs" / "points.md"
UNKNOWN = dict.fromkeys(("l", "w", "h", "yaw", "z"))


def test_the_page_prints_what_it_says() -> None:
    """The first block of code of the page and the text below it."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    code, wanted = blocks[:2]
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(compile(code, str(PAGE), "exec"), {})  # noqa: S102 - of this repository
    assert printed.getvalue() == wanted


def test_a_table_of_points_is_tracked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Time, place, class and score are enough: each object keeps its id, and faces along its way."""
    write_table(tmp_path / "points.csv", boxes(**UNKNOWN))
    done = run_here(capsys, "track", tmp_path / "points.csv", "--out", tmp_path / "t.csv", "--verbose")
    assert done.returncode == 0, done.stderr
    assert "no column for the size or the heading: unknown" in done.stderr + done.stdout
    tracks = read_table(tmp_path / "t.csv")
    last = np.flatnonzero(tracks["t"] == tracks["t"].max())
    assert len(last) == len(set(tracks["id"].tolist())) == 3
    course = np.where(tracks["vx"][last] > 0.0, 0.0, np.pi)
    np.testing.assert_allclose(np.cos(tracks["yaw"][last] - course), 1.0, atol=0.01)
    assert (tracks["vx"][last] < 0.0).sum() == 1


def test_a_table_with_a_part_of_the_box_says_what_it_lacks(tmp_path: Path) -> None:
    """A heading or a z without a size is used, and a size without a heading; a width alone is refused."""
    for lacking, height in ((("l", "w", "h"), True), (("l", "w", "h", "z"), False)):
        write_table(tmp_path / "d.csv", boxes(**dict.fromkeys(lacking)))
        (frame, *_) = TableDataset(tmp_path / "d.csv").sequences(["all"])[0].frames()
        assert np.isnan(frame.size).all()
        assert np.isfinite(frame.yaw).all()
        assert np.isfinite(frame.center[:, 2]).all() == height
    write_table(tmp_path / "d.csv", boxes(yaw=None))
    (frame, *_) = TableDataset(tmp_path / "d.csv").sequences(["all"])[0].frames()
    assert np.isfinite(frame.size).all()
    assert np.isnan(frame.yaw).all()
    write_table(tmp_path / "d.csv", boxes(l=None))
    with pytest.raises(DatasetError, match="expected a column l "):
        TableDataset(tmp_path / "d.csv")


def test_points_are_smoothed_while_their_heading_is_known(tmp_path: Path) -> None:
    """The frames before the heading is known stay as they were; the others are given the later ones."""
    write_table(tmp_path / "points.csv", boxes(**UNKNOWN))
    (sequence,) = TableDataset(tmp_path / "points.csv").sequences(["all"])
    parameters = optipmb.load_profile("generic")
    plain, smooth = (track_whole(Tracking(parameters, smooth=one), sequence).tracks for one in (False, True))
    changed = 0
    for index, before in plain.items():
        after = smooth[index]
        assert after.id.tolist() == before.id.tolist()
        assert np.isfinite(after.covariance).all()
        if before.measured is None:
            continue
        unknown = before.measured & 1 == 0
        np.testing.assert_array_equal(after.center[unknown], before.center[unknown])
        changed += int((after.center[~unknown] != before.center[~unknown]).any())
    assert changed > FRAMES // 2


@pytest.mark.parametrize("mode", ["headings", "points"])
def test_kitti_without_headings(mode: str) -> None:
    """Cars of PointRCNN, tracked without headings, and without sizes and heights too.

    At most 10 switches within 2 m of an object. At most 3 % of the boxes of moving cars are more than 30 degrees off,
    the first frames of tracks among them; of those whose heading the tracker says that it knows, at most 1 %.
    """
    parameters, near = optipmb.load_profile("kitti"), default_rules("kitti", "distance", 2.0)
    results, off = [], []
    for sequence in open_dataset("kitti", kitti_root(), "pointrcnn", clouds=False).sequences(["all"]):
        clip = load(sequence, parameters, rules_of("kitti"))
        clip = replace(clip, frames=tuple(without(frame, points=mode == "points") for frame in clip.frames))
        table = track_clip(clip, parameters)
        kept = table.existence >= 0.5
        results.append(clear(prepare(clip.world, table.take(kept), "Car", near, clip.name), near))
        off.append(headings_off(clip, parameters))
    assert combine(results).switches <= 10
    wrong, known = np.concatenate(off).T
    assert len(wrong) > 4000
    assert wrong.mean() <= 0.03
    assert wrong[known].mean() <= 0.01
    assert known.mean() > 0.85


def without(frame: optipmb.Frame, *, points: bool) -> optipmb.Frame:
    """The frame without its headings; as points without sizes and heights too."""
    unknown = np.full(len(frame.score), np.nan)
    if not points:
        return replace(frame, yaw=unknown)
    center = np.column_stack((frame.center[:, :2], unknown))
    return replace(frame, yaw=unknown, center=center, size=np.full_like(frame.size, np.nan))


def headings_off(clip: Clip, parameters: optipmb.Parameters) -> np.ndarray:
    """Whether the confirmed track nearest to each moving car is more than 30 degrees off, and its heading is known."""
    tracker, truth, found = optipmb.Tracker(parameters), clip.world, []
    density, cars = tracker.initial(), truth.names == "Car"
    for index, frame in enumerate(clip.frames):
        result = tracker.step(density, frame)
        density, tracks = result.density, result.tracks
        known = np.ones(len(tracks)) if result.measured is None else result.measured & 1
        shown = np.flatnonzero(tracks.confirmed & (tracks.label == parameters.labels.index("Car")))
        for row in np.flatnonzero(cars & (truth.frame == index)):
            ends = [truth.center[(truth.id == truth.id[row]) & (truth.frame == index + k), :2] for k in (-1, 1)]
            away = np.linalg.norm(tracks.center[shown, :2] - truth.center[row, :2], axis=1)
            if min(map(len, ends)) and len(away) and away.min() < 2.0 and np.linalg.norm(ends[1] - ends[0]) > 0.4:
                k = shown[away.argmin()]
                found.append((np.cos(tracks.yaw[k] - truth.yaw[row]) < np.cos(np.pi / 6), known[k]))
    return np.array(found, dtype=np.bool_).reshape(-1, 2)

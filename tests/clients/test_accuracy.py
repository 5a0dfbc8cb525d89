"""How accurate the profiles that ship are, on real data: below these figures something has been lost."""

from functools import cache
from pathlib import Path

import pytest
from greedy import greedy_tracks
from kalman import kalman_tracks
from optipmb_client.cli import run
from optipmb_client.datasets import open_dataset
from optipmb_client.evaluation.calibration import CalibrationResult
from optipmb_client.tuning.calibrate import cross_calibration
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.material import Clip, load, of_class, track_clip
from optipmb_client.tuning.scoring import Scorer, rules_of, scorer_of
from optipmb_client.tuning.values import only
from real_data import kitti_root, nuscenes_root

import optipmb

DOCS = Path(__file__).parents[2] / "docs"
PROFILES = Path(optipmb.__file__).parent / "profiles"


@cache
def material(dataset: str, detections: str) -> tuple[dict[str, Scorer], dict[str, list[Clip]]]:
    """Scorers and clips of each class that is labelled."""
    root = kitti_root() if dataset == "kitti" else nuscenes_root()
    options = {"z_bottom": True} if detections == "pointpillars" else {}
    sequences = open_dataset(dataset, root, detections, clouds=False, **options).sequences(["all"])
    rules = rules_of(dataset)
    clips = [load(one, optipmb.load_profile(dataset), rules) for one in sequences]
    labelled = {str(name) for clip in clips for name in clip.truth.names[~clip.truth.ignored]}
    names = [name for name in optipmb.load_profile(dataset).labels if name in labelled]
    return (
        {name: scorer_of(dataset, name, sequences) for name in names},
        {name: [of_class(clip, name, rules) for clip in clips] for name in names},
    )


@cache
def figures(profile: str, detections: str, name: str) -> Figures:
    """The figures of one class by one profile."""
    scorers, clips = material(profile.removesuffix("-paper"), detections)
    parameters = only(optipmb.load_profile(profile), name)
    return scorers[name].figures([scorers[name].measure(clip, track_clip(clip, parameters)) for clip in clips[name]])


def calibration(profile: str, detections: str, name: str) -> CalibrationResult:
    """How well the tracks of one class know themselves, each sequence with the calibration that the others give."""
    scorers, clips = material(profile, detections)
    return cross_calibration(clips[name], scorers[name], only(optipmb.load_profile(profile), name))


@pytest.mark.parametrize(("name", "amota", "hota"), [("car", 0.85, 0.66), ("pedestrian", 0.92, 0.74)])
def test_nuscenes_is_tracked_like_by_the_best_public_trackers(name: str, amota: float, hota: float) -> None:
    """Official AMOTA (theirs: 0.866, 0.886), HOTA of all that is written (0.608, 0.609), at most three switches."""
    found = figures("nuscenes", "centerpoint", name)
    assert found.amota >= amota
    assert found.hota_all >= hota
    assert found.ids <= 3


@pytest.mark.parametrize("detections", ["centerpoint", "pointpillars"])
def test_no_class_is_tracked_worse_than_greedily(detections: str) -> None:
    """With either detector, one without velocities: each class that is found has at least the greedy AMOTA."""
    scorers, clips = material("nuscenes", detections)
    compared = 0
    for name, scorer in scorers.items():
        if any(len(frame.score) for clip in clips[name] for frame in clip.frames):
            simple = scorer.figures([scorer.measure(clip, greedy_tracks(clip, name)) for clip in clips[name]])
            assert figures("nuscenes", detections, name).amota >= simple.amota, name
            compared += 1
    assert compared >= 2


@pytest.mark.parametrize(("name", "lead"), [("Car", 0.02), ("Pedestrian", 0.04), ("Cyclist", 0.1)])
def test_kitti_is_tracked_better_than_by_simple_trackers(name: str, lead: float) -> None:
    """The same detections, the same evaluator: sAMOTA and MOTA lead those of the greedy and of AB3DMOT's tracker."""
    scorers, clips = material("kitti", "pointrcnn")
    own = figures("kitti", "pointrcnn", name)
    for simple in (greedy_tracks, kalman_tracks):
        other = scorers[name].figures([scorers[name].measure(clip, simple(clip, name)) for clip in clips[name]])
        assert own.samota >= other.samota + lead
        assert own.mota >= other.mota + lead
        assert own.amota >= other.amota + lead


@pytest.mark.parametrize("name", ["Car", "Pedestrian", "Cyclist"])
def test_kitti_is_tracked_at_least_as_well_as_with_the_papers_values(name: str) -> None:
    """Neither sAMOTA nor MOTA is less than with the values of the paper's table, by more than a thousandth."""
    tuned, paper = figures("kitti", "pointrcnn", name), figures("kitti-paper", "pointrcnn", name)
    assert tuned.samota >= paper.samota - 0.001
    assert tuned.mota >= paper.mota - 0.001


def test_car_tracks_know_themselves() -> None:
    """In sequences left out NEES is 2 within what objects leave open, and existence comes true within ten points."""
    found = calibration("kitti", "pointrcnn", "Car")
    low, high = found.interval
    assert low < 2.0 < high
    rows = [one for one in found.deciles if one.count >= 100]
    assert len(rows) == 10
    assert all(abs(one.predicted - one.observed) < 0.1 for one in rows)


def test_the_tables_of_the_ablation_come_out_as_they_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb ablate` prints the sixteen rows of each class that docs/ablation.md has, but for frames per second."""
    data = ["--dataset", "nuscenes", "--root", str(nuscenes_root()), "--detections", "centerpoint"]
    assert run(["ablate", *data, "--markdown"]) == 0
    rows = [line.rsplit("|", 2)[0] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert len(rows) == 18 * 6  # five classes that are labelled, and all
    page = (DOCS / "ablation.md").read_text(encoding="utf-8")
    section = page[page.index("## nuScenes") :].split("\n## ")[0]
    assert rows == [line.rsplit("|", 2)[0] for line in section.splitlines() if line.startswith("|")]


def test_the_profile_that_ships_is_what_tuning_gives(tmp_path: Path) -> None:
    """The command of docs/tuning.md for nuScenes writes the profile that ships, byte for byte."""
    page = (DOCS / "tuning.md").read_text(encoding="utf-8")
    (line,) = (line for line in page.splitlines() if line.startswith("optipmb tune") and "--name nuscenes" in line)
    words = line.split()[1:]
    words[words.index("--root") + 1], words[words.index("--out") + 1] = str(nuscenes_root()), str(tmp_path)
    assert run(words) == 0
    assert (tmp_path / "tuned.toml").read_bytes() == (PROFILES / "nuscenes.toml").read_bytes()

"""How accurate the profile that ships is on nuScenes, and that its tables and itself come out again."""

import csv
from pathlib import Path

import numpy as np
import pytest
from accuracy import figures, material, tracked, without_motion
from greedy import greedy_tracks
from optipmb_tools.cli import run
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.calibration import rows_of, sample
from optipmb_tools.tuning.clips import load, of_class, track_clip
from optipmb_tools.tuning.scoring import rules_of, scorer_of
from optipmb_tools.tuning.values import only
from real_data import all_nuscenes, nuscenes_root

import optipmb

DOCS = Path(__file__).parents[2] / "docs"
PROFILES = Path(optipmb.__file__).parent / "model/profiles"


@pytest.mark.parametrize(("name", "amota", "hota"), [("car", 0.85, 0.66), ("pedestrian", 0.92, 0.74)])
def test_nuscenes_is_tracked_like_by_the_best_public_trackers(name: str, amota: float, hota: float) -> None:
    """Official AMOTA (theirs: 0.866, 0.886), HOTA of all that is written (0.608, 0.609), at most three switches."""
    found = figures("nuscenes", "centerpoint", name)
    assert found["AMOTA"] >= amota
    assert found["HOTA, all"] >= hota
    assert found["IDS"] <= 3


@pytest.mark.parametrize(("name", "error", "moving"), [("car", 0.7, 0.09), ("pedestrian", 0.265, 0.05)])
def test_velocities_are_those_of_the_labels(name: str, error: float, moving: float) -> None:
    """The root mean square error, m/s, and the share above 0.3 m/s of what stands, at 2 Hz without velocities."""
    scorers, clips = material("nuscenes", "centerpoint")
    (clip,), (full,) = clips[name], tracked("nuscenes", "centerpoint", name)
    truth, found = clip.world, sample(clip.world, full, full, name, scorers[name].near)
    row, owner = found.row[found.true], found.owner[found.true]
    before, after = (rows_of(truth.frame, truth.id, full.frame[row] + shift, owner) for shift in (-1, 1))
    row, before, after = (rows[(before >= 0) & (after >= 0)] for rows in (row, before, after))
    elapsed = (clip.stamps[truth.frame[after]] - clip.stamps[truth.frame[before]]) * 1e-9
    velocity = (truth.center[after, :2] - truth.center[before, :2]) / elapsed[:, None]
    lasting = full.age[row] > 0.0
    off = np.linalg.norm(full.velocity[row] - velocity, axis=1)[lasting]
    stands = (np.linalg.norm(velocity, axis=1) < 0.1) & lasting
    assert np.sqrt(np.mean(off**2)) < error
    assert np.mean(np.linalg.norm(full.velocity[row][stands], axis=1) > 0.3) < moving


@pytest.mark.parametrize("detections", ["centerpoint", "pointpillars"])
def test_no_class_is_tracked_worse_than_greedily(detections: str) -> None:
    """With either detector, one without velocities: each class that is found has at least the greedy AMOTA."""
    scorers, clips = material("nuscenes", detections)
    compared = 0
    for name, scorer in scorers.items():
        if any(len(frame.score) for clip in clips[name] for frame in clip.frames):
            simple = scorer.figures([scorer.measure(clip, greedy_tracks(clip, name)) for clip in clips[name]])
            assert figures("nuscenes", detections, name)["AMOTA"] >= simple["AMOTA"], name
            compared += 1
    assert compared >= 2


def test_the_figures_of_the_ablation_come_out_as_they_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb ablate` prints the sixteen rows of each class in docs/ablation/nuscenes.csv, and frames per second."""
    data = ["--dataset", "nuscenes", "--root", str(nuscenes_root()), "--detections", "centerpoint"]
    assert run(["ablate", *data, "--profile", "nuscenes", "--markdown"]) == 0
    printed, title = [], ""
    for line in capsys.readouterr().out.splitlines():
        if line.endswith(":") and not line.startswith("|"):
            title = line.removesuffix(":")
        elif line.startswith("| ") and not line.startswith(("| ADP", "| ---")):
            printed.append([title, *(cell.strip() for cell in line[1:-1].split("|")[:-1])])
    assert len(printed) == 16 * 6  # five classes that are labelled, and all
    with (DOCS / "ablation" / "nuscenes.csv").open(encoding="utf-8", newline="") as file:
        assert printed == list(csv.reader(file))[1:]


def test_a_profile_that_ships_is_what_its_command_gives(tmp_path: Path) -> None:
    """The command of docs/tuning.md that names a profile writes the one that ships, but for the motion."""
    page = (DOCS / "tuning.md").read_text(encoding="utf-8")
    (line,) = (
        line for line in page.splitlines() if line.startswith("optipmb tune") and "--name nuscenes-megvii " in line
    )
    words = line.split()[1:]
    words[words.index("--root") + 1], words[words.index("--out") + 1] = str(all_nuscenes(tmp_path)), str(tmp_path)
    assert run(words) == 0
    assert without_motion(tmp_path / "calibrated.toml") == without_motion(PROFILES / "nuscenes-megvii.toml")


@pytest.mark.parametrize(("name", "amota", "before"), [("car", 0.885, 0.875), ("pedestrian", 0.82, 0.37)])
def test_calibrated_scores_hold_where_they_were_not_measured(
    name: str, amota: float, before: float, tmp_path: Path
) -> None:
    """AMOTA of Megvii on the six scenes not used for its curve, with its own profile and with CenterPoint's."""
    dataset, rules = open_dataset("nuscenes", all_nuscenes(tmp_path), "megvii", clouds=False), rules_of("nuscenes")
    provenance = optipmb.load_profile("nuscenes-megvii").provenance
    sequences = [one for one in dataset.sequences(["all"]) if one.name not in provenance]
    assert len(sequences) == 6
    scorer, found = scorer_of("nuscenes", name, sequences), []
    for profile in ("nuscenes-megvii", "nuscenes"):
        parameters = optipmb.load_profile(profile)
        clips = [of_class(load(one, parameters, rules), name, rules) for one in sequences]
        measured = [scorer.measure(clip, track_clip(clip, only(parameters, name))) for clip in clips]
        found.append(scorer.figures(measured)["AMOTA"])
    assert found[0] >= amota
    assert found[1] <= before

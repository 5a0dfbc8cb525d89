"""Curves between the scores of two detectors: a known distortion is found again, and the command writes it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nuscenes_tables import Scene, Thing, box, write_detections, write_root
from optipmb_tools.cli import run
from optipmb_tools.tuning.clips import Clip, load, of_class
from optipmb_tools.tuning.estimate import pair_all, score_curve
from optipmb_tools.tuning.scoring import rules_of
from optipmb_tools.tuning.values import only
from tuning_cases import Habits, Recorded, recorded

import optipmb
from optipmb.model.frame import calibrated

RULES = rules_of("scene")
CARS = only(optipmb.load_profile("kitti"), "Car")


def cars(seed: int, power: float = 1.0, frames: int = 400) -> list[Clip]:
    """Detections of score s that are of a car with the probability s or so; told is s to some power."""
    made = recorded(Habits(false=27.0), seed, frames)
    rng = np.random.default_rng(seed)
    given = []
    for frame in made.frames():
        true = frame.center[:, 1] > -250.0
        score = np.where(true, rng.beta(2.0, 1.0, len(true)), rng.beta(1.0, 2.0, len(true)))
        given.append(replace(frame, score=np.clip(score, 0.01, 0.99) ** power))
    return [of_class(load(Recorded("0000", given, made.truth()), CARS, RULES), "Car", RULES)]


def curve_of(own: list[Clip], reference: list[Clip]) -> optipmb.ScoreCalibration | None:
    return score_curve(*(pair_all(clips, "Car", CARS, RULES) for clips in (own, reference)))


@pytest.mark.parametrize("power", [0.4, 1.0, 3.0])
def test_a_known_distortion_of_scores_is_found_again(power: float) -> None:
    """A detector tells the power of another one's score, on other objects: the curve is the root, to 0.05."""
    curve = curve_of(cars(1, power), cars(2))
    assert curve is not None
    score = np.linspace(0.1, 0.9, 50)
    np.testing.assert_allclose(calibrated(curve, score**power), score, atol=0.05)


def test_nothing_is_made_of_little() -> None:
    """Fewer than fifty detections on labels, of either detector, give no curve."""
    assert curve_of(cars(1, frames=1), cars(2)) is None
    assert curve_of(cars(1), cars(2, frames=1)) is None


SCENES = ("scene-0103", "scene-0553")


def write_data(root: Path) -> None:
    """Two scenes with ten cars; `made` has both, `known` the second one alone, and `made` tells the square."""
    scenes = []
    for name in SCENES:
        things = [
            Thing(f"car-{i}", "vehicle.car", frame, (20.0 * i, 5.0, 1.0)) for i in range(10) for frame in range(20)
        ]
        scenes.append(Scene(name, [(100.0, 0.0)] * 20, things))
    write_root(root, scenes)
    for detector, power, wanted in (("made", 2.0, scenes), ("known", 1.0, scenes[1:])):
        rng = np.random.default_rng(len(wanted))
        boxes = {}
        for scene in wanted:
            for frame in range(20):
                score = rng.uniform(0.05, 0.95, 10)
                aside = np.where(rng.random(10) < score, rng.normal(0.0, 0.2, 10), 9.0)  # no label is so far
                boxes[scene.token(frame)] = [
                    box(
                        scene.token(frame),
                        translation=[20.0 * i, 5.0 + float(aside[i]), 1.0],
                        detection_score=float(score[i] ** power),
                    )
                    for i in range(10)
                ]
        write_detections(root, detector, wanted, boxes)


def test_the_command_writes_the_profile_with_the_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """calibrated.toml differs from the profile in the curves alone, measured where both detectors are."""
    write_data(tmp_path)
    data = ["--dataset", "nuscenes", "--root", str(tmp_path), "--detections", "made", "--profile", "nuscenes"]
    asked = ["tune", *data, "--estimate-only", "--reference", "known", "--name", "mine"]
    assert run([*asked, "--out", str(tmp_path / "a")]) == 0
    assert "car: score -> score of known: 0." in capsys.readouterr().out
    made, before = optipmb.load_profile(tmp_path / "a" / "calibrated.toml"), optipmb.load_profile("nuscenes")
    curve = made.classes["car"].score_calibration
    assert curve is not None
    assert calibrated(curve, np.array([0.09, 0.25, 0.49])) == pytest.approx([0.3, 0.5, 0.7], abs=0.12)
    assert made.name == "mine"
    assert made.provenance.endswith("detections made, sequences scene-0553, to the scores of known; classes car.")
    document = made.model_dump() | {name: getattr(before, name) for name in ("name", "provenance")}
    document["classes"]["car"]["score_calibration"] = None
    assert optipmb.parse_parameters(document) == before
    estimated = optipmb.load_profile(tmp_path / "a" / "estimated.toml").classes["car"]
    assert estimated.score_calibration == curve

    again = [*data[:-1], str(tmp_path / "a" / "calibrated.toml")]
    rest = ["--estimate-only", "--reference", "known", "--name", "mine", "--out", str(tmp_path / "b"), "--json"]
    assert run(["tune", *again, *rest]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["score_calibration"]["car"]["detector"] == list(curve.detector), "whatever curves there were"
    assert (tmp_path / "a" / "estimate.json").read_bytes() == (tmp_path / "b" / "estimate.json").read_bytes()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--reference", "known"], "--reference: with --estimate-only"),
        (["--reference", "nobody", "--estimate-only"], "detections/nobody.json"),
        (["--reference", "known", "--estimate-only", "--sequences", "scene-0103"], "received none"),
    ],
)
def test_a_reference_that_is_none_is_told_in_one_line(
    options: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is asked for without the estimate, not there, or has none of the sequences."""
    write_data(tmp_path)
    data = ["--dataset", "nuscenes", "--root", str(tmp_path), "--detections", "made", "--profile", "nuscenes"]
    assert run(["tune", *data, *options, "--out", str(tmp_path / "out")]) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert text in error
    assert all("its profile is auto" in note for note in notes)

"""AB3DMOT's protocol: known answers, and the published evaluation's own figures."""

import json
from pathlib import Path

import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, tracks_of, truth_of, write_kitti
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.ab3dmot import (
    Ab3dmotResult,
    evaluate_ab3dmot,
)
from optipmb_tools.evaluation.cases import Case, ab3dmot_rules, prepare
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings

AGREED = json.loads((Path(__file__).with_name("devkit") / "ab3dmot.json").read_text())


def case_of(truth: list[TruthRow], tracks: list[TrackRow], ignored: tuple[int, ...] = ()) -> Case:
    return prepare(truth_of(truth, ignored=ignored), tracks_of(tracks), "Car", ab3dmot_rules())


def result_of(truth: list[TruthRow], tracks: list[TrackRow], ignored: tuple[int, ...] = ()) -> Ab3dmotResult:
    return evaluate_ab3dmot([case_of(truth, tracks, ignored)])


CROWD = parked(8, 20)


def test_no_tracks_score_zero() -> None:
    """Without any track there is no recall point: averages are 0, everything is missed, and nothing fails."""
    figures = result_of(CROWD, []).summary()
    assert [figures[name] for name in ("points", "sAMOTA", "AMOTA", "AMOTP", "MOTA", "TP", "FP")] == [0] * 7
    assert (figures["FN"], figures["ML"]) == (160, 1.0)


def test_without_truth_nothing_is_defined() -> None:
    """Tracks where no truth is are false; averages and MOTA are not defined, and nothing fails."""
    figures = result_of([], followed(CROWD)).summary()
    assert figures["FP"] == 160
    assert figures["sAMOTA"] is figures["AMOTA"] is figures["MOTA"] is None


@pytest.mark.parametrize("seed", AGREED)
def test_figures_are_those_of_the_published_evaluation(seed: str, tmp_path: Path) -> None:
    """On generated benchmarks with all cases of the rules, figures still equal the published code (devkit/)."""
    write_kitti(tmp_path, tmp_path / "results", int(seed))
    recordings = load_recordings("kitti", open_dataset("kitti", tmp_path).sequences(["all"]), tmp_path / "results")
    figures = evaluate_figures("kitti", recordings, ("Car", "Pedestrian", "Cyclist"))
    found = {f"{one.name} {result.limit:g}": result.summary() for one in figures for result in one.ab3dmot}
    assert found.keys() == AGREED[seed].keys()
    for key, values in AGREED[seed].items():
        assert found[key] == pytest.approx(values, abs=1e-9), key

"""AB3DMOT's protocol: known answers, and the published evaluation's own figures."""

import json
from pathlib import Path

import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, shuffled, tracks_of, truth_of, write_kitti
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.ab3dmot import (
    POINTS,
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


def test_the_truth_scores_a_hundred() -> None:
    """Tracks equal to the truth reach every recall point with every average and MOTA at 1 and no error of any kind."""
    figures = result_of(CROWD, followed(CROWD)).summary()
    assert figures["points"] == POINTS
    for name in ("sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "precision", "recall", "MT"):
        assert figures[name] == pytest.approx(1.0)
    assert [figures[name] for name in ("FP", "FN", "IDS", "FRAG", "ML")] == [0, 0, 0, 0, 0]
    assert (figures["GT"], figures["TP"]) == (160, 160)


def test_ids_shuffled_in_every_frame_are_switches() -> None:
    """The same boxes with ids exchanged at random switch nearly always, and the averages fall."""
    good, bad = result_of(CROWD, followed(CROWD)), result_of(CROWD, shuffled(followed(CROWD)))
    assert good.best.switches == 0
    assert bad.best.switches > 0.7 * 8 * 19
    assert bad.best.mota < 0.3
    assert bad.amota < 0.3 < good.amota


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


def test_ignored_truth_counts_neither_way_but_in_true_positives() -> None:
    """Objects that are ignored add no miss and no false track; a match adds to TP, precision and recall."""
    truth = parked(2, 20)
    second = tuple(row for row, (_, one, *_) in enumerate(truth) if one == 1)
    found = result_of(truth, followed(truth), second).best
    assert (found.truth, found.true, found.false, found.missed, found.mota) == (20, 40, 0, 0, 1.0)
    lost = result_of(truth, [row for row in followed(truth) if row[1] == 0], second).best
    assert (lost.truth, lost.true, lost.missed, lost.mota) == (20, 20, 0, 1.0)


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

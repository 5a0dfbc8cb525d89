"""AB3DMOT's protocol: known answers, the published evaluation's own figures, and a naive twin."""

import json
from pathlib import Path

import numpy as np
import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, shuffled, tracks_of, truth_of, write_kitti
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.ab3dmot import (
    POINTS,
    Ab3dmotResult,
    evaluate_ab3dmot,
)
from optipmb_tools.evaluation.cases import Case, ab3dmot_rules, prepare
from optipmb_tools.evaluation.clear import Counts
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings
from scipy.optimize import linear_sum_assignment

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


def naive(case: Case, threshold: float) -> Counts:
    """Count as the published evaluation does, box by box."""
    means = {
        one: round(sum(case.track_score[case.track_id == one]) / sum(case.track_id == one), 12)
        for one in set(case.track_id.tolist())
    }
    overlap = dict(
        zip(zip(case.truth_row.tolist(), case.track_row.tolist(), strict=True), case.similarity, strict=True)
    )
    match: dict[int, int] = {}
    counts = dict.fromkeys(vars(Counts()), 0)
    counts["similarity"] = 0.0
    for frame in sorted({*case.truth_frame.tolist(), *case.track_frame.tolist()}):
        truth = np.flatnonzero(case.truth_frame == frame).tolist()
        tracks = [int(k) for k in np.flatnonzero(case.track_frame == frame) if means[case.track_id[k]] >= threshold]
        cost = np.array([[1.0 - overlap.get((t, k), -1e9) for k in tracks] for t in truth]).reshape(
            len(truth), len(tracks)
        )
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if (truth[row], tracks[column]) in overlap:
                match[truth[row]] = tracks[column]
        used = [match[t] for t in truth if t in match]
        counts["false"] += sum(k not in used and not case.excused[k] for k in tracks)
    counts["truth"] = int((~case.ignored).sum())
    counts["true"] = len(match)
    counts["missed"] = sum(row not in match and not case.ignored[row] for row in range(len(case.truth_frame)))
    counts["similarity"] = sum(overlap[pair] for pair in match.items())
    for one in sorted(set(case.truth_id.tolist())):
        rows = sorted(np.flatnonzero(case.truth_id == one).tolist(), key=lambda row: case.truth_frame[row])
        life = [int(case.track_id[match[row]]) if row in match else -1 for row in rows]
        ignored = [bool(case.ignored[row]) for row in rows]
        if all(ignored):
            continue
        counts["objects"] += 1
        last, tracked = life[0], int(life[0] >= 0)
        for f in range(1, len(life)):
            if ignored[f]:
                last = -1
                continue
            known = last != -1 and life[f] != -1
            counts["switches"] += known and last != life[f] and life[f - 1] != -1
            counts["fragments"] += known and f < len(life) - 1 and life[f - 1] != life[f] and life[f + 1] != -1
            if life[f] != -1:
                tracked, last = tracked + 1, life[f]
        counts["fragments"] += len(life) > 1 and life[-2] != life[-1] != -1 != last and not ignored[-1]
        share = tracked / (len(life) - sum(ignored))
        counts["mostly_tracked"] += share > 0.8
        counts["mostly_lost"] += share < 0.2
    return Counts(**counts)


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

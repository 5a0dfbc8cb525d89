"""AB3DMOT's protocol: known answers, the published evaluation's own figures, and a naive twin."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, shuffled, tracks_of, truth_of, write_kitti
from hypothesis import given, settings
from hypothesis import strategies as st
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

PATIENT = settings(deadline=None, max_examples=60)  # other work on the machine may make any example slow
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


def test_recall_points_that_are_not_reached_count_zero() -> None:
    """Half of the objects, found one by one as the threshold falls: sAMOTA is a half, AMOTA the sum of k / 40 / 40."""
    truth = parked(40, 8)
    tracks = [row for row in followed(truth) if row[1] < 20]
    tracks = [(frame, one, x, y, 1.0 - 0.01 * one) for frame, one, x, y, _ in tracks]
    result = result_of(truth, tracks)
    assert len(result.points) == POINTS // 2
    assert result.samota == pytest.approx(0.5)
    assert result.amota == pytest.approx(sum(k / 40 for k in range(1, 21)) / 40)
    assert result.amotp == pytest.approx(0.5)


def test_tracks_are_ranked_by_the_mean_of_their_scores() -> None:
    """A false track with one high score and low ones goes before a true one with middling scores."""
    truth = parked(4, 20)
    false = [(frame, 9, 500.0, 0.0, 1.0 if frame == 0 else 0.1) for frame in range(20)]
    result = result_of(truth, [*followed(truth, 0.5), *false])
    assert result.threshold == pytest.approx(0.5)
    assert (result.best.false, result.best.mota) == (0, 1.0)


def test_ignored_truth_counts_neither_way_but_in_true_positives() -> None:
    """Objects that are ignored add no miss and no false track; a match adds to TP, precision and recall."""
    truth = parked(2, 20)
    second = tuple(row for row, (_, one, *_) in enumerate(truth) if one == 1)
    found = result_of(truth, followed(truth), second).best
    assert (found.truth, found.true, found.false, found.missed, found.mota) == (20, 40, 0, 0, 1.0)
    lost = result_of(truth, [row for row in followed(truth) if row[1] == 0], second).best
    assert (lost.truth, lost.true, lost.missed, lost.mota) == (20, 20, 0, 1.0)


@pytest.mark.parametrize(
    ("track", "switches", "fragments"),
    [
        ("aaaaaa", 0, 0),
        ("aaabbb", 1, 1),
        ("aa.aaa", 0, 1),
        ("aa.bbb", 0, 1),
        ("aaaaab", 1, 1),
        ("....aa", 0, 0),
        (".....a", 0, 1),
        ("a.a.a.", 0, 0),
        ("ababab", 5, 5),
    ],
)
def test_switches_and_breaks(track: str, switches: int, fragments: int) -> None:
    """Changes from frame to frame are switches; a break counts when two frames are followed after it, or the last."""
    truth = parked(1, len(track))
    tracks = [(frame, ord(one), 0.0, 0.0, 0.9) for frame, one in enumerate(track) if one != "."]
    (point, *_) = evaluate_ab3dmot([case_of(truth, tracks)] * 20).points  # many objects, so that points are reached
    assert (point.counts.switches, point.counts.fragments) == (20 * switches, 20 * fragments)


def test_stricter_overlaps_find_less() -> None:
    """Boxes half a metre off match at 0.25 and 0.7, boxes a metre off at 0.25 and 0.5."""
    for dx, limits in ((0.5, (0.25, 0.5, 0.7)), (1.0, (0.25, 0.5))):
        case = case_of(CROWD, followed(CROWD, dx=dx))
        found = tuple(limit for limit in (0.25, 0.5, 0.7) if evaluate_ab3dmot([case], limit).best.true == 160)
        assert found == limits
        assert evaluate_ab3dmot([case]).amotp == pytest.approx((4.0 - dx) / (4.0 + dx))


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


@PATIENT
@given(st.integers(0, 2**32 - 1))
def test_counts_are_those_of_a_naive_twin(seed: int) -> None:
    """At every threshold the counts equal a count frame by frame and object by object."""
    chance = np.random.default_rng(seed)
    frames = range(8)
    truth = [(f, one, float(chance.uniform(0, 12)), 0.0) for f in frames for one in range(4) if chance.random() < 0.8]
    tracks = [
        (f, one, float(chance.uniform(0, 12)), 0.0, float(chance.random()))
        for f in frames
        for one in range(5)
        if chance.random() < 0.8
    ]
    ignored = tuple(row for row in range(len(truth)) if chance.random() < 0.3)
    case = case_of(truth, tracks, ignored)
    result = evaluate_ab3dmot([case])
    for point in result.points:
        twin = naive(case, point.threshold)
        assert vars(point.counts) == pytest.approx(vars(twin))
        errors = twin.false + twin.missed + twin.switches
        if twin.truth:
            scaled = 1.0 - (errors - (1.0 - point.recall) * twin.truth) / (point.recall * twin.truth)
            assert point.smota == pytest.approx(min(1.0, max(0.0, scaled)))
    if math.isinf(result.threshold):
        assert vars(result.best) == pytest.approx(vars(naive(case, -math.inf)))
    else:
        assert result.best.mota == max(point.counts.mota for point in result.points) > 0.0


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

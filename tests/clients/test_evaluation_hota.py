"""HOTA of centres and of image boxes: known answers, and TrackEval as the twin."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, tracks_of, truth_of, write_kitti
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.cases import Case, Rules, counted, hota_2d_rules, prepare, similarity
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings
from optipmb_tools.evaluation.hota import NOTHING, HotaResult, evaluate_hota

PATIENT = settings(deadline=None, max_examples=30)  # other work on the machine may make any example slow
NEAR = Rules("distance", 2.0)


def hota_of(truth: list[TruthRow], tracks: list[TrackRow], ignored: tuple[int, ...] = ()) -> HotaResult:
    return evaluate_hota([prepare(truth_of(truth, ignored=ignored), tracks_of(tracks), "Car", NEAR)], NEAR)


CROWD = parked(8, 20)


def test_no_tracks_score_zero_and_nothing_at_all_is_undefined() -> None:
    """Empty results have HOTA 0; without truth and without tracks nothing is defined; neither fails."""
    assert hota_of(CROWD, []).summary() == {"HOTA": 0.0, "DetA": 0.0, "AssA": 0.0, "LocA": None}
    assert hota_of([], followed(CROWD)).hota == 0.0
    assert set(hota_of([], []).summary().values()) == {None}


def test_ignored_truth_takes_its_tracks_with_it() -> None:
    """Tracks on ignored objects are neither right nor wrong; those beyond a similarity of a half are false."""
    truth = parked(2, 10)
    second = tuple(row for row, (_, one, *_) in enumerate(truth) if one == 1)
    assert hota_of(truth, followed(truth), second).hota == 1.0
    assert hota_of(truth, [row for row in followed(truth) if row[1] == 0], second).hota == 1.0
    away = [(f, i, x + 1.1 * i, y, s) for f, i, x, y, s in followed(truth)]
    assert hota_of(truth, away, second).deta == 0.5


def image_case(seed: int) -> Case:
    """Prepare image boxes at random places, many of which overlap."""
    chance = np.random.default_rng(seed)

    def boxes(count: int) -> np.ndarray:
        corner = chance.uniform(0, 60, (count, 2))
        return np.hstack([corner, corner + chance.uniform(30, 60, (count, 2))])

    truth = truth_of([(f, i, 0.0, 0.0) for f in range(12) for i in range(4) if chance.random() < 0.8])
    tracks = tracks_of([(f, i, 0.0, 0.0, 0.9) for f in range(12) for i in range(5) if chance.random() < 0.8])
    ignored = np.asarray(chance.random(len(truth)) < 0.2)
    truth = replace(truth, box2d=boxes(len(truth)), ignored=ignored)
    return prepare(truth, replace(tracks, box2d=boxes(len(tracks))), "Car", hota_2d_rules())


@PATIENT
@given(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=3))
def test_figures_are_those_of_trackeval(seeds: list[int]) -> None:
    """On boxes at random places, over several sequences, our figures equal TrackEval's metric."""
    metric = pytest.importorskip("trackeval").metrics.HOTA()
    cases = [image_case(seed) for seed in seeds]
    ours, theirs = evaluate_hota(cases, hota_2d_rules()), NOTHING
    for case in cases:
        found = metric.eval_sequence(sequence_of(counted(case, hota_2d_rules())))
        true = found["HOTA_TP"]
        weighted = found["AssA"] * true, found["LocA"] * true
        theirs += HotaResult(true, found["HOTA_FN"], found["HOTA_FP"], *weighted)
    for name, value in vars(ours).items():
        assert value == pytest.approx(getattr(theirs, name)), name
    assert ours.summary() == pytest.approx(theirs.summary())


@pytest.mark.parametrize("seed", range(3))
def test_the_hota_of_image_boxes_is_the_benchmarks(seed: int, tmp_path: Path) -> None:
    """On generated benchmarks cars and pedestrians have the figures of TrackEval's own reading of the same files."""
    trackeval = pytest.importorskip("trackeval")
    root, results = write_kitti(tmp_path, tmp_path / "results", seed), tmp_path / "results"
    theirs = official(trackeval, tmp_path, root, results)
    recordings = load_recordings("kitti", open_dataset("kitti", root).sequences(["all"]), results)
    for one in evaluate_figures("kitti", recordings, ("Car", "Pedestrian")):
        ours = one.everything.hota_2d
        assert ours is not None
        found = theirs[one.name.lower()]["HOTA"]
        assert ours.hota == pytest.approx(found["HOTA"].mean(), abs=1e-9)
        assert ours.deta == pytest.approx(found["DetA"].mean(), abs=1e-9)
        assert ours.assa == pytest.approx(found["AssA"].mean(), abs=1e-9)
        assert 0.1 < ours.hota < 0.9


def official(trackeval: ModuleType, folder: Path, root: Path, results: Path) -> dict[str, Any]:
    """Evaluate a folder of results with TrackEval alone; return its figures over all sequences by class."""
    truth, tracks = folder / "gt", folder / "trackers" / "ours" / "data"
    truth.mkdir()
    tracks.parent.mkdir(parents=True)
    (truth / "label_02").symlink_to(root / "training" / "label_02")
    tracks.symlink_to(results)
    poses = sorted((root / "training" / "poses").glob("*.txt"))
    lines = [f"{path.stem} empty 000000 {len(path.read_text().splitlines()):06d}\n" for path in poses]
    (truth / "evaluate_tracking.seqmap.training").write_text("".join(lines))
    quiet = {"PRINT_CONFIG": False}
    places = {"GT_FOLDER": str(truth), "TRACKERS_FOLDER": str(folder / "trackers")}
    dataset = trackeval.datasets.Kitti2DBox({**quiet, **places})
    names = (
        "PRINT_RESULTS",
        "TIME_PROGRESS",
        "OUTPUT_SUMMARY",
        "OUTPUT_DETAILED",
        "PLOT_CURVES",
        "DISPLAY_LESS_PROGRESS",
    )
    evaluator = trackeval.Evaluator(
        {**quiet, **dict.fromkeys(names, False), "BREAK_ON_ERROR": True, "LOG_ON_ERROR": None}
    )
    found, _ = evaluator.evaluate([dataset], [trackeval.metrics.HOTA()])
    return dict(found["Kitti2DBox"]["ours"]["COMBINED_SEQ"])


def sequence_of(case: Case) -> dict[str, Any]:
    """Return one sequence as TrackEval's metrics take it."""
    alike = similarity(case, hota_2d_rules())
    _, object_of = np.unique(case.truth_id, return_inverse=True)
    _, track_of = np.unique(case.track_id, return_inverse=True)
    frames = np.unique(np.concatenate([case.truth_frame, case.track_frame]))
    objects, tracks, tables = [], [], []
    for frame in frames:
        begin, end = np.searchsorted(case.truth_frame, [frame, frame + 1])
        start, stop = np.searchsorted(case.track_frame, [frame, frame + 1])
        table = np.zeros((end - begin, stop - start))
        pairs = slice(*np.searchsorted(case.truth_row, [begin, end]))  # pairs stand in the order of their truth rows
        table[case.truth_row[pairs] - begin, case.track_row[pairs] - start] = alike[pairs]
        objects.append(object_of[begin:end])
        tracks.append(track_of[start:stop])
        tables.append(table)
    return {
        "num_timesteps": len(frames),
        "num_gt_ids": len(np.unique(object_of)),
        "num_tracker_ids": len(np.unique(track_of)),
        "num_gt_dets": len(object_of),
        "num_tracker_dets": len(track_of),
        "gt_ids": objects,
        "tracker_ids": tracks,
        "similarity_scores": tables,
    }

"""IDF1 and errors of velocities: known answers, and TrackEval as the twin."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_cases import followed, parked, tracks_of, truth_of
from optipmb_tools.evaluation.cases import Case, Rules, counted, prepare, similarity
from optipmb_tools.evaluation.identity import IdentityResult, evaluate_identity, velocity_errors

NEAR = Rules("distance", 2.0)
CROWD = parked(6, 20)


def crowd(seed: int) -> Case:
    """Prepare tracks that miss, stray and change their ids among objects that stand close together."""
    chance = np.random.default_rng(seed)
    rows = [
        (f, int(chance.integers(12)) if chance.random() < 0.1 else 20 + i, x + float(chance.normal(0, 1.0)), y, s)
        for f, i, x, y, s in followed(CROWD)
        if chance.random() < 0.8
    ]
    once = {(f, i): (f, i, x, y, s) for f, i, x, y, s in rows}
    return prepare(truth_of(CROWD), tracks_of(sorted(once.values())), "Car", NEAR)


@pytest.mark.parametrize("seed", range(4))
def test_idf1_is_that_of_trackeval(seed: int) -> None:
    """Over objects that may be several tracks, and tracks that may be several objects."""
    case = counted(crowd(seed), NEAR)
    ids = [np.unique(one, return_inverse=True) for one in (case.truth_id, case.track_id)]
    frames = range(20)
    alike = []
    for frame in frames:
        rows, columns = (np.flatnonzero(one == frame) for one in (case.truth_frame, case.track_frame))
        table = np.zeros((len(rows), len(columns)))
        here = case.pair_frame == frame
        table[np.searchsorted(rows, case.truth_row[here]), np.searchsorted(columns, case.track_row[here])] = (
            0.5 + 0.5 * (similarity(case, NEAR)[here])
        )
        alike.append(table)
    metric = pytest.importorskip("trackeval").metrics.Identity({"PRINT_CONFIG": False})
    theirs = metric.eval_sequence(
        {
            "num_gt_dets": len(case.truth_frame),
            "num_tracker_dets": len(case.track_frame),
            "num_gt_ids": len(ids[0][0]),
            "num_tracker_ids": len(ids[1][0]),
            "gt_ids": [ids[0][1][case.truth_frame == frame] for frame in frames],
            "tracker_ids": [ids[1][1][case.track_frame == frame] for frame in frames],
            "similarity_scores": alike,
        }
    )
    ours = evaluate_identity([crowd(seed)], NEAR)
    assert ours.true == theirs["IDTP"]
    assert ours.summary()["IDF1"] == pytest.approx(theirs["IDF1"])
    assert evaluate_identity([crowd(seed)] * 2, NEAR).summary() == ours.summary()


def test_nothing_has_no_idf1() -> None:
    """Without truth and tracks the figure is not defined; without tracks it is 0."""
    assert IdentityResult().summary() == {"IDF1": None}
    none = prepare(truth_of(CROWD), tracks_of([]), "Car", NEAR)
    assert evaluate_identity([none], NEAR).summary() == {"IDF1": 0.0}


def test_velocities_are_compared_with_the_way_of_the_objects() -> None:
    """By the stamps around a frame, where the truth has no velocity; tracks without velocities have no errors."""
    truth = truth_of([(f, 0, 2.0 * f, 0.0) for f in range(5)])
    tracks = tracks_of([(f, 7, 2.0 * f, 0.0, 0.9) for f in range(5)])
    stamps = np.array([0, 1, 2, 4, 5], np.int64) * 10**9
    assert not len(velocity_errors(stamps, truth, tracks, "Car", NEAR))
    still = replace(tracks, velocity=np.zeros((5, 2)))
    np.testing.assert_allclose(velocity_errors(stamps, truth, still, "Car", NEAR), [2.0, 4.0 / 3.0, 4.0 / 3.0])
    known = replace(truth, velocity=np.full((5, 2), [0.0, 1.0]))
    np.testing.assert_allclose(velocity_errors(stamps, known, still, "Car", NEAR), np.ones(5))

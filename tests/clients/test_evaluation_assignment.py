"""Who belongs to whom: shortcuts change nothing."""

import numpy as np
from evaluation_cases import tracks_of, truth_of
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_tools.evaluation.cases import (
    Case,
    Rules,
    assign_frames,
    best_pairs,
    by_frame,
    match_frames,
    most_pairs,
    prepare,
    uncontested,
)
from scipy.optimize import linear_sum_assignment

PATIENT = settings(deadline=None, max_examples=100)  # other work on the machine may make any example slow


def made(seed: int) -> Case:
    """Prepare a crowd in which most pairs are contested; objects of the truth come and go."""
    chance = np.random.default_rng(seed)
    wide = float(chance.choice([3.0, 8.0, 20.0]))
    truth = [(f, i, float(chance.uniform(0, wide)), 0.0) for f in range(6) for i in range(4) if chance.random() < 0.8]
    tracks = [
        (f, i, float(chance.uniform(0, wide)), 0.0, 0.9) for f in range(6) for i in range(4) if chance.random() < 0.8
    ]
    return prepare(truth_of(truth), tracks_of(tracks), "Car", Rules("distance", 2.0))


@PATIENT
@given(st.integers(0, 2**32 - 1))
def test_frames_at_once_are_as_frames_one_by_one(seed: int) -> None:
    """Taking uncontested pairs without solving gives what solving every frame as a whole gives."""
    case = made(seed)
    frame = case.truth_frame[case.truth_row]
    for solver, value in ((most_pairs, case.cost), (best_pairs, 2.5 - case.cost)):
        whole = [
            pairs[solver(case.truth_row[pairs], case.track_row[pairs], value[pairs])]
            for pairs in by_frame(frame, np.arange(len(frame)))
        ]
        taken = assign_frames(frame, case.truth_row, case.track_row, value, solver)
        assert taken.tolist() == sorted(int(pair) for pairs in whole for pair in pairs)
        assert uncontested(case.truth_row[taken], case.track_row[taken]).all()


def naive(case: Case) -> dict[int, int]:
    """Match frame after frame, remembering who was with whom."""
    last: dict[int, tuple[int, int]] = {}
    match: dict[int, int] = {}
    pairs = list(zip(case.truth_row.tolist(), case.track_row.tolist(), case.cost.tolist(), strict=True))
    for frame in range(6):
        here = [pair for pair in pairs if case.truth_frame[pair[0]] == frame]
        claims: dict[int, tuple[int, int]] = {}
        for row, column, _ in here:
            since, track = last.get(int(case.truth_id[row]), (-1, -1))
            if track == case.track_id[column] and since > claims.get(column, (-1, -1))[0]:
                claims[column] = since, row
        found = {row: column for column, (_, row) in claims.items()}
        left = [(r, c, v) for r, c, v in here if r not in found and c not in claims]
        rows, columns = sorted({r for r, _, _ in left}), sorted({c for _, c, _ in left})
        table = np.full((len(rows), len(columns)), 1e6)
        for row, column, cost in left:
            table[rows.index(row), columns.index(column)] = cost
        for i, j in zip(*linear_sum_assignment(table), strict=True):
            if table[i, j] < 1e6:
                found[rows[i]] = columns[j]
        match |= found
        last |= {int(case.truth_id[row]): (frame, int(case.track_id[column])) for row, column in found.items()}
    return match


@PATIENT
@given(st.integers(0, 2**32 - 1))
def test_objects_stay_with_their_tracks(seed: int) -> None:
    """With continuity, matches equal a loop over frames that remembers pairs; no track is used twice."""
    case = made(seed)
    match = match_frames(case, continuity="latest")
    hit = np.flatnonzero(match >= 0)
    assert dict(zip(hit.tolist(), match[hit].tolist(), strict=True)) == naive(case)
    assert len(set(match[hit].tolist())) == len(hit)

"""GOSPA and OSPA: known answers, and all assignments tried out."""

import itertools

import numpy as np
import pytest
from evaluation_cases import TrackRow, TruthRow, followed, parked, tracks_of, truth_of
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_tools.evaluation.cases import Rules, prepare
from optipmb_tools.evaluation.gospa import GospaResult, evaluate_gospa

PATIENT = settings(deadline=None, max_examples=30)  # other work on the machine may make any example slow


def gospa_of(
    truth: list[TruthRow], tracks: list[TrackRow], frames: int = 1, cutoff: float = 2.0, order: float = 2.0
) -> GospaResult:
    rules = Rules("distance", cutoff)
    return evaluate_gospa([(prepare(truth_of(truth), tracks_of(tracks), "Car", rules), frames)], rules, order)


ONE = parked(1, 1)


@pytest.mark.parametrize(
    ("truth", "tracks", "expected"),
    [
        (ONE, followed(ONE), [0.0, 0.0, 0.0, 0.0, 0.0]),
        (ONE, followed(ONE, dx=0.6), [0.6, 0.6, 0.0, 0.0, 0.6]),
        (ONE, [], [2**0.5, 0.0, 2**0.5, 0.0, 2.0]),
        ([], followed(ONE), [2**0.5, 0.0, 0.0, 2**0.5, 2.0]),
        (ONE, followed(ONE, dx=3.0), [2.0, 0.0, 2**0.5, 2**0.5, 2.0]),
        ([], [], [0.0, 0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_single_frames(truth: list[TruthRow], tracks: list[TrackRow], expected: list[float]) -> None:
    """A pair costs its distance, a missed or false object c / 2^(1/p) in GOSPA and c in OSPA, nothing costs nothing."""
    names = ("GOSPA", "localisation", "missed", "false", "OSPA")
    assert gospa_of(truth, tracks).summary() == pytest.approx(dict(zip(names, expected, strict=True)))


def test_figures_are_means_over_all_frames() -> None:
    """An object missed in one frame of four costs a quarter of the cost in one; empty frames count."""
    found = gospa_of(parked(1, 2), followed(parked(1, 1)), frames=4).summary()
    assert found["GOSPA"] == pytest.approx(2**0.5 / 4)
    assert found["OSPA"] == pytest.approx(2.0 / 4)
    assert set(gospa_of([], [], frames=0).summary().values()) == {None}


def test_ids_do_not_matter() -> None:
    """Other ids in every frame leave all figures as they are."""
    truth = parked(3, 5)
    tracks = [(f, 100 * f + i, x + 0.3, y, s) for f, i, x, y, s in followed(truth)]
    assert gospa_of(truth, tracks, 5) == gospa_of(truth, followed(truth, dx=0.3), 5)


POINTS = st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), max_size=4)


def naive(
    truth: list[tuple[float, float]], tracks: list[tuple[float, float]], c: float, p: float
) -> tuple[float, float]:
    """Try all assignments out; return GOSPA and OSPA."""
    few, many = sorted((truth, tracks), key=len)
    gospa, ospa = [], []
    for chosen in itertools.permutations(many, len(few)):
        apart = [float(np.hypot(a[0] - b[0], a[1] - b[1])) for a, b in zip(few, chosen, strict=True)]
        near = [d for d in apart if d < c]
        gospa.append(sum(d**p for d in near) + c**p / 2 * (len(few) + len(many) - 2 * len(near)))
        ospa.append((sum(min(d, c) ** p for d in apart) + c**p * (len(many) - len(few))) / max(len(many), 1))
    return min(gospa) ** (1 / p), min(ospa) ** (1 / p)


@PATIENT
@given(POINTS, POINTS, st.floats(0.5, 4.0), st.sampled_from([1.0, 2.0, 3.0]))
def test_no_assignment_is_better(
    truth: list[tuple[float, float]], tracks: list[tuple[float, float]], cutoff: float, order: float
) -> None:
    """Both figures equal the least over all assignments, and GOSPA is made of its parts."""
    rows = [(0, i, x, y) for i, (x, y) in enumerate(truth)]
    found = gospa_of(rows, [(0, i, x, y, 0.9) for i, (x, y) in enumerate(tracks)], 1, cutoff, order)
    assert (found.gospa, found.ospa) == pytest.approx(naive(truth, tracks, cutoff, order), abs=1e-6)
    parts = sum(part**order for part in (found.localisation, found.missed, found.false))
    assert found.gospa**order == pytest.approx(parts, abs=1e-6)

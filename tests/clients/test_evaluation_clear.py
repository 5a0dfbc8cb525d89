"""CLEAR MOT on hand-made cases with known answers."""

from collections.abc import Iterable
from dataclasses import replace

import evaluation_cases
import numpy as np
import pytest
from evaluation_cases import evaluate_clear
from optipmb_tools.datasets import Regions, Truth
from optipmb_tools.evaluation import Rules, combine
from optipmb_tools.evaluation.cases import prepare
from optipmb_tools.evaluation.clear import ClearResult, Switch, sweep
from optipmb_tools.results import ResultTable

Row = tuple[int, int, float]
"""Frame, id and place along x."""


def truth_of(rows: Iterable[Row], *, ignored: Iterable[Row] = ()) -> Truth:
    """Give truth cars along x; rows in `ignored` are marked so."""
    table, hidden = sorted(rows), set(ignored)
    places = [place for place, row in enumerate(table) if row in hidden]
    return evaluation_cases.truth_of([(*row, 0.0) for row in table], ignored=places)


def tracks_of(rows: Iterable[Row], scores: dict[int, float] | None = None) -> ResultTable:
    return evaluation_cases.tracks_of([(*row, 0.0, (scores or {}).get(row[1], 1.0)) for row in sorted(rows)])


def figures(result: ClearResult) -> tuple[int, int, int, int, int]:
    return result.truth, result.true, result.false, result.missed, result.switches


TWO = [(f, i, 10.0 * i + f) for f in range(10) for i in (1, 2)]
"""Two cars side by side for ten frames, 10 m apart."""


def test_truth_as_tracks_is_perfect() -> None:
    """MOTA, MOTP, precision and recall are 1, everybody is mostly tracked, and there is nothing to look at."""
    result = evaluate_clear(truth_of(TWO), tracks_of(TWO), "Car")
    assert figures(result) == (20, 20, 0, 0, 0)
    assert (result.mota, result.precision, result.recall) == (1.0, 1.0, 1.0)
    assert result.motp == pytest.approx(1.0)
    assert (result.mostly_tracked, result.mostly_lost, result.fragments, result.objects) == (2, 0, 0, 2)
    assert result.changes == result.misses == ()


ONE = [row for row in TWO if row[1] == 1]
STILL = [(f, 1, 0.0) for f in range(3)]
NEARER = [*((f, 1, 0.5) for f in range(3)), (1, 2, 0.1)]
"""Tracks of `STILL`, to which another one comes nearer for one frame."""
HIDDEN = truth_of(TWO, ignored=[row for row in TWO if row[1] == 2])
VAN = replace(truth_of(TWO), label=np.where(truth_of(TWO).id == 2, 1, 0))


@pytest.mark.parametrize(
    ("truth", "tracks", "rules", "expected"),
    [
        pytest.param(truth_of(TWO), [], Rules(), (20, 0, 0, 20, 0), id="no tracks miss everything"),
        pytest.param(truth_of([]), TWO, Rules(), (0, 0, 20, 0, 0), id="without truth all tracks are false"),
        pytest.param(truth_of([]), [], Rules(), (0, 0, 0, 0, 0), id="nothing at all"),
        pytest.param(truth_of(STILL), NEARER, Rules(continuity=True), (3, 3, 1, 0, 0), id="continuity keeps a match"),
        pytest.param(truth_of(STILL), NEARER, Rules(continuity=False), (3, 3, 1, 0, 2), id="the nearest matches"),
        pytest.param(HIDDEN, TWO, Rules(), (10, 10, 0, 0, 0), id="a track on a hidden object is not false"),
        pytest.param(HIDDEN, ONE, Rules(), (10, 10, 0, 0, 0), id="a hidden object is not missed"),
        pytest.param(VAN, TWO, Rules(neighbours={"Car": ("Van",)}), (10, 10, 0, 0, 0), id="a track on a neighbour"),
        pytest.param(VAN, TWO, Rules(), (10, 10, 10, 0, 0), id="a track on another class"),
    ],
)
def test_known_counts(truth: Truth, tracks: list[Row], rules: Rules, expected: tuple[int, ...]) -> None:
    """GT, TP, FP, FN and IDS of small cases; a figure that is not defined is None."""
    result = evaluate_clear(truth, tracks_of(tracks), "Car", rules)
    assert figures(result) == expected
    shown = result.summary()
    mota = None if not expected[0] else pytest.approx(1.0 - sum(expected[2:]) / expected[0])
    assert shown["MOTA"] == mota
    assert (shown["precision"] is None) == (not tracks)
    assert (shown["MOTP"] is None) == (expected[1] == 0)
    assert len(result.misses) == expected[3]


def test_no_case_at_all_does_no_harm() -> None:
    """Without any case the sweep has a result without objects."""
    assert sweep([], Rules()).results[0].truth == 0


def test_ids_shuffled_in_every_frame_are_all_switches() -> None:
    """Two objects whose ids change places in each of ten frames: 18 switches, named with frame and ids."""
    swapped = [(f, 3 - i if f % 2 else i, x) for f, i, x in TWO]
    result = evaluate_clear(truth_of(TWO), tracks_of(swapped), "Car", sequence="0001")
    assert figures(result) == (20, 20, 0, 0, 18)
    assert result.mota == pytest.approx(1.0 - 18 / 20)
    assert result.changes[:2] == (Switch("0001", 1, 1, 1, 2), Switch("0001", 1, 2, 2, 1))


def test_one_id_change_is_one_switch_at_its_frame() -> None:
    """Car 2 is followed by track 2 until frame 5 and by track 9 from frame 6 on."""
    tracks = [(f, 9 if i == 2 and f > 5 else i, x) for f, i, x in TWO]
    result = evaluate_clear(truth_of(TWO), tracks_of(tracks), "Car")
    assert result.changes == (Switch("", 6, 2, 2, 9),)


def test_a_break_is_a_fragment_and_with_memory_a_change_over_it_counts() -> None:
    """Lost for three frames and found again under another id: a switch with memory, none without it."""
    tracks = [(f, 9 if f > 5 else 1, x) for f, i, x in TWO if i == 1 and f not in (3, 4, 5)]
    truth = truth_of(row for row in TWO if row[1] == 1)
    with_memory = evaluate_clear(truth, tracks_of(tracks), "Car", Rules(memory=True))
    without = evaluate_clear(truth, tracks_of(tracks), "Car", Rules(memory=False))
    assert figures(with_memory) == (10, 7, 0, 3, 1)
    assert figures(without) == (10, 7, 0, 3, 0)
    assert with_memory.fragments == without.fragments == 1
    assert [miss.frame for miss in with_memory.misses] == [3, 4, 5]
    assert with_memory.mostly_tracked == 0


def test_as_many_pairs_as_possible_match() -> None:
    """One track is near both objects, the other near one: both match, though one pair alone would be nearer."""
    truth = truth_of([(0, 1, 0.0), (0, 2, 1.5)])
    tracks = tracks_of([(0, 1, 1.4), (0, 2, 3.0)])
    result = evaluate_clear(truth, tracks, "Car", Rules(measure="distance", limit=2.0))
    assert figures(result) == (2, 2, 0, 0, 0)
    assert result.motp == pytest.approx((1.4 + 1.5) / 2)


def test_the_limit_decides_about_a_match() -> None:
    """Boxes of 4 m shifted by 2 m overlap by a third; centres 2 m apart match within 2 m."""
    truth, tracks = truth_of([(0, 1, 0.0)]), tracks_of([(0, 1, 2.0)])
    hits = [
        evaluate_clear(truth, tracks, "Car", rules).true
        for rules in (
            Rules(limit=0.33),
            Rules(limit=0.34),
            Rules(measure="distance", limit=2.0),
            Rules(measure="distance", limit=1.99),
        )
    ]
    assert hits == [1, 0, 1, 0]


def test_low_image_boxes_and_unannotated_regions_excuse_unmatched_tracks() -> None:
    """A track of 25 pixels is excused, one of 26 is not; half in a region is not enough, a little more is."""
    tracks = tracks_of([(0, i, 100.0 * i) for i in range(4)])
    tracks = replace(
        tracks,
        box2d=np.array([[0, 0, 50, 25], [0, 0, 50, 26], [0, 100, 50, 200], [1, 100, 51, 200]], dtype=np.float64),
    )
    truth = replace(truth_of([]), regions=Regions(np.array([0]), np.array([[25.5, 90.0, 99.0, 300.0]])))
    assert evaluate_clear(truth, tracks, "Car", Rules()).false == 4
    assert evaluate_clear(truth, tracks, "Car", Rules(min_height=25.0)).false == 3
    assert evaluate_clear(truth, tracks, "Car", Rules(min_height=25.0, regions=True)).false == 2


def test_sequences_add_up() -> None:
    """Together two sequences have the sum of the counts and the figures of the sums."""
    first = evaluate_clear(truth_of(TWO), tracks_of(TWO), "Car", sequence="a")
    second = evaluate_clear(truth_of(TWO), tracks_of([]), "Car", sequence="b")
    both = combine([first, second])
    assert figures(both) == (40, 20, 0, 20, 0)
    assert both.mota == 0.5
    assert {miss.sequence for miss in both.misses} == {"b"}


def test_the_best_threshold_leaves_the_false_tracks_out() -> None:
    """A false track of low score and true ones of high score: the best threshold lies between them."""
    rows = [*TWO, *((f, 7, 500.0) for f in range(10))]
    case = prepare(truth_of(TWO), tracks_of(rows, {7: 0.2, 1: 0.8, 2: 0.9}), "Car", Rules())
    found = sweep([case], Rules())
    assert found.thresholds[0] == pytest.approx(0.2)
    assert found.results[0].mota == 0.5
    assert found.results[found.best].mota == 1.0
    assert 0.2 < found.thresholds[found.best] <= 0.8

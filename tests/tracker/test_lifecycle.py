"""How objects are born, kept, extracted and forgotten: one rule of the paper, or of ours, at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scenes import boxes, random_parameters, steps

import optipmb
from optipmb.model.parameters import parse_parameters

SIMPLE = {
    "score_filter": 0.1, "nms_iou": 0.1, "survival": 0.99, "gate": 4.0, "detection": 0.9, "expected_points": 10.0,
    "detection_floor": 0.5, "birth_score": 0.5, "adaptive_birth_rate": 2.0, "undetected_birth_rate": 1.0,
    "clutter_rate": 0.5, "area": 5000.0, "poisson_steps": 2, "extract_new": 0.6, "extract_known": 0.9,
    "extract_misses": 3, "max_misses": 6, "min_existence": 1e-3, "birth_heading_speed": 0.0,
    "heading_sign": None, "reported_noise": None,
}  # fmt: skip


def car(**changes: Any) -> optipmb.Parameters:
    """A profile with one class, at 10 Hz."""
    document = random_parameters(0, ("Car",))
    document["classes"]["Car"] |= SIMPLE | changes
    return parse_parameters(document)


def test_a_high_score_starts_a_track_at_once() -> None:
    """HABM, high score: r = 1, id 1, extracted in the first frame, confidence (1 - 1/e) z_s."""
    result = steps(car(), [boxes(car(), 0, (1, 2), score=0.5)])[0]
    np.testing.assert_array_equal(result.density.bernoulli.existence, [1.0])
    np.testing.assert_array_equal(result.tracks.id, [1])
    np.testing.assert_array_equal(result.tracks.detection, [0])
    np.testing.assert_allclose(result.tracks.score, [0.5 * (1 - math.exp(-1))])
    np.testing.assert_allclose(result.tracks.center, [[1, 2, 0]])
    assert len(result.density.poisson.weight) == 0


def test_a_low_score_announces_and_the_second_one_starts_the_track() -> None:
    """HABM, low score: a Poisson component first; detected again, a Bernoulli of r = e / (e + lambda_c)."""
    parameters = car()
    first, second = steps(parameters, [boxes(parameters, seconds, (1, 2), score=0.3) for seconds in (0, 0.1)])
    assert len(first.density.bernoulli.id) == len(first.tracks.id) == 0
    np.testing.assert_array_equal(first.density.poisson.weight, [2.0])
    assert len(second.density.poisson.weight) == 0  # RPP: the marked component is used up
    np.testing.assert_array_equal(second.density.bernoulli.id, [1])
    assert 0.9 < second.density.bernoulli.existence[0] < 1.0


def test_a_poisson_component_lives_for_its_steps() -> None:
    """RPP: an undetected component goes after eta_step periods; its weight falls by p_s (1 - p_d) per frame."""
    parameters = car()
    frames = [boxes(parameters, 0, (0, 0), score=0.3), *[boxes(parameters, 0.1 * k) for k in (1, 2, 3)]]
    weights = [result.density.poisson.weight.tolist() for result in steps(parameters, frames)]
    assert weights == [[2.0], [pytest.approx(2 * 0.099)], [pytest.approx(2 * 0.099**2)], []]


@pytest.mark.parametrize("silent", [False, True])
def test_a_certain_object_is_removed_after_its_misses(*, silent: bool) -> None:
    """With p_s = 1 r stays 1; six missed periods are kept, the seventh removes, with frames or without."""
    parameters = car(survival=1.0)
    seconds = [0.6, 0.7] if not silent else [0.7]
    first = [] if silent else [boxes(parameters, 0.1 * k) for k in range(1, 6)]
    results = steps(parameters, [boxes(parameters, 0, (0, 0)), *first, *[boxes(parameters, s) for s in seconds]])
    if not silent:
        np.testing.assert_array_equal(results[-2].density.bernoulli.id, [1])
        assert results[-2].tracks.id.size == 0  # no longer extracted, still there
    assert results[-1].density.bernoulli.id.size == 0


@pytest.mark.parametrize("periods", [1, 3, 6, 7])
@pytest.mark.parametrize("silent", [False, True])
def test_an_object_that_returns_in_time_keeps_its_id(*, silent: bool, periods: int) -> None:
    """Missed for up to max_misses periods, the object is found again under its id in the period after."""
    parameters = car(survival=1.0)
    between = [] if silent else [boxes(parameters, 0.1 * k) for k in range(1, periods)]
    results = steps(parameters, [boxes(parameters, 0, (0, 0)), *between, boxes(parameters, 0.1 * periods, (0, 0))])
    np.testing.assert_array_equal(results[-1].tracks.id, [1])
    np.testing.assert_array_equal(results[-1].tracks.detection, [0])
    np.testing.assert_array_equal(results[-1].density.bernoulli.seen_ns, [results[-1].density.stamp_ns])


def test_two_thresholds_extract_early_and_drop_early() -> None:
    """A new track comes at eta_ext1, a known one goes below eta_ext2 although r is above eta_ext1."""
    parameters = car(extract_new=0.5, extract_known=0.95, detection=0.5)
    frames = [boxes(parameters, 0.1 * k, xy) for k, xy in enumerate([(0, 0), (), (), (0, 0)])]
    results = steps(parameters, frames)
    r = [result.density.bernoulli.existence[0] for result in results]
    assert r[0] == r[3] == 1.0
    assert r[1] > 0.95
    assert 0.5 < r[2] < 0.95
    assert [result.tracks.id.tolist() for result in results] == [[1], [1], [], [1]]
    single = steps(parameters, frames, optipmb.Modules(ote=False))
    assert [result.tracks.id.tolist() for result in single] == [[1]] * 4


def test_a_known_track_is_dropped_after_eta_cnt_misses() -> None:
    """However certain, a track is extracted only while its misses are fewer than eta_cnt; with OTE off, it stays."""
    parameters = car(survival=1.0)
    frames = [boxes(parameters, 0, (0, 0)), *[boxes(parameters, 0.1 * k) for k in range(1, 6)]]
    assert [len(result.tracks) for result in steps(parameters, frames)] == [1, 1, 1, 0, 0, 0]
    assert [len(result.tracks) for result in steps(parameters, frames, optipmb.Modules(ote=False))] == [1] * 6


def test_confidence_counts_time_not_frames() -> None:
    """x_len is in nominal periods: the same second at twice the rate gives the same confidence."""
    parameters = car()
    slow = steps(parameters, [boxes(parameters, 0.1 * k, (0, 0)) for k in range(4)])
    fast = steps(parameters, [boxes(parameters, 0.05 * k, (0, 0)) for k in range(7)])
    np.testing.assert_allclose(slow[-1].tracks.score, fast[-1].tracks.score)
    np.testing.assert_allclose(slow[-1].tracks.age, [0.3])
    np.testing.assert_allclose(fast[-1].tracks.time_since_detection, [0.0])


def test_classes_do_not_mix() -> None:
    """A measurement of another class at the same place starts a track of its own."""
    document = random_parameters(0, ("Car", "Van"))
    for values in document["classes"].values():
        values.update(SIMPLE)
    parameters = parse_parameters(document)
    frames = [boxes(parameters, 0, (0, 0)), boxes(parameters, 0.1, (0, 0), label="Van")]
    result = steps(parameters, frames)[1]
    np.testing.assert_array_equal(result.tracks.id, [1, 2])
    np.testing.assert_array_equal(result.tracks.label, [0, 1])


@pytest.mark.parametrize(("groups", "tracked"), [((None, None), 2), (("motor", "motor"), 1), (("motor", "other"), 2)])
def test_classes_of_one_group_make_one_object(groups: tuple[str | None, str | None], tracked: int) -> None:
    """A car and a truck detected at one place are two tracks, or the better scored alone where they share a group."""
    document = random_parameters(0, ("Car", "Truck"))
    for values, group in zip(document["classes"].values(), groups, strict=True):
        values.update(SIMPLE, group=group)
    parameters = parse_parameters(document)
    frame, _ = optipmb.make_frame(
        parameters,
        stamp_ns=0,
        labels=["Car", "Truck"],
        label=[0, 1],
        center=[[5.0, 2.0, 0.0], [5.2, 2.1, 0.0]],
        size=[[4.0, 1.8, 1.5], [4.5, 1.9, 1.7]],
        yaw=[0.1, 0.1],
        score=[0.7, 0.8],
    )
    (result,) = steps(parameters, [frame])
    assert sorted(result.tracks.label) == [0, 1][-tracked:]
    assert result.diagnostics.suppressed == 2 - tracked


def test_diagnostics_count_what_happened() -> None:
    """Below the score filter, suppressed, associated and born objects are counted."""
    parameters = car()
    xy = [(0, 0), (0.2, 0), (20, 0), (30, 0)]
    frames = [boxes(parameters, 0, (0, 0)), boxes(parameters, 0.1, xy, score=[0.9, 0.8, 0.9, 0.05])]
    found = steps(parameters, frames)[1].diagnostics
    counted = (found.detections, found.below_score, found.suppressed, found.associated, found.born, found.repaired)
    assert counted == (4, 1, 1, 1, 1, 0)
    assert not found.cloud_used

"""The bound on what a step looks at."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from class_rows import class_rows

import optipmb
from optipmb.filter.hypotheses import pairs_of_many
from optipmb.filter.preprocess import non_maximum_suppression

PARAMETERS = optipmb.load_profile("nuscenes")


def crowd(count: int, extent: float, *, stamp_ns: int = 0) -> optipmb.Frame:
    """Pedestrians at random places of a square, m."""
    rng = np.random.default_rng(count + stamp_ns)
    values: dict[str, Any] = {
        "stamp_ns": stamp_ns,
        "labels": ("pedestrian",),
        "label": np.zeros(count, np.int64),
        "center": np.c_[rng.uniform(0, extent, (count, 2)), np.ones(count)],
        "size": np.full((count, 3), 0.1),
        "yaw": np.zeros(count),
        "score": np.full(count, 0.9),
    }
    return optipmb.make_frame(PARAMETERS, **values)[0]


@pytest.mark.parametrize("seed", range(4))
def test_pairs_are_counted_up_to_a_limit(seed: int) -> None:
    """As many as there are of a class within its gate, or more than the limit."""
    rng = np.random.default_rng(seed)
    center, position = rng.uniform(0, 20, (40, 2)), rng.uniform(0, 20, (50, 2))
    label, measured, gate = rng.integers(0, 2, 40), rng.integers(0, 2, 50), np.array([2.0, 5.0])
    distance = np.linalg.norm(center[:, None] - position[None], axis=2)
    pairs = int(((distance <= gate[label][:, None]) & (label[:, None] == measured[None])).sum())
    assert pairs > 20

    def count(widening: np.ndarray, most: int) -> int:
        return len(pairs_of_many(center, label, gate[label], (position, measured, widening), 2, most)[0])

    assert [count(np.zeros(50), most) for most in (pairs, pairs - 1)] == [pairs, pairs]
    assert 7 < count(np.zeros(50), 7) < pairs
    widening = rng.choice([0.0, 16.0], 50)
    within = distance**2 <= gate[label][:, None] ** 2 + widening
    assert count(widening, 2000) == (within & (label[:, None] == measured[None])).sum() > pairs


def test_a_crowd_beyond_the_bound_is_refused_before_it_costs_anything() -> None:
    """The same objects are tracked where they stand apart, and the density stays usable."""
    tracker = optipmb.Tracker(PARAMETERS, max_pairs=2000)
    density = tracker.step(tracker.initial(), crowd(300, 300.0)).density
    with pytest.raises(optipmb.EffortError, match="center: expected at most 2000 pairs"):
        tracker.step(density, crowd(300, 1.0, stamp_ns=10**9))
    assert len(tracker.step(density, crowd(300, 300.0, stamp_ns=10**9)).density.bernoulli) > 0


def test_what_is_within_the_bound_has_the_same_bytes() -> None:
    """A bound that is not reached changes nothing."""
    density = bounded = optipmb.Tracker(PARAMETERS).initial()
    for number in range(3):
        frame = crowd(60, 40.0, stamp_ns=number * 10**8)
        density = optipmb.Tracker(PARAMETERS).step(density, frame).density
        bounded = optipmb.Tracker(PARAMETERS, max_pairs=20_000).step(bounded, frame).density
    for one, other in zip(optipmb.columns_of(density).values(), optipmb.columns_of(bounded).values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_suppression_gives_up_at_its_bound() -> None:
    """Long thin boxes across each other overlap too little to suppress one another."""
    angles = np.linspace(0, 3, 30)
    star = np.c_[np.zeros((30, 2)), np.full(30, 20.0), np.full(30, 0.05), angles]
    given = np.full(30, 0.5), np.zeros(30, np.int64), np.zeros(30, np.bool_), class_rows(1, nms_iou=0.5)
    assert non_maximum_suppression(star, *given, 30 * 29 // 2).all()
    assert non_maximum_suppression(star, *given, 30 * 29 // 2 - 1).shape == (0,)

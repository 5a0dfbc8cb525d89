"""Which tracks are confirmed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from class_rows import class_rows
from scenes import boxes, random_parameters, steps

import optipmb
from optipmb.filter.extract import confirm

SIMPLE: dict[str, Any] = {
    "score_filter": 0.05,
    "birth_score": 0.1,
    "gate": 4.0,
    "extract_new": 0.5,
    "extract_known": 0.5,
    "extract_misses": 20,
    "survival": 1.0,
    "max_misses": 15,
    "confirm_from": 0.6,
    "confirm_until": 0.3,
    "calibration": {
        "memory": 0.5,
        "missed": 2.0,
        "evidence": [-2.0, 2.0],
        "existence": [0.0, 1.0],
        "along": [0.0, 0.0],
        "across": [0.0, 0.0],
    },
}


@pytest.mark.parametrize("seed", range(4))
def test_confirmation_has_hysteresis(seed: int) -> None:
    """From the upper threshold on, and while detected or not below the lower one; other rows stay as they were."""
    rng = np.random.default_rng(seed)
    label, rows, existence = rng.integers(0, 2, 30), np.flatnonzero(rng.random(30) < 0.6), rng.uniform(0, 1, 30)
    before, upper, lower = rng.random(30) < 0.5, np.array([0.5, 0.8]), np.array([0.2, 0.8])
    found, classes = before.astype(np.int64), class_rows(2, confirm_from=upper, confirm_until=lower)
    told, measurement = np.full(rows.size, 7), rng.integers(-1, 2, 30)
    confirm(rows, label[rows], existence[: rows.size], measurement, classes, found, told)
    stays = before & (measurement >= 0)
    wanted = stays[rows] | (existence[: rows.size] >= np.where(before, lower[label], upper[label])[rows])
    np.testing.assert_array_equal(told, wanted)
    np.testing.assert_array_equal(found[rows], wanted)
    np.testing.assert_array_equal(np.delete(found, rows), np.delete(before, rows))


def test_a_track_is_confirmed_by_good_detections_and_stays_so_through_a_few_misses() -> None:
    """The flag follows the calibrated existence, up and down, one threshold each; it is in the density too."""
    document = random_parameters(0, ("Car",))
    document["classes"]["Car"] |= SIMPLE
    parameters = optipmb.parse_parameters(document)
    flags, existence = [], []
    scores = [0.5, 0.5, 0.9, 0.9, 0.9, None, None, None, None, 0.6]
    places = [() if score is None else (0, 0) for score in scores]
    frames = [boxes(parameters, 0.1 * k, places[k], score=score or 0.5) for k, score in enumerate(scores)]
    for result in steps(parameters, frames):
        density = result.density
        np.testing.assert_array_equal(density.bernoulli.id, [1])
        flags.append(bool(result.tracks.confirmed[0]))
        existence.append(float(result.tracks.existence[0]))
        np.testing.assert_array_equal(density.bernoulli.confirmed, result.tracks.confirmed)
    wanted, state = [], False
    for one in existence:
        state = one >= (0.3 if state else 0.6)
        wanted.append(state)
    assert flags == wanted
    assert not flags[0]
    assert flags[4]
    assert flags[5]  # between the thresholds, and stays
    assert 0.3 < existence[5] < 0.6
    assert not flags[8]
    assert not flags[9]  # between the thresholds again, and stays


def test_every_track_is_confirmed_where_the_profile_asks_for_nothing() -> None:
    """The paper knows no confirmation: under its profiles every extracted track is confirmed."""
    for name in ("kitti-paper", "nuscenes-paper"):
        for values in optipmb.load_profile(name).classes.values():
            assert values.confirm_from == values.confirm_until == 0.0

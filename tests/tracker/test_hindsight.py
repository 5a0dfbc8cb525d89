"""Existence, `confirmed` and velocity of tracks in hindsight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import optipmb
from optipmb.hindsight import with_hindsight

PARAMETERS = optipmb.generic_parameters(["car", "pedestrian"], 0.1)


def tracks(existence: dict[int, float], label: int = 0) -> optipmb.Tracks:
    """Return tracks of some ids with these existence probabilities, else all alike."""
    count = len(existence)
    columns: dict[str, Any] = {
        name: np.ones((count, *column.shape), column.number) for name, column in optipmb.Tracks.described.items()
    }
    columns |= {"id": np.array(list(existence), np.int64), "label": np.full(count, label)}
    return optipmb.Tracks(**columns | {"existence": np.array(list(existence.values()), float)})


def test_existence_is_by_the_mean_log_odds_of_the_frames_that_have_the_track() -> None:
    """Tracks end and begin between frames; certain ones count with bounded log odds; all other columns stay."""
    frames = [
        tracks({2: 0.3, 5: 0.9, 7: 1.0}, label=1),
        tracks({1: 0.5, 2: 0.8, 7: 0.01}),
        tracks({2: 0.7, 9: 0.1}),
    ]
    found = with_hindsight(frames[0], frames[1:], PARAMETERS)
    odds = {2: [0.3, 0.8, 0.7], 5: [0.9], 7: [1.0 / (1.0 + math.exp(-14.0)), 0.01]}
    for k, identity in enumerate((2, 5, 7)):
        mean = float(np.mean([math.log(p / (1.0 - p)) for p in odds[identity]]))
        assert found.existence[k] == pytest.approx(1.0 / (1.0 + math.exp(-mean)), rel=1e-9)
    assert found.confirmed.tolist() == (found.existence >= 0.5).tolist() == [True, True, True]
    for name, column in found.columns():
        if name not in {"existence", "confirmed"}:
            assert column.tobytes() == getattr(frames[0], name).tobytes(), name


def test_clutter_that_fades_was_never_confirmed() -> None:
    """A track that is confirmed when it begins, and doubted in all frames after, is not in hindsight."""
    found = with_hindsight(tracks({1: 0.6}), [tracks({1: 0.2})] * 3, PARAMETERS)
    assert found.confirmed.tolist() == [False]


def test_velocity_of_a_first_frame_is_told_by_the_frames_after_it() -> None:
    """An object that brakes along a bend: later velocities are taken back; in other axes the velocity stays."""
    found = []
    for k in range(6):
        seconds, turn = 0.1 * k, 0.2 * 0.1 * k
        one = tracks({3: 0.9, 4: 0.9})
        speed = np.array([12.0 - 2.0 * seconds, 0.2])
        if k == 0:
            speed[0] = 0.0
        covariance = np.broadcast_to(np.diag([0.1, 0.1, 100.0 if k == 0 else 0.25, 0.01, 0.01, 0.1]), (2, 6, 6)).copy()
        columns = {
            "velocity": speed[:, None] * np.array([math.cos(turn), math.sin(turn)]),
            "yaw": np.full(2, turn),
            "yaw_rate": np.full(2, 0.2),
            "acceleration": np.array([-2.0, 0.0]),
            "age": np.full(2, seconds),
            "covariance": covariance,
        }
        found.append(one.replaced(**columns))
    seen = with_hindsight(found[0], found[1:], PARAMETERS, same_axes=True)
    assert seen.velocity[0] == pytest.approx([12.0, 0.0], abs=0.05)
    assert np.linalg.norm(seen.velocity[1]) < 0.01  # less than a standard deviation: it stands
    stays = with_hindsight(found[0], found[1:], PARAMETERS)
    assert stays.velocity.tobytes() == found[0].velocity.tobytes()

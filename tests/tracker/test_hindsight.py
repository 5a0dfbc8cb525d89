"""Existence, `confirmed` and velocity of tracks in hindsight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import optipmb
from optipmb.learning.hindsight import with_hindsight

PARAMETERS = optipmb.generic_parameters(["car", "pedestrian"], 0.1)


def tracks(existence: dict[int, float], label: int = 0, missed: tuple[int, ...] = ()) -> optipmb.Tracks:
    """Return tracks of some ids with these existence probabilities, else all alike but for the missed ones."""
    count = len(existence)
    columns: dict[str, Any] = {
        name: np.ones((count, *column.shape), column.number) for name, column in optipmb.Tracks.described.items()
    }
    columns |= {"id": np.array(list(existence), np.int64), "label": np.full(count, label)}
    columns["time_since_detection"] = np.isin(columns["id"], missed) * 0.1
    return optipmb.Tracks(**columns | {"existence": np.array(list(existence.values()), float)})


def test_existence_is_by_the_mean_log_odds_of_the_track_up_to_its_last_detection() -> None:
    """Certain frames count with bounded log odds, gaps count, few detections cost, and what follows the last stays."""
    frames = [
        tracks({2: 0.3, 5: 0.9, 7: 1.0}, label=1),
        tracks({1: 0.5, 2: 0.8, 7: 0.01}, missed=(2,)),
        tracks({2: 0.7, 7: 0.8, 9: 0.1}, missed=(7,)),
    ]
    found = with_hindsight(frames, PARAMETERS)
    odds = {1: [0.5], 2: [0.3, 0.8, 0.7], 5: [0.9], 7: [1.0 / (1.0 + math.exp(-14.0)), 0.01], 9: [0.1]}
    detections = {1: 1, 2: 2, 5: 1, 7: 2, 9: 1}
    for given, columns in zip(frames, found, strict=True):
        for k, identity in enumerate(given.id.tolist()):
            mean = float(np.mean([math.log(p / (1.0 - p)) for p in odds[identity]]))
            mean = 1.6 * (mean - 2.0 / detections[identity])
            ended = identity == 7 and given is frames[2]
            wanted = 0.8 if ended else 1.0 / (1.0 + math.exp(-mean))
            assert columns["existence"][k] == pytest.approx(wanted, rel=1e-9)
            assert columns["confirmed"][k] == (not ended and wanted >= 0.5)
    assert set(found[0]) == {"existence", "confirmed"}


def test_a_track_is_confirmed_as_a_whole() -> None:
    """Clutter that fades was never confirmed, an object that becomes sure was from its first frame on."""
    frames = [tracks({1: 0.6, 2: 0.3}), *[tracks({1: 0.2, 2: 0.9})] * 3]
    assert [one["confirmed"].tolist() for one in with_hindsight(frames, PARAMETERS)] == [[False, True]] * 4
    shown = with_hindsight(frames, PARAMETERS, show=0.05)
    assert [one["confirmed"].tolist() for one in shown] == [[True, True]] * 4


def test_velocity_of_a_first_frame_is_told_by_the_frames_after_it() -> None:
    """An object that brakes along a bend: later velocities are taken back, of the time that is asked for."""
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
    seen = with_hindsight(found, PARAMETERS, velocity_s=1.0)[0]["velocity"]
    assert seen[0] == pytest.approx([12.0, 0.0], abs=0.05)
    assert np.linalg.norm(seen[1]) < 0.01  # less than a standard deviation: it stands
    near = with_hindsight(found, PARAMETERS, velocity_s=0.2)[0]["velocity"]
    assert near.tobytes() == with_hindsight(found[:3], PARAMETERS, velocity_s=1.0)[0]["velocity"].tobytes()

"""Existence and `confirmed` of tracks in hindsight."""

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

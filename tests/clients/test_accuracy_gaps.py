"""How many gaps of generated scenes are joined, and how many joins are right: below these figures something is lost."""

from functools import cache

import gaps
import numpy as np
import pytest
from optipmb_tools.run.rejoining import RejoinOptions, joins, tracklets

from optipmb import generic_parameters
from optipmb.joining.decision import Kinds

SEEDS = range(21, 27)
"""Scenes that nothing was chosen by."""


@cache
def judged() -> gaps.Judged:
    parameters, found = generic_parameters(gaps.CLASSES, 0.1), gaps.Judged()
    for name in gaps.SCENES:
        for seed in SEEDS:
            recording = gaps.record(name, seed)
            tracks = gaps.tracked(recording.frames, parameters)
            rows = tracklets(tracks, parameters.labels)
            joined = joins(rows, Kinds.of(parameters), RejoinOptions.gap_s)
            found += gaps.judge(rows, joined, gaps.owners(tracks, recording.source))
    return found


def test_most_gaps_are_joined_and_nearly_all_joins_are_right() -> None:
    """At the default probability 97.5 % of the joins are right, and 65 % of the gaps of 2 to 5 s are joined."""
    right, wrong, _ = judged().counts(RejoinOptions.min_probability)
    assert right / (right + wrong) >= 0.975
    share, count = judged().share(2.0, 5.0, RejoinOptions.min_probability)
    assert count > 1000
    assert share >= 0.65


@pytest.mark.parametrize(("low", "high", "least"), [(0.8, 0.9, 0.7), (0.9, 0.98, 0.82), (0.99, 1.01, 0.97)])
def test_probabilities_of_joins_hold(low: float, high: float, least: float) -> None:
    """Of the joins with a probability about as many are right."""
    join = judged().join
    right = join[(join[:, 0] >= low) & (join[:, 0] < high), 1]
    assert len(right) >= 100
    assert np.nanmean(right) >= least

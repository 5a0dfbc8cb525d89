"""The objective of tuning: gains over recordings, and the changes that are kept."""

import pytest
from optipmb_tools.tuning.clips import load, of_class
from optipmb_tools.tuning.refine import Candidates
from optipmb_tools.tuning.scoring import MARGIN, Objective, rules_of, scorer_of
from optipmb_tools.tuning.values import only, with_values
from tuning_cases import Habits, recorded

import optipmb


@pytest.fixture
def objective() -> Objective:
    whole, rules = optipmb.load_profile("kitti-paper"), rules_of("scene")
    sequences = [recorded(Habits(), seed, frames=25, objects=10, name=f"{seed:04d}") for seed in range(3)]
    clips = [of_class(load(one, whole, rules), "Car", rules) for one in sequences]
    return Objective([clips], scorer_of("scene", "Car", sequences), "mota")


def test_a_change_that_does_not_pay_is_taken_back(objective: Objective) -> None:
    """Of two changed values, the useful one is kept and the idle one is put back; the gain is reported."""
    start = with_values(only(optipmb.load_profile("kitti-paper"), "Car"), "Car", {"gate": 0.1})
    candidates = Candidates(objective, range(3), start)
    chosen = candidates.prune({"gate": 4.0, "birth.acceleration": 1.1})
    assert chosen == {"gate": 4.0}
    (found,) = candidates.weigh(chosen)
    assert (found.path, found.start, found.value, found.positive, found.groups) == ("gate", 0.1, 4.0, 3, 3)
    assert found.gain > 3.0 * found.error > 0.0


def test_a_margin_is_taken_off_all_but_the_start(objective: Objective) -> None:
    """The start keeps its score; other candidates lose the standard error of their gain."""
    start = only(optipmb.load_profile("kitti-paper"), "Car")
    own = objective.gain(start, start, range(3))
    assert (own.gain, own.error, own.score) == (0.0, 0.0, own.value)
    found = objective.gain(with_values(start, "Car", {"score_filter": 0.6}), start, range(3))
    assert found.error > 0.0
    assert found.score == pytest.approx(found.value - MARGIN * found.error)
    assert found.gain == pytest.approx(found.value - own.value)

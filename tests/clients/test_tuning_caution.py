"""What tuning keeps and takes back: changes weighed over recordings."""

from functools import partial

import pytest
from optipmb_client.tuning.caution import Jury
from optipmb_client.tuning.evidence import prune, weigh
from optipmb_client.tuning.material import load, of_class
from optipmb_client.tuning.objective import Bench
from optipmb_client.tuning.scoring import rules_of, scorer_of
from optipmb_client.tuning.values import Value, only, value_of, with_values
from optipmb_client.tuning.watch import Watch
from tuning_cases import Habits, recorded

import optipmb


@pytest.fixture
def bench() -> Bench:
    """Three recordings of cars."""
    whole, rules = optipmb.load_profile("kitti-paper"), rules_of("scene")
    sequences = [recorded(Habits(), seed, frames=25, objects=10, name=f"{seed:04d}") for seed in range(3)]
    clips = [of_class(load(one, whole, rules), "Car", rules) for one in sequences]
    return Bench([clips], scorer_of("scene", "Car", sequences), "mota")


def test_a_change_that_does_not_pay_is_taken_back(bench: Bench) -> None:
    """Of two changed values, the one with a use is kept and the idle one is put back; the use is told."""
    start = with_values(only(optipmb.load_profile("kitti-paper"), "Car"), "Car", {"gate": 0.1})
    before: dict[str, Value] = {"gate": 0.1, "birth.acceleration": value_of(start, "Car", "birth.acceleration")}
    made = partial(with_values, start, "Car")
    jury = Jury(bench, range(3), start)
    chosen = prune(jury, made, before, {"gate": 4.0, "birth.acceleration": 1.1}, 1.0, Watch())
    assert chosen == {"gate": 4.0}
    (found,) = weigh(jury, made, before, chosen, Watch())
    assert (found.path, found.start, found.value, found.positive, found.groups) == ("gate", 0.1, 4.0, 3, 3)
    assert found.gain > 3.0 * found.error > 0.0


def test_the_start_needs_no_caution_and_others_do(bench: Bench) -> None:
    """The cautious score of the start is its score; that of others is less than theirs by their error."""
    start = only(optipmb.load_profile("kitti-paper"), "Car")
    jury = Jury(bench, range(3), start)
    assert jury.score(start, 5.0) == jury.gain(start).value
    other = with_values(start, "Car", {"score_filter": 0.6})
    found = jury.gain(other)
    assert found.error > 0.0
    assert jury.score(other, 2.0) == pytest.approx(found.value - 2.0 * found.error)

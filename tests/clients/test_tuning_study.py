"""The study: the same trials whenever and however often it is resumed, better ones than it began with."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from optipmb_client.errors import UsageError
from optipmb_tools.tuning.values import (
    Value,
    profile_text,
    value_of,
    with_calibration,
    with_classes,
    with_values,
    write_profile,
)

import optipmb

pytest.importorskip("optuna")
from optipmb_tools.tuning.study import Dimension, Plan, dimensions, opened, repaired, search

SPACE = (*(Dimension(f"d{i}", "log", 0.1, 10.0, 1.0) for i in range(5)), Dimension("n", "whole", 1, 100, 30))
START = {one.path: one.value(one.start) for one in SPACE}


def valley(values: Mapping[str, Value]) -> float:
    """Rise towards d_i = 1.5, n = 20."""
    return -sum(math.log(values[f"d{i}"] / 1.5) ** 2 for i in range(5)) - 0.01 * abs(values["n"] - 20)


def searched(
    path: Path, trials: int, score: Callable[[Mapping[str, Value]], float] = valley, *, seed: int = 0, settings: int = 1
) -> tuple[dict[str, Value], list[Mapping[str, Value]]]:
    """Return the best values of a study, and the values that were asked for."""
    asked: list[Mapping[str, Value]] = []

    def noted(values: Mapping[str, Value]) -> float:
        asked.append(values)
        return score(values)

    plan = Plan(trials=trials, seed=seed)
    return search(opened(path, "valley", {"a": settings}), SPACE, [START, {"d0": 2.0}], noted, plan), asked


def test_an_interrupted_study_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    """Stopped in the middle of a trial and resumed, trials equal an uninterrupted study; another seed differs."""
    best, whole = searched(tmp_path / "whole.db", 9)
    count = 0

    def failing(values: Mapping[str, Value]) -> float:
        nonlocal count
        count += 1
        if count == 5:
            raise KeyboardInterrupt
        return valley(values)

    with pytest.raises(KeyboardInterrupt):
        searched(tmp_path / "parts.db", 9, failing)
    _, middle = searched(tmp_path / "parts.db", 7)
    found, last = searched(tmp_path / "parts.db", 9)
    assert [*whole[:4], *middle, *last] == whole
    assert found == best
    assert searched(tmp_path / "other.db", 9, seed=1)[1] != whole


def test_the_first_trials_are_the_starts_and_the_best_is_better(tmp_path: Path) -> None:
    """The best of all trials is returned; each value is within its bounds and has the digits of a profile."""
    best, asked = searched(tmp_path / "a.db", 30)
    assert asked[:2] == [START, {**START, "d0": 2.0}]
    assert valley(best) == max(map(valley, asked)) > valley(START)
    for values in asked:
        for dimension in SPACE:
            value = values[dimension.path]
            assert dimension.low <= value <= dimension.high
            assert dimension.value(float(value)) == value


def test_trials_of_another_study_are_not_mixed_in(tmp_path: Path) -> None:
    """Other settings in the same file are an error that says what to do."""
    searched(tmp_path / "a.db", 2)
    with pytest.raises(UsageError, match=r"choose another --out"):
        searched(tmp_path / "a.db", 2, settings=2)


def test_what_has_no_effect_is_not_searched() -> None:
    """Without velocities and clouds their parameters are left alone; the paper's are searched only when asked for."""
    parameters = optipmb.load_profile("kitti-paper")
    own = {one.path for one in dimensions(parameters, "Car", {}, [], everything=False)}
    everything = {one.path for one in dimensions(parameters, "Car", {}, [], everything=True)}
    assert own < everything
    assert not {"measurement_noise.velocity", "birth.speed", "expected_points"} & everything
    assert "birth_score" in everything - own
    assert {"process_noise.speed", "measurement_noise.position", "birth.position", "area", "max_misses"} <= own


def test_every_choice_is_a_profile() -> None:
    """Thresholds of extraction that contradict each other are put right."""
    parameters = optipmb.load_profile("kitti-paper")
    for values in ({"extract_new": 0.95}, {"extract_known": 0.5}, {"extract_new": 0.9, "extract_known": 0.4}):
        changed = with_values(parameters, "Car", repaired(values, parameters, "Car"))
        assert value_of(changed, "Car", "extract_new") <= value_of(changed, "Car", "extract_known")


def test_a_profile_is_written_as_it_is_read(tmp_path: Path) -> None:
    """Writing a profile and reading it gives the same parameters, for any texts in it."""
    parameters = optipmb.load_profile("nuscenes-paper")
    odd = with_classes(parameters, {}, "odd", 'one "line"\nanother \\ line\tand a \x07 bell')
    calibrated = with_calibration(parameters, "car", optipmb.load_profile("nuscenes").classes["car"].calibration)
    assert calibrated.classes["car"].calibration is not None
    for one in (parameters, odd, calibrated):
        write_profile(tmp_path / "p.toml", one)
        assert optipmb.load_profile(tmp_path / "p.toml") == one
    assert profile_text(parameters) == profile_text(parameters)

"""The search: the same trials whenever and however often it is resumed, better ones than it began with."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from optipmb_client.errors import UsageError
from optipmb_tools.tuning.search import Dimension, dimensions, penalty, repaired
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
from optipmb_tools.tuning.search import Search

SPACE = (*(Dimension(f"d{i}", "log", 0.1, 10.0, 1.0) for i in range(5)), Dimension("n", "whole", 1, 100, 30))
START = {one.path: one.value(one.start) for one in SPACE}


def valley(values: Mapping[str, Value], _guess: Callable[[float], None] | None = None) -> float:
    """Rise towards d_i = 1.5, n = 20."""
    return -sum(math.log(values[f"d{i}"] / 1.5) ** 2 for i in range(5)) - 0.01 * abs(values["n"] - 20)


def guessed(values: Mapping[str, Value], guess: Callable[[float], None]) -> float:
    """Give the score after an early guess, which ends bad trials."""
    guess(valley(values))
    return valley(values)


def search(path: Path, *, seed: int = 0, settings: dict[str, int] | None = None) -> Search:
    return Search(path, "valley", settings or {"a": 1}, SPACE, [START], seed)


def tried(found: Search) -> list[tuple[dict[str, Any], list[float]]]:
    return [(trial.params, trial.values) for trial in found.trials]


class Stopped(Exception):  # noqa: N818 - nothing went wrong
    """The session was ended in the middle of a trial."""


def test_an_interrupted_search_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    """Stopped in the middle of a trial and resumed, trials equal an uninterrupted search; another seed differs."""
    whole = search(tmp_path / "whole.db")
    whole.run(14, guessed)
    count = 0

    def failing(values: Mapping[str, Value], guess: Callable[[float], None]) -> float:
        nonlocal count
        count += 1
        if count == 7:
            raise Stopped
        return guessed(values, guess)

    with pytest.raises(Stopped):
        search(tmp_path / "parts.db").run(14, failing)
    assert len(search(tmp_path / "parts.db").trials) == 6
    search(tmp_path / "parts.db").run(11, guessed)
    parts = search(tmp_path / "parts.db")
    parts.run(14, guessed)
    assert tried(parts) == tried(whole)
    first = [trial.values[0] for trial in whole.trials[:5]]
    assert valley(whole.run(5, guessed)) == max(first)
    other = search(tmp_path / "other.db", seed=1)
    other.run(14, guessed)
    assert tried(other) != tried(whole)


def test_the_first_trial_is_the_start_and_the_best_is_better(tmp_path: Path) -> None:
    """Forty trials get more than half of the way from the start to the top."""
    heard: list[float] = []
    asked: list[Mapping[str, Value]] = []

    def noted(values: Mapping[str, Value], _guess: Callable[[float], None]) -> float:
        asked.append(values)
        return valley(values)

    best = search(tmp_path / "a.db").run(40, noted, heard.append)
    assert asked[0] == START
    assert heard == [max(map(valley, asked[: i + 1])) for i in range(40)]
    assert valley(best) == heard[-1]
    assert heard[-1] > 0.5 * valley(START)
    for values in asked:
        for dimension in SPACE:
            value = values[dimension.path]
            assert dimension.low <= value <= dimension.high
            assert dimension.value(float(value)) == value


def test_a_trial_ends_where_its_first_score_is_bad(tmp_path: Path) -> None:
    """Trials with an early score far below the others are not scored, and are never the best."""
    scored = 0

    def score(values: Mapping[str, Value], guess: Callable[[float], None]) -> float:
        nonlocal scored
        guess(valley(values))
        scored += 1
        return valley(values)

    found = search(tmp_path / "a.db")
    best = found.run(30, score)
    assert len(found.trials) == 30
    assert 1 < scored < 25
    assert valley(best) >= valley(START)


def test_trials_of_another_session_are_not_mixed_in(tmp_path: Path) -> None:
    """Other settings in the same file are an error that says what to do."""
    search(tmp_path / "a.db").run(2, valley)
    with pytest.raises(UsageError, match=r"choose another --out"):
        search(tmp_path / "a.db", settings={"a": 2})


def test_what_has_no_effect_is_not_searched() -> None:
    """Without velocities and clouds their parameters are left alone; the paper's are searched only when asked for."""
    parameters = optipmb.load_profile("kitti-paper")
    own = {one.path for one in dimensions(parameters, "Car", {}, [], everything=False)}
    everything = {one.path for one in dimensions(parameters, "Car", {}, [], everything=True)}
    assert own < everything
    assert not {"measurement_noise.velocity", "birth.speed", "expected_points"} & everything
    assert "birth_score" in everything - own
    assert {"process_noise.speed", "measurement_noise.position", "birth.position", "area", "max_misses"} <= own


def test_leaving_the_start_costs() -> None:
    """At the start nothing, and the more the farther."""
    assert penalty(SPACE, START, 1.0) == 0.0
    near, far = ({**START, "d0": value} for value in (1.2, 3.0))
    assert 0.0 < penalty(SPACE, near, 1.0) < penalty(SPACE, far, 1.0)


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

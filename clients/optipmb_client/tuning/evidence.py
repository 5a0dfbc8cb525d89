"""Which of the values that a search has changed are worth it.

Each changed value is put back alone, and the loss is set against its standard error. The error is that of the
jackknife (Efron, 1982): the loss is taken again without each of five groups of sequences, whole sequences since objects
of one have much in common. A value that does not pay stays what it was: the rest is found one by one, cheapest first,
and put back as long as the whole does not lose by it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optipmb import Parameters
from optipmb_client.geometry import Floats
from optipmb_client.tuning.folds import deal
from optipmb_client.tuning.objective import Bench
from optipmb_client.tuning.space import repaired
from optipmb_client.tuning.values import Value, value_of, with_values
from optipmb_client.tuning.watch import Watch

__all__ = ["Evidence", "prune", "weigh"]

GROUPS = 5
"""Groups of sequences for the standard error."""


@dataclass(frozen=True)
class Evidence:
    """What one changed value is worth."""

    path: str
    start: Value
    value: Value
    gain: float
    """Of the objective, over putting it back."""
    error: float
    """Standard error of the gain; NaN with one sequence."""
    positive: int
    """In how many of `groups` choices of sequences, each without one group, there is a gain."""
    groups: int
    kept: bool = True

    @property
    def ratio(self) -> float:
        """Gain in standard errors; 0 where there is no gain."""
        if self.gain <= 0.0:
            return 0.0
        return self.gain / self.error if self.error > 0.0 else math.inf


def weigh(
    bench: Bench, base: Parameters, name: str, values: Mapping[str, Value], paths: Sequence[str], watch: Watch
) -> list[Evidence]:
    """Return what each of some values of a choice is worth, the others staying.

    Args:
        bench: all sequences.
        base: the parameters before.
        name: the class.
        values: the choice.
        paths: which of its values are put back, one at a time.
        watch: told how far it has come.

    """
    clips = tuple(range(len(bench.names)))
    groups = deal([bench.boxes(i) for i in clips], GROUPS)
    subsets = [clips, *(tuple(i for i in clips if i not in group) for group in groups)]
    chosen = _values(bench, with_values(base, name, repaired(values, base, name)), clips, subsets)
    found = []
    for path in paths:
        watch.note(f"{name}: weighing {path}")
        start = value_of(base, name, path)
        rest = repaired({**values, path: start}, base, name)
        gains = chosen - _values(bench, with_values(base, name, rest), clips, subsets)
        count = len(groups)
        error = math.sqrt((count - 1) * float(np.var(gains[1:]))) if count else math.nan
        found.append(Evidence(path, start, values[path], float(gains[0]), error, int((gains[1:] > 0).sum()), count))
    return found


def _values(bench: Bench, parameters: Parameters, clips: tuple[int, ...], subsets: Sequence[tuple[int, ...]]) -> Floats:
    """Return the objective on subsets of the sequences."""
    measured = bench.measure(parameters, clips)
    return np.array(
        [bench.value(bench.figures([[variant[i] for i in part] for variant in measured]), part) for part in subsets]
    )


def changed(base: Parameters, name: str, values: Mapping[str, Value]) -> list[str]:
    """Return the paths whose value differs from what it was."""
    return [path for path, value in values.items() if value != value_of(base, name, path)]


def prune(
    bench: Bench,
    base: Parameters,
    name: str,
    values: Mapping[str, Value],
    least: float,
    watch: Watch,
) -> tuple[dict[str, Value], tuple[Evidence, ...]]:
    """Return a choice without the values that do not pay, and what was found out about each that was changed.

    Args:
        bench: all sequences.
        base: the parameters before.
        name: the class.
        values: what the search chose.
        least: a value is kept without question when its gain is so many standard errors.
        watch: told how far it has come.

    """
    allowed = repaired(values, base, name)
    chosen = {path: allowed[path] for path in changed(base, name, allowed)}
    first = weigh(bench, base, name, chosen, list(chosen), watch)
    best = _value(bench, base, name, chosen)
    dropped = []
    for one in sorted(first, key=lambda found: (found.ratio, found.gain)):
        if one.ratio >= least:
            continue
        watch.note(f"{name}: trying without {one.path}")
        rest = {path: value for path, value in chosen.items() if path != one.path}
        value = _value(bench, base, name, rest)
        if value >= best - (least * one.error if math.isfinite(one.error) else 0.0):
            chosen, best = rest, max(best, value)
            dropped.append(replace(one, kept=False))
    last = weigh(bench, base, name, chosen, list(chosen), watch)
    return chosen, (*sorted(last, key=_by_gain), *sorted(dropped, key=_by_gain))


def _by_gain(one: Evidence) -> float:
    return -one.gain


def _value(bench: Bench, base: Parameters, name: str, values: Mapping[str, Value]) -> float:
    clips = range(len(bench.names))
    parameters = with_values(base, name, repaired(values, base, name))
    return bench.value(bench.figures(bench.measure(parameters, clips)), clips)

"""Which of the values that a search has changed are worth it.

Values are put back one after the other, those of the paper's table first, and stay back unless the score and the
cautious score both lose by it. What each of the rest is worth is then weighed by putting it back alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from optipmb import Parameters
from optipmb_client.tuning.caution import Jury
from optipmb_client.tuning.values import Value
from optipmb_client.tuning.watch import Watch

__all__ = ["WORTH", "Evidence", "prune", "weigh"]

WORTH = 0.0002
"""What a changed value must at least add to the cautious score."""

Made = Callable[[Mapping[str, Value]], Parameters]
"""From changed values to the parameters that are tracked with."""


@dataclass(frozen=True)
class Evidence:
    """What one changed value is worth."""

    path: str
    start: Value
    value: Value
    gain: float
    """Of the objective, over putting it back."""
    error: float
    """Standard error of the gain."""
    positive: int
    """In how many of `groups` choices of sequences, each without one group, there is a gain."""
    groups: int


def prune(
    jury: Jury, made: Made, start: Mapping[str, Value], values: Mapping[str, Value], caution: float, watch: Watch
) -> dict[str, Value]:
    """Return those of the changed values that pay.

    Args:
        jury: judges by the sequences that the values were chosen on.
        made: gives the parameters of changed values.
        start: the values before, by path.
        values: what the search chose.
        caution: standard errors that are taken off.
        watch: called with how far it has come.

    """
    chosen = {path: value for path, value in values.items() if value != start[path]}
    now = jury.gain(made(chosen))
    best = now.value - caution * now.error
    for path in reversed(list(chosen)):
        watch.note(f"trying without {path}")
        rest = {one: value for one, value in chosen.items() if one != path}
        without = jury.gain(made(rest))
        score = without.value - caution * without.error
        if score >= best - WORTH:
            chosen, now, best = rest, without, max(best, score)
        elif without.value >= now.value:  # nearer to the start and no worse, if not as sure
            chosen, now, best = rest, without, score
    return chosen


def weigh(
    jury: Jury, made: Made, start: Mapping[str, Value], values: Mapping[str, Value], watch: Watch
) -> tuple[Evidence, ...]:
    """Return what each of some changed values is worth, the others staying; the most worth first.

    Arguments as in `prune`.
    """
    found = []
    for path in values:
        watch.note(f"weighing {path}")
        rest = {one: value for one, value in values.items() if one != path}
        one = jury.gain(made(values), made(rest))
        found.append(Evidence(path, start[path], values[path], one.gain, one.error, one.positive, one.groups))
    return tuple(sorted(found, key=lambda one: -one.gain))

"""How sure a gain is, and what is left of it when one is cautious.

A gain over the start is the difference of a figure over all sequences. Its standard error is that of the jackknife
(Efron, 1982): the difference is taken again without each of five groups of sequences, whole sequences since objects of
one have much in common. The cautious score of parameters is their score less that error; the start has none. So a
search leaves the start only for what helps in most places, and not for the luck of one sequence.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optipmb import Parameters
from optipmb_client.geometry import Floats
from optipmb_client.tuning.folds import deal
from optipmb_client.tuning.objective import Bench

__all__ = ["GROUPS", "Gain", "Jury"]

GROUPS = 5
"""Groups of sequences for the standard error."""


@dataclass(frozen=True)
class Gain:
    """Of one set of parameters over another."""

    value: float
    """Score of the first, over all sequences."""
    gain: float
    error: float
    """Standard error of the gain; 0 where there are too few sequences to tell."""
    positive: int
    """In how many of `groups` choices of sequences, each without one group, there is a gain."""
    groups: int


class Jury:
    """Judges parameters by some sequences, against a start.

    Args:
        bench: of all sequences.
        clips: those that judge.
        start: the parameters that others are compared with.
    """

    def __init__(self, bench: Bench, clips: Sequence[int], start: Parameters) -> None:
        self._bench = bench
        self._clips = tuple(clips)
        groups = deal([bench.boxes(i) if i in clips else 0 for i in range(len(bench.names))], GROUPS)
        self._parts = [self._clips, *(tuple(i for i in self._clips if i not in group) for group in groups)]
        self._start = self._values(start)

    def _values(self, parameters: Parameters) -> Floats:
        """Return the score on all sequences, and without each group."""
        measured = self._bench.measure(parameters, self._clips)
        place = {clip: i for i, clip in enumerate(self._clips)}
        return np.array(
            [
                self._bench.value(
                    self._bench.figures([[variant[place[i]] for i in part] for variant in measured]), part
                )
                for part in self._parts
            ]
        )

    def gain(self, parameters: Parameters, over: Parameters | None = None) -> Gain:
        """Return the gain of parameters over others, or over the start."""
        values = self._values(parameters)
        gains = values - (self._start if over is None else self._values(over))
        count = len(self._parts) - 1
        error = math.sqrt((count - 1) * float(np.var(gains[1:]))) if count else 0.0
        return Gain(float(values[0]), float(gains[0]), error, int((gains[1:] > _NOTHING).sum()), count)

    def score(self, parameters: Parameters, caution: float) -> float:
        """Return the score less `caution` standard errors of the gain over the start."""
        found = self.gain(parameters)
        return found.value - caution * found.error


_NOTHING = 1e-9

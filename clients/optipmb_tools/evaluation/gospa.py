"""GOSPA and OSPA: the distance between the set of tracks and the set of true objects, frame by frame.

Conventions: metres, centres in the plane. With d the distance of a pair, c the cut-off and p the order, the generalised
optimal sub-pattern assignment metric (Rahmathullah et al., 2017; alpha = 2) of one frame is

    GOSPA = ( sum over pairs of d^p + c^p / 2 (missed + false) )^(1/p)

for the best choice of pairs with d < c; an object without a pair is missed, a track without one is false. Its three
parts, each raised to 1/p, are given too; the p-th power of GOSPA is the sum of the p-th powers of the parts. The
optimal sub-pattern assignment metric (Schuhmacher et al., 2008) is bounded by c; with m <= n the sizes of the two sets,
all m are paired and

    OSPA = ( 1/n ( sum over pairs of min(d, c)^p + c^p (n - m) ) )^(1/p)

Both are 0 where there is neither an object nor a track. The figures are means over all frames. They know nothing of
identities: they say how good the picture of each moment is.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optipmb_tools.evaluation.cases import Case, Rules, assign_frames, best_pairs, counted

CUTOFF = 2.0
ORDER = 2.0


@dataclass(frozen=True)
class GospaResult:
    """Sums over frames, metres; results of several sequences add up."""

    frames: int = 0
    gospa: float = 0.0
    localisation: float = 0.0  # part of GOSPA: inaccurate places
    missed: float = 0.0  # part of GOSPA: missed objects
    false: float = 0.0  # part of GOSPA: false tracks
    ospa: float = 0.0

    def __add__(self, other: "GospaResult") -> "GospaResult":
        return GospaResult(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    def summary(self) -> dict[str, float | None]:
        """Return the means over frames by name; None where there are no frames."""
        names = {
            "GOSPA": self.gospa,
            "localisation": self.localisation,
            "missed": self.missed,
            "false": self.false,
            "OSPA": self.ospa,
        }
        return {name: value / self.frames if self.frames else None for name, value in names.items()}


def evaluate_gospa(parts: Iterable[tuple[Case, int]], rules: Rules, order: float = ORDER) -> GospaResult:
    """Return the figures of one class over all sequences.

    Args:
        parts: the class in each sequence and the number of frames of the sequence that are compared.
        rules: those by which the cases were prepared; centres, and their limit is the cut-off c.
        order: p, at least 1.
    """
    return sum((_gospa(counted(case, rules), frames, rules.limit, order) for case, frames in parts), GospaResult())


def _gospa(case: Case, frames: int, cutoff: float, order: float) -> GospaResult:
    """Return the figures of one sequence in which everything counts."""
    near = case.pairs(case.cost < cutoff)
    power = near.cost**order
    limit = cutoff**order
    # A pair is worth its saving: either of the two metrics charges c^p for two boxes that are alone or far apart.
    taken = assign_frames(near.pair_frame, near.truth_row, near.track_row, limit - power, best_pairs)
    when = near.pair_frame[taken]
    stop = 1 + max(case.truth_frame.max(initial=-1), case.track_frame.max(initial=-1))
    paired = np.bincount(when, minlength=stop)
    objects = np.bincount(case.truth_frame, minlength=stop)
    tracks = np.bincount(case.track_frame, minlength=stop)
    parts = [
        np.bincount(when, power[taken], stop),
        0.5 * limit * (objects - paired),
        0.5 * limit * (tracks - paired),
    ]
    most = np.maximum(objects, tracks)
    ospa = (parts[0] + limit * (most - paired)) / np.maximum(most, 1)
    return GospaResult(frames, *(float((part ** (1.0 / order)).sum()) for part in (sum(parts), *parts, ospa)))

"""How well tracks agree with the truth: from a clip and its tracks to something small, and from those to figures.

A scorer measures each sequence on its own, so that processes can share the work, and sums up any choice of sequences:
all of them, those of a fold, or all but one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from optipmb_client.evaluation import Case, Rules, prepare
from optipmb_client.results import ResultTable
from optipmb_client.tuning.figures import HOTA_DISTANCE, Figures, figures, join
from optipmb_client.tuning.material import Clip
from optipmb_client.geometry import to_sensor

__all__ = ["Measured", "Scorer"]


@dataclass(frozen=True)
class Measured:
    """One sequence: truth and tracks with the pairs that may match."""

    case: Case
    """By the rules of the benchmark."""
    near: Case
    """By the distance of the centres, for HOTA."""


@dataclass(frozen=True)
class Scorer:
    """The figures of one class by some rules."""

    name: str
    rules: Rules

    def measure(self, clip: Clip, tracks: ResultTable) -> Measured:
        """Compare the tracks of a clip, in the world frame, with its truth."""
        when = tracks.frame
        center, yaw = to_sensor(clip.rotation[when], clip.translation[when], tracks.center, tracks.yaw)
        local = replace(tracks, center=center, yaw=yaw)
        case = prepare(clip.truth, local, self.name, self.rules, clip.name)
        near = replace(self.rules, measure="distance", limit=HOTA_DISTANCE)
        return Measured(case, case if near == self.rules else prepare(clip.truth, local, self.name, near, clip.name))

    def figures(self, measured: Sequence[Measured]) -> Figures:
        """Return the figures of some sequences together."""
        return figures(
            join([one.case for one in measured]), self.rules, join([one.near for one in measured])
        )

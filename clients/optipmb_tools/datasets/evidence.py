"""Evidence for an assumption: how many of the things that were looked at agree with it."""

from dataclasses import dataclass
from typing import Final

SURE: Final = 2.6  # standard deviations of the bounds of a share
CLEAR: Final = 0.25  # difference of two shares that is more than noise of the values


@dataclass(frozen=True)
class Evidence:
    """How many of some boxes, moves or frames agree."""

    agree: float = 0
    of: float = 0

    @property
    def share(self) -> float:
        """Share that agrees; 0 of none."""
        return self.agree / self.of if self.of else 0.0

    @property
    def bounds(self) -> tuple[float, float]:
        """Wilson's interval of the share: wide where few were looked at."""
        weight = SURE**2 / max(self.of, 1e-9)
        middle = (self.share + 0.5 * weight) / (1.0 + weight)
        half = (weight * (self.share * (1.0 - self.share) + 0.25 * weight)) ** 0.5 / (1.0 + weight)
        return middle - half, middle + half

    def beats(self, other: "Evidence") -> bool:
        """Tell whether this is the stronger evidence, by more than chance and noise explain."""
        return self.bounds[0] > other.bounds[1] and self.share > other.share + CLEAR

"""Which values of a class are searched, and between which bounds.

By default only what the paper's table of parameters lacks: Q, R, P^0, the area and the two limits of forgetting. Bounds
lie around the values that a search begins from: those of the profile and those that were estimated.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optipmb import Parameters
from optipmb_client.tuning.material import Clip
from optipmb_client.tuning.values import Value, rounded, value_of

__all__ = ["Dimension", "dimensions", "penalty", "repaired"]

Kind = Literal["log", "linear", "whole"]

_FACTOR = 4.0
_OWN: tuple[tuple[str, Kind, float, float], ...] = (
    ("area", "log", 10.0, 1e6),
    ("max_misses", "whole", 1, 100),
    ("min_existence", "log", 1e-4, 0.3),
    ("process_noise.position", "log", 0.005, 2.0),
    ("process_noise.speed", "log", 0.01, 10.0),
    ("process_noise.heading", "log", 0.003, 3.0),
    ("process_noise.turn_rate", "log", 0.003, 3.0),
    ("process_noise.acceleration", "log", 0.01, 10.0),
    ("measurement_noise.position", "log", 0.01, 3.0),
    ("measurement_noise.velocity", "log", 0.05, 10.0),
    ("measurement_noise.heading", "log", 0.01, 3.0),
    ("birth.position", "log", 0.01, 5.0),
    ("birth.speed", "log", 0.05, 30.0),
    ("birth.unknown_speed", "log", 0.1, 50.0),
    ("birth.heading", "log", 0.01, 3.0),
    ("birth.turn_rate", "log", 0.005, 3.0),
    ("birth.acceleration", "log", 0.01, 10.0),
)
_PAPER: tuple[tuple[str, Kind, float, float], ...] = (
    ("score_filter", "linear", 0.0, 0.6),
    ("nms_iou", "linear", 0.01, 0.5),
    ("survival", "linear", 0.95, 1.0),
    ("gate", "log", 0.5, 20.0),
    ("detection", "linear", 0.4, 0.99),
    ("expected_points", "log", 1.0, 200.0),
    ("detection_floor", "linear", 0.1, 1.0),
    ("birth_score", "linear", 0.05, 0.95),
    ("adaptive_birth_rate", "log", 0.01, 20.0),
    ("undetected_birth_rate", "log", 0.01, 20.0),
    ("clutter_rate", "log", 0.05, 50.0),
    ("poisson_steps", "whole", 0, 6),
    ("extract_new", "linear", 0.3, 0.95),
    ("extract_known", "linear", 0.3, 0.99),
    ("extract_misses", "whole", 1, 15),
)
_VELOCITY = ("measurement_noise.velocity", "birth.speed")
_NO_VELOCITY = ("birth.unknown_speed",)
_CLOUD = ("expected_points", "detection_floor")


@dataclass(frozen=True)
class Dimension:
    """One value that is searched."""

    path: str
    kind: Kind
    low: float
    high: float
    start: float

    def value(self, raw: float) -> Value:
        """Return a number as the profile has it: within the bounds, with few digits."""
        bounded = min(max(raw, self.low), self.high)
        return round(bounded) if self.kind == "whole" else rounded(bounded)

    def offset(self, value: float) -> float:
        """Return how far a value is from the start, in units of the range: logarithms where the range is large."""
        if self.kind == "linear":
            return (value - self.start) / (self.high - self.low)
        shift = 1.0 if self.kind == "whole" else 0.0
        return math.log((value + shift) / (self.start + shift)) / math.log((self.high + shift) / (self.low + shift))

    def moved(self, value: float, step: float) -> Value:
        """Return a value moved by a share of the range."""
        if self.kind == "linear":
            return self.value(value + step * (self.high - self.low))
        shift = 1.0 if self.kind == "whole" else 0.0
        factor = ((self.high + shift) / (self.low + shift)) ** step
        return self.value((value + shift) * factor - shift)


def dimensions(
    parameters: Parameters, name: str, estimated: Mapping[str, Value], clips: Sequence[Clip], *, everything: bool
) -> tuple[Dimension, ...]:
    """Return what is searched for a class.

    Args:
        parameters: the values to begin with.
        name: the class.
        estimated: other values to begin with, by path.
        clips: decide which values have any effect: those about velocities only where there are any, and so on.
        everything: also the values of the paper's table.

    """
    known = [np.isfinite(frame.velocity).all(axis=1) for clip in clips for frame in clip.frames]
    velocities = any(row.any() for row in known)
    idle = set() if velocities else set(_VELOCITY)
    if velocities and all(row.all() for row in known):
        idle |= set(_NO_VELOCITY)
    if all(frame.cloud is None for clip in clips for frame in clip.frames):
        idle |= set(_CLOUD)
    found = []
    for path, kind, least, most in (*_OWN, *(_PAPER if everything else ())):
        if path in idle:
            continue
        start = float(value_of(parameters, name, path))
        known_values = [start, float(estimated.get(path, start))]
        low, high = (least, most) if kind == "linear" else _around(known_values, kind, least, most)
        found.append(Dimension(path, kind, min(low, start), max(high, start), start))
    return tuple(found)


def _around(values: Sequence[float], kind: Kind, least: float, most: float) -> tuple[float, float]:
    low, high = max(least, min(values) / _FACTOR), min(most, max(values) * _FACTOR)
    if kind == "whole":
        return float(math.floor(low)), float(math.ceil(high))
    return rounded(low), rounded(high)


def repaired(values: Mapping[str, Value], parameters: Parameters, name: str) -> dict[str, Value]:
    """Return values that a profile allows: a track is never harder to extract again than for the first time."""
    fixed = dict(values)
    new = fixed.get("extract_new", value_of(parameters, name, "extract_new"))
    known = fixed.get("extract_known", value_of(parameters, name, "extract_known"))
    if new > known:
        fixed["extract_new" if "extract_new" in fixed else "extract_known"] = known if "extract_new" in fixed else new
    return fixed


def penalty(space: Sequence[Dimension], values: Mapping[str, Value], weight: float) -> float:
    """Return what leaving the start costs: without effect on the tracks a value stays where it was."""
    return weight * sum(one.offset(float(values[one.path])) ** 2 for one in space if one.path in values)

"""What the values of a table mean: units of time and angle, order of sizes, axes, kind of score.

What the user or a column's name says holds. What nobody says is found in the values and reported, so that every
assumption can be read; what contradicts itself is refused. Results: nanoseconds, metres, radians, z up.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from optipmb_client.camera import sensor_from_kitti
from optipmb_client.files import DatasetError
from optipmb_client.geometry import Floats, Ints

__all__ = ["Reading", "read_angle", "read_axes", "read_scores", "read_sizes", "read_stamps"]

SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
EPOCHS: Final = (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8))
"""From this value on a stamp counts its unit since 1970: years from 1973 on."""
PERIODS: Final = (0.004, 4.0)
"""Shortest and longest time between frames, in seconds, that is taken for granted when a unit is to be found."""
FULL_TURN: Final = 6.4
PERCENT: Final = 100.0
SPREAD: Final = 8.0
LOGIT: Final = 30.0
"""Beyond it a sigmoid is 0 or 1 in six decimals."""


@dataclass
class Reading:
    """The options of the user, where the values come from, and what was assumed about them."""

    path: Path
    options: Mapping[str, str]
    notes: list[str] = field(default_factory=list)
    unmatched: dict[str, DatasetError] = field(default_factory=dict)
    """Options `column.*` and `class.*` that name nothing in this table; another table may have it."""

    def note(self, text: str) -> None:
        """Report an assumption, once."""
        if text not in self.notes:
            self.notes.append(text)

    def chosen(self, name: str, known: Mapping[str, object] | tuple[str, ...]) -> str | None:
        """Return what the user says of something; None where nothing.

        Raises:
            DatasetError: it is not one of `known`.
        """
        value = self.options.get(name)
        if value is not None and value not in known:
            raise DatasetError(f"--option {name}", " or ".join(known), repr(value))
        return value

    def first(self, bad: np.ndarray, line: Callable[[int], int], expected: str, values: np.ndarray) -> None:
        """Raise for the first row that is `bad`."""
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise DatasetError(self.path, expected, str(values[row]), line=line(row))


def read_stamps(reading: Reading, values: np.ndarray, unit: str | None) -> Ints:
    """Return stamps in nanoseconds, counted from the first one where they would be negative.

    Raises:
        DatasetError: the values count frames, or their unit cannot be found.
    """
    if values.dtype.kind == "M":
        return values.astype("datetime64[ns]").astype(np.int64)
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "if":
        raise DatasetError(reading.path, "stamps: numbers, or dates as YYYY-MM-DD HH:MM:SS.ffffff", repr(values[0]))
    unit = reading.chosen("time", SECONDS) or unit
    steps = np.diff(np.unique(numbers))
    period = float(np.median(steps)) if len(steps) else 0.0
    if unit is None:
        unit = next((name for name, least in EPOCHS if float(np.max(numbers)) >= least), None)
        if unit is None and period:
            fitting = [name for name, size in SECONDS.items() if PERIODS[0] <= period * size <= PERIODS[1]]
            counts = period == 1.0 and bool(np.all(numbers == np.round(numbers)))
            if counts or len(fitting) != 1:
                what = "whole numbers in steps of 1, which may count frames" if counts else f"steps of {period:g}"
                raise DatasetError(reading.path, "a unit of time (--option time=s, ms, us or ns, or rate=HZ)", what)
            (unit,) = fitting
        unit = unit or "s"
        reading.note(f"stamps look like {_WORDS[unit]} (in steps of {period:g})")
    if numbers.dtype.kind == "i":
        return numbers * round(SECONDS[unit] * 1e9)
    return np.round(numbers * (SECONDS[unit] * 1e9)).astype(np.int64)


_WORDS: Final = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


def read_angle(reading: Reading, values: Floats, unit: str | None) -> Floats:
    """Return headings in radians."""
    chosen = reading.chosen("yaw", ("degrees", "radians"))
    if chosen is None and unit is not None:
        chosen = "degrees" if unit == "deg" else "radians"
    if chosen is None:
        most = float(np.abs(values).max()) if len(values) else 0.0
        chosen = "degrees" if most > FULL_TURN else "radians"
        if chosen == "degrees":
            reading.note(f"yaw looks like degrees (up to {most:.4g})")
    return np.deg2rad(values) if chosen == "degrees" else values


def read_sizes(reading: Reading, sizes: Floats, names: np.ndarray, *, stated: bool) -> Floats:
    """Return length, width, height.

    The order is found by the cars, whose median length exceeds their width by far, and is height, width, length when
    the longest comes last.

    Args:
        reading: with options.
        sizes: (R, 3) in the order of the columns.
        names: (R,) classes.
        stated: whether the names of the columns say which is which.
    """
    order = reading.chosen("sizes", ("lwh", "wlh", "hwl"))
    if order is None:
        cars = sizes[["car" in _words(name) for name in names.tolist()]]
        median = np.median(cars, axis=0) if len(cars) else np.array([3.0, 2.0, 1.0])
        longest = int(np.argmax(median))
        looks = ("lwh", "wlh", "hwl")[longest] if median[longest] > 1.5 * np.median(median) else "lwh"
        if looks != "lwh":
            said = "sizes look like " + ", ".join(looks)
            if stated:
                reading.note(f"{said}, and not as their columns are named: --option sizes={looks} reads them so")
                looks = "lwh"
            else:
                reading.note(said)
        order = looks
    return sizes[:, [order.index(letter) for letter in "lwh"]]


def _words(name: str) -> list[str]:
    return re.split(r"[^a-z]+", name.lower())


def read_axes(reading: Reading, center: Floats, size: Floats, yaw: Floats) -> tuple[Floats, Floats, Floats]:
    """Return boxes with z up.

    Raises:
        DatasetError: the axes look like those of a camera, and nobody says so.
    """
    axes = reading.chosen("axes", ("z-up", "camera"))
    if axes == "camera":
        hwl = np.ascontiguousarray(size[:, ::-1])
        return sensor_from_kitti(center, hwl, yaw)
    if axes is None and len(center) > 1:
        low, high = np.quantile(center, [0.05, 0.95], axis=0)
        across, up = (high - low)[1:]
        if up > SPREAD and up > 3.0 * across:
            found = f"z from {low[2]:.3g} to {high[2]:.3g} m and y from {low[1]:.3g} to {high[1]:.3g} m"
            expected = (
                "z to point up (--option axes=z-up), or camera axes: x right, y down, z forward, y at the bottom of "
                "the box, yaw about y as in KITTI (--option axes=camera)"
            )
            raise DatasetError(reading.path, expected, found)
    return center, size, yaw


def read_scores(reading: Reading, scores: Floats) -> Floats:
    """Return scores in [0, 1]."""
    kind = reading.chosen("score", ("probability", "logit", "percent"))
    if kind is None:
        low, high = (float(scores.min()), float(scores.max())) if len(scores) else (0.0, 1.0)
        kind = "probability"
        if low < 0.0 or (high > 1.0 and not (high > PERCENT / 4 and high <= PERCENT)):
            kind = "logit"
            reading.note(f"scores look like logits ({low:.3g} to {high:.3g}): taken through a sigmoid")
        elif high > 1.0:
            kind = "percent"
            reading.note(f"scores look like percent (up to {high:.4g}): divided by 100")
    if kind == "logit":
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(scores, -LOGIT, LOGIT))), dtype=np.float64)
    return scores / PERCENT if kind == "percent" else scores

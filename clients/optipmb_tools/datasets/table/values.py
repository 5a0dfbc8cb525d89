"""Units and conventions of the values of a table, found for a whole recording at once.

An option of the user holds, then what the name of a column says, then the evidence of the values: the time between
frames, the directions in which boxes move, the classes. Each assumption is a finding; a contradiction is refused with
the option that resolves it. Results: nanoseconds, metres, radians, z up.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from optipmb_tools.datasets.interface import class_like
from optipmb_tools.datasets.motion import LEAST_ALONG, SAME_DIRECTION, SURE_MOVES, Moves
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Ints, wrap_angle
from optipmb_tools.table_files import line_of

SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
DATED: Final = (1e8, 4.2e9)  # seconds since 1970 that are taken for a date: 1973 to 2103
PERIODS: Final = (0.005, 10.0)  # shortest and longest time between frames that is plausible, s
COUNTED_HZ: Final = 10.0  # default rate of frames that are counted and not stamped
APART: Final = 3.0  # ratio of the shortest step between frames to the longest step inside of one
UPRIGHT: Final = 0.3  # largest x and y of the quaternion of a box that stands upright
FULL_TURN: Final = 6.4
PERCENT: Final = 100.0
SPREAD: Final = 8.0
LOGIT: Final = 30.0  # beyond it a sigmoid is 0 or 1 in six decimals; scores beyond it are no logits
ROUNDING: Final = 1e-3  # scores up to so much above 1 are 1
FEW: Final = 0.05  # share of scores outside 0 to 1 up to which they are mistakes and not of another kind
ENOUGH_MOVES: Final = 5  # moves from which headings are compared with motion
AGREED: Final = 0.5  # share of moves along headings of another convention from which it is likely
DOUBTFUL: Final = 0.7
CERTAIN: Final = 0.8
"""Headings are in degrees where fewer moves than the first share are along them in radians, more than the second go
forward along them in degrees."""
SINGLE: Final = 0.1
FAR: Final = 1e5  # coordinates in metres beyond which single precision loses centimetres

# Axis from which a heading is measured, counter-clockwise if not said otherwise -> (sign, offset) of the yaw
HEADINGS: Final[Mapping[str, tuple[float, float]]] = {
    "x": (1.0, 0.0),
    "y": (1.0, 0.5 * np.pi),
    "-x": (1.0, np.pi),
    "-y": (1.0, -0.5 * np.pi),
    "x-clockwise": (-1.0, 0.0),
    "y-clockwise": (-1.0, 0.5 * np.pi),
    "-x-clockwise": (-1.0, np.pi),
    "-y-clockwise": (-1.0, -0.5 * np.pi),
}


@dataclass(frozen=True)
class Finding:
    """An assumption about a recording, or an error in it."""

    topic: str  # `time`, `yaw`, `scores` …
    text: str  # one line
    option: str = ""  # that changes it
    wrong: bool = False  # whether `optipmb track` refuses the recording for it


@dataclass
class Reading:
    """Files of a recording, options of the user, and findings.

    Attributes:
        path: The file, or the folder of several.
        options: Options of the data set.
        lenient: Errors become findings; the reader goes on as if nothing were known.
        files: Each file with the first of its rows; empty: all rows are in `path`.
        named: Options `column.*` and `class.*`, with the error if they name nothing in the tables read so far.
    """

    path: Path
    options: Mapping[str, str]
    lenient: bool = False
    files: tuple[tuple[Path, int], ...] = ()
    findings: list[Finding] = field(default_factory=list)
    named: dict[str, DatasetError | None] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        """The findings, a line each."""
        return [f"{one.text} ({one.option})" if one.option else one.text for one in self.findings]

    def note(self, topic: str, text: str, option: str = "") -> None:
        """Report an assumption, once."""
        finding = Finding(topic, text, option)
        if finding not in self.findings:
            self.findings.append(finding)

    def refuse(self, topic: str, expected: str, received: str, option: str = "", row: int | None = None) -> None:
        """Raise a `DatasetError`; with `lenient`, add a finding."""
        path, line = (self.path, None) if row is None else self.place(row)
        if not self.lenient:
            raise DatasetError(path, f"{expected} ({option})" if option else expected, received, line=line)
        where = "" if line is None else f"{path.name}:{line}: "
        self.findings.append(Finding(topic, f"{where}expected {expected}, received {received}", option, wrong=True))

    def name(self, option: str, known: Collection[str], expected: str, name: str) -> None:
        """Record whether a table has the column or class that an option names."""
        error = DatasetError(f"--option {option}", f"{expected}: {', '.join(known)}", repr(name))
        if name in known or name.lower() in map(str.lower, known):
            self.named[option] = None
        self.named.setdefault(option, error)

    def place(self, row: int) -> tuple[Path, int]:
        """Return the file of a row and its line there, counted from 1."""
        path, first = next((one for one in reversed(self.files) if one[1] <= row), (self.path, 0))
        return path, line_of(path, row - first, self.options)

    def chosen(self, name: str, known: Mapping[str, object] | tuple[str, ...]) -> str | None:
        """Return the value of an option; None where it is not given.

        Raises:
            DatasetError: It is not one of `known`.
        """
        value = self.options.get(name)
        if value is not None and value not in known:
            raise DatasetError(f"--option {name}", " or ".join(known), repr(value))
        return value

    def first(self, topic: str, bad: np.ndarray, expected: str, values: np.ndarray, option: str = "") -> None:
        """Refuse the first row that is `bad`."""
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            value = values[row]
            shown = repr(value.item()) if isinstance(value, np.str_) else str(value)
            self.refuse(topic, expected, shown, option, row)


def median_step(numbers: np.ndarray, key: Ints) -> float:
    """Return the median time between the frames of a recording (R,), 0 where it has no two.

    Stamps that differ within a frame count as one.
    """
    steps = _steps(numbers, key)
    longest = _longest_inside(steps)
    return float(np.median(steps[steps > longest])) if len(steps) else 0.0


def frame_starts(stamp: Ints, key: Ints) -> Ints | None:
    """Return the first stamp (R,) of each row's frame where the rows of a frame differ in stamp; None otherwise."""
    longest = _longest_inside(_steps(stamp, key))
    return group_stamps(stamp, key, longest) if longest else None


def group_stamps(stamp: Ints, key: Ints, longest: float) -> Ints:
    """Return the first stamp of each stamp's frame; neighbouring stamps up to `longest` apart are of one frame."""
    order = np.lexsort((stamp, key))
    ordered = stamp[order]
    begins = np.r_[True, (np.diff(key[order]) != 0) | (np.diff(ordered) > longest)]
    found = np.empty_like(stamp)
    found[order] = ordered[np.flatnonzero(begins)[np.cumsum(begins) - 1]]
    return found


def _steps(numbers: np.ndarray, key: Ints) -> np.ndarray:
    order = np.lexsort((numbers, key))
    steps = np.diff(numbers[order])[np.diff(key[order]) == 0]
    return np.asarray(steps[steps > 0])


def _longest_inside(steps: np.ndarray) -> float:
    """Return the longest step between stamps of one frame; 0 where frames have one stamp.

    The widest gap of the sorted steps divides steps inside of frames from steps between frames: the next longer step is
    at least three times as long, and many steps are on either side.
    """
    ordered = np.sort(steps)
    count = len(ordered)
    low, high = int(0.3 * count), count - max(4, count // 100)
    if high <= low:
        return 0.0
    ratio = ordered[low + 1 : high + 1] / ordered[low:high]
    place = int(np.argmax(ratio))
    return float(ordered[low + place]) if ratio[place] >= APART else 0.0


def read_stamps(reading: Reading, numbers: np.ndarray, key: Ints, unit: str | None) -> Ints:
    """Return stamps (R,) in nanoseconds of times (R,) of recordings `key` (R,); `unit` is in the name of the column.

    Raises:
        DatasetError: The values count frames, or no unit fits them.
    """
    asked = reading.chosen("time", SECONDS)
    period = median_step(numbers, key)
    fitting = [name for name, size in SECONDS.items() if PERIODS[0] <= period * size <= PERIODS[1]]
    dated = [name for name, size in SECONDS.items() if DATED[0] <= float(numbers.max(initial=0)) * size <= DATED[1]]
    stated, how = asked or unit, ""
    if stated is None:
        both = [name for name in fitting if name in dated]
        counts = period == 1.0 and not dated and bool(np.all(numbers == np.round(numbers)))
        found = both or fitting or dated or (["s"] if not period else [])
        how = ", by their date" if both or not fitting else ""
        if counts or len(found) != 1:
            what = "whole numbers in steps of 1, which may count frames" if counts else f"steps of {period:g}"
            reading.refuse("time", "a unit of time", what, "--option time=s, ms, us or ns, or rate=HZ")
        stated = found[0] if found else "s"
    elif asked is None and period and not (0.2 * PERIODS[0] <= period * SECONDS[stated] <= 6.0 * PERIODS[1]):
        for other in fitting[:1]:
            expected = f"frames at a plausible rate: in {_WORDS[stated]}, as the column's name says, {period:g} apart"
            reading.refuse(
                "time", expected, f"steps that fit {_WORDS[other]}", f"--option time={other}, or time={stated}"
            )
    rate = f"frames at {1.0 / (period * SECONDS[stated]):.3g} Hz" if period else "one stamp"
    reading.note("time", f"stamps are in {_WORDS[stated]}{how}: {rate}", "" if asked else "--option time=UNIT")
    if numbers.dtype.kind == "i":
        return numbers * round(SECONDS[stated] * 1e9)
    return np.round(numbers * (SECONDS[stated] * 1e9)).astype(np.int64)


_WORDS: Final = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


def read_angle(reading: Reading, name: str, values: Floats, unit: str | None) -> Floats:
    """Return the angles of a pose in radians; the unit follows from the name of the column and their range."""
    chosen = reading.chosen("yaw", ("degrees", "radians")) or _UNITS.get(unit or "")
    most = float(np.abs(values).max(initial=0.0))
    if chosen is None:
        chosen = "degrees" if most > FULL_TURN else "radians"
        reading.note("pose", f"{name} is taken for {chosen} (up to {most:.4g})", "--option yaw=degrees, radians")
    return np.deg2rad(values) if chosen == "degrees" else values


_UNITS: Final = {"deg": "degrees", "rad": "radians"}


def read_turn(reading: Reading, topic: str, parts: Floats, *, named: bool) -> Floats:
    """Return quaternions (R, 4) as w, x, y, z from `parts`, in the order of the columns unless these are `named`."""
    order = reading.chosen("quaternion", ("wxyz", "xyzw"))
    if order is None and not named and len(parts):
        level = np.nanmax(np.abs(parts), axis=0) < UPRIGHT
        looks_xyzw, looks_wxyz = bool(level[0] and level[1]), bool(level[1] and level[2])
        if looks_xyzw and looks_wxyz:
            expected = "quaternions whose order is told by upright boxes"
            reading.refuse(topic, expected, "boxes that all have one of two headings", "--option quaternion=wxyz, xyzw")
        order = "xyzw" if looks_xyzw else "wxyz"
        how = "as boxes then stand upright" if looks_xyzw != looks_wxyz else "which nothing contradicts"
        reading.note(topic, f"quaternions are in the order {' '.join(order)}, {how}", "--option quaternion=wxyz, xyzw")
    return parts[:, [3, 0, 1, 2]] if order == "xyzw" else parts


def read_heading(
    reading: Reading,
    values: Floats,
    unit: str | None,
    moves: Moves,
    carry: Callable[[Floats, Ints], Floats],
    *,
    strict: bool,
) -> Floats:
    """Return headings (B,) in radians, counter-clockwise from x.

    Args:
        reading: Gets the findings.
        values: (B,) of the table.
        unit: Unit in the name of the column; `quaternion` where the values come from one.
        moves: Moves of the boxes, in the world.
        carry: Returns headings in the world from headings (K,) and the rows (K,) of their boxes.
        strict: Whether headings that disagree with the motion are refused, and not only noted.
    """
    asked = reading.chosen("yaw", ("degrees", "radians"))
    zero = reading.chosen("heading", HEADINGS)
    stated = asked or ("radians" if unit == "quaternion" else _UNITS.get(unit or ""))
    units = [stated] if stated else ["radians", "degrees"]
    most = float(np.abs(values).max(initial=0.0))
    if len(units) > 1 and most > FULL_TURN:
        units = ["degrees"]
    readings = {(one, axis): _radians(values, one, axis) for one in units for axis in HEADINGS}
    shares = {one: _shares(yaw, moves, carry) for one, yaw in readings.items()} if len(moves) >= ENOUGH_MOVES else {}
    axis, found = zero or "x", units[0]
    what = {"quaternion": "yaw is that of quaternions"}.get(unit or "", "yaw is in {}")
    option = "" if asked or unit else "--option yaw=degrees, radians"
    if not shares:
        text = f"{what.format(found)} (up to {most:.4g}); too few boxes move to compare headings with motion"
        reading.note("yaw", text, option)
        return readings[found, axis]
    best = max((one for one in HEADINGS if one != axis), key=lambda one: shares[found, one])
    if len(units) > 1 and shares["radians", axis][0] < DOUBTFUL and shares["degrees", axis][1] >= CERTAIN:
        found = "degrees"  # within some degrees of x: then all objects go forward in one direction
    share, other = shares[found, axis][0], shares["radians" if len(units) > 1 else found, best][0]
    text = f"{share:.0%} of {len(moves)} moves are along it"
    likely = other >= (AGREED if found == units[0] else CERTAIN)
    if strict and zero is None and len(moves) >= SURE_MOVES and likely and (share < 0.5 * other or found != units[0]):
        text += f" in {found}, {other:.0%} if it is measured from {best.replace('-clockwise', ' clockwise')}"
        choice = f"--option heading={best}, or heading=x to keep it"
        reading.refuse("yaw", "headings along the motion of the boxes", text, choice)
        return readings[found, axis]
    doubt = "headings and motion disagree: " if share < LEAST_ALONG else ""
    reading.note("yaw", f"{what.format(found)}: {doubt}{text}", option)
    return readings[found, axis]


def _radians(values: Floats, unit: str, axis: str) -> Floats:
    sign, offset = HEADINGS[axis]
    return wrap_angle(sign * (np.deg2rad(values) if unit == "degrees" else values) + offset)


def _shares(yaw: Floats, moves: Moves, carry: Callable[[Floats, Ints], Floats]) -> tuple[float, float, float]:
    """Return the shares of moves along the headings and forward along them, and how near the others are, for ties."""
    off = np.abs(moves.turn(carry(yaw[moves.start], moves.start)))
    aligned = np.minimum(off, np.pi - off) < SAME_DIRECTION
    return float(np.mean(aligned)), float(np.mean(off < SAME_DIRECTION)), -float(np.mean(off))


def read_velocity(
    reading: Reading, velocity: Floats, moves: Moves, carry: Callable[[Floats, Ints], Floats], *, posed: bool
) -> str:
    """Return the axes of velocities (B, 2), m/s, NaN where unknown: `sensor`, or `world` where boxes are `posed`.

    The other arguments are as for `read_heading`.
    """
    asked = reading.chosen("velocity", ("sensor", "world"))
    known = moves.take(np.asarray(np.isfinite(velocity[moves.start]).all(axis=1)))
    if len(known) < ENOUGH_MOVES:
        return asked or "sensor"
    given = velocity[known.start]
    speed = np.hypot(*given.T)
    course = carry(np.arctan2(given[:, 1], given[:, 0]), known.start)
    along = {"sensor": speed[:, None] * np.column_stack([np.cos(course), np.sin(course)]), "world": given}
    off = {axes: float(np.median(np.linalg.norm(one - known.velocity, axis=1))) for axes, one in along.items()}
    option = "--option velocity=sensor, world" if posed else ""
    axes = asked or ("world" if posed and off["world"] < 0.5 * off["sensor"] and off["sensor"] > SLOW else "sensor")
    real = float(np.median(np.hypot(*known.step.T) / known.duration))
    if off[axes] > max(2.0 * SLOW, 0.5 * real):
        text = f"velocities and motion disagree: {np.median(speed):.3g} m/s on average, boxes move at {real:.3g} m/s"
        reading.note("velocity", f"{text}; another unit, or relative to the sensor?", option)
    elif posed:
        reading.note("velocity", f"velocities are along the axes of the {axes}, as boxes move", "" if asked else option)
    return axes


SLOW: Final = 0.5  # differences of velocities up to it say nothing, m/s


def read_sizes(reading: Reading, sizes: Floats, names: np.ndarray, *, stated: bool) -> Floats:
    """Return length, width, height of sizes (B, 3) in the order of the columns, whose names may be `stated`.

    The order follows from vehicles, whose median length exceeds their width by far, and is height, width, length when
    the longest comes last.
    """
    order = reading.chosen("sizes", ("lwh", "wlh", "hwl"))
    if order is None:
        long = {name for name in np.unique(names).tolist() if class_like(name, LONG)}
        vehicles = sizes[np.isin(names, list(long))]
        median = np.median(vehicles, axis=0) if len(vehicles) else np.array([3.0, 2.0, 1.0])
        longest = int(np.argmax(median))
        looks = ("lwh", "wlh", "hwl")[longest] if median[longest] > 1.5 * np.median(median) else "lwh"
        words = ", ".join(_SIDES[letter] for letter in looks)
        if looks != "lwh" and stated:
            reading.note("sizes", f"sizes look like {words}, not as their columns are named", f"--option sizes={looks}")
            looks = "lwh"
        elif looks != "lwh" or not stated:
            how = f"as the {'/'.join(sorted(long))} boxes have them" if len(vehicles) else "which nothing contradicts"
            reading.note("sizes", f"sizes are {words}, {how}", "--option sizes=lwh, wlh, hwl")
        order = looks
    return sizes[:, [order.index(letter) for letter in "lwh"]]


LONG: Final = ("car", "truck", "bus", "trailer")
_SIDES: Final = {"l": "length", "w": "width", "h": "height"}


def read_axes(reading: Reading, center: Floats) -> bool:
    """Return whether boxes have the axes of a camera.

    Raises:
        DatasetError: The axes look like a camera's, and no option says so.
    """
    axes = reading.chosen("axes", ("z-up", "camera"))
    if axes is None and len(center) > 1:
        low, high = np.quantile(center, [0.05, 0.95], axis=0)
        across, up = (high - low)[1:]
        if up > SPREAD and up > 3.0 * across:
            found = f"z from {low[2]:.3g} to {high[2]:.3g} m and y from {low[1]:.3g} to {high[1]:.3g} m"
            expected = (
                "z to point up (--option axes=z-up), or camera axes: x right, y down, z forward, y at the bottom of "
                "the box, yaw about y as in KITTI"
            )
            reading.refuse("axes", expected, found, "--option axes=camera")
    return axes == "camera"


def read_digits(reading: Reading, center: Floats) -> None:
    """Report coordinates that have lost digits."""
    plane = center[:, :2]
    if not len(plane) or float(np.abs(plane).max()) < FAR:
        return
    single = plane.astype(np.float32)
    off = np.abs(plane - single) / np.spacing(np.abs(single))  # of double precision a quarter on average
    for steps, alike in (
        ("whole metres", bool(np.all(plane == np.round(plane)))),
        ("single precision", float(np.mean(off)) < SINGLE),
    ):
        if alike:
            lost = f"coordinates up to {np.abs(plane).max():.4g} m have the digits of {steps} only"
            reading.note("position", f"{lost}; motion below their steps is lost")
            return


def read_scores(reading: Reading, scores: Floats, rows: Ints) -> Floats:
    """Return scores (B,) of the boxes in `rows` of the table as probabilities; NaN where one is to be left out.

    Raises:
        DatasetError: Some are outside of 0 to 1, and no kind of score fits all.
    """
    kind = reading.chosen("score", ("probability", "logit", "percent"))
    rounded = (scores > 1.0) & (scores <= 1.0 + ROUNDING)
    outside = ((scores < 0.0) | (scores > 1.0)) & ~rounded
    low, high = float(scores.min(initial=0.0)), float(scores.max(initial=0.0))
    if kind is None and float(np.mean(outside) if len(scores) else 0.0) > FEW:
        kind = "percent" if low >= 0.0 and high > PERCENT / 4 else "logit"
        if high > PERCENT or (kind == "logit" and max(high, -low) > LOGIT):
            expected = "scores that are probabilities, percent or logits; scale them to 0 to 1"
            reading.refuse("score", expected, f"scores from {low:.4g} to {high:.4g}")
        taken = "divided by 100" if kind == "percent" else "taken through a sigmoid"
        text = f"scores look like {'percent' if kind == 'percent' else 'logits'} ({low:.3g} to {high:.4g}): {taken}"
        reading.note("score", text, "--option score=probability, logit, percent")
    if kind == "logit":
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(scores, -LOGIT, LOGIT))), dtype=np.float64)
    if kind == "percent":
        scores = scores / PERCENT
    elif rounded.any():
        reading.note("score", f"{int(rounded.sum())} scores up to {scores[rounded].max():.9g} are taken for 1")
        scores = np.where(rounded, 1.0, scores)
    wrong = (scores < 0.0) | (scores > 1.0)
    if wrong.any() and reading.options.get("invalid") != "skip":
        place = int(np.flatnonzero(wrong)[0])
        option = "--option invalid=skip leaves such rows out; score=logit, percent reads others"
        reading.refuse("score", "a score from 0 to 1", f"{scores[place]:g}", option, int(rows[place]))
    return np.where(wrong, np.nan, scores)

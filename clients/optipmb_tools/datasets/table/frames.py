"""Frames of a table: rows grouped by their stamps, and doubts about these."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.motion import MOST_ALONE, REACH, SPEEDS, find_reports, kinds_apart, next_steps, overlapping
from optipmb_tools.datasets.table.draft import Draft, Stamps
from optipmb_tools.datasets.table.findings import NOISE, Claim, Reading
from optipmb_tools.datasets.table.times import (
    DATED,
    LONGEST_GAP,
    PERIODS,
    frame_starts,
    group_stamps,
    median_step,
    rows_of_frames,
)
from optipmb_tools.geometry import Ints

CROWDED: Final = 0.5  # share of boxes that share their place with another one from which their stamps cannot be right
ROUNDED: Final = 1e-3  # relative difference of a step from a power of ten
FASTEST: Final = 30.0  # frames a second of a detector
UNITS_APART: Final = 100.0  # ratio of steps, many of either length, from which stamps have two units
_TWICE: Final = 0.25  # share of boxes at the place of another one from which objects are reported twice
_MOST_SENSORS: Final = 16
_MANY: Final = 30  # boxes that tell whether any can be followed


def step(reading: Reading, draft: Draft) -> Draft:
    """Group the rows into frames, and doubt their stamps by the places of the boxes."""
    framed = replace(draft, stamps=_framed(reading, draft))
    _check_times(reading, framed)
    frame = np.unique(np.column_stack([draft.series, framed.stamps.ns])[draft.row], axis=0, return_inverse=True)[1]
    apart = kinds_apart(frame.reshape(-1), draft.center[:, :2], draft.size, draft.kind)
    names = sorted(set(draft.name[np.isin(draft.kind, apart)].tolist()))
    if names:
        reading.note(
            "rows", f"boxes of class {', '.join(names)} stand close together and keep apart: each is one thing"
        )
    return replace(framed, apart=tuple(names))


def reports(reading: Reading, draft: Draft) -> Draft:
    """Tell whether objects report one by one."""
    row = draft.row
    if not draft.scored or draft.pose is not None or "sensor" in draft.roles or draft.placed is not None:
        return draft
    found = find_reports(draft.series[row], draft.stamps.ns[row] / 1e9, draft.center[:, :2], draft.kind)
    steps, times = next_steps(draft.series[row], draft.stamps.ns[row] / 1e9, draft.center[:, :2], draft.kind)
    far = float(np.mean(steps > REACH[0] + SPEEDS[0] * times)) if len(steps) >= _MANY else 0.0
    received = f"{far:.0%} of {len(steps)} boxes without one of their class within {SPEEDS[0]:g} m/s"
    if far:
        received += f": the nearest are {np.median(steps):.3g} m away after {np.median(times):.3g} s"
    claims = [
        Claim(
            "frames",
            option="--option time=UNIT, rate=HZ, length_factor=FACTOR; time=s keeps seconds",
            possible=found is None and (far <= MOST_ALONE or bool({"time", "rate", "group"} & reading.options.keys())),
        )
    ]
    if found is not None:
        text = f"objects report one by one: a frame is a look at {found.distance:.3g} m around its box"
        claims.append(Claim("reports", text=text, option="--option group=SECONDS joins them", wins="doubt"))
    reading.decide("time", claims, expected="boxes that can be followed from frame to frame", received=received)
    return replace(draft, reports=found)


def _framed(reading: Reading, draft: Draft) -> Stamps:
    """Return the stamps of frames; refuse frames most of whose boxes stand at the places of others."""
    stamps, series, row = draft.stamps, draft.series, draft.row

    def at_places(stamp: Ints, part: NDArray[Any]) -> Ints:
        frame = series[row]
        for one in (stamp, part):
            place = np.unique(one[row], return_inverse=True)[1]
            frame = np.unique(frame * len(stamp) + place, return_inverse=True)[1].astype(np.int64)
        return overlapping(frame, draft.center[:, :2], draft.size, draft.kind, draft.score)

    def crowd(stamp: Ints, part: NDArray[Any] = series) -> float:
        return float(np.mean(at_places(stamp, part) > 1)) if len(row) else 0.0

    column = draft.roles.get("frame")
    numbers = None if column is None or column.name == stamps.column else draft.frame_numbers
    name = "" if column is None else column.name
    stamps = read_frames(reading, stamps, series, numbers, crowd, name)
    share = crowd(stamps.ns) if draft.scored else 0.0
    if share <= _TWICE:
        return stamps
    used = {one.name for one in draft.roles.values()}
    parts = (name for name in draft.columns if name not in used and _is_name_of_few(draft, name))
    divider = next((name for name in parts if crowd(stamps.ns, draft.columns[name]) < NOISE), None)
    counts = at_places(stamps.ns, series)
    crowded = share > CROWDED and "time" not in reading.options
    merged = share > CROWDED and may_be_merged(stamps.ns, series, float(np.median(counts[counts > 1])))
    received = f"{share:.0%} of the boxes at the place of another one of their stamp and class"
    lost = "stamps have lost digits, frames were merged, or two detectors see each object"
    claims = (
        Claim("apart", possible=False),
        Claim(
            "sensors",
            text=f"{received}, which differs in column {divider}",
            option=f"--option column.sensor={divider}",
            wins="refused" if crowded else "doubt",
            possible=divider is not None,
        ),
        Claim(
            "merged",
            text=f"{received}: {lost}",
            option="--option time=UNIT, if the stamps are right",
            wins="refused" if crowded else "doubt",
            possible=merged,
        ),
        Claim(
            "twice",
            text=f"{received}: objects are reported twice, by two detectors or before suppression",
            wins="doubt",
        ),
    )
    topic = "time" if crowded and (merged or divider is not None) else "rows"
    reading.decide(topic, claims, expected="boxes apart from each other under one stamp")
    return stamps


def _check_times(reading: Reading, draft: Draft) -> None:
    """Refuse stamps far from all others, and whole milliseconds that may be seconds by the speeds of the boxes."""
    stamps, series, row = draft.stamps, draft.series, draft.row
    refuse_gap(reading, stamps.ns, series)
    counted = "stamp" not in draft.roles or {"time", "rate"} & reading.options.keys()
    if counted or not may_be_seconds(stamps, series, draft.unit("stamp")):
        return
    steps, times = next_steps(series[row], stamps.ns[row] / 1e9, draft.center[:, :2], draft.kind)
    speed = float(np.quantile(steps / times, 0.75)) if len(steps) else 0.0  # others may stand
    text = f"whole numbers that may be seconds; in milliseconds, boxes go at {speed:.3g} m/s"
    seconds = Claim("s", text=text, option="--option time=s, or time=ms", wins="refused")
    reading.decide("time", (Claim("ms", possible=speed <= SPEEDS[0]), seconds), expected="a unit of time")


def _is_name_of_few(draft: Draft, column: str) -> bool:
    """Tell whether a column may have the names of a few sensors."""
    values = draft.columns[column]
    return values.dtype.kind in "iU" and 1 < len(np.unique(values)) <= _MOST_SENSORS


def may_be_merged(stamp: Ints, key: Ints, boxes: float) -> bool:
    """Tell whether each of the stamps (R,) may hold several frames, given the number of `boxes` at one place.

    Then they are a power of ten apart, or further than frames are, and no detector is faster than the merged frames.
    """
    step = median_step(stamp, key) / 1e9
    rounded = not step or step > PERIODS[1] or abs(np.log10(step) - round(np.log10(step))) < ROUNDED
    return bool(rounded and (not step or boxes <= FASTEST * step))


def may_be_seconds(stamps: Stamps, key: Ints, unit: str | None) -> bool:
    """Tell whether stamps that were taken for milliseconds are whole numbers of a step that may be seconds."""
    numbers = stamps.time
    if unit is not None or numbers.dtype.kind not in "if" or not np.all(numbers == np.round(numbers)):
        return False
    step = median_step(numbers, key)
    return bool(PERIODS[1] < step <= LONGEST_GAP and float(numbers.max(initial=0)) < DATED[0])


def refuse_gap(reading: Reading, stamp: Ints, key: Ints) -> None:
    """Refuse a stamp that is further from the others of its recording than these are from each other."""
    for one in np.unique(key).tolist():
        rows = np.flatnonzero(key == one)
        ordered = np.unique(stamp[rows])
        steps = np.diff(ordered)
        if len(steps) < 2:  # noqa: PLR2004  of two stamps none is the odd one
            continue
        low, high = np.quantile(steps, (0.2, 0.8)).tolist()
        place = int(np.argmax(steps))
        gap = int(steps[place])
        rest = int(steps.sum()) - gap
        if high <= UNITS_APART * low and (gap <= LONGEST_GAP * 1e9 or gap <= rest):
            continue
        before = stamp[rows] <= ordered[place]
        few = rows[before if before.sum() < 0.5 * len(rows) else ~before]
        count = f"{len(few)} of {len(rows)} rows are {gap / 1e9:.6g} s from the others, which span {rest / 1e9:.6g} s"
        if "time" in reading.options:
            reading.doubt("time", count)
        else:
            option = "--option time=UNIT, if the stamps are right"
            reading.refuse("time", "stamps of one recording in one unit", count, option, int(few[0]))


def read_frames(
    reading: Reading,
    stamps: Stamps,
    series: Ints,
    number: NDArray[Any] | None,
    crowd: Callable[[Ints], float],
    name: str,
) -> Stamps:
    """Return the stamps of frames: equal for boxes of a frame that have stamps of their own.

    Args:
        reading: Gets the findings.
        stamps: Of the rows (R,).
        series: (R,) recording of each row.
        number: (R,) of frames; None without such a column.
        crowd: Returns the share of boxes that share their place under stamps (R,).
        name: Of the column of `number`.
    """

    def of(first: Ints) -> Stamps:
        return Stamps(stamps.ns[first], stamps.time[first], stamps.column, stamps.skipped)

    asked = reading.positive("group", "seconds", zero=True)
    if asked is not None:
        return of(group_stamps(stamps.ns, series, asked * 1e9, whole=True)) if asked else stamps
    most = max(0.5 * CROWDED, crowd(stamps.ns))
    by_number = None if number is None else rows_of_frames(stamps.ns, number, series)
    by_step = frame_starts(stamps.ns, series)
    claims, found = [Claim("stamp")], {"stamp": stamps}
    if by_step is not None:
        found["step"] = of(by_step)
        apart, frames = (stamps.ns - found["step"].ns).max() / 1e9, len(np.unique(found["step"].ns))
        text = f"stamps differ by up to {apart:.3g} s within a frame: grouped into {frames} frames"
        possible = crowd(found["step"].ns) <= most
        claims.insert(0, Claim("step", text=text, option="--option group=SECONDS, 0 for none", possible=possible))
    if by_number is not None:
        found["number"] = of(by_number)
        text = f"stamps differ within a frame: each has the first one of its {name}"
        claims.insert(0, Claim("number", text=text, possible=crowd(found["number"].ns) <= most))
        if not claims[0].possible:
            text = f"column {name} is not used: its frames hold boxes at one place"
            reading.doubt("time", text, f"--option column.frame={name}")
    return found[reading.decide("time", claims)]

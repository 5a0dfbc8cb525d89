"""Stamps of a table: unit, origin, and the steps between them."""

import re
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.table.columns import UNITS, TableColumn
from optipmb_tools.datasets.table.draft import Draft, Stamps, missing, numbers
from optipmb_tools.datasets.table.findings import HALF, Claim, Reading
from optipmb_tools.files import is_number
from optipmb_tools.geometry import Bools, Ints
from optipmb_tools.table_files import NO_VALUE

SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_WORDS: Final = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
DATED: Final = (1e8, 4.2e9)  # seconds since 1970 that are taken for a date: 1973 to 2103
PERIODS: Final = (0.005, 10.0)  # shortest and longest time between frames that is plausible, s
SLOWEST: Final = 3600.0  # s between frames that no option confirms
COUNTED_HZ: Final = 10.0  # default rate of frames that are counted and not stamped
APART: Final = 3.0  # ratio of the shortest step between frames to the longest step inside of one
NEAR: Final = 5.0  # steps of a counter from its end to its beginning, where it wraps
LONGEST_GAP: Final = 60.0  # s; a longer one than this and than all other steps together is a fault of a stamp
_WRAPS: Final = (
    *(2.0**bits for bits in (16, 24, 31, 32)),
    *(size * 10.0**power for size in (1, 60, 3600, 86400, 604800) for power in (0, 3, 6, 9)),
)
"""Ends of counters: of bits, a second, a minute, an hour, a day and a week, in any unit."""
_MEASURED: Final = re.compile(r"([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([a-zA-Z]+)")
_DIGITS: Final = 18
DAY: Final = 86400.0
_DAYS: Final = {"a spreadsheet": (25569.0, (30_000.0, 80_000.0)), "MATLAB": (719529.0, (700_000.0, 800_000.0))}
"""Days of 1970-01-01 in the serial dates of programs, and the days of dates from 1982 to 2119."""
_TURN: Final = 40.0  # what hhmmss counts too much at the turn of a minute
_YEARS: Final = (1970, 2100)
_CLOCK: Final = (24, 60, 60)
_CLOCK_TEXT: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:\.\d*)?)")


def median_step(numbers: np.ndarray, key: Ints) -> float:
    """Return the median time between the frames of a recording (R,), 0 where it has no two.

    Stamps that differ within a frame count as one.
    """
    steps = _steps(numbers, key)
    longest = _longest_inside(steps)
    return float(np.median(steps[steps > longest])) if len(steps) else 0.0


def read_clock(texts: NDArray[np.str_]) -> np.ndarray | None:
    """Return the seconds (R,) of times of a day, as `12:59:58.250`; None where one of them is something else."""
    found = [_CLOCK_TEXT.fullmatch(text.strip()) for text in texts.tolist()]
    parts = [match.groups() for match in found if match is not None]
    if len(parts) < len(found):
        return None
    return np.array([3600 * int(hour) + 60 * int(minute) + float(second) for hour, minute, second in parts])


def frame_starts(stamp: Ints, key: Ints) -> Ints | None:
    """Return the row (R,) of the first stamp of each row's frame where the rows of a frame differ; None otherwise."""
    longest = _longest_inside(_steps(stamp, key))
    return group_stamps(stamp, key, longest) if longest else None


def group_stamps(stamp: Ints, key: Ints, longest: float, *, whole: bool = False) -> Ints:
    """Return the row (R,) of the first stamp of each stamp's frame.

    Neighbouring stamps up to `longest` apart are of one frame; with `whole`, so are its first and its last one.
    """
    order = np.lexsort((stamp, key))
    ordered, new = stamp[order], np.diff(key[order]) != 0
    begins = np.r_[True, new | (np.diff(ordered) > longest)]
    if whole:
        start = 0
        ends = np.flatnonzero(np.r_[new, True]) + 1
        while start < len(order):
            begins[start] = True
            end = int(ends[np.searchsorted(ends, start, side="right")])
            after = start + int(np.searchsorted(ordered[start:end], ordered[start] + longest, side="right"))
            begins[start + 1 : after] = False
            start = after
    return _first_rows(order, begins)


def rows_of_frames(stamp: np.ndarray, number: NDArray[Any], key: Ints) -> Ints | None:
    """Return the row (R,) of the first stamp of each row's frame by the numbers of frames.

    None where frames do not follow each other in time, or where each has one stamp.
    """
    frame = np.unique(key * len(stamp) + np.unique(number, return_inverse=True)[1], return_inverse=True)[1]
    order = np.lexsort((frame, stamp, key))
    begins = np.r_[True, np.diff(frame[order]) != 0]
    first = _first_rows(order, begins)
    return None if int(begins.sum()) > frame.max() + 1 or np.array_equal(stamp[first], stamp) else first


def _first_rows(order: Ints, begins: Bools) -> Ints:
    found = np.empty_like(order)
    found[order] = order[np.flatnonzero(begins)[np.cumsum(begins) - 1]]
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


def read_stamps(reading: Reading, numbers: np.ndarray, key: Ints, unit: str | None, frame: NDArray[Any] | None) -> Ints:
    """Return stamps (R,) in nanoseconds of times (R,) of recordings `key` (R,); `unit` is in the name of the column.

    `frame` (R,) are the numbers of the frames, if the table has them.

    Raises:
        DatasetError: The values count frames, or no unit fits them.
    """
    asked = reading.chosen("time", SECONDS)
    if asked is None and len(numbers) and (read := _calendar(reading, numbers, unit)) is not None:
        return unwrapped(reading, read, key)
    if asked is None and unit is None and (days := _serial_days(reading, numbers, key)) is not None:
        return days
    numbers = unwrapped(reading, numbers, key)
    first = None if frame is None else rows_of_frames(numbers, frame, key)
    period = median_step(numbers if first is None else numbers[first], key)
    fitting = [name for name, size in SECONDS.items() if PERIODS[0] <= period * size <= PERIODS[1]]
    dated = [name for name, size in SECONDS.items() if DATED[0] <= float(numbers.max(initial=0)) * size <= DATED[1]]
    how = ""
    if unit is None:
        both = [name for name in fitting if name in dated]
        counts = period == 1.0 and not dated and bool(np.all(numbers == np.round(numbers)))
        found = [] if counts else both or fitting or dated or (["s"] if not period else [])
        how = ", by their date" if (both or not fitting) and asked is None else ""
        option, expected = "--option time=s, ms, us or ns, or rate=HZ", "a unit of time"
        claims = [Claim(one, option=option, possible=one in found) for one in SECONDS]
        received = "whole numbers in steps of 1, which may count frames" if counts else f"steps of {period:g}"
    else:
        slow, fast = 6.0 * PERIODS[1], 0.2 * PERIODS[0]
        expected = f"frames at a plausible rate: in {_WORDS[unit]}, as the column's name says, {period:g} apart"
        claims = [Claim(unit, possible=not period or fast <= period * SECONDS[unit] <= slow)]
        claims += [
            Claim(
                one, text=f"steps that fit {_WORDS[one]}", option=f"--option time={one}, or time={unit}", wins="refused"
            )
            for one in fitting[:1]
        ]
        received = ""
    stated = asked or reading.decide("time", claims, expected=expected, received=received)
    if period * SECONDS[stated] > SLOWEST and not (asked or unit):
        what = f"steps of {period:g}, which are {period * SECONDS[stated]:.3g} s in {_WORDS[stated]}"
        reading.refuse("time", "frames at a plausible rate", what, "--option time=UNIT")
    rate = f"frames at {1.0 / (period * SECONDS[stated]):.3g} Hz" if period else "one stamp"
    reading.note("time", f"stamps are in {_WORDS[stated]}{how}: {rate}", "" if asked else "--option time=UNIT")
    return nanoseconds(reading, numbers, SECONDS[stated] * 1e9)


def nanoseconds(reading: Reading, numbers: NDArray[Any], unit: float) -> Ints:
    """Return stamps (R,) of times in units of so many nanoseconds.

    Raises:
        DatasetError: One is beyond 64 bits.
    """
    beyond = ~(np.abs(numbers.astype(np.float64)) < 2.0**63 / max(unit, 1.0))
    replace(reading, lenient=False).first("time", beyond, "stamps that fit into 64 bits of nanoseconds", numbers)
    if numbers.dtype.kind in "iu" and unit.is_integer():
        return numbers.astype(np.int64) * int(unit)
    return np.round(numbers * unit).astype(np.int64)


def _serial_days(reading: Reading, numbers: np.ndarray, key: Ints) -> Ints | None:
    """Return stamps in nanoseconds of days with decimals, as spreadsheets and MATLAB count them; None of others."""
    if numbers.dtype.kind != "f" or not len(numbers):
        return None
    for program, (epoch, (low, high)) in _DAYS.items():
        if not low <= numbers.min() <= numbers.max() <= min(high, numbers.min() + 1.0):
            continue
        step = median_step(np.round(numbers * DAY, 4), key)  # such numbers have the digits of microseconds
        if PERIODS[0] <= step <= PERIODS[1]:
            reading.note("time", f"stamps are days of {program}", "--option time=UNIT")
            return np.round((numbers - epoch) * DAY * 1e4).astype(np.int64) * 100_000
    return None


def _calendar(reading: Reading, numbers: np.ndarray, unit: str | None) -> Ints | None:
    """Return stamps in nanoseconds of numbers whose digits are YYYYMMDDhhmmss or hhmmss, with any decimals."""
    if not ((numbers >= 0) & (numbers < 2**63)).all():
        return None
    for decimals in range(10) if numbers.dtype.kind in "iu" else (0,):
        whole = numbers // 10**decimals
        part = (numbers - whole * 10**decimals) / 10**decimals
        day, clock = (whole // 10**6).astype(np.int64), (whole % 10**6).astype(np.int64)
        fields = np.column_stack((clock // 10**4, clock // 100 % 100, clock % 100))
        if (fields >= _CLOCK).any():
            continue
        seconds = fields @ np.array([3600, 60, 1])
        dated = bool(np.all((day // 10**4 >= _YEARS[0]) & (day // 10**4 <= _YEARS[1])))
        if dated:
            texts = [f"{one // 10**4}-{one // 100 % 100:02d}-{one % 100:02d}" for one in day.tolist()]
            try:
                seconds = seconds + np.array(texts, dtype="datetime64[s]").astype(np.int64)
            except ValueError:
                continue
        elif day.any() or decimals % 3 or unit not in {None, "s"} or not _turns_minutes(whole + part, seconds + part):
            continue
        text = f"stamps are {'YYYYMMDD' * dated}hhmmss, as their digits say"
        reading.note("time", text, "--option time=UNIT")
        found: Ints = seconds * 1_000_000_000 + np.round(part * 1e9).astype(np.int64)
        return found
    return None


def _turns_minutes(digits: np.ndarray, seconds: np.ndarray) -> bool:
    """Tell whether digits hhmmss (R,) go on by 41 at the turn of each minute, where `seconds` (R,) go on evenly."""
    raw, read = np.unique(digits), np.unique(seconds)
    steps = np.diff(read)
    if len(raw) != len(read) or not len(steps):
        return False
    usual, turns = float(np.median(steps)), np.diff(raw // 100) > 0
    rarely = PERIODS[0] <= usual <= PERIODS[1] and 0.0 < usual * turns.sum() < HALF * steps.sum()
    return rarely and bool(np.diff(raw)[turns].min() >= _TURN and steps[turns].max() <= NEAR * usual)


def unwrapped(reading: Reading, numbers: np.ndarray, key: Ints) -> np.ndarray:
    """Return times (R,) that go on where the counter of their clock begins again, as the order of the rows shows."""
    found = numbers
    for one in np.unique(key).tolist():
        rows = np.flatnonzero(key == one)
        values = numbers[rows]
        steps = np.diff(values)
        back = np.flatnonzero(steps < 0)
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        if not len(back) or not usual or len(back) > MOST_BACK:
            continue
        ends, begins = values[back], values[back + 1]
        fitting = [w for w in _WRAPS if np.all((ends < w) & (ends > w - NEAR * usual) & (begins < NEAR * usual))]
        path, line = reading.place(int(rows[back[0] + 1]))
        if fitting and values.min() >= 0:
            wraps = np.zeros(len(rows), dtype=numbers.dtype if numbers.dtype.kind == "f" else np.int64)
            wraps[back + 1] = fitting[0]
            found = found.astype(wraps.dtype)
            found[rows] += np.cumsum(wraps)
            reading.note(
                "time", f"the clock begins again after {fitting[0]:.0f} at {path.name}:{line}: stamps go on there"
            )
        elif all(len(np.unique(part)) < len(part) for part in np.split(values, back + 1)):  # not object by object
            text = f"stamps go back {len(back)} times in the order of the rows, first at {path.name}:{line}"
            reading.doubt("time", f"{text}; rows are taken by their stamps", "a column recording, if it is another one")
    return found


MOST_BACK: Final = 3  # steps back of a table whose rows are in the order of time


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the stamps of all rows, or the numbers of frames."""
    return replace(draft, stamps=_stamps(reading, draft))


def _stamps(reading: Reading, draft: Draft) -> Stamps:
    found = draft.roles
    rate = reading.positive("rate", "frames per second")
    column = found.get("stamp")
    skipped = np.zeros(draft.rows, dtype=np.bool_)
    if column is None or (rate is not None and "frame" in found):
        return _counted(reading, draft, rate)
    values = draft.columns[column.name]
    missing = np.isnat(values) if values.dtype.kind == "M" else values != values  # noqa: PLR0124  NaN differs from itself
    if values.dtype.kind == "U":
        missing = np.isin(np.char.strip(values), NO_VALUE)
    if missing.any() and not missing.all() and reading.skips:
        skipped = missing
        near = np.maximum.accumulate(np.where(missing, 0, np.arange(draft.rows)))
        values = values[np.where(missing[near], np.flatnonzero(~missing)[0], near)]
    else:
        expected = f"a stamp in column {column.name} (--option invalid=skip leaves such rows out)"
        reading.strict().first("time", missing, expected, values)
    if values.dtype.kind == "M":
        reading.note("time", f"stamps are dates in column {column.name}")
        return Stamps(values.astype("datetime64[ns]").astype(np.int64), values, column.name, skipped)
    shown = values
    values, unit = _of_texts(reading, values, column) if values.dtype.kind not in "iuf" else (values, column.unit)
    if rate is not None:
        counted = "nanosec" not in found and bool(np.all((values == np.round(values)) & (values < DATED[0])))
        if counted:
            reading.note("time", f"column {column.name} counts frames, {rate:g} a second")
            return Stamps(nanoseconds(reading, values, 1e9 / rate), values, column.name, skipped)
        reading.doubt("time", f"rate is not used: column {column.name} has times, not numbers of frames")
    if "nanosec" in found:
        whole = np.asarray(values == np.floor(values))
        reading.strict().first("time", ~whole, f"whole seconds in column {column.name}", values)
        part = numbers(reading, draft, "nanosec")
        reading.strict().first("time", ~np.isfinite(part), f"nanoseconds in column {found['nanosec'].name}", part)
        reading.note("time", f"stamps are {column.name} + {found['nanosec'].name}")
        stamp = values.astype(np.int64) * 1_000_000_000 + part.astype(np.int64)
        return Stamps(stamp, stamp, "stamp_ns", skipped)
    stamp = read_stamps(reading, values, draft.series, unit, draft.frame_numbers)
    return Stamps(stamp, shown if shown.dtype.kind == "U" and unit == "s" else values, column.name, skipped)


def _of_texts(reading: Reading, values: NDArray[Any], column: TableColumn) -> tuple[np.ndarray, str | None]:
    """Return the numbers (R,) of stamps that are texts, and their unit."""
    if values.dtype.kind == "U" and (clock := read_clock(values)) is not None:
        reading.note("time", f"stamps are times of a day in column {column.name}")
        return clock, "s"
    if values.dtype.kind == "U" and (measured := _measured(values)) is not None:
        return measured
    bad = np.array([not is_number(text) for text in values.tolist()], dtype=np.bool_)
    expected = f"stamps in column {column.name}: numbers, or dates as YYYY-MM-DD HH:MM:SS.ffffff"
    reading.strict().first("time", bad, expected, values)
    texts = [text.strip() for text in values.tolist()]
    # Nanoseconds with an empty cell are texts; what is beyond 64 bits fits no unit.
    if all(text.lstrip("+-").isdigit() and len(text) <= _DIGITS for text in texts):
        return np.array([int(text) for text in texts], dtype=np.int64), column.unit
    return np.array(texts, dtype=np.float64), column.unit


def _measured(texts: NDArray[np.str_]) -> tuple[np.ndarray, str] | None:
    """Return the numbers of texts as `0.1 sec`, and their unit; None where they have none, or several."""
    found = [_MEASURED.fullmatch(text.strip()) for text in texts.tolist()]
    units = {match[2].lower() for match in found if match is not None}
    if None in found or len(units) != 1 or (unit := UNITS.get(units.pop())) not in SECONDS:
        return None
    return np.array([float(match[1]) for match in found if match is not None]), str(unit)


def _counted(reading: Reading, draft: Draft, rate: float | None) -> Stamps:
    """Return stamps from the numbers of frames."""
    column = draft.roles.get("frame")
    if column is None:
        raise missing(reading, draft, "stamp")
    frame = numbers(reading, draft, "frame")
    reading.strict().first("time", ~np.isfinite(frame), f"the number of a frame in column {column.name}", frame)
    if rate is None:
        step = median_step(frame, draft.series) or 1.0
        rate = COUNTED_HZ * step
        steps = "" if step == 1.0 else f" (numbers in steps of {step:g})"
        text = f"no column of stamps: frames of column {column.name} are taken to come at {COUNTED_HZ:g} Hz{steps}"
        reading.note("time", text, "--option rate=HZ")
    else:
        reading.note("time", f"column {column.name} counts frames, {rate:g} a second")
    stamp = nanoseconds(reading, frame, 1e9 / rate)
    return Stamps(stamp, draft.columns[column.name], column.name, np.zeros(draft.rows, dtype=np.bool_))

"""Sizes of boxes: their order and unit."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.interface import class_like
from optipmb_tools.datasets.table.draft import Draft, numbers
from optipmb_tools.datasets.table.findings import HALF, Claim, Reading
from optipmb_tools.geometry import Bools, Floats
from optipmb_tools.table_files import unique_texts

MOST_SIZES: Final = 100_000  # boxes whose sizes are looked at
LARGEST_SIZE: Final = 500.0  # m: longer than any ship
LONGER: Final = 1.3  # ratio of the longest side of a vehicle to the next one
LONG: Final = ("car", "truck", "bus", "trailer")
USUAL: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    "car": ((3.0, 6.0), (1.4, 2.4), (1.2, 2.4)),
    "bus": ((6.0, 20.0), (2.2, 3.5), (2.4, 4.5)),
    "pedestrian": ((0.25, 1.4), (0.25, 1.2), (1.2, 2.2)),
    "bicycle": ((1.2, 2.3), (0.3, 1.0), (0.9, 2.1)),
}
FACTORS: Final = {"1": "", "2": "halves", "0.5": "doubled", "0.01": "centimetres", "0.001": "millimetres",
                  "0.0254": "inches", "0.3048": "feet"}  # fmt: skip
_SIDES: Final = {"l": "length", "w": "width", "h": "height"}


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the sizes in the order of their columns."""
    centres = not {"l", "w"} & draft.roles.keys()
    ends = (("l", 1.0 if centres else None), ("w", 1.0 if centres else None), ("h", 1.5))
    factor = reading.positive("size_factor", "a factor of sizes") or 1.0
    size = factor * np.column_stack([numbers(reading, draft, role, without) for role, without in ends])
    zero = np.asarray((size[:, :2] == 0.0).all(axis=1))
    if zero.any():
        reading.note("sizes", f"{int(zero.sum())} rows have a size of 0: it is unknown")
        size[zero] = np.nan
    unsized = zero | _empty_of_class(draft, size)
    if (unsized & ~zero).any():
        names = ", ".join(np.unique(draft.name[unsized & ~zero]).tolist())
        reading.note("sizes", f"most boxes of class {names} have no size: it is unknown")
    return replace(draft, size=size, centres=centres, unsized=unsized)


def _empty_of_class(draft: Draft, size: Floats) -> Bools:
    """Return the rows (R,) without length and width whose class mostly lacks them; in others a value is missing."""
    empty = np.isnan(size[:, :2]).all(axis=1) & np.isfinite(draft.center[:, :2]).all(axis=1)
    kind = unique_texts(draft.name)[1]
    placed = np.bincount(kind, np.isfinite(draft.center[:, :2]).all(axis=1))
    return np.asarray(empty & (np.bincount(kind, empty) > HALF * placed)[kind])


def order(reading: Reading, draft: Draft) -> Draft:
    """Put sizes into the order length, width, height."""
    if draft.centres:
        return draft
    base = draft.roles["l"].base
    stated = base == "l" or base.endswith(("_l", "length"))
    return replace(draft, size=read_sizes(reading, draft.size, draft.name, stated=stated, tall="h" in draft.roles))


def read_sizes(reading: Reading, sizes: Floats, names: np.ndarray, *, stated: bool, tall: bool) -> Floats:
    """Return length, width, height of sizes (B, 3) in the order of the columns, whose names may be `stated`.

    The order is that in which vehicles are longer than wide and high; height, width, length where the longest is last.
    """
    asked = reading.chosen("sizes", ("lwh", "wlh", "hwl"))
    kinds = {name: class_like(name, tuple(USUAL)) or class_like(name, LONG) for name in unique_texts(names)[0].tolist()}
    long = [name for name, kind in kinds.items() if kind in LONG]
    some = slice(None, None, 1 + len(sizes) // MOST_SIZES)
    vehicles = sizes[some][np.isin(names[some], long)]
    with np.errstate(invalid="ignore"):
        longest = np.where(vehicles.max(axis=1, initial=0.0) > LONGER * np.median(vehicles, axis=1), 1.0, 0.0)
        side = np.argmax(np.nan_to_num(vehicles), axis=1)
    claims = []
    for place, one in enumerate(("lwh", "wlh", "hwl")):
        words = ", ".join(_SIDES[letter] for letter in one)
        how = f"as the {'/'.join(sorted(long))} boxes have them" if long else "which nothing contradicts"
        text = f"sizes are {words}, {how}"
        if stated and place:
            text = f"sizes look like {words}, not as their columns are named"
        evidence = Evidence(float((longest * (side == place)).sum()), len(vehicles))
        shown = "" if stated and not place else text
        option = f"--option sizes={one}" if stated else "--option sizes=lwh, wlh, hwl"
        claims.append(Claim(one, evidence, shown, option, "doubt" if stated else "taken"))
    held = reading.decide("sizes", claims, asked=asked)
    found = sizes[:, [held.index(letter) for letter in "lwh"]]
    if not {"size_factor", "length_factor"} & reading.options.keys():
        _check_sizes(reading, found[some], names[some], kinds, sides=2 + tall)
    return found


def _check_sizes(
    reading: Reading, sizes: Floats, names: np.ndarray, kinds: Mapping[str, str | None], *, sides: int
) -> None:
    """Doubt sizes that would be usual ones of their classes if they were multiplied by a factor."""
    usual = {name: USUAL[kind] for name, kind in kinds.items() if kind is not None and kind in USUAL}
    known = bool(usual)
    usual = usual or dict.fromkeys(kinds, USUAL["car"])  # of unknown classes the sizes of cars tell the unit of length
    rows = np.isin(names, list(usual)) & np.isfinite(sizes).all(axis=1)
    found, place = unique_texts(names[rows])
    bounds = np.array([usual[name] for name in found.tolist()]).reshape(-1, 3, 2)[place]
    claims = []
    for factor, unit in FACTORS.items():
        if not known and unit in {"halves", "doubled"}:
            continue
        size = sizes[rows] * float(factor)
        fits = ((size >= bounds[:, :, 0]) & (size <= bounds[:, :, 1]))[:, :sides].all(axis=1)
        both = f", or length_factor={factor} of all lengths" if unit not in {"", "halves", "doubled"} else ""
        option = f"--option size_factor={factor}{both}"
        claims.append(
            Claim(factor, Evidence(float(fits.sum()), len(size)), f"as {unit}" if unit else "", option, "doubt")
        )
    clash = f"sizes are not usual ones of {', '.join(sorted(usual))}"
    reading.decide("sizes", claims, "boxes have a usual size", clash=clash)

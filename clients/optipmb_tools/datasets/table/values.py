"""Units and conventions of the values of a table, found for a whole recording at once.

Each rule counts what agrees with each way to read the values: the directions in which boxes move, the classes, the
ranges. `Reading.decide` compares the counts. Results: metres, radians, z up.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.interface import class_like
from optipmb_tools.datasets.motion import LEAST_ALONG, MOST, SAME_DIRECTION, Moves
from optipmb_tools.datasets.table.findings import HALF, Claim, Reading
from optipmb_tools.geometry import Bools, Floats, Ints, wrap_angle
from optipmb_tools.table_files import unique_texts

UPRIGHT: Final = 0.3  # largest x and y of the quaternion of a box that stands upright
FULL_TURN: Final = 6.4
LARGEST_DEGREES: Final = 360.5
LARGEST_RADIANS: Final = 4.0 * np.pi
PERCENT: Final = 100.0
SPREAD: Final = 8.0
LOGIT: Final = 30.0  # beyond it a sigmoid is 0 or 1 in six decimals; scores beyond it are no logits
ROUNDING: Final = 1e-3  # scores up to so much above 1 are 1
FEW: Final = 0.05  # share of values outside of a range up to which they are mistakes and not of another kind
NOISE: Final = 0.1  # difference of two shares that tells nothing
ENOUGH_MOVES: Final = 5  # moves from which headings are compared with motion
REFUSED_MOVES: Final = 80  # moves of several objects from which headings are refused
FORWARD: Final = 0.8  # share of forward moves from which traffic shares a motion, not the sensor
SINGLE: Final = 0.1
FAR: Final = 1e5  # coordinates in metres beyond which single precision loses centimetres
MOST_SIZES: Final = 100_000  # boxes whose sizes are looked at
LARGEST_SIZE: Final = 500.0  # m: longer than any ship
LONGER: Final = 1.3  # ratio of the longest side of a vehicle to the next one
SLOW: Final = 0.5  # differences of velocities up to it say nothing, m/s
LONG: Final = ("car", "truck", "bus", "trailer")
USUAL: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    "car": ((3.0, 6.0), (1.4, 2.4), (1.2, 2.4)),
    "bus": ((6.0, 20.0), (2.2, 3.5), (2.4, 4.5)),
    "pedestrian": ((0.25, 1.4), (0.25, 1.2), (1.2, 2.2)),
    "bicycle": ((1.2, 2.3), (0.3, 1.0), (0.9, 2.1)),
}
"""Shortest and longest length, width and height of classes whose sizes differ little, m."""
FACTORS: Final = {"1": "", "2": "halves", "0.5": "doubled", "0.01": "centimetres", "0.001": "millimetres",
                  "0.0254": "inches", "0.3048": "feet"}  # fmt: skip
_SIDES: Final = {"l": "length", "w": "width", "h": "height"}
_UNITS: Final = {"deg": "degrees", "rad": "radians"}
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


def read_angle(reading: Reading, name: str, values: Floats, unit: str | None) -> Floats:
    """Return the angles of a pose in radians; the unit follows from the name of the column and their range."""
    chosen = reading.chosen("yaw", ("degrees", "radians")) or _UNITS.get(unit or "")
    if chosen is None:
        most = float(np.nanmax(np.abs(values), initial=0.0))
        chosen = "degrees" if most > FULL_TURN else "radians"
        reading.note("pose", f"{name} is taken for {chosen} (up to {most:.4g})", "--option yaw=degrees, radians")
    return np.deg2rad(values) if chosen == "degrees" else values


def no_angle(reading: Reading, values: Floats, unit: str | None) -> Bools:
    """Return which values (R,) of a column of headings are beyond any angle, such as marks for no value."""
    stated = reading.options.get("yaw") or _UNITS.get(unit or "")
    size = np.abs(np.nan_to_num(values, posinf=0.0, neginf=0.0))
    radians = stated == "radians" or (stated is None and (size > FULL_TURN).sum() <= FEW * len(size))
    return np.asarray(size > (LARGEST_RADIANS if radians else LARGEST_DEGREES), dtype=np.bool_)


def read_turn(reading: Reading, topic: str, parts: Floats, *, named: bool) -> Floats:
    """Return quaternions (R, 4) as w, x, y, z from `parts`, in the order of the columns unless these are `named`."""
    asked = reading.chosen("quaternion", ("wxyz", "xyzw"))
    if asked is None and named:
        return parts
    level = np.abs(parts[np.isfinite(parts).all(axis=1)]) < UPRIGHT
    claims = [
        Claim(
            order,
            Evidence(float(level[:, places].all(axis=1).sum()), len(level)),
            f"quaternions are in the order {' '.join(order)}",
            "--option quaternion=wxyz, xyzw",
        )
        for order, places in (("wxyz", [1, 2]), ("xyzw", [0, 1]))
    ]
    if asked is None and len(level) and min(one.evidence.share for one in claims) == 1.0:
        expected = "quaternions whose order is told by upright boxes"
        reading.refuse(topic, expected, "boxes that all have one of two headings", claims[0].option)
    order = reading.decide(topic, claims, "boxes then stand upright", asked=asked)
    return parts[:, [3, 0, 1, 2]] if order == "xyzw" else parts


def read_heading(
    reading: Reading,
    values: Floats,
    unit: str | None,
    moves: Moves,
    carry: Callable[[Floats, Ints], Floats],
    *,
    strict: bool,
    moving: bool,
    free: bool,
) -> Floats:
    """Return headings (B,) in radians, counter-clockwise from x; NaN where unknown.

    Args:
        reading: Gets the findings.
        values: (B,) of the table.
        unit: Unit in the name of the column; `quaternion` where the values come from one.
        moves: Moves of the boxes, in the world.
        carry: Returns headings in the world from headings (K,) and the rows (K,) of their boxes.
        strict: Whether headings that disagree with the motion are refused, and not only noted.
        moving: Whether the sensor moves and has no poses: then motion says little about headings.
        free: Whether the motion gives the sense of the headings.
    """
    asked = reading.chosen("yaw", ("degrees", "radians"))
    zero = reading.chosen("heading", HEADINGS)
    stated = asked or ("radians" if unit == "quaternion" else _UNITS.get(unit or ""))
    size = np.abs(values[np.isfinite(values)])
    if stated is None and len(size) and np.mean(size > FULL_TURN) > FEW:
        stated = "degrees"
    moves = moves.take(np.isfinite(values[moves.start]))
    count = len(moves) if len(moves) >= ENOUGH_MOVES else 0
    sure = count >= REFUSED_MOVES and len(np.unique(moves.object)) > 1

    def along(one: str, axis: str) -> tuple[Evidence, Evidence]:
        """Return the moves along the headings in either sense, and those forward."""
        off = np.abs(moves.turn(carry(_radians(values[moves.start], one, axis), moves.start)))
        near = off < SAME_DIRECTION
        both = near | (off > np.pi - SAME_DIRECTION)
        return Evidence(float(both.sum()) * bool(count), count), Evidence(float(near.sum()) * bool(count), count)

    axis = zero or "x"
    claims = [Claim("radians", along("radians", axis)[0]), Claim("degrees", along("degrees", axis)[1])]
    claims += [Claim("radians", along("radians", one)[0]) for one in HEADINGS]
    found = stated or reading.decide("yaw", claims)  # small degrees: all objects go forward in one direction
    text = "yaw is that of quaternions" if unit == "quaternion" else f"yaw is in {found}"
    if not count:
        most = float(size.max(initial=0.0))
        text += f" (up to {most:.4g}); too few boxes move to compare headings with motion"
    shares = {one: tuple(part.share for part in along(found, one)) for one in HEADINGS if one != axis}
    near = max(both for both, _ in shares.values()) - NOISE
    other = max((one for one in shares if shares[one][0] >= near), key=lambda one: shares[one][1])
    what = f"if it is measured from {other.replace('-clockwise', ' clockwise')}"
    option = f"--option heading={other}, or heading=x to keep it"
    claims = [
        Claim(axis, along(found, axis)[0], text, "" if asked or unit else "--option yaw=degrees, radians"),
        Claim(other, along(found, other)[0], what, option, "refused" if strict and not moving else "doubt", sure),
    ]
    reading.decide(
        "yaw",
        claims,
        "moves are along it",
        clash="headings and motion disagree",
        expected="headings along the motion of the boxes",
        asked=zero,
        least=LEAST_ALONG if sure else 0.0,
    )
    if claims[0].evidence.share > HALF and not moving:  # along a grid of streets only the sense differs
        turned = axis.removesuffix("-clockwise") if axis.endswith("-clockwise") else f"{axis}-clockwise"
        ways = (axis, axis.removeprefix("-") if axis.startswith("-") else f"-{axis}", *(() if free else (turned,)))
        claims = [
            Claim(
                one,
                along(found, one)[1],
                f"if it is {one}" if one != axis and not free else "",
                f"--option heading={one}, or heading={axis} to keep it",
                "taken" if free else "doubt",
            )
            for one in ways
        ]
        axis = reading.decide("yaw", claims, "moves are forward", clash="many boxes drive backwards", asked=zero)
    return _radians(values, found, axis)


def _radians(values: Floats, unit: str, axis: str) -> Floats:
    sign, offset = HEADINGS[axis]
    return wrap_angle(sign * (np.deg2rad(values) if unit == "degrees" else values) + offset)


def is_moving(yaw: Floats, moves: Moves) -> bool:
    """Return whether a sensor without poses moves: places keep their distances, and boxes are not driving forward."""
    off = np.abs(moves.turn(yaw[moves.start]))
    off = off[np.isfinite(off)]
    forward = float(np.mean(off < SAME_DIRECTION)) if len(off) >= ENOUGH_MOVES else 1.0
    return moves.common.bounds[0] > MOST and forward < FORWARD


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
    real = np.hypot(*known.velocity.T)
    off = {axes: np.linalg.norm(one - known.velocity, axis=1) for axes, one in along.items()}
    claims = [
        Claim(
            axes,
            Evidence(float((off[axes] + 0.5 * SLOW < off[other]).sum()), len(known) * posed),
            f"velocities are along the axes of the {axes}, as boxes move" if posed else "",
            "--option velocity=sensor, world",
        )
        for axes, other in (("sensor", "world"), ("world", "sensor"))
    ]
    axes = reading.decide("velocity", claims, asked=asked)
    fits = off[axes] < np.maximum(2.0 * SLOW, 0.5 * real)
    clash = f"velocities and motion disagree: {np.median(speed):.3g} m/s on average, boxes move at"
    clash += f" {np.median(real):.3g} m/s; another unit, or relative to the sensor?"
    claims = [Claim(axes, Evidence(float(fits.sum()), len(known)))]
    return reading.decide("velocity", claims, "moves have the velocity of their box", clash=clash, least=HALF)


def read_sizes(reading: Reading, sizes: Floats, names: np.ndarray, *, stated: bool) -> Floats:
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
    for place, order in enumerate(("lwh", "wlh", "hwl")):
        words = ", ".join(_SIDES[letter] for letter in order)
        how = f"as the {'/'.join(sorted(long))} boxes have them" if long else "which nothing contradicts"
        text = f"sizes are {words}, {how}"
        if stated and place:
            text = f"sizes look like {words}, not as their columns are named"
        evidence = Evidence(float((longest * (side == place)).sum()), len(vehicles))
        shown = "" if stated and not place else text
        option = f"--option sizes={order}" if stated else "--option sizes=lwh, wlh, hwl"
        claims.append(Claim(order, evidence, shown, option, "doubt" if stated else "taken"))
    order = reading.decide("sizes", claims, asked=asked)
    found = sizes[:, [order.index(letter) for letter in "lwh"]]
    if not {"size_factor", "length_factor"} & reading.options.keys():
        _check_sizes(reading, found[some], names[some], kinds)
    return found


def _check_sizes(reading: Reading, sizes: Floats, names: np.ndarray, kinds: Mapping[str, str | None]) -> None:
    """Doubt sizes that would be usual ones of their classes if they were multiplied by a factor."""
    usual = {name: USUAL[kind] for name, kind in kinds.items() if kind is not None and kind in USUAL}
    rows = np.isin(names, list(usual)) & np.isfinite(sizes).all(axis=1)
    found, place = unique_texts(names[rows])
    bounds = np.array([usual[name] for name in found.tolist()]).reshape(-1, 3, 2)[place]
    claims = []
    for factor, unit in FACTORS.items():
        size = sizes[rows] * float(factor)
        fits = ((size >= bounds[:, :, 0]) & (size <= bounds[:, :, 1])).all(axis=1)
        both = f", or length_factor={factor} of all lengths" if unit not in {"", "halves", "doubled"} else ""
        option = f"--option size_factor={factor}{both}"
        claims.append(
            Claim(factor, Evidence(float(fits.sum()), len(size)), f"as {unit}" if unit else "", option, "doubt")
        )
    clash = f"sizes are not usual ones of {', '.join(sorted(usual))}"
    reading.decide("sizes", claims, "boxes have a usual size", clash=clash)


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
    if wrong.any() and not reading.skips:
        place = int(np.flatnonzero(wrong)[0])
        option = "--option invalid=skip leaves such rows out; score=logit, percent reads others"
        reading.refuse("score", "a score from 0 to 1", f"{scores[place]:g}", option, int(rows[place]))
    return np.where(wrong, np.nan, scores)

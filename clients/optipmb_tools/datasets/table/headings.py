"""Headings and velocities of boxes, against their motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.motion import LEAST_ALONG, MOST, SAME_DIRECTION, Moves
from optipmb_tools.datasets.table.angles import ANGLE_UNITS, FULL_TURN, no_angle, read_quaternion
from optipmb_tools.datasets.table.columns import BEARINGS, TableColumn, normalised, turned
from optipmb_tools.datasets.table.corners import CORNERED
from optipmb_tools.datasets.table.draft import Draft, column_numbers, numbers
from optipmb_tools.datasets.table.findings import HALF, NOISE, Claim, Reading
from optipmb_tools.datasets.table.poses import rotated
from optipmb_tools.datasets.table.scores import FEW
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Ints, wrap_angle

ENOUGH_MOVES: Final = 5  # moves from which headings are compared with motion
REFUSED_MOVES: Final = 80  # moves of several objects from which headings are refused
FORWARD: Final = 0.8  # share of forward moves from which traffic shares a motion, not the sensor
ONE_WAY: Final = 0.7  # length of the mean direction of moves from which they share one
_POSES: Final = "pose columns, or --option poses=FILE"
_MOST_SHOWN: Final = 6
_TILTED: Final = 1 / 12  # of a turn: largest angle about x and y of a box that stands upright
_INVERSE: Final = np.array([1.0, -1.0, -1.0, -1.0])
SLOW: Final = 0.5  # differences of velocities up to it say nothing, m/s
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
class _Way:
    """Circumstances in which headings are read."""

    strict: bool  # headings that disagree with the motion are refused, and not only noted
    unposed: bool  # there are no poses
    moving: bool  # and the sensor moves: then motion says little about headings
    free: bool  # the motion gives the sense of the headings
    compass: bool  # they stand beside latitudes
    bearing: bool  # their name is that of a bearing


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the headings as the table has them."""
    yaw, unit = _yaw(reading, draft)
    beyond = no_angle(reading, yaw, unit)
    marks = np.unique(yaw[beyond])
    if len(marks) == 1 and beyond.sum() > 1 and unit != "none":
        reading.note("yaw", f"a heading of {marks[0]:g} in {int(beyond.sum())} rows is none: it is unknown")
        yaw = np.where(beyond, np.nan, yaw)
    missing = ["the size"] * draft.centres + ["the heading"] * (unit == "none")
    if missing:
        meaning = "unknown" if draft.scored else "only centres can be compared"
        reading.note("sizes", f"no column for {' or '.join(missing)}: {meaning}")
    used = {one.name for one in draft.roles.values()}
    if unit == "none" and (others := turned(name for name in draft.columns if name not in used)):
        text = f"the heading is unknown, though {', '.join(others[:_MOST_SHOWN])} may have it"
        reading.doubt("yaw", text, "--option column.yaw=NAME, or none")
    return replace(draft, yaw=yaw, yaw_unit=unit)


def along(reading: Reading, draft: Draft) -> Draft:
    """Compare headings with the motion of the boxes, and turn them to radians from x."""
    return replace(draft, yaw=_heading(reading, draft))


def velocities(reading: Reading, draft: Draft) -> Draft:
    """Read the velocities."""
    return replace(draft, velocity=_velocity(reading, draft))


def _yaw(reading: Reading, draft: Draft) -> tuple[Floats, str | None]:
    """Return headings as the table has them, and the unit that is stated for them; `none` where there are none."""
    if "yaw" in draft.roles:
        return numbers(reading, draft, "yaw"), draft.unit("yaw")
    quaternion = None if draft.turn_of in {"angles", "matrix"} else read_quaternion(reading, draft, "q", "yaw")
    if quaternion is not None:
        w, x, y, z = quaternion.T
        return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z), "quaternion"
    parts = (
        np.column_stack([column_numbers(reading, draft, "yaw", name) for name in draft.turn_columns])
        if draft.turn_columns
        else None
    )
    if parts is None:
        return np.full(draft.rows, np.nan if draft.scored else 0.0), "none"
    if draft.turn_of == "matrix":
        return np.arctan2(parts[:, 3], parts[:, 0]), "quaternion"
    upright = 1 if reading.options.get("axes") == "camera" else 2
    turn = 360.0 if np.nanmax(np.abs(parts), initial=0.0) > FULL_TURN else 2.0 * np.pi
    if draft.turn_of == "part" or (np.abs(np.delete(parts, upright, axis=1)) > _TILTED * turn).any():
        expected = "a column yaw (--option column.yaw=NAME), a quaternion, a matrix, or angles of upright boxes"
        raise DatasetError(reading.path, expected, f"the numbers {', '.join(draft.turn_columns)}")
    column = draft.turn_columns[upright]
    reading.note("yaw", f"yaw is {column}, as boxes stand upright by the other angles", "--option column.yaw=NAME")
    return parts[:, upright], normalised(column).unit


def _carry(draft: Draft, yaw: Floats, rows: Ints) -> Floats:
    """Return headings (K,) of boxes in the world from those in the frame of the sensor."""
    if draft.pose is None:
        return yaw
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
    turn = rotated(draft.pose[draft.row[rows], 3:], heading)
    return np.asarray(np.arctan2(turn[:, 1], turn[:, 0]), dtype=np.float64)


def _heading(reading: Reading, draft: Draft) -> Floats:
    size, moves, yaw, unit = draft.size, draft.moves, draft.yaw, draft.yaw_unit
    long = moves.take((size[moves.start, :2].max(axis=1) > 1.3 * size[moves.start, :2].min(axis=1)) | draft.centres)
    unposed, carry = draft.pose is None, partial(_carry, draft)
    found = yaw
    if unit != "none":
        unknown = int(np.isnan(yaw).sum())
        if unknown < len(yaw):
            moving = unposed and is_moving(yaw, long)
            column = draft.roles.get("yaw", TableColumn("", None, ""))
            way = _Way(
                strict=draft.scored,
                unposed=unposed,
                moving=moving,
                free=column.name == CORNERED,
                compass="x" not in draft.roles and column.base in {"heading", *BEARINGS},
                bearing=column.base in BEARINGS,
            )
            found = read_heading(reading, yaw, unit, long, carry, way)
        if unknown:
            reading.note("yaw", f"{unknown} of {len(yaw)} boxes have no heading: it is unknown")
    if unposed and draft.placed is None:
        reading.note("pose", "no columns for the pose of the sensor: boxes are assumed to be in the world frame")
        if unit != "none" and is_moving(found, long):
            text = f"the sensor seems to move, boxes share a motion in {moves.common.share:.0%} of the frames"
            reading.doubt("pose", f"{text}: add its poses", _POSES)
    return found


def read_heading(
    reading: Reading,
    values: Floats,
    unit: str | None,
    moves: Moves,
    carry: Callable[[Floats, Ints], Floats],
    way: _Way,
) -> Floats:
    """Return headings (B,) in radians, counter-clockwise from x; NaN where unknown.

    Args:
        reading: Gets the findings.
        values: (B,) of the table.
        unit: Unit in the name of the column; `quaternion` where the values come from one.
        moves: Moves of the boxes, in the world.
        carry: Returns headings in the world from headings (K,) and the rows (K,) of their boxes.
        way: What is known of them besides.
    """
    asked = reading.chosen("yaw", ("degrees", "radians"))
    zero = reading.chosen("heading", HEADINGS)
    usual = "y-clockwise" if way.compass else "x"
    stated = asked or ("radians" if unit == "quaternion" else ANGLE_UNITS.get(unit or ""))
    size = np.abs(values[np.isfinite(values)])
    radians = not len(size) or float(np.mean(size > FULL_TURN)) <= FEW
    moves = moves.take(np.isfinite(values[moves.start]))
    count = len(moves) if len(moves) >= ENOUGH_MOVES else 0
    sure = count >= REFUSED_MOVES and len(np.unique(moves.object)) > 1

    def share(one: str, axis: str) -> tuple[Evidence, Evidence]:
        """Return the moves along the headings in either sense, and those forward."""
        off = np.abs(moves.turn(carry(_radians(values[moves.start], one, axis), moves.start)))
        near = off < SAME_DIRECTION
        both = near | (off > np.pi - SAME_DIRECTION)
        return Evidence(float(both.sum()) * bool(count), count), Evidence(float(near.sum()) * bool(count), count)

    axis = zero or usual
    claims = [Claim("radians", share("radians", axis)[0], possible=radians)]
    claims += [Claim("degrees", share("degrees", axis)[1])]
    claims += [Claim("radians", share("radians", one)[0], possible=radians) for one in HEADINGS]
    found = stated or reading.decide("yaw", claims)  # small degrees: all objects go forward in one direction
    text = "yaw is that of quaternions" if unit == "quaternion" else f"yaw is in {found}"
    text += ", clockwise from north as beside latitudes" if way.compass and zero is None else ""
    if not count:
        most = float(size.max(initial=0.0))
        text += f" (up to {most:.4g}); too few boxes move to compare headings with motion"
    shares = {one: tuple(part.share for part in share(found, one)) for one in HEADINGS if one != axis}
    near = max(both for both, _ in shares.values()) - NOISE
    other = max((one for one in shares if shares[one][0] >= near), key=lambda one: shares[one][1])
    what = f"if it is measured from {other.replace('-clockwise', ' clockwise')}"
    option = f"--option heading={other}, or heading={usual} to keep it"
    wins: Literal["taken", "doubt", "refused"] = "refused" if way.strict and not way.moving else "doubt"
    explains = shares[other][0] > FORWARD
    if way.unposed and count and not explains:  # moves of what stands beside a sensor are its own
        what, option = "along another axis: a sensor that moves?", _POSES
    if way.bearing and other == "y-clockwise":
        wins, what = "taken", f"yaw is in {found}, clockwise from y"
    least = LEAST_ALONG if sure else 0.0
    own = "" if asked or unit else "--option yaw=degrees, radians"
    claims = [
        Claim(axis, share(found, axis)[0], text, own, least=least),
        Claim(other, share(found, other)[0], what, option, wins, sure and explains, least=least),
    ]
    if way.bearing and not (count or way.compass or zero):
        reading.doubt("yaw", f"{text}; it may be clockwise from north", "--option heading=y-clockwise, or heading=x")
    axis = reading.decide(
        "yaw",
        claims,
        "moves are along it",
        clash="headings and motion disagree",
        expected="headings along the motion of the boxes",
        asked=zero,
    )
    if claims[axis == other].evidence.share > HALF and not way.moving:  # along a grid of streets only the sense differs
        poses = _POSES if way.unposed and one_way(moves) else ""
        claims = _senses(axis, lambda one: share(found, one)[1], poses, free=way.free)
        axis = reading.decide("yaw", claims, "moves are forward", clash="many boxes drive backwards", asked=zero)
    return _radians(values, found, axis)


def _senses(axis: str, forward: Callable[[str], Evidence], option: str, *, free: bool) -> list[Claim]:
    """Return the claims of an axis, of the opposite one, and of the other turn where the corners are not `free`."""
    turned = axis.removesuffix("-clockwise") if axis.endswith("-clockwise") else f"{axis}-clockwise"
    ways = (axis, axis.removeprefix("-") if axis.startswith("-") else f"-{axis}", *(() if free else (turned,)))
    return [
        Claim(
            one,
            forward(one),
            f"if it is {one}" if one != axis and not free else "",
            option or f"--option heading={one}, or heading={axis} to keep it",
            "taken" if free else "doubt",
        )
        for one in ways
    ]


def _radians(values: Floats, unit: str, axis: str) -> Floats:
    sign, offset = HEADINGS[axis]
    return wrap_angle(sign * (np.deg2rad(values) if unit == "degrees" else values) + offset)


def is_moving(yaw: Floats, moves: Moves) -> bool:
    """Return whether a sensor without poses moves: places keep their distances, and boxes are not driving forward."""
    off = np.abs(moves.turn(yaw[moves.start]))
    off = off[np.isfinite(off)]
    forward = float(np.mean(off < SAME_DIRECTION)) if len(off) >= ENOUGH_MOVES else 1.0
    return moves.common.bounds[0] > MOST and forward < FORWARD


def one_way(moves: Moves) -> bool:
    """Return whether boxes go in one direction, as what stands does beside a sensor that moves."""
    unit = moves.step / np.maximum(np.linalg.norm(moves.step, axis=1, keepdims=True), 1e-9)
    return len(np.unique(moves.object)) > 1 and float(np.linalg.norm(unit.mean(axis=0))) > ONE_WAY


def _velocity(reading: Reading, draft: Draft) -> Floats | None:
    """Return velocities (B, 2) along the axes of the boxes; NaN where unknown, None where there are none."""
    if not {"vx", "vy"} <= draft.roles.keys():
        return None
    velocity = np.column_stack([numbers(reading, draft, "vx"), numbers(reading, draft, "vy")])[draft.row]
    velocity[np.isnan(velocity).any(axis=1)] = np.nan
    if len(draft.moves) and not np.nan_to_num(velocity).any():  # as detectors without velocities write
        reading.note("velocity", "every velocity is 0 though boxes move: velocities are unknown")
        return None
    axes, wrong = read_velocity(reading, velocity, draft.moves, draft, posed=draft.pose is not None)
    if axes == "world" and draft.pose is not None:
        flat = np.column_stack([velocity, np.zeros(len(velocity))])
        velocity = rotated(draft.pose[draft.row, 3:] * _INVERSE, flat)[:, :2]
    chain = draft.moves.chain
    velocity[np.isin(chain, wrong) | ((chain < 0) & bool(len(wrong)))] = np.nan  # of later ones nothing is known
    return velocity


def read_velocity(reading: Reading, velocity: Floats, moves: Moves, draft: Draft, *, posed: bool) -> tuple[str, Ints]:
    """Return the axes of velocities (B, 2), m/s, NaN where unknown, and the objects whose velocities contradict motion.

    The axes are `sensor`, or `world` where boxes are `posed`.
    """
    asked = reading.chosen("velocity", ("sensor", "world"))
    known = moves.take(np.asarray(np.isfinite(velocity[moves.start]).all(axis=1)))
    none = np.empty(0, dtype=np.int64)
    if len(known) < ENOUGH_MOVES:
        return asked or "sensor", none
    given = velocity[known.start]
    speed = np.hypot(*given.T)
    course = _carry(draft, np.arctan2(given[:, 1], given[:, 0]), known.start)
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
    most = np.maximum(2.0 * SLOW, 0.5 * real)
    fits = off[axes] < most
    if fits.mean() >= HALF:
        objects, place = np.unique(known.object, return_inverse=True)
        count = np.bincount(place)
        wrong = objects[(np.bincount(place, fits) < HALF * count) & (count >= ENOUGH_MOVES)]
        if len(wrong) and asked is None:
            mine = np.isin(known.object, wrong)
            text = f"velocities of {len(wrong)} of {len(objects)} objects contradict their motion and are left out"
            heading = _carry(draft, draft.yaw[known.start], known.start) if draft.yaw_unit != "none" else course
            turn = heading + np.arctan2(given[:, 1], given[:, 0])
            own = speed[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
            ways = (
                ("are along the heading of the box", own),
                ("point backwards", -along[axes]),
                ("are of another unit or relative to the sensor", known.velocity),
            )
            off_by = [float(np.median(np.linalg.norm(one - known.velocity, axis=1)[mine])) for _, one in ways]
            best = int(np.argmin(off_by[:2]))
            how = ways[best if off_by[best] < np.median(most[mine]) else -1][0]
            reading.note("velocity", f"{text}: they {how}", "--option velocity=sensor keeps them")
            return axes, wrong
    clash = f"velocities and motion disagree: {np.median(speed):.3g} m/s on average, boxes move at"
    clash += f" {np.median(real):.3g} m/s; another unit, or relative to the sensor?"
    claims = [Claim(axes, Evidence(float(fits.sum()), len(known)), least=HALF)]
    return reading.decide("velocity", claims, "moves have the velocity of their box", clash=clash), none

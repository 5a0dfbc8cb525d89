"""Angles: their unit, and quaternions."""

from typing import Final

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.table.draft import Draft, numbers
from optipmb_tools.datasets.table.findings import Claim, Reading
from optipmb_tools.datasets.table.scores import FEW
from optipmb_tools.geometry import Bools, Floats

UPRIGHT: Final = 0.3  # largest x and y of the quaternion of a box that stands upright
FULL_TURN: Final = 6.4
LARGEST_DEGREES: Final = 360.5
LARGEST_RADIANS: Final = 4.0 * np.pi
ANGLE_UNITS: Final = {"deg": "degrees", "rad": "radians"}


def read_angle(reading: Reading, name: str, values: Floats, unit: str | None) -> Floats:
    """Return the angles of a pose in radians; the unit follows from the name of the column and their range."""
    chosen = reading.chosen("yaw", ("degrees", "radians")) or ANGLE_UNITS.get(unit or "")
    if chosen is None:
        most = float(np.nanmax(np.abs(values), initial=0.0))
        text, option = "{} is taken for {} (up to {:.4g})", "--option yaw=degrees, radians"
        claims = [
            Claim(one, text=text.format(name, one, most), option=option, possible=one == "degrees" or most <= FULL_TURN)
            for one in ("radians", "degrees")
        ]
        chosen = reading.decide("pose", claims)
    return np.deg2rad(values) if chosen == "degrees" else values


def no_angle(reading: Reading, values: Floats, unit: str | None) -> Bools:
    """Return which values (R,) of a column of headings are beyond any angle, such as marks for no value."""
    stated = reading.options.get("yaw") or ANGLE_UNITS.get(unit or "")
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
    alike = min(one.evidence.share for one in claims) == 1.0
    order = reading.decide(
        topic,
        claims,
        "boxes then stand upright",
        expected="quaternions whose order follows from upright boxes",
        received="boxes that all have one of two headings" if alike else "",
        asked=asked,
    )
    return parts[:, [3, 0, 1, 2]] if order == "xyzw" else parts


def read_quaternion(reading: Reading, draft: Draft, prefix: str, topic: str) -> Floats | None:
    """Return quaternions w x y z (R, 4); None where the table has none."""
    roles = [f"{prefix}{part}" for part in "wxyz"]
    if not {roles[0], roles[3]} <= draft.roles.keys():
        return None
    named = not draft.roles[roles[0]].base[-1:].isdigit()
    if not named and not set(roles) <= draft.roles.keys():
        return None
    parts = np.column_stack([numbers(reading, draft, role, 0.0) for role in roles])  # about z alone w and z are enough
    return read_turn(reading, topic, parts, named=named)

"""Places of boxes: origin, pixels, axes, digits."""

import re
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from optipmb_tools.camera import sensor_from_kitti
from optipmb_tools.datasets.interface import georeference_of
from optipmb_tools.datasets.table.angles import read_angle
from optipmb_tools.datasets.table.columns import normalised
from optipmb_tools.datasets.table.draft import Draft, column_numbers, leave_out, numbers
from optipmb_tools.datasets.table.findings import Claim, Reading
from optipmb_tools.datasets.table.pixels import Placed, place
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats

_LAST_OF_FOUR: Final = re.compile(r"(.*[._])?b?box(_?2d)?\.3")
_PIXELS: Final = re.compile(
    r"(.*_)?(px|pixels?|image|img|u|v|bb|xmin|ymin|xmax|ymax|x1|y1|x2|y2|bbox_(left|top|width|height))(_.*)?"
)
SPREAD: Final = 8.0
SINGLE: Final = 0.1
_POLE: Final = 90.0
FAR: Final = 1e5  # coordinates in metres beyond which single precision loses centimetres
LEAST_VARIANCE: Final = 1e-8
LARGEST_VARIANCE: Final = 1e8  # variances of a position along any axis, m^2, as `Detections` have them


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the centres of the boxes, or place those of a camera on the ground."""
    placed = _place(reading, draft)
    if placed is not None:
        center = np.insert(placed.center[:, :2], 2, 0.0, axis=1)
        return replace(draft, placed=placed, center=center, covariance=placed.covariance)
    _refuse_pixels(reading, draft)
    return replace(draft, center=_centers(reading, draft))


def axes(reading: Reading, draft: Draft) -> Draft:
    """Turn boxes in the axes of a camera, and look at the digits of the centres."""
    center, size, yaw, unit = draft.center, draft.size, draft.yaw, draft.yaw_unit
    if read_axes(reading, center):
        yaw = yaw if unit in {"quaternion", "none"} else read_angle(reading, "yaw", yaw, unit)
        center, size, yaw = sensor_from_kitti(center, np.ascontiguousarray(size[:, ::-1]), yaw)
        unit = "none" if unit == "none" else "rad"
    read_digits(reading, center)
    return replace(draft, center=center, size=size, yaw=yaw, yaw_unit=unit)


def _centers(reading: Reading, draft: Draft) -> Floats:
    """Return centres (R, 3): x, y, z, or latitude and longitude where an origin is given and x is not."""
    origin, found = reading.options.get("origin"), draft.roles
    if origin is None and "lat" in found and "lon" in found and "x" not in found:
        expected = "x and y in metres, or an origin for the latitudes (--option origin=LAT,LON,HEIGHT)"
        raise DatasetError(reading.path, expected, f"columns {found['lat'].name}, {found['lon'].name}")
    if "x" in found or "lat" not in found or origin is None:
        ends = (("x", None), ("y", None), ("z", 0.0))
        return np.column_stack([numbers(reading, draft, role, without) for role, without in ends])
    alt = numbers(reading, draft, "alt") if draft.height == "alt" else None
    lat, lon = numbers(reading, draft, "lat"), numbers(reading, draft, "lon")
    most = float(np.nanmax(np.abs(lat), initial=0.0))
    claims = (
        Claim("degrees", possible=most <= _POLE),
        Claim("1e-7", text="latitudes and longitudes are in 1e-7 degrees", possible=1e5 * _POLE < most <= 1e7 * _POLE),
    )
    received = f"up to {most:.9g} in column {found['lat'].name}"
    unit = reading.decide("position", claims, expected="latitudes in degrees, or in 1e-7 degrees", received=received)
    lat, lon = (lat, lon) if unit == "degrees" else (1e-7 * lat, 1e-7 * lon)
    center = georeference_of(origin).to_world(lat, lon, alt)
    if alt is None:
        center[:, 2] = numbers(reading, draft, "z", 0.0)
    return center


def _place(reading: Reading, draft: Draft) -> Placed | None:
    """Return the pixel boxes of a camera on the ground; None without a camera."""
    if "camera" not in reading.options:
        return None
    frame = np.unique(np.column_stack([draft.series, draft.stamps.ns]), axis=0, return_inverse=True)[1].reshape(-1)
    read = partial(column_numbers, reading, draft)
    return place(reading, list(draft.columns), read, frame, draft.name)


def _refuse_pixels(reading: Reading, draft: Draft) -> None:
    """Refuse boxes of an image."""
    found = draft.roles
    centres = not {"l", "w"} & found.keys()
    named = [name for name in draft.columns if _PIXELS.fullmatch(normalised(name).base)]
    lists = [one for one in draft.columns if _LAST_OF_FOUR.fullmatch(one) and f"{one[:-1]}4" not in draft.columns]
    named += lists
    flat = {"w", "h"} <= found.keys() and "l" not in found
    if not lists and ("z" in found or not (flat or (centres and named)) or "lat" in found):
        return
    received = f"{', '.join(named or [found['w'].name, found['h'].name])} and no length: boxes in pixels?"
    expected = (
        "boxes in metres, with z up, or --camera FILE, the calibration that places pixel boxes on the ground "
        "(docs/cameras.md)"
    )
    reading.refuse("sizes", expected, received, "--option column.l=NAME")


def covariances(reading: Reading, draft: Draft) -> Draft:
    """Read the covariances of the centres, if the table has them; rows without values are unknown.

    Rows with others are left out, if the user leaves such rows out.
    The height has no column: its variance is the mean of the others, and nothing depends on it.
    """
    if not draft.scored or draft.placed is not None or not {"cov_xx", "cov_yy"} & draft.roles.keys():
        return draft
    if reading.options.get("axes") == "camera":
        expected = "covariances of positions along axes with z up"
        raise DatasetError(reading.path, expected, "columns of them, and camera axes")
    xx, xy, yy = (
        numbers(reading, draft, "cov_xx"),
        numbers(reading, draft, "cov_xy", 0.0),
        numbers(reading, draft, "cov_yy"),
    )
    unknown = np.isnan(xx) & np.isnan(yy)
    with np.errstate(invalid="ignore"):  # of infinite ones NaN comes, which is not fine either
        least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    fine = unknown | ((least >= LEAST_VARIANCE) & (np.maximum(xx, yy) <= LARGEST_VARIANCE))
    expected = f"variances of x and y from {LEAST_VARIANCE:g} to {LARGEST_VARIANCE:g} m^2 along every axis, or none"
    bad = np.asarray(draft.kept & ~fine)
    if not reading.skips:
        reading.first("covariance", bad, expected, np.column_stack((xx, xy, yy)))
    kept = leave_out(reading, draft.kept, bad, "with covariances that are none")
    covariance = np.zeros((draft.rows, 3, 3))
    covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2] = xx, yy, 0.5 * (xx + yy)
    covariance[:, 0, 1] = covariance[:, 1, 0] = xy
    covariance[unknown] = np.nan
    return replace(draft, kept=kept, covariance=covariance)


def read_axes(reading: Reading, center: Floats) -> bool:
    """Return whether boxes have the axes of a camera.

    Raises:
        DatasetError: The axes look like a camera's, and no option says so.
    """
    axes = reading.chosen("axes", ("z-up", "camera"))
    if len(center) <= 1:  # one box has no spread
        return axes == "camera"
    low, high = np.quantile(center, [0.05, 0.95], axis=0)
    across, up = (high - low)[1:]
    found = f"z from {low[2]:.3g} to {high[2]:.3g} m and y from {low[1]:.3g} to {high[1]:.3g} m"
    expected = (
        "z to point up (--option axes=z-up), or camera axes: x right, y down, z forward, y at the bottom of the box, "
        "yaw about y as in KITTI"
    )
    claims = (
        Claim("z-up", possible=up <= max(SPREAD, 3.0 * across)),
        Claim("camera", text=found, option="--option axes=camera", wins="refused"),
    )
    return (axes or reading.decide("axes", claims, expected=expected)) == "camera"


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

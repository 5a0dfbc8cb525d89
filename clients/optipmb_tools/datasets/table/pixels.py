"""Pixel boxes of a table, placed on the ground by a calibrated camera (`--camera`)."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import FieldOfView

from optipmb_tools.datasets.interface import class_like
from optipmb_tools.datasets.table.columns import normalised
from optipmb_tools.datasets.table.findings import Claim, Reading
from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, Ints, Pose, rotation_of, to_sensor, to_world
from optipmb_tools.table_files import unique_texts

if TYPE_CHECKING:
    from optipmb import GroundCamera

OPTIONS: Final = ("camera", "box", "scale")
METRES: Final = (
    *("x", "y", "z", "lat", "lon", "alt", "l", "w", "h", "yaw", "vx", "vy", "cov_xx", "cov_xy", "cov_yy"),
    *("qw", "qx", "qy", "qz"),
)
"""Meanings that no column has in a table of pixel boxes."""
_LOW: Final = (("x1", "xmin", "x_min", "left", "x"), ("y1", "ymin", "y_min", "top", "y"))
_HIGH: Final = (("x2", "xmax", "x_max", "right"), ("y2", "ymax", "y_max", "bottom"))
_SIDES: Final = (("w", "width"), ("h", "height"))
_MIDDLE: Final = tuple((f"{one}_center", f"{one}_centre", f"center_{one}", f"{one}c", f"c{one}") for one in "xy")
_FORMS: Final = {
    "xyxy": (*_LOW, *_HIGH), "cxcywh": (*_MIDDLE, *_SIDES), "xywh": (*_LOW, *_SIDES), "uv": (("u",), ("v",)),
}  # fmt: skip
"""Names of the columns of each form, the first form that has all of them first."""
_PREFIX: Final = re.compile(r"^(bbox|box|bb|bounding_box|xyxy|xywh|rect|foot)_(?=.)|_(px|pixels?)$")
_SHARES: Final = 1.05  # largest share of the image, with boxes that its border cuts
_MANY: Final = 0.1  # share of boxes outside the image from which they may be of another one


@dataclass(frozen=True)
class Placed:
    """Rows of a table on the ground, in the frame of the camera's position; NaN: no box, or one without a place."""

    camera: "GroundCamera"
    columns: tuple[str, ...]  # that were read
    center: Floats  # (R, 3)
    covariance: Floats  # (R, 3, 3)


def camera_of(path: str) -> "GroundCamera":
    """Return the camera of a file.

    Raises:
        DatasetError: It is none.
    """
    from optipmb import GroundCamera, ParameterError  # noqa: PLC0415  loads the tracker, which few tables need

    try:
        return GroundCamera.read(Path(path))
    except ParameterError as error:
        raise DatasetError(error.path, error.expected, error.received) from error


def find_boxes(names: Iterable[str], asked: str | None) -> tuple[str, tuple[str, ...]] | None:
    """Return the form of pixel boxes, `xyxy`, `xywh` or `uv`, and the columns that have them; None for none."""
    plain = {_PREFIX.sub("", normalised(name).base): name for name in reversed(list(names))}
    for form, parts in _FORMS.items():
        if asked in {None, form}:
            listed = () if form == "uv" else tuple(plain.get(str(place), "") for place in range(4))
            names_of = [(*part, part[0][0]) if form == asked == "cxcywh" else part for part in parts]
            found = tuple(next((plain[one] for one in part if one in plain), "") for part in names_of)
            if "" in found and listed:
                found = listed
            if "" not in found:
                return form, found
    return None


def place(
    reading: Reading, names: Sequence[str], numbers: Callable[[str, str], Floats], frame: Ints, labels: NDArray[np.str_]
) -> Placed:
    """Return the boxes of a table on the ground.

    Args:
        reading: With the options `camera`, `box` and `scale`; receives the findings.
        names: Of all columns.
        numbers: Function of a meaning and a column that gives its numbers (R,).
        frame: (R,) of each row.
        labels: (R,) classes.

    Raises:
        DatasetError: The camera is none, columns are missing, or a box is none; names the line.
    """
    from optipmb import Pose as PoseOfVehicle  # noqa: PLC0415  as above

    camera = camera_of(reading.options["camera"])
    asked = reading.chosen("box", ("xyxy", "xywh", "cxcywh"))
    found = find_boxes(names, asked)
    if found is None:
        expected = "pixel boxes: columns x1 y1 x2 y2, x y w h (--option box=xywh, or cxcywh of centres), or u v"
        raise DatasetError(reading.path, expected, f"the columns {', '.join(names)}")
    form, columns = found
    pixels = np.column_stack([numbers(name, name) for name in columns]) * (reading.positive("scale", "a factor") or 1.0)
    claims = (
        Claim("pixels", possible=bool((pixels > _SHARES).any() or not (pixels > 0.0).any())),
        Claim("shares", text="pixels are shares of the image, as all are up to 1", option="--option scale=1"),
    )
    if reading.decide("camera", claims, asked="pixels" if "scale" in reading.options else None) == "shares":
        pixels *= np.resize(camera.image, pixels.shape[1])
    form = asked or _form(reading, form, columns, pixels, camera.image)
    if form == "cxcywh":
        pixels[:, :2] -= 0.5 * pixels[:, 2:]
    if form in {"xywh", "cxcywh"}:
        pixels[:, 2:] += pixels[:, :2]
    given = ~np.isnan(pixels).all(axis=1)
    bad = np.asarray(given & ~np.isfinite(pixels).all(axis=1))
    expected = "finite pixels"
    if form != "uv":
        with np.errstate(invalid="ignore"):
            bad |= (pixels[:, 2:] < pixels[:, :2]).any(axis=1)
        expected = f"pixel boxes {', '.join(columns)} ({form}) with x1 <= x2 and y1 <= y2"
    reading.first("camera", bad, expected, pixels, "" if form == "uv" else "--option box=xyxy, box=xywh or box=cxcywh")
    given &= ~bad
    _note_outside(reading, form, columns, pixels[given], camera.image)
    center, covariance = np.full((len(pixels), 3), np.nan), np.full((len(pixels), 3, 3), np.nan)
    left_out: Counter[str] = Counter()
    pose = PoseOfVehicle(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])) if camera.mount == "vehicle" else None
    rows = np.flatnonzero(given)
    rows = rows[np.argsort(frame[rows], kind="stable")]
    for mine in np.split(rows, np.flatnonzero(np.diff(frame[rows])) + 1) if len(rows) else ():
        boxes = {"foot" if form == "uv" else "box": pixels[mine]}
        one = camera.detections(label=labels[mine], pose=pose, **boxes)
        kept = mine[one["row"]]
        center[kept], covariance[kept] = one["center"], one["position_covariance"]
        left_out.update(one["left_out"])
    usual = [one for one in unique_texts(labels[rows])[0].tolist() if not class_like(one, tuple(camera.classes))]
    if camera.range != "ground" and usual:
        text = f"ranges follow from usual heights of {', '.join(usual)}"
        reading.note("camera", f"{text}: [class.NAME] size in the calibration has the real ones")
    if left_out:
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(left_out.items()))
        text = f"{left_out.total()} of {len(rows)} boxes have no place on the ground: {reasons}"
        (reading.doubt if 2 * left_out.total() > len(rows) else reading.note)("camera", text)
    return Placed(camera, columns, center, covariance)


def _form(reading: Reading, form: str, columns: Sequence[str], pixels: Floats, image: tuple[int, int]) -> str:
    """Return the form of boxes whose columns do not tell it: of a list, or of x, y, width and height."""
    if form == "xywh":
        plain = [normalised(name).base for name in columns[:2]] == ["x", "y"]
        text = f"{columns[0]}, {columns[1]} are taken for the left upper corner"
        centre = Claim("cxcywh", text=text, option="--option box=xywh, cxcywh", wins="doubt", possible=plain)
        return reading.decide("camera", (Claim("xywh", possible=not plain), centre))
    if form != "xyxy" or not normalised(columns[2]).base[-1:].isdigit() or columns[2][-2:-1].isalpha():
        return form
    low, high = pixels[:, :2], pixels[:, 2:]
    text = "boxes are left, top, width, height: taken for corners, they end before they begin"
    inside = bool(np.all((low + high <= np.array(image) + 1.0) | np.isnan(high)))
    sides = Claim("xywh", text=text, option="--option box=xyxy", possible=inside)
    return reading.decide("camera", (Claim("xyxy", possible=bool(np.all((high >= low) | np.isnan(high)))), sides))


def _note_outside(reading: Reading, form: str, columns: Sequence[str], pixels: Floats, image: tuple[int, int]) -> None:
    """Note the form of the boxes, and the share of them outside the image."""
    ends = pixels.reshape(len(pixels), -1, 2)
    share = float(((ends < -1.0) | (ends > np.array(image) + 1.0)).any(axis=(1, 2)).mean()) if len(pixels) else 0.0
    text = (
        f"pixels are {form} in columns {', '.join(columns)}, {share:.0%} outside the image of {image[0]} x {image[1]}"
    )
    doubtful = share > _MANY
    option = "--option box=xyxy, box=xywh or box=cxcywh, scale=FACTOR" if form != "uv" else "--option scale=FACTOR"
    (reading.doubt if doubtful else reading.note)("camera", text, option)


def seen_from(
    camera: "GroundCamera", pose: Pose, columns: dict[str, Any]
) -> tuple[Pose, dict[str, Any], FieldOfView | None]:
    """Return the pose, the columns and the field of view of a frame in the axes of the camera, where it has a place."""
    import optipmb  # noqa: PLC0415  as above

    view = camera.view_from(optipmb.Pose(*pose) if camera.mount == "vehicle" else None)
    if view is None or view.pose is None:
        return pose, columns, None
    own = Pose(view.pose.translation, view.pose.quaternion)
    before, after = (rotation_of(one.quaternion) for one in (pose, own))
    center, yaw = to_world(before, pose.translation, columns["center"], columns["yaw"])
    turn = after.T @ before
    center, yaw = to_sensor(after, own.translation, center, yaw)
    moved = {"center": center, "yaw": yaw, "position_covariance": turn @ columns["position_covariance"] @ turn.T}
    parts = {name: np.array(getattr(view, name)) for name in ("azimuth", "elevation", "range")}
    return own, columns | moved, FieldOfView(**parts)

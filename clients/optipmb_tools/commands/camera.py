"""`optipmb camera`: the calibration of a camera from points, and places of pixels."""

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from optipmb_client.errors import UsageError

from optipmb_tools.commands.options import Origin, plain_table, print_table, say, warn
from optipmb_tools.datasets.interface import georeference_of
from optipmb_tools.extras import needed
from optipmb_tools.files import DatasetError, write_whole
from optipmb_tools.table_files import read_table

if TYPE_CHECKING:
    from optipmb_tools.camera_fit import Fit
    from optipmb_tools.geometry import Floats

_RANGES = (10.0, 20.0, 40.0)  # m


class Action(StrEnum):
    """What to do with a camera."""

    fit = "fit"
    ground = "ground"
    convert = "convert"


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of `optipmb camera fit`."""

    image: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the image, for fit, px.", show_default=False)
    ] = None
    intrinsics: Annotated[
        Path | None,
        typer.Option(help="Of the lens: camera_info of ROS, or YAML or XML of OpenCV.", show_default=False),
    ] = None
    out: Annotated[Path | None, typer.Option("--out", help="Calibration to write (TOML).", show_default=False)] = None
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the points and of the fit to write.", show_default=False)
    ] = None
    frame: Annotated[Path | None, typer.Option(help="Image of the camera, for the picture.", show_default=False)] = None
    origin: Origin = None
    force: Annotated[bool, typer.Option("--force", help="Write the calibration in spite of large residuals.")] = False

    def size(self) -> tuple[int, int]:
        """Return width and height of the image.

        Raises:
            UsageError: They are missing.
        """
        size = re.fullmatch(r"(\d+)x(\d+)", self.image or "")
        if size is None:
            raise UsageError(f"--image: expected WIDTHxHEIGHT, as 1920x1080, received {self.image}")
        return int(size[1]), int(size[2])


def camera(
    action: Annotated[Action, typer.Argument(help="fit, convert: make a calibration; ground: print places of pixels.")],
    file: Annotated[Path, typer.Argument(help="Table of points (fit), or calibration (ground).")],
    pixels: Annotated[
        list[str] | None, typer.Argument(metavar="[U,V]...", help="Pixels, for ground.", show_default=False)
    ] = None,
    *,
    how: FitOptions,
) -> None:
    """Calibrate a camera on points of the ground, or show where pixels are.

    fit reads a table with u, v, x, y and, if it differs, z; or u, v, lat, lon, alt with --origin. It prints the
    residual of each point, and names one that does not fit. Without --intrinsics at least 4 points on the ground give a
    homography; with them 4 in a plane or 6 in space give the pose.

    convert reads a file with the matrix of the lens and its distortion (or --intrinsics FILE), and R and t, rvec and
    tvec, or a matrix of them, from the world to the camera.
    """
    if action is Action.ground:
        _print_places(file, pixels or [])
    elif action is Action.convert:
        _convert(file, how)
    else:
        _fit(file, how)


def _fit(file: Path, how: FitOptions) -> None:
    size = how.size()
    needed("fitting a camera", "evaluation", "scipy")
    if how.picture is not None:
        needed("the picture", "plot", "matplotlib")
    from optipmb_tools import camera_fit  # noqa: PLC0415  packages of an extra

    lens = None if how.intrinsics is None else _lens(how.intrinsics, list(size))
    found = camera_fit.fit(file, *_points(file, how.origin), size, lens)
    _print_fit(found, camera_fit.odd_point(file, found, lens))
    if how.picture is not None:
        _draw(found, how.picture, how.frame)
        say(f"picture in {how.picture}")
    if found.rms > camera_fit.LARGEST_RMS and not how.force:
        expected = f"residuals up to {camera_fit.LARGEST_RMS:g} px RMS (--force writes the calibration anyway)"
        raise DatasetError(file, expected, f"{found.rms:.1f} px")
    if how.out is not None:
        error = {"pixel": [round(max(1.0, found.rms), 3), 0.04]}
        write_whole(how.out, camera_fit.toml({**found.document, "error": error}).encode())
        say(f"calibration in {how.out}")


def _convert(file: Path, how: FitOptions) -> None:
    from optipmb import GroundCamera, ParameterError  # noqa: PLC0415  loads the tracker
    from optipmb.cameras.camera_files import read_pose  # noqa: PLC0415  as above
    from optipmb_tools.camera_fit import toml  # noqa: PLC0415  as above

    size = how.size()
    try:
        document = {"image": list(size), "pinhole": {**_lens(how.intrinsics or file, list(size)), **read_pose(file)}}
        GroundCamera.parse(document)
    except ParameterError as error:
        raise DatasetError(f"{file}: {error.path}", error.expected, error.received) from error
    text = toml(document)
    if how.out is None:
        say(text.rstrip())
        return
    write_whole(how.out, text.encode())
    say(f"calibration in {how.out}")


def _print_places(file: Path, pixels: list[str]) -> None:
    from optipmb_tools.datasets.table.pixels import camera_of  # noqa: PLC0415  loads the tracker

    matches = [re.fullmatch(r"(-?[\d.]+),(-?[\d.]+)", one) for one in pixels]
    if not pixels or None in matches:
        raise UsageError(f"pixels: expected U,V ..., as 812,640, received {' '.join(pixels) or 'none'}")
    places = camera_of(str(file)).ground([[float(one[1]), float(one[2])] for one in matches if one])
    for text, (x, y) in zip(pixels, places.tolist(), strict=True):
        say(f"{text} {x:.3f} {y:.3f}" if np.isfinite(x) else f"{text} beyond the horizon")


def _lens(path: Path, image: list[int]) -> dict[str, Any]:
    from optipmb import ParameterError  # noqa: PLC0415  loads the tracker
    from optipmb.cameras.camera_files import read_lens  # noqa: PLC0415  as above

    try:
        return read_lens(path, image)
    except ParameterError as error:
        raise DatasetError(f"--{error.path}", error.expected, error.received) from error


def _points(file: Path, origin: str | None) -> "tuple[Floats, Floats]":
    """Return pixels (N, 2) and places (N, 3) of a table."""
    columns = read_table(file)
    given = {name: columns[name] for name in ("u", "v", "x", "y", "z", "lat", "lon", "alt") if name in columns}
    wanted = ("u", "v", "x", "y") if origin is None else ("u", "v", "lat", "lon")
    if missing := [name for name in wanted if name not in given]:
        raise DatasetError(file, f"columns {', '.join(wanted)}", f"no {', '.join(missing)}")
    for name, values in given.items():
        if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise DatasetError(file, f"finite numbers in column {name}", "others")
    pixels = np.column_stack([given["u"], given["v"]]).astype(np.float64)
    if origin is not None:
        place = georeference_of(origin)
        points = place.to_world(given["lat"], given["lon"], given.get("alt"))
        points[:, 2] = given["alt"] - place.origin[2] if "alt" in given else 0.0  # above the curved earth
        return pixels, points
    zero = np.zeros(len(pixels))
    return pixels, np.column_stack([given["x"], given["y"], given.get("z", zero)]).astype(np.float64)


def _print_fit(found: "Fit", odd: tuple[int, float] | None) -> None:
    from optipmb_tools.camera_fit import IN_PLANE, error_at, horizon_row  # noqa: PLC0415  packages of an extra

    table = plain_table((), ("point", "u", "v", "off by px", "m"))
    for row, (pixel, off, away) in enumerate(zip(found.pixels, found.residual_px, found.residual_m, strict=True), 1):
        place = "-" if np.isnan(away) else f"{away:.2f}"
        table.add_row(str(row), f"{pixel[0]:.0f}", f"{pixel[1]:.0f}", f"{off:.1f}", place)
    print_table(table)
    exact = len(found.points) == IN_PLANE
    say(f"no residual can be given for {IN_PLANE} points" if exact else f"RMS {found.rms:.2f} px")
    if odd is not None:
        warn(f"point {odd[0] + 1} is {odd[1]:.0f} px off the others: a wrong place, or swapped u and v?")
    say(f"horizon at row {horizon_row(found.camera):.0f}")
    errors = [(reach, error_at(found.camera, reach, max(1.0, found.rms))) for reach in _RANGES]
    if known := [f"{error:.2f} m at {reach:g} m" for reach, error in errors if np.isfinite(error)]:
        say(f"error of {max(1.0, found.rms):.1f} px: {', '.join(known)}")


def _draw(found: "Fit", path: Path, frame: Path | None) -> None:
    """Draw the points, where the fit has them, and lines of the ground every 10 m."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  an extra
    from matplotlib.figure import Figure  # noqa: PLC0415  as above
    from matplotlib.image import imread  # noqa: PLC0415  as above

    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    width, height = found.camera.image
    if frame is not None:
        axes.imshow(imread(frame), extent=(0, width, height, 0))
    low, high = (
        np.floor(found.points[:, :2].min(axis=0) / 10 - 1) * 10,
        np.ceil(found.points[:, :2].max(axis=0) / 10 + 1) * 10,
    )
    z = found.points[0, 2]
    for axis in (0, 1):
        along = np.linspace(low[1 - axis], high[1 - axis], 200)
        for value in np.arange(low[axis], high[axis] + 1, 10):
            line = np.column_stack([np.full(200, value), along] if axis == 0 else [along, np.full(200, value)])
            axes.plot(*found.camera.project(np.insert(line, 2, z, axis=1)).T, color="#009E73", lw=0.6)
    fitted = found.camera.project(found.points)
    axes.plot(*found.pixels.T, "+", color="#D55E00", label="given")
    axes.plot(*fitted.T, "o", mfc="none", color="#0072B2", label="fitted")
    for row, (given, mine) in enumerate(zip(found.pixels, fitted, strict=True), 1):
        axes.plot(*np.stack([given, mine]).T, color="#D55E00", lw=0.8)
        axes.annotate(str(row), given, xytext=(5, 5), textcoords="offset points")
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    axes.legend()
    figure.savefig(path, dpi=100, metadata={"Software": None})

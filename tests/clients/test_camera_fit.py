"""`optipmb camera`: calibrations from points of generated cameras, and places of pixels."""

from pathlib import Path

import numpy as np
import pytest
from commands import run_here
from numpy.typing import NDArray
from PIL import Image

import optipmb

Floats = NDArray[np.float64]
LENS = """image_width: 1920
image_height: 1080
camera_matrix:
  data: [1050.0, 0.0, 960.0, 0.0, 1040.0, 540.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  data: [-0.1, 0.02, 0.0, 0.0, 0.0]
"""
DOWN = [0.395, -0.586, 0.586, -0.395]
"""About the quaternion of a camera that looks along x and 22 degrees down."""


def camera(*, bent: bool) -> optipmb.GroundCamera:
    unit = np.array(DOWN) / np.linalg.norm(DOWN)
    lens = {"intrinsics": [1050.0, 1040.0, 960.0, 540.0], "distortion": [-0.1, 0.02, 0.0, 0.0, 0.0] if bent else []}
    place = {"position": [1.0, -2.0, 7.0], "quaternion": unit.tolist()}
    return optipmb.GroundCamera.parse({"image": [1920, 1080], "pinhole": lens | place})


def points(count: int, height: float = 0.0) -> Floats:
    random = np.random.default_rng(1)
    place = np.column_stack([random.uniform(11, 35, count), random.uniform(-7, 5, count), np.zeros(count)])
    place[:, 2] = random.uniform(0, height, count)
    return place


def write(path: Path, pixels: Floats, places: Floats) -> Path:
    rows = [",".join(f"{value:.6f}" for value in row) for row in np.hstack([pixels, places])]
    path.write_text("\n".join(["u,v,x,y,z", *rows]) + "\n")
    return path


@pytest.mark.parametrize(("bent", "height"), [(True, 0.0), (True, 3.0), (False, 0.0)])
def test_exact_points_give_the_camera_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], *, bent: bool, height: float
) -> None:
    """Points of a generated camera, in a plane or in space, give a calibration with its pixels and places."""
    given, places = camera(bent=bent), points(10, height)
    table, out = write(tmp_path / "p.csv", given.project(places), places), tmp_path / "gate.toml"
    (tmp_path / "lens.yaml").write_text(LENS)
    words = ("--intrinsics", tmp_path / "lens.yaml") if bent else ()
    done = run_here(capsys, "camera", "fit", table, "--image", "1920x1080", *words, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "RMS 0.00 px" in done.stdout
    assert not done.stderr
    found = optipmb.GroundCamera.read(out)
    other = points(50)
    np.testing.assert_allclose(found.project(other), given.project(other), atol=0.01)
    pixel = given.project(other[:1])[0].round(3)
    done = run_here(capsys, "camera", "ground", out, f"{pixel[0]},{pixel[1]}", "960,-5000")
    x, y = (float(one) for one in done.stdout.split()[1:3])
    assert abs(np.array([x, y]) - other[0, :2]).max() < 0.01
    assert done.stdout.splitlines()[1] == "960,-5000 beyond the horizon"


@pytest.mark.parametrize("lens", [True, False])
def test_a_wrong_point_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], *, lens: bool) -> None:
    """Of ten clicked points the one that is 30 px off is named, and `error.pixel` is not below the RMS."""
    given, places = camera(bent=lens), points(10)
    pixels = given.project(places) + np.random.default_rng(2).normal(0.0, 0.7, (10, 2))
    pixels[4] += (24.0, -18.0)
    table, out = write(tmp_path / "p.csv", pixels, places), tmp_path / "gate.toml"
    (tmp_path / "lens.yaml").write_text(LENS)
    Image.new("L", (192, 108)).save(tmp_path / "gray.png")
    words = ["--intrinsics", tmp_path / "lens.yaml"] if lens else []
    words += ["--out", out, "--picture", tmp_path / "fit.png", "--frame", tmp_path / "gray.png"]
    done = run_here(capsys, "camera", "fit", table, "--image", "1920x1080", *words)
    assert done.returncode == 0, done.stderr
    assert "point 5 is" in done.stderr
    off = float(done.stderr.partition("point 5 is ")[2].split()[0])
    assert off == pytest.approx(30.0, abs=6.0)
    rms = float(done.stdout.partition("RMS ")[2].split()[0])
    assert optipmb.GroundCamera.read(out).error.pixel[0] == pytest.approx(rms, abs=0.01)
    with Image.open(tmp_path / "fit.png") as picture:
        assert picture.size == (960, 540)


def test_four_points_have_no_residual(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exactly four points give a homography, and the command says that nothing tells how good it is."""
    given = camera(bent=False)
    places = np.array([[12.0, 3.0, 0.0], [13.0, -6.0, 0.0], [30.0, -8.0, 0.0], [32.0, 6.0, 0.0]])
    table = write(tmp_path / "p.csv", given.project(places), places)
    done = run_here(capsys, "camera", "fit", table, "--image", "1920x1080", "--out", tmp_path / "g.toml")
    assert done.returncode == 0, done.stderr
    assert "no residual can be given" in done.stdout
    other = points(20)
    np.testing.assert_allclose(
        optipmb.GroundCamera.read(tmp_path / "g.toml").ground(given.project(other)), other[:, :2], atol=1e-3
    )


@pytest.mark.parametrize(
    ("places", "words", "message"),
    [
        ([[12, 0, 0], [20, 3, 0], [30, -3, 0]], (), "expected at least 4 points, received 3"),
        ([[12, 0, 0], [20, 0, 0], [30, 0, 0], [30, 4, 0]], (), "no three are on one line"),
        ([[12, 0, 0], [20, 3, 1], [30, -3, 2], [33, 5, 0]], (), "or --intrinsics"),
        ([[12, 0, 0], [20, 3, 1], [30, -3, 2], [33, 5, 0]], ("--intrinsics", "lens.yaml"), "at least 6 points"),
        (None, (), "(--force writes the calibration anyway)"),
        ([[12, 0, 0]], ("--image", "large"), "--image: expected WIDTHxHEIGHT"),
        ([[12, 0, 0]], ("--origin", "48,11,0"), "expected columns u, v, lat, lon, received no lat, lon"),
    ],
)
def test_points_that_make_no_camera_are_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    places: list[list[float]] | None,
    words: tuple[str, ...],
    message: str,
) -> None:
    """Too few points, three on a line, heights without a lens, and large residuals end with status 2."""
    given, (out, table) = camera(bent=False), (tmp_path / "g.toml", tmp_path / "p.csv")
    (tmp_path / "lens.yaml").write_text(LENS)
    known = points(9) if places is None else np.array(places, float)
    pixels = given.project(known)
    if places is None:
        pixels += np.random.default_rng(4).normal(0.0, 40.0, pixels.shape)
    write(table, pixels, known)
    rest = [tmp_path / one if one.endswith(".yaml") else one for one in words]
    done = run_here(capsys, "camera", "fit", table, "--image", "1920x1080", "--out", out, *rest)
    assert done.returncode == 2
    assert message in done.stderr
    assert not out.exists()
    if places is None:
        assert run_here(capsys, "camera", "fit", table, "--image", "1920x1080", "--out", out, "--force").returncode == 0


def test_points_on_both_sides_of_the_horizon_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A point that lies above the horizon of the others cannot be on the ground."""
    given = camera(bent=False)
    places = np.array([[12.0, 3.0, 0.0], [13.0, -6.0, 0.0], [30.0, -8.0, 0.0], [-40.0, 16.0, 0.0]])
    homogeneous = given.project(places[:3])
    behind = np.array([[600.0, 40.0]])
    lens = given.pinhole
    assert lens is not None
    ray = lens.rays(behind[0]) @ lens.pose.rotation.T
    places[3] = lens.pose.translation - lens.height / ray[2] * ray
    write(tmp_path / "p.csv", np.vstack([homogeneous, behind]), places)
    done = run_here(capsys, "camera", "fit", tmp_path / "p.csv", "--image", "1920x1080")
    assert done.returncode == 2
    assert "horizon" in done.stderr


def test_places_of_pixels_need_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb camera ground` without pixels, or with others, says the form."""
    for words in ((), ("812",), ("a,b",)):
        done = run_here(capsys, "camera", "ground", tmp_path / "gate.toml", *words)
        assert done.returncode == 2
        assert "expected U,V ..., as 812,640" in done.stderr

"""Files of calibrations: TOML, and intrinsics of ROS and OpenCV."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from optipmb.errors import ParameterError

FilePath = str | Path
_NAMES: Final = ("camera_?matrix|K", "distortion_?coefficients|dist_?coeffs|D")
_MODELS: Final = MappingProxyType(
    {
        "plumb_bob": "opencv",
        "rational_polynomial": "opencv",
        "equidistant": "fisheye",
        "fisheye": "fisheye",
    }
)


def read_calibration(file: FilePath) -> dict[str, Any]:
    """Return the calibration of a TOML file, whose `intrinsics` may name a file in its folder.

    Raises:
        ParameterError: a file cannot be read.
    """
    path = Path(file)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ParameterError("", "the calibration of a camera (TOML)", str(error)) from error
    for part in (document.get("pinhole"), document.get("homography")):
        if isinstance(part, dict) and isinstance(name := part.get("intrinsics"), str):
            part.update(read_lens(path.parent / name, document.get("image")))
    return document


def read_lens(path: Path, image: Any) -> dict[str, Any]:
    """Return `intrinsics`, `distortion` and `model` of a `camera_info` of ROS or a file of OpenCV (YAML, XML).

    Args:
        path: of the file.
        image: width and height that the camera has; a file that names others is refused.

    Raises:
        ParameterError: the file cannot be read, or has no such matrices.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError("intrinsics", "a file of ROS or OpenCV (YAML, XML)", f"{path}: {error}") from error
    matrix, distortion = (_numbers(path, text, names) for names in _NAMES)
    if len(matrix) != 9:  # noqa: PLR2004 - 3 x 3
        raise ParameterError("intrinsics", "a matrix camera_matrix of 9 numbers", f"{len(matrix)} in {path}")
    kind = _value(text, "distortion_model") or "plumb_bob"
    if kind not in _MODELS:
        raise ParameterError("intrinsics", f"a distortion_model among {', '.join(_MODELS)}", f"{kind!r} in {path}")
    size = [_value(text, f"(?:image_)?{side}") for side in ("width", "height")]
    if None not in size and [str(one) for one in image or ()] != size:
        raise ParameterError("image", f"{' x '.join(map(str, size))}, as {path} has it", str(image))
    return {
        "intrinsics": [matrix[0], matrix[4], matrix[2], matrix[5]],
        "distortion": distortion,
        "model": _MODELS[kind],
    }


def _value(text: str, name: str) -> str | None:
    """Return the value of a line `NAME: VALUE`, or of an element of XML."""
    found = re.search(rf"(?im)^\s*{name}\s*:[ \t]*[\"']?([\w.]+)|<{name}>\s*([\w.]+)", text)
    return (found[1] or found[2]) if found else None


def _numbers(path: Path, text: str, names: str) -> list[float]:
    """Return the numbers of a matrix: a list behind its name, or below it behind `data`."""
    found = re.search(rf"(?ims)^({names})\s*:(.*?)(?=^[^\s-]|\Z)|<({names})[ >](.*?)</\3>", text)
    section = re.split(r"data\s*:|<data>", found[2] or found[4])[-1] if found else ""
    words = re.sub(r"(?m)^\s*-\s|[\[\],]|<[^>]*>", " ", section).split()
    try:
        return [float(word) for word in words]
    except ValueError:
        raise ParameterError("intrinsics", f"numbers as {names.partition('|')[0]}", f"{words[:9]} in {path}") from None

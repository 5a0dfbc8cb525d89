"""Files of calibrations: TOML, and intrinsics and extrinsics of ROS and OpenCV (YAML, XML, JSON)."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.model.errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

FilePath = str | Path
_MATRIX: Final = r"camera_?matrix|k|k1|m1|mtx|intrinsics?(_?matrix)?|camera_intrinsics?|intrinsic_k"
_DISTORTION: Final = r"dist(ortion)?(_?coef(f|fs|ficients?)?)?|d|d1|dist_?params|distortion_params"
_PROJECTION: Final = r"p|p2|projection(_?matrix)?|proj(_?mat)?|camera_projection(_matrix)?"
_NAME: Final = r"name|id|sensor(_?(id|name))?|camera(_?(id|name))?|frame_id|channel"
_STRUCTURE: Final = frozenset({"rows", "cols", "dt", "type_id", "header", "flags"})
_MODELS: Final = MappingProxyType({
    "plumb_bob": "opencv", "rational_polynomial": "opencv", "radtan": "opencv", "radial_tangential": "opencv",
    "brown_conrady": "opencv", "pinhole": "opencv", "opencv": "opencv", "equidistant": "fisheye", "equi": "fisheye",
    "fisheye": "fisheye", "kannala_brandt": "fisheye",
})  # fmt: skip


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
        if isinstance(part, dict) and isinstance(name := part.pop("extrinsics", None), str):
            part.update(read_pose(path.parent / name))
    return document


def read_lens(path: Path, image: Any) -> dict[str, Any]:
    """Return `intrinsics`, `distortion` and `model` of a `camera_info` of ROS or a file of OpenCV (YAML, XML, JSON).

    Args:
        path: of the file.
        image: width and height that the camera has; a file that names others is refused.

    Raises:
        ParameterError: the file cannot be read, or has no such matrix, or one without a distortion.
    """
    known = read_numbers(path)
    matrix, distortion = (_named(known, names) for names in (_MATRIX, _DISTORTION))
    if {"fx", "fy", "cx", "cy"} <= known.keys():
        matrix = " ".join(known[name] for name in ("fx", "fy", "cx", "cy"))
    if {"k1", "k2", "p1", "p2"} <= known.keys():
        distortion = " ".join(known[name] for name in ("k1", "k2", "p1", "p2", "k3") if name in known)
    projection = _projection(path, known) if matrix is None else None
    if projection is not None:  # of a straightened image
        matrix, distortion = " ".join(map(str, projection[0].ravel())), distortion or ""
    numbers = _numbers(path, "camera_matrix", matrix)
    if len(numbers) not in {4, 9}:
        raise ParameterError("intrinsics", "a matrix camera_matrix of 9 numbers", f"{len(numbers)} in {path}")
    if distortion is None:
        expected = "the distortion of the lens beside its matrix (distortion_coefficients: [] says that it has none)"
        raise ParameterError("distortion", expected, f"the names {', '.join(known)} in {path}")
    stated = _named(known, "distortion_model|camera_model|lens_model|model")
    kind = (stated or "plumb_bob").lower()
    if kind == "pinhole" and "distortion_model" in known:
        kind = known["distortion_model"].lower()
    if kind not in _MODELS:
        raise ParameterError("intrinsics", f"a distortion_model among {', '.join(_MODELS)}", f"{stated!r} in {path}")
    fisheye = (_named(known, "(is_?)?fisheye(_model)?") or "0").lower() in {"1", "true", "yes"}
    size = [_named(known, f"(image_)?{side}") for side in ("width", "height")]
    if None not in size and [str(one) for one in image or ()] != size:
        raise ParameterError("image", f"{' x '.join(map(str, size))}, as {path} has it", str(image))
    return {
        "intrinsics": numbers if len(numbers) == 4 else [numbers[0], numbers[4], numbers[2], numbers[5]],  # noqa: PLR2004
        "distortion": _numbers(path, "distortion_coefficients", distortion),
        "model": "fisheye" if fisheye else _MODELS[kind],
    }


def read_pose(path: Path) -> dict[str, Any]:
    """Return `position` and `quaternion` of a camera by its extrinsics: from the world to the axes of the camera.

    These are R and t, rvec and tvec, or a matrix of three rows and four columns, with or without a fourth row.

    Raises:
        ParameterError: the file has none of them.
    """
    known = read_numbers(path)
    whole = _named(known, r"extrinsics?(_?matrix)?|rt|t_cam_world|world_?2_?cam(era)?|world_to_camera")
    turn = _named(known, r"r|rotation(_?matrix)?|rvec|rot_mat|r_mat")
    shift = _named(known, r"t|tvec|translation(_?vector)?|trans")
    if whole is not None:
        matrix = np.array(_numbers(path, "extrinsics", whole))
        if matrix.size not in {12, 16}:
            raise ParameterError("extrinsics", "12 or 16 numbers, by rows", f"{matrix.size} in {path}")
        rotation, translation = matrix[:12].reshape(3, 4)[:, :3], matrix[:12].reshape(3, 4)[:, 3]
    elif turn is not None and shift is not None:
        values, translation = np.array(_numbers(path, "R", turn)), np.array(_numbers(path, "t", shift))
        if values.size not in {3, 9} or translation.size != 3:  # noqa: PLR2004 - of space
            expected = "R of 9 numbers, or rvec of 3, and t of 3"
            raise ParameterError("extrinsics", expected, f"{values.size} and {translation.size} in {path}")
        rotation = values.reshape(3, 3) if values.size == 9 else _rodrigues(values)  # noqa: PLR2004 - 3 x 3
    elif (projection := _projection(path, known)) is not None:
        _, rotation, translation = projection
    else:
        expected = "R and t, rvec and tvec, or a matrix extrinsic or projection, from the world to the camera"
        raise ParameterError("extrinsics", expected, f"the names {', '.join(known)} in {path}")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0.0:
        raise ParameterError("extrinsics", "a rotation from the world to the camera", str(rotation.tolist()))
    return {"position": (-rotation.T @ translation).tolist(), "quaternion": _quaternion(rotation.T)}


def _projection(path: Path, known: Mapping[str, str]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the intrinsics (3, 3), rotation (3, 3) and translation (3,) of a projection (3, 4); None without one."""
    text = _named(known, _PROJECTION)
    if text is None or len(values := _numbers(path, "projection", text)) != 12:  # noqa: PLR2004 - 3 x 4
        return None
    matrix = np.array(values).reshape(3, 4)
    turn, upper = np.linalg.qr(np.flipud(matrix[:, :3]).T)  # an RQ decomposition
    upper, turn = np.fliplr(np.flipud(upper.T)), np.flipud(turn.T)
    sign = np.diag(np.sign(np.diag(upper)))
    upper, turn = upper @ sign, sign @ turn
    shift = np.linalg.solve(upper, matrix[:, 3])
    if np.linalg.det(turn) < 0.0:
        turn, shift = -turn, -shift
    return upper / upper[2, 2], turn, shift


def _rodrigues(vector: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) about a vector by its length, rad."""
    angle = max(float(np.linalg.norm(vector)), 1e-12)
    x, y, z = vector / angle
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across)


def _quaternion(rotation: np.ndarray) -> list[float]:
    """Return w, x, y, z of a rotation, as the eigenvector of Bar-Itzhack (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    matrix = np.array([
        [a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(matrix / 3.0)[1][:, -1].tolist()
    sign = 1.0 if w >= 0.0 else -1.0
    return [sign * w, sign * x, sign * y, sign * z]


def read_numbers(path: Path) -> dict[str, str]:
    """Return the values of a file of YAML, XML or JSON by their names in small letters, as text.

    Of a file with several sensors, `FILE#SENSOR` names one.

    Raises:
        ParameterError: the file cannot be read, or has several sensors of which the path names none.
    """
    name, _, sensor = path.name.partition("#")
    path = path.with_name(name)
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = json.loads(text) if text.lstrip().startswith(("{", "[")) else None
    except (OSError, ValueError) as error:
        raise ParameterError("intrinsics", "a file of ROS or OpenCV (YAML, XML, JSON)", f"{path}: {error}") from error
    if content is not None:
        return dict(_of_json(_chosen(path, _sensors_of_json(content, ""), sensor, content)))
    if text.lstrip().startswith("<"):
        inner = r"(?:\s*<(?:rows|cols|dt|type_id)>[^<]*</\w+>)*\s*<data>([^<]*)</data>"
        matrices = re.findall(rf"<(\w+)[^<>]*>{inner}", text)
        return {
            name.lower(): value.strip() for name, value in (*re.findall(r"<(\w+)[^<>]*>([^<]*)</", text), *matrices)
        }
    text = _chosen(path, _sensors_of_yaml(text), sensor, text)
    values: dict[str, str] = {}
    name = ""
    for line in re.sub(r"(?m)(^|[ \t])#.*$|^%YAML.*$|^---.*$|!!opencv-matrix", "", text).split("\n"):
        key = re.match(r"\s*(?:- )?[\"']?([A-Za-z]\w*)[\"']?\s*:(.*)", line)
        if key is None:
            values[name] = f"{values.get(name, '')} {line.strip()}" if name else ""
        elif key[1] == "data":
            values[name] = key[2].strip()
        elif key[1] not in _STRUCTURE:
            name = key[1].lower()
            values.setdefault(name, "")
            values[name] = key[2].strip() or values[name]
    return {name: value.strip(" \"'") for name, value in values.items() if name}


def _chosen(path: Path, sensors: Mapping[str, Any], asked: str, whole: Any) -> Any:
    """Return the part of a file that is of one sensor: the whole of a file with one."""
    if asked in sensors or (len(sensors) <= 1 and not asked):
        return sensors.get(asked, whole)
    expected = f"one of the sensors {', '.join(f'{path.name}#{name}' for name in sensors)}"
    raise ParameterError("intrinsics", expected, f"{path.name}#{asked}" if asked else path.name)


def _sensors_of_json(value: Any, name: str) -> dict[str, Any]:
    """Return the objects that have a matrix, by their names in the file."""
    if isinstance(value, dict) and any(_is_matrix(key) for key in value):
        return {name: value}
    inner = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
    found: dict[str, Any] = {}
    for key, part in inner:
        own = dict(_of_json(part)) if isinstance(part, dict) and isinstance(value, list) else {}
        own_sensors = _sensors_of_json(part, _named(own, _NAME) or str(key))
        found |= {f"{key}.{one}" if one in found else one: sensor for one, sensor in own_sensors.items()}
    return found


def _sensors_of_yaml(text: str) -> dict[str, str]:
    """Return the parts that have a matrix, by the name before them, or that in the element of a list."""
    lines = text.split("\n")
    keys = [re.match(r"(\s*)(- )?[\"']?([A-Za-z]\w*)[\"']?\s*:\s*(.*)", line) for line in lines]
    depths = [-1 if key is None else len(key[1]) + len(key[2] or "") for key in keys]
    least = min((depth for key, depth in zip(keys, depths, strict=True) if key and _is_matrix(key[3])), default=0)
    begins = [
        place
        for place, key in enumerate(keys)
        if key is not None and len(key[1]) < least and (key[2] or (not key[4] and depths[place] < least))
    ]
    found: dict[str, str] = {}
    for begin, end in zip(begins, [*begins, len(lines)][1:], strict=True):
        own = [key for key in keys[begin:end] if key is not None]
        if any(_is_matrix(key[3]) for key in own):
            named = (key[4].strip(" \"'") for key in own if own[0][2] and re.fullmatch(_NAME, key[3].lower()))
            sensor = next(named, str(len(found)) if own[0][2] else own[0][3])
            found[f"{len(found)}.{sensor}" if sensor in found else sensor] = "\n".join(lines[begin:end])
    return found


def _is_matrix(name: object) -> bool:
    """Return whether a name denotes the matrix or the projection of a camera."""
    return re.fullmatch(f"{_MATRIX}|{_PROJECTION}", str(name).lower()) is not None


def _of_json(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _of_json(inner, str(key).lower())
    else:
        yield name, str(value)


def _named(known: Mapping[str, str], names: str) -> str | None:
    """Return the value whose name matches a pattern."""
    return next((value for name, value in known.items() if re.fullmatch(names, name)), None)


def _numbers(path: Path, name: str, text: str | None) -> list[float]:
    words = re.sub(r"(?m)^\s*-\s|(?<!\S)-(?=\s)|[\[\](),;]", " ", text or "").split()
    try:
        return [float(word) for word in words]
    except ValueError:
        raise ParameterError("intrinsics", f"numbers as {name}", f"{words[:9]} in {path}") from None

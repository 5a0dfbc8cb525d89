"""Reader of ASAM OpenLABEL 1.0.0: the cuboids of each frame, as records of a table in the world.

The world is the coordinate system without a parent. Cuboids of other systems are carried there by the transforms of
their frame, or else by the pose of their system in its parent. Objects without frames stand in all frames of their
intervals.
"""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
import numpy as np
from msgspec import Struct, field

from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Floats, quaternion_of, rotation_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

T = TypeVar("T")

_QUATERNION, _EULER, _PIXELS = 10, 9, 4  # numbers of a cuboid by its rotation, and of a box in an image
_MATRIX: Final = 16
_HEAD: Final = 4096
_ZONE: Final = re.compile(r"(?:Z|([-+])(\d\d):?(\d\d))$")  # at the end of a time
_SCORES: Final = ("score", "confidence")


class _Value(Struct):
    val: Any
    name: str = ""


class _Attributes(Struct):
    num: list[_Value] = []
    vec: list[_Value] = []


class _Shape(Struct):
    val: list[float] | None
    name: str = ""
    coordinate_system: str = ""
    attributes: _Attributes = field(default_factory=_Attributes)


class _Data(Struct):
    cuboid: list[_Shape] | _Shape = []
    bbox: list[_Shape] | _Shape = []
    num: list[_Value] = []
    type: str = ""


class _Interval(Struct):
    frame_start: int
    frame_end: int


class _Object(Struct):
    type: str = ""
    object_data: _Data = field(default_factory=_Data)
    frame_intervals: list[_Interval] = []


class _Pose(Struct):
    matrix4x4: list[float] = []
    quaternion: list[float] = []
    translation: list[float] = []


class _Transform(Struct):
    src: str
    dst: str
    transform_src_to_dst: _Pose


class _Properties(Struct):
    timestamp: str | float | None = None
    transforms: dict[str, _Transform] = {}


class _LabelFrame(Struct):
    frame_properties: _Properties = field(default_factory=_Properties)
    objects: dict[str, Any] = {}


class _System(Struct):
    parent: str = ""
    pose_wrt_parent: _Pose | None = None


class _Content(Struct):
    frames: dict[str, Any] = {}
    objects: dict[str, Any] = {}
    coordinate_systems: dict[str, _System] = {}


def openlabel_records(path: Path, content: Any) -> list[dict[str, Any]]:
    """Return a record for each cuboid, in the order of the frames; a frame without any has a record of its time.

    Boxes in images are records only where there are no cuboids. Ids that are no numbers are counted from 0, as they
    appear.

    Args:
        path: Of the file.
        content: Value of its key `openlabel`.

    Raises:
        DatasetError: Something is not as the standard has it; names its place in the file.
    """
    whole = _converted(path, "openlabel", content, _Content)
    static = {name: _converted(path, f"objects.{name}", one, _Object) for name, one in whole.objects.items()}
    wrong = next((key for key in whole.frames if not key.isdecimal()), None)
    if wrong is not None:
        raise DatasetError(path, "numbers as the keys of openlabel.frames", repr(wrong))
    frames = {int(key): _converted(path, f"frames.{key}", one, _LabelFrame) for key, one in whole.frames.items()}
    records: list[dict[str, Any]] = []
    flat: list[dict[str, Any]] = []
    for number, frame in sorted(frames.items()):
        place = f"frames.{number}"
        time = {"frame": number} | _time(path, place, frame.frame_properties.timestamp)
        carry = partial(_to_root, path, place, whole.coordinate_systems, frame.frame_properties.transforms)
        count = len(records)
        for where, name, kind, data in _objects(path, place, number, frame, static):
            about = time | {"id": name, "class": kind}
            for at, shape, values in _shapes(path, f"{where}.object_data.cuboid", data.cuboid, _QUATERNION, _EULER):
                rotation, translation = carry(at, shape.coordinate_system)
                records.append(about | _box(rotation, translation, values) | _others(path, at, shape, data, rotation))
            for at, shape, (u, v, width, height) in _shapes(path, f"{where}.object_data.bbox", data.bbox, _PIXELS):
                corners = {"x1": u - width / 2, "y1": v - height / 2, "x2": u + width / 2, "y2": v + height / 2}
                flat.append(about | corners | _others(path, at, shape, data, np.eye(3)))
        if len(records) == count:
            records.append(time)
    found = flat if flat and not any("class" in one for one in records) else records
    ids = {name: place for place, name in enumerate(dict.fromkeys(one["id"] for one in found if "id" in one))}
    if not all(name.isdecimal() for name in ids):
        found = [one | {"id": ids[one["id"]]} if "id" in one else one for one in found]
    return found


def options_of(files: Sequence[Path]) -> dict[str, str]:
    """Return the options of tables that the standard defines, where files are OpenLABEL by their first bytes."""
    for path in files:
        if path.suffix.lower() != ".json" or not path.is_file():
            return {}
        with path.open("rb") as file:
            if b'"openlabel"' not in file.read(_HEAD):
                return {}
    return {"heading": "x", "sizes": "lwh", "axes": "z-up", "velocity": "world"}


def _converted(path: Path, place: str, value: Any, kind: type[T]) -> T:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        expected, _, inner = str(error).partition(" - at `$")
        expected, _, received = expected.removeprefix("Expected ").partition(", got ")
        where = f"{place}{inner.rstrip('`')}".removeprefix("openlabel.")
        raise DatasetError(path, f"{expected} at openlabel.{where}", received or "another value") from error


def _time(path: Path, place: str, value: str | float | None) -> dict[str, Any]:
    """Return the column of a time: nanoseconds of a date, or the number as it is."""
    if value is None:
        return {}
    try:
        return {"timestamp": float(value)}
    except ValueError:
        pass
    try:
        zone = _ZONE.search(str(value))
        minutes = int(f"{zone[1]}1") * (60 * int(zone[2]) + int(zone[3])) if zone and zone[1] else 0
        local = np.datetime64(_ZONE.sub("", str(value)), "ns") - np.timedelta64(minutes, "m")
        return {"stamp_ns": int(local.astype(np.int64))}
    except ValueError as error:
        where = f"openlabel.{place}.frame_properties.timestamp"
        raise DatasetError(path, f"seconds, or a time as 2026-01-31T08:00:00Z, at {where}", repr(value)) from error


def _objects(
    path: Path, place: str, number: int, frame: _LabelFrame, static: Mapping[str, _Object]
) -> Iterator[tuple[str, str, str, _Data]]:
    """Yield place, id, class and data of the objects of a frame, then of standing ones."""
    for name, value in frame.objects.items():
        one = _converted(path, f"{place}.objects.{name}", value, _Object)
        known = static.get(name, one)
        yield f"{place}.objects.{name}", name, one.object_data.type or one.type or known.type, one.object_data
    for name, one in static.items():
        inside = any(part.frame_start <= number <= part.frame_end for part in one.frame_intervals)
        if name not in frame.objects and (inside or not one.frame_intervals):
            yield f"objects.{name}", name, one.object_data.type or one.type, one.object_data


def _shapes(
    path: Path, place: str, shapes: list[_Shape] | _Shape, *counts: int
) -> Iterator[tuple[str, _Shape, list[float]]]:
    """Yield place, shape and values of a list of shapes, or of one alone."""
    several = shapes if isinstance(shapes, list) else [shapes]
    for at, one in enumerate(several):
        where = f"{place}[{at}]" if isinstance(shapes, list) else place
        if one.val is None:
            continue
        if len(one.val) not in counts or not np.isfinite(one.val).all():
            expected = f"{' or '.join(map(str, counts))} finite numbers at openlabel.{where}.val"
            raise DatasetError(path, expected, f"{len(one.val)}: {str(one.val)[:60]}")
        yield where, one, one.val


def _box(rotation: Floats, translation: Floats, values: list[float]) -> dict[str, Any]:
    """Return the columns of a cuboid, carried by a rotation (3, 3) and a translation (3,)."""
    center, size = np.array(values[:3]), values[-3:]
    if len(values) == _QUATERNION:
        x, y, z, w = values[3:7]
        turn = rotation_of(np.array([w, x, y, z])) if any(values[3:7]) else np.eye(3)
    else:
        turn = np.eye(3)
        for axis, angle in enumerate(values[3:6]):  # Rz Ry Rx
            one, other = (axis + 1) % 3, (axis + 2) % 3
            about = np.eye(3)
            about[one, one] = about[other, other] = np.cos(angle)
            about[other, one] = np.sin(angle)
            about[one, other] = -np.sin(angle)
            turn = about @ turn
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "l", "w", "h")
    carried = np.concatenate([rotation @ center + translation, quaternion_of(rotation @ turn), size])
    return dict(zip(names, carried.tolist(), strict=True))


def _others(path: Path, place: str, shape: _Shape, data: _Data, rotation: Floats) -> dict[str, Any]:
    """Return the score, 1 where there is none, and the velocity of a shape."""
    numbers = {one.name: one.val for one in (*data.num, *shape.attributes.num)}
    others = {"score": next((numbers[name] for name in _SCORES if name in numbers), 1.0)}
    for at, one in enumerate(shape.attributes.vec):
        if one.name == "velocity" and one.val is not None:
            where = f"{place}.attributes.vec[{at}].val"
            velocity = _converted(path, where, one.val, list[float])
            if len(velocity) not in {2, 3} or not np.isfinite(velocity).all():
                raise DatasetError(path, f"2 or 3 finite numbers at openlabel.{where}", str(velocity)[:60])
            vx, vy, _ = rotation @ np.array([*velocity, 0.0][:3])
            return others | {"vx": float(vx), "vy": float(vy)}
    return others


def _to_root(
    path: Path, place: str, systems: Mapping[str, _System], transforms: Mapping[str, _Transform], at: str, name: str
) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and translation (3,) of a coordinate system to the root of all.

    Args:
        path: Of the file.
        place: Of the frame.
        systems: All coordinate systems.
        transforms: Of the frame; they hold before the pose of a system.
        at: Place of the cuboid.
        name: Coordinate system of the cuboid; empty: the root.
    """
    rotation, translation = np.eye(3), np.zeros(3)
    if not (name and systems):
        return rotation, translation
    if name not in systems:
        raise DatasetError(path, f"one of {', '.join(systems)} at openlabel.{at}.coordinate_system", repr(name))
    for _ in systems:
        parent = systems[name].parent
        if not parent:
            return rotation, translation
        step = next((one for one in transforms.values() if {one.src, one.dst} == {name, parent}), None)
        pose = step.transform_src_to_dst if step is not None else systems[name].pose_wrt_parent
        if pose is None:
            raise DatasetError(path, f"a transform of {name} to {parent} in openlabel.{place}", "none")
        turn, offset = _pose(path, place, name, pose)
        if step is not None and step.src == parent:
            turn, offset = turn.T, -turn.T @ offset
        rotation, translation = turn @ rotation, turn @ translation + offset
        name = parent
        if name not in systems:
            raise DatasetError(path, f"one of {', '.join(systems)} as a parent in openlabel.coordinate_systems", name)
    raise DatasetError(path, "a coordinate system without parent in openlabel.coordinate_systems", "none")


def _pose(path: Path, place: str, name: str, pose: _Pose) -> tuple[Floats, Floats]:
    if len(pose.matrix4x4) == _MATRIX:
        matrix = np.array(pose.matrix4x4).reshape(4, 4)
        return rotation_of(quaternion_of(matrix[:3, :3])), matrix[:3, 3]
    if len(pose.quaternion) == len("xyzw") and len(pose.translation) == len("xyz") and any(pose.quaternion):
        x, y, z, w = pose.quaternion
        return rotation_of(np.array([w, x, y, z])), np.array(pose.translation)
    expected = f"matrix4x4, or quaternion and translation, of {name} in openlabel.{place}"
    raise DatasetError(path, expected, "neither in full")

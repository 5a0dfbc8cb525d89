"""Tracks of a recording as ASAM OpenLABEL 1.0.0: a cuboid for each track and frame, in the world.

A cuboid is x, y, z, the quaternion x, y, z, w, length, width, height. Poses of the sensor are the transforms of the
coordinate system `vehicle`. Times in UTC are ISO texts; other times are seconds as text, because some readers refuse a
number with a fraction.
"""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from optipmb_schemas import Tracks
from optipmb_schemas.json_form import shown

from optipmb_tools.files import write_whole
from optipmb_tools.geometry import Floats
from optipmb_tools.results.exports import is_utc, iso_times

if TYPE_CHECKING:
    from optipmb_tools.datasets.interface import DataSequence

_DIGITS: Final = 10
_UPPER: Final = np.triu_indices(6)
_SECOND: Final = 10**9
_AT_ORIGIN: Final = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def write_openlabel(
    path: Path, sequence: "DataSequence", tracks: Mapping[int, Tracks], time_origin_ns: int = 0, *, full: bool = False
) -> None:
    """Write the tracks (world frame) of a sequence by frame index; the file appears complete, or not at all.

    With `full`, cuboids also have the upper triangle of the covariance of (x, y, v, phi, omega, a), by rows.
    """
    order = sorted(tracks)
    stamps = np.array([tracks[index].stamp_ns for index in order], np.int64) + time_origin_ns
    times = iso_times(stamps).tolist() if len(stamps) and is_utc(stamps) else [_seconds(one) for one in stamps.tolist()]
    frames: dict[str, Any] = {}
    seen: dict[int, list[int]] = {}
    kinds: dict[int, str] = {}
    for index, time in zip(order, times, strict=True):
        one = tracks[index]
        objects = {}
        cuboids = _cuboids(one, full=full)
        for number, label, cuboid in zip(one.id.tolist(), one.label.tolist(), cuboids, strict=True):
            seen.setdefault(number, []).append(index)
            kinds[number] = one.labels[label]
            objects[str(number)] = {"object_data": {"cuboid": [cuboid]}}
        frames[str(index)] = {"frame_properties": {"timestamp": time}, **({"objects": objects} if objects else {})}
    systems: dict[str, Any] = {"world": {"type": "scene_cs", "parent": "", "children": []}}
    poses = sequence.poses
    if any(np.any(np.concatenate(poses[index]) != _AT_ORIGIN) for index in order):
        systems["world"]["children"] = ["vehicle"]
        systems["vehicle"] = {"type": "sensor_cs", "parent": "world", "children": []}
        for index in order:
            w, *xyz = poses[index].quaternion.tolist()
            transform = {"quaternion": [*xyz, w], "translation": poses[index].translation.tolist()}
            frames[str(index)]["frame_properties"]["transforms"] = {
                "vehicle_to_world": {"src": "vehicle", "dst": "world", "transform_src_to_dst": transform}
            }
    content = {
        "metadata": {
            "schema_version": "1.0.0",
            "tagged_file": sequence.name,
            "annotator": f"optipmb {version('optipmb')}",
        },
        "coordinate_systems": systems,
        "frame_intervals": _intervals(order),
        "frames": frames,
        "objects": {
            str(number): {
                "name": f"{kinds[number]}-{number}",
                "type": kinds[number],
                "frame_intervals": _intervals(at),
                "object_data_pointers": {"box": {"type": "cuboid", "frame_intervals": _intervals(at)}},
            }
            for number, at in sorted(seen.items())
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps({"openlabel": content}, allow_nan=False).encode())


def _cuboids(tracks: Tracks, *, full: bool) -> list[dict[str, Any]]:
    """Return the cuboid of each track of a frame."""
    half, zero = 0.5 * tracks.yaw, np.zeros(len(tracks.id))
    boxes = np.column_stack([tracks.center, zero, zero, np.sin(half), np.cos(half), tracks.size])
    numbers = {name: _rounded(getattr(tracks, name)) for name in ("existence", "score", "yaw_rate")}
    vectors = {"velocity": _rounded(tracks.velocity)}
    if full:
        vectors["covariance"] = _rounded(tracks.covariance[:, *_UPPER])
    confirmed = shown(tracks).tolist()
    return [
        {
            "name": "box",
            "val": box,
            "coordinate_system": "world",
            "attributes": {
                "num": [{"name": name, "val": values[row]} for name, values in numbers.items()],
                "boolean": [{"name": "confirmed", "val": confirmed[row]}],
                "vec": [{"name": name, "val": values[row]} for name, values in vectors.items()],
            },
        }
        for row, box in enumerate(_rounded(boxes))
    ]


def _rounded(values: Floats) -> list[Any]:
    return (np.round(values, _DIGITS) + 0.0).tolist()  # type: ignore[no-any-return]  # numpy's tolist


def _seconds(stamp_ns: int) -> str:
    whole, rest = divmod(abs(stamp_ns), _SECOND)
    return f"{'-' * (stamp_ns < 0)}{whole}.{rest:09d}"


def _intervals(frames: Sequence[int]) -> list[dict[str, int]]:
    """Return frames (ascending) as intervals without gaps."""
    parts = np.split(np.array(frames, np.int64), np.flatnonzero(np.diff(frames) != 1) + 1)
    return [{"frame_start": int(part[0]), "frame_end": int(part[-1])} for part in parts if len(part)]

"""Meanings of the columns of a table, found by their names.

Names are compared in lower case, with every run of other characters as one underscore, and without a unit at the end
(`yaw_deg`, `x [m]`). Units in names are kept. A column that is one of a group (`rotation.x`, `rotation.y` …) has a
meaning only in a reading that uses the whole group.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

from optipmb_tools.box_records import BOX_LISTS


@dataclass(frozen=True)
class TableColumn:
    """A column of a table."""

    name: str  # as the table has it
    unit: str | None  # in its name: `deg`, `rad`, `s`, `ms`, `us`, `ns`
    base: str  # its name without the unit, normalised
    depth: int = 0  # groups around it that its name does without


def _vector(bases: str, part: str, place: int) -> tuple[str, ...]:
    found: list[str] = []
    for base in bases.split():
        found += [f"{base}_{part}", f"{part}_{base}", f"{base}{part}", f"{base}_{place}"]
    return tuple(found)


_CENTER: Final = "center centre centroid pos position loc location translation 3d_location xyz c p t bbox box"
_SIZE: Final = "size dim dims dimension dimensions extent extents 3d_dimensions scale lwh box_size"
_SPEED: Final = "v vel velocity speed"
_POSE_NAMES: Final = (
    "pose ego sensor_pose ego_pose ego_translation pose_translation ego_position sensor_position pose_position"
)
_TURN: Final = "pose ego sensor_pose ego_pose ego_rotation pose_rotation pose_orientation"
_BOX_TURN: Final = "q quat quaternion rotation rotations rot orientation"


def _extent(axis: str, letter: str, word: str, place: int) -> tuple[str, ...]:
    return tuple(name for part in (axis, letter, word) for name in _vector(_SIZE, part, place))


def _turn(bases: str, part: str, place: int) -> tuple[str, ...]:
    return (*(f"{base}_q{part}" for base in bases.split()), *_vector(bases, part, place))


BEARINGS: Final = ("angle", "hdg", "course", "cog", "course_over_ground", "true_track")
"""Names of headings that are often clockwise from north."""
ALIASES: Final[Mapping[str, tuple[str, ...]]] = {
    "stamp": ("stamp", "t", "time", "timestamp", "ts", "sec", "secs", "seconds", "nanoseconds", "sim_time", "datetime",
              "header_stamp", "header_timestamp", "time_stamp", "frame_time", "frame_timestamp", "frame_stamp",
              "date_time", "unix_time", "unix_timestamp", "epoch_time", "utc_time", "utc", "capture_time", "scan_time",
              "lidar_timestamp", "lidar_time", "sensor_timestamp", "sensor_time", "measurement_time", "gps_time",
              "base_date_time", "global_time", "timestep_time", "time_of_day", "posix_time", "position_time",
              "sample_timestamp", "unixtime", "frame_ts"),
    "nanosec": ("nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds"),
    "frame": ("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_no", "frame_nr",
              "frame_num", "frame_count", "frame_counter", "scan_id", "scan_index", "scan_idx", "scan_number",
              "sweep_id", "timestep", "time_step", "sample_idx", "sample_index", "image_id", "img_id"),
    "x": ("x", "cx", "xc", "px", "x_center", "x_centre", "tx", "easting", "east", "local_x", "world_x", "x_world",
          "map_x", "x_map", "utm_x", "utm_e", "utm_easting", "x_utm", *_vector(_CENTER, "x", 0)),
    "y": ("y", "cy", "yc", "py", "y_center", "y_centre", "ty", "northing", "north", "local_y", "world_y", "y_world",
          "map_y", "y_map", "utm_y", "utm_n", "utm_northing", "y_utm", *_vector(_CENTER, "y", 1)),
    "z": ("z", "cz", "zc", "pz", "z_center", "z_centre", "tz", *_vector(_CENTER, "z", 2)),
    "lat": ("lat", "latitude", "geometry_coordinates_1"),
    "lon": ("lon", "lng", "longitude", "geometry_coordinates_0"),
    "alt": ("alt", "altitude", "geometry_coordinates_2"),
    "l": ("l", "length", "box_length", "dx", *_extent("x", "l", "length", 0)),
    "w": ("w", "width", "box_width", "dy", *_extent("y", "w", "width", 1)),
    "h": ("h", "height", "box_height", "dz", *_extent("z", "h", "height", 2)),
    "yaw": ("yaw", "heading", "theta", "yaw_angle", "heading_angle", "rotation_z", "rot_z", "rz", "rotation_y", "ry",
            "rot", "rotation", "orientation", "rotation_yaw", "rot_yaw", "orientation_yaw", "euler_yaw",
            "rpy_yaw", "yaw_of_corners", "psi", "utm_angle", *BEARINGS),
    "qw": ("qw", "q0", *_vector(_BOX_TURN, "w", 0)),
    "qx": ("qx", "q1", *_vector(_BOX_TURN, "x", 1)),
    "qy": ("qy", "q2", *_vector(_BOX_TURN, "y", 2)),
    "qz": ("qz", "q3", *_vector(_BOX_TURN, "z", 3)),
    "score": ("score", "confidence", "conf", "prob", "probability", "detection_score", "det_score", "tracking_score",
              "score_3d", "scores_3d", "pred_score", "pred_scores", "scores"),
    "class": ("class", "class_name", "cls", "label", "label_name", "category", "category_name", "type", "object_type",
              "obj_type", "class_id", "label_id", "classification", "object_class", "name", "tracking_name",
              "detection_name", "label_3d", "labels_3d", "pred_label", "pred_labels", "names", "labels", "label_class",
              "class_label", "agent_type", "agent_class", "agent_category", "kind", "species", "semantic_class",
              "category_id", "class_index", "class_idx", "cls_id", "type_id", "category_index"),
    "vx": _vector(_SPEED, "x", 0),
    "vy": _vector(_SPEED, "y", 1),
    "cov_xx": ("cov_xx", "cov_x_x", "covariance_xx", "covariance_x_x", "var_x", "variance_x", "x_var", "x_variance"),
    "cov_xy": ("cov_xy", "cov_x_y", "covariance_xy", "covariance_x_y"),
    "cov_yy": ("cov_yy", "cov_y_y", "covariance_yy", "covariance_y_y", "var_y", "variance_y", "y_var", "y_variance"),
    "id": ("id", "track_id", "object_id", "obj_id", "objid", "tracking_id", "instance_id", "instance",
           "instance_token", "track", "track_uuid", "object_uuid", "instance_uuid", "uuid", "track_label", "agent_id",
           "actor_id", "person_id", "player_id", "target_id", "mmsi", "icao24"),
    "recording": ("recording", "recording_id", "sequence", "sequence_id", "sequence_name", "scene", "scene_name",
                  "scene_id", "session", "log", "log_id", "run", "run_id", "drive", "segment", "bag", "stream"),
    "sensor": ("sensor", "sensor_id", "sensor_name", "node", "lidar", "device"),
    "pose_x": _vector(_POSE_NAMES, "x", 0),
    "pose_y": _vector(_POSE_NAMES, "y", 1),
    "pose_z": _vector(_POSE_NAMES, "z", 2),
    "pose_yaw": ("pose_yaw", "ego_yaw", "sensor_yaw", "pose_heading", "ego_heading"),
    "pose_qw": _turn(_TURN, "w", 0),
    "pose_qx": _turn(_TURN, "x", 1),
    "pose_qy": _turn(_TURN, "y", 2),
    "pose_qz": _turn(_TURN, "z", 3),
}  # fmt: skip
"""Names of each column, the most telling first."""

_LISTED: Final = ("x", "y", "z", "l", "w", "h", "yaw", "vx", "vy")  # meanings of the numbers of a list of `BOX_LISTS`
UNITS: Final[Mapping[str, str]] = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad", "radians": "rad",
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us", "usec": "us",
    "millis": "ms", "micros": "us", "nanos": "ns",
    "ns": "ns", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanosecs": "ns", "nanoseconds": "ns",
}  # fmt: skip
_WORDS: Final = {"stamp", "class", "id", "recording", "sensor"}  # meanings whose values may be words
_WORDS_OF: Final = {
    "stamp": "time|stamp|timestamp|ts|datetime|date|clock|epoch|nanos|micros|millis|nsec|usec|msec",
    "frame": "frame|scan|sweep|step|image|index",
    "x": "x|xc|x0|lon|longitude|long|longitudinal|east|easting|utm_x|utm_e",
    "y": "y|yc|y0|lat|latitude|lateral|north|northing|utm_y|utm_n",
    "l": "l|len|length|long|size|dims?|dimensions?|extents?", "w": "w|width|wide|beam|size|dims?|dimensions?|extents?",
    "class": "class|classes|type|category|categories|label|labels|kind|species|subtype|classification",
    "id": "id|uid|uuid|guid|token|mmsi|imo|icao|callsign|track",
}  # fmt: skip
"""Words of the names of columns that may have a meaning."""
_PART: Final = re.compile(
    rf"((?:{'|'.join((*_BOX_TURN.split(), 'r', 'euler', 'rpy', 'ypr', 'matrix', 'rotvec', 'rvec'))})"
    r"(?:_(?:matrix|mat|angles?|vector|vec))?)_?(q?[wxyz]|\d(?:_?\d)?)"
)
"""Base of a column that may be one of several numbers of an orientation."""
_TURNED: Final = re.compile(
    "(^|_)(rot|r?vec|orient|head|hdg$|yaw|quat|euler|angle|axis|cog$|course|bearing|azimuth|direction|psi|facing)"
)
_LEADING: Final = re.compile(
    "^(det|detection|gt|pred|prediction|obj|object|(3d_)?b?box(_?3d)?|bounding_box(_3d)?|cuboid|agent|actor|target|"
    "veh|vehicle|v(?=_(length|width|height|class|type|id)))_"
)
"""Word before the name of a column that only says what the column is of."""
_GROUP_OF: Final = (("size", "size|dims?|dimensions?|extents?"), ("velocity", "vel|velocity|twist|speed"))
_NO_PLACE: Final = (
    "acc|accel|acceleration|force|jerk|angular|std|sigma|var|cov|covariance|error|offset|gyro|imu|"
    "polygon|vertex|vertices|contour|hull|footprint"
)
"""Words of groups whose members x, y, z are no places."""
_OTHER: Final = re.compile("ego|pose|sensor|camera|lidar|vehicle|header")  # groups that describe no box
_LENGTHS: Final = {"m", "meter", "meters", "metre", "metres", "mps"}
_TRANSLATED: Final[Mapping[str, str]] = {
    name: word
    for word, names in {
        "time": "zeit zeitstempel uhrzeit datum temps horodatage 时间 时间戳", "frame": "bild bildnummer 帧 帧号 帧id",
        "class": "klasse typ objekttyp objektklasse classe 类别 类型 目标类型 目标类别",
        "id": "objekt_id objekt objektnummer 目标id 目标编号 编号 id号",
        "length": "länge laenge longueur 长 长度", "width": "breite largeur 宽 宽度",
        "height": "höhe hoehe hauteur 高 高度",
        "yaw": "gierwinkel winkel orientierung cap 航向角 航向 朝向 偏航角", "score": "konfidenz 置信度 得分",
        "lat": "breitengrad 纬度", "lon": "längengrad laengengrad 经度", "x": "x坐标", "y": "y坐标", "z": "z坐标",
    }.items()
    for name in names.split()
}  # fmt: skip
"""Standard names of columns for those in German, French and Chinese."""
FACTORS: Final[Mapping[str, float]] = {
    "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "feet": 0.3048, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6,
    "mph": 0.44704,
}  # fmt: skip
"""Metres, or metres per second, of other units in the names of columns."""


def find_columns(
    names: Iterable[str], chosen: Mapping[str, str], texts: Collection[str] = ()
) -> dict[str, TableColumn]:
    """Return the column of each meaning among `names`.

    Args:
        names: Of all columns.
        chosen: Meanings whose column the user has named.
        texts: Columns without any number, which hold no quantities under any name.
    """
    known = normalised_all(names)
    taken: dict[str, TableColumn] = {}
    used = set(chosen.values())
    for role in ALIASES:
        aliases = _names_of(role)
        if chosen.get(role) == NOTHING:
            continue
        if role in chosen:
            unit = next((one.unit for one in known if one.name == chosen[role]), None)
            taken[role] = TableColumn(chosen[role], unit, "")
            continue
        fitting = [
            one
            for one in known
            if one.base in aliases and one.name not in used and (role in _WORDS or one.name not in texts)
        ]
        if role == "yaw":
            turn = turn_of(known)
            fitting = [
                one for one in fitting if not (turn and _PART.fullmatch(one.base)) and not _is_shared(one, known)
            ]
        if role == "nanosec":
            bases = {
                one.base for one in known if "stamp" in taken and one.name == taken["stamp"].name and one.unit == "s"
            }
            parts = [one for one in known if bases and _is_second_half(one)]
            fitting = [
                TableColumn(one.name, "ns", aliases[0]) for one in parts if one.base in bases or one.base in aliases
            ]
        if fitting:
            order = {one: (one.depth, aliases.index(one.base), _is_second_half(one), len(one.name)) for one in fitting}
            best = min(fitting, key=order.__getitem__)
            taken[role] = best
            used.add(best.name)
    return taken


def _is_shared(column: TableColumn, known: Collection[TableColumn]) -> bool:
    """Tell whether a column is one of several of an orientation, as `rotation.angle` with `rotation.axis`."""
    group = column.name.rpartition(".")[0]
    others = [one for one in known if one.name.startswith(f"{group}.") and one.name != column.name]
    if _plain(column.name).endswith("_yaw"):  # of roll, pitch and yaw
        return False
    return bool(group and others) and _plain(group.rpartition(".")[2]) in _BOX_TURN.split()


def turned(names: Iterable[str]) -> list[str]:
    """Return the names that may be of a heading."""
    return [name for name in names if _TURNED.search(_plain(name))]


def candidates(names: Iterable[str], role: str) -> list[str]:
    """Return the names whose words say that they may have a meaning, whatever else they say."""
    words = re.compile(f"(^|_)({_WORDS_OF.get(role, role)})(_|$)")
    return [name for name in names if words.search(_plain(name)) and not _known(normalised(name).base)]


def _names_of(role: str) -> tuple[str, ...]:
    """Return the names of a meaning, the most telling first; those in lists of boxes come before flat columns."""
    if role not in _LISTED:
        return ALIASES[role]
    place = _LISTED.index(role)
    first, last = ([f"{name}_{place}" for name in lists] for lists in (BOX_LISTS, ("bbox", "box")))
    return (*first, *ALIASES[role], *last)


def _is_second_half(column: TableColumn) -> bool:
    """Tell whether a column may be the rest of a stamp, as `stamp.nanosec` of `stamp.sec`; `stamp_ns` is not."""
    return column.unit == "ns" and not _plain(column.name).endswith("ns")


def _plain(name: str) -> str:
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", re.sub(r"3D(?![a-z])", "3d", name))
    return re.sub(r"[\W_]+", "_", words.lower()).strip("_")


def normalised(name: str) -> TableColumn:
    """Return a column by its name, with the unit that the name has.

    Of a name with dots the last parts count where only they have a meaning, as in `psr.position.x`.
    """
    base, unit = _base(name)
    path = name.split(".")
    for start in range(1, 1 if _known(base) or _OTHER.match(base) else len(path)):
        last, last_unit = _base(".".join(path[start:]))
        group = f"_{_plain('.'.join(path[:start]))}_"
        if _known(last) and not re.search(f"_({_NO_PLACE})(_?[23]d)?_", group):
            of = (kind for kind, words in _GROUP_OF if re.search(f"_({words})(_?[23]d)?_", group))
            named = f"{next(of, '')}_{last}".strip("_")
            return TableColumn(name, last_unit, named if _known(named) else last, start)
    rest = _LEADING.sub("", base, count=1)
    return TableColumn(name, unit, base if _known(base) or not _known(rest) else rest)


def normalised_all(names: Iterable[str]) -> list[TableColumn]:
    """Return columns by their names; the numbers of a list that count from 1 count from 0."""
    known = [normalised(name) for name in names]
    lists: dict[str, set[str]] = {}
    for one in known:
        stem, _, number = one.base.rpartition("_")
        if number.isdigit():
            lists.setdefault(stem, set()).add(number)
    from_one = {stem for stem, numbers in lists.items() if {"1", "2"} <= numbers and "0" not in numbers}
    return [
        replace(one, base=f"{stem}_{int(number) - 1}")
        if (stem := one.base.rpartition("_")[0]) in from_one and (number := one.base.rpartition("_")[2]).isdigit()
        else one
        for one in known
    ]


def _known(base: str) -> bool:
    return _PART.fullmatch(base) is not None or any(base in names for names in ALIASES.values())


def _base(name: str) -> tuple[str, str | None]:
    base = re.sub("_km_h$", "_kmh", _plain(name)).removesuffix("_m_s")
    base = _TRANSLATED.get(base, base)
    head, _, tail = base.rpartition("_")
    if head and tail in FACTORS:
        return head, tail
    if head and tail in UNITS:
        return head, UNITS[tail]
    if base in UNITS and base not in {"s", "ms", "us", "ns"}:
        return base, UNITS[base]
    return head if head and tail in _LENGTHS else base, None


def turn_of(known: Iterable[TableColumn]) -> tuple[str, list[str]] | None:
    """Return the kind and the columns of an orientation that has several numbers, if there is one.

    `quaternion` columns are named or in a list; `angles` are about x, y and z; a `matrix` is by rows.
    """
    groups: dict[str, dict[str, str]] = {}
    for one in known:
        if match := _PART.fullmatch(one.base):
            groups.setdefault(match[1], {})[match[2].removeprefix("q").replace("_", "")] = one.name
    for stem, parts in groups.items():
        members = [parts[part] for part in sorted(parts)]
        if {"z", "w"} <= parts.keys() or parts.keys() == set("0123"):
            return "quaternion", members
        if len(parts) == len(_AXES) and parts.keys() in ({"x", "y", "z"}, set("012")):
            return "angles", members[::-1] if stem == "ypr" else members
        if len(parts) == len(_AXES) ** 2:
            return "matrix", members
        if len(parts) > 1:
            return "part", members
    return None


_AXES: Final = "xyz"
NOTHING: Final = "none"  # name that a user gives for a meaning that no column has

"""Meanings of the columns of a table: by names and values, by corners, and numbers in names."""

import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.box_records import frame_numbers
from optipmb_tools.datasets.table.angles import LARGEST_DEGREES
from optipmb_tools.datasets.table.columns import (
    ALIASES,
    NOTHING,
    TableColumn,
    candidates,
    find_columns,
    normalised,
    normalised_all,
    turn_of,
)
from optipmb_tools.datasets.table.corners import with_boxes
from optipmb_tools.datasets.table.draft import Draft
from optipmb_tools.datasets.table.findings import Reading, Understood
from optipmb_tools.datasets.table.pixels import METRES
from optipmb_tools.files import is_number
from optipmb_tools.table_files import NO_VALUE, Columns, unique_texts

_MOST_SHOWN: Final = 6
_NO_COLUMN: Final = TableColumn("", None, "")
_NEEDED: Final = ("x", "y", "lat", "lon", "l", "w")  # with texts they are refused where a text stands
_MATRICES: Final = (12, 16)  # numbers of a pose
_FEW_CLASSES: Final = 64
_LONGEST: Final = 30.0  # boxes that are longer, in metres, are suspicious
_LONGEST_TEXT: Final = 24
_LOOKED_AT: Final = 200  # texts of a column that tell whether it has numbers
_SPARED: Final = ("z", "h", "score", "class")  # without a value in any row they are as without a column


def step(reading: Reading, draft: Draft) -> Draft:
    """Find the column of each meaning."""
    columns = _with_frame_numbers(reading, draft.columns, draft.roles)
    roles = draft.roles if columns is draft.columns else find(reading, columns)
    boxes = with_boxes(reading, columns, roles)
    if boxes is not columns:
        roles = find(reading, boxes)
    if reading.lenient:
        first = {name: str(values[0])[:_LONGEST_TEXT] if len(values) else "" for name, values in boxes.items()}
        rows = [Understood(role, one.name, one.unit or "", first[one.name]) for role, one in roles.items()]
        used = {one.column for one in rows}
        rows += [Understood("", name, "", first[name]) for name in boxes if name not in used]
        reading.understood += [one for one in rows if one not in reading.understood]
    kind, members = (None if "yaw" in roles else turn_of(normalised_all(boxes))) or ("", [])
    return replace(draft, columns=boxes, roles=roles, turn_of=kind, turn_columns=tuple(members))


def find(reading: Reading, columns: Columns) -> dict[str, TableColumn]:
    """Return the column of each meaning, as the user says or by names and values."""
    chosen = {key.removeprefix("column."): name for key, name in reading.options.items() if key.startswith("column.")}
    for role, name in chosen.items():
        reading.name(f"column.{role}", [*columns, NOTHING], "a column", name)
    if "camera" in reading.options:
        chosen |= dict.fromkeys(METRES, NOTHING)
    taken = {role: name for role, name in chosen.items() if name in columns or name == NOTHING}
    words = {name for name, one in columns.items() if _has_no_number(one)}
    empty = {name for name, one in columns.items() if one.dtype.kind == "f" and len(one) and np.isnan(one).all()}
    empty |= {name for name, one in columns.items() if normalised(name).base in ALIASES["yaw"] and _is_no_angle(one)}
    found = find_columns([name for name in columns if name not in empty], taken, words)
    if empty:
        found = {role: one for role, one in find_columns(columns, taken, words).items() if role not in _SPARED} | found
    used = {one.name for one in found.values()}
    for role, one in find_columns(columns, taken).items():  # refused when it is read, as a number is expected
        if role not in found and one.name in words - used and (role in _NEEDED or _has_units(columns[one.name])):
            found[role] = one
    found = _by_others(columns, found, chosen)
    if "class" not in chosen and (kind := _class_column(columns, found, words)) is not None:
        found["class"] = kind
    return found


def _by_others(columns: Columns, found: dict[str, TableColumn], chosen: Mapping[str, str]) -> dict[str, TableColumn]:
    """Return the columns with those whose meaning follows from what else there is."""
    dates = [name for name, one in columns.items() if one.dtype.kind == "M"]
    if len(dates) == 1 and not {"stamp", "frame"} & found.keys():
        found["stamp"] = TableColumn(dates[0], None, "")
    cells = [
        name for name in columns if re.fullmatch(r"(.*[._])?(ego|sensor|lidar)?_?pose(_matrix)?[._]\d[._]\d", name)
    ]
    if "pose_x" not in found and len(cells) in _MATRICES:  # a matrix by rows, which `poses` reads as a whole
        found |= {role: TableColumn(name, None, "") for role, name in zip(("pose_x", "pose_y"), cells, strict=False)}
    if not {"x", "lat"} & {*found, *chosen} and found.get("pose_x", _NO_COLUMN).base.startswith("pose"):
        found = {role.removeprefix("pose_"): one for role, one in found.items()}  # of the box, as no other place is
    track = found.get("id")
    over_ground = track is not None and track.base == "track" and columns[track.name].dtype.kind == "f"
    if track is not None and over_ground and {"lat", "lon"} <= found.keys() and "yaw" not in found:
        found["yaw"] = replace(found.pop("id"), base="true_track")
    return found


def _class_column(columns: Columns, found: Mapping[str, TableColumn], words: Collection[str]) -> TableColumn | None:
    """Return the column of classes: with words rather than numbers, and with several rather than one."""
    held = found.get("class")
    worded = held is not None and columns[held.name].dtype.kind == "U"
    if held is not None and worded and len(unique_texts(columns[held.name])[0]) > 1:
        return held
    used = {one.name for one in found.values()}
    texts = {name: unique_texts(columns[name])[0].tolist() for name in words if name not in used}
    few = {name: one for name, one in texts.items() if len(one) <= _FEW_CLASSES}
    order = {
        one: (len(few[one.name]) == 1, one.depth, ALIASES["class"].index(one.base))
        for one in map(normalised, few)
        if one.base in ALIASES["class"]
        and len(few[one.name]) > worded
        and not all(map(re.compile(r"\d").search, few[one.name]))  # names of objects
    }
    if held is None and not order:
        likely = [name for name in candidates(columns, "class") if name in few]
        return TableColumn(likely[0], None, "") if len(likely) == 1 else None
    return min(order, key=order.__getitem__, default=held)


def note(reading: Reading, draft: Draft) -> Draft:
    if reading.lenient:
        long = int((draft.size[:, :2] > _LONGEST).any(axis=1).sum())
        if long:
            reading.note("rows", f"{long} boxes are longer than {_LONGEST:g} m")
    used = {one.name for one in draft.roles.values()} | set(draft.turn_columns)
    used |= set(draft.placed.columns if draft.placed else ())
    unused = [name for name in draft.columns if name not in used]
    stems = {name.rpartition(".")[0] for name in used} - {""}
    unused.sort(key=lambda name: name.rpartition(".")[0] not in stems)  # the rest of a group that is used in part
    for role in ("class", "id", *(("l", "w") if draft.centres else ())):
        likely = candidates(unused, role)[:_MOST_SHOWN]
        if likely and role not in draft.roles and f"column.{role}" not in reading.options:
            text = f"no column for {role} is found, though {', '.join(likely)} may have it"
            how = f"--option column.{role}=NAME, or none"
            (reading.note if role == "id" else reading.doubt)("columns", text, how)
    if unused:
        more = f" and {len(unused) - _MOST_SHOWN} more" if len(unused) > _MOST_SHOWN else ""
        reading.note("columns", f"columns not used: {', '.join(unused[:_MOST_SHOWN])}{more}")
    return draft


def _with_frame_numbers(reading: Reading, columns: Columns, found: Mapping[str, TableColumn]) -> Columns:
    """Return columns with the numbers of frames, or stamps, that their names hold: `frame_12.bin`.

    Raises:
        DatasetError: The names differ in several numbers.
    """
    if "stamp" in found:
        return columns
    named = (
        [found["frame"].name]
        if "frame" in found
        else [one for one in columns if normalised(one).base in ALIASES["frame"]]
    )
    for name in (one for one in named if _has_no_number(columns[one])):
        texts, place = np.unique(columns[name], return_inverse=True)
        if len(texts) > 1 and all(map(re.compile(r"\d").search, texts.tolist())):
            kind, numbers = frame_numbers([reading.path / text for text in texts.tolist()])
            return columns | {name if kind == "frame" else kind: np.array(numbers)[place]}
    return columns


def _is_no_angle(values: NDArray[Any]) -> bool:
    """Tell whether all numbers of a column are beyond any angle, as one that has marks for no value alone."""
    return values.dtype.kind in "if" and len(values) > 0 and bool((np.abs(values) > LARGEST_DEGREES).all())


def _has_units(texts: NDArray[np.str_]) -> bool:
    """Tell whether each text of a column begins with a number, as `87%` and `4.5 m`."""
    return all(re.match(r"[-+]?\.?\d", text.strip()) for text in texts.tolist() if text.strip() not in NO_VALUE)


def _has_no_number(values: NDArray[Any]) -> bool:
    """Tell whether a column has texts, none of which is a number."""
    if values.dtype.kind != "U":
        return False
    texts = [text for text in values[:_LOOKED_AT].tolist() if text.strip() not in NO_VALUE]
    return bool(texts) and not any(map(is_number, texts))

"""Tables of boxes, one row per box: read, checked, in nanoseconds, metres and radians with z up."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.box_records import frame_numbers
from optipmb_tools.datasets.table import frames, headings, kept, names, places, poses, roles, scores, sizes, times
from optipmb_tools.datasets.table.columns import TableColumn
from optipmb_tools.datasets.table.draft import Draft, TableRows
from optipmb_tools.datasets.table.findings import Reading
from optipmb_tools.files import DatasetError
from optipmb_tools.table_files import NO_VALUE, Columns, read_table

STEPS: Final = (
    *(roles.step, names.keys, times.step, names.step, places.step, sizes.step, headings.step, scores.step, kept.step),
    *(
        scores.probabilities,
        places.covariances,
        kept.boxes,
        names.spellings,
        sizes.order,
        places.axes,
        frames.step,
        poses.step,
        names.people,
    ),
    *(headings.along, headings.velocities, frames.reports, roles.note),
)
"""Steps of the reading, in this order; each reads fields of the draft that earlier ones set."""


def read_tables(
    paths: Sequence[Path], reading: Reading, *, scored: bool, loaded: Mapping[Path, Columns] | None = None
) -> list[tuple[Path, TableRows]]:
    """Read the tables of a recording; tables with the same columns share units and conventions.

    Args:
        paths: Files, or folders with a file for each frame. Tables without rows give no boxes.
        reading: Options of the user; receives the findings.
        scored: Whether boxes are detections, which have a score.
        loaded: Tables that were read already.

    Raises:
        DatasetError: A column is missing or a value is not allowed; names the line.
        ClientError: pyarrow is not installed.
    """
    tables = dict(loaded or {path: read_table(path, reading.options) for path in paths})
    known: dict[Path, Mapping[str, TableColumn]] = {
        path: roles.find(reading, columns) for path, columns in tables.items()
    }
    framed = _is_frame_each(reading, tables, known)
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in tables:
        groups.setdefault(tuple(sorted(f"{role} {one.name}" for role, one in known[path].items())), []).append(path)
    found: dict[Path, TableRows] = {}
    for members in groups.values():
        lengths = [len(next(iter(tables[path].values()), ())) for path in members]
        ends = np.cumsum(lengths).tolist()
        starts = [end - length for end, length in zip(ends, lengths, strict=True)]
        reading.files = tuple((path, start) for path, start, n in zip(members, starts, lengths, strict=True) if n)
        filled = [path for path, length in zip(members, lengths, strict=True) if length] or members[:1]
        columns = _joined([tables.pop(path) for path in filled])
        found_roles = known[filled[0]] if len(filled) == 1 else roles.find(reading, columns)
        if not columns:
            raise DatasetError(members[0], "a first line with the names of the columns", "no column")
        judged = reading if any(lengths) else replace(reading, findings=[])  # rows that are not there tell nothing
        drafts = [Draft(columns, sum(lengths), scored=scored, framed=framed, roles=found_roles)]
        del columns  # from here on the draft alone has the columns, and frees them
        boxes = _boxes(judged, drafts.pop())
        if framed:
            return [(reading.path, boxes)]
        found |= {path: boxes.rows(start, end) for path, start, end in zip(members, starts, ends, strict=True)}
    return [(path, found[path]) for path in paths]


def _is_frame_each(reading: Reading, tables: dict[Path, Columns], known: dict[Path, Mapping[str, TableColumn]]) -> bool:
    """Tell whether the tables of a folder are frames of one recording; those without stamps get their file's number."""
    filled = {path: columns for path, columns in tables.items() if len(next(iter(columns.values()), ()))}
    found = {path: known[path] for path in filled}
    if len(filled) < 2 or any("recording" in one for one in found.values()):  # noqa: PLR2004  of one nothing is joined
        return False
    for role in ("stamp", "frame"):
        if all(role in one for one in found.values()):
            times = [np.unique(columns[found[path][role].name]) for path, columns in filled.items()]
            if max(map(len, times)) > 1 or len(np.unique(np.concatenate(times))) == 1:
                return False
            order = sorted(zip((one[0] for one in times), filled, strict=True))
            tables |= {path: tables.pop(path) for _, path in order}  # in the order of time
            return True
    if any(one.keys() & {"stamp", "frame"} for one in found.values()) or not reading.path.is_dir():
        return False
    name, numbers = frame_numbers(list(tables))
    for (path, columns), number in zip(tables.items(), numbers, strict=True):
        tables[path] = {**columns, name: np.full(len(next(iter(columns.values()), ())), number)}
        known[path] = roles.find(reading, tables[path])
    return True


def _joined(tables: Sequence[Columns]) -> Columns:
    """Return the columns that all of some tables have as one; a column is text where it is text in one of them."""
    if len(tables) == 1:
        return tables[0]
    joined: Columns = {}
    for name in (one for one in tables[0] if all(one in other for other in tables)):
        parts = [one[name] for one in tables]
        kinds = {part.dtype.kind for part in parts}
        if len(kinds) > 1 and kinds != {"i", "f"}:
            parts = [np.where(np.isin(one := part.astype(np.str_), ("nan", "NaT")), "", one) for part in parts]
        joined[name] = np.concatenate(parts)
    return joined


def _boxes(reading: Reading, draft: Draft) -> TableRows:
    """Return what all steps read."""
    for one in STEPS:
        draft = one(reading, draft)
    center, sensor = draft.center, draft.roles.get("sensor")
    if draft.scored and draft.centres and draft.height not in draft.roles:  # not even that is taken for granted
        center = np.insert(center[:, :2], 2, np.nan, axis=1)
    return TableRows(
        frame_stamp=draft.stamps.ns,
        frame_key=draft.key,
        frame_pose=draft.pose,
        frame_time=draft.stamps.time,
        frame_number=draft.frame_numbers,
        reports=draft.reports,
        row=draft.row,
        center=center,
        size=np.full_like(draft.size, np.nan) if draft.centres else draft.size,
        yaw=np.full_like(draft.yaw, np.nan) if draft.yaw_unit == "none" else draft.yaw,
        velocity=draft.velocity,
        position_covariance=draft.covariance,
        score=draft.score,
        name=draft.name,
        id=draft.id,
        time_column=draft.stamps.column,
        key_columns=draft.key_columns,
        sensor_column="" if sensor is None else sensor.name,
        keys=draft.keys,
        apart=draft.apart,
        attributes=_attributes(reading, draft) if draft.scored and "attributes" in reading.options else None,
        camera=draft.placed.camera if draft.placed else None,
    )


def _attributes(reading: Reading, draft: Draft) -> NDArray[np.object_]:
    """Return the texts of each box by the names of the columns that the option `attributes` names."""
    found = np.array([{} for _ in draft.row], np.object_)
    for name in map(str.strip, reading.options["attributes"].split(",")):
        if name not in draft.columns:
            raise DatasetError(reading.path, f"a column {name} (--option attributes)", ", ".join(draft.columns))
        values = draft.columns[name][draft.row]
        if values.dtype.kind == "f":  # numbers of a column that has none in some rows
            values = np.where(np.isnan(values), "", np.char.mod("%.15g", values))
        for texts, text in zip(found, np.char.strip(values.astype(np.str_)).tolist(), strict=True):
            if text not in NO_VALUE:
                texts[name.removeprefix("attributes.")] = text
    return found

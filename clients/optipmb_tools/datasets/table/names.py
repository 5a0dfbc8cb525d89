"""Names in a table: of recordings and sensors, of classes, and ids of objects."""

import re
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.datasets.motion import are_people, find_moves, next_steps
from optipmb_tools.datasets.table.draft import Draft
from optipmb_tools.datasets.table.findings import HALF, Claim, Reading
from optipmb_tools.geometry import Ints
from optipmb_tools.table_files import NO_VALUE, unique_texts

NO_CLASS: Final = "object"  # class of all boxes of a table without classes
_ENOUGH: Final = 5  # changes of name from which two names may be of one class
_WALKING: Final = "pedestrian"
NO_ID: Final = -1  # id of a box that has none
_NUMBERED: Final = re.compile(r"(.*[^\W\d_])[\W_]*\d+|\d+[\W_]*([^\W\d_].*)")  # a class, a number of an object


def keys(reading: Reading, draft: Draft) -> Draft:
    """Read the recordings and sensors."""
    names = tuple(draft.roles[role].name for role in ("recording", "sensor") if role in draft.roles)
    key, named = np.full(draft.rows, ""), {"": ("",) * len(names)}
    if names and draft.rows:
        key, named = _joined(draft, names)
    file = np.searchsorted([first for _, first in reading.files], np.arange(draft.rows), side="right")
    series = unique_texts(key)[1] * (len(reading.files) + 1) + file * (not draft.framed)
    return replace(draft, key=key, key_columns=names, keys=named, series=series)


def step(reading: Reading, draft: Draft) -> Draft:
    """Read the classes and ids."""
    names, objects = _classes(reading, draft)
    return replace(draft, name=names, id=_ids(draft, objects))


def spellings(reading: Reading, draft: Draft) -> Draft:
    """Make one class of the spellings of one, and of names of one kind between which objects change.

    `Car`, `car` and `vehicle.car` are spellings. `person` and `pedestrian` may be two classes, or of two schemes: in
    one scheme an object keeps its name.
    """
    names, place = unique_texts(draft.name)
    asked = {one for name, one in reading.options.items() if name.startswith("class.")}
    free = [name for name in names.tolist() if name and name not in asked]
    if len(free) < 2:  # noqa: PLR2004  one name has no other spelling
        return replace(draft, kind=place)
    from optipmb.model.class_names import common_name  # noqa: PLC0415  loads the tracker, which few tables need

    kind = {name: common_name(name) or _plain(name) for name in free}
    if len(set(kind.values())) == len(kind):
        return replace(draft, kind=place)
    share = dict(zip(names.tolist(), np.bincount(place, minlength=len(names)).tolist(), strict=True))
    first: dict[str, str] = {}
    for name in sorted(free, key=lambda one: -share[one]):
        same = (one for one in first if kind[one] == kind[name])
        alike = [one for one in same if _plain(one) == _plain(name) or _change(draft, names, place, one, name)]
        first[name] = first[alike[0]] if alike else name
    merged = {name: one for name, one in first.items() if name != one}
    if not merged:
        return replace(draft, kind=place)
    for one in dict.fromkeys(merged.values()):
        others = ", ".join(name for name in sorted(merged) if merged[name] == one)
        text = f"{others} and {one} are read as one class, {one}"
        reading.note("class", text, f"--option class.{others.split(', ')[0]}=NAME keeps it")
    name = np.array([merged.get(name, name) for name in names.tolist()], dtype=np.str_)[place]
    return replace(draft, name=name, kind=unique_texts(name)[1])


def people(reading: Reading, draft: Draft) -> Draft:
    """Give a table without classes that of people where its boxes are theirs."""
    if not draft.scored or "class" in draft.roles or set(draft.name.tolist()) != {NO_CLASS}:
        return draft
    size = None if draft.centres or not {"l", "w", "h"} <= draft.roles.keys() else draft.size
    row, xy = draft.row, draft.center[:, :2]
    frame = np.unique(draft.stamps.ns[row], return_inverse=True)[1] + draft.series[row] * len(row)
    steps, times = next_steps(draft.series[row], draft.stamps.ns[row] / 1e9, xy, draft.kind)
    what = "speeds and distances" if size is None else "sizes"
    text = f"boxes have the {what} of people: they are of class {_WALKING}"
    claims = (
        Claim(NO_CLASS, possible=not are_people(frame, xy, size, steps / times)),
        Claim(_WALKING, text=text, option="--option class.object=NAME"),
    )
    if reading.decide("class", claims) == NO_CLASS:
        return draft
    name = np.full(len(draft.name), _WALKING)
    return replace(draft, name=name, apart=(_WALKING,) if draft.apart else ())


def _plain(name: str) -> str:
    """Return the last part of the name of a class in small letters: `vehicle.car` is `car`."""
    return re.sub(r"[\W_]+", "_", re.split(r"[./:]", re.sub(r"([a-z])([A-Z])", r"\1_\2", name))[-1].lower()).strip("_")


def _change(draft: Draft, names: NDArray[np.str_], place: Ints, one: str, other: str) -> bool:
    """Tell whether objects change between two names: where a box of either has a box of the other next."""
    own = np.flatnonzero(np.isin(place, [np.flatnonzero(names == name)[0] for name in (one, other)]))
    row = draft.row[own]
    moves = find_moves(
        draft.series[row], draft.stamps.ns[row] / 1e9, draft.center[own, :2], np.zeros(len(own), dtype=np.int64)
    )
    names_of = place[own]
    changed = names_of[moves.start] != names_of[moves.end]
    part = float(np.mean(names_of[moves.start] == names_of[0])) if len(changed) else 0.0
    return int(changed.sum()) >= _ENOUGH and float(changed.mean()) > HALF * 2.0 * part * (1.0 - part)


def _joined(draft: Draft, names: tuple[str, ...]) -> tuple[NDArray[np.str_], dict[str, tuple[str, ...]]]:
    parts = [draft.columns[name].astype(np.str_, copy=False) for name in names]
    place = np.zeros(draft.rows, dtype=np.int64)
    for part in parts:
        values, own = unique_texts(part)
        place = place * len(values) + own
    _, first, place = np.unique(place, return_index=True, return_inverse=True)
    rows = list(zip(*(part[first].tolist() for part in parts), strict=True))
    joined = [".".join(row) for row in rows]
    found = {joined[one]: rows[one] for one in np.argsort(first).tolist()}  # in the order of the table
    return np.array(joined, dtype=np.str_)[place], found


def _classes(reading: Reading, draft: Draft) -> tuple[NDArray[np.str_], NDArray[np.str_] | None]:
    """Return the classes (R,), and the names (R,) of objects where the column has these too."""
    column, objects = draft.roles.get("class"), None
    if column is None:
        given = names = np.array([NO_CLASS])
        place = np.zeros(draft.rows, dtype=np.int64)
        texts = names[place]
        reading.note("class", f"no column for class: every box is of class {NO_CLASS}")
    else:
        values = draft.columns[column.name]
        if values.dtype.kind == "f":  # numbers with an empty cell
            values = np.where(np.isnan(values), "", np.char.mod("%g", values))
        texts = values.astype(np.str_, copy=False)
        given, place = unique_texts(texts)
        names = np.char.strip(given, " \t'\"")
        named = np.where(np.isin(names, NO_VALUE), "", names)
        names = _without_numbers(reading, draft, named, place)
        objects = None if names is named else named[place]
    renamed = {key.removeprefix("class."): name for key, name in reading.options.items() if key.startswith("class.")}
    have = sorted(set(names.tolist()))
    folded = {name.lower(): name for name in renamed}
    for name in renamed if draft.rows else ():
        if not name.isdigit():  # classes are counted: a recording need not have all of them
            reading.name(f"class.{name}", have, "a class of the table", name)
        elif name not in have:
            reading.note("class", f"no box is of class {name}")
    new = {one: renamed[folded[one.lower()]] if one.lower() in folded else one for one in have}
    classes = np.array([new[name] for name in names.tolist()], dtype=np.str_)
    return texts if np.array_equal(classes, given) else classes[place], objects  # a copy takes 40 bytes a row


def _without_numbers(reading: Reading, draft: Draft, names: NDArray[np.str_], place: Ints) -> NDArray[np.str_]:
    """Return the classes of different names that are a class and the number of an object, as `car:12`; else the names.

    `place` (R,) has each row's name.
    """
    split = {name: _NUMBERED.fullmatch(name) for name in names.tolist() if name}
    classes = {name: match[1] or match[2] for name, match in split.items() if match}
    if len(classes) < len(split) or len(set(classes.values())) == len(classes):
        return names
    found = np.array([classes.get(name, name) for name in names.tolist()])

    def most(values: NDArray[np.str_]) -> int:
        kind = np.unique(values, return_inverse=True)[1][place]
        frame = np.unique(draft.stamps.ns, return_inverse=True)[1]
        return int(np.unique(frame * len(values) + kind, return_counts=True)[1].max())

    column = draft.roles["class"].name
    text = f"column {column} has classes and numbers of objects: {names[0]} is of class {found[0]}"
    claims = (  # a class may have several boxes in a frame, an object has one
        Claim("classes", possible=most(names) > 1 or most(found) == 1),
        Claim("objects", text=text),
    )
    return names if reading.decide("class", claims) == "classes" else found


def _ids(draft: Draft, objects: NDArray[np.str_] | None) -> Ints | None:
    column = draft.roles.get("id")
    values = objects if column is None else draft.columns[column.name]
    if values is None:
        return None
    if values.dtype.kind == "i":
        return values.astype(np.int64)
    texts = np.char.strip(values.astype(np.str_))
    numbers = np.unique(texts, return_inverse=True)[1].astype(np.int64)
    return np.where(np.isin(texts, (*NO_VALUE, "-1", "-1.0")), NO_ID, numbers)

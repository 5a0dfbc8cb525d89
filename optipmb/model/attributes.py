"""Attributes of objects, as a plate or a colour: texts by name, each with its evidence.

A detection may bring up to `MOST_NAMES` attributes, each a text with a score. The evidence of a text is the sum of its
scores. An object keeps its `MOST_NAMES` attributes and the `MOST_TEXTS` texts of each that have most evidence.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from optipmb.model.errors import FrameError
from optipmb.model.rows import Column, Rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index

MOST_NAMES: Final = 8
MOST_TEXTS: Final = 4
MOST_OBJECTS: Final = 5000
"""Objects with attributes, the newest: readers of messages accept those of 7,000 by default."""
MOST_BYTES: Final = 32
"""Longest name and text, bytes of UTF-8, and"""
WORDS: Final = MOST_BYTES // 8
"""the same in words."""
_UNSENT: Final = re.compile("[\0\ud800-\udfff]").search
"""Characters that no text has: the end of bytes, and halves of pairs of UTF-16."""


class Attributes(Rows):
    """Texts of objects with their evidence, one row for each; ascending ids, names and texts.

    Attributes:
        id: (N,) int64 of the object.
        name: (N, `WORDS`) int64 bytes of the name.
        text: (N, `WORDS`) int64 bytes of the text.
        evidence: (N,) sum of the scores.
    """

    part = "attributes"
    __slots__ = ()

    id = Column(np.int64)
    name = Column(np.int64, WORDS)
    text = Column(np.int64, WORDS)
    evidence = Column(np.float64)


class Readings(NamedTuple):
    """Attributes of the detections of a frame.

    Attributes:
        row: (A,) detection, as in `Frame.source`.
        name: (A, `WORDS`) bytes of the name.
        text: (A, `WORDS`) bytes of the text.
        score: (A,) in (0, 1].
    """

    row: Index
    name: Index
    text: Index
    score: Array


def readings_of(given: Sequence[Mapping[str, Any] | None], count: int) -> Readings:
    """Return the attributes of so many detections, each a text or a text with its score by name, or None.

    Raises:
        FrameError: another number of detections, too many attributes, or a name, text or score that is none.
    """
    if len(given) != count:
        raise FrameError("attributes", f"{count} maps, one for each detection", str(len(given)))
    rows: list[tuple[int, str, str, float]] = []
    for row, one in enumerate(given):
        if one is not None and not hasattr(one, "items"):
            raise FrameError(f"attributes[{row}]", "a map of texts by name", type(one).__name__)
        if len(one or ()) > MOST_NAMES:
            raise FrameError(f"attributes[{row}]", f"at most {MOST_NAMES} attributes", str(len(one or ())))
        for name, value in (one or {}).items():
            match value:
                case [text, score]:
                    pass
                case text:
                    score = 1.0
            for part, path in ((name, f"attributes[{row}]"), (text, f"attributes[{row}].{name}")):
                if not _is_brief(part):
                    raise FrameError(path, f"a text of 1 to {MOST_BYTES} bytes, or one with its score", repr(part)[:80])
            if not isinstance(score, int | float | np.floating) or not 0.0 < score <= 1.0:
                raise FrameError(f"attributes[{row}].{name}", "a score in (0, 1]", repr(score)[:80])
            rows.append((row, name, text, float(score)))
    row_of, names, texts, scores = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Readings(np.array(row_of, np.int64), words_of(names), words_of(texts), np.array(scores, np.float64))


def _is_brief(part: object) -> bool:
    return isinstance(part, str) and not _UNSENT(part) and 1 <= len(part.encode()) <= MOST_BYTES


def words_of(texts: Sequence[str]) -> Index:
    """Return the bytes of texts (A, `WORDS`), with zeros behind them."""
    packed = np.array([one.encode() for one in texts], f"S{MOST_BYTES}")
    return packed.view(np.int64).reshape(-1, WORDS)


def texts_of(words: Index) -> list[str]:
    """Return the texts of bytes (A, `WORDS`)."""
    packed: NDArray[np.bytes_] = np.ascontiguousarray(words).view(f"S{MOST_BYTES}").ravel()
    return [one.decode(errors="replace") for one in packed.tolist()]


def gathered(before: Attributes, identity: Index, name: Index, text: Index, score: Array) -> Attributes:
    """Return the attributes with more texts (A,) of objects; of each object those with most evidence are kept."""
    if not len(identity):
        return before
    ids, names = np.concatenate((before.id, identity)), np.concatenate((before.name, name))
    texts, evidence = np.concatenate((before.text, text)), np.concatenate((before.evidence, score))
    keys = np.column_stack((ids.astype(">i8").view(np.int64), names, texts))
    packed = np.ascontiguousarray(keys).view(f"V{keys.itemsize * keys.shape[1]}").ravel()
    _, first, place = np.unique(packed, return_index=True, return_inverse=True)
    total = np.bincount(place, evidence, len(first))
    of_object, of_name = _groups(ids[first], names[first])
    kept = _leading(of_name, total) < MOST_TEXTS
    by_name = np.bincount(of_name[kept], total[kept], len(first))
    owner = np.zeros(len(first), np.int64)
    owner[of_name] = of_object
    names_used = np.unique(of_name)
    most = names_used[_leading(owner[names_used], by_name[names_used]) < MOST_NAMES]
    rows = np.flatnonzero(kept & np.isin(of_name, most))
    chosen = first[rows]
    return Attributes(id=ids[chosen], name=names[chosen], text=texts[chosen], evidence=total[rows])


def _groups(ids: Index, names: Index) -> tuple[Index, Index]:
    """Return numbers of the object and of the name of each row; rows of either lie together."""
    other = np.diff(ids, prepend=-1) != 0
    return np.cumsum(other) - 1, np.cumsum(other | (np.diff(names, axis=0, prepend=-1) != 0).any(axis=1)) - 1


def _leading(group: NDArray[np.integer], value: NDArray[np.number]) -> Index:
    """Return the rank of each row in its group; the largest value has rank 0."""
    order = np.lexsort((-value, group))
    place = np.empty(len(group), np.int64)
    start = np.searchsorted(group[order], group[order])
    place[order] = np.arange(len(group)) - start
    return place


def leading(attributes: Attributes) -> tuple[Index, Array]:
    """Return the rows with the most evidence of each name of each object, and their shares of it."""
    _, of_name = _groups(attributes.id, attributes.name)
    rows = np.flatnonzero(_leading(of_name, attributes.evidence) == 0)
    total = np.bincount(of_name, attributes.evidence)
    return rows, attributes.evidence[rows] / total[of_name[rows]]


def read(before: Attributes | None, readings: Readings | None, identity: Index, detection: Index) -> Attributes:
    """Return the attributes of objects with the readings of a frame.

    Args:
        before: those before it.
        readings: of its detections.
        identity: (K,) of the objects that are detected.
        detection: (K,) their detections, as in `Frame.source`.
    """
    known = Attributes.empty() if before is None else before
    if readings is None or not len(identity):
        return known
    order = np.argsort(detection, kind="stable")
    place = np.searchsorted(detection[order], readings.row).clip(max=len(order) - 1)
    owner = order[place]
    rows = np.flatnonzero(detection[owner] == readings.row)
    return gathered(known, identity[owner[rows]], readings.name[rows], readings.text[rows], readings.score[rows])


def shown_of(attributes: Attributes, identity: Index) -> dict[str, tuple[list[str], Array]]:
    """Return texts (N,) and shares of their evidence (N,) of objects by name; "" and 0: unknown."""
    rows, share = leading(attributes)
    place: dict[int, list[int]] = {}
    for k, one in enumerate(identity.tolist()):
        place.setdefault(one, []).append(k)
    found: dict[str, tuple[list[str], Array]] = {}
    columns = attributes.id[rows].tolist(), texts_of(attributes.name[rows]), texts_of(attributes.text[rows])
    for owner, name, text, part in zip(*columns, share.tolist(), strict=True):
        for k in place.get(owner, ()):
            texts, shares = found.setdefault(name, ([""] * len(identity), np.zeros(len(identity))))
            texts[k], shares[k] = text, part
    return {name: found[name] for name in sorted(found)}

"""Parts of linked objects, and their global ids.

Linked objects form parts, in which no two tracks of one session exist at once, and no two that overlapping views show
to be two objects. The oldest object of a part gives it its id.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from optipmb_service.links import views
from optipmb_service.links.objects import NONE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index
    from optipmb_service.links.objects import Objects

    Table = NDArray[np.void]


def settle(objects: Objects, pairs: Table) -> tuple[Index, Index]:
    """Give each linked part its id, and unlink pairs by which tracks of two objects would be one.

    Returns:
        The part of each object, and the rows whose id or end is to be published.
    """
    own = objects.table
    part, linked = _linked(objects, pairs)
    a, b = (objects.at(pairs[side][linked]) for side in ("a", "b"))
    _, oldest, part = np.unique(part, return_index=True, return_inverse=True)
    claim = own["global"][oldest]
    order = np.lexsort((oldest, claim[:, 0], claim[:, 1]))
    again = np.zeros(len(oldest), np.bool_)
    again[order[1:]] = (claim[order[1:]] == claim[order[:-1]]).all(axis=1)
    for n in np.flatnonzero(again).tolist():
        claim[n] = objects.id_of(int(oldest[n]))
    changed = (own["global"] != claim[part]).any(axis=1)
    own["global"] = claim[part]
    order = np.argsort(pairs["probability"][linked], kind="stable")
    own["how"], own["probability"] = NONE, 1.0
    for side in (a, b):
        own["how"][side[order]] = pairs["how"][linked[order]]
        own["probability"][side[order]] = pairs["probability"][linked[order]]
    size = np.bincount(part)[part]
    state = 1 + 2 * own["ended"]
    told = (size > 1) | (own["told"] > 0)
    new = np.flatnonzero(told & (changed | (own["told"] != state)))
    own["told"][new] = state[new]
    return part, new


def connected(count: int, a: Index, b: Index) -> Index:
    """Return the part of each object that links from `a` to `b` connect."""
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def opposed(objects: Objects, pairs: Table, part: Index) -> Index:
    """Return the rows (P, 2) of objects of one part that overlapping views show to be two."""
    against = pairs[(pairs["evidence"] < views.LEAST) & (pairs["linked"] == 0)]
    rows = np.column_stack([objects.at(against[side]) for side in ("a", "b")])
    same: Index = rows[part[rows[:, 0]] == part[rows[:, 1]]]
    return same


def _linked(objects: Objects, pairs: Table) -> tuple[Index, Index]:
    """Return the connected part of each object, and the pairs that stay linked."""
    own = objects.table
    linked: Index = np.flatnonzero(pairs["linked"] > 0)
    a, b = (objects.at(pairs[side][linked]) for side in ("a", "b"))
    for _ in range(2):
        part = connected(len(own), a, b)
        order = np.lexsort((own["first_ns"], own["session"], part))
        one, following = order[:-1], order[1:]
        clash = (part[one] == part[following]) & (own["session"][one] == own["session"][following])
        clash &= own["first_ns"][following] < own["last_ns"][one]
        apart = opposed(objects, pairs, part)
        if not clash.any() and len(apart) == 0:
            break
        inside = np.isin(part[a], part[np.concatenate((one[clash], apart[:, 0]))])
        stays = ~inside
        stays[inside] = _compatible(own, pairs["evidence"][linked[inside]], (a[inside], b[inside]), apart)
        pairs["linked"][linked[~stays]] = 0
        linked, a, b = linked[stays], a[stays], b[stays]
    return part, linked


def _compatible(own: Table, evidence: Array, links: tuple[Index, Index], apart: Index) -> NDArray[np.bool_]:
    """Return which links of parts with a clash stay: the surest first, and none of two objects.

    Two tracks of a session at once are two objects, and the rows `apart` (P, 2).
    """
    a, b = links
    stays = np.zeros(len(a), np.bool_)
    members: dict[int, list[int]] = {}
    where: dict[int, int] = {}
    two = set(map(tuple, np.concatenate((apart, apart[:, ::-1])).tolist()))
    for n in np.argsort(-evidence, kind="stable").tolist():
        one, other = (where.setdefault(int(row), int(row)) for row in (a[n], b[n]))
        left, right = members.setdefault(one, [one]), members.setdefault(other, [other])
        if one != other:
            if any((x, y) in two or _at_once(own[x], own[y]) for x in left for y in right):
                continue
            left += right
            for row in right:
                where[row] = one
        stays[n] = True
    return stays


def _at_once(x: np.void, y: np.void) -> bool:
    return bool(x["session"] == y["session"] and max(x["first_ns"], y["first_ns"]) < min(x["last_ns"], y["last_ns"]))

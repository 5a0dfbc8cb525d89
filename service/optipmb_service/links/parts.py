"""Parts of linked objects, and their global ids.

Linked objects form parts, in which no two tracks of one session exist at once. The oldest object of a part gives it its
id.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from optipmb_service.links.objects import NONE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Index
    from optipmb_service.links.objects import Objects

    Table = NDArray[np.void]


def settle(objects: Objects, pairs: Table) -> tuple[Index, Index]:
    """Give each linked part its id, and unlink pairs by which tracks of one session at once would be one object.

    Returns:
        The part of each object, and the rows whose id or end is to be published.
    """
    own = objects.table
    part, linked = _linked(own, pairs)
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


def _linked(own: Table, pairs: Table) -> tuple[Index, Index]:
    """Return the connected part of each object, and the pairs that stay linked."""
    linked: Index = np.flatnonzero(pairs["linked"] > 0)
    a, b = (np.searchsorted(own["number"], pairs[side][linked]) for side in ("a", "b"))
    for _ in range(2):
        graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(own), len(own)))
        _, part = connected_components(graph, directed=False)
        order = np.lexsort((own["first_ns"], own["session"], part))
        one, following = order[:-1], order[1:]
        clash = (part[one] == part[following]) & (own["session"][one] == own["session"][following])
        clash &= own["first_ns"][following] < own["last_ns"][one]
        if not clash.any():
            break
        parts = np.unique(part[one[clash]])
        inside = np.isin(part[a], parts)
        stays = ~inside
        stays[inside] = _compatible(own, pairs["probability"][linked[inside]], a[inside], b[inside])
        pairs["linked"][linked[~stays]] = 0
        linked, a, b = linked[stays], a[stays], b[stays]
    return part.astype(np.int64), linked


def _compatible(own: Table, probability: NDArray[np.float32], a: Index, b: Index) -> NDArray[np.bool_]:
    """Return which links of parts with a clash stay: no two tracks of a session at once; the oldest links first."""
    stays = np.zeros(len(a), np.bool_)
    members: dict[int, list[int]] = {}
    where: dict[int, int] = {}
    for n in np.lexsort((-probability, own["first_ns"][a] + own["first_ns"][b])).tolist():
        one, other = (where.setdefault(int(row), int(row)) for row in (a[n], b[n]))
        left, right = members.setdefault(one, [one]), members.setdefault(other, [other])
        if one != other:
            if any(_at_once(own[x], own[y]) for x in left for y in right):
                continue
            left += right
            for row in right:
                where[row] = one
        stays[n] = True
    return stays


def _at_once(x: np.void, y: np.void) -> bool:
    return bool(x["session"] == y["session"] and max(x["first_ns"], y["first_ns"]) < min(x["last_ns"], y["last_ns"]))

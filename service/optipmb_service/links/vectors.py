"""Appearance of the objects of an area: their vectors, and what a distance of two vectors says.

Distances are counted as joining over gaps counts them: within a track, of different objects, and of one object in two
views, which are objects that are sure without vectors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.joining.appearance import MOST_COUNTS, Vectors, appearance_score, bin_of, distance
from optipmb.model.lost_objects import DISTANCES
from optipmb_service.links.kinds import KINDS
from optipmb_service.links.objects import APPEARANCE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index
    from optipmb_service.links.looks import Look
    from optipmb_service.links.objects import Objects

    Table = NDArray[np.void]

OTHERS: Final = 8
"""Other objects from which the distance of a vector is counted."""
WITHIN, DIFFERENT, VIEWS = range(3)


class ObjectVectors:
    """Vectors of objects.

    Attributes:
        sums: when the newest vector of an object came, and their sum, by number.
        counts: distances by kind, of `WITHIN`, `DIFFERENT` and `VIEWS`, and distance.
    """

    def __init__(self) -> None:
        self.sums: dict[int, tuple[int, NDArray[np.float32]]] = {}
        self.counts = np.zeros((len(KINDS), 3, DISTANCES))

    def see(self, look: Look, numbers: Index, rows: Index, objects: Objects, pairs: Table) -> None:
        """Add the vectors of rows of a message to objects, and count distances.

        Other objects are the present ones; of a linked object, all that it is not linked to.
        """
        if look.vectors is None:
            return
        fresh = [n for n, row in enumerate(rows.tolist()) if not np.isnan(look.vectors[row, 0])]
        vectors = {int(numbers[n]): look.vectors[rows[n]] for n in fresh}
        partners = _partners(pairs)
        own = objects.table
        alive = own["number"][own["ended"] == 0].tolist()
        for number, vector in vectors.items():
            kind = int(own["kind"][objects.at(np.array(number))])
            views = partners.get(number, ())
            linked = {number, *views, *(one for other in views for one in partners[other])}
            known = self.sums if views else [one for one in alive if one in self.sums]
            self._count(kind, WITHIN, vector, (number,))
            self._count(kind, DIFFERENT, vector, [one for one in known if one not in linked][-OTHERS:])
            self._count(kind, VIEWS, vector, views)
        for number, vector in vectors.items():
            total = vector / np.linalg.norm(vector)
            if (old := self.sums.get(number)) is not None and len(old[1]) == len(vector):
                total = total + old[1] * np.float32(0.9)
            self.sums[number] = look.stamp_ns, total.astype(np.float32)

    def alike(self, lost: Index, young: Index, kind: Index) -> Array:
        """Return what vectors say of pairs (L, Y) of objects."""
        more = np.zeros((len(lost), len(young)))
        for m, number in enumerate(young.tolist()):
            if (own := self.sums.get(number)) is None:
                continue
            for n, other in enumerate(lost.tolist()):
                if (old := self.sums.get(other)) is not None and len(old[1]) == len(own[1]):
                    both = Vectors(np.array([number]), own[1][None], np.array([other]), old[1][None], self.counts)
                    more[n, m] = appearance_score(both, other, number, int(kind[m]))
        return more

    def _count(self, kind: int, which: int, vector: NDArray[np.float32], others: Iterable[int]) -> None:
        for other in others:
            known = self.sums.get(other)
            if known is None or len(known[1]) != len(vector):
                continue
            d = distance(vector, known[1], 0.0)
            if not np.isnan(d):
                self.counts[kind, which, bin_of(d)] += 1.0
        if self.counts[kind, which].sum() >= MOST_COUNTS:
            self.counts[kind, which] *= 0.5


def _partners(pairs: Table) -> dict[int, list[int]]:
    # Within a track vectors are more alike than in two views, and a link by vectors says nothing new of them.
    linked = pairs[(pairs["linked"] > 0) & (pairs["how"] < APPEARANCE)]
    found: dict[int, list[int]] = {}
    for a, b in zip(linked["a"].tolist(), linked["b"].tolist(), strict=True):
        found.setdefault(a, []).append(b)
        found.setdefault(b, []).append(a)
    return found

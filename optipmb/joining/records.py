"""Records of the state of joining as kernels read them: columns, and copies of rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.lost_objects import Beginnings, Ends, Places, Returns, Statistics, Tracklets
from optipmb.model.rows import arrays_of, views_of

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Index, Rows

TrackletArrays: Final = arrays_of(Tracklets, "TrackletArrays", __name__)
tracklets_in: Final = views_of(Tracklets, TrackletArrays, "tracklets_in", __file__)
PlaceArrays: Final = arrays_of(Places, "PlaceArrays", __name__)
places_in: Final = views_of(Places, PlaceArrays, "places_in", __file__)
BeginningArrays: Final = arrays_of(Beginnings, "BeginningArrays", __name__)
beginnings_in: Final = views_of(Beginnings, BeginningArrays, "beginnings_in", __file__)
ReturnArrays: Final = arrays_of(Returns, "ReturnArrays", __name__)
returns_in: Final = views_of(Returns, ReturnArrays, "returns_in", __file__)
EndArrays: Final = arrays_of(Ends, "EndArrays", __name__)
ends_in: Final = views_of(Ends, EndArrays, "ends_in", __file__)
StatisticArrays: Final = arrays_of(Statistics, "StatisticArrays", __name__)
statistics_in: Final = views_of(Statistics, StatisticArrays, "statistics_in", __file__)


def layout_of(rows: type[Rows]) -> Index:
    """Return first word and words of each column (K, 2)."""
    return np.array([(one.begin, one.end - one.begin) for one in rows.described.values()], dtype=np.int64)


@kernel
def copy_rows(source: Array, rows: Index, target: Array, places: Index, layout: Index) -> None:
    """Write rows of the words of a record to places in another's, column by column."""
    width = layout[-1, 0] + layout[-1, 1]
    many, most = source.shape[0] // width, target.shape[0] // width
    for c in range(layout.shape[0]):
        begin, size = layout[c, 0], layout[c, 1]
        for k in range(rows.shape[0]):
            n, place = begin * many + rows[k] * size, begin * most + places[k] * size
            for s in range(size):
                target[place + s] = source[n + s]


@kernel
def selected(source: Array, rows: Index, layout: Index) -> Array:
    """Return the words of the rows."""
    target = np.empty(rows.shape[0] * (layout[-1, 0] + layout[-1, 1]))
    copy_rows(source, rows, target, np.arange(rows.shape[0]), layout)
    return target

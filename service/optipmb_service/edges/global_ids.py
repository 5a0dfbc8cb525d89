"""Global ids of the tracks of streams, as `optipmb-service link` publishes them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import numpy as np
from optipmb_client.merging import remember

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_schemas import Links, Tracks

MOST: Final = 100_000
"""Objects of an area, as many as a message has; with more, the objects with the oldest rows are forgotten."""


class GlobalIds:
    """The newest row of each object of each area. For any threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._areas: OrderedDict[str, OrderedDict[tuple[str, str, int], str]] = OrderedDict()

    def take(self, message: Links) -> None:
        """Apply the rows of a message; a message with the whole state replaces all rows of its area."""
        with self._lock:
            rows = OrderedDict() if message.whole else self._areas.get(message.area, OrderedDict())
            for one in message.objects:
                key = one.stream, one.session, one.object
                rows[key] = one.global_id.hex()
                rows.move_to_end(key)
            while len(rows) > MOST:
                rows.popitem(last=False)
            remember(self._areas, message.area, rows)

    def of(self, tracks: Tracks) -> Sequence[str]:
        """Return the global id of each track in hexadecimal digits, empty where there is none; nothing without any."""
        with self._lock:
            if not any(self._areas.values()):
                return ()
            areas = [rows for _, rows in sorted(self._areas.items())]
            own = tracks.id if tracks.object is None else np.where(tracks.object >= 0, tracks.object, tracks.id)
            keys = ((tracks.stream, tracks.session, one) for one in own.tolist())
            found = [next((rows[key] for rows in areas if key in rows), "") for key in keys]
        return found if any(found) else ()

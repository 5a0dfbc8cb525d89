"""What a subscriber wants of the tracks: which of them, and which columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, get_args

import numpy as np
import optipmb_schemas as schemas
from optipmb_client.merging import FinalEventsOfStreams
from optipmb_schemas.json_form import Selection
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import column, select

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_CORNERS: Final = 1000
MAX_NAMES: Final = 256
CORNERS: Final = 3
KINDS: Final = get_args(schemas.ZoneEvent.model_fields["kind"].annotation)


def check_bound(name: str, value: int, most: int) -> None:
    """Raise MessageError if a value is above a bound."""
    if value > most:
        raise schemas.MessageError("too_large", name, f"at most {most}", str(value))


class Filter:
    """A filter as it was asked for.

    Args:
        asked: the filter.

    Raises:
        MessageError: it is not valid, with the path of its field.
    """

    def __init__(self, asked: pb.TrackFilter) -> None:
        self.key = asked.SerializeToString(deterministic=True)
        """Equal filters have equal keys; a filter of everything has an empty one."""
        check_bound("filter.classes", len(asked.classes), MAX_NAMES)
        check_bound("filter.fields", len(asked.fields), MAX_NAMES)
        for row, field in enumerate(asked.fields):
            if field not in (known := (*schemas.Tracks.arrays, "attributes")):
                expected = f"one of {', '.join(known)}"
                raise schemas.MessageError("invalid_value", f"filter.fields[{row}]", expected, ascii(field)[:80])
        if not 0 <= asked.min_existence <= 1:
            raise schemas.MessageError(
                "invalid_value", "filter.min_existence", "a number in [0, 1]", f"{asked.min_existence:g}"
            )
        self._selection = Selection(frozenset(asked.classes), asked.confirmed_only, asked.min_existence)
        self._area = _polygon(asked.area) if asked.HasField("area") else None
        paths = ["horizons"] if set(schemas.PATHS).intersection(asked.fields) else []
        self._fields = frozenset((*asked.fields, "id", *paths)) if asked.fields else None

    def of(self, tracks: pb.Tracks) -> pb.Tracks:
        """Return the selection of the tracks of a frame."""
        rows = self._rows(tracks)
        chosen = pb.Tracks()
        chosen.CopyFrom(tracks)
        for name, array in schemas.Tracks.arrays.items():
            if self._fields is not None and name not in self._fields:
                chosen.ClearField(name)
            elif chosen.HasField(name) and array.rows == "N":
                select(getattr(chosen, name), rows)
        place = np.cumsum(rows) - 1
        wanted = self._fields is None or "attributes" in self._fields
        known = [one for one in chosen.attributes if wanted and rows[one.row]]
        for one in known:
            one.row = place[one.row]
        kept = pb.Tracks(attributes=known)
        chosen.ClearField("attributes")
        chosen.attributes.extend(kept.attributes)
        return chosen

    def _rows(self, tracks: pb.Tracks) -> NDArray[np.bool_]:
        label, existence, age = (column(one) for one in (tracks.label, tracks.existence, tracks.age))
        confirmed = column(tracks.confirmed) if tracks.HasField("confirmed") else None
        rows = self._selection.rows_of(tracks.labels, label, existence, age, confirmed)
        if self._area is not None:
            rows &= _inside(column(tracks.center)[:, :2], self._area)
        return rows


EVERYTHING: Final = Filter(pb.TrackFilter())


class EventSelection:
    """Events as they were asked for.

    Args:
        asked: the request.

    Raises:
        MessageError: it is not valid, with the path of its field.
    """

    def __init__(self, asked: pb.SubscribeEventsRequest) -> None:
        self._chosen = {name: frozenset(getattr(asked, name)) for name in ("zones", "kinds", "classes")}
        for name, values in self._chosen.items():
            check_bound(name, len(values), MAX_NAMES)
        if unknown := self._chosen["kinds"] - set(KINDS):
            expected = f"some of {', '.join(KINDS)}"
            raise schemas.MessageError("invalid_value", "kinds", expected, ascii(min(unknown))[:80])
        self._final = asked.final or not asked.HasField("final")
        self._streams = FinalEventsOfStreams()

    def responses(self, message: schemas.Events) -> list[bytes]:
        """Return the responses that a message makes due."""
        due = self._streams.take(message) if self._final else [message]
        return [
            pb.SubscribeEventsResponse(events=convert.to_proto(one)).SerializeToString()
            for one in map(self._of, due)
            if one.events or one.zones or not self._final
        ]

    def _of(self, message: schemas.Events) -> schemas.Events:
        zones, kinds, classes = self._chosen.values()
        rows = [
            row
            for row, one in enumerate(message.events)
            if (not zones or one.zone in zones)
            and (not kinds or one.kind in kinds)
            and (not classes or message.labels[one.label] in classes)
        ]
        events, known = tuple(message.events[row] for row in rows), schemas.attributes_of_rows(message.attributes, rows)
        counts = message.zones and tuple(one for one in message.zones if not zones or one.zone in zones)
        return message.model_copy(update={"events": events, "zones": counts, "attributes": known})


def _inside(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points (N, 2) lie in a polygon (K, 2): those from which a ray along x crosses its edges an odd number
    of times.
    """  # noqa: D205 - one sentence
    x, y = points[:, :1], points[:, 1:]
    x1, y1 = corners.T
    x2, y2 = np.roll(corners, -1, axis=0).T
    crosses = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):  # horizontal edges cross no ray
        crosses &= x < x1 + (y - y1) / (y2 - y1) * (x2 - x1)
    odd: NDArray[np.bool_] = np.count_nonzero(crosses, axis=1) % 2 == 1
    return odd


def _polygon(area: pb.Polygon) -> NDArray[np.float64]:
    if not CORNERS <= len(area.x) <= MAX_CORNERS or len(area.y) != len(area.x):
        expected = f"x and y of {CORNERS} to {MAX_CORNERS} corners"
        raise schemas.MessageError("invalid_value", "filter.area", expected, f"{len(area.x)} x and {len(area.y)} y")
    corners = np.array([area.x, area.y], dtype="f8").T
    if not np.isfinite(corners).all():
        raise schemas.MessageError("invalid_value", "filter.area", "finite numbers", "others")
    return corners

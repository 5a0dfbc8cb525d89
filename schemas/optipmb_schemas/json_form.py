"""JSON of the edges: one object per detection, track, event and problem, for browsers, sensors and Node-RED.

A text is one frame of a WebSocket, one server-sent event, or the payload of one MQTT message. Numbers equal the
messages, rounded; stamps are texts, because 2^63 does not fit a number of JavaScript.
"""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import repeat
from math import isnan
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType

from optipmb_schemas.codec import encode_json
from optipmb_schemas.control import Problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from optipmb_schemas.messages import Attribute, Events, Tracks

    Place = Callable[[Any, Any], tuple[NDArray[np.float64], ...]]
    """Returns latitudes, longitudes, heights and headings of centres (N, 3) and yaws (N,)."""

DIGITS: Final = 3
"""Decimals of all numbers but latitude and longitude (9: 0.1 mm) and heading (1)."""

PLACE: Final = {"lat": 9, "lon": 9, "alt": 3, "heading": 1}
"""Fields of a place, and their decimals."""

CONFIRMED_EXISTENCE: Final = 0.5
EXACT: Final = 2**53
"""Numbers from here on are texts: JavaScript would round them."""

YEARS_NS: Final = (946_684_800 * 10**9, 4_102_444_800 * 10**9)  # 2000 and 2100

Lat = Annotated[float, Meta(description="Latitude in degrees (WGS84), 9 decimals. Absent: the site has no place.")]
Lon = Annotated[float, Meta(description="Longitude in degrees, 9 decimals.")]
Alt = Annotated[float, Meta(description="Height above the ellipsoid in m.")]
Position = Annotated[tuple[float, float, float], Meta(description="Centre: x, y, z in m, world frame.")]
Yaw = Annotated[float, Meta(description="Heading in radians, counter-clockwise from x of the world frame.")]
Speed = Annotated[float, Meta(description="Speed in m/s.")]
Known = float | None
Spot = Annotated[tuple[float, float, Known], Meta(description="Centre: x, y, z in m, world frame; null: not known.")]
Size = Annotated[tuple[Known, Known, Known], Meta(description="Length, width, height in m; null: not known.")]
Class = Annotated[str, Meta(description="Name of the class.")]


Told = Annotated[
    dict[str, tuple[str, float]],
    Meta(description="Attributes of the object, as its plate: by name a text and its share of the evidence."),
]


class EdgeTrack(Struct, frozen=True, rename={"kind": "class"}):
    """One track. Fields that a reader did not ask for are absent."""

    id: Annotated[int, Meta(description="Identity: unique in the stream, never used again.")]
    kind: Class | UnsetType = UNSET
    confirmed: Annotated[bool, Meta(description="Whether the object is taken to exist.")] | UnsetType = UNSET
    existence: Annotated[float, Meta(description="Probability that the object exists.")] | UnsetType = UNSET
    position: Spot | UnsetType = UNSET
    size: Size | UnsetType = UNSET
    yaw: Yaw | UnsetType | None = UNSET
    speed: Speed | UnsetType = UNSET
    velocity: Annotated[tuple[float, float], Meta(description="Velocity in m/s along x and y.")] | UnsetType = UNSET
    age_s: Annotated[float, Meta(description="Seconds since its first detection.")] | UnsetType = UNSET
    seen_s: Annotated[float, Meta(description="Seconds since its last detection.")] | UnsetType = UNSET
    object: (
        Annotated[int, Meta(description="Id of the first track of its object. Absent: not decided, or not joined.")]
        | UnsetType
    ) = UNSET
    object_probability: (
        Annotated[float, Meta(description="Probability that all joins of the object are right.")] | UnsetType
    ) = UNSET
    global_id: (
        Annotated[str, Meta(description="32 hexadecimal digits: one in all streams. Absent: it is not linked.")]
        | UnsetType
    ) = UNSET
    attributes: Told | UnsetType = UNSET
    lat: Lat | UnsetType = UNSET
    lon: Lon | UnsetType = UNSET
    alt: Alt | UnsetType = UNSET
    heading: Annotated[float, Meta(description="Degrees clockwise from true north, in [0, 360).")] | UnsetType = UNSET


FIELDS: Final = frozenset(msgspec.structs.asdict(EdgeTrack(0))) - {"id", "kind"} | {"class"}
"""Fields of an object that a reader may choose; `id` is always there."""


class _FrameForm(Struct, frozen=True, tag_field="type", kw_only=True):
    stream: Annotated[str, Meta(description="Name of the stream.")]
    sensor: Annotated[str, Meta(description="Stream of the detections.")]
    time: Annotated[str, Meta(description="Time of the frame in UTC; absent if not in 2000 to 2100.")] | UnsetType = (
        UNSET
    )
    stamp_ns: Annotated[str, Meta(description="The same in nanoseconds of the sensor's clock, as text.")]
    session: Annotated[str, Meta(description="32 hexadecimal digits. When it changes, earlier tracks have ended.")]
    epoch: Annotated[str, Meta(description="Start of the publisher, 32 hexadecimal digits.")]
    seq: Annotated[int | str, Meta(description="Number of the frame in its epoch; from 2^53 on as text.")]
    revision: Annotated[int, Meta(description="Above 0: replaces what was sent for the same epoch and seq.")]
    run: Annotated[int, Meta(description="A higher one replaces what was sent for the same epoch and seq.")]
    skipped: (
        Annotated[int, Meta(description="Texts left out since the one before: the reader was slow.")] | UnsetType
    ) = UNSET


class EdgeTracks(_FrameForm, frozen=True, tag="tracks", kw_only=True):
    """The tracks of one frame, also when there are none."""

    objects: Annotated[list[EdgeTrack], Meta(description="The tracks, ordered by id.")]
    predicted_to_ns: Annotated[str, Meta(description="Time of the states with `predict`, as text.")] | UnsetType = UNSET
    frame_age_s: Annotated[float, Meta(description="Seconds since the frame came, when this was sent.")] | UnsetType = (
        UNSET
    )
    stale: Annotated[bool, Meta(description="Whether that is more than `stale_s`.")] | UnsetType = UNSET


class EdgeEvent(_FrameForm, frozen=True, tag="event", kw_only=True, rename={"name": "class"}):
    """What a track did in a zone or at a line."""

    zone: Annotated[str, Meta(description="Name of the zone or line.")]
    kind: Literal["entered", "left", "stayed", "crossed"]
    n: Annotated[int, Meta(description="Counts the events of this zone and kind from 1, through restarts.")]
    id: Annotated[int, Meta(description="The track.")]
    name: Class
    at: Annotated[str, Meta(description="When, in UTC; absent if not in 2000 to 2100.")] | UnsetType = UNSET
    at_ns: Annotated[str, Meta(description="When, in nanoseconds of the sensor's clock, as text.")]
    position: Position
    speed: Speed
    yaw: Yaw
    how: Annotated[str, Meta(description="`crossed` the border, `appeared`, `lost` or `ended`.")] | UnsetType = UNSET
    dwell_s: Annotated[float, Meta(description="Seconds inside.")] | UnsetType = UNSET
    direction: Annotated[str, Meta(description="To the `left` or `right` of the line.")] | UnsetType = UNSET
    lat: Lat | UnsetType = UNSET
    lon: Lon | UnsetType = UNSET
    alt: Alt | UnsetType = UNSET
    object: Annotated[int, Meta(description="Id of the first track of its object.")] | UnsetType = UNSET
    attributes: Told | UnsetType = UNSET
    event_id: Annotated[str, Meta(description="Where a reader goes on: `after`. Absent over MQTT.")] | UnsetType = UNSET


class EdgeZones(_FrameForm, frozen=True, tag="zones", kw_only=True):
    """Counts of the zones and lines after a frame, once a second."""

    zones: Annotated[
        dict[str, dict[str, dict[str, int]]],
        Meta(description="By zone and class: `inside`, `entered`, `distinct` objects, `left`, …, as in Events."),
    ]


class EdgeMissed(Struct, frozen=True, tag_field="type", tag="missed"):
    """What a reader of events that comes again, or is too slow, cannot get any more."""

    stream: Annotated[str, Meta(description="The pattern of its streams.")]
    events: Annotated[int | None, Meta(description="So many events; null: not known, compare `n`.")]


Corners = Annotated[tuple[float, float, float, float], Meta(description="Left, top, right, bottom in pixels.")]
Foot = Annotated[tuple[float, float], Meta(description="Column and row in pixels where it stands.")]
Row = tuple[float, float, float]


class EdgeObject(Struct, frozen=True, rename={"name": "class"}):
    """One detection: its class and one of `position`, `lat` with `lon`, `box` and `foot`. Other fields are ignored."""

    name: Class
    score: Annotated[float, Meta(description="Confidence of the detector, 0 to 1. Absent: 1.")] | None = None
    confidence: Annotated[float, Meta(description="Another name of `score`.")] | None = None
    position: (
        Annotated[list[Known], Meta(min_length=2, max_length=3, description="Centre: x, y, and z if known; m.")] | None
    ) = None
    lat: Annotated[float, Meta(ge=-90, le=90, description="Latitude in degrees; the site needs a place.")] | None = None
    lon: Annotated[float, Meta(ge=-180, le=180, description="Longitude in degrees.")] | None = None
    alt: Annotated[float, Meta(ge=-1e5, le=1e5, description="Height above the ellipsoid in m.")] | None = None
    heading: (
        Annotated[float, Meta(ge=-1e5, le=1e5, description="Degrees clockwise from true north: `yaw` of the site.")]
        | None
    ) = None
    box: Corners | None = None
    foot: Foot | None = None
    size: Size | None = None
    yaw: Annotated[float, Meta(description="Heading in radians, counter-clockwise from x of `frame`.")] | None = None
    velocity: Annotated[tuple[float, float], Meta(description="Over ground, m/s along x and y of `frame`.")] | None = (
        None
    )
    position_covariance: Annotated[tuple[Row, Row, Row], Meta(description="Of the errors of x, y, z; m^2.")] | None = (
        None
    )
    embedding: Annotated[list[float], Meta(description="Appearance, of the frame's `embedding_model`.")] | None = None
    attributes: (
        Annotated[
            dict[str, str | tuple[str, float]],
            Meta(description="Texts by name, as `plate`, each alone or with a score; at most 8 of 32 bytes."),
        ]
        | None
    ) = None


class EdgeDetections(Struct, frozen=True, forbid_unknown_fields=True):
    """The detections of one frame, from a sensor that speaks JSON. A frame without objects is sent, too."""

    objects: Annotated[list[EdgeObject], Meta(description="The detected objects; may be empty.")]
    stream: Annotated[str, Meta(description="`site/node/sensor`. Absent: the address says it.")] | None = None
    time: Annotated[str, Meta(description="Sensor time: ISO 8601 with `Z` or an offset. Absent: arrival.")] | None = (
        None
    )
    stamp_ns: Annotated[int | str, Meta(description="The same in nanoseconds, also as text.")] | None = None
    frame: Annotated[Literal["world", "sensor"], Meta(description="Frame of all coordinates.")] = "world"
    pose: Annotated[dict[str, Any], Meta(description="As in Detections.")] | None = None
    field_of_view: Annotated[dict[str, Any], Meta(description="As in Detections.")] | None = None
    relocation: Annotated[dict[str, Any], Meta(description="As in Detections.")] | None = None
    embedding_model: Annotated[str, Meta(description="As in Detections.")] | None = None
    epoch: Annotated[str, Meta(description="As in Detections, with `seq`. Absent: the edge numbers.")] | None = None
    seq: Annotated[int | str, Meta(description="As in Detections, also as text.")] | None = None
    key: Annotated[str, Meta(min_length=1, max_length=128, description="Frames of one key are one frame.")] | None = (
        None
    )


KINDS: Final = (EdgeDetections, EdgeTracks, EdgeEvent, EdgeZones, EdgeMissed)


class Selection(Struct, frozen=True):
    """Which tracks a reader wants, and which of their fields."""

    classes: frozenset[str] = frozenset()
    confirmed: bool = False
    min_existence: float = 0.0
    fields: frozenset[str] = frozenset()

    def rows(self, tracks: Tracks) -> NDArray[np.bool_]:
        """Return which rows of the tracks (N,) are wanted."""
        return self.rows_of(tracks.labels, tracks.label, tracks.existence, tracks.age, tracks.confirmed)

    def rows_of(
        self,
        labels: Iterable[str],
        label: NDArray[Any],
        existence: NDArray[np.float64],
        age: NDArray[np.float64],
        confirmed: NDArray[Any] | None,
    ) -> NDArray[np.bool_]:
        """Return as `rows` by columns (N,)."""
        rows: NDArray[np.bool_] = existence >= self.min_existence
        if self.confirmed:
            rows &= shown_rows(confirmed, existence, age)
        if self.classes:
            rows &= np.isin(label, [at for at, name in enumerate(labels) if name in self.classes])
        return rows


EVERYTHING: Final = Selection()


def shown(tracks: Tracks) -> NDArray[np.bool_]:
    """Return which tracks (N,) people are shown, and all counts count: the confirmed ones."""
    return shown_rows(tracks.confirmed, tracks.existence, tracks.age)


def shown_rows(
    confirmed: NDArray[Any] | None, existence: NDArray[np.float64], age: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return as `shown` by columns (N,); without `confirmed`, probable tracks that were detected twice."""
    if confirmed is not None:
        return np.asarray(confirmed > 0)
    return np.asarray((existence > CONFIRMED_EXISTENCE) & (age > 0.0))


def _objects(tracks: Tracks, rows: NDArray[np.int64]) -> dict[str, Iterable[Any]]:
    """Return the fields of the objects of rows."""
    if tracks.object is None or tracks.object_probability is None:
        return dict.fromkeys(("object", "object_probability"), repeat(UNSET))
    number = tracks.object[rows]
    probability = np.round(tracks.object_probability[rows].astype(np.float64), DIGITS)
    known = zip(number.tolist(), probability.tolist(), strict=True)
    # A reader that counts by `object` would take all tracks with one mark for one object.
    told = [(one, share) if one >= 0 else (UNSET, UNSET) for one, share in known]
    return {"object": [one for one, _ in told], "object_probability": [share for _, share in told]}


def _told(attributes: tuple[Attribute, ...] | None) -> dict[int, dict[str, tuple[str, float]]]:
    """Return the attributes of each row that has any."""
    found: dict[int, dict[str, tuple[str, float]]] = {}
    for one in attributes or ():
        found.setdefault(one.row, {})[one.name] = one.text, round(one.score, DIGITS)
    return found


def tracks_json(
    tracks: Tracks, selection: Selection = EVERYTHING, place: Place | None = None, global_ids: Sequence[str] = ()
) -> bytes:
    """Return the selected tracks of a frame as one text; `global_ids` of all tracks, empty where there is none."""
    rows = np.flatnonzero(selection.rows(tracks))
    center, size, yaw = tracks.center, tracks.size, tracks.yaw
    if tracks.measured is not None:  # NaN becomes null
        heading, sized, high = (tracks.measured & bit > 0 for bit in (1, 2, 4))
        center = np.where(high[:, None] | np.array([True, True, False]), center, np.nan)
        size, yaw = np.where(sized[:, None], size, np.nan), np.where(heading, yaw, np.nan)
    numbers = {
        "existence": tracks.existence,
        "position": center,
        "size": size,
        "yaw": yaw,
        "speed": np.hypot(*tracks.velocity.T),
        "velocity": tracks.velocity,
        "age_s": tracks.age,
        "seen_s": tracks.time_since_detection,
    }
    columns: dict[str, Iterable[Any]] = {
        "id": tracks.id[rows].tolist(),
        "class": map(tracks.labels.__getitem__, tracks.label[rows].tolist()),
        "confirmed": shown(tracks)[rows].tolist(),
        **{name: np.round(column[rows], DIGITS).tolist() for name, column in numbers.items()},
        **_objects(tracks, rows),
        "global_id": (global_ids[row] or UNSET for row in rows.tolist()) if global_ids else repeat(UNSET),
        "attributes": map(_told(tracks.attributes).get, rows.tolist(), repeat(UNSET)),
        **dict(zip(PLACE, _placed(tracks.center[rows], yaw[rows], place), strict=True)),
    }
    if selection.fields:
        columns |= dict.fromkeys(columns.keys() - selection.fields - {"id"}, repeat(UNSET))
    objects = [EdgeTrack(*row) for row in zip(*columns.values(), strict=False)]
    time_ns = UNSET if tracks.predicted_to_ns is None else str(tracks.predicted_to_ns)
    return msgspec.json.encode(EdgeTracks(**_about(tracks), objects=objects, predicted_to_ns=time_ns))


def features_json(frames: Iterable[bytes]) -> bytes:
    """Return frames of tracks (`tracks_json`) as a GeoJSON text: a point for each track that has a place.

    Properties are the fields of the track and of its frame.
    """
    features = []
    for text in frames:
        about = msgspec.json.decode(text)
        del about["type"]
        for one in about.pop("objects"):
            if "lat" not in one:  # farther than 100 km from the origin of its site
                continue
            coordinates = [one.pop(name) for name in ("lon", "lat", "alt")]
            point = {"type": "Point", "coordinates": coordinates}
            name = f"{about['stream']}/{one.get('object', one['id'])}"  # as the UUID of ROS 2
            features.append({"type": "Feature", "id": name, "geometry": point, "properties": about | one})
    return msgspec.json.encode({"type": "FeatureCollection", "features": features})


def event_json(events: Events, place: Place | None = None) -> list[bytes]:
    """Return each event of a message as a text."""
    about = _about(events)
    position = np.array([one.position for one in events.events], np.float64).reshape(-1, 3)
    placed, told = _placed(position, np.zeros(len(position)), place), _told(events.attributes)
    rows = zip(events.events, *placed, strict=True)
    return [
        msgspec.json.encode(
            EdgeEvent(
                **about,
                zone=one.zone,
                kind=one.kind,
                n=one.n,
                id=one.id,
                name=events.labels[one.label],
                at=_time(one.at_ns),
                at_ns=str(one.at_ns),
                position=tuple(round(value, DIGITS) for value in one.position),
                speed=round(one.speed, DIGITS),
                yaw=round(one.yaw, DIGITS),
                how=one.how or UNSET,
                dwell_s=UNSET if one.dwell_s is None else round(one.dwell_s, DIGITS),
                direction=one.direction or UNSET,
                object=UNSET if one.object is None else one.object,
                attributes=told.get(row, UNSET),
                lat=lat,
                lon=lon,
                alt=alt,
            )
        )
        for row, (one, lat, lon, alt, _) in enumerate(rows)
    ]


def zones_json(events: Events) -> bytes | None:
    """Return the counts of a message as one text; None without any."""
    if events.zones is None:
        return None
    zones = {
        zone.zone: {
            name: {count: values[at] for count, values in zone.present() if count != "zone"}
            for at, name in enumerate(events.labels)
        }
        for zone in events.zones
    }
    return msgspec.json.encode(EdgeZones(**_about(events), zones=zones))


def problem_json(problem: Problem) -> bytes:
    """Return a problem as one text: the message with its type."""
    return b'{"type":"problem",' + encode_json(problem)[1:]


def missed_json(stream: str, events: int | None) -> bytes:
    """Return a text that says how many events of a pattern a reader cannot get."""
    return msgspec.json.encode(EdgeMissed(stream, events))


def with_age(text: bytes, age_s: float, *, stale: bool) -> bytes:
    """Return the text of a frame with its age."""
    return text[:-1] + b',"frame_age_s":%.3f,"stale":%b}' % (age_s, b"true" if stale else b"false")


def with_event_id(text: bytes, event_id: str) -> bytes:
    """Return the text of an event with the id after which a reader goes on."""
    return text[:-1] + b',"event_id":"%b"}' % event_id.encode()


def with_skipped(text: bytes, skipped: int) -> bytes:
    """Return a text that says how many others were left out before it."""
    return text[:-1] + b',"skipped":%d}' % skipped if skipped else text


def schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schemas (draft 2020-12) of all texts, by name."""
    found = {}
    for kind in KINDS:
        definitions = msgspec.json.schema(kind)["$defs"]
        found[kind.__name__] = definitions.pop(kind.__name__) | ({"$defs": definitions} if definitions else {})
    problem = Problem.model_json_schema()
    fields = {"type": {"enum": ["problem"]}} | problem["properties"] | {"skipped": {"type": "integer"}}
    found["EdgeProblem"] = problem | {
        "title": "EdgeProblem",
        "properties": fields,
        "required": ["type", *problem["required"]],
    }
    return found


def _about(message: Tracks | Events) -> dict[str, Any]:
    """Return the fields that all texts about a frame have."""
    return {
        "stream": message.stream,
        "sensor": message.sensor or message.stream,
        "time": _time(message.stamp_ns),
        "stamp_ns": str(message.stamp_ns),
        "session": message.session,
        "epoch": message.epoch.hex(),
        "seq": message.seq if message.seq < EXACT else str(message.seq),
        "revision": message.revision,
        "run": 0 if message.delivery is None else message.delivery.run,
    }


def _time(stamp_ns: int) -> str | UnsetType:
    if not YEARS_NS[0] <= stamp_ns < YEARS_NS[1]:
        return UNSET
    seconds, rest = divmod(stamp_ns, 10**9)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"


def _placed(center: NDArray[np.float64], yaw: NDArray[np.float64], place: Place | None) -> list[Any]:
    """Return columns of latitude, longitude, height and heading; UNSET where they are not known."""
    if place is None:
        return [[UNSET] * len(center)] * len(PLACE)
    columns = [np.round(one, digits) for one, digits in zip(place(center, yaw), PLACE.values(), strict=True)]
    columns[3] %= 360.0  # 359.97 was rounded to 360
    return [[UNSET if isnan(value) else value for value in column.tolist()] for column in columns]

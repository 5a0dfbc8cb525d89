"""The page for people: streams, health and the live tracks of one stream, seen from above.

Nothing here costs anything until somebody looks. Viewers of a stream share its subscriptions, which end a minute after
the last of them. Each gets the newest frame at most ten times a second, as one line of JSON (world frame, metres,
radians, seconds; rounded to what can be seen); what a slow viewer cannot take is never made. Files and data come from
here alone, and a header has the browser accept nothing else.
"""

from __future__ import annotations

import asyncio
import importlib.resources
import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas
from optipmb_schemas.json_form import shown
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from optipmb_service.edges.http.api import parameters_of
from optipmb_service.edges.queues import Outbox

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from optipmb_schemas.json_form import Place
    from starlette.requests import Request

    from optipmb_service.edges.http.api import Readers
    from optipmb_service.edges.readers import EventLog, Logs, Publication
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth

PERIOD_S: Final = 0.1  # a viewer gets no more than one frame in this time
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}

FILES: Final = {"/": "index.html", "/look.js": "look.js", "/look.css": "look.css"}
TYPES: Final = {"html": "text/html", "js": "text/javascript", "css": "text/css"}


_SENSORS: Final = 8  # detections of so many sensors are kept for a viewer of tracks that several share
_BYTES: Final = 2**22  # and so many bytes of them, or one message
_EVENTS: Final = 8  # newest events in one frame
_MOST: Final = 1000  # tracks, and detections, in one frame at most


def page(health: ProcessHealth, readers: Readers, settings: Settings, places: Mapping[str, Place]) -> list[Route]:
    """Return the routes of the page."""

    async def status(request: Request) -> Response:
        parameters_of(request, ())
        (await readers.caller(request)).may_read("*/*/*")
        if (found := await asyncio.to_thread(health.status)) is None:
            return JSONResponse({"state": health.state()}, headers=HEADERS)
        return Response(schemas.encode_json(found), media_type="application/json", headers=HEADERS)

    async def live(request: Request) -> Response:
        stream = parameters_of(request, ["stream"]).get("stream", "")
        keys = [readers.keys.tracks(stream)]
        seen = health.detections_of(stream)
        (await readers.caller(request)).may_read(seen)
        keys.append(readers.keys.all("detections").replace("*/*/*", seen))
        place = places.get(stream.partition("/")[0])
        zones = []
        if settings.zones_of(stream):
            zones = await asyncio.to_thread(_shapes, settings, stream)
            keys.append(readers.keys.events(stream))
        return await readers.stream(request, keys, lambda: Live(place, zones), HEADERS, PERIOD_S)

    files = [Route(path, _file(name)) for path, name in FILES.items()]
    return [*files, Route("/status", status), Route("/live", live)]


def _shapes(settings: Settings, stream: str) -> list[dict[str, Any]]:
    """Return the polygons and lines of a stream, in its world frame."""
    site = settings.sites.get(stream.partition("/")[0])
    zones = {name: settings.zones[name].zone(name, site) for name in settings.zones_of(stream)}
    return [{"name": name, "polygon": one.polygon or None, "line": one.line or None} for name, one in zones.items()]


def _file(name: str) -> Callable[[Request], Response]:
    content = importlib.resources.files(__package__).joinpath("static", name).read_bytes()
    kind = TYPES[name.rpartition(".")[2]]

    async def endpoint(_request: Request) -> Response:
        return Response(content, media_type=kind, headers=HEADERS)

    return endpoint  # type: ignore[return-value]  # Starlette takes both kinds


class Live:
    """Queue of the page: the newest tracks of a stream, drawn when they are taken, with the newest detections."""

    def __init__(self, place: Place | None, zones: Sequence[dict[str, Any]] = ()) -> None:
        self._place = place
        self._zones = zones
        self._counts: bytes | None = None
        self._events: EventLog | None = None
        self._tracks: Outbox[Publication] = Outbox()
        self._detections: tuple[Publication, ...] = ()

    def receive(self, one: Publication) -> None:
        """Take a message, on any thread."""
        if one.topic == "tracks":
            self._tracks.put("", one, len(one.payload))
            return
        if one.topic == "events":
            self._counts = (one.message and one.zones) or self._counts
            return
        kept = (one, *self._detections)[:_SENSORS]
        while len(kept) > 1 and sum(len(each.payload) for each in kept) > _BYTES:
            kept = kept[:-1]
        self._detections = kept  # they are shown with the next tracks

    def read(self, logs: list[Logs]) -> str:
        """Show the newest events of the last one of these logs, as they are published."""
        for log in logs:
            self._events = log[False]
        return ""

    async def take(self, seconds: float | None = None) -> tuple[bytes, str]:
        """Return the next drawing. Raises TimeoutError where none has come in so long."""
        while True:
            await self._tracks.wait(seconds)
            taken = self._tracks.take_now()
            if taken is not None and (text := live_frame(taken[0], *self._detections, place=self._place)) is not None:
                return self._with_zones(text), ""

    def _with_zones(self, text: bytes) -> bytes:
        if not self._zones:
            return text
        events = [] if self._events is None else [one.text for one in self._events.after(0)[0][-_EVENTS:]]
        shapes = json.dumps(self._zones, separators=(",", ":")).encode()
        parts = text[:-1], shapes, self._counts or b"null", b",".join(events)
        return b'%b,"zones":%b,"counts":%b,"events":[%b]}' % parts


def live_frame(tracks: Publication, *detections: Publication, place: Place | None = None) -> bytes | None:
    """Return the drawing of the page, as JSON; None without a valid message.

    Of the detections, the latest first, the latest of each stream are drawn, up to the first repeated stream.
    """
    message = tracks.message
    if message is None:
        return None
    rows = np.column_stack(
        [
            message.center[:, :2],
            message.size[:, :2],
            message.yaw,
            message.velocity,
            message.existence,
            message.score,
            message.age,
            message.time_since_detection,
            np.ones(len(message.id)) if message.heading_confidence is None else message.heading_confidence,
        ]
    )
    confirmed = shown(message)
    numbers = np.round(rows[confirmed][:_MOST], 3).tolist()
    if message.object is not None:
        numbers = [[*one, number] for one, number in zip(numbers, message.object[confirmed].tolist(), strict=False)]
    heads = zip(message.id[confirmed].tolist(), message.label[confirmed].tolist(), numbers, strict=False)
    sensor, found = _seen(detections)
    frame: dict[str, Any] = {
        "time": message.stamp_ns / 1e9,
        "session": message.session,
        "profile": message.profile,
        "labels": message.labels,
        "tracks": [[identity, label, *values] for identity, label, values in heads],
        "unconfirmed": int((~confirmed).sum()),
        "sensor": sensor,
        "detections": found,
    }
    if ids := tracks.global_ids:
        frame["global"] = [ids[row] for row in np.flatnonzero(confirmed)[:_MOST].tolist()]
    if place is not None:
        places = place(message.center[confirmed][:_MOST], message.yaw[confirmed][:_MOST])
        rows = np.stack([np.round(one, digits) for one, digits in zip(places, (9, 9, 3, 1), strict=True)], axis=1)
        frame["geographic"] = [None if np.isnan(row[0]) else row.tolist() for row in rows]
    return json.dumps(frame, separators=(",", ":")).encode()


def _seen(publications: Sequence[Publication]) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the newest sensor, where it is known, and x, y of all detections, in the world frame."""
    sensor: list[float] | None = None
    found: list[list[float]] = []
    streams: set[str] = set()
    for number, one in enumerate(publications):
        if (message := one.message) is None:
            continue
        if message.stream in streams:
            break
        streams.add(message.stream)
        place, centers = _placed(message)
        sensor = sensor if number else place
        found += centers
    return sensor, found


def _placed(message: schemas.Detections) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the sensor, where it is known, and x, y of the detections, in the world frame.

    A pose that is the origin itself says no more than that there are none.
    """
    center, sensor = message.center[:_MOST], None
    if message.pose is not None:
        w, x, y, z = message.pose.quaternion
        rows = np.array(  # the first two rows of the rotation: the view from above
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            ]
        )
        place = message.pose.translation[:2]
        found = np.round([*place, np.arctan2(rows[1, 0], rows[0, 0])], 3)
        sensor = found.tolist() if found.any() else None
        if message.frame == "sensor":
            center = center @ rows.T + place
    return sensor, np.round(center[:, :2], 2).tolist()

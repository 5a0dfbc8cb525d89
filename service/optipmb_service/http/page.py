"""The page for people: streams, health and the live tracks of one stream, seen from above.

Nothing here costs anything until somebody looks. Viewers of a stream share a tap on its keys, which ends a minute after
the last of them. Each gets the newest frame at most ten times a second, as one line of JSON (world frame, metres,
radians, seconds; rounded to what can be seen); what a slow viewer cannot take is never made. Files and data come from
here alone, and a header has the browser accept nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.resources
import json
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas
from optipmb_client.errors import ConnectionFailed as TransportError
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from starlette.requests import Request
    from starlette.types import Receive, Scope, Send

    from optipmb import Georeference
    from optipmb_service.telemetry.health import ProcessHealth

PERIOD_S: Final = 0.1  # a viewer gets no more than one frame in this time
KEEP_ALIVE_S: Final = 5.0  # period of signs of life of a silent stream, for proxies in between
RETRY_MS: Final = 15_000  # a viewer whose stream cannot be subscribed to comes back after so long
VIEWERS: Final = 16  # those who look at the same time; more are asked to come back
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
_MOST: Final = 1000  # tracks, and detections, in one frame at most

Sample = tuple[bytes, str]
"""Payload and encoding."""


def page(health: ProcessHealth, sites: Mapping[str, Georeference] | None = None) -> list[Route]:
    """Return the routes of the page."""
    viewers = _Viewers(health, sites or {})
    files = [Route(path, _file(name)) for path, name in FILES.items()]
    return [*files, Route("/status", _status(health)), Route("/live", viewers.live)]


def _file(name: str) -> Callable[[Request], Response]:
    content = importlib.resources.files(__package__).joinpath("static", name).read_bytes()
    kind = TYPES[name.rpartition(".")[2]]

    async def endpoint(_request: Request) -> Response:
        return Response(content, media_type=kind, headers=HEADERS)

    return endpoint  # type: ignore[return-value]  # Starlette takes both kinds


def _status(health: ProcessHealth) -> Callable[[Request], Response]:
    def endpoint(_request: Request) -> Response:
        status = health.status()
        if status is None:
            return JSONResponse({"state": health.state()}, headers=HEADERS)
        return Response(schemas.encode_json(status), media_type="application/json", headers=HEADERS)

    return endpoint


class _Counted(StreamingResponse):
    """Events for one viewer; calls `leave` when they end, however they do."""

    def __init__(self, events: AsyncIterator[str], leave: Callable[[], None]) -> None:
        super().__init__(events, media_type="text/event-stream", headers=HEADERS)
        self._leave = leave

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._leave()


class _Viewers:
    """Those who look at a stream now."""

    def __init__(self, health: ProcessHealth, sites: Mapping[str, Georeference]) -> None:
        self._health = health
        self._sites = sites
        self._count = 0

    async def live(self, request: Request) -> Response:
        """Answer with the frames of a stream as server-sent events."""
        stream = request.query_params.get("stream", "")
        try:
            schemas.Keys().tracks(stream)
        except schemas.MessageError as error:
            return PlainTextResponse(str(error), status_code=400, headers=HEADERS)
        if self._count >= VIEWERS:
            return PlainTextResponse(f"{VIEWERS} viewers are here already", status_code=503, headers=HEADERS)
        self._count += 1  # before anything is awaited: those who come together are counted one by one
        return _Counted(self._events(stream), self._leave)

    def _leave(self) -> None:
        self._count -= 1

    async def _events(self, stream: str) -> AsyncIterator[str]:
        loop = asyncio.get_running_loop()
        newest = Newest(loop)
        tapped = loop.run_in_executor(None, self._health.tap, stream, newest.put)
        try:
            release = await asyncio.shield(tapped)
        except TransportError as error:
            yield f"retry: {RETRY_MS}\n: {error}\n\n"
            return
        except asyncio.CancelledError:
            tapped.add_done_callback(_undo)  # the viewer has gone; the thread makes the tap all the same
            raise
        if release is None:
            return
        try:
            heard = time.monotonic()
            yield ": hello\n\n"  # the headers go with the first piece: the viewer knows that it is connected
            while self._health.state() != "stopping":
                if not await newest.came(PERIOD_S):
                    if time.monotonic() - heard > KEEP_ALIVE_S:
                        heard = time.monotonic()
                        yield ": silent\n\n"
                    continue
                heard = time.monotonic()
                text = live_frame(*newest.take(), georeference=self._sites.get(stream.partition("/")[0]))
                if text is not None:
                    yield f"data: {text}\n\n"
                await asyncio.sleep(PERIOD_S)
        finally:
            loop.run_in_executor(None, release)  # not awaited: the viewer's task may be cancelled


def _undo(tapped: asyncio.Future[Callable[[], None] | None]) -> None:
    """Release a tap whose viewer has gone."""
    if tapped.cancelled() or tapped.exception() is not None or (release := tapped.result()) is None:
        return
    with contextlib.suppress(RuntimeError):  # the server ends, and so do its threads
        tapped.get_loop().run_in_executor(None, release)


class Newest:
    """The newest message of each topic for one reader on an event loop; one that was not taken is replaced."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._tracks: Sample | None = None
        self._detections: deque[Sample] = deque(maxlen=_SENSORS)
        self._event = asyncio.Event()

    def put(self, topic: str, payload: bytes, encoding: str) -> None:
        """Take a message, on any thread."""
        with self._lock:
            if topic == "detections":
                self._detections.appendleft((payload, encoding))
                while len(self._detections) > 1 and sum(len(one) for one, _ in self._detections) > _BYTES:
                    self._detections.pop()
                return  # it is shown with its tracks
            waits = self._tracks is not None
            self._tracks = (payload, encoding)
        if not waits and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._event.set)

    async def came(self, seconds: float) -> bool:
        """Wait for tracks, at most so long; tell whether there are any."""
        try:
            await asyncio.wait_for(self._event.wait(), seconds)
        except TimeoutError:
            return False
        return True

    def take(self) -> tuple[Sample | None, *tuple[Sample, ...]]:
        """Return the newest tracks, once, and the newest detections, the latest first."""
        with self._lock:
            self._event.clear()
            tracks, self._tracks = self._tracks, None
            return tracks, *self._detections


def live_frame(tracks: Sample | None, *detections: Sample, georeference: Georeference | None = None) -> str | None:
    """Return the drawing of the page, as JSON; None without a valid message.

    Of the detections, the latest first, the latest of each stream are drawn, up to the first repeated stream.
    """
    if tracks is None:
        return None
    try:
        message = schemas.decode(tracks[0], schemas.Tracks, encoding=tracks[1])
    except schemas.MessageError:
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
    confirmed = np.ones(len(rows), np.bool_) if message.confirmed is None else message.confirmed > 0
    numbers = np.round(rows[confirmed][:_MOST], 3).tolist()
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
    if georeference is not None:
        places = georeference.to_geographic(message.center[confirmed][:_MOST], message.yaw[confirmed][:_MOST])
        rows = np.stack([np.round(one, digits) for one, digits in zip(places, (9, 9, 3, 1), strict=True)], axis=1)
        frame["geographic"] = [None if np.isnan(row[0]) else row.tolist() for row in rows]
    return json.dumps(frame, separators=(",", ":"))


def _seen(samples: Sequence[Sample]) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the newest sensor, where it is known, and x, y of all detections, in the world frame."""
    sensor: list[float] | None = None
    found: list[list[float]] = []
    streams: set[str] = set()
    for number, sample in enumerate(samples):
        try:
            message = schemas.decode(sample[0], schemas.Detections, encoding=sample[1])
        except schemas.MessageError:
            continue
        if message.stream in streams:
            break
        streams.add(message.stream)
        place, centers = _placed(message)
        sensor = sensor if number else place
        found += centers
    return sensor, found


def _placed(message: schemas.Detections) -> tuple[list[float] | None, list[list[float]]]:
    """Return x, y, heading of the sensor, where it is known, and x, y of the detections, in the world frame."""
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
        sensor = np.round([*place, np.arctan2(rows[1, 0], rows[0, 0])], 3).tolist()
        if message.frame == "sensor":
            center = center @ rows.T + place
    return sensor, np.round(center[:, :2], 2).tolist()

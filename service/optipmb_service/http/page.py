"""The page for people: streams, health and the live tracks of one stream, seen from above.

Nothing here costs anything until somebody looks. Those who look at a stream share a tap on its keys, which ends a
minute after the last of them. Each gets the newest frame at most ten times a second; what a slow viewer cannot take is
never made. Files and data come from here alone, and a header has the browser accept nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.resources
from typing import TYPE_CHECKING, Final, Protocol

import optipmb_schemas as schemas
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from optipmb_service.http.live import Newest, live_frame
from optipmb_service.runtime.ports import TransportError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from starlette.requests import Request
    from starlette.routing import BaseRoute
    from starlette.types import Receive, Scope, Send

PERIOD_S: Final = 0.1
"""A viewer gets no more than one frame in this time."""

KEEP_ALIVE_S: Final = 5.0
"""A silent stream gets a sign of life, so that nobody in between takes the connection for dead."""

RETRY_MS: Final = 15_000
"""A viewer whose stream cannot be subscribed to comes back after so long."""

VIEWERS: Final = 16
"""Those who look at the same time; more are asked to come back."""

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


class Watched(Protocol):
    """What the page shows; every method may be called by any thread and answers at once."""

    def state(self) -> str:
        """Return the state of the process."""

    def status(self) -> schemas.ServiceStatus | None:
        """Return the service's own report; None while it starts."""

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None] | None:
        """Hand over topic, payload and encoding of a stream's detections and tracks until the result is called.

        None while the service starts. `receive` is called by other threads and must return at once.

        Raises:
            TransportError: the network cannot be used, or too many streams were looked at.
        """


def page(watched: Watched) -> list[BaseRoute]:
    """Return the routes of the page."""
    viewers = _Viewers(watched)
    files = [Route(path, _file(name)) for path, name in FILES.items()]
    return [*files, Route("/status", _status(watched)), Route("/live", viewers.live)]


def _file(name: str) -> Callable[[Request], Response]:
    content = importlib.resources.files(__package__).joinpath("static", name).read_bytes()
    kind = TYPES[name.rpartition(".")[2]]

    async def endpoint(_request: Request) -> Response:
        return Response(content, media_type=kind, headers=HEADERS)

    return endpoint  # type: ignore[return-value]  # Starlette takes both kinds


def _status(watched: Watched) -> Callable[[Request], Response]:
    def endpoint(_request: Request) -> Response:
        status = watched.status()
        if status is None:
            return JSONResponse({"state": watched.state()}, headers=HEADERS)
        return Response(schemas.encode_json(status), media_type="application/json", headers=HEADERS)

    return endpoint


class _Counted(StreamingResponse):
    """Events for one viewer, and what is called when they end, however they do."""

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

    def __init__(self, watched: Watched) -> None:
        self._watched = watched
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
        tapped = loop.run_in_executor(None, self._watched.tap, stream, newest.put)
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
            yield ": hello\n\n"  # the headers go with the first piece: the viewer knows that it is connected
            while self._watched.state() != "stopping":
                if not await newest.came(PERIOD_S):
                    if newest.silent_s > KEEP_ALIVE_S:
                        newest.heard()
                        yield ": silent\n\n"
                    continue
                text = live_frame(*newest.take())
                if text is not None:
                    yield f"data: {text}\n\n"
                await asyncio.sleep(PERIOD_S)
        finally:
            loop.run_in_executor(None, release)  # not awaited: the viewer's task may be cancelled


def _undo(tapped: asyncio.Future[Callable[[], None] | None]) -> None:
    """Release a tap that nobody waits for any more."""
    if tapped.cancelled() or tapped.exception() is not None or (release := tapped.result()) is None:
        return
    with contextlib.suppress(RuntimeError):  # the server ends, and so do its threads
        tapped.get_loop().run_in_executor(None, release)

"""Detections by POST and over a WebSocket: frames in JSON from programs that have no client of ours."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import time
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import optipmb_schemas as schemas
from optipmb_schemas.json_form import EXACT
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from optipmb_service.edges import access
from optipmb_service.edges.access import NotAllowedError
from optipmb_service.edges.http.api import (
    HEADERS,
    MALFORMED,
    NOT_VALID,
    PROTOCOL,
    TRY_AGAIN,
    RequestError,
    Room,
    parameters_of,
    wish_of,
)
from optipmb_service.edges.inputs import INLINE_BYTES, Inputs, RefusedError
from optipmb_service.edges.json_frames import FrameReader
from optipmb_service.edges.readers import Publication
from optipmb_service.settings import is_loopback
from optipmb_service.telemetry.metrics import INPUT_METRICS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from optipmb_schemas.json_form import Place, Selection
    from starlette.requests import HTTPConnection, Request

    from optipmb_service.edges.access import Caller
    from optipmb_service.edges.http.api import Occupant, Readers
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth
    from optipmb_service.zenoh.client import Client

BODY_S: Final = 10.0
"""Longest time until a body has come."""

WAIT_S: Final = 5.0
"""Longest wait for tracks."""

SHARE: Final = 0.25
"""Share of the places of senders that one name may have."""

JSON: Final = "application/json"
SELECTION: Final = ("classes", "confirmed", "min_existence", "fields")
LENGTH_DIGITS: Final = 12

STATUS: Final = {
    "busy": HTTPStatus.TOO_MANY_REQUESTS,
    "duplicate_epoch": HTTPStatus.CONFLICT,
    "duplicate_key": HTTPStatus.CONFLICT,
    "not_allowed": HTTPStatus.FORBIDDEN,
    "too_many_streams": HTTPStatus.TOO_MANY_REQUESTS,
    "unlinked": HTTPStatus.SERVICE_UNAVAILABLE,
}
"""Statuses of refused frames by their codes; of others 400."""


class _StreamName(msgspec.Struct):
    """The stream that a frame names."""

    stream: str = ""


class Senders:
    """Programs that send now, counted apart from other requests.

    Attributes:
        room: for them.

    Args:
        health: of the process.
        readers: whose tokens hold for senders, too.
        settings: of the process.
        places: of the world frames of sites.
        sessions: returns the session that a stream feeds.
    """

    def __init__(
        self,
        health: ProcessHealth,
        readers: Readers,
        settings: Settings,
        places: Mapping[str, Place],
        sessions: Callable[[str], str],
    ) -> None:
        self.room = Room(settings.http_senders, "requests and sockets that send", SHARE, settings.sender_idle_s)
        self._health = health
        self._readers = readers
        self._settings = settings
        self._places = places
        self._sessions = sessions
        self._frames = FrameReader(settings)
        self._is_open = bool(settings.http_tokens) or not settings.http or is_loopback(settings.http)
        self._inputs: Inputs | None = None

    def routes(self) -> list[Route | WebSocketRoute]:
        paths = ("/api/v1/detections", "/api/v1/detections/")  # many clients do not follow a redirection of a POST
        posts = [Route(path, self.post, methods=["POST"]) for path in paths]
        return [*posts, *(WebSocketRoute(path, self.socket) for path in paths)]

    async def post(self, request: Request) -> Response:
        """Hand the frames of a request to the network."""
        caller = await self._caller(request)
        parameters = parameters_of(request, ("stream", "wait", *(SELECTION if "wait" in request.query_params else ())))
        stream, wait_s = parameters.get("stream", ""), _wait(parameters)
        wish = wish_of({name: parameters[name] for name in SELECTION if name in parameters} | {"stream": "*/*/*"})
        inputs = self._opened()
        with self.room.entered(caller.name):
            _check_type(request)
            frames, is_array = self._frames.split(await self._body(request), stream)
            if is_array and wait_s:
                raise schemas.MessageError(
                    "invalid_value", "wait", "one frame, not in an array", f"{len(frames)} frames"
                )
            sender = _Sender(inputs, self._frames, caller, stream, request.headers.get("traceparent", ""))
            repeats = request.headers.get("idempotency-key", "")
            answers = []
            for at, payload in enumerate(frames):
                path = f"frames[{at}]" if is_array else ""
                answer = await sender.send(payload, path, repeats and f"Idempotency-Key {at} {repeats}", wait_s)
                answers.append({"index": at} | answer)
            return self._answer(answers, sender.retry_s, wish.selection if wait_s else None)

    async def socket(self, websocket: WebSocket) -> None:
        """Hand the frames of a WebSocket to the network, each with an answer before the next."""
        caller = await self._caller(websocket)
        stream = parameters_of(websocket, ("stream",)).get("stream", "")
        sender = _Sender(self._opened(), self._frames, caller, stream, websocket.headers.get("traceparent", ""))
        with self.room.entered(caller.name, yields=True) as place, contextlib.suppress(WebSocketDisconnect):
            await websocket.accept(PROTOCOL if PROTOCOL in websocket.scope["subprotocols"] else None)
            for index in itertools.count():
                if (text := await self._next(websocket, caller, place)) is None:
                    return
                answer = await sender.send(text.encode())
                await websocket.send_text(msgspec.json.encode({"index": index} | answer).decode())

    async def _next(self, websocket: WebSocket, caller: Caller, place: Occupant) -> str | None:
        """Return the next text of a socket; None when it has ended, or was closed here."""
        while True:
            message: Mapping[str, Any] | None = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(access.LOOK_S):
                    message = await websocket.receive()
            if message is not None and message["type"] == "websocket.disconnect":
                return None
            reason, code = "", MALFORMED
            if place.left:
                reason, code = "another sender needed the place of this idle one", TRY_AGAIN
            elif await self._readers.is_revoked(websocket, caller):
                reason = NOT_VALID
            elif message is not None:
                if (text := message.get("text")) is not None:
                    place.used_s = time.monotonic()
                    return str(text)
                reason = "texts are expected"
            if reason:
                await websocket.close(code, reason)
                return None

    async def _caller(self, request: HTTPConnection) -> Caller:
        """Return who sends.

        Raises:
            NoTokenError: the token is missing or not valid.
            NotAllowedError: without tokens detections are taken on a loopback address alone.
        """
        if not self._is_open:
            raise NotAllowedError("set http_tokens: without them detections are taken on a loopback address alone")
        return await self._readers.caller(request)

    def _opened(self) -> Inputs:
        """Return the inputs on the session of the process.

        Raises:
            TransportError: there is no session yet.
        """
        client = cast("Client", self._readers.session())  # as in every process with edges
        if self._inputs is None or self._inputs.client is not client:
            self._inputs = inputs = Inputs(self._settings, client, "http", self._sessions)
            self._health.metrics.add(INPUT_METRICS, lambda: inputs)
        return self._inputs

    async def _body(self, request: Request) -> bytes:
        """Return the body of a request.

        Raises:
            RequestError: it is too large, or does not come in time.
        """
        most = self._settings.limits.max_json_bytes
        too_large = RequestError(
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too_large", f"a body of at most {most} bytes is expected"
        )
        length, body = request.headers.get("content-length", ""), bytearray()
        is_over = length.isdecimal() and (len(length) > LENGTH_DIGITS or int(length) > most)
        if is_over and "expect" in request.headers:  # it asks before it sends
            raise too_large
        try:
            async with asyncio.timeout(BODY_S):
                async for chunk in request.stream():  # to its end: a sender that still sends would not read the answer
                    is_over = is_over or len(body) + len(chunk) > most
                    if not is_over:
                        body += chunk
        except TimeoutError:
            if not is_over:
                late = f"the body did not come within {BODY_S:g} s"
                raise RequestError(HTTPStatus.REQUEST_TIMEOUT, "late", late) from None
        except ClientDisconnect:
            raise RequestError(HTTPStatus.BAD_REQUEST, "malformed", "the sender has gone") from None
        if is_over:
            raise too_large
        return bytes(body)

    def _answer(self, frames: list[dict[str, Any]], retry_s: float, selection: Selection | None) -> Response:
        """Return the answer about frames, and when refused ones may come again."""
        errors = [one["error"] for one in frames if "error" in one]
        refused = [one["code"] for one in errors]
        body: dict[str, Any] = {"accepted": len(frames) - len(refused), "refused": len(refused), "frames": frames}
        statuses = {STATUS.get(code, HTTPStatus.BAD_REQUEST) for code in refused}
        headers = dict(HEADERS)
        if not refused:
            status = HTTPStatus.ACCEPTED if selection is None else HTTPStatus.OK
        elif body["accepted"]:
            status = HTTPStatus.MULTI_STATUS
        else:
            body["error"] = errors[0]
            status = statuses.pop() if len(statuses) == 1 else HTTPStatus.BAD_REQUEST
            if status in {HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE}:
                headers["retry-after"] = str(math.ceil(retry_s))
        if selection is not None and not refused:
            tracks = frames[0].pop("tracks")
            body["tracks"] = None
            if tracks is not None:
                found = Publication(tracks.key, tracks.payload, tracks.encoding, self._places)
                body["tracks"] = msgspec.Raw(found.tracks(selection, self._settings.stale_s))
        return Response(msgspec.json.encode(body), status, headers, JSON)


@dataclass
class _Sender:
    """A request or socket that sends frames.

    Attributes:
        inputs: takes them.
        frames: reads them.
        caller: who sends.
        stream: that the address names; empty: none.
        traceparent: W3C trace context, unchecked.
        retry_s: when refused frames may come again.
    """

    inputs: Inputs
    frames: FrameReader
    caller: Caller
    stream: str
    traceparent: str
    retry_s: float = 1.0

    async def send(self, payload: bytes, path: str = "", repeats: str = "", wait_s: float = 0.0) -> dict[str, Any]:
        """Send a frame; return the answer about it."""
        refused: schemas.MessageError | RefusedError
        name = ""
        try:
            if len(payload) <= INLINE_BYTES:
                frame = self.frames.read(payload, self.stream)
            else:
                frame = await asyncio.to_thread(self.frames.read, payload, self.stream)
            name = frame.message.stream
            self.caller.may_publish(name)
            found = await self.inputs.send(frame, self.frames.rules(name), repeats, self.traceparent, wait_s)
        except schemas.MessageError as error:
            self.inputs.report(self._reported(payload), error)
            refused = error.under(path) if path else error
            path = refused.path
        except NotAllowedError as error:
            refused, name = RefusedError("not_allowed", "a stream of the token", str(error)), ""
        except RefusedError as error:
            refused = error
        else:
            sent, duplicate, tracks = found
            answer = {
                "stream": name,
                "epoch": sent.epoch.hex(),
                "seq": sent.seq if sent.seq < EXACT else str(sent.seq),
                "stamp_ns": str(sent.stamp_ns),
                "duplicate": duplicate,
            }
            return answer | ({"tracks": tracks} if wait_s else {})
        if isinstance(refused, RefusedError):
            self.inputs.report(name, refused)
            self.retry_s = max(self.retry_s, refused.retry_s)
        about = {"code": refused.code, "path": path, "expected": refused.expected, "received": refused.received}
        return {"error": about | {"message": str(refused)}}

    def _reported(self, payload: bytes) -> str:
        """Return the stream on which a frame that is not valid is reported; empty: on none."""
        name = self.stream
        try:
            name = name or msgspec.json.decode(payload, type=_StreamName).stream
            self.inputs.client.keys.problems(name)
            self.caller.may_publish(name)
        except (ValueError, msgspec.DecodeError, RecursionError, NotAllowedError):
            return ""
        return name


def _check_type(request: Request) -> None:
    """Refuse a body that a page of a stranger could send without asking, and one that is compressed.

    Raises:
        RequestError: it is such.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != JSON or "content-encoding" in request.headers:
        expected = f"content-type {JSON} without content-encoding is expected"
        raise RequestError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "wrong_type", expected)


def _wait(parameters: Mapping[str, str]) -> float:
    """Return how long a request waits for tracks, s; 0 without it.

    Raises:
        MessageError: it is no such time.
    """
    if (text := parameters.get("wait")) is None:
        return 0.0
    try:
        wait_s = float(text)
    except ValueError:
        wait_s = math.nan
    if not 0 < wait_s <= WAIT_S:
        raise schemas.MessageError(
            "invalid_value", "wait", f"seconds, above 0 and at most {WAIT_S:g}", ascii(text)[:80]
        )
    return wait_s

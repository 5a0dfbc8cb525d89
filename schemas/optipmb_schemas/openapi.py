"""HTTP as an OpenAPI 3.1 document: paths, parameters, and the texts that come and go, for code generators and portals.

A service serves it at `/openapi.json`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Final

from optipmb_schemas import json_form
from optipmb_schemas.codec import MAJOR
from optipmb_schemas.control import ServiceStatus, SessionSummary
from optipmb_schemas.export import schema_of

ADDRESS: Final = "127.0.0.1:8080"
_TEXT: Final = {"type": "string"}
_FLAG: Final = {"enum": ["0", "1"]}
PARAMETERS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "stream": ("A stream, `site/node/sensor`, or a pattern with `*` for any part.", _TEXT),
    "wait": (
        "Seconds to wait for the tracks of the one frame.",
        {"type": "number", "exclusiveMinimum": 0, "maximum": 5},
    ),
    "format": ("Form of the answer.", {"enum": ["json", "geojson"]}),
    "topics": ("Of `tracks`, `events`, `zones` and `problems`, with commas.", _TEXT),
    "classes": ("Names of classes, with commas.", _TEXT),
    "confirmed": ("0: also tracks that may be of nothing.", _FLAG),
    "min_existence": ("Least probability of existence.", {"type": "number", "minimum": 0, "maximum": 1}),
    "fields": ("Fields of the objects, with commas.", _TEXT),
    "max_rate_hz": ("Highest rate of the tracks of a stream.", {"type": "number", "minimum": 0}),
    "events": ("Events when they are final, or now.", {"enum": ["final", "now"]}),
    "predict": ("1: tracks predicted to now.", _FLAG),
    "after": ("Id of the event after which a reader goes on.", _TEXT),
}
"""Meaning and schema of the parameters of all paths."""

_SELECTION: Final = ("classes", "confirmed", "min_existence", "fields")


@dataclass(frozen=True)
class Path:
    """A path of a service.

    Attributes:
        about: it, in a sentence.
        parameters: names of those that it takes.
        answer: schema of its text, or the content type of another one.
        method: of HTTP.
        statuses: of answers, besides 200; above 400 of refusals.
    """

    about: str
    parameters: tuple[str, ...] = ()
    answer: dict[str, Any] | str = "application/json"
    method: str = "get"
    statuses: tuple[int, ...] = ()


def _of(name: str) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{name}"}


def _array(*names: str) -> dict[str, Any]:
    return {"type": "array", "items": _of(names[0]) if len(names) == 1 else {"anyOf": [_of(name) for name in names]}}


_READ: Final = (400, 401, 403, 503)
PATHS: Final = {
    "/api/v1/detections": Path(
        "Take a frame of detections, or up to 256.",
        ("stream", "wait", *_SELECTION),
        _of("Taken"),
        "post",
        (202, 207, 400, 401, 403, 408, 409, 413, 415, 429, 503),
    ),
    "/api/v1/streams": Path("Sessions, with rate and latency.", ("stream",), _array("Session"), statuses=_READ),
    "/api/v1/tracks": Path(
        "Newest frame of each stream.",
        ("stream", "format", "predict", *_SELECTION),
        _array("EdgeTracks"),
        statuses=_READ,
    ),
    "/api/v1/zones": Path("Newest counts of zones.", ("stream",), _array("EdgeZones"), statuses=_READ),
    "/api/v1/stream": Path(
        "Server-sent events, each with a text.",
        ("stream", "topics", *_SELECTION, "max_rate_hz", "events", "predict", "after"),
        "text/event-stream",
        statuses=_READ,
    ),
    "/api/v1/asyncapi.json": Path("The keys of Zenoh, MQTT and WebSockets as an AsyncAPI document."),
    "/openapi.json": Path("This document."),
    "/status": Path("Report of the service.", (), _of("ServiceStatus"), statuses=(401, 403)),
    "/healthz": Path("Whether the process is alive.", statuses=(503,)),
    "/readyz": Path("Whether the service can be used.", statuses=(503,)),
    "/metrics": Path("Metrics in Prometheus' text format.", (), "text/plain"),
}
"""Paths of the document."""

_ERROR: Final = {
    "type": "object",
    "required": ["code", "path", "message"],
    "properties": {"code": _TEXT, "path": _TEXT, "message": _TEXT},
}
_COUNT: Final = {"type": "integer", "minimum": 0}
_FORMS: Final[dict[str, Any]] = {
    "Error": _ERROR,
    "Refused": {"type": "object", "required": ["error"], "properties": {"error": _of("Error")}},
    "Taken": {
        "type": "object",
        "required": ["accepted", "refused", "frames"],
        "properties": {
            "accepted": _COUNT,
            "refused": _COUNT,
            "frames": {"type": "array", "items": _of("Frame")},
            "tracks": {"anyOf": [_of("EdgeTracks"), {"type": "null"}]},
            "error": _of("Error"),
        },
    },
    "Frame": {
        "type": "object",
        "required": ["index"],
        "properties": {
            "index": _COUNT,
            "stream": _TEXT,
            "epoch": _TEXT,
            "seq": {"type": ["integer", "string"]},
            "stamp_ns": _TEXT,
            "duplicate": {"type": "boolean"},
            "error": _of("Error"),
        },
    },
    "Session": {
        "allOf": [_of("SessionSummary")],
        "type": "object",
        "required": ["instance"],
        "properties": {"instance": _TEXT},
    },
}
"""Schemas of texts that are no messages."""


def document(address: str = ADDRESS) -> str:
    """Return the document as JSON, for an address of HTTP."""
    schemas: dict[str, Any] = dict(_FORMS)
    found = json_form.schemas() | {kind.__name__: schema_of(kind) for kind in (ServiceStatus, SessionSummary)}
    for name, schema in found.items():
        lifted = json.loads(json.dumps(schema).replace("#/$defs/", "#/components/schemas/"))
        schemas |= lifted.pop("$defs", {})
        schemas[name] = {key: value for key, value in lifted.items() if key[0] not in "$x"}
    whole = {
        "openapi": "3.1.0",
        "info": {"title": "OptiPMB tracking service", "version": f"{MAJOR}.0.0"},
        "servers": [{"url": f"http://{address}"}],
        "security": [{}, {"token": []}],
        "paths": {path: {one.method: _operation(path, one)} for path, one in PATHS.items()},
        "components": {"schemas": schemas, "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
    }
    return json.dumps(whole, indent=2, sort_keys=True) + "\n"


def _operation(path: str, one: Path) -> dict[str, Any]:
    content = {"application/json": {"schema": one.answer}} if isinstance(one.answer, dict) else {one.answer: {}}
    operation: dict[str, Any] = {
        "operationId": path.strip("/").replace("api/v1/", "").replace(".", "_"),
        "summary": one.about,
        "parameters": [
            {"name": name, "in": "query", "description": about, "schema": schema, "required": False}
            for name in one.parameters
            for about, schema in [PARAMETERS[name]]
        ],
        "responses": {"200": {"description": "The answer.", "content": content}},
    }
    for status in one.statuses:
        taken = status < 300  # noqa: PLR2004 - of HTTP
        operation["responses"][str(status)] = {
            "description": "Taken." if taken else "Refused.",
            "content": content if taken else _refused(one),
        }
    if one.method == "post":
        frames = {"oneOf": [_of("EdgeDetections"), _array("EdgeDetections") | {"minItems": 1, "maxItems": 256}]}
        operation["requestBody"] = {"required": True, "content": {"application/json": {"schema": frames}}}
        repeats = "Frames of one key are one frame."
        key = {"name": "Idempotency-Key", "in": "header", "description": repeats, "schema": _TEXT}
        operation["parameters"].append(key)
    return operation


def _refused(one: Path) -> dict[str, Any]:
    """Return the content of a refusal; probes have a form of their own."""
    return {"application/json": {"schema": _of("Refused")} if isinstance(one.answer, dict) or one.parameters else {}}

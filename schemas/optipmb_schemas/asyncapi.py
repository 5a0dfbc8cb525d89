"""The interface as an AsyncAPI 3 document: keys as channels, messages as schemas, for code generators and portals.

    python -m optipmb_schemas.export --asyncapi schemas/asyncapi.json

A service serves it at `/api/v1/asyncapi.json`, with its own prefix and endpoint.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Final, Literal

from optipmb_schemas import json_form
from optipmb_schemas.codec import MAJOR, MESSAGES, encoding_of
from optipmb_schemas.export import schema_of
from optipmb_schemas.keys import PREFIX, Keys

ENDPOINT: Final = "tcp/127.0.0.1:7447"
HTTP: Final = "127.0.0.1:8080"
MQTT: Final = "127.0.0.1:1883"
METRICS: Final = "Metrics"  # a reply that is no message: text in Prometheus' format
QUERY: Final = "Query"  # a query without a payload
_PARAMETERS: Final = {
    "site": "Site of a stream, not `owner` or `service`.",
    "node": "Node of a stream.",
    "sensor": "Sensor of a stream, or `fused`.",
    "area": "Area of linked streams.",
    "instance": "Name of a service instance.",
}
_STREAM: Final = "site/node/sensor"
EDGE: Final = tuple(json_form.schemas())  # texts of WebSocket and MQTT, in JSON alone
_CACHED: Final = "Zenoh's advanced publisher: reliable, with a cache for subscribers that come late or miss a message."

_AT_RATE: Final = "Put by the service at the rate of `outputs`, without a cache; dropped under congestion."


@dataclass(frozen=True)
class Channel:
    """A row of the table of keys, seen from the service."""

    key: str  # method of `Keys`
    of: tuple[str, ...]  # its arguments
    messages: tuple[str, ...] = ()
    replies: tuple[str, ...] = ()
    about: str = "Query."
    action: Literal["send", "receive"] | None = "receive"  # None: a liveliness token
    server: str = "router"
    address: str = ""  # in place of a key; below the prefix, or a path of HTTP


def _query(what: str, messages: tuple[str, ...], *replies: str) -> Channel:
    return Channel("query", (_STREAM, what), messages, replies)


def _mqtt(topic: str, *messages: str) -> Channel:
    return Channel("", (), messages, (), "Put by `optipmb-service mqtt`.", "send", "mqtt", f"{_STREAM}/{topic}")


def _instance(key: str, messages: tuple[str, ...], *replies: str) -> Channel:
    return Channel(key, ("instance",), messages, replies)


CHANNELS: Final = {
    "detections": Channel("detections", (_STREAM,), ("Detections",), about=f"Put by the publisher. {_CACHED}"),
    "points": Channel("points", (_STREAM,), ("Points",), about="Put by the publisher; dropped under congestion."),
    "tracks": Channel("tracks", (_STREAM,), ("Tracks",), (), f"Put by the service. {_CACHED}", "send"),
    "now": Channel("now", (_STREAM,), ("Tracks",), (), _AT_RATE, "send"),
    "events": Channel("events", (_STREAM,), ("Events",), (), f"Put by the service. {_CACHED}", "send"),
    "problems": Channel("problems", (_STREAM,), ("Problem",), (), "Put by the service.", "send"),
    "links": Channel(
        "links", ("area",), ("Links",), (), "Put by `optipmb-service link`; the whole every 10 s.", "send"
    ),
    "allLinks": Channel("links_query", ("area",), (QUERY,), ("Links",)),
    "state": _query("state", (QUERY,), "SessionState"),
    "density": _query("density", (QUERY,), "Density"),
    "keptTracks": _query("tracks", (QUERY, "TracksRequest"), "Tracks", "TracksRequest"),
    "zones": _query("zones", (QUERY,), "Events"),
    "reset": _query("reset", (QUERY, "ResetRequest"), "SessionState"),
    "parameters": _query("parameters", (QUERY, "SessionParameters"), "SessionParameters"),
    "owner": Channel("owner", (_STREAM, "instance"), about="Liveliness: this instance tracks the stream.", action=None),
    "alive": Channel("alive", ("instance",), about="Liveliness: this instance runs.", action=None),
    "status": _instance("status", (QUERY,), "ServiceStatus"),
    "metrics": _instance("metrics", (QUERY,), METRICS),
    "move": _instance("move", ("MoveRequest",), "MoveRequest"),
    "drain": _instance("drain", (QUERY, "DrainRequest"), "DrainRequest"),
    "reader": Channel("", (), EDGE, (), "WebSocket of a reader.", "send", "http", "/api/v1/ws"),
    "mqttTracks": _mqtt("tracks", "EdgeTracks"),
    "mqttEvents": _mqtt("events", "EdgeEvent"),
    "mqttZones": _mqtt("zones", "EdgeZones"),
    "mqttProblems": _mqtt("problems", "EdgeProblem"),
}
"""Channels of the document by name."""


def document(prefix: str = PREFIX, endpoint: str = ENDPOINT, http: str = HTTP) -> str:
    """Return the document as JSON, for a prefix of keys, an endpoint of a Zenoh router and an address of HTTP."""
    schemas: dict[str, Any] = {}
    messages: dict[str, Any] = {
        QUERY: {"title": "Query without a payload", "payload": {"type": "null"}},
        METRICS: {"title": "Metrics of an instance", "contentType": "text/plain", "payload": {"type": "string"}},
    }
    for kind in MESSAGES:
        schema = json.loads(json.dumps(schema_of(kind)).replace("#/$defs/", "#/components/schemas/"))
        schemas |= schema.pop("$defs", {})
        schemas[kind.__name__] = {name: value for name, value in schema.items() if name[0] not in "$x"}
        for form in ("msgpack", "json"):
            messages[f"{kind.__name__}.{form}"] = {
                "name": kind.__name__,
                "contentType": encoding_of(kind, form=form),
                "payload": {"$ref": f"#/components/schemas/{kind.__name__}"},
            }
    for name, schema in json_form.schemas().items():
        lifted = json.loads(json.dumps(schema).replace("#/$defs/", "#/components/schemas/"))
        schemas |= lifted.pop("$defs", {}) | {name: lifted}
        messages[name] = {"contentType": "application/json", "payload": {"$ref": f"#/components/schemas/{name}"}}
    whole = {
        "asyncapi": "3.0.0",
        "info": {
            "title": "OptiPMB tracking service",
            "version": f"{MAJOR}.0.0",
            "description": "3D multi-object tracking over Zenoh, seen from the service. The content type is the "
            "encoding of a sample. In msgpack, arrays may be blocks and byte strings are binary; schemas are of JSON.",
        },
        "defaultContentType": encoding_of(MESSAGES[0]).partition(";")[0],
        "servers": {
            "router": {"host": endpoint.partition("/")[2], "protocol": "zenoh"},
            "http": {"host": http, "protocol": "ws"},
            "mqtt": {"host": MQTT, "protocol": "mqtt"},
        },
        "channels": {name: _channel(channel, Keys(prefix)) for name, channel in CHANNELS.items()},
        "operations": {name: _operation(name, channel) for name, channel in CHANNELS.items() if channel.action},
        "components": {"messages": messages, "schemas": schemas},
    }
    return json.dumps(whole, indent=2, sort_keys=True) + "\n"


def _forms(names: tuple[str, ...]) -> list[str]:
    """Return the messages of a document that stand for messages of the product: each in two encodings."""
    alone = {QUERY, METRICS, *EDGE}
    forms = ([name] if name in alone else [f"{name}.msgpack", f"{name}.json"] for name in names)
    return [one for form in forms for one in form]


def _replies(channel: Channel) -> tuple[str, ...]:
    return (*channel.replies, "Problem") if channel.replies else ()


def _channel(channel: Channel, keys: Keys) -> dict[str, Any]:
    key = channel.address or getattr(keys, channel.key)(*channel.of).removeprefix(f"{keys.prefix}/")
    below = key.split("/")
    parameters = {chunk: {"description": _PARAMETERS[chunk]} for chunk in below if chunk in _PARAMETERS}
    named = (f"{{{chunk}}}" if chunk in parameters else chunk for chunk in below)
    names = _forms((*channel.messages, *_replies(channel)))
    return {
        "address": key if channel.server == "http" else f"{keys.prefix}/{'/'.join(named)}",
        "description": channel.about,
        "parameters": parameters,
        "servers": [{"$ref": f"#/servers/{channel.server}"}],
        **({"messages": {name: {"$ref": f"#/components/messages/{name}"} for name in names}} if names else {}),
    }


def _operation(name: str, channel: Channel) -> dict[str, Any]:
    def refs(names: tuple[str, ...]) -> list[dict[str, str]]:
        return [{"$ref": f"#/channels/{name}/messages/{one}"} for one in _forms(names)]

    where = {"$ref": f"#/channels/{name}"}
    reply = {"reply": {"channel": where, "messages": refs(_replies(channel))}} if channel.replies else {}
    return {"action": channel.action, "channel": where, "messages": refs(channel.messages), **reply}

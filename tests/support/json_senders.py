"""Senders of JSON: an HTTP edge on a network of its own, requests to it, and documents that are damaged."""

import contextlib
import http.client
import json
import random
from collections.abc import Iterator
from copy import deepcopy
from types import SimpleNamespace
from typing import Any, Self

from optipmb_schemas import Detections
from optipmb_service.app.configuration import load
from optipmb_service.edges.http import Server, application
from optipmb_service.settings import Settings
from optipmb_service.telemetry.health import Component, ProcessHealth
from optipmb_service.telemetry.metrics import Metrics
from optipmb_service.zenoh.client import Client

DEADLINE_S = 60.0
SECOND = 1_000_000_000


class Edge:
    """An HTTP edge in a session of its own, as a gateway is; it may be started again."""

    def __init__(self, endpoint: str, **settings: Any) -> None:
        where = {"listen": [endpoint], "router": True} if settings.pop("router", False) else {"connect": [endpoint]}
        given = where | {"instance": "edge", "http": "127.0.0.1:0"} | settings
        self.settings: Settings = load(None, given).settings
        self.client = Client(self.settings)
        self.health = ProcessHealth("edge", Metrics())
        self.health.report(Component(self.client))
        self._server = Server(
            application(self.health, self.settings), "127.0.0.1:0", self.settings.limits.max_json_bytes
        )
        self.address = self._server.address

    def close(self) -> None:
        self._server.close()
        self.client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def post(self, body: Any, query: str = "", **headers: str) -> SimpleNamespace:
        return post(self.address, body, query, **headers)


def post(address: str, body: Any, query: str = "", **headers: str) -> SimpleNamespace:
    """Send a body, of which JSON is made unless it is bytes; return status, headers and the JSON of the answer."""
    payload = body if isinstance(body, bytes) else json.dumps(body).encode()
    host, _, port = address.rpartition(":")
    with contextlib.closing(http.client.HTTPConnection(host, int(port), timeout=DEADLINE_S)) as connection:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request("POST", f"/api/v1/detections?{query}", payload, {"content-type": "application/json"} | named)
        with connection.getresponse() as response:
            text = response.read()
            kind = response.headers.get("content-type", "")
            answer = json.loads(text) if "json" in kind else text
            return SimpleNamespace(status=response.status, headers=response.headers, body=answer)


def document(message: Detections, *names: str) -> dict[str, Any]:
    """Return a frame as its sender would write it, with these fields of the header besides the stamp."""
    columns = {"position": message.center, "size": message.size, "yaw": message.yaw, "velocity": message.velocity}
    objects = [
        {"class": message.labels[label], "score": score}
        | {name: column[at].tolist() for name, column in columns.items() if column is not None}
        for at, (label, score) in enumerate(zip(message.label.tolist(), message.score.tolist(), strict=True))
    ]
    header = {"stream": message.stream, "epoch": message.epoch.hex(), "seq": message.seq}
    return {"stamp_ns": message.stamp_ns, "objects": objects} | {name: header[name] for name in names}


def damaged(valid: dict[str, Any], count: int) -> Iterator[bytes]:
    """Yield documents with a fault each, the same ones in every run."""
    chance = random.Random(0)
    values = (
        None,
        True,
        -1,
        1e999,
        10**400,
        2**63,
        "",
        "\ud800",
        "x" * 5000,
        [],
        [[]],
        {},
        {"a": 1},
        nested(40),
        nested(5000),
    )
    text = json.dumps(valid).encode()
    for number in range(count):
        kind = number % 4
        if kind == 0:
            yield text[: chance.randrange(len(text))]
        elif kind == 1:
            at = chance.randrange(len(text))
            yield text[:at] + bytes([chance.randrange(256)]) + text[at + 1 :]
        else:
            tree = deepcopy(valid)
            places = list(_places(tree))
            inside, key = chance.choice(places)
            if kind == 2:
                inside[key] = chance.choice(values)
            elif isinstance(inside, dict):
                name = chance.choice(["object", "labels", "center", key])
                yield json.dumps(tree).encode().replace(b"{", b'{"%b": 1, ' % name.encode(), 1)
                continue
            else:
                del inside[key]
            yield _written(tree)


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def _written(tree: Any) -> bytes:
    try:
        return json.dumps(tree).encode()
    except RecursionError:
        return b'{"objects": %b1%b}' % (b"[" * 100_000, b"]" * 100_000)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _places(tree[key])


def exists(path: str, text: bytes) -> bool:
    """Return whether a path leads somewhere in a document; its last name may be missing there."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return not path
    parts = path.replace("[", ".[").removeprefix(".").split(".") if path else []
    for number, part in enumerate(parts):
        try:
            value = value[int(part[1:-1]) if part.startswith("[") else part]
        except (KeyError, IndexError, TypeError):
            return number == len(parts) - 1
    return True

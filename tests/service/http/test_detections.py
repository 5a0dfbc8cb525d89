"""Detections by POST: the same tracks as over Zenoh, once for each frame, and clear answers to what is wrong."""

import asyncio
import contextlib
import hashlib
import itertools
import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from socket import create_connection as open_connection
from typing import Any

import numpy as np
import pytest
from json_senders import Edge, damaged, document, exists, post
from optipmb_schemas import Attribute, MessageError, encode_json
from optipmb_service.app.configuration import load
from optipmb_service.edges import access, inputs
from optipmb_service.edges.http import detections
from optipmb_service.edges.inputs import Inputs
from optipmb_service.edges.json_frames import MOST_SEPARATE, FrameReader, separate
from optipmb_service.settings import InputSettings, Settings
from optipmb_service.telemetry import problem_reporter
from optipmb_service.zenoh.client import Client
from router import Node, Sensor, plain, until
from routers import free_endpoint
from watched import Watched, asked, served
from websocket import ABNF, WebSocket, WebSocketBadStatusException, WebSocketException, create_connection

from optipmb import Georeference

SENSOR = Sensor()
STREAM = f"stream={SENSOR.stream}"
CAR = {"class": "car", "position": [0, 0]}
PAGE = Path(__file__).parents[3] / "docs/json.md"
HELD = (0, 100, *range(200, 5200, 100), 5200, 5300)  # ms: 50 frames of an outage, and live ones before and after
BURST = (HELD, (5000, 5100, *range(10_150, 10_200), 10_200, 10_300), [5000 + one for one in HELD])
DRAINED = (HELD, (5000, 5100, *range(8200, 10_200, 40), 10_200, 10_300), [5000 + one for one in HELD])
SITE = (48.265, 11.67, 489.0)


@pytest.fixture
def endpoint(start: Any) -> str:
    return str(start()[1])


@pytest.fixture
def edge(endpoint: str) -> Iterator[Edge]:
    with Edge(endpoint) as one:
        yield one


def frame(seq: int, *names: str) -> dict[str, Any]:
    return document(SENSOR.detections(seq), *names)


def stamped(seq: int, **fields: Any) -> dict[str, Any]:
    return {"stamp_ns": SENSOR.stamp_ns(seq), "objects": []} | fields


@contextlib.contextmanager
def socket(address: str, query: str, **options: Any) -> Iterator[WebSocket]:
    options = {"suppress_origin": "origin" not in options, **options}
    connection = create_connection(f"ws://{address}/api/v1/detections?{query}", timeout=60, **options)
    try:
        yield connection
    finally:
        connection.shutdown()


def cut(edge: Edge, body: Any, way: str) -> bool:
    """Send a frame, and end the connection before the answer has come."""
    payload = json.dumps(body).encode()
    if way == "socket":
        with socket(edge.address, STREAM) as connection:
            connection.send(payload.decode())
        return True
    head = f"POST /api/v1/detections?{STREAM} HTTP/1.1\r\nhost: {edge.address}\r\ncontent-type: application/json\r\n"
    with open_connection((edge.address.rpartition(":")[0], int(edge.address.rpartition(":")[2]))) as connection:
        connection.sendall(f"{head}content-length: {len(payload)}\r\n\r\n".encode() + payload)
    return True


def sent(edge: Edge, body: Any, way: str) -> dict[str, Any]:
    """Send a frame over a connection of its own, and return the answer about it."""
    if way == "post":
        return dict(edge.post(body, STREAM).body["frames"][0])
    with socket(edge.address, STREAM) as connection:
        connection.send(json.dumps(body))
        return dict(json.loads(connection.recv()))


def error(body: Any) -> tuple[str, str]:
    (one,) = body["frames"]
    assert body["error"] == one["error"]
    return one["error"]["code"], one["error"]["path"]


def test_the_same_frames_give_the_same_bytes(start: Any) -> None:
    """Frames over Zenoh, by POST as objects and columns, and over a WebSocket give equal `Tracks`; empty ones count."""
    messages = [SENSOR.detections(seq, **({"objects": 0} if seq == 3 else {})) for seq in range(6)]
    found = []
    for way in ("zenoh", "objects", "columns", "socket"):
        endpoint = start()[1]
        with Node(endpoint) as node, Edge(endpoint) as edge:
            if way == "zenoh":
                node.send(*messages)
            elif way == "objects":
                for one in messages:
                    assert edge.post(document(one, "epoch", "seq"), STREAM).status == HTTPStatus.ACCEPTED
            elif way == "socket":
                with socket(edge.address, STREAM) as connection:
                    for index, one in enumerate(messages):
                        connection.send(json.dumps(document(one, "epoch", "seq")))
                        answer = json.loads(connection.recv())
                        assert (answer["index"], answer["seq"], answer["duplicate"]) == (index, index, False)
            else:
                answer = edge.post(b"[%b]" % b",".join(map(encode_json, messages)))
                assert (answer.status, answer.body["accepted"]) == (HTTPStatus.ACCEPTED, len(messages))
            tracks = node.tracks(SENSOR.stream, len(messages))
            found.append([plain(one.model_copy(update={"session": "0" * 32})) for one in tracks])
    assert found[0] == found[1] == found[2] == found[3]


def test_numbered_frames_sent_again_take_no_room(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    """However often one comes, the epochs of other streams are kept."""
    monkeypatch.setattr(inputs, "ALL_FRAMES", 4)
    epochs = set()
    for _ in range(6):
        assert edge.post(frame(0, "epoch", "seq"), STREAM).status == HTTPStatus.ACCEPTED
        (answer,) = edge.post({"objects": []}, "stream=site/node/other").body["frames"]
        epochs.add(answer["epoch"])
    assert len(epochs) == 1


@pytest.mark.parametrize("way", ["post", "socket"])
def test_a_frame_that_is_sent_again_counts_once(endpoint: str, way: str) -> None:
    """Each frame is cut before its answer and sent twice more, over two edges: tracks come once, ids go on."""
    with Node(endpoint) as node:
        for first in (0, 4):
            with Edge(endpoint) as edge:
                if first:  # the answer to this one was lost with the edge before
                    again = edge.post(frame(first), f"{STREAM}&wait=5")
                    assert again.body["frames"][0]["duplicate"]
                    assert again.body["tracks"]["seq"] == first
                    assert error(edge.post(frame(0) | {"stamp_ns": 5}, STREAM).body) == ("late", "")
                for seq in range(first + (first > 0), first + 4):
                    cut(edge, frame(seq), way)
                    answers = [sent(edge, frame(seq), way) for _ in range(2)]
                    assert answers[1]["duplicate"]
                    assert answers[0]["seq"] == answers[1]["seq"] == seq - first - (first > 0)
                if not first:  # a server that sees the end of a connection first does not read the frame
                    until(lambda: cut(edge, frame(4), way) and len(node.tracks_seen.items) == 5, "tracks of frame 4")
        tracks = node.tracks(SENSOR.stream, 8)
    assert [one.stamp_ns for one in tracks] == [SENSOR.stamp_ns(seq) for seq in range(8)]
    assert len({(one.session, *one.id.tolist()) for one in tracks}) == 1


@pytest.mark.parametrize("way", ["post", "socket"])
def test_a_payload_of_another_maker_is_a_frame(start: Any, way: str) -> None:
    """Of a stream whose format says so, be it a list; one of another sensor is refused with the path of `only`."""
    mapping = {"objects": "[]", "class": "kind", "position": "at", "score": "conf", "score_scale": 0.01}
    rules = {SENSOR.stream: {"format": "mapped", "mapping": mapping, "only": {"[0].unit": 7}}}
    endpoint = start()[1]
    payload = [{"kind": "car", "at": [9, 2, 1], "conf": 90, "unit": 7}, {"kind": "car", "at": [-9, 2, 1], "conf": 90}]
    with Node(endpoint) as node, Edge(endpoint, inputs=rules) as edge:
        other = sent(edge, [payload[0] | {"unit": 8}], way)["error"]
        assert (other["path"], other["received"]) == ("[0].unit", "8")
        assert sent(edge, [payload[0] | {"conf": 900}], way)["error"]["path"] == "[0].conf"
        assert sent(edge, payload, way)["stream"] == SENSOR.stream
        (tracks,) = node.tracks(SENSOR.stream, 1)
    assert sorted(tracks.center[:, 0].tolist()) == [-9.0, 9.0]


def test_an_object_of_another_maker_without_a_place_is_refused_with_its_path() -> None:
    """Fields of a mapped payload have the maker's names, whatever ours are."""
    mapping = {"objects": "items[]", "class": "kind", "position": "at"}
    reader = FrameReader(Settings(inputs={SENSOR.stream: {"format": "mapped", "mapping": mapping}}))
    with pytest.raises(MessageError) as raised:
        reader.read(json.dumps({"items": [{"kind": "car", "bbox": [0, 0, 9, 9]}]}).encode(), SENSOR.stream)
    assert (raised.value.path, raised.value.received) == ("items[0]", "none")


def test_incomplete_frames_say_nothing_of_other_objects(start: Any) -> None:
    """An object without a report for 9 s keeps its id, and ends after `missing_s`; frames sent again count once."""
    rules = {"site/*/lidar": {"complete": False, "missing_s": 10}}
    endpoint = start(inputs=rules, profile="generic")[1]

    def document_of(tick: int) -> dict[str, Any]:
        parked = [{"class": "car", "position": [20, 5, 1], "size": [4.4, 1.8, 1.6], "yaw": 0}]
        driving = [{"class": "car", "position": [tick - 60, -15, 1], "size": [4.4, 1.8, 1.6], "yaw": 0}]
        return {"stamp_ns": 10**18 + tick * 2 * 10**8, "objects": driving + parked * (tick < 10 or tick == 55)}

    with Node(endpoint) as node, Edge(endpoint, inputs=rules) as edge:
        count = 0
        for first in range(0, 120, 20):
            documents = [document_of(tick) for tick in range(first, first + 20)]
            answers = [edge.post(documents, STREAM).body["frames"] for _ in range(2)]
            assert [{one["duplicate"] for one in frames} for frames in answers] == [{False}, {True}]
            count += sum(len(one["objects"]) for one in documents)
            tracks = node.tracks(SENSOR.stream, count)
        empty = edge.post({"stamp_ns": 10**18 + 25 * 10**9, "objects": []}, STREAM)
        assert empty.status == HTTPStatus.ACCEPTED
        last = node.tracks(SENSOR.stream, count + 1)[-1]
        view = {"azimuth": [-1, 1], "elevation": [-1, 1], "range": [0, 9]}
        for name in ("epoch", "field_of_view"):
            fields = {"epoch": "0" * 32, "seq": 1, "field_of_view": view}
            given = {one: fields[one] for one in (("epoch", "seq") if name == "epoch" else (name,))}
            assert error(edge.post({"objects": []} | given, STREAM).body)[1] == name
    parked_ids = [set(one.id[np.abs(one.center[:, 1] - 5) < 3].tolist()) for one in tracks]
    drivers = [set(one.id[np.abs(one.center[:, 1] + 15) < 3].tolist()) for one in tracks]
    (parked,) = parked_ids[20]
    again = 10 + 55
    assert all(ids == {parked} for ids in parked_ids[20 : again + 2])
    assert parked_ids[-1] == set()
    assert len(set.union(*drivers)) == 1
    assert len(tracks) == count
    assert len(last.id) == 1


def test_objects_of_incomplete_frames_are_told_apart() -> None:
    """Two objects of one stamp are two frames; a frame of more than 64 objects is sent whole, and once."""
    with Edge(free_endpoint(), router=True, inputs={"site/*/*": {"complete": False}}) as edge:
        objects = [{"class": "car", "position": [x, 5]} for x in (20, 40)]
        answers = [edge.post(stamped(0, objects=[one]), STREAM).body["frames"][0] for one in (*objects, objects[0])]
        assert [(one["seq"], one["duplicate"]) for one in answers] == [(0, False), (1, False), (0, True)]
        answer = edge.post({"objects": objects * 50}, STREAM)
        assert (answer.status, answer.body["frames"][0]["seq"]) == (HTTPStatus.ACCEPTED, 101)


def test_incomplete_frames_have_a_bounded_number_of_objects() -> None:
    """Each costs a step: more are refused, and reported; of complete frames the limits hold."""
    rules = {"site/*/lidar": {"complete": False}}
    with Edge(free_endpoint(), router=True, inputs=rules) as edge, Node(edge.settings.listen[0]) as node:
        objects = [CAR | {"position": [at, 5]} for at in range(MOST_SEPARATE + 1)]
        refused = edge.post(stamped(0, objects=objects), STREAM)
        assert (refused.status, error(refused.body)) == (HTTPStatus.BAD_REQUEST, ("too_large", "objects"))
        assert str(MOST_SEPARATE) in node.problem(SENSOR.stream, "too_large").expected
        assert edge.post(stamped(0, objects=objects), "stream=site/node/radar").status == HTTPStatus.ACCEPTED
        assert edge.post(stamped(0, objects=objects[1:]), STREAM).status == HTTPStatus.ACCEPTED


def test_keys_tell_frames_without_stamps(edge: Edge) -> None:
    """A key in the frame or the header `Idempotency-Key` with the place in an array; with neither all are new."""
    one = {"objects": [], "key": "a"}
    assert [edge.post(one, STREAM).body["frames"][0]["duplicate"] for _ in range(2)] == [False, True]
    two = [{"objects": []}] * 2
    found = [edge.post(two, STREAM, idempotency_key="k").body["frames"] for _ in range(2)]
    assert [[frame["duplicate"] for frame in frames] for frames in found] == [[False] * 2, [True] * 2]
    assert [edge.post({"objects": []}, STREAM).body["frames"][0]["seq"] for _ in range(2)] == [3, 4]


@pytest.mark.parametrize("known_by", ["stamp_ns", "key", "Idempotency-Key"])
def test_other_content_under_a_known_stamp_or_key_is_told(endpoint: str, known_by: str) -> None:
    """To its sender and on the stream, with the key and both sizes; the same content again is a duplicate."""
    headers = {"idempotency_key": "k"} if known_by == "Idempotency-Key" else {}
    named = {"stamp_ns": SENSOR.stamp_ns(0), "key": "a", "Idempotency-Key": SENSOR.stamp_ns(0)}[known_by]
    bodies = [{"objects": [CAR | {"position": [at, 0]}] * at} for at in (1, 2)]
    if known_by != "Idempotency-Key":
        bodies = [body | {known_by: named} for body in bodies]
    with Node(endpoint) as node, Edge(endpoint) as edge:
        for _ in range(2):
            (answer,) = edge.post(bodies[0], STREAM, **headers).body["frames"]
        assert answer["duplicate"]
        refused = [edge.post(bodies[1], STREAM, **headers) for _ in range(4)][-1]
        assert (refused.status, error(refused.body)) == (HTTPStatus.CONFLICT, ("duplicate_key", ""))
        problem = node.problem(SENSOR.stream, "duplicate_key")
        for about in (refused.body["frames"][0]["error"], problem.model_dump()):
            assert known_by in about["expected"]
            assert "`seq`" in about["expected"]
            sizes = [int(re.findall(r"(\d+) bytes", about[name])[0]) for name in ("expected", "received")]
            assert sizes[0] < sizes[1]
        edge.post(bodies[0], STREAM, **headers)


def test_stamps_that_are_not_used_need_not_differ() -> None:
    """With the clock of the arrival, frames of one stamp are told apart by their content."""
    with Edge(free_endpoint(), router=True, inputs={"site/*/*": {"clock": "arrival"}}) as edge:
        bodies = [stamped(0, objects=[CAR | {"position": [at, 0]}]) for at in (0, 1, 1)]
        answers = [edge.post(body, STREAM).body["frames"][0] for body in bodies]
        assert [(one["seq"], one["duplicate"]) for one in answers] == [(0, False), (1, False), (1, True)]


@pytest.mark.parametrize(
    ("clock", "sent_ms", "arrived_ms", "stamps_ms"),
    [
        ("sender", (0, 100), (5000, 5000), (0, 100)),
        ("arrival", (0, 100), (5000, 5070), (5000, 5070)),
        ("arrival", (None, None), (5000, 5000), (5000, 5000.001)),
        ("offset", (0, 100, 200, 300), (5050, 5120, 5280, 5310), (5050, 5120, 5220, 5310)),
        (
            "offset",
            (0, 100, 9200, 9300, 9400, 9500),
            (5000, 5100, 5200, 5300, 5420, 5500),
            (5000, 5100, 5200, 5300, 5400, 5500),
        ),
        (
            "offset",
            (9000, 9100, 0, 100, 200, 300),
            (5000, 5100, 5200, 5300, 5400, 5500),
            (5000, 5100, -4000, -3900, 5400, 5500),
        ),
        ("offset", *BURST),
        ("offset", *DRAINED),
    ],
)
async def test_stamps_are_of_the_clock_of_the_settings(
    endpoint: str, clock: Any, sent_ms: Any, arrived_ms: Any, stamps_ms: Any
) -> None:
    """The sender's; of the arrival, however late a frame goes out; or the sender's by the least difference."""
    settings = load(None, {"connect": [endpoint], "instance": "edge"}).settings
    network = await asyncio.to_thread(Client, settings)
    inputs, reader, found = Inputs(settings, network, "http", str), FrameReader(settings), []
    for sent, arrived in zip(sent_ms, arrived_ms, strict=True):
        body = {"objects": []} | ({} if sent is None else {"stamp_ns": 10**18 + sent * 10**6})
        frame = reader.read(json.dumps(body).encode(), SENSOR.stream)
        numbers, *_ = await inputs.send(frame._replace(arrived_ns=10**18 + arrived * 10**6), InputSettings(clock=clock))
        found.append((numbers.stamp_ns - 10**18) / 10**6)
    assert found == list(stamps_ms)
    await asyncio.to_thread(network.close)


def test_a_late_frame_is_a_problem_until_the_clock_is_new() -> None:
    """Frames that are held for more than a second keep the offset of the clock; the stream tells of it."""
    clock = {"site/*/*": {"clock": "offset"}}
    with Edge(free_endpoint(), router=True, inputs=clock) as edge, Node(edge.settings.listen[0]) as node:
        now = time.time_ns()
        found = []
        for late_s in (0, 30):
            (one,) = edge.post({"stamp_ns": now - late_s * 10**9, "objects": []}, STREAM).body["frames"]
            found.append(int(one["stamp_ns"]))
        assert found[0] - found[1] == 30 * 10**9
        assert "30." in node.problem(SENSOR.stream, "clock").received


@pytest.mark.parametrize("way", ["post", "socket"])
def test_damaged_documents_get_a_path(edge: Edge, endpoint: str, way: str) -> None:
    """200 documents with a fault are accepted or get an error whose path is in them; another stream loses nothing."""
    query, valid = "stream=site/node/damaged", document(SENSOR.detections(0), "epoch", "seq")
    with Node(endpoint) as node, socket(edge.address, query) as connection, socket(edge.address, query) as large:
        for number, damage in enumerate(damaged(valid, 200)):
            text = damage if way == "post" else damage.decode(errors="replace").encode()
            if way == "socket":
                connection.send(text.decode())
                answers = [json.loads(connection.recv())]
                assert answers[0]["index"] == number
            else:
                answer = edge.post(text, query)
                assert answer.status in {HTTPStatus.ACCEPTED, HTTPStatus.BAD_REQUEST}, (text, answer)
                answers = answer.body.get("frames", [answer.body])
            assert all(exists(one["error"]["path"], text) for one in answers if "error" in one), (answers, text)
            if number % 20 == 0:
                assert edge.post(frame(number // 20), STREAM).status == HTTPStatus.ACCEPTED
        assert edge.post(b" " * 10_000_000, STREAM).status == HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        with pytest.raises((WebSocketException, OSError, ValueError)):  # it is closed, while it sends or after
            json.loads(large.send(" " * 10_000_000) and large.recv())
        assert [one.stamp_ns for one in node.tracks(SENSOR.stream, 10)] == list(map(SENSOR.stamp_ns, range(10)))


@pytest.mark.parametrize(
    ("fields", "code", "path"),
    [
        ({"objects": [{"class": "car"}]}, "invalid_value", "objects[0]"),
        ({"objects": [{"class": "car", "position": [0, 0], "foot": [1, 1]}]}, "invalid_value", "objects[0]"),
        ({"objects": [{"class": "car", "box": [0, 0, 1, 1]}]}, "invalid_value", "objects[0].box"),
        ({"objects": [{"class": "car", "lat": 1.0}]}, "missing_field", "objects[0].lon"),
        ({"objects": [{"class": "car", "lat": 1.0, "lon": 1.0}]}, "invalid_value", "objects[0].lat"),
        ({"objects": [{"class": "car", "position": [0, None]}]}, "invalid_value", "objects[0].position[1]"),
        (
            {"objects": [{"class": "car", "position": [0, 0], "confidence": 7}]},
            "invalid_value",
            "objects[0].confidence",
        ),
        (
            {"objects": [{"class": "car", "position": [0, 0], "size": [1, -1, 1]}]},
            "invalid_value",
            "objects[0].size[1]",
        ),
        ({"objects": [{"class": "\n", "position": [0, 0]}]}, "invalid_value", "objects[0].class"),
        ({"objects": [CAR | {"embedding": [1, 2]}]}, "invalid_value", "embedding_model"),
        (
            {"objects": [CAR | {"embedding": [1, 2]}, CAR | {"embedding": [1]}], "embedding_model": "reid-7"},
            "invalid_value",
            "objects[1].embedding",
        ),
        (
            {"objects": [CAR, CAR | {"embedding": [0, 0]}], "embedding_model": "reid-7"},
            "invalid_value",
            "objects[1].embedding",
        ),
        ({"objects": [CAR, CAR | {"attributes": {"plate": ""}}]}, "invalid_value", "objects[1].attributes"),
        ({"objects": [CAR, CAR | {"attributes": {"plate": ["A", 2.0]}}]}, "invalid_value", "objects[1].attributes"),
        ({"objects": [CAR, CAR | {"yaw": 90}]}, "invalid_value", "objects[1].yaw"),
        ({"objects": [], "object": []}, "invalid_value", "object"),
        ({"objects": [], "frame": "sensor"}, "missing_field", "pose"),
        ({"objects": [], "frame": "map"}, "invalid_value", "frame"),
        ({"objects": [], "time": "2026-11-27T08:00:00"}, "invalid_value", "time"),
        ({"objects": [], "time": "2262-11-27T08:00:00Z"}, "invalid_value", "time"),
        ({"objects": [], "time": "2026-11-27T08:00:00Z", "stamp_ns": 1}, "invalid_value", "stamp_ns"),
        ({"objects": [], "seq": 1}, "missing_field", "epoch"),
        ({"objects": [], "stream": "a/b/c"}, "invalid_value", "stream"),
        ({"objects": [], "key": "k" * 129}, "invalid_value", "key"),
        ({"labels": [], "label": [], "key": "k" * 129}, "invalid_value", "key"),
        ({"labels": [], "label": [], "seq": True}, "invalid_value", "seq"),
    ],
)
def test_an_error_names_the_path(fields: dict[str, Any], code: str, path: str) -> None:
    """In the sender's words: objects and their fields, not columns."""
    with pytest.raises(MessageError) as raised:
        FrameReader(Settings()).read(json.dumps(fields).encode(), SENSOR.stream)
    assert (raised.value.code, raised.value.path) == (code, path)


@pytest.mark.parametrize(
    ("fields", "path", "ours"),
    [
        ({"objects": [{"label": "car", "position": [0, 0]}]}, "objects[0].class", "label is class here"),
        ({"objects": [{"x": 1, "y": 2, "label": "car"}]}, "objects[0].class", "label is class here"),
        ({"objects": [{"class": "car", "bbox": [0, 0, 9, 9]}]}, "objects[0]", "bbox is box here"),
        ({"objects": [CAR, {"class": "car", "x": 1, "y": 2}]}, "objects[1]", "x is position here"),
        ({"objects": [], "timestamp": 1.5}, "timestamp", "timestamp is time or stamp_ns here"),
        ({"detections": [{"class": "car"}]}, "detections", "detections is objects here"),
    ],
)
def test_an_error_says_our_name_of_a_field_that_others_call_otherwise(
    fields: dict[str, Any], path: str, ours: str
) -> None:
    """Only where a field is missing or not known: names that mean nothing here are free."""
    with pytest.raises(MessageError) as raised:
        FrameReader(Settings()).read(json.dumps(fields).encode(), SENSOR.stream)
    assert (raised.value.path, raised.value.received.rpartition("; ")[2]) == (path, ours)


def test_vectors_of_objects_are_columns() -> None:
    """An object without one is unknown, and a frame that says nothing of other objects has one frame for each."""
    body = {"objects": [CAR | {"embedding": [3, 4]}, CAR], "embedding_model": "reid-7"}
    found = FrameReader(Settings()).read(json.dumps(body).encode(), SENSOR.stream)
    assert found.message.embedding is not None
    np.testing.assert_array_equal(found.message.embedding, [[3, 4], [np.nan, np.nan]])
    assert found.message.embedding_model == "reid-7"
    assert [np.shape(one.message.embedding) for one in separate(found)] == [(1, 2)] * 2


def test_attributes_of_objects_are_theirs() -> None:
    """A text may have a score, and stays with its object where the frame is split; errors name object and field."""
    body = {"objects": [CAR, CAR | {"attributes": {"plate": ["AB 1", 0.5], "colour": "red"}}]}
    found = FrameReader(Settings()).read(json.dumps(body).encode(), SENSOR.stream)
    told = (Attribute(row=1, name="plate", text="AB 1", score=0.5), Attribute(row=1, name="colour", text="red"))
    assert found.message.attributes == told
    one, other = (part.message.attributes for part in separate(found))
    assert one is None
    assert other == tuple(each.model_copy(update={"row": 0}) for each in told)


def test_latitude_and_heading_become_the_world(tmp_path: Path) -> None:
    """By the place of the site, in which x points north here; classes have the names of the settings."""
    settings = Settings(
        sites={"site": {"origin": SITE, "x_heading": 0.0}}, inputs={"site/*/*": {"classes": {"Human": "pedestrian"}}}
    )
    place = Georeference(SITE, 0.0)
    lat, lon, alt, heading = place.to_geographic([[300.0, -40.0, 1.0]], [0.3])
    one = {"class": "Human", "lat": lat[0], "lon": lon[0], "alt": alt[0], "heading": heading[0]}
    body = {
        "objects": [one, {"class": "pedestrian", "position": [1, 2]}],
        "time": "2026-11-27T09:00:00.000000001+01:00",
    }
    message = FrameReader(settings).read(json.dumps(body).encode(), SENSOR.stream).message
    np.testing.assert_allclose(message.center, [[300.0, -40.0, 1.0], [1.0, 2.0, np.nan]], atol=1e-6)
    assert message.yaw is not None
    np.testing.assert_allclose(message.yaw, [0.3, np.nan], atol=1e-9)
    assert (message.labels, message.label.tolist()) == (("pedestrian",), [0, 0])
    assert message.stamp_ns == 1_795_766_400_000_000_001


def test_large_frames_hold_no_loop(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are read on a thread of their own, small ones at once."""
    threads: list[str] = []
    read = FrameReader.read

    def reading(self: FrameReader, *arguments: Any) -> Any:
        threads.append(threading.current_thread().name)
        return read(self, *arguments)

    monkeypatch.setattr(FrameReader, "read", reading)
    for count in (1, 3000):
        assert edge.post({"objects": [CAR] * count}, STREAM).status == HTTPStatus.ACCEPTED
    assert [name == "http" for name in threads] == [True, False]


def test_a_page_of_a_stranger_cannot_send(edge: Edge) -> None:
    """By its origin, and by what it can send without asking: other content types."""
    assert edge.post(stamped(0), STREAM, origin="https://stranger.example").status == HTTPStatus.FORBIDDEN
    for headers in ({"content_type": "text/plain"}, {"content_encoding": "gzip"}):
        assert edge.post(stamped(0), STREAM, **headers).status == HTTPStatus.UNSUPPORTED_MEDIA_TYPE
    assert edge.post(stamped(0), STREAM, origin=f"http://{edge.address}").status == HTTPStatus.ACCEPTED


def test_a_socket_answers_each_text(edge: Edge) -> None:
    """Also a wrong one, with its path; it ends at a message that is no text, and a stranger's page opens none."""
    with socket(edge.address, STREAM) as connection:
        for text in ('{"objects": [], "key": "a"}', "[]", '{"objects": [{}]}', '{"objects": [], "key": "a"}'):
            connection.send(text)
        found = [json.loads(connection.recv()) for _ in range(4)]
        assert [one["index"] for one in found] == [0, 1, 2, 3]
        assert [one.get("duplicate") for one in found] == [False, None, None, True]
        assert [one["error"]["path"] for one in found[1:3]] == ["", "objects[0].class"]
        connection.send(b"{}", ABNF.OPCODE_BINARY)
        assert connection.recv_data(control_frame=True)[0] == ABNF.OPCODE_CLOSE
    for query, origin in (("", "https://stranger.example"), ("streem=a", None)):
        options = {"origin": origin} if origin else {}
        with pytest.raises(WebSocketBadStatusException), socket(edge.address, query, **options):
            pass


def test_a_path_with_a_slash_is_that_without(edge: Edge) -> None:
    """No redirection, which a sender would not follow with its body."""
    with asked(edge.address, f"/api/v1/detections/?{STREAM}", "POST") as response:
        assert response.status == HTTPStatus.UNSUPPORTED_MEDIA_TYPE


def test_a_byte_order_mark_is_read(edge: Edge) -> None:
    """Before a frame or an array, as editors and some languages write it."""
    for payload in (b'{"objects": []}', b'[{"objects": []}]'):
        assert edge.post(b"\xef\xbb\xbf" + payload, STREAM).status == HTTPStatus.ACCEPTED
    with socket(edge.address, STREAM) as connection:
        connection.send("\ufeff" + '{"objects": []}')
        assert "seq" in json.loads(connection.recv())


def test_a_body_of_two_lengths_is_refused(edge: Edge) -> None:
    """A proxy in front may go by the other one: the connection ends."""
    host, _, port = edge.address.rpartition(":")
    head = f"POST /api/v1/detections?{STREAM} HTTP/1.1\r\nhost: {edge.address}\r\ncontent-type: application/json\r\n"
    body = b"f\r\n" + b'{"objects": []}' + b"\r\n0\r\n\r\n"
    with open_connection((host, int(port)), 60) as connection:
        lengths = f"content-length: {len(body)}\r\ntransfer-encoding: chunked\r\n\r\n"
        connection.sendall((head + lengths).encode() + body)
        answer = b"".join(iter(lambda: connection.recv(4096), b""))
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert answer.count(b"HTTP/1.1") == 1


def test_pages_of_named_origins_may_send(watched: Watched) -> None:
    """A browser asks before it sends: the answer allows POST with a content type and a token."""
    asks = {"origin": "https://map.example", "access-control-request-method": "POST"}
    asks["access-control-request-headers"] = "authorization,content-type,idempotency-key"
    with served(watched, http_origins=["https://map.example"]) as address:
        with asked(address, "/api/v1/detections", "OPTIONS", **asks) as response:
            assert response.status == HTTPStatus.OK
        with asked(address, "/api/v1/detections", "OPTIONS", **asks | {"origin": "https://other"}) as response:
            assert response.status == HTTPStatus.BAD_REQUEST


def test_tokens_send_their_own_streams(endpoint: str, tmp_path: Path) -> None:
    """A node sends its streams, a viewer none; without tokens only a loopback address takes detections."""
    names = {"node": "site/node", "viewer": "viewer/map", "service": "service/one"}
    file = tmp_path / "tokens.json"
    file.write_text(json.dumps({hashlib.sha256(token.encode()).hexdigest(): name for token, name in names.items()}))
    both = [stamped(0, stream=SENSOR.stream), stamped(0, stream="site/other/lidar")]
    with Edge(endpoint, http="0.0.0.0:8080", http_tokens=str(file)) as edge:
        tokens = {name: {"authorization": f"Bearer {name}"} for name in ("", *names)}
        assert edge.post(both).status == HTTPStatus.UNAUTHORIZED
        answer = edge.post(both, **tokens["node"])
        assert answer.status == HTTPStatus.MULTI_STATUS
        assert answer.body["frames"][1]["error"]["code"] == "not_allowed"
        for name in ("viewer", "service"):
            assert edge.post(both, **tokens[name]).status == HTTPStatus.FORBIDDEN
    with Edge(endpoint, http="0.0.0.0:8080") as edge:
        answer = edge.post(both)
        assert (answer.status, "set http_tokens" in answer.body["error"]["message"]) == (HTTPStatus.FORBIDDEN, True)


def test_a_sender_whose_token_is_taken_out_is_closed(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether it sends or not; its next requests are refused."""
    monkeypatch.setattr(access, "LOOK_S", 0.05)
    file = tmp_path / "tokens.json"
    file.write_text(json.dumps({hashlib.sha256(b"node").hexdigest(): "site/node"}))
    header = {"header": ["authorization: Bearer node"]}
    with (
        Edge(endpoint, http_tokens=str(file)) as edge,
        socket(edge.address, STREAM, **header) as busy,
        socket(edge.address, STREAM, **header) as idle,
    ):
        file.write_text("{}")
        busy.send('{"objects": []}')
        with contextlib.suppress(OSError):
            while busy.recv_data(control_frame=True)[0] != ABNF.OPCODE_CLOSE:
                busy.send('{"objects": []}')
        assert idle.recv_data(control_frame=True)[0] == ABNF.OPCODE_CLOSE
        assert edge.post(stamped(0), STREAM, authorization="Bearer node").status == HTTPStatus.UNAUTHORIZED


def test_one_name_has_a_quarter_of_the_places(endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those who send; idle sockets give theirs to others, and the status has who was refused."""
    monkeypatch.setattr(access, "LOOK_S", 0.05)
    file = tmp_path / "tokens.json"
    names = {name: f"site/{name}" for name in ("one", "two", "three", "four", "node")}
    file.write_text(json.dumps({hashlib.sha256(token.encode()).hexdigest(): name for token, name in names.items()}))
    for idle_s in (3600.0, 0.0):
        settings = {"http_tokens": str(file), "http_senders": 8, "sender_idle_s": idle_s}
        with Edge(endpoint, **settings) as edge, contextlib.ExitStack() as opened:

            def connect(name: str, edge: Edge = edge, opened: contextlib.ExitStack = opened) -> WebSocket:
                header = {"header": [f"authorization: Bearer {name}"]}
                return opened.enter_context(socket(edge.address, f"stream=site/{name}/lidar", **header))

            held = [connect(name) for name in ("one", "one", "two", "two", "three", "three", "four", "four")]
            for name in ("one", "node"):  # above its share, and above all
                if idle_s:
                    with pytest.raises(WebSocketBadStatusException) as raised:
                        connect(name)
                    assert raised.value.status_code == HTTPStatus.SERVICE_UNAVAILABLE
                else:
                    other = connect(name)
                    other.send(json.dumps({"objects": []}))
                    assert "seq" in json.loads(other.recv())
            if idle_s:
                with asked(edge.address, "/readyz") as response:
                    assert json.loads(response.read())["senders_refused"] == {"site/one": 1, "site/node": 1}
            else:
                assert held[0].recv_data(control_frame=True)[0] == ABNF.OPCODE_CLOSE


def test_a_second_edge_of_a_stream_is_told(endpoint: str) -> None:
    """The edge whose epoch another one has replaced answers 409."""
    with Node(endpoint) as node, Edge(endpoint) as one, Edge(endpoint) as other:
        assert one.post(stamped(0), f"{STREAM}&wait=5").body["tracks"] is not None
        assert other.post(stamped(1), f"{STREAM}&wait=5").body["tracks"] is not None
        assert one.post(stamped(2), STREAM).status == HTTPStatus.ACCEPTED
        node.problem(SENSOR.stream, "duplicate_epoch")
        ends, stamps = time.monotonic() + 60, itertools.count(SENSOR.stamp_ns(3))  # a stamp that went is a duplicate
        while (answer := one.post({"stamp_ns": next(stamps), "objects": []}, STREAM)).status != HTTPStatus.CONFLICT:
            assert time.monotonic() < ends
        assert error(answer.body)[0] == "duplicate_epoch"


def test_a_sender_waits_while_nothing_is_tracked() -> None:
    """64 frames of a stream without tracks: 429 and when to come again; without a network 503."""
    with Edge(free_endpoint(), router=True) as edge:
        frames = [stamped(seq) for seq in range(70)]
        answer = edge.post(frames, STREAM)
        assert (answer.status, answer.body["accepted"]) == (HTTPStatus.MULTI_STATUS, 64)
        assert {one["error"]["code"] for one in answer.body["frames"][64:]} == {"busy"}
        again = edge.post(frames[64:], STREAM)
        assert (again.status, again.headers["retry-after"]) == (HTTPStatus.TOO_MANY_REQUESTS, "1")


def test_without_a_network_nothing_is_taken(watched: Watched) -> None:
    """503 before the service has a session."""
    watched.network = None
    with served(watched) as address:
        answer = post(address, stamped(0), STREAM)
        assert (answer.status, answer.headers["retry-after"]) == (HTTPStatus.SERVICE_UNAVAILABLE, "1")


def test_a_body_has_a_bound_and_a_time(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond `max_json_bytes`, also in chunks of unknown number, 413; one that does not come, 408."""
    host, _, port = edge.address.rpartition(":")
    head = b"POST /api/v1/detections HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"

    def answer(text: bytes) -> bytes:
        with open_connection((host, int(port)), 60) as connection:
            connection.sendall(head + text)
            return connection.recv(100).split(b"\r\n")[0]

    chunk = b"%x\r\n%b\r\n" % (2**16, b" " * 2**16)
    assert b" 413 " in answer(b"transfer-encoding: chunked\r\n\r\n" + chunk * 33 + b"0\r\n\r\n")
    assert b" 413 " in answer(b"expect: 100-continue\r\ncontent-length: 3000000\r\n\r\n")
    monkeypatch.setattr(detections, "BODY_S", 0.05)
    assert b" 408 " in answer(b"content-length: 10\r\n\r\n1")


@pytest.mark.parametrize(
    ("query", "path"),
    [
        ("streem=a/b/c", "streem"),
        (f"{STREAM}&wait=6", "wait"),
        (f"{STREAM}&fields=id", "fields"),
        (f"{STREAM}&wait=1&min_existence=2", "min_existence"),
    ],
)
def test_a_parameter_that_is_wrong_is_named(edge: Edge, query: str, path: str) -> None:
    """Before the body is read."""
    answer = edge.post(stamped(0), query)
    assert (answer.status, answer.body["error"]["path"]) == (HTTPStatus.BAD_REQUEST, path)


def test_problems_beyond_the_rate_come_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of twelve streams with wrong frames, three a second, all have theirs, though nothing else comes."""
    monkeypatch.setattr(problem_reporter, "PUBLISHED_PER_SECOND", 3)
    frames = [{"stream": f"site/node/{number}", "objects": [{}]} for number in range(12)]
    endpoint = free_endpoint()
    with Edge(endpoint, router=True) as edge, Node(endpoint) as node:
        until(lambda: edge.post(frames[:1]) and node.problems_seen.items, "a problem")  # it is known who watches
        edge.post(frames)
        for one in frames:
            node.problem(one["stream"], "missing_field")


def test_refused_frames_are_problems_of_the_stream(endpoint: str, edge: Edge) -> None:
    """Whoever watches the stream sees why nothing comes, and the metrics count it."""
    with Node(endpoint) as node:

        def seen() -> bool:  # the first one may be sent before the edge knows that somebody watches
            edge.post({"objects": [{"class": "car"}]}, STREAM)
            return bool(node.problems_seen.items)

        until(seen, "a problem")
        assert node.problem(SENSOR.stream, "invalid_value").path == "objects[0]"
    assert b'optipmb_inputs_refused_total{code="invalid_value",edge="http"}' in edge.health.metrics.text()


@pytest.mark.skipif(not shutil.which("curl"), reason="needs curl")
def test_the_commands_of_the_page(edge: Edge, tmp_path: Path) -> None:
    """They run as they stand: a frame gives a track, of two frames one is refused; its settings are valid."""
    text = PAGE.read_text(encoding="utf-8").partition("## Choose what you get")[0]
    answers = []
    for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL):
        command = block.replace("127.0.0.1:8080", edge.address)
        if command.startswith("curl"):
            run = subprocess.run(command, shell=True, capture_output=True, check=True, timeout=60)  # noqa: S602 - of the page
            answers.append(run.stdout)
    first, _ = json.JSONDecoder().raw_decode(answers[0].decode())
    assert [one["class"] for one in first["tracks"]["objects"]] == ["car"]
    assert (json.loads(answers[1])["accepted"], json.loads(answers[1])["refused"]) == (1, 1)
    file = tmp_path / "settings.toml"
    file.write_text(re.findall(r"```toml\n(\[?http_senders.*?)```", text, re.DOTALL)[0])
    assert load(file).settings.inputs["garage/*/cam*"].clock == "offset"

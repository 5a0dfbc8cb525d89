"""JSON over HTTP: who may read, what readers get, and what slow and many readers cost."""

import contextlib
import hashlib
import http.client
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from socket import SO_RCVBUF, SOL_SOCKET
from socket import create_connection as create_socket
from typing import Any

import numpy as np
import pytest
import structlog
from geojson_pydantic import FeatureCollection
from optipmb_client.errors import ClientError
from optipmb_schemas import (
    ServiceStatus,
    SessionSummary,
)
from optipmb_schemas.json_form import event_json, problem_json, tracks_json, zones_json
from optipmb_service.app.configuration import SettingsInvalidError, load
from optipmb_service.edges import access
from optipmb_service.edges.access import Caller, NotAllowedError
from optipmb_service.edges.http import application, server
from optipmb_service.edges.readers import BURST, Bounds, Feeds, Publication, Reader, Wish
from optipmb_service.settings import Settings
from readers import received, texts
from router import until
from watched import (
    KEYS,
    PROBLEM,
    STREAM,
    Session,
    Watched,
    asked,
    delivery,
    events,
    key_of,
    links,
    plain,
    served,
    settled,
    tracks,
)
from websocket import (
    ABNF,
    WebSocket,
    WebSocketBadStatusException,
    create_connection,
)

from optipmb import Georeference

ALL = "garage/*/*"
DEADLINE_S = 60.0
TOKENS = {"secret": "viewer/map", "rig": "garage/rig"}
OK = http.client.OK


@pytest.fixture
def address(watched: Watched) -> Iterator[str]:
    with served(watched, http_clients=4, http_origins=["https://map.example"]) as address:
        yield address


@pytest.fixture
def guarded(watched: Watched, tmp_path: Path) -> Iterator[str]:
    file = tmp_path / "tokens.json"
    file.write_text(json.dumps({hashlib.sha256(token.encode()).hexdigest(): name for token, name in TOKENS.items()}))
    fused = {"crossing": {"streams": ["garage/*/radar"], "read": ["garage/rig"]}}
    with served(watched, http_tokens=str(file), fused=fused) as address:
        yield address


def get(address: str, path: str, **headers: str) -> tuple[int, Any]:
    with asked(address, f"/api/v1/{path}", **headers) as response:
        return response.status, json.loads(response.read())


@contextlib.contextmanager
def lines(address: str, query: str) -> Iterator[Iterator[bytes]]:
    with asked(address, f"/api/v1/stream?{query}") as response:
        assert response.status == OK
        assert response.readline() == b": hello\n"
        yield texts(response)


@contextlib.contextmanager
def socket(address: str, query: str, **options: Any) -> Iterator[WebSocket]:
    """Open a WebSocket; by default as a program, which names no origin."""
    options = {"suppress_origin": "origin" not in options, **options}
    connection = create_connection(f"ws://{address}/api/v1/ws?{query}", timeout=DEADLINE_S, **options)
    try:
        yield connection
    finally:
        connection.shutdown()


def refused(address: str, query: str, **options: Any) -> tuple[int, bytes]:
    with pytest.raises(WebSocketBadStatusException) as raised, socket(address, query, **options):
        pass
    return raised.value.status_code, raised.value.resp_body or b""


def closed(connection: WebSocket) -> int:
    while True:
        opcode, data = connection.recv_data(control_frame=True)
        if opcode == ABNF.OPCODE_CLOSE:
            return int.from_bytes(data[:2], "big")


def test_get_stream_and_socket_give_the_same_text(session: Session, address: str) -> None:
    """The newest frame by GET, and the same text as a server-sent event and as a frame of a WebSocket."""
    message = tracks(3)
    session.cache = [(key_of(message), message)]
    query = f"stream={ALL}&confirmed=0"
    with lines(address, query) as events, socket(address, query) as connection:
        session.publish(message)
        text = plain(next(events))
        assert plain(received(connection)) == text
        assert session.subscriptions[0][0] == f"{KEYS.prefix}/{ALL}/tracks"
        assert len(session.subscriptions) == 1, "they share it"
    assert text == tracks_json(message)
    with asked(address, f"/api/v1/tracks?{query}") as response:
        assert plain(response.read()) == b"[%b]" % text
    chosen = get(address, f"tracks?stream={ALL}&fields=position,class&classes=car,dog&min_existence=0.3")[1]
    assert chosen[0]["objects"] == [{"id": 0, "class": "car", "position": [0.0, 0.143, 0.286]}]
    assert get(address, f"tracks?stream={ALL}&min_existence=0.4")[1][0]["objects"] == []


def test_all_topics_come_on_one_connection(session: Session, address: str) -> None:
    """Events, problems and counts are texts of their own; topics not asked for do not come."""
    expected = [*event_json(events(1, 2)), zones_json(events(1)), problem_json(PROBLEM)]
    with socket(address, f"stream={STREAM}&topics=events,zones,problems&events=now") as connection:
        session.publish(tracks(1), events(1, 2), PROBLEM)
        found = sorted(plain(received(connection)) for _ in expected)
        assert found == sorted(text for text in expected if text is not None)
    with lines(address, f"stream={STREAM}&topics=zones") as found_texts:
        session.publish(events(2, 3))
        assert next(found_texts) == zones_json(events(2))
    session.cache = [(key_of(events(4)), events(4))]
    assert get(address, f"zones?stream={STREAM}")[1] == [json.loads(zones_json(events(4)) or b"")]


def test_linked_tracks_have_their_global_id(session: Session, address: str) -> None:
    """As `Links` said before a reader came, and says since; a map has it, too, and no track that is not linked."""
    message = tracks(3)
    session.cache = [(key_of(message), message)]
    session.links = [links((STREAM, 0, "a"), ("other/rig/a", 1, "a"))]
    query = f"tracks?stream={ALL}&confirmed=0"

    def found(query: str) -> list[str | None]:
        return [one.get("global_id") for one in get(address, query)[1][0]["objects"]]

    assert found(query) == ["a" * 32, None]
    session.publish(links((STREAM, 1, "b"), whole=False))
    assert found(query) == ["a" * 32, "b" * 32]
    assert found(f"{query}&fields=speed") == [None, None]
    session.publish(links((STREAM, 1, "c")), links((STREAM, 0, "d"), area="other"))
    assert found(f"{query}&fields=global_id") == ["d" * 32, "c" * 32]


def test_a_map_gets_the_newest_tracks_as_points(session: Session, watched: Watched) -> None:
    """GeoJSON where the site has a place, with longitude first; elsewhere the answer names the setting."""
    session.cache = [(key_of(one), one) for one in (tracks(3), tracks(4, "other/rig/a"))]
    with served(watched, {"garage": Georeference((48.0, 11.0, 500.0)).to_geographic}) as address:
        query = f"tracks?stream={ALL}&confirmed=0"
        (frame,) = get(address, query)[1]
        with asked(address, f"/api/v1/{query}&format=geojson") as response:
            assert response.headers["content-type"] == "application/geo+json"
            found = FeatureCollection.model_validate_json(response.read())
        assert [one.id for one in found.features] == [f"{frame['stream']}/{one['id']}" for one in frame["objects"]]
        for feature, one in zip(found.features, frame["objects"], strict=True):
            assert feature.geometry is not None
            assert list(feature.geometry.coordinates) == [one["lon"], one["lat"], one["alt"]]
            assert feature.properties is not None
            assert (feature.properties["stamp_ns"], feature.properties["class"]) == (frame["stamp_ns"], one["class"])
        few = get(address, f"{query}&format=geojson&fields=speed")[1]["features"][0]
        assert (len(few["geometry"]["coordinates"]), "speed" in few["properties"]) == (3, True)
        assert "class" not in few["properties"]
        assert get(address, "tracks?stream=other/*/*&format=geojson")[1]["error"]["path"] == "sites"
        assert get(address, f"{query}&format=kml")[1]["error"]["path"] == "format"


def test_a_feature_has_the_id_of_its_object(session: Session, watched: Watched) -> None:
    """Where tracks are joined over gaps, features have the ids of objects, for any choice of fields."""
    known = {"id": np.array([5, 8]), "object": np.array([3, -1]), "object_probability": np.ones(2, np.float32)}
    joined = tracks(3).model_copy(update=known)
    session.cache = [(key_of(joined), joined)]
    with served(watched, {"garage": Georeference((48.0, 11.0, 500.0)).to_geographic}) as address:
        found = get(address, f"tracks?stream={ALL}&confirmed=0&format=geojson&fields=speed")[1]["features"]
    assert [feature["id"] for feature in found] == [f"{STREAM}/3", f"{STREAM}/8"]


def test_the_newest_frame_is_that_of_the_latest_run(session: Session, address: str) -> None:
    """Caches of the service that tracked a stream before have frames too; streams come by name."""
    held = [tracks(9, run=1), tracks(5, run=2), tracks(1, "garage/rig/a"), tracks(7, "elsewhere/rig/a")]
    session.cache = [(key_of(one), one) for one in held]
    assert [(one["stream"], one["seq"]) for one in get(address, f"tracks?stream={ALL}")[1]] == [
        ("garage/rig/a", 1),
        (STREAM, 5),
    ]


def test_what_is_not_valid_is_logged() -> None:
    """A message that no reader gets is in the log of the process, once."""
    with structlog.testing.capture_logs() as logged:
        one = Publication(KEYS.tracks(STREAM), b"garbage", "", {})
        assert (one.message, one.message) == (None, None)
    assert [line["event"] for line in logged] == ["edge_invalid"]


def test_streams_are_those_of_all_services(session: Session, address: str) -> None:
    """Each with its instance; workers, which answer too, are left out, and so is an answer that is not valid."""
    session.statuses.append(PROBLEM)
    for name in ("one", "one-w0"):
        summaries = [SessionSummary(stream=one, profile="kitti", state="running") for one in (STREAM, "x/y/z")]
        status = ServiceStatus(
            instance=name, version="1", started_ns=0, uptime_s=1.0, state="ready", sessions=summaries
        )
        session.statuses.append(status)
    assert [(one["instance"], one["stream"]) for one in get(address, "streams")[1]] == [
        ("one", STREAM),
        ("one", "x/y/z"),
    ]
    assert [one["stream"] for one in get(address, f"streams?stream={ALL}")[1]] == [STREAM]


@pytest.mark.parametrize(
    ("query", "path"),
    [
        ("", "stream"),
        ("stream=garage", "stream"),
        (f"stream={ALL}&min_existence=2", "min_existence"),
        (f"stream={ALL}&max_rate_hz=nan", "max_rate_hz"),
        (f"stream={ALL}&confirmed=maybe", "confirmed"),
        (f"stream={ALL}&topics=tracks,points", "topics"),
        (f"stream={ALL}&classes=", "classes"),
        (f"stream={ALL}&stream=garage/rig/*", "stream"),
        (f"stream={ALL}&fields=colour", "fields"),
        (f"stream={ALL}&class=car", "class"),
        (f"stream={ALL}&events=soon", "events"),
    ],
)
def test_a_bad_parameter_is_refused_with_its_path(address: str, query: str, path: str) -> None:
    """The same for every way to read, with the name as it was written; a WebSocket before its handshake."""
    for way in ("tracks", "zones", "stream"):
        status, answer = get(address, f"{way}?{query}")
        assert (status, answer["error"]["path"]) == (http.client.BAD_REQUEST, path)
        assert answer["error"]["message"].startswith(f"{path}: expected ")
    status, body = refused(address, query)
    assert (status, json.loads(body)["error"]["path"]) == (http.client.BAD_REQUEST, path)


def test_no_parameter_is_ignored(address: str) -> None:
    """Every path refuses unknown parameters, also parameters of other paths."""
    paths = (
        "api/v1/streams?class=car",
        "api/v1/asyncapi.json?class=car",
        f"live?stream={STREAM}&class=car",
        "status?class=1",
    )
    ways = ("tracks", "max_rate_hz=2"), ("tracks", "events=now"), ("zones", "classes=car"), ("streams", "fields=yaw")
    for path in (*paths, *(f"api/v1/{way}?stream={ALL}&{query}" for way, query in ways)):
        with asked(address, f"/{path}") as response:
            assert (response.status, path) == (http.client.BAD_REQUEST, path)
            assert (
                json.loads(response.read())["error"]["path"]
                == path.rpartition("&" if "&" in path else "?")[2].partition("=")[0]
            )


def test_the_newest_tracks_are_not_predicted(address: str) -> None:
    """Nothing of a fixed rate is kept to be asked for."""
    status, answer = get(address, f"tracks?stream={ALL}&predict=1")
    assert (status, answer["error"]["path"]) == (http.client.BAD_REQUEST, "predict")


def test_tokens_decide_who_reads_what(guarded: str, session: Session) -> None:
    """No token or a wrong one: 401; a node reads its own streams and `fused` ones that name it. Health asks none."""
    viewer, node = {"authorization": "Bearer secret"}, {"authorization": "bearer rig"}
    for path in ("streams", f"tracks?stream={ALL}", f"zones?stream={ALL}", f"stream?stream={ALL}"):
        assert get(guarded, path)[0] == get(guarded, path, authorization="Bearer no")[0] == http.client.UNAUTHORIZED
        if path != "streams":
            assert get(guarded, path, **node)[0] == http.client.FORBIDDEN
    with asked(guarded, f"/live?stream={STREAM}") as response:
        assert response.status == http.client.UNAUTHORIZED, "the page shows no tracks to those who may not read them"
    assert get(guarded, f"tracks?stream={ALL}", **viewer)[0] == OK
    assert get(guarded, "tracks?stream=garage/rig/*", **node)[0] == OK
    assert get(guarded, "tracks?stream=garage/fused/crossing", **node)[0] == OK
    assert get(guarded, "tracks?stream=garage/fused/*", **node)[0] == http.client.FORBIDDEN
    assert refused(guarded, f"stream={ALL}")[0] == http.client.UNAUTHORIZED
    assert refused(guarded, f"stream={ALL}", header=["Authorization: Bearer rig"])[0] == http.client.FORBIDDEN
    with socket(guarded, f"stream={ALL}", subprotocols=["optipmb.v1", "bearer.secret"]) as connection:
        assert connection.subprotocol == "optipmb.v1"
        session.publish(tracks(1))
        assert json.loads(received(connection))["seq"] == 1
    with socket(guarded, "stream=garage/rig/*", subprotocols=["optipmb.v1", "bearer.rig"]) as connection:
        connection.send(json.dumps({"subscribe": {"stream": ALL}}))
        assert closed(connection) == 1008
    with asked(guarded, "/healthz") as response:
        assert response.status == OK


def test_a_token_that_is_taken_out_of_the_file_ends(
    watched: Watched, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one with other rights: its open streams and sockets end, later requests are refused, and others go on."""
    monkeypatch.setattr(access, "LOOK_S", 0.05)
    file = tmp_path / "tokens.json"
    names = {hashlib.sha256(token.encode()).hexdigest(): name for token, name in TOKENS.items()}
    file.write_text(json.dumps(names))
    query = "stream=garage/rig/*"
    with (
        served(watched, http_tokens=str(file)) as address,
        socket(address, query, subprotocols=["optipmb.v1", "bearer.rig"]) as ended,
        socket(address, query, subprotocols=["optipmb.v1", "bearer.secret"]) as changed,
        asked(address, f"/api/v1/stream?{query}", authorization="Bearer rig") as stream,
    ):
        file.write_text("cut sh")  # as it is while it is written
        assert get(address, f"tracks?{query}", authorization="Bearer rig")[0] == OK
        file.write_text(json.dumps({hashlib.sha256(b"secret").hexdigest(): "viewer/other"}))
        assert [closed(one) for one in (ended, changed)] == [1008] * 2
        stream.read()  # to its end
        assert get(address, f"tracks?{query}", authorization="Bearer rig")[0] == http.client.UNAUTHORIZED
        assert get(address, f"tracks?{query}", authorization="Bearer secret")[0] == OK


GOOD = hashlib.sha256(b"secret").hexdigest()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, ""),
        ("[]", ""),
        ("{}", ""),
        ("garbage", ""),
        ('{"00": "viewer/map"}', "64 hexadecimal digits"),
        (json.dumps({hashlib.sha256(b"").hexdigest(): "viewer/map"}), "the empty token"),
        (json.dumps({GOOD: ""}), "viewer/NAME"),
        (json.dumps({GOOD: "garage"}), "viewer/NAME"),
        (json.dumps({GOOD: "garage/a/b"}), "viewer/NAME"),
        (json.dumps({GOOD: "*/*"}), "reads all"),
        (json.dumps({GOOD: "garage/*"}), "viewer/NAME"),
    ],
)
def test_a_file_of_tokens_that_cannot_be_used_ends_the_start(tmp_path: Path, content: str | None, said: str) -> None:
    """One line with the setting and the file; names without rights, and digests of no token, are such."""
    file = tmp_path / "tokens.json"
    if content is not None:
        file.write_text(content)
    source: Any = Watched()
    with pytest.raises(ClientError, match=f"setting http_tokens: {file}.*{said}"):
        application(source, Settings(http_tokens=str(file)))
    file.write_text(json.dumps({GOOD.upper(): "viewer/map"}))
    application(source, Settings(http_tokens=str(file)))


def test_a_name_with_a_wildcard_has_no_rights() -> None:
    """Whoever gives it: a certificate, or a function of one's own."""
    for name in ("*/*", "garage/*", "*/rig"):
        caller = Caller(name)
        for check in (caller.may_read, caller.may_publish, caller.may_command):
            with pytest.raises(NotAllowedError):
                check(f"{name}/*")


def test_an_empty_setting_of_tokens_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a variable of a shell that is not set: it does not let everybody in."""
    for name in ("HTTP_TOKENS", "GRPC_TOKENS"):
        with monkeypatch.context() as patch:
            patch.setenv(f"OPTIPMB_{name}", "")
            with pytest.raises(SettingsInvalidError, match=f"setting {name.lower()}"):
                load()


def test_pages_of_strangers_open_no_socket(session: Session, address: str) -> None:
    """A browser names the page's origin without a check of its own: only our own and listed origins may connect."""
    query = f"stream={STREAM}"
    for origin in ("https://evil.example", "http://127.0.0.1:1", "null"):
        assert refused(address, query, origin=origin)[0] == http.client.FORBIDDEN
    assert refused(address, query, host="evil.example")[0] == 421
    assert refused(address, query, host="evil.example", origin="http://evil.example")[0] == 421
    for origin in (f"http://{address}", "https://map.example"):
        with socket(address, query, origin=origin) as connection:
            session.publish(tracks(1))
            assert json.loads(received(connection))["seq"] == 1
    with asked(address, "/api/v1/asyncapi.json", origin="https://map.example") as response:
        assert response.getheader("access-control-allow-origin") == "https://map.example"
    with asked(address, "/api/v1/asyncapi.json", origin="https://evil.example") as response:
        assert response.getheader("access-control-allow-origin") is None


def test_a_client_changes_what_it_reads(session: Session, address: str) -> None:
    """`subscribe` replaces the filter; anything else, or too much, ends the connection."""
    with socket(address, f"stream={STREAM}") as connection:
        connection.send(json.dumps({"subscribe": {"stream": "garage/other/*", "confirmed": False, "fields": ["yaw"]}}))
        other = tracks(2, "garage/other/lidar")
        until(lambda: any(key.endswith("garage/other/*/tracks") for key, _ in session.subscriptions), "it has changed")
        while True:
            session.publish(tracks(1), other)
            if (text := json.loads(received(connection)))["seq"] == 2:
                break
        assert [set(one) for one in text["objects"]] == [{"id", "yaw"}] * 2
    for bad in ("{", "[]", '{"subscribe": 3}', '{"subscribe": {"stream": "a"}}', '{"publish": {}}'):
        with socket(address, f"stream={STREAM}") as connection:
            connection.send(bad)
            assert closed(connection) == 1008
    with socket(address, f"stream={STREAM}") as connection:
        connection.send(" " * 5000)
        assert closed(connection) == 1009


def test_many_readers_keep_no_probe_out(address: str) -> None:
    """However they read, only so many are let in; probes and other requests are answered, and places come back."""

    def status() -> int:
        with asked(address, f"/api/v1/stream?stream={STREAM}") as response:
            return response.status

    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(socket(address, f"stream={STREAM}"))
            stack.enter_context(lines(address, f"stream={STREAM}"))
        assert refused(address, f"stream={STREAM}")[0] == status() == http.client.SERVICE_UNAVAILABLE
        for path in ("/healthz", "/readyz", "/metrics", "/", "/api/v1/asyncapi.json"):
            with asked(address, path) as response:
                assert response.status == OK
    until(lambda: status() == OK, "there is room again")


def test_the_end_of_the_service_closes_sockets(watched: Watched) -> None:
    """With the code by which a client knows that it may come again."""
    with contextlib.ExitStack() as stack:
        with served(watched) as address:
            connection = stack.enter_context(socket(address, f"stream={STREAM}"))
            watched.now = "stopping"
        assert closed(connection) == 1012


def test_a_service_that_starts_has_nothing_to_read(watched: Watched, address: str) -> None:
    """503 until there is a session on the network."""
    watched.network, watched.now = None, "starting"
    assert get(address, f"tracks?stream={ALL}")[0] == refused(address, f"stream={ALL}")[0] == 503


STALE_S = 30.0


def reader_of(session: Session, bounds: Bounds | None = None, stale_s: float = STALE_S, **wish: Any) -> Reader:
    """Return a reader that has joined."""
    network: Any = session
    feeds = Feeds(network, KEYS, {}, bounds or Bounds())
    reader = Reader(Wish((ALL,), **wish), stale_s)
    keys = Wish((ALL,), **wish).keys(KEYS)
    feeds.join(keys, reader.receive)
    reader.read(feeds.logs(keys))
    return reader


async def taken(reader: Reader, seconds: float = 0.01) -> list[dict[str, Any]]:
    """Return all texts that wait."""
    found = []
    with contextlib.suppress(TimeoutError):
        while True:
            found.append(json.loads((await reader.take(seconds))[0]))
    return found


async def test_a_slow_reader_gets_the_newest_of_each_stream(session: Session) -> None:
    """Between two reads all but the newest frame of each stream are left out, and counted in the next text."""
    reader = reader_of(session, topics=frozenset({"tracks"}))
    for seq in range(5):
        session.publish(*(tracks(seq, stream) for stream in (STREAM, "garage/rig/b")))
    found = await taken(reader)
    assert [(one["stream"], one["seq"], one.get("skipped")) for one in found] == [
        (STREAM, 4, 8),
        ("garage/rig/b", 4, None),
    ]


async def test_the_rate_is_bounded_in_sensor_time(session: Session) -> None:
    """Frames that come sooner are left out; a correction of one that was sent is sent."""
    reader = reader_of(session, topics=frozenset({"tracks"}), max_rate_hz=5.0)
    sent = []
    for seq in (0, 1, 2, 3, 2):
        session.publish(tracks(seq))
        sent += [one["seq"] for one in await taken(reader)]
    assert sent == [0, 2, 2]


async def test_a_stream_that_stopped_is_said_to_be_stale(session: Session) -> None:
    """Its newest frame comes again, once, with its age; also one that the reader's rate had left out."""
    reader = reader_of(session, topics=frozenset({"tracks"}), max_rate_hz=5.0, stale_s=0.2)
    session.publish(tracks(0), tracks(1))
    found = await taken(reader, 1.0)
    assert [(one["seq"], one["stale"], one["frame_age_s"] > 0.2) for one in found] == [
        (0, False, False),
        (1, True, True),
    ]
    session.publish(tracks(2))
    assert [one["stale"] for one in await taken(reader, 1.0)] == [False, True]


def test_the_newest_frame_has_its_age(session: Session, address: str) -> None:
    """A cache of a stream that stopped still has its last frame: the answer says how old it is."""
    age_ns = 27 * 10**9
    message = tracks(3)
    old = delivery(0, time.time_ns() - age_ns)
    session.cache = [(key_of(message), message.model_copy(update={"delivery": old}))]
    (found,) = get(address, f"tracks?stream={ALL}")[1]
    assert found["stale"]
    assert 27 <= found["frame_age_s"] < 27 + DEADLINE_S


async def test_events_come_once_when_they_are_final_or_as_they_are_published(session: Session) -> None:
    """A revision replaces events that are not final; a reader of all events gets both."""
    corrected = events(1, 3, revision=1)
    published = [events(1, 2), corrected, events(5, 1, final_ns=5)]
    both = [reader_of(session, topics=frozenset({"events"}), final=final) for final in (True, False)]
    session.publish(*published)
    for reader, messages in zip(both, ([corrected], published), strict=True):
        texts = [text for message in messages for text in event_json(message)]
        assert [plain((await reader.take())[0]) for _ in texts] == texts
        assert await taken(reader) == []


async def test_a_reader_of_events_that_is_too_slow_learns_how_many_it_missed(session: Session) -> None:
    """So many of each stream are kept for it."""
    reader = reader_of(session, Bounds(events=3), topics=frozenset({"events"}), final=False)
    session.publish(events(1, 5), events(2, 1, "garage/rig/b"))
    found = await taken(reader)
    assert (found[0], [one["n"] for one in found[1:]]) == (
        {"type": "missed", "stream": ALL, "events": 2},
        [1002, 1003, 1004, 2000],
    )
    assert reader.lost_events == 2


def read_events(address: str, query: str, count: int, **headers: str) -> list[tuple[str, Any]]:
    """Return so many server-sent events with their ids; without any, the id after which they begin."""
    found, event_id, ends = [], "", time.monotonic() + DEADLINE_S
    with asked(address, f"/api/v1/stream?{query}", **headers) as response:
        while len(found) < max(count, 1):
            name, _, value = response.readline().decode().rstrip().partition(": ")
            if name == "id":
                event_id = value
            if name == "data" or (name == "id" and not count):
                found.append((event_id, json.loads(value) if count else None))
            assert time.monotonic() < ends, "nothing but keep-alives"
    return found


@pytest.mark.parametrize("way", ["final", "now"])
def test_a_reader_that_comes_again_gets_the_events_since(session: Session, address: str, way: str) -> None:
    """By the id of the last event that it has: as a browser gives it, as a parameter, or in `subscribe`."""
    query = f"stream={STREAM}&topics=events&events={way}"
    ((begins, _),) = read_events(address, query, 0)
    session.publish(events(1, 2), settled(2))
    (_, first), (after, second) = read_events(address, query, 2, **{"last-event-id": begins})
    assert [first["n"], second["n"]] == [1000, 1001]
    assert second["event_id"] == after
    session.publish(events(3, 2), settled(4), events(5, 1), settled(6))
    since = [3000, 3001, 5000]
    assert [one["n"] for _, one in read_events(address, query, 3, **{"last-event-id": after})] == since
    with socket(address, f"{query}&after={after}") as connection:
        assert [json.loads(received(connection))["n"] for _ in since] == since
    with socket(address, f"stream={STREAM}") as connection:
        asked_for = {"stream": STREAM, "topics": ["events"], "events": way, "after": after}
        connection.send(json.dumps({"subscribe": asked_for}))
        assert [json.loads(received(connection))["n"] for _ in since] == since
    with socket(address, f"{query}&after=0") as connection:
        assert [json.loads(received(connection))["n"] for _ in range(5)] == [1000, 1001, *since]


def test_a_reader_with_an_id_of_another_process_gets_all_that_is_kept(session: Session, address: str) -> None:
    """It learns first that events may be missing, and sees by their numbers which."""
    query = f"stream={STREAM}&topics=events"
    read_events(address, query, 0)
    session.publish(events(1, 2), settled(2))
    found = [one for _, one in read_events(address, query, 3, **{"last-event-id": "12ab-7"})]
    assert found[0] == {"type": "missed", "stream": STREAM, "events": None}
    assert [one["n"] for one in found[1:]] == [1000, 1001]


def test_a_thousand_events_of_a_stream_are_kept(session: Session, address: str) -> None:
    """A reader that comes again later learns how many more there were."""
    query = f"stream={STREAM}&topics=events&events=now"
    ((begins, _),) = read_events(address, query, 0)
    session.publish(*(events(seq, 100) for seq in range(1, 12)))
    found = [one for _, one in read_events(address, query, 1001, **{"last-event-id": begins})]
    assert found[0] == {"type": "missed", "stream": STREAM, "events": 100}
    assert [one["n"] for one in found[1:]] == [1000 * seq + at for seq in range(2, 12) for at in range(100)]


def test_a_slow_socket_loses_no_event(session: Session, address: str) -> None:
    """A client that reads late gets the newest tracks, and all events in order."""
    small = ((SOL_SOCKET, SO_RCVBUF, 4096),)
    with socket(address, f"stream={STREAM}&topics=events,tracks&confirmed=0&events=now", sockopt=small) as connection:
        for seq in range(30):
            session.publish(tracks(seq, count=2000), events(seq, 30))
        found: list[int] = []
        while len(found) < 900:
            found += [one["n"] for one in [json.loads(received(connection))] if one["type"] == "event"]
        assert found == [1000 * seq + at for seq in range(30) for at in range(30)]


@pytest.mark.parametrize("path", [f"api/v1/stream?stream={STREAM}", f"live?stream={STREAM}"])
def test_other_methods_than_get_hold_no_place(session: Session, address: str, path: str) -> None:
    """HEAD is answered with the headers of the stream, which proxies pass on at once; OPTIONS is not allowed."""
    for _ in range(10):
        with asked(address, f"/{path}", "HEAD") as response:
            assert (response.status, response.read()) == (OK, b"")
            assert response.getheader("x-accel-buffering") == "no"
            assert "no-transform" in (response.getheader("cache-control") or "")
        with asked(address, f"/{path}", "OPTIONS") as response:
            assert response.status == http.client.METHOD_NOT_ALLOWED
    assert session.subscriptions == []


@pytest.mark.parametrize("way", ["stream", "socket"])
def test_a_reader_that_takes_nothing_loses_its_place(
    session: Session, address: str, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """After `SEND_S` its connection is aborted, so that another one may read."""
    monkeypatch.setattr(server, "SEND_S", 0.2)
    query = f"stream={STREAM}&confirmed=0"
    head = (
        ""
        if way == "stream"
        else "upgrade: websocket\r\nsec-websocket-version: 13\r\nsec-websocket-key: MTIzNDU2Nzg5MDEyMzQ1Ng==\r\n"
    )
    path = f"/api/v1/{'stream' if way == 'stream' else 'ws'}?{query}"
    host, _, port = address.rpartition(":")

    def welcomed() -> bool:
        session.publish(tracks(next(numbers), count=5000))
        with asked(address, f"/api/v1/stream?{query}") as response:
            return response.status == OK

    numbers = itertools.count()
    with contextlib.ExitStack() as stack:
        for _ in range(4):
            frozen = stack.enter_context(create_socket((host, int(port))))
            connection = "close" if way == "stream" else "upgrade"
            frozen.sendall(f"GET {path} HTTP/1.1\r\nhost: a\r\nconnection: {connection}\r\n{head}\r\n".encode())
            assert b" 200 " in (line := frozen.recv(4096)) or b" 101 " in line
        assert not welcomed()
        until(welcomed, "a frozen reader has gone")


def test_too_many_patterns_are_refused_with_the_reason(session: Session, watched: Watched) -> None:
    """503 before anything of the stream is sent; readers of subscribed patterns go on."""
    with served(watched, http_clients=4) as address:
        for number in range(BURST):
            with asked(address, f"/api/v1/stream?stream=garage/rig/s{number}") as response:
                assert response.status == OK
        with asked(address, "/api/v1/stream?stream=garage/rig/further") as response:
            assert response.status == http.client.SERVICE_UNAVAILABLE
            assert "too many new streams" in json.loads(response.read())["error"]["message"]
        with asked(address, f"/api/v1/stream?stream=garage/rig/s{BURST - 1}") as response:
            assert response.status == OK


def test_numbers_that_javascript_would_round_are_texts() -> None:
    """Sequence numbers from 2^53 on."""
    for seq, found in ((2**53 - 1, 2**53 - 1), (2**53, str(2**53))):
        assert json.loads(tracks_json(tracks(1).model_copy(update={"seq": seq})))["seq"] == found

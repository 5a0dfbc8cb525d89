"""JSON over HTTP: who may read, what readers get, and what slow and many readers cost."""

import contextlib
import hashlib
import http.client
import json
from collections.abc import Iterator
from pathlib import Path
from socket import SO_RCVBUF, SOL_SOCKET
from typing import Any

import pytest
import structlog
from optipmb_client.errors import ClientError
from optipmb_schemas import (
    ServiceStatus,
    SessionSummary,
)
from optipmb_schemas.json_form import event_json, problem_json, tracks_json, with_skipped, zones_json
from optipmb_service.edge.readers import EVENTS, Publication, Reader, Wish
from optipmb_service.http import application
from optipmb_service.settings import Settings
from readers import received, texts
from router import until
from watched import KEYS, PROBLEM, STREAM, Session, Watched, asked, events, key_of, publication, served, tracks
from websocket import (
    ABNF,
    WebSocket,
    WebSocketBadStatusException,
    WebSocketConnectionClosedException,
    create_connection,
)

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
        text = next(events)
        assert received(connection) == text.decode()
        assert session.subscriptions[0][0] == f"{KEYS.prefix}/{ALL}/tracks"
        assert len(session.subscriptions) == 1, "they share it"
    assert text == tracks_json(message)
    with asked(address, f"/api/v1/tracks?{query}") as response:
        assert response.read() == b"[%b]" % text
    chosen = get(address, f"tracks?stream={ALL}&fields=position,class&classes=car,dog&min_existence=0.3")[1]
    assert chosen[0]["objects"] == [{"id": 0, "class": "car", "position": [0.0, 0.143, 0.286]}]
    assert get(address, f"tracks?stream={ALL}&min_existence=0.4")[1][0]["objects"] == []


def test_all_topics_come_on_one_connection(session: Session, address: str) -> None:
    """Events, problems and counts are texts of their own; topics not asked for do not come."""
    expected = [*event_json(events(1, 2)), zones_json(events(1)), problem_json(PROBLEM)]
    with socket(address, f"stream={STREAM}&topics=events,zones,problems&events=now") as connection:
        session.publish(tracks(1), events(1, 2), PROBLEM)
        found = sorted(str(received(connection)).encode() for _ in expected)
        assert found == sorted(text for text in expected if text is not None)
    with lines(address, f"stream={STREAM}&topics=zones") as found_texts:
        session.publish(events(2, 3))
        assert next(found_texts) == zones_json(events(2))
    session.cache = [(key_of(events(4)), events(4))]
    assert get(address, f"zones?stream={STREAM}")[1] == [json.loads(zones_json(events(4)) or b"")]


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
        ("stream=garage", "pattern"),
        (f"stream={ALL}&min_existence=2", "min_existence"),
        (f"stream={ALL}&max_rate_hz=nan", "max_rate_hz"),
        (f"stream={ALL}&confirmed=maybe", "confirmed"),
        (f"stream={ALL}&topics=tracks,points", "topics[1]"),
        (f"stream={ALL}&fields=colour", "fields"),
        (f"stream={ALL}&class=car", "class"),
        (f"stream={ALL}&events=soon", "events"),
    ],
)
def test_a_bad_parameter_is_refused_with_its_path(address: str, query: str, path: str) -> None:
    """The same for every way to read; a WebSocket before its handshake."""
    for way in ("tracks", "zones", "stream"):
        status, answer = get(address, f"{way}?{query}")
        assert (status, answer["path"]) == (http.client.BAD_REQUEST, path)
        assert answer["error"].startswith(f"{path}: expected ")
    status, body = refused(address, query)
    assert (status, json.loads(body)["path"]) == (http.client.BAD_REQUEST, path)


def test_the_newest_tracks_are_not_predicted(address: str) -> None:
    """Nothing of a fixed rate is kept to be asked for."""
    status, answer = get(address, f"tracks?stream={ALL}&predict=1")
    assert (status, answer["path"]) == (http.client.BAD_REQUEST, "predict")


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


@pytest.mark.parametrize("content", [None, "[]", '{"00": ""}', "garbage"])
def test_a_file_of_tokens_that_cannot_be_used_ends_the_start(tmp_path: Path, content: str | None) -> None:
    """One line with the setting and the file."""
    file = tmp_path / "tokens.json"
    if content is not None:
        file.write_text(content)
    source: Any = Watched()
    with pytest.raises(ClientError, match=f"setting http_tokens: {file}"):
        application(source, Settings(http_tokens=str(file)))


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


async def test_a_slow_reader_gets_the_newest_of_each_stream() -> None:
    """Between two reads all but the newest frame of each stream are left out, and counted in the next text."""
    reader = Reader(Wish((ALL,), frozenset({"tracks"})))
    for seq in range(5):
        for stream in (STREAM, "garage/rig/b"):
            reader.receive(publication(tracks(seq, stream)))
    assert await reader.take() == with_skipped(tracks_json(tracks(4)), 8)
    assert await reader.take() == tracks_json(tracks(4, "garage/rig/b"))
    with pytest.raises(TimeoutError):
        await reader.take(0.01)


async def test_the_rate_is_bounded_in_sensor_time() -> None:
    """Frames that come sooner are left out; a correction of one that was sent is sent."""
    reader = Reader(Wish((ALL,), frozenset({"tracks"}), max_rate_hz=5.0))
    sent = []
    for seq in (0, 1, 2, 3, 2):
        reader.receive(publication(tracks(seq)))
        with contextlib.suppress(TimeoutError):
            sent.append(json.loads(await reader.take(0.01) or b"")["seq"])
    assert sent == [0, 2, 2]


async def test_events_come_once_when_they_are_final_or_as_they_are_published() -> None:
    """A revision replaces events that are not final; a reader of all events gets both."""
    final, now = (Reader(Wish((ALL,), frozenset({"events"}), final=final)) for final in (True, False))
    corrected = events(1, 3, revision=1)
    published = [events(1, 2), corrected, events(5, 1, final_ns=5)]
    for reader in (final, now):
        for message in published:
            reader.receive(publication(message))
    assert [await final.take() for _ in range(3)] == event_json(corrected)
    with pytest.raises(TimeoutError):
        await final.take(0.01)
    assert [await now.take() for _ in range(6)] == [text for message in published for text in event_json(message)]


async def test_a_reader_that_loses_events_has_to_come_again() -> None:
    """So many events wait, of all streams together; with one more, the reader ends."""
    reader = Reader(Wish((ALL,), frozenset({"events"}), final=False))
    reader.receive(publication(events(1, EVENTS)))
    assert json.loads(await reader.take() or b"")["n"] == 1000
    reader.receive(publication(events(2, 1)))
    assert json.loads(await reader.take() or b"")["n"] == 1001
    reader.receive(publication(events(3, 2)))
    assert await reader.take() is None


def test_a_socket_that_loses_events_is_closed(session: Session, address: str) -> None:
    """A client that reads nothing is closed with the code for trying again later."""
    small = ((SOL_SOCKET, SO_RCVBUF, 4096),)
    with socket(address, f"stream={STREAM}&topics=events,tracks&confirmed=0&events=now", sockopt=small) as connection:
        for seq in range(30):
            session.publish(tracks(seq, count=2000), events(seq, 100))
        assert closed(connection) == 1013
        with pytest.raises((WebSocketConnectionClosedException, OSError)):
            received(connection)

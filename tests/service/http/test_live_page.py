"""What the page costs and gives: viewers, their taps, and the frames that they get. A browser sees it in tests/e2e."""

import asyncio
import contextlib
import functools
import http.client
import json
from collections.abc import Iterator, MutableMapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import numpy as np
import pytest
from optipmb_schemas import Detections, Pose, Tracks, encode, encode_json, encoding_of
from optipmb_service.edges import global_ids
from optipmb_service.edges.global_ids import GlobalIds
from optipmb_service.edges.http import application, page
from optipmb_service.edges.http.page import Live, live_frame
from optipmb_service.edges.readers import Publication
from optipmb_service.settings import Settings
from optipmb_service.zenoh import client
from readers import texts
from router import until
from tracks_message import tracks_message
from watched import KEYS, Session, Watched, asked, events, key_of, links, publication, served

from optipmb import Georeference

VIEWERS = 6
STREAM = "yard/gate/lidar"
DEADLINE_S = 60.0


def tracks(seq: int) -> Tracks:
    return tracks_message(
        STREAM,
        seq,
        [5, 6],
        stamp_ns=seq * 100_000_000,
        center=[[100.12345, -7.0, 1.0], [0.0, 0.0, 0.0]],
        size=[4.0, 2.0, 1.5],
        yaw=1 / 3,
        heading_confidence=0.875,
        velocity=[1.0, 2.0],
        existence=[0.75, 0.25],
        score=0.5,
        age=2,
        time_since_detection=0.2,
        detection=-1,
        confirmed=[1, 0],
    )


DETECTIONS = Detections(
    stream=STREAM,
    epoch=bytes(16),
    seq=0,
    stamp_ns=0,
    frame="sensor",
    pose=Pose(translation=[10.0, 20.0, 1.0], quaternion=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]),
    labels=["Car"],
    label=[0],
    center=[[5.0, 1.0, 0.0]],
    size=[[4.0, 2.0, 1.5]],
    yaw=[0.0],
    score=[0.9],
)


@pytest.fixture
def address(watched: Watched) -> Iterator[str]:
    with served(watched, http_clients=VIEWERS) as address:
        yield address


def get(address: str, path: str) -> tuple[int, bytes]:
    with asked(address, path) as response:
        return response.status, response.read()


@contextlib.contextmanager
def looking(address: str) -> Iterator[Iterator[dict[str, object]]]:
    with asked(address, f"/live?stream={STREAM}") as response:
        assert response.status == http.client.OK
        assert response.getheader("content-type", "").startswith("text/event-stream")
        assert response.readline() == b": hello\n", "it is there when it has subscribed"

        yield map(json.loads, texts(response))


@pytest.mark.parametrize("path", ["/", "/look.js", "/look.css", "/status", f"/live?stream={STREAM}"])
def test_every_answer_forbids_what_is_from_elsewhere(watched: Watched, address: str, path: str) -> None:
    """Scripts, styles and data of this page alone, no frames, no forms, nothing guessed, nothing kept."""
    with asked(address, path) as response:
        assert response.status == http.client.OK
        policy = response.getheader("content-security-policy", "")
        assert "default-src 'none'" in policy
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
        assert response.getheader("x-content-type-options") == "nosniff"
        assert (response.getheader("cache-control") or "").startswith("no-store")
        if path in {"/", "/look.js", "/look.css"}:
            assert b"http" not in response.read()


def test_nobody_looks_nothing_is_subscribed(address: str, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages and status open no subscription; viewers of a stream share two, which go a while after the last viewer."""
    monkeypatch.setattr(client, "IDLE_S", 0.05)
    get(address, "/")
    get(address, "/status")
    assert session.subscriptions == []
    with looking(address) as one, looking(address) as other:
        assert sorted(key for key, _ in session.subscriptions) == [KEYS.detections(STREAM), KEYS.tracks(STREAM)]
        session.publish(tracks(3))
        assert next(one)["time"] == next(other)["time"] == 0.3
    session.wait(0)


def test_viewers_get_the_newest_frame_and_not_too_often(
    session: Session, watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of frames that another reader gets one by one, a viewer gets few: the first and, after a pause, the newest."""
    monkeypatch.setattr(page, "PERIOD_S", 1.0)
    with (
        served(watched) as address,
        looking(address) as frames,
        asked(address, f"/api/v1/stream?stream={STREAM}&confirmed=0") as response,
    ):
        assert response.readline() == b": hello\n"
        every = texts(response)
        for seq in range(20):
            session.publish(tracks(seq))
            assert json.loads(next(every))["seq"] == seq
        times = []
        while 1.9 not in times:
            times.append(next(frames)["time"])
    assert times == sorted(set(times), key=float)
    assert len(times) < 20


async def test_a_viewer_that_leaves_before_it_has_subscribed_leaves_nothing(
    watched: Watched, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connection is lost while a thread subscribes: the subscriptions go as soon as they are there."""
    monkeypatch.setattr(client, "IDLE_S", 0.05)
    session.gate.clear()
    arrived = asyncio.Event()
    session.arrived = functools.partial(asyncio.get_running_loop().call_soon_threadsafe, arrived.set)

    async def receive() -> dict[str, object]:
        await asyncio.wait_for(arrived.wait(), DEADLINE_S)
        return {"type": "http.disconnect"}

    async def send(_message: MutableMapping[str, object]) -> None:
        pass

    query, host = f"stream={STREAM}".encode(), [(b"host", b"localhost")]
    scope = {"type": "http", "method": "GET", "path": "/live", "headers": host, "query_string": query}
    answering = asyncio.ensure_future(application(cast("Any", watched), Settings())(scope, receive, send))
    await arrived.wait()
    assert session.subscriptions == []
    session.gate.set()
    await answering
    await asyncio.to_thread(session.wait, 0)


def test_the_end_of_the_service_ends_the_viewers(watched: Watched, address: str) -> None:
    """While the service stops, live answers end by themselves, so that nothing keeps the process."""
    with looking(address) as frames:
        watched.now = "stopping"
        assert list(frames) == []


def test_there_is_room_for_so_many_viewers(address: str) -> None:
    """One more is asked to come back, and may when another has gone."""

    def status() -> int:
        with asked(address, f"/live?stream={STREAM}") as response:
            return response.status

    with contextlib.ExitStack() as stack:
        for _ in range(VIEWERS - 1):
            stack.enter_context(looking(address))
        with looking(address):
            assert status() == http.client.SERVICE_UNAVAILABLE
            assert get(address, "/healthz")[0] == http.client.OK
        until(lambda: status() == http.client.OK, "there is room again")


def test_viewers_that_come_together_are_counted_one_by_one(session: Session, address: str) -> None:
    """More than there is room for, all before the first has subscribed: those beyond the limit are to come back."""
    session.gate.clear()

    def status() -> int:
        with asked(address, f"/live?stream={STREAM}") as response:
            return response.status

    with ThreadPoolExecutor(VIEWERS + 4) as pool:
        answers = [pool.submit(status) for _ in range(VIEWERS + 4)]
        until(lambda: sum(one.done() for one in answers) == 4, "those beyond the limit are refused")
        session.gate.set()
        assert sorted(one.result() for one in answers) == [200] * VIEWERS + [503] * 4


def test_wrong_streams_and_a_service_that_starts_are_shown(watched: Watched, address: str) -> None:
    """No stream name: 400; not ready: the state alone."""
    for stream in ("", "a/b", "a/b/*", "a/b/c/d", "../../x"):
        assert get(address, f"/live?stream={stream}")[0] == http.client.BAD_REQUEST
    status = watched.status()
    assert status is not None
    assert get(address, "/status") == (http.client.OK, encode_json(status))
    watched.now = "starting"
    assert get(address, "/status") == (http.client.OK, b'{"state":"starting"}')


def test_a_frame_holds_what_is_drawn() -> None:
    """Tracks by column; detections and the sensor in the world frame, for either input frame."""
    detections = DETECTIONS
    text = live_frame(publication(tracks(1)), publication(detections))
    assert text is not None
    frame = json.loads(text)
    assert frame["tracks"] == [[5, 0, 100.123, -7.0, 4.0, 2.0, 0.333, 1.0, 2.0, 0.75, 0.5, 2.0, 0.2, 0.875]]
    assert frame["unconfirmed"] == 1
    assert frame["sensor"] == [10.0, 20.0, 1.571]
    assert frame["detections"] == [[9.0, 25.0]]
    place = Georeference((48.0, 11.0, 500.0), x_heading=0.0).to_geographic
    placed = live_frame(publication(tracks(1)), place=place)
    assert placed is not None
    ((lat, lon, alt, heading),) = json.loads(placed)["geographic"]
    assert lat == pytest.approx(48.0 + 100.123 / 111_200, abs=1e-5)
    assert lon == pytest.approx(11.0 + 7.0 / 74_600, abs=1e-5)
    assert alt == pytest.approx(500.0, abs=3.0)
    assert heading == pytest.approx(360.0 - np.degrees(0.333), abs=0.1)
    assert "geographic" not in frame
    rear = detections.model_copy(update={"stream": "site/node/rear", "pose": None, "frame": "world"})
    older = detections.model_copy(update={"center": np.zeros((1, 3))})
    both = live_frame(publication(tracks(1)), *map(publication, (detections, rear, older)))
    assert both is not None
    assert json.loads(both)["detections"] == [[9.0, 25.0], [5.0, 1.0]]
    assert json.loads(both)["sensor"] == [10.0, 20.0, 1.571]
    assert live_frame(Publication(key_of(tracks(1)), b"\xc1", "", {})) is None


def test_global_ids_are_drawn_where_they_are_known() -> None:
    """By track, in the order of the tracks; nothing where none is linked."""
    ids = GlobalIds()
    message = tracks(1).model_copy(update={"session": "0" * 32})
    given = (key_of(message), encode(message), encoding_of(message), {}, ids)
    assert "global" not in json.loads(live_frame(Publication(*given)) or b"")
    ids.take(links((STREAM, 5, "a")))
    assert json.loads(live_frame(Publication(*given)) or b"")["global"] == ["a" * 32]


def test_the_objects_with_the_oldest_rows_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new row of an object makes it the newest one of its area."""
    monkeypatch.setattr(global_ids, "MOST", 2)
    ids = GlobalIds()
    for rows in ([(STREAM, 5, "a"), (STREAM, 6, "b")], [(STREAM, 5, "c")], [(STREAM, 7, "d")]):
        ids.take(links(*rows, whole=False))
    message = tracks(1).model_copy(update={"session": "0" * 32, "id": np.array([5, 6, 7])})
    assert list(ids.of(message)) == ["c" * 32, "", "d" * 32]


def test_a_pose_at_the_origin_is_no_sensor() -> None:
    """Publishers without poses send it: nothing is drawn where no sensor is known to be."""
    pose = Pose(translation=[0.0, 0.0, 0.0], quaternion=[1.0, 0.0, 0.0, 0.0])
    text = live_frame(publication(tracks(1)), publication(DETECTIONS.model_copy(update={"pose": pose})))
    assert json.loads(text or b"")["sensor"] is None


def test_zones_of_a_stream_come_with_its_frames(watched: Watched, session: Session) -> None:
    """Their shapes, the newest counts and the newest events; other streams have none."""
    zone = {"streams": [STREAM], "line": [[0.0, 0.0], [1.0, 0.0]]}
    with served(watched, zones={"gate": zone}) as address:
        with looking(address) as frames:
            session.publish(events(1, 20, STREAM), tracks(1))
            frame = next(frames)
        assert frame["zones"] == [{"name": "gate", "polygon": None, "line": zone["line"]}]
        assert frame["counts"]["zones"]["gate"]["car"]["inside"] == 1
        assert [one["n"] for one in frame["events"]] == list(range(1012, 1020))
        with asked(address, "/live?stream=yard/hall/lidar"):
            assert not any("hall" in key and key.endswith("/events") for key, _ in session.subscriptions)


async def test_only_the_newest_is_kept() -> None:
    """Unread frames are replaced; of detections the newest eight are kept, or one that is large."""
    live = Live(None)
    for number in range(10):
        live.receive(publication(DETECTIONS.model_copy(update={"stream": f"site/node/sensor-{number}"})))
    for seq in range(3):
        live.receive(publication(tracks(seq)))
    text, _ = await live.take(1.0)
    assert json.loads(text)["time"] == 0.2
    assert len(json.loads(text)["detections"]) == 8
    with pytest.raises(TimeoutError):
        await live.take(0.01)
    live.receive(publication(tracks(3)))
    assert await live.take(1.0)

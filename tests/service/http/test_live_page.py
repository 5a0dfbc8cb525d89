"""What the page costs and gives: viewers, their taps, and the frames that they get. A browser sees it in tests/e2e."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http.client
import json
import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from optipmb_schemas import Detections, Pose, ServiceStatus, encode, encode_json, encoding_of
from optipmb_service.http import Server
from optipmb_service.http.page import VIEWERS, Newest, live_frame, page
from starlette.applications import Starlette
from tracks_message import tracks_message

from optipmb import Georeference

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, MutableMapping

STREAM = "yard/gate/lidar"
DEADLINE_S = 60.0


def tracks(seq: int) -> bytes:
    """One track, a long way from the origin, and one that is not confirmed, in msgpack."""
    return encode(
        tracks_message(
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
    )


class Watched:
    """A service that a test speaks for."""

    def __init__(self) -> None:
        self.taps: dict[int, Callable[[str, bytes, str], None]] = {}
        self.now = "ready"
        self.gate = threading.Event()
        self.gate.set()
        self.arrived: Callable[[], object] = lambda: None
        self.released = 0
        self._changed = threading.Condition()

    def state(self) -> str:
        """As told."""
        return self.now

    def status(self) -> ServiceStatus | None:
        """Nothing while it starts."""
        if self.now == "starting":
            return None
        return ServiceStatus(instance="one", version="1", started_ns=0, uptime_s=1.0, state=self.now)

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None]) -> Callable[[], None] | None:
        """Keep what is to be called."""
        assert stream == STREAM
        self.arrived()
        assert self.gate.wait(DEADLINE_S)
        number = id(receive)
        with self._changed:
            self.taps[number] = receive
            self._changed.notify_all()

        def release() -> None:
            with self._changed:
                self.taps.pop(number, None)
                self.released += 1
                self._changed.notify_all()

        return release

    def wait_taps(self, count: int) -> None:
        """Wait until so many look."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.taps) == count, DEADLINE_S), len(self.taps)

    def wait_released(self, count: int) -> None:
        """Wait until so many taps have been released."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.released == count, DEADLINE_S), self.released

    def send(self, payload: bytes, topic: str = "tracks") -> None:
        """Hand something to everybody who looks."""
        for receive in tuple(self.taps.values()):
            receive(topic, payload, "")


@pytest.fixture
def watched() -> Watched:
    """A service."""
    return Watched()


@pytest.fixture
def address(watched: Watched) -> Iterator[str]:
    """Where its page is."""
    server = Server(Starlette(routes=page(watched)), "127.0.0.1:0")
    try:
        yield server.address
    finally:
        server.close()


@contextlib.contextmanager
def asked(address: str, path: str) -> Iterator[http.client.HTTPResponse]:
    """Ask for something; the answer's body is still to be read."""
    host, _, port = address.rpartition(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=DEADLINE_S)
    connection.request("GET", path, headers={"connection": "close"})
    response = connection.getresponse()
    try:
        yield response
    finally:
        response.close()
        connection.close()


def get(address: str, path: str) -> tuple[int, bytes]:
    """Status and body of an answer."""
    with asked(address, path) as response:
        return response.status, response.read()


@contextlib.contextmanager
def looking(address: str) -> Iterator[Iterator[dict[str, object]]]:
    """Look at the stream; gives the frames as they come."""
    with asked(address, f"/live?stream={STREAM}") as response:
        assert response.status == http.client.OK
        assert response.getheader("content-type", "").startswith("text/event-stream")

        def frames() -> Iterator[dict[str, object]]:
            while line := response.readline():
                if line.startswith(b"data: "):
                    yield json.loads(line[6:])

        yield frames()


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
        assert response.getheader("cache-control") == "no-store"
        if path in {"/", "/look.js", "/look.css"}:
            assert b"http" not in response.read()


def test_nobody_looks_nothing_is_tapped(watched: Watched, address: str) -> None:
    """Pages and status open no tap; a viewer opens one, and it is gone when the viewer is."""
    get(address, "/")
    get(address, "/status")
    assert watched.taps == {}
    with looking(address) as one:
        watched.wait_taps(1)
        with looking(address):
            watched.wait_taps(2)
        watched.wait_taps(1)
        watched.send(tracks(3))
        assert next(one)["time"] == 0.3
    watched.wait_taps(0)


def test_viewers_get_the_newest_frame_and_not_too_often(watched: Watched, address: str) -> None:
    """Of frames at 200 Hz a viewer gets about ten a second, each newer than the one before, and the last one."""
    with looking(address) as frames:
        watched.wait_taps(1)
        began = time.monotonic()
        for seq in range(200):
            watched.send(tracks(seq))
            time.sleep(0.005)  # the pace is what is tested
        took = time.monotonic() - began
        times = []
        for frame in frames:
            times.append(frame["time"])
            if frame["time"] == 19.9:
                break
    assert times == sorted(set(times), key=float)
    assert len(times) <= took / 0.1 + 3


async def test_a_viewer_that_leaves_before_its_tap_is_made_leaves_none(watched: Watched) -> None:
    """The connection is lost while a thread makes the tap: it is released as soon as it is there."""
    watched.gate.clear()
    arrived = asyncio.Event()
    watched.arrived = functools.partial(asyncio.get_running_loop().call_soon_threadsafe, arrived.set)

    async def receive() -> dict[str, object]:
        await arrived.wait()
        return {"type": "http.disconnect"}

    async def send(_message: MutableMapping[str, object]) -> None:
        pass

    query = f"stream={STREAM}".encode()
    scope = {"type": "http", "method": "GET", "path": "/live", "headers": [], "query_string": query}
    await Starlette(routes=page(watched))(scope, receive, send)
    assert watched.taps == {}
    watched.gate.set()
    await asyncio.to_thread(watched.wait_released, 1)
    assert watched.taps == {}


def test_the_end_of_the_service_ends_the_viewers(watched: Watched, address: str) -> None:
    """While the service stops, live answers end by themselves, so that nothing keeps the process."""
    with looking(address) as frames:
        watched.wait_taps(1)
        watched.now = "stopping"
        assert list(frames) == []
    watched.wait_taps(0)


def test_there_is_room_for_so_many_viewers(watched: Watched, address: str) -> None:
    """One more is asked to come back, and may when another has gone."""
    with contextlib.ExitStack() as stack:
        for _ in range(VIEWERS - 1):
            stack.enter_context(looking(address))
        with looking(address):
            watched.wait_taps(VIEWERS)
            assert get(address, f"/live?stream={STREAM}")[0] == http.client.SERVICE_UNAVAILABLE
        watched.wait_taps(VIEWERS - 1)
        with looking(address):
            watched.wait_taps(VIEWERS)


def test_viewers_that_come_together_are_counted_one_by_one(watched: Watched, address: str) -> None:
    """More than there is room for, all before the first has its tap: those beyond the limit are asked to come back."""
    watched.gate.clear()
    with contextlib.ExitStack() as stack:
        path = f"/live?stream={STREAM}"
        answers = [stack.enter_context(asked(address, path)) for _ in range(VIEWERS + 4)]
        assert sorted(one.status for one in answers) == [200] * VIEWERS + [503] * 4
        watched.gate.set()
        watched.wait_taps(VIEWERS)
    watched.wait_taps(0)


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
    """Tracks by column; detections and the sensor in the world frame, whatever frame they came in."""
    detections = Detections(
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
    text = live_frame((tracks(1), ""), (encode(detections), encoding_of(detections)))
    assert text is not None
    frame = json.loads(text)
    assert frame["tracks"] == [[5, 0, 100.123, -7.0, 4.0, 2.0, 0.333, 1.0, 2.0, 0.75, 0.5, 2.0, 0.2, 0.875]]
    assert frame["unconfirmed"] == 1
    assert frame["sensor"] == [10.0, 20.0, 1.571]
    assert frame["detections"] == [[9.0, 25.0]]
    place = Georeference((48.0, 11.0, 500.0), x_heading=0.0)
    placed = live_frame((tracks(1), ""), georeference=place)
    assert placed is not None
    ((lat, lon, alt, heading),) = json.loads(placed)["geographic"]
    assert lat == pytest.approx(48.0 + 100.123 / 111_200, abs=1e-5)
    assert lon == pytest.approx(11.0 + 7.0 / 74_600, abs=1e-5)
    assert alt == pytest.approx(500.0, abs=3.0)
    assert heading == pytest.approx(360.0 - np.degrees(0.333), abs=0.1)
    assert "geographic" not in frame
    rear = detections.model_copy(update={"stream": "site/node/rear", "pose": None, "frame": "world"})
    older = detections.model_copy(update={"center": np.zeros((1, 3))})
    both = live_frame((tracks(1), ""), *((encode(one), encoding_of(one)) for one in (detections, rear, older)))
    assert both is not None
    assert json.loads(both)["detections"] == [[9.0, 25.0], [5.0, 1.0]]
    assert json.loads(both)["sensor"] == [10.0, 20.0, 1.571]
    assert live_frame((b"\xc1", "")) is None
    assert live_frame(None) is None


async def test_only_the_newest_is_kept() -> None:
    """What nobody took in time is replaced, and its place is free at once."""
    newest = Newest(asyncio.get_running_loop())
    for seq in range(3):
        newest.put("tracks", bytes([seq]), "")
    newest.put("detections", bytes(2**22), "large")
    for number in range(20):
        newest.put("detections", bytes([number]), "x")
    assert await newest.came(1.0)
    assert newest.take() == ((b"\x02", ""), *((bytes([number]), "x") for number in range(19, 11, -1)))
    assert not await newest.came(0.01)
    newest.put("tracks", b"3", "")
    assert await newest.came(1.0)

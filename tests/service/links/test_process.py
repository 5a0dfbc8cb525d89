"""Links between streams: the role of the service, as a process."""

import json
import signal
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from gateway import GatewayProcess
from nats_process import NatsProcess
from optipmb_client import Connection, Publisher, Subscriber, linked_objects
from optipmb_client.errors import ServiceUnavailable
from optipmb_client.grpc import GrpcConnection
from optipmb_client.sessions import links_of
from optipmb_schemas import Keys, Links, Tracks, decode, encode, encoding_of
from optipmb_tools.cli import run
from optipmb_tools.run.service_process import free_port
from service_process import ServiceProcess
from tracks_message import tracks_message

STREAMS = ("west/node/lidar", "east/node/lidar")
CLUSTERED = ("north/node/lidar", "south/node/lidar")
PEOPLE = ("left/node/camera", "right/node/lidar")
OBJECTS = 6
HTTP = f"127.0.0.1:{free_port()}"
BEGIN_NS = 1_700_000_000_000_000_000
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def services() -> Iterator[ServiceProcess]:
    """Two services, of which the first is the router."""
    with ServiceProcess("--instance", "one", "--profile", "generic", "--http", HTTP) as one:
        one.wait_ready()
        two = ("--connect", one.endpoint, "--instance", "two", "--profile", "generic")
        with ServiceProcess(*two, listen=False) as other:
            other.wait_ready()
            yield one


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    file = tmp_path / "link.toml"
    file.write_text(
        f'store = "{tmp_path}"\n[links.campus]\nstreams = ["west/*/*", "east/*/lidar"]\n'
        "[links.campus.frames]\nwest = {translation = [0, 0]}\neast = {translation = [100, 0], yaw = 3.14159265}\n"
    )
    return file


def of_sites(settings: Path, west: str, east: str) -> None:
    """Have the settings link other sites, whose streams no other test has sent."""
    settings.write_text(settings.read_text().replace("west", west).replace("east", east))


def link(services: ServiceProcess, settings: Path, nats: str = "") -> ServiceProcess:
    store = {"OPTIPMB_CLUSTER": nats} if nats else {"OPTIPMB_STORE": str(settings.parent)}
    options = ("link", "--settings", str(settings), "--connect", services.endpoint)
    return ServiceProcess(*options, listen=False, environment=store)


def send(publishers: list[Publisher], frames: range) -> None:
    """Publish objects that drive side by side; the second site looks at them from the other end, the other way."""
    for frame in frames:
        place = np.column_stack((10.0 + 0.8 * frame + np.zeros(OBJECTS), 8.0 * np.arange(OBJECTS), np.ones(OBJECTS)))
        for number, publisher in enumerate(publishers):
            center = place if number == 0 else np.array((100.0, 0.0, 2.0)) - place
            publisher.publish(
                stamp_ns=BEGIN_NS + frame * 100_000_000,
                labels=("car",),
                label=np.zeros(OBJECTS, np.int64),
                center=center,
                size=np.tile((4.5, 1.9, 1.6), (OBJECTS, 1)),
                yaw=np.full(OBJECTS, np.pi * number),
                score=np.full(OBJECTS, 0.9),
            )
        time.sleep(0.02)


def until_linked(connection: Connection) -> dict[tuple[str, str, int], bytes]:
    """Return the links, once all objects of both streams are linked in pairs."""
    ends = time.monotonic() + PATIENCE_S
    found: dict[tuple[str, str, int], bytes] = {}
    while len(found) < 2 * OBJECTS:
        assert time.monotonic() < ends, found
        try:
            found = linked_objects(connection, "campus")
        except ServiceUnavailable:
            time.sleep(0.1)
    return found


def test_killed_with_a_cluster(services: ServiceProcess, settings: Path, tmp_path: Path) -> None:
    """With NATS, links survive a kill on a machine that keeps nothing."""
    of_sites(settings, "north", "south")
    with Connection(services.endpoint) as connection, NatsProcess(tmp_path) as nats:
        publishers = [Publisher(one, frame="world", connection=connection) for one in CLUSTERED]
        with link(services, settings, nats.url) as process:
            process.wait_ready()
            send(publishers, range(40))
            before = until_linked(connection)
            time.sleep(2.0)  # it is saved once a second
            process.end(signal.SIGKILL)
        for publisher in publishers:
            publisher.close()  # with the cache of its messages
        with link(services, settings, nats.url) as process:
            process.wait_ready()
            assert until_linked(connection) == before
            assert process.end()[0] == 0


def test_killed_and_started_again(services: ServiceProcess, settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Links survive a kill; a consumer counts the objects of two streams once each; other readers get the same ids."""
    with Connection(services.endpoint) as connection, Subscriber("*/*/*", connection=connection) as subscriber:
        publishers = [Publisher(one, frame="world", connection=connection) for one in STREAMS]
        with link(services, settings) as process:
            assert process.wait_ready() == f"ready link=campus endpoints={services.endpoint}"
            send(publishers, range(40))
            before = until_linked(connection)
            send(publishers, range(40, 50))
            time.sleep(2.0)  # it is saved once a second
            process.end(signal.SIGKILL)
        send(publishers, range(50, 55))
        with link(services, settings) as process:
            process.wait_ready()
            send(publishers, range(55, 75))
            after = until_linked(connection)
            shown = {}
            for tracks in subscriber:  # the newest of each stream
                shown[tracks.stream] = {(tracks.stream, tracks.session, one) for one in tracks.id.tolist()}
                if len(shown) == len(STREAMS) and tracks.seq == 74:
                    break
            ids = linked_objects(connection, "campus")
            with GatewayProcess(services.endpoint) as gateway:
                gateway.wait_ready()
                with GrpcConnection((gateway.address,)) as remote:
                    assert linked_objects(remote, "campus") == ids
            with urllib.request.urlopen(f"http://{HTTP}/api/v1/tracks?stream=*/*/*") as answer:
                frames = [one for one in json.load(answer) if one["stream"] in STREAMS]
            read = [one["global_id"] for frame in frames for one in frame["objects"]]
            assert sorted(read) == sorted(one.hex() for one in ids.values())
            assert run(["links", "campus", "--connect", services.endpoint]) == 0
            lines = capsys.readouterr().out.splitlines()
            distinct = {ids.get(track, track) for each in shown.values() for track in each}
            assert process.end()[0] == 0
        for publisher in publishers:
            publisher.close()
    assert after == before
    assert len(set(before.values())) == OBJECTS
    assert len(distinct) == OBJECTS
    assert all(len(one) <= 80 for one in lines)
    assert f"{OBJECTS} objects of campus" in lines[-1]
    assert sum("west/node/lidar" in one and "east/node/lidar" in one for one in lines) == OBJECTS


def looks(publisher: Publisher, frames: range, place: np.ndarray, vectors: np.ndarray) -> None:
    """Publish objects at places (F, N, 2) with the vectors of a model."""
    rng = np.random.default_rng(frames.start)
    for frame, centre in zip(frames, place, strict=True):
        count = len(centre)
        publisher.publish(
            stamp_ns=BEGIN_NS + frame * 100_000_000,
            labels=("pedestrian",),
            label=np.zeros(count, np.int64),
            center=np.column_stack((centre, np.ones(count))),
            size=np.tile((0.6, 0.6, 1.7), (count, 1)),
            yaw=np.zeros(count),
            score=np.full(count, 0.9),
            embedding=(vectors[:count] + 0.1 * rng.standard_normal((count, vectors.shape[1]))).astype(np.float32),
            embedding_model="reid",
        )


def test_vectors(services: ServiceProcess, settings: Path) -> None:
    """People who change places out of sight are linked by vectors, whose distances overlapping views have taught."""
    of_sites(settings, "left", "right")
    more = (
        'embedding_model = "reid"\nmin_probability = 0.8\npassages = [{from = "*/*/*", to = "left/*/*", s = [4, 20]}]\n'
    )
    settings.write_text(settings.read_text().replace("[links.campus.frames]", f"{more}[links.campus.frames]"))
    vectors = np.random.default_rng(1).standard_normal((OBJECTS, 32))
    still = np.column_stack((np.zeros(OBJECTS), 6.0 * np.arange(OBJECTS)))
    elsewhere = still[None] + (12.0, 3.0)
    with Connection(services.endpoint) as connection, link(services, settings) as process:
        process.wait_ready()
        west, east = (Publisher(one, frame="world", connection=connection) for one in PEOPLE)
        for frame in range(400):
            for publisher, place in ((west, still), (east, (100.0, 0.0) - still)):
                looks(publisher, range(frame, frame + 1), place[None], vectors)
            time.sleep(0.01)
        for frame in range(400, 700):  # west sees no object any more, then all of them elsewhere, in another order
            order = vectors[::-1] if frame >= 480 else vectors
            looks(west, range(frame, frame + 1), elsewhere if frame >= 480 else still[None, :0], order)
            looks(east, range(frame, frame + 1), still[None, :0], vectors)
            time.sleep(0.01)
        ends, found = time.monotonic() + PATIENCE_S, []
        while len(found) < OBJECTS // 2 and time.monotonic() < ends:
            found = [one for one in links_of(connection, "campus").objects if one.kind == "appearance"]
            time.sleep(0.1)
        for publisher in (west, east):
            publisher.close()
        assert process.end()[0] == 0
    assert len({one.global_id for one in found}) >= OBJECTS // 2


def test_hostile_tracks(services: ServiceProcess, settings: Path) -> None:
    """Bytes that are no tracks, and tracks of another stream, are counted and reported; others are linked."""
    key = Keys().tracks("west/node/odd")
    with Connection(services.endpoint) as connection, link(services, settings) as process:
        process.wait_ready()
        sender = connection.plain_sender(key, encoding_of(Tracks))
        for payload in (encode(tracks_message("west/node/other", 0)), b"\xff" * 100):
            sender.put(payload)
        process.wait_log("malformed")
        process.wait_log("west/node/other")
        assert process.end()[0] == 0


def test_whole_state(services: ServiceProcess, settings: Path) -> None:
    """The whole state of an area is published when the process starts."""
    with Connection(services.endpoint) as connection, link(services, settings) as process:
        process.wait_ready()
        ends = time.monotonic() + PATIENCE_S
        answers: tuple[object, ...] = ()
        while not answers and time.monotonic() < ends:
            answers = connection.query(Keys().links_query("campus"))
        message = decode(answers[0].payload, Links, encoding=answers[0].encoding)  # type: ignore[attr-defined]
        assert (message.area, message.whole) == ("campus", True)
        assert process.end()[0] == 0

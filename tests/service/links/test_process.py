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
from optipmb_client import Connection, Publisher, Subscriber, linked_objects
from optipmb_client.errors import ServiceUnavailable
from optipmb_client.grpc import GrpcConnection
from optipmb_schemas import Keys, Links, Tracks, decode, encode, encoding_of
from optipmb_tools.cli import run
from optipmb_tools.run.service_process import free_port
from service_process import ServiceProcess
from tracks_message import tracks_message

STREAMS = ("west/node/lidar", "east/node/lidar")
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


def link(services: ServiceProcess, settings: Path) -> ServiceProcess:
    return ServiceProcess(
        "link",
        "--settings",
        str(settings),
        "--connect",
        services.endpoint,
        listen=False,
        environment={"OPTIPMB_STORE": str(settings.parent)},
    )


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
                read = [one["global_id"] for frame in json.load(answer) for one in frame["objects"]]
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

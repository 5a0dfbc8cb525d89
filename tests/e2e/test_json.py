"""JSON of a real service: the same texts over HTTP, WebSocket and MQTT, and a page of another origin draws them."""

import asyncio
import contextlib
import itertools
import json
import queue
import re
import shlex
import shutil
import subprocess
import threading
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from broker import Broker, mosquitto
from browser import browser, console, wait
from optipmb_schemas.json_form import Selection, tracks_json
from readers import received
from readers import texts as events_of
from router import Node, Sensor
from service_process import ServiceProcess
from watched import plain
from websocket import create_connection

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "examples/json/index.html"
JSON_PAGE = REPOSITORY / "docs/json.md"
SENSOR = Sensor()
FRAMES = 30
CONFIRMED = Selection(confirmed=True)
ZONES = """
[zones.all]
streams = ["*/*/*"]
polygon = [[-500, -500], [500, -500], [500, 500], [-500, 500]]
min_s = 0
"""


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceProcess]:
    file = tmp_path / "zones.toml"
    file.write_text(ZONES)
    options = ("--http", "127.0.0.1:0", "--log-format", "json", "--settings", str(file))
    with ServiceProcess(*options, environment={"OPTIPMB_HTTP_ORIGINS": "null", "OPTIPMB_REWIND_S": "0"}) as process:
        process.wait_ready()
        yield process


def address_of(service: ServiceProcess) -> str:
    return str(re.findall(r'"http", .*?"address": "([^"]+)"|"address": "([^"]+)"', service.errors)[0][1])


def read(address: str, count: int, lines: queue.SimpleQueue[bytes]) -> None:
    """Put the first line of an answer and the texts that follow."""
    with urllib.request.urlopen(f"http://{address}/api/v1/stream?stream={SENSOR.stream}", timeout=60) as response:
        lines.put(response.readline())
        for text in itertools.islice(events_of(response), count):
            lines.put(plain(text))


def frames(service: ServiceProcess, address: str) -> tuple[list[bytes], list[bytes]]:
    """Publish each frame when all readers have the one before, and compare; return the texts of tracks and of events.

    Readers get only the newest waiting frame.
    """
    base, query = f"http://{address}/api/v1", f"stream={SENSOR.stream}&topics=tracks,events&events=now"
    socket = create_connection(f"ws://{address}/api/v1/ws?{query}", timeout=60, suppress_origin=True)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with contextlib.closing(socket), Node(service.endpoint) as node, ThreadPoolExecutor(1) as pool:
        reading = pool.submit(read, address, FRAMES, lines)
        assert lines.get(timeout=60) == b": hello\n"
        expected: list[bytes] = []
        texts: list[bytes] = []
        for seq in range(FRAMES):
            node.send(SENSOR.detections(seq))
            expected.append(tracks_json(node.tracks(SENSOR.stream, seq + 1)[-1], CONFIRMED))
            while len(of(texts, "tracks")) <= seq:
                texts.append(plain(received(socket)))
            assert lines.get(timeout=60) == expected[-1]
        reading.result(60)
        assert of(texts, "tracks") == expected
        assert plain(get(f"{base}/tracks?stream=*/*/*")) == b"[%b]" % expected[-1]
        assert [one["stream"] for one in json.loads(get(f"{base}/streams"))] == [SENSOR.stream]
        assert json.loads(get(f"{base}/zones?stream=*/*/*"))[0]["zones"]["all"]
    return expected, of(texts, "event")


def get(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=60) as response:  # noqa: S310 - of the service
        return bytes(response.read())


def of(texts: list[bytes], kind: str) -> list[bytes]:
    return [text for text in texts if json.loads(text)["type"] == kind]


async def test_every_edge_gives_the_text_of_the_published_tracks(service: ServiceProcess) -> None:
    """Tracks, events and counts by WebSocket and MQTT, tracks as server-sent events, the newest by GET."""
    address = address_of(service)
    async with Broker() as broker:
        options = ("mqtt", "--connect", service.endpoint, "--broker", f"mqtt://127.0.0.1:{broker.port}")
        environment = {"OPTIPMB_MQTT__TRACKS_HZ": "0"}
        with ServiceProcess(*options, listen=False, environment=environment) as bridge:
            assert (await asyncio.to_thread(bridge.wait_ready)).startswith("ready mqtt=mqtt://127.0.0.1:")
            await broker.wait(1, "/alive")

            expected, happened = await asyncio.to_thread(frames, service, address)
            assert happened
            assert set(map(plain, await broker.wait(1, "/tracks"))) <= set(expected), "a slow bridge leaves frames out"
            assert set(broker.of("/events")) <= set(happened)
            assert await broker.wait(1, "/zones")
            status, _ = await asyncio.to_thread(bridge.end)
            assert status == 0
        assert await broker.wait(2, "/alive") == [b"1", b"0"]


@pytest.mark.skipif(shutil.which("mosquitto_pub") is None, reason="mosquitto-clients are not installed")
def test_a_car_drives_through_a_zone_by_curl_and_mosquitto_pub_alone(tmp_path: Path) -> None:
    """The commands of the page, at the speed of this machine: both streams have the events, and no log has an error."""
    section = JSON_PAGE.read_text().partition("### A car through a zone\n")[2].partition("\n#")[0]
    _, programs = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    starting, bridging, reading, driving = programs.splitlines()
    senders = (REPOSITORY / driving.split()[1]).read_text()
    senders = senders.replace("sleep 0.1", ":").replace("$(date +%s%N)", "$((1795766400000000000 + x * 100000000))")
    settings = ("--settings", str(REPOSITORY / starting.split()[2]))
    assert starting.split()[3:] == ["--http", "127.0.0.1:8080"]
    assert bridging.split()[:4] == ["optipmb-service", "mqtt", *starting.split()[1:3]]
    with (
        mosquitto(tmp_path) as broker,
        ServiceProcess(*settings, "--http", "127.0.0.1:0", "--log-format", "json") as service,
    ):
        port = broker.rpartition(":")[2]
        service.wait_ready()
        options = ("mqtt", *settings, "--connect", service.endpoint, "--broker", broker)
        reader = [*shlex.split(reading), "-t", "optipmb/v1/mqtt/+/alive", "-p", port, "-C", "5", "-W", "60"]
        with ServiceProcess(*options, listen=False) as bridge:
            bridge.wait_ready()
            with subprocess.Popen(reader, stdout=subprocess.PIPE, text=True) as events:
                assert events.stdout is not None
                assert events.stdout.readline() == "1\n", "the retained topic says that it has subscribed"
                senders = senders.replace("127.0.0.1:8080", address_of(service)).replace("_pub", f"_pub -p {port}")
                subprocess.run(["bash", "-ec", senders], cwd=tmp_path, check=True, timeout=120)  # noqa: S607 - found by its name
                found = [json.loads(line) for line in events.stdout]
            assert "internal_error" not in bridge.errors
    happened = {(one["stream"], one["kind"], one["how"], one["n"]) for one in found}
    streams = ("garage/gate/radar", "garage/gate/lidar")
    assert happened == {(stream, kind, "crossed", 1) for stream in streams for kind in ("entered", "left")}


def test_the_example_page_draws_tracks(service: ServiceProcess, tmp_path: Path) -> None:
    """Opened from a file, an origin in the settings, it shows the tracks; its console stays empty."""
    over = threading.Event()

    def publish() -> None:
        with Node(service.endpoint) as node:
            for seq in range(10_000):
                if over.wait(0.05):
                    return
                one = SENSOR.detections(min(seq, 40))  # then they wait within the picture, however late the browser
                velocity = one.velocity if seq < 40 else np.zeros((len(one.center), 2))
                node.send(SENSOR.detections(seq, center=one.center, velocity=velocity))

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        with browser(tmp_path) as chrome:
            chrome.get(f"file://{PAGE}?host={address_of(service)}")
            wait(chrome, "/^[1-9][0-9]* tracks$/.test(document.title)")
            wait(chrome, "document.querySelector('p').textContent.includes('entered all')")
            drawn = "context.getImageData(0, 0, canvas.width, canvas.height).data.some(value => value > 0)"
            wait(chrome, drawn)
            assert console(chrome) == []
    finally:
        over.set()
        thread.join(60)

"""The page of a real service, seen by a real browser while detections come in."""

import contextlib
import hashlib
import itertools
import json
import math
import re
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import browser, console, requested, size, wait
from optipmb_client import Publisher
from optipmb_schemas import ServiceStatus, SessionSummary
from optipmb_service.edges.http import api
from processes import descendants, wait_until_ended
from proxy import Proxy
from readers import texts
from routers import free_endpoint
from selenium.webdriver import Chrome
from service_process import ServiceProcess
from watched import PROBLEM, STREAM, Watched, served, tracks

ENDPOINT, HTTP = free_endpoint(), free_endpoint().removeprefix("tcp/")
BASE = f"http://{HTTP}"
CARS, WALKERS = "yard/gate/lidar", "yard/hall/lidar"
DEADLINE_S = 60.0


def service(*options: str) -> ServiceProcess:
    return ServiceProcess("--listen", ENDPOINT, "--http", HTTP, "--profile", "nuscenes", *options, listen=False)


@contextlib.contextmanager
def publishing(stream: str, label: str, length: float) -> Iterator[None]:
    """Publish three objects that go in circles around a sensor, ten times a second."""
    over = threading.Event()

    def run() -> None:
        with Publisher(stream, ENDPOINT, frame="sensor", timeout=60) as publisher:
            while not over.wait(0.1):
                now = time.monotonic() % 1000
                angles = [0.3 * now + part for part in (0.0, 2.0, 4.0)]
                publisher.publish(
                    stamp_ns=time.time_ns(),
                    label=[label] * 3,
                    center=[[12 * math.cos(angle), 12 * math.sin(angle), 0.0] for angle in angles],
                    size=[[length, 1.0, 1.6]] * 3,
                    yaw=[(angle + math.pi / 2) % (2.0 * math.pi) for angle in angles],
                    velocity=[[-3.6 * math.sin(angle), 3.6 * math.cos(angle)] for angle in angles],
                    score=[0.9] * 3,
                    pose=([100.0, 50.0, 0.0], [1.0, 0.0, 0.0, 0.0]),
                )

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(60)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    with browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def chrome(shared: Chrome) -> Chrome:
    """The browser, without the page, size and messages of an earlier test."""
    shared.get("about:blank")
    size(shared, 1280, 800)
    console(shared)
    requested(shared)
    return shared


def test_the_page_shows_live_tracks_and_survives_a_restart(chrome: Chrome, tmp_path: Path) -> None:
    """It is a page for one who looks.

    Live tracks of the chosen stream, drawn where they are; figures at a tap; nothing in the
    console, nothing from elsewhere; after a restart of the service it goes on by itself.
    """
    with service() as first:
        first.wait_ready()
        with publishing(CARS, "car", 4.0):
            chrome.get(BASE)
            wait(chrome, f"chosen === '{CARS}'")  # the first that it sees
            with publishing(WALKERS, "pedestrian", 1.0):
                wait(chrome, "at('streams').rows.length === 2 && frame !== null && frame.tracks.length === 3")
                wait(chrome, "at('state').textContent === 'ready'")
                assert chrome.execute_script("return chosen") == CARS
                chrome.execute_script(
                    f"[...document.querySelectorAll('td button')].find(b => b.textContent === '{WALKERS}').click()"
                )
                wait(
                    chrome,
                    "frame !== null && frame.tracks.length === 3"
                    " && frame.labels[frame.tracks[0][LABEL]] === 'pedestrian'",
                )
                assert "yard%2Fhall%2Flidar" in chrome.current_url
                shown_moving(chrome)
                figures(chrome)
                assert console(chrome) == []
                urls = requested(chrome)
                assert f"{BASE}/look.js" in urls
                assert {url for url in urls if not url.startswith((BASE, "data:"))} == set()
                before = chrome.execute_script("return frame.time")
                assert first.end()[0] == 0
                wait(chrome, "at('state').textContent === 'no answer'")
                with service() as second:
                    second.wait_ready()
                    wait(chrome, f"at('state').textContent === 'ready' && frame.time > {before} + 1")
                    assert chrome.execute_script("return chosen") == WALKERS
                    shown_moving(chrome)
                    restarts = ("net::ERR_", "status of 503")  # of a service that is gone, and of one that ends
                    refused = [line for line in console(chrome) if not any(one in line for one in restarts)]
                    assert refused == []
                    phone(chrome)


def shown_moving(chrome: Chrome) -> None:
    """The first track has the colour of its id where it is, and is somewhere else a second later."""
    wait(chrome, "!dirty && trails.get(frame.tracks[0][ID]).length > 5")
    (r, g, b, alpha), name = chrome.execute_script(
        "const t = frame.tracks[0]; dirty = true; draw(); const [x, y] = toScreen(t[X], t[Y]);"
        "const copy = new OffscreenCanvas(1, 1).getContext('2d', {willReadFrequently: true});"
        "copy.drawImage(canvas, -x, -y); return [[...copy.getImageData(0, 0, 1, 1).data], colour(t[ID])]"
    )
    want = bytes.fromhex(name.removeprefix("#"))
    assert alpha > 128
    assert max(abs(a - w) for a, w in zip((r, g, b), want, strict=True)) < 140
    assert (r, g, b) != (255, 255, 255)
    x, y = chrome.execute_script("return [frame.tracks[0][X], frame.tracks[0][Y]]")
    assert math.hypot(x - 100, y - 50) == pytest.approx(12, abs=1.5)
    wait(chrome, f"Math.hypot(frame.tracks[0][X] - {x}, frame.tracks[0][Y] - {y}) > 1")


def figures(chrome: Chrome) -> None:
    """A tap on a track shows its existence and score; a tap elsewhere hides them."""
    for place, hidden in (("toScreen(frame.tracks[1][X], frame.tracks[1][Y])", False), ("[60, 20]", True)):
        chrome.execute_script(
            f"const [x, y] = {place}, box = canvas.getBoundingClientRect();"
            "for (const kind of ['pointerdown', 'pointerup']) canvas.dispatchEvent(new PointerEvent(kind,"
            "{clientX: box.x + x, clientY: box.y + y, pointerId: 1}))"
        )
        wait(chrome, f"at('details').hidden === {str(hidden).lower()}")
        if not hidden:
            text = chrome.execute_script("return at('details').innerText")
            assert "existence" in text
            assert "score" in text


def phone(chrome: Chrome) -> None:
    """On a narrow screen nothing is wider than it, and the tracks are still drawn."""
    size(chrome, 390, 844)
    chrome.refresh()
    wait(chrome, "frame !== null && frame.tracks.length === 3 && canvas.width === 390")
    assert chrome.execute_script("return document.documentElement.scrollWidth") <= 390
    assert chrome.execute_script("return canvas.clientHeight") > 300
    shown_moving(chrome)


ZONES = """
[zones.yard]
streams = ["yard/*/*"]
polygon = [[85, 35], [115, 35], [115, 65], [85, 65]]
min_s = 0
[zones.gate]
streams = ["yard/*/*"]
line = [[100, 55], [100, 68]]
"""


def test_the_page_takes_a_token_and_shows_zones(chrome: Chrome, tmp_path: Path) -> None:
    """Without the token it asks for it, and shows nothing; in the dark it is dark; after the last frame it says so."""
    (tmp_path / "zones.toml").write_text(ZONES)
    (tmp_path / "tokens.json").write_text(json.dumps({hashlib.sha256(b"secret").hexdigest(): "viewer/map"}))
    environment = {"OPTIPMB_HTTP_TOKENS": str(tmp_path / "tokens.json")}
    options = ("--listen", ENDPOINT, "--http", HTTP, "--settings", str(tmp_path / "zones.toml"))
    with ServiceProcess(*options, listen=False, environment=environment) as process:
        process.wait_ready()
        with publishing(CARS, "car", 4.0):
            chrome.get("about:blank")
            chrome.get(BASE)
            wait(chrome, "at('state').textContent === 'token needed' && !at('token').hidden")
            assert chrome.execute_script("return [frame, at('none').hidden]") == [None, True]
            chrome.find_element("id", "secret").send_keys("secret\n")
            wait(chrome, "at('state').textContent === 'ready' && at('token').hidden")
            wait(chrome, "at('zones').rows.length === 2 && at('events').children.length > 2")
            wait(chrome, "at('zones').rows[1].cells[2].textContent !== '0'")
            cells = chrome.execute_script("return [...at('zones').rows[1].cells].map((cell) => cell.textContent)")
            assert cells[0] == "yard"
            assert cells[2] == cells[3]  # entered, distinct
            wait(chrome, "at('streams').rows[0].cells[5].textContent === 'now'")
            dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
            for features, is_dark in ((dark, True), ({"features": []}, False)):
                chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", features)
                wait(chrome, f"(parseInt(ink.ground.trim().slice(1, 3), 16) < 64) === {str(is_dark).lower()}")
        wait(chrome, "at('caption').textContent.includes('no frame for')")
        wait(chrome, "at('streams').rows[0].cells[5].textContent.endsWith('s ago')")


class Sessions(Watched):
    """A service with so many sessions and one problem."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def status(self) -> ServiceStatus | None:
        status = super().status()
        about = {"session": "0" * 32, "state": "tracking", "profile": "kitti", "tracks": 1, "frames": 1, "age_s": 0.1}
        figures = dict.fromkeys(("rate_hz", "latency_p50_ms", "latency_p99_ms", "late", "missing"), 0)
        sessions = tuple(SessionSummary(stream=f"yard/gate/{n:04}", **about, **figures) for n in range(self.count))
        problem = PROBLEM.model_copy(update={"reported_ns": time.time_ns()})
        return status and status.model_copy(update={"sessions": sessions, "problems": (problem,)})


def see(chrome: Chrome, address: str, name: str) -> None:
    chrome.get("about:blank")
    chrome.get(f"http://{address}/#{name}")
    wait(chrome, "at('state').textContent === 'ready'")


def publish(chrome: Chrome, watched: Watched, seq: int) -> None:
    """Publish a frame when somebody looks, and wait until the page has taken it."""
    assert watched.network is not None
    watched.network.wait(2)
    before = chrome.execute_script("return came")
    watched.network.publish(tracks(seq))
    wait(chrome, f"came !== {before}")


@pytest.mark.parametrize("name", ["100%", "gate"])
def test_a_stream_that_cannot_be_shown_is_refused_on_the_page(chrome: Chrome, name: str) -> None:
    """An address with a name that is none: the page says why it has no tracks, and works."""
    with served(Sessions(1)) as address:
        see(chrome, address, name)
        wait(chrome, "at('caption').textContent.includes('expected a stream as site/node/sensor')")
        chrome.execute_script("at('streams').rows[0].cells[0].firstChild.click()")
        wait(chrome, "at('caption').textContent === 'yard/gate/0000: waiting for tracks'")


def test_tracks_of_a_service_that_has_gone_are_shown_as_old(chrome: Chrome) -> None:
    """While the page tries to connect again, it says since when there is no frame."""
    watched = Watched()
    with served(watched) as address:
        see(chrome, address, STREAM)
        publish(chrome, watched, 1)
    wait(chrome, "at('state').textContent === 'no answer'")
    wait(chrome, "at('caption').textContent.includes('no frame for')")


def test_the_page_leaves_a_connection_that_is_lost_without_an_end(
    chrome: Chrome, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cable that is pulled and a gateway that forgets: the page says that there is no answer, and connects again."""
    monkeypatch.setattr(api, "KEEP_ALIVE_S", 0.05)
    faster = (
        "const now = performance.now.bind(performance), timeout = AbortSignal.timeout.bind(AbortSignal);"
        "performance.now = () => 20 * now(); AbortSignal.timeout = (ms) => timeout(ms / 20)"
    )
    script = chrome.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": faster})
    watched = Watched()
    with served(watched) as address, Proxy(address) as proxy:
        see(chrome, proxy.address, STREAM)
        publish(chrome, watched, 1)
        proxy.cut()
        wait(chrome, "at('state').textContent === 'no answer'")
        proxy.strand()
        proxy.mend()
        before = chrome.execute_script("return came")
        for seq in itertools.count(2):
            assert watched.network is not None
            watched.network.publish(tracks(seq))
            if chrome.execute_script(f"return came !== {before}"):
                break
        wait(chrome, "at('state').textContent.startsWith('ready')")
        chrome.get("about:blank")
    chrome.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


def test_a_late_frame_does_not_end_the_paths(chrome: Chrome) -> None:
    """Corrected tracks of earlier frames of the session are not drawn; another session starts with empty paths."""
    watched = Watched()
    with served(watched) as address:
        see(chrome, address, STREAM)
        for seq in (5, 3, 6):
            publish(chrome, watched, seq)
        assert chrome.execute_script("return trails.get(0).map((point) => Math.round(10 * (point[2] - 1.8e9)))") == [
            5,
            6,
        ]


def test_the_list_of_streams_stays_and_is_bounded(chrome: Chrome) -> None:
    """Its buttons stay where they are, so that they can be pressed; of 1,001 streams 1,000 are there, and a hint.

    The age of a problem goes by the clock of the service.
    """
    watched = Sessions(3)
    with served(watched) as address:
        see(chrome, address, "")
        wait(chrome, "at('streams').rows.length === 3")
        chrome.execute_script(
            "window.row = at('streams').rows[1]; row.cells[0].firstChild.focus(); row.cells[2].textContent = 'before'"
        )
        wait(chrome, "row.cells[2].textContent === '0.0' && row.isConnected")
        assert chrome.execute_script("return document.activeElement === row.cells[0].firstChild && at('more').hidden")
        chrome.execute_script("Date.now = () => 0; row.remove()")
        watched.count = 1001
        wait(chrome, "at('streams').rows.length === 1000 && at('more').textContent.startsWith('and 1 more')")
        assert re.fullmatch(
            "just now|[0-9]+ s ago", chrome.execute_script("return at('problems').querySelector('time').textContent")
        )


def test_streams_of_workers_are_shown_and_workers_end_with_their_parent() -> None:
    """With several processes the page of the whole gets the tracks of whichever worker has the stream.

    And kill -9 of the parent, without any notice, leaves no worker behind.
    """
    with service("--workers", "2") as whole:
        whole.wait_ready()
        with publishing(CARS, "car", 4.0), publishing(WALKERS, "pedestrian", 1.0):
            for stream, label in ((CARS, "car"), (WALKERS, "pedestrian")):
                address = f"{BASE}/live?stream={stream}"
                with urllib.request.urlopen(address, timeout=DEADLINE_S) as events:  # noqa: S310 - our own
                    frame = json.loads(next(texts(events)))
                assert frame["labels"][frame["tracks"][0][1]] == label
            children = descendants(whole.process.pid)
            assert len(children) == 2
            whole.process.kill()
            assert wait_until_ended(children, DEADLINE_S) == set()

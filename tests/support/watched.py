"""A service that a test speaks for, and its HTTP server: readers of its session get what the test publishes."""

import contextlib
import fnmatch
import http.client
import re
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from optipmb_client.incoming import Answer, Arrival
from optipmb_schemas import (
    Delivery,
    Events,
    Keys,
    LinkedObject,
    Links,
    Message,
    Problem,
    ServiceStatus,
    Tracks,
    ZoneCount,
    ZoneEvent,
    encode,
    encoding_of,
)
from optipmb_service.edges.http import Server, application
from optipmb_service.edges.readers import Publication
from optipmb_service.settings import Settings

KEYS = Keys()
STREAM = "garage/rig/lidar"
DEADLINE_S = 60.0


class Session:
    """The session of the service: subscriptions by key, and caches."""

    keys = KEYS

    def __init__(self) -> None:
        self.subscriptions: list[tuple[str, Callable[[Message], None]]] = []
        self.cache: list[tuple[str, Message]] = []
        self.instances: list[str] = ["one"]
        self.statuses: list[Message] = []
        self.problems: list[Problem] = []
        self.links: list[Links] = []  # answers of `q/links`
        self.linking: Callable[[Message], None] = lambda _: None
        self.counted: list[Events] = []  # answers of `q/zones`; without zones: an error
        self.gate = threading.Event()
        self.gate.set()
        self.arrived: Callable[[], object] = lambda: None
        self._changed = threading.Condition()

    def _add(self, key: str, receive: Callable[[Message], None]) -> Any:
        self.arrived()
        assert self.gate.wait(DEADLINE_S)
        entry = (key, receive)
        with self._changed:
            self.subscriptions.append(entry)
            self._changed.notify_all()

        def close() -> None:
            with self._changed:
                self.subscriptions.remove(entry)
                self._changed.notify_all()

        return SimpleNamespace(close=close)

    def subscribe(self, key: str, receive: Callable[[Any], object], *, history: bool) -> Any:
        assert history

        def put(message: Message) -> None:
            receive(Arrival(key_of(message), encode(message), encoding_of(message), time.monotonic_ns()))

        return self._add(key, put)

    def read_newest(self, key: str, receive: Callable[[Any], None], *, most: int) -> Any:
        assert most > 0

        def put(message: Message) -> None:
            payload = SimpleNamespace(to_bytes=lambda: encode(message))
            receive(SimpleNamespace(key_expr=key_of(message), payload=payload, encoding=encoding_of(message)))

        if key == KEYS.all_links():
            self.linking = put
            return SimpleNamespace(close=lambda: None)
        return self._add(key, put)

    def query(self, selector: str, *, timeout: float = 2.0) -> list[Answer]:
        assert timeout
        if selector.endswith("/q/zones"):
            stream = selector.removesuffix("/q/zones").removeprefix(f"{KEYS.prefix}/")
            answers = [one for one in self.counted if one.stream == stream]
            return [Answer(selector, encode(one), encoding_of(one), ok=one.zones is not None) for one in answers]
        if selector == KEYS.all_links_query():
            return [Answer(selector, encode(one), encoding_of(one), ok=True) for one in self.links]
        if selector == KEYS.all_status():
            return [Answer("status", encode(one), encoding_of(one), ok=True) for one in self.statuses]
        key, _, parameters = selector.partition("/@adv/**")
        assert parameters.startswith("?_max=")
        found = [(at, one) for at, one in self.cache if fnmatch.fnmatchcase(at, key)]
        return [Answer(at, encode(one), encoding_of(one), ok=True) for at, one in found]

    def alive(self, pattern: str, *, timeout: float = 2.0) -> list[str]:
        assert pattern == KEYS.all_alive()
        assert timeout
        return [KEYS.alive(one) for one in self.instances]

    def publish_problem(self, problem: Problem) -> None:
        self.problems.append(problem)

    def linked(self) -> bool:
        return True

    def wait(self, count: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.subscriptions) == count, DEADLINE_S), self.subscriptions

    def publish(self, *messages: Message) -> None:
        for message in messages:
            if isinstance(message, Links):
                self.linking(message)
                continue
            for key, put in tuple(self.subscriptions):
                if fnmatch.fnmatchcase(key_of(message), key):
                    put(message)


def key_of(message: Any) -> str:
    if isinstance(message, Links):
        return KEYS.links(message.area)
    topics = {"Tracks": "tracks", "Events": "events", "Detections": "detections", "Problem": "problems"}
    topic = "now" if getattr(message, "predicted_to_ns", None) is not None else topics[type(message).__name__]
    return f"{KEYS.prefix}/{message.stream}/{topic}"


class Watched:
    def __init__(self) -> None:
        self.network: Session | None = Session()
        self.now = "ready"
        self.why = ""
        self.age_s = 0.1
        self.metrics: Any = SimpleNamespace(text=lambda: b"one 1\n")

    def state(self) -> str:
        return self.now

    def failure(self) -> str:
        return self.why

    def beat_age_s(self) -> float:
        return self.age_s

    def alive(self) -> bool:
        return self.age_s < 10

    def ready(self) -> bool:
        return self.now == "ready"

    def status(self) -> ServiceStatus | None:
        if self.now == "starting":
            return None
        return ServiceStatus(instance="one", version="1", started_ns=0, uptime_s=1.0, state=self.now)

    def session(self) -> Any:
        return self.network

    def detections_of(self, stream: str) -> str:
        return stream


@contextlib.contextmanager
def served(source: Any, places: Any = None, **settings: Any) -> Iterator[str]:
    given = Settings(**settings)
    server = Server(application(source, given, places), "127.0.0.1:0", given.limits.max_json_bytes)
    try:
        yield server.address
    finally:
        server.close()


def tracks(seq: int, stream: str = STREAM, run: int = 0, count: int = 2) -> Tracks:
    one = np.ones(count)
    return Tracks(
        stream=stream,
        epoch=bytes(16),
        seq=seq,
        stamp_ns=1_800_000_000 * 10**9 + seq * 10**8,
        session="0" * 32,
        profile="kitti",
        cloud_used=False,
        labels=["car", "pedestrian"],
        id=np.arange(count),
        label=np.arange(count) % 2,
        center=np.arange(3 * count).reshape(count, 3) / 7,
        size=np.ones((count, 3)),
        yaw=one / 3,
        velocity=np.ones((count, 2)),
        yaw_rate=one,
        acceleration=one,
        existence=one / 3,
        score=one,
        covariance=np.zeros((count, 6, 6)),
        age=one,
        time_since_detection=one,
        detection=np.arange(count),
        confirmed=(np.arange(count) == 0).astype(int),
        delivery=delivery(run, seq),
    )


def delivery(run: int, seq: int, final_ns: int | None = None) -> Delivery:
    times = dict.fromkeys(("queue_ms", "decode_ms", "step_ms"), 0.0)
    final = {} if final_ns is None else {"final_session": "0" * 32, "final_ns": final_ns}
    return Delivery(instance="one", received_ns=0, published_ns=seq, run=run, **times, **final)


def events(seq: int, count: int = 1, stream: str = STREAM, final_ns: int | None = None, **changes: Any) -> Events:
    one = ZoneEvent(
        zone="gate",
        kind="crossed",
        n=1,
        id=7,
        label=0,
        at_ns=5,
        position=(1.0, 2.0, 3.0),
        speed=1.0,
        yaw=0.0,
        direction="left",
    )
    counts = {name: [1, 0] for name in ZoneCount.names if name != "zone"}
    return Events(
        stream=stream,
        epoch=bytes(16),
        seq=seq,
        stamp_ns=seq,
        session="0" * 32,
        labels=["car", "pedestrian"],
        events=[one.model_copy(update={"n": seq * 1000 + at}) for at in range(count)],
        zones=[ZoneCount(zone="gate", **counts)],
        delivery=delivery(0, seq, final_ns),
    ).model_copy(update=changes)


def settled(seq: int) -> Events:
    return events(seq, 0, final_ns=seq, zones=None)


PROBLEM = Problem(stream=STREAM, instance="one", code="late", message="Late.")


def publication(message: Message) -> Publication:
    return Publication(key_of(message), encode(message), encoding_of(message), {})


def links(*ids: tuple[str, int, str], area: str = "campus", whole: bool = True) -> Links:
    """Return links of tracks in sessions of zeros: stream, track and the first digit of its global id."""
    common = {"session": "0" * 32, "probability": 0.99, "kind": "overlap", "ended": False}
    rows = [
        LinkedObject(global_id=bytes.fromhex(digit * 32), stream=stream, object=number, **common)
        for stream, number, digit in ids
    ]
    return Links(area=area, revision=1, stamp_ns=0, whole=whole, objects=tuple(rows))


def plain(text: bytes | str) -> bytes:
    """Return a text without what depends on when it was sent: the age of its frame, the id of its event."""
    text = text.encode() if isinstance(text, str) else text
    return re.sub(rb',"frame_age_s":[0-9.]+,"stale":(true|false)|,"event_id":"[0-9a-f]+-[0-9]+"', b"", text)


@contextlib.contextmanager
def asked(address: str, path: str, method: str = "GET", **headers: str) -> Iterator[http.client.HTTPResponse]:
    """Ask for something; the answer's body is still to be read."""
    host, _, port = address.rpartition(":")
    with contextlib.closing(http.client.HTTPConnection(host, int(port), timeout=DEADLINE_S)) as connection:
        connection.request(method, path, headers={"connection": "close", **headers})
        with connection.getresponse() as response:
            yield response

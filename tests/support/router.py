"""A sensor's messages, and a node on a real Zenoh network that sends them and waits for answers.

Nothing here sleeps: a wait ends with a message, or fails at a deadline.
"""

import json
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

import numpy as np
import zenoh
import zenoh.ext
from optipmb_client.incoming import Arrival
from optipmb_client.zenoh.session import ZenohSession
from optipmb_schemas import (
    Detections,
    Keys,
    Message,
    MoveRequest,
    Points,
    Pose,
    Problem,
    Tracks,
    decode,
    encode,
    encoding_of,
)

SECOND = 1_000_000_000
DEADLINE_S = 60.0
PERIOD_S = 0.1

_T = TypeVar("_T", bound=Message)


@dataclass(frozen=True)
class Sensor:
    """Makes the messages of one stream: objects that drive along x, seen at 10 Hz in the world frame."""

    stream: str = "site/node/lidar"
    epoch: bytes = b"0123456789abcdef"
    objects: int = 3
    start_s: float = 10_000.0

    def stamp_ns(self, seq: int) -> int:
        return round((self.start_s + seq * PERIOD_S) * SECOND)

    def detections(self, seq: int, **changes: Any) -> Detections:
        """The frame `seq`; the same call gives the same message."""
        count = int(changes.pop("objects", self.objects))
        index = np.arange(count, dtype=np.float64)
        noise = np.random.default_rng(seq).normal(0, 0.05, (count, 3))
        fields: dict[str, Any] = {
            "stream": self.stream,
            "epoch": self.epoch,
            "seq": seq,
            "stamp_ns": self.stamp_ns(seq),
            "frame": "world",
            "labels": ("car", "pedestrian"),
            "label": np.zeros(count, np.int64),
            "center": np.stack([5 * seq * PERIOD_S + 0 * index, 12 * index, 1 + 0 * index], axis=1) + noise,
            "size": np.tile([4.5, 1.9, 1.6], (count, 1)),
            "yaw": np.zeros(count),
            "velocity": np.tile([5.0, 0.0], (count, 1)),
            "score": np.full(count, 0.8),
        }
        return Detections(**(fields | changes))

    def points(self, seq: int, count: int = 500, **changes: Any) -> Points:
        xyz = np.random.default_rng(seq).uniform(-30, 30, (count, 3)).astype(np.float32)
        fields: dict[str, Any] = {
            "stream": self.stream,
            "epoch": self.epoch,
            "seq": seq,
            "stamp_ns": self.stamp_ns(seq),
            "frame": "sensor",
            "pose": Pose(translation=np.array([5 * seq * PERIOD_S, 0, 0]), quaternion=np.array([1.0, 0, 0, 0])),
            "xyz": xyz,
        }
        return Points(**(fields | changes))


def plain(tracks: Tracks) -> bytes:
    """The bytes of tracks that must be the same in every run: all but how they were delivered."""
    return encode(tracks.model_copy(update={"delivery": None}))


@dataclass
class Collected:
    items: list[tuple[str, bytes, str]] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def add(self, key: str, payload: bytes, encoding: str) -> None:
        with self.changed:
            self.items.append((key, payload, encoding))
            self.times_ns.append(time.monotonic_ns())
            self.changed.notify_all()

    def wait(self, enough: Callable[[list[tuple[str, bytes, str]]], bool], what: str) -> None:
        with self.changed:
            if not self.changed.wait_for(lambda: enough(self.items), DEADLINE_S):
                raise AssertionError(f"{what} did not come within {DEADLINE_S:g} s; {len(self.items)} messages came")


class Node:
    """A publisher and subscriber as users write them; a client of the router at `endpoint`, perhaps with its own id."""

    def __init__(self, endpoint: str, keys: Keys | None = None, zid: str = "") -> None:
        self.keys = keys or Keys()
        self.session = zenoh.open(_configuration(endpoint, {"id": zid} if zid else {}))
        self._publishers: dict[str, Any] = {}
        self._closing: list[Callable[[], object]] = []
        self.tracks_seen = self._collect(self.keys.all("tracks"))
        self.problems_seen = self._collect(self.keys.all("problems"))
        self.alive(self.keys.all_owners())  # the answer comes after the router knows the subscriptions

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        for close in self._closing:
            close()
        self._publishers.clear()  # withdraws them; to undeclare them may stop the process for ten seconds
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped

    def send(self, *messages: Detections | Points) -> None:
        for message in messages:
            topic = "detections" if isinstance(message, Detections) else "points"
            key = getattr(self.keys, topic)(message.stream)
            self._publisher(key, type(message), cached=topic == "detections").put(encode(message))

    def send_plain(self, *messages: Detections) -> None:
        """Publish detections without caches and tokens: they are lost without a subscriber."""
        for message in messages:
            key = self.keys.detections(message.stream)
            self.session.put(key, encode(message), encoding=encoding_of(message), express=True)

    def send_raw(self, key: str, payload: bytes, encoding: str = "") -> None:
        self.session.put(key, payload, encoding=encoding or None)

    def query(
        self, key: str, message: Message | bytes | None = None, timeout: float = 5.0
    ) -> list[tuple[bool, str, bytes]]:
        """Ask everybody; returns for each reply whether it is no error, its key and its payload."""
        payload = encode(message) if isinstance(message, Message) else message
        encoding = encoding_of(message) if isinstance(message, Message) else None
        answers = []
        for reply in self.session.get(
            key,
            payload=payload,
            encoding=encoding,
            timeout=timeout,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        ):
            if (sample := reply.ok) is not None:
                answers.append((True, str(sample.key_expr), sample.payload.to_bytes()))
            elif (error := reply.err) is not None:
                answers.append((False, key, error.payload.to_bytes()))
        return answers

    def ask(self, key: str, expected: type[_T], message: Message | bytes | None = None) -> _T:
        answers = self.query(key, message)
        assert [ok for ok, _, _ in answers] == [True], answers
        return decode(answers[0][2], expected)

    def refused(self, key: str, message: Message | bytes | None = None) -> Problem:
        answers = self.query(key, message)
        assert [ok for ok, _, _ in answers] == [False], answers
        return decode(answers[0][2], Problem)

    def move(self, instance: str, stream: str, worker: int = 0) -> None:
        """Have a stream moved to a worker of an instance, asking until it is done."""
        request = MoveRequest(stream=stream, worker=worker)

        def moved() -> bool:
            return [ok for ok, _, _ in self.query(self.keys.move(instance), request, 30.0)] == [True]

        until(moved, f"{stream} is moved to worker {worker} of {instance}")

    def alive(self, pattern: str) -> list[str]:
        replies = self.session.liveliness().get(pattern, timeout=60.0)
        return sorted(str(sample.key_expr) for reply in replies if (sample := reply.ok) is not None)

    def watch_alive(self, pattern: str) -> Collected:
        """Collect the tokens that come (payload `b"+"`) and go (`b"-"`) under a pattern."""
        collected = Collected()
        subscriber = self.session.liveliness().declare_subscriber(
            pattern, zenoh.handlers.FifoChannel(1000), history=True
        )
        put = zenoh.SampleKind.PUT
        self._drain(
            subscriber, lambda sample: collected.add(str(sample.key_expr), b"+" if sample.kind == put else b"-", "")
        )
        return collected

    def tracks(self, stream: str, count: int) -> list[Tracks]:
        return self._wait(self.tracks_seen, self.keys.tracks(stream), count, Tracks)

    def problems(self, stream: str, count: int = 1) -> list[Problem]:
        return self._wait(self.problems_seen, self.keys.problems(stream), count, Problem)

    def problem(self, stream: str, code: str) -> Problem:
        key = self.keys.problems(stream)

        def found(items: Iterable[tuple[str, bytes, str]]) -> list[Problem]:
            problems = [decode(payload, Problem) for at, payload, _ in items if at == key]
            return [problem for problem in problems if problem.code == code]

        self.problems_seen.wait(lambda items: bool(found(items)), f"a problem {code} on {key}")
        return found(self.problems_seen.items)[-1]

    def _wait(self, collected: Collected, key: str, count: int, kind: type[_T]) -> list[_T]:
        collected.wait(lambda items: sum(at == key for at, _, _ in items) >= count, f"{count} messages on {key}")
        with collected.changed:
            return [decode(payload, kind) for at, payload, _ in collected.items if at == key]

    def _publisher(self, key: str, kind: type[Message], *, cached: bool) -> Any:
        if key not in self._publishers:
            if cached:
                self._publishers[key] = zenoh.ext.declare_advanced_publisher(
                    self.session,
                    key,
                    encoding=encoding_of(kind),
                    priority=zenoh.Priority.DATA_HIGH,
                    express=True,
                    cache=zenoh.ext.CacheConfig(1000),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.1, sporadic_heartbeat=None),
                    publisher_detection=True,
                )
            else:
                # A test's clouds must not be dropped by its own side when the machine is busy.
                self._publishers[key] = self.session.declare_publisher(
                    key,
                    encoding=encoding_of(kind),
                    priority=zenoh.Priority.DATA_LOW,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
        return self._publishers[key]

    def _collect(self, pattern: str) -> Collected:
        collected = Collected()

        def take(arrival: Arrival) -> None:
            collected.add(arrival.key, arrival.payload, arrival.encoding)

        self._closing.append(ZenohSession(self.session).subscribe(pattern, take).close)
        return collected

    def _drain(self, subscriber: Any, take: Callable[[Any], None]) -> None:
        self._closing.append(subscriber.undeclare)
        handler = subscriber.handler

        def loop() -> None:
            try:
                for sample in handler:
                    take(sample)
            except zenoh.ZError:  # closed and empty
                return

        threading.Thread(target=loop, daemon=True).start()


def _configuration(endpoint: str, more: dict[str, object]) -> zenoh.Config:
    """What publishers should set: without the waits messages are dropped on a busy machine."""
    waits = "transport/link/tx/queue/congestion_control/drop"
    values: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        f"{waits}/wait_before_drop": 1_000_000,
        f"{waits}/max_wait_before_drop_fragments": 1_000_000,
    }
    config = zenoh.Config()
    for key, value in (values | more).items():
        config.insert_json5(key, json.dumps(value))
    return config


def until(true: Callable[[], bool], what: str | Callable[[], str], deadline_s: float = DEADLINE_S) -> None:
    """Ask again and again, for what sends no message; fails at the deadline with the name of the condition."""
    ends = time.monotonic() + deadline_s
    pause = threading.Event()
    while not true():
        if time.monotonic() > ends:
            raise AssertionError(f"{what if isinstance(what, str) else what()} within {deadline_s:g} s")
        pause.wait(0.03)  # asking costs the processor that is waited for

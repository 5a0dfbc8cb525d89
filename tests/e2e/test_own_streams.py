"""Members receive their own streams: two services on two linked routers that share a folder, and what goes to each."""

import operator
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import pytest
from fleet import PROFILE, Fleet, RouterProcess
from optipmb_schemas import Detections, Points, ServiceStatus, SessionState, encode, encoding_of
from optipmb_service.cluster.leases import PARTITIONS
from optipmb_service.session.outputs import TrackedFrame
from optipmb_service.session.session import Session
from proxy import Proxy
from router import Node, Sensor, plain, until
from service_process import ServiceProcess
from takeovers import KEYS, check, distinct, expected

import optipmb

SENSORS = [Sensor(stream=f"site/node-{number}/lidar") for number in range(8)]
POINTS = 30_000
EXCESS = 0.02
ROUND_S = 5.0
"""After which a cloud that did not come is taken for lost."""


class Pair:
    """Two services, each behind a proxy that counts the bytes sent to it; a node at the first."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = ExitStack()
        self.services: dict[str, ServiceProcess] = {}
        self.proxies: dict[str, Proxy] = {}

    def __enter__(self) -> Self:
        fleet = self._context.enter_context(Fleet(self._folder, cloud_wait_s=5.0, lease_s=6.0))
        beyond = self._context.enter_context(RouterProcess(fleet.endpoint))
        self.node = self._context.enter_context(Node(fleet.endpoint))
        for instance, router in (("a", fleet.endpoint), ("b", beyond.endpoint)):
            proxy = self.proxies[instance] = self._context.enter_context(Proxy(router))
            self.services[instance] = fleet.service(instance, endpoint=proxy.endpoint)
        self.settle()
        return self

    def __exit__(self, *_: object) -> None:
        self._context.close()

    def settle(self) -> None:
        """Wait until each has half of the partitions, and one of them is the discoverer."""
        half = f"held={PARTITIONS // 2} "
        until(lambda: all(half in one.errors for one in self.services.values()), "each has half of the partitions")

    def owners(self) -> dict[str, str]:
        keys = self.node.alive(KEYS.all_owners())
        return {KEYS.stream_of(key): KEYS.instance_of(key) for key in keys}

    def figure(self, instance: str, name: str, topic: str) -> float:
        text = self.node.query(KEYS.metrics(instance))[0][2].decode()
        found = re.search(rf'^optipmb_{name}{{topic="{topic}"}} (\S+)$', text, re.MULTILINE)
        assert found, text
        return float(found[1])

    def frames(self, instance: str) -> int:
        return self.node.ask(KEYS.status(instance), ServiceStatus).frames


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with Pair(tmp_path) as one:
        yield one


def raw(node: Node, *messages: Detections | Points) -> None:
    """Publish without a publisher: no token, no cache, no number."""
    for message in messages:
        key = getattr(KEYS, "points" if hasattr(message, "xyz") else "detections")(message.stream)
        node.session.put(key, encode(message), encoding=encoding_of(message))


def with_clouds(sensor: Sensor, frames: int) -> dict[int, set[bytes]]:
    """The tracks of a session alone, each frame with its cloud."""
    session = Session(sensor.stream, optipmb.load_profile(PROFILE))
    outputs = []
    for seq in range(frames):
        outputs += session.on_points(sensor.points(seq), 0)
        outputs += session.on_detections(sensor.detections(seq, has_points=True), 0)
    tracked = [one.tracks for one in outputs if isinstance(one, TrackedFrame)]
    assert all(one.cloud_used for one in tracked)
    return {one.seq: {plain(one)} for one in tracked}


def clouds(pair: Pair, name: str) -> list[float]:
    return [pair.figure(instance, name, "points") for instance in "ab"]


def only_own(pair: Pair) -> bool:
    """Send a cloud on each stream; whether each service receives its own and no others.

    The first ones are lost: they come before it is known who needs them.
    """
    before, foreign = clouds(pair, "received_total"), clouds(pair, "foreign_total")
    pair.node.send(*(sensor.points(0) for sensor in SENSORS))
    owners = list(pair.owners().values())
    own = [count + owners.count(instance) for count, instance in zip(before, "ab", strict=True)]
    ends = time.monotonic() + ROUND_S
    while not all(map(operator.ge, clouds(pair, "received_total"), own)) and time.monotonic() < ends:
        time.sleep(0.05)  # asking costs the processor that is waited for
    return (clouds(pair, "received_total"), clouds(pair, "foreign_total")) == (own, foreign)


def test_a_member_receives_its_own_streams(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    """A member receives the bytes of its streams and 2 % more; of clouds of others nothing."""
    node = pair.node
    for instance, sensor in zip("ab", SENSORS, strict=False):
        node.move(instance, sensor.stream)  # each has some
    sizes = {"a": 0, "b": 0}
    node.send(*(sensor.detections(0) for sensor in SENSORS))
    until(lambda: pair.frames("a") + pair.frames("b") == len(SENSORS), "the first frames are tracked")
    until(lambda: only_own(pair), "who left a partition receives its streams no longer")
    received, foreign = clouds(pair, "received_total"), clouds(pair, "foreign_total")
    owners = pair.owners()
    before = {instance: proxy.delivered for instance, proxy in pair.proxies.items()}
    last = 31
    for seq in range(1, last):
        for sensor in SENSORS:
            cloud, frame = sensor.points(seq, POINTS), sensor.detections(seq, has_points=True)
            node.send(cloud, frame)
            sizes[owners[sensor.stream]] += len(encode(cloud)) + len(encode(frame))
    until(lambda: pair.frames("a") + pair.frames("b") == last * len(SENSORS), "all are tracked")
    excess = {one: (proxy.delivered - before[one]) / sizes[one] - 1.0 for one, proxy in pair.proxies.items()}
    with capsys.disabled():
        print(f"\nbeyond its own streams: {', '.join(f'{one} {more:.3%}' for one, more in excess.items())}")  # noqa: T201 - the figures
    assert max(excess.values()) < EXCESS
    assert clouds(pair, "foreign_total") == foreign
    sent = [(last - 1) * list(owners.values()).count(instance) for instance in "ab"]
    assert clouds(pair, "received_total") == list(map(operator.add, received, sent))


def test_a_publisher_without_a_token_is_tracked_from_its_first_frame(pair: Pair) -> None:
    """All frames are tracked for any owner of the partition, and after a kill -9 of the discoverer."""
    node = pair.node
    for seq in range(20):
        raw(node, *(sensor.detections(seq) for sensor in SENSORS))
        time.sleep(0.05)  # the rate of a sensor
    for sensor in SENSORS:
        tracks, _ = expected(20, sensor)
        until(lambda: len(distinct(node, sensor)) == 20, "all frames are tracked")  # noqa: B023 - called here
        assert distinct(node, sensor) == {seq: {one} for seq, one in enumerate(tracks)}
    tokens = node.alive(KEYS.all_discovered())
    assert {stream for token in tokens for stream in KEYS.discovered_streams(token)} == {
        sensor.stream for sensor in SENSORS
    }
    (discoverer,) = {KEYS.instance_of(token) for token in tokens}
    left = "ab".replace(discoverer, "")
    pair.services[discoverer].process.kill()
    for seq in range(20, 60):
        raw(node, *(sensor.detections(seq) for sensor in SENSORS))
        time.sleep(0.05)  # the rate of a sensor
    for sensor in SENSORS:
        check(node, 60, owner=left, sensor=sensor)
    until(lambda: {KEYS.instance_of(one) for one in node.alive(KEYS.all_discovered())} == {left}, "it discovers now")


def test_streams_that_move_lose_no_frame_and_no_cloud(pair: Pair) -> None:
    """Streams without a cache move from member to member while they come: tracks as of an undisturbed session."""
    node, sensors = pair.node, SENSORS[:2]
    node.move("a", sensors[0].stream)
    node.move("b", sensors[1].stream)
    for sensor in sensors:  # the first clouds may come before the member knows of the stream
        until(lambda: begins(node, sensor), f"{sensor.stream} has begun")  # noqa: B023 - called here
    ending = threading.Event()
    sent = 1

    def publish(some: Sequence[Sensor]) -> None:
        nonlocal sent
        while not ending.is_set():
            for sensor in some:
                raw(node, sensor.points(sent), sensor.detections(sent, has_points=True))
            sent += 1
            time.sleep(0.05)  # the rate of a sensor

    publishing = threading.Thread(target=publish, args=(sensors,), daemon=True)
    publishing.start()
    try:
        for turn in range(3):
            for number, sensor in enumerate(sensors):
                node.move("ba"[(turn + number) % 2], sensor.stream)
    finally:
        ending.set()
        publishing.join(60)
    for sensor in sensors:
        until(lambda: len(distinct(node, sensor)) == sent, f"{sent} frames are tracked")  # noqa: B023 - called here
        assert distinct(node, sensor) == with_clouds(sensor, sent)


def begins(node: Node, sensor: Sensor) -> bool:
    """Send the first cloud and frame until they were tracked together; whether they were."""
    raw(node, sensor.points(0), sensor.detections(0, has_points=True))
    return len(distinct(node, sensor)) == 1


def test_what_waits_in_a_session_moves_with_it(pair: Pair) -> None:
    """A frame that is held for its cloud, and a cloud before its frame, are there where the stream goes on."""
    node, sensor = pair.node, SENSORS[0]
    node.move("a", sensor.stream)
    until(lambda: begins(node, sensor), "it has begun")
    raw(node, sensor.detections(1, has_points=True))
    until(lambda: node.ask(KEYS.query(sensor.stream, "state"), SessionState).queue == 1, "the frame is held")
    node.move("b", sensor.stream)
    raw(node, sensor.points(1))
    until(lambda: len(distinct(node, sensor)) == 2, "it is tracked")
    before = pair.figure("b", "received_total", "points")
    raw(node, sensor.points(2))
    until(lambda: pair.figure("b", "received_total", "points") > before, "the cloud is there")
    node.move("a", sensor.stream)
    raw(node, sensor.detections(2, has_points=True))
    until(lambda: len(distinct(node, sensor)) == 3, "it is tracked, too")
    assert distinct(node, sensor) == with_clouds(sensor, 3)
    states = [node.ask(KEYS.status(instance), ServiceStatus) for instance in "ab"]
    assert sum(one.received for one in states) == sum(one.frames + one.duplicates for one in states)

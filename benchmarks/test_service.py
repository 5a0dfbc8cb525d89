"""How long a user waits for tracks: `pytest benchmarks/test_service.py -s`, in milliseconds from `put` to arrival.

A service process with its own router on this machine, sensors at 10 Hz with 40 objects each and no clouds, their frames
spread over the period as independent sensors' are. Time counts from just before `put` in the publisher to the arrival
of the tracks in a subscriber of the same process; encoding the frame is not in it. Throughput is in frames per
second, when a window of 8 is kept full, as a replay does.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest
from optipmb_schemas import Tracks, decode
from router import Node, Sensor
from service_process import ServiceProcess

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pytest_benchmark.fixture import BenchmarkFixture

OBJECTS = 40
PERIOD_S = 0.1
SETTLED = 20
FRAMES = 150
WINDOW = 8
ROUNDS = 5
ROUND = 100


@pytest.fixture(scope="module")
def node() -> Iterator[Node]:
    """A node beside a service in a process of its own."""
    with ServiceProcess("--instance", "benchmark") as service:
        service.wait_ready()
        with Node(service.endpoint) as one:
            yield one


def percentile(values: list[float], share: float) -> float:
    """The value that a share of all is not above."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


@pytest.mark.parametrize("streams", [1, 10])
def test_latency(benchmark: BenchmarkFixture, node: Node, streams: int) -> None:
    """Latency of sensors at 10 Hz."""
    sensors = [Sensor(stream=f"latency/{streams}/{index}", objects=OBJECTS) for index in range(streams)]
    for sensor in sensors:
        node.send(sensor.detections(0))
    messages = [(sensor, seq, sensor.detections(seq)) for seq in range(1, FRAMES) for sensor in sensors]
    sent: dict[tuple[str, int], int] = {}

    def stream_all() -> None:
        first = time.monotonic()
        for number, (sensor, seq, message) in enumerate(messages):
            pause = first + number * PERIOD_S / streams - time.monotonic()
            if pause > 0:
                time.sleep(pause)
            sent[sensor.stream, seq] = time.monotonic_ns()
            node.send(message)
        for sensor in sensors:
            node.tracks(sensor.stream, FRAMES)

    benchmark.pedantic(stream_all, rounds=1)
    latencies, steps = [], []
    for at, (key, payload, _) in zip(node.tracks_seen.times_ns, node.tracks_seen.items, strict=True):
        stream = node.keys.stream_of(key)
        if stream.startswith(f"latency/{streams}/"):
            tracks = decode(payload, Tracks)
            if tracks.seq >= SETTLED and tracks.delivery is not None:
                latencies.append((at - sent[stream, tracks.seq]) / 1e6)
                steps.append(tracks.delivery.step_ms)
    figures = {
        "streams": streams,
        "p50_ms": round(percentile(latencies, 0.5), 3),
        "p99_ms": round(percentile(latencies, 0.99), 3),
        "step_p50_ms": round(percentile(steps, 0.5), 3),
    }
    benchmark.extra_info.update(figures)
    print(figures)  # noqa: T201 - the table of pytest-benchmark does not show what is wanted here
    assert len(latencies) == streams * (FRAMES - SETTLED)


class Window:
    """Sends frames of one sensor, so many at once without their tracks."""

    def __init__(self, node: Node, sensor: Sensor) -> None:
        self._node = node
        self._key = node.keys.tracks(sensor.stream)
        self._frames = iter([sensor.detections(seq) for seq in range(ROUNDS * ROUND)])
        self._sent = self._answered = self._seen = 0

    def run(self) -> None:
        """Send a round of frames and wait for the tracks of all."""
        for _ in range(ROUND):
            self._node.send(next(self._frames))
            self._sent += 1
            self._wait(self._sent - WINDOW)
        self._wait(self._sent)

    def _wait(self, answers: int) -> None:
        self._node.tracks_seen.wait(lambda items: self._count(items) >= answers, "tracks")

    def _count(self, items: list[tuple[str, bytes, str]]) -> int:
        self._answered += sum(key == self._key for key, _, _ in items[self._seen :])
        self._seen = len(items)
        return self._answered


def test_throughput(benchmark: BenchmarkFixture, node: Node) -> None:
    """Frames per second of one stream with a window of frames in flight."""
    window = Window(node, Sensor(stream="throughput/one/lidar", objects=OBJECTS))
    benchmark.pedantic(window.run, rounds=ROUNDS)
    figures = {"frames_per_second": round(ROUND / benchmark.stats.stats.median)}
    benchmark.extra_info.update(figures)
    print(figures)  # noqa: T201 - as above

"""How long a user waits for tracks: `pytest benchmarks/test_service.py -s`, in milliseconds from `put` to arrival.

A service process with its own router on this machine, sensors at 10 Hz with 40 objects each, their frames spread over
the period as independent sensors' are; sent by what `optipmb load` is made of. Time counts from just before `put` in
the publisher to the arrival of the tracks in a subscriber of the same process; encoding the frame is not in it.
Throughput is in frames per second, when a window of 8 is kept full, as a replay does.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from optipmb_client import Connection
from optipmb_tools.run.load import Load, generated, run_load
from router import Node, Sensor
from service_process import ServiceProcess

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pytest_benchmark.fixture import BenchmarkFixture

OBJECTS = 40
RATE = 10.0
SECONDS = float(os.environ.get("OPTIPMB_BENCHMARK_SECONDS", "8"))
WINDOW = 8
ROUNDS = 5
ROUND = 100


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A service in a process of its own."""
    with ServiceProcess("--instance", "benchmark", "--log-level", "warning") as process:
        process.wait_ready()
        yield process


@pytest.fixture
def node(service: ServiceProcess) -> Iterator[Node]:
    """A node beside it."""
    with Node(service.endpoint) as one:
        yield one


@pytest.mark.parametrize(("streams", "points"), [(1, 0), (10, 0), (50, 0), (1, 30_000), (10, 30_000)])
def test_latency(benchmark: BenchmarkFixture, service: ServiceProcess, streams: int, points: int) -> None:
    """Latency of sensors at 10 Hz, and what of it is spent where."""
    frames = generated(OBJECTS, points, RATE)
    with Connection(service.endpoint) as connection:
        load = Load(streams, RATE, SECONDS)
        run = benchmark.pedantic(lambda: run_load(connection, load, frames), rounds=1)
    figures = {name: round(getattr(run, name), 3) for name in ("p50_ms", "p99_ms", "max_ms", "late_p99_ms")}
    figures |= {f"{stage}_p50_ms": round(value, 3) for stage, value in run.stages_p50_ms.items()}
    figures |= {"streams": streams, "points": points, "lost": run.lost}
    benchmark.extra_info.update(figures)
    print(figures)  # noqa: T201 - the table of pytest-benchmark does not show what is wanted here
    assert run.received > 0


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

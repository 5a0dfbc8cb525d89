"""How long a user waits for tracks: `pytest benchmarks/test_service.py -s`, in milliseconds from `put` to arrival.

A service process with its own router on this machine, sensors at 10 Hz with 40 objects each, their frames spread over
the period as independent sensors' are; sent as by `benchmarks/load.py`. Time counts from just before `put` in
the publisher to the arrival of the tracks in a subscriber of the same process; encoding the frame is not in it.
Throughput is in frames per second, when a window of 8 is kept full, as a replay does.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np
import pytest
from gateway import GatewayProcess
from load import Load, generated, run_load
from optipmb_client import Connection, Publisher, Subscriber
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
SETTLED = 10  # frames that do not count


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A service in a process of its own."""
    with ServiceProcess("--instance", "benchmark", "--log-level", "warning") as process:
        process.wait_ready()
        yield process


@pytest.fixture
def node(service: ServiceProcess) -> Iterator[Node]:
    """A node that is connected to it."""
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
    print(figures)  # noqa: T201 - the table of pytest-benchmark does not show these
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


@pytest.mark.parametrize("rate", [10, 100])
def test_gateway(service: ServiceProcess, rate: int) -> None:
    """Median latency over Zenoh and through a gRPC gateway, and the gateway's processor time per frame."""
    with GatewayProcess(service.endpoint) as gateway:
        gateway.wait_ready()
        zenoh_ms = _latency_ms(service.endpoint, f"gateway/zenoh-{rate}/lidar", rate)
        began_s = _processor_s(gateway.process.pid)
        grpc_ms = _latency_ms(f"grpc://{gateway.address}", f"gateway/grpc-{rate}/lidar", rate)
        used_ms = (_processor_s(gateway.process.pid) - began_s) / round(rate * SECONDS) * 1e3
    figures = {"rate": rate, "zenoh_ms": zenoh_ms, "grpc_ms": grpc_ms, "gateway_processor_ms": used_ms}
    print({name: round(value, 2) for name, value in figures.items()})  # noqa: T201 - as above


def _latency_ms(endpoint: str, stream: str, rate: int) -> float:
    number = np.arange(float(OBJECTS))
    took_ms = []
    with Publisher(stream, endpoint, frame="world") as publisher, Subscriber(stream, endpoint) as subscriber:
        for k in range(round(rate * SECONDS)):
            publisher.publish(
                stamp_ns=10**18 + k * 10**9 // rate,
                label=["car"] * OBJECTS,
                center=np.column_stack((k / rate + 0 * number, 10 * number, 0 * number)),
                size=np.tile((4.5, 1.9, 1.6), (OBJECTS, 1)),
                yaw=0 * number,
                score=0 * number + 0.9,
            )
            received = subscriber.receive(10.0)
            assert received is not None
            took_ms.append((received.monotonic_ns - publisher.last_put_ns) / 1e6)
            time.sleep(max(0.0, 1 / rate - took_ms[-1] / 1e3))
    return median(took_ms[SETTLED:])


def _processor_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

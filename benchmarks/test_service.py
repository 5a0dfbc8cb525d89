"""How long a user waits for tracks: `pytest benchmarks/test_service.py -s`, in milliseconds from `put` to arrival.

A service process with its own router on this machine, sensors at 10 Hz with 40 objects each, their frames spread over
the period as independent sensors' are; sent as by `benchmarks/load.py`. Time counts from just before `put` in
the publisher to the arrival of the tracks in a subscriber of the same process; encoding the frame is not in it.
Throughput is in frames per second, when a window of 8 is kept full, as a replay does.
"""

from __future__ import annotations

import http.client
import json
import os
import time
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import paho.mqtt.client as paho
import pytest
import websocket
from broker import mosquitto
from gateway import GatewayProcess
from json_senders import document
from load import Load, generated, run_load
from optipmb_client import Connection, Publisher, Subscriber
from paho.mqtt.enums import CallbackAPIVersion
from router import Node, Sensor
from routers import free_endpoint
from service_process import ServiceProcess

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from optipmb_schemas import Detections
    from pytest_benchmark.fixture import BenchmarkFixture

    Send = Callable[[Detections], int]
    """Sends a frame; returns when it was handed over, monotonic, ns."""

OBJECTS = 40
RATE = 10.0
SECONDS = float(os.environ.get("OPTIPMB_BENCHMARK_SECONDS", "8"))
WINDOW = 8
ROUNDS = 5
ROUND = 100
SETTLED = 10  # frames that do not count
TOPIC = "detections"
HTTP = free_endpoint().removeprefix("tcp/")


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A service in a process of its own."""
    with ServiceProcess("--instance", "benchmark", "--log-level", "warning", "--http", HTTP) as process:
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


@contextmanager
def put(endpoint: str, stream: str) -> Iterator[Send]:
    """Send by a publisher of the client: over Zenoh, or gRPC."""
    with Publisher(stream, endpoint, frame="world") as publisher:

        def send(frame: Detections) -> int:
            columns = {name: getattr(frame, name) for name in ("center", "size", "yaw", "velocity", "score")}
            publisher.publish(stamp_ns=frame.stamp_ns, label=["car"] * len(frame.label), **columns)
            return publisher.last_put_ns

        yield send


@contextmanager
def post(address: str, stream: str) -> Iterator[Send]:
    """Send each frame as a request of one connection."""
    with closing(http.client.HTTPConnection(address, timeout=60)) as connection:

        def send(frame: Detections) -> int:
            body, began_ns = json.dumps(document(frame)), time.monotonic_ns()
            connection.request(
                "POST", f"/api/v1/detections?stream={stream}", body, {"content-type": "application/json"}
            )
            assert connection.getresponse().read()
            return began_ns

        yield send


@contextmanager
def web_socket(address: str, stream: str) -> Iterator[Send]:
    """Send each frame as a text of one WebSocket."""
    with closing(websocket.create_connection(f"ws://{address}/api/v1/detections?stream={stream}")) as socket:

        def send(frame: Detections) -> int:
            body, began_ns = json.dumps(document(frame)), time.monotonic_ns()
            socket.send(body)
            assert socket.recv()
            return began_ns

        yield send


@contextmanager
def mqtt(broker: str) -> Iterator[Send]:
    """Publish each frame with QoS 1."""
    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.connect("127.0.0.1", int(broker.rpartition(":")[2]))
    client.loop_start()

    def send(frame: Detections) -> int:
        body, began_ns = json.dumps(document(frame)), time.monotonic_ns()
        client.publish(TOPIC, body, qos=1).wait_for_publish(60)
        return began_ns

    try:
        yield send
    finally:
        client.disconnect()
        client.loop_stop()


@pytest.mark.parametrize("interface", ["zenoh", "post", "websocket", "grpc", "mqtt"])
def test_interface(service: ServiceProcess, interface: str, tmp_path: Path) -> None:
    """Latency of frames that come by an interface and leave over Zenoh; processor time of a frame in each process."""
    edge: ServiceProcess | None = None
    stream = f"interface/{interface}/lidar"
    with ExitStack() as context:
        if interface == "grpc":
            gateway = context.enter_context(GatewayProcess(service.endpoint))
            edge, sender = gateway, put(f"grpc://{gateway.address}", stream)
        elif interface == "mqtt":
            broker = context.enter_context(mosquitto(tmp_path))
            (tmp_path / "mqtt.toml").write_text(f'[mqtt.inputs."{stream}"]\ntopic = "{TOPIC}"\n')
            options = ("--settings", str(tmp_path / "mqtt.toml"), "--connect", service.endpoint, "--broker", broker)
            edge, sender = context.enter_context(ServiceProcess("mqtt", *options, listen=False)), mqtt(broker)
        elif interface == "zenoh":
            sender = put(service.endpoint, stream)
        else:
            sender = post(HTTP, stream) if interface == "post" else web_socket(HTTP, stream)
        if edge is not None:
            edge.wait_ready()
        send = context.enter_context(sender)
        subscriber = context.enter_context(Subscriber(stream, service.endpoint))
        sensor, took_ms = Sensor(stream=stream, objects=OBJECTS), []
        processes = [service.process.pid, *([] if edge is None else [edge.process.pid])]
        for seq in range(SETTLED + round(RATE * SECONDS)):
            if seq == SETTLED:
                before = [_processor_s(pid) for pid in processes]
            began_ns = send(sensor.detections(seq))
            received = subscriber.receive(
                1.0 if seq < SETTLED else 10.0
            )  # the broker drops frames before a subscription
            if received is None:
                assert seq < SETTLED
                continue
            took_ms.append((received.monotonic_ns - began_ns) / 1e6)
            time.sleep(max(0.0, 1 / RATE - took_ms[-1] / 1e3))
        after = [_processor_s(pid) for pid in processes]
    used_ms = [(last - first) / round(RATE * SECONDS) * 1e3 for first, last in zip(before, after, strict=True)]
    shown = " + ".join(f"{one:.2f}" for one in used_ms)
    print(f"| {interface} | {median(took_ms[-round(RATE * SECONDS) :]):.1f} | {shown} |")  # noqa: T201 - as above


def _processor_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

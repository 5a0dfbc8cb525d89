"""What a gRPC gateway costs: processor time per frame, and latency beside plain Zenoh, in one run.

python benchmarks/grpc_cost.py [--frames N] [--objects N] [--subscribers N] [--connections N]

A router, a gateway and this program, which also answers each frame with as many tracks at once: what is measured is the
edge, not the tracker. Frames go out in turns over Zenoh, over gRPC, and to a server of grpcio that answers each request
with as many bytes and does nothing else: all meet the same machine, and the last one is what a gateway cannot be below.
Latency is from handing a frame to the client library until its tracks are there.

With `--subscribers`, so many more take the tracks: in the first half of the frames all of them read, in the second half
one sleeps. With `--connections`, so many connections without calls are open at the end.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import queue
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import grpc
import numpy as np
from optipmb_client import Publisher, Subscriber

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from gateway import GatewayProcess, resident
from optipmb_schemas import Detections, Keys, Tracks, decode, encode, encoding_of
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from routers import open_client
from service_process import ServiceProcess

if TYPE_CHECKING:
    import zenoh

RATE_HZ = 10.0
WARM = 20
ECHO = "/Echo/Call"
IDLE_S = 2.0
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
PER_ADDRESS = 20_000
"""Connections from one address of the loopback: ports run short beyond it."""


def processor_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def boxes(objects: int, k: int) -> dict[str, Any]:
    """Objects on a grid, all driving along x at 10 m/s."""
    side = int(np.ceil(np.sqrt(objects)))
    place = 12.0 * np.stack([np.arange(objects) % side, np.arange(objects) // side], axis=1)
    center = np.column_stack([place[:, 0] + k / RATE_HZ * 10.0, place[:, 1], np.full(objects, 0.8)])
    size = np.tile([4.5, 1.9, 1.6], (objects, 1))
    shared = {"labels": ("car",), "label": np.zeros(objects, dtype=int), "yaw": np.zeros(objects)}
    return {**shared, "center": center, "size": size, "score": np.full(objects, 0.9)}


def percentiles(latencies: list[float], warm: int = WARM) -> dict[str, float]:
    """Median and 99th percentile in ms."""
    p50, p99 = np.percentile(1e3 * np.array(latencies[warm:]), (50, 99))
    return {"p50_ms": round(float(p50), 3), "p99_ms": round(float(p99), 3)}


def main() -> None:
    """Measure, and print one line of JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--subscribers", type=int, default=0, help="further subscribers, one of them asleep")
    parser.add_argument("--connections", type=int, default=0, help="connections without calls")
    parser.add_argument("--echo", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.echo is not None:
        asyncio.run(echo(options.echo))
        return
    with ServiceProcess("router") as router, GatewayProcess(router.endpoint) as gateway:
        router.wait_ready()
        gateway.wait_ready()
        with open_client(router.endpoint) as session:
            kept = [answering(session, f"cost/{way}/lidar") for way in ("zenoh", "grpc")]
            result = measure(router.endpoint, gateway, options)
            del kept
        if options.connections:
            result["connections"] = idle_connections(gateway, options.connections)
    sys.stdout.write(json.dumps(result) + "\n")


def answering(session: zenoh.Session, stream: str) -> Any:
    """Answer every frame of a stream with a track for each of its objects."""
    keys = Keys()
    publisher = session.declare_publisher(keys.tracks(stream), encoding=encoding_of(Tracks), express=True)

    def answer(sample: zenoh.Sample) -> None:
        frame = decode(sample.payload.to_bytes(), Detections)
        publisher.put(encode(tracks_of(frame)))

    return publisher, session.declare_subscriber(keys.detections(stream), answer)


def tracks_of(frame: Detections) -> Tracks:
    """A track for each object of a frame."""
    n = len(frame.label)
    zeros, ones = np.zeros(n), np.ones(n)
    header = {"stream": frame.stream, "epoch": frame.epoch, "seq": frame.seq, "stamp_ns": frame.stamp_ns}
    boxes = {"label": frame.label, "center": frame.center, "size": frame.size, "yaw": frame.yaw}
    rest = {"velocity": np.zeros((n, 2)), "yaw_rate": zeros, "acceleration": zeros, "existence": ones, "score": ones}
    last = {"covariance": np.tile(np.eye(6), (n, 1, 1)), "age": ones, "time_since_detection": zeros}
    return Tracks(
        **header, **boxes, **rest, **last, session="0" * 32, profile="cost", cloud_used=False, labels=frame.labels,
        id=np.arange(n), detection=np.arange(n),
    )  # fmt: skip


async def echo(size: int) -> None:
    """Answer each request of a stream with so many bytes: grpcio alone."""
    response = bytes(size)

    async def answer(_requests: Any, context: Any) -> None:
        while await context.read() is not grpc.aio.EOF:
            await context.write(response)

    server = grpc.aio.server()
    _, service, method = ECHO.split("/")
    handler = grpc.stream_stream_rpc_method_handler(answer)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, {method: handler}),))
    sys.stdout.write(f"{server.add_insecure_port('127.0.0.1:0')}\n")
    sys.stdout.flush()
    await server.start()
    await server.wait_for_termination()


class Echo:
    """A server of grpcio alone in a process of its own, and a call to it."""

    def __init__(self, request: bytes, size: int) -> None:
        command = [sys.executable, __file__, "--echo", str(size)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - it calls itself, with a number
        assert self.process.stdout is not None
        channel = grpc.insecure_channel(f"127.0.0.1:{int(self.process.stdout.readline())}")
        self._request = request
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._call = channel.stream_stream(ECHO)(iter(self._requests.get, None))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._requests.put(None)
        list(self._call)
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def turn(self) -> float:
        """Send a request and wait for its response; return the seconds that took."""
        began = time.monotonic()
        self._requests.put(self._request)
        next(self._call)
        return time.monotonic() - began


def measure(endpoint: str, gateway: GatewayProcess, options: argparse.Namespace) -> dict[str, Any]:
    """Send frames over all ways in turns."""
    ways = {"zenoh": endpoint, "grpc": f"grpc://{gateway.address}"}
    latencies: dict[str, list[float]] = {way: [] for way in (*ways, "echo")}
    header = {"stream": "a/b/c", "epoch": bytes(16), "seq": 0, "stamp_ns": 0, "frame": "world"}
    frame = Detections(**header, **boxes(options.objects, 0))
    request = pb.PublishRequest(detections=convert.to_proto(frame)).SerializeToString()
    size = convert.to_proto(tracks_of(frame)).ByteSize()
    readers = Readers(gateway.address, options.subscribers)
    publishers = {way: Publisher(f"cost/{way}/lidar", where, frame="world") for way, where in ways.items()}
    subscribers = {way: Subscriber(f"cost/{way}/lidar", where) for way, where in ways.items()}
    memory: list[int] = []
    with Echo(request, size) as floor:
        pids = {"gateway": gateway.process.pid, "echo": floor.process.pid}
        spent = {name: processor_s(pid) for name, pid in pids.items()}
        time.sleep(IDLE_S)
        idle = processor_s(pids["gateway"]) - spent["gateway"]
        for k in range(options.frames):
            began = time.monotonic()
            if k == WARM:
                spent = {name: processor_s(pid) for name, pid in pids.items()}
            if k == options.frames // 2:
                readers.sleep()
            for way in ways:
                at = time.monotonic_ns()
                readers.sent[k] = time.monotonic()
                publishers[way].publish(stamp_ns=10**18 + k * 10**8, **boxes(options.objects, k))
                tracks = subscribers[way].receive(10.0)
                if tracks is None:
                    raise SystemExit(f"no tracks of frame {k} over {way}")
                latencies[way].append((tracks.monotonic_ns - at) / 1e9)
                time.sleep(0.02)
            latencies["echo"].append(floor.turn())
            memory.append(resident(pids["gateway"]))
            time.sleep(max(0.0, began + 1 / RATE_HZ - time.monotonic()))
        spent = {name: processor_s(pid) - spent[name] for name, pid in pids.items()}
    readers.close()
    for one in (*publishers.values(), *subscribers.values()):
        one.close()
    return {
        "objects": options.objects,
        **{way: percentiles(values) for way, values in latencies.items()},
        **{f"{name}_ms_per_frame": round(1e3 * s / (options.frames - WARM), 3) for name, s in spent.items()},
        "gateway_idle_ms_per_s": round(1e3 * idle / IDLE_S, 3),
        "gateway_mb": {"all_read": memory[options.frames // 2 - 1] // 2**20, "one_sleeps": max(memory) // 2**20},
        **readers.result(options.frames),
    }


class Readers:
    """Subscribers of the stream over gRPC, on a thread of their own; the first one can be put to sleep."""

    def __init__(self, address: str, number: int) -> None:
        self.sent: dict[int, float] = {}
        self._late: dict[int, list[float]] = {}
        self._asleep = asyncio.Event()
        self._begun = threading.Semaphore(0)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._tasks = [
            asyncio.run_coroutine_threadsafe(self._read(address, index), self._loop) for index in range(number)
        ]
        for _ in self._tasks:
            self._begun.acquire()

    async def _read(self, address: str, index: int) -> None:
        options = [("grpc.use_local_subchannel_pool", 1)]  # a connection of its own for each
        async with grpc.aio.insecure_channel(address, options=options) as channel:
            call = rpc.TrackingServiceStub(channel).Subscribe(pb.SubscribeRequest(pattern="cost/grpc/lidar"))
            await call.initial_metadata()
            self._begun.release()
            while not (index == 0 and self._asleep.is_set()):
                response = await call.read()
                arrived = time.monotonic()
                if index:
                    seq = response.tracks.seq
                    self._late.setdefault(seq, []).append(arrived - self.sent[seq])
            await asyncio.Event().wait()

    def sleep(self) -> None:
        """Have the first one read no more."""
        self._loop.call_soon_threadsafe(self._asleep.set)

    def close(self) -> None:
        """End all."""
        for task in self._tasks:
            task.cancel()
            with contextlib.suppress(BaseException):
                task.result(5)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def result(self, frames: int) -> dict[str, Any]:
        """Latency of all subscribers but the first, before it slept and then, and how many frames they have missed."""
        if not self._tasks:
            return {}
        halves = {"all_read": range(WARM, frames // 2), "one_sleeps": range(frames // 2, frames)}
        late = {name: [one for k in half for one in self._late.get(k, ())] for name, half in halves.items()}
        missed = (frames - WARM) * (len(self._tasks) - 1) - sum(map(len, late.values()))
        return {"subscribers": {name: percentiles(one, 0) for name, one in late.items()} | {"missed": missed}}


def idle_connections(gateway: GatewayProcess, number: int) -> dict[str, Any]:
    """Open connections without calls; tell what they take, and how long a question takes meanwhile."""
    host, _, port = gateway.address.rpartition(":")
    pid, stub = gateway.process.pid, gateway.stub()
    stub.ListStreams(pb.ListStreamsRequest())
    before, idle = resident(pid), []
    try:
        for index in range(number):
            source = (f"127.0.0.{1 + index // PER_ADDRESS}", 0)
            one = socket.create_connection((host, int(port)), timeout=10, source_address=source)
            one.sendall(PREFACE)
            idle.append(one)
        opened = sum(bool(one.recv(1)) for one in idle)
        taken, began = resident(pid) - before, time.monotonic()
        stub.ListStreams(pb.ListStreamsRequest())
        answered = time.monotonic() - began
    finally:
        for one in idle:
            one.close()
    return {"open": opened, "bytes_each": taken // number, "answer_ms": round(1e3 * answered, 1)}


if __name__ == "__main__":
    main()

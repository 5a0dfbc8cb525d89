"""What a gRPC gateway costs: processor time per frame and latency, beside its libraries alone and plain Zenoh.

python benchmarks/grpc_cost.py [--rates 10,100,400] [--seconds S] [--rounds N] [--objects N] [--against CHECKOUT]
                               [--subscribers N] [--connections N]

A router, a process for each way, and this program, which also answers each frame with as many tracks at once: what is
measured is the edge, not the tracker. At each rate frames go out by the clock, over one way after the other, in rounds:

| way | what |
| --- | --- |
| `zenoh` | the client library over Zenoh |
| `grpc` | the client library over a gateway: a `Publish` and a `Subscribe` call |
| `track` | a `Track` call to a gateway, with bytes that were made before |
| `bare` | a server that passes the bytes of a gRPC call on to Zenoh and back, unread: grpcio and Zenoh alone |
| `echo` | a server that answers each request with bytes: grpcio alone |

Milliseconds per frame are the processor time of the process in between, with what it does anyway. Latency is from
handing a frame over until its tracks are there. With `--against`, `grpc` and `track` are measured with the gateway of
another checkout too. With `--subscribers`, so many more take the tracks: in the first half of the frames all of them
read, in the second half one sleeps. With `--connections`, so many connections without calls are open at the end.
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np
from grpc_ways import BARE, RATE_HZ, TRACK, Library, Raw, Way, answer_of, answering, boxes, frame_of, request_of
from optipmb_client import Publisher
from optipmb_client.zenoh.session import Session

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from gateway import GatewayProcess, resident
from optipmb_schemas import encode
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf import tracking_pb2_grpc as rpc
from optipmb_service.settings import Settings
from optipmb_service.zenoh.client import Client
from routers import open_client
from service_process import ServiceProcess

if TYPE_CHECKING:
    from optipmb_service.zenoh.client import Outgoing

WARM = 20
WAIT_S = 20.0
PAUSE_S = 0.5
READ = "cost/read/lidar"
PACKAGES = ("service", "schemas", "clients", ".")
SENT: collections.Counter[str] = collections.Counter()
"""Frames sent over each way: their numbers go on."""
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
PER_ADDRESS = 20_000
"""Connections from one address of the loopback: ports run short beyond it."""


def processor_s(pid: int) -> float:
    """Processor time of a process's threads so far."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has ended
            total += int((task / "schedstat").read_text().split()[0])
    return total / 1e9


def percentiles(latencies: list[float]) -> dict[str, float]:
    """Median and 99th percentile in ms."""
    p50, p99 = np.percentile(1e3 * np.array(latencies), (50, 99))
    return {"p50_ms": round(float(p50), 3), "p99_ms": round(float(p99), 3)}


def main() -> None:
    """Measure, and print one line of JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rates", default="10,100,400", help="frames per second")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each way in each round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--against", type=Path, help="a checkout whose gateway is measured in the same run")
    parser.add_argument("--subscribers", type=int, default=0, help="further subscribers, one of them asleep")
    parser.add_argument("--connections", type=int, default=0, help="connections without calls")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        asyncio.run(serve(*options.serve))
        return
    with contextlib.ExitStack() as opened:
        router = opened.enter_context(ServiceProcess("router"))
        router.wait_ready()
        session = Session(opened.enter_context(open_client(router.endpoint)))
        ways = opened_ways(opened, router.endpoint, options)
        kept = [answering(session, way.stream) for way in ways if way.stream]
        rates = [float(rate) for rate in options.rates.split(",")]
        result: dict[str, Any] = {"objects": options.objects, "rates": [measure(ways, rate, options) for rate in rates]}
        gateway = opened.enter_context(GatewayProcess(router.endpoint))
        gateway.wait_ready()
        if options.subscribers:
            kept.append(answering(session, READ))
            result["subscribers"] = subscribers(router.endpoint, gateway, options)
        if options.connections:
            result["connections"] = idle_connections(gateway, options.connections)
        for way in ways:
            way.close()
        del kept
    sys.stdout.write(json.dumps(result) + "\n")


async def serve(router: str, stream: str) -> None:
    """Pass the requests of a call on to Zenoh, and what comes back to the caller; without a router answer with them."""
    loop, coming = asyncio.get_running_loop(), asyncio.Queue[bytes]()
    outgoing: Outgoing | None = None
    if router:
        client = Client(Settings(connect=(router,)))
        outgoing = client.publish(stream, 200, 0, lambda: None)
        kept = client.subscribe(
            client.keys.tracks(stream), lambda one: loop.call_soon_threadsafe(coming.put_nowait, one.payload)
        )

    async def write(context: Any) -> None:
        while True:
            await context.write(await coming.get())

    async def answer(_requests: Any, context: Any) -> None:
        writing = asyncio.create_task(write(context)) if outgoing else None
        while (request := await context.read()) is not grpc.aio.EOF:
            if outgoing is None:
                await context.write(request)
            else:
                outgoing.detections(request)
        if writing is not None:
            writing.cancel()

    server = grpc.aio.server()
    _, service, method = BARE.split("/")
    handler = grpc.stream_stream_rpc_method_handler(answer)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, {method: handler}),))
    sys.stdout.write(f"{server.add_insecure_port('127.0.0.1:0')}\n")
    sys.stdout.flush()
    await server.start()
    await server.wait_for_termination()
    del kept


def opened_ways(opened: contextlib.ExitStack, router: str, options: argparse.Namespace) -> list[Way]:
    """Open all ways, each gateway in a process of its own."""
    ways: list[Way] = [Library("zenoh", router)]
    for suffix, checkout in (("", None), *([("_against", options.against)] if options.against else [])):
        folders = ":".join(str(checkout.absolute() / one) for one in PACKAGES) if checkout else ""
        for name in ("grpc", "track"):
            gateway = opened.enter_context(
                GatewayProcess(router, environment={"PYTHONPATH": folders} if checkout else None)
            )
            gateway.wait_ready()
            pid = gateway.process.pid
            if name == "grpc":
                ways.append(Library(name + suffix, f"grpc://{gateway.address}", pid))
            else:
                ways.append(Raw(name + suffix, pid, gateway.address, TRACK, request_of))
    for name, endpoint in (("bare", router), ("echo", "")):
        command = [sys.executable, __file__, "--serve", endpoint, f"cost/{name}/lidar"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - it calls itself
        opened.callback(process.wait)
        opened.callback(process.kill)
        assert process.stdout is not None
        opened.callback(process.stdout.close)
        address = f"127.0.0.1:{int(process.stdout.readline())}"
        ways.append(Raw(name, process.pid, address, BARE, encode if endpoint else answer_of))
    return ways


def measure(ways: list[Way], rate: float, options: argparse.Namespace) -> dict[str, Any]:
    """Send frames at a rate over all ways in turns."""
    number = max(WARM, round(rate * options.seconds))
    latencies: dict[str, list[float]] = {way.name: [] for way in ways}
    spent = dict.fromkeys(latencies, 0.0)
    for _ in range(options.rounds):
        for way in ways:
            run(way, WARM, rate, options.objects)
            time.sleep(PAUSE_S)
            before = processor_s(way.pid) if way.pid else 0.0
            latencies[way.name] += run(way, number, rate, options.objects)
            spent[way.name] += (processor_s(way.pid) if way.pid else 0.0) - before
    figures = {name: percentiles(values) for name, values in latencies.items()}
    for way in ways:
        if way.pid:
            figures[way.name]["ms_per_frame"] = round(1e3 * spent[way.name] / (number * options.rounds), 3)
    return {"rate_hz": rate, **figures}


def run(way: Way, number: int, rate: float, objects: int) -> list[float]:
    """Send so many frames at a rate over a way; return the latency of each in seconds."""
    first = SENT[way.name]
    SENT[way.name] += number
    frames = [frame_of(way.stream or "cost/echo/lidar", first + k, objects) for k in range(number)]
    arrived: list[int] = []
    reader = threading.Thread(target=lambda: arrived.extend(way.receive() for _ in frames))
    reader.start()
    sent, began = [], time.monotonic()
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, began + k / rate - time.monotonic()))
        sent.append(time.monotonic_ns())
        way.send(frame)
    reader.join(WAIT_S)
    if len(arrived) < number:
        raise SystemExit(f"{number - len(arrived)} of {number} frames have no tracks over {way.name}")
    return [(one - other) / 1e9 for one, other in zip(arrived, sent, strict=True)]


def subscribers(router: str, gateway: GatewayProcess, options: argparse.Namespace) -> dict[str, Any]:
    """Publish a stream that many read over gRPC, one of them only half of the time."""
    readers = Readers(gateway.address, options.subscribers)
    number, memory = 2 * round(RATE_HZ * options.seconds), []
    with Publisher(READ, router, frame="world") as publisher:
        for k in range(number):
            began = time.monotonic()
            if k == number // 2:
                readers.sleep()
            readers.sent[k] = began
            publisher.publish(stamp_ns=10**18 + k * 10**8, **boxes(options.objects, k))
            memory.append(resident(gateway.process.pid))
            time.sleep(max(0.0, began + 1 / RATE_HZ - time.monotonic()))
    time.sleep(PAUSE_S)
    readers.close()
    megabytes = {"all_read": memory[number // 2 - 1] // 2**20, "one_sleeps": max(memory) // 2**20}
    return {**readers.result(number), "gateway_mb": megabytes}


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
            call = rpc.TrackingServiceStub(channel).Subscribe(pb.SubscribeRequest(pattern=READ))
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
        halves = {"all_read": range(frames // 2), "one_sleeps": range(frames // 2, frames)}
        late = {name: [one for k in half for one in self._late.get(k, ())] for name, half in halves.items()}
        missed = frames * (len(self._tasks) - 1) - sum(map(len, late.values()))
        return {name: percentiles(one) for name, one in late.items()} | {"missed": missed}


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

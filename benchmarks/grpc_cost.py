"""What a gRPC gateway costs: processor time per frame, and latency beside plain Zenoh, in one run.

python benchmarks/grpc_cost.py [--frames N] [--objects N] [--subscribers N]

A router, a gateway and this program, which also answers each frame with as many tracks at once: what is measured is the
edge, not the tracker. Frames go out in turns over Zenoh and over gRPC: both meet the same machine. Latency is from
handing a frame to the client library until its tracks are there.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np
from optipmb_client import Publisher, Subscriber

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from gateway import GatewayProcess
from optipmb_schemas import Detections, Keys, Tracks, decode, encode, encoding_of
from optipmb_schemas.protobuf import tracking_pb2 as pb
from routers import open_client
from service_process import ServiceProcess

if TYPE_CHECKING:
    import zenoh

RATE_HZ = 10.0
WARM = 20


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


def percentiles(latencies: list[float]) -> dict[str, float]:
    """Median and 99th percentile in ms."""
    p50, p99 = np.percentile(1e3 * np.array(latencies[WARM:]), (50, 99))
    return {"p50_ms": round(float(p50), 3), "p99_ms": round(float(p99), 3)}


def main() -> None:
    """Measure, and print one line of JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--subscribers", type=int, default=0, help="further subscribers, one of them asleep")
    options = parser.parse_args()
    with ServiceProcess("router") as router, GatewayProcess(router.endpoint) as gateway:
        router.wait_ready()
        gateway.wait_ready()
        with open_client(router.endpoint) as session:
            kept = [answering(session, f"cost/{way}/lidar") for way in ("zenoh", "grpc")]
            result = measure(router.endpoint, gateway, options)
            del kept
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


def measure(endpoint: str, gateway: GatewayProcess, options: argparse.Namespace) -> dict[str, Any]:
    """Send frames over both ways in turns."""
    ways = {"zenoh": endpoint, "grpc": f"grpc://{gateway.address}"}
    latencies: dict[str, list[float]] = {way: [] for way in ways}
    received = [0] * options.subscribers
    readers = subscribe_many(gateway, options.subscribers, received)
    publishers = {way: Publisher(f"cost/{way}/lidar", where, frame="world") for way, where in ways.items()}
    subscribers = {way: Subscriber(f"cost/{way}/lidar", where) for way, where in ways.items()}
    pid = gateway.process.pid
    begun_s, memory = 0.0, 0
    for k in range(options.frames):
        began = time.monotonic()
        begun_s = processor_s(pid) if k == WARM else begun_s
        for way in ways:
            at = time.monotonic_ns()
            publishers[way].publish(stamp_ns=10**18 + k * 10**8, **boxes(options.objects, k))
            tracks = subscribers[way].receive(10.0)
            if tracks is None:
                raise SystemExit(f"no tracks of frame {k} over {way}")
            latencies[way].append((tracks.monotonic_ns - at) / 1e9)
            time.sleep(0.02)
        memory = max(memory, int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096)
        time.sleep(max(0.0, began + 1 / RATE_HZ - time.monotonic()))
    spent = processor_s(pid) - begun_s
    for call in readers:
        call.cancel()
    for one in (*publishers.values(), *subscribers.values()):
        one.close()
    return {
        "objects": options.objects,
        **{way: percentiles(values) for way, values in latencies.items()},
        "gateway_ms_per_frame": round(1e3 * spent / (options.frames - WARM), 3),
        "gateway_mb": memory // 2**20,
        "subscribers": {"fewest": min(received[1:], default=0), "most": max(received, default=0)},
    }


def subscribe_many(gateway: GatewayProcess, number: int, received: list[int]) -> list[Any]:
    """Subscribe to the stream over gRPC many times; the first one never reads."""
    calls = []
    for index in range(number):
        call = gateway.stub().Subscribe(pb.SubscribeRequest(pattern="cost/grpc/lidar"))
        call.initial_metadata()
        calls.append(call)
        if index:
            threading.Thread(target=count, args=(call, received, index), daemon=True).start()
    return calls


def count(call: Any, received: list[int], index: int) -> None:
    """Count the responses of a subscription."""
    try:
        for _ in call:
            received[index] += 1
    except grpc.RpcError as error:
        if error.code() is not grpc.StatusCode.CANCELLED:  # the end of the measurement cancels it
            raise


if __name__ == "__main__":
    main()

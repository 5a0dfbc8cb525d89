"""A service under load for a time: nothing grows, nothing is lost, and every message is accounted for."""

import os
import resource
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import pytest
from fleet import Fleet
from load import Load, Run, generated, run_load
from optipmb_client import Connection
from optipmb_client.sessions import find_services
from optipmb_schemas import Detections, Keys, ServiceStatus, encode, encoding_of
from router import Sensor

SECONDS = float(os.environ.get("OPTIPMB_TEST_SOAK_S", "14"))
STREAMS = int(os.environ.get("OPTIPMB_TEST_SOAK_STREAMS", "5"))
CLOUD_STREAMS = max(1, STREAMS // 10)
RATE_HZ = 20.0
OBJECTS, POINTS = 40, 30_000
MOST_GROWTH = 0.05
MOST_CLOUDLESS = 0.005
"""Share of the frames with clouds that may go without: a network that is behind drops what has low priority."""
WARM_S = 7.0
"""Until then the caches of the newest tracks fill up."""
SAMPLES = 60
TELL_EVERY_S = 60.0
EXTRA = Sensor(stream="soak/extra/lidar")
KEYS = Keys()


@dataclass
class Sample:
    at_s: float
    memory_kb: int
    waiting: int
    status: ServiceStatus

    def __str__(self) -> str:
        p99 = max((session.latency_p99_ms for session in self.status.sessions), default=0.0)
        return (
            f"{self.at_s:5.0f} s: {self.memory_kb / 1024:.1f} MB, {self.waiting} waiting, "
            f"{self.status.received} received, worst p99 of a stream {p99:.1f} ms"
        )


def test_nothing_grows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing grows or is lost: memory within 5 %, queues below a second, every frame tracked, each message counted.

    Streams with and without clouds, and one that also sends every frame twice and garbage between.
    """
    loads = {
        Load(STREAMS, RATE_HZ, SECONDS, "nuscenes"): generated(OBJECTS, 0, RATE_HZ),
        Load(CLOUD_STREAMS, RATE_HZ, SECONDS, "nuscenes"): generated(OBJECTS, POINTS, RATE_HZ),
    }
    with (
        Fleet(tmp_path, checkpoint_s=1.0) as fleet,
        Connection(fleet.endpoint) as connection,
        ThreadPoolExecutor() as pool,
    ):
        service = fleet.service("soak", fresh=True)
        running = [pool.submit(run_load, connection, load, frames) for load, frames in loads.items()]
        samples, extra = _watched(connection, service.process.pid, running, capsys)
        runs = [one.result(60) for one in running]
        status = _when_all_is_done(connection, sum(one.sent for one in runs) + 3 * extra)
        assert service.end()[0] == 0
    cloudless = sum(one.cloudless for one in runs)
    warm = [sample for sample in samples if sample.at_s > WARM_S]
    third = len(warm) // 3
    first, last = warm[:third], warm[-third:]
    settled, ended = (median(sample.memory_kb for sample in part) for part in (first, last))
    _tell(
        capsys,
        f"{SECONDS:g} s, {STREAMS + CLOUD_STREAMS} streams: {status.received} received = {status.frames} tracked + "
        f"{status.duplicates} duplicates + {status.refused} refused, {cloudless} without their cloud; "
        f"memory {settled / 1024:.1f} to {ended / 1024:.1f} MB; p50 / p99 {_quantiles(runs)}",
    )
    assert [(one.lost, one.repeated) for one in runs] == [(0, 0)] * 2
    assert cloudless <= MOST_CLOUDLESS * runs[1].sent
    assert (status.frames, status.shed, status.late) == (sum(one.sent for one in runs) + extra, 0, 0)
    assert (status.duplicates, status.refused) == (extra, extra)
    assert status.received == status.frames + status.duplicates + status.refused
    assert ended <= settled * (1 + MOST_GROWTH), f"{settled} kB have become {ended} kB"
    # A queue that grows has more by then; a pause of the machine leaves less.
    assert median(sample.waiting for sample in last) < STREAMS * RATE_HZ, "a second of every stream waits"


def _watched(
    connection: Connection, pid: int, running: list[Future[Run]], capsys: pytest.CaptureFixture[str]
) -> tuple[list[Sample], int]:
    """Look at the service until the loads end, and send it a frame, the same again, and garbage each time."""
    samples: list[Sample] = []
    began, told_s, pause_s = time.monotonic(), 0.0, SECONDS / SAMPLES
    sender = connection.cached_sender(KEYS.detections(EXTRA.stream), encoding_of(Detections), cache=100)
    while wait(running, timeout=pause_s).not_done:
        frame = encode(EXTRA.detections(len(samples)))
        for payload in (frame, frame, b"garbage"):
            sender.put(payload)
        (status,) = find_services(connection)
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
        at_s = time.monotonic() - began
        waiting = sum(session.queue for session in status.sessions)
        samples.append(Sample(at_s, pages * resource.getpagesize() // 1024, waiting, status))
        if at_s - told_s >= TELL_EVERY_S:
            told_s = at_s
            _tell(capsys, str(samples[-1]))
    sender.close()
    return samples, len(samples)


def _when_all_is_done(connection: Connection, sent: int) -> ServiceStatus:
    """The status when all that was sent has been received and accounted for."""
    ends = time.monotonic() + 60.0
    while True:
        (status,) = find_services(connection)
        accounted = status.frames + status.duplicates + status.late + status.refused + status.shed
        if status.received == accounted == sent:
            return status
        assert time.monotonic() < ends, (sent, status)


def _quantiles(runs: list[Run]) -> str:
    return ", ".join(f"{one.p50_ms:.1f} / {one.p99_ms:.1f} ms" for one in runs)


def _tell(capsys: pytest.CaptureFixture[str], text: str) -> None:
    with capsys.disabled():
        print(f"\n{text}", flush=True)  # noqa: T201 - the figures that the test is for

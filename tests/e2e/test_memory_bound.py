"""A service stays within its memory under any input: real processes, their peak read from the system."""

import re
from pathlib import Path

import pytest
import zenoh
from optipmb_schemas import Keys
from router import Node, Sensor
from service_process import ServiceProcess

pytestmark = pytest.mark.alone

KEYS = Keys()
SENSOR = Sensor()
GARBAGE = 16 * 2**20
MESSAGES = 100
MEMORY_MB = 128
BESIDE_MB = 400
"""What the network's library holds while such messages are under way, and what the allocator gives back late."""


def peak_mb(pid: int) -> float:
    (kilobytes,) = re.findall(r"^VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return int(kilobytes) / 1024


def test_garbage_takes_no_more_memory_than_is_set(capsys: pytest.CaptureFixture[str]) -> None:
    """A hundred messages of 16 MB that are none: memory stays near the setting, another stream is served."""
    settings = {"OPTIPMB_MEMORY_MB": str(MEMORY_MB), "OPTIPMB_STREAM_MB": "64"}
    with ServiceProcess(environment=settings, fresh=True) as service:
        service.wait_ready()
        with Node(service.endpoint) as node:
            node.send(SENSOR.detections(0))
            node.tracks(SENSOR.stream, 1)
            before = peak_mb(service.process.pid)
            key = KEYS.detections("site/careless/lidar")
            publisher = node.session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            for number in range(MESSAGES):
                publisher.put(bytes([number]) * GARBAGE)
            publisher.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stubs leave it untyped
            node.send(*(SENSOR.detections(seq) for seq in range(1, 11)))
            node.tracks(SENSOR.stream, 11)
            grown = peak_mb(service.process.pid) - before
    with capsys.disabled():
        print(  # noqa: T201 - the figure is for people
            f"\npeak memory: {before:.0f} MB before {MESSAGES} messages of 16 MB, {grown:.0f} MB more after"
        )
    assert grown < MEMORY_MB + BESIDE_MB

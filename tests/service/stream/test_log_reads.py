"""Reads of the log for sessions whose frames do not arrive."""

import time
from collections.abc import Callable
from typing import Any

from optipmb_service.session.checkpoint import Checkpoint
from registries import Around, packet_of, streams_of
from router import Sensor

SENSORS = [Sensor(stream=f"yard/{number}/lidar") for number in range(100)]
LEASE_NS = 2 * 10**9


class Log:
    """A log with nothing new, whose answers come when they are asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Callable[[list[Any]], None]]] = []

    def fetch(self, _: str, __: object, first: Callable[[list[Any]], None], ___: object) -> None:
        first([])

    def look(self, checkpoint: Checkpoint, then: Callable[[list[Any]], None]) -> None:
        self.asked.append((checkpoint.stream, then))


def test_many_silent_streams_read_the_log_a_few_at_a_time() -> None:
    """Each of them has its turn, and reads seldom while it is silent for long; one that has frames reads none."""
    around, log = Around(), Log()
    streams = streams_of(around, log=log, cluster=("nats://127.0.0.1:1",), lease_s=2)
    now_ns = time.monotonic_ns()  # before the frames, however long it takes to track them
    for sensor in SENSORS:
        streams.receive(packet_of(sensor.detections(0)))
    around.run()
    streams.sweep(now_ns + 10**9)
    around.run()
    assert not log.asked
    most, seen, reads = 0, set(), 0
    for _ in range(400):
        now_ns += LEASE_NS
        streams.sweep(now_ns)
        around.run()
        most, reads = max(most, len(log.asked)), reads + len(log.asked)
        seen |= {stream for stream, _ in log.asked}
        for _, then in log.asked:
            then([])
        log.asked.clear()
        around.run()
    assert seen == {sensor.stream for sensor in SENSORS}
    assert most <= 32
    assert 400 * len(SENSORS) / 9 < reads < 400 * len(SENSORS) / 7

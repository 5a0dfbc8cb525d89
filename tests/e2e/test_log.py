"""The log of detections: a successor elsewhere knows what nobody tracked, also of publishers without a cache."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest
from fleet import Fleet
from log_process import LogProcess
from nats_process import NatsProcess
from router import Node, Sensor
from takeovers import check

import optipmb

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from service_process import ServiceProcess

SENSORS = [Sensor(stream=f"site/node-{number}/lidar") for number in range(3)]


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    optipmb.warm_up()


class Logged:
    """A router, a NATS server, and a bridge between them that receives; members come and go."""

    def __init__(self, folder: Path, fleet: Fleet, nats: NatsProcess, bridge: LogProcess, node: Node) -> None:
        self.nats, self.bridge, self.node = nats, bridge, node
        self._folder, self._fleet = folder, fleet

    def member(self, instance: str, **settings: object) -> ServiceProcess:
        """Start a member with a folder of its own."""
        return self._fleet.service(instance, cluster=self.nats.url, store=self._folder / instance, **settings)

    def send(self, first: int, last: int) -> None:
        """Publish frames of all streams without caches, at the rate of a sensor."""
        for seq in range(first, last):
            self.node.send_plain(*(sensor.detections(seq) for sensor in SENSORS))
            time.sleep(0.05)  # the rate of a sensor, not a wait for anything

    def check(self, frames: int, owner: str) -> None:
        """All frames of all streams have been tracked as if nothing had happened."""
        for sensor in SENSORS:
            check(self.node, frames, owner=owner, sensor=sensor)


@pytest.fixture
def logged(tmp_path: Path) -> Iterator[Logged]:
    """Without members."""
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") as nats,
        Fleet(tmp_path) as fleet,
        Node(fleet.endpoint) as node,
        LogProcess(fleet.endpoint, nats.url) as bridge,
    ):
        bridge.wait_receiving(node)
        yield Logged(tmp_path, fleet, nats, bridge, node)


@pytest.mark.timeout(600)
def test_a_successor_reads_what_nobody_tracked(logged: Logged) -> None:
    """A member is killed, frames come while there is none, another one goes on from its checkpoint, to the byte.

    The publishers have no caches, and the successor was not there. So it is before the first checkpoint, too.
    """
    logged.send(0, 10)
    first = logged.member("a")
    logged.send(10, 30)
    logged.check(30, "a")
    first.process.kill()
    first.process.wait()
    logged.send(30, 60)
    logged.member("b")
    logged.send(60, 70)
    logged.check(70, "b")

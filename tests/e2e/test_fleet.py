"""Several service processes on one router, with one store: killed, frozen, ended, cut off."""

from __future__ import annotations

import resource
import time
from typing import TYPE_CHECKING

import pytest
from fleet import Fleet, freeze, thaw
from optipmb_client import Publisher
from optipmb_schemas import ServiceStatus
from router import Node, until
from takeovers import KEYS, SENSOR, check, outage_s, published_by, send

import optipmb

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    optipmb.warm_up()


@pytest.mark.timeout(300)
def test_who_stands_by_takes_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fault 17: SIGKILL of the owner, then SIGSTOP of its successor: each time another goes on, to the byte.

    The frozen one finds its write lease lapsed when it wakes up, publishes nothing more and stands by.
    """
    with Fleet(tmp_path) as fleet, Node(fleet.endpoint) as node:
        first = fleet.service("a")
        send(node, 0, 10)
        check(node, 10, owner="a")
        frozen = fleet.service("b")
        send(node, 10, 20)
        check(node, 20, owner="a")
        first.process.kill()
        killed_ns = time.monotonic_ns()
        send(node, 20, 40)
        check(node, 40, owner="b")
        at_once_s = outage_s(node, killed_ns)
        fleet.service("c")
        send(node, 40, 45)
        freeze(frozen)
        frozen_ns = time.monotonic_ns()
        send(node, 45, 100, 0.1)
        check(node, 100, owner="c")
        lease_s = outage_s(node, frozen_ns)
        before = len(published_by(node, "b"))
        thaw(frozen)
        frozen.wait_log("superseded")
        send(node, 100, 110)
        state = check(node, 110, owner="c")
        assert len(published_by(node, "b")) == before
        assert frozen.end()[0] == 0
    accounted = state.frames + state.duplicates + state.late + state.refused + state.shed + state.queue
    assert state.received == accounted
    with capsys.disabled():
        print(f"\ntakeover after a kill {at_once_s:.2f} s, after a freeze {lease_s:.2f} s (lease 2 s)")  # noqa: T201 - the figure


@pytest.mark.timeout(600)
def test_terminated_in_the_middle(tmp_path: Path) -> None:
    """Fault 18: SIGTERM among frames under way: status 0 in time, and the next process goes on to the byte.

    Fault 1: of a publisher that keeps clouds and began in between, it gets frames and clouds from the caches.
    """
    box = {"label": ["car"], "center": [[0, 0, 1]], "size": [[4, 2, 1.5]], "yaw": [0], "score": [0.9]}
    cloud = [[x / 10, 0.0, 1.0] for x in range(20)]
    with (
        Fleet(tmp_path) as fleet,
        Node(fleet.endpoint) as node,
        Publisher("site/node/late", fleet.endpoint, frame="world", cache_clouds=10) as publisher,
    ):
        service = fleet.service("a")
        node.send(*(SENSOR.detections(seq) for seq in range(50)))
        node.tracks(SENSOR.stream, 10)
        status, seconds = service.end()
        assert status == 0
        assert '"drained": false' not in service.errors
        assert seconds < 60.0
        node.send(*(SENSOR.detections(seq) for seq in range(50, 60)))
        for seq in range(5):
            publisher.publish(stamp_ns=SENSOR.stamp_ns(seq), points=cloud, **box)
        fleet.service("a", cloud_wait_s=30.0)
        assert [tracks.cloud_used for tracks in node.tracks("site/node/late", 5)] == [True] * 5
        check(node, 60, owner="a")


@pytest.mark.timeout(600)
def test_a_router_that_is_killed(tmp_path: Path) -> None:
    """Fault 16: no router for longer than the lease: the owner looks, goes on, recovers all, applies nothing twice."""
    with Fleet(tmp_path, lease_s=1.0) as fleet, Node(fleet.endpoint) as node:
        service = fleet.service("a")
        send(node, 0, 10)
        node.tracks(SENSOR.stream, 10)
        fleet.router.kill()
        send(node, 10, 40)
        service.wait_log("write_lease_lapsed")
        fleet.router.start()
        send(node, 40, 45)
        state = check(node, 45, owner="a")
        assert state.duplicates + state.frames == state.received


@pytest.mark.timeout(600)
def test_a_full_disk(tmp_path: Path) -> None:
    """Fault 19: no byte more can be written: tracking goes on, the status says degraded; with room again it is ready.

    What was tracked meanwhile is kept then: the next process goes on to the byte.
    """
    with Fleet(tmp_path, checkpoint_s=0.1) as fleet, Node(fleet.endpoint) as node:
        service = fleet.service("a")

        def state() -> str:
            return node.ask(KEYS.status("a"), ServiceStatus).state

        send(node, 0, 10)
        check(node, 10, owner="a")
        pid = service.process.pid
        soft, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, hard))
        send(node, 10, 20)
        until(lambda: state() == "degraded", "the status says degraded")
        check(node, 20, owner="a")
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
        until(lambda: state() == "ready", "the store has healed")
        service.process.kill()
        service.process.wait()
        fleet.service("a")
        send(node, 20, 30)
        check(node, 30, owner="a")

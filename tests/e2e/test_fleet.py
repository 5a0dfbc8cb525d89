"""A service process and a router: ended, cut off, without room on its disk."""

import resource
import shutil
import time
from dataclasses import replace
from pathlib import Path

from fleet import Fleet
from optipmb_client import Publisher
from optipmb_schemas import ServiceStatus
from router import Node, until
from takeovers import KEYS, SENSOR, check, published_by, send


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
        status, _ = service.end()
        assert status == 0
        assert '"drained": false' not in service.errors
        node.send(*(SENSOR.detections(seq) for seq in range(50, 60)))
        for seq in range(5):
            publisher.publish(stamp_ns=SENSOR.stamp_ns(seq), points=cloud, **box)
        fleet.service("a", cloud_wait_s=30.0)
        assert [tracks.cloud_used for tracks in node.tracks("site/node/late", 5)] == [True] * 5
        check(node, 60, owner="a")


def test_a_router_that_is_killed(tmp_path: Path) -> None:
    """Fault 16: no router for longer than the lease: the owner goes on, recovers all, applies nothing twice."""
    with Fleet(tmp_path, lease_s=1.0) as fleet, Node(fleet.endpoint) as node:
        service = fleet.service("a")
        send(node, 0, 10)
        node.tracks(SENSOR.stream, 10)
        fleet.router.kill()
        send(node, 10, 40)
        service.wait_log("peer_lost")
        fleet.router.start()
        send(node, 40, 45)
        state = check(node, 45, owner="a")
        assert state.duplicates + state.frames == state.received


def test_all_that_a_cache_holds_is_tracked_after_an_outage(tmp_path: Path) -> None:
    """As many frames as come at once from a cache wait for the session, however slow that is: none is shed."""
    frames, busy = 800, replace(SENSOR, objects=40)
    with Fleet(tmp_path) as fleet, Node(fleet.endpoint) as node:
        service = fleet.service("a")
        send(node, 0, 10, sensors=[busy])
        node.tracks(busy.stream, 10)
        fleet.router.kill()
        service.wait_log("peer_lost")
        send(node, 10, frames, pace_s=0.0, sensors=[busy])
        fleet.router.start()
        state = check(node, frames, owner="a", sensor=busy)
    assert (state.shed, state.gaps) == (0, 0)


def test_a_store_that_is_deleted_while_in_use(tmp_path: Path) -> None:
    """The folder is made again with all that it held: its members go on, and so does one that starts after a kill."""
    store = tmp_path / "store"
    with Fleet(store, checkpoint_s=0.1) as fleet, Node(fleet.endpoint) as node:
        services = [fleet.service(name) for name in "ab"]
        send(node, 0, 10)
        node.tracks(SENSOR.stream, 10)
        for last in (20, 30):
            shutil.rmtree(store)
            send(node, last - 10, last)
            files = [store / "sessions.db", store / "leases.db"]
            until(lambda: all(file.exists() for file in files), "both files are there again")  # noqa: B023 - called here
        for service in services:
            service.wait_log("store_deleted")
        (owner,) = {KEYS.instance_of(key) for key in node.alive(KEYS.all_owners())}
        session = check(node, 30, owner=owner).session
        assert not any("lease_lost" in service.errors for service in services)
        time.sleep(0.5)  # several times `checkpoint_s`
        for service in services:
            service.process.kill()
            service.process.wait(60)
        fleet.service("c")
        send(node, 30, 40)
        state = check(node, 40, owner="c")
    assert (state.session, state.gaps) == (session, 0)


def test_killed_before_its_first_checkpoint(tmp_path: Path) -> None:
    """Fault 2: a member that begins the session once more publishes under a higher run, which replaces the others."""
    with Fleet(tmp_path, checkpoint_s=3600.0) as fleet, Node(fleet.endpoint) as node:
        runs: list[set[int]] = []
        for instance in "abc":
            service = fleet.service(instance)
            node.send(*(SENSOR.detections(seq) for seq in range(5)))
            until(lambda instance=instance: len(published_by(node, instance)) == 5, "its tracks")  # type: ignore[misc]  # bound now
            runs.append({one.delivery.run for one in published_by(node, instance) if one.delivery})
            service.process.kill()
            service.process.wait(60)
    assert [len(one) for one in runs] == [1, 1, 1]
    assert max(runs[0]) < max(runs[1]) < max(runs[2])


def test_a_full_disk(tmp_path: Path) -> None:
    """Fault 19: no byte more can be written: tracking goes on, the status says degraded; with room again it is ready.

    The frames tracked meanwhile are kept then: the next process goes on to the byte.
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
        service.process.wait(60)
        fleet.service("a")
        send(node, 20, 30)
        check(node, 30, owner="a")
